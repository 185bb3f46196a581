"""Products with a sparse matrix on arrays of other libraries than NumPy, on whatever device they
are.

PyTorch and CuPy have such products, by the maker of the device (cuSPARSE, MKL). For any other
library that follows the array API standard the entries are gathered and summed, which every library
can.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from tofclip.arrays import Array, ComputeDevice, namespace
from tofclip.threads import split_blocks

if TYPE_CHECKING:
    import scipy.sparse

GATHERED_BYTES = 1 << 28
"""At most so much is gathered at once."""


class Product(Protocol):
    """The product with one sparse matrix."""

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block of the matrix's type; the result is (rows, frames)."""
        ...


def make_portable_product(matrix: scipy.sparse.csr_array, device: ComputeDevice) -> Product:
    """Bring a CSR matrix to `device` and return the product with it there.

    `device`: library and device of the arrays to come. Returns takes (columns, frames) arrays on
    that device.
    """
    kinds: dict[str, Callable[..., Product]] = {"torch": TorchProduct, "cupy": CupyProduct}
    return kinds.get(device.library, GatheredProduct)(matrix, device)


class TorchProduct:
    """PyTorch's own product with a CSR matrix."""

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        import torch

        if (
            not matrix.has_canonical_format
        ):  # PyTorch wants every entry once and in order, and does not look
            matrix = matrix.copy()
            matrix.sum_duplicates()
        parts = (device.put(part) for part in (matrix.indptr, matrix.indices, matrix.data))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
            self._matrix = torch.sparse_csr_tensor(
                *parts, size=matrix.shape, check_invariants=False
            )

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        return self._matrix @ block.contiguous()


class CupyProduct:
    """CuPy's own product with a CSR matrix."""

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        from cupyx.scipy.sparse import csr_matrix

        parts = tuple(device.put(part) for part in (matrix.data, matrix.indices, matrix.indptr))
        self._matrix = csr_matrix(parts, shape=matrix.shape)

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        return self._matrix @ block


class GatheredProduct:
    """The sum of what a row's entries gather, by functions of the array API standard alone.

    Every row is filled up with zeros to the longest, so rows of much the same length cost least
    memory.
    """

    def __init__(self, matrix: scipy.sparse.csr_array, device: ComputeDevice) -> None:
        lengths = np.diff(matrix.indptr)
        shape = (matrix.shape[0], max(1, int(lengths.max(initial=0))))
        columns, values = np.zeros(shape, np.int64), np.zeros(shape, matrix.dtype)
        filled = np.arange(shape[1]) < lengths[:, np.newaxis]
        columns[filled], values[filled] = matrix.indices, matrix.data
        self._columns, self._values = device.put(columns), device.put(values[..., np.newaxis])
        self._itemsize = matrix.dtype.itemsize

    def __call__(self, block: Array) -> Array:
        """Multiply a (columns, frames) block."""
        xp = namespace(block)
        rows, width = self._columns.shape
        at_once = max(1, GATHERED_BYTES // max(1, width * block.shape[1] * self._itemsize))
        parts = []
        for piece in split_blocks(rows, at_once):
            columns = self._columns[piece, :]
            gathered = xp.take(block, xp.reshape(columns, (-1,)), axis=0)
            terms = (
                xp.reshape(gathered, (*columns.shape, block.shape[1])) * self._values[piece, ...]
            )
            parts.append(xp.sum(terms, axis=1))
        return xp.concat(parts)
