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
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.errors import InputError
from tofclip.lidar import depth
from tofclip.recovery.surfaces.amplitudes import (
    AGAINST_DIM,
    START_ITERATIONS,
    AmplitudeSolver,
    Tick,
    explain_by_amplitude,
    scale_amplitude,
)
from tofclip.recovery.surfaces.bodies import part_bodies
from tofclip.recovery.surfaces.extents import (
    find_steep,
    grow_surfaces,
    join_surfaces,
    keep_lit,
    take_apart,
)
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.others import add_surfaces, find_others
from tofclip.recovery.surfaces.patches import find_dimmer_patches
from tofclip.recovery.surfaces.pulse import (
    LEAST_EXPLAINED,
    LEAST_TAIL,
    TINY,
    Image,
    measure_pulse,
)
from tofclip.recovery.surfaces.ranges import (
    FURTHER_FREE_ITERATIONS,
    Refinement,
    refine_state,
    take_step,
)
from tofclip.recovery.surfaces.start import (
    CHANGED_RATIO,
    DIM,
    MAX_UNEXPLAINED,
    SURE_FALSE_ALARM,
    TOO_DARK,
    call_dark,
    estimate_darkness,
    find_brightest_patches,
    find_surfaces,
    lay_out,
    measure_rays,
    require_explained,
    require_pulse,
)
from tofclip.recovery.surfaces.straighten import straighten_surfaces
from tofclip.shots import Frames, Returns, Streak
from tofclip.solvers import Progress, ignore_progress
from tofclip.threads import limit_blas_threads

PULSE_ITERATIONS = 10  # of those at the start, before the pulse is measured
# Steps on ranges before surfaces are parted, and at most after it; where one is far off after as many, it goes on.
MIN_REFINEMENTS, MAX_REFINEMENTS = 3, 4
# What dim light costs, in deviations, and for how many iterations at most, where it is to stay only as
# the shot needs it: first it gives way, then what is needed comes back. Fewer after the first shot.
SPARSELY, FOLLOWING_SPARSELY = ((4.0, 80), (2.0, 20)), ((4.0, 30), (2.0, 10))
# Of the stated deviations, root mean square over all points: a step on ranges as short is the last.
LAST_STEP_SIGMAS = 0.15
# Of the misfit with a tail: a pulse without that has more after a step does not get there (1.5 of scene5).
SURE_TAIL = 1.2
# After a longer one of its own a surface goes on alone, for as many steps, more after the last one, if each
# leads on that far where the one before led; others are at their end, or nowhere.
LONG_STEP_SIGMAS, SETTLING_STEPS, LAST_SETTLING_STEPS, GOES_ON = 0.7, 3, 16, 0.5
MOST_ONWARD = 0.75  # of a step, how far the next may be thought to lead
LONGER_PULSES = (
    12.0,
    4.0,
)  # by as many deviations longer, one after the other, that lead nearer to a steep surface
# Where the last shot's fit begins: before and after the ranges' step, and how far beyond the returns
# of quick frames surfaces may reach.
FOLLOWING_ITERATIONS, FOLLOWING_MARGIN_PX = 10, 4
CHANGED_EXCESS = 0.02  # beyond `CHANGED_RATIO` of what surfaces left unexplained


# Standard deviations of a blur along the slit, px, that are tried until one explains the shot less well than
# the one before; what has to be left of the misfit with the one that was known (0.3 of a shot of 2000 photons,
# 0.97 of the recorded scene5; 0.997 of one that is not blurred, of leaves); how often it is measured anew.
BLURS_PX, LEAST_BLURRED, BLUR_ROUNDS = (0.0, 0.7, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0), 0.985, 4


