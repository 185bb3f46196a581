"""The method "surfaces", in the order of docs/recovery_algorithm.md: the surfaces of a shot are found,
or those of the shot before taken, fitted, and returned as points with the frames that they render.
What is no shot of surfaces (smoke, light in flight, relay walls) is refused on the way.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, measure
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import InputError
from tofclip.lidar import Detection, compute_ray_directions, depth
from tofclip.lidar.range_calibration import correct_returns
from tofclip.recovery.surfaces.amplitudes import LEAST_COUNT, AmplitudeSolver
from tofclip.recovery.surfaces.model import (
    SMOOTHING_PX,
    SurfaceModel,
    SurfaceState,
    compare_smoothed,
    find_rows,
    weigh_measurements,
)
from tofclip.recovery.surfaces.patches import (
    COEFFICIENTS,
    MARGIN_PX,
    Patch,
    Pixels,
    find_dimmer_patches,
    find_patches,
    rank_within_pixels,
    reach_further,
)
from tofclip.recovery.surfaces.pulse import EXTENT_SIGMAS, Image, ShotPulse, measure_pulse
from tofclip.recovery.surfaces.ranges import Refinement, measure_local_shifts, refine_state
from tofclip.shots import Frames, Returns, Streak
from tofclip.solvers import Method, Progress, Sparse, TotalVariation, ignore_progress
from tofclip.threads import limit_blas_threads
from tofclip.units import SPEED_OF_LIGHT

SURE_FALSE_ALARM = 0.04  # of a return that makes a surface
MIN_SURE_FRACTION = 0.8  # of a patch's returns
START_ITERATIONS = 25
MIN_REFINEMENTS, MAX_REFINEMENTS, REFINEMENT_ITERATIONS = 2, 4, 10
# Of the stated deviations, root mean square over all points: a step on ranges as short is the last.
LAST_STEP_SIGMAS = 0.3
# Where the last shot's fit begins: before and after the ranges' step, and how far beyond the returns
# of quick frames surfaces may reach.
FOLLOWING_ITERATIONS, FOLLOWING_MARGIN_PX = 10, 4
# Of what surfaces leave unexplained, and beyond: from there on they are not the next shot's.
CHANGED_RATIO, CHANGED_EXCESS = 1.25, 0.02

# Of the returns' light: below, the shot is not one of surfaces. Simulated shots of surfaces have 0.93
# or more, recorded ones 0.97; recorded relay walls have 0.50 to 0.79.
MIN_SURFACE_SHARE = 0.7
# Of the measurements, both smoothed so that photons' noise hardly counts: above, much of the light is
# not where the surfaces are. Surfaces leave 0.02 to 0.22, 0.3 where frames see things beside them, and
# recorded relay walls 0.2 to 0.5. Smoke's first light looks like one surface, but only the first.
MAX_UNEXPLAINED = 0.4
# Of a pulse's light, that long after its peak: more is not an instrument's afterglow (0.18), but light
# that comes from many depths to each pixel.
MAX_TAIL_SHARE = 0.3
# Bins of range that a pixel spans where a surface is seen nearly edge-on, and the share of the
# returns' light there: returns scatter by several bins about it, and a fit to them would be as far
# off. Plates that are turned by 1.3 rad have 0.01 of it, by 1.4 rad 0.43, other scenes up to 0.011.
STEEP_BINS, MAX_STEEP_SHARE = 10.0, 0.3
SLOPE_WINDOW_PX = 7

# Of the greatest need for splines of all surfaces: those that need them more have them.
CERTAINLY_BENT = 3.0

# Bins in range, and pixels, within which frames' returns and surfaces are the same.
NEAR_BINS, NEAR_PX = 7.0, 1.5
MIN_BRIGHTNESS_FRACTION = 0.1  # of the surface's usual brightness: fainter is not looked at
SURE_SIGMAS = 20.0  # points of which a surface certainly consists
UPPER_QUANTILE = 0.9
# Of what certainly is a surface, and beyond: points that are fainter are looked at no further.
LIT_SIGMAS, LIT_FRACTION, LIT_MARGIN_PX = 3.5, 0.05, 3


# Logarithm of the odds that a surface's point is false: nothing known, for each e-fold of its
# significance over 20, for each deviation by which the border beside it is needed, within limits, for
# each e-fold of 1 and its way to that border, px, and where the frames have a return. From scenes of
# known returns (tests/lidar/physics_scenes.py); docs tell what they miss.
FALSE_ODDS = np.array([1.79, -0.29, -0.28, -0.82, -3.24])
BORDER_LIMITS = -5.0, 10.0

# Of a surface's error at a place, what the light that is left there shows: neighbours' amplitudes take
# the rest. Medians over ten kinds of bent surfaces of known range are 0.13 to 0.75.
SHIFT_SHOWN = 1 / 3

# A surface that fills as little of the square over its length is a rod, whose roundness no pixel
# resolves; and by how much of a pixel's width, root mean square, its points are off for that: those
# of rods of 10 and 12 mm are off by 0.07 to 0.17.
ROD_FRACTION, ROD_PX = 0.1, 0.12

NO_SHARES = Detection(min_scene_fraction=0.0, min_time_bin_fraction=0.0, min_pixel_fraction=0.0)


@dataclass(frozen=True)
class SurfaceFit:
    """Surfaces as they were fitted to a shot."""

    model: SurfaceModel
    solver: AmplitudeSolver
    refinement: Refinement  # the last one
    remainder: FloatArray  # (surfaces,), what further steps would still change of ranges, m
    # what the surfaces left unexplained when they were found, as a fraction of the signal
    reference: float
    # of the frames, where the shot shows light that no surface explains; ranges as measured
    others: Returns
    whole: AmplitudeSolver  # with the light of these
    seen: Returns  # of the frames, all


@limit_blas_threads()  # products of a few dozen columns are too small to share
def fit_surfaces(
    streak: Streak,
    frames: Frames,
    weight: float,
    iterations: int,
    progress: Progress = ignore_progress,
) -> SurfaceFit:
    """Find and fit the surfaces of a shot. `frames`: A fast recovery of the same shot, with the
    camera to use; `weight, iterations`: see `SurfaceRecovery`; `progress`: called with the number
    of frame iterations just done.
    """
    # 1. Frames by a fast method, whose returns are a picture of ranges. The model explains what was
    # measured: corrections come when its own returns are listed.
    found = depth(frames, frames.camera.replace(range_calibration=None))
    try:
        return _fit_returns(found, streak, frames, weight, iterations, progress)
    except InputError as fault:
        dark = estimate_darkness(streak, frames)
        if dark <= MAX_UNEXPLAINED:
            raise
        raise InputError(
            f"noise is {100 * dark:.0f} % of this shot's signal: it is too dark for surfaces; "
            'choose `method="tv"`, or average shots'
        ) from fault


def estimate_darkness(streak: Streak, frames: Frames) -> float:
    """Return how large noise is beside a shot's signal, both smoothed as what is left unexplained."""
    noise = MeasurementNoise.from_figures(frames.figures)
    if noise is None:
        return 0.0
    image, _ = weigh_measurements(streak, frames.camera)
    variance = float(np.sum(noise.compute_variance(np.maximum(image, 0))))
    signal = np.linalg.norm(scipy.ndimage.gaussian_filter(image, SMOOTHING_PX))
    # what is left of the variance of neighbours' mean
    return float(np.sqrt(variance / (4 * np.pi)) / SMOOTHING_PX / max(signal, LEAST_COUNT))


