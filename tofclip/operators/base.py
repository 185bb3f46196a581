"""Linear operators: exact shapes, an adjoint beside every forward, composition with ``@``; and what turns
light into measurements: the shear, from the refocused picture to what a view sees (supplement Eq. 3),
pixels of a sensor, the codes of a single pixel, and masks that weigh the views of a light field
(supplement Note 5).

An operator maps arrays of `shape_in` to arrays of `shape_out`. A batch is one explicit last axis
more; nothing is flattened or broadcast behind the caller's back.

Every operator takes NumPy arrays. Those that are `portable` take the arrays of any library that
follows the array API standard as well, such as CuPy's and PyTorch's on a GPU, and
answer in kind; the others refuse them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from tofclip.arrays import (
    Array,
    ComputeDevice,
    FloatArray,
    PerDevice,
    as_type,
    is_complex,
    is_numpy,
    namespace,
    require_numpy,
    zeros,
)
from tofclip.errors import InputError, ShapeError, require, require_axes, require_shape

Shape = tuple[int, ...]

NORM_ITERATIONS = 15  # enough for a percent of the norm, which a test checks for every camera

REAL_TYPES = (np.dtype(np.float32), np.dtype(np.float64))


class LinearOperator(ABC):
    """A linear map between real arrays of fixed shapes, `shape_in` and `shape_out` without the batch axis;
    inputs are converted to its `dtype`, float32 or float64, which results have.

    Subclasses write `_forward` and `_adjoint`, which get a block of the operator's own type with
    the batch as last axis, and return one: of NumPy's arrays a contiguous one, and of other
    libraries' only what says it is `portable`. `parts` are the operators that this one is made of.
    """

    portable = False
    parts: tuple[LinearOperator, ...] = ()

    def __init__(self, shape_in: Shape, shape_out: Shape, dtype: DTypeLike = np.float32) -> None:
        self.shape_in = tuple(int(n) for n in shape_in)
        self.shape_out = tuple(int(n) for n in shape_out)
        self.dtype = np.dtype(dtype)
        require(self.dtype in REAL_TYPES, f"operators work in float32 or float64, not {self.dtype}")
        if min((*self.shape_in, *self.shape_out)) < 1:
            raise ShapeError(
                "an operator", "at least one element on both sides", (shape_in, shape_out)
            )

    @abstractmethod
    def _forward(self, block: Array) -> Array:
        """Apply to a block of shape ``shape_in + (batch,)``."""

    @abstractmethod
    def _adjoint(self, block: Array) -> Array:
        """Apply the adjoint to a block of shape ``shape_out + (batch,)``."""

    @cached_property
    def squared_norm(self) -> float:
        """Largest eigenvalue of A'A as `NORM_ITERATIONS` products tell it, from below."""
        return estimate_squared_norm(self, NORM_ITERATIONS)

    def __call__(self, x: Array) -> Array:
        """Apply the operator to an array of shape `shape_in`, or `shape_in` and a batch axis."""
        block, single = self._to_block(x, self.shape_in, "the operand")
        result = self._forward(block)
        return result[..., 0] if single else result

    def adjoint(self, y: Array) -> Array:
        """Apply the adjoint to an array of shape `shape_out`, or `shape_out` and a batch axis."""
        block, single = self._to_block(y, self.shape_out, "the adjoint's operand")
        result = self._adjoint(block)
        return result[..., 0] if single else result

    def _to_block(self, values: Array, shape: Shape, what: str) -> tuple[Array, bool]:
        if not self.portable:
            require_numpy(f"the operator {type(self._numpy_only_part).__name__}", values)
        array = np.asarray(values) if is_numpy(values) else values
        single = array.shape == shape
        if not single and array.shape[:-1] != shape:
            raise ShapeError(what, f"{shape} or {shape} and a batch axis", tuple(array.shape))
        if is_complex(array):
            raise InputError(f"{what} must be real, got {array.dtype}")
        return as_type(array[..., None] if single else array, self.dtype), single

    def _set_parts(self, *parts: LinearOperator) -> None:
        """Remember the parts; what is made of several takes the arrays that all of them take."""
        self.parts, self.portable = parts, all(part.portable for part in parts)

    @property
    def _numpy_only_part(self) -> LinearOperator:
        """The innermost part because of which other libraries' arrays cannot be taken."""
        return next((part._numpy_only_part for part in self.parts if not part.portable), self)

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
        self._set_parts(operator)

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
        require_shape("the inner operator's result", outer.shape_in, inner.shape_out)
        require(
            outer.dtype == inner.dtype,
            f"cannot compose {outer.dtype} with {inner.dtype}; build both in one type",
        )
        super().__init__(inner.shape_in, outer.shape_out, outer.dtype)
        self._set_parts(outer, inner)

    def _forward(self, block: Array) -> Array:
        outer, inner = self.parts
        return outer._forward(inner._forward(block))

    def _adjoint(self, block: Array) -> Array:
        outer, inner = self.parts
        return inner._adjoint(outer._adjoint(block))


