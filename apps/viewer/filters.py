"""Which points are shown: those within limits of range, intensity and time, and within a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar import PointCloud

Limits = tuple[float, float]
NO_LIMITS: Limits = (-np.inf, np.inf)


@dataclass(frozen=True)
class Filters:
    """Limits, all of them inclusive; a point must keep every one.

    Parameters
    ----------
    range : (float, float)
        m.
    intensity : (float, float)
        Counts, referred to 1 m.
    time : (float, float)
        Time of flight, s.
    x, y, z : (float, float)
        Sides of the box, m.

    Raises
    ------
    InputError
        A lower limit above its upper one.
    """

    range: Limits = NO_LIMITS
    intensity: Limits = NO_LIMITS
    time: Limits = NO_LIMITS
    x: Limits = NO_LIMITS
    y: Limits = NO_LIMITS
    z: Limits = NO_LIMITS

    def __post_init__(self) -> None:
        for name, (low, high) in vars(self).items():
            if not low <= high:
                raise InputError(f"the limits of {name} must rise, got {low:g} and {high:g}")

    def select(self, cloud: PointCloud) -> NDArray[np.bool_]:
        """Return for each point whether it is shown, (n,)."""
        kept = np.ones(len(cloud), bool)
        columns = {"range": cloud.range, "intensity": cloud.intensity, "time": cloud.time}
        columns |= dict(zip("xyz", cloud.xyz.T, strict=True))
        for name, values in columns.items():
            low, high = getattr(self, name)
            # Limits that are not set cost no comparison, and keep NaN.
            if low > -np.inf:
                kept &= values >= np.float32(low)
            if high < np.inf:
                kept &= values <= np.float32(high)
        return kept
