"""Derivatives of the modelled streak image by what is solved for beside the amplitudes.

Solving for ranges, and for what is uncertain of the instrument, by Gauss-Newton steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.recovery.surfaces.amplitudes import TINY, explain_by_amplitude, scale_amplitude
from tofclip.recovery.surfaces.model import (
    FloatArray,
    Image,
    SurfaceModel,
    SurfaceState,
    measure_height,
)
from tofclip.recovery.surfaces.patches import COEFFICIENTS
from tofclip.recovery.surfaces.pulse import differentiate_pulse
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other
LEAST_VARIANCE = 1e-12  # of the largest one
MAX_LEVERAGE = 0.9  # of a cluster: what it alone determines, its misfit says nothing about


class Derivatives(NamedTuple):
    """Derivatives of the streak image by some unknowns, on the part of it that they change."""

    # field of `SurfaceState`, number of the surface or 0, number of the entry
    names: list[tuple[str, int, int]]
    row: int  # of the part's corner
    column: int  # of the part's corner
    images: Image  # (unknowns, rows, columns)


def iterate_derivatives(model: SurfaceModel, amplitude: Image) -> Iterator[Derivatives]:
    """Yield the image's derivatives by the unknowns of the state, each view's and surface's.

    The reference view keeps its delay and stretch: time zero is its own. Derivatives by gains
    and widths are by their logarithms.

    `amplitude` (points,).
    """
    views = range(model.camera.views)
    yield from map_parallel(lambda view: _differentiate_view(model, view, amplitude), views)
    yield from map_parallel(
        lambda view: _differentiate_sweep(model, view, amplitude),
        [view for view in views if view != model.reference],
    )
    yield from map_parallel(
        lambda surface: _differentiate_surface(model, surface, amplitude),
        range(len(model.masks)),
    )


def _differentiate_view(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    kernel, own = model.kernels[view], model.overlap(view)
    wider = model.make_kernel(view, 1 + WIDTH_STEP)
    images = {
        "gains": model.project(view, amplitude, kernel),
        "widths": model.project(view, amplitude, (wider - kernel) / np.float32(WIDTH_STEP)),
    }
    unknowns = [(name, 0, view) for name in images]
    projected = list(images.values())
    for surface in np.unique(model.surface[model.behind]):
        chosen = model.behind & (model.surface == surface)
        unknowns.append(("shading", int(surface), view))
        projected.append(model.project(view, amplitude * chosen, kernel))
    stacked = np.stack(projected)[:, :, own[0]] * np.float32(model.state.gains[view])
    return Derivatives(unknowns, 0, own[1].start, stacked)


def _differentiate_sweep(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    """By delay and stretch at a view's centre, which the views beside it feel as well."""
    felt = []
    for other, place in enumerate(model.footprints):
        weight = place.between.weigh_centre(view)
        if not weight.any():
            continue
        slope = differentiate_pulse(model.kernels[other])
        slope *= np.float32(model.state.gains[other])
        light = amplitude * weight
        late = light * measure_height(place.row, model.image.shape[0])
        own, slit = model.overlap(other)
        images = [
            model.project(other, one.astype(np.float32), slope)[:, own] for one in (light, late)
        ]
        felt.append((slit, images))
    first = min((slit.start for slit, _ in felt), default=0)
    last = max((slit.stop for slit, _ in felt), default=first + 1)
    total = np.zeros((2, model.image.shape[0], last - first), np.float32)
    for slit, images in felt:
        total[:, :, slit.start - first : slit.stop - first] += images
    return Derivatives([("delays", 0, view), ("stretches", 0, view)], 0, first, total)


def _differentiate_surface(model: SurfaceModel, surface: int, amplitude: Image) -> Derivatives:
    part, monomials = model.parts[surface], model.monomials[surface]
    first = min(int(one.row[part].min(initial=0)) for one in model.footprints) - model.half
    last = max(int(one.row[part].max(initial=0)) for one in model.footprints) + model.half + 3
    first = min(max(first, 0), model.image.shape[0] - 1)
    last = max(min(last, model.image.shape[0]), first + 1)
    there = 2 * model.distance[part] / SPEED_OF_LIGHT + model.camera.time_zero
    rows_per_metre = 2 / SPEED_OF_LIGHT / np.interp(there, model.times, np.gradient(model.times))
    # range = length / inverse depth
    by_inverse = -(model.distance[part] ** 2) / model.ray_length[part] * rows_per_metre
    in_range = (amplitude[part] * by_inverse)[:, np.newaxis] * monomials
    lights = np.ascontiguousarray(in_range.T, np.float32)
    images = np.zeros((len(lights), last - first, model.image.shape[1]), np.float32)
    for view, place in enumerate(model.footprints):
        slope = differentiate_pulse(model.kernels[view])
        slope *= np.float32(model.state.gains[view] * place.rows_per_instant)
        own, slit = model.overlap(view)
        for number, light in enumerate(lights):
            image = model.project(view, light, slope, part, (first, last))
            images[number, :, slit] += image[:, own]
    names = [("coefficients", surface, number) for number in range(len(lights))]
    return Derivatives(names, first, 0, images)


