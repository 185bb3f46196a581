"""Convolution of a picture with a point-spread function: what a lens, a mask or a diffuser puts on
a sensor.

A 1D sensor behind point-spread functions (supplement Note 4), and coded lines as such functions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.arrays import Array, FloatArray
from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import LinearOperator


class PointSpreadConvolution(LinearOperator):
    """A picture convolved with a point-spread function (PSF), on the plane of the sensor
    (supplement Eq. 4).

    A point in the picture's middle puts the PSF, as it is, about the sensor's middle. The
    convolution is linear: the picture is dark beyond its border, and light that falls beside the
    sensor is lost. It runs over Fourier space, padded by just as much as keeps periodic images of
    the picture off the sensor.

    Parameters
    ----------
    image_shape : (int, int)
        Rows and columns of the picture.
    point_spread : (rows, columns) array
        Light on the sensor from a point of brightness 1; its origin is pixel
        ``(rows // 2, columns // 2)``.
    sensor_shape : (int, int), optional
        Rows and columns of the sensor, about the picture's middle; the default is the picture's
        shape. A lensless camera sees more than its sensor covers: then the picture is the larger.
    dtype : dtype
        float32 or float64.

    Raises
    ------
    ShapeError, InputError
        The PSF is larger than the picture, dark everywhere, or holds NaN or infinity.

    Notes
    -----
    ``scipy.fft`` is used: 0.18 ms for both transforms of a 128 x 128 picture padded to 192 x 192. A
    pyFFTW plan takes 0.16 ms unmeasured and 0.12 ms measured, but owns its memory, so that threads
    would have to wait for each other.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spread: ArrayLike,
        sensor_shape: tuple[int, int] | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.fft

        sensor_shape = image_shape if sensor_shape is None else sensor_shape
        super().__init__(image_shape, sensor_shape, dtype)
        spread, centre = _crop_to_support(validate_point_spread(point_spread, image_shape))
        sides = zip(image_shape, sensor_shape, strict=True)
        first = [image // 2 - sensor // 2 for image, sensor in sides]
        # long enough that no period's copy of the picture reaches the sensor
        self._padded = tuple(
            scipy.fft.next_fast_len(alias_free_length(*sizes), real=True)
            for sizes in zip(image_shape, sensor_shape, spread.shape, first, centre, strict=True)
        )
        placed = np.zeros(self._padded, self.dtype)
        placed[: spread.shape[0], : spread.shape[1]] = spread
        # pixel (0, 0) of the result is the sensor's first pixel, under the PSF's centre
        shift = [-(begin + middle) for begin, middle in zip(first, centre, strict=True)]
        self._spectrum = scipy.fft.rfft2(np.roll(placed, shift, (0, 1)))[..., np.newaxis]
        self._conjugate = self._spectrum.conj()  # correlation: it turns the convolution around

    def _forward(self, block: Array) -> Array:
        return self._apply_spectrum(block, self._spectrum, self.shape_out)

    def _adjoint(self, block: Array) -> Array:
        return self._apply_spectrum(block, self._conjugate, self.shape_in)

    def _apply_spectrum(
        self, block: Array, spectrum: NDArray[Any], shape: tuple[int, ...]
    ) -> Array:
        import scipy.fft

        # One axis after the other: rows of padding need no transform along themselves.
        rows, columns = self._padded
        transformed = scipy.fft.rfft(block, columns, axis=1)
        transformed = scipy.fft.fft(transformed, rows, axis=0, overwrite_x=True)
        transformed *= spectrum
        kept = scipy.fft.ifft(transformed, axis=0, overwrite_x=True)[: shape[0]]
        filtered = scipy.fft.irfft(kept, columns, axis=1, overwrite_x=True)
        return np.ascontiguousarray(filtered[:, : shape[1]])


def validate_point_spread(point_spread: ArrayLike, image_shape: tuple[int, int]) -> FloatArray:
    """Return a PSF as float64 once it is known to fit pictures of `image_shape`."""
    spread = np.asarray(point_spread, dtype=np.float64)
    if spread.ndim != 2 or 0 in spread.shape:
        raise ShapeError("a point-spread function", "(rows, columns)", spread.shape)
    if any(size > limit for size, limit in zip(spread.shape, image_shape, strict=True)):
        raise InputError(
            f"a point-spread function of {spread.shape} px is larger than the picture of {tuple(image_shape)} px; "
            "crop it or bin it to the picture's pixels"
        )
    if not np.all(np.isfinite(spread)):
        raise InputError("a point-spread function must not hold NaN or infinity")
    if not spread.any():
        raise InputError(
            "a point-spread function that is dark everywhere shows nothing; check its background"
        )
    return spread


def _crop_to_support(spread: FloatArray) -> tuple[FloatArray, list[int]]:
    """Cut a PSF down to where it is not zero; return it and where its origin lies then."""
    lit = [np.flatnonzero(spread.any(axis=other)) for other in (1, 0)]
    cut = spread[lit[0][0] : lit[0][-1] + 1, lit[1][0] : lit[1][-1] + 1]
    # the centre stays where it was, although dark rows and columns are gone
    return cut, [size // 2 - int(axis[0]) for size, axis in zip(spread.shape, lit, strict=True)]


def alias_free_length(image: int, sensor: int, spread: int, first: int, centre: int) -> int:
    """Least period, pixels, for which no sensor pixel gets light from a periodic image of the picture.

    Sensor pixels lie at first ... first + sensor - 1 of the picture's own pixels 0 ... image - 1;
    the PSF reaches from -centre to spread - 1 - centre.
    """
    return max(image, sensor, spread, first + sensor + centre, image - first + spread - 1 - centre)


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
) -> FloatArray:
    """Make a line PSF of sum 1 times a random 0/1 code of `width_px` (n_p) cells in each row (supplement
    Note 4). Each row's cells are moved by ``row * tan(angle)`` columns, `angle` being that of the line
    from the vertical, and shared between two columns where that is not a whole number.
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
    first = columns // 2 - width_px // 2
    slant = np.tan(angle) * (np.arange(rows)[:, None] - rows // 2)
    place = first + np.arange(width_px) + slant
    left = np.floor(place).astype(int)
    spread = np.zeros(shape)
    for column, share in ((left, 1 - place + left), (left + 1, place - left)):
        row, cell = np.nonzero((column >= 0) & (column < columns))
        np.add.at(spread, (row, column[row, cell]), (code * share)[row, cell])
    spread /= spread.sum()
    return spread
