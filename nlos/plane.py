"""Evenly spaced points of a plane before the hidden scene: a planar wall, or a virtual one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError

FloatArray = NDArray[np.float64]

EVENNESS_TOLERANCE = 1e-3
"""Points may be off an even spacing by this fraction of it; at half a wavelength that is a phase of
3 mrad.
"""


@dataclass(frozen=True, eq=False)
class Plane:
    """Points at all combinations of x and y on the plane z = const.

    Parameters
    ----------
    x, y : (n,) array
        Evenly spaced and increasing, m; at least 2 of each.
    z : float
        m.

    Raises
    ------
    ShapeError, InputError
        An axis is too short, not evenly spaced or not increasing, or a number is not finite.
    """

    x: FloatArray
    y: FloatArray
    z: float

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            axis = np.array(getattr(self, name), dtype=np.float64)
            if axis.ndim != 1 or axis.size < 2:
                raise ShapeError(f"axis {name} of a plane", "(n,) with n >= 2", axis.shape)
            if not is_evenly_spaced(axis):
                raise InputError(
                    f"axis {name} of a plane must be finite, increasing and evenly spaced"
                )
            object.__setattr__(self, name, axis)
        object.__setattr__(self, "z", float(self.z))
        if not np.isfinite(self.z):
            raise InputError(f"a plane needs a finite z, got {self.z}")

    @property
    def shape(self) -> tuple[int, int]:
        """Points along (y, x)."""
        return self.y.size, self.x.size

    @property
    def steps(self) -> tuple[float, float]:
        """Distance of neighbouring points along y and x, m."""
        return axis_step(self.y), axis_step(self.x)

    @property
    def points(self) -> FloatArray:
        """Position of every point, m, shape (y, x, 3)."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return np.stack([x, y, np.full_like(x, self.z)], axis=-1)


def axis_step(axis: FloatArray) -> float:
    """Distance of neighbouring entries of an evenly spaced axis."""
    # from end to end, where rounding of single points matters least
    return float(axis[-1] - axis[0]) / (axis.size - 1)


def is_evenly_spaced(axis: FloatArray) -> bool:
    """Whether an axis increases in equal steps; a single entry does."""
    if not np.all(np.isfinite(axis)):
        return False
    if axis.size < 2:
        return True
    spacing = axis_step(axis)
    even = axis[0] + spacing * np.arange(axis.size)
    return bool(spacing > 0 and np.max(np.abs(axis - even)) <= EVENNESS_TOLERANCE * spacing)
