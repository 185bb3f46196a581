"""Solving for ranges, and for what is uncertain of the instrument, by Gauss-Newton steps.

A step on everything but the amplitudes (`refine_state`) goes in four: what amplitudes leave of the
misfit, the derivatives J with what amplitudes explain taken off, the normal equations, and the step's
length. Unknowns are named by the field of `SurfaceState`, the number of the surface or 0, and that of
the entry. W are the weights of the measurements, A is the model (`SurfaceModel`).
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.camera.model import interpolate_linearly
from tofclip.recovery.surfaces.amplitudes import (
    AmplitudeSolver,
    Tick,
    explain_by_amplitude,
    scale_amplitude,
    share_misfit,
)
from tofclip.recovery.surfaces.model import SurfaceModel, Window
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.pulse import TINY, Image, differentiate_pulse
from tofclip.recovery.surfaces.shapes import ROUND_COEFFICIENTS, Pixels, QuadricBasis
from tofclip.units import SPEED_OF_LIGHT

WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other
LEAST_VARIANCE = 1e-12  # of the largest one
MAX_LEVERAGE = 0.9  # of a cluster: what it alone determines, its misfit says nothing about
# Parts of a Gauss-Newton step that are tried until it lowers half the squared misfit, or raises it by so
# little that it says nothing; how often; and what part of the most that a surface loses shortens its step.
PARTS, SAYS_NOTHING, TRIES, SHORTENING_LOSS = (1, 1 / 4, 1 / 16, 0), 1.0, 6, 0.1
# Rows by which each view's part of a sweep that was found from the shot is off: root mean squares of
# scenes by a forward model of their own (0.015 and 0.05 in the demonstration). Later views and farther
# surfaces look alike, so that the mean over the views is what all ranges have in common.
SWEEP_SIGMAS = {"delays": 0.1, "stretches": 0.3}
KNOWN_SIGMAS = {**SWEEP_SIGMAS, "borders": 1.0}  # where pictures end nothing but the shot tells
# Of a sweep that little light shows, its prior takes a part of the correction, and ranges take it on:
# how much the prior is believed there, and how many times of that a range is off. Walls and balls of
# 200 photons are off by 1 to 4 times, of 2000 photons by less than what the covariance says.
SWEEP_DOUBT, PULL_SIGMAS = 0.1, 2.0
# Pixels by which a centre that was found from frames is off, and by which all together may displace
# the picture: no shot shows that, and it stays where the calibration has it.
CENTRE_SIGMA_PX, DISPLACEMENT_SIGMA_PX = 0.3, 1e-3
# Of the brightness behind another surface, between the views: less does not matter, or is noise.
MIN_SHADING, SHADING_SIGMAS = 0.1, 3.0
MOST_SHADING = 3.0  # steps on what has hardly any light may lead anywhere
# Of conjugate gradients. Smooth changes of amplitude, which matter for a derivative, converge first,
# and those of the last step are nearly right.
ELIMINATION_ITERATIONS, FURTHER_ELIMINATION_ITERATIONS = 6, 2
# What the prior takes from amplitudes is as fine as they are. After 6 the ranges of a wall behind
# wires were 0.009 mm too near, without noise and with the model exact; after 15, 0.0005 mm.
FREE_ITERATIONS, FURTHER_FREE_ITERATIONS, MOVED_FREE_ITERATIONS = 15, 6, 3
# By which the middle of a part of a pixel is off from where `fill_partly` puts it, root mean square.
LEFT_ASIDE_PX = 0.2

Unknown = tuple[str, int, int]
RIDGE = 1e-6  # of each unknown's own information: for what the shot says nothing about


@dataclass(frozen=True)
class Derivatives(Window):
    """Derivatives of the streak image by some unknowns on a part of it: whole clusters, which no
    other part with the same unknowns shares.
    """

    names: list[Unknown]  # one for each image


def iterate_derivatives(
    model: SurfaceModel, amplitude: Image, instrument: bool = True
) -> Iterator[Derivatives]:
    """Yield the image's derivatives by the unknowns of the state, each view's and surface's, part by
    part. The reference view keeps its delay and stretch: time zero is its own. Derivatives by gains
    and widths are by their logarithms. `instrument`: by what is uncertain of it as well.
    """
    views = range(model.camera.views)
    others = [view for view in views if view != model.reference]
    surfaces = range(len(model.masks))
    works = [
        (_differentiate_view, views),
        (_differentiate_sweep, others),
        (_differentiate_borders, range(1)),
        (_differentiate_surface, surfaces),
    ]
    for work, numbers in works if instrument else works[-1:]:
        parts = model.map(partial(work, model, amplitude), numbers)
        yield from itertools.chain.from_iterable(parts)


def _join_windows(
    model: SurfaceModel, names: list[Unknown], windows: Sequence[Window]
) -> Iterator[Derivatives]:
    """Yield derivatives by some unknowns as windows show them, an image for each: on whole clusters, and
    windows that share one as one part.
    """
    rows, columns = model.image.shape
    boxes: list[tuple[int, int, int, int, list[Window]]] = []
    for window in windows:
        if not window.images.size:
            continue
        (top, bottom), (left, right) = (
            (area.start // side * side, min(-(-area.stop // side) * side, size))
            for area, side, size in zip(
                window.area, (CLUSTER_ROWS, CLUSTER_COLUMNS), (rows, columns), strict=True
            )
        )
        held, apart = [window], []
        # a box that grows may meet others that were apart
        while True:
            for box in boxes:
                if box[0] < bottom and top < box[1] and box[2] < right and left < box[3]:
                    top, bottom = min(top, box[0]), max(bottom, box[1])
                    left, right = min(left, box[2]), max(right, box[3])
                    held += box[4]
                else:
                    apart.append(box)
            if len(apart) == len(boxes):
                break
            boxes, apart = apart, []
        boxes = [*apart, (top, bottom, left, right, held)]
    if not boxes:  # nothing of it falls on the slit
        yield Derivatives(0, 0, np.zeros((len(names), 0, 0), np.float32), names)
    for top, bottom, left, right, held in boxes:
        images = np.zeros((len(names), bottom - top, right - left), np.float32)
        for window in held:
            _, height, width = window.images.shape
            row, column = window.row - top, window.column - left
            images[:, row : row + height, column : column + width] += window.images
        yield Derivatives(top, left, images, names)


def _differentiate_view(model: SurfaceModel, amplitude: Image, view: int) -> list[Derivatives]:
    kernel = model.kernels[view]
    wider = (model.make_kernel(view, 1 + WIDTH_STEP) - kernel) / np.float32(WIDTH_STEP)
    seen, widened = (model.receive(view, amplitude, one) for one in (kernel, wider))
    beside = -np.gradient(seen.images, axis=2) if seen.images.size else seen.images
    images = np.concatenate([seen.images, widened.images, beside])
    names: list[Unknown] = [(name, 0, view) for name in ("gains", "widths", "centres")]
    found = [*_join_windows(model, names, [replace(seen, images=images)])]
    for surface in np.unique(model.surface[model.behind]):
        part = model.parts[surface]
        hidden = model.receive(view, amplitude[part] * model.behind[part], kernel, part)
        found += _join_windows(model, [("shading", int(surface), view)], [hidden])
    return found


def _differentiate_sweep(model: SurfaceModel, amplitude: Image, view: int) -> list[Derivatives]:
    """By delay and stretch at a view's centre, which the views beside it feel as well."""
    windows, centres = [], model.camera.centres_px
    for other, place in enumerate(model.footprints):
        weight = interpolate_linearly(place.slit, centres, np.eye(centres.size)[view])
        if not weight.any():
            continue
        light = amplitude * weight
        lights = np.array([light, light * place.height], np.float32)
        windows.append(model.receive(other, lights, differentiate_pulse(model.kernels[other])))
    return [*_join_windows(model, [("delays", 0, view), ("stretches", 0, view)], windows)]