class ClusterProducts(NamedTuple):
    """What a part of the image says of the unknowns that change it."""

    own: NDArray[np.intp]  # (n,), numbers of these unknowns
    normal: Image  # (n, n), j'WJ of the part
    score: Image  # (n,), j'W of its misfit


class NormalEquations(NamedTuple):
    """What a Gauss-Newton step is made of."""

    normal: FloatArray  # (unknowns, unknowns), j'WJ
    slope: FloatArray  # (unknowns,), j' of what is to be explained
    clusters: list[ClusterProducts]  # what each part of the image adds to them

    def sum_squared_scores(self, inverse: FloatArray) -> FloatArray:
        """Return the sum of squares of the clusters' scores, as they were before the step.

        A step explains a part of each cluster's misfit, the more the fewer clusters there are, and what
        is left is too little. With the leverage h of a cluster, ``1 - h`` of its variance is left
        (R. Bell and D. McCaffrey, Surv. Methodol. 28, 169, 2002).

        `inverse` (unknowns, unknowns): of the normal matrix. Returns (unknowns, unknowns).
        """
        scores = np.zeros((len(self.clusters), self.slope.size))
        for score, (own, normal, pull) in zip(scores, self.clusters, strict=True):
            factor, inverse_factor = _take_root(inverse[np.ix_(own, own)])
            leverage, directions = np.linalg.eigh(factor.T @ normal @ factor)
            left = np.sqrt(1 - np.clip(leverage, 0, MAX_LEVERAGE))
            along = directions.T @ (factor.T @ pull)
            score[own] = inverse_factor.T @ (directions @ (along / left))
        return scores.T @ scores


