"""Solving for ranges, and for what is uncertain of the instrument, by Gauss-Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofclip.recovery.surfaces.amplitudes import (
    TINY,
    explain_by_amplitude,
    scale_amplitude,
)
from tofclip.recovery.surfaces.basis import COEFFICIENTS
from tofclip.recovery.surfaces.derivatives import (
    Derivatives,
    iterate_derivatives,
    multiply_derivatives,
)
from tofclip.recovery.surfaces.model import FloatArray, Image, SurfaceModel
from tofclip.recovery.surfaces.state import SurfaceState

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