def _differentiate_borders(model: SurfaceModel, amplitude: Image, _: int) -> list[Derivatives]:
    """What a view sees further comes half a pixel beyond its outer columns' middles."""
    windows = []
    right = model.column[model.outer] > 0
    for view, kernel in enumerate(model.kernels):
        lights = np.zeros((2, amplitude.size), np.float32)
        lights[right.astype(int), model.outer] = amplitude[model.outer] * model.excess[view]
        seen = model.receive(view, lights, kernel)
        image = seen.images.sum(axis=0) / 2
        image[:, :-1] += seen.images[0, :, 1:] / 2
        image[:, 1:] += seen.images[1, :, :-1] / 2
        windows.append(replace(seen, images=image[np.newaxis]))
    return [*_join_windows(model, [("borders", 0, 0)], windows)]


def _differentiate_surface(
    model: SurfaceModel, amplitude: Image, surface: int
) -> list[Derivatives]:
    part, derivatives = model.parts[surface], model.derivatives[surface]
    there = 2 * model.distance[part] / SPEED_OF_LIGHT + model.camera.time_zero
    rows_per_metre = 2 / SPEED_OF_LIGHT / np.interp(there, model.times, np.gradient(model.times))
    # range = length / inverse depth
    by_inverse = -(model.distance[part] ** 2) / model.ray_length[part] * rows_per_metre
    in_range = (amplitude[part] * by_inverse)[:, np.newaxis] * derivatives
    lights = np.ascontiguousarray(in_range.T, np.float32)
    windows = []
    for view, place in enumerate(model.footprints):
        slope = differentiate_pulse(model.kernels[view]) * np.float32(place.rows_per_instant)
        windows.append(model.receive(view, lights, slope, part))
    names = [("coefficients", surface, number) for number in range(len(lights))]
    return [*_join_windows(model, names, windows)]


