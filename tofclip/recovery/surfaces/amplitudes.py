"""Solving for amplitudes at fixed ranges: with the prior by FISTA, and without it what they explain."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.pulse import Image
from tofclip.threads import run_blocks

PROX_ITERATIONS = 6  # of the dual, which is kept from step to step
NORM_ITERATIONS, FURTHER_NORM_ITERATIONS = 10, 2
NORM_MARGIN = 1.1
EVEN_RATIO, EVEN_PX = 1.1, 31  # amplitudes as bright, and the side of the square where they count
NEIGHBOURHOOD_PX = 7  # side of the square whose measurements decide whether a point is there
# Of light that was spread beyond its surface: rounds of taking a border off and iterations in each; the
# deviations from which on a border is needed, and by which it would be missed if nothing took its light;
# the part of the usual brightness below which light was spread; the part of the points of which as few
# are not that no further round is worth it; how much brighter the inside has to become by that light, or
# of the brightness inside what a pixel has at most that is hardly filled
BORDER_ROUNDS, TAKING_ITERATIONS, FURTHER_TAKING_ITERATIONS = 8, 30, 15
NEEDED_SIGMAS, MISSED_SIGMAS, DIM_FRACTION, FEW_POINTS = 4.0, 8.0, 0.75, 0.0005
GAINED_RATIO, HARDLY_FILLED = 1.1, 0.35
# Sides of squares: of a place's brightness, and of light that stays there as it spreads
FILLED_PX, SPREAD_PX = 3, 31
MISFIT_PX = 4.0  # about a measurement, by whose misfit it is judged
LEAST_COUNT = 1e-3  # of light in a measurement, for it to be any surface's
TINY = float(np.finfo(np.float32).tiny)

Tick = Callable[[], object]


class AmplitudeSolver:
    """FISTA for the amplitudes, a step size for each surface.

    Different surfaces hardly share measurements, so that a step for each is as safe as one for all and
    does not hold the bright ones back.

    `weight`: of total variation, in standard deviations of the noise in the misfit's gradient;
    `earlier`: of the same surfaces, seen by another shot: what it found saves work.
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
        boxes = (scipy.ndimage.find_objects(mask) for mask in model.masks.astype(np.int8))
        self._boxes = [next(iter(box), (slice(0, 1), slice(0, 1))) for box in boxes]
        self._direction = np.ones(model.surface.size, np.float32)
        self._fresh = True
        self.variance = 1.0
        if earlier is not None:
            self._dual, self._direction = earlier._dual.copy(), earlier._direction
            self._fresh, self.variance = False, earlier.variance

    def cover(self, masks: NDArray[np.bool_]) -> AmplitudeSolver:
        """Return the same for surfaces that lie only, or also, where their masks are."""
        left = masks.any(axis=(1, 2))
        pictures, directions = np.zeros((2, *masks.shape), np.float32)
        pictures[self.model.masks], directions[self.model.masks] = self.amplitude, self._direction
        other = AmplitudeSolver(self.model.cover(masks), pictures[masks], self.weight, self)
        other._dual, other._direction = self._dual[left], directions[masks]
        return other

    def estimate_local_variance(self) -> Image:
        """What is left of the measurements about each, (rows, columns), in units of what the weights
        expect, at least what is left of the shot: noise, and beside bright light what the model does
        not explain of it.
        """
        model = self.model
        rest = model.weights * (model.image - model.render(self.amplitude)) ** 2
        valid = (model.weights > 0).astype(np.float32)
        around, seen = (scipy.ndimage.gaussian_filter(one, MISFIT_PX) for one in (rest, valid))
        return np.asarray(np.maximum(around / np.maximum(seen, TINY), np.float32(self.variance)))

    def measure_significance(self, variance: Image | None = None) -> Image:
        """By how many standard deviations each point's amplitude is above nothing, (points,). A pixel
        alone is hardly above the photons' noise: its neighbours on the surface, which the prior ties
        to it, count as well. `variance`: of `estimate_local_variance`, by default the own one.
        """
        if variance is None:
            variance = self.estimate_local_variance()
        information = self.model.gather(self.model.weights / variance, squared=True)
        found = self.map_pictures(pool_information, information, self.amplitude)
        # running sums may leave a rounding error below nothing
        return np.asarray(self.amplitude * np.sqrt(np.maximum(found, 0)))

    def map_pictures(
        self, work: Callable[..., NDArray[Any]], *values: NDArray[Any]
    ) -> NDArray[Any]:
        """Apply `work` to the pictures of each surface, the part that it covers, 0 beside it; return
        what it makes of `values`, (points,) each, in the type of the first.
        """
        found, model = np.zeros_like(values[0]), self.model
        for mask, box, part in zip(model.masks, self._boxes, model.parts, strict=True):
            lit = mask[box]
            pictures = np.zeros((len(values), *lit.shape), found.dtype)
            pictures[:, lit] = [one[part] for one in values]
            found[part] = work(*pictures)[lit]
        return found

    def find_spread(self, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Say which of the points `shown`, (points,), have light that belongs further inside.

        The light of a line of one range that runs level may lie anywhere in a lens about it: no view
        tells, and the prior favours the lens, which is dimmer. From the borders inwards such points are
        found: the whole shot is explained as well without them and all that lie outside, those inside
        free to take over the light (`explain_by_amplitude`), and with that light inside their
        surface is still dimmer than beside the nearest border that the shot needs. What hardly
        makes it brighter was not spread: a surface is dark there, unless its border alone is.
        Nothing is known of light so weak that it would not be missed.
        """
        model = copy.copy(self.model)
        model.weights = model.weights / self.estimate_local_variance()
        amplitude, left = self.amplitude, shown.copy()
        taken, usual = np.zeros_like(amplitude), np.zeros(shown.size)

        def average(values: NDArray[Any], side: int) -> FloatArray:
            mean = partial(scipy.ndimage.uniform_filter, size=side, mode="constant")
            return self.map_pictures(mean, values.astype(np.float64))

        def sum_near(light: Image, seen: Image) -> FloatArray:
            """What some light about each point says of how much worse the shot is explained."""
            own = light * model.gather(model.weights * seen)
            return NEIGHBOURHOOD_PX**2 * average(own, NEIGHBOURHOOD_PX)

        # how bright the surface is inside, where no pixel is only partly filled
        light = np.where(shown, amplitude, np.float32(0))
        bright = average(light, FILLED_PX) / np.maximum(average(shown, FILLED_PX), TINY)
        largest = partial(scipy.ndimage.maximum_filter, size=NEIGHBOURHOOD_PX, mode="constant")
        bright = self.map_pictures(largest, np.where(shown, bright, 0))
        around = average(light, SPREAD_PX)
        for number in range(BORDER_ROUNDS):
            inside = np.zeros_like(model.masks)
            inside[model.masks] = left
            inside &= [scipy.ndimage.binary_erosion(one, border_value=1) for one in inside]
            free = inside[model.masks]
            border, without = left & ~free, np.where(free, np.float32(0), light)
            taken = np.where(free, taken, np.float32(0))
            iterations = FURTHER_TAKING_ITERATIONS if number else TAKING_ITERATIONS
            image = model.render(without - taken)
            taken += explain_by_amplitude(model, image, scale_amplitude(model, free), iterations)
            # at the best that is free these add up to what the shot is explained worse by
            needed = sum_near(without, model.render(without - taken)) > NEEDED_SIGMAS**2
            missed = sum_near(without, model.render(without)) > MISSED_SIGMAS**2
            if number == 0:
                usual = self._spread_from(border & needed, bright)
            gained = around / np.maximum(average(light * left, SPREAD_PX), TINY)
            idle = border & ~needed & missed
            idle &= bright * gained < DIM_FRACTION * usual
            left &= ~idle
            if idle.sum() <= FEW_POINTS * left.sum():
                break
        gained = around / np.maximum(average(light * left, SPREAD_PX), TINY)
        faint = amplitude < HARDLY_FILLED * bright
        return shown & ~left & (faint | (gained > GAINED_RATIO))

    def _spread_from(self, known: NDArray[np.bool_], values: FloatArray) -> FloatArray:
        """What the nearest point of the surface among those that are known has; 0 where none is."""

        def spread(picture: FloatArray) -> FloatArray:
            if not picture.any():
                return picture
            nearest = scipy.ndimage.distance_transform_edt(
                picture == 0, return_distances=False, return_indices=True
            )
            return np.asarray(picture[tuple(nearest)])

        return self.map_pictures(spread, np.where(known, values, 0))

    def run(self, iterations: int, tick: Tick = lambda: None) -> None:
        """Take some steps, with a call of `tick` after each."""
        model = self.model
        steps = 1 / (NORM_MARGIN * self._estimate_norms())
        # The gradient A'W(A a - y) has the covariance A'WA times a weighted measurement's variance.
        information = self.variance * model.gather(model.weights, squared=True)
        noise = np.array(
            [
                np.sqrt(np.median(information[part])) if part.stop > part.start else 1.0
                for part in model.parts
            ]
        )
        weights = self.weight * noise
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
            tick()
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

    def _shrink(self, amplitude: Image, weights: FloatArray) -> Image:
        """The proximal step of total variation on each surface."""
        from tofclip.recovery.surfaces.kernels import prox_masked_tv

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


def pool_information(information: Image, picture: Image) -> Image:
    """Return the information about each pixel's amplitude, (rows, columns), one over its variance,
    with that of pixels tied to it. These are the nearest ones, and those further off that the prior
    has made as bright: where little is known of each pixel it leaves large even pieces, whose
    amplitude all their pixels determine.
    """

    def add_up(values: Image, side: int) -> Image:
        mean: Image = scipy.ndimage.uniform_filter(values, side, mode="constant")
        return side**2 * mean

    pooled = add_up(information, NEIGHBOURHOOD_PX)
    lit, level = picture > 0, np.zeros(picture.shape, np.intp)
    level[lit] = np.floor(np.log(picture[lit]) / np.log(EVEN_RATIO)).astype(np.intp)
    for one in np.unique(level[lit]):
        even = lit & (np.abs(level - one) <= 1)
        own = lit & (level == one)
        wide = add_up(np.where(even, information, 0), EVEN_PX)
        pooled[own] = np.maximum(pooled[own], wide[own])
    return pooled


def estimate_excess_variance(model: SurfaceModel, amplitude: Image) -> float:
    """Return the misfit's variance in units of what the weights expect, over lit measurements."""
    predicted = model.render(amplitude)
    lit = (predicted > 0) & (model.weights > 0)
    if not lit.any():
        return 1.0
    return float(np.mean(model.weights[lit] * (predicted - model.image)[lit] ** 2))


def scale_amplitude(model: SurfaceModel, lit: NDArray[np.bool_]) -> Image:
    """Return scales in which lit amplitudes count alike for the data; 0 for all others, which stay."""
    diagonal = model.gather(model.weights, squared=True)
    scale = 1 / np.sqrt(np.maximum(diagonal, TINY))
    return np.where(lit & (diagonal > 0), scale, 0).astype(np.float32)


def explain_by_amplitude(model: SurfaceModel, image: Image, scale: Image, iterations: int) -> Image:
    """Return the change of amplitude x that lowers ``|image - A x|_w`` most, by conjugate gradients
    in the scale of `scale_amplitude`.
    """
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