def _fit_returns(
    found: Returns,
    streak: Streak,
    frames: Frames,
    weight: float,
    iterations: int,
    progress: Progress,
) -> SurfaceFit:
    """Fit the surfaces that returns show."""
    camera, count = frames.camera, frames.times.size
    bin_m = SPEED_OF_LIGHT * frames.bin_width / 2
    ray_length = measure_rays(camera)
    require_gentle_slopes(found, bin_m)

    # 2. Patches.
    shown = leave_out_doubtful(found, ray_length, bin_m)
    patches = _find_brightest_patches(shown, ray_length, bin_m)
    on_surface = np.zeros(camera.image_shape, bool)
    for patch in patches:
        on_surface.ravel()[patch.pixels] = True
    share = _measure_light(shown, on_surface)
    if share < MIN_SURFACE_SHARE:
        raise _refuse(f"only {100 * share:.0f} % of the returns' light lies on smooth surfaces")
    patches += find_dimmer_patches(patches, shown, ray_length, bin_m)
    seen = np.concatenate([patch.pixels for patch in patches])
    strongest = shown.image("range").astype(np.float64).ravel()
    pulse = measure_pulse(frames, seen, strongest[seen])
    if pulse.tail_share > MAX_TAIL_SHARE:
        late = f"{100 * pulse.tail_share:.0f} % of each pixel's light"
        raise _refuse(f"{late} comes long after its peak")

    # 3. A surface may reach beyond its returns: measurements decide where it ends.
    light = frames.values.sum(axis=0)
    state = SurfaceState.start([patch.coefficients for patch in patches], camera)
    solver = lay_out(patches, shown, light, streak, camera, state, pulse, weight)
    model = solver.model

    # 4. Amplitudes.
    solver.run(START_ITERATIONS, progress, count)
    limit = float(np.hypot(MAX_UNEXPLAINED, estimate_darkness(streak, frames)))
    if model.unexplained(solver.amplitude) > limit:
        # what is too small for a surface may be all that is bright
        _, whole = find_others(solver, found, bin_m, progress, count)
        require_explained(whole, limit, frames, streak)
    solver = keep_lit(solver)
    solver.model.find_behind(solver.amplitude)

    # 5. Ranges, after splines that are not needed: these take longer to be right, and late views give
    # way to them.
    solver, begun = straighten_surfaces(solver)
    refinement, remainder = _refine(solver, begun, progress, count)
    solver.run(iterations, progress, count)
    reference = solver.model.unexplained(solver.amplitude)
    others, whole = find_others(solver, found, bin_m, progress, count)
    return SurfaceFit(solver.model, solver, refinement, remainder, reference, others, whole, found)


