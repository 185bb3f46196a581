"""From a plane to the voxels of many depths: a periodic lattice, its plane waves, and the plan that
holds both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import Grid
from nlos.method import MEMORY_LIMIT_BYTES
from nlos.plane import Plane, axis_step
from nlos.rsd.transfer import (
    SphericalWaves,
    TransferFunction,
    Window,
    find_fast_length,
    find_max_offsets,
    find_min_periods,
)
from tofclip.errors import InputError

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


BYTES_PER_WAVE = 8
"""A complex64 phasor of a plane wave at one frequency."""


@dataclass(frozen=True, eq=False)
class DiffractionPlan:
    """How fields on one plane reach one grid of voxels.

    Parameters
    ----------
    plane : Plane
    grid : Grid
        x and y evenly spaced, z as you like.
    waves : SphericalWaves
    tolerance : float
        Relative error allowed.
    """

    plane: Plane
    grid: Grid
    waves: SphericalWaves
    tolerance: float

    @cached_property
    def _max_offsets(self) -> tuple[float, float]:
        return find_max_offsets(self.plane, self.grid.y, self.grid.x)

    @cached_property
    def lattice(self) -> tuple[int, int]:
        """Voxels in a period along y and x: no image of a source may meet a voxel inside the
        window.
        """
        y, x = (
            find_fast_length(side / axis_step(axis)) if axis.size > 1 else 1
            for side, axis in zip(
                find_min_periods(self._max_offsets), (self.grid.y, self.grid.x), strict=True
            )
        )
        return y, x

    @cached_property
    def _periods(self) -> tuple[float, float]:
        """Of the lattice along y and x, m."""
        y, x = (
            count * axis_step(axis) if axis.size > 1 else side
            for count, axis, side in zip(
                self.lattice,
                (self.grid.y, self.grid.x),
                find_min_periods(self._max_offsets),
                strict=True,
            )
        )
        return y, x

    @cached_property
    def _window(self) -> Window:
        return Window.within(self._max_offsets, self._periods)

    @cached_property
    def plane_waves(self) -> PlaneWaves:
        """The plane waves that carry the field."""
        return PlaneWaves(
            self._periods, self.waves.wavenumbers + self._window.spectral_spread(self.tolerance)
        )

    @property
    def plane_wave_count(self) -> float:
        """How many plane waves there are, roughly: what a circle of wavenumbers holds."""
        y, x = self.plane_waves.period
        return float(np.pi * self.plane_waves.lateral_limits[-1] ** 2 * y * x / (2 * np.pi) ** 2)

    def require_memory(self) -> None:
        """Refuse a field whose plane waves do not fit into memory."""
        count = self.plane_wave_count
        size = count * self.waves.count * BYTES_PER_WAVE
        if size > MEMORY_LIMIT_BYTES:
            raise InputError(
                f"{count:.3g} plane waves at {self.waves.count} frequencies need {size / 2**30:.1f} GiB, more than the "
                f"{MEMORY_LIMIT_BYTES >> 30} GiB allowed: use a longer wavelength or a smaller grid"
            )

    @cached_property
    def transfer(self) -> TransferFunction:
        """Transfer functions from the plane to any depth."""
        finest = max(float(np.abs(self.grid.z - self.plane.z).min()), axis_step(self.plane.x) / 2)
        return TransferFunction(
            self.waves, self._window, float(self.plane_waves.lateral_limits[-1]), finest
        )
