"""The surface that a picture of few photons shows: neighbours lend each other theirs.

1. The instant of each pixel's surface is matched on a coarse time axis, and planes through the
   neighbours on the same one give it below a bin, with its deviation (`matching`).
2. Further returns are looked for in what the first surface leaves.

How much neighbours have to agree, how far they reach, the response and the probability of an
outlier come from the data: a part of the photons is held back, and what explains it best counts.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from tofclip.arrays import BoolArray, Float32Array, FloatArray
from tofclip.errors import InputError
from tofclip.lidar.photons.detector import PhotonDetector
from tofclip.lidar.photons.image import PhotonImage, SurfaceImage, find_dim_pixels
from tofclip.lidar.photons.matching import (
    JUMP_COST_RATIO,
    PLANE_ROUNDS,
    TRIAL_ROUNDS,
    LabelAxis,
    choose_label_axis,
    compute_scores,
    estimate_bias,
    fit_surface,
    match_labels,
    match_photons,
)
from tofclip.lidar.photons.scene import (
    MIN_SHAPE_BINS,
    BinnedResponse,
    Scene,
    even_out_bins,
    learn_response,
    learn_shading,
    prepare_photons,
    require_plausible_pulse,
)
from tofclip.lidar.pulse import Pulse
from tofclip.units import SPEED_OF_LIGHT

HELD_OUT_FRACTION = 0.25
REACHES_PX = (1, 2, 3, 4, 6, 8)
RESPONSE_ROUNDS, RESPONSE_REACH_PX = 4, 3
# Log-likelihood, and its standard deviations, by which a learnt response has to beat a given one;
# its free shape alone gains some hundred.
MIN_LEARNT_GAIN, MIN_LEARNT_SIGNIFICANCE = 500.0, 5.0
SIGNAL_POOL_PX, MIN_SIGNAL_SHARE = 5, 0.002
WIDER_POOLS_PX = (SIGNAL_POOL_PX, 9, 17, 33, 65)
# Log odds in a unit of a label's margin, and how far (in its logarithm) scenes differ in it: eight
# paths count what they share several times. In 16 simulated scenes of 0.7 to 20 signal and 2 to 200
# background photons the weight was 0.076 to 0.28.
MARGIN_WEIGHT, MARGIN_WEIGHT_SPREAD = 1 / 7, 0.5
# Of the logarithm of the number of labels that rival the best one: about one on surfaces (0.6 to
# 2.4 in the same scenes), many where no light comes back.
RIVAL_SPREAD = 0.5
MARGIN_WEIGHTS, RIVALS = np.geomspace(0.03, 0.8, 24), np.geomspace(0.5, 256, 10)
# Of pixels that send no light back: sides of the squares whose photons count, and whose background.
EMPTY_POOL_PX, EMPTY_BACKGROUND_PX, EMPTY_ROUNDS = 3, 9, 30
TINY = 1e-9
MAX_JUDGED_PIXELS = 20_000  # evenly chosen, that the outlier probability is learnt from
SLOPE_COSTS = (0.5, 2.0, 10.0)  # log-likelihood that a change by one label has to bring

# How well it is known where in a response that was learnt from the scene its surface lies: one offset
# for the whole picture, which `settings` state and no pixel's deviation holds.
LEARNT_RESPONSE_SIGMA_WIDTHS = 1 / 30
LONG_GATE_STEPS, LONG_GATE_ROUNDS = 4.0, 20
LABEL_SIGMA_WIDTHS = 1 / np.sqrt(6)  # of a triangle that falls to nothing a width to either side
MIN_EXPLAINED_DENSITY = 0.003  # of the response's peak: where it is brighter photons are explained
# Of the time axis, and pixels that have to show a stretch before their surfaces; photons expected behind
# surfaces, and the share of them that has to be missing before a detector is said to be blind there.
BLIND_STRETCHES, MIN_WITNESSES = 64, 20
MIN_BLIND_PHOTONS, MIN_MISSED_SHARE, SURFACE_SIGMAS = 400.0, 0.2, 4.0
# That the background alone shows as many photons at a further surface, in the pixel and in the nine
# pixels around it.
MAX_OWN_CHANCE, MAX_POOLED_CHANCE = 0.02, 1e-4


def estimate_surface(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    learn: bool = True,
    max_returns: int = 1,
    seed: int = 0,
    progress: Callable[[float], object] | None = None,
    cycles: int | None = None,
) -> SurfaceImage:
    """Find one surface for every pixel, with the help of its neighbours.

    Parameters
    ----------
    photons : PhotonImage
    pulse : Pulse, optional
        Shape of a return; by default as wide as pairs of photons say.
    learn : bool
        Learn the shape from the photons, and use what was learnt if it explains the photons that
        are held back clearly better than `pulse`.
    max_returns : int
        Surfaces looked for in every pixel, one behind the other.
    seed : int
        Of the choice of the photons that are held back.
    progress : callable, optional
        Called with the fraction of the work that is done.
    cycles : int, optional
        Laser cycles of each pixel, of a detector that counts the first photon of a cycle only.

    Returns
    -------
    SurfaceImage
        Every pixel has a range, a hot one that of its neighbours;
        `SurfaceImage.outlier_probability` says what it is worth.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised.

    Notes
    -----
    Memory: at most 2 GiB beside the photons.
    """
    report = progress or (lambda _: None)
    counted, dim = photons, find_dim_pixels(photons)
    photons, start, hot = prepare_photons(photons, pulse)
    if cycles is not None:
        photons = photons.correct_pile_up(cycles)
    elif not photons.sampled:
        photons = replace(photons, shading=learn_shading(photons, start.fwhm / photons.bin_width))
    scene = Scene.start(photons, start)
    axis = choose_label_axis(photons, scene)
    train, test = photons.split(HELD_OUT_FRACTION, seed)
    training = scene.scale(1 - HELD_OUT_FRACTION)
    report(0.1)
    slope_cost, surface, margin = choose_slope_cost(train, test, training, axis)
    report(0.4)
    learnt = None
    if pulse is None or (learn and not photons.sampled):  # an instrument knows its gate
        learnt = learn_scene(train, test, training, surface, required=pulse is None)
    if learnt is not None:
        scene = Scene(learnt, scene.background)
        require_plausible_pulse(photons, learnt.pulse)
        training = scene.scale(1 - HELD_OUT_FRACTION)
        surface, margin = match_photons(train, training, axis, slope_cost)
    report(0.6)
    if cycles is None and photons.shading is None:
        even = even_out_bins(counted, photons, surface[np.newaxis], scene.response.width)
        if even is not None:
            return estimate_surface(even, pulse, learn, max_returns, seed, progress)
    reach, fitted = choose_reach(train, test, training, surface)
    to_probability = calibrate_outliers(test, train, training, fitted, margin)
    empty = estimate_emptiness(test, train, training, fitted[..., 0])
    report(0.8)

    search = SurfaceSearch(scene, axis, slope_cost, reach, to_probability)
    layers = search.find_layers(photons, empty, max_returns)
    missed = 0.0 if cycles is not None else find_missed_share(photons, scene, layers)
    if missed and len(layers) == 1:
        # light of a surface before it would be missing behind it as well
        further = search.find_further(remove_return(photons, scene, layers[0]))
        missed = find_missed_share(photons, scene, [*layers, further])
    stack = np.stack(layers)
    strongest = np.argsort(-np.nan_to_num(stack[..., 2], nan=-1.0), axis=0, kind="stable")
    stack = np.take_along_axis(stack, strongest[..., np.newaxis], axis=0)[:max_returns]
    bin_m = SPEED_OF_LIGHT / 2 * photons.bin_width
    stack = photons.add_bin_errors(stack * [bin_m, bin_m, 1, 1])
    if photons.sampled:
        detector = PhotonDetector(start, photons.bin_width, photons.bins).learn(photons)
        stack = detector.add_step_errors(stack)
    common = LEARNT_RESPONSE_SIGMA_WIDTHS * scene.response.width if learnt is not None else 0.0
    settings: dict[str, float | str] = {
        "response": "given" if learnt is None else "learnt",
        "pulse_fwhm_ps": scene.response.pulse.fwhm * 1e12,
        "background_photons_per_bin": scene.background,
        "slope_cost": slope_cost,
        "jump_cost": slope_cost * JUMP_COST_RATIO,
        "reach_px": reach,
        "response_sigma_m": common * bin_m,
        "hot_pixels": int(hot.sum()),
        "dim_pixels": int(dim.sum()),
        "pile_up": missed,
        "uneven_bins_sigma_m": photons.bins_sigma_m,
    }
    return SurfaceImage.from_layers(stack, scene.response.pulse, settings, hot)


@dataclass(frozen=True)
class SurfaceSearch:
    """How a picture's surfaces are found, as photons that were held back have it."""

    scene: Scene
    axis: LabelAxis
    slope_cost: float
    reach: int  # of planes, px
    to_probability: Callable[[Float32Array], FloatArray]  # of an outlier, from a label's margin

    def locate(self, photons: PhotonImage) -> FloatArray:
        """Find the strongest surface, (rows, columns, 4), instant and deviation in bins."""
        scene, reach, width = self.scene, self.reach, self.scene.response.width
        surface, margin = match_photons(photons, scene, self.axis, self.slope_cost)
        # labels of a gate that is open for many steps are further off than its edges are steep
        is_long = photons.sampled and width > LONG_GATE_STEPS
        rounds = LONG_GATE_ROUNDS if is_long else PLANE_ROUNDS
        nested = fit_surface(photons, scene, surface, max(reach // 2, 1), rounds)
        fitted = fit_surface(photons, scene, nested[..., 0], reach)
        # Where no photon is near, or none on a slope of the response, the label is all there is.
        counted = np.minimum(fitted[..., 1], width * LABEL_SIGMA_WIDTHS)
        sigma = np.sqrt(counted**2 + estimate_bias(fitted, nested, reach, width))
        return np.stack([fitted[..., 0], sigma, fitted[..., 2], self.to_probability(margin)], -1)

    def find_further(self, photons: PhotonImage) -> FloatArray:
        """Find a surface in what nearer ones leave, NaN where the background alone explains it."""
        return keep_significant(photons, self.scene, self.locate(photons))

    def find_layers(
        self, photons: PhotonImage, empty: FloatArray, max_returns: int
    ) -> list[FloatArray]:
        """Find the picture's surfaces, in the order in which they stand out; `empty`: how probable it
        is that a pixel sends no light back.
        """
        layers = [self.locate(photons)]
        layers[0][..., 3] += (1 - layers[0][..., 3]) * empty
        # A surface goes on where another one stops: behind an edge the second of a pixel may be found
        # only when the third of the picture is looked for.
        for _ in range(max_returns if max_returns > 1 else 0):
            photons = remove_return(photons, self.scene, layers[-1])
            if not photons.bin.size:
                break
            further = self.find_further(photons)
            if np.isnan(further).all():
                break
            layers.append(further)
        return layers


def choose_slope_cost(
    train: PhotonImage, test: PhotonImage, scene: Scene, axis: LabelAxis
) -> tuple[float, FloatArray, Float32Array]:
    """Find the cost that explains the photons held back best, and what `match_labels` gives."""
    score, trials = compute_scores(train, scene, axis), []
    for cost in SLOPE_COSTS:
        surface, margin = match_labels(score, axis, train.image_shape, cost)
        evidence = float(weigh_evidence(test, train, scene, surface).mean())
        trials.append((evidence, cost, surface, margin))
    return max(trials, key=lambda trial: trial[0])[1:]


def weigh_evidence(
    test: PhotonImage,
    train: PhotonImage,
    scene: Scene,
    surface: FloatArray,
    signal_pool: int = SIGNAL_POOL_PX,
) -> FloatArray:
    """Log-likelihood ratio of each pixel's held-back photons, (pixels,): this surface, in bins,
    against any instant. Pixels in a square of `signal_pool` share one fraction of signal photons.
    """
    from tofclip.lidar.photons import kernels

    response, late = scene.response, train.times_after(surface)
    inside = (late >= response.start) & (late <= response.width - response.start)
    length = response.width - 2 * response.start
    seen, total = (
        scipy.ndimage.uniform_filter(train.sum_by_pixel(part), signal_pool, mode="nearest")
        for part in (train.count * inside, train.count)
    )
    outside = length * estimate_background(train, surface, inside, length, signal_pool)
    # That all is signal is never claimed: one photon against it would decide for the pixel. More
    # than there is would count against every surface in a hundred times as much background.
    signal = np.clip((seen - outside) / np.maximum(total, 1e-9), MIN_SIGNAL_SHARE, 0.98)
    evidence, course = np.empty(test.pixels), test.relative
    flat = np.ascontiguousarray(surface, dtype=np.float64).ravel()
    if train.shading is not None:
        course = course / train.shading.average().at(np.arange(flat.size), flat)[test.pixel]
    sampled = response.density * train.bins, response.start, response.step, signal.ravel()
    kernels.sum_evidence(test.offsets, test.bin, test.count, course, flat, *sampled, evidence)
    return evidence


def estimate_background(
    photons: PhotonImage, surface: FloatArray, inside: BoolArray, length: float, side: int
) -> FloatArray:
    """Return the background's photons a bin at each pixel's surface, (rows, columns): as dense as outside
    of a response, `length` bins long, where it is as bright, in a square of so many pixels a side.
    `inside`: which events lie on a surface.
    """
    outside = photons.sum_by_pixel(photons.count * ~inside / photons.relative)
    even = scipy.ndimage.uniform_filter(outside, side, mode="nearest")
    return np.asarray(even * photons.relative_at(surface) / max(photons.bins - length, 1))


def learn_scene(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray, required: bool
) -> BinnedResponse | None:
    """Learn the response from the photons held back, around the surface that the others found.
    Returns None if the response known so far explains the photons as well and none is required.
    """
    known = scene.response
    fitted = fit_surface(train, scene, surface, RESPONSE_REACH_PX)
    before = weigh_evidence(test, train, scene, fitted[..., 0])
    for _ in range(RESPONSE_ROUNDS):
        scene, later = learn_response(test, train, scene, fitted)
        begin = fitted[..., 0] + later
        fitted = fit_surface(train, scene, begin, RESPONSE_REACH_PX, TRIAL_ROUNDS)
        if scene.response.width < MIN_SHAPE_BINS and not np.any(test.bin % 1):
            return known if required else None  # whole bins show no shape
    gain = weigh_evidence(test, train, scene, fitted[..., 0]) - before
    clear = MIN_LEARNT_SIGNIFICANCE * np.sqrt(gain.size) * gain.std() + MIN_LEARNT_GAIN
    return scene.response if required or gain.sum() > clear else None


def choose_reach(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray
) -> tuple[int, FloatArray]:
    """Find the reach that explains the photons held back best, and what `fit_surface` gives."""
    best, chosen, highest = REACHES_PX[0], np.zeros(0), -np.inf
    rounds = PLANE_ROUNDS
    for reach in REACHES_PX:
        if reach > REACHES_PX[0] and 2 * reach + 1 > min(surface.shape):
            break
        fitted = fit_surface(train, scene, surface, reach, rounds)
        surface, rounds = fitted[..., 0], TRIAL_ROUNDS
        value = float(weigh_evidence(test, train, scene, surface).mean())
        if value <= highest:
            break
        best, chosen, highest = reach, fitted, value
    return best, chosen


def calibrate_outliers(
    test: PhotonImage,
    train: PhotonImage,
    scene: Scene,
    fitted: FloatArray,
    margin: Float32Array,
) -> Callable[[Float32Array], FloatArray]:
    """Learn how to turn margins of labels into probabilities of an outlier.

    A margin is what the paths make of the log odds: the probability is a logistic function of it,
    one half where two labels are as good and the others are not. Its slope and the number of rivals
    are the most likely ones given the photons held back, in which right and wrong pixels are mixed.
    """
    # A response does not explain the photons that it was learnt from as it does others, nor one that
    # is given what a surface that is slightly off shows: either half is judged by the other one's.
    # Noise of the assumed share of signal makes surfaces look surer than they are: it is taken from
    # as large a neighbourhood as explains the photons best.
    one, other = test.split(0.5, 0)
    evidence = np.zeros(margin.size)
    for teacher, part in ((other, one), (one, other)):
        learnt, later = scene, 0.0
        with contextlib.suppress(InputError):  # too few photons to show one
            learnt, later = learn_response(teacher, train, scene, fitted)
        moved = fitted[..., 0] + later
        pooled = [weigh_evidence(part, train, learnt, moved, pool) for pool in WIDER_POOLS_PX]
        evidence += max(pooled, key=np.sum)
    some = slice(None, None, -(-margin.size // MAX_JUDGED_PIXELS))
    for_surface = np.exp(np.clip(evidence[some], -30, 30))

    def doubt(value: Float32Array, weight: float, rivals: float) -> FloatArray:
        odds = np.log(rivals) - weight * np.maximum(value, 0).astype(np.float64)
        return scipy.special.expit(odds)

    def weigh(choice: tuple[float, float]) -> float:
        wrong = doubt(margin.ravel()[some], *choice)
        prior = (np.log(choice[0] / MARGIN_WEIGHT) / MARGIN_WEIGHT_SPREAD) ** 2
        prior += (np.log(choice[1]) / RIVAL_SPREAD) ** 2
        return float(np.sum(np.log((1 - wrong) * for_surface + wrong)) - prior / 2)

    weight, rivals = max(itertools.product(MARGIN_WEIGHTS, RIVALS), key=weigh)
    return lambda value: doubt(value, weight, rivals)


def estimate_emptiness(
    test: PhotonImage, train: PhotonImage, scene: Scene, surface: FloatArray
) -> FloatArray:
    """Return how probable it is that a pixel sends no light back, (rows, columns), where its neighbours'
    surface, in bins, goes on: photons held back, which had no part in it, are the background's then.
    Those of the neighbours count as well. How bright surfaces are and how many pixels are empty is
    what explains all pixels best.
    """
    response, side = scene.response, EMPTY_POOL_PX
    # a response's tail holds little light and much background
    bright = response.times[response.density >= response.density.max() / 2]
    short = float(bright[-1] - bright[0]) + max(response.step, 1.0)
    length = response.width - 2 * response.start

    def count(photons: PhotonImage) -> FloatArray:
        late = photons.times_after(surface) - (bright[0] + bright[-1]) / 2
        return photons.sum_by_pixel(photons.count * (np.abs(late) <= short / 2))

    def add_up(values: FloatArray) -> FloatArray:
        mean = scipy.ndimage.uniform_filter(values.astype(np.float64), side, mode="nearest")
        return np.asarray(side**2 * mean)

    late = train.times_after(surface)
    inside = (late >= response.start) & (late <= response.width - response.start)
    even = estimate_background(train, surface, inside, length, EMPTY_BACKGROUND_PX)
    even *= short / (1 - HELD_OUT_FRACTION)
    held_back = count(test)
    seen, expected = np.rint(add_up(held_back)), HELD_OUT_FRACTION * add_up(even)
    share, empty = 0.5, np.full(surface.shape, 0.5)
    for _ in range(EMPTY_ROUNDS):
        light = max(float(np.average(seen - expected, weights=1 - empty)), TINY)
        empty = scipy.special.expit(
            scipy.special.logit(share) - compare_with_background(seen, expected, light)
        )
        share = float(np.clip(empty.mean(), TINY, 1 - TINY))
    # what has empty pixels beside it may have its photons from the others beside it
    own = held_back + count(train)
    others = (add_up(own - even) - (own - even)) / (side**2 - 1)
    alone = scipy.special.expit(-compare_with_background(own, even, np.maximum(others, TINY)))
    beside = scipy.ndimage.maximum_filter(empty, side, mode="nearest") > 0.5
    return np.asarray(np.where(beside, np.maximum(empty, alone), empty))


def compare_with_background(
    seen: FloatArray, expected: FloatArray, light: float | FloatArray
) -> FloatArray:
    """Log-likelihood ratio of photons that are seen: of a surface, whose light is exponentially
    distributed with the mean `light`, against the background alone, of which so many are expected.
    """
    expected, rate = np.maximum(expected, TINY), 1 + 1 / light
    beyond = scipy.special.gammaincc(seen + 1, expected * rate)
    lit = np.log(np.maximum(beyond, TINY)) + expected / light - np.log(light)
    lit -= (seen + 1) * np.log(rate)
    alone = scipy.special.xlogy(seen, expected) - expected - scipy.special.gammaln(seen + 1)
    return np.asarray(lit - alone)


def remove_return(photons: PhotonImage, scene: Scene, layer: FloatArray) -> PhotonImage:
    """Leave out the photons that a surface, the first of a `layer`'s numbers, explains better."""
    response = scene.response
    bright = response.times[response.density >= MIN_EXPLAINED_DENSITY * response.density.max()]
    late = photons.times_after(layer[..., 0])
    return photons.select(photons.count * ~((late >= bright[0]) & (late <= bright[-1])))


def find_missed_share(photons: PhotonImage, scene: Scene, layers: list[FloatArray]) -> float:
    """Share of the background that is missing behind surfaces, the first numbers of `layers`, as of a
    detector that their photons blind; 0 where nothing says so. What is
    expected there is a pixel's own background before its surface and beside the others, with the
    course over time that pixels show whose surfaces come later.
    """
    seen = photons.count_stretches(BLIND_STRETCHES)
    pixels, number = seen.shape
    length = photons.bins / number
    middle, reach = (np.arange(number) + 0.5) * length, 2 * scene.response.width + length
    late, *others = (middle - layer[..., 0].reshape(-1, 1) for layer in layers)
    before = late < -reach
    for other in others:
        before &= ~(np.abs(other) < reach)
    known = (late > 12 * scene.response.width + length) & (before.sum(axis=0) >= MIN_WITNESSES)
    own, course = np.ones((pixels, 1)), np.ones(number)
    for _ in range(5):
        own = (seen * before).sum(1, keepdims=True) / np.maximum(before @ course, 1e-9)[:, None]
        course = (seen * before).sum(axis=0) / np.maximum((before * own).sum(axis=0), 1e-9)
        expected = own * course
        # more is another surface
        before &= seen <= expected + SURFACE_SIGMAS * np.sqrt(expected + 1)
    light = float((known * expected).sum())
    share = 1 - float((seen * known).sum()) / max(light, 1e-9)
    return share if light > MIN_BLIND_PHOTONS and share > MIN_MISSED_SHARE else 0.0


def keep_significant(photons: PhotonImage, scene: Scene, layer: FloatArray) -> FloatArray:
    """Return a further surface, NaN where the background alone would explain its photons.
    `photons`: those that no nearer surface explains; `layer` (rows, columns, 4).
    """
    reach, surface = 0.5 * scene.response.width + 1, layer[..., 0]
    seen = photons.sum_by_pixel(photons.count * (np.abs(photons.times_after(surface)) <= reach))
    expected = scene.background * (2 * reach + 1) * photons.relative_at(surface).astype(np.float64)
    pooled = np.rint(scipy.ndimage.uniform_filter(seen, 3, mode="nearest") * 9)

    def is_rare(seen: FloatArray, expected: FloatArray, most: float) -> BoolArray:
        # chance of that many photons or more by Poisson's law; scipy.stats loads for a second
        chance = scipy.special.gammainc(np.maximum(seen, 1), expected)
        return (seen > 0) & (chance < most)

    kept = is_rare(seen, expected, MAX_OWN_CHANCE) & is_rare(
        pooled, 9 * expected, MAX_POOLED_CHANCE
    )
    return np.where(kept[..., np.newaxis], layer, np.nan)
