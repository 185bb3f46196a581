"""Codes of a single-pixel camera: sums of the picture under 0/1 masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from tofclip.errors import InputError
from tofclip.operators.base import Array, LinearOperator


class HadamardCodes(LinearOperator):
    """Random 0/1 codes with a fast product: rows of a Hadamard matrix whose columns have random
    signs.

    A code is ``(1 + H D) / 2``: D holds a random sign for each pixel, and the rows of H are drawn
    without replacement (structurally random matrices, T. T. Do et al., IEEE Trans. Signal Process.
    60, 139 (2012)). H is the Kronecker product of one Hadamard matrix for each side, the picture
    padded to powers of two, so that all of it is a fast Walsh-Hadamard transform along either side
    of the picture.

    Parameters
    ----------
    image_shape : (int, int)
    codes : int
        Number of measurements.
    seed : int
        Of the signs and the rows.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(image_shape, (codes,), dtype)
        self._padded = tuple(1 << (size - 1).bit_length() for size in image_shape)
        cells = self._padded[0] * self._padded[1]
        if codes > cells:
            raise InputError(f"a {image_shape} picture has at most {cells} codes, not {codes}")
        random = np.random.default_rng(seed)
        self._signs = random.choice(np.array([-1, 1], self.dtype), image_shape)[..., np.newaxis]
        rows, columns = np.unravel_index(random.choice(cells, codes, replace=False), self._padded)
        self._chosen = columns * self._padded[0] + rows  # the spectrum comes out transposed

    def _forward(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), (padded_rows, padded_columns), batch = (
            self.shape_in,
            self._padded,
            block.shape[-1],
        )
        signed = np.zeros((padded_rows, columns, batch), self.dtype)
        np.multiply(block, self._signs, out=signed[:rows])
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        spectrum = np.zeros((padded_columns, padded_rows, batch), self.dtype)
        spectrum[:columns] = signed.swapaxes(0, 1)
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        coded: Array = spectrum.reshape(-1, batch)[self._chosen]
        coded += block.sum(axis=0).sum(axis=0)
        coded /= 2
        return coded

    def _adjoint(self, block: Array) -> Array:
        from tofclip.operators.kernels import transform_walsh_hadamard

        (rows, columns), (padded_rows, padded_columns), batch = (
            self.shape_in,
            self._padded,
            block.shape[-1],
        )
        spectrum = np.zeros((padded_columns * padded_rows, batch), self.dtype)
        spectrum[self._chosen] = block
        transform_walsh_hadamard(spectrum.reshape(padded_columns, -1))
        half_way = spectrum.reshape(padded_columns, padded_rows, batch)[:columns]
        signed = np.ascontiguousarray(half_way.swapaxes(0, 1))
        transform_walsh_hadamard(signed.reshape(padded_rows, -1))
        pictures: Array = signed[:rows] * self._signs
        pictures += block.sum(axis=0)
        pictures /= 2
        return pictures


class RandomCodes(LinearOperator):
    """Independent random 0/1 codes, kept as a dense matrix: the reference for `HadamardCodes`.

    Parameters
    ----------
    image_shape : (int, int)
    codes : int
        Number of measurements.
    seed : int
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self, image_shape: tuple[int, int], codes: int, seed: int, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(image_shape, (codes,), dtype)
        drawn = np.random.default_rng(seed).integers(0, 2, (codes, image_shape[0] * image_shape[1]))
        self._codes = drawn.astype(self.dtype)

    def _forward(self, block: Array) -> Array:
        coded: Array = self._codes @ block.reshape(-1, block.shape[-1])
        return coded

    def _adjoint(self, block: Array) -> Array:
        return (self._codes.T @ block).reshape(*self.shape_in, block.shape[-1])
