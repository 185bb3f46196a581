"""The way of a field from one plane to the voxels of many: window, lattice, plane waves and
transfer functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlos.geometry import Grid
from nlos.method import MEMORY_LIMIT_BYTES, Support
from nlos.plane import Plane, axis_step
from nlos.rsd.spectrum import PlaneWaves
from nlos.rsd.transfer import SphericalWaves, TransferFunction
from nlos.rsd.window import Window, find_fast_length, find_max_offsets, find_min_periods

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

    def supports(self) -> Support:
        """Say whether the field's plane waves fit into memory."""
        y, x = self.plane_waves.period
        # area of the circle of lateral wavenumbers over that of one plane wave, (2 pi)^2 / (y x)
        count = np.pi * float(self.plane_waves.lateral_limits[-1]) ** 2 * y * x / (2 * np.pi) ** 2
        size = count * self.waves.count * BYTES_PER_WAVE
        if size > MEMORY_LIMIT_BYTES:
            return Support(
                f"{count:.3g} plane waves at {self.waves.count} frequencies need {size / 2**30:.1f} GiB, more than the "
                f"{MEMORY_LIMIT_BYTES >> 30} GiB allowed: use a longer wavelength or a smaller grid"
            )
        return Support()

    @cached_property
    def transfer(self) -> TransferFunction:
        """Transfer functions from the plane to any depth."""
        finest = max(float(np.abs(self.grid.z - self.plane.z).min()), axis_step(self.plane.x) / 2)
        return TransferFunction(
            self.waves, self._window, float(self.plane_waves.lateral_limits[-1]), finest
        )
