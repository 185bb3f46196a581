"""Finding the surfaces of a shot and fitting them, or those of the shot before, to what it shows."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import scipy

from tofclip.lidar import compute_ray_directions, depth
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.model import FloatArray, SurfaceModel
from tofclip.recovery.surfaces.patches import (
    MARGIN_PX,
    find_dimmer_patches,
    find_patches,
    reach_further,
)
from tofclip.recovery.surfaces.pulse import measure_pulse
from tofclip.recovery.surfaces.ranges import Refinement, refine_state
from tofclip.recovery.surfaces.refusal import (
    require_explained,
    require_gentle_slopes,
    require_short_pulse,
    require_surfaces,
)
from tofclip.recovery.surfaces.state import SurfaceState
from tofclip.shots import Frames, Streak
from tofclip.solvers import Progress, ignore_progress
from tofclip.threads import limit_blas_threads
from tofclip.units import SPEED_OF_LIGHT

START_ITERATIONS = 25
MIN_REFINEMENTS, MAX_REFINEMENTS, REFINEMENT_ITERATIONS = 2, 4, 10
# Of the stated deviations, root mean square over all points: a step on ranges as short is the last.
LAST_STEP_SIGMAS = 0.3
FOLLOWING_ITERATIONS = 10  # before and after the ranges' step, where the last shot's fit begins
# Of what surfaces leave unexplained, and beyond: from there on they are not the next shot's.
CHANGED_RATIO, CHANGED_EXCESS = 1.25, 0.02


@dataclass(frozen=True)
class SurfaceFit:
    """Surfaces as they were fitted to a shot."""

    model: SurfaceModel
    solver: AmplitudeSolver
    refinement: Refinement  # the last one
    # (surfaces,), what further steps would still change of each surface's range, m
    remainder: FloatArray
    # what the surfaces left unexplained when they were found, as a fraction of the signal
    reference: float

    def count_iterations(self) -> int:
        """Return the iterations of FISTA until the ranges were known."""
        return START_ITERATIONS + self.refinement.steps * REFINEMENT_ITERATIONS


@limit_blas_threads()  # products of a few dozen columns are too small to share
def fit_surfaces(
    streak: Streak,
    frames: Frames,
    weight: float,
    iterations: int,
    progress: Progress = ignore_progress,
) -> SurfaceFit:
    """Find and fit the surfaces of a shot.

    `frames`: A fast recovery of the same shot, with the camera to use; `weight`: of total
    variation; see `tofclip.recovery.SurfaceRecovery`; `iterations`: after the ranges are known;
    `progress`: called with the number of frame iterations just done.
    """
    camera, count = frames.camera, frames.times.size
    # The model explains what was measured: corrections come when its returns are listed.
    found = depth(frames, camera.replace(range_calibration=None))
    bin_m = SPEED_OF_LIGHT * frames.bin_width / 2
    directions = compute_ray_directions(camera, *np.indices(camera.image_shape).reshape(2, -1))
    ray_length = (1 / directions[:, 2]).reshape(camera.image_shape)
    require_gentle_slopes(found, bin_m)
    # Weaker returns of a pixel are often the frames' own: they would widen the surfaces.
    strongest = found.image("range").astype(np.float64).ravel()
    pixels = np.flatnonzero(np.isfinite(strongest))
    patches = find_patches(pixels, strongest[pixels], ray_length, bin_m)
    require_surfaces(found, patches)
    patches += find_dimmer_patches(patches, found, ray_length, bin_m)
    masks = np.zeros((len(patches), *camera.image_shape), bool)
    pictures = np.zeros(masks.shape, np.float32)
    brightness = frames.values.sum(axis=0).ravel()
    for patch, mask, picture in zip(patches, masks, pictures, strict=True):
        picture.ravel()[patch.pixels] = brightness[patch.pixels]
        seen = reach_further(patch, found, ray_length, bin_m)
        mask[...] = scipy.ndimage.binary_dilation(seen, np.ones((3, 3)), MARGIN_PX)
    state = SurfaceState.start([patch.coefficients for patch in patches], camera)
    bases = [patch.basis for patch in patches]
    on_surface = np.concatenate([patch.pixels for patch in patches])
    pulse = measure_pulse(frames, on_surface, strongest[on_surface])
    require_short_pulse(pulse)
    model = SurfaceModel(streak, camera, masks, bases, state, pulse)
    solver = AmplitudeSolver(model, pictures[masks], weight)
    solver.run(START_ITERATIONS, progress, count)
    require_explained(model, solver.amplitude, frames, streak)
    model.find_behind(solver.amplitude)
    # before ranges are refined: splines take longer to be right, and views that are late give way
    solver = straighten_surfaces(solver)
    refinement, remainder = _refine(solver.model, solver, progress, count)
    solver.run(iterations, progress, count)
    reference = solver.model.unexplained(solver.amplitude)
    return SurfaceFit(solver.model, solver, refinement, remainder, reference)


def straighten_surfaces(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Replace splines by quadratics that explain the shot at least as well, after a step each.

    Splines follow the returns of frames, also where these are displaced, as behind gauze; the shot
    itself says whether the surface is bent.

    Returns of the model with those quadratics; the same where all splines are needed.
    """
    bent = [surface for surface, basis in enumerate(solver.model.bases) if not basis.is_quadratic]
    if not bent:
        return solver
    ahead = copy.copy(solver.model)
    least = refine_state(ahead, solver.amplitude).objective
    for surface in bent:
        if not (solver.amplitude[solver.model.parts[surface]] > 0).any():
            continue
        trial = solver.model.straighten(surface, solver.amplitude)
        moved = refine_state(trial, solver.amplitude)
        if moved.objective <= least:
            solver = AmplitudeSolver(trial, moved.amplitude, solver.weight, solver)
            least = moved.objective
    return solver


