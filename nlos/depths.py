"""Fields propagated from a plane to a grid's depths at every frequency, each step beside its
adjoint.

The same diffraction as `nlos.rsd.image_planes`, in plain matrix products of either precision: for
what needs the way back (iterative refinement) or the frequencies apart from the laser's wave
(transient video).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.kernels import TAPS

Array = NDArray[Any]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DepthPropagator:
    """Plane waves between a plane and the depths of a grid.

    Memory: some 20 bytes per plane wave and frequency in single precision, as much again for every
    spectrum.
    """

    plan: DiffractionPlan
    # complex64 or complex128; the transfer functions are those of single precision in either
    dtype: DTypeLike = np.complex64

    def to_waves(self, values: Array) -> Array:
        """Return the plane waves (waves, frequencies) of a field (y, x, frequencies) on the plane."""
        along_y, along_x = self.from_plane
        half = (along_y @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])
        spectrum: Array = (along_x @ half).reshape(-1, values.shape[-1])[self.cell_indices]
        return spectrum * self._wave_weights

    def to_waves_adjoint(self, spectrum: Array) -> Array:
        """Apply the adjoint of `to_waves`: the field (y, x, frequencies) on the plane."""
        along_y, along_x = self.from_plane
        full = np.zeros((len(along_y) * len(along_x), spectrum.shape[1]), self.dtype)
        full[self.cell_indices] = spectrum * self._wave_weights
        half = along_x.conj().T @ full.reshape(len(along_y), len(along_x), -1)
        values: Array = along_y.conj().T @ half.reshape(len(along_y), -1)
        return values.reshape(*self.plan.plane.shape, -1)

    def transfer(self, depth: float, delay: FloatArray) -> Array:
        """Return what every wave (waves, frequencies) is multiplied by on its way to a depth; see
        `Transfer.evaluate`.

        `depth`: z, m; `delay` (2,): path in m and the wavenumber k_0 in rad/m. Returns (waves,
        frequencies).
        """
        nodes = self.plan.transfer.evaluate(depth - self.plan.plane.z, delay)
        matrix, turn = self._node_interpolation
        values = (matrix @ nodes.reshape(len(nodes), -1)).reshape(-1, *nodes.shape[1:])
        return np.asarray(values[:, 0] + 1j * values[:, 1], self.dtype)[turn]

    def to_images(self, terms: Array) -> Array:
        """Return the images (m, y, x) on the voxels of sums (waves, m) of plane waves."""
        along_y, along_x = self.to_voxels
        spectra = np.zeros((terms.shape[1], len(along_y) * len(along_x)), self.dtype)
        spectra[:, self.cell_indices] = terms.T
        images: Array = along_y.T @ spectra.reshape(-1, len(along_y), len(along_x)) @ along_x
        return images

    def to_images_adjoint(self, images: Array) -> Array:
        """Apply the adjoint of `to_images`: plane waves (waves, m) of images (m, y, x)."""
        along_y, along_x = self.to_voxels
        spectra = along_y.conj() @ images @ along_x.conj().T
        terms: Array = spectra.reshape(len(images), -1)[:, self.cell_indices].T
        return terms

    @cached_property
    def _max_indices(self) -> tuple[int, int]:
        """Largest index of a wave along y and x."""
        waves = self.plan.plane_waves
        return int(np.abs(waves.row).max()), int(np.abs(waves.column).max())

    @cached_property
    def cell_indices(self) -> NDArray[np.int64]:
        """Place of every wave in a full rectangle of them."""
        waves, (rows, columns) = self.plan.plane_waves, self._max_indices
        return np.asarray((waves.row + rows) * (2 * columns + 1) + waves.column + columns)

    @cached_property
    def _wave_weights(self) -> Array:
        """1 / area of a period, or 0 where a wave is too fine for a frequency, shape (waves,
        frequencies).
        """
        waves = self.plan.plane_waves
        travels = waves.lateral_limits >= waves.lateral_wavenumbers[:, np.newaxis]
        return (travels / np.prod(waves.period)).astype(np.zeros(0, self.dtype).real.dtype)

    @cached_property
    def from_plane(self) -> tuple[Array, Array]:
        """``exp(-1j * q * r)`` along y and along x of the plane's points."""
        return self._waves_at((self.plan.plane.y, self.plan.plane.x), -1)

    @cached_property
    def to_voxels(self) -> tuple[Array, Array]:
        """``exp(+1j * q * r)`` along y and along x of the voxels."""
        return self._waves_at((self.plan.grid.y, self.plan.grid.x), 1)

    def _waves_at(self, axes: tuple[FloatArray, FloatArray], sign: int) -> tuple[Array, Array]:
        origin = (self.plan.grid.y[0], self.plan.grid.x[0])
        y, x = (
            np.exp(
                sign * 2j * np.pi / period * np.outer(np.arange(-reach, reach + 1), axis - start)
            ).astype(self.dtype)
            for axis, start, period, reach in zip(
                axes, origin, self.plan.plane_waves.period, self._max_indices, strict=True
            )
        )
        return y, x

    @cached_property
    def _node_interpolation(self) -> tuple[Any, NDArray[np.intp]]:
        """Matrix from nodes to the different lateral wavenumbers, and which of these every wave
        has.
        """
        from scipy.sparse import csr_array

        lateral, turn = np.unique(self.plan.plane_waves.lateral_wavenumbers, return_inverse=True)
        node, weight = self.plan.transfer.interpolation(lateral)
        index = (node[:, np.newaxis] + np.arange(TAPS)).ravel()
        shape = (lateral.size, len(self.plan.transfer.bessel_matrix))
        return csr_array(
            (weight.ravel(), index, TAPS * np.arange(lateral.size + 1)), shape=shape
        ), turn.ravel()
