"""The time axis of a capture, given as lengths of path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

MIN_BINS = 2


@dataclass(frozen=True)
class TimeAxis:
    """Evenly spaced time bins.

    Parameters
    ----------
    bins : int
        How many; at least 2.
    bin_width : float
        Duration of a bin, s.
    start : float
        Length of the path laser spot -> hidden point -> wall point that bin 0 holds, m.

    Raises
    ------
    InputError
        Too few bins, a width that is not positive, or a number that is not finite.
    """

    bins: int
    bin_width: float
    start: float = 0.0

    def __post_init__(self) -> None:
        if self.bins < MIN_BINS:
            raise InputError(f"a transient needs at least {MIN_BINS} time bins, got {self.bins}")
        if not (np.isfinite(self.bin_width) and self.bin_width > 0):
            raise InputError(
                f"bin width must be a positive number of seconds, got {self.bin_width}"
            )
        if not np.isfinite(self.start):
            raise InputError(
                f"the path length of bin 0 must be a finite number of metres, got {self.start}"
            )

    @property
    def spacing(self) -> float:
        """Path that light travels during one bin, m."""
        return SPEED_OF_LIGHT * self.bin_width

    @property
    def paths(self) -> NDArray[np.float64]:
        """Path length of every bin, m, shape (bins,)."""
        return self.start + self.spacing * np.arange(self.bins, dtype=np.float64)
