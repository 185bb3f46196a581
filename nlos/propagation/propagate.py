"""`nlos.propagate`: what a wall of any shape recorded, as the field on a plane in front of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from nlos.backends import Backend, choose_backend
from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.illumination_groups import IlluminationGroup, build_waves, group_by_illumination
from nlos.method import Progress, ignore_progress, require_numpy_signal
from nlos.plane import Plane, PlaneField
from nlos.propagation.shift_and_sum import propagate_in_time
from nlos.propagation.wall_to_plane_plan import WallBeforePlane
from tofclip.arrays import Array
from tofclip.errors import InputError

Propagation = Literal["spectral", "time"]

WallToPlane = Callable[[Capture, Progress], Array]
"""Carries what a capture's wall points recorded to a plane: the field (y, x, frequencies) there."""

GroupToPlane = Callable[[Capture, Progress, IlluminationGroup], Array]
"""The same for one of several groups of the same wall points."""


def propagate(
    capture: Capture,
    plane: Plane,
    pulse: VirtualPulse,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> PlaneField:
    """Carry a capture's phasor field from its wall onto a plane between wall and scene.

    The wall may have any shape and any number of pieces; its points need no order, and masked ones
    are left out.

    Parameters
    ----------
    capture : Capture
        Of one laser spot, or confocal.
    plane : Plane
        In front of every wall point.
    pulse : VirtualPulse
    propagation : {"spectral", "time"}
        At the band's frequencies only; or the paper's shifting and adding of transients, whose
        error is that of linear interpolation between bins.
    tolerance : float
        Relative error of the field that is allowed for the sake of speed, 1e-4 to 0.1; "spectral"
        only. Walls of many points go by Fourier transforms, those of scattered points if finufft is
        installed (``tofclip[scattered]``), others by direct sums, good to 1e-5.

    Returns
    -------
    PlaneField

    Raises
    ------
    InputError
        Several laser spots, an empty band, or a plane that is not in front of the wall.
    """
    groups = group_by_illumination(capture)
    if len(groups) > 1:
        raise InputError(
            f"{len(groups)} laser spots make as many fields: propagate the wall points of one at a time"
        )
    require_tolerance(tolerance)
    require_propagation(propagation)
    group, band = groups[0], Band(pulse, capture.axis)
    wall_to_plane = plan_wall_to_plane(
        capture,
        WallBeforePlane.of(capture.points[group.indices], plane),
        group,
        band,
        choose_backend(capture, band),
        propagation,
        tolerance,
    )
    wavenumbers = group.legs * band.wavenumbers
    return PlaneField(wall_to_plane(capture, ignore_progress, group), plane, wavenumbers)


def plan_wall_to_plane(
    capture: Capture,
    geometry: WallBeforePlane,
    group: IlluminationGroup,
    band: Band,
    backend: Backend,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> GroupToPlane:
    """Return what carries an illumination group of such captures, or another one of the same wall
    points, onto a plane; see `propagate`.

    `capture`: for the device of its signal; `geometry`: the group's wall points, and the plane.
    Returns from a capture, a progress, which counts points of the plane times frequencies, and a
    group to the field (y, x, frequencies).
    """
    points, plane = geometry.points, geometry.plane
    foremost = float(points[:, 2].max())
    if plane.z <= foremost:
        raise InputError(
            f"the plane at z = {plane.z:.4g} m must lie in front of the wall, which reaches up to {foremost:.4g} m"
        )
    if propagation == "time":
        require_numpy_signal("propagation in time", capture)

        def shift_and_sum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            traces = np.ascontiguousarray(one.traces()[group.indices])
            return propagate_in_time(points, traces, plane, band, group.legs, progress)

        return shift_and_sum
    waves = build_waves(group, band, continued=False)
    propagated = backend.propagate_phasors(geometry, waves, tolerance)

    def propagate_spectrum(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
        return propagated.field(backend.compute_phasors(one, group), progress)

    return propagate_spectrum


def require_propagation(propagation: str) -> None:
    """Refuse a word that is not a propagation from wall to plane."""
    if propagation not in get_args(Propagation):
        raise InputError(
            f"propagation must be one of {', '.join(get_args(Propagation))}, got '{propagation}'"
        )


def require_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that makes no sense or cannot be met in single precision."""
    if not 1e-4 <= tolerance <= 0.1:
        raise InputError(f"the tolerance must lie between 1e-4 and 0.1, got {tolerance}")