def measure_rays(camera: Camera) -> FloatArray:
    """Return range over depth of each pixel, (rows, columns)."""
    directions = compute_ray_directions(camera, *np.indices(camera.image_shape).reshape(2, -1))
    return np.asarray(1 / directions[:, 2]).reshape(camera.image_shape)


def lay_out(
    patches: list[Patch],
    shown: Returns,
    light: Image,
    streak: Streak,
    camera: Camera,
    state: SurfaceState,
    pulse: ShotPulse,
    weight: float,
    margin_px: int = MARGIN_PX,
) -> AmplitudeSolver:
    """Have points where patches and the returns of their surfaces are, and about them, each patch as
    bright as its pixels; `light`: of these, (rows, columns).
    """
    bin_m = SPEED_OF_LIGHT * float(np.mean(np.diff(streak.times))) / 2
    masks = np.zeros((len(patches), *camera.image_shape), bool)
    pictures = np.zeros(masks.shape, np.float32)
    for patch, mask, picture in zip(patches, masks, pictures, strict=True):
        picture.ravel()[patch.pixels] = light.ravel()[patch.pixels]
        reached = reach_further(patch, shown, bin_m)
        mask[...] = scipy.ndimage.binary_dilation(reached, np.ones((3, 3)), margin_px)
    model = SurfaceModel(streak, camera, masks, [patch.basis for patch in patches], state, pulse)
    return AmplitudeSolver(model, pictures[masks], weight)


def _find_brightest_patches(returns: Returns, ray_length: FloatArray, bin_m: float) -> list[Patch]:
    """Patches of each pixel's strongest return: weaker ones are often the frames' own, and would widen
    the surfaces.
    """
    strongest, deviation = (
        returns.image(name).astype(np.float64).ravel() for name in ("range", "confidence")
    )
    pixels = np.flatnonzero(np.isfinite(strongest))
    return find_patches(pixels, strongest[pixels], deviation[pixels], ray_length, bin_m)


def leave_out_doubtful(found: Returns, ray_length: FloatArray, bin_m: float) -> Returns:
    """Leave out returns that may be false, but not where most of a patch are so, as on a surface that
    is turned far: what is left out elsewhere the surface still reaches.
    """
    sure = ~(found.false_alarm > SURE_FALSE_ALARM)
    pixel = found.y.astype(np.intp) * ray_length.shape[1] + found.x
    kept = sure.copy()
    for patch in _find_brightest_patches(found, ray_length, bin_m):
        own = np.isin(pixel, patch.pixels)
        if sure[own].mean() < MIN_SURE_FRACTION:
            kept |= own
    return found[kept]


