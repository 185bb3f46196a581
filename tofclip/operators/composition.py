"""Operators made of others, and what is done to all views together: several joined into one, some
views of a light field, and the part that all measurements of a view have in common weighed down.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import Array, namespace, zeros
from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import LinearOperator


class Stack(LinearOperator):
    """Operators on the same input, their results joined along the first axis: ``[A; B; ...] x``."""

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        if not operators:
            raise InputError("a stack needs at least one operator")
        first = operators[0]
        for other in operators[1:]:
            if other.shape_in != first.shape_in or other.shape_out[1:] != first.shape_out[1:]:
                raise ShapeError(
                    "every operator of a stack",
                    f"{first.shape_in} -> (any, *{first.shape_out[1:]})",
                    f"{other.shape_in} -> {other.shape_out}",
                )
            if other.dtype != first.dtype:
                raise InputError(
                    f"cannot stack {first.dtype} on {other.dtype}; build both in one type"
                )
        rows = [operator.shape_out[0] for operator in operators]
        super().__init__(first.shape_in, (sum(rows), *first.shape_out[1:]), first.dtype)
        self.operators = tuple(operators)
        self._set_parts(*operators)

    def _forward(self, block: Array) -> Array:
        return namespace(block).concat([operator._forward(block) for operator in self.operators])

    def _adjoint(self, block: Array) -> Array:
        # The adjoint of a stack adds up: every part has looked at the same input.
        total = zeros((*self.shape_in, block.shape[-1]), block)
        for operator, part in _split_rows(self.operators, block):
            total += operator._adjoint(part)
        return total


class BlockDiagonal(LinearOperator):
    """One operator for each entry of the input's first axis, their results joined: ``[A_1 x_1; A_2
    x_2; ...]``.

    With a view's encoder for each view it is the model of a whole 4D light field (supplement Eq.
    20).
    """

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        stacked = Stack(operators)  # refuses operators that do not fit each other
        super().__init__((len(operators), *stacked.shape_in), stacked.shape_out, stacked.dtype)
        self.operators = stacked.operators
        self._set_parts(*operators)

    def _forward(self, block: Array) -> Array:
        # No part sees the input of another, so that there is nothing to add up in either direction.
        parts = [operator._forward(block[k, ...]) for k, operator in enumerate(self.operators)]
        return namespace(block).concat(parts)

    def _adjoint(self, block: Array) -> Array:
        parts = [operator._adjoint(part) for operator, part in _split_rows(self.operators, block)]
        return namespace(block).stack(parts)


class Integration(LinearOperator):
    """The sum of what an operator makes of each entry of the input's first axis: ``[A_1, A_2, ...]
    [x_1; x_2; ...]``.

    With a view's encoder for each view it is the model of a sensor on which all views add up
    (supplement Eq. 19).
    """

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        if not operators:
            raise InputError("an integration needs at least one operator")
        first = operators[0]
        for other in operators[1:]:
            if (other.shape_in, other.shape_out) != (first.shape_in, first.shape_out):
                shapes = (f"{kind.shape_in} -> {kind.shape_out}" for kind in (first, other))
                raise ShapeError("every operator of an integration", *shapes)
            if other.dtype != first.dtype:
                raise InputError(
                    f"cannot add {first.dtype} to {other.dtype}; build both in one type"
                )
        super().__init__((len(operators), *first.shape_in), first.shape_out, first.dtype)
        self.operators = tuple(operators)
        self._set_parts(*operators)

    def _forward(self, block: Array) -> Array:
        total = zeros((*self.shape_out, block.shape[-1]), block)
        for k, operator in enumerate(self.operators):
            total += operator._forward(block[k, ...])
        return total

    def _adjoint(self, block: Array) -> Array:
        # Every entry gets the whole of the measurements back: the sensor did not keep apart what
        # fell on it.
        return namespace(block).stack([operator._adjoint(block) for operator in self.operators])


def _split_rows(
    operators: Sequence[LinearOperator], block: Array
) -> Iterator[tuple[LinearOperator, Array]]:
    """Each operator with its part of their results, which are joined along the first axis."""
    first = 0
    for operator in operators:
        last = first + operator.shape_out[0]
        yield operator, block[first:last, ...]
        first = last


class ViewSelection(LinearOperator):
    """Keeps some of a light field's views; the adjoint leaves the others dark.

    Parameters
    ----------
    light_field_shape : (int, int, int)
        Views, rows, columns.
    kept : sequence of int
        Numbers of the views to keep, without repeats.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        light_field_shape: tuple[int, int, int],
        kept: Sequence[int],
        dtype: DTypeLike = np.float32,
    ) -> None:
        self.view_indices = np.asarray(kept, np.intp)
        if np.unique(self.view_indices).size != self.view_indices.size or not np.all(
            (self.view_indices >= 0) & (self.view_indices < light_field_shape[0])
        ):
            raise InputError(
                f"views to keep must be different numbers from 0 to {light_field_shape[0] - 1}"
            )
        super().__init__(light_field_shape, (self.view_indices.size, *light_field_shape[1:]), dtype)

    def _forward(self, block: Array) -> Array:
        kept: Array = block[self.view_indices]
        return kept

    def _adjoint(self, block: Array) -> Array:
        views = np.zeros((*self.shape_in, block.shape[-1]), self.dtype)
        views[self.view_indices] = block
        return views


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
