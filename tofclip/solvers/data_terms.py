"""How badly a predicted measurement fits the measurements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from tofclip.arrays import Array, ComputeDevice, is_numpy, namespace, scalar_like
from tofclip.errors import require, require_positive, require_shape
from tofclip.units import MAD_TO_SIGMA

Mask = Array | None


def sum_squares(values: Array) -> Array:
    """Sum of squares of each frame of (measurements, frames) values, float64."""
    if is_numpy(values):  # multiplied and added without a temporary
        return np.einsum("if,if->f", values, values, dtype=np.float64)
    return namespace(values).sum(values * values, axis=0, dtype=namespace(values).float64)


class DataTerm(ABC):
    """A smooth function of the predicted `measurements` (measurements, frames) whose gradient has
    Lipschitz constant 1, frame by frame; `valid` is False where one is saturated or dead, and left out.

    Every one has a gradient of the form ``weights * (predicted - measurements)``, so that a solver
    of quadratic problems can treat it by iteratively reweighted least squares.
    """

    def __init__(self, measurements: Array, valid: Mask = None) -> None:
        if valid is not None:
            require_shape("the mask of valid measurements", measurements.shape, valid.shape)
        xp = namespace(measurements)
        all_good = valid is None or xp.all(valid)
        self.measurements = measurements
        self.valid = None if all_good else xp.astype(valid, measurements.dtype)

    @abstractmethod
    def value(self, predicted: Array) -> Array:
        """Return the misfit of each frame, (frames,) float64, of (measurements, frames)."""

    @abstractmethod
    def weights(self, predicted: Array) -> Array:
        """Return from 0 to 1 what each measurement's residual counts at `predicted`."""

    def gradient(self, predicted: Array) -> Array:
        """Return the derivative with respect to `predicted`, same shape."""
        return self.weights(predicted) * (predicted - self.measurements)

    def dual_value(self, slope: Array, scale: Array) -> Array | None:
        """Return the value of the dual point ``-scale * slope``, (frames,) float64, where the
        conjugate is known: of the `slope` (measurements, frames) that `gradient` returned and a
        `scale` (frames,) from 0 to 1.
        """
        return None

    def squared_length(self, change: Array) -> Array:
        """Return the sum of squares over the valid measurements of each frame, (frames,) float64."""
        return sum_squares(self._apply_mask(change))

    def _apply_mask(self, values: Array) -> Array:
        return values if self.valid is None else values * self.valid


DataTermMaker = Callable[..., DataTerm]
"""Makes the term of a block of (measurements, frames) measurements, and the mask of valid ones."""


class _SquaredNearZero(DataTerm):
    """A data term whose conjugate is ``<dual, f> + 1/2 |dual|^2`` wherever its gradient gets to."""

    def dual_value(self, slope: Array, scale: Array) -> Array:
        xp = namespace(slope)
        # the slope of an invalid measurement is zero
        along = xp.sum(slope * self.measurements, axis=0, dtype=xp.float64)
        return -scale * along - scale**2 / 2 * sum_squares(slope)


class LeastSquares(_SquaredNearZero):
    """``1/2 |W (predicted - measurements)|^2``, W = 0 or 1: right for even, Gaussian errors."""

    def value(self, predicted: Array) -> Array:
        return 0.5 * sum_squares(self.gradient(predicted))

    def weights(self, predicted: Array) -> Array:
        return self._apply_mask(namespace(predicted).ones_like(predicted))

    def gradient(self, predicted: Array) -> Array:
        residual = predicted - self.measurements
        if self.valid is not None:
            residual *= self.valid
        return residual


