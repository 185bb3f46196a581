"""The way of a field from one plane to the voxels of many: window, lattice, plane waves and transfer functions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlos.geometry import Grid
from nlos.method import MEMORY_LIMIT_BYTES, Support
from nlos.plane import Plane, step
from nlos.rsd.spectrum import PlaneWaves
from nlos.rsd.transfer import Transfer, Waves

REACH = 0.9
"""Where the window begins to fall, relative to the largest distance of a source and a voxel, from corner to corner."""

EDGE = 0.25
"""Width of the window's edge, relative to the largest distance along one axis."""


WAVE_BYTES = 8
"""A complex64 phasor of a plane wave at one frequency."""


@dataclass(frozen=True, eq=False)
class Diffraction:
    """How fields on one plane reach one grid of voxels.

    Parameters
    ----------
    plane : Plane
    grid : Grid
        x and y evenly spaced, z as you like.
    waves : Waves
    tolerance : float
        Relative error allowed.
    """

    plane: Plane
    grid: Grid
    waves: Waves
    tolerance: float

    @cached_property
    def _farthest(self) -> tuple[float, float]:
        """Largest distance of a source from a voxel along y and along x, m."""
        pairs = ((self.grid.y, self.plane.y), (self.grid.x, self.plane.x))
        y, x = (float(max(abs(a[-1] - b[0]), abs(a[0] - b[-1]))) for a, b in pairs)
        return y, x

    @cached_property
    def _window(self) -> tuple[float, float]:
        """Where the window's edge begins and ends, m."""
        reach = REACH * float(np.hypot(*self._farthest))
        return reach, reach + EDGE * max(self._farthest)

    @cached_property
    def lattice(self) -> tuple[int, int]:
        """Voxels in a period along y and x: no image of a source may meet a voxel inside the window."""
        sides = (self._window[1] + far for far in self._farthest)
        counts = (
            int(np.ceil(side / step(axis))) if axis.size > 1 else 1
            for side, axis in zip(sides, (self.grid.y, self.grid.x), strict=True)
        )
        y, x = (_convenient(count) for count in counts)
        return y, x

    @cached_property
    def plane_waves(self) -> PlaneWaves:
        """The plane waves that carry the field."""
        # The window's edge spreads grazing waves over lateral wavenumbers beyond their own; measured on point scenes.
        spread = np.log10(self.tolerance) ** 2 / 2 / (self._window[1] - self._window[0])
        limits = self.waves.first + self.waves.step * np.arange(self.waves.count) + spread
        sides = (
            count * step(axis) if axis.size > 1 else self._window[1] + far
            for count, axis, far in zip(self.lattice, (self.grid.y, self.grid.x), self._farthest, strict=True)
        )
        y, x = sides
        return PlaneWaves((y, x), limits)

    def supports(self) -> Support:
        """Say whether the field's plane waves fit into memory."""
        y, x = self.plane_waves.period
        count = np.pi * float(self.plane_waves.limits[-1]) ** 2 * y * x / (2 * np.pi) ** 2
        size = count * self.waves.count * WAVE_BYTES
        if size > MEMORY_LIMIT_BYTES:
            return Support(
                f"{count:.3g} plane waves at {self.waves.count} frequencies need {size / 2**30:.1f} GiB, more than the "
                f"{MEMORY_LIMIT_BYTES >> 30} GiB allowed: use a longer wavelength or a smaller grid"
            )
        return Support()

    @cached_property
    def transfer(self) -> Transfer:
        """Transfer functions from the plane to any depth."""
        reach, edge = self._window
        finest = float(np.abs(self.grid.z - self.plane.z).min())
        return Transfer(
            self.waves, reach, edge, float(self.plane_waves.limits[-1]), max(finest, step(self.plane.x) / 2)
        )


def _convenient(count: int) -> int:
    """Next length that Fourier transforms are fast at: factors 2, 3 and 5 only, and a few 2 among them for vectors."""
    from scipy.fft import next_fast_len

    while count > 1 and (count % 16 or next_fast_len(count, real=True) != count):
        count += 1
    return count
