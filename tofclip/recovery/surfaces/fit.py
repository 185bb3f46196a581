"""The fit of surfaces to a shot, in the order of docs/recovery_algorithm.md: those of quick frames, or
of the shot before, are taken, their amplitudes and ranges fitted, and the frames' returns beside them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.errors import InputError
from tofclip.lidar import Detection, depth
from tofclip.lidar.significance import DEFAULT_FALSE_ALARM
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver, Tick, share_misfit
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.patches import (
    MARGIN_PX,
    MIN_BEHIND_FRACTION,
    MIN_ROUND_PX,
    find_dimmer_patches,
    rank_within_pixels,
)
from tofclip.recovery.surfaces.points import Shape
from tofclip.recovery.surfaces.pulse import (
    LEAST_EXPLAINED,
    LEAST_TAIL,
    TINY,
    Image,
    measure_pulse,
)
from tofclip.recovery.surfaces.ranges import Refinement, refine_state
from tofclip.recovery.surfaces.shapes import Pixels, QuadricBasis
from tofclip.recovery.surfaces.start import (
    CHANGED_RATIO,
    DIM,
    MAX_UNEXPLAINED,
    SURE_FALSE_ALARM,
    call_dark,
    estimate_darkness,
    find_brightest_patches,
    find_surfaces,
    lay_out,
    measure_rays,
    require_explained,
    require_pulse,
)
from tofclip.shots import Frames, Returns, Streak
from tofclip.solvers import Progress, ignore_progress
from tofclip.threads import limit_blas_threads

START_ITERATIONS, PULSE_ITERATIONS = 25, 10  # of these, before the pulse is measured
MIN_REFINEMENTS, MAX_REFINEMENTS, REFINEMENT_ITERATIONS = 2, 6, 10
AGAINST_DIM = 3.0  # until ranges are known; then amplitudes are as the shot has them
# What dim light costs, in deviations, and for how many iterations at most, where it is to stay only as
# the shot needs it: first it gives way, then what is needed comes back. Fewer after the first shot.
SPARSELY, FOLLOWING_SPARSELY = ((4.0, 80), (2.0, 20)), ((4.0, 50), (2.0, 10))
# Of the stated deviations, root mean square over all points: a step on ranges as short is the last.
LAST_STEP_SIGMAS = 0.15
# After a longer one of its own a surface goes on alone, for as many steps; more after the last one.
LONG_STEP_SIGMAS, SETTLING_STEPS, LAST_SETTLING_STEPS = 0.7, 3, 8
# Where the last shot's fit begins: before and after the ranges' step, and how far beyond the returns
# of quick frames surfaces may reach.
FOLLOWING_ITERATIONS, FOLLOWING_MARGIN_PX = 10, 4
CHANGED_EXCESS = 0.02  # beyond `CHANGED_RATIO` of what surfaces left unexplained

# Of the greatest need to be bent of all surfaces, or of a need that leaves no doubt: those that need it
# more are bent.
CERTAINLY_BENT, NO_DOUBT = 3.0, 100.0

# Of a surface's usual brightness: the shape of what is dimmer says nothing of it.
ROUND_FRACTION = 0.3

DOUBLE_FRACTION = 0.2  # of a surface's lit points: that many beside another's may be the other's

# Bins in range, and pixels, within which frames' returns and surfaces are the same.
NEAR_BINS, NEAR_PX = 7.0, 1.5
MIN_BRIGHTNESS_FRACTION = 0.1  # of the surface's usual brightness: fainter is not looked at
SURE_SIGMAS = 20.0  # points of which a surface certainly consists
UPPER_QUANTILE = 0.9
# Of what certainly is a surface, and beyond: points that are fainter are looked at no further.
LIT_SIGMAS, LIT_FRACTION, LIT_MARGIN_PX = 3.5, 0.05, 3
# A surface that is that certainly lit at so many pixels this near the border of where it may be goes on beyond
# it, if the shot is explained the better by that much, in the noise's variance for each of its new lit
# points (7 and more of tables and a plate in 200 photons that do; in 50, up to 2.7 of what does not).
SURELY_LIT_SIGMAS, BORDER_PX, MIN_BORDER_PX, LEAST_GAIN = 5.0, 2, 10, 4.0

# Logarithm of the odds that a return of the frames beside the surfaces is false: nothing known, for each
# deviation out of the noise that the whole shot shows, where there are few, and for each e-fold of the
# odds that the frames alone give it. From scenes of known returns, of those that the shot shows at all.
OTHER_ODDS, ENOUGH_SIGMAS, LEAST_DOUBT = np.array([4.64, -0.77, 1.06]), 15.0, 1e-4
# About such a return its range may have light as well: what is too dim to be a surface is seen at a few
# of its pixels, which would have the light of all.
ABOUT_OTHERS_PX = 1

# Standard deviations of a blur along the slit, px, that are tried until one explains the shot less well than
# the one before, each for as many iterations, and what has to be left of the misfit without it (0.3 of a shot
# of 2000 photons; 0.997 of one that is not blurred, of leaves).
BLURS_PX, BLUR_ITERATIONS, LEAST_BLURRED = (0.0, 0.7, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0), 10, 0.98

Places = tuple[NDArray[Any], NDArray[Any], FloatArray]


@dataclass(frozen=True)
class SurfaceFit:
    """Surfaces as they were fitted to a shot."""

    solver: AmplitudeSolver
    sparse: AmplitudeSolver  # the same with dim light beside bright only where the shot needs it
    refinement: Refinement  # the last one
    remainder: FloatArray  # (surfaces,), what further steps would still change of ranges, m
    # what the surfaces left unexplained when they were found, as a fraction of the signal
    reference: float
    # of the frames, where the shot shows light that no surface explains; ranges as measured
    others: Returns
    whole: AmplitudeSolver  # with what is expected of their light
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
        tick = partial(progress, frames.times.size)
        return _fit_returns(found, streak, frames, weight, iterations, tick)
    except InputError as fault:
        dark = estimate_darkness(streak, frames)
        if dark <= MAX_UNEXPLAINED:
            raise
        raise call_dark(dark) from fault


def _fit_returns(
    found: Returns,
    streak: Streak,
    frames: Frames,
    weight: float,
    iterations: int,
    tick: Tick,
) -> SurfaceFit:
    """Fit the surfaces that returns show."""
    darkness = estimate_darkness(streak, frames)
    solver = find_surfaces(found, streak, frames, weight, darkness)

    # 4. Amplitudes, and the pulse as they show it.
    solver.run(PULSE_ITERATIONS, tick, AGAINST_DIM)
    solver = _measure_pulse(solver)
    solver.run(START_ITERATIONS - PULSE_ITERATIONS, tick, AGAINST_DIM)
    limit = np.hypot(MAX_UNEXPLAINED, darkness)
    if solver.model.unexplained(solver.amplitude) > limit:
        # what is too small for a surface may be all that is bright
        _, whole = _find_others(solver, found, tick)
        require_explained(whole, limit, frames, streak)
    if darkness > DIM:
        # frames show so little of some that others take their light
        solver = _grow_surfaces(solver)
    solver = _measure_blur(join_surfaces(_keep_lit(solver)))
    solver.model.find_behind(solver.amplitude)

    # 5. Ranges, after splines that are not needed: these take longer to be right, and late views give
    # way to them.
    solver, begun = straighten_surfaces(solver)
    refinement, remainder = _refine(solver, begun, tick)
    grown = _grow_surfaces(solver)
    if grown is not solver:
        solver = _keep_lit(grown)
        refinement, remainder = _refine(solver, refinement.cover(solver.model))
    if solver.model.pulse.reach:
        # what seemed a tail may have been ranges that were off
        plain = _measure_pulse(solver, np.inf)
        further, _ = _refine(plain, refinement, most=MIN_REFINEMENTS)
        if _measure_misfit(plain) < _measure_misfit(solver):
            solver, (refinement, remainder) = plain, _refine(plain, further)
    # dim light has given way a little by now
    sparse = _explain_sparsely(solver.model, solver, weight, SPARSELY)
    solver.run(iterations, tick)
    reference = solver.model.unexplained(solver.amplitude)
    beside = _find_others(solver, found, tick)
    return SurfaceFit(solver, sparse, refinement, remainder, reference, *beside, found)


def _measure_pulse(solver: AmplitudeSolver, least_tail: float = LEAST_TAIL) -> AmplitudeSolver:
    """Give surfaces the pulse that the shot shows, without a tail of less than a part of the light."""
    model, light = solver.model, solver.model.render_instants(solver.amplitude)
    width = model.camera.pulse_fwhm / model.bin_width
    least_tail = max(least_tail, LEAST_EXPLAINED * model.unexplained(solver.amplitude))
    pulse = measure_pulse(light, model.image, model.weights, width, least_tail)
    require_pulse(pulse)
    if (pulse.sigma, pulse.reach) == (model.pulse.sigma, model.pulse.reach):
        return solver
    return AmplitudeSolver(model.respond(pulse), solver.amplitude, solver.weight, solver)


def _measure_blur(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Give surfaces the blur along the slit, as of a streak tube, with which they explain the shot best."""

    def blur(sigma_px: float) -> AmplitudeSolver:
        blurred = solver.model.blur(sigma_px)
        trial = AmplitudeSolver(blurred, solver.amplitude, solver.weight, solver)
        trial.run(BLUR_ITERATIONS, against_dim=AGAINST_DIM)
        return trial

    misfits: list[float] = []
    for sigma_px in BLURS_PX:
        misfits.append(_measure_misfit(blur(sigma_px)))
        if misfits[-1] > min(misfits):
            break
    best = int(np.argmin(misfits))
    if misfits[best] > LEAST_BLURRED * misfits[0]:
        return solver
    about = slice(best - 1, best + 2)
    tried = np.array(BLURS_PX[about]), np.array(misfits[about])
    curve = np.polynomial.Polynomial.fit(*tried, 2)
    lowest = curve.deriv().roots()[0] if best + 1 < len(misfits) else BLURS_PX[best]
    return blur(float(lowest))


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
    model, begun = fit.solver.model.see(streak), replace(fit.refinement, free=None)
    solver = AmplitudeSolver(model, fit.solver.amplitude, weight, fit.solver)
    seen, remainder, limit = fit.seen, fit.remainder, CHANGED_RATIO * fit.reference + CHANGED_EXCESS
    changed = model.unexplained(solver.amplitude) > limit
    if changed:
        seen, light = look()
        camera, ray_length = model.camera, measure_rays(model.camera)
        shown = seen[~(seen.false_alarm > SURE_FALSE_ALARM)]
        patches = find_brightest_patches(shown, ray_length, model.row_m)
        patches += find_dimmer_patches(patches, shown, ray_length, model.row_m)
        if not patches:
            return None
        masks, amplitude = lay_out(patches, shown, light, model.row_m, FOLLOWING_MARGIN_PX)
        even = np.zeros((len(patches), camera.views))
        shapes = [patch.coefficients for patch in patches]
        state = replace(model.state, coefficients=shapes, shading=even)
        model, limit = model.lay_out(masks, [p.basis for p in patches], state), MAX_UNEXPLAINED
        solver = AmplitudeSolver(model, amplitude, weight)
        remainder = np.zeros(len(patches))
        begun = begun.cover(model)
    solver.run(FOLLOWING_ITERATIONS)
    # what explains the last shot best without the prior has that shot's noise
    refinement = refine_state(model, solver.amplitude, begun, True)
    solver.amplitude = refinement.amplitude
    before = solver if changed else fit.sparse
    sparse = _explain_sparsely(model, before, weight, FOLLOWING_SPARSELY)
    solver.run(FOLLOWING_ITERATIONS)
    unexplained = model.unexplained(solver.amplitude)
    if unexplained > limit:
        return None
    reference = unexplained if changed else fit.reference
    none = seen[np.zeros(0, np.intp)]
    return SurfaceFit(solver, sparse, refinement, remainder, reference, none, solver, seen)