class Identity(LinearOperator):
    """Leaves everything as it is; composed with another operator it is that operator itself."""

    portable = True

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
    """The same values in another shape, such as the views of a light field as one tall picture."""

    portable = True

    def __init__(self, shape_in: Shape, shape_out: Shape, dtype: DTypeLike = np.float32) -> None:
        if np.prod(shape_in) != np.prod(shape_out):
            raise ShapeError("the result", f"as many elements as {shape_in}", shape_out)
        super().__init__(shape_in, shape_out, dtype)

    def _forward(self, block: Array) -> Array:
        return namespace(block).reshape(block, (*self.shape_out, -1))

    def _adjoint(self, block: Array) -> Array:
        return namespace(block).reshape(block, (*self.shape_in, -1))


class Diagonal(LinearOperator):
    """Elementwise weights, such as view gains or a mask of live pixels; self-adjoint."""

    portable = True

    def __init__(self, weights: ArrayLike, dtype: DTypeLike = np.float32) -> None:
        array = np.asarray(weights, dtype=dtype)
        require(np.all(np.isfinite(array)), "weights must be finite")
        super().__init__(array.shape, array.shape, dtype)
        self.weights = array
        self._weights = PerDevice(partial(ComputeDevice.put, values=array[..., np.newaxis]))

    def _forward(self, block: Array) -> Array:
        return self._weights.get(block) * block

    def _adjoint(self, block: Array) -> Array:
        return self._forward(block)


def estimate_squared_norm(operator: LinearOperator, iterations: int = 30, seed: int = 0) -> float:
    """Estimate the largest eigenvalue of A'A of an `operator` from below, by the Lanczos
    iteration: as many products with A'A as `iterations`, from a random start of a `seed`.
    `InputError` where it maps everything to zero.

    For a solver's step this is used with a margin. Power iteration needs several times as many
    products where the largest eigenvalues lie close together, as they do for codes whose mean
    was taken off.
    """
    # a random start has a part along the largest eigenvector, whatever the operator
    import scipy.linalg

    x = np.random.default_rng(seed).random(operator.shape_in).astype(operator.dtype)
    x /= np.linalg.norm(x)
    number: Any = operator.dtype.type
    before, diagonal, beside = np.zeros_like(x), list[float](), [0.0]
    for _ in range(iterations):
        y = operator.adjoint(operator(x)) - number(beside[-1]) * before
        diagonal.append(float(np.vdot(x, y).real))
        y -= number(diagonal[-1]) * x
        beside.append(float(np.linalg.norm(y)))
        if beside[-1] <= np.finfo(operator.dtype).eps * max(diagonal):
            break  # x spans all that A'A makes of it: the value is exact
        before, x = x, y / number(beside[-1])
    require(max(diagonal) > 0, f"{operator!r} maps everything to zero")
    # Without orthogonalising anew, values come twice, but the largest one is right.
    values = scipy.linalg.eigvalsh_tridiagonal(diagonal, beside[1 : len(diagonal)])
    return float(values[-1])


def _require_alike(what: str, operators: Sequence[LinearOperator], joined: int) -> LinearOperator:
    """Return the first of operators of one type, and one shape but for the `joined` axes."""
    require(operators, f"{what} needs at least one operator")
    first = operators[0]
    for other in operators[1:]:
        if (other.shape_in, other.shape_out[joined:]) != (first.shape_in, first.shape_out[joined:]):
            shapes = (f"{one.shape_in} -> {one.shape_out}" for one in (first, other))
            raise ShapeError(f"every operator of {what}", *shapes)
        require(
            other.dtype == first.dtype,
            f"{what} cannot join {first.dtype} with {other.dtype}; build both in one type",
        )
    return first