def find_others(
    solver: AmplitudeSolver, found: Returns, bin_m: float, progress: Progress, count: int
) -> tuple[Returns, AmplitudeSolver]:
    """Return those of the frames' returns that no surface is near and that the whole shot shows, with
    surfaces and all other returns free to take over their light; and the light of all.
    """
    model = solver.model
    chosen = find_candidates(solver, Detection.signal_to_noise)[0]
    y, x = np.divmod(model.pixel[chosen], model.camera.image_shape[1])
    near = find_near((found.y, found.x, found.range), (y, x, model.distance[chosen]), bin_m)
    others = found[~near]
    if not len(others):
        return others, solver
    least = max(LIT_SIGMAS, find_sure_level(solver.measure_significance()) / 2)
    together, own = add_returns(solver, others, progress, count)
    weights = together.model.weights / together.estimate_local_variance()
    information = together.model.gather(weights, squared=True)[own]
    others = others[together.amplitude[own] * np.sqrt(information) > least]
    # light of those that are left out goes to the others
    return others, add_returns(solver, others, progress, count)[0]


Places = tuple[NDArray[Any], NDArray[Any], FloatArray]


def find_near(places: Places, others: Places, bin_m: float) -> NDArray[np.bool_]:
    """Say which places, rows, columns and ranges, have one of some others near. One in a neighbouring
    pixel may be a bin further off for each that it is aside.
    """
    reach = NEAR_BINS * bin_m
    those, these = (
        np.stack([reach / NEAR_PX * y, reach / NEAR_PX * x, distance], axis=1)
        for y, x, distance in (others, places)
    )
    away, _ = scipy.spatial.cKDTree(those).query(these, p=np.inf, distance_upper_bound=reach)
    return np.asarray(np.isfinite(away))


def add_returns(
    solver: AmplitudeSolver, others: Returns, progress: Progress, count: int
) -> tuple[AmplitudeSolver, Pixels]:
    """Solve for the light of surfaces and of returns beside them; also return the returns' points."""
    shape = solver.model.camera.image_shape
    pixel = others.y.astype(np.intp) * shape[1] + others.x
    order, rank = rank_within_pixels(pixel, others.range)
    layer = np.empty_like(rank)
    layer[order] = rank
    masks = np.zeros((int(rank.max(initial=-1)) + 1, *shape), bool)
    inverse = np.ones(masks.shape)
    masks[layer, others.y, others.x] = True
    depths = compute_ray_directions(solver.model.camera, others.y, others.x)[:, 2] * others.range
    inverse[layer, others.y, others.x] = 1 / depths
    whole = solver.model.add(masks, inverse)
    begin = np.concatenate([solver.amplitude, np.zeros(pixel.size, np.float32)])
    together = AmplitudeSolver(whole, begin, solver.weight)
    together.run(START_ITERATIONS, progress, count)
    point = np.empty_like(pixel)
    point[np.lexsort((pixel, layer))] = solver.model.surface.size + np.arange(pixel.size)
    return together, point


def _measure_light(found: Returns, where: NDArray[np.bool_]) -> float:
    """Fraction of the returns' light in some pixels, (rows, columns)."""
    light = float(found.intensity.sum())
    return float(found.intensity[where[found.y, found.x]].sum()) / light if light else 0.0


def _refuse(fault: str) -> InputError:
    """The error of a shot that is not one of surfaces."""
    return InputError(
        f"{fault}: this shot's light is not on surfaces (smoke, light in flight, a relay wall); "
        'choose `method="tv"`'
    )


def require_gentle_slopes(found: Returns, bin_m: float) -> None:
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


def straighten_surfaces(
    solver: AmplitudeSolver,
) -> tuple[AmplitudeSolver, Refinement | None]:
    """Replace splines by quadratics where these explain the shot as well, after a step; return what
    that step knew as well, if there was one. Splines follow the returns of frames, also where these
    are displaced, as behind gauze; the shot itself says whether the surface is bent.
    """
    model = solver.model
    bent = [
        surface
        for surface, basis in enumerate(model.bases)
        if not basis.is_quadratic and (solver.amplitude[model.parts[surface]] > 0).any()
    ]
    if not bent:
        return solver, None
    ahead = copy.copy(model)
    before, straight = refine_state(ahead, solver.amplitude), bent
    # whose light it is says to which surface a change of the misfit belongs
    light = np.maximum(model.render(solver.amplitude), np.float32(LEAST_COUNT))
    while straight:
        trial = model.straighten(straight, solver.amplitude)
        after = refine_state(trial, solver.amplitude)
        change = ((after.rest**2 - before.rest**2) / light).astype(np.float32)
        excess = solver.amplitude * model.gather(model.weights * change)
        needed = []
        for surface in straight:
            basis, coefficients = ahead.bases[surface], ahead.state.coefficients[surface]
            freedom = 2 * solver.variance * (coefficients.size - COEFFICIENTS)
            bending = coefficients @ basis.bending @ coefficients
            needed.append(excess[model.parts[surface]].sum() / (freedom + bending))
        if max(needed) <= 1:
            return AmplitudeSolver(trial, after.amplitude, solver.weight, solver), after
        # one that is bent for certain takes light from others: these are tried again without it
        least = max(1.0, max(needed) / CERTAINLY_BENT)
        straight = [one for one, need in zip(straight, needed, strict=True) if need <= least]
    return solver, replace(before, free=None)


