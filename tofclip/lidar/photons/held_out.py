"""What photons that were held back say of a surface that the others found: how well it explains them,
which response and which reach of planes explain them best, and how probable an outlier is.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.errors import InputError
from tofclip.lidar.photons.image import PhotonImage
from tofclip.lidar.photons.matching import PLANE_ROUNDS, TRIAL_ROUNDS, fit_surface
from tofclip.lidar.photons.scene import MIN_SHAPE_BINS, BinnedResponse, Scene, learn_response

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
MAX_JUDGED_PIXELS = 20_000  # evenly chosen, that the outlier probability is learnt from


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

    response = scene.response
    flat, shading = np.ascontiguousarray(surface, dtype=np.float64).ravel(), train.shading
    pixels = np.arange(flat.size)
    late = train.bin - flat[train.pixel]
    inside = (late >= response.start) & (late <= response.width - response.start)
    length = response.width - 2 * response.start
    seen = np.bincount(train.pixel, train.count * inside, flat.size).reshape(surface.shape)
    pooled, total = (
        scipy.ndimage.uniform_filter(part, signal_pool, mode="nearest")
        for part in (seen, train.photons_per_pixel)
    )
    # Background within the response's length, as dense as outside of it where it is as bright.
    even = np.bincount(train.pixel, train.count * ~inside / train.relative, flat.size)
    even = scipy.ndimage.uniform_filter(even.reshape(surface.shape), signal_pool, mode="nearest")
    here = 1.0 if shading is None else shading.at(pixels, flat).reshape(surface.shape)
    outside = even * here * length / max(train.bins - length, 1)
    # That all is signal is never claimed: one photon against it would decide for the pixel. More
    # than there is would count against every surface in a hundred times as much background.
    signal = np.clip((pooled - outside) / np.maximum(total, 1e-9), MIN_SIGNAL_SHARE, 0.98)
    evidence, course = np.empty(flat.size), test.relative
    if shading is not None:
        course = course / shading.average().at(pixels, flat)[test.pixel]
    sampled = response.density * train.bins, response.start, response.step, signal.ravel()
    kernels.sum_evidence(test.offsets, test.bin, test.count, course, flat, *sampled, evidence)
    return evidence


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
    """Find the reach of planes, in pixels, that explains the photons held back best, and what
    `fit_surface` gives with it.
    """
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
    margin: NDArray[np.float32],
) -> Callable[[NDArray[np.float32]], FloatArray]:
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

    def doubt(value: NDArray[np.float32], weight: float, rivals: float) -> FloatArray:
        odds = np.log(rivals) - weight * np.maximum(value, 0).astype(np.float64)
        return np.asarray(scipy.special.expit(odds))

    def weigh(choice: tuple[float, float]) -> float:
        wrong = doubt(margin.ravel()[some], *choice)
        prior = (np.log(choice[0] / MARGIN_WEIGHT) / MARGIN_WEIGHT_SPREAD) ** 2
        prior += (np.log(choice[1]) / RIVAL_SPREAD) ** 2
        return float(np.sum(np.log((1 - wrong) * for_surface + wrong)) - prior / 2)

    weight, rivals = max(itertools.product(MARGIN_WEIGHTS, RIVALS), key=weigh)
    return lambda value: doubt(value, weight, rivals)