class Cluster(NamedTuple):
    """What some neighbouring measurements say of the unknowns."""

    numbers: NDArray[np.intp]  # (n,), of the unknowns that they say anything of
    information: Image  # (n, n), J'WJ
    score: Image  # (n,), J'W of the misfit as it was before the step


@dataclass(frozen=True)
class NormalEquations:
    """What a Gauss-Newton step is made of: products of all derivatives with each other and with the
    misfit that a step is to explain. Cluster by cluster: what is on one stays in cache, and most
    derivatives are on few.
    """

    names: list[Unknown]
    normal: FloatArray  # (unknowns, unknowns), J'WJ
    slope: FloatArray  # (unknowns,), J'W of what is to be explained
    clusters: list[Cluster]

    @classmethod
    def multiply(
        cls, groups: list[Derivatives], weights: Image, rest: Image, error: Image
    ) -> NormalEquations:
        """Multiply derivatives with each other, with what is to be explained, `rest`, and with the misfit
        as it was, `error`.
        """
        names = list(dict.fromkeys(name for group in groups for name in group.names))
        number = {name: place for place, name in enumerate(names)}
        sides = CLUSTER_ROWS, CLUSTER_COLUMNS
        parts: dict[tuple[int, int], list[tuple[NDArray[np.intp], Image]]] = {}
        for group in groups:
            own = np.array([number[name] for name in group.names])
            lit = (group.images != 0).any(axis=0)
            for axis, side in enumerate(sides):
                lit = np.logical_or.reduceat(lit, np.arange(0, lit.shape[axis], side), axis)
            for down, right in np.argwhere(lit) * sides:
                part = group.images[:, down : down + CLUSTER_ROWS, right : right + CLUSTER_COLUMNS]
                place = group.row + int(down), group.column + int(right)
                parts.setdefault(place, []).append((own, part))
        normal, slope = np.zeros((len(names), len(names))), np.zeros(len(names))
        clusters, root = [], np.sqrt(weights)
        rest, error = root * rest, root * error
        for (row, column), found in parts.items():
            area = slice(row, row + CLUSTER_ROWS), slice(column, column + CLUSTER_COLUMNS)
            numbers, images = (np.concatenate(one) for one in zip(*found, strict=True))
            images *= root[area]
            images = images.reshape(numbers.size, -1)
            information = images @ images.T
            normal[numbers[:, np.newaxis], numbers] += information
            slope[numbers] += images @ rest[area].ravel()
            clusters.append(Cluster(numbers, information, images @ error[area].ravel()))
        return cls(names, normal, slope, clusters)

    def estimate_covariances(self, inverse: FloatArray, known: FloatArray) -> FloatArray:
        """Return the covariance ``H^-1 S H^-1``, (unknowns, unknowns), right within the blocks of each
        surface's coefficients. S is the sum of squares of the clusters' scores and of what was known
        before; `inverse`: of the normal matrix.

        A step explains a part of each cluster's misfit, the more the fewer clusters there are, and what
        is left is too little. With the leverage h of a cluster, ``1 - h`` of its variance is left
        (R. Bell and D. McCaffrey, Surv. Methodol. 28, 169, 2002), here in each direction of what the
        cluster says of a surface.
        """
        ranges = "coefficients", "patterns"
        surfaces = np.array([number if name in ranges else -1 for name, number, _ in self.names])
        scores = np.zeros((len(self.clusters), self.slope.size))
        # of each surface, which clusters say anything of it, and by which of their own numbers
        informed: dict[int, list[tuple[int, Pixels]]] = {}
        for number, cluster in enumerate(self.clusters):
            scores[number, cluster.numbers] = cluster.score
            owners = surfaces[cluster.numbers]
            for surface in set(owners[owners >= 0].tolist()):
                informed.setdefault(surface, []).append((number, np.flatnonzero(owners == surface)))
        influence, covariance = scores @ inverse, inverse @ known @ inverse
        for surface, found in informed.items():
            part = np.flatnonzero(surfaces == surface)
            factor, inverse_factor = _take_root(inverse[np.ix_(part, part)])
            says = np.array([number for number, _ in found])
            said = np.zeros((says.size, part.size, part.size))
            for information, (number, own) in zip(said, found, strict=True):
                # a cluster may say nothing of some
                place = np.searchsorted(part, self.clusters[number].numbers[own])
                whole = self.clusters[number].information
                information[place[:, np.newaxis], place] = whole[own[:, np.newaxis], own]
            leverage, axes = np.linalg.eigh(factor.T @ said @ factor)
            left = np.sqrt(1 - np.clip(leverage, 0, MAX_LEVERAGE))
            along = influence[np.ix_(says, part)] @ inverse_factor.T
            along = (along[:, np.newaxis] @ axes)[:, 0] / left
            influence[np.ix_(says, part)] = (axes @ along[..., np.newaxis])[..., 0] @ factor.T
            covariance[np.ix_(part, part)] += influence[:, part].T @ influence[:, part]
        return covariance


