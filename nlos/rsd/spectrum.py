"""The plane waves that make up a field on a plane, at every frequency of the band."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LATERAL_ROUNDING = 1e-9
"""Lateral wavenumbers nearer to each other are one, rad/m."""


@dataclass(frozen=True, eq=False)
class PlaneWaves:
    """The plane waves of a periodic lattice that carry anything, ordered by lateral wavenumber.

    Parameters
    ----------
    period : (float, float)
        Of the lattice in space along y and x, m.
    lateral_limits : (frequencies,) array
        Largest lateral wavenumber that counts at each frequency, rad/m; increasing.
    """

    period: tuple[float, float]
    lateral_limits: FloatArray

    @property
    def max_indices(self) -> tuple[int, int]:
        """Largest index along y and x."""
        return self.max_indices_within(float(self.lateral_limits[-1]))

    def max_indices_within(self, lateral: float) -> tuple[int, int]:
        """Largest index along y and x up to a lateral wavenumber."""
        y, x = (int((lateral + LATERAL_ROUNDING) * side / (2 * np.pi)) for side in self.period)
        return y, x

    @cached_property
    def _sorted_waves(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Indices along y and x, and lateral wavenumbers."""
        rows, columns = (np.arange(-n, n + 1) for n in self.max_indices)
        qy, qx = (
            2 * np.pi / side * index
            for side, index in zip(self.period, (rows, columns), strict=True)
        )
        # Rounded, so that waves mirrored in an axis or in the diagonal are equal.
        lateral = (
            LATERAL_ROUNDING * np.rint(np.hypot(qy[:, np.newaxis], qx) / LATERAL_ROUNDING).ravel()
        )
        inside = np.flatnonzero(lateral <= self.lateral_limits[-1])
        # from the longest lateral wave up: those within a frequency's limit are the first ones
        order = inside[np.argsort(lateral[inside], kind="stable")]
        return rows[order // columns.size], columns[order % columns.size], lateral[order]

    @property
    def row(self) -> IntArray:
        """Index along y of every wave."""
        return self._sorted_waves[0]

    @property
    def column(self) -> IntArray:
        """Index along x of every wave."""
        return self._sorted_waves[1]

    @property
    def lateral_wavenumbers(self) -> FloatArray:
        """Lateral wavenumber of every wave, rad/m."""
        return self._sorted_waves[2]
