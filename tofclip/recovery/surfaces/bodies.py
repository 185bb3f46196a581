"""Which surface is several, as the whole shot decides: bodies that touch at one range, which the returns of frames
do not tell from one. Where they may part is looked for in ranges that follow the shot point by point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver, share_misfit
from tofclip.recovery.surfaces.creases import divide_further, find_bodies
from tofclip.recovery.surfaces.extents import LIT_SIGMAS, find_lit, find_steep, take_apart
from tofclip.recovery.surfaces.patches import Patch
from tofclip.recovery.surfaces.pulse import Image
from tofclip.recovery.surfaces.ranges import take_step
from tofclip.recovery.surfaces.shapes import TINY, SmoothBasis
from tofclip.recovery.surfaces.shifts import SHIFT_SHOWN, follow_local_shifts, measure_local_shifts
from tofclip.recovery.surfaces.start import measure_rays

BODY_FRACTION = 0.3  # of a surface's usual brightness: ranges of what is dimmer say little
FOLLOWED_BINS = 0.25  # ranges that follow the shot are that much nearer than those of frames
BODY_MARGIN_PX = 3  # how far one body may reach into the next
# Steps until bodies are compared with the surface that they were taken for, and how often, as they may be several
# again; by how much the misfit has to fall, in the noise's variance, for each number that bodies have more than the
# surface, or a quarter of their own (4 to 30 where balls, leaves and tables were one, 45 to 2000 where there were
# several).
BODY_STEPS, BODY_ROUNDS, BODY_GAIN = 2, 3, 40.0


class Body(NamedTuple):
    """A surface, or a part of one."""

    mask: NDArray[np.bool_]  # (rows, columns), where it may be
    light: Image  # (rows, columns)
    basis: SmoothBasis
    coefficients: FloatArray


def part_bodies(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Give bodies that touch at one range surfaces of their own, where these explain the shot better."""
    doubtful: Sequence[int] = range(len(solver.model.masks))
    for _ in range(BODY_ROUNDS):
        apart, better = take_apart(solver, doubtful), dict[int, list[Body]]()
        # a few bodies first: where these explain it no better, more of them may
        for found in _find_bodies(apart):
            left = {surface: parts for surface, parts in found.items() if surface not in better}
            if left:
                better |= _try_bodies(take_apart(apart, list(left)), left)
        if not better:
            break
        surfaces = {doubtful[surface]: parts for surface, parts in better.items()}
        solver, doubtful = _replace(solver, surfaces)
    return solver


def _find_bodies(solver: AmplitudeSolver) -> tuple[dict[int, list[Body]], dict[int, list[Body]]]:
    """The bodies of which surfaces may consist, of those that may be several; and those of which they may consist
    if these are several in turn.
    """
    model = solver.model
    rest, ray_length = model.image - model.render(solver.amplitude), measure_rays(model.camera)
    shifts = measure_local_shifts(model, solver.amplitude, rest) / SHIFT_SHOWN
    variance = solver.estimate_local_variance()
    distance = model.distance + follow_local_shifts(solver, rest, variance, shifts)
    lit = find_lit(solver, LIT_SIGMAS, BODY_FRACTION)[model.masks]
    few, more, wholes = dict[int, list[Body]](), dict[int, list[Body]](), list_bodies(solver)
    # where a pixel has no one range, returns do not lie on any surface
    flat = ~find_steep(solver) | [not basis.is_quadratic for basis in model.bases]
    for surface, part in enumerate(model.parts):
        own = part.start + np.flatnonzero(lit[part])
        if own.size and flat[surface]:
            deviation, bin_m = np.full(own.size, TINY), FOLLOWED_BINS * model.row_m
            whole = Patch.fit(model.pixel[own], distance[own], deviation, ray_length)
            patches = find_bodies(whole, bin_m)
            if len(patches) > 1:
                few[surface] = _divide(wholes[surface], patches)
                further = divide_further(patches, bin_m)
                if len(further) > len(patches):
                    more[surface] = _divide(wholes[surface], further)
    return few, more


