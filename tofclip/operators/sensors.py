"""Area sensors: which pixels of the light on the sensor's plane are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import Array, LinearOperator


class _Sensor(LinearOperator):
    """The measurements of some pixels of a plane; the adjoint leaves the others dark.

    `plane_shape`: rows and columns of the light on the sensor's plane; `pixels` (measurements,):
    flat numbers of the pixels that are read, without repeats.
    """

    def __init__(
        self, plane_shape: tuple[int, int], pixels: NDArray[np.intp], dtype: DTypeLike
    ) -> None:
        if pixels.size == 0:
            raise InputError(
                f"no pixel of the {tuple(plane_shape)} plane is read; check the sensor's mask and offset"
            )
        super().__init__(plane_shape, (pixels.size,), dtype)
        self.pixels = pixels

    def _forward(self, block: Array) -> Array:
        read: Array = block.reshape(-1, block.shape[-1])[self.pixels]
        return read

    def _adjoint(self, block: Array) -> Array:
        plane = np.zeros((self.shape_in[0] * self.shape_in[1], block.shape[-1]), self.dtype)
        plane[self.pixels] = block
        return plane.reshape(*self.shape_in, -1)


class DenseSensor(_Sensor):
    """Every pixel is read, row by row.

    Parameters
    ----------
    plane_shape : (int, int)
    dtype : dtype
        float32 or float64.
    """

    def __init__(self, plane_shape: tuple[int, int], dtype: DTypeLike = np.float32) -> None:
        super().__init__(plane_shape, np.arange(plane_shape[0] * plane_shape[1]), dtype)

    def _forward(self, block: Array) -> Array:
        return block.reshape(-1, block.shape[-1])

    def _adjoint(self, block: Array) -> Array:
        return block.reshape(*self.shape_in, -1)


class PitchedSensor(_Sensor):
    """Small pixels far apart: every n-th pixel of the plane is read (supplement Note 3, sparse 2D
    sensors).

    Parameters
    ----------
    plane_shape : (int, int)
    pitch_px : (float, float)
        Distance from row to row and from column to column, at least 1. A pitch that is not a whole
        number reads the pixels nearest below the true places.
    offset_px : (float, float)
        First row and column that are read.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        plane_shape: tuple[int, int],
        pitch_px: tuple[float, float],
        offset_px: tuple[float, float] = (0, 0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        rows, columns = (
            _pixel_positions(*axis) for axis in zip(plane_shape, pitch_px, offset_px, strict=True)
        )
        super().__init__(
            plane_shape, (rows[:, np.newaxis] * plane_shape[1] + columns).ravel(), dtype
        )
        self.grid_shape = (rows.size, columns.size)
        """Rows and columns of the sensor: measurements reshaped to it are a picture."""


class MaskedSensor(_Sensor):
    """Only live pixels are read: defective ones are left out, or the sensor has any layout
    whatever.

    Parameters
    ----------
    live : (rows, columns) bool array
    dtype : dtype
        float32 or float64.
    """

    def __init__(self, live: ArrayLike, dtype: DTypeLike = np.float32) -> None:
        mask = np.asarray(live, dtype=bool)
        if mask.ndim != 2:
            raise ShapeError("the mask of live pixels", "(rows, columns)", mask.shape)
        super().__init__((mask.shape[0], mask.shape[1]), np.flatnonzero(mask), dtype)


def _pixel_positions(size: int, pitch_px: float, offset_px: float) -> NDArray[np.intp]:
    if not (np.isfinite(pitch_px) and pitch_px >= 1):
        raise InputError(f"a sensor's pitch must be at least one pixel, got {pitch_px}")
    if not 0 <= offset_px < size:
        raise InputError(f"a sensor's offset must lie on the plane of {size} px, got {offset_px}")
    # The sum of many pitches must not fall short of a whole number by rounding.
    return np.floor(np.arange(offset_px, size, pitch_px) + 1e-9).astype(np.intp)