@limit_blas_threads()
def follow_surfaces(fit: SurfaceFit, streak: Streak, weight: float) -> SurfaceFit | None:
    """Fit the surfaces of the shot before to the next one of the same camera.

    `fit`: of the shot before; `weight`: of total variation; see `tofclip.recovery.SurfaceRecovery`.
    Returns none where these surfaces no longer explain what they did: the scene has changed, and
    surfaces have to be found anew.
    """
    model = fit.model.see(streak)
    solver = AmplitudeSolver(model, fit.solver.amplitude, weight, fit.solver)
    solver.run(FOLLOWING_ITERATIONS, ignore_progress, 0)
    # what explains the last shot best without the prior has that shot's noise
    refinement = refine_state(model, solver.amplitude, replace(fit.refinement, free=None))
    solver.amplitude = refinement.amplitude
    solver.run(FOLLOWING_ITERATIONS, ignore_progress, 0)
    unexplained = model.unexplained(solver.amplitude)
    if unexplained > CHANGED_RATIO * fit.reference + CHANGED_EXCESS:
        return None
    return SurfaceFit(model, solver, refinement, fit.remainder, fit.reference)


def _refine(
    model: SurfaceModel, solver: AmplitudeSolver, progress: Progress, count: int
) -> tuple[Refinement, FloatArray]:
    """Steps on ranges and instrument until they hardly move; the last one, and what more would
    change of each surface.
    """
    before, changes = model.distance, []
    found = None
    for number in range(MAX_REFINEMENTS):
        model.find_behind(solver.amplitude)
        found = refine_state(model, solver.amplitude, found)
        solver.amplitude = found.amplitude
        solver.run(REFINEMENT_ITERATIONS, progress, count)
        moved = model.distance - before
        changes.append([np.sqrt(np.mean(moved[part] ** 2)) for part in model.parts])
        before = model.distance
        sigmas = moved / model.estimate_deviation(found.covariances)
        if number + 1 >= MIN_REFINEMENTS and np.sqrt(np.mean(sigmas**2)) < LAST_STEP_SIGMAS:
            break
    assert found is not None
    return found, extrapolate_steps(np.array(changes))


def extrapolate_steps(lengths: FloatArray) -> FloatArray:
    """Return how far steps that shrink as the last two did would still go.

    `lengths` (steps, n): two steps or more. Returns (n,): the sum of a geometric series; steps that
    do not shrink count as if they halved.
    """
    tiny = np.finfo(np.float64).tiny
    ratio = np.minimum(lengths[-1] / np.maximum(lengths[-2], tiny), 0.5)
    left: FloatArray = lengths[-1] * ratio / (1 - ratio)
    return left