def _divide(whole: Body, patches: Sequence[Patch]) -> list[Body]:
    """Give each point of a surface to the nearest of some patches."""
    mask, light, *_ = whole
    label = np.zeros(mask.shape, np.intp)
    for number, patch in enumerate(patches):
        label.ravel()[patch.pixels] = number + 1
    nearest = scipy.ndimage.distance_transform_edt(
        label == 0, return_distances=False, return_indices=True
    )
    owner, about = label[tuple(nearest)], np.ones((2 * BODY_MARGIN_PX + 1,) * 2)
    bodies = []
    for number, patch in enumerate(patches):
        own = owner == number + 1
        reached = own | scipy.ndimage.binary_dilation(label == number + 1, about)
        seen = np.where(own, light, np.float32(0))
        bodies.append(Body(mask & reached, seen, patch.basis, patch.coefficients))
    return bodies


def _try_bodies(solver: AmplitudeSolver, found: Mapping[int, list[Body]]) -> dict[int, list[Body]]:
    """Take steps on surfaces, and on the bodies of each, by the surfaces' numbers; return the bodies that explain
    the shot so much better that they are worth their freedom.
    """
    trial, _ = _replace(solver, dict(enumerate(found.values())))
    light, fallen = solver.model.render(solver.amplitude), np.zeros_like(solver.model.image)
    for one, sign in ((solver, 1), (trial, -1)):
        one.run_briefly()
        step = None
        for _ in range(BODY_STEPS):
            step = take_step(one, step, instrument=False)
        assert step is not None
        fallen += sign * step.rest**2
    model, bodies = solver.model, iter(list_bodies(trial))
    gained = share_misfit(model, solver.amplitude, light, model.weights * fallen)
    better = {}
    wholes = zip(list_bodies(solver), model.parts, found.items(), strict=True)
    for whole, part, (surface, begun) in wholes:
        parts = [next(bodies) for _ in begun]
        own = sum(body.coefficients.size for body in parts)
        freedom = max(own - whole.coefficients.size, own / 4)
        if float(gained[part].sum()) > BODY_GAIN * solver.variance * freedom:
            better[surface] = parts
    return better


def list_bodies(solver: AmplitudeSolver) -> list[Body]:
    """All surfaces of a shot."""
    model, bodies = solver.model, []
    shapes = zip(model.masks, model.parts, model.bases, model.state.coefficients, strict=True)
    for mask, part, basis, coefficients in shapes:
        light = np.zeros(mask.shape, np.float32)
        light[mask] = solver.amplitude[part]
        bodies.append(Body(mask, light, basis, coefficients))
    return bodies


def _replace(
    solver: AmplitudeSolver, parts: Mapping[int, list[Body]]
) -> tuple[AmplitudeSolver, list[int]]:
    """Have bodies in place of some surfaces; also return the numbers of those of which one became several."""
    model, owners = solver.model, list[int]()
    bodies, several = list[Body](), list[int]()
    for surface, whole in enumerate(list_bodies(solver)):
        own = parts.get(surface, [whole])
        if len(own) > 1:
            several += range(len(bodies), len(bodies) + len(own))
        bodies += own
        owners += [surface] * len(own)
    return lay_bodies(solver, bodies, model.state.shading[owners]), several


def lay_bodies(
    solver: AmplitudeSolver, bodies: Sequence[Body], shading: FloatArray
) -> AmplitudeSolver:
    """Return a solver of other surfaces before the same shot. `shading`: theirs, (surfaces, views)."""
    model, masks = solver.model, np.array([body.mask for body in bodies])
    shapes = [body.coefficients for body in bodies]
    state = replace(model.state.copy(), coefficients=shapes, shading=shading)
    laid = AmplitudeSolver(
        model.lay_out(masks, [body.basis for body in bodies], state),
        np.array([body.light for body in bodies])[masks],
        solver.weight,
    )
    laid.variance = solver.variance
    return laid
