"""Confocal imaging by transforms of the whole scan at once: what both methods need of a capture
(its lattice, its signals from path 0 on), the light-cone transform, which is one deconvolution, and
f-k migration, which lets a wave run back into the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.illumination import find_leg_bounds
from nlos.kernels import migrate_row, rebin, shift_signals
from nlos.method import (
    Method,
    Plan,
    Progress,
    require_imageable,
    require_memory,
    require_numpy_signal,
)
from nlos.plane import PlanarWall, Plane, axis_step
from nlos.volume import Grid, Volume
from tofclip.arrays import AnyArray, ComplexArray, Float32Array, FloatArray
from tofclip.errors import InputError, require, require_positive
from tofclip.threads import run_blocks, thread_count

# Points may be off the lattice by this fraction of its step.
LATTICE_TOLERANCE = 0.02
# Larger transforms are refused before anything is allocated.
LIMIT_BYTES = 4 << 30
# Of the box padded to twice its sides: two half spectra in complex64, the signals, and the result.
BYTES_PER_SAMPLE = 12
# A start that lies this close to a whole bin, in bins, is taken for one.
WHOLE_BIN_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class ConfocalScan:
    """Signals on a lattice of wall points; where a point is missing, it is dark."""

    # (y, x, t), what every wall point saw; bin i stands for the distance ``i * spacing`` from it
    signal: Float32Array
    plane: Plane  # the wall points
    spacing: float  # distance per bin, m: half the path

    @classmethod
    def of(cls, capture: Capture, grid: Grid) -> ConfocalScan:
        """Sort a capture onto its lattice, from distance 0, half the path, to the farthest voxel."""
        wall, spacing = PlanarWall.of(capture.points, LATTICE_TOLERANCE), capture.axis.spacing
        _, farthest = find_leg_bounds(capture.points, grid)
        recorded = int(np.ceil(capture.axis.paths[-1] / spacing)) + 1
        bins = max(2, min(recorded, int(np.ceil(2 * farthest / spacing)) + 2))
        traces = _shift_to_distance_zero(capture, bins)
        return cls(wall.lattice.place(traces), wall.plane, spacing / 2)

    def correct_falloff(self, falloff: float) -> Float32Array:
        """Return the signal times d^falloff, relative to the farthest bin's distance d."""
        relative = np.arange(self.signal.shape[2], dtype=np.float32) / (self.signal.shape[2] - 1)
        return np.asarray(self.signal * relative**falloff, dtype=np.float32)


class ConfocalPlan(Plan):
    """Imaging by transforms of whole confocal scans of a lattice on a plane z = const, up to half a
    wall beyond its edges. `compute`: from a scan and the grid to the values (z, y, x).
    """

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        compute: Callable[[ConfocalScan, Grid], Float32Array],
        settings: Mapping[str, Any],
    ) -> None:
        require_numpy_signal("a light-cone transform or f-k migration", capture)
        require_imageable(capture, grid)
        super().__init__(capture, grid)
        plane = _require_lattice(capture, grid)
        places = plane.x.size * plane.y.size
        bins = capture.axis.bins + max(0, int(capture.start / capture.axis.spacing))
        needed = 8 * places * bins * BYTES_PER_SAMPLE
        remedy = "put time bins together or leave wall points out"
        require_memory(needed, f"{places} wall points with {bins} bins", remedy, LIMIT_BYTES)
        self.memory_bytes += needed
        self._compute, self.settings = compute, dict(settings)

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        image = self._compute(ConfocalScan.of(capture, self.grid), self.grid)
        progress(self.grid.size)
        return Volume(image, self.grid, {**capture.provenance, "imaging": self.settings})


def find_padded_length(count: int) -> int:
    """At least twice as many samples: an even number that Fourier transforms are quick with."""
    from scipy.fft import next_fast_len

    return 2 * int(next_fast_len(count))


def interpolate_axis(values: Float32Array, position: FloatArray, axis: int) -> Float32Array:
    """Read a periodic axis at fractional positions (n,), in its steps, by linear interpolation."""
    below = np.floor(position).astype(np.intp)
    weight = (position - below).astype(np.float32)
    weight = weight.reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    count = values.shape[axis]
    # the lattice is padded, so that a period's seam lies outside the image
    lower, upper = (np.take(values, index % count, axis) for index in (below, below + 1))
    return lower + weight * (upper - lower)


