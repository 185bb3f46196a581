"""From wall points to the plane waves of a periodic lattice."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nlos.fourier_plans import FourierPlan, allocate_zeros, plan_transform
from nlos.plane import WallLattice
from nlos.rsd.kernels import transpose

COLUMN_STEP = 8
"""Columns from one plan for Fourier transforms to the next."""


class PlaneWaveAnalysis(Protocol):
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, on one thread."""

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x, (terms, columns, rows); see
        `LatticeAnalysis`.

        `values` (points,); `weights` (terms, points); `reach`: largest index along x. Returns
        (terms, columns, rows).
        """
        ...


class LatticeAnalysis:
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, for points that stand above an
    even lattice.

    Along x only the rows with points in them are transformed, along y only the columns that count.
    Not to be shared between threads.

    `lattice`: places in a period along y and x; at least the wall's; `reach`: largest index along
    x; `terms`: at most.
    """

    def __init__(self, wall: WallLattice, lattice: tuple[int, int], reach: int, terms: int) -> None:
        high, wide = lattice
        self._wide, self._shape = wide, wall.shape
        rows, columns = wall.shape
        self._place = None if wall.is_complete else wall.row * columns + wall.column
        most = min(2 * self._count_columns(reach), wide)
        shapes = ((rows, wide), (rows, wide), (most, high), (terms * most, high))
        arrays = [allocate_zeros(shape) for shape in shapes]
        self._points, self._lines, self._middle = arrays[:3]
        self._spectra: NDArray[np.complex64] = arrays[3]
        self._along_x = plan_transform(self._points, self._lines, axis=1)
        self._along_y: dict[int, FourierPlan] = {}

    def _count_columns(self, reach: int) -> int:
        """How many columns from index 0 on are transformed; as many before it, unless these are
        all.
        """
        needed = -(-(reach + 1) // COLUMN_STEP) * COLUMN_STEP
        return needed if 2 * needed < self._wide else self._wide

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x.

        Arguments and result are those of `PlaneWaveAnalysis.spectra`.
        """
        columns, (rows, wide) = self._count_columns(reach), self._lines.shape
        ends = (
            (slice(0, columns), slice(wide - columns, wide))
            if columns < wide
            else (slice(0, wide),)
        )
        # indices from -reach to reach only: they lie at both ends of a Fourier transform
        count = len(ends) * columns
        plan, middle = self._get_plan(count), self._middle[:count]
        # In one piece, whatever its size: compiled loops are quicker then.
        spectra = self._spectra[: len(weights) * count].reshape(len(weights), count, -1)
        for spectrum, weight in zip(spectra, weights, strict=True):
            self._place_values(values, weight)
            self._along_x.execute()
            for number, end in enumerate(ends):
                turned = middle[number * columns : (number + 1) * columns, :rows]
                # along y in contiguous memory: quicker than a transform with a stride
                transpose(self._lines[:, end].view(np.float64), turned.view(np.float64))
            plan.update_arrays(middle, spectrum)
            plan.execute()
        return spectra

    def _place_values(self, values: NDArray[np.complex64], weight: NDArray[np.complex64]) -> None:
        """Put weighted values into their places."""
        rows, columns = self._shape
        if self._place is None:
            np.multiply(
                values.reshape(self._shape),
                weight.reshape(self._shape),
                out=self._points[:, :columns],
            )
        else:
            flat = np.zeros(rows * columns, np.complex64)
            flat[self._place] = values * weight
            self._points[:, :columns] = flat.reshape(self._shape)

    def _get_plan(self, columns: int) -> FourierPlan:
        if columns not in self._along_y:
            arrays = self._middle[:columns], self._spectra[:columns]
            self._along_y[columns] = plan_transform(*arrays, axis=1)
        return self._along_y[columns]
