"""How far waves are followed, and periodic lattices in which their images keep off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane

FloatArray = NDArray[np.float64]
Sides = tuple[float, float]

INNER_RADIUS_FRACTION = 0.88
"""Where the window begins to fall at least, relative to the largest distance of a source and a
target.
"""

MIN_EDGE_FRACTION, MAX_EDGE_FRACTION = 0.25, 0.5
"""Width of the window's edge, relative to the largest distance along one axis."""

SPREAD_FACTOR = 0.6
"""Widening of a grazing wave's spectrum by the window's edge, per squared digit of the tolerance and edge width;
measured on point scenes."""

FFT_LENGTH_FACTORS = (1, 3, 5, 15, 25)
"""Of these times a power of 2, single-precision Fourier transforms take half as long as of other
lengths; measured.
"""

VECTOR_LENGTH = 8
"""complex64 numbers in 64 bytes: where vector instructions like rows to start."""


@dataclass(frozen=True)
class Window:
    """A circle about every source, outside of which its wave is cut off smoothly.

    Parameters
    ----------
    inner_radius, outer_radius : float
        Radii up to which waves are whole, and from which on they are gone, m.
    """

    inner_radius: float
    outer_radius: float

    @classmethod
    def within(cls, farthest: Sides, periods: Sides) -> Window:
        """Return the widest window that lets no image of a source in a periodic lattice meet a
        target.

        Parameters
        ----------
        farthest : (float, float)
            As `find_max_offsets` gives it.
        periods : (float, float)
            Along y and x, m; at least `find_min_periods`.

        Returns
        -------
        Window
        """
        corner, along = float(np.hypot(*farthest)), max(farthest)
        # beyond this distance the next period's image of a source would meet a target
        room = min(period - far for period, far in zip(periods, farthest, strict=True))
        reach = min(corner, room - MIN_EDGE_FRACTION * along)
        return cls(reach, min(room, reach + MAX_EDGE_FRACTION * along))

    def spectral_spread(self, tolerance: float) -> float:
        """Lateral wavenumbers by which the window's edge spreads grazing waves, rad/m."""
        return float(
            SPREAD_FACTOR * np.log10(tolerance) ** 2 / (self.outer_radius - self.inner_radius)
        )


def find_max_offsets(sources: Plane, y: FloatArray, x: FloatArray) -> Sides:
    """Return the largest distance of a source on a plane from a target along y and along x, m.

    Parameters
    ----------
    sources : Plane
    y, x : (n,) float64 array
        Coordinates of the targets, ascending, m.

    Returns
    -------
    (float, float)
        Along y and along x, m.
    """
    pairs = ((y, sources.y), (x, sources.x))
    along_y, along_x = (float(max(abs(a[-1] - b[0]), abs(a[0] - b[-1]))) for a, b in pairs)
    return along_y, along_x


def find_min_periods(farthest: Sides) -> Sides:
    """Return the shortest periods along y and x in which a window has room, m."""
    edge = INNER_RADIUS_FRACTION * float(np.hypot(*farthest)) + MIN_EDGE_FRACTION * max(farthest)
    y, x = (edge + far for far in farthest)
    return y, x


def find_fast_length(count: float) -> int:
    """Next length that Fourier transforms are quick at."""
    # products of small factors, and of a vector's length
    lengths = (
        factor * 2 * VECTOR_LENGTH << power for factor in FFT_LENGTH_FACTORS for power in range(20)
    )
    return min(length for length in lengths if length >= count)
