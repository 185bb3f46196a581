"""Parallel projections of a picture at many angles, each onto a line detector of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators.sparse import SparseMatrix, split_between_bins


class RadonProjection(SparseMatrix):
    """Line projections in Radon coordinates (supplement Note 6).

    Pixel (row, column), at ``X = column - columns // 2`` and ``Y = row - rows // 2``, falls on position
    ``detector_px // 2 + X cos(angle) + Y sin(angle) + offset`` of the angle's detector and is shared between the two
    nearest detector pixels. An offset of ``s (du cos(angle) + dv sin(angle))`` makes it A_k B_k for the view (dv, du)
    from the reference, because a line integral turns a 2D shift into a 1D one (Eq. 21).

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
    Readings are (angles * detector_px,), angle by angle.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        detector_px: int,
        angles: ArrayLike,
        offsets_px: ArrayLike,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.sparse

        self.angles = np.asarray(angles, dtype=np.float64)
        self.offsets_px = np.asarray(offsets_px, dtype=np.float64)
        if self.angles.ndim != 1 or self.angles.shape != self.offsets_px.shape:
            raise ShapeError("angles and offsets", "(angles,) each", (self.angles.shape, self.offsets_px.shape))
        if not np.all(np.isfinite([self.angles, self.offsets_px])):
            raise InputError("angles and offsets must be finite")
        reading, pixel, weight = self._entries(image_shape, detector_px)
        readings = self.angles.size * detector_px
        matrix = scipy.sparse.csr_array(
            (weight.astype(dtype), (reading, pixel)), shape=(readings, image_shape[0] * image_shape[1])
        )
        super().__init__(matrix, image_shape, (readings,))

    def _entries(
        self, image_shape: tuple[int, int], detector_px: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Row, column and value of every nonzero."""
        rows, columns = image_shape
        y = (np.arange(rows) - rows // 2)[:, np.newaxis]
        x = (np.arange(columns) - columns // 2)[np.newaxis, :]
        angle = self.angles[:, np.newaxis, np.newaxis]
        position = detector_px // 2 + x * np.cos(angle) + y * np.sin(angle) + self.offsets_px[:, None, None]
        entry, bins, weight = split_between_bins(position, detector_px)
        number, pixel = np.divmod(entry, rows * columns)
        return number * detector_px + bins, pixel, weight
