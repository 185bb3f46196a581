"""Effects that measurements have in common, with those of their shots and of their pixels apart.

A measurement of pixel p in shot s is ``A theta + b_s + o_p + noise``: fixed effects theta, and shots
and pixels whose own effects are drawn from normal distributions with unknown variances. These
variances are estimated with the effects (restricted maximum likelihood by the EM algorithm: Laird
and Ware, Biometrics 38, 963 (1982)), so that an effect that the measurements do not show is pulled
to zero and standard deviations hold whatever varies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

EM_ROUNDS = 10, 60
"""At most: a rough estimate to tell what does not belong, then the one that counts."""

EM_TOLERANCE = 5e-3
"""Change of the variances below which they are known, relative to themselves or to what the noise
makes of a shot's or a pixel's mean."""

MAX_FITTED_PIXELS = 4096
"""That say how large the variances are; all pixels are solved for."""

OUTLIER_SIGMA = 4.5
"""Standard deviations beyond which a measurement is left out: of normal errors, one in 150,000."""

CORRELATION_BLOCK_PX = 6
TINY = 1e-30


@dataclass(frozen=True)
class Measurements:
    """Measurements of one quantity in many pixels and several shots."""

    value: FloatArray  # (n,), with one standard deviation, right up to a factor
    sigma: FloatArray  # (n,), with one standard deviation, right up to a factor
    design: FloatArray  # (n, effects), fixed effects
    shot: NDArray[np.int64]  # (n,), numbers from 0
    pixel: NDArray[np.int64]  # (n,), numbers from 0
    place: tuple[NDArray[np.int64], NDArray[np.int64]]  # row and column of the pixel

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Measurements:
        return Measurements(
            self.value[chosen],
            self.sigma[chosen],
            self.design[chosen],
            self.shot[chosen],
            self.pixel[chosen],
            (self.place[0][chosen], self.place[1][chosen]),
        )


@dataclass(frozen=True)
class Variances:
    """What varies."""

    noise: float  # factor of the measurements' own variances
    shots: float  # variances of the shots' and the pixels' effects; 0: none
    pixels: float  # variances of the shots' and the pixels' effects; 0: none


@dataclass(frozen=True)
class Effects:
    """What was found."""

    fixed: FloatArray  # (effects,)
    covariance: FloatArray  # (effects, effects), of the fixed effects
    shots: FloatArray  # (shots,), each shot's own
    pixels: FloatArray  # (pixels,), each pixel's own, and its standard deviation
    pixel_sigma: FloatArray  # (pixels,), each pixel's own, and its standard deviation
    variances: Variances
    inliers: NDArray[np.bool_]  # (n,), measurements that were used


@dataclass(frozen=True)
class _Solution:
    fixed: FloatArray
    shots: FloatArray
    pixels: FloatArray
    covariance: FloatArray
    pixel_variance: FloatArray
    residual: FloatArray
    fitted_variance: FloatArray


def fit_effects(data: Measurements, with_shots: bool = True, with_pixels: bool = True) -> Effects:
    """Estimate all effects and what they vary by.

    `with_shots, with_pixels`: whether shots and pixels have effects of their own.
    """
    shots, pixels = int(data.shot.max()) + 1, int(data.pixel.max()) + 1
    step = -(-pixels // MAX_FITTED_PIXELS)
    inliers = np.ones(data.value.size, bool)
    for rounds in EM_ROUNDS:
        chosen = inliers & (data.pixel % step == 0)
        variances = _estimate_variances(
            data[chosen], (shots, pixels), (with_shots, with_pixels), rounds
        )
        found = _solve(data[inliers], variances, (shots, pixels))
        everything = _predict(data, found)
        distance = np.abs(data.value - everything) / (data.sigma * np.sqrt(variances.noise))
        inliers = distance < OUTLIER_SIGMA
    used = data[inliers]
    found = _solve(used, variances, (shots, pixels))
    company = measure_correlation(found.residual / (used.sigma * np.sqrt(variances.noise)), used)
    # Errors that neighbours share do not average out: as many measurements as are independent.
    fewer = Variances(variances.noise * company, variances.shots, variances.pixels)
    effects = data.design.shape[1]
    covariance = _solve(used, fewer, (shots, pixels)).covariance[:effects, :effects]
    if variances.shots > 0:
        still = replace(fewer, shots=0.0)
        without = _solve(used, still, (shots, pixels)).covariance[:effects, :effects]
        # What a handful of shots say of their own spread is uncertain itself: Student's t.
        freedom = max(shots - effects, 1)
        widened = float(scipy.special.stdtrit(freedom, scipy.special.ndtr(1.0))) ** 2
        covariance = without + widened * (covariance - without)
    return Effects(
        found.fixed,
        covariance,
        found.shots,
        found.pixels,
        np.sqrt(found.pixel_variance),
        variances,
        inliers,
    )


def measure_correlation(standardised: FloatArray, data: Measurements) -> float:
    """Return how many neighbouring pixels share one error: 1 where each has its own.

    `standardised` (n,): residuals in standard deviations. Returns variance of the sums over blocks
    of pixels, over that of independent errors; 1 where the difference is within chance.
    """
    row, column = (place // CORRELATION_BLOCK_PX for place in data.place)
    blocks = np.stack([data.shot, row, column], axis=1)
    _, block, number = np.unique(blocks, axis=0, return_inverse=True, return_counts=True)
    sums = np.bincount(block.ravel(), standardised)
    large = number > CORRELATION_BLOCK_PX
    if large.sum() < 2:
        return 1.0
    mean_square = float(np.mean(standardised**2))
    excess = float(np.mean(sums[large] ** 2 / number[large])) / max(mean_square, TINY)
    # The mean of m squares of normal numbers varies by the root of 2 / m.
    chance = 3 * np.sqrt(2 / large.sum())
    return excess if excess > 1 + chance else 1.0


def _estimate_variances(
    data: Measurements, sizes: tuple[int, int], present: tuple[bool, bool], rounds: int
) -> Variances:
    """Estimate what varies, from the scatter of the means over shots and over pixels.

    `sizes`: numbers of shots and of pixels; `present`: whether shots and pixels have effects of
    their own; `rounds`: at most.
    """
    start = _solve(data, Variances(1.0, 0.0, 0.0), sizes)
    if data.value.size <= data.design.shape[1]:
        # Nothing is left over that would tell the noise: the measurements' own deviations hold.
        return Variances(1.0, 0.0, 0.0)
    scatter = float(np.mean(start.residual**2 / data.sigma**2))
    typical = scatter * float(np.median(data.sigma**2))
    seen = [np.unique(data.shot), np.unique(data.pixel)]
    # What the noise alone makes of the means over shots and over pixels.
    least = [typical * one.size / data.value.size for one in seen]
    groups = zip((data.shot, data.pixel), sizes, seen, least, strict=True)
    spread = [
        max(float(np.var(_average(start.residual, group, size)[which])), floor)
        for group, size, which, floor in groups
    ]
    now = Variances(max(scatter, TINY), present[0] * spread[0], present[1] * spread[1])
    effects = data.design.shape[1]
    for _ in range(rounds):
        found = _solve(data, now, sizes)
        squares = (found.residual**2 + found.fitted_variance) / data.sigma**2
        own = np.diagonal(found.covariance)[effects:]
        later = Variances(
            max(float(np.mean(squares)), TINY),
            float(np.mean(found.shots**2 + own)) if present[0] else 0.0,
            float(np.mean((found.pixels**2 + found.pixel_variance)[seen[1]]))
            if present[1]
            else 0.0,
        )
        pairs = zip(
            (later.noise, later.shots, later.pixels),
            (now.noise, now.shots, now.pixels),
            strict=True,
        )
        settled = all(abs(new - old) <= EM_TOLERANCE * old for new, old in pairs)
        now = later
        if settled:
            break
    return now


def _average(values: FloatArray, group: NDArray[np.int64], size: int) -> FloatArray:
    """Mean of the values of each group; 0 of empty ones."""
    means: FloatArray = np.bincount(group, values, size) / np.maximum(
        np.bincount(group, minlength=size), 1
    )
    return means


def _solve(data: Measurements, variances: Variances, sizes: tuple[int, int]) -> _Solution:
    """Solve for all effects at once; those of pixels are eliminated first.

    `sizes`: numbers of shots and of pixels.
    """
    shots, pixels = sizes
    weight = 1 / (variances.noise * data.sigma**2)
    effects = data.design.shape[1]
    columns = [data.design]
    prior = np.zeros(effects)
    if variances.shots > 0:
        columns.append((data.shot[:, np.newaxis] == np.arange(shots)).astype(np.float64))
        prior = np.r_[prior, np.full(shots, 1 / variances.shots)]
    design = np.concatenate(columns, axis=1)
    weighted = design * weight[:, np.newaxis]
    normal, moment = design.T @ weighted + np.diag(prior), weighted.T @ data.value
    gather = np.zeros((pixels, design.shape[1]))
    total = np.full(pixels, np.inf)
    sums = np.zeros(pixels)
    if variances.pixels > 0:
        for number, column in enumerate(weighted.T):
            gather[:, number] = np.bincount(data.pixel, column, pixels)
        total[:] = np.bincount(data.pixel, weight, pixels) + 1 / variances.pixels
        sums[:] = np.bincount(data.pixel, weight * data.value, pixels)
        normal = normal - gather.T @ (gather / total[:, np.newaxis])
        moment = moment - gather.T @ (sums / total)
    # Columns of very different units are scaled, so that none is lost in rounding.
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal), TINY))
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True)
    covariance = inverse * np.outer(scale, scale)
    theta = covariance @ moment
    leverage: FloatArray = gather / total[:, np.newaxis]
    own = (sums / total) - leverage @ theta
    shot_effects = theta[effects:] if variances.shots > 0 else np.zeros(shots)
    own_variance = 1 / total + np.einsum("pi,ij,pj->p", leverage, covariance, leverage)
    # The variance of what is fitted to each measurement: effects as they are seen beside its pixel.
    beside = design - leverage[data.pixel]
    fitted = np.einsum("ni,ij,nj->n", beside, covariance, beside) + 1 / total[data.pixel]
    residual = data.value - design @ theta - own[data.pixel]
    if variances.shots == 0:
        covariance = np.pad(covariance, (0, shots))
    return _Solution(theta[:effects], shot_effects, own, covariance, own_variance, residual, fitted)


def _predict(data: Measurements, found: _Solution) -> FloatArray:
    predicted: FloatArray = (
        data.design @ found.fixed + found.shots[data.shot] + found.pixels[data.pixel]
    )
    return predicted
