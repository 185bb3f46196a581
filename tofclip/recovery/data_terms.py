"""How badly a predicted measurement fits the readings."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import ShapeError

Array = NDArray[Any]


class DataTerm(Protocol):
    """A smooth function of the predicted readings whose gradient has Lipschitz constant 1, frame by frame."""

    def value(self, predicted: Array) -> NDArray[np.float64]:
        """Return the misfit of each frame, (frames,), for `predicted` of shape (readings, frames)."""
        ...

    def gradient(self, predicted: Array) -> Array:
        """Return the derivative with respect to `predicted`, same shape."""
        ...


class LeastSquares:
    """``1/2 |W (predicted - readings)|^2`` for each frame, W = 0 or 1: readings known to be bad are left out.

    Parameters
    ----------
    readings : (readings, frames) array
    good : (readings, frames) bool array, optional
        False where a reading is saturated or dead.
    """

    def __init__(self, readings: Array, good: NDArray[np.bool_] | None = None) -> None:
        if good is not None and good.shape != readings.shape:
            raise ShapeError("the mask of good readings", readings.shape, good.shape)
        self.readings = readings
        self.good = None if good is None or good.all() else good.astype(readings.dtype)

    def value(self, predicted: Array) -> NDArray[np.float64]:
        residual = self.gradient(predicted)
        misfit: NDArray[np.float64] = 0.5 * np.einsum("if,if->f", residual, residual, dtype=np.float64)
        return misfit

    def gradient(self, predicted: Array) -> Array:
        residual: Array = predicted - self.readings
        if self.good is not None:
            residual *= self.good
        return residual
