"""Parallel projections of a picture at many angles, each onto a line detector of its own."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from tofclip.arrays import Array, IntArray
from tofclip.errors import ShapeError, require
from tofclip.operators.base import LinearOperator
from tofclip.operators.sparse import SparseMatrix, share_light

if TYPE_CHECKING:
    import scipy.sparse

FRACTION_BITS = 32
"""Positions on a detector are whole multiples of 2^-32 pixels, in the matrix and in the compiled
loops alike.
"""


class RadonProjection(SparseMatrix):
    """Line projections in Radon coordinates (supplement Note 6).

    Pixel (row, column), at ``X = column - columns // 2`` and ``Y = row - rows // 2``, falls on
    position ``detector_px // 2 + X cos(angle) + Y sin(angle) + offset`` of the angle's detector and
    is shared between the two nearest detector pixels. An offset of ``s (du cos(angle) + dv
    sin(angle))`` makes it A_k B_k for the view (dv, du) from the reference, because a line integral
    turns a 2D shift into a 1D one (Eq. 21).

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of the picture.
    detector_px : int
        Pixels of each line detector; what falls beyond them is lost.
    angles : (angles,) array
        Direction along which the detector extends, rad from the x axis towards y (down).
    offsets_px : (angles,) array
        Shift of the picture along each detector.
    dtype : dtype
        float32 or float64.

    Notes
    -----
    Measurements are (angles * detector_px,), angle by angle. A lone picture is projected without a
    matrix.
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
