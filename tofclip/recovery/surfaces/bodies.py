"""Which bodies a surface is, or some surfaces that touch, as the whole shot decides: the returns of frames do not tell
apart what touches at one range. Bodies are looked for in ranges that follow the shot point by point.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver, share_misfit
from tofclip.recovery.surfaces.extents import LIT_SIGMAS, find_lit, find_steep, take_apart
from tofclip.recovery.surfaces.growing import find_bodies, find_halves
from tofclip.recovery.surfaces.patches import Patch
from tofclip.recovery.surfaces.pulse import Image
from tofclip.recovery.surfaces.ranges import take_step
from tofclip.recovery.surfaces.shapes import TINY, SmoothBasis
from tofclip.recovery.surfaces.shifts import SHIFT_SHOWN, follow_local_shifts, measure_local_shifts
from tofclip.recovery.surfaces.start import measure_rays

BODY_FRACTION = 0.3  # of a surface's usual brightness: ranges of what is dimmer say little
FOLLOWED_BINS = 0.25  # ranges that follow the shot are that much nearer than those of frames
BODY_MARGIN_PX = 3  # how far one body may reach into the next
# Steps until bodies are compared with the surfaces that they were taken for, and how often, as they may be several
# again; by how much the misfit has to fall, in the noise's variance, for each number that bodies have more than the
# surfaces, or a quarter of their own (4 to 30 where balls, leaves and tables were one, 45 to 2000 where there were
# several).
BODY_STEPS, BODY_ROUNDS, BODY_GAIN = 2, 3, 40.0
# Halves may be of anything: 0.11 to 0.6 of the light of cups and bent arms, up to 0.05 of heads, leaves and legs.
HALVES_LIGHT = 0.08
# As if ranges were that much nearer to bodies: few of these are tried, and more.
FINER = 0.75, 1.25
# Surfaces are tried alone, and those together whose ranges differ by less where they touch, if they are few.
TOUCHING_ROWS, MOST_MEMBERS = (0.0, 3.0), 6

Group = tuple[int, ...]  # numbers of surfaces


class Body(NamedTuple):
    """A surface, or a part of one."""

    mask: NDArray[np.bool_]  # (rows, columns), where it may be
    light: Image  # (rows, columns)
    basis: SmoothBasis
    coefficients: FloatArray


class Trial(NamedTuple):
    """Bodies that may be in place of a group of surfaces."""

    gain: float  # by how much more they explain of the shot than their freedom is worth
    group: Group
    bodies: list[Body]


def part_bodies(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Give bodies that touch at one range surfaces of their own, where these explain the shot better than the
    surfaces that there are: of one, or of some that touch.
    """
    doubtful = set(range(len(solver.model.masks)))
    for _ in range(BODY_ROUNDS):
        patches, trials = _follow(solver), list[Trial]()
        for rows in TOUCHING_ROWS:
            groups = _list_groups(patches, rows * solver.model.row_m)
            left = [group for group in groups if doubtful & set(group)]
            for finer in FINER:
                if found := _find_bodies(solver, patches, left, finer):
                    trials += _try_bodies(solver, found)
        if found := _find_halves(solver, {one: patches[one] for one in doubtful & set(patches)}):
            trials += _try_bodies(solver, found, HALVES_LIGHT)
        better = dict[Group, list[Body]]()
        for trial in sorted(trials, key=lambda one: -one.gain):
            taken = set(itertools.chain.from_iterable(better))
            if trial.gain > 0 and not taken & set(trial.group):
                better[trial.group] = trial.bodies
        if not better:
            break
        solver, doubtful = _replace(solver, better)
    return solver


def _list_groups(patches: Mapping[int, Patch], apart: float) -> list[Group]:
    """Surfaces that touch at ranges that differ by less, m; without that each alone."""
    if not apart:
        return [(one,) for one in patches]
    numbers, every = list(patches), list(patches.values())
    beside = np.zeros((len(numbers),) * 2, bool)
    for number, patch in enumerate(every):
        beside[number, patch.find_touching(every, apart)] = True
    count, label = scipy.sparse.csgraph.connected_components(beside, directed=False)
    groups = [tuple(numbers[k] for k in np.flatnonzero(label == one)) for one in range(count)]
    return [group for group in groups if 1 < len(group) <= MOST_MEMBERS]


