"""Wall to plane to depths: the three steps that `PlanarRSD` and `Hybrid` share, on any backend.

See ``docs/nlos_algorithm.md``: phasors P_k on the wall, the field S_k on a plane, and the image,
the sum over k of ``S_k(r) * exp(1j * k * |r_L - r|)``, at every depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nlos.backends import Backend
from nlos.band import Band
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.illumination_groups import IlluminationGroup, build_source, warn_of_aliasing
from nlos.method import PhasorPlan, Progress, SubProgress
from nlos.plane import Plane
from nlos.propagation.propagate import WallToPlane
from nlos.rsd.diffraction import BYTES_PER_WAVE, DiffractionPlan
from nlos.volume import Volume

SUM_BYTES, MAGNITUDE_BYTES = 8, 4
"""Per voxel: a complex64 sum, and its float32 magnitude."""

SPECTRUM_COPIES = 2
"""Spectra are held before and after they are transformed."""


@dataclass(frozen=True, eq=False)
class GroupPlan:
    """The road of one illumination group: from its wall points to a plane, and on to the voxels.

    Parameters
    ----------
    group : IlluminationGroup
    wall_to_plane : callable
        Gives the field S_k where `plane_to_depths` begins; on a virtual plane, times the area that
        each of its points stands for, as the Rayleigh-Sommerfeld integral has it.
    plane_to_depths : DiffractionPlan
        From the plane, the wall's own or a virtual one, to the voxels.
    wall_fraction : float
        Of all time, what the way from the wall to the plane takes, roughly.
    """

    group: IlluminationGroup
    wall_to_plane: WallToPlane
    plane_to_depths: DiffractionPlan
    wall_fraction: float = 0.0

    @property
    def memory_bytes(self) -> int:
        """What fields and plane waves take, all frequencies together, bytes; an estimate."""
        plan = self.plane_to_depths
        values = int(plan.plane_wave_count) + plan.plane.x.size * plan.plane.y.size
        return (values + len(self.group.indices)) * plan.waves.count * BYTES_PER_WAVE


class WavePlan(PhasorPlan):
    """Every illumination group's road, and the images at their ends added up.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    band : Band
        The frequencies that are imaged.
    backend : Backend
        Of the capture's arrays.
    groups : sequence of GroupPlan
    settings : mapping
        What a volume reports of how it was imaged.
    """

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        band: Band,
        backend: Backend,
        groups: Sequence[GroupPlan],
        settings: Mapping[str, Any],
    ) -> None:
        super().__init__(capture, grid)
        self.band, self.groups, self.settings = band, groups, dict(settings)
        self._backend = backend
        self._memory_bytes = (
            grid.size * (SUM_BYTES + MAGNITUDE_BYTES)
            + MAGNITUDE_BYTES * capture.axis.bins * capture.valid.size
            + SPECTRUM_COPIES * groups[0].memory_bytes
        )
        self._diffractions = [
            backend.plane_to_depths(one.plane_to_depths, build_source(one.group, band))
            for one in groups
        ]
        self._warned = False

    @property
    def cost(self) -> int:
        return len(self.groups) * self.grid.size

    @property
    def memory_bytes(self) -> int:
        return self._memory_bytes

    @property
    def plane(self) -> Plane:
        """The plane of the first illumination group."""
        return self.groups[0].plane_to_depths.plane

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        if not self._warned:
            warn_of_aliasing(capture, self.band)
            self._warned = True
        total = self._backend.zeros(self.grid.shape)
        for group, diffraction in zip(self.groups, self._diffractions, strict=True):
            plane, waves = group.plane_to_depths.plane, group.plane_to_depths.waves
            wall_work = int(group.wall_fraction * self.grid.size)
            wall_progress = SubProgress(
                progress, plane.x.size * plane.y.size * waves.count, wall_work
            )
            depth_progress = SubProgress(progress, self.grid.size, self.grid.size - wall_work)
            on_plane = group.wall_to_plane(capture, wall_progress)
            diffraction.add(on_plane, total, depth_progress)
        return Volume(total, self.grid, {**capture.provenance, "imaging": self.settings})
