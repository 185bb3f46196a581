"""Linear operators: exact shapes, an adjoint beside every forward, composition with ``@``.

An operator maps arrays of `shape_in` to arrays of `shape_out`. A batch is one explicit last axis more; nothing is
flattened or broadcast behind the caller's back.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import InputError, ShapeError

Array = NDArray[Any]
Shape = tuple[int, ...]

REAL_TYPES = (np.dtype(np.float32), np.dtype(np.float64))


class LinearOperator(ABC):
    """A linear map between real arrays of fixed shapes.

    Subclasses write `_forward` and `_adjoint`, which get a contiguous block of the operator's own type with the batch
    as last axis, and return one.

    Parameters
    ----------
    shape_in, shape_out : tuple of int
        Shapes without the batch axis.
    dtype : dtype
        float32 or float64; inputs are converted to it, results have it.
    """

    def __init__(self, shape_in: Shape, shape_out: Shape, dtype: DTypeLike = np.float32) -> None:
        self.shape_in = tuple(int(n) for n in shape_in)
        self.shape_out = tuple(int(n) for n in shape_out)
        self.dtype = np.dtype(dtype)
        if self.dtype not in REAL_TYPES:
            raise InputError(f"operators work in float32 or float64, not {self.dtype}")
        if min((*self.shape_in, *self.shape_out)) < 1:
            raise ShapeError("an operator", "at least one element on both sides", (shape_in, shape_out))

    @abstractmethod
    def _forward(self, block: Array) -> Array:
        """Apply to a block of shape ``shape_in + (batch,)``."""

    @abstractmethod
    def _adjoint(self, block: Array) -> Array:
        """Apply the adjoint to a block of shape ``shape_out + (batch,)``."""

    def __call__(self, x: ArrayLike) -> Array:
        """Apply the operator to an array of shape `shape_in`, or `shape_in` and a batch axis."""
        block, single = self._as_block(x, self.shape_in, "the operand")
        result = self._forward(block)
        return result[..., 0] if single else result

    def adjoint(self, y: ArrayLike) -> Array:
        """Apply the adjoint to an array of shape `shape_out`, or `shape_out` and a batch axis."""
        block, single = self._as_block(y, self.shape_out, "the adjoint's operand")
        result = self._adjoint(block)
        return result[..., 0] if single else result

    def _as_block(self, values: ArrayLike, shape: Shape, what: str) -> tuple[Array, bool]:
        array = np.asarray(values)
        single = array.shape == shape
        if not single and array.shape[:-1] != shape:
            raise ShapeError(what, f"{shape} or {shape} and a batch axis", array.shape)
        if np.iscomplexobj(array):
            raise InputError(f"{what} must be real, got {array.dtype}")
        if single:
            array = array[..., np.newaxis]
        return np.ascontiguousarray(array, dtype=self.dtype), single

    @property
    def H(self) -> LinearOperator:  # noqa: N802 - the field's own symbol
        """The adjoint as an operator."""
        return Adjoint(self)

    def __matmul__(self, other: LinearOperator) -> LinearOperator:
        """Compose: ``(A @ B)(x) = A(B(x))``."""
        return Composition(self, other)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.shape_in} -> {self.shape_out}, {self.dtype})"


class Adjoint(LinearOperator):
    """The adjoint of an operator; its own adjoint is the operator itself."""

    def __init__(self, operator: LinearOperator) -> None:
        super().__init__(operator.shape_out, operator.shape_in, operator.dtype)
        self.operator = operator

    def _forward(self, block: Array) -> Array:
        return self.operator._adjoint(block)

    def _adjoint(self, block: Array) -> Array:
        return self.operator._forward(block)

    @property
    def H(self) -> LinearOperator:  # noqa: N802
        """The operator this is the adjoint of."""
        return self.operator


class Composition(LinearOperator):
    """``outer(inner(x))``."""

    def __init__(self, outer: LinearOperator, inner: LinearOperator) -> None:
        if outer.shape_in != inner.shape_out:
            raise ShapeError("the inner operator's result", outer.shape_in, inner.shape_out)
        if outer.dtype != inner.dtype:
            raise InputError(f"cannot compose {outer.dtype} with {inner.dtype}; build both in one type")
        super().__init__(inner.shape_in, outer.shape_out, outer.dtype)
        self.outer, self.inner = outer, inner

    def _forward(self, block: Array) -> Array:
        return self.outer._forward(self.inner._forward(block))

    def _adjoint(self, block: Array) -> Array:
        return self.inner._adjoint(self.outer._adjoint(block))


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
                raise InputError(f"cannot stack {first.dtype} on {other.dtype}; build both in one type")
        rows = [operator.shape_out[0] for operator in operators]
        super().__init__(first.shape_in, (sum(rows), *first.shape_out[1:]), first.dtype)
        self.operators = tuple(operators)
        self._cuts = np.cumsum(rows)[:-1]

    def _forward(self, block: Array) -> Array:
        return np.concatenate([operator._forward(block) for operator in self.operators])

    def _adjoint(self, block: Array) -> Array:
        total = np.zeros((*self.shape_in, block.shape[-1]), self.dtype)
        for operator, part in zip(self.operators, np.split(block, self._cuts), strict=True):
            total += operator._adjoint(part)
        return total


class BlockDiagonal(LinearOperator):
    """One operator for each entry of the input's first axis, their results joined: ``[A_1 x_1; A_2 x_2; ...]``.

    With a view's encoder for each view it is the model of a whole 4D light field (supplement Eq. 20).
    """

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        stacked = Stack(operators)  # refuses operators that do not fit each other
        super().__init__((len(operators), *stacked.shape_in), stacked.shape_out, stacked.dtype)
        self.operators = stacked.operators
        self._cuts = np.cumsum([operator.shape_out[0] for operator in operators])[:-1]

    def _forward(self, block: Array) -> Array:
        pairs = zip(self.operators, block, strict=True)
        return np.concatenate([operator._forward(part) for operator, part in pairs])

    def _adjoint(self, block: Array) -> Array:
        pairs = zip(self.operators, np.split(block, self._cuts), strict=True)
        return np.stack([operator._adjoint(part) for operator, part in pairs])


class Integration(LinearOperator):
    """The sum of what an operator makes of each entry of the input's first axis: ``[A_1, A_2, ...] [x_1; x_2; ...]``.

    With a view's encoder for each view it is the model of a sensor on which all views add up (supplement Eq. 19).
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
                raise InputError(f"cannot add {first.dtype} to {other.dtype}; build both in one type")
        super().__init__((len(operators), *first.shape_in), first.shape_out, first.dtype)
        self.operators = tuple(operators)

    def _forward(self, block: Array) -> Array:
        total = np.zeros((*self.shape_out, block.shape[-1]), self.dtype)
        for operator, part in zip(self.operators, block, strict=True):
            total += operator._forward(part)
        return total

    def _adjoint(self, block: Array) -> Array:
        return np.stack([operator._adjoint(block) for operator in self.operators])


