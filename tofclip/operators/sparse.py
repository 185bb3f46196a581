"""Sparse matrices as linear operators on pictures, and those that everything begins with: the line
projection F of a row of cylindrical lenslets, and parallel projections of a picture at many angles,
each onto a line detector of its own.
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.arrays import (
    AnyArray,
    Array,
    ComputeDevice,
    FloatArray,
    IntArray,
    PerDevice,
    is_numpy,
    namespace,
)
from tofclip.errors import ShapeError, require, require_shape
from tofclip.operators.base import LinearOperator, Shape
from tofclip.threads import LANES, run_blocks, split_blocks

if TYPE_CHECKING:
    import scipy.sparse

Product = Callable[[Array], Array]
"""Multiplies a sparse matrix with a (columns, frames) block of its type."""

GATHERED_NUMBERS = 1 << 25  # gathered at once, at most
TILE_BYTES = 1 << 19  # half of a present-day core's second-level cache


class Tiles(NamedTuple):
    """A CSR matrix cut into groups of neighbouring columns, so that a group's part of the operand
    stays in cache: nonzeros in the order of tile, row, and their place in the row.
    """

    starts: IntArray  # (tiles, rows + 1), where each row's nonzeros begin in the other two
    columns: NDArray[np.uint32]  # (nonzeros,)
    values: AnyArray  # (nonzeros,)

    @classmethod
    def from_csr(cls, matrix: scipy.sparse.csr_array) -> Tiles:
        """Cut so that the rows of `LANES` frames that belong to a tile's columns stay in cache."""
        width = max(1, TILE_BYTES // (LANES * matrix.dtype.itemsize))
        firsts = range(0, matrix.shape[1], width)
        parts = [matrix[:, first : first + width] for first in firsts]
        before = np.cumsum([0, *(part.nnz for part in parts[:-1])])
        starts = np.stack([part.indptr for part in parts]) + before[:, np.newaxis]
        columns = [part.indices + first for part, first in zip(parts, firsts, strict=True)]
        values = np.concatenate([part.data for part in parts])
        return cls(starts, np.concatenate(columns).astype(np.uint32), values)


def make_product(matrix: scipy.sparse.csr_array, device: ComputeDevice) -> Product:
    """Bring a CSR matrix to where the arrays to come are. NumPy's are multiplied by compiled loops.
    PyTorch and CuPy have such products, by the maker of the device (cuSPARSE, MKL); any other
    library gathers a row's entries and sums them.
    """
    if device.library == "numpy":
        return partial(_multiply_tiles, Tiles.from_csr(matrix))
    if device.library == "torch":
        import torch

        if not matrix.has_canonical_format:  # every entry once and in order: PyTorch does not look
            matrix = matrix.copy()
            matrix.sum_duplicates()
        parts = (device.put(part) for part in (matrix.indptr, matrix.indices, matrix.data))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
            brought = torch.sparse_csr_tensor(*parts, size=matrix.shape, check_invariants=False)
        return lambda block: brought @ block.contiguous()
    if device.library == "cupy":
        from cupyx.scipy.sparse import csr_matrix

        parts = (device.put(part) for part in (matrix.data, matrix.indices, matrix.indptr))
        return partial(operator.matmul, csr_matrix(tuple(parts), shape=matrix.shape))
    # Every row is filled up with zeros to the longest: of much the same length they cost least.
    lengths = np.diff(matrix.indptr)
    shape = (matrix.shape[0], max(1, int(lengths.max(initial=0))))
    columns, values = np.zeros(shape, np.int64), np.zeros(shape, matrix.dtype)
    filled = np.arange(shape[1]) < lengths[:, np.newaxis]
    columns[filled], values[filled] = matrix.indices, matrix.data
    return partial(_multiply_gathered, device.put(columns), device.put(values[..., np.newaxis]))


def _multiply_tiles(tiles: Tiles, block: AnyArray) -> AnyArray:
    from tofclip.operators.kernels import multiply_sparse_block

    result = np.empty((tiles.starts.shape[1] - 1, block.shape[-1]), block.dtype)
    if block.shape[-1] == LANES:
        multiply_sparse_block(*tiles, block, result)
        return result

    def work(piece: slice) -> None:
        lanes = piece.stop - piece.start
        # the compiled product takes whole blocks only
        padded = np.zeros((block.shape[0], LANES), block.dtype)
        padded[:, :lanes] = block[:, piece]
        product = np.empty((len(result), LANES), block.dtype)
        multiply_sparse_block(*tiles, padded, product)
        result[:, piece] = product[:, :lanes]

    run_blocks(work, block.shape[-1])
    return result


def _multiply_gathered(columns: Array, values: Array, block: Array) -> Array:
    """Functions of the array API standard alone."""
    xp, (rows, width), frames = namespace(block), columns.shape, block.shape[1]
    parts = []
    for piece in split_blocks(rows, max(1, GATHERED_NUMBERS // max(1, width * frames))):
        gathered = xp.take(block, xp.reshape(columns[piece, :], (-1,)), axis=0)
        terms = xp.reshape(gathered, (-1, width, frames)) * values[piece, ...]
        parts.append(xp.sum(terms, axis=1))
    return xp.concat(parts)


class SparseMatrix(LinearOperator):
    """A CSR `matrix`, float32 or float64, and its transpose, applied to blocks of frames: from `shape_in`,
    of as many elements as it has columns, to `shape_out`, of as many as it has rows.

    Matrix and transpose are set up on first use, for each library and device whose arrays come in,
    so that forward and adjoint are one gathering product on blocks. Memory is 8 bytes per nonzero
    and side in float32, in each place. A lone NumPy picture goes through scipy's own product.
    """

    portable = True

    def __init__(self, matrix: scipy.sparse.csr_array, shape_in: Shape, shape_out: Shape) -> None:
        super().__init__(shape_in, shape_out, matrix.dtype)
        matrix = matrix.tocsr()
        expected = (int(np.prod(shape_out)), int(np.prod(shape_in)))
        require_shape("the sparse matrix", expected, matrix.shape)
        require(np.all(np.isfinite(matrix.data)), "the sparse matrix must be finite")
        # Products wait for memory: half as long an index is a third less to read.
        starts = matrix.indptr.astype(np.int32 if matrix.nnz < 1 << 31 else np.int64)
        parts = (matrix.data, matrix.indices.astype(np.int32), starts)
        self._matrix = type(matrix)(parts, shape=matrix.shape)

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The CSR matrix, (all of `shape_out`, all of `shape_in`)."""
        return self._matrix

    @cached_property
    def _products(self) -> tuple[PerDevice[Product], PerDevice[Product]]:
        """Forward and adjoint. The transpose is a copy: products by rows write each result once,
        products by columns would scatter.
        """
        return (
            PerDevice(lambda device: make_product(self.matrix, device)),
            PerDevice(lambda device: make_product(self.matrix.T.tocsr(), device)),
        )

    def _forward(self, block: Array) -> Array:
        if block.shape[-1] == 1 and is_numpy(block):
            return self._forward_single(block[..., 0])[..., np.newaxis]
        return _apply(self._products[0], block, self.shape_out)

    def _adjoint(self, block: Array) -> Array:
        if block.shape[-1] == 1 and is_numpy(block):
            return self._adjoint_single(block[..., 0])[..., np.newaxis]
        return _apply(self._products[1], block, self.shape_in)

    def _forward_single(self, picture: Array) -> Array:
        """Apply to a lone array: there are no neighbouring frames to share a vector instruction."""
        product = self.matrix @ picture.reshape(-1)
        return product.reshape(self.shape_out)

    def _adjoint_single(self, measurements: Array) -> Array:
        product = self.matrix.T @ measurements.reshape(-1)
        return product.reshape(self.shape_in)


def _apply(products: PerDevice[Product], block: Array, target: Shape) -> Array:
    xp = namespace(block)
    flat = xp.reshape(block, (-1, block.shape[-1]))
    return xp.reshape(products.get(block)(flat), (*target, -1))


class LineProjection(SparseMatrix):
    """All views' line projections onto one slit, as a single sparse matrix on native slit pixels, in `dtype`
    float32 or float64.

    Pixel (row, column) of the picture, of `image_shape`, at ``X = column - columns // 2`` and ``Y = row -
    rows // 2`` from the optical axis, falls on slit position ``centre_k + X - Y * tan(angle_k)`` of view
    k and is shared between the two nearest of the `slit_width_px` slit pixels by linear interpolation;
    what falls beyond them is lost. `centres_px` (views,) are the real positions of each view's optical
    axis, `angles` (views,) those of the line responses from the vertical, rad, `gains` (views,) the
    brightness of each view. Views may overlap on the slit: their light adds up, as it does in the
    instrument. Refocusing moves the centres (`Camera.operator`), because a line integral turns a 2D shift
    into a 1D one (supplement Eq. 21: A_k B_k is A_k with an offset detector).
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
        self.centres_px = np.asarray(centres_px, dtype=np.float64)
        self.angles = np.asarray(angles, dtype=np.float64)
        self.gains = np.asarray(gains, dtype=np.float64)
        if not self.centres_px.shape == self.angles.shape == self.gains.shape:
            raise ShapeError("centres, angles and gains", "(views,) each", self.angles.shape)
        rows, columns = image_shape
        y = (np.arange(rows) - rows // 2)[:, np.newaxis]
        x = np.arange(columns) - columns // 2
        views = (np.s_[:], np.newaxis, np.newaxis)
        position = self.centres_px[views] + x - y * np.tan(self.angles)[views]
        left = np.floor(position).astype(np.int64)
        matrix = share_light(left, position - left, self.gains[views], slit_width_px, dtype)
        super().__init__(matrix, image_shape, (slit_width_px,))


def share_light(
    left: IntArray, share: FloatArray, gain: ArrayLike, width_px: int, dtype: DTypeLike
) -> scipy.sparse.csr_array:
    """Return the CSR matrix (width_px, rows * columns) of a picture's projections onto one line, on
    which every pixel's light falls between pixel `left` (..., rows, columns) and the next, which gets
    its `share`; what falls beyond the line is lost.
    """
    import scipy.sparse

    rows, columns = left.shape[-2:]
    place = np.stack([left, left + 1])
    weight = np.stack([1.0 - share, share]) * gain
    # no explicit zeros, which every product would pay for
    seen = (place >= 0) & (place < width_px) & (weight != 0)
    pixel = np.broadcast_to(np.arange(rows * columns).reshape(rows, columns), place.shape)
    entries = weight[seen].astype(dtype), (place[seen], pixel[seen])
    return scipy.sparse.csr_array(entries, shape=(width_px, rows * columns))


# Positions on a detector are whole multiples of 2^-32 pixels, in the matrix and in the compiled loops
# alike.
FRACTION_BITS = 32


class RadonProjection(SparseMatrix):
    """Line projections in Radon coordinates (supplement Note 6): (angles * detector_px,) measurements, angle by
    angle, in `dtype` float32 or float64. A lone picture is projected without a matrix.

    Pixel (row, column) of a picture of `image_shape`, at ``X = column - columns // 2`` and ``Y = row - rows
    // 2``, falls on position ``detector_px // 2 + X cos(angle) + Y sin(angle) + offset`` of the angle's
    detector and is shared between the two nearest of its `detector_px` pixels; what falls beyond them is
    lost. `angles` (angles,) say along which direction each detector extends, rad from the x axis towards y
    (down), `offsets_px` (angles,) by how much the picture is shifted along it. An offset of ``s (du
    cos(angle) + dv sin(angle))`` makes it A_k B_k for the view (dv, du) from the reference, because a line
    integral turns a 2D shift into a 1D one (Eq. 21).
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        detector_px: int,
        angles: ArrayLike,
        offsets_px: ArrayLike,
        dtype: DTypeLike = np.float32,
    ) -> None:
        self.angles = np.asarray(angles, dtype=np.float64)
        self.offsets_px = np.asarray(offsets_px, dtype=np.float64)
        if self.angles.ndim != 1 or self.angles.shape != self.offsets_px.shape:
            raise ShapeError(
                "angles and offsets", "(angles,) each", (self.angles.shape, self.offsets_px.shape)
            )
        require(
            np.all(np.isfinite([self.angles, self.offsets_px])), "angles and offsets must be finite"
        )
        self.detector_px = detector_px
        # Not by way of SparseMatrix: the matrix is made if a block of frames or a caller asks for
        # it.
        LinearOperator.__init__(self, image_shape, (self.angles.size * detector_px,), dtype)

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The CSR matrix, (angles * detector_px, rows * columns); made on first use."""
        import scipy.sparse

        before, _, paths = self._line_paths
        row, column = np.indices(self.shape_in)
        lines = []
        for start, right, down in zip(*paths, strict=True):
            position = start + column * right + row * down
            left = (position >> FRACTION_BITS) - before
            share = (position & ((1 << FRACTION_BITS) - 1)) * 2.0**-FRACTION_BITS
            lines.append(share_light(left, share, 1.0, self.detector_px, self.dtype))
        made = scipy.sparse.vstack(lines, "csr")
        return SparseMatrix(made, self.shape_in, self.shape_out).matrix

    @cached_property
    def _line_paths(self) -> tuple[int, int, list[IntArray]]:
        """Bins before the detector's first, bins in all, and positions on lines extended so.

        The positions are those of each line's first pixel and the steps to its right and lower
        neighbour, in units of 2^-32 bins. The lines are long enough for every pixel to fall on
        them, so that compiled loops need not ask.
        """
        rows, columns = self.shape_in
        right, down = np.cos(self.angles), np.sin(self.angles)
        first = self.detector_px // 2 + self.offsets_px - columns // 2 * right - rows // 2 * down
        across, along = (columns - 1) * right, (rows - 1) * down
        lowest = first + np.minimum(across, 0) + np.minimum(along, 0)
        highest = first + np.maximum(across, 0) + np.maximum(along, 0)
        # one bin more on either side, because light is shared with the next bin
        before = max(0, -int(np.floor(lowest.min()))) + 1
        bins = before + max(self.detector_px, int(np.ceil(highest.max())) + 2)
        # fixed-point positions: steps add up without rounding, and the bin is a shift of bits away
        fixed = [
            np.rint(values * 2.0**FRACTION_BITS).astype(np.int64)
            for values in (first + before, right, down)
        ]
        return before, bins, fixed

    def _forward_single(self, picture: Array) -> Array:
        from tofclip.operators.kernels import project_onto_lines

        before, bins, paths = self._line_paths
        lines = np.zeros((self.angles.size, bins, 2), self.dtype)
        project_onto_lines(picture, *paths, lines)
        seen = slice(before, before + self.detector_px)
        # light for the next bin lies in column 1 of the bin before it
        shared = slice(before - 1, before + self.detector_px - 1)
        return (lines[:, seen, 0] + lines[:, shared, 1]).reshape(self.shape_out)

    def _adjoint_single(self, measurements: Array) -> Array:
        from tofclip.operators.kernels import back_project_lines

        before, bins, paths = self._line_paths
        lines = np.zeros((self.angles.size, bins), self.dtype)
        lines[:, before : before + self.detector_px] = measurements.reshape(-1, self.detector_px)
        picture = np.empty(self.shape_in, self.dtype)
        back_project_lines(lines, *paths, picture)
        return picture
