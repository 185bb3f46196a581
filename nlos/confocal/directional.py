"""The directional light-cone transform: albedo and normals of a confocal scan by one deconvolution."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.confocal.light_cone import (
    LightCone,
    tabulate_powers,
    transform_squared_distances,
)
from nlos.confocal.scan import ConfocalScan, resample_to_grid
from nlos.front_surface import (
    FrontSurface,
    build_front_surface,
    find_front_surface,
    require_surface,
)
from nlos.geometry import Grid
from nlos.volume import Volume
from tofclip.arrays import ComputeDevice
from tofclip.errors import InputError
from tofclip.threads import run_blocks, thread_count

FREQUENCIES_PER_BLOCK = 8


@dataclass(frozen=True)
class DirectionalLightCone:
    """Surfaces with normals from a confocal scan.

    A matte facet of albedo times normal v at x returns ``<x' - x, v> / d^(falloff + 1)`` to the
    wall point x'. With u = z^2 and w = d^2 (see `LightCone`) the signals, multiplied by d^(falloff
    + 1), are the sum of three convolutions over x, y and u: of v_x with ``x * h``, of v_y with ``y
    * h``, of ``-z * v_z`` with h, the paraboloid. All three follow from one Wiener filter.

    Young, Lindell, Girod, Taubman, Wetzstein, "Non-line-of-sight surface reconstruction using the
    directional light-cone transform", CVPR 2020.
    """

    transform: LightCone = field(default_factory=LightCone)  # its Wiener filter and falloff

    def find_front_surface(
        self, capture: Capture, grid: Grid, fraction: float = 0.3
    ) -> FrontSurface:
        """Find depth, albedo and normal on every line of sight.

        `capture`: as of `LightCone`; `grid`: at least 3 voxels along every axis; `fraction`: A line
        of sight shows a surface where its brightest voxel has this fraction of the brightest of
        all.
        """
        # Refuses what the transform cannot image.
        self.transform.plan(capture, grid)
        scan = ConfocalScan.of(capture, grid)
        vectors = self._deconvolve(scan, grid)
        volume = Volume(np.linalg.norm(vectors, axis=0).astype(np.float32), grid)
        require_surface(volume.magnitude, fraction)
        peak = volume.magnitude.argmax(axis=0)
        rows, columns = np.indices(peak.shape)
        normals = np.moveaxis(vectors[:, peak, rows, columns], 0, -1)
        found = build_front_surface(volume, normals, fraction)
        return replace(found, source="directional light-cone transform")

    def _deconvolve(self, scan: ConfocalScan, grid: Grid) -> NDArray[np.float32]:
        """Return albedo times normal, (3, z, y, x)."""
        from scipy.fft import ifft2, irfft

        bins, workers = scan.signal.shape[2], thread_count()
        squares = bins * scan.spacing**2
        # By one power more than the transform without directions.
        falloff = self.transform.falloff + 1
        spectrum, shape = transform_squared_distances(scan, squares, falloff)
        unit = float(grid.z.mean() - scan.plane.z)
        parts = _separate(spectrum, scan, squares, shape, unit, 1 / self.transform.signal_to_noise)
        depth = grid.z - scan.plane.z
        position = np.clip(depth**2 / squares - 0.5, 0, bins - 1)
        vectors = np.empty((3, *grid.shape), np.float32)
        for number, part in enumerate(parts):
            image = irfft(ifft2(part, axes=(0, 1), workers=workers), shape[2], workers=workers)
            vectors[number] = resample_to_grid(image[..., :bins], scan, grid, position)
        vectors[2] *= (-unit / np.maximum(depth, scan.spacing))[:, np.newaxis, np.newaxis]
        return vectors


def _separate(
    spectrum: NDArray[np.complex64],
    scan: ConfocalScan,
    squares: float,
    shape: tuple[int, int, int],
    unit: float,
    floor: float,
) -> NDArray[np.complex64]:
    """Spectra (3, ky, kx, w) of v_x, v_y and ``-z * v_z / unit``, by a Wiener filter; lengths in
    the kernels are in multiples of `unit`.
    """
    from scipy.fft import fft2

    y, x = (
        length * np.fft.fftfreq(n, 1 / n)
        for length, n in zip(scan.plane.steps, shape[:2], strict=True)
    )
    # In coordinates of squared time a point's light is a paraboloid, late by the square of the
    # distance across: the same at every depth, hence one convolution for all.
    late = (y[:, np.newaxis] ** 2 + x**2) / squares
    whole = np.floor(late)
    weight = (late - whole)[..., np.newaxis]
    height = (whole < shape[2] - 1) / np.sqrt(shape[0] * shape[1])
    sides = np.stack(np.broadcast_arrays(x / unit, y[:, np.newaxis] / unit, 1.0))
    parts = np.empty((3, *spectrum.shape), np.complex64)

    def process_block(some: slice) -> None:
        # A delay of a whole number of bins is a power of one phase; the fraction is shared between
        # two bins, as in time.
        turn = np.exp(-2j * np.pi * np.arange(some.start, some.stop) / shape[2])
        column = tabulate_powers(turn, whole.astype(np.intp), shape[2], some.start)
        column = column * ((1 - weight + weight * turn) * height[..., np.newaxis])
        kernels = fft2(sides[..., np.newaxis] * column, axes=(1, 2)).astype(np.complex64)
        # Wiener: the floor is the noise over the signal; the three components are what explains the
        # signal with the least power.
        gain = spectrum[..., some] / (np.sum(np.abs(kernels) ** 2, axis=0) + np.float32(floor))
        parts[..., some] = kernels.conj() * gain

    run_blocks(process_block, spectrum.shape[2], FREQUENCIES_PER_BLOCK)
    return parts


def find_imaged_surface(capture: Capture, volume: Volume, fraction: float = 0.3) -> FrontSurface:
    """Find the front surface of a capture that has been imaged: by the directional light-cone
    transform where it takes the capture, else from the volume's gradients.

    `capture`: that the volume was made of; `volume`: whose voxels are taken; `fraction`: A line of
    sight shows a surface where its brightest voxel has this fraction of the brightest of all.
    """
    here = volume.on(ComputeDevice())
    require_surface(here.magnitude, fraction)
    try:
        return DirectionalLightCone().find_front_surface(
            capture.on(ComputeDevice()), volume.grid, fraction
        )
    except InputError:
        return find_front_surface(here, fraction)