class ClippedSquares(DataTerm):
    """Least squares of `measurements` that are cut off at a `limit`: those from there on may be
    brighter, and count only while less is predicted. `valid` as for `DataTerm`.
    """

    def __init__(self, measurements: Array, valid: Mask = None, *, limit: float) -> None:
        require_positive("the limit of measurements", limit)
        super().__init__(measurements, valid)
        self._clipped = measurements >= scalar_like(limit, measurements)

    def value(self, predicted: Array) -> Array:
        return 0.5 * sum_squares(self.gradient(predicted))

    def weights(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        counts = ~(self._clipped & (predicted > self.measurements))
        return self._apply_mask(xp.astype(counts, predicted.dtype))


class Huber(_SquaredNearZero):
    """Squares up to a threshold and straight lines beyond: a few wildly wrong measurements do no
    harm. P. J. Huber, Ann. Math. Stat. 35, 73 (1964). `measurements` and `valid` as for
    `DataTerm`; `threshold` in their unit: one to three times `estimate_robust_deviation` is
    usual.
    """

    def __init__(self, measurements: Array, valid: Mask = None, *, threshold: float) -> None:
        require_positive("Huber's threshold", threshold)
        super().__init__(measurements, valid)
        self.threshold = scalar_like(threshold, measurements)

    def value(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        size = xp.abs(predicted - self.measurements)
        kept = xp.minimum(size, self.threshold)
        return xp.sum(self._apply_mask(kept * (size - 0.5 * kept)), axis=0, dtype=xp.float64)

    def weights(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        size = xp.abs(predicted - self.measurements)
        return self._apply_mask(self.threshold / xp.maximum(size, self.threshold))


class Poisson(DataTerm):
    """The negative log-likelihood of photon counts, each residual in units of its own measurement's
    noise.

    Predicted and counted are both divided by a `deviation` (measurements,) of at least ``sqrt(count +
    1)`` beforehand (weigh the operator's rows alike), so that no measurement's curvature at its own
    count is above 1. Below half the deviation's square the logarithm is continued by its parabola,
    whose gradient stays Lipschitz; the whole is divided by the largest curvature.
    """

    CURVATURE = 4.0  # at the knee, where it is largest

    def __init__(self, measurements: Array, valid: Mask = None, *, deviation: Array) -> None:
        require(
            namespace(measurements).min(measurements) >= 0,
            "photon counts must not be negative; take the data term of squares",
        )
        super().__init__(measurements, valid)
        beside = ComputeDevice.of(measurements).put(deviation)
        self.deviation = namespace(measurements).astype(beside, measurements.dtype)[:, None]
        self._counts = measurements * self.deviation
        self._knee = self.deviation**2 / 2
        self._zero = scalar_like(0.0, measurements)

    def value(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        counts, knee = self._counts, self._knee
        expected = predicted * self.deviation
        base = xp.maximum(expected, knee)
        short = xp.minimum(expected - knee, self._zero)
        loss = base - counts * xp.log(base)
        loss += (1 - counts / knee) * short + counts / knee**2 * short**2 / 2
        # the value at predicted = counted, so that a perfect fit costs nothing
        best = counts - counts * xp.log(xp.maximum(counts, scalar_like(1e-30, counts)))
        return xp.sum(self._apply_mask(loss - best), axis=0, dtype=xp.float64) / self.CURVATURE

    def weights(self, predicted: Array) -> Array:
        base = namespace(predicted).maximum(predicted * self.deviation, self._knee)
        return self._apply_mask(self.deviation**2 / base / self.CURVATURE)

    def gradient(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        expected = predicted * self.deviation
        base = xp.maximum(expected, self._knee)
        slope = 1 - self._counts / base
        slope += self._counts / self._knee**2 * xp.minimum(expected - self._knee, self._zero)
        return self._apply_mask(self.deviation / self.CURVATURE * slope)


def estimate_robust_deviation(residual: Array) -> float:
    """Return the standard deviation that Gaussian errors with the median size of `residual` have."""
    deviation = MAD_TO_SIGMA * float(np.median(np.abs(residual)))
    require(
        deviation > 0, "most measurements are met exactly; there is nothing to be robust against"
    )
    return deviation
