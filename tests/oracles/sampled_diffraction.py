"""Diffraction by convolution with the sampled wave: exact for sources and voxels of one lattice,
and slow.

What the quick way answers to where direct sums would take too long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.phasor.transfer import SphericalWaves
from nlos.plane import Plane, axis_step
from nlos.volume import Grid
from tofclip.errors import InputError


def diffract_by_convolution(
    values: NDArray[Any], plane: Plane, grid: Grid, waves: SphericalWaves
) -> NDArray[np.complex128]:
    """Return the field of every frequency at every voxel, complex128, shape (frequencies, z, y, x).

    Parameters
    ----------
    values : (y, x, frequencies) complex array
        On `plane`.
    plane : Plane
    grid : Grid
        Its voxels are as far from each other as the plane's points.
    waves : SphericalWaves
        Waves of points; one complex128 number per voxel and frequency has to fit into memory.

    Returns
    -------
    (frequencies, z, y, x) complex128 array

    Raises
    ------
    InputError
        The voxels are not as far from each other as the points, or the waves are not those of
        points.
    """
    from scipy.fft import fft2, ifft2

    pitches = (axis_step(grid.y), axis_step(grid.x))
    if waves.continued or not np.allclose(pitches, plane.steps):
        raise InputError(
            "the sampled wave is that of points, at voxels as far from each other as the points"
        )
    # linear convolution: a period as long as both together
    lattice = tuple(a + b - 1 for a, b in zip(plane.shape, grid.shape[1:], strict=True))
    spectrum = fft2(values.astype(np.complex128), lattice, axes=(0, 1))
    wavenumbers = waves.first + waves.step * np.arange(waves.count)
    # Offsets from the last source to the first voxel up to from the first source to the last voxel.
    y, x = (
        start[0] - end[-1] + pitch * np.arange(count)
        for start, end, pitch, count in zip(
            (grid.y, grid.x), (plane.y, plane.x), pitches, lattice, strict=True
        )
    )
    field = np.empty((waves.count, *grid.shape), np.complex128)
    for i, depth in enumerate(grid.z):
        path = np.sqrt(y[:, np.newaxis] ** 2 + x**2 + (depth - plane.z) ** 2)
        kernel = np.exp(1j * path[..., np.newaxis] * wavenumbers) / path[..., np.newaxis]
        full = ifft2(spectrum * fft2(kernel, axes=(0, 1)), axes=(0, 1))
        rows, columns = plane.shape
        # offsets before the first voxel belong to the lattice, not to the grid
        field[:, i] = np.moveaxis(full[rows - 1 :, columns - 1 :], -1, 0)
    return field
