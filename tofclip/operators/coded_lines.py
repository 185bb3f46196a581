"""A 1D sensor behind point-spread functions (supplement Note 4), and coded lines as such functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import Array, LinearOperator
from tofclip.operators.convolution import alias_free_length, validate_point_spread


class SliceConvolution(LinearOperator):
    """The middle row of a picture's convolution with each of several PSFs: what 1D sensors read
    (Eq. 8).

    Along the sensor's direction the convolution is a product in Fourier space; across it, each of
    the picture's rows is weighed by its own row of the PSF and all are summed. So at every
    frequency k the measurements are a small matrix times the picture's column of the spectrum,
    ``L[k] = G_k P_k`` (supplement Eq. 15 and 16). Its cost and memory, 8 bytes for each PSF, row
    and frequency, do not depend on how large or how sparse the PSFs are.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of the picture. The sensors lie at row ``(rows - 1) // 2``, from where a
        PSF as high as the picture reaches all rows.
    point_spreads : (lines, rows, columns) array
        Light on the sensor's plane from a point in the middle; the origin is pixel ``(rows // 2,
        columns // 2)``.
    sensor_px : int, optional
        Pixels of each sensor, about the picture's middle; the default is the picture's columns.
    dtype : dtype
        float32 or float64.

    Notes
    -----
    Measurements are (lines * sensor_px,), PSF by PSF.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spreads: ArrayLike,
        sensor_px: int | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.fft

        spreads = np.asarray(point_spreads, dtype=dtype)
        if spreads.ndim != 3 or len(spreads) == 0:
            raise ShapeError("the PSFs of 1D sensors", "(lines, rows, columns)", spreads.shape)
        for spread in spreads:
            validate_point_spread(spread, image_shape)
        rows, columns = image_shape
        self.sensor_px = columns if sensor_px is None else sensor_px
        super().__init__(image_shape, (len(spreads) * self.sensor_px,), dtype)
        # The sensor's row sees row y of the picture through row `centre + sensor - y` of the PSF.
        mirrored = np.zeros((len(spreads), rows, spreads.shape[2]), self.dtype)
        seen_through = spreads.shape[1] // 2 + (rows - 1) // 2 - np.arange(rows)
        reached = (seen_through >= 0) & (seen_through < spreads.shape[1])
        mirrored[:, reached] = spreads[:, seen_through[reached]]
        centre = spreads.shape[2] // 2
        first = columns // 2 - self.sensor_px // 2
        least = alias_free_length(columns, self.sensor_px, spreads.shape[2], first, centre)
        self._padded = scipy.fft.next_fast_len(least, real=True)
        placed = np.zeros((len(spreads), rows, self._padded), self.dtype)
        placed[..., : spreads.shape[2]] = mirrored
        spectra = scipy.fft.rfft(np.roll(placed, -(first + centre), axis=2), axis=2)
        self.spectra = np.ascontiguousarray(np.moveaxis(spectra, 2, 0))
        """G_k of every frequency k of the padded sensor, (frequencies, lines, rows)."""

    def _forward(self, block: Array) -> Array:
        import scipy.fft

        columns = np.moveaxis(scipy.fft.rfft(block, self._padded, axis=1), 1, 0)
        lines = scipy.fft.irfft(self.spectra @ columns, self._padded, axis=0)[: self.sensor_px]
        return np.ascontiguousarray(np.moveaxis(lines, 0, 1)).reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        import scipy.fft

        measurements = block.reshape(-1, self.sensor_px, block.shape[-1])
        lines = np.moveaxis(scipy.fft.rfft(measurements, self._padded, axis=1), 1, 0)
        # G^H l without a conjugated copy of G: conj(G^T conj(l)).
        columns = (self.spectra.swapaxes(1, 2) @ lines.conj()).conj()
        rows = scipy.fft.irfft(columns, self._padded, axis=0)[: self.shape_in[1]]
        return np.ascontiguousarray(np.moveaxis(rows, 0, 1))


def make_coded_line(
    shape: tuple[int, int], width_px: int, angle: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Make a line PSF times a random 0/1 code (supplement Note 4).

    `shape`: rows and columns of the PSF; the line runs through all rows; `width_px`: n_p, cells of
    the code in each row; `angle`: of the line from the vertical, rad; each row's cells are moved by
    ``row * tan(angle)`` columns, and shared between two columns where that is not a whole number;
    `random`: of the code. Returns (rows, columns): its sum is 1.
    """
    rows, columns = shape
    if not 1 <= width_px <= columns:
        raise InputError(f"a coded line must be 1 to {columns} px wide, got {width_px}")
    if not abs(angle) < np.pi / 2:
        raise InputError(
            f"a line's angle from the vertical must lie between -90 and 90 degrees, got {angle} rad"
        )
    code = random.integers(0, 2, (rows, width_px))
    code[rows // 2, width_px // 2] = 1  # never dark altogether
    place = (
        columns // 2
        - width_px // 2
        + np.arange(width_px)
        + np.tan(angle) * (np.arange(rows)[:, None] - rows // 2)
    )
    left = np.floor(place).astype(int)
    spread = np.zeros(shape)
    for column, share in ((left, 1 - place + left), (left + 1, place - left)):
        row, cell = np.nonzero((column >= 0) & (column < columns))
        np.add.at(spread, (row, column[row, cell]), (code * share)[row, cell])
    spread /= spread.sum()
    return spread