def resample_to_grid(
    values: Float32Array, scan: ConfocalScan, grid: Grid, depth_position: FloatArray
) -> Float32Array:
    """Read an image (y, x, depth) on the padded lattice at voxels (z, y, x), whose planes are at
    `depth_position` (z,) in its steps.
    """
    image = interpolate_axis(values, depth_position, 2)
    for number, wanted, axis in ((1, grid.x, scan.plane.x), (0, grid.y, scan.plane.y)):
        image = interpolate_axis(image, (wanted - axis[0]) / axis_step(axis), number)
    return np.ascontiguousarray(np.moveaxis(image, 2, 0))


def _require_lattice(capture: Capture, grid: Grid) -> Plane:
    """Return the plane of a confocal scan of a lattice; refuse others, and voxels too far beside."""
    try:
        plane = PlanarWall.of(capture.points, LATTICE_TOLERANCE).plane
    except InputError as problem:
        raise InputError(f"a lattice of points on a plane is needed: {problem}") from problem
    if len(capture.lasers) != len(capture.points):
        raise InputError(
            "a confocal scan is needed, where every wall point is its own laser spot; use another method"
        )
    apart = float(np.abs(capture.lasers - capture.points).max())
    if apart > LATTICE_TOLERANCE * min(plane.steps):
        raise InputError(
            f"a confocal scan is needed, but lasers are up to {apart:.3g} m from their wall points; "
            "use another method"
        )
    for name, axis, wanted in (("x", plane.x, grid.x), ("y", plane.y, grid.y)):
        # Transforms pad the wall to twice its width: what lies farther out would come in again.
        margin = (axis[-1] - axis[0]) / 2
        low, high = axis[0] - margin, axis[-1] + margin
        if wanted[0] < low or wanted[-1] > high:
            raise InputError(
                f"the grid's {name} runs from {wanted[0]:.3g} to {wanted[-1]:.3g} m, but this method sees only from "
                f"{low:.3g} to {high:.3g} m, half a wall beyond the wall"
            )
    return plane


def _shift_to_distance_zero(capture: Capture, bins: int) -> Float32Array:
    """Signals (points, bins) from path 0 on, by whole bins if that suffices."""
    delay, traces = capture.start / capture.axis.spacing, capture.traces()
    whole = round(delay)
    if abs(delay - whole) > WHOLE_BIN_TOLERANCE:
        by_bin = np.ascontiguousarray(traces.T)
        traces = np.ascontiguousarray(shift_signals(by_bin, np.full(len(traces), whole - delay)).T)
    moved = np.zeros((len(traces), bins), np.float32)
    first, last = max(0, whole), min(bins, whole + traces.shape[1])
    if first < last:
        moved[:, first:last] = traces[:, first - whole : last - whole]
    return moved


def _require_falloff(falloff: float) -> None:
    require(0 <= falloff < np.inf, f"falloff must be a power of 0 or more, got {falloff}")


