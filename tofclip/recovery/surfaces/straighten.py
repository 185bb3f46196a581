"""Which of the shapes that surfaces may have the shot shows."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver, share_misfit
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.patches import MIN_ROUND_PX
from tofclip.recovery.surfaces.points import Shape
from tofclip.recovery.surfaces.ranges import Refinement, refine_state
from tofclip.recovery.surfaces.shapes import QuadricBasis

# Of the greatest need to be bent of all surfaces, or of a need that leaves no doubt: those that need it
# more are bent.
CERTAINLY_BENT, NO_DOUBT = 3.0, 100.0
# Of what the freedom is worth that surfaces of second order lack: splines whose freedom is needed more stay
# (0.13 of a melon whose returns are displaced).
ROUND_NEED = 0.5
# Of a surface's usual brightness: the shape of what is dimmer says nothing of it.
ROUND_FRACTION = 0.3


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
    better = {surface: shape for surface, shape in shapes.items() if needed[surface] <= ROUND_NEED}
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
