"""What precedes the fit of surfaces: those that the returns of quick frames show, laid out over the
picture. What is no shot of surfaces (smoke, light in flight, relay walls) is refused.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, estimate_dark_level, measure
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import InputError
from tofclip.lidar import compute_ray_directions, depth
from tofclip.recovery.surfaces.amplitudes import LEAST_COUNT, AmplitudeSolver
from tofclip.recovery.surfaces.growing import bend_patches
from tofclip.recovery.surfaces.model import (
    SMOOTHING_PX,
    SurfaceModel,
    compare_smoothed,
    smooth_evenly,
)
from tofclip.recovery.surfaces.patches import (
    MARGIN_PX,
    Patch,
    extend_patches,
    find_dimmer_patches,
    find_plain_patches,
    reach_further,
)
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.pulse import Image, ShotPulse
from tofclip.recovery.surfaces.shapes import Pixels
from tofclip.shots import Frames, Returns, Streak
from tofclip.units import SPEED_OF_LIGHT

SURE_FALSE_ALARM = 0.04  # of a return that makes a surface
MIN_SURE_FRACTION = 0.8  # of a patch's returns
# Of the signal, noise that hides surfaces from single pixels (0.05 to 0.1 in 200 photons, 0.2 to 0.7 in 50), and
# the standard deviations of means over pixels that are then looked at, one after the other, each from how much
# noise on: some surfaces show in a few pixels, others in a hundred.
DIM, DARK = 0.05, 0.15
POOLED_PX = ((0.7, DIM), (1.4, DARK), (2.8, DARK))

# Of the returns' light: below, the shot is not one of surfaces. Simulated shots of surfaces have 0.93
# or more, recorded ones 0.97; recorded relay walls have 0.50 to 0.79.
MIN_SURFACE_SHARE = 0.7
# Of the measurements, both smoothed so that photons' noise hardly counts: above, much of the light is
# not where the surfaces are. Surfaces leave 0.02 to 0.22, 0.3 where frames see things beside them, and
# recorded relay walls 0.2 to 0.5. Smoke's first light looks like one surface, but only the first.
MAX_UNEXPLAINED = 0.4
TOO_DARK = 0.8  # noise, of a shot's signal: what surfaces are found there are noise's (0.9 of 5 photons, 0.6 of 15)
# Of what frames leave unexplained, and of what surfaces left in the shot before: from there on the
# surfaces are not the shot's.
CHANGED_RATIO = 1.25
# Of a pulse's light, that long after its peak: more is not an instrument's afterglow (0.18 of one of a
# quarter of the light), but light that comes from many depths to each pixel (0.32 and 0.34 of two recorded
# relay walls, but 0.16 of a third).
MAX_TAIL_SHARE = 0.21
# Bins of range that a pixel spans where a surface is seen nearly edge-on, and the share of the
# returns' light there: returns scatter by several bins about it, and a fit to them would be as far
# off. Plates that are turned by 1.3 rad have 0.01 of it, by 1.4 rad 0.43, other scenes up to 0.011.
STEEP_BINS, MAX_STEEP_SHARE = 10.0, 0.3
SLOPE_WINDOW_PX = 7


def find_surfaces(
    found: Returns, streak: Streak, frames: Frames, weight: float, darkness: float
) -> tuple[AmplitudeSolver, Returns]:
    """Find the surfaces that the returns of frames show, and what else frames show of them; refuse what is no
    shot of surfaces. `darkness`: of `estimate_darkness`.
    """
    camera, bin_m = frames.camera, SPEED_OF_LIGHT * frames.bin_width / 2
    ray_length = measure_rays(camera)
    _require_gentle_slopes(found, bin_m)

    # 2. Patches.
    shown = _leave_out_doubtful(found, ray_length, bin_m)
    for sigma_px, least in POOLED_PX:
        if darkness > least:
            shown = _add_pooled(shown, frames, sigma_px, ray_length, bin_m)
    patches = find_brightest_patches(shown, ray_length, bin_m)
    on_surface = np.zeros(camera.image_shape, bool)
    for patch in patches:
        on_surface.ravel()[patch.pixels] = True
    share = _measure_light(shown, on_surface)
    if share < MIN_SURFACE_SHARE:
        raise _refuse(f"only {100 * share:.0f} % of the returns' light lies on smooth surfaces")
    patches += find_dimmer_patches(patches, shown, ray_length, bin_m)

    # 3. A surface may reach beyond its returns: measurements decide where it ends.
    masks, amplitude = lay_out(patches, shown, frames.values.sum(axis=0), bin_m)
    state = SurfaceState.start([patch.coefficients for patch in patches], camera)
    bases = [patch.basis for patch in patches]
    model = SurfaceModel(streak, camera, masks, bases, state)
    there = np.isfinite(found.image("range"))
    seen = found.merge(shown[~there[shown.y, shown.x]])
    return AmplitudeSolver(model, amplitude, weight), seen


def _add_pooled(
    shown: Returns, frames: Frames, sigma_px: float, ray_length: FloatArray, bin_m: float
) -> Returns:
    """Add what pixels without a return show together with those about them: of a surface in little light
    none alone is out of the noise, but many beside each other are at one range.
    """
    there = np.isfinite(shown.image("range"))
    pooled = scipy.ndimage.gaussian_filter(frames.values, (0, sigma_px, sigma_px))
    pooled = np.where(there, frames.values, pooled)
    found = depth(replace(frames, values=pooled), shown.camera)
    found = _leave_out_doubtful(found, ray_length, bin_m)
    return shown.merge(found[~there[found.y, found.x]])


def measure_rays(camera: Camera) -> FloatArray:
    """Return range over depth of each pixel, (rows, columns)."""
    directions = compute_ray_directions(camera, *np.indices(camera.image_shape).reshape(2, -1))
    return np.asarray(1 / directions[:, 2]).reshape(camera.image_shape)


def _require_gentle_slopes(found: Returns, bin_m: float) -> None:
    """Refuse a shot most of whose light is on surfaces seen nearly edge-on."""
    slope, scatter = measure_slopes(found.image("range"))
    share = _measure_light(found, (slope > STEEP_BINS * bin_m) & (scatter < slope))
    if share > MAX_STEEP_SHARE:
        raise InputError(
            f"{100 * share:.0f} % of the returns' light lies on surfaces that are turned so far that a "
            f"pixel spans more than {STEEP_BINS:.0f} bins of range, which has no one range: choose "
            '`method="tv"`, or turn them towards the camera'
        )


def measure_slopes(distance: Image) -> tuple[FloatArray, FloatArray]:
    """Return how far ranges, (rows, columns), m or NaN, change from pixel to pixel, by a plane through
    each pixel's surroundings; 0 where less than half of these has a range. Also the root mean square
    distance of the ranges from the plane, m.
    """
    known = np.isfinite(distance)
    place = np.indices(distance.shape).astype(np.float64)
    # differences of large numbers follow: the middle of all is taken off first
    middle = float(np.median(distance[known])) if known.any() else 0.0

    def average(image: FloatArray) -> FloatArray:
        image = np.where(known, image, 0.0)
        return np.asarray(scipy.ndimage.uniform_filter(image, SLOPE_WINDOW_PX, mode="constant"))

    share = average(np.ones(distance.shape))
    whole = np.maximum(share, SLOPE_WINDOW_PX**-2)
    columns = (place[1], place[0], np.where(known, distance - middle, 0.0).astype(np.float64))
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


def _leave_out_doubtful(found: Returns, ray_length: FloatArray, bin_m: float) -> Returns:
    """Leave out returns that may be false, but not where most of a patch are so, as on a surface that
    is turned far: what is left out elsewhere the surface still reaches.
    """
    sure = ~(found.false_alarm > SURE_FALSE_ALARM)
    pixel = found.y.astype(np.intp) * ray_length.shape[1] + found.x
    kept = sure.copy()
    for patch in find_plain_patches(*_list_strongest(found), ray_length, bin_m):
        own = np.isin(pixel, patch.pixels)
        if sure[own].mean() < MIN_SURE_FRACTION:
            kept |= own
    return found[kept]


def find_brightest_patches(returns: Returns, ray_length: FloatArray, bin_m: float) -> list[Patch]:
    """Patches of each pixel's strongest return: weaker ones are often the frames' own, and would widen
    the surfaces.
    """
    plain = find_plain_patches(*_list_strongest(returns), ray_length, bin_m)
    return extend_patches(bend_patches(plain, bin_m), returns, bin_m)


def _list_strongest(returns: Returns) -> tuple[Pixels, FloatArray, FloatArray]:
    """Pixels, ranges and deviations of each pixel's strongest return, (n,) each."""
    strongest, deviation = (
        returns.image(name).astype(np.float64).ravel() for name in ("range", "confidence")
    )
    pixels = np.flatnonzero(np.isfinite(strongest))
    return pixels, strongest[pixels], deviation[pixels]


