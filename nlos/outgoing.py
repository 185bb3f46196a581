"""What a wall sends into the hidden scene, on the plane from which a method carries it on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.exposure import exposures
from nlos.geometry import Grid
from nlos.hybrid import PASSAGE_SHARE, Hybrid
from nlos.propagation.propagate import carried
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.planar import PlanarRSD, waves_of
from nlos.rsd.wall import PlanarWall

Method = PlanarRSD | Hybrid


def outgoing_way(method: Method, capture: Capture, grid: Grid, band: Band) -> Diffraction:
    """Return the way from the plane of a method, the wall itself or a virtual one, to the voxels.

    Parameters
    ----------
    method : PlanarRSD or Hybrid
    capture : Capture
        Of one laser spot, or confocal.
    grid : Grid
    band : Band
    """
    (part,) = exposures(capture)
    if isinstance(method, PlanarRSD):
        plane = PlanarWall.of(capture.points).plane
        return Diffraction(plane, grid, waves_of(part, band, continued=False), method.tolerance)
    plane = method.virtual_plane(capture, grid)
    return Diffraction(plane, grid, waves_of(part, band, continued=True), method.tolerance)


def outgoing_field(method: Method, capture: Capture, way: Diffraction, band: Band) -> NDArray[Any]:
    """Return the field of every frequency on the plane where `way` begins, (y, x, frequencies), complex64."""
    (part,) = exposures(capture)
    if isinstance(method, PlanarRSD):
        return PlanarWall.of(capture.points).field(part.phasors(capture, band))
    values = carried(capture, part, way.plane, band, method.propagation, PASSAGE_SHARE * method.tolerance).values
    return values * np.float32(np.prod(way.plane.steps))
