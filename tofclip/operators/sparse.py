"""Products with a sparse matrix on arrays of other libraries than NumPy, on whatever device they
are.

PyTorch and CuPy have such products, by the maker of the device (cuSPARSE, MKL). For any other
library that follows the array API standard the entries are gathered and summed, which every library
can.

Sparse matrices as linear operators on pictures, and the one that everything begins with: the line
projection F of a row of cylindrical lenslets.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.arrays import Array, ComputeDevice, PerDevice, is_numpy, namespace
from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import LinearOperator, Shape
from tofclip.threads import LANES, run_blocks, split_blocks

if TYPE_CHECKING:
    import scipy.sparse


GATHERED_BYTES = 1 << 28
"""At most so much is gathered at once."""


class Product(Protocol):
    """The product with one sparse matrix."""

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block of the matrix's type; the result is (rows, frames)."""
        ...


def make_portable_product(matrix: scipy.sparse.csr_array, device: ComputeDevice) -> Product:
    """Bring a CSR matrix to `device` and return the product with it there.

    `device`: library and device of the arrays to come. Returns takes (columns, frames) arrays on
    that device.
    """
    kinds: dict[str, Callable[..., Product]] = {"torch": TorchProduct, "cupy": CupyProduct}
    return kinds.get(device.library, GatheredProduct)(matrix, device)


class TorchProduct:
    """PyTorch's own product with a CSR matrix."""

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        import torch

        if (
            not matrix.has_canonical_format
        ):  # PyTorch wants every entry once and in order, and does not look
            matrix = matrix.copy()
            matrix.sum_duplicates()
        parts = (device.put(part) for part in (matrix.indptr, matrix.indices, matrix.data))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
            self._matrix = torch.sparse_csr_tensor(
                *parts, size=matrix.shape, check_invariants=False
            )

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        return self._matrix @ block.contiguous()


class CupyProduct:
    """CuPy's own product with a CSR matrix."""

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        from cupyx.scipy.sparse import csr_matrix

        parts = tuple(device.put(part) for part in (matrix.data, matrix.indices, matrix.indptr))
        self._matrix = csr_matrix(parts, shape=matrix.shape)

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        return self._matrix @ block


