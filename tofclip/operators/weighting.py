"""Weighing down what all measurements of a view have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from tofclip.errors import InputError
from tofclip.operators.base import Array, LinearOperator


class MeanWeighting(LinearOperator):
    """``W = I - (1 - w) 11' / m_k`` for each view's m_k measurements: their mean counts w times;
    self-adjoint.

    Codes of 0 and 1 all measure half the picture's sum, which swamps what tells them apart; apply W
    to the measurements and to the operator alike.

    Parameters
    ----------
    counts : sequence of int
        m_k, measurements of each view, in the order of the measurements.
    weight : float
        w, between 0 and 1.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self, counts: Sequence[int], weight: float = 0.02, dtype: DTypeLike = np.float32
    ) -> None:
        if not counts or min(counts) < 1:
            raise InputError("every view needs at least one reading")
        if not 0 <= weight <= 1:
            raise InputError(f"the weight of the mean must lie between 0 and 1, got {weight}")
        super().__init__((sum(counts),), (sum(counts),), dtype)
        self._counts = np.asarray(counts)
        self._starts = np.cumsum(self._counts) - self._counts
        self._removed = 1 - weight

    def _forward(self, block: Array) -> Array:
        means = np.add.reduceat(block, self._starts, axis=0) / self._counts[:, np.newaxis]
        weighted: Array = block - np.repeat(self._removed * means, self._counts, axis=0)
        return weighted.astype(self.dtype)

    def _adjoint(self, block: Array) -> Array:
        return self._forward(block)
