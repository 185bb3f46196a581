"""What photons that were held back say of a surface that the others found: how well it explains them,
which response and which reach of planes explain them best, and how probable an outlier is.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar.photons.image import FloatArray, PhotonImage
from tofclip.lidar.photons.planes import PLANE_ROUNDS, TRIAL_ROUNDS, fit_surface
from tofclip.lidar.photons.response import BinnedResponse, Scene, learn_response

REACHES_PX = (1, 2, 3, 4, 6, 8)

RESPONSE_ROUNDS = 3

RESPONSE_REACH_PX = 3

MIN_LEARNT_GAIN, MIN_LEARNT_SIGNIFICANCE = 500.0, 5.0
"""Log-likelihood, and its standard deviations, by which a learnt response has to beat a given one;
its free shape alone gains some hundred."""

SIGNAL_POOL_PX = 5
WIDER_POOLS_PX = (SIGNAL_POOL_PX, 9, 17, 33, 65)

MARGIN_WEIGHT, MARGIN_WEIGHT_SPREAD = 1 / 7, 0.5
"""Log odds in a unit of a label's margin, and how far (in its logarithm) scenes differ in it: eight
paths count what they share several times. In 16 simulated scenes of 0.7 to 20 signal and 2 to 200
background photons the weight was 0.076 to 0.28."""

RIVAL_SPREAD = 0.5
"""Of the logarithm of the number of labels that rival the best one: about one on surfaces (0.6 to
2.4 in the same scenes), many where no light comes back."""

MARGIN_WEIGHTS, RIVALS = np.geomspace(0.03, 0.8, 24), np.geomspace(0.5, 256, 10)
MAX_JUDGED_PIXELS = 20_000
"""Pixels, evenly chosen, that the outlier probability is learnt from."""


def weigh_evidence(
    test: PhotonImage,
    train: PhotonImage,
    scene: Scene,
    surface: FloatArray,
    signal_pool: int = SIGNAL_POOL_PX,
) -> FloatArray:
    """Log-likelihood ratio of each pixel's held-back photons: this surface against any instant.

    `test, train`: the photons held back, and those that found the surface; `surface` (rows,
    columns): in bins; `signal_pool`: side of the square of pixels, in pixels, whose share of signal
    photons is taken as one. Returns (pixels,).
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    response = scene.response
    flat = np.ascontiguousarray(surface, dtype=np.float64).ravel()
    ahead = response.start
    late = train.bin - flat[train.pixel]
    inside = (late >= ahead) & (late <= -ahead + response.width)
    length = response.width - 2 * ahead
    seen = np.bincount(train.pixel, train.count * inside, flat.size).reshape(surface.shape)
    whole = train.photons_per_pixel
    pooled, total = (
        scipy.ndimage.uniform_filter(part, signal_pool, mode="nearest") for part in (seen, whole)
    )
    # Background within the response's length, as dense as outside of it.
    outside = np.maximum(total - pooled, 0) * length / max(train.bins - length, 1)
    # Neither certainty is ever claimed: one photon against it would decide for the pixel.
    signal = np.clip((pooled - outside) / np.maximum(total, 1e-9), 0.02, 0.98)
    evidence = np.empty(flat.size)
    density = response.density * train.bins
    kernels.sum_evidence(
        test.offsets,
        test.bin,
        test.count,
        flat,
        density,
        response.start,
        response.step,
        signal.ravel(),
        evidence,
    )
    return evidence


def judge_surface(
    test: PhotonImage, train: PhotonImage, scene: Scene, surface: FloatArray
) -> float:
    """Mean log-likelihood of the photons that were held back; see `weigh_evidence`.

    `test, train`: photons held back, and those that the surface was found from; `surface` (rows,
    columns): instants, bins. Returns nats per photon.
    """
    return float(weigh_evidence(test, train, scene, surface).mean())


def learn_scene(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray, required: bool
) -> BinnedResponse | None:
    """Learn the response from the photons held back, around the surface that the others found.

    `scene`: with the response that is known so far; `surface` (rows, columns): in bins; `required`:
    there is no other response to stay with. Returns none if the response known so far explains the
    photons as well.
    """
    fitted = fit_surface(train, scene, surface, RESPONSE_REACH_PX)[..., 0]
    before = weigh_evidence(test, train, scene, fitted)
    for _ in range(RESPONSE_ROUNDS):
        residual = test.bin - fitted.ravel()[test.pixel]
        pulse, later = learn_response(residual, test.count, scene.response.width, train.bin_width)
        scene = Scene(BinnedResponse(pulse, train.bin_width), scene.background)
        fitted = fit_surface(train, scene, fitted + later, RESPONSE_REACH_PX, TRIAL_ROUNDS)[..., 0]
    gain = weigh_evidence(test, train, scene, fitted) - before
    clear = MIN_LEARNT_SIGNIFICANCE * np.sqrt(gain.size) * gain.std() + MIN_LEARNT_GAIN
    return scene.response if required or gain.sum() > clear else None


