"""What photons that were held back say of a surface that the others found: how well it explains them,
which response and which reach of planes explain them best, and how probable an outlier is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.lidar.photons.photon_image import FloatArray, PhotonImage
from tofclip.lidar.photons.planes import PLANE_ROUNDS, TRIAL_ROUNDS, fit_surface
from tofclip.lidar.photons.response import BinnedResponse, learn_response
from tofclip.lidar.photons.scene import Scene

REACHES_PX = (1, 2, 3, 4, 6, 8)

RESPONSE_ROUNDS = 3

RESPONSE_REACH_PX = 3

MIN_LEARNT_GAIN, MIN_LEARNT_SIGNIFICANCE = 500.0, 5.0
"""Log-likelihood, and its standard deviations, by which a learnt response has to beat a given one;
its free shape alone gains some hundred."""

SIGNAL_POOL_PX = 5


def weigh_evidence(
    test: PhotonImage, train: PhotonImage, scene: Scene, surface: FloatArray
) -> FloatArray:
    """Log-likelihood ratio of each pixel's held-back photons: this surface against any instant.

    Parameters
    ----------
    test, train : PhotonImage
        The photons held back, and those that found the surface.
    scene : Scene
    surface : (rows, columns) array
        In bins.

    Returns
    -------
    (pixels,) array
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
        scipy.ndimage.uniform_filter(part, SIGNAL_POOL_PX, mode="nearest") for part in (seen, whole)
    )
    outside = np.maximum(total - pooled, 0) * length / max(train.bins - length, 1)
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

    Parameters
    ----------
    test, train : PhotonImage
        Photons held back, and those that the surface was found from.
    scene : Scene
    surface : (rows, columns) float64 array
        Instants, bins.

    Returns
    -------
    float
        Nats per photon.
    """
    return float(weigh_evidence(test, train, scene, surface).mean())


def learn_scene(
    train: PhotonImage, test: PhotonImage, scene: Scene, surface: FloatArray, required: bool
) -> BinnedResponse | None:
    """Learn the response from the photons held back, around the surface that the others found.

    Parameters
    ----------
    train, test : PhotonImage
    scene : Scene
        With the response that is known so far.
    surface : (rows, columns) array
        In bins.
    required : bool
        There is no other response to stay with.

    Returns
    -------
    BinnedResponse or None
        None if the response known so far explains the photons as well.
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

    Parameters
    ----------
    train, test : PhotonImage
    scene : Scene
    surface : (rows, columns) array
        In bins.

    Returns
    -------
    int, (rows, columns) array
        Pixels, and the surface that it gives.
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
    margin: NDArray[np.float32], evidence: FloatArray
) -> Callable[[NDArray[np.float32]], FloatArray]:
    """Learn the probability of an outlier from what the photons held back say.

    Parameters
    ----------
    margin : (pixels,) array
        By how much the label of each pixel beat the others.
    evidence : (pixels,) array
        See `weigh_evidence`.

    Returns
    -------
    callable
        Turns margins into probabilities: a logistic curve of the margin's logarithm.
    """
    feature = np.log1p(np.maximum(margin, 0)).astype(np.float64)
    ratio = np.clip(evidence, -30, 30)

    def misfit(coefficients: FloatArray) -> float:
        wrong = _logistic(coefficients[0] - np.exp(coefficients[1]) * feature)
        return -float(np.mean(np.log((1 - wrong) * np.exp(ratio) + wrong)))

    found = scipy.optimize.minimize(misfit, np.array([0.0, 0.0]), method="Nelder-Mead").x

    def to_probability(value: NDArray[np.float32]) -> FloatArray:
        known = np.log1p(np.maximum(value, 0)).astype(np.float64)
        return _logistic(found[0] - np.exp(found[1]) * known)

    return to_probability


def _logistic(value: FloatArray) -> FloatArray:
    # exp does not overflow, and at 40 the result is 0 or 1 within 1e-17
    result: FloatArray = 1 / (1 + np.exp(-np.clip(value, -40, 40)))
    return result