def _explain_sparsely(
    model: SurfaceModel,
    begun: AmplitudeSolver,
    weight: float,
    schedule: Sequence[tuple[float, int]],
) -> AmplitudeSolver:
    """Explain a shot with dim light beside bright only where it needs it, from amplitudes of the same
    surfaces; `schedule`: what such light costs, and for how many iterations at most.

    A line that is half as wide is twice as bright, and total variation would keep it wide: it counts
    the less, the further a surface's light is out of a pixel's noise by itself.
    """
    sparse = AmplitudeSolver(model, begun.amplitude, weight, begun)
    for sigmas, most in schedule:
        sparse.weight = weight / (1 + sparse.measure_light())
        sparse.run(most, against_dim=sigmas)
    return sparse


def _grow_surfaces(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Let surfaces reach further where they are lit up to the border of where they may be, as long as that
    explains the shot better: of one that is dim or turned far, frames in little light show a part.
    """
    growing = np.array([basis.is_quadratic for basis in solver.model.bases])
    beside, near = (np.ones((2 * far + 1,) * 2) for far in (BORDER_PX, MARGIN_PX))
    while growing.any():
        masks, further = solver.model.masks, np.zeros_like(solver.model.masks)
        lit = find_lit(solver, SURELY_LIT_SIGMAS, MIN_BEHIND_FRACTION)
        for one in np.flatnonzero(growing):
            within = scipy.ndimage.binary_erosion(masks[one], beside, border_value=1)
            if np.count_nonzero(lit[one] & ~within) >= MIN_BORDER_PX:
                further[one] = scipy.ndimage.binary_dilation(lit[one] & ~within, near) & ~masks[one]
        if not further.any():
            break
        before, solver = solver, solver.cover(masks | further)
        solver.run(REFINEMENT_ITERATIONS, against_dim=AGAINST_DIM)
        model, light = solver.model, solver.model.render(solver.amplitude)
        left, less = (model.image - one for one in (before.model.render(before.amplitude), light))
        gained = share_misfit(model, solver.amplitude, light, model.weights * (left**2 - less**2))
        new = further[model.masks] & (solver.amplitude > 0)
        gain, points = (
            np.bincount(model.surface[new], one, growing.size) for one in (gained[new], new[new])
        )
        growing &= gain > LEAST_GAIN * solver.variance * points
        solver = solver.cover(masks | further & growing[:, np.newaxis, np.newaxis])
    return solver


def _keep_lit(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Leave out the points of surfaces that are dark and far from any that is not, beside what is usual
    on their own surface: others may be far brighter.
    """
    near = np.ones((2 * LIT_MARGIN_PX + 1,) * 2)
    lit = find_lit(solver, LIT_SIGMAS, LIT_FRACTION)
    kept = [scipy.ndimage.binary_dilation(one, near) for one in lit] & solver.model.masks
    return solver.cover(kept) if kept.any() else solver


def find_lit(solver: AmplitudeSolver, sigmas: float, fraction: float) -> NDArray[np.bool_]:
    """Say where surfaces are lit, (surfaces, rows, columns): so far out of the noise, and so bright beside
    what is usual on them.
    """
    model, significance = solver.model, solver.measure_significance()
    lit = np.zeros_like(model.masks)
    for own, mask, part in zip(lit, model.masks, model.parts, strict=True):
        amplitude, out = solver.amplitude[part], significance[part]
        least = fraction * find_usual_brightness(amplitude, out, LIT_SIGMAS)
        own[mask] = (out > sigmas) & (amplitude > least)
    return lit


def join_surfaces(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Make one of two surfaces that are both lit in the same pixels within a pulse of each other, if that
    explains the shot better: returns of frames are bent about what stands on a table, and surfaces that
    follow these take the table's light for theirs.
    """
    doubles = _list_doubles(solver)
    while doubles:
        pair = doubles.pop(0)
        apart, own = _take_apart(solver, pair), int(pair[0] > pair[1])
        apart.run(REFINEMENT_ITERATIONS, against_dim=AGAINST_DIM)
        # where the smaller is far off, the larger alone is the better guess
        trials = [apart, *(_join(apart, own, 1 - own, like) for like in ([0, 1], [own]))]
        for trial in trials[1:]:
            trial.run(REFINEMENT_ITERATIONS, against_dim=AGAINST_DIM)
        best = int(np.argmin([_measure_misfit(trial) for trial in trials]))
        if best:
            solver = _join(solver, *pair, [*pair][: 3 - best])
            solver.run(REFINEMENT_ITERATIONS, against_dim=AGAINST_DIM)
            doubles = _list_doubles(solver)
    return solver


def _take_apart(solver: AmplitudeSolver, surfaces: Sequence[int] | Pixels) -> AmplitudeSolver:
    """Return some surfaces before what the others leave of the shot."""
    model, own = solver.model, np.zeros(len(solver.model.masks), bool)
    own[np.asarray(surfaces)] = True
    apart = solver.cover(model.masks & own[:, np.newaxis, np.newaxis])
    others = np.where(own[model.surface], np.float32(0), solver.amplitude)
    apart.model.image = model.image - model.render(others)
    return apart


def _list_doubles(solver: AmplitudeSolver) -> list[tuple[int, int]]:
    """Pairs of surfaces of which the smaller is, in a part of its pixels, where the larger is; the larger
    one first.
    """
    model = solver.model
    lit = np.flatnonzero(solver.measure_significance() > LIT_SIGMAS)
    order, rank = rank_within_pixels(model.pixel[lit], model.distance[lit])
    nearer, farther = lit[order[:-1]], lit[order[1:]]
    near = (rank[1:] > 0) & (
        model.distance[farther] - model.distance[nearer] < NEAR_BINS * model.row_m
    )
    size = np.bincount(model.surface[lit], minlength=len(model.parts))
    shared = np.zeros((size.size, size.size))
    np.add.at(shared, (model.surface[nearer[near]], model.surface[farther[near]]), 1)
    shared = np.triu(shared + shared.T, 1)
    pairs = np.argwhere(shared > DOUBLE_FRACTION * np.minimum.outer(size, size))
    pairs = pairs[np.argsort(-shared[tuple(pairs.T)])]
    return [(int(a), int(b)) if size[a] >= size[b] else (int(b), int(a)) for a, b in pairs]


def _join(solver: AmplitudeSolver, large: int, small: int, like: list[int]) -> AmplitudeSolver:
    """Give the light and the pixels of one surface to another, as the quadratic nearest to some."""
    model = solver.model
    points = np.flatnonzero(np.isin(model.surface, like))
    nearest = model.find_quadratic(points, solver.amplitude)
    masks, pictures = model.masks.copy(), np.zeros(model.masks.shape, np.float32)
    pictures[masks] = solver.amplitude
    masks[large] |= masks[small]
    pictures[large] += pictures[small]
    masks[small] = False
    joined = solver.cover(masks)
    joined.amplitude = pictures[masks]
    joined.model = joined.model.reshape({large - (small < large): nearest})
    return joined


def _measure_misfit(solver: AmplitudeSolver) -> float:
    """The weighted sum of squares of what surfaces leave of the shot."""
    model = solver.model
    rest = model.image - model.render(solver.amplitude)
    return float(np.sum(model.weights * rest**2, dtype=np.float64))


def straighten_surfaces(
    solver: AmplitudeSolver,
) -> tuple[AmplitudeSolver, Refinement | None]:
    """Replace splines and quadrics by quadratics where these explain the shot as well, after a step;
    return what that step knew as well, if there was one. Splines follow the returns of frames, also where these
    are displaced, as behind gauze; the shot itself says whether the surface is bent.
    """
    model = solver.model
    lit = np.bincount(model.surface, solver.amplitude > 0, len(model.bases))
    straight = [k for k, basis in enumerate(model.bases) if not basis.is_quadratic and lit[k]]
    if not straight:
        return solver, None
    ahead = copy.copy(model)
    before = refine_state(ahead, solver.amplitude)
    while straight:
        own = {k: np.flatnonzero(model.surface == k) for k in straight}
        plain = {k: model.find_quadratic(points, solver.amplitude) for k, points in own.items()}
        trial, after, needed = _try_shapes(solver, ahead, before, plain)
        most = max(needed.values())
        if most <= 1:
            ahead, before = trial, after
            break
        # one that is bent for certain takes light from others: these are tried again without it
        least = max(1.0, min(most, NO_DOUBT) / CERTAINLY_BENT)
        straight = [k for k in straight if needed[k] <= least]
    return _round_splines(AmplitudeSolver(ahead, before.amplitude, solver.weight, solver), before)


def _round_splines(
    solver: AmplitudeSolver, found: Refinement
) -> tuple[AmplitudeSolver, Refinement]:
    """Replace splines by surfaces of second order where these explain the shot better, after a step from where
    the step `found` led: returns of frames do not always tell which of them a melon is.
    """
    model, points = solver.model, {}
    for surface, (basis, part) in enumerate(zip(model.bases, model.parts, strict=True)):
        light = solver.amplitude[part]
        if basis.is_quadratic or isinstance(basis, QuadricBasis) or not light.any():
            continue
        bright = light > ROUND_FRACTION * np.median(light[light > 0])
        if np.count_nonzero(bright) >= MIN_ROUND_PX:
            points[surface] = part.start + np.flatnonzero(bright)
    if not points:
        return solver, found
    ahead = copy.copy(model)
    before = refine_state(ahead, solver.amplitude, replace(found, steps=0))
    shapes = {surface: ahead.find_quadric(own) for surface, own in points.items()}
    trial, after, needed = _try_shapes(solver, ahead, before, shapes)
    better = {surface: shape for surface, shape in shapes.items() if needed[surface] <= 0}
    if 0 < len(better) < len(shapes):
        trial, after, _ = _try_shapes(solver, ahead, before, better)
    if better:
        ahead, before = trial, after
    return AmplitudeSolver(ahead, before.amplitude, solver.weight, solver), before


def _try_shapes(
    solver: AmplitudeSolver, ahead: SurfaceModel, before: Refinement, shapes: dict[int, Shape]
) -> tuple[SurfaceModel, Refinement, dict[int, float]]:
    """Take the step that led `ahead` with other shapes of some surfaces; also return how much worse each explains the
    shot, of what the freedom that it lacks is worth.
    """
    model = solver.model
    trial = model.reshape(shapes)
    # what amplitudes explain hardly depends on the basis: begun there, but still a first step
    after = refine_state(trial, solver.amplitude, replace(before, steps=0))
    change = model.weights * (after.rest**2 - before.rest**2)
    excess = share_misfit(model, solver.amplitude, model.render(solver.amplitude), change)
    needed = {}
    for surface, (_, fewer) in shapes.items():
        basis, coefficients = ahead.bases[surface], ahead.state.coefficients[surface]
        freedom = 2 * solver.variance * (coefficients.size - fewer.size)
        bending = coefficients @ basis.bending @ coefficients
        needed[surface] = float(excess[model.parts[surface]].sum() / (freedom + bending))
    return trial, after, needed


def _refine(
    solver: AmplitudeSolver,
    found: Refinement | None,
    tick: Tick = lambda: None,
    most: int = MAX_REFINEMENTS,
) -> tuple[Refinement, FloatArray]:
    """Steps on ranges and instrument until they hardly move; the last one, and what more would
    change of each surface.
    """
    model, lengths = solver.model, []
    for number in range(most):
        before = model.distance
        model.find_behind(solver.amplitude)
        found = refine_state(model, solver.amplitude, found, number + 1 >= MIN_REFINEMENTS)
        solver.amplitude = found.amplitude
        solver.run(REFINEMENT_ITERATIONS, tick, AGAINST_DIM)
        # where a surface is dark, it may go anywhere
        light = solver.amplitude + np.finfo(np.float32).tiny
        squares = (model.distance - before) ** 2
        lengths.append([np.sqrt(np.average(squares[p], weights=light[p])) for p in model.parts])
        far, points = _measure_step(solver, before, found)
        if number + 1 >= MIN_REFINEMENTS:
            if far.sum() < LAST_STEP_SIGMAS**2 * points.sum():
                break
            alone = far > LONG_STEP_SIGMAS**2 * points
            # where most of a scene moves, it may be the instrument that is not known yet
            if 2 * points[alone].sum() < points.sum():
                last = number + 1 == most
                steps = LAST_SETTLING_STEPS if last else SETTLING_STEPS
                settle_surfaces(solver, alone, found, steps)
    assert found is not None
    return found, extrapolate_steps(np.array(lengths))


def _measure_step(
    solver: AmplitudeSolver, before: FloatArray, found: Refinement
) -> tuple[NDArray[Any], NDArray[Any]]:
    """How far ranges went of each surface, the sum of squares over its lit points in their deviations, and
    how many these are, (surfaces,) each, the more a point counts the more light it has; `before`: ranges,
    (points,).
    """
    model, light = solver.model, solver.amplitude
    moved = (model.distance - before) / model.estimate_deviation(found.covariances)
    far, whole, points = (
        np.bincount(model.surface, one, len(model.parts))
        for one in (light * moved**2, light, light > 0)
    )
    return points * far / np.maximum(whole, TINY), points


def settle_surfaces(
    solver: AmplitudeSolver, chosen: NDArray[np.bool_], found: Refinement, steps: int
) -> None:
    """Take further steps on the ranges of some surfaces, (surfaces,), alone, after the step `found`: where
    one has far to go, as a ball on a table, all others and the instrument have long been settled.
    """
    if not chosen.any():
        return
    model, own = solver.model, chosen[solver.model.surface]
    apart = _take_apart(solver, np.flatnonzero(chosen))
    step = replace(found, explained=found.explained[:, own], free=None)
    for _ in range(steps):
        before = apart.model.distance
        step = refine_state(apart.model, apart.amplitude, step, instrument=False)
        apart.amplitude = step.amplitude
        apart.run(REFINEMENT_ITERATIONS, against_dim=AGAINST_DIM)
        far, points = _measure_step(apart, before, step)
        if far.sum() < LAST_STEP_SIGMAS**2 * points.sum():
            break
    state = model.state.copy()
    shapes = zip(np.flatnonzero(chosen), apart.model.state.coefficients, strict=True)
    for surface, coefficients in shapes:
        state.coefficients[surface] = coefficients
    model.place(state)
    solver.amplitude[own] = apart.amplitude


def extrapolate_steps(lengths: FloatArray) -> FloatArray:
    """Return how far steps, (steps, n), two or more, that shrink as the last two did would still go:
    the sum of a geometric series; steps that do not shrink count as if they halved.
    """
    tiny = np.finfo(np.float64).tiny
    ratio = np.minimum(lengths[-1] / np.maximum(lengths[-2], tiny), 0.5)
    return np.asarray(lengths[-1] * ratio / (1 - ratio))


def _find_others(
    solver: AmplitudeSolver, found: Returns, tick: Tick
) -> tuple[Returns, AmplitudeSolver]:
    """Return those of the frames' returns that no surface is near and that the whole shot shows, with
    surfaces and all other returns free to take over their light; and the light of all.
    """
    model = solver.model
    chosen = find_candidates(solver, solver.measure_significance(), Detection.signal_to_noise)
    points = model.row[chosen], model.column[chosen], model.distance[chosen]
    near = find_near((found.y, found.x, found.range), points, model.row_m)
    others = found[~near]
    if not len(others):
        return others, solver
    dark = np.zeros(len(others), np.float32)
    together, own = _add_returns(solver, others, dark, 0, tick)
    weights = together.model.weights / together.estimate_local_variance()
    information = together.model.gather(weights, squared=True)[own]
    shown = np.minimum(together.amplitude[own] * np.sqrt(information), ENOUGH_SIGMAS)
    doubt = np.clip(np.nan_to_num(others.false_alarm, nan=SURE_FALSE_ALARM), LEAST_DOUBT, 0.5)
    known = [np.ones(shown.size), shown, scipy.special.logit(doubt)]
    doubt = scipy.special.expit(OTHER_ODDS @ np.array(known)).astype(np.float32)
    doubt[shown < 1] = 1
    others = replace(others, false_alarm=doubt)
    # Drawn is what is expected of each where it may be false, or noise (W. James and C. Stein, Proc. 4th
    # Berkeley Symp. 1, 361, 1961). The light of those that are not drawn, or dropped as all methods drop
    # them, goes to the others; and what lies about them is not theirs alone.
    drawn = doubt <= DEFAULT_FALSE_ALARM
    if not drawn.any():
        return others[doubt < 0.5], solver
    light = together.amplitude[own[drawn]]
    whole, own = _add_returns(solver, others[drawn], light, ABOUT_OTHERS_PX, tick)
    whole.amplitude[own] *= (1 - doubt[drawn]) * (1 - 1 / shown[drawn] ** 2)
    return others[doubt < 0.5], whole


def _add_returns(
    solver: AmplitudeSolver, others: Returns, light: Image, margin_px: int, tick: Tick
) -> tuple[AmplitudeSolver, Pixels]:
    """Solve for the light of surfaces and of returns beside them, which is `light` at first; also return
    the returns' points. Light of a return's range may lie as many pixels about it.
    """
    model, shape = solver.model, solver.model.camera.image_shape
    pixel = others.y.astype(np.intp) * shape[1] + others.x
    order, rank = rank_within_pixels(pixel, others.range)
    layer = np.empty_like(rank)
    layer[order] = rank
    masks = np.zeros((int(rank.max(initial=-1)) + 1, *shape), bool)
    ranges = np.ones(masks.shape)
    place = layer, others.y, others.x
    masks[place], ranges[place] = True, others.range
    about = np.ones((2 * margin_px + 1,) * 2)
    for mask, distance in zip(masks, ranges, strict=True):
        nearest = scipy.ndimage.distance_transform_edt(
            ~mask, return_distances=False, return_indices=True
        )
        distance[...] = distance[tuple(nearest)]
        mask[...] = scipy.ndimage.binary_dilation(mask, about)
    point = model.surface.size + np.cumsum(masks).reshape(masks.shape)[place] - 1
    begin = np.append(solver.amplitude, np.zeros(masks.sum(), np.float32))
    begin[point] = light
    inverse = measure_rays(model.camera) / ranges
    together = AmplitudeSolver(model.add(masks, inverse), begin, solver.weight)
    together.run(START_ITERATIONS, tick)
    return together, point


def find_near(places: Places, others: Places, bin_m: float) -> NDArray[np.bool_]:
    """Say which places, rows, columns and ranges, have one of some others near. One in a neighbouring
    pixel may be a bin further off for each that it is aside.
    """
    reach = np.array([NEAR_PX, NEAR_PX, NEAR_BINS * bin_m])
    those, these = (np.transpose(one) / reach for one in (others, places))
    away, _ = scipy.spatial.cKDTree(those).query(these, p=np.inf, distance_upper_bound=1)
    return np.asarray(np.isfinite(away))


def find_candidates(
    solver: AmplitudeSolver, significance: Image, limit: float
) -> NDArray[np.bool_]:
    """Say which points stand out of the noise, by their significance, and are not far fainter than
    their surface.
    """
    model, amplitude = solver.model, solver.amplitude
    usual = [find_usual_brightness(amplitude[p], significance[p], limit) for p in model.parts]
    faint = amplitude <= MIN_BRIGHTNESS_FRACTION * np.array(usual)[model.surface]
    return np.asarray((significance > limit) & ~faint)


def find_usual_brightness(amplitude: Image, significance: Image, limit: float) -> float:
    """Return the usual amplitude of the points of which a surface certainly consists; infinite if
    none is that many standard deviations out of the noise. In little light none is 20 out of it, but
    some are further than others.
    """
    upper = float(np.quantile(significance, UPPER_QUANTILE)) if significance.size else np.inf
    sure = amplitude[significance > min(SURE_SIGMAS, max(limit, upper / 2))]
    return float(np.median(sure)) if sure.size else np.inf