@dataclass(frozen=True)
class SurfaceFit:
    """Surfaces as they were fitted to a shot."""

    solver: AmplitudeSolver
    sparse: AmplitudeSolver  # the same with dim light beside bright only where the shot needs it
    refinement: Refinement  # the last one
    remainder: FloatArray  # (points,), what further steps would still change of ranges, m
    # what the surfaces left unexplained when they were found, as a fraction of the signal
    reference: float
    # of the frames, where the shot shows light that no surface explains; ranges as measured
    others: Returns
    whole: AmplitudeSolver  # with what is expected of their light
    seen: Returns  # of the frames, all; in little light also of means over more pixels


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
    darkness = estimate_darkness(streak, frames)
    if darkness > TOO_DARK:
        raise call_dark(darkness)
    try:
        tick = partial(progress, frames.times.size)
        return _fit_returns(found, streak, frames, weight, iterations, darkness, tick)
    except InputError as fault:
        if darkness <= MAX_UNEXPLAINED:
            raise
        raise call_dark(darkness) from fault


def _fit_returns(
    found: Returns,
    streak: Streak,
    frames: Frames,
    weight: float,
    iterations: int,
    darkness: float,
    tick: Tick,
) -> SurfaceFit:
    """Fit the surfaces that returns show. `darkness`: of `estimate_darkness`."""
    solver, seen = find_surfaces(found, streak, frames, weight, darkness)

    # 4. Amplitudes, and the pulse as they show it.
    solver.run(PULSE_ITERATIONS, tick, AGAINST_DIM)
    # in little light a part of the noise comes late, 0.5 to 0.8 of it
    solver = _measure_pulse(solver, max(LEAST_TAIL, darkness))
    require_pulse(solver.model.pulse, darkness)
    solver.run(START_ITERATIONS - PULSE_ITERATIONS, tick, AGAINST_DIM)
    limit = np.hypot(MAX_UNEXPLAINED, darkness)
    if solver.model.unexplained(solver.amplitude) > limit:
        # what is too small for a surface may be all that is bright
        _, whole = find_others(solver, found, tick)
        require_explained(whole, limit, frames, streak)
    if darkness > DIM:
        # frames show so little of some that others take their light
        solver = grow_surfaces(solver)
    begun = _measure_blur(join_surfaces(keep_lit(solver)))

    # 5. Ranges.
    shown = found, frames.values.sum(axis=0)
    solver, refinement, remainder = _fit_ranges(begun, shown, darkness, tick)
    for _ in range(BLUR_ROUNDS if solver.model.blur_px else 0):
        # what ranges of frames' returns were off by had hidden a part of the blur
        better = _measure_blur(solver)
        if better is solver:
            break
        model = begun.model.respond(better.model.pulse).blur(better.model.blur_px)
        again = AmplitudeSolver(model, begun.amplitude, weight, begun)
        solver, refinement, remainder = _fit_ranges(again, shown, darkness)
    if solver.model.pulse.reach:
        # what seemed a tail may have been ranges that were off
        plain, misfit = _measure_pulse(solver, np.inf), solver.measure_misfit()
        further, _ = _refine(plain, refinement, most=1)
        if plain.measure_misfit() < SURE_TAIL * misfit:
            further, _ = _refine(plain, further, least=MIN_REFINEMENTS, most=MIN_REFINEMENTS)
        if plain.measure_misfit() < misfit:
            solver, (refinement, remainder) = plain, _refine(plain, further)
    # dim light has given way a little by now
    sparse = _explain_sparsely(solver.model, solver, weight, SPARSELY)
    solver.run(iterations, tick)
    reference = solver.model.unexplained(solver.amplitude)
    beside = find_others(solver, found, tick)
    return SurfaceFit(solver, sparse, refinement, remainder, reference, *beside, seen)


