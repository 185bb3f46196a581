"""Solving for surfaces: amplitudes by FISTA for fixed ranges, and ranges with what is uncertain of
the instrument by Gauss-Newton.

Both lower ``J = 1/2 |A(r) a - y|^2_w + sum_k weight_k TV(a_k) + 1/2 sum_k |bending of 1/z_k|^2``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.recovery.surface_model import (
    Derivatives,
    FloatArray,
    Image,
    SurfaceModel,
    SurfaceState,
)
from tofclip.recovery.surface_patches import COEFFICIENTS
from tofclip.solvers import Progress
from tofclip.threads import run_blocks

PROX_ITERATIONS = 6  # of the dual, which is kept from step to step
NORM_ITERATIONS, FURTHER_NORM_ITERATIONS = 10, 2
NORM_MARGIN = 1.1
SMALLEST_STEP = 1 / 16  # of a Gauss-Newton step, halved until it lowers the misfit
# Smooth changes of amplitude, which matter, converge first; those of the last step are nearly right.
ELIMINATION_ITERATIONS, FURTHER_ELIMINATION_ITERATIONS = 6, 2
# Rows by which each view's part of a sweep that was found from the shot is off: root mean squares of
# the demonstration. Later views and farther surfaces look alike, so that the mean over the views is
# what all ranges have in common.
SWEEP_SIGMAS = {"delays": 0.015, "stretches": 0.05}
# Of the brightness behind another surface, between the views: less does not matter, or is noise.
MIN_SHADING, SHADING_SIGMAS = 0.1, 3.0
TINY = float(np.finfo(np.float32).tiny)
RIDGE = 1e-6  # of each unknown's own information: for what the shot says nothing about
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other


class AmplitudeSolver:
    """FISTA for the amplitudes, a step size for each surface.

    Different surfaces hardly share measurements, so that a step for each is as safe as one for all and
    does not hold the bright ones back.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
        Start.
    weight : float
        Of total variation, in standard deviations of the noise in the misfit's gradient.
    earlier : AmplitudeSolver, optional
        Of the same surfaces, seen by another shot: what it found saves work.
    """

    def __init__(
        self,
        model: SurfaceModel,
        amplitude: Image,
        weight: float,
        earlier: AmplitudeSolver | None = None,
    ) -> None:
        self.model, self.amplitude, self.weight = model, amplitude, weight
        rows, columns = model.camera.image_shape
        self._dual = np.zeros((len(model.masks), 2, rows, columns), np.float32)
        self._boxes = [find_box(mask) for mask in model.masks]
        self._direction = np.ones(model.surface.size, np.float32)
        self._fresh = True
        self.variance = 1.0
        if earlier is not None:
            self._dual, self._direction = earlier._dual.copy(), earlier._direction
            self._fresh, self.variance = False, earlier.variance

    def run(self, iterations: int, progress: Progress, frames: int) -> None:
        """Take some steps; `progress` hears of `frames` after each."""
        model = self.model
        steps = 1 / (NORM_MARGIN * self._estimate_norms())
        weights = self.weight * self._estimate_gradient_noise()
        step = steps[model.surface].astype(np.float32)
        ahead, age = self.amplitude, 1.0
        for _ in range(iterations):
            error = model.render(ahead) - model.image
            moved = self._shrink(
                ahead - step * model.gather(model.weights * error), weights * steps
            )
            if np.sum((ahead - moved) * (moved - self.amplitude)) > 0:
                age = 1.0  # the momentum points uphill (O'Donoghue and Candes, 2015)
            older = (1 + np.sqrt(1 + 4 * age**2)) / 2
            ahead = moved + np.float32((age - 1) / older) * (moved - self.amplitude)
            self.amplitude, age = moved, older
            progress(frames)
        self.variance = estimate_excess_variance(model, self.amplitude)

    def _estimate_norms(self) -> FloatArray:
        """Largest eigenvalue of A'WA for each surface, by power iteration."""
        model, count = self.model, len(self.model.masks)
        vector, norms = self._direction, np.ones(count)
        # the vector of the last time is nearly the one of moved surfaces
        for _ in range(NORM_ITERATIONS if self._fresh else FURTHER_NORM_ITERATIONS):
            vector = model.gather(model.weights * model.render(vector))
            norms = np.sqrt(np.bincount(model.surface, vector.astype(np.float64) ** 2, count))
            norms = np.maximum(norms, 1e-3 * norms.max())
            vector /= norms[model.surface].astype(np.float32)
        self._direction, self._fresh = vector, False
        return norms

    def _estimate_gradient_noise(self) -> FloatArray:
        """Standard deviation of the misfit's gradient that photons make, for each surface.

        The gradient A'W(A a - y) has the covariance A'WA times the variance of a weighted measurement.
        """
        model = self.model
        information = self.variance * model.gather(model.weights, squared=True)
        return np.array(
            [
                np.sqrt(np.median(information[part])) if part.stop > part.start else 1.0
                for part in model.parts
            ]
        )

    def _shrink(self, amplitude: Image, weights: FloatArray) -> Image:
        """The proximal step of total variation on each surface."""
        from tofclip.recovery.surface_kernels import prox_masked_tv

        masks, found = self.model.masks, np.empty_like(amplitude)

        def work(block: slice) -> None:
            for one in range(block.start, block.stop):
                rows, columns = self._boxes[one]
                mask = np.ascontiguousarray(masks[one, rows, columns])
                picture = np.zeros(mask.shape, np.float32)
                picture[mask] = amplitude[self.model.parts[one]]
                dual = np.ascontiguousarray(self._dual[one, :, rows, columns])
                result = np.empty_like(picture)
                prox_masked_tv(picture, mask, weights[one], PROX_ITERATIONS, dual, result)
                self._dual[one, :, rows, columns] = dual
                found[self.model.parts[one]] = result[mask]

        run_blocks(work, len(masks), 1)
        return found


