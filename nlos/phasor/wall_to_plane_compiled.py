"""From wall points to a plane by compiled loops: by Fourier transforms, or by direct sums.

The counterpart of `nlos.phasor.wall_to_plane_arrays`. Either way returns ``S_k(r_v) = sum_p
P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nlos.method import Progress, ignore_progress
from nlos.phasor.to_depths_compiled import choose_inverse
from nlos.phasor.wall_kernels import (
    FREQUENCY_STEPS,
    TARGET_LANES,
    add_low_rank_terms,
    add_spherical_waves,
)
from nlos.phasor.wall_to_plane import WallToPlanePlan
from nlos.plane import Plane
from tofclip.arrays import ComplexArray, FloatArray
from tofclip.threads import limit_blas_threads, run_blocks

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
