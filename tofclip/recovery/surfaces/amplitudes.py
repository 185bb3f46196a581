"""Solving for amplitudes at fixed ranges: with the prior by FISTA, and without it what they explain."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.model import SurfaceModel, smooth_evenly
from tofclip.recovery.surfaces.pulse import TINY, Image

START_ITERATIONS, REFINEMENT_ITERATIONS = 25, 10  # of what is new, and of what has changed
AGAINST_DIM = 3.0  # until ranges are known; then amplitudes are as the shot has them
PROX_ITERATIONS = 6  # of the dual, which is kept from step to step
# At least and at most, until norms change by as little: where many surfaces share measurements it takes long
NORM_ITERATIONS, FURTHER_NORM_ITERATIONS, MOST_NORM_ITERATIONS, SETTLED_NORM = 10, 2, 40, 0.02
NORM_MARGIN = 1.1
EVEN_RATIO, EVEN_PX = 1.1, 31  # amplitudes as bright, and the side of the square where they count
NEIGHBOURHOOD_PX = 7  # side of the square whose measurements decide whether a point is there
# Of light beside brighter light of its surface: the sides of the squares whose mean is a place's brightness
# and in which the brightest counts, the part of that below which a place is dim, and after how many
# iterations what is dim is looked for anew
PLACE_PX, BESIDE_PX, DIM_PART, REWEIGHT_ITERATIONS = 3, 15, 0.75, 10
# Of the deviations by which the brightest is out of the noise: what dim light costs at most
CAPPED_COST = 0.5
# Deviations of a pixel's noise: iterations that change each surface by less, root mean square, are enough
SETTLED_SIGMAS = 0.01
MISFIT_PX = 4.0  # about a measurement, by whose misfit it is judged
LEAST_COUNT = 1e-3  # of light in a measurement, for it to be any surface's

Tick = Callable[[], object]


class AmplitudeSolver:
    """FISTA for the amplitudes, a step size for each surface.

    Different surfaces hardly share measurements, so that a step for each is as safe as one for all and
    does not hold the bright ones back.

    `weight`: of total variation, in standard deviations of the noise in the misfit's gradient, one or one
    for each surface; `earlier`: of the same surfaces, seen by another shot: what it found saves work.
    """

    def __init__(
        self,
        model: SurfaceModel,
        amplitude: Image,
        weight: float | FloatArray,
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
        around, seen = (smooth_evenly(one, MISFIT_PX) for one in (rest, valid))
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

    def measure_misfit(self) -> float:
        """The weighted sum of squares of what surfaces leave of the shot."""
        model = self.model
        rest = model.image - model.render(self.amplitude)
        return float(np.sum(model.weights * rest**2, dtype=np.float64))

    def measure_light(self) -> FloatArray:
        """By how many deviations of a pixel's noise the light of each surface stands out of it, on average
        over the light, (surfaces,). Of the noise that the weights expect: what else the model does not
        explain no prior makes better.
        """
        model, amplitude = self.model, self.amplitude
        information = np.maximum(model.gather(model.weights, squared=True), 0)
        light, out = (
            np.bincount(model.surface, one, len(model.parts))
            for one in (amplitude, amplitude**2 * np.sqrt(information))
        )
        return np.asarray(out / np.maximum(light, TINY))

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

    def run(self, iterations: int, tick: Tick = lambda: None, against_dim: float = 0.0) -> None:
        """Take some steps, with a call of `tick` after each.

        Light of a line of one range that runs level may lie anywhere in a lens about it: no view tells,
        and total variation favours the lens, which is dimmer. `against_dim` is what light costs at places
        that are dark beside the brightest of their surface nearby, in standard deviations as `weight`
        (reweighted l1, E. Candes and others, J. Fourier Anal. Appl. 14, 877, 2008): the lens gives way
        from its border inwards, and what the shot needs stays. It ends early where no surface's light
        changes any more.
        """
        model = self.model
        steps = 1 / (NORM_MARGIN * self._estimate_norms())
        # The gradient A'W(A a - y) has the covariance A'WA times a weighted measurement's variance.
        information = np.maximum(self.variance * model.gather(model.weights, squared=True), 0)
        noise = np.array(
            [
                np.sqrt(np.median(information[part])) if part.stop > part.start else 1.0
                for part in model.parts
            ]
        )
        weights = self.weight * noise
        step = steps[model.surface].astype(np.float32)
        deviation, sizes = np.sqrt(information), np.bincount(model.surface)
        ahead, age, cost = self.amplitude, 1.0, np.zeros_like(step)
        for number in range(iterations):
            if against_dim and number % REWEIGHT_ITERATIONS == 0:
                cost = self._cost_dim(against_dim, deviation)
            slope = model.pull(ahead, model.image) + cost
            moved = self._shrink(ahead - step * slope, weights * steps)
            if np.sum((ahead - moved) * (moved - self.amplitude)) > 0:
                age = 1.0  # the momentum points uphill (O'Donoghue and Candes, 2015)
            older, change = (1 + np.sqrt(1 + 4 * age**2)) / 2, moved - self.amplitude
            ahead = moved + np.float32((age - 1) / older) * change
            self.amplitude, age = moved, older
            tick()
            squares = np.bincount(model.surface, (change * deviation / self.variance) ** 2)
            if np.all(squares <= SETTLED_SIGMAS**2 * sizes):
                break
        self.variance = estimate_excess_variance(model, self.amplitude)

    def run_briefly(self, tick: Tick = lambda: None) -> None:
        """Take as many steps as follow one on ranges, or another change that amplitudes hardly feel."""
        self.run(REFINEMENT_ITERATIONS, tick, AGAINST_DIM)

    def _cost_dim(self, sigmas: float, noise: Image) -> Image:
        """What light costs at each point for being dimmer than the brightest of its surface beside it:
        so many deviations, `noise` of the gradient, where it is dark, but no more than half of those
        by which the brightest is out of it: in little light nothing would be left.
        """
        bright, brightest = self.compare_places()
        usual = np.maximum(np.float32(DIM_PART) * brightest, TINY)
        dim = np.clip(1 - bright / usual, 0, 1)
        out = CAPPED_COST * noise * usual / np.float32(self.variance)
        return np.asarray(dim * noise * np.minimum(np.float32(sigmas), out))

    def compare_places(self) -> tuple[Image, Image]:
        """How bright the place of each point is, and the brightest of its surface beside it."""
        mean = partial(scipy.ndimage.uniform_filter, size=PLACE_PX, mode="constant")
        largest = partial(scipy.ndimage.maximum_filter, size=BESIDE_PX, mode="constant")
        bright = self.map_pictures(mean, self.amplitude)
        return bright, self.map_pictures(largest, bright)

    def _estimate_norms(self) -> FloatArray:
        """Largest eigenvalue of A'WA for each surface, by power iteration."""
        model, count = self.model, len(self.model.masks)
        vector, norms = self._direction, np.ones(count)
        # the vector of the last time is nearly the one of moved surfaces
        least = NORM_ITERATIONS if self._fresh else FURTHER_NORM_ITERATIONS
        for number in range(MOST_NORM_ITERATIONS):
            vector, before = model.pull(vector), norms
            norms = np.sqrt(np.bincount(model.surface, vector.astype(np.float64) ** 2, count))
            norms = np.maximum(norms, 1e-3 * norms.max())
            vector /= norms[model.surface].astype(np.float32)
            if number + 1 >= least and np.all(norms < (1 + SETTLED_NORM) * before):
                break
        self._direction, self._fresh = vector, False
        return norms

    def _shrink(self, amplitude: Image, weights: FloatArray) -> Image:
        """The proximal step of total variation on each surface."""
        from tofclip.recovery.surfaces.kernels import prox_masked_tv

        masks, found = self.model.masks, np.empty_like(amplitude)

        def work(surfaces: range) -> None:
            for one in surfaces:
                rows, columns = self._boxes[one]
                mask = np.ascontiguousarray(masks[one, rows, columns])
                picture = np.zeros(mask.shape, np.float32)
                picture[mask] = amplitude[self.model.parts[one]]
                dual = np.ascontiguousarray(self._dual[one, :, rows, columns])
                result = np.empty_like(picture)
                prox_masked_tv(picture, mask, weights[one], PROX_ITERATIONS, dual, result)
                self._dual[one, :, rows, columns] = dual
                found[self.model.parts[one]] = result[mask]

        self.model.share_out(work, len(masks))
        return found