class _Joined(LinearOperator):
    """Operators whose results are joined along the first axis, on inputs that have `axes` more."""

    def __init__(self, operators: Sequence[LinearOperator], *axes: int) -> None:
        first = _require_alike("a stack", operators, 1)
        rows = sum(operator.shape_out[0] for operator in operators)
        shapes = (*axes, *first.shape_in), (rows, *first.shape_out[1:])
        super().__init__(*shapes, first.dtype)
        self._set_parts(*operators)

    def _split_rows(self, block: Array) -> Iterator[tuple[LinearOperator, Array]]:
        """Each operator with its part of the results."""
        first = 0
        for operator in self.parts:
            last = first + operator.shape_out[0]
            yield operator, block[first:last, ...]
            first = last


class Stack(_Joined):
    """Operators on the same input, their results joined along the first axis: ``[A; B; ...] x``."""

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        super().__init__(operators)

    def _forward(self, block: Array) -> Array:
        return namespace(block).concat([operator._forward(block) for operator in self.parts])

    def _adjoint(self, block: Array) -> Array:
        # every part has looked at the same input
        total = zeros((*self.shape_in, block.shape[-1]), block)
        for operator, part in self._split_rows(block):
            total += operator._adjoint(part)
        return total


class BlockDiagonal(_Joined):
    """One operator for each entry of the input's first axis, their results joined: ``[A_1 x_1; A_2
    x_2; ...]``.

    With a view's encoder for each view it is the model of a whole 4D light field (supplement Eq.
    20).
    """

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        super().__init__(operators, len(operators))

    def _forward(self, block: Array) -> Array:
        parts = [operator._forward(block[k, ...]) for k, operator in enumerate(self.parts)]
        return namespace(block).concat(parts)

    def _adjoint(self, block: Array) -> Array:
        parts = [operator._adjoint(part) for operator, part in self._split_rows(block)]
        return namespace(block).stack(parts)


class Integration(Adjoint):
    """The sum of what an operator makes of each entry of the input's first axis: ``[A_1, A_2, ...]
    [x_1; x_2; ...]``.

    With a view's encoder for each view it is the model of a sensor on which all views add up
    (supplement Eq. 19).
    """

    def __init__(self, operators: Sequence[LinearOperator]) -> None:
        first = _require_alike("an integration", operators, 0)
        # the sensor did not keep apart what fell on it: each view gets back all of it
        every = Stack([operator.H for operator in operators])
        views = Reshape(every.shape_out, (len(operators), *first.shape_in), first.dtype)
        super().__init__(views @ every)