def _take_root(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F with ``F F' = C``, and its inverse. Products in float32 may leave a covariance with
    a variance of zero or below along directions that a shot says nothing about, where no Cholesky
    factor is. There it is taken for very small.
    """
    unit = np.sqrt(np.maximum(np.abs(np.diag(covariance)), np.finfo(np.float64).tiny))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    deviations = np.sqrt(np.maximum(variances, LEAST_VARIANCE * variances.max()))
    return unit[:, np.newaxis] * axes * deviations, (axes / deviations).T / unit


@dataclass(frozen=True)
class Refinement:
    """What a Gauss-Newton step knows."""

    # of each surface's coefficients; everything else that was solved for is unknown
    covariances: list[FloatArray]
    amplitude: Image  # after the step
    # (9, points), changes of amplitude that look like a change of each coefficient of a quadratic, of
    # which there are six, or of a surface of second order in space
    explained: Image
    steps: int  # taken, with this one
    # after the step: the misfit that amplitudes cannot explain, (rows, columns)
    rest: Image
    # amplitudes that explain this shot best without the prior, if it is this shot's step
    free: Image | None

    def cover(self, model: SurfaceModel) -> Refinement:
        """Return what is known where the same camera sees other points."""
        explained = np.zeros((ROUND_COEFFICIENTS, model.surface.size), np.float32)
        return replace(self, explained=explained, free=None)


def refine_state(
    model: SurfaceModel,
    amplitude: Image,
    earlier: Refinement | None = None,
    robust: bool = False,
    instrument: bool = True,
) -> Refinement:
    """Take a Gauss-Newton step on ranges, gains, pulse widths and, from the second step on, delays
    and stretches, if it lowers the misfit that amplitudes cannot explain. The model is moved in
    place; the mean gain stays, and so does the mean brightness behind a surface. What the step
    before this one (`earlier`) knew saves work. Without the `instrument`, on ranges alone.
    """
    model.fill_partly(amplitude)
    given, model.weights = model.weights, doubt_borders(model, amplitude)
    error = model.image - model.render(amplitude)
    scale = scale_amplitude(model, amplitude > 0)

    # 1. The prior leaves amplitudes a little too even. That looks like views that are late, but not
    # once amplitudes have explained what they can.
    excess, rest, iterations = np.zeros_like(amplitude), error, FREE_ITERATIONS
    if earlier is not None and earlier.free is not None:
        excess = np.where(scale > 0, earlier.free - amplitude, np.float32(0))
        rest, iterations = error - model.render(excess), FURTHER_FREE_ITERATIONS
    change, rest = explain_by_amplitude(model, rest, scale, iterations)
    excess += change

    # 2. As long as ranges are off by much, late views would take a part of it: ranges go first.
    groups = [
        group
        for group in iterate_derivatives(model, amplitude, instrument)
        if (earlier is not None and earlier.steps) or group.names[0][0] not in SWEEP_SIGMAS
    ]
    groups = _leave_out_even_shading(model, groups, rest)
    start = None if earlier is None else earlier.explained
    changes, patterns = _eliminate_amplitude(model, scale, groups, start)
    groups += patterns

    # 3. The covariance is ``H^-1 S H^-1`` with the information H of the data and the sum S of squares
    # of the score over clusters of measurements (H. White, Econometrica 50, 1, 1982): it holds the
    # noise that the misfit has, also where misfits of neighbouring measurements depend on each other.
    equations = NormalEquations.multiply(groups, model.weights, rest, error)
    names = equations.names
    second, first = _differentiate_priors(model, names)
    unit = np.sqrt(np.diag(equations.normal)) + TINY
    whole = (equations.normal + second) / np.outer(unit, unit) + RIDGE * np.eye(unit.size)
    inverse = np.linalg.inv(whole) / np.outer(unit, unit)
    newton = inverse @ (equations.slope - first)
    covariance = inverse
    if robust:
        # of a surface that is dark nothing is known, and not all
        covariance = equations.estimate_covariances(inverse, second + RIDGE * np.diag(unit**2))
        # What a sweep's prior still takes of all ranges, as if most of it were not there
        weaker = (equations.normal + SWEEP_DOUBT * second) / np.outer(unit, unit)
        swept = np.array([name in SWEEP_SIGMAS for name, _, _ in names])
        pull = np.linalg.solve(weaker + RIDGE * np.eye(unit.size), first * swept / unit) / unit
        covariance += PULL_SIGMAS**2 * np.outer(pull, pull)

    # 4. The step's length.
    moved, free, rest = _go_ahead(model, amplitude, (rest, excess, scale), names, newton, changes)
    numbers = np.array([one if name == "coefficients" else -1 for name, one, _ in names])
    own = [np.ix_(numbers == surface, numbers == surface) for surface in range(len(model.masks))]
    covariances = [covariance[block] for block in own]
    steps = 1 if earlier is None else earlier.steps + 1
    model.weights = given
    return Refinement(covariances, moved, changes, steps, rest, free)


def take_step(
    solver: AmplitudeSolver,
    earlier: Refinement | None = None,
    robust: bool = False,
    instrument: bool = True,
    tick: Tick = lambda: None,
) -> Refinement:
    """Take a step as `refine_state` does, and amplitudes along."""
    step = refine_state(solver.model, solver.amplitude, earlier, robust, instrument)
    solver.amplitude = step.amplitude
    solver.run_briefly(tick)
    return step


def _go_ahead(
    model: SurfaceModel,
    amplitude: Image,
    begun: tuple[Image, Image, Image],
    names: list[Unknown],
    newton: FloatArray,
    changes: Image,
) -> tuple[Image, Image, Image]:
    """Move the model as far along a step as each surface's own misfit allows: those that explain less than
    before go less far, and do not hold the others back. Return the amplitudes that go along, those that
    explain the shot best then, and what is left of it. `begun`: before the step, what is left of the
    misfit, what amplitudes change to explain it, and their scales.

    There are as many iterations before the step as after it, so that these alone do not make it good. A
    step that is far too long may overflow: it is refused like others that lower nothing.
    """
    state, (rest, excess, scale) = model.state, begun
    settled, rest = explain_by_amplitude(model, rest, scale, MOVED_FREE_ITERATIONS)
    before = compute_objective(model, rest)
    ranges = "coefficients", "patterns", "shading"
    owners = np.array([one if name in ranges else len(model.parts) for name, one, _ in names])
    tries = np.zeros(len(model.parts) + 1, np.intp)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(TRIES):
            parts = np.array(PARTS)[tries]
            ahead = _move(model, state, amplitude, names, parts[owners] * newton, changes)
            free = ahead + excess
            left = model.image - model.render(free)
            change, left = explain_by_amplitude(model, left, scale, MOVED_FREE_ITERATIONS)
            if compute_objective(model, left) < before + SAYS_NOTHING:
                return ahead, free + change, left
            lost = model.weights * (left**2 - rest**2)
            lost = share_misfit(model, ahead, model.render(ahead), lost)
            losses = np.bincount(model.surface, lost, parts.size) * (parts > 0)
            further = ~(losses <= SHORTENING_LOSS * losses.max()) | (losses.max() <= 0)
            tries = np.minimum(tries + further, len(PARTS) - 1)
    model.place(state)
    return amplitude, amplitude + excess + settled, rest


def doubt_borders(model: SurfaceModel, amplitude: Image) -> Image:
    """Return the weights of measurements, (rows, columns), with what pixels that a surface fills in part
    add to their variance: their light comes from any part of the pixel, and where the surface is steep
    that is a range of its own, by which the whole of it would be turned or moved.
    """
    late = estimate_border_shift(model, amplitude) / model.row_m
    late *= np.array([not isinstance(basis, QuadricBasis) for basis in model.bases])[model.surface]
    moved = delay_light(model).render((amplitude * late).astype(np.float32))
    return model.weights / (1 + model.weights * moved**2)


def estimate_border_shift(model: SurfaceModel, amplitude: Image) -> FloatArray:
    """How far off points are, (points,), m, of whose pixels a surface may fill any part."""
    light = model.find_light_beside((amplitude / model.facing).astype(np.float32))
    uneven = [np.abs(a - b) / np.maximum(a + b, TINY) for a, b in light]
    return LEFT_ASIDE_PX * np.hypot(*(np.array(uneven) * model.compute_slopes()))


def delay_light(model: SurfaceModel) -> SurfaceModel:
    """Return the model whose light is what later light of the surfaces changes, for a row."""
    apart = copy.copy(model)
    pairs = zip(model.kernels, model.footprints, strict=True)
    apart.kernels = [
        (differentiate_pulse(kernel) * place.rows_per_instant).astype(np.float32)
        for kernel, place in pairs
    ]
    return apart


def _leave_out_even_shading(
    model: SurfaceModel, groups: list[Derivatives], rest: Image
) -> list[Derivatives]:
    """Leave out the shading of surfaces whose hidden points all views see alike, as behind a rim. A
    surface that has been found to be shaded before stays so.
    """
    # what each view would make of them alone; views hardly share measurements
    information, shading = np.zeros(model.state.shading.shape), model.state.shading.copy()
    known = shading.any(axis=1)
    pulls = np.zeros(shading.shape)
    for group in groups:
        name, surface, view = group.names[0]
        if name == "shading":
            weighted = model.weights[group.area] * group.images[0]
            information[surface, view] += np.vdot(weighted, group.images[0])
            pulls[surface, view] += np.vdot(weighted, rest[group.area])
    shading += pulls / np.maximum(information, TINY)
    shading -= shading.mean(axis=1, keepdims=True)
    variance = float(np.average(rest**2 * model.weights, weights=model.weights > 0))
    gain = np.mean(information * shading**2, axis=1)
    shaded = (np.std(shading, axis=1) > MIN_SHADING) & (gain > SHADING_SIGMAS**2 * variance)
    shaded |= known
    model.behind = model.behind & shaded[model.surface]
    return [one for one in groups if one.names[0][0] != "shading" or shaded[one.names[0][1]]]


def _eliminate_amplitude(
    model: SurfaceModel, scale: Image, groups: list[Derivatives], start: Image | None
) -> tuple[Image, list[Derivatives]]:
    """Take from derivatives by coefficients, in place, what amplitudes can explain of them.

    What is left of a derivative J is ``J - A x`` with the x that minimises its weighted norm, found
    by conjugate gradients; a step on a coefficient takes x of the amplitude with it. Of different
    surfaces, which hardly share measurements, the derivatives of one number are treated at once.
    Splines bend less than amplitudes could follow, but what of them is a quadratic does not.

    Returns `changes` (9, points): x for each coefficient of a quadratic, or of a surface of second
    order in space; and derivatives by these changes of each surface's amplitude, ("patterns",
    surface, number). Things of one range, as head and arms, do share measurements: of one of them
    alone amplitudes, its own and the others', explain more than of all together. What they explain is
    an unknown of its own; taken for what only late views explain, it would make steps too short and
    ranges surer than they are.
    """
    own = [group for group in groups if group.names[0][0] == "coefficients"]
    shares = [basis.quadratic_parts for basis in model.bases]
    changes = np.zeros((ROUND_COEFFICIENTS, model.surface.size), np.float32)
    iterations = ELIMINATION_ITERATIONS
    if start is not None:
        changes[:, scale > 0] = start[:, scale > 0]
        iterations = FURTHER_ELIMINATION_ITERATIONS
    most = max(functions.shape[1] for functions, _ in shares)
    images = np.zeros((most, *model.image.shape), np.float32)
    for group in own:
        functions, _ = shares[group.names[0][1]]
        area = slice(functions.shape[1]), *group.area
        images[area] += _combine(functions, group.images)
    counts = np.array([functions.shape[1] for functions, _ in shares])[model.surface]
    for number, (image, change) in enumerate(zip(images, changes, strict=False)):
        # quadrics have more of them than others: theirs alone change amplitudes then
        free = np.where(counts > number, scale, np.float32(0))
        if change.any():
            image = image - model.render(change)
        change += explain_by_amplitude(model, image, free, iterations)[0]
        if start is None and number == 0:
            # a smooth multiple of a derivative takes nearly that multiple of its change
            for surface, (functions, _) in enumerate(shares):
                part = model.parts[surface]
                multiples = (model.derivatives[surface] @ functions).T
                changes[1 : len(multiples), part] = multiples[1:] * change[part]
            iterations = FURTHER_ELIMINATION_ITERATIONS

    def explain(surface: int) -> list[Derivatives]:
        part = model.parts[surface]
        own = changes[: len(shares[surface][1]), part]
        windows = [
            model.receive(view, own, kernel, part) for view, kernel in enumerate(model.kernels)
        ]
        names = [("explained", surface, number) for number in range(len(own))]
        return [*_join_windows(model, names, windows)]

    patterns = []
    explained = model.map(explain, range(len(model.masks)))
    # the same points, and so the same parts of the image
    for group, seen in zip(own, itertools.chain.from_iterable(explained), strict=True):
        surface = group.names[0][1]
        _, quadratic = shares[surface]
        group.images[...] -= _combine(quadratic, seen.images)
        patterns.append(replace(seen, names=[("patterns", *name[1:]) for name in seen.names]))
    return changes, patterns


def _combine(shares: FloatArray, images: Image) -> Image:
    """Sums of images, (n, rows, columns), by shares, (n, sums); those of quadratics and quadrics are the
    images themselves.
    """
    few, many = shares.shape
    return images if few == many else np.tensordot(shares.T.astype(np.float32), images, 1)


def compute_objective(model: SurfaceModel, rest: Image) -> float:
    """Half the squared misfit that is left, and what is known of surfaces and sweep beforehand."""
    state = model.state
    bases = zip(model.bases, state.coefficients, strict=True)
    bent = sum(float(c @ basis.bending @ c) for basis, c in bases)
    swept = sum(
        float(np.sum(getattr(state, name) ** 2)) / sigma**2 for name, sigma in KNOWN_SIGMAS.items()
    )
    moved = float(state.centres @ weigh_centres(model.camera) @ state.centres)
    return (float(np.sum(model.weights * rest**2, dtype=np.float64)) + bent + swept + moved) / 2


def weigh_centres(camera: Camera) -> FloatArray:
    """Return what is known of the centres beforehand, (views, views), 1/px^2: the inverse of their
    covariance.
    """
    looks = np.stack([np.ones(camera.views), -np.tan(camera.angles)], axis=1)
    displaced = looks @ np.linalg.pinv(looks)
    return np.asarray(
        np.eye(camera.views) / CENTRE_SIGMA_PX**2 + displaced / DISPLACEMENT_SIGMA_PX**2
    )


def _differentiate_priors(
    model: SurfaceModel, names: list[tuple[str, int, int]]
) -> tuple[FloatArray, FloatArray]:
    """Second and first derivative of what is known of bending and sweep beforehand."""
    second, first = np.zeros((len(names), len(names))), np.zeros(len(names))
    centres = [index for index, (name, _, _) in enumerate(names) if name == "centres"]
    if centres:
        weights = weigh_centres(model.camera)
        second[np.ix_(centres, centres)] = weights
        first[centres] = weights @ model.state.centres
    for index, (name, surface, number) in enumerate(names):
        if name == "coefficients":
            bending = model.bases[surface].bending[number]
            own = index - number + np.arange(bending.size)
            second[index, own] = bending
            first[index] = bending @ model.state.coefficients[surface]
        elif name in KNOWN_SIGMAS:
            second[index, index] = 1 / KNOWN_SIGMAS[name] ** 2
            first[index] = getattr(model.state, name)[number] / KNOWN_SIGMAS[name] ** 2
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
    steps: dict[tuple[str, int], list[float]] = {}
    for (name, surface, number), value in zip(names, change, strict=True):
        steps.setdefault((name, surface), []).append(value)
        if name not in ("coefficients", "patterns"):
            values = getattr(moved, name)
            values = values[surface] if name == "shading" else values
            # gains and widths change relatively
            values[number] += value * (values[number] if name in ("gains", "widths") else 1.0)
    for surface, (part, basis) in enumerate(zip(model.parts, model.bases, strict=True)):
        own, explained = (np.array(steps[name, surface]) for name in ("coefficients", "patterns"))
        moved.coefficients[surface] = basis.take_step(
            model.functions[surface], state.coefficients[surface], own, amplitude[part]
        )
        along = explained - basis.quadratic_parts[1] @ own
        ahead[part] += along.astype(np.float32) @ changes[: along.size, part]
    # the mean gain is the amplitudes' unit, and so is the mean brightness behind a surface
    brighter, shading = moved.gains.mean() / state.gains.mean(), moved.shading.mean(axis=1)
    shading = np.clip(shading, -MOST_SHADING, MOST_SHADING)
    moved.gains /= brighter
    moved.shading = np.clip(moved.shading - shading[:, np.newaxis], -MOST_SHADING, MOST_SHADING)
    ahead = np.float32(brighter) * np.maximum(ahead, 0)
    ahead *= np.where(model.behind, np.exp(shading)[model.surface], 1).astype(np.float32)
    model.place(moved)
    return ahead
