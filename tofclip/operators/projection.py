"""The line projection: what a row of cylindrical lenslets puts on a slit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import ShapeError
from tofclip.operators.sparse import SparseMatrix, split_between_bins


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
        position = (
            self.centres_px[:, np.newaxis, np.newaxis]
            + x
            - y * np.tan(self.angles)[:, np.newaxis, np.newaxis]
        )
        entry, slit, weight = split_between_bins(position, slit_width_px)
        view, pixel = np.divmod(entry, rows * columns)
        return slit, pixel, self.gains[view] * weight
