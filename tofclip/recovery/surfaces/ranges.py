"""Solving for ranges, and for what is uncertain of the instrument, by Gauss-Newton steps.

A step on everything but the amplitudes (`refine_state`) goes in four: what amplitudes leave of the
misfit, the derivatives J with what amplitudes explain taken off, the normal equations, and the step's
length. Unknowns are named by the field of `SurfaceState`, the number of the surface or 0, and that of
the entry. W are the weights of the measurements, A is the model (`SurfaceModel`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.recovery.surfaces.amplitudes import TINY, explain_by_amplitude, scale_amplitude
from tofclip.recovery.surfaces.model import SurfaceModel, SurfaceState
from tofclip.recovery.surfaces.patches import COEFFICIENTS, FloatArray
from tofclip.recovery.surfaces.pulse import Image, differentiate_pulse
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other
LEAST_VARIANCE = 1e-12  # of the largest one
MAX_LEVERAGE = 0.9  # of a cluster: what it alone determines, its misfit says nothing about
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


class Derivatives(NamedTuple):
    """Derivatives of the streak image by some unknowns, on the part of it that they change."""

    names: list[tuple[str, int, int]]
    row: int  # of the part's corner
    column: int  # of the part's corner
    images: Image  # (unknowns, rows, columns)


def iterate_derivatives(model: SurfaceModel, amplitude: Image) -> Iterator[Derivatives]:
    """Yield the image's derivatives by the unknowns of the state, each view's and surface's. The
    reference view keeps its delay and stretch: time zero is its own. Derivatives by gains and
    widths are by their logarithms.
    """
    views = range(model.camera.views)
    others = [view for view in views if view != model.reference]
    surfaces = range(len(model.masks))
    yield from map_parallel(lambda view: _differentiate_view(model, view, amplitude), views)
    yield from map_parallel(lambda view: _differentiate_sweep(model, view, amplitude), others)
    yield from map_parallel(lambda k: _differentiate_surface(model, k, amplitude), surfaces)


def _differentiate_view(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    kernel, (own, slit) = model.kernels[view], model.overlap(view)
    wider = (model.make_kernel(view, 1 + WIDTH_STEP) - kernel) / np.float32(WIDTH_STEP)
    unknowns = [("gains", 0, view), ("widths", 0, view)]
    projected = [model.project(view, amplitude, one) for one in (kernel, wider)]
    for surface in np.unique(model.surface[model.behind]):
        chosen = model.behind & (model.surface == surface)
        unknowns.append(("shading", int(surface), view))
        projected.append(model.project(view, amplitude * chosen, kernel))
    stacked = np.stack(projected)[:, :, own] * np.float32(model.state.gains[view])
    return Derivatives(unknowns, 0, slit.start, stacked)


def _differentiate_sweep(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    """By delay and stretch at a view's centre, which the views beside it feel as well."""
    total = np.zeros((2, *model.image.shape), np.float32)
    first, last = total.shape[2], 1
    for other, place in enumerate(model.footprints):
        weight = place.between.weigh_centre(view)
        if not weight.any():
            continue
        slope = differentiate_pulse(model.kernels[other]) * np.float32(model.state.gains[other])
        light = amplitude * weight
        own, slit = model.overlap(other)
        for image, one in zip(total, (light, light * model.measure_height(place.row)), strict=True):
            image[:, slit] += model.project(other, one.astype(np.float32), slope)[:, own]
        first, last = min(first, slit.start), max(last, slit.stop)
    first = min(first, last - 1)
    unknowns = [("delays", 0, view), ("stretches", 0, view)]
    return Derivatives(unknowns, 0, first, total[:, :, first:last])


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
        for image, light in zip(images, lights, strict=True):
            image[:, slit] += model.project(view, light, slope, part, (first, last))[:, own]
    names = [("coefficients", surface, number) for number in range(len(lights))]
    return Derivatives(names, first, 0, images)


class ClusterProducts(NamedTuple):
    """What a part of the image says of the unknowns that change it."""

    own: NDArray[np.intp]  # (n,), numbers of these unknowns
    normal: Image  # (n, n), J'WJ of the part
    score: Image  # (n,), J'W of its misfit


