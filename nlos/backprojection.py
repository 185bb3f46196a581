"""Phasor-field back-projection: every wall point's filtered signal, back-projected over the voxels
that it may come from.

Filtered back-projection: the signals themselves are back-projected, and a Laplacian sharpens
what comes out.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse, Waveforms
from nlos.capture import Capture
from nlos.illumination import warn_of_aliasing
from nlos.kernels import add_backprojection
from nlos.method import (
    VOXEL_BYTES,
    Method,
    PhasorMethod,
    PhasorPlan,
    Plan,
    Progress,
    require_imageable,
    require_numpy_signal,
)
from nlos.plane import axis_step, is_evenly_spaced
from nlos.volume import FloatArray, Grid, Volume
from tofclip.arrays import is_numpy
from tofclip.errors import InputError
from tofclip.threads import run_blocks, split_blocks

# Filtered signals held at a time; and how often, while they are filtered.
TABLE_BYTES, TABLE_COPIES = 32 << 20, 2

SignalFilter = Callable[[NDArray[np.float32]], Waveforms]
"""Turns signals (points, t) into what is back-projected over the voxels."""

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
        if not (np.isfinite(self.falloff) and np.isfinite(self.obliquity) and self.obliquity >= 0):
            raise InputError(
                f"weights need finite powers, that of the obliquity not negative, got {self}"
            )


@dataclass(frozen=True)
class Backprojection(PhasorMethod):
    """Point-wise back-projection with a virtual pulse: exact for every wall, laser and grid, slow.

    ``I(r) = | sum_p s_p(|r_L - r| + |r - r_p|) / |r - r_p| |`` with s_p the signal of wall point
    r_p, filtered with the pulse to its complex (analytic) form. It is read between finely spaced
    samples by complex linear interpolation, so the carrier's phase never has to be computed per
    voxel and stays accurate in float32.

    Costs one look-up per voxel and wall point; memory for the volume and for 32 MiB of signals. A
    capture of another library's arrays is imaged in that library; see `nlos.portable`.

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
    pulse: VirtualPulse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pulse", VirtualPulse(self.wavelength, self.cycles))

    def plan(self, capture: Capture, grid: Grid) -> BackprojectionPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            Of several wall points; any wall and lasers.
        grid : Grid
            Not behind the wall.

        Returns
        -------
        BackprojectionPlan

        Raises
        ------
        InputError
            A single wall point, a grid behind the wall, a volume above 8 GiB, or time bins too
            coarse for the wavelength.
        """
        band = Band(self.pulse, capture.axis)
        require_imageable(capture, grid)
        settings = {
            "method": "backprojection",
            "wavelength_m": self.wavelength,
            "cycles": self.cycles,
        }
        return BackprojectionPlan(capture, grid, band, self.weighting, settings)


class BackprojectionPlan(PhasorPlan):
    """Back-projection with a virtual pulse, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    band : Band
    weighting : Weighting
    settings : mapping
        What a volume reports of how it was imaged.
    """

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        band: Band,
        weighting: Weighting,
        settings: Mapping[str, Any],
    ) -> None:
        super().__init__(capture, grid)
        self.band, self.weighting, self.settings = band, weighting, dict(settings)
        self._points = len(capture.points)
        self._warned = False

    @property
    def cost(self) -> int:
        """Look-ups: one per voxel and wall point."""
        return self._points * self.grid.size

    @property
    def memory_bytes(self) -> int:
        return self.grid.size * VOXEL_BYTES + TABLE_COPIES * TABLE_BYTES

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        if not self._warned:
            warn_of_aliasing(capture, self.band)
            self._warned = True
        history = {**capture.provenance, "imaging": self.settings}
        if not is_numpy(capture.signal):
            from nlos.backprojection_arrays import backproject_on_device

            values = backproject_on_device(capture, self.grid, self.band, self.weighting, progress)
            return Volume(values, self.grid, history)
        band = self.band

        def apply_filter(traces: NDArray[np.float32]) -> Waveforms:
            return band.waveforms(band.compute_phasors(traces))

        count = max(1, TABLE_BYTES // (band.sample_count * np.dtype(np.complex64).itemsize))
        total = backproject_signals(
            capture, self.grid, apply_filter, count, self.weighting, progress
        )
        return Volume(total, self.grid, history)


def backproject_signals(
    capture: Capture,
    grid: Grid,
    apply_filter: SignalFilter,
    points_at_a_time: int,
    weighting: Weighting,
    progress: Progress,
) -> NDArray[np.complex64]:
    """Smear every wall point's filtered signal over the voxels that it may come from, and add all
    up.

    `apply_filter`: filters the signals of some wall points; `points_at_a_time`: how many are
    filtered at once; bounds the memory; `progress`: called with the number of look-ups just done.
    Returns (z, y, x).
    """
    total = np.zeros(grid.shape, np.complex64)
    for some in split_blocks(len(capture.points), points_at_a_time):
        lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[some]
        wall = capture.points[some].astype(np.float32)
        batch = _Batch(
            apply_filter(capture.traces(some)), wall, lasers.astype(np.float32), weighting
        )
        _add_batch(batch, grid, total, progress)
    return total


@dataclass(frozen=True, eq=False)
class _Batch:
    """Some wall points with their filtered signals, as the compiled loop takes them."""

    waveforms: Waveforms
    wall: NDArray[np.float32]
    lasers: NDArray[np.float32]
    weighting: Weighting

    def add_to(
        self, field: NDArray[np.complex64], x: FloatArray, y: FloatArray, z: FloatArray
    ) -> None:
        """Add what these wall points contribute to a brick of voxels.

        `field` (z, y, x): added to, in place; `x, y, z`: axes of the brick, m.
        """
        values = self.waveforms.values.view(np.float32)
        start, spacing = np.float32(self.waveforms.start), np.float32(self.waveforms.spacing)
        axes = (axis.astype(np.float32) for axis in (x, y, z))
        # A brick of its own, because a contiguous array lets one compiled version serve every piece
        # of a volume.
        brick = np.zeros(field.shape, np.complex64)
        # the loop divides by the distance already
        powers = np.array([1 - self.weighting.falloff, self.weighting.obliquity], np.float32)
        add_backprojection(values, start, spacing, self.wall, self.lasers, *axes, powers, brick)
        field += brick


def _add_batch(batch: _Batch, grid: Grid, total: NDArray[np.complex64], progress: Progress) -> None:
    """Add a batch of wall points to the whole volume, brick by brick, on all threads."""
    # bricks, not planes: the paths of neighbouring voxels look up neighbouring samples
    bricks = list(
        itertools.product(
            split_blocks(grid.z.size, BRICK_Z),
            split_blocks(grid.y.size, BRICK_Y),
            split_blocks(grid.x.size, BRICK_X),
        )
    )

    def process_block(turn: slice) -> None:
        for z, y, x in bricks[turn]:
            batch.add_to(total[z, y, x], grid.x[x], grid.y[y], grid.z[z])
            progress(len(batch.wall) * total[z, y, x].size)

    run_blocks(process_block, len(bricks), size=1)


# Zeros before and after every signal, where look-ups outside the record end.
PADDING_SAMPLES = (1, 2)
# Standard deviations at which the Laplacian is cut off: at 4, a thousandth of the haze would pass
# it.
FILTER_TRUNCATION_SIGMAS = 6.0
# Volumes in float32 that are held beside the sum while it is sharpened.
LAPLACIAN_COPIES = 4
# All voxels alike: the signals' own scale.
UNIFORM_WEIGHTING = Weighting(falloff=0.0)


@dataclass(frozen=True)
class FilteredBackprojection(Method):
    """Point-wise back-projection of the measured signals, then a Laplacian, for every wall and
    laser.

    The filter is ``-sigma^2 * (d2/dx2 + d2/dy2 + d2/dz2)`` of a Gaussian of standard deviation
    sigma. What it makes negative, the shadows of bright things, is set to 0. Needs no wavelength;
    noisier than a virtual pulse.

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
        if not (np.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(
                f"sigma of the Laplacian must be a positive number of metres, got {self.sigma}"
            )

    def plan(self, capture: Capture, grid: Grid) -> FilteredBackprojectionPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            A NumPy array; any wall and lasers.
        grid : Grid
            Evenly spaced, not behind the wall.

        Returns
        -------
        FilteredBackprojectionPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid.
        """
        require_numpy_signal("filtered back-projection", capture)
        if not all(is_evenly_spaced(axis) for axis in (grid.x, grid.y, grid.z)):
            raise InputError("the Laplacian needs evenly spaced voxels along x, y and z")
        require_imageable(capture, grid)
        return FilteredBackprojectionPlan(capture, grid, self)


class FilteredBackprojectionPlan(Plan):
    """Filtered back-projection, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    method : FilteredBackprojection
    """

    def __init__(self, capture: Capture, grid: Grid, method: FilteredBackprojection) -> None:
        super().__init__(capture, grid)
        self.method = method
        self._points, self._bins = len(capture.points), capture.axis.bins

    @property
    def cost(self) -> int:
        """Look-ups: one per voxel and wall point."""
        return self._points * self.grid.size

    @property
    def memory_bytes(self) -> int:
        signals = min(TABLE_BYTES, 8 * self._points * self._bins)
        return self.grid.size * (VOXEL_BYTES + 4 * LAPLACIAN_COPIES) + TABLE_COPIES * signals

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        spacing = capture.axis.spacing

        def pad_signals(traces: NDArray[np.float32]) -> Waveforms:
            values = np.pad(traces, ((0, 0), PADDING_SAMPLES)).astype(np.complex64)
            return Waveforms(values, capture.start - spacing, spacing)

        count = max(1, TABLE_BYTES // (8 * (self._bins + sum(PADDING_SAMPLES))))
        total = np.ascontiguousarray(
            backproject_signals(
                capture, self.grid, pad_signals, count, self.method.weighting, progress
            ).real
        )
        sharpened = _apply_laplacian(total, self.grid, self.method.sigma)
        settings = {"method": "filtered backprojection", "sigma_m": self.method.sigma}
        return Volume(
            np.maximum(sharpened, 0), self.grid, {**capture.provenance, "imaging": settings}
        )


def _apply_laplacian(values: NDArray[np.float32], grid: Grid, sigma: float) -> NDArray[np.float32]:
    from scipy.ndimage import gaussian_filter

    sigmas = [
        sigma / axis_step(axis) if axis.size > 1 else 0.0 for axis in (grid.z, grid.y, grid.x)
    ]
    total = np.zeros_like(values)
    for axis in (axis for axis in range(3) if sigmas[axis] > 0):
        order = [2 if i == axis else 0 for i in range(3)]
        total -= np.float32(sigmas[axis] ** 2) * gaussian_filter(
            values, sigmas, order, mode="nearest", truncate=FILTER_TRUNCATION_SIGMAS
        )
    return total
