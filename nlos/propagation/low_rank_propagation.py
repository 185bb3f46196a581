"""From a wall in relief to a plane by Fourier transforms: a few convolutions per frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, ignore_progress
from nlos.propagation.kernels import add_low_rank_terms
from nlos.propagation.wall_to_plane_plan import WallToPlanePlan
from nlos.rsd.inverse import choose_inverse
from tofclip.threads import limit_blas_threads, run_blocks


def propagate_low_rank(
    plan: WallToPlanePlan, phasors: NDArray[np.complex64], progress: Progress = ignore_progress
) -> NDArray[np.complex64]:
    """Return ``sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|`` on a plane, within the
    passage's tolerance.

    Per frequency some two to ten Fourier transforms of the wall, weighted by functions of its
    depth, and one back. Memory for the result, for as many transfer functions as depth nodes (10 to
    20 MB for 128 x 128 points and 120 frequencies) and, per thread, for the spectra of one
    frequency's terms.

    Parameters
    ----------
    plan : WallToPlanePlan
    phasors : (n, frequencies) complex64 array
    progress : callable, optional
        Called with the number of values just done.

    Returns
    -------
    (y, x, frequencies) complex64 array
        In memory, frequency after frequency.
    """
    field = np.empty((phasors.shape[1], *plan.plane.shape), np.complex64)
    low_rank_transfer = plan.low_rank_transfer
    with limit_blas_threads():
        max_terms = max(low_rank_transfer.term_counts)
        _ = plan.phase_shifts, plan.node_interpolation
        spare: list[_Workspace] = []

        def process_block(some: slice) -> None:
            workspace = spare.pop() if spare else _Workspace(plan, max_terms)
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

    def __init__(self, plan: WallToPlanePlan, terms: int) -> None:
        self.plan = plan
        self.analysis = plan.analysis(terms)
        column, row = np.meshgrid(
            *(np.arange(-n, n + 1) for n in plan.max_indices[::-1]), indexing="ij"
        )
        self.inverse = choose_inverse((row, column), plan.plane_lattice, plan.plane.shape, 1)
        self.cells = (
            self.inverse.cell_indices[:, 0],
            self.inverse.cell_indices[0] - self.inverse.cell_indices[0, 0],
        )

    def propagate_group(
        self, number: int, phasors: NDArray[np.complex64], field: NDArray[np.complex64]
    ) -> None:
        """Propagate one group of frequencies.

        Parameters
        ----------
        number : int
            Of the group.
        phasors : (points, frequencies) complex64 array
        field : (frequencies, y, x) complex64 array
            Overwritten at the group's frequencies.
        """
        plan = self.plan
        group, terms = plan.low_rank_transfer.groups[number], plan.low_rank_transfer.terms(number)
        values = np.ascontiguousarray(phasors[:, group].T)
        shift_y, shift_x = plan.phase_shifts
        spectrum = self.inverse.spectra[0]
        for i, frequency in enumerate(range(group.start, group.stop)):
            reach = plan.max_row_indices(frequency)
            spectra = self.analysis.spectra(values[i], terms.point_factors, reach.size - 1)
            spectrum[:] = 0
            parts = spectra.view(np.float32)
            wave_factors = terms.wave_factors[i], *plan.node_interpolation
            add_low_rank_terms(parts, *wave_factors, reach, shift_x, shift_y, *self.cells, spectrum)
            self.inverse.transform(slice(0, 1))
            np.multiply(self.inverse.images[0], self.inverse.carrier, out=field[frequency])