def _fit_ranges(
    begun: AmplitudeSolver,
    shown: tuple[Returns, Image],
    darkness: float,
    tick: Tick = lambda: None,
) -> tuple[AmplitudeSolver, Refinement, FloatArray]:
    """Fit ranges, and straighten splines that are not needed first: these take longer to be right, and late views
    give way to them. Which surfaces are several shows once they are nearly right, and where some are, again once
    all are. `begun` stays as it is.
    """
    solver = AmplitudeSolver(copy.copy(begun.model), begun.amplitude, begun.weight, begun)
    solver.model.find_behind(solver.amplitude)
    solver, straightened = straighten_surfaces(solver)
    _approach_steep(solver, darkness)
    refinement, _ = _refine(solver, straightened, tick, least=MIN_REFINEMENTS, most=MIN_REFINEMENTS)
    added = add_surfaces(solver, *shown)
    # ranges that follow the shot point by point follow noise otherwise
    parted = part_bodies(added) if darkness <= DIM else added
    grown = grow_surfaces(parted)
    if grown is not solver:
        solver = keep_lit(grown)
        refinement = refinement.cover(solver.model)
        _approach_steep(solver, darkness)
    refined = _refine(solver, refinement, tick)
    if parted is not added and (again := part_bodies(solver)) is not solver:
        solver = keep_lit(again)
        refined = _refine(solver, refined[0].cover(solver.model), tick)
    return solver, *refined


def _measure_pulse(solver: AmplitudeSolver, least_tail: float = LEAST_TAIL) -> AmplitudeSolver:
    """Give surfaces the pulse that the shot shows, without a tail of less than a part of the light."""
    model, light = solver.model, solver.model.render_instants(solver.amplitude)
    width = model.camera.pulse_fwhm / model.bin_width
    least_tail = max(least_tail, LEAST_EXPLAINED * model.unexplained(solver.amplitude))
    pulse = measure_pulse(light, model.image, model.weights, width, least_tail)
    return AmplitudeSolver(model.respond(pulse), solver.amplitude, solver.weight, solver)


