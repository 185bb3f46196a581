"""From wall points to the plane waves of a periodic lattice."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlos.rsd.inverse import PLANNING
from nlos.rsd.wall import WallLattice

if TYPE_CHECKING:
    import pyfftw

COLUMNS_AT_A_TIME = 16
"""Plans for Fourier transforms of so many columns more."""


class LatticeAnalysis:
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, for points that stand above an even lattice.

    Along x only the rows with points in them are transformed, along y only the columns that count. Not to be shared
    between threads.

    Parameters
    ----------
    wall : WallLattice
    lattice : (int, int)
        Places in a period along y and x; at least the wall's.
    reach : int
        Largest index along x.
    terms : int
        At most.
    """

    def __init__(self, wall: WallLattice, lattice: tuple[int, int], reach: int, terms: int) -> None:
        import pyfftw

        high, wide = lattice
        self._lattice, self._shape = lattice, wall.shape
        rows, columns = wall.shape
        self._place = None if wall.complete else wall.row * columns + wall.column
        self._points: NDArray[np.complex64] = pyfftw.zeros_aligned((rows, wide), np.complex64)
        self._middle: NDArray[np.complex64] = pyfftw.zeros_aligned((wide, high), np.complex64)
        widest = self._columns(reach)
        self._spectra: NDArray[np.complex64] = pyfftw.zeros_aligned((terms, min(2 * widest, wide), high), np.complex64)
        with PLANNING:
            self._along_x = pyfftw.FFTW(self._points, self._middle[:, :rows].T, axes=(1,), flags=("FFTW_MEASURE",))
        self._along_y: dict[int, pyfftw.FFTW] = {}

    def _columns(self, reach: int) -> int:
        """How many columns from index 0 on are transformed; as many before it, unless these are all."""
        needed = -(-(reach + 1) // COLUMNS_AT_A_TIME) * COLUMNS_AT_A_TIME
        return needed if 2 * needed < self._lattice[1] else self._lattice[1]

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x.

        Parameters
        ----------
        values : (points,) complex64 array
        weights : (terms, points) complex64 array
        reach : int

        Returns
        -------
        (terms, columns, rows) complex64 array
            Columns and rows in the order of Fourier transforms, first 0 and last -1; an index beyond them is found
            modulo their number. Valid until the next call.
        """
        columns = self._columns(reach)
        plan = self._plan(columns)
        ends = (slice(0, columns), slice(self._lattice[1] - columns, None)) if columns < self._lattice[1] else ()
        for term, weight in enumerate(weights):
            self._spread(values, weight)
            self._along_x.execute()
            for number, some in enumerate(ends or (slice(None),)):
                out = self._spectra[term, number * columns : (number + 1) * columns]
                plan.update_arrays(self._middle[some], out)
                plan.execute()
        return self._spectra[: len(weights), : 2 * columns if ends else columns]

    def _spread(self, values: NDArray[np.complex64], weight: NDArray[np.complex64]) -> None:
        """Put weighted values into their places."""
        rows, columns = self._shape
        if self._place is None:
            np.multiply(values.reshape(self._shape), weight.reshape(self._shape), out=self._points[:, :columns])
        else:
            flat = np.zeros(rows * columns, np.complex64)
            flat[self._place] = values * weight
            self._points[:, :columns] = flat.reshape(self._shape)

    def _plan(self, columns: int) -> pyfftw.FFTW:
        import pyfftw

        if columns not in self._along_y:
            with PLANNING:
                arrays = self._middle[:columns], self._spectra[0, :columns]
                self._along_y[columns] = pyfftw.FFTW(*arrays, axes=(1,), flags=("FFTW_MEASURE",))
        return self._along_y[columns]