def _follow(solver: AmplitudeSolver) -> dict[int, Patch]:
    """The lit points of surfaces, by number, at ranges that follow the shot point by point. Where a pixel has no one
    range these do not lie on any surface.
    """
    model = solver.model
    rest, ray_length = model.image - model.render(solver.amplitude), measure_rays(model.camera)
    shifts = measure_local_shifts(model, solver.amplitude, rest) / SHIFT_SHOWN
    variance = solver.estimate_local_variance()
    distance = model.distance + follow_local_shifts(solver, rest, variance, shifts)
    lit = find_lit(solver, LIT_SIGMAS, BODY_FRACTION)[model.masks]
    flat = ~find_steep(solver) | [not basis.is_quadratic for basis in model.bases]
    patches = dict[int, Patch]()
    for surface, part in enumerate(model.parts):
        own = part.start + np.flatnonzero(lit[part])
        if own.size and flat[surface]:
            returns = model.pixel[own], distance[own], np.full(own.size, TINY), ray_length
            shape = model.bases[surface], model.state.coefficients[surface]
            patches[surface] = Patch(*returns, *shape)
    return patches


def _find_bodies(
    solver: AmplitudeSolver, patches: Mapping[int, Patch], groups: Iterable[Group], finer: float
) -> dict[Group, list[Body]]:
    """The bodies of which groups of surfaces may consist, of those that may be others. `patches`: of `_follow`;
    `finer`: as if their ranges were that much nearer to bodies.
    """
    bin_m, bodies = FOLLOWED_BINS * solver.model.row_m / finer, list_bodies(solver)
    found = dict[Group, list[Body]]()
    for group in groups:
        if parts := find_bodies([patches[one] for one in group], bin_m):
            found[group] = _divide(_unite([bodies[one] for one in group]), parts)
    return found


def _find_halves(solver: AmplitudeSolver, patches: Mapping[int, Patch]) -> dict[Group, list[Body]]:
    """The two bodies of which each of some small surfaces may consist."""
    bin_m, bodies = FOLLOWED_BINS * solver.model.row_m, list_bodies(solver)
    halves = {one: find_halves(patch, bin_m) for one, patch in patches.items()}
    return {(one,): _divide(bodies[one], parts) for one, parts in halves.items() if parts}


def _unite(bodies: Sequence[Body]) -> Body:
    """The first of some bodies where all are."""
    mask = np.any([one.mask for one in bodies], axis=0)
    return bodies[0]._replace(mask=mask, light=np.sum([one.light for one in bodies], axis=0))


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


def _try_bodies(
    solver: AmplitudeSolver, found: Mapping[Group, list[Body]], of_light: float = 0.0
) -> list[Trial]:
    """Take steps on surfaces, and on the bodies that may be in place of each group of them. `of_light`: the part of
    its light by which a group has to gain.
    """
    members = sorted(itertools.chain.from_iterable(found))
    place = {one: number for number, one in enumerate(members)}
    own = {tuple(place[one] for one in group): parts for group, parts in found.items()}
    kept = take_apart(solver, members)
    trial, _ = _replace(kept, own)
    light, fallen = kept.model.render(kept.amplitude), np.zeros_like(kept.model.image)
    for one, sign in ((kept, 1), (trial, -1)):
        one.run_briefly()
        step = None
        for _ in range(BODY_STEPS):
            step = take_step(one, step, instrument=False)
        assert step is not None
        fallen += sign * step.rest**2
    model, before, after = kept.model, list_bodies(kept), iter(list_bodies(trial))
    gained = share_misfit(model, kept.amplitude, light, model.weights * fallen)
    trials = list[Trial]()
    for (group, begun), places in zip(found.items(), own, strict=True):
        bodies = [next(after) for _ in begun]
        gain = sum(float(gained[model.parts[one]].sum()) for one in places)
        free = sum(body.coefficients.size for body in bodies)
        freed = sum(before[one].coefficients.size for one in places)
        whole = sum(float(before[one].light.sum()) for one in places)
        gain -= BODY_GAIN * solver.variance * max(free - freed, free / 4) + of_light * whole
        trials.append(Trial(gain, group, bodies))
    return trials


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
    solver: AmplitudeSolver, parts: Mapping[Group, list[Body]]
) -> tuple[AmplitudeSolver, set[int]]:
    """Have bodies in place of some groups of surfaces; also return their numbers."""
    left = {(one,): [body] for one, body in enumerate(list_bodies(solver))}
    for group in parts:
        for one in group:
            del left[one,]
    bodies = [*itertools.chain.from_iterable([*left.values(), *parts.values()])]
    owners = [group[0] for group, own in [*left.items(), *parts.items()] for _ in own]
    replaced = lay_bodies(solver, bodies, solver.model.state.shading[owners])
    return replaced, set(range(len(left), len(bodies)))


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