def _measure_light(found: Returns, where: NDArray[np.bool_]) -> float:
    """Fraction of the returns' light in some pixels, (rows, columns)."""
    light = found.intensity
    return float(light[where[found.y, found.x]].sum() / max(light.sum(), LEAST_COUNT))


def _refuse(fault: str) -> InputError:
    """The error of a shot that is not one of surfaces."""
    return InputError(
        f"{fault}: this shot's light is not on surfaces (smoke, light in flight, a relay wall); "
        'choose `method="tv"`'
    )


def lay_out(
    patches: list[Patch], shown: Returns, light: Image, bin_m: float, margin_px: int = MARGIN_PX
) -> tuple[NDArray[np.bool_], Image]:
    """Say where points are, (surfaces, rows, columns): where patches and the returns of their surfaces are,
    and about them; each patch is as bright as its pixels. `light`: of these.
    """
    masks = np.zeros((len(patches), *shown.camera.image_shape), bool)
    pictures = np.zeros(masks.shape, np.float32)
    for patch, mask, picture in zip(patches, masks, pictures, strict=True):
        picture.ravel()[patch.pixels] = light.ravel()[patch.pixels]
        reached = reach_further(patch, shown, bin_m)
        mask[...] = scipy.ndimage.binary_dilation(reached, np.ones((3, 3)), margin_px)
    return masks, pictures[masks]


