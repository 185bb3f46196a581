"""How badly a predicted measurement fits the readings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np

from tofclip.arrays import Array, Place, namespace, number
from tofclip.errors import InputError, ShapeError
from tofclip.solvers.loops import loops_for

Mask = Array | None


class DataTerm(ABC):
    """A smooth function of the predicted readings whose gradient has Lipschitz constant 1, frame by frame.

    Every one has a gradient of the form ``weights * (predicted - readings)``, so that a solver of quadratic problems
    can treat it by iteratively reweighted least squares.

    Parameters
    ----------
    readings : (readings, frames) array
    good : (readings, frames) bool array, optional
        False where a reading is saturated or dead: it is left out.
    """

    def __init__(self, readings: Array, good: Mask = None) -> None:
        if good is not None and good.shape != readings.shape:
            raise ShapeError("the mask of good readings", tuple(readings.shape), tuple(good.shape))
        xp = namespace(readings)
        self.readings = readings
        self.good = None if good is None or xp.all(good) else xp.astype(good, readings.dtype)

    @abstractmethod
    def value(self, predicted: Array) -> Array:
        """Return the misfit of each frame, (frames,) float64, for `predicted` of shape (readings, frames)."""

    @abstractmethod
    def weights(self, predicted: Array) -> Array:
        """Return between 0 and 1 what each reading's residual counts at `predicted`, (readings, frames)."""

    def gradient(self, predicted: Array) -> Array:
        """Return the derivative with respect to `predicted`, same shape."""
        return self.weights(predicted) * (predicted - self.readings)

    def _masked(self, values: Array) -> Array:
        return values if self.good is None else values * self.good


class DataTermMaker(Protocol):
    """Makes the data term of a block of frames."""

    def __call__(self, readings: Array, good: Mask = None) -> DataTerm:
        """Return the term for `readings` (readings, frames), those not `good` left out."""
        ...


class LeastSquares(DataTerm):
    """``1/2 |W (predicted - readings)|^2`` for each frame, W = 0 or 1: right for even, Gaussian errors."""

    def value(self, predicted: Array) -> Array:
        residual = self.gradient(predicted)
        return 0.5 * loops_for(residual).squared_sums(residual)

    def weights(self, predicted: Array) -> Array:
        return self._masked(namespace(predicted).ones_like(predicted))

    def gradient(self, predicted: Array) -> Array:
        residual = predicted - self.readings
        if self.good is not None:
            residual *= self.good
        return residual


class Huber(DataTerm):
    """Squares up to a threshold and straight lines beyond: a few wildly wrong readings do no harm.

    P. J. Huber, Ann. Math. Stat. 35, 73 (1964).

    Parameters
    ----------
    readings : (readings, frames) array
    good : (readings, frames) bool array, optional
    threshold : float
        In the unit of the readings; one to three times `robust_deviation` is usual.
    """

    def __init__(self, readings: Array, good: Mask = None, *, threshold: float) -> None:
        if not (np.isfinite(threshold) and threshold > 0):
            raise InputError(f"Huber's threshold must be positive, got {threshold}")
        super().__init__(readings, good)
        self.threshold = number(threshold, readings)

    def value(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        size = xp.abs(predicted - self.readings)
        kept = xp.minimum(size, self.threshold)
        return xp.sum(self._masked(kept * (size - 0.5 * kept)), axis=0, dtype=xp.float64)

    def weights(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        size = xp.abs(predicted - self.readings)
        return self._masked(self.threshold / xp.maximum(size, self.threshold))


class Poisson(DataTerm):
    """The negative log-likelihood of photon counts, each residual in units of its own reading's noise.

    Predicted and counted are both divided by a `deviation` of at least ``sqrt(count + 1)`` beforehand (weigh the
    operator's rows alike), so that no reading's curvature at its own count is above 1. Below half the deviation's
    square the logarithm is continued by its parabola, whose gradient stays Lipschitz; the whole is divided by the
    largest curvature.

    Parameters
    ----------
    readings : (readings, frames) array
        Counts over `deviation`.
    good : (readings, frames) bool array, optional
    deviation : (readings,) array
    """

    CURVATURE = 4.0  # at the knee, where it is largest

    def __init__(self, readings: Array, good: Mask = None, *, deviation: Array) -> None:
        if namespace(readings).min(readings) < 0:
            raise InputError("photon counts must not be negative; take the data term of squares")
        super().__init__(readings, good)
        beside = Place.of(readings).put(deviation)
        self.deviation = namespace(readings).astype(beside, readings.dtype)[:, None]
        self._counted = readings * self.deviation
        self._knee = self.deviation**2 / 2
        self._nothing = number(0.0, readings)

    def value(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        expected = predicted * self.deviation
        base = xp.maximum(expected, self._knee)
        short = xp.minimum(expected - self._knee, self._nothing)
        loss = base - self._counted * xp.log(base)
        loss += (1 - self._counted / self._knee) * short + self._counted / self._knee**2 * short**2 / 2
        best = self._counted - self._counted * xp.log(xp.maximum(self._counted, number(1e-30, self._counted)))
        return xp.sum(self._masked(loss - best), axis=0, dtype=xp.float64) / self.CURVATURE

    def weights(self, predicted: Array) -> Array:
        base = namespace(predicted).maximum(predicted * self.deviation, self._knee)
        return self._masked(self.deviation**2 / base / self.CURVATURE)

    def gradient(self, predicted: Array) -> Array:
        xp = namespace(predicted)
        expected = predicted * self.deviation
        base = xp.maximum(expected, self._knee)
        slope = 1 - self._counted / base
        slope += self._counted / self._knee**2 * xp.minimum(expected - self._knee, self._nothing)
        return self._masked(self.deviation / self.CURVATURE * slope)


def robust_deviation(residual: Array) -> float:
    """Return the standard deviation that Gaussian errors with the median size of `residual` have.

    Raises
    ------
    InputError
        More than half of the residual is zero: there is no scale to be had.
    """
    deviation = 1.4826 * float(np.median(np.abs(residual)))
    if not deviation > 0:
        raise InputError("most readings are met exactly; there is nothing to be robust against")
    return deviation
