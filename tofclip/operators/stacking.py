"""Several operators joined into one: on the same input, on parts of it, or adding up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

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