class GatheredProduct:
    """The sum of what a row's entries gather, by functions of the array API standard alone.

    Every row is filled up with zeros to the longest, so rows of much the same length cost least
    memory.
    """

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        lengths = np.diff(matrix.indptr)
        shape = (matrix.shape[0], max(1, int(lengths.max(initial=0))))
        columns, values = np.zeros(shape, np.int64), np.zeros(shape, matrix.dtype)
        filled = np.arange(shape[1]) < lengths[:, np.newaxis]
        columns[filled], values[filled] = matrix.indices, matrix.data
        self._columns, self._values = device.put(columns), device.put(values[..., np.newaxis])
        self._itemsize = matrix.dtype.itemsize

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        xp = namespace(block)
        rows, width = self._columns.shape
        at_once = max(1, GATHERED_BYTES // max(1, width * block.shape[1] * self._itemsize))
        parts = []
        for piece in split_blocks(rows, at_once):
            columns = self._columns[piece, :]
            gathered = xp.take(block, xp.reshape(columns, (-1,)), axis=0)
            terms = (
                xp.reshape(gathered, (*columns.shape, block.shape[1])) * self._values[piece, ...]
            )
            parts.append(xp.sum(terms, axis=1))
        return xp.concat(parts)


TILE_BYTES = 1 << 19  # half of a present-day core's second-level cache


class SparseMatrix(LinearOperator):
    """A CSR matrix and its transpose, applied to blocks of frames.

    Matrix and transpose are set up on first use, for each library and device whose arrays come in,
    so that forward and adjoint are one gathering product on blocks. Memory is 8 bytes per nonzero
    and side in float32, in each place. A lone NumPy picture goes through scipy's own product.

    Parameters
    ----------
    matrix : scipy sparse matrix or array, (rows, columns)
        float32 or float64, with as many columns as `shape_in` has elements and rows as `shape_out`.
    shape_in, shape_out : tuple of int
    """

    portable = True

    def __init__(self, matrix: scipy.sparse.csr_array, shape_in: Shape, shape_out: Shape) -> None:
        super().__init__(shape_in, shape_out, matrix.dtype)
        matrix = matrix.tocsr()
        expected = (int(np.prod(shape_out)), int(np.prod(shape_in)))
        if matrix.shape != expected:
            raise ShapeError("the sparse matrix", expected, matrix.shape)
        if not np.all(np.isfinite(matrix.data)):
            raise InputError("the sparse matrix must be finite")
        # Products wait for memory: half as long an index is a third less to read.
        short = (
            matrix.indices.astype(np.int32),
            matrix.indptr.astype(np.int32 if matrix.nnz < 1 << 31 else np.int64),
        )
        self._matrix = type(matrix)((matrix.data, *short), shape=matrix.shape)

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The CSR matrix, (all of `shape_out`, all of `shape_in`)."""
        return self._matrix

    @cached_property
    def _forward_products(self) -> PerDevice[Product]:
        return PerDevice(self._make_forward_product)

    @cached_property
    def _adjoint_products(self) -> PerDevice[Product]:
        return PerDevice(self._make_adjoint_product)

    def _make_forward_product(self, device: ComputeDevice) -> Product:
        return make_product(device, self.matrix)

    def _make_adjoint_product(self, device: ComputeDevice) -> Product:
        # a transposed copy: products by rows write each result once, products by columns would
        # scatter
        return make_product(device, self.matrix.T.tocsr())

    def _forward(self, block: Array) -> Array:
        if block.shape[-1] == 1 and is_numpy(block):
            return self._forward_single(block[..., 0])[..., np.newaxis]
        return _apply_product(self._forward_products.get(block), block, self.shape_out)

    def _adjoint(self, block: Array) -> Array:
        if block.shape[-1] == 1 and is_numpy(block):
            return self._adjoint_single(block[..., 0])[..., np.newaxis]
        return _apply_product(self._adjoint_products.get(block), block, self.shape_in)

    def _forward_single(self, picture: Array) -> Array:
        """Apply to a lone array: there are no neighbouring frames to share a vector instruction
        with.
        """
        product: Array = self.matrix @ picture.reshape(-1)
        return product.reshape(self.shape_out)

    def _adjoint_single(self, measurements: Array) -> Array:
        product: Array = self.matrix.T @ measurements.reshape(-1)
        return product.reshape(self.shape_in)


class LineProjection(SparseMatrix):
    """All views' line projections onto one slit, as a single sparse matrix on native slit pixels.

    Pixel (row, column) of the picture, at ``X = column - columns // 2`` and ``Y = row - rows // 2``
    from the optical axis, falls on slit position ``centre_k + X - Y * tan(angle_k)`` of view k and
    is shared between the two nearest slit pixels by linear interpolation. Views may overlap on the
    slit: their light adds up, as it does in the instrument. Refocusing moves the centres
    (`Camera.operator`), because a line integral turns a 2D shift into a 1D one (supplement Eq. 21:
    A_k B_k is A_k with an offset detector).

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of the picture.
    slit_width_px : int
        Slit pixels; what falls beyond them is lost.
    centres_px : (views,) array
        Slit position of each view's optical axis; real numbers.
    angles : (views,) array
        Angles of the line responses from the vertical, rad.
    gains : (views,) array
        Brightness of each view.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        slit_width_px: int,
        centres_px: ArrayLike,
        angles: ArrayLike,
        gains: ArrayLike,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.sparse

        self.centres_px = np.asarray(centres_px, dtype=np.float64)
        self.angles = np.asarray(angles, dtype=np.float64)
        self.gains = np.asarray(gains, dtype=np.float64)
        if not self.centres_px.shape == self.angles.shape == self.gains.shape:
            raise ShapeError("centres, angles and gains", "(views,) each", self.angles.shape)
        slit, pixel, weight = self._compute_entries(image_shape, slit_width_px)
        matrix = scipy.sparse.csr_array(
            (weight.astype(dtype), (slit, pixel)),
            shape=(slit_width_px, image_shape[0] * image_shape[1]),
        )
        super().__init__(matrix, image_shape, (slit_width_px,))

    def _compute_entries(
        self, image_shape: tuple[int, int], slit_width_px: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Row, column and value of every nonzero."""
        rows, columns = image_shape
        y = (np.arange(rows) - rows // 2)[:, np.newaxis]
        x = (np.arange(columns) - columns // 2)[np.newaxis, :]
        # Slit coordinate of a scene point (X, Y) in a view: its centre + X - Y tan(angle), Y
        # downwards.
        position = (
            self.centres_px[:, np.newaxis, np.newaxis]
            + x
            - y * np.tan(self.angles)[:, np.newaxis, np.newaxis]
        )
        entry, slit, weight = split_between_bins(position, slit_width_px)
        view, pixel = np.divmod(entry, rows * columns)
        return slit, pixel, self.gains[view] * weight


def make_product(device: ComputeDevice, matrix: scipy.sparse.csr_array) -> Product:
    """Set up the product with `matrix` for the arrays of a device.

    `device`: library and device of the arrays to come. Returns takes (columns, frames) arrays on
    that device.
    """
    return (
        TiledProduct(matrix) if device.has_compiled_loops else make_portable_product(matrix, device)
    )


def _apply_product(product: Product, block: Array, target: Shape) -> Array:
    xp = namespace(block)
    return xp.reshape(product(xp.reshape(block, (-1, block.shape[-1]))), (*target, -1))


class TiledProduct:
    """The product with a CSR matrix on NumPy arrays, by compiled loops on blocks of frames."""

    def __init__(self, matrix: scipy.sparse.csr_array) -> None:
        self._tiles, self._count = Tiles.from_csr(matrix), matrix.shape[0]

    def __call__(self, block: NDArray[Any]) -> NDArray[Any]:
        """Multiply a (columns, frames) block."""
        from tofclip.operators.kernels import multiply_sparse_block

        rows, batch = self._count, block.shape[-1]
        result = np.empty((rows, batch), block.dtype)
        if batch == LANES:
            multiply_sparse_block(*self._tiles, block, result)
            return result

        def work(piece: slice) -> None:
            lanes = piece.stop - piece.start
            # the compiled product takes whole blocks only
            padded = np.zeros((block.shape[0], LANES), block.dtype)
            padded[:, :lanes] = block[:, piece]
            product = np.empty((rows, LANES), block.dtype)
            multiply_sparse_block(*self._tiles, padded, product)
            result[:, piece] = product[:, :lanes]

        run_blocks(work, batch)
        return result


class Tiles(NamedTuple):
    """A CSR matrix cut into groups of neighbouring columns, so that a group's part of the operand
    stays in cache.
    """

    # (tiles, rows + 1), where each row's nonzeros begin in the other two, tile by tile
    starts: NDArray[np.int64]
    columns: NDArray[np.uint32]  # (nonzeros,)
    values: NDArray[Any]  # (nonzeros,)

    @classmethod
    def from_csr(cls, matrix: scipy.sparse.csr_array) -> Tiles:
        """Sort the nonzeros of `matrix` by tile, then row, then as they stand in the row."""
        from tofclip.operators.kernels import count_tile_nonzeros, sort_into_tiles

        # as many columns as let their rows of the block stay in cache
        width = max(1, TILE_BYTES // (LANES * matrix.dtype.itemsize))
        per_row = np.zeros((-(-matrix.shape[1] // width), matrix.shape[0]), np.int64)
        count_tile_nonzeros(matrix.indptr, matrix.indices, width, per_row)
        ends = np.cumsum(per_row).reshape(per_row.shape)
        starts = np.concatenate([ends - per_row, ends[:, -1:]], axis=1)
        columns, values = np.empty(matrix.nnz, np.uint32), np.empty(matrix.nnz, matrix.dtype)
        sort_into_tiles(
            matrix.indptr,
            matrix.indices,
            matrix.data,
            width,
            starts[:, :-1].copy(),
            columns,
            values,
        )
        return cls(starts, columns, values)


def split_between_bins(
    position: NDArray[np.float64], bins: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Share every pixel's light between the two bins nearest to where it falls, by linear
    interpolation.

    `position` (groups, rows, columns): where each pixel falls among the bins of each group, in
    bins; `bins`: what falls beyond them is lost. Returns `entry, bin, weight` (nonzeros,): flat
    index into `position`, the bin, and the fraction of the light that it gets.
    """
    left = np.floor(position).astype(np.int64)
    share = position - left
    nearest, weight = np.stack([left, left + 1]), np.stack([1.0 - share, share])
    entry = np.broadcast_to(np.arange(position.size).reshape(position.shape), nearest.shape)
    # no explicit zeros, which every product would pay for
    seen = (nearest >= 0) & (nearest < bins) & (weight != 0)
    return entry[seen], nearest[seen], weight[seen]