def _measure_blur(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Give surfaces the blur along the slit, as of a streak tube, with which they explain the shot best, and the
    pulse that is left then: light of other ranges that a blur brings seems to come earlier and later.
    """
    model, amplitude = solver.model, solver.amplitude

    def find_misfit(sigma_px: float) -> float:
        blurred = model.blur(sigma_px)
        error = blurred.image - blurred.render(amplitude)
        scale = scale_amplitude(blurred, amplitude > 0)
        _, rest = explain_by_amplitude(blurred, error, scale, FURTHER_FREE_ITERATIONS)
        return float(np.sum(model.weights * rest**2, dtype=np.float64))

    misfits: list[float] = []
    for sigma_px in BLURS_PX:
        misfits.append(find_misfit(sigma_px))
        if misfits[-1] > min(misfits):
            break
    best = int(np.argmin(misfits))
    sigma_px = BLURS_PX[best]
    if 0 < best < len(misfits) - 1:
        about = slice(best - 1, best + 2)
        curve = np.polynomial.Polynomial.fit(np.array(BLURS_PX[about]), np.array(misfits[about]), 2)
        sigma_px = float(curve.deriv().roots()[0])
    if sigma_px == model.blur_px:
        return solver
    if find_misfit(sigma_px) > LEAST_BLURRED * find_misfit(model.blur_px):
        return solver
    blurred = AmplitudeSolver(model.blur(sigma_px), amplitude, solver.weight, solver)
    blurred.run_briefly()
    return _measure_pulse(blurred)


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
        remainder = np.zeros(model.surface.size)
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


def _approach_steep(solver: AmplitudeSolver, darkness: float) -> None:
    """Take steps on ranges as longer pulses show them, where a surface is steep. Returns of frames are off by
    many pulses there; and as light may be a part of a pixel higher where its range is longer, steps that see
    each pulse's place lead a tenth of the way. In little light a longer pulse is one with what is beside it.
    """
    if darkness > DIM:
        return
    steep = find_steep(solver)
    if not steep.any():
        return
    apart = take_apart(solver, np.flatnonzero(steep))
    for pulses in LONGER_PULSES:
        longer = apart.model.lengthen(pulses * solver.model.pulse.sigma, apart.amplitude)
        trial = AmplitudeSolver(longer, apart.amplitude, solver.weight, apart)
        trial.run_briefly()
        apart.amplitude = refine_state(longer, trial.amplitude, instrument=False).amplitude
        shapes = longer.state.coefficients
        apart.model.place(replace(apart.model.state, coefficients=shapes))
    _put_back(solver, steep, apart)
    solver.run_briefly()


def _refine(
    solver: AmplitudeSolver,
    found: Refinement | None,
    tick: Tick = lambda: None,
    least: int = 1,
    most: int = MAX_REFINEMENTS,
) -> tuple[Refinement, FloatArray]:
    """Take Gauss-Newton steps on ranges and instrument, at least and at most so many, until one is short; return
    the last one, and what more would change of each point's range, (points,), m.
    """
    model, moved = solver.model, np.zeros(solver.amplitude.size)
    for number in range(most):
        before = model.distance
        model.find_behind(solver.amplitude)
        found = take_step(solver, found, robust=number + 1 >= least, tick=tick)
        earlier, moved = moved, model.distance - before
        far, points = _measure_step(solver, moved, found)
        if number + 1 >= least and far.sum() < LAST_STEP_SIGMAS**2 * points.sum():
            break
        if number + 1 >= MIN_REFINEMENTS:
            alone = far > LONG_STEP_SIGMAS**2 * points
            # where most of a scene moves, it may be the instrument that is not known yet
            if 2 * points[alone].sum() < points.sum():
                last = number + 1 == most
                steps = LAST_SETTLING_STEPS if last else SETTLING_STEPS
                settle_surfaces(solver, alone, found, steps)
    assert found is not None
    # where a surface is dark, it may go anywhere
    light = solver.amplitude + np.float32(TINY)
    remainder = [extrapolate_step(moved[p], earlier[p], light[p]) for p in model.parts]
    return found, np.concatenate(remainder)


def _measure_step(
    solver: AmplitudeSolver, moved: FloatArray, found: Refinement
) -> tuple[NDArray[Any], NDArray[Any]]:
    """How far ranges went of each surface, the sum of squares over its lit points in their deviations, and
    how many these are, (surfaces,) each, the more a point counts the more light it has; `moved`: ranges, by
    so much, (points,).
    """
    model, light = solver.model, solver.amplitude
    sigmas = moved / model.estimate_deviation(found.covariances)
    far, whole, points = (
        np.bincount(model.surface, one, len(model.parts))
        for one in (light * sigmas**2, light, light > 0)
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
    own = chosen[solver.model.surface]
    apart = take_apart(solver, np.flatnonzero(chosen))
    step = replace(found, explained=found.explained[:, own], free=None)
    moved = np.zeros(apart.amplitude.size)
    for number in range(steps):
        before = apart.model.distance
        step = take_step(apart, step, instrument=False)
        earlier, moved = moved, apart.model.distance - before
        far, points = _measure_step(apart, moved, step)
        if far.sum() < LAST_STEP_SIGMAS**2 * points.sum():
            break
        if number and _lead_on(moved, earlier, apart.amplitude) < GOES_ON:
            break
    _put_back(solver, chosen, apart)


def _put_back(solver: AmplitudeSolver, chosen: NDArray[np.bool_], apart: AmplitudeSolver) -> None:
    """Have some surfaces, (surfaces,), as they became apart from the others."""
    state = solver.model.state.copy()
    shapes = zip(np.flatnonzero(chosen), apart.model.state.coefficients, strict=True)
    for surface, coefficients in shapes:
        state.coefficients[surface] = coefficients
    solver.model.place(state)
    solver.amplitude[chosen[solver.model.surface]] = apart.amplitude


def extrapolate_step(last: FloatArray, earlier: FloatArray, light: Image) -> FloatArray:
    """Return how far the steps of a surface would still lead each point, if each leads on as the last did from the
    one before: the sum of a geometric series. All (points,).
    """
    ratio = min(max(_lead_on(last, earlier, light), 0.0), MOST_ONWARD)
    return np.abs(last) * (ratio / (1 - ratio))


def _lead_on(last: FloatArray, earlier: FloatArray, light: Image) -> float:
    """How far a step leads where the one before it led, as a part of how far that led; all (points,)."""
    return float(light @ (last * earlier)) / max(float(light @ earlier**2), TINY)
