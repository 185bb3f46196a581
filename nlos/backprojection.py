"""Back-projection of every wall point's signal over the voxels that it may come from: of the signal
filtered with a virtual pulse, or of the signal itself, whose sum a Laplacian then sharpens.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from nlos.band import Band, Waveforms
from nlos.capture import Capture, select_lasers
from nlos.illumination import warn_of_aliasing
from nlos.kernels import MIN_DISTANCE_M, add_backprojection
from nlos.method import (
    Method,
    PhasorPlan,
    Plan,
    Progress,
    PulsedMethod,
    require_imageable,
    require_numpy_signal,
)
from nlos.phasor.arrays import ArrayLibrary, BandTransform, get_traces
from nlos.plane import axis_step, is_evenly_spaced
from nlos.volume import Grid, Volume
from tofclip.arrays import Array, ComplexArray, Float32Array, is_numpy
from tofclip.errors import InputError, require_positive
from tofclip.threads import run_blocks, split_blocks

# Filtered signals held at a time; and how often, while they are filtered.
TABLE_BYTES, TABLE_COPIES = 32 << 20, 2
# Voxels treated together: few enough for the cache, rows along x long enough for vector registers,
# and at a batch of wall points some 30 ms of work, which is how long an interruption waits.
BRICK_Z, BRICK_Y, BRICK_X = 8, 8, 128


@dataclass(frozen=True)
class Weighting:
    """Factor ``cos(angle)^obliquity / distance^falloff`` of a wall point's signal at a voxel.

    Parameters
    ----------
    falloff : float
        1: each wall point is a source of a spherical wave, as in Liu et al. 2019; 0: all voxels
        alike.
    obliquity : float
        Power of the cosine of the angle at the wall point between the voxel and +z; 1 with falloff
        1 makes it the far field of the first Rayleigh-Sommerfeld integral; 0: all directions alike.
    """

    falloff: float = 1.0
    obliquity: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.falloff) and 0 <= self.obliquity < np.inf):
            raise InputError(
                f"weights need finite powers, that of the obliquity not negative, got {self}"
            )


@dataclass(frozen=True)
class Backprojection(PulsedMethod):
    """Point-wise back-projection with a virtual pulse: exact for every wall, laser and grid, slow.

    ``I(r) = | sum_p s_p(|r_L - r| + |r - r_p|) / |r - r_p| |`` with s_p the signal of wall point
    r_p, filtered with the pulse to its complex (analytic) form. It is read between finely spaced
    samples by complex linear interpolation, so the carrier's phase never has to be computed per
    voxel and stays accurate in float32.

    Costs one look-up per voxel and wall point; memory for the volume and for 32 MiB of signals. A
    capture of another library's arrays is imaged in that library.

    Liu et al., "Non-line-of-sight imaging using phasor-field virtual wave optics", Nature 572,
    620-623 (2019).

    Parameters
    ----------
    wavelength : float
        Carrier wavelength of the virtual pulse, m of path. Lateral resolution is about wavelength *
        depth / wall size.
    cycles : float
        Length of the pulse in wavelengths; see `nlos.band.VirtualPulse`.
    weighting : Weighting
        How much a voxel gets by its distance and direction from the wall point.
    """

    wavelength: float
    cycles: float = 3.0
    weighting: Weighting = Weighting()

    def plan(self, capture: Capture, grid: Grid) -> BackprojectionPlan:
        require_imageable(capture, grid)
        return BackprojectionPlan(capture, grid, self)


class BackprojectionPlan(PhasorPlan):
    """Back-projection with a virtual pulse, ready for captures of one geometry."""

    def __init__(self, capture: Capture, grid: Grid, method: Backprojection) -> None:
        super().__init__(capture, grid)
        self.band, self.weighting = Band(method.pulse, capture.axis), method.weighting
        pulse = {"wavelength_m": method.wavelength, "cycles": method.cycles}
        self.settings: dict[str, Any] = {
            "method": "backprojection",
            **pulse,
            **asdict(method.weighting),
        }
        self.cost = len(capture.points) * grid.size  # look-ups
        self.memory_bytes += TABLE_COPIES * TABLE_BYTES

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        warn_of_aliasing(capture, self.band)
        history = {**capture.provenance, "imaging": self.settings}
        grid, band, weighting = self.grid, self.band, self.weighting
        if not is_numpy(capture.signal):
            values = backproject_on_device(capture, grid, band, weighting, progress)
            return Volume(values, grid, history)

        def apply_filter(traces: Float32Array) -> Waveforms:
            return band.waveforms(band.compute_phasors(traces))

        samples = band.sample_count
        total = backproject_signals(capture, grid, apply_filter, samples, weighting, progress)
        return Volume(total, grid, history)


def backproject_signals(
    capture: Capture,
    grid: Grid,
    apply_filter: Callable[[Float32Array], Waveforms],
    samples: int,
    weighting: Weighting,
    progress: Progress,
) -> ComplexArray:
    """Smear every wall point's filtered signal over the voxels (z, y, x) that it may come from.
    `apply_filter`: from signals (points, t) to so many `samples`.
    """
    total = np.zeros(grid.shape, np.complex64)
    # the loop divides by the distance already
    powers = np.array([1 - weighting.falloff, weighting.obliquity], np.float32)
    x, y, z = (axis.astype(np.float32) for axis in (grid.x, grid.y, grid.z))
    # bricks, not planes: the paths of neighbouring voxels look up neighbouring samples
    sizes = (BRICK_Z, BRICK_Y, BRICK_X)
    sides = (split_blocks(*side) for side in zip(grid.shape, sizes, strict=True))
    bricks = list(itertools.product(*sides))

    def process_brick(waveforms: Sequence[Any], turn: slice) -> None:
        own = bricks[turn.start]
        # A brick of its own: a contiguous array lets one compiled version serve every piece.
        brick = np.zeros(total[own].shape, np.complex64)
        add_backprojection(*waveforms, x[own[2]], y[own[1]], z[own[0]], powers, brick)
        total[own] += brick
        progress(len(waveforms[0]) * brick.size)

    for points in split_blocks(len(capture.points), max(1, TABLE_BYTES // (8 * samples))):
        lasers = select_lasers(capture, points)
        spots = (some.astype(np.float32) for some in (capture.points[points], lasers))
        signals = apply_filter(capture.traces(points))
        start, spacing = np.float32(signals.start), np.float32(signals.spacing)
        waveforms = signals.values.view(np.float32), start, spacing, *spots
        run_blocks(partial(process_brick, waveforms), len(bricks), size=1)
    return total


# Of other libraries' arrays: waveforms held at a time, and a pair of voxel and wall point, which takes
# five times as much, in several arrays.
DEVICE_TABLE_BYTES, BYTES_PER_PAIR = 64 << 20, 16


def backproject_on_device(
    capture: Capture, grid: Grid, band: Band, weighting: Weighting, progress: Progress
) -> Array:
    """Return the sum of `nlos.Backprojection` where the signal lives. Memory: the volume, 64 MiB of
    waveforms, and five chunks (`ArrayLibrary.chunk_bytes`).
    """
    library = ArrayLibrary(capture.device)
    xp = library.xp
    z, y = (
        library.put(axis.reshape(-1, 1, 1)) for axis in np.meshgrid(grid.z, grid.y, indexing="ij")
    )
    x, rows = library.put(grid.x[:, np.newaxis]), grid.z.size * grid.y.size
    total = library.zeros((rows, grid.x.size))
    transform = BandTransform(band, capture.axis.bins, library)
    carriers, start, spacing = band.carriers
    carriers, samples = library.put(carriers), band.sample_count
    pairs = library.chunk_bytes // BYTES_PER_PAIR
    size = min(DEVICE_TABLE_BYTES // (8 * samples), max(1, pairs // grid.x.size))
    for points in split_blocks(len(capture.points), max(1, size)):
        # Waveforms of some wall points in one flat array, 0 at the first and the last two samples.
        waveforms = xp.reshape(transform.of(get_traces(capture, points)) @ carriers, (-1,))
        count = points.stop - points.start
        first, wall = library.put(samples * np.arange(count)), library.put(capture.points[points].T)
        lasers = select_lasers(capture, points)
        laser = library.put(lasers.T)
        for some in split_blocks(rows, max(1, pairs // (grid.x.size * count))):
            ahead, across = z[some, ...] - wall[2, :], y[some, ...] - wall[1, :]
            squared = xp.clip(across**2 + ahead**2, MIN_DISTANCE_M**2, None)
            distance = xp.sqrt(squared + (x - wall[0, :]) ** 2)
            aside = (y[some, ...] - laser[1, :]) ** 2 + (z[some, ...] - laser[2, :]) ** 2
            outward = xp.sqrt((x - laser[0, :]) ** 2 + aside)
            # Samples that the path is late by, in the order in which single precision loses least.
            position = (outward - start) * (1 / spacing) + distance * (1 / spacing)
            position = xp.clip(position, 0.0, float(samples - 2))
            before = xp.astype(position, xp.int64)
            weight, index = position - xp.astype(before, position.dtype), before + first
            here, there = (
                xp.reshape(xp.take(waveforms, xp.reshape(one, (-1,))), weight.shape)
                for one in (index, index + 1)
            )
            factor = 1 / distance if weighting.falloff == 1 else distance**-weighting.falloff
            if weighting.obliquity != 0:
                cosine = xp.clip(ahead, 0.0, None) / distance
                factor = factor * cosine**weighting.obliquity
            total[some, :] += xp.sum((here + weight * (there - here)) * factor, axis=-1)
            progress((some.stop - some.start) * grid.x.size * count)
    return xp.reshape(total, grid.shape)


# Zeros before and after every signal, where look-ups outside the record end.
PADDING_SAMPLES = (1, 2)
# Standard deviations where the Laplacian is cut off: at 4, a thousandth of the haze would pass.
FILTER_TRUNCATION_SIGMAS = 6.0
# Volumes in float32 that are held beside the sum while it is sharpened.
LAPLACIAN_COPIES = 4
# All voxels alike: the signals' own scale.
UNIFORM_WEIGHTING = Weighting(falloff=0.0)


@dataclass(frozen=True)
class FilteredBackprojection(Method):
    """Point-wise back-projection of the measured signals, then a Laplacian, for every wall and
    laser, onto evenly spaced voxels.

    The filter is ``-sigma^2 * (d2/dx2 + d2/dy2 + d2/dz2)`` of a Gaussian of standard deviation
    sigma. What it makes negative, the shadows of bright things, is set to 0. Needs no wavelength;
    noisier than a virtual pulse. Takes NumPy's arrays only.

    Costs one look-up per voxel and wall point; memory for the volume three times over and for 32
    MiB of signals.

    Velten et al., "Recovering three-dimensional shape around a corner using ultrafast
    time-of-flight imaging", Nat. Commun. 3, 745 (2012).

    Parameters
    ----------
    sigma : float
        Standard deviation of the Gaussian, m: about the size of the finest detail, and at least one
        voxel.
    weighting : Weighting
        How much a voxel gets by its distance and direction from the wall point.
    """

    sigma: float = 0.02
    weighting: Weighting = UNIFORM_WEIGHTING

    def __post_init__(self) -> None:
        require_positive("sigma of the Laplacian", self.sigma, "number of metres")

    def plan(self, capture: Capture, grid: Grid) -> FilteredBackprojectionPlan:
        require_numpy_signal("filtered back-projection", capture)
        if not all(is_evenly_spaced(axis) for axis in (grid.x, grid.y, grid.z)):
            raise InputError("the Laplacian needs evenly spaced voxels along x, y and z")
        require_imageable(capture, grid)
        return FilteredBackprojectionPlan(capture, grid, self)


class FilteredBackprojectionPlan(Plan):
    """Filtered back-projection, ready for captures of one geometry."""

    def __init__(self, capture: Capture, grid: Grid, method: FilteredBackprojection) -> None:
        super().__init__(capture, grid)
        points, bins = len(capture.points), capture.axis.bins
        self.method, self.cost = method, points * grid.size  # look-ups
        self.memory_bytes += 4 * LAPLACIAN_COPIES * grid.size
        self.memory_bytes += TABLE_COPIES * min(TABLE_BYTES, 8 * points * bins)

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        grid, method, spacing = self.grid, self.method, capture.axis.spacing

        def pad_signals(traces: Float32Array) -> Waveforms:
            values = np.pad(traces, ((0, 0), PADDING_SAMPLES)).astype(np.complex64)
            return Waveforms(values, capture.start - spacing, spacing)

        samples = capture.axis.bins + sum(PADDING_SAMPLES)
        total = backproject_signals(capture, grid, pad_signals, samples, method.weighting, progress)
        sharpened = _apply_laplacian(np.ascontiguousarray(total.real), grid, method.sigma)
        named = {"method": "filtered backprojection", "sigma_m": method.sigma}
        settings = named | asdict(method.weighting)
        history = {**capture.provenance, "imaging": settings}
        return Volume(np.maximum(sharpened, 0), grid, history)


def _apply_laplacian(values: Float32Array, grid: Grid, sigma: float) -> Float32Array:
    from scipy.ndimage import gaussian_filter

    axes = (grid.z, grid.y, grid.x)
    sigmas = [sigma / axis_step(axis) if axis.size > 1 else 0.0 for axis in axes]
    total = np.zeros_like(values)
    for axis in (axis for axis in range(3) if sigmas[axis] > 0):
        order = [2 if i == axis else 0 for i in range(3)]
        total -= np.float32(sigmas[axis] ** 2) * gaussian_filter(
            values, sigmas, order, mode="nearest", truncate=FILTER_TRUNCATION_SIGMAS
        )
    return total
