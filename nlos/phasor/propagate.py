"""From a wall of any shape to a plane in front of it, ``S_k(r_v) = sum_p P_k(r_p) * exp(1j * k * |r_v -
r_p|) / |r_v - r_p|``, by Fourier transforms or direct sums: by compiled loops for NumPy's arrays, by
matrix products for arrays of any other library, which stay where they are. What is computed, and in
which order, is written once, in `nlos.phasor.plan`. `nlos.propagate` gives the field on a plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.illumination import IlluminationGroup, build_waves, find_leg_bounds, group_by_illumination
from nlos.kernels import MIN_DISTANCE_M
from nlos.method import Progress, ignore_progress, require_numpy_signal
from nlos.phasor.arrays import ArrayLibrary, BandTransform, arrange_on_lattice, get_traces
from nlos.phasor.depth_steps import DiffractionPlan
from nlos.phasor.to_depths import PortableDiffraction
from nlos.phasor.to_depths_compiled import CompiledDiffraction, LaserSource, choose_inverse
from nlos.phasor.to_depths_kernels import TAPS
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_kernels import (
    FREQUENCY_STEPS,
    TARGET_LANES,
    add_low_rank_terms,
    add_spherical_waves,
    shift_and_sum,
)
from nlos.phasor.wall_to_plane import WallBeforePlane, WallToPlanePlan, has_finufft, plan_transforms
from nlos.plane import Plane, PlaneField, WallLattice
from nlos.volume import Grid
from tofclip.arrays import Array, ComplexArray, Float32Array, FloatArray, is_numpy, to_numpy
from tofclip.errors import InputError, require_known
from tofclip.threads import limit_blas_threads, run_blocks, split_blocks

Propagation = Literal["spectral", "time"]

WallToPlane = Callable[[Capture, Progress, IlluminationGroup], Array]
"""Carries what one of several groups of the same wall points recorded to a plane: the field (y, x,
frequencies) there.
"""

# Enough wall points to tell the strength of a frequency from.
STRENGTH_POINTS = 1024
# Groups of targets per piece of work.
LANE_GROUPS_PER_BLOCK = 4


def estimate_strength(phasors: ComplexArray) -> FloatArray:
    """Estimate how strong phasors (points, frequencies) are at each frequency, relative to the
    strongest.
    """
    energy = np.mean(np.abs(phasors).astype(np.float64) ** 2, axis=0)
    return np.sqrt(energy / energy.max()) if energy.any() else np.ones(energy.size)


def propagate_low_rank(
    plan: WallToPlanePlan, phasors: ComplexArray, progress: Progress = ignore_progress
) -> ComplexArray:
    """Return the field (y, x, frequencies) on a plane, within the plan's tolerance; in memory,
    frequency after frequency.

    Per frequency some two to ten Fourier transforms of the wall, weighted by functions of its
    depth, and one back. Memory for the result, for as many transfer functions as depth nodes (10 to
    20 MB for 128 x 128 points and 120 frequencies) and, per thread, for the spectra of one
    frequency's terms.
    """
    field = np.empty((phasors.shape[1], *plan.plane.shape), np.complex64)
    low_rank_transfer = plan.low_rank_transfer
    with limit_blas_threads():
        max_terms = max(low_rank_transfer.term_counts)
        shifts, spare = plan.phase_shifts(), list[_Workspace]()

        def process_block(some: slice) -> None:
            workspace = spare.pop() if spare else _Workspace(plan, max_terms, shifts)
            for number in range(some.start, some.stop):
                # High frequencies have most waves: with these first, threads end together.
                group = len(low_rank_transfer.groups) - 1 - number
                workspace.propagate_group(group, phasors, field)
                progress(field[low_rank_transfer.groups[group]].size)
            spare.append(workspace)

        run_blocks(process_block, len(low_rank_transfer.groups), size=1)
    return np.moveaxis(field, 0, -1)


class _Workspace:
    """One thread's memory, and what it does there."""

    def __init__(self, plan: WallToPlanePlan, terms: int, shifts: tuple[Any, Any]) -> None:
        self.plan, self.phase_shifts = plan, shifts
        self.analysis = plan.analysis(terms)
        column, row = np.meshgrid(
            *(np.arange(-n, n + 1) for n in plan.max_indices[::-1]), indexing="ij"
        )
        self.inverse = choose_inverse((row, column), plan.plane_lattice, plan.plane.shape, 1)
        self.cells = (
            self.inverse.cell_indices[:, 0],
            self.inverse.cell_indices[0] - self.inverse.cell_indices[0, 0],
        )

    def propagate_group(self, number: int, phasors: ComplexArray, field: ComplexArray) -> None:
        """Overwrite the field (frequencies, y, x) at one group's frequencies."""
        plan = self.plan
        group = plan.low_rank_transfer.groups[number]
        over_waves, over_points = plan.low_rank_transfer.terms(number)
        values = np.ascontiguousarray(phasors[:, group].T)
        shift_y, shift_x = self.phase_shifts
        spectrum = self.inverse.spectra[0]
        for i, frequency in enumerate(range(group.start, group.stop)):
            reach = plan.max_row_indices(frequency)
            spectra = self.analysis.spectra(values[i], over_points, reach.size - 1)
            spectrum[:] = 0
            parts = spectra.view(np.float32)
            wave_factors = over_waves[i], *plan.node_interpolation
            add_low_rank_terms(parts, *wave_factors, reach, shift_x, shift_y, *self.cells, spectrum)
            self.inverse.transform(slice(0, 1))
            np.multiply(self.inverse.images[0], self.inverse.carrier, out=field[frequency])


