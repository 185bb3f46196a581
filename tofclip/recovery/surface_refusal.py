"""Which shots are not of surfaces: smoke, light in flight, relay walls. They are refused."""

from __future__ import annotations

import numpy as np

from tofclip.camera import measure
from tofclip.errors import InputError
from tofclip.recovery.surface_model import Image, SurfaceModel, compare_smoothed
from tofclip.recovery.surface_patches import Patch
from tofclip.recovery.surface_pulse import ShotPulse
from tofclip.shots import Frames, Returns, Streak

# Of the returns' light: below, the shot is not one of surfaces. Simulated shots of surfaces have 0.93
# or more, recorded ones 0.97; recorded relay walls have 0.50 to 0.79.
MIN_SURFACE_SHARE = 0.7
# Of the measurements, both smoothed so that photons' noise hardly counts: above, much of the light is
# not where the surfaces are. Surfaces leave 0.02 to 0.22, recorded relay walls 0.2 to 0.5. Smoke's
# first light looks like one surface, but only the first.
MAX_UNEXPLAINED = 0.3
# Of a pulse's light, that long after its peak: more is not an instrument's afterglow (0.18), but light
# that comes from many depths to each pixel.
MAX_TAIL_SHARE = 0.3


def require_surfaces(found: Returns, patches: list[Patch]) -> None:
    """Refuse a shot whose returns do not lie side by side on surfaces.

    Parameters
    ----------
    found : Returns
    patches : list of Patch
        Surfaces through them.

    Raises
    ------
    InputError
        Less than `MIN_SURFACE_SHARE` of their light lies on surfaces.
    """
    on_surface = np.zeros(found.camera.image_shape, bool)
    for patch in patches:
        on_surface.ravel()[patch.pixels] = True
    light = float(found.intensity.sum())
    share = float(found.intensity[on_surface[found.y, found.x]].sum()) / light if light else 0.0
    if share < MIN_SURFACE_SHARE:
        raise _refuse(f"only {100 * share:.0f} % of the returns' light lies on smooth surfaces")


def require_short_pulse(pulse: ShotPulse) -> None:
    """Refuse a shot whose pixels go on receiving light long after the return.

    Parameters
    ----------
    pulse : ShotPulse

    Raises
    ------
    InputError
        More than `MAX_TAIL_SHARE` of its light comes long after its peak.
    """
    if pulse.tail_share > MAX_TAIL_SHARE:
        raise _refuse(
            f"{100 * pulse.tail_share:.0f} % of each pixel's light comes long after its peak"
        )


def require_explained(
    model: SurfaceModel, amplitude: Image, frames: Frames, streak: Streak
) -> None:
    """Refuse a shot that surfaces explain neither well nor as well as its frames do.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
    frames : Frames
        A fast recovery of the same shot.
    streak : Streak

    Raises
    ------
    InputError
        Surfaces leave more than `MAX_UNEXPLAINED` of the signal, and more than the frames do.
    """
    unexplained = model.unexplained(amplitude)
    if unexplained <= MAX_UNEXPLAINED:
        return
    # In little light noise is left over however right the surfaces are, and by frames as well.
    camera = frames.camera
    seen = measure(streak.counts, streak.saturated, camera)
    predicted = np.zeros_like(seen.values)
    for shear in np.unique(frames.shears):
        own = np.flatnonzero(frames.shears == shear)
        pictures = np.ascontiguousarray(np.moveaxis(frames.values[own], 0, -1))
        predicted[:, own] = camera.operator(float(shear))(pictures)
    by_frames = compare_smoothed(predicted, seen.values, seen.valid)
    if unexplained > by_frames:
        raise _refuse(
            f"surfaces leave {100 * unexplained:.0f} % of the signal unexplained, and frames "
            f"{100 * by_frames:.0f} %"
        )


def _refuse(fault: str) -> InputError:
    """The error of a shot that is not one of surfaces."""
    return InputError(
        f"{fault}: this shot's light is not on surfaces (smoke, light in flight, a relay wall); "
        'choose `method="tv"`'
    )
