"""From plane waves to the voxels of a plane: inverse Fourier transforms without the parts that are
0 or unwanted.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nlos.fourier_plans import FourierPlan, allocate_zeros, plan_transform
from nlos.rsd.kernels import transpose
from nlos.rsd.transfer import VECTOR_LENGTH

CACHE_BYTES = 1 << 19
"""Spectra that are transformed at a time: they stay in a core's second cache, and calls stay few."""

PRODUCT_SPEEDUP = 3
"""How many operations of a matrix product take as long as one of a pruned Fourier transform;
measured.
"""


WaveIndices = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Of plane waves along y and x, in arrays of one shape; these reach as far below 0 as above."""


class Inverse(Protocol):
    """From the spectra of several terms to their images, with memory of its own; not to be shared
    between threads.
    """

    cell_indices: NDArray[np.int64]
    """Where in a spectrum every plane wave goes, in the shape of its indices."""

    spare: int
    """A cell that belongs to no wave."""

    carrier: NDArray[np.complex64]
    """What every column of an image has still to be multiplied by."""

    spectra: NDArray[np.complex64]
    """Room for some spectra (n, cells), to be transformed at a time; 0 where no plane wave goes."""

    images: NDArray[np.complex64]
    """Room for the images of all terms, (terms, y, x)."""

    def transform(self, terms: slice) -> None:
        """Turn the first spectra into the images of these terms."""
        ...


def choose_inverse(
    waves: WaveIndices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int
) -> Inverse:
    """Choose the quicker way: few voxels of a long period by matrix products, many by Fourier
    transforms.

    Parameters are those of `InverseTransform`; a period that is not a whole number of voxels leaves
    matrix products only.

    `waves` (rows, columns): indices along y and x; `lattice`: voxels in a period along y and x;
    `wanted`: voxels wanted along y and x, from the origin on; `terms`: maximum number of spectra.
    """
    rows, columns = (2 * int(np.max(index)) + 1 for index in waves)
    high, wide = (int(length) for length in lattice)
    if (high, wide) != lattice:
        return InverseProduct(waves, lattice, wanted, terms)
    # real operations: 8 of a complex product and sum, 5 n log2 n of a Fourier transform
    products = 8 * columns * wanted[0] * (rows + wanted[1])
    transforms = 5 * (
        columns * lattice[0] * np.log2(lattice[0] + 1)
        + wanted[0] * lattice[1] * np.log2(lattice[1] + 1)
    )
    if products < PRODUCT_SPEEDUP * transforms:
        return InverseProduct(waves, lattice, wanted, terms)
    return InverseTransform(waves, (high, wide), wanted, terms)


class InverseProduct:
    """Inverse transforms of several spectra as two matrix products each.

    Parameters are those of `InverseTransform`.
    """

    def __init__(
        self, waves: WaveIndices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int
    ) -> None:
        reach = rows, columns = tuple(int(np.max(index)) for index in waves)
        self._shape = (2 * columns + 1, 2 * rows + 1)
        self.spare = self._shape[0] * self._shape[1]
        self.cell_indices = (waves[1] + columns) * self._shape[1] + waves[0] + rows
        self.carrier = np.ones(wanted[1], np.complex64)
        self.spectra = np.zeros((_count_per_batch(self.spare, terms), self.spare + 1), np.complex64)
        self.images = np.empty((terms, *wanted), np.complex64)
        self._along_y, self._along_x = (
            np.exp(
                2j * np.pi / length * np.outer(np.arange(-reach, reach + 1), np.arange(count))
            ).astype(np.complex64)
            for reach, length, count in zip(reach, lattice, wanted, strict=True)
        )

    def transform(self, terms: slice) -> None:
        """Turn the first spectra into the images of these terms."""
        for spectrum, image in zip(self.spectra, self.images[terms], strict=False):
            # the transform is separable: y first, for every index along x
            half = spectrum[: self.spare].reshape(self._shape) @ self._along_y
            np.matmul(half.T, self._along_x, out=image)


class InverseTransform:
    """Inverse transforms of several spectra by pruned Fourier transforms.

    Along y only the columns that plane waves fall into are transformed, along x only the rows that
    voxels lie in. Where voxels are too coarse for the finest waves, these are folded into the
    lattice, as the voxels see them.

    `waves` (rows, columns): indices along y and x; `lattice`: voxels in a period along y and x;
    `wanted`: voxels wanted along y and x, from the origin on; `terms`: spectra at most.
    """

    def __init__(
        self, waves: WaveIndices, lattice: tuple[int, int], wanted: tuple[int, int], terms: int
    ) -> None:
        self._high, self._wide = high, wide = lattice
        reach = int(np.max(waves[1]))
        columns = min(2 * reach + 1, wide)
        # Unfolded columns are shifted so that none is negative; `carrier` takes the shift back.
        shift = reach if 2 * reach + 1 < wide else 0
        self.spare = columns * _pad_to_vector(high)
        self.cell_indices: NDArray[np.int64] = (waves[1] + shift) % wide * _pad_to_vector(
            high
        ) + waves[0] % high
        self.carrier = np.exp(-2j * np.pi * shift / wide * np.arange(wanted[1])).astype(
            np.complex64
        )
        some = _count_per_batch(self.spare, terms)
        self.spectra: NDArray[np.complex64] = allocate_zeros((some, self.spare + VECTOR_LENGTH))
        self._columns = self.spectra[:, : self.spare].reshape(some, columns, _pad_to_vector(high))[
            ..., :high
        ]
        self._lines = allocate_zeros((some, columns, _pad_to_vector(high)))[..., :high]
        self._middle = allocate_zeros((some, wanted[0], _pad_to_vector(wide)))[..., :wide]
        self._rows = allocate_zeros((terms, wanted[0], _pad_to_vector(wide)))[..., :wide]
        self.images: NDArray[np.complex64] = self._rows[..., : wanted[1]]
        self._plans: dict[int, tuple[FourierPlan, FourierPlan]] = {}

    def transform(self, terms: slice) -> None:
        """Turn the first spectra into the images of these terms."""
        count = terms.stop - terms.start
        along_y, along_x = self._get_plans(count)
        along_y.execute()
        # only the rows that voxels lie in are transformed along x
        wanted, columns = self._middle.shape[1], self._lines.shape[1]
        lines, middles = self._lines.view(np.float64), self._middle.view(np.float64)
        for line, middle in zip(lines[:count], middles, strict=False):
            transpose(line[:, :wanted], middle[:, :columns])
        along_x.update_arrays(self._middle[:count], self._rows[terms])
        along_x.execute()

    def _get_plans(self, count: int) -> tuple[FourierPlan, FourierPlan]:
        if count not in self._plans:
            arrays = (self._columns, self._lines), (self._middle, self._rows)
            y, x = (
                plan_transform(source[:count], target[:count], axis=2, inverse=True)
                for source, target in arrays
            )
            self._plans[count] = y, x
        return self._plans[count]


def _count_per_batch(cells: int, terms: int) -> int:
    # spectra that stay in cache between the two transforms
    return max(1, min(terms, CACHE_BYTES // (8 * cells)))


def _pad_to_vector(count: int) -> int:
    return -(-count // VECTOR_LENGTH) * VECTOR_LENGTH