def propagate_direct(
    points: FloatArray,
    phasors: ComplexArray,
    plane: Plane,
    wavenumbers: FloatArray,
    progress: Progress = ignore_progress,
) -> ComplexArray:
    """Return the field (y, x, frequencies) on a plane as a direct sum; see `sum_spherical_waves`."""
    targets = plane.points.reshape(-1, 3)
    field = sum_spherical_waves(targets, points, phasors, wavenumbers, progress)
    return field.reshape(*plane.shape, -1)


def sum_spherical_waves(
    targets: FloatArray,
    sources: FloatArray,
    phasors: ComplexArray,
    wavenumbers: FloatArray,
    progress: Progress = ignore_progress,
) -> ComplexArray:
    """Return ``sum_s P_k(s) * exp(1j * k * |t - s|) / |t - s|`` at every target t, in float32.

    Good to 1e-5 for points of any place and order; one complex product per pair of points and
    frequency. Memory for the result and a copy of the phasors.

    `targets, sources` (m, 3): m; `phasors` (n, frequencies); `wavenumbers` (frequencies,): evenly
    spaced, rad/m. Returns (m, frequencies).
    """
    frequencies = wavenumbers.size
    padded = -(-frequencies // FREQUENCY_STEPS) * FREQUENCY_STEPS
    parts = np.zeros((len(sources), 2 * padded), np.float32)
    parts[:, : 2 * frequencies] = np.ascontiguousarray(phasors, np.complex64).view(np.float32)
    # Distances are what counts: near the middle of both, float32 coordinates have most digits.
    middle = (sources.mean(axis=0) + targets.mean(axis=0)) / 2
    groups = -(-len(targets) // TARGET_LANES)
    lanes = np.resize((targets - middle).astype(np.float32), (groups * TARGET_LANES, 3)).reshape(
        groups, TARGET_LANES, 3
    )
    emitters = (sources - middle).astype(np.float32)
    field = np.empty((groups, TARGET_LANES, frequencies), np.complex64)
    step = wavenumbers[1] - wavenumbers[0] if frequencies > 1 else 0.0
    cycles, cycle_step = np.float32(wavenumbers[0] / (2 * np.pi)), np.float32(step / (2 * np.pi))

    def process_block(some: slice) -> None:
        for group in range(some.start, some.stop):
            sums = np.zeros(padded * 2 * TARGET_LANES, np.float32)
            add_spherical_waves(
                emitters,
                parts,
                np.ascontiguousarray(lanes[group].T).ravel(),
                cycles,
                cycle_step,
                sums,
            )
            real, imaginary = np.moveaxis(sums.reshape(padded, 2, TARGET_LANES)[:frequencies], 1, 0)
            field[group].real, field[group].imag = real.T, imaginary.T
        progress(
            (min(some.stop * TARGET_LANES, len(targets)) - some.start * TARGET_LANES) * frequencies
        )

    run_blocks(process_block, groups, size=LANE_GROUPS_PER_BLOCK)
    return field.reshape(-1, frequencies)[: len(targets)]


class DevicePropagation:
    """A wall in relief by Fourier matrices: every term is one flat wall; see
    `propagate_low_rank`. Memory beyond phasors and result: some 8 bytes per wall point,
    term and six frequencies (20 MB for 128 x 128 points and 120 frequencies), and four chunks
    (`ArrayLibrary.chunk_bytes`).
    """

    def __init__(self, plan: WallToPlanePlan, library: ArrayLibrary) -> None:
        self.plan, self.library, put = plan, library, library.put
        indices = [np.arange(-reach, reach + 1) for reach in plan.max_indices]
        # Fourier matrices from the wall's rows (waves, rows) and columns (columns, waves), and to
        # the plane's rows (rows, waves) and columns (waves, columns)
        from_y, from_x = (
            np.exp(-2j * np.pi / length * np.outer(index, np.arange(count)))
            for length, index, count in zip(plan.lattice, indices, plan.wall.shape, strict=True)
        )
        to_y, to_x = (
            np.exp(2j * np.pi / length * np.outer(np.arange(count), index)) * shift
            for length, index, count, shift in zip(
                plan.plane_lattice, indices, plan.plane.shape, plan.phase_shifts(), strict=True
            )
        )
        self._from_wall, self._to_plane = (put(from_y), put(from_x.T)), (put(to_y), put(to_x.T))
        # First node and weights of the waves of one quadrant, and which of these every wave mirrors.
        node, weight = plan.node_interpolation
        row, column = (np.abs(index) for index in indices)
        corner = column * (plan.max_indices[0] + 1) + row[:, np.newaxis]
        weights = [put(weight[..., tap].reshape(-1, 1)) for tap in range(TAPS)]
        self._nodes = put(node.ravel()), weights, put(corner.ravel())
        # 1 where a wave counts at a frequency, else 0, (frequencies, rows, columns)
        counted = np.zeros((plan.lateral_limits.size, row.size, column.size), np.float32)
        for frequency, mask in enumerate(counted):
            tallest = plan.max_row_indices(frequency)
            tall = np.append(tallest, -1)[np.minimum(column, tallest.size)]
            mask[:] = row[:, np.newaxis] <= tall
        self._mask = put(counted)
        # Frequencies that share their functions of depth, and so few that their spectra fit: with
        # their terms at points (m, n) and at nodes (frequencies, nodes, m)
        self._groups: list[tuple[slice, Array, Array]] = []
        for number, together in enumerate(plan.low_rank_transfer.groups):
            parts, over_points = plan.low_rank_transfer.terms(number)
            count = len(over_points)
            at_nodes = parts[..., :count] + 1j * parts[..., count : 2 * count]
            at_points = put(over_points)
            size = library.chunk_bytes // (8 * count * row.size * column.size)
            for some in split_blocks(len(at_nodes), max(1, size)):
                frequencies = slice(together.start + some.start, together.start + some.stop)
                self._groups.append((frequencies, at_points, put(at_nodes[some])))

    def field(self, phasors: Array) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies)."""
        xp = self.library.xp
        field = self.library.zeros((*self.plan.plane.shape, phasors.shape[1]))
        (from_y, from_x), (to_y, to_x) = self._from_wall, self._to_plane
        node, weights, corner = self._nodes
        for frequencies, at_points, at_nodes in self._groups:
            values = xp.permute_dims(phasors[:, frequencies], (1, 0))[:, None, :] * at_points
            spectra = from_y @ arrange_on_lattice(values, self.plan.wall, self.library) @ from_x
            factors = weights[0] * xp.take(at_nodes, node, axis=1)
            for tap in range(1, TAPS):
                factors = factors + weights[tap] * xp.take(at_nodes, node + tap, axis=1)
            factors = xp.permute_dims(xp.take(factors, corner, axis=1), (0, 2, 1))
            joined = xp.sum(xp.reshape(factors, spectra.shape) * spectra, axis=1)
            on_plane = to_y @ (joined * self._mask[frequencies, ...]) @ to_x
            field[:, :, frequencies] = xp.permute_dims(on_plane, (1, 2, 0))
        return field


def sum_waves_on_device(
    geometry: WallBeforePlane, waves: SphericalWaves, library: ArrayLibrary, phasors: Array
) -> Array:
    """Every wall point's spherical wave, summed; see `propagate_direct`."""
    xp, shape, sources = library.xp, geometry.plane.shape, phasors.shape[0]
    ends = geometry.plane.points.reshape(-1, 3), geometry.points
    # Distances are what counts: near the middle, single-precision coordinates have most digits.
    middle = ends[0].mean(axis=0)
    targets, walls = (library.put((one - middle).T) for one in ends)
    # Products of few coarse and few fine waves make up all frequencies: exponentials cost more than
    # products.
    fine = int(np.ceil(np.sqrt(waves.count)))
    coarse = -(-waves.count // fine)
    first = waves.first + waves.step * fine * np.arange(coarse)
    steps = [library.put(k / (2 * np.pi)) for k in (first, waves.step * np.arange(fine))]
    missing = library.zeros((sources, coarse * fine - waves.count))
    padded = xp.reshape(xp.concat([phasors, missing], axis=1), (sources, coarse, fine))
    field = library.zeros((targets.shape[1], coarse * fine))
    size = max(1, library.chunk_bytes // (8 * sources * coarse * fine))
    for some in split_blocks(targets.shape[1], size):
        across = xp.sum((targets[:, some, None] - walls[:, None, :]) ** 2, axis=0)
        distance = xp.sqrt(xp.clip(across, MIN_DISTANCE_M**2, None))[:, :, None]
        slow, fast = (library.exp_cycles(distance * cycles) for cycles in steps)
        spherical = (slow / distance)[:, :, :, None] * fast[:, :, None, :]
        field[some, :] = xp.reshape(xp.sum(spherical * padded, axis=1), (-1, coarse * fine))
    return xp.reshape(field[:, : waves.count], (*shape, waves.count))


def choose_propagation(
    geometry: WallBeforePlane,
    waves: SphericalWaves,
    tolerance: float,
    library: ArrayLibrary | None,
    phasors: Array,
) -> Callable[[Array, Progress], Array]:
    """Return the faster way that keeps the tolerance from phasors (n, frequencies) of wall points to the
    field (y, x, frequencies) on a plane, whose values progress counts: direct sums, or Fourier
    transforms, whose terms are chosen for the spectrum of these `phasors`. `library`: theirs, none for
    NumPy.
    """
    sample = phasors[slice(None, None, phasors.shape[0] // STRENGTH_POINTS + 1), :]
    strength = estimate_strength(sample if library is None else to_numpy(sample))
    scattered = library is None and has_finufft()
    with limit_blas_threads():
        plan = plan_transforms(geometry, waves, strength, tolerance, scattered)
    if library is not None:
        carry = partial(sum_waves_on_device, geometry, waves, library)
        on_lattice = plan and DevicePropagation(plan, library).field

        def carry_at_once(phasors: Array, progress: Progress) -> Array:
            field = (on_lattice or carry)(phasors)
            progress(math.prod(field.shape))
            return field

        return carry_at_once
    if plan is not None:
        return partial(propagate_low_rank, plan)
    return lambda phasors, progress: propagate_direct(
        geometry.points, phasors, geometry.plane, waves.wavenumbers, progress
    )


Diffraction = CompiledDiffraction | PortableDiffraction


class Backend:
    """What computes on a capture's arrays at the frequencies of a band."""

    def __init__(self, band: Band, capture: Capture) -> None:
        self.band, self.library = band, None
        zeros: Callable[..., Array] = partial(np.zeros, dtype=np.complex64)
        if not is_numpy(capture.signal):
            self.library = library = ArrayLibrary(capture.device)
            self._transform, zeros = BandTransform(band, capture.axis.bins, library), library.zeros
        self.zeros = zeros

    def compute_phasors(self, capture: Capture, group: IlluminationGroup) -> Array:
        """Return the phasors P_k (points, frequencies) of a group's wall points, complex64."""
        if self.library is not None:
            return self._transform.of(get_traces(capture, group.indices))
        traces = capture.traces()
        own = traces if len(group.indices) == len(traces) else traces[group.indices]
        return np.asarray(self.band.compute_phasors(own), np.complex64)

    def place_on_lattice(self, phasors: Array, lattice: WallLattice) -> Array:
        """Put phasors (points, frequencies) into their places, (y, x, frequencies)."""
        if self.library is None:
            return lattice.place(phasors)
        xp = self.library.xp
        placed = arrange_on_lattice(xp.permute_dims(phasors, (1, 0)), lattice, self.library)
        return xp.permute_dims(placed, (1, 2, 0))

    def plane_to_depths(self, plan: DiffractionPlan, source: LaserSource) -> Diffraction:
        """Return what carries fields from a plane to all depths, in the light of a source."""
        if self.library is None:
            return CompiledDiffraction(plan, source)
        return PortableDiffraction(plan, source, self.library)


def propagate(
    capture: Capture,
    plane: Plane,
    pulse: VirtualPulse,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> PlaneField:
    """Carry a capture's phasor field from its wall onto a plane between wall and scene.

    The wall may have any shape and any number of pieces; its points need no order, and masked ones
    are left out.

    Parameters
    ----------
    capture : Capture
        Of one laser spot, or confocal.
    plane : Plane
        In front of every wall point.
    pulse : VirtualPulse
    propagation : {"spectral", "time"}
        At the band's frequencies only; or the paper's shifting and adding of transients, whose
        error is that of linear interpolation between bins.
    tolerance : float
        Relative error of the field that is allowed for the sake of speed, 1e-4 to 0.1; "spectral"
        only. Walls of many points go by Fourier transforms, those of scattered points if finufft is
        installed (``tofclip[scattered]``), others by direct sums, good to 1e-5.

    Raises
    ------
    InputError
        Several laser spots, an empty band, or a plane that is not in front of the wall.
    """
    groups = group_by_illumination(capture)
    if len(groups) > 1:
        raise InputError(
            f"{len(groups)} laser spots make as many fields: propagate the wall points of one at a time"
        )
    require_tolerance(tolerance)
    require_known("propagation", propagation, get_args(Propagation))
    group, band = groups[0], Band(pulse, capture.axis)
    wall = WallBeforePlane.of(capture.points[group.indices], plane)
    how = Backend(band, capture), propagation, tolerance
    carry = plan_wall_to_plane(capture, wall, group, band, *how)
    wavenumbers = group.legs * band.wavenumbers
    return PlaneField(carry(capture, ignore_progress, group), plane, wavenumbers)


def plan_wall_to_plane(
    capture: Capture,
    geometry: WallBeforePlane,
    group: IlluminationGroup,
    band: Band,
    backend: Backend,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> WallToPlane:
    """Return what carries groups of the same wall points onto a plane; see `propagate`. Progress
    counts points of the plane times frequencies.
    """
    points, plane = geometry.points, geometry.plane
    require_in_front(plane.z, points)
    if propagation == "time":
        require_numpy_signal("propagation in time", capture)

        def shift_and_sum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            traces = np.ascontiguousarray(one.traces()[group.indices])
            return propagate_in_time(points, traces, plane, band, group.legs, progress)

        return shift_and_sum
    how = geometry, build_waves(group, band, continued=False), tolerance, backend.library
    chosen: list[Callable[[Array, Progress], Array]] = []  # by the first phasors that come

    def propagate_spectrum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
        phasors = backend.compute_phasors(one, group)
        if not chosen:
            chosen.append(choose_propagation(*how, phasors))
        return chosen[0](phasors, progress)

    return propagate_spectrum


POINTS_PER_BLOCK = 64


def propagate_in_time(
    points: FloatArray,
    traces: Float32Array,
    plane: Plane,
    band: Band,
    legs: int,
    progress: Progress = ignore_progress,
) -> ComplexArray:
    """Return the phasors (y, x, frequencies) of transients (n, t) of points (n, 3), m, carried onto
    a plane bin by bin: earlier by their way there, `legs` times, linear between bins, an error of
    some 0.5 % for 15 bins per wavelength that grows with their square.

    Supplementary Note 12 of X. Feng, Y. Ma, L. Gao, Nat. Commun. 13, 3333 (2022).
    """
    targets = plane.points.reshape(-1, 3)
    scale = legs / band.axis.spacing
    nearest, farthest = find_leg_bounds(points, Grid(plane.x, plane.y, np.array([plane.z])))
    latest = np.ceil(farthest * scale)
    bins = traces.shape[1] + int(latest - np.floor(nearest * scale)) + 2
    paths = band.axis.start + band.axis.spacing * (np.arange(bins) - latest)
    analysis = (band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))).astype(np.complex64)
    field = np.empty((len(targets), band.wavenumbers.size), np.complex64)

    def process_block(block: slice) -> None:
        sums = np.zeros((block.stop - block.start, bins), np.float32)
        shift_and_sum(traces, points, targets[block], scale, float(latest), sums)
        field[block] = sums @ analysis
        progress(field[block].size)

    run_blocks(process_block, len(targets), size=POINTS_PER_BLOCK)
    return field.reshape(*plane.shape, -1)


def require_in_front(z: float, points: FloatArray) -> None:
    """Refuse a virtual plane that a wall's points (n, 3) reach up to."""
    foremost = float(points[:, 2].max())
    if z <= foremost:
        raise InputError(
            f"the virtual plane must lie in front of the wall, which reaches up to z = {foremost:.4g} m"
        )


def require_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that makes no sense or cannot be met in single precision."""
    if not 1e-4 <= tolerance <= 0.1:
        raise InputError(f"the tolerance must lie between 1e-4 and 0.1, got {tolerance}")
