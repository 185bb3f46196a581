"""`nlos.PreparedImaging`: captures of one geometry, imaged one after the other by what is planned once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.exposure import Exposure, exposures, unfolded_band
from nlos.geometry import Grid
from nlos.method import Progress, silent
from nlos.portable.diffraction import PortableDiffraction
from nlos.portable.library import Library
from nlos.portable.signals import exposed_phasors
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.planar import PlanarRSD, source_of, waves_of
from nlos.rsd.wall import PlanarWall
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
    method : PlanarRSD
    capture : Capture
        One of them; geometry, time axis and place are what counts.
    grid : Grid

    Raises
    ------
    InputError
        The method does not support such a capture on the grid.
    """

    def __init__(self, method: PlanarRSD, capture: Capture, grid: Grid) -> None:
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
    method : PlanarRSD
    capture : Capture
        One of them; geometry, time axis and place are what counts.
    grid : Grid
    """

    def __init__(self, method: PlanarRSD, capture: Capture, grid: Grid) -> None:
        self.grid, self.library = grid, Library(capture.place)
        self.settings = method.settings
        band = unfolded_band(capture, grid, method.pulse)
        self._routes = [self._planar(method, capture, band, part) for part in exposures(capture)]

    def of(self, capture: Capture, progress: Progress = silent) -> Array:
        """Return the field (z, y, x), complex64, where the capture's signal lives."""
        total = self.library.zeros(self.grid.shape)
        for route in self._routes:
            route.onwards.add(route.onto(capture), total, progress)
        return total

    def _planar(self, method: PlanarRSD, capture: Capture, band: Band, part: Exposure) -> _Route:
        wall = PlanarWall.of(capture.points[part.members])
        way = Diffraction(wall.plane, self.grid, waves_of(part, band, continued=False), method.tolerance)
        onwards = PortableDiffraction(way, source_of(part, band), self.library)
        return _Route(lambda one: _on_wall(wall, exposed_phasors(one, part, band), self.library), onwards)


def _on_wall(wall: PlanarWall, phasors: Array, library: Library) -> Array:
    """Put phasors (points, frequencies) into their places on the wall, (y, x, frequencies); the others stay dark."""
    xp, shape = library.xp, wall.plane.shape
    if not wall.lattice.complete:
        place = np.full(shape[0] * shape[1], phasors.shape[0])
        place[wall.lattice.row * shape[1] + wall.lattice.column] = np.arange(phasors.shape[0])
        padded = xp.concat([phasors, library.zeros((1, phasors.shape[1]))], axis=0)
        phasors = xp.take(padded, library.put(place), axis=0)
    return xp.reshape(phasors, (*shape, -1))
