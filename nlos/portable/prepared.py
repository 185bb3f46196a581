"""`nlos.PreparedImaging`: captures of one geometry, imaged one after the other by what is planned once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlos.capture import Capture
from nlos.exposure import Exposure, exposures, unfolded_band
from nlos.geometry import FloatArray, Grid
from nlos.hybrid import PASSAGE_SHARE, Hybrid
from nlos.method import Progress, silent
from nlos.portable.diffraction import PortableDiffraction
from nlos.portable.library import Library
from nlos.portable.propagation import WallToPlane
from nlos.portable.signals import Analysis, exposed, on_lattice
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.planar import PlanarRSD, source_of, waves_of
from nlos.rsd.wall import PlanarWall, WallLattice
from nlos.volume import Volume
from tofclip.arrays import Array, is_numpy
from tofclip.errors import InputError

Onto = Callable[[Capture], Array]
"""Carries a capture onto a plane: the field (y, x, frequencies) there, weighted as diffraction takes it."""


@dataclass(frozen=True, eq=False)
class _Route:
    """One exposure's way to the voxels."""

    onto: Onto
    onwards: PortableDiffraction


class PreparedImaging:
    """A method made ready for captures that differ in their signals only, such as those of a moving scene.

    On other libraries' arrays, transfer functions, illuminations and all that is planned stay where the signals live:
    the second capture costs matrix products only. On NumPy's the compiled loops plan each anew.

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

    def reconstruct(self, capture: Capture, progress: Progress = silent) -> Volume:
        """Image a capture; the result is that of ``method.reconstruct(capture, grid)``.

        Raises
        ------
        InputError
            Its wall, laser, time axis or place is another than that of the capture that was prepared for.
        """
        self._require_alike(capture)
        if self._prepared is None:
            return self.method.reconstruct(capture, self.grid, progress)
        field = self._prepared.of(capture, progress)
        return Volume(abs(field), self.grid, {**capture.provenance, "imaging": self._prepared.settings})

    def _require_alike(self, capture: Capture) -> None:
        for name in ("wall", "laser"):
            if not np.array_equal(getattr(capture, name), getattr(self._first, name), equal_nan=True):
                raise InputError(f"the {name} is not that of the capture that this imaging was prepared for")
        if capture.axis != self._first.axis:
            raise InputError(f"prepared for {self._first.axis}, got a capture of {capture.axis}")
        if capture.place != self._first.place:
            raise InputError(f"prepared for signals on {self._first.place}, got one on {capture.place}")


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
        self.grid, self.library = grid, Library(capture.place)
        self.settings = method.settings
        self._band = unfolded_band(capture, grid, method.pulse)
        self._analysis = Analysis(self._band, capture.axis.bins, self.library)
        if isinstance(method, PlanarRSD):
            self._routes = [self._planar(method, capture, part) for part in exposures(capture)]
        else:
            ways = method.ways(capture, grid)
            self._routes = [self._by_plane(method, capture.points[part.members], part, way) for part, way in ways]
            self.settings["plane_z_m"] = ways[-1][1].plane.z

    def of(self, capture: Capture, progress: Progress = silent) -> Array:
        """Return the field (z, y, x), complex64, where the capture's signal lives."""
        total = self.library.zeros(self.grid.shape)
        for route in self._routes:
            route.onwards.add(route.onto(capture), total, progress)
        return total

    def _planar(self, method: PlanarRSD, capture: Capture, part: Exposure) -> _Route:
        wall = PlanarWall.of(capture.points[part.members])
        way = Diffraction(wall.plane, self.grid, waves_of(part, self._band, continued=False), method.tolerance)

        def onto(one: Capture) -> Array:
            return _on_wall(wall.lattice, self._analysis.of(exposed(one, part)), self.library)

        return _Route(onto, PortableDiffraction(way, source_of(part, self._band), self.library))

    def _by_plane(self, method: Hybrid, points: FloatArray, part: Exposure, way: Diffraction) -> _Route:
        tolerance, area = PASSAGE_SHARE * method.tolerance, float(np.prod(way.plane.steps))
        waves = waves_of(part, self._band, continued=False)
        carrying = WallToPlane(points, way.plane, waves, tolerance, self.library)

        def onto(one: Capture) -> Array:
            return area * carrying.field(self._analysis.of(exposed(one, part)))

        return _Route(onto, PortableDiffraction(way, source_of(part, self._band), self.library))


def _on_wall(wall: WallLattice, phasors: Array, library: Library) -> Array:
    """Put phasors (points, frequencies) into their places on the wall, (y, x, frequencies)."""
    xp = library.xp
    return xp.permute_dims(on_lattice(xp.permute_dims(phasors, (1, 0)), wall, library), (1, 2, 0))