class Identity(LinearOperator):
    """Leaves everything as it is; composed with another operator it is that operator itself."""

    def __init__(self, shape: Shape, dtype: DTypeLike = np.float32) -> None:
        super().__init__(shape, shape, dtype)

    def _forward(self, block: Array) -> Array:
        return block

    def _adjoint(self, block: Array) -> Array:
        return block

    def __matmul__(self, other: LinearOperator) -> LinearOperator:
        """Return `other`, if it fits."""
        Composition(self, other)  # refuses operators that do not fit each other
        return other


class Reshape(LinearOperator):
    """The same values in another shape, such as the views of a light field one below the other as one tall picture."""

    def __init__(self, shape_in: Shape, shape_out: Shape, dtype: DTypeLike = np.float32) -> None:
        if np.prod(shape_in) != np.prod(shape_out):
            raise ShapeError("the result", f"as many elements as {shape_in}", shape_out)
        super().__init__(shape_in, shape_out, dtype)

    def _forward(self, block: Array) -> Array:
        return block.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        return block.reshape(*self.shape_in, -1)


class Diagonal(LinearOperator):
    """Elementwise weights, such as view gains or a mask of live pixels; self-adjoint."""

    def __init__(self, weights: ArrayLike, dtype: DTypeLike = np.float32) -> None:
        array = np.asarray(weights, dtype=dtype)
        if not np.all(np.isfinite(array)):
            raise InputError("weights must be finite")
        super().__init__(array.shape, array.shape, dtype)
        self.weights = array

    def _forward(self, block: Array) -> Array:
        product: Array = self.weights[..., np.newaxis] * block
        return product

    def _adjoint(self, block: Array) -> Array:
        return self._forward(block)


def squared_norm(operator: LinearOperator, iterations: int = 30, seed: int = 0) -> float:
    """Estimate the largest eigenvalue of A'A from below by power iteration.

    For a solver's step this is used with a margin; the iteration converges from below.

    Parameters
    ----------
    operator : LinearOperator
    iterations : int
        Products with A'A.
    seed : int
        Of the random start.

    Raises
    ------
    InputError
        The operator maps everything to zero.
    """
    x = np.random.default_rng(seed).random(operator.shape_in).astype(operator.dtype)
    value = 0.0
    for _ in range(iterations):
        x = operator.adjoint(operator(x))
        value = float(np.linalg.norm(x))
        if value == 0:
            raise InputError(f"{operator!r} maps everything to zero")
        x /= value
    return value