class NormalEquations(NamedTuple):
    """What a Gauss-Newton step is made of."""

    normal: FloatArray  # (unknowns, unknowns), J'WJ
    slope: FloatArray  # (unknowns,), J'W of what is to be explained
    clusters: list[ClusterProducts]  # what each part of the image adds to them

    def sum_squared_scores(self, inverse: FloatArray) -> FloatArray:
        """Return the sum of squares of the clusters' scores, (unknowns, unknowns), as they were before
        the step; `inverse`: of the normal matrix.

        A step explains a part of each cluster's misfit, the more the fewer clusters there are, and what
        is left is too little. With the leverage h of a cluster, ``1 - h`` of its variance is left
        (R. Bell and D. McCaffrey, Surv. Methodol. 28, 169, 2002).
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
    """Return F with ``F F' = C``, and its inverse. Products in float32 may leave a covariance with
    a variance of zero or below along directions that a shot says nothing about, where no Cholesky
    factor is. There it is taken for very small.
    """
    unit = np.sqrt(np.maximum(np.abs(np.diag(covariance)), np.finfo(np.float64).tiny))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    deviations = np.sqrt(np.maximum(variances, LEAST_VARIANCE * variances.max()))
    return unit[:, np.newaxis] * axes * deviations, (axes / deviations).T / unit


def multiply_derivatives(
    groups: list[Derivatives], weights: Image, rest: Image, error: Image
) -> NormalEquations:
    """Return the products of all derivatives with each other, with the misfit that a step is to
    explain and with the one of the clusters' scores. Cluster by cluster: what is on one stays in
    cache, and most derivatives are on few.
    """
    ends = np.cumsum([0] + [len(group.names) for group in groups])
    normal, slope = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    clusters = []
    for top in range(0, weights.shape[0], CLUSTER_ROWS):
        for left in range(0, weights.shape[1], CLUSTER_COLUMNS):
            area = np.s_[top : top + CLUSTER_ROWS, left : left + CLUSTER_COLUMNS]
            own, parts = [], []
            for group, first, last in zip(groups, ends[:-1], ends[1:], strict=True):
                part = _cut_out(group, top, left, weights[area].shape)
                if part is not None:
                    own.append(np.arange(first, last))
                    parts.append(part)
            if not own:
                continue
            numbers, images = np.concatenate(own), np.concatenate(parts)
            weighted: Image = images * weights[area].ravel()
            product: Image = weighted @ images.T
            score: Image = weighted @ error[area].ravel()
            normal[np.ix_(numbers, numbers)] += product
            slope[numbers] += weighted @ rest[area].ravel()
            clusters.append(ClusterProducts(numbers, product, score))
    return NormalEquations(normal, slope, clusters)


def _cut_out(group: Derivatives, top: int, left: int, shape: tuple[int, ...]) -> Image | None:
    """Derivatives on a part of the image, (n, pixels); None where they change nothing."""
    row, column = group.row - top, group.column - left
    here = group.images[
        :, max(-row, 0) : max(shape[0] - row, 0), max(-column, 0) : max(shape[1] - column, 0)
    ]
    if not here.any():
        return None
    row, column = max(row, 0), max(column, 0)
    part = np.zeros((here.shape[0], *shape), np.float32)
    part[:, row : row + here.shape[1], column : column + here.shape[2]] = here
    return part.reshape(here.shape[0], -1)


@dataclass(frozen=True)
class Refinement:
    """What a Gauss-Newton step knows."""

    # of each surface's coefficients; everything else that was solved for is unknown
    covariances: list[FloatArray]
    amplitude: Image  # after the step
    # (6, points), changes of amplitude that look like a change of each coefficient of a quadratic
    explained: Image
    steps: int  # taken, with this one
    # after the step: half the weighted squared misfit that amplitudes cannot explain, and what is
    # known of surfaces and sweep beforehand
    objective: float
    # amplitudes that explain this shot best without the prior, if it is this shot's step
    free: Image | None


def refine_state(
    model: SurfaceModel, amplitude: Image, earlier: Refinement | None = None
) -> Refinement:
    """Take a Gauss-Newton step on ranges, gains, pulse widths and, from the second step on, delays
    and stretches, if it lowers the misfit that amplitudes cannot explain. The model is moved in
    place; the mean gain stays, and so does the mean brightness behind a surface. What the step
    before this one (`earlier`) knew saves work.
    """
    error = model.image - model.render(amplitude)
    scale = scale_amplitude(model, amplitude > 0)

    # 1. The prior leaves amplitudes a little too even. That looks like views that are late, but not
    # once amplitudes have explained what they can.
    excess, iterations = np.zeros_like(amplitude), FREE_ITERATIONS
    if earlier is not None and earlier.free is not None:
        excess = np.where(scale > 0, earlier.free - amplitude, np.float32(0))
        iterations = FURTHER_FREE_ITERATIONS
    excess, rest = _explain_rest(model, error, excess, scale, iterations)

    # 2. As long as ranges are off by much, late views would take a part of it: ranges go first.
    groups = [
        group
        for group in iterate_derivatives(model, amplitude)
        if earlier is not None or group.names[0][0] not in SWEEP_SIGMAS
    ]
    groups = _leave_out_even_shading(model, groups, rest)
    start = None if earlier is None else earlier.explained
    changes, patterns = _eliminate_amplitude(model, scale, groups, start)
    groups += patterns

    # 3. The covariance is ``H^-1 S H^-1`` with the information H of the data and the sum S of squares
    # of the score over clusters of measurements (H. White, Econometrica 50, 1, 1982): it holds the
    # noise that the misfit has, also where misfits of neighbouring measurements depend on each other.
    names = [name for group in groups for name in group.names]
    equations = multiply_derivatives(groups, model.weights, rest, error)
    second, first = _differentiate_priors(model, names)
    unit = np.sqrt(np.diag(equations.normal)) + TINY
    whole = (equations.normal + second) / np.outer(unit, unit) + RIDGE * np.eye(unit.size)
    inverse = np.linalg.inv(whole) / np.outer(unit, unit)
    robust = inverse @ (equations.sum_squared_scores(inverse) + second) @ inverse
    change = inverse @ (equations.slope - first)

    # 4. With as many iterations before the step as after it, so that these alone do not make it good.
    # A step that is far too long may overflow: it is refused like others that lower nothing.
    state, step = model.state, 1.0
    settled, left = _explain_rest(model, error, excess, scale, MOVED_FREE_ITERATIONS)
    before = objective = _compute_objective(model, left)
    moved, free = amplitude, amplitude + settled
    with np.errstate(over="ignore", invalid="ignore"):
        while step >= SMALLEST_STEP:
            ahead = _move(model, state, amplitude, names, step * change, changes)
            error = model.image - model.render(ahead)
            settled, left = _explain_rest(model, error, excess, scale, MOVED_FREE_ITERATIONS)
            objective = _compute_objective(model, left)
            if objective < before:
                moved, free = ahead, ahead + settled
                break
            step /= 2
        else:
            model.place(state)
            objective = before
    numbers = np.array([one if name == "coefficients" else -1 for name, one, _ in names])
    own = [np.ix_(numbers == surface, numbers == surface) for surface in range(len(model.masks))]
    covariances = [robust[block] for block in own]
    steps = 1 if earlier is None else earlier.steps + 1
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
    """Leave out the shading of surfaces whose hidden points all views see alike, as behind a rim. A
    surface that has been found to be shaded before stays so.
    """
    # what each view would make of them alone; views hardly share measurements
    information, shading = np.zeros(model.state.shading.shape), model.state.shading.copy()
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
            n for n, (name, one, _) in enumerate(group.names) if name != "shading" or shaded[one]
        ]
        names = [group.names[number] for number in own]
        left.append(group._replace(names=names, images=group.images[own]))
    return left


def _eliminate_amplitude(
    model: SurfaceModel, scale: Image, groups: list[Derivatives], start: Image | None
) -> tuple[Image, list[Derivatives]]:
    """Take from derivatives by coefficients, in place, what amplitudes can explain of them.

    What is left of a derivative J is ``J - A x`` with the x that minimises its weighted norm, found
    by conjugate gradients; a step on a coefficient takes x of the amplitude with it. Of different
    surfaces, which hardly share measurements, the derivatives of one number are treated at once.
    Splines bend less than amplitudes could follow, but what of them is a quadratic does not.

    Returns `changes` (6, points): x for each coefficient of a quadratic; and derivatives by the first
    of these changes of each surface's amplitude, ("patterns", surface, 0): what amplitudes can explain
    of views that are all late is an unknown of its own. Taken for what only late views explain, it
    would make steps too short and ranges surer than they are.
    """
    own = [group for group in groups if group.names[0][0] == "coefficients"]
    surfaces = [group.names[0][1] for group in own]
    shares = [model.bases[surface].split_quadratic() for surface in surfaces]
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
    for group, surface, (_, quadratic) in zip(own, surfaces, shares, strict=True):
        part, rows = model.parts[surface], (group.row, group.row + group.images.shape[1])
        explained = np.stack([model.render(change[part], part, rows) for change in changes])
        group.images[...] -= np.tensordot(quadratic.T.astype(np.float32), explained, 1)
        patterns.append(Derivatives([("patterns", surface, 0)], group.row, 0, explained[:1]))
    return changes, patterns


def _compute_objective(model: SurfaceModel, rest: Image) -> float:
    """Half the squared misfit that is left, and what is known of surfaces and sweep beforehand."""
    state = model.state
    bases = zip(model.bases, state.coefficients, strict=True)
    bent = sum(float(c @ basis.bending @ c) for basis, c in bases)
    swept = sum(
        float(np.sum(getattr(state, name) ** 2)) / sigma**2 for name, sigma in SWEEP_SIGMAS.items()
    )
    return (float(np.sum(model.weights * rest**2, dtype=np.float64)) + bent + swept) / 2


def _differentiate_priors(
    model: SurfaceModel, names: list[tuple[str, int, int]]
) -> tuple[FloatArray, FloatArray]:
    """Second and first derivative of what is known of bending and sweep beforehand."""
    second, first = np.zeros((len(names), len(names))), np.zeros(len(names))
    for index, (name, surface, number) in enumerate(names):
        if name == "coefficients":
            bending = model.bases[surface].bending[number]
            own = index - number + np.arange(bending.size)
            second[index, own] = bending
            first[index] = bending @ model.state.coefficients[surface]
        elif name in SWEEP_SIGMAS:
            second[index, index] = 1 / SWEEP_SIGMAS[name] ** 2
            first[index] = getattr(model.state, name)[number] / SWEEP_SIGMAS[name] ** 2
    return second, first


def _move(
    model: SurfaceModel,
    state: SurfaceState,
    amplitude: Image,
    names: list[tuple[str, int, int]],
    change: FloatArray,
    changes: Image,
) -> Image:
    """Place the model where a step leads from a state; return the amplitudes that go along."""
    moved, ahead = state.copy(), amplitude.copy()
    for (name, surface, number), value in zip(names, change, strict=True):
        if name != "patterns":
            values = getattr(moved, name)
            values = values[surface] if name in ("coefficients", "shading") else values
            # gains and widths change relatively
            values[number] += value * (values[number] if name in ("gains", "widths") else 1.0)
    for surface, part in enumerate(model.parts):
        own = [i for i, name in enumerate(names) if name[:2] == ("coefficients", surface)]
        _, quadratic = model.bases[surface].split_quadratic()
        along = -quadratic @ change[own]
        along[0] += change[names.index(("patterns", surface, 0))]
        ahead[part] += along.astype(np.float32) @ changes[:, part]
    # the mean gain is the amplitudes' unit, and so is the mean brightness behind a surface
    brighter, shading = moved.gains.mean() / state.gains.mean(), moved.shading.mean(axis=1)
    moved.gains /= brighter
    moved.shading -= shading[:, np.newaxis]
    ahead = np.float32(brighter) * np.maximum(ahead, 0)
    ahead *= np.where(model.behind, np.exp(shading)[model.surface], 1).astype(np.float32)
    model.place(moved)
    return ahead
