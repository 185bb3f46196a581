"""Wall to plane to depths: the three steps that `PlanarRSD` and `Hybrid` share, on any backend.

See ``docs/nlos_algorithm.md``: phasors P_k on the wall, the field S_k on a plane, and the image,
the sum over k of ``S_k(r) * exp(1j * k * |r_L - r|)``, at every depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nlos.backends import Backend, Diffraction
from nlos.band import Band
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.illumination_groups import IlluminationGroup, build_source, warn_of_aliasing
from nlos.method import PhasorPlan, Progress, SubProgress
from nlos.plane import Plane
from nlos.propagation.propagate import WallToPlane
from nlos.rsd.diffraction import BYTES_PER_WAVE, DiffractionPlan
from nlos.volume import Volume
from tofclip.arrays import Array

SUM_BYTES, MAGNITUDE_BYTES = 8, 4
"""Per voxel: a complex64 sum, and its float32 magnitude."""

COMPUTED_BYTES = 8
"""Per voxel, at most: the complex64 images of those depths that are computed, from which the others
follow."""

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
            grid.size * (SUM_BYTES + COMPUTED_BYTES + MAGNITUDE_BYTES)
            + MAGNITUDE_BYTES * capture.axis.bins * capture.valid.size
            + SPECTRUM_COPIES * groups[0].memory_bytes
        )
        self._held: tuple[DiffractionPlan | None, dict[int, Diffraction]] = None, {}
        self._warned = False

    @property
    def cost(self) -> int:
        return len(self.groups) * self.grid.size

    @property
    def images(self) -> int:
        """Images that are made and added up."""
        return len(self.groups)

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
        total = self.zeros()
        for number in range(len(self.groups)):
            self.add_to_depths(
                number, self.propagate_to_plane(number, capture, progress), total, progress
            )
        return Volume(total, self.grid, {**capture.provenance, "imaging": self.settings})

    def zeros(self) -> Array:
        """Make a dark field (z, y, x) on the plan's device, complex64."""
        return self._backend.zeros(self.grid.shape)

    def propagate_to_plane(self, number: int, capture: Capture, progress: Progress) -> Array:
        """Return the field (y, x, frequencies) of one illumination group on its plane.

        Parameters
        ----------
        number : int
            Of the group.
        capture : Capture
        progress : callable
            Called with a part of the number of voxels.

        Returns
        -------
        (y, x, frequencies) complex64 array
        """
        group = self.groups[number]
        plane, waves = group.plane_to_depths.plane, group.plane_to_depths.waves
        points = plane.x.size * plane.y.size * waves.count
        return group.wall_to_plane(capture, SubProgress(progress, points, self._wall_work(number)))

    def add_to_depths(self, number: int, on_plane: Array, total: Array, progress: Progress) -> None:
        """Add what the field of one illumination group shows to a volume.

        Parameters
        ----------
        number : int
            Of the group.
        on_plane : (y, x, frequencies) complex64 array
        total : (z, y, x) complex64 array
            Added to, in place.
        progress : callable
            Called with the rest of the number of voxels.
        """
        work = self.grid.size - self._wall_work(number)
        diffraction = self._hold_diffraction(number)
        diffraction.add(on_plane, total, SubProgress(progress, self.grid.size, work))

    def _hold_diffraction(self, number: int) -> Diffraction:
        """Return what carries a group's field to the voxels.

        Tables and threads' memory are those of one plane at a time, which its groups share: a scan
        may have hundreds of planes.
        """
        group = self.groups[number]
        plane, made = self._held
        if plane is not group.plane_to_depths:
            plane, made = self._held = group.plane_to_depths, {}
        if not made:
            # a copy, whose tables end with it
            source = build_source(group.group, self.band)
            made[number] = self._backend.plane_to_depths(replace(plane), source)
        elif number not in made:
            made[number] = next(iter(made.values())).for_laser(group.group.laser)
        return made[number]

    def _wall_work(self, number: int) -> int:
        """How many voxels the way from the wall to the plane counts for."""
        return int(self.groups[number].wall_fraction * self.grid.size)
