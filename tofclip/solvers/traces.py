"""The linear inverse pixel by pixel: a few pixels at all instants, instead of all pixels at a few
instants.

Code that looks at one pixel's brightness over time, as the search for returns does, never needs the
transient cube: the dense part of the inverse, which is small, is worked out for the whole shot, and
the sparse part for a few pixels at a time, whose traces stay in cache.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array
from tofclip.errors import InputError
from tofclip.operators import SparseMatrix
from tofclip.operators.sparse import Tiles
from tofclip.solvers.direct import PreparedInverse

PATCH_ROWS, PATCH_COLUMNS = (
    8,
    8,
)  # the measurements that such a patch looks at stay in the second-level cache


def order_by_patch(image_shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the numbers of all pixels of a picture, counted in raster order, patch by patch."""
    row, column = np.divmod(np.arange(image_shape[0] * image_shape[1]), image_shape[1])
    return np.lexsort((column, row, column // PATCH_COLUMNS, row // PATCH_ROWS))


class InverseTraces:
    """A prepared inverse whose sparse part is applied to pixels in an order of their own.

    Parameters
    ----------
    inverse : PreparedInverse
        Of a sparse matrix in float32.
    pixels : (n,) int array
        Numbers of the pixels, counted in raster order; see `order_by_patch`.
    """

    def __init__(self, inverse: PreparedInverse, pixels: NDArray[np.int64]) -> None:
        if not isinstance(inverse.operator, SparseMatrix):
            raise InputError(
                f"traces of single pixels need a sparse matrix, not {inverse.operator!r}"
            )
        self.inverse = inverse
        # The transpose has one row per pixel, in the order in which they are wanted.
        self._tiles = Tiles.from_csr(inverse.operator.matrix.T.tocsr()[pixels])

    def peak_response(self, readings: Array, span: slice) -> Array:
        """Return how far the brightest pixel of each back-projected frame stands out.

        Parameters
        ----------
        readings : (measurements, frames) contiguous array
            In units of their noise.
        span : slice
            Of the frames, a multiple of `LANES` of them.

        Returns
        -------
        (frames of the span,) array
            The largest ``a'f / |a|`` over the columns a of A: the response of the filter that is
            matched to a lone pixel, in units of its noise. Never below zero.
        """
        from tofclip.solvers.kernels import update_peaks

        highest = np.zeros(span.stop - span.start, readings.dtype)
        update_peaks(*self._tiles, self._scales, readings, (span.start, span.stop), highest)
        return highest

    @cached_property
    def _scales(self) -> Array:
        """``1 / |a|`` of each pixel, 0 where nothing is seen."""
        starts, _, values = self._tiles
        # Sums between the starts of neighbouring pixels, in float64: differences of a running sum
        # lose digits.
        ends = np.concatenate([[0], np.cumsum(values.astype(np.float64) ** 2)])
        energy = (ends[starts[:, 1:]] - ends[starts[:, :-1]]).sum(axis=0)
        scales = np.divide(1, np.sqrt(energy), out=np.zeros(energy.size), where=energy > 0)
        return scales.astype(values.dtype)

    def fill(self, weights: Array, piece: slice, traces: Array, frames: slice) -> None:
        """Write what the inverse makes of a shot at the pixels ``pixels[piece]``.

        Parameters
        ----------
        weights : (measurements, time and some) array
            `PreparedInverse.weights` of the shot's measurements.
        piece : slice
        traces : (pixels of the piece, time) contiguous array
            Its columns `frames` are overwritten.
        frames : slice
            Time bins; as many as the measurements have.
        """
        from tofclip.solvers.kernels import compute_traces

        compute_traces(
            *self._tiles,
            (piece.start, piece.start + len(traces)),
            weights,
            traces,
            (frames.start, frames.stop),
        )
