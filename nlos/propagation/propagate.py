"""`nlos.propagate`: what a wall of any shape recorded, as the field on a plane in front of it."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.exposure import Exposure, exposures
from nlos.method import Progress, silent
from nlos.plane import Plane
from nlos.propagation.direct import direct_sum
from nlos.propagation.layered import layered_sum
from nlos.propagation.passage import Passage
from nlos.propagation.plane_field import PlaneField
from nlos.propagation.scattered import ScatteredPassage, scattered_transforms
from nlos.propagation.shift_and_sum import delayed_sum
from nlos.rsd.planar import require_tolerance, waves_of
from tofclip.arrays import is_numpy, require_numpy
from tofclip.errors import InputError

Propagation = Literal["spectral", "time"]

SAMPLED_POINTS = 1024
"""Enough wall points to tell the strength of a frequency from."""


def propagate(
    capture: Capture,
    plane: Plane,
    pulse: VirtualPulse,
    propagation: Propagation = "spectral",
    tolerance: float = 1e-2,
) -> PlaneField:
    """Carry a capture's phasor field from its wall onto a plane between wall and scene.

    The wall may have any shape and any number of pieces; its points need no order, and masked ones are left out.

    Parameters
    ----------
    capture : Capture
        Of one laser spot, or confocal.
    plane : Plane
        In front of every wall point.
    pulse : VirtualPulse
    propagation : {"spectral", "time"}
        At the band's frequencies only; or the paper's shifting and adding of transients, whose error is that of linear
        interpolation between bins.
    tolerance : float
        Relative error of the field that is allowed for the sake of speed, 1e-4 to 0.1; "spectral" only. Walls of many
        points go by Fourier transforms, those of scattered points if finufft is installed (``tofclip[scattered]``),
        others by direct sums, good to 1e-5.

    Returns
    -------
    PlaneField

    Raises
    ------
    InputError
        Several laser spots, an empty band, or a plane that is not in front of the wall.
    """
    parts = exposures(capture)
    if len(parts) > 1:
        raise InputError(f"{len(parts)} laser spots make as many fields: propagate the wall points of one at a time")
    require_tolerance(tolerance)
    return carried(capture, parts[0], plane, Band(pulse, capture.axis), propagation, tolerance)


def carried(
    capture: Capture,
    part: Exposure,
    plane: Plane,
    band: Band,
    propagation: Propagation,
    tolerance: float = 1e-2,
    progress: Progress = silent,
) -> PlaneField:
    """Carry one exposure of a capture at a band's frequencies; see `propagate`.

    Progress, which another library's arrays leave out, counts points of the plane times frequencies.
    """
    require_propagation(propagation)
    points = capture.points[part.members]
    foremost = float(points[:, 2].max())
    if plane.z <= foremost:
        raise InputError(
            f"the plane at z = {plane.z:.4g} m must lie in front of the wall, which reaches up to {foremost:.4g} m"
        )
    wavenumbers = part.passes * band.wavenumbers
    if propagation == "time":
        require_numpy("propagation in time", capture.signal)
        traces = np.ascontiguousarray(capture.traces()[part.members])
        return PlaneField(delayed_sum(points, traces, plane, band, part.passes, progress), plane, wavenumbers)
    if not is_numpy(capture.signal):
        from nlos.portable.propagation import carried_elsewhere

        return carried_elsewhere(capture, part, plane, band, tolerance)
    phasors = part.phasors(capture, band)
    way = points, plane, waves_of(part, band, continued=False), strength(phasors), tolerance
    passage = Passage.of(*way)
    if passage is None and scattered_transforms():
        passage = ScatteredPassage.of(*way)
    if passage is not None and passage.quicker:
        return PlaneField(layered_sum(passage, phasors, progress), plane, wavenumbers)
    return PlaneField(direct_sum(points, phasors, plane, wavenumbers, progress), plane, wavenumbers)


def strength(phasors: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Estimate how strong phasors (points, frequencies) are at each frequency, relative to the strongest."""
    some = np.abs(phasors[:: len(phasors) // SAMPLED_POINTS + 1])
    energy = np.mean(some.astype(np.float64) ** 2, axis=0)
    relative: NDArray[np.float64] = np.sqrt(energy / energy.max()) if energy.any() else np.ones(energy.size)
    return relative


def require_propagation(propagation: str) -> None:
    """Refuse a word that names no way of propagating."""
    if propagation not in get_args(Propagation):
        raise InputError(f"propagation must be one of {', '.join(get_args(Propagation))}, got '{propagation}'")
