"""From plane waves to the voxels of a plane: inverse Fourier transforms without the parts that are 0 or unwanted."""

from __future__ import annotations

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nlos.rsd.kernels import transpose
from nlos.rsd.window import VECTOR

PLANNING = threading.Lock()
"""FFTW plans one transform at a time."""

PLANS = ("FFTW_ESTIMATE",)
"""Plans that are measured are no faster here, and differ from run to run, as the last bits of an image would."""

PRODUCT_RATE = 3
"""How many operations of a matrix product take as long as one of a pruned Fourier transform; measured."""


class Indices(Protocol):
    """Plane waves, known by their indices along y and x; these reach as far below 0 as above."""

    @property
    def row(self) -> NDArray[np.int64]: ...

    @property
    def column(self) -> NDArray[np.int64]: ...


class Inverse(Protocol):
    """From the spectra of several terms to their images, with memory of its own; not to be shared between threads."""

    cell: NDArray[np.int64]
    """Where in a flat spectrum every plane wave goes."""

    carrier: NDArray[np.complex64]
    """What every column of an image has still to be multiplied by."""

    spectra: NDArray[np.complex64]
    """Memory for the spectra, term by term; 0 where no plane wave goes."""

    def images(self, terms: int) -> NDArray[np.complex64]:
        """Transform the first `terms` of `spectra`; the result (term, y, x) is valid until the next call."""
        ...


def inverse(waves: Indices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int) -> Inverse:
    """Choose the quicker way: few voxels of a long period by matrix products, many by Fourier transforms.

    Parameters are those of `InverseTransform`; a period that is no whole number of voxels leaves matrix products only.
    """
    columns, rows = (2 * int(np.max(index)) + 1 for index in (waves.column, waves.row))
    high, wide = (int(length) for length in lattice)
    if (high, wide) != lattice:
        return InverseProduct(waves, lattice, wanted, terms)
    products = 8 * columns * wanted[0] * (rows + wanted[1])
    transforms = 5 * (columns * lattice[0] * np.log2(lattice[0] + 1) + wanted[0] * lattice[1] * np.log2(lattice[1] + 1))
    if products < PRODUCT_RATE * transforms:
        return InverseProduct(waves, lattice, wanted, terms)
    return InverseTransform(waves, (high, wide), wanted, terms)


class InverseProduct:
    """Inverse transforms of several spectra as two matrix products each.

    Parameters are those of `InverseTransform`.
    """

    def __init__(self, waves: Indices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int) -> None:
        rows, columns = (int(np.max(index)) for index in (waves.row, waves.column))
        self.cell = (waves.column + columns) * (2 * rows + 1) + waves.row + rows
        self.carrier = np.ones(wanted[1], np.complex64)
        self.spectra = np.zeros((terms, 2 * columns + 1, 2 * rows + 1), np.complex64)
        self._along_y, self._along_x = (
            np.exp(2j * np.pi / length * np.outer(np.arange(-reach, reach + 1), np.arange(count))).astype(np.complex64)
            for reach, length, count in zip((rows, columns), lattice, wanted, strict=True)
        )

    def images(self, terms: int) -> NDArray[np.complex64]:
        """Transform the first `terms` of `spectra`; the result is (term, y, x)."""
        return np.stack([(spectrum @ self._along_y).T @ self._along_x for spectrum in self.spectra[:terms]])


class InverseTransform:
    """Inverse transforms of several spectra by pruned Fourier transforms.

    Along y only the columns that plane waves fall into are transformed, along x only the rows that voxels lie in. Where
    voxels are too coarse for the finest waves, these are folded into the lattice, as the voxels see them.

    Parameters
    ----------
    waves : Indices
    lattice : (int, int)
        Voxels in a period along y and x.
    wanted : (int, int)
        Voxels wanted along y and x, from the origin on.
    terms : int
        Spectra at most.
    """

    def __init__(self, waves: Indices, lattice: tuple[int, int], wanted: tuple[int, int], terms: int) -> None:
        import pyfftw

        high, wide = lattice
        reach = int(np.max(waves.column))
        columns = min(2 * reach + 1, wide)
        # Unfolded columns are shifted so that none is negative; `carrier` takes the shift back.
        self._shift = reach if 2 * reach + 1 < wide else 0
        column = (waves.column + self._shift) % wide
        self.cell: NDArray[np.int64] = column * _padded(high) + waves.row % high
        self.carrier = np.exp(-2j * np.pi * self._shift / wide * np.arange(wanted[1])).astype(np.complex64)
        self._wanted = wanted
        shapes = ((terms, columns, high), (columns, high), (wanted[0], wide), (terms, wanted[0], wide))
        arrays = [pyfftw.zeros_aligned((*shape[:-1], _padded(shape[-1])), np.complex64) for shape in shapes]
        self.spectra: NDArray[np.complex64] = arrays[0]
        self._lines: NDArray[np.complex64] = arrays[1]
        self._middle: NDArray[np.complex64] = arrays[2]
        self._images: NDArray[np.complex64] = arrays[3]
        self._high, self._wide = high, wide
        with PLANNING:
            backward = {"direction": "FFTW_BACKWARD", "axes": (1,), "flags": PLANS}
            self._along_y = pyfftw.FFTW(self.spectra[0, :, :high], self._lines[:, :high], **backward)
            self._along_x = pyfftw.FFTW(self._middle[:, :wide], self._images[0, :, :wide], **backward)

    def images(self, terms: int) -> NDArray[np.complex64]:
        """Transform the first `terms` of `spectra`; the result (term, y, x) is valid until the next call."""
        columns, rows = len(self._lines), self._wanted[0]
        for term in range(terms):
            self._along_y.update_arrays(self.spectra[term, :, : self._high], self._lines[:, : self._high])
            self._along_y.execute()
            transpose(self._lines[:, :rows], self._middle[:, :columns])
            self._along_x.update_arrays(self._middle[:, : self._wide], self._images[term, :, : self._wide])
            self._along_x.execute()
        return self._images[:terms, :, : self._wanted[1]]


def _padded(count: int) -> int:
    return -(-count // VECTOR) * VECTOR
