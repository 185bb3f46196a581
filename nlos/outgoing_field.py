"""What a wall sends into the hidden scene, on the plane from which a method carries it on."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.hybrid import WALL_TO_PLANE_ERROR_FRACTION, Hybrid
from nlos.illumination_groups import group_by_illumination
from nlos.propagation.propagate import propagate_group
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.planar import PlanarRSD, build_waves
from nlos.rsd.wall import PlanarWall

DiffractionMethod = PlanarRSD | Hybrid


def plan_outgoing_diffraction(
    method: DiffractionMethod, capture: Capture, grid: Grid, band: Band
) -> DiffractionPlan:
    """Return the way from the plane of a method, the wall itself or a virtual one, to the voxels.

    Parameters
    ----------
    method : PlanarRSD or Hybrid
    capture : Capture
        Of one laser spot, or confocal.
    grid : Grid
    band : Band

    Returns
    -------
    DiffractionPlan
    """
    (group,) = group_by_illumination(capture)
    if isinstance(method, PlanarRSD):
        plane = PlanarWall.of(capture.points).plane
        return DiffractionPlan(
            plane, grid, build_waves(group, band, continued=False), method.tolerance
        )
    plane = method.virtual_plane(capture, grid)
    return DiffractionPlan(plane, grid, build_waves(group, band, continued=True), method.tolerance)


def compute_outgoing_field(
    method: DiffractionMethod, capture: Capture, plan: DiffractionPlan, band: Band
) -> NDArray[Any]:
    """Return the field of every frequency on the plane where `plan` begins.

    Parameters
    ----------
    method : PlanarRSD or Hybrid
    capture : Capture
        With a single illumination group.
    plan : DiffractionPlan
    band : Band

    Returns
    -------
    (y, x, frequencies) complex64 array
    """
    (group,) = group_by_illumination(capture)
    if isinstance(method, PlanarRSD):
        return PlanarWall.of(capture.points).field(group.compute_phasors(capture, band))
    values = propagate_group(
        capture,
        group,
        plan.plane,
        band,
        method.propagation,
        WALL_TO_PLANE_ERROR_FRACTION * method.tolerance,
    ).values
    return values * np.float32(np.prod(plan.plane.steps))