def find_sure_level(significance: Image) -> float:
    """Standard deviations from which on a point is certain in a shot."""
    lit = significance[significance > LIT_SIGMAS]
    # In little light no point is that far out of the noise, but some are further than others.
    upper = float(np.quantile(lit, UPPER_QUANTILE)) if lit.size else np.inf
    return min(SURE_SIGMAS, max(LIT_SIGMAS, upper / 2))


def keep_lit(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Leave out the points of surfaces that are dark and far from any that is not, beside what is usual
    on their own surface: others may be far brighter.
    """
    model, significance = solver.model, solver.measure_significance()
    kept = np.zeros_like(model.masks)
    near = np.ones((2 * LIT_MARGIN_PX + 1,) * 2)
    for surface, (part, mask) in enumerate(zip(model.parts, model.masks, strict=True)):
        amplitude, own = solver.amplitude[part], significance[part]
        least = LIT_FRACTION * find_usual_brightness(amplitude, own, LIT_SIGMAS)
        kept[surface][mask] = (own > LIT_SIGMAS) & (amplitude > least)
        kept[surface] = mask & scipy.ndimage.binary_dilation(kept[surface], near)
    return solver.cover(kept) if kept.any() else solver


def _refine(
    solver: AmplitudeSolver, found: Refinement | None, progress: Progress, count: int
) -> tuple[Refinement, FloatArray]:
    """Steps on ranges and instrument until they hardly move; the last one, and what more would
    change of each surface.
    """
    model, lengths = solver.model, []
    for number in range(MAX_REFINEMENTS):
        before = model.distance
        model.find_behind(solver.amplitude)
        found = refine_state(model, solver.amplitude, found, number + 1 >= MIN_REFINEMENTS)
        solver.amplitude = found.amplitude
        solver.run(REFINEMENT_ITERATIONS, progress, count)
        moved = model.distance - before
        # where a surface is dark, it may go anywhere
        light = solver.amplitude + np.finfo(np.float32).tiny
        lengths.append([np.sqrt(np.average(moved[p] ** 2, weights=light[p])) for p in model.parts])
        sigmas = moved / model.estimate_deviation(found.covariances)
        if number + 1 >= MIN_REFINEMENTS and np.sqrt(np.mean(sigmas**2)) < LAST_STEP_SIGMAS:
            break
    assert found is not None
    return found, extrapolate_steps(np.array(lengths))


def extrapolate_steps(lengths: FloatArray) -> FloatArray:
    """Return how far steps, (steps, n), two or more, that shrink as the last two did would still go:
    the sum of a geometric series; steps that do not shrink count as if they halved.
    """
    tiny = np.finfo(np.float64).tiny
    ratio = np.minimum(lengths[-1] / np.maximum(lengths[-2], tiny), 0.5)
    return np.asarray(lengths[-1] * ratio / (1 - ratio))


@limit_blas_threads()
def follow_surfaces(
    fit: SurfaceFit,
    streak: Streak,
    weight: float,
    look: Callable[[], tuple[Returns, Image]],
) -> SurfaceFit | None:
    """Fit the surfaces of the shot before to the next one of the same camera; where they no longer
    explain what they did, those that quick frames show, with the instrument as it was; None where
    these do not explain the shot either: surfaces have to be found with more care.

    `look`: makes such frames; their returns, and the light of each pixel, (rows, columns).
    """
    model, begun = fit.model.see(streak), replace(fit.refinement, free=None)
    solver = AmplitudeSolver(model, fit.solver.amplitude, weight, fit.solver)
    seen, remainder, limit = fit.seen, fit.remainder, CHANGED_RATIO * fit.reference + CHANGED_EXCESS
    changed = model.unexplained(solver.amplitude) > limit
    if changed:
        seen, light = look()
        camera, bin_m = model.camera, SPEED_OF_LIGHT * model.bin_width / 2
        ray_length = measure_rays(camera)
        shown = seen[~(seen.false_alarm > SURE_FALSE_ALARM)]
        patches = _find_brightest_patches(shown, ray_length, bin_m)
        patches += find_dimmer_patches(patches, shown, ray_length, bin_m)
        if not patches:
            return None
        shapes = [patch.coefficients for patch in patches]
        even = np.zeros((len(patches), camera.views))
        state = replace(model.state, coefficients=shapes, shading=even)
        solver = lay_out(
            patches, shown, light, streak, camera, state, model.pulse, weight, FOLLOWING_MARGIN_PX
        )
        model, limit = solver.model, MAX_UNEXPLAINED
        remainder = np.zeros(len(patches))
        begun = replace(begun, explained=np.zeros((COEFFICIENTS, model.surface.size), np.float32))
    solver.run(FOLLOWING_ITERATIONS, ignore_progress, 0)
    # what explains the last shot best without the prior has that shot's noise
    refinement = refine_state(model, solver.amplitude, begun, True)
    solver.amplitude = refinement.amplitude
    solver.run(FOLLOWING_ITERATIONS, ignore_progress, 0)
    unexplained = model.unexplained(solver.amplitude)
    if unexplained > limit:
        return None
    none = fit.others[np.zeros(0, np.intp)]
    reference = unexplained if changed else fit.reference
    return SurfaceFit(model, solver, refinement, remainder, reference, none, solver, seen)


def find_candidates(solver: AmplitudeSolver, limit: float) -> tuple[NDArray[np.bool_], Image]:
    """Say which points stand out of the noise and are not far fainter than their surface; and by how
    many standard deviations all do.
    """
    model, amplitude = solver.model, solver.amplitude
    significance = solver.measure_significance()
    usual = [find_usual_brightness(amplitude[p], significance[p], limit) for p in model.parts]
    faint = amplitude <= MIN_BRIGHTNESS_FRACTION * np.array(usual)[model.surface]
    return (significance > limit) & ~faint, significance


def judge_points(fit: SurfaceFit, limit: float) -> tuple[Pixels, FloatArray]:
    """Numbers of the candidates among the points, and how probable it is that each is false."""
    model, seen = fit.solver.model, fit.seen
    shown, significance = find_candidates(fit.solver, limit)
    need, inside = fit.solver.weigh_borders(shown)
    y, x = np.divmod(model.pixel[shown], model.camera.image_shape[1])
    bin_m = SPEED_OF_LIGHT * model.bin_width / 2
    known = [
        np.log(significance[shown] / SURE_SIGMAS),
        np.clip(need[shown], *BORDER_LIMITS),
        np.log1p(inside[shown]),
        find_near((y, x, model.distance[shown]), (seen.y, seen.x, seen.range), bin_m),
    ]
    return np.flatnonzero(shown), scipy.special.expit(
        FALSE_ODDS[0] + FALSE_ODDS[1:] @ np.array(known)
    )


@limit_blas_threads()
def list_returns(fit: SurfaceFit, detection: Detection, centre_error_px: float = 0.0) -> Returns:
    """List the points of surfaces that stand out of the noise, and beside them the frames' returns where
    no surface is, pixel by pixel.

    `centre_error_px`: how far off the calibration had each slit centre, see `tofclip.recovery.Shot`.
    """
    model, amplitude = fit.model, fit.solver.amplitude
    centres = model.camera.centres_px + model.state.centres
    camera = model.camera.replace(gains=model.state.gains, centres_px=centres)
    distance, others = model.distance, fit.others
    # 6. Points.
    bright, doubt = judge_points(fit, detection.signal_to_noise)
    # brightness is told as the reference view sees it
    intensity = model.shade(model.reference, amplitude) * distance**2
    time = 2 * distance / SPEED_OF_LIGHT
    strong = detection.find_significant(
        model.pixel[bright], time[bright], intensity[bright], camera.pulse_fwhm
    )
    chosen = bright[strong]

    fitted = model.estimate_deviation(fit.refinement.covariances)
    moved = estimate_displacement(camera, centre_error_px)[:, np.newaxis] * model.compute_slopes()
    rest = model.image - fit.whole.model.render(fit.whole.amplitude)
    bent = measure_local_shifts(model, amplitude, rest) / SHIFT_SHOWN
    y, x = np.divmod(model.pixel[chosen], camera.image_shape[1])
    rounded = np.zeros(distance.size)
    for surface in np.unique(model.surface[chosen]):
        own = model.surface[chosen] == surface
        if own.sum() < ROD_FRACTION * (np.ptp(y[own]) ** 2 + np.ptp(x[own]) ** 2):
            rounded[chosen[own]] = ROD_PX * distance[chosen[own]] / camera.focal_length_px
    swept = model.estimate_sweep_error()
    parts = np.stack([fitted, fit.remainder[model.surface], *moved, bent, rounded])
    deviation = np.sqrt(np.sum(parts**2, axis=0) + swept**2)
    measured: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {
        "y": (y, others.y),
        "x": (x, others.x),
        "range": (distance[chosen], others.range),
        "intensity": (intensity[chosen], others.intensity),
        "confidence": (deviation[chosen], others.confidence),
        "time": (time[chosen], others.time),
        "false_alarm": (doubt[strong], others.false_alarm),
    }
    columns: dict[str, NDArray[Any]] = {
        name: np.concatenate(parts) for name, parts in measured.items()
    }
    pixel = columns["y"] * camera.image_shape[1] + columns["x"]
    order, rank = rank_within_pixels(pixel.astype(np.intp), columns["range"])
    columns = {name: column[order] for name, column in columns.items()}
    return correct_returns(
        Returns(
            y=columns["y"].astype(np.int32),
            x=columns["x"].astype(np.int32),
            range=columns["range"],
            intensity=columns["intensity"].astype(np.float32),
            confidence=columns["confidence"].astype(np.float32),
            return_number=(rank + 1).astype(np.uint8),
            time=columns["time"],
            camera=camera,
            shear=np.asarray(camera.shear_at(columns["range"])),
            false_alarm=columns["false_alarm"],
        )
    )


def estimate_displacement(camera: Camera, centre_error_px: float) -> FloatArray:
    """Return how far errors of the slit centres displace the picture to the right and down, px.

    Of errors e_v a shot shows all but what looks like a displaced picture, ``e_v = dx - dy
    tan(angle_v)``. That part is taken to be that of errors which alternate, as of neighbouring
    lenslets measured in turns; independent ones would leave sqrt(views) as much.
    """
    in_turns = (-1.0) ** np.arange(camera.views)
    looks = np.stack([np.ones(camera.views), -np.tan(camera.angles)], axis=1)
    return np.asarray(np.abs(np.linalg.pinv(looks) @ in_turns) * centre_error_px)


def find_usual_brightness(amplitude: Image, significance: Image, limit: float) -> float:
    """Return the usual amplitude of the points of which a surface certainly consists; infinite if
    none is that many standard deviations out of the noise.
    """
    if amplitude.size == 0:
        return float("inf")
    # In little light no point is that far out of the noise, but some are further than others.
    upper = float(np.quantile(significance, UPPER_QUANTILE))
    sure = amplitude[significance > min(SURE_SIGMAS, max(limit, upper / 2))]
    return float(np.median(sure)) if sure.size else float("inf")


@dataclass(frozen=True)
class SurfaceRecovery:
    """Surfaces from a whole shot, and frames as their rendering.

    Parameters
    ----------
    weight : float
        Of total variation of the amplitudes, in standard deviations of what photon noise makes of
        the misfit's gradient. It needs no knowledge of the scene or of the light's amount.
    iterations : int
        Of FISTA after the ranges are known; before that there are 45 to 65 more.
    start : Method
        Recovers the frames in whose returns the surfaces are looked for.
    detection : Detection
        Which points of the surfaces are returned.
    otherwise : Method, optional
        Recovers the frames of a shot that is not of surfaces; without one it is refused.

    Notes
    -----
    Right for shots of surfaces: smoke, light in flight and relay walls stay with frames. Views are
    taken to see the same surfaces: what one hides from a view but not from another is not modelled.
    """

    weight: float = 2.0
    iterations: int = 60
    start: Method = field(default_factory=lambda: Sparse(iterations=40))
    detection: Detection = field(default_factory=lambda: NO_SHARES)
    otherwise: Method | None = None
    name = "surfaces"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weight) and self.weight > 0 and self.iterations >= 1):
            raise InputError("surfaces need a positive weight and at least one iteration")

    @property
    def steps(self) -> int:
        """Iterations of FISTA at most."""
        return 2 * START_ITERATIONS + MAX_REFINEMENTS * REFINEMENT_ITERATIONS + self.iterations

    def work(self, frames: int) -> int:
        """Frame iterations that are reported at most: the start's, one per frame and iteration, and
        those of the frames in place of surfaces.
        """
        instead = 0 if self.otherwise is None else self.otherwise.work(frames)
        return self.start.work(frames) + self.steps * frames + instead

    def recover_surfaces(
        self,
        streak: Streak,
        frames: Frames,
        progress: Progress = ignore_progress,
        centre_error_px: float = 0.0,
    ) -> Frames:
        """Recover the surfaces of a shot.

        Parameters
        ----------
        streak : Streak
        frames : Frames
            A fast recovery of the same shot, with the camera to use.
        progress : callable
            Called with the number of frame iterations just done.
        centre_error_px : float
            How far off the calibration had each slit centre, as for `tofclip.recovery.Shot`.

        Returns
        -------
        Frames
            With ``.returns``.

        Raises
        ------
        InputError
            Most of the light does not come from surfaces.
        """
        fit = fit_surfaces(streak, frames, self.weight, self.iterations, progress)
        returns = list_returns(fit, self.detection, centre_error_px)
        return self._make_frames(frames, fit, returns)

    def _make_frames(self, start: Frames, fit: SurfaceFit, returns: Returns) -> Frames:
        model, amplitude, camera = fit.whole.model, fit.whole.amplitude, returns.camera
        # Rectified like every other method's: its residual is of measurements, not of raw pixels.
        rendered = model.render(amplitude)
        predicted, measured = (
            measure(image, model.weights == 0, model.camera, 0.0)
            for image in (rendered, model.image)
        )
        error = (predicted.values - measured.values)[measured.valid]
        residual = float(np.linalg.norm(error) / np.linalg.norm(measured.values[measured.valid]))
        distance = np.maximum(SPEED_OF_LIGHT * start.times / 2, start.bin_width * SPEED_OF_LIGHT)
        figures: dict[str, Any] = {
            "method": self.name,
            "focus": "depth-locked",
            "iterations": START_ITERATIONS
            + fit.refinement.steps * REFINEMENT_ITERATIONS
            + self.iterations,
            "stopped_because": "iterations done",
            "relative_residual": residual,
            "surfaces": len(fit.model.masks),
        }
        return replace(
            start,
            values=_render_frames(start, model, model.shade(model.reference, amplitude)),
            camera=camera,
            figures={**start.figures, **figures},
            shears=np.asarray(camera.shear_at(distance)),
            returns=returns,
        )


def recover_automatically() -> SurfaceRecovery:
    """Surfaces where a shot is of surfaces, otherwise frames by total variation."""
    return SurfaceRecovery(otherwise=TotalVariation())


def _render_frames(start: Frames, model: SurfaceModel, amplitude: Image) -> Image:
    """The surfaces as a reference view without blur would see them over time."""
    from scipy.special import ndtr

    lit = np.flatnonzero(amplitude)
    row = find_rows(start.times, 2 * model.distance[lit] / SPEED_OF_LIGHT)
    sigma = model.pulse.sigma
    half = int(np.ceil(EXTENT_SIGMAS * sigma + 0.5))
    rows = np.round(row).astype(np.intp)[:, np.newaxis] + np.arange(-half, half + 2)
    upto = ndtr((rows - 0.5 - row[:, np.newaxis]) / sigma)
    light = amplitude[lit][:, np.newaxis] * np.diff(upto, axis=1)
    rows = rows[:, :-1]
    values = np.zeros(start.values.shape, np.float32)
    inside = (rows >= 0) & (rows < len(values))
    pixel = np.broadcast_to(model.pixel[lit][:, np.newaxis], rows.shape)
    np.add.at(values.reshape(len(values), -1), (rows[inside], pixel[inside]), light[inside])
    if model.pulse.reach:
        tail = model.pulse.extend(np.ones(1, np.float32))
        values = scipy.ndimage.convolve1d(values, tail, axis=0, mode="constant")
    return values
