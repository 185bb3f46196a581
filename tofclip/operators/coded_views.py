"""Operators of compressive light-field photography (supplement Note 5): whole light fields on dense
area sensors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators.base import Array, LinearOperator
from tofclip.operators.shear import LinearShear, View


class WeightedViews(LinearOperator):
    """Exposures through masks in the aperture: ``y_j = sum_k w_jk P_k`` (supplement Eq. 17).

    Parameters
    ----------
    image_shape : (int, int)
    weights : (exposures, views) array
        w, what fraction of each view's light an exposure's mask lets pass.
    dtype : dtype
        float32 or float64.

    Notes
    -----
    Light fields are (views, rows, columns); measurements are (exposures * rows * columns,).
    """

    def __init__(
        self, image_shape: tuple[int, int], weights: ArrayLike, dtype: DTypeLike = np.float32
    ) -> None:
        self.weights = np.asarray(weights, dtype=dtype)
        if self.weights.ndim != 2:
            raise ShapeError("mask weights", "(exposures, views)", self.weights.shape)
        if not np.all(np.isfinite(self.weights)):
            raise InputError("mask weights must be finite")
        exposures, views = self.weights.shape
        super().__init__(
            (views, *image_shape), (exposures * image_shape[0] * image_shape[1],), dtype
        )

    def _forward(self, block: Array) -> Array:
        # One dense product for all pixels and frames: a mask in the aperture treats every pixel
        # alike.
        seen: Array = self.weights @ block.reshape(len(block), -1)
        return seen.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        spread: Array = self.weights.T @ block.reshape(len(self.weights), -1)
        return spread.reshape(*self.shape_in, -1)


class MaskedViews(LinearOperator):
    """One exposure through a mask near the sensor: ``y = sum_k C_k P_k``, C_k the mask as view k
    sees it (Eq. 18).

    Parameters
    ----------
    codes : (views, rows, columns) array
        Diagonals of C_k.
    dtype : dtype
        float32 or float64.

    Notes
    -----
    Light fields are (views, rows, columns); measurements are (rows * columns,).
    """

    def __init__(self, codes: ArrayLike, dtype: DTypeLike = np.float32) -> None:
        self.codes = np.asarray(codes, dtype=dtype)
        if self.codes.ndim != 3:
            raise ShapeError("mask codes", "(views, rows, columns)", self.codes.shape)
        if not np.all(np.isfinite(self.codes)):
            raise InputError("mask codes must be finite")
        super().__init__(self.codes.shape, (self.codes.shape[1] * self.codes.shape[2],), dtype)

    def _forward(self, block: Array) -> Array:
        seen: Array = np.einsum("kyx,kyxb->yxb", self.codes, block)
        return seen.reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        # A diagonal matrix is its own transpose: light goes back through the same holes.
        plane = block.reshape(*self.shape_in[1:], -1)
        spread: Array = self.codes[..., np.newaxis] * plane
        return spread


class ShearedViews(LinearOperator):
    """All views that a picture at one depth has: ``[B_1; B_2; ...]``, (rows, columns) to (views,
    rows, columns).

    Composed with a model of the whole light field it makes that of the picture refocused at one
    depth (Eq. 21).

    Parameters
    ----------
    image_shape : (int, int)
    views : sequence of (float, float)
    shear : float
        s, pixels per view step.
    reference : (float, float)
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        views: Sequence[View],
        shear: float,
        reference: View = (0.0, 0.0),
        dtype: DTypeLike = np.float32,
    ) -> None:
        super().__init__(image_shape, (len(views), *image_shape), dtype)
        self._shears = [LinearShear(image_shape, shear, view, reference, dtype) for view in views]

    def _forward(self, block: Array) -> Array:
        return np.stack([shear._forward(block) for shear in self._shears])

    def _adjoint(self, block: Array) -> Array:
        total = np.zeros((*self.shape_in, block.shape[-1]), self.dtype)
        for shear, part in zip(self._shears, block, strict=True):
            total += shear._adjoint(part)
        return total


def make_sheared_mask(
    image_shape: tuple[int, int],
    views: Sequence[View],
    mask_shear: float,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Make the codes of a random mask at some distance in front of the sensor.

    `mask_shear`: pixels by which the mask appears moved from view to view: 0 on the sensor, where
    all views see it alike; `random`: of the mask's transmissions, evenly from 0 to 1. Returns
    (views, rows, columns).
    """
    # So much larger that no view looks past the edge of the mask.
    margin = int(np.ceil(abs(mask_shear) * np.abs(np.asarray(views)).max())) + 1
    large = (image_shape[0] + 2 * margin, image_shape[1] + 2 * margin)
    mask = random.random(large)
    inner = (slice(margin, -margin), slice(margin, -margin))
    return np.stack(
        [LinearShear(large, mask_shear, view, dtype=np.float64)(mask)[inner] for view in views]
    )
