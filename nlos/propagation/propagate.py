"""`nlos.propagate`: what a wall of any shape recorded, as the field on a plane in front of it."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.illumination_groups import IlluminationGroup, group_by_illumination
from nlos.method import Progress, ignore_progress
from nlos.plane import Plane
from nlos.propagation.direct import propagate_direct
from nlos.propagation.low_rank_propagation import propagate_low_rank
from nlos.propagation.plane_field import PlaneField
from nlos.propagation.scattered import ScatteredWallToPlanePlan, has_finufft
from nlos.propagation.shift_and_sum import propagate_in_time
from nlos.propagation.wall_to_plane_plan import WallToPlanePlan
from nlos.rsd.planar import build_waves, require_tolerance
from tofclip.arrays import is_numpy, require_numpy
from tofclip.errors import InputError

Propagation = Literal["spectral", "time"]

STRENGTH_POINTS = 1024
"""Enough wall points to tell the strength of a frequency from."""


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
    return propagate_group(
        capture, groups[0], plane, Band(pulse, capture.axis), propagation, tolerance
    )


def propagate_group(
    capture: Capture,
    group: IlluminationGroup,
    plane: Plane,
    band: Band,
    propagation: Propagation,
    tolerance: float = 1e-2,
    progress: Progress = ignore_progress,
) -> PlaneField:
    """Propagate one illumination group of a capture at a band's frequencies; see `propagate`.

    Progress, which another library's arrays leave out, counts points of the plane times
    frequencies.

    Parameters
    ----------
    capture : Capture
    group : IlluminationGroup
        Points of the capture that share a laser spot.
    plane : Plane
        In front of the wall.
    band : Band
        Wavenumbers, rad/m.
    propagation : str
        ``"time"`` for signals shifted in time; otherwise by frequency.
    tolerance : float
        Relative error of the quick ways.
    progress : callable

    Returns
    -------
    PlaneField
        The field at the plane's points and the band's frequencies.

    Raises
    ------
    InputError
        The plane does not lie in front of the wall, or the arrays are not NumPy's and propagation
        is in time.
    """
    require_propagation(propagation)
    points = capture.points[group.indices]
    foremost = float(points[:, 2].max())
    if plane.z <= foremost:
        raise InputError(
            f"the plane at z = {plane.z:.4g} m must lie in front of the wall, which reaches up to {foremost:.4g} m"
        )
    wavenumbers = group.legs * band.wavenumbers
    if propagation == "time":
        require_numpy("propagation in time", capture.signal)
        traces = np.ascontiguousarray(capture.traces()[group.indices])
        return PlaneField(
            propagate_in_time(points, traces, plane, band, group.legs, progress), plane, wavenumbers
        )
    if not is_numpy(capture.signal):
        from nlos.portable.propagation import propagate_on_device

        return propagate_on_device(capture, group, plane, band, tolerance)
    phasors = group.compute_phasors(capture, band)
    wall_and_plane = (
        points,
        plane,
        build_waves(group, band, continued=False),
        estimate_strength(phasors),
        tolerance,
    )
    plan = WallToPlanePlan.of(*wall_and_plane)
    if plan is None and has_finufft():
        plan = ScatteredWallToPlanePlan.of(*wall_and_plane)
    if plan is not None and plan.is_faster_than_direct:
        return PlaneField(propagate_low_rank(plan, phasors, progress), plane, wavenumbers)
    return PlaneField(
        propagate_direct(points, phasors, plane, wavenumbers, progress), plane, wavenumbers
    )


def estimate_strength(phasors: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Estimate how strong phasors (points, frequencies) are at each frequency, relative to the
    strongest.
    """
    some = np.abs(phasors[:: len(phasors) // STRENGTH_POINTS + 1])
    energy = np.mean(some.astype(np.float64) ** 2, axis=0)
    relative: NDArray[np.float64] = (
        np.sqrt(energy / energy.max()) if energy.any() else np.ones(energy.size)
    )
    return relative


def require_propagation(propagation: str) -> None:
    """Refuse a word that names no way of propagating."""
    if propagation not in get_args(Propagation):
        raise InputError(
            f"propagation must be one of {', '.join(get_args(Propagation))}, got '{propagation}'"
        )
