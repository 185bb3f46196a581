"""`nlos.PreparedImaging`: captures of one geometry, imaged one after the other by what is planned
once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlos.capture import Capture
from nlos.geometry import FloatArray, Grid
from nlos.hybrid import WALL_TO_PLANE_ERROR_FRACTION, Hybrid
from nlos.illumination_groups import IlluminationGroup, choose_unaliased_band, group_by_illumination
from nlos.method import Progress, ignore_progress
from nlos.portable.diffraction import PortableDiffraction
from nlos.portable.library import ArrayLibrary
from nlos.portable.propagation import PortablePropagation
from nlos.portable.signals import BandTransform, arrange_on_lattice, get_group_traces
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.planar import PlanarRSD, build_source, build_waves
from nlos.rsd.wall import PlanarWall, WallLattice
from nlos.volume import Volume
from tofclip.arrays import Array, is_numpy
from tofclip.errors import InputError

PlanePropagation = Callable[[Capture], Array]
"""Carries a capture onto a plane: the field (y, x, frequencies) there, weighted as diffraction
takes it.
"""


@dataclass(frozen=True, eq=False)
class _GroupPlan:
    """One exposure's way to the voxels."""

    propagate_to_plane: PlanePropagation
    diffraction: PortableDiffraction


class PreparedImaging:
    """A method made ready for captures that differ in their signals only, such as those of a moving
    scene.

    On other libraries' arrays, transfer functions, illuminations and all that is planned stay where
    the signals live: the second capture costs matrix products only. On NumPy's the compiled loops
    plan each anew.

    Memory: see `nlos.portable.diffraction.PortableDiffraction`.

    Parameters
    ----------
    method : PlanarRSD or Hybrid
    capture : Capture
        One of them; geometry, time axis and place are what counts.
    grid : Grid

    Raises
    ------
    InputError
        The method does not support such a capture on the grid.
    """

    def __init__(self, method: PlanarRSD | Hybrid, capture: Capture, grid: Grid) -> None:
        method.supports(capture, grid).require()
        self.method, self.grid = method, grid
        self._first = capture
        self._prepared = None if is_numpy(capture.signal) else PreparedField(method, capture, grid)

    def reconstruct(self, capture: Capture, progress: Progress = ignore_progress) -> Volume:
        """Image a capture; the result is that of ``method.reconstruct(capture, grid)``.

        Parameters
        ----------
        capture : Capture
            Of the geometry that was prepared for.
        progress : callable
            As for the method's own.

        Returns
        -------
        Volume

        Raises
        ------
        InputError
            Its wall, laser, time axis or place is another than that of the capture that was
            prepared for.
        """
        self._require_same_geometry(capture)
        if self._prepared is None:
            return self.method.reconstruct(capture, self.grid, progress)
        field = self._prepared.of(capture, progress)
        return Volume(
            abs(field), self.grid, {**capture.provenance, "imaging": self._prepared.settings}
        )

    def _require_same_geometry(self, capture: Capture) -> None:
        for name in ("wall", "laser"):
            if not np.array_equal(
                getattr(capture, name), getattr(self._first, name), equal_nan=True
            ):
                raise InputError(
                    f"the {name} is not that of the capture that this imaging was prepared for"
                )
        if capture.axis != self._first.axis:
            raise InputError(f"prepared for {self._first.axis}, got a capture of {capture.axis}")
        if capture.device != self._first.device:
            raise InputError(
                f"prepared for signals on {self._first.device}, got one on {capture.device}"
            )


class PreparedField:
    """The complex field of captures that differ in their signals only.

    Parameters
    ----------
    method : PlanarRSD or Hybrid
    capture : Capture
        One of them; geometry, time axis and place are what counts.
    grid : Grid
    """

    def __init__(self, method: PlanarRSD | Hybrid, capture: Capture, grid: Grid) -> None:
        self.grid, self.library = grid, ArrayLibrary(capture.device)
        self.settings = method.settings
        self._band = choose_unaliased_band(capture, grid, method.pulse)
        self._band_transform = BandTransform(self._band, capture.axis.bins, self.library)
        if isinstance(method, PlanarRSD):
            self._group_plans = [
                self._plan_planar(method, capture, group)
                for group in group_by_illumination(capture)
            ]
        else:
            plans = method.plans(capture, grid)
            self._group_plans = [
                self._plan_hybrid(method, capture.points[group.indices], group, plan)
                for group, plan in plans
            ]
            self.settings["plane_z_m"] = plans[-1][1].plane.z

    def of(self, capture: Capture, progress: Progress = ignore_progress) -> Array:
        """Return the field (z, y, x), complex64, where the capture's signal lives.

        Parameters
        ----------
        capture : Capture
        progress : callable

        Returns
        -------
        (z, y, x) complex64 array
        """
        total = self.library.zeros(self.grid.shape)
        for group_plan in self._group_plans:
            group_plan.diffraction.add(group_plan.propagate_to_plane(capture), total, progress)
        return total

    def _plan_planar(
        self, method: PlanarRSD, capture: Capture, group: IlluminationGroup
    ) -> _GroupPlan:
        wall = PlanarWall.of(capture.points[group.indices])
        plan = DiffractionPlan(
            wall.plane, self.grid, build_waves(group, self._band, continued=False), method.tolerance
        )

        def propagate_to_plane(one: Capture) -> Array:
            return _arrange_on_wall(
                wall.lattice, self._band_transform.of(get_group_traces(one, group)), self.library
            )

        return _GroupPlan(
            propagate_to_plane,
            PortableDiffraction(plan, build_source(group, self._band), self.library),
        )

    def _plan_hybrid(
        self, method: Hybrid, points: FloatArray, group: IlluminationGroup, plan: DiffractionPlan
    ) -> _GroupPlan:
        tolerance, area = (
            WALL_TO_PLANE_ERROR_FRACTION * method.tolerance,
            float(np.prod(plan.plane.steps)),
        )
        waves = build_waves(group, self._band, continued=False)
        propagation = PortablePropagation(points, plan.plane, waves, tolerance, self.library)

        def propagate_to_plane(one: Capture) -> Array:
            return area * propagation.field(self._band_transform.of(get_group_traces(one, group)))

        return _GroupPlan(
            propagate_to_plane,
            PortableDiffraction(plan, build_source(group, self._band), self.library),
        )


def _arrange_on_wall(wall: WallLattice, phasors: Array, library: ArrayLibrary) -> Array:
    """Put phasors (points, frequencies) into their places on the wall, (y, x, frequencies)."""
    xp = library.xp
    return xp.permute_dims(
        arrange_on_lattice(xp.permute_dims(phasors, (1, 0)), wall, library), (1, 2, 0)
    )
