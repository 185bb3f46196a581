"""The linear inverse pixel by pixel: a few pixels at all instants, instead of all pixels at a few
instants.

Code that looks at one pixel's brightness over time, as the search for returns does, never needs the
transient cube: the dense part of the inverse, which is small, is worked out for the whole shot, and
the sparse part for a few pixels at a time, whose traces stay in cache.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array
from tofclip.errors import InputError
from tofclip.operators import SparseMatrix
from tofclip.operators.sparse import Tiles
from tofclip.solvers.direct import PreparedInverse

PATCH_ROWS, PATCH_COLUMNS = 8, 8
"""The measurements that such a patch looks at stay in the first-level cache."""

GROUP_PIXELS = 4
"""Neighbours in a row of a patch: of each view they look at nearly the same measurements."""


def order_by_patch(image_shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the numbers of all pixels of a picture, counted in raster order, patch by patch."""
    row, column = np.divmod(np.arange(image_shape[0] * image_shape[1]), image_shape[1])
    return np.lexsort((column, row, column // PATCH_COLUMNS, row // PATCH_ROWS))


class InverseTraces:
    """A prepared inverse whose sparse part is applied to pixels in an order of their own.

    `inverse`: of a sparse matrix in float32; `pixels` (n,): numbers of the pixels, counted in
    raster order; see `order_by_patch`.
    """

    def __init__(self, inverse: PreparedInverse, pixels: NDArray[np.int64]) -> None:
        if not isinstance(inverse.operator, SparseMatrix):
            raise InputError(
                f"traces of single pixels need a sparse matrix, not {inverse.operator!r}"
            )
        self.inverse = inverse
        # The transpose has one row per pixel, in the order in which they are wanted.
        self._tiles = Tiles.from_csr(inverse.operator.matrix[inverse.used].T.tocsr()[pixels])

    @property
    def tiles(self) -> Tiles:
        """The operator's transpose, a row for each pixel, a column for each measurement; without
        what is not used.
        """
        used = self.inverse.used.astype(np.uint32)
        return self._tiles._replace(columns=used[self._tiles.columns])

    def fill(self, weights: Array, piece: slice, traces: Array, frames: slice) -> None:
        """Write what the inverse makes of a shot at the pixels ``pixels[piece]``.

        `weights` (used measurements, time and some): `PreparedInverse.weights` of the shot's
        measurements; `traces` (pixels of the piece, time): its columns `frames` are overwritten;
        `frames`: time bins; as many as the measurements have.
        """
        from tofclip.solvers.kernels import compute_traces

        compute_traces(
            *self._tiles,
            (piece.start, piece.start + len(traces)),
            weights,
            traces,
            (frames.start, frames.stop),
        )