def pool_information(information: Image, picture: Image) -> Image:
    """Return the information about each pixel's amplitude, (rows, columns), one over its variance,
    with that of pixels tied to it. These are the nearest ones, and those further off that the prior
    has made as bright: where little is known of each pixel it leaves large even pieces, whose
    amplitude all their pixels determine.
    """
    from tofclip.recovery.surfaces.kernels import add_up_even

    mean = scipy.ndimage.uniform_filter(information, NEIGHBOURHOOD_PX, mode="constant")
    lit, level = picture > 0, np.zeros_like(picture)
    level[lit] = np.floor(np.log(picture[lit]) / np.log(EVEN_RATIO))
    even = np.zeros_like(information)
    add_up_even(np.where(lit, information, 0), level, lit, EVEN_PX // 2, even)
    return np.asarray(np.maximum(NEIGHBOURHOOD_PX**2 * mean, even))


def estimate_excess_variance(model: SurfaceModel, amplitude: Image) -> float:
    """Return the misfit's variance in units of what the weights expect, over lit measurements."""
    predicted = model.render(amplitude)
    lit = (predicted > 0) & (model.weights > 0)
    if not lit.any():
        return 1.0
    return float(np.mean(model.weights[lit] * (predicted - model.image)[lit] ** 2))


def share_misfit(model: SurfaceModel, amplitude: Image, light: Image, misfit: Image) -> Image:
    """Give each point its part of a misfit, or a change of one, (rows, columns): each measurement's
    belongs to the points whose `light`, as amplitudes are rendered, it is.
    """
    relative: Image = (misfit / np.maximum(light, np.float32(LEAST_COUNT))).astype(np.float32)
    return amplitude * model.gather(relative)


def scale_amplitude(model: SurfaceModel, lit: NDArray[np.bool_]) -> Image:
    """Return scales in which lit amplitudes count alike for the data; 0 for all others, which stay."""
    diagonal = model.gather(model.weights, squared=True)
    scale = 1 / np.sqrt(np.maximum(diagonal, TINY))
    return np.where(lit & (diagonal > 0), scale, 0).astype(np.float32)


def explain_by_amplitude(
    model: SurfaceModel, image: Image, scale: Image, iterations: int
) -> tuple[Image, Image]:
    """Return the change of amplitude x that lowers ``|image - A x|_w`` most, by conjugate gradients
    in the scale of `scale_amplitude`, and what is left of the image.
    """
    change, direction, before = np.zeros_like(scale), np.zeros_like(scale), 1.0
    left = image.copy()
    rest, weights = left[model.lit], model.weights[model.lit]  # `rest` is a part of what is left
    for _ in range(iterations):
        pull = scale * model.gather_lit(weights * rest)
        energy = float(np.sum(pull**2, dtype=np.float64))
        if energy == 0:
            break
        direction = pull + np.float32(energy / before) * direction
        light = model.render_lit(scale * direction)
        length = np.float32(energy / max(float(np.vdot(weights * light, light)), TINY))
        change += length * scale * direction
        light *= length
        rest -= light
        before = energy
    return change, left