def find_box(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest box that holds a mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return slice(0, 1), slice(0, 1)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def estimate_excess_variance(model: SurfaceModel, amplitude: Image) -> float:
    """Return the misfit's variance in units of what the weights expect, over lit measurements.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
    """
    predicted = model.render(amplitude)
    lit = (predicted > 0) & (model.weights > 0)
    if not lit.any():
        return 1.0
    return float(np.mean(model.weights[lit] * (predicted - model.image)[lit] ** 2))


@dataclass(frozen=True)
class Refinement:
    """What a Gauss-Newton step knows.

    Parameters
    ----------
    covariances : list of (n, n) float arrays
        Of each surface's coefficients; everything else that was solved for is unknown.
    amplitude : (points,) float32 array
        After the step.
    explained : (6, points) float32 array
        Changes of amplitude that look like a change of each coefficient of a quadratic.
    """

    covariances: list[FloatArray]
    amplitude: Image
    explained: Image


def refine_state(
    model: SurfaceModel, amplitude: Image, earlier: Refinement | None = None
) -> Refinement:
    """Take a Gauss-Newton step on ranges, gains, pulse widths and, from the second step on, delays
    and stretches, if it lowers the misfit that amplitudes cannot explain.

    The covariance is ``H^-1 S H^-1`` with the information H of the data and the sum S of squares of
    the score over clusters of measurements (H. White, Econometrica 50, 1, 1982): it holds the noise that
    the misfit has, also where misfits of neighbouring measurements depend on each other.

    Parameters
    ----------
    model : SurfaceModel
        Moved in place. The mean gain stays, and so does the mean brightness behind a surface.
    amplitude : (points,) float32 array
    earlier : Refinement, optional
        The step before this one, which saves work.

    Returns
    -------
    Refinement
    """
    state = model.state
    error = model.image - model.render(amplitude)
    pull = model.weights * error
    # As long as ranges are off by much, views that are late would take a part of it: ranges go first.
    groups = [
        group
        for group in model.iterate_derivatives(amplitude)
        if earlier is not None or group.names[0][0] not in SWEEP_SIGMAS
    ]
    # The prior leaves amplitudes a little too even. That looks like views that are late, but not once
    # amplitudes have explained what they can.
    scale = _scale_amplitude(model, amplitude > 0)
    rest = _leave_unexplained(model, error, scale)
    groups = _leave_out_even_shading(model, groups, rest)
    changes = _eliminate_amplitude(
        model, amplitude, groups, None if earlier is None else earlier.explained
    )
    names = [name for group in groups for name in group.names]
    normal = _multiply_groups(groups, model.weights)
    scores = _sum_scores(groups, pull)
    bending, moment = _bend(model, names)
    for index, (name, _, view) in enumerate(names):
        if name in SWEEP_SIGMAS:
            bending[index, index] = 1 / SWEEP_SIGMAS[name] ** 2
            moment[index] = getattr(state, name)[view] / SWEEP_SIGMAS[name] ** 2
    slope = _sum_scores(groups, model.weights * rest).sum(axis=1) - moment
    unit = np.sqrt(np.diag(normal)) + TINY
    whole = (normal + bending) / np.outer(unit, unit) + RIDGE * np.eye(unit.size)
    inverse = np.linalg.inv(whole) / np.outer(unit, unit)
    change = inverse @ slope
    before, step = _objective(model, rest), 1.0
    moved = amplitude
    # A step that is far too long may overflow: it is refused like others that lower nothing.
    with np.errstate(over="ignore", invalid="ignore"):
        while step >= SMALLEST_STEP:
            ahead = _move(state, names, step * change)
            # the mean gain is the amplitudes' unit, and so is the mean brightness behind a surface
            excess = ahead.gains.mean() / state.gains.mean()
            ahead.gains /= excess
            moved = amplitude.copy()
            for surface, part in enumerate(model.parts):
                own = [i for i, name in enumerate(names) if name[:2] == ("coefficients", surface)]
                if len(own) == len(changes):
                    moved[part] -= (step * change[own]).astype(np.float32) @ changes[:, part]
            moved = np.float32(excess) * np.maximum(moved, 0)
            brighter = ahead.shading.mean(axis=1)
            ahead.shading -= brighter[:, np.newaxis]
            moved *= np.where(model.behind, np.exp(brighter)[model.surface], 1).astype(np.float32)
            model.place(ahead)
            rest = _leave_unexplained(model, model.image - model.render(moved), scale)
            if _objective(model, rest) < before:
                break
            step /= 2
        else:
            model.place(state)
            moved = amplitude
    robust = inverse @ (scores @ scores.T + bending) @ inverse
    numbers = np.array([one if name == "coefficients" else -1 for name, one, _ in names])
    blocks = [np.flatnonzero(numbers == surface) for surface in range(len(model.masks))]
    return Refinement([robust[block][:, block] for block in blocks], moved, changes)


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
        left.append(group._replace(names=[group.names[i] for i in own], images=group.images[own]))
    return left


def _eliminate_amplitude(
    model: SurfaceModel, amplitude: Image, groups: list[Derivatives], start: Image | None
) -> Image:
    """Take from derivatives by coefficients, in place, what amplitudes can explain of them.

    What is left of a derivative J is ``J - A x`` with the x that minimises its weighted norm, found
    by conjugate gradients; a step on a coefficient takes x of the amplitude with it. Of different
    surfaces, which hardly share measurements, the derivatives of one number are treated at once.
    Surfaces of splines bend less than amplitudes could follow and are left as they are.

    Returns
    -------
    (6, points) float32 array
        x for each coefficient of the surfaces that are quadratics.
    """
    plain = [
        group
        for group in groups
        if group.names[0][0] == "coefficients" and len(group.names) == COEFFICIENTS
    ]
    quadratic = np.isin(model.surface, [group.names[0][1] for group in plain])
    scale = _scale_amplitude(model, (amplitude > 0) & quadratic)
    changes = np.zeros((COEFFICIENTS, model.surface.size), np.float32)
    iterations = ELIMINATION_ITERATIONS
    if start is not None:
        changes[:, scale > 0] = start[:, scale > 0]
        iterations = FURTHER_ELIMINATION_ITERATIONS
    for number, change in enumerate(changes):
        image = np.zeros_like(model.image)
        for group in plain:
            image[group.row : group.row + group.images.shape[1]] += group.images[number]
        if start is not None:
            image -= model.render(change)
        change += _explain_by_amplitude(model, image, scale, iterations)
        for group in plain:
            part = model.parts[group.names[0][1]]
            rows = group.row, group.row + group.images.shape[1]
            group.images[number] -= model.render_part(change[part], part, rows)
    return changes


def _scale_amplitude(model: SurfaceModel, lit: NDArray[np.bool_]) -> Image:
    """Scales in which lit amplitudes count alike for the data; 0 for all others, which stay."""
    diagonal = model.gather(model.weights, squared=True)
    scale = 1 / np.sqrt(np.maximum(diagonal, TINY))
    return np.where(lit & (diagonal > 0), scale, 0).astype(np.float32)


def _explain_by_amplitude(
    model: SurfaceModel, image: Image, scale: Image, iterations: int
) -> Image:
    """The change of amplitude x that lowers ``|image - A x|_w`` most, by conjugate gradients."""
    change = np.zeros_like(scale)
    residual = scale * model.gather(model.weights * image)
    direction, energy = residual.copy(), float(np.sum(residual**2, dtype=np.float64))
    for _ in range(iterations):
        if energy == 0:
            break
        product = scale * model.gather(model.weights * model.render(scale * direction))
        length = energy / float(np.sum(direction * product, dtype=np.float64))
        change += np.float32(length) * scale * direction
        residual -= np.float32(length) * product
        before, energy = energy, float(np.sum(residual**2, dtype=np.float64))
        direction = residual + np.float32(energy / before) * direction
    return change


def _leave_unexplained(model: SurfaceModel, error: Image, scale: Image) -> Image:
    """What amplitudes cannot explain of a misfit."""
    change = _explain_by_amplitude(model, error, scale, ELIMINATION_ITERATIONS)
    rest: Image = error - model.render(change)
    return rest


def compute_objective(model: SurfaceModel, amplitude: Image) -> float:
    """Return half the weighted squared misfit that amplitudes cannot explain, and what is known of
    surfaces and sweep beforehand.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
    """
    error = model.image - model.render(amplitude)
    return _objective(
        model, _leave_unexplained(model, error, _scale_amplitude(model, amplitude > 0))
    )


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


def _multiply_groups(groups: list[Derivatives], weights: Image) -> FloatArray:
    """J'WJ, group by group, over the part of the image that two groups share."""
    starts = np.cumsum([0] + [len(group.names) for group in groups])
    normal = np.zeros((starts[-1], starts[-1]))
    for i, one in enumerate(groups):
        height, width = one.images.shape[1:]
        area = np.s_[one.row : one.row + height, one.column : one.column + width]
        weighted = one.images * weights[area]
        for j, other in enumerate(groups[: i + 1]):
            top, left = max(one.row, other.row), max(one.column, other.column)
            bottom = min(one.row + height, other.row + other.images.shape[1])
            right = min(one.column + width, other.column + other.images.shape[2])
            if bottom <= top or right <= left:
                continue
            here, there = (
                images[
                    :,
                    top - group.row : bottom - group.row,
                    left - group.column : right - group.column,
                ].reshape(len(group.names), -1)
                for images, group in ((weighted, one), (other.images, other))
            )
            block = (here @ there.T).astype(np.float64)
            normal[starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = block
            normal[starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = block.T
    return normal


def _sum_scores(groups: list[Derivatives], pull: Image) -> FloatArray:
    """Derivatives of the misfit, summed over clusters of measurements, (unknowns, clusters)."""
    tall, wide = -(-pull.shape[0] // CLUSTER_ROWS), -(-pull.shape[1] // CLUSTER_COLUMNS)
    found = []
    for group in groups:
        count, height, width = group.images.shape
        area = np.s_[group.row : group.row + height, group.column : group.column + width]
        scores = group.images * pull[area]
        row = (group.row + np.arange(height)) // CLUSTER_ROWS
        column = (group.column + np.arange(width)) // CLUSTER_COLUMNS
        first_row, first_column = (
            np.unique(row, return_index=True),
            np.unique(column, return_index=True),
        )
        scores = np.add.reduceat(scores, first_row[1], axis=1, dtype=np.float64)
        scores = np.add.reduceat(scores, first_column[1], axis=2)
        placed = np.zeros((count, tall, wide))
        placed[:, first_row[0][:, np.newaxis], first_column[0]] = scores
        found.append(placed.reshape(count, -1))
    return np.concatenate(found)


def _move(
    state: SurfaceState, names: list[tuple[str, int, int]], change: FloatArray
) -> SurfaceState:
    """The state after a step; gains and widths change relatively."""
    moved = state.copy()
    for (name, surface, number), value in zip(names, change, strict=True):
        values = getattr(moved, name)
        if name in ("coefficients", "shading"):
            values = values[surface]
        values[number] += value * (values[number] if name in ("gains", "widths") else 1.0)
    return moved
