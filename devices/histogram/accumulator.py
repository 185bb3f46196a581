"""Bins of time, and the sum over everything that was put into them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.shots import Streak
from tofclip.threads import run_blocks, thread_count

MAX_CELLS = 1 << 26
"""Bins of all pixels together: half a gigabyte for each thread."""

MIN_WIDTH_BINS = 1e-3
"""Bins over which a photon is shared out at least; a step of no width would be infinitely high."""

ROUNDING_PHOTONS = 1e-6
"""Photons in a bin that are rounding errors of adding up steps, not photons."""

_MIN_PIECE = 1 << 16


@dataclass(frozen=True)
class BinAxis:
    """Bins of equal width; bin k lies around ``start + k * bin_width``.

    Parameters
    ----------
    bin_width : float
        s.
    bins : int
    start : float
        Middle of the first bin, s after the laser's pulse.
    period : float or None
        Time between two pulses of the laser, s: photons of all periods add up. None: there is one
        pulse only, or every photon is already counted from its own pulse.

    Raises
    ------
    InputError
        A number is not positive and finite, or the bins are longer than the period.
    """

    bin_width: float
    bins: int
    start: float = 0.0
    period: float | None = None

    def __post_init__(self) -> None:
        if not (
            math.isfinite(self.bin_width)
            and self.bin_width > 0
            and math.isfinite(self.start)
            and self.bins >= 1
        ):
            raise InputError(f"bins need a positive width, a number and a start, got {self}")
        if self.period is None:
            return
        if not (math.isfinite(self.period) and self.period > 0):
            raise InputError(
                f"the laser's period must be a positive number of seconds, got {self.period}"
            )
        # A relative tolerance, because a width is often computed as period / bins.
        if self.bins * self.bin_width > self.period * (1 + 1e-9):
            raise InputError(
                f"{self.bins} bins of {self.bin_width:.4g} s are longer than the laser's period of {self.period:.4g} s"
            )

    @property
    def times(self) -> NDArray[np.float64]:
        """Middle of each bin, s."""
        times: NDArray[np.float64] = self.start + np.arange(self.bins) * np.float64(self.bin_width)
        return times

    @property
    def shift_bins(self) -> float:
        """Where the laser's pulse lies, bins."""
        return 0.5 - self.start / self.bin_width

    @property
    def period_bins(self) -> float:
        """Bins in the laser's period, 0 for none."""
        return 0.0 if self.period is None else self.period / self.bin_width


class Accumulator:
    """Photons of a line of pixels, added up over any number of batches.

    Memory: 8 bytes for each bin, pixel and thread, however many photons come.

    Parameters
    ----------
    pixels : int
    axis : BinAxis
    hot_pixels : sequence of int
        Pixels of which nothing can be believed.
    """

    def __init__(
        self, pixels: int, axis: BinAxis, hot_pixels: NDArray[np.int64] | tuple[int, ...] = ()
    ) -> None:
        if pixels < 1 or pixels * axis.bins > MAX_CELLS:
            raise InputError(
                f"{pixels} pixels of {axis.bins} bins are none, or more than {MAX_CELLS} cells"
            )
        self.pixels, self.axis = pixels, axis
        self._hot = np.asarray(hot_pixels, np.int64)
        self._parts: list[NDArray[np.float64]] = []

    @property
    def counts(self) -> NDArray[np.float64]:
        """Photons in each bin of each pixel so far, (bins, pixels); right to a millionth of a
        photon.
        """
        total = np.zeros((self.pixels, self.axis.bins + 2))
        for part in self._parts:
            total += part
        # steps add up to the density; the last two bins hold what lies beyond the axis
        photons = np.cumsum(total[:, : self.axis.bins], axis=1).T
        # steps up and down cancel to rounding only
        photons[photons < ROUNDING_PHOTONS] = 0
        return photons

    def to_streak(self, camera: Camera | None = None, source: str = "photon histogram") -> Streak:
        """Return the sum so far as a streak image: rows are instants after the laser's pulse,
        columns are pixels.

        Hot pixels are marked in ``Streak.saturated``, so that recovery does not rely on them.

        Parameters
        ----------
        camera : Camera, optional
        source : str
            What the streak image calls its source.

        Returns
        -------
        Streak
            Counts (bins, pixels) float32.

        Raises
        ------
        InputError
            No photon came.
        """
        counts = self.counts.astype(np.float32)
        untrusted = np.zeros(counts.shape, bool)
        untrusted[:, self._hot] = True
        return Streak(counts, self.axis.times, untrusted, camera=camera, source=source)

    def _add_in_parallel(self, add: Callable[[slice, NDArray[Any]], None], total: int) -> None:
        """Call `add` on pieces of ``range(total)``, each with an array of steps that no other
        thread uses.
        """
        size = max(_MIN_PIECE, -(-total // thread_count()))
        # a sum for each piece, so that threads never write to the same one
        while len(self._parts) * size < total:
            self._parts.append(np.zeros((self.pixels, self.axis.bins + 2)))
        run_blocks(lambda piece: add(piece, self._parts[piece.start // size]), total, size)
