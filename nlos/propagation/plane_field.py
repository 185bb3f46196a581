"""The virtual plane, and the field on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import Grid
from nlos.plane import Plane
from nlos.rsd.transfer import SphericalWaves

FloatArray = NDArray[np.float64]

MIN_GAP_M, MAX_GAP_M = 0.05, 0.1
"""The virtual plane keeps this far from the foremost wall point, m."""


@dataclass(frozen=True, eq=False)
class PlaneField:
    """Phasors of every frequency of a band on a plane.

    Parameters
    ----------
    values : (y, x, frequencies) complex64 array
        ``S_k(r_v) = sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|``, of the library of
        the capture's signal.
    plane : Plane
    wavenumbers : (frequencies,) array
        Of the waves on the plane, rad/m: the band's, doubled for a confocal scan.
    """

    values: NDArray[np.complex64]
    plane: Plane
    wavenumbers: FloatArray


def choose_virtual_plane(
    points: FloatArray, grid: Grid, waves: SphericalWaves, zones: float, z: float | None = None
) -> Plane:
    """Choose a plane between a wall and the hidden scene that misses little of what passes.

    It holds the straight way from every wall point to every voxel behind it, and around these some
    Fresnel zones of the middle wave; its points are half the shortest wavelength apart.

    Parameters
    ----------
    points : (n, 3) array
        Wall points, m.
    grid : Grid
    waves : SphericalWaves
    zones : float
        Room beside the straight ways, in radii of the first Fresnel zone.
    z : float, optional
        Where, m. Defaults to the shortest wavelength, but 5 to 10 cm, in front of the foremost wall
        point.

    Returns
    -------
    Plane
    """
    low, high = points.min(axis=0), points.max(axis=0)
    shortest, middle = (
        2 * np.pi / waves.max_wavenumber,
        4 * np.pi / (waves.first + waves.max_wavenumber),
    )
    if z is None:
        z = float(high[2] + np.clip(shortest, MIN_GAP_M, MAX_GAP_M))
    gap = z - float(low[2])
    behind = grid.z[grid.z > z]
    weight = gap / (gap + float(behind[0]) - z) if behind.size else 1.0
    room = zones * np.sqrt(middle * gap)
    axes = []
    for first, last, voxels in zip(low[:2], high[:2], (grid.x, grid.y), strict=True):
        start = first + weight * min(0.0, voxels[0] - first) - room
        stop = last + weight * max(0.0, voxels[-1] - last) + room
        count = max(1, int(np.ceil((stop - start) / (shortest / 2))))
        axes.append(np.linspace(start, stop, count + 1))
    return Plane(axes[0], axes[1], z)