def estimate_darkness(streak: Streak, frames: Frames) -> float:
    """Return how large noise is beside a shot's signal, both smoothed as what is left unexplained."""
    noise = MeasurementNoise.from_figures(frames.figures)
    if noise is None:
        return 0.0
    image = streak.counts - np.float32(estimate_dark_level(streak.counts))
    variance = float(np.sum(noise.compute_variance(np.maximum(image, 0))))
    signal = np.linalg.norm(smooth_evenly(image, SMOOTHING_PX))
    # what is left of the variance of neighbours' mean
    return float(np.sqrt(variance / (4 * np.pi)) / SMOOTHING_PX / max(signal, LEAST_COUNT))


def call_dark(darkness: float) -> InputError:
    """Return a refusal of a shot in whose noise no surface stands out."""
    return InputError(
        f"noise is {100 * darkness:.0f} % of this shot's signal: it is too dark for surfaces; "
        'choose `method="tv"`, or average shots'
    )


def require_pulse(pulse: ShotPulse, darkness: float) -> None:
    """Refuse a shot whose light follows no pulse."""
    # noise comes late as well; where it is more than surfaces may leave, the shot is too dark for them
    noise = darkness if darkness <= MAX_UNEXPLAINED else 0.0
    if pulse.tail_share > np.hypot(MAX_TAIL_SHARE, noise):
        late = 100 * pulse.tail_share
        raise _refuse(f"{late:.0f} % of each pixel's light comes long after its peak")


def require_explained(whole: AmplitudeSolver, limit: float, frames: Frames, streak: Streak) -> None:
    """Refuse a shot that surfaces, with returns beside them, explain neither to a limit nor nearly as
    well as its frames do.
    """
    unexplained = whole.model.unexplained(whole.amplitude)
    if unexplained <= limit:
        return
    camera = frames.camera
    seen = measure(streak.counts, streak.saturated, camera)
    predicted = np.zeros_like(seen.values)
    for shear in np.unique(frames.shears):
        own = np.flatnonzero(frames.shears == shear)
        pictures = np.ascontiguousarray(np.moveaxis(frames.values[own], 0, -1))
        predicted[:, own] = camera.operator(float(shear))(pictures)
    by_frames = compare_smoothed(predicted, seen.values, seen.valid)
    if unexplained > CHANGED_RATIO * by_frames:
        raise _refuse(
            f"surfaces leave {100 * unexplained:.0f} % of the signal unexplained, and frames "
            f"{100 * by_frames:.0f} %"
        )
