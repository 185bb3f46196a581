"""From a wall in relief to a plane by Fourier transforms: a few convolutions per frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, silent
from nlos.propagation.kernels import join_terms
from nlos.propagation.passage import Passage
from nlos.rsd.inverse import inverse
from tofclip.threads import one_blas_thread, run_blocks


def layered_sum(passage: Passage, phasors: NDArray[np.complex64], progress: Progress = silent) -> NDArray[np.complex64]:
    """Return ``sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|`` on a plane, within the passage's tolerance.

    Per frequency some two to ten Fourier transforms of the wall, weighted by functions of its depth, and one back.
    Memory for the result, for as many transfer functions as depth nodes (10 to 20 MB for 128 x 128 points and 120
    frequencies) and, per thread, for the spectra of one frequency's terms.

    Parameters
    ----------
    passage : Passage
    phasors : (n, frequencies) complex64 array
    progress : callable, optional
        Called with the number of values just done.

    Returns
    -------
    (y, x, frequencies) complex64 array
        In memory, frequency after frequency.
    """
    field = np.empty((phasors.shape[1], *passage.plane.shape), np.complex64)
    relief = passage.relief
    with one_blas_thread():
        most = max(relief.counts)
        _ = passage.shifts, passage.between_nodes
        spare: list[_Bench] = []

        def work(some: slice) -> None:
            bench = spare.pop() if spare else _Bench(passage, most)
            for number in range(some.start, some.stop):
                # High frequencies have most waves: with these first, threads end together.
                group = len(relief.groups) - 1 - number
                bench.carry(group, phasors, field)
                progress(field[relief.groups[group]].size)
            spare.append(bench)

        run_blocks(work, len(relief.groups), size=1)
    return np.moveaxis(field, 0, -1)


class _Bench:
    """One thread's memory, and what it does there."""

    def __init__(self, passage: Passage, terms: int) -> None:
        self.passage = passage
        self.analysis = passage.analysis(terms)
        column, row = np.meshgrid(*(np.arange(-n, n + 1) for n in passage.reach[::-1]), indexing="ij")
        self.inverse = inverse((row, column), passage.plane_lattice, passage.plane.shape, 1)
        self.cells = self.inverse.cell[:, 0], self.inverse.cell[0] - self.inverse.cell[0, 0]

    def carry(self, number: int, phasors: NDArray[np.complex64], field: NDArray[np.complex64]) -> None:
        """Carry one group of frequencies."""
        passage = self.passage
        group, terms = passage.relief.groups[number], passage.relief.terms(number)
        values = np.ascontiguousarray(phasors[:, group].T)
        shift_y, shift_x = passage.shifts
        spectrum = self.inverse.spectra[0]
        for i, frequency in enumerate(range(group.start, group.stop)):
            reach = passage.rows_within(frequency)
            spectra = self.analysis.spectra(values[i], terms.over_points, reach.size - 1)
            spectrum[:] = 0
            parts = spectra.view(np.float32)
            over_waves = terms.over_waves[i], *passage.between_nodes
            join_terms(parts, *over_waves, reach, shift_x, shift_y, *self.cells, spectrum)
            self.inverse.transform(slice(0, 1))
            np.multiply(self.inverse.images[0], self.inverse.carrier, out=field[frequency])
