"""What turns light into measurements: the shear, from the refocused picture to what a view sees
(supplement Eq. 3); which pixels of a sensor are read, the codes of a single pixel, and how masks
weigh the views of a light field (supplement Note 5).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from tofclip.arrays import Array, FloatArray
from tofclip.errors import require, require_axes
from tofclip.operators.base import (
    LinearOperator,
    Reshape,
    Selection,
)

View = tuple[float, float]


class LinearShear(LinearOperator):
    """A shift of the whole picture by s times the view's distance from the reference view, with linear
    interpolation between neighbouring pixels; dark beyond the border.

    View (v, u) sees ``p(x, y) = h(x - s (u - u_ref), y - s (v - v_ref))``, s being the shear in
    pixels per view step; the reference may lie anywhere (viewpoint synthesis). The adjoint is the
    opposite shift, exactly.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        shear: float,
        view: View,
        reference: View = (0.0, 0.0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        super().__init__(image_shape, image_shape, dtype)
        self.shift_px = tuple(float(shear * (a - b)) for a, b in zip(view, reference, strict=True))
        require(
            np.all(np.abs(self.shift_px) < np.asarray(image_shape)),
            f"shear {shear} moves view {view} by {self.shift_px} px, out of a {image_shape} picture; "
            "take a shear nearer to zero",
        )

    def _forward(self, block: Array) -> Array:
        return self._shift(block, *self.shift_px)

    def _adjoint(self, block: Array) -> Array:
        return self._shift(block, *(-shift for shift in self.shift_px))

    def _shift(self, block: Array, down: float, right: float) -> Array:
        from tofclip.operators.kernels import shift_linearly

        rows, columns = (int(np.floor(shift)) for shift in (down, right))
        below, beside = np.array([down - rows, right - columns], self.dtype)
        shifted = np.empty_like(block)
        shift_linearly(block, rows, columns, below, beside, shifted)
        return shifted


class DenseSensor(Reshape):
    """Every pixel of a plane of `plane_shape` is read, row by row; `dtype` float32 or float64."""

    def __init__(self, plane_shape: tuple[int, int], dtype: DTypeLike = np.float32) -> None:
        super().__init__(plane_shape, (plane_shape[0] * plane_shape[1],), dtype)


class PitchedSensor(Selection):
    """Small pixels far apart: every n-th pixel of the plane is read (supplement Note 3, sparse 2D
    sensors), of a picture of `plane_shape`, in `dtype` float32 or float64. `pitch_px` is the distance
    from row to row and from column to column, at least 1; where it is not a whole number, the pixels
    nearest below the true places are read. `offset_px`: first row and column that are read.
    """

    def __init__(
        self,
        plane_shape: tuple[int, int],
        pitch_px: tuple[float, float],
        offset_px: tuple[float, float] = (0, 0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        axes = []
        for size, pitch, offset in zip(plane_shape, pitch_px, offset_px, strict=True):
            require(
                np.isfinite(pitch) and pitch >= 1,
                f"a sensor's pitch must be at least one pixel, got {pitch}",
            )
            require(
                0 <= offset < size,
                f"a sensor's offset must lie on the plane of {size} px, got {offset}",
            )
            # The sum of many pitches must not fall short of a whole number by rounding.
            places = np.floor(np.arange(offset, size, pitch) + 1e-9).astype(np.intp)
            axes.append(places[places < size])
        rows, columns = axes
        pixels = (rows[:, np.newaxis] * plane_shape[1] + columns).ravel()
        super().__init__(plane_shape, (pixels.size,), pixels, dtype)
        self.grid_shape = (rows.size, columns.size)
        """Rows and columns of the sensor: measurements reshaped to it are a picture."""


class HadamardCodes(LinearOperator):
    """Random 0/1 codes with a fast product: rows of a Hadamard matrix whose columns have random
    signs, so many `codes` of pictures of `image_shape`, in `dtype` float32 or float64; the signs and the
    rows are those of a `seed`.

    A code is ``(1 + H D) / 2``: D holds a random sign for each pixel, and the rows of H are drawn
    without replacement (structurally random matrices, T. T. Do et al., IEEE Trans. Signal Process.
    60, 139 (2012)). H is the Kronecker product of one Hadamard matrix for each side, the picture
    padded to powers of two, so that all of it is a fast Walsh-Hadamard transform along either side
    of the picture.
    """

    def __init__(
        self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(image_shape, (codes,), dtype)
        self._padded = tuple(1 << (size - 1).bit_length() for size in image_shape)
        cells = self._padded[0] * self._padded[1]
        require(codes <= cells, f"a {image_shape} picture has at most {cells} codes, not {codes}")
        random = np.random.default_rng(seed)
        self._signs = random.choice(np.array([-1, 1], self.dtype), image_shape)[..., np.newaxis]
        rows, columns = np.unravel_index(random.choice(cells, codes, replace=False), self._padded)
        self._chosen = columns * self._padded[0] + rows  # the spectrum comes out transposed

    def _forward(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), batch = self.shape_in, block.shape[-1]
        padded_rows, padded_columns = self._padded
        signed = np.zeros((padded_rows, columns, batch), self.dtype)
        np.multiply(block, self._signs, out=signed[:rows])
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        spectrum = np.zeros((padded_columns, padded_rows, batch), self.dtype)
        spectrum[:columns] = signed.swapaxes(0, 1)
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        coded = spectrum.reshape(-1, batch)[self._chosen]
        coded += block.sum(axis=0).sum(axis=0)
        coded /= 2
        return coded

    def _adjoint(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), batch = self.shape_in, block.shape[-1]
        padded_rows, padded_columns = self._padded
        spectrum = np.zeros((padded_columns * padded_rows, batch), self.dtype)
        spectrum[self._chosen] = block
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        half_way = spectrum.reshape(padded_columns, padded_rows, batch)[:columns]
        signed = np.ascontiguousarray(half_way.swapaxes(0, 1))
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        pictures = signed[:rows] * self._signs
        pictures += block.sum(axis=0)
        pictures /= 2
        return pictures


class WeightedViews(LinearOperator):
    """Exposures through masks in the aperture: ``y_j = sum_k w_jk P_k`` (supplement Eq. 17), from
    light fields (views, rows, columns) of pictures of `image_shape` to (exposures * rows *
    columns,). `weights` (exposures, views) are w, what fraction of each view's light an
    exposure's mask lets pass; `dtype` float32 or float64.
    """

    def __init__(
        self, image_shape: tuple[int, int], weights: ArrayLike, dtype: DTypeLike = np.float32
    ) -> None:
        self.weights = np.asarray(weights, dtype=dtype)
        require_axes("mask weights", "exposures, views", self.weights.shape)
        require(np.all(np.isfinite(self.weights)), "mask weights must be finite")
        exposures, views = self.weights.shape
        super().__init__(
            (views, *image_shape), (exposures * image_shape[0] * image_shape[1],), dtype
        )

    def _forward(self, block: Array) -> Array:
        # One dense product for all pixels and frames: a mask in the aperture treats every pixel
        # alike.
        seen = self.weights @ block.reshape(len(block), -1)
        return seen.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        spread = self.weights.T @ block.reshape(len(self.weights), -1)
        return spread.reshape(*self.shape_in, -1)


def make_sheared_mask(
    image_shape: tuple[int, int],
    views: Sequence[View],
    mask_shear: float,
    random: np.random.Generator,
) -> FloatArray:
    """Make the codes of a random mask at some distance in front of the sensor, (views, rows, columns):
    from view to view it appears moved by `mask_shear` pixels. Transmissions are evenly from 0 to 1.
    """
    # So much larger that no view looks past the edge of the mask.
    margin = int(np.ceil(abs(mask_shear) * np.abs(np.asarray(views)).max())) + 1
    large = (image_shape[0] + 2 * margin, image_shape[1] + 2 * margin)
    mask = random.random(large)
    inner = (slice(margin, -margin), slice(margin, -margin))
    return np.stack(
        [LinearShear(large, mask_shear, view, dtype=np.float64)(mask)[inner] for view in views]
    )
