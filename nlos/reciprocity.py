"""Laser spots and wall points in each other's place: light takes the same path either way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.geometry import FloatArray, Grid
from nlos.illumination_groups import swap_roles
from nlos.kernels import MIN_DISTANCE_M
from nlos.method import PhasorPlan, Progress
from nlos.volume import Volume
from nlos.wave_plan import SUM_BYTES, WavePlan


class ReciprocalPlan(PhasorPlan):
    """A plan for captures whose roles are swapped, for captures as they come.

    Of the swapped capture come waves ``s(L) / |r_L - r|`` that fall with the distance from the
    laser spots. As the path is ``L = |r_L - r| + |r - r_p|``, the same waves of signals times their
    path, less those waves times ``|r - r_p|``, fall with neither distance; divided by ``|r - r_p|``
    they are those of the capture as it came.

    `capture`: as it comes; `swapped`: for the capture whose roles are swapped.
    """

    def __init__(self, capture: Capture, grid: Grid, swapped: WavePlan) -> None:
        super().__init__(capture, grid)
        self.swapped = swapped

    @property
    def cost(self) -> int:
        return 2 * self.swapped.cost

    @property
    def images(self) -> int:
        """Images that are made and added up."""
        return 2 * self.swapped.images

    @property
    def memory_bytes(self) -> int:
        return self.swapped.memory_bytes + 2 * SUM_BYTES * self.grid.size

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        plain, device = swap_roles(capture), capture.device
        paths = capture.axis.paths.reshape(-1, *[1] * (capture.wall.ndim - 1))
        longer = replace(plain, signal=plain.signal * device.put(paths.astype(np.float32)))
        band = self.swapped.band
        # i dG/dk / G of the pulse's weights G_k, whose phasors of L * H are not those of L * s
        detuning = band.wavenumbers - band.pulse.wavenumber
        slopes = device.put((-1j * band.pulse.sigma**2 * detuning).astype(np.complex64))
        total, without = self.swapped.zeros(), self.swapped.zeros()
        for number, one in enumerate(self.swapped.groups):
            plane_field = self.swapped.propagate_to_plane(number, plain, progress)
            self.swapped.add_to_depths(number, plane_field, without, progress)
            plane_field = self.swapped.propagate_to_plane(number, longer, progress) + (
                plane_field * slopes
            )
            own = self.swapped.zeros()
            self.swapped.add_to_depths(number, plane_field, own, progress)
            total += own / device.put(_find_distance(one.group.laser, self.grid))
        history = {**capture.provenance, "imaging": self.swapped.settings}
        return Volume(total - without, self.grid, history)


def _find_distance(spot: FloatArray | None, grid: Grid) -> NDArray[np.float32]:
    """Distance of every voxel (z, y, x) from a spot, m."""
    x, y, z = np.zeros(3) if spot is None else spot
    across = (grid.y[:, np.newaxis] - y) ** 2 + (grid.x - x) ** 2
    squared = (grid.z[:, np.newaxis, np.newaxis] - z) ** 2 + across
    return np.asarray(np.sqrt(np.maximum(squared, MIN_DISTANCE_M**2)), np.float32)