def _take_root(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F with ``F F' = C``, and its inverse.

    Products in float32 may leave a covariance with a variance of zero or below along directions that
    a shot says nothing about, where no Cholesky factor is. There it is taken for very small.
    """
    unit = np.sqrt(np.maximum(np.abs(np.diag(covariance)), np.finfo(np.float64).tiny))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    deviations = np.sqrt(np.maximum(variances, LEAST_VARIANCE * variances.max()))
    return unit[:, np.newaxis] * axes * deviations, (axes / deviations).T / unit


def multiply_derivatives(
    groups: list[Derivatives], weights: Image, rest: Image, error: Image
) -> NormalEquations:
    """Return the products of all derivatives with each other and with misfits.

    Cluster by cluster: what is on one stays in cache, and most derivatives are on few.

    `weights` (rows, columns); `rest` (rows, columns): misfit that a step is to explain; `error`
    (rows, columns): misfit of the clusters' scores.
    """
    ends = np.cumsum([0] + [len(group.names) for group in groups])
    normal, slope = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    clusters = []
    for top in range(0, weights.shape[0], CLUSTER_ROWS):
        for left in range(0, weights.shape[1], CLUSTER_COLUMNS):
            area = np.s_[top : top + CLUSTER_ROWS, left : left + CLUSTER_COLUMNS]
            own, images = _cut_out(groups, ends, area, weights[area].shape)
            if own.size == 0:
                continue
            weighted: Image = images * weights[area].ravel()
            product: Image = weighted @ images.T
            score: Image = weighted @ error[area].ravel()
            normal[np.ix_(own, own)] += product
            slope[own] += weighted @ rest[area].ravel()
            clusters.append(ClusterProducts(own, product, score))
    return NormalEquations(normal, slope, clusters)


def _cut_out(
    groups: list[Derivatives],
    ends: NDArray[np.int64],
    area: tuple[slice, slice],
    shape: tuple[int, ...],
) -> tuple[NDArray[np.intp], Image]:
    """The unknowns that change a part of the image, and their derivatives there, (n, pixels)."""
    own, parts = [], []
    top, left = area[0].start, area[1].start
    for group, first, last in zip(groups, ends[:-1], ends[1:], strict=True):
        row, column = group.row - top, group.column - left
        here = group.images[
            :, max(-row, 0) : max(shape[0] - row, 0), max(-column, 0) : max(shape[1] - column, 0)
        ]
        if not here.any():
            continue
        row, column = max(row, 0), max(column, 0)
        part = np.zeros((here.shape[0], *shape), np.float32)
        part[:, row : row + here.shape[1], column : column + here.shape[2]] = here
        own.append(np.arange(first, last))
        parts.append(part.reshape(here.shape[0], -1))
    if not own:
        return np.zeros(0, np.intp), np.zeros((0, shape[0] * shape[1]), np.float32)
    return np.concatenate(own), np.concatenate(parts)


SMALLEST_STEP = 1 / 16  # of a Gauss-Newton step, halved until it lowers the misfit
# Rows by which each view's part of a sweep that was found from the shot is off: root mean squares of
# the demonstration. Later views and farther surfaces look alike, so that the mean over the views is
# what all ranges have in common.
SWEEP_SIGMAS = {"delays": 0.015, "stretches": 0.05}
# Of the brightness behind another surface, between the views: less does not matter, or is noise.
MIN_SHADING, SHADING_SIGMAS = 0.1, 3.0
# Of conjugate gradients. Smooth changes of amplitude, which matter for a derivative, converge first,
# and those of the last step are nearly right.
ELIMINATION_ITERATIONS, FURTHER_ELIMINATION_ITERATIONS = 12, 4
# What the prior takes from amplitudes is as fine as they are. After 6 the ranges of a wall behind
# wires were 0.009 mm too near, without noise and with the model exact; after 15, 0.0005 mm.
FREE_ITERATIONS, FURTHER_FREE_ITERATIONS, MOVED_FREE_ITERATIONS = 15, 6, 3
RIDGE = 1e-6  # of each unknown's own information: for what the shot says nothing about


@dataclass(frozen=True)
class Refinement:
    """What a Gauss-Newton step knows."""

    # of each surface's coefficients; everything else that was solved for is unknown
    covariances: list[FloatArray]
    amplitude: Image  # (points,), after the step
    # (6, points), changes of amplitude that look like a change of each coefficient of a quadratic
    explained: Image
    steps: int  # taken, with this one
    # after the step: half the weighted squared misfit that amplitudes cannot explain, and what is
    # known of surfaces and sweep beforehand
    objective: float
    # (points,), amplitudes that explain this shot best without the prior, if it is this shot's step
    free: Image | None


def refine_state(
    model: SurfaceModel, amplitude: Image, earlier: Refinement | None = None
) -> Refinement:
    """Take a Gauss-Newton step on ranges, gains, pulse widths and, from the second step on, delays
    and stretches, if it lowers the misfit that amplitudes cannot explain.

    What amplitudes can explain of views that are all late is an unknown of its own: taken for what
    only late views explain, it would make steps too short and ranges surer than they are.

    The covariance is ``H^-1 S H^-1`` with the information H of the data and the sum S of squares of
    the score over clusters of measurements (H. White, Econometrica 50, 1, 1982): it holds the noise that
    the misfit has, also where misfits of neighbouring measurements depend on each other, and what the
    step itself takes from them (`NormalEquations.sum_squared_scores`).

    `model`: moved in place. The mean gain stays, and so does the mean brightness behind a surface;
    `amplitude` (points,); `earlier`: the step before this one, which saves work.
    """
    state = model.state
    error = model.image - model.render(amplitude)
    # As long as ranges are off by much, views that are late would take a part of it: ranges go first.
    groups = [
        group
        for group in iterate_derivatives(model, amplitude)
        if earlier is not None or group.names[0][0] not in SWEEP_SIGMAS
    ]
    # The prior leaves amplitudes a little too even. That looks like views that are late, but not once
    # amplitudes have explained what they can.
    scale = scale_amplitude(model, amplitude > 0)
    excess = np.zeros_like(amplitude)
    iterations = FREE_ITERATIONS
    if earlier is not None and earlier.free is not None:
        excess = np.where(scale > 0, earlier.free - amplitude, np.float32(0))
        iterations = FURTHER_FREE_ITERATIONS
    excess, rest = _explain_rest(model, error, excess, scale, iterations)
    groups = _leave_out_even_shading(model, groups, rest)
    changes, patterns = _eliminate_amplitude(
        model, scale, groups, None if earlier is None else earlier.explained
    )
    groups += patterns
    names = [name for group in groups for name in group.names]
    equations = multiply_derivatives(groups, model.weights, rest, error)
    bending, moment = _bend(model, names)
    for index, (name, _, view) in enumerate(names):
        if name in SWEEP_SIGMAS:
            bending[index, index] = 1 / SWEEP_SIGMAS[name] ** 2
            moment[index] = getattr(state, name)[view] / SWEEP_SIGMAS[name] ** 2
    unit = np.sqrt(np.diag(equations.normal)) + TINY
    whole = (equations.normal + bending) / np.outer(unit, unit) + RIDGE * np.eye(unit.size)
    inverse = np.linalg.inv(whole) / np.outer(unit, unit)
    change = inverse @ (equations.slope - moment)
    # with as many iterations as after the step, so that these alone do not make it a good one
    settled, left = _explain_rest(model, error, excess, scale, MOVED_FREE_ITERATIONS)
    before, step = _objective(model, left), 1.0
    objective, moved, free = before, amplitude, amplitude + settled
    # A step that is far too long may overflow: it is refused like others that lower nothing.
    with np.errstate(over="ignore", invalid="ignore"):
        while step >= SMALLEST_STEP:
            ahead = _move(state, names, step * change)
            # the mean gain is the amplitudes' unit, and so is the mean brightness behind a surface
            brighter = ahead.gains.mean() / state.gains.mean()
            ahead.gains /= brighter
            moved = amplitude.copy()
            for surface, part in enumerate(model.parts):
                own = [i for i, name in enumerate(names) if name[:2] == ("coefficients", surface)]
                first = change[names.index(("patterns", surface, 0))]
                _, quadratic = model.bases[surface].split_quadratic()
                along = -quadratic @ change[own]
                along[0] += first
                moved[part] += (step * along).astype(np.float32) @ changes[:, part]
            moved = np.float32(brighter) * np.maximum(moved, 0)
            shading = ahead.shading.mean(axis=1)
            ahead.shading -= shading[:, np.newaxis]
            moved *= np.where(model.behind, np.exp(shading)[model.surface], 1).astype(np.float32)
            model.place(ahead)
            error = model.image - model.render(moved)
            settled, left = _explain_rest(model, error, excess, scale, MOVED_FREE_ITERATIONS)
            objective = _objective(model, left)
            if objective < before:
                free = moved + settled
                break
            step /= 2
        else:
            model.place(state)
            objective, moved = before, amplitude
    robust = inverse @ (equations.sum_squared_scores(inverse) + bending) @ inverse
    steps = 1 if earlier is None else earlier.steps + 1
    numbers = np.array([one if name == "coefficients" else -1 for name, one, _ in names])
    blocks = [np.flatnonzero(numbers == surface) for surface in range(len(model.masks))]
    covariances = [robust[block][:, block] for block in blocks]
    return Refinement(covariances, moved, changes, steps, objective, free)


def _explain_rest(
    model: SurfaceModel, error: Image, change: Image, scale: Image, iterations: int
) -> tuple[Image, Image]:
    """The change of amplitude that explains a misfit best, begun at `change`, and what is left."""
    if change.any():
        error = error - model.render(change)
    further = explain_by_amplitude(model, error, scale, iterations)
    return change + further, error - model.render(further)


def _leave_out_even_shading(
    model: SurfaceModel, groups: list[Derivatives], rest: Image
) -> list[Derivatives]:
    """Leave out the shading of surfaces whose hidden points all views see alike, as behind a rim.

    A surface that has been found to be shaded before stays so.
    """
    # what each view would make of them alone; views hardly share measurements
    information = np.zeros(model.state.shading.shape)
    shading = model.state.shading.copy()
    known = shading.any(axis=1)
    for group in groups:
        height, width = group.images.shape[1:]
        area = np.s_[group.row : group.row + height, group.column : group.column + width]
        for (name, surface, view), image in zip(group.names, group.images, strict=True):
            if name == "shading":
                weighted = model.weights[area] * image
                information[surface, view] = np.sum(weighted * image, dtype=np.float64)
                pull = float(np.sum(weighted * rest[area], dtype=np.float64))
                shading[surface, view] += pull / max(information[surface, view], TINY)
    shading -= shading.mean(axis=1, keepdims=True)
    variance = float(np.average(rest**2 * model.weights, weights=model.weights > 0))
    gain = np.mean(information * shading**2, axis=1)
    shaded = (np.std(shading, axis=1) > MIN_SHADING) & (gain > SHADING_SIGMAS**2 * variance)
    shaded |= known
    model.behind = model.behind & shaded[model.surface]
    left = []
    for group in groups:
        own = [
            i for i, (name, one, _) in enumerate(group.names) if name != "shading" or shaded[one]
        ]
        if len(own) < len(group.names):
            names = [group.names[i] for i in own]
            group = group._replace(names=names, images=group.images[own])
        left.append(group)
    return left


def _eliminate_amplitude(
    model: SurfaceModel, scale: Image, groups: list[Derivatives], start: Image | None
) -> tuple[Image, list[Derivatives]]:
    """Take from derivatives by coefficients, in place, what amplitudes can explain of them.

    What is left of a derivative J is ``J - A x`` with the x that minimises its weighted norm, found
    by conjugate gradients; a step on a coefficient takes x of the amplitude with it. Of different
    surfaces, which hardly share measurements, the derivatives of one number are treated at once.
    Splines bend less than amplitudes could follow, but what of them is a quadratic does not.

    Returns `changes` (6, points): x for each coefficient of a quadratic; `patterns`: by the first
    of these changes of each surface's amplitude: it is what amplitudes can explain of views that
    are all late.
    """
    own = [group for group in groups if group.names[0][0] == "coefficients"]
    parts = [model.parts[group.names[0][1]] for group in own]
    shares = [model.bases[group.names[0][1]].split_quadratic() for group in own]
    changes = np.zeros((COEFFICIENTS, model.surface.size), np.float32)
    iterations = ELIMINATION_ITERATIONS
    if start is not None:
        changes[:, scale > 0] = start[:, scale > 0]
        iterations = FURTHER_ELIMINATION_ITERATIONS
    for number, change in enumerate(changes):
        image = np.zeros_like(model.image)
        for group, (functions, _) in zip(own, shares, strict=True):
            derivative = np.tensordot(functions[:, number].astype(np.float32), group.images, 1)
            image[group.row : group.row + group.images.shape[1]] += derivative
        if start is not None:
            image -= model.render(change)
        change += explain_by_amplitude(model, image, scale, iterations)
    patterns = []
    for group, part, (_, quadratic) in zip(own, parts, shares, strict=True):
        rows = group.row, group.row + group.images.shape[1]
        explained = np.stack([model.render_part(change[part], part, rows) for change in changes])
        group.images[...] -= np.tensordot(quadratic.T.astype(np.float32), explained, 1)
        patterns.append(
            Derivatives([("patterns", group.names[0][1], 0)], group.row, 0, explained[:1])
        )
    return changes, patterns


def _objective(model: SurfaceModel, rest: Image) -> float:
    """Half the squared misfit that is left, and what is known of surfaces and sweep beforehand."""
    bent = sum(
        float(c @ basis.bending @ c) / 2
        for basis, c in zip(model.bases, model.state.coefficients, strict=True)
    )
    swept = sum(
        float(np.sum(getattr(model.state, name) ** 2)) / (2 * sigma**2)
        for name, sigma in SWEEP_SIGMAS.items()
    )
    misfit = float(np.sum(model.weights * rest**2, dtype=np.float64)) / 2
    return misfit + bent + swept


def _bend(model: SurfaceModel, names: list[tuple[str, int, int]]) -> tuple[FloatArray, FloatArray]:
    """Second and first derivative of the surfaces' bending by all unknowns."""
    second, first = np.zeros((len(names), len(names))), np.zeros(len(names))
    for surface, (basis, c) in enumerate(zip(model.bases, model.state.coefficients, strict=True)):
        own = [
            i for i, (name, one, _) in enumerate(names) if (name, one) == ("coefficients", surface)
        ]
        second[np.ix_(own, own)] = basis.bending
        first[own] = basis.bending @ c
    return second, first


def _move(
    state: SurfaceState, names: list[tuple[str, int, int]], change: FloatArray
) -> SurfaceState:
    """The state after a step; gains and widths change relatively."""
    moved = state.copy()
    for (name, surface, number), value in zip(names, change, strict=True):
        if name == "patterns":
            continue
        values = getattr(moved, name)
        if name in ("coefficients", "shading"):
            values = values[surface]
        values[number] += value * (values[number] if name in ("gains", "widths") else 1.0)
    return moved
