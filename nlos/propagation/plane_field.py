"""The virtual plane, and the field on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane

FloatArray = NDArray[np.float64]

NEAREST_GAP, WIDEST_GAP = 0.05, 0.1
"""The virtual plane keeps this far from the foremost wall point, m."""


@dataclass(frozen=True, eq=False)
class PlaneField:
    """Phasors of every frequency of a band on a plane.

    Parameters
    ----------
    values : (y, x, frequencies) complex64 array
        ``S_k(r_v) = sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|``.
    plane : Plane
    wavenumbers : (frequencies,) array
        Of the waves on the plane, rad/m: the band's, doubled for a confocal scan.
    """

    values: NDArray[np.complex64]
    plane: Plane
    wavenumbers: FloatArray


def virtual_plane(points: FloatArray, shortest: float, widening: float, z: float | None = None) -> Plane:
    """Choose a plane in front of a wall.

    Parameters
    ----------
    points : (n, 3) array
        Wall points, m.
    shortest : float
        Shortest wavelength that the plane has to carry, m; its points are half of it apart.
    widening : float
        Width and height relative to the wall's.
    z : float, optional
        Where, m. Defaults to the shortest wavelength, but 5 to 10 cm, in front of the foremost wall point.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    if z is None:
        z = float(high[2] + np.clip(shortest, NEAREST_GAP, WIDEST_GAP))
    # A wall that is a line or a point still radiates into all directions.
    extent = max(float(np.max(high[:2] - low[:2])), shortest)
    axes = []
    for first, last in zip(low[:2], high[:2], strict=True):
        half = widening * max(last - first, extent / 2) / 2
        count = int(np.ceil(half / (shortest / 2)))
        axes.append((first + last) / 2 + np.linspace(-half, half, 2 * count + 1))
    return Plane(axes[0], axes[1], z)