@dataclass(frozen=True)
class LightCone(Method):
    """Confocal imaging by the light-cone transform.

    With u = z^2 and v = d^2, d half the path, the hyperboloid of a hidden point is ``v = u + x^2 +
    y^2``: the same paraboloid at every depth, so that the picture follows from one
    three-dimensional deconvolution with a Wiener filter. Needs a confocal scan of a lattice on a
    plane z = const, without the light that the wall returns at once (see
    `nlos.preparation.remove_first_bounce`); hidden things must scatter evenly or straight back.
    Sees up to half a wall beyond the wall's edges.

    Memory: for P wall points and T bins, two half spectra of the box padded to twice its size along
    all three axes, some 100 * P * T bytes (0.2 GB for 64 x 64 x 512); time: four transforms of that
    box.

    O'Toole, Lindell, Wetzstein, "Confocal non-line-of-sight imaging based on the light-cone
    transform", Nature 555, 338-341 (2018), Eq. 3 and 5.

    Parameters
    ----------
    signal_to_noise : float
        Of the Wiener filter ``conj(h) / (|h|^2 + 1 / signal_to_noise)``, for a kernel h of unit
        energy. Smaller is smoother.
    falloff : float
        Power of the distance with which brightness falls: 4 for diffuse things, 2 for
        retroreflective ones.
    """

    signal_to_noise: float = 0.8
    falloff: float = 4.0

    def __post_init__(self) -> None:
        require_positive("signal_to_noise", self.signal_to_noise)
        _require_falloff(self.falloff)

    def plan(self, capture: Capture, grid: Grid) -> ConfocalPlan:
        settings = {"signal_to_noise": self.signal_to_noise, "falloff": self.falloff}
        return ConfocalPlan(capture, grid, self._compute, {"method": "lightcone", **settings})

    def _compute(self, scan: ConfocalScan, grid: Grid) -> Float32Array:
        """Return the image (z, y, x) of a scan on a grid."""
        from scipy.fft import dctn

        spectrum, squares, shape = transform_squared_distances(scan, self.falloff)
        # along x and y the kernel is even: cosine transforms of a quadrant suffice
        sides = zip(scan.plane.steps, shape[:2], strict=True)
        y, x = (length * np.arange(n // 2 + 1) for length, n in sides)
        columns = transform_paraboloid(y, x, squares, shape, slice(0, spectrum.shape[2]))
        kernel = dctn(columns.astype(np.complex64), 1, axes=(0, 1), workers=thread_count())
        apply_wiener_filter(spectrum, kernel, self.signal_to_noise)
        return np.maximum(image_squared_depths(spectrum, scan, grid, squares, shape[2]), 0)


def apply_wiener_filter(
    spectrum: ComplexArray, kernel: ComplexArray, signal_to_noise: float
) -> None:
    """Filter a spectrum (y, x, v) in place; a quarter of the kernel's, which is even, is enough."""
    # the gain falls where the kernel is weaker than the noise
    gain = kernel.conj() / (np.abs(kernel) ** 2 + np.float32(1 / signal_to_noise))
    row, column = (np.minimum(np.arange(n), n - np.arange(n)) for n in spectrum.shape[:2])

    def process_block(rows: slice) -> None:
        for r in range(rows.start, rows.stop):
            spectrum[r] *= gain[row[r], column]

    run_blocks(process_block, spectrum.shape[0], 8)


def transform_squared_distances(
    scan: ConfocalScan, falloff: float
) -> tuple[ComplexArray, float, tuple[int, int, int]]:
    """Return the half spectrum (y, x, v) of the signals over the square v of the distance, times
    d^falloff, padded; from sample to sample of v, and of u = z^2, m^2; and its samples with the padding.
    """
    from scipy.fft import fft2, rfft

    rows, columns, bins = scan.signal.shape
    # one sample of u = z^2 for each bin, over the same range of depths
    squares = bins * scan.spacing**2
    shape = (find_padded_length(rows), find_padded_length(columns), find_padded_length(bins))
    # edges of the bins in v; a bin is centred on its distance
    edges = (np.clip(np.arange(bins + 1) - 0.5, 0, None) * scan.spacing) ** 2
    # means over even intervals
    light = scan.correct_falloff(falloff) * (np.diff(edges) / squares).astype(np.float32)
    over_squares = rebin(light, edges, squares * np.arange(bins + 1))
    workers = thread_count()
    spectrum = rfft(over_squares, shape[2], workers=workers)
    return fft2(spectrum, shape[:2], axes=(0, 1), workers=workers), squares, shape


def image_squared_depths(
    spectrum: ComplexArray, scan: ConfocalScan, grid: Grid, squares: float, samples: int
) -> Float32Array:
    """Return voxels (z, y, x) of a half spectrum (y, x, u) over the square of the depth, which it
    overwrites.
    """
    from scipy.fft import ifft2, irfft

    bins, workers = scan.signal.shape[2], thread_count()
    spectrum = ifft2(spectrum, axes=(0, 1), workers=workers, overwrite_x=True)
    values = irfft(spectrum, samples, workers=workers, overwrite_x=True)[..., :bins]
    position = (grid.z - scan.plane.z) ** 2 / squares - 0.5
    # Depths between the wall and the first sample read the first.
    return resample_to_grid(values, scan, grid, np.clip(position, 0, bins - 1))


def transform_paraboloid(
    y: AnyArray, x: AnyArray, squares: float, shape: tuple[int, int, int], some: slice
) -> NDArray[np.complex128]:
    """Spectrum along v (y, x, frequencies) of the kernel ``v = x^2 + y^2`` of unit energy, the same
    at every depth: an impulse for every column (y, x), m, shared linearly between two samples.
    """
    late = (y[:, np.newaxis] ** 2 + x**2) / squares
    whole = np.floor(late).astype(np.intp)
    weight = (late - whole)[..., np.newaxis]
    frequencies = np.arange(some.start, some.stop)
    turn = np.exp(-2j * np.pi / shape[2] * frequencies)
    # A delay is a power of one phase; a table of one turn is quicker than exponentials, and exact.
    table = np.exp(-2j * np.pi / shape[2] * np.arange(shape[2])).astype(np.complex64)
    delayed = table[whole[..., np.newaxis] * frequencies % shape[2]]
    # Impulses beyond the padded record would wrap around into it.
    height = (whole < shape[2] - 1) / np.sqrt(shape[0] * shape[1])
    return delayed * ((1 - weight + weight * turn) * height[..., np.newaxis])


@dataclass(frozen=True)
class FKMigration(Method):
    """Confocal imaging by f-k (Stolt) migration.

    The signals are taken for a wave that all hidden points sent out at once and that travelled to
    the wall at half the speed of light. A resampling of its spectrum, from frequency to depth
    wavenumber, gives the wave at that one instant. Needs the scans of `LightCone`; copes with
    glossy and retroreflective things.

    The spectrum is interpolated about the middle of the record, where linear interpolation dims
    late signals least.

    Memory as of `LightCone`; time: two transforms of its padded box.

    Lindell, Wetzstein, O'Toole, "Wave-based non-line-of-sight imaging using fast f-k migration",
    ACM Trans. Graph. 38, 116 (2019), Eq. 7-9.

    Parameters
    ----------
    falloff : float
        As of `LightCone`.
    """

    falloff: float = 4.0

    def __post_init__(self) -> None:
        _require_falloff(self.falloff)

    def plan(self, capture: Capture, grid: Grid) -> ConfocalPlan:
        settings = {"method": "fk", "falloff": self.falloff}
        return ConfocalPlan(capture, grid, self._compute, settings)

    def _compute(self, scan: ConfocalScan, grid: Grid) -> Float32Array:
        """Return the image (z, y, x) of a scan on a grid."""
        from scipy.fft import fft2, ifft, ifft2, rfft

        rows, columns, bins = scan.signal.shape
        brightness = scan.correct_falloff(self.falloff)
        # brightness is the square of a wave's amplitude; noise keeps its sign
        wave = np.copysign(np.sqrt(np.abs(brightness)), brightness)
        period, workers = find_padded_length(bins), thread_count()
        spectrum = rfft(wave, period, workers=workers)
        # the record's middle becomes time zero, about which a spectrum varies slowest
        delay = 2 * np.pi * (bins // 2) / period
        spectrum *= np.exp(1j * delay * np.arange(spectrum.shape[2])).astype(np.complex64)
        padded = (find_padded_length(rows), find_padded_length(columns))
        spectrum = fft2(spectrum, padded, axes=(0, 1), workers=workers)
        ky, kx = (
            np.fft.fftfreq(n, axis_step(axis)) * period * scan.spacing
            for n, axis in zip(padded, (scan.plane.y, scan.plane.x), strict=True)
        )

        def migrate(block: slice) -> None:
            for r in range(block.start, block.stop):
                migrate_row(spectrum[r], ky[r], kx, delay)

        run_blocks(migrate, padded[0], 8)
        wave = ifft2(spectrum, axes=(0, 1), workers=workers, overwrite_x=True)
        energy = np.empty((*padded, bins), np.float32)

        def add_energy(block: slice) -> None:
            # no negative depth wavenumbers: the wave runs one way
            field = ifft(wave[block], period)[..., :bins]
            energy[block] = field.real**2 + field.imag**2

        run_blocks(add_energy, padded[0], 8)
        return resample_to_grid(energy, scan, grid, (grid.z - scan.plane.z) / scan.spacing)