def choose_reach(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray
) -> tuple[int, FloatArray]:
    """Find the reach of the planes that explains the photons held back best.

    `surface` (rows, columns): in bins. Returns pixels, and the surface that it gives.
    """
    best, chosen, highest = REACHES_PX[0], surface, -np.inf
    rounds = PLANE_ROUNDS
    for reach in REACHES_PX:
        if reach > REACHES_PX[0] and 2 * reach + 1 > min(surface.shape):
            break
        surface = fit_surface(train, scene, surface, reach, rounds)[..., 0]
        rounds = TRIAL_ROUNDS
        value = judge_surface(test, train, scene, surface)
        if value <= highest:
            break
        best, chosen, highest = reach, surface, value
    return best, chosen


def calibrate_outliers(
    test: PhotonImage,
    train: PhotonImage,
    scene: Scene,
    surface: FloatArray,
    margin: NDArray[np.float32],
) -> Callable[[NDArray[np.float32]], FloatArray]:
    """Learn the probability of an outlier from what the photons held back say.

    The margin between two labels is what the paths make of the log odds: the probability is a
    logistic function of it, one half where two labels are as good and the others are not. Its slope
    and the number of rivals are the most likely ones given the photons held back, in which right
    and wrong pixels are mixed.

    `surface` (rows, columns): in bins; `margin` (rows, columns): by how much the label of each
    pixel beat the others. Returns turns margins into probabilities.
    """
    # Noise of the assumed share of signal makes surfaces look surer than they are: it is taken from
    # as large a neighbourhood as explains the photons best.
    # Nor does a response explain the photons that it was learnt from as it does others, or one that
    # is given what a surface that is slightly off shows: either half is judged by the other one's.
    one, other = test.split(0.5, 0)
    evidence = np.zeros(surface.size)
    for teacher, part in ((other, one), (one, other)):
        evidence += _weigh_best_pooled(part, train, *_learn_anew(teacher, scene, surface))
    some = slice(None, None, -(-margin.size // MAX_JUDGED_PIXELS))
    for_surface = np.exp(np.clip(evidence[some], -30, 30))
    known = np.maximum(margin.ravel()[some], 0).astype(np.float64)

    def weigh(choice: tuple[np.float64, np.float64]) -> float:
        weight, rivals = choice
        wrong = _logistic(np.log(rivals) - weight * known)
        prior = (np.log(weight / MARGIN_WEIGHT) / MARGIN_WEIGHT_SPREAD) ** 2
        prior += (np.log(rivals) / RIVAL_SPREAD) ** 2
        return float(np.sum(np.log((1 - wrong) * for_surface + wrong)) - prior / 2)

    weight, rivals = max(itertools.product(MARGIN_WEIGHTS, RIVALS), key=weigh)

    def to_probability(value: NDArray[np.float32]) -> FloatArray:
        return _logistic(np.log(rivals) - weight * np.maximum(value, 0).astype(np.float64))

    return to_probability


def _learn_anew(
    teacher: PhotonImage, scene: Scene, surface: FloatArray
) -> tuple[Scene, FloatArray]:
    """Return scene and surface with the response that these photons show, if they show one."""
    residual = teacher.bin - surface.ravel()[teacher.pixel]
    width = scene.response.width
    try:
        pulse, later = learn_response(residual, teacher.count, width, teacher.bin_width)
    except InputError:
        return scene, surface
    return Scene(BinnedResponse(pulse, teacher.bin_width), scene.background), surface + later


def _weigh_best_pooled(
    test: PhotonImage,
    train: PhotonImage,
    scene: Scene,
    surface: FloatArray,
) -> FloatArray:
    """Return the evidence of each pixel, with the share of signal pooled as explains most."""
    candidates = (weigh_evidence(test, train, scene, surface, pool) for pool in WIDER_POOLS_PX)
    return max(candidates, key=lambda evidence: float(evidence.sum()))


def _logistic(value: FloatArray) -> FloatArray:
    # exp does not overflow, and at 40 the result is 0 or 1 within 1e-17
    result: FloatArray = 1 / (1 + np.exp(-np.clip(value, -40, 40)))
    return result
