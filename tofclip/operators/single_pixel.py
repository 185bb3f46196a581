"""Codes of a single-pixel camera: sums of the picture under 0/1 masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from tofclip.errors import InputError
from tofclip.operators.base import Array, LinearOperator


class HadamardCodes(LinearOperator):
    """Random 0/1 codes with a fast product: rows of a Hadamard matrix whose columns have random signs.

    A code is ``(1 + H D) / 2``: D holds a random sign for each pixel, and the rows of H are drawn without
    replacement (structurally random matrices, T. T. Do et al., IEEE Trans. Signal Process. 60, 139 (2012)). H is the
    Kronecker product of one Hadamard matrix for each side, the picture padded to powers of two, so that all of it
    is a matrix product on either side of the picture.

    Parameters
    ----------
    image_shape : (int, int)
    codes : int
        Number of readings.
    seed : int
        Of the signs and the rows.
    dtype : dtype
        float32 or float64.
    """

    def __init__(self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32) -> None:
        import scipy.linalg

        super().__init__(image_shape, (codes,), dtype)
        padded = [1 << (size - 1).bit_length() for size in image_shape]
        if codes > padded[0] * padded[1]:
            raise InputError(f"a {image_shape} picture has at most {padded[0] * padded[1]} codes, not {codes}")
        random = np.random.default_rng(seed)
        self._signs = random.choice(np.array([-1, 1], self.dtype), image_shape)
        chosen = random.choice(padded[0] * padded[1], codes, replace=False)
        self._chosen = np.unravel_index(chosen, padded)
        self._vertical, self._horizontal = (
            scipy.linalg.hadamard(n).astype(self.dtype)[:, :size] for n, size in zip(padded, image_shape, strict=True)
        )

    def _forward(self, block: Array) -> Array:
        pictures = np.moveaxis(block, -1, 0)
        spectrum = self._vertical @ (pictures * self._signs) @ self._horizontal.T
        coded = spectrum[:, self._chosen[0], self._chosen[1]] + pictures.sum(axis=(1, 2))[:, np.newaxis]
        return np.ascontiguousarray(coded.T / 2)

    def _adjoint(self, block: Array) -> Array:
        readings = block.T
        spectrum = np.zeros((block.shape[-1], self._vertical.shape[0], self._horizontal.shape[0]), self.dtype)
        spectrum[:, self._chosen[0], self._chosen[1]] = readings
        pictures = (self._vertical.T @ spectrum @ self._horizontal) * self._signs
        pictures += readings.sum(axis=1)[:, np.newaxis, np.newaxis]
        return np.ascontiguousarray(np.moveaxis(pictures / 2, 0, -1))


class RandomCodes(LinearOperator):
    """Independent random 0/1 codes, kept as a dense matrix: the reference for `HadamardCodes`.

    Parameters
    ----------
    image_shape : (int, int)
    codes : int
        Number of readings.
    seed : int
    dtype : dtype
        float32 or float64.
    """

    def __init__(self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32) -> None:
        super().__init__(image_shape, (codes,), dtype)
        drawn = np.random.default_rng(seed).integers(0, 2, (codes, image_shape[0] * image_shape[1]))
        self._codes = drawn.astype(self.dtype)

    def _forward(self, block: Array) -> Array:
        coded: Array = self._codes @ block.reshape(-1, block.shape[-1])
        return coded

    def _adjoint(self, block: Array) -> Array:
        return (self._codes.T @ block).reshape(*self.shape_in, block.shape[-1])
