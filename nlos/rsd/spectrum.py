"""The plane waves that make up a field on a plane, at every frequency of the band."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.plane import Plane
from tofclip.threads import run_blocks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


TILE = 8
"""Side of a square of plane waves that stand together: a cache line of a spectrum."""


@dataclass(frozen=True, eq=False)
class PlaneWaves:
    """The plane waves of a periodic lattice that carry anything.

    Neighbours stand together in tiles, with those mirrored in the axes and in the diagonal, so that they are quickly
    put into a spectrum; tiles are ordered by their distance from the middle, and their waves by lateral wavenumber.

    Parameters
    ----------
    period : (float, float)
        Of the lattice in space along y and x, m.
    limits : (frequencies,) array
        Largest lateral wavenumber that counts at each frequency, rad/m; increasing.
    """

    period: tuple[float, float]
    limits: FloatArray

    @cached_property
    def _reach(self) -> tuple[int, int]:
        """Largest index along y and x."""
        highest = float(self.limits[-1])
        y, x = (int(highest * side / (2 * np.pi)) for side in self.period)
        return y, x

    @cached_property
    def _ordered(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Indices along y and x, and lateral wavenumbers."""
        rows, columns = (np.arange(-n, n + 1) for n in self._reach)
        qy, qx = (2 * np.pi / side * index for side, index in zip(self.period, (rows, columns), strict=True))
        lateral: FloatArray = np.sqrt(qy[:, np.newaxis] ** 2 + qx**2)
        # Rounded, so that waves mirrored in an axis or in the diagonal stand together.
        lateral = np.round(lateral, 9).ravel()
        inside = np.flatnonzero(lateral <= self.limits[-1])
        lateral, row, column = lateral[inside], rows[inside // columns.size], columns[inside % columns.size]
        tiles = np.sort(np.stack([abs(row), abs(column)]) // TILE, axis=0)
        order = np.lexsort((lateral, *tiles, np.hypot(*tiles)))
        return row[order], column[order], lateral[order]

    @property
    def row(self) -> IntArray:
        """Index along y of every wave."""
        return self._ordered[0]

    @property
    def column(self) -> IntArray:
        """Index along x of every wave."""
        return self._ordered[1]

    @property
    def lateral(self) -> FloatArray:
        """Lateral wavenumber of every wave, rad/m."""
        return self._ordered[2]

    def first_frequency(self, lateral: float) -> int:
        """Lowest frequency at which a wave of this lateral wavenumber counts."""
        return int(np.searchsorted(self.limits, lateral))

    def analysed(self, values: NDArray[np.complex64], plane: Plane, origin: tuple[float, float]) -> NDArray[np.float32]:
        """Return ``sum_p values(p) * exp(-1j * q (r_p - origin))`` of every wave q.

        Two matrix products: the plane's spacing need not fit the lattice, a coarse one repeats itself in q as it
        should, and waves beyond their limit are never computed.

        Parameters
        ----------
        values : (y, x, frequencies) complex64 array
        plane : Plane
        origin : (float, float)
            y and x of the point whose phase is 0, m.

        Returns
        -------
        (waves, 2, frequencies) float32 array
            Real and imaginary parts.
        """
        count = values.shape[-1]
        along_y, along_x = (
            _waves(axis - start, side, reach)
            for axis, start, side, reach in zip((plane.y, plane.x), origin, self.period, self._reach, strict=True)
        )
        by_row = np.argsort(self.row, kind="stable")
        edges = np.searchsorted(self.row[by_row], np.arange(-self._reach[0], self._reach[0] + 2))
        half = (along_y @ values.reshape(plane.y.size, -1)).reshape(-1, plane.x.size, count)
        spectrum = np.zeros((self.row.size, 2, count), np.float32)

        def analyse(rows: slice) -> None:
            for i in range(rows.start, rows.stop):
                members = by_row[edges[i] : edges[i + 1]]
                if members.size:
                    first = self.first_frequency(float(self.lateral[members].min()))
                    reach = int(self.column[members].max())
                    waves = along_x[self._reach[1] - reach : self._reach[1] + reach + 1]
                    line = waves @ half[i, :, first:]
                    chosen = line[self.column[members] + reach]
                    spectrum[members, 0, first:], spectrum[members, 1, first:] = chosen.real, chosen.imag

        run_blocks(analyse, len(edges) - 1, size=8)
        return spectrum


def _waves(positions: FloatArray, period: float, reach: int) -> NDArray[np.complex64]:
    indices = 2 * np.pi / period * np.arange(-reach, reach + 1)
    return np.asarray(np.exp(-1j * np.outer(indices, positions)), np.complex64)
