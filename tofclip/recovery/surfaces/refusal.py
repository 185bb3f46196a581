"""Which shots are not of surfaces: smoke, light in flight, relay walls. They are refused."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import measure
from tofclip.errors import InputError
from tofclip.recovery.surfaces.model import Image, SurfaceModel
from tofclip.recovery.surfaces.patches import Patch
from tofclip.recovery.surfaces.pulse import ShotPulse
from tofclip.recovery.surfaces.weights import compare_smoothed
from tofclip.shots import Frames, Returns, Streak

FloatArray = NDArray[np.float64]

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
# Bins of range that a pixel spans where a surface is seen nearly edge-on, and the share of the
# returns' light there: returns scatter by several bins about it, and a fit to them would be as far
# off. Plates that are turned by 1.3 rad have 0.01 of it, by 1.4 rad 0.43, other scenes up to 0.011.
STEEP_BINS, MAX_STEEP_SHARE = 10.0, 0.3
SLOPE_WINDOW_PX = 7


def require_gentle_slopes(found: Returns, bin_m: float) -> None:
    """Refuse a shot most of whose light is on surfaces seen nearly edge-on.

    `bin_m`: range of a bin, m.
    """
    slope, scatter = measure_slopes(found.image("range"))
    steep = (slope > STEEP_BINS * bin_m) & (scatter < slope)
    light = float(found.intensity.sum())
    share = float(found.intensity[steep[found.y, found.x]].sum()) / light if light else 0.0
    if share > MAX_STEEP_SHARE:
        raise InputError(
            f"{100 * share:.0f} % of the returns' light lies on surfaces that are turned so far that a "
            f"pixel spans more than {STEEP_BINS:.0f} bins of range, which has no one range: choose "
            '`method="tv"`, or turn them towards the camera'
        )


def measure_slopes(distance: Image) -> tuple[FloatArray, FloatArray]:
    """Return how far ranges change from pixel to pixel, by a plane through each pixel's
    surroundings.

    `distance` (rows, columns): ranges, m; NaN where there is none. Returns `slope` (rows, columns):
    m per pixel; 0 where less than half of the surroundings has a range; `scatter` (rows, columns):
    root mean square distance of the ranges from the plane, m.
    """
    known = np.isfinite(distance)
    place = np.indices(distance.shape).astype(np.float64)
    y, x = place[0], place[1]
    # differences of large numbers follow: the middle of all is taken off first
    middle = float(np.median(distance[known])) if known.any() else 0.0
    values: FloatArray = np.where(known, distance - middle, 0.0).astype(np.float64)

    def average(image: FloatArray) -> FloatArray:
        found: FloatArray = scipy.ndimage.uniform_filter(
            np.where(known, image, 0.0), SLOPE_WINDOW_PX, mode="constant"
        )
        return found

    share = average(np.ones(distance.shape))
    whole = np.maximum(share, SLOPE_WINDOW_PX**-2)
    columns = (x, y, values)
    mean = [average(one) / whole for one in columns]
    xx, xy, xr, yy, yr, rr = (
        average(columns[i] * columns[j]) / whole - mean[i] * mean[j]
        for i in range(3)
        for j in range(i, 3)
    )
    determinant = np.maximum(xx * yy - xy**2, np.finfo(np.float32).eps)
    across, down = (xr * yy - yr * xy) / determinant, (yr * xx - xr * xy) / determinant
    scatter = np.sqrt(np.maximum(rr - across * xr - down * yr, 0))
    return np.where(share > 0.5, np.hypot(across, down), 0.0), scatter


def require_surfaces(found: Returns, patches: list[Patch]) -> None:
    """Refuse a shot whose returns do not lie side by side on surfaces.

    `patches`: surfaces through them.
    """
    on_surface = np.zeros(found.camera.image_shape, bool)
    for patch in patches:
        on_surface.ravel()[patch.pixels] = True
    light = float(found.intensity.sum())
    share = float(found.intensity[on_surface[found.y, found.x]].sum()) / light if light else 0.0
    if share < MIN_SURFACE_SHARE:
        raise _refuse(f"only {100 * share:.0f} % of the returns' light lies on smooth surfaces")


def require_short_pulse(pulse: ShotPulse) -> None:
    """Refuse a shot whose pixels go on receiving light long after the return."""
    if pulse.tail_share > MAX_TAIL_SHARE:
        raise _refuse(
            f"{100 * pulse.tail_share:.0f} % of each pixel's light comes long after its peak"
        )


def require_explained(
    model: SurfaceModel, amplitude: Image, frames: Frames, streak: Streak
) -> None:
    """Refuse a shot that surfaces explain neither well nor as well as its frames do.

    `amplitude` (points,); `frames`: A fast recovery of the same shot.
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