class Selection(LinearOperator):
    """Some of the pieces that an input is cut into along its first axes: those of the numbers `chosen`,
    without repeats, such as views of a light field, or pixels of a sensor, numbered row by row; the
    adjoint leaves the others dark. `shape_out` is that of all of them together; `dtype` float32 or
    float64.
    """

    def __init__(
        self, shape_in: Shape, shape_out: Shape, chosen: ArrayLike, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(shape_in, shape_out, dtype)
        self.chosen = np.asarray(chosen, np.intp)
        self._pieces = int(np.prod(shape_in)) * self.chosen.size // int(np.prod(shape_out))
        different = np.unique(self.chosen)
        require(
            0 < different.size == self.chosen.size
            and np.all((different >= 0) & (different < self._pieces)),
            f"what is chosen must be one or more different numbers from 0 to {self._pieces - 1}",
        )

    def _forward(self, block: Array) -> Array:
        kept = block.reshape(self._pieces, -1)[self.chosen]
        return kept.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        whole = np.zeros((*self.shape_in, block.shape[-1]), self.dtype)
        whole.reshape(self._pieces, -1)[self.chosen] = block.reshape(self.chosen.size, -1)
        return whole


class MeanWeighting(LinearOperator):
    """``W = I - (1 - w) 11' / m_k`` for each view's m_k measurements, `counts` in the order of the
    measurements: their mean counts w times, the `weight` between 0 and 1; self-adjoint; `dtype`
    float32 or float64.

    Codes of 0 and 1 all measure half the picture's sum, which swamps what tells them apart;
    apply W to the measurements and to the operator alike.
    """

    def __init__(
        self, counts: Sequence[int], weight: float = 0.02, dtype: DTypeLike = np.float32
    ) -> None:
        require(counts and min(counts) >= 1, "every view needs at least one reading")
        require(0 <= weight <= 1, f"the weight of the mean must lie between 0 and 1, got {weight}")
        super().__init__((sum(counts),), (sum(counts),), dtype)
        self._counts = np.asarray(counts)
        self._starts = np.cumsum(self._counts) - self._counts
        self._removed = 1 - weight

    def _forward(self, block: Array) -> Array:
        means = np.add.reduceat(block, self._starts, axis=0) / self._counts[:, np.newaxis]
        weighted = block - np.repeat(self._removed * means, self._counts, axis=0)
        return weighted.astype(self.dtype)

    def _adjoint(self, block: Array) -> Array:
        return self._forward(block)


View = tuple[float, float]


class LinearShear(LinearOperator):
    """A shift of the whole picture by s times the view's distance from the reference view, with linear
    interpolation between neighbouring pixels; dark beyond the border.

    View (v, u) sees ``p(x, y) = h(x - s (u - u_ref), y - s (v - v_ref))``, s being the shear in
    pixels per view step; the reference may lie anywhere (viewpoint synthesis). The adjoint is the
    opposite shift, exactly.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        shear: float,
        view: View,
        reference: View = (0.0, 0.0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        super().__init__(image_shape, image_shape, dtype)
        self.shift_px = tuple(float(shear * (a - b)) for a, b in zip(view, reference, strict=True))
        require(
            np.all(np.abs(self.shift_px) < np.asarray(image_shape)),
            f"shear {shear} moves view {view} by {self.shift_px} px, out of a {image_shape} picture; "
            "take a shear nearer to zero",
        )

    def _forward(self, block: Array) -> Array:
        return self._shift(block, *self.shift_px)

    def _adjoint(self, block: Array) -> Array:
        return self._shift(block, *(-shift for shift in self.shift_px))

    def _shift(self, block: Array, down: float, right: float) -> Array:
        from tofclip.operators.kernels import shift_linearly

        rows, columns = (int(np.floor(shift)) for shift in (down, right))
        below, beside = np.array([down - rows, right - columns], self.dtype)
        shifted = np.empty_like(block)
        shift_linearly(block, rows, columns, below, beside, shifted)
        return shifted


class DenseSensor(Reshape):
    """Every pixel of a plane of `plane_shape` is read, row by row; `dtype` float32 or float64."""

    def __init__(self, plane_shape: tuple[int, int], dtype: DTypeLike = np.float32) -> None:
        super().__init__(plane_shape, (plane_shape[0] * plane_shape[1],), dtype)


class PitchedSensor(Selection):
    """Small pixels far apart: every n-th pixel of the plane is read (supplement Note 3, sparse 2D
    sensors), of a picture of `plane_shape`, in `dtype` float32 or float64. `pitch_px` is the distance
    from row to row and from column to column, at least 1; where it is not a whole number, the pixels
    nearest below the true places are read. `offset_px`: first row and column that are read.
    """

    def __init__(
        self,
        plane_shape: tuple[int, int],
        pitch_px: tuple[float, float],
        offset_px: tuple[float, float] = (0, 0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        axes = []
        for size, pitch, offset in zip(plane_shape, pitch_px, offset_px, strict=True):
            require(
                np.isfinite(pitch) and pitch >= 1,
                f"a sensor's pitch must be at least one pixel, got {pitch}",
            )
            require(
                0 <= offset < size,
                f"a sensor's offset must lie on the plane of {size} px, got {offset}",
            )
            # The sum of many pitches must not fall short of a whole number by rounding.
            places = np.floor(np.arange(offset, size, pitch) + 1e-9).astype(np.intp)
            axes.append(places[places < size])
        rows, columns = axes
        pixels = (rows[:, np.newaxis] * plane_shape[1] + columns).ravel()
        super().__init__(plane_shape, (pixels.size,), pixels, dtype)
        self.grid_shape = (rows.size, columns.size)
        """Rows and columns of the sensor: measurements reshaped to it are a picture."""


class HadamardCodes(LinearOperator):
    """Random 0/1 codes with a fast product: rows of a Hadamard matrix whose columns have random
    signs, so many `codes` of pictures of `image_shape`, in `dtype` float32 or float64; the signs and the
    rows are those of a `seed`.

    A code is ``(1 + H D) / 2``: D holds a random sign for each pixel, and the rows of H are drawn
    without replacement (structurally random matrices, T. T. Do et al., IEEE Trans. Signal Process.
    60, 139 (2012)). H is the Kronecker product of one Hadamard matrix for each side, the picture
    padded to powers of two, so that all of it is a fast Walsh-Hadamard transform along either side
    of the picture.
    """

    def __init__(
        self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(image_shape, (codes,), dtype)
        self._padded = tuple(1 << (size - 1).bit_length() for size in image_shape)
        cells = self._padded[0] * self._padded[1]
        require(codes <= cells, f"a {image_shape} picture has at most {cells} codes, not {codes}")
        random = np.random.default_rng(seed)
        self._signs = random.choice(np.array([-1, 1], self.dtype), image_shape)[..., np.newaxis]
        rows, columns = np.unravel_index(random.choice(cells, codes, replace=False), self._padded)
        self._chosen = columns * self._padded[0] + rows  # the spectrum comes out transposed

    def _forward(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), batch = self.shape_in, block.shape[-1]
        padded_rows, padded_columns = self._padded
        signed = np.zeros((padded_rows, columns, batch), self.dtype)
        np.multiply(block, self._signs, out=signed[:rows])
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        spectrum = np.zeros((padded_columns, padded_rows, batch), self.dtype)
        spectrum[:columns] = signed.swapaxes(0, 1)
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        coded = spectrum.reshape(-1, batch)[self._chosen]
        coded += block.sum(axis=0).sum(axis=0)
        coded /= 2
        return coded

    def _adjoint(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), batch = self.shape_in, block.shape[-1]
        padded_rows, padded_columns = self._padded
        spectrum = np.zeros((padded_columns * padded_rows, batch), self.dtype)
        spectrum[self._chosen] = block
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        half_way = spectrum.reshape(padded_columns, padded_rows, batch)[:columns]
        signed = np.ascontiguousarray(half_way.swapaxes(0, 1))
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        pictures = signed[:rows] * self._signs
        pictures += block.sum(axis=0)
        pictures /= 2
        return pictures


class WeightedViews(LinearOperator):
    """Exposures through masks in the aperture: ``y_j = sum_k w_jk P_k`` (supplement Eq. 17), from
    light fields (views, rows, columns) of pictures of `image_shape` to (exposures * rows *
    columns,). `weights` (exposures, views) are w, what fraction of each view's light an
    exposure's mask lets pass; `dtype` float32 or float64.
    """

    def __init__(
        self, image_shape: tuple[int, int], weights: ArrayLike, dtype: DTypeLike = np.float32
    ) -> None:
        self.weights = np.asarray(weights, dtype=dtype)
        require_axes("mask weights", "exposures, views", self.weights.shape)
        require(np.all(np.isfinite(self.weights)), "mask weights must be finite")
        exposures, views = self.weights.shape
        super().__init__(
            (views, *image_shape), (exposures * image_shape[0] * image_shape[1],), dtype
        )

    def _forward(self, block: Array) -> Array:
        # One dense product for all pixels and frames: a mask in the aperture treats every pixel
        # alike.
        seen = self.weights @ block.reshape(len(block), -1)
        return seen.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        spread = self.weights.T @ block.reshape(len(self.weights), -1)
        return spread.reshape(*self.shape_in, -1)


def make_sheared_mask(
    image_shape: tuple[int, int],
    views: Sequence[View],
    mask_shear: float,
    random: np.random.Generator,
) -> FloatArray:
    """Make the codes of a random mask at some distance in front of the sensor, (views, rows, columns):
    from view to view it appears moved by `mask_shear` pixels. Transmissions are evenly from 0 to 1.
    """
    # So much larger that no view looks past the edge of the mask.
    margin = int(np.ceil(abs(mask_shear) * np.abs(np.asarray(views)).max())) + 1
    large = (image_shape[0] + 2 * margin, image_shape[1] + 2 * margin)
    mask = random.random(large)
    inner = (slice(margin, -margin), slice(margin, -margin))
    return np.stack(
        [LinearShear(large, mask_shear, view, dtype=np.float64)(mask)[inner] for view in views]
    )
