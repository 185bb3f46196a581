"""What stands first on every line of sight from the wall: its depth, albedo and normal, from a
volume or, of a confocal scan, by the directional light-cone transform.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.confocal import (
    ConfocalScan,
    LightCone,
    image_squared_depths,
    transform_paraboloid,
    transform_squared_distances,
)
from nlos.export import require_surface, write_ply
from nlos.plane import axis_step
from nlos.volume import Grid, Volume
from tofclip.arrays import (
    AnyArray,
    BoolArray,
    ComplexArray,
    ComputeDevice,
    Float32Array,
    FloatArray,
)
from tofclip.errors import InputError
from tofclip.threads import run_blocks

# Standard deviation of the neighbourhood whose gradients give a normal, voxels.
GRADIENT_VOXELS = 2.0
# Neighbouring pixels whose depths differ by more, in voxels, are of different things.
MAX_STEP_VOXELS = 3.0
MIN_VOXELS = 3  # along every axis, of a volume that has surfaces


@dataclass(frozen=True, eq=False)
class FrontSurface:
    """The hidden surface that is seen from the wall, one point per pixel of the front view."""

    x: FloatArray  # (n,), pixels, m
    y: FloatArray  # (n,), pixels, m
    depth: Float32Array  # (y, x), m; NaN where nothing is seen
    albedo: Float32Array  # (y, x), brightness, 0 where nothing is seen
    # (y, x, 3), unit vectors that point to the wall's side (z < 0); NaN where nothing is seen
    normals: Float32Array
    source: str = "gradient of the volume"  # what depth and normals were found from

    @property
    def seen(self) -> BoolArray:
        """Pixels with a surface, (y, x)."""
        return np.isfinite(self.depth)

    @property
    def points(self) -> Float32Array:
        """Places of the pixels with a surface, (n, 3), m."""
        rows, columns = np.nonzero(self.seen)
        places: list[AnyArray] = [self.x[columns], self.y[rows], self.depth[rows, columns]]
        return np.stack(places, axis=-1).astype(np.float32)

    @property
    def faces(self) -> NDArray[np.int32]:
        """Triangles of neighbouring pixels of one thing: (m, 3) indices into `points`,
        counter-clockwise as seen from the wall.
        """
        index = np.full(self.depth.shape, -1, np.int32)
        index[self.seen] = np.arange(int(self.seen.sum()))
        corners = [part.ravel() for part in _list_corners(index)]
        depths = np.stack([part.ravel() for part in _list_corners(self.depth)])
        step = max(axis_step(axis) for axis in (self.x, self.y) if axis.size > 1)
        # NaN, where a corner is not seen, is not near.
        near = np.ptp(depths, axis=0) < MAX_STEP_VOXELS * step
        a, b, c, d = (corner[near] for corner in corners)
        return np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).astype(np.int32)

    def save(self, path: str | Path) -> None:
        """Write an oriented cloud that is a mesh as well, as binary PLY, whole or not at all."""
        faces = self.faces if min(self.depth.shape) > 1 else np.empty((0, 3), np.int32)
        vertices = [self.points, self.normals[self.seen], self.albedo[self.seen][:, np.newaxis]]
        names = ("x", "y", "z", "nx", "ny", "nz", "brightness")
        write_ply(path, names, np.concatenate(vertices, axis=1), faces, f"normals: {self.source}")


def find_front_surface(volume: Volume, fraction: float = 0.3) -> FrontSurface:
    """Find the front surface of a volume of at least 3 voxels along every axis, where brightness is
    `fraction` of the brightest; normals are directions in which it changes most.
    """
    from scipy.ndimage import gaussian_filter

    grid, magnitude = volume.grid, volume.magnitude.astype(np.float64)
    require_surface(magnitude, fraction, MIN_VOXELS)
    gradients = np.gradient(magnitude, grid.z, grid.y, grid.x)
    rows, columns = np.indices(magnitude.shape[1:])
    peak = magnitude.argmax(axis=0)
    tensor = np.empty((*peak.shape, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            # z, y, x of the gradients are 2, 1, 0 of the normal.
            mean = gaussian_filter(gradients[2 - i] * gradients[2 - j], GRADIENT_VOXELS)
            tensor[..., i, j] = tensor[..., j, i] = mean[peak, rows, columns]
    _, directions = np.linalg.eigh(tensor)
    return build_front_surface(volume, directions[..., 2], fraction)


def build_front_surface(volume: Volume, normals: AnyArray, fraction: float) -> FrontSurface:
    """Put together the surface of the brightest voxels; `normals` (y, x, 3) of any length and side."""
    grid, magnitude = volume.grid, volume.magnitude
    albedo = magnitude.max(axis=0)
    seen = albedo >= fraction * albedo.max()
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    towards = np.where(normals[..., 2:] > 0, -1.0, 1.0) / np.maximum(length, 1e-30)
    return FrontSurface(
        grid.x,
        grid.y,
        np.where(seen, _refine_peaks(magnitude, grid.z), np.nan).astype(np.float32),
        np.where(seen, albedo, 0).astype(np.float32),
        np.where(seen[..., np.newaxis], normals * towards, np.nan).astype(np.float32),
    )


def _refine_peaks(magnitude: NDArray[np.floating], z: FloatArray) -> FloatArray:
    """Depth (y, x) of the brightest voxel, between voxels by a parabola."""
    peak = magnitude.argmax(axis=0)
    inner = np.clip(peak, 1, z.size - 2)
    below, middle, above = (
        np.take_along_axis(magnitude, (inner + i)[np.newaxis], axis=0)[0].astype(np.float64)
        for i in (-1, 0, 1)
    )
    curvature = below - 2 * middle + above
    # Where the three do not bend downwards there is no vertex: dividing by -inf moves nothing.
    safe = np.where(curvature < 0, curvature, -np.inf)
    offset = np.where(peak == inner, (below - above) / (2 * safe), 0.0)
    step = float(np.median(np.diff(z)))
    return z[peak] + np.clip(offset, -0.5, 0.5) * step


def _list_corners(values: AnyArray) -> list[AnyArray]:
    """Upper left, upper right, lower left and lower right of every square of four pixels."""
    return [values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]]


FREQUENCIES_PER_BLOCK = 8


@dataclass(frozen=True)
class DirectionalLightCone:
    """Surfaces with normals from a confocal scan: a matte facet of albedo times normal v at x
    returns ``<x' - x, v> / d^(falloff + 1)`` to the wall point x'. Over u = z^2 and w = d^2 the
    signals, times d^(falloff + 1), are the sum of v_x with ``x * h``, v_y with ``y * h``, and ``-z
    * v_z`` with h, the paraboloid: one Wiener filter gives all three.

    Young, Lindell, Girod, Taubman, Wetzstein, CVPR 2020.
    """

    transform: LightCone = field(default_factory=LightCone)  # its Wiener filter and falloff

    def find_front_surface(
        self, capture: Capture, grid: Grid, fraction: float = 0.3
    ) -> FrontSurface:
        """Find depth, albedo and normal on every line of sight; see the function of that name."""
        # Refuses what the transform cannot image.
        self.transform.plan(capture, grid)
        scan = ConfocalScan.of(capture, grid)
        vectors = self._deconvolve(scan, grid)
        volume = Volume(np.linalg.norm(vectors, axis=0).astype(np.float32), grid)
        require_surface(volume.magnitude, fraction, MIN_VOXELS)
        peak = volume.magnitude.argmax(axis=0)
        rows, columns = np.indices(peak.shape)
        normals = np.moveaxis(vectors[:, peak, rows, columns], 0, -1)
        found = build_front_surface(volume, normals, fraction)
        return replace(found, source="directional light-cone transform")

    def _deconvolve(self, scan: ConfocalScan, grid: Grid) -> Float32Array:
        """Return albedo times normal, (3, z, y, x)."""
        # By one power more than the transform without directions.
        falloff = self.transform.falloff + 1
        spectrum, squares, shape = transform_squared_distances(scan, falloff)
        unit, depth = float(grid.z.mean() - scan.plane.z), grid.z - scan.plane.z
        parts = _separate(spectrum, scan, squares, shape, unit, 1 / self.transform.signal_to_noise)
        images = [image_squared_depths(part, scan, grid, squares, shape[2]) for part in parts]
        vectors = np.stack(images)
        vectors[2] *= (-unit / np.maximum(depth, scan.spacing))[:, np.newaxis, np.newaxis]
        return vectors


def _separate(
    spectrum: ComplexArray,
    scan: ConfocalScan,
    squares: float,
    shape: tuple[int, int, int],
    unit: float,
    floor: float,
) -> ComplexArray:
    """Spectra (3, ky, kx, w) of v_x, v_y and ``-z * v_z / unit``, by a Wiener filter; `unit`: m."""
    from scipy.fft import fft2

    lengths = zip(scan.plane.steps, shape[:2], strict=True)
    y, x = (length * np.fft.fftfreq(n, 1 / n) for length, n in lengths)
    sides = np.stack(np.broadcast_arrays(x / unit, y[:, np.newaxis] / unit, 1.0))
    parts = np.empty((3, *spectrum.shape), np.complex64)

    def process_block(some: slice) -> None:
        column = transform_paraboloid(y, x, squares, shape, some)
        kernels = fft2(sides[..., np.newaxis] * column, axes=(1, 2)).astype(np.complex64)
        # Wiener: the three components are what explains the signal with the least power.
        gain = spectrum[..., some] / (np.sum(np.abs(kernels) ** 2, axis=0) + np.float32(floor))
        parts[..., some] = kernels.conj() * gain

    run_blocks(process_block, spectrum.shape[2], FREQUENCIES_PER_BLOCK)
    return parts


def find_imaged_surface(capture: Capture, volume: Volume, fraction: float = 0.3) -> FrontSurface:
    """Find the front surface of an imaged capture, by the directional transform if that takes it."""
    here, light = volume.on(ComputeDevice()), capture.on(ComputeDevice())
    require_surface(here.magnitude, fraction, MIN_VOXELS)
    try:
        return DirectionalLightCone().find_front_surface(light, volume.grid, fraction)
    except InputError:
        return find_front_surface(here, fraction)
