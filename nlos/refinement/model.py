"""The wall's phasors as a linear function of the hidden volume, at the hybrid's speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from nlos.band import Band
from nlos.capture import Capture
from nlos.exposure import Exposure, exposures, unfolded_band
from nlos.geometry import Grid
from nlos.hybrid import Hybrid
from nlos.outgoing import outgoing_way
from nlos.refinement.lit_depths import LitDepths
from nlos.refinement.spherical import spherical_sum
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.planar import source_of
from tofclip.operators import Diagonal, LinearOperator, Stack
from tofclip.threads import one_blas_thread

Array = NDArray[Any]
FloatArray = NDArray[np.float64]


class HiddenToWall(LinearOperator):
    """From a hidden volume to the phasors that one exposure of a wall sees, by way of a virtual plane.

    ``P_k(r_p) = sqrt(G_k) * sum_r h(r) * exp(-1j * k * (|r_L - r| + |r - r_p|)) / |r - r_p|``: the phasors of the
    conventions in `nlos`, weighted so that the adjoint of the phasors divided by ``sqrt(G_k)`` is the real part of the
    hybrid's field. Result: real and imaginary parts in turns, point by point, each at all frequencies.

    Memory beyond volume and phasors: some 40 bytes per plane wave and frequency and thread.

    Parameters
    ----------
    points : (n, 3) array
        Wall points, m.
    way : Diffraction
        From a virtual plane to the voxels.
    exposure : Exposure
    band : Band
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self, points: FloatArray, way: Diffraction, exposure: Exposure, band: Band, dtype: DTypeLike = np.float32
    ) -> None:
        super().__init__(way.grid.shape, (2 * len(points) * way.waves.count,), dtype)
        self.points, self.plane = points, way.plane
        self.wavenumbers = exposure.passes * band.wavenumbers
        self._kind = np.result_type(self.dtype, np.complex64)
        self._depths = LitDepths(way, source_of(exposure, band), self._kind)
        area = float(np.prod(way.plane.steps))
        self._strength = (np.sqrt(band.weights) * area).astype(self.dtype)

    def _forward(self, block: Array) -> Array:
        return self._each(self._phasors, block)

    def _adjoint(self, block: Array) -> Array:
        return self._each(self._volume, block)

    def _phasors(self, volume: Array) -> Array:
        waves = self._depths.to_plane(volume).reshape(-1, self.wavenumbers.size).conj()
        phasors = spherical_sum(self.plane.points.reshape(-1, 3), waves, self.points, self.wavenumbers).conj()
        return np.asarray(phasors * self._strength).view(self.dtype).ravel()

    def _volume(self, readings: Array) -> Array:
        phasors = readings.view(self._kind).reshape(len(self.points), -1) * self._strength
        waves = spherical_sum(self.points, phasors, self.plane.points.reshape(-1, 3), self.wavenumbers)
        return self._depths.to_volume(waves.reshape(*self.plane.shape, -1))

    def _each(self, work: Callable[[Array], Array], block: Array) -> Array:
        """Treat every frame alone: each is a volume, too large to gain from company."""
        # Depths and targets share the cores already: BLAS threads of its own would fight with ours.
        with one_blas_thread():
            return np.stack([work(np.ascontiguousarray(frame)) for frame in np.moveaxis(block, -1, 0)], axis=-1)


@dataclass(frozen=True, eq=False)
class WallModel:
    """A capture's phasors and the operator that makes them of a hidden volume.

    A hidden point of albedo a returns ``a / (d_L * d_p)^2`` after the path ``L = d_L + d_p``, while the operator's
    waves fall as ``1 / d_p``. Signals are therefore multiplied by L^2, or L^3 if confocal: what is left,
    ``(d_L + d_p)^2 / (d_L^2 * d_p)``, is ``4 / d_L`` for equal legs, changes by less than 8 % up to a ratio of 1.7, and
    is exactly 8 if confocal. The operator acts on volumes divided by `outward`.

    Parameters
    ----------
    hybrid : Hybrid
    capture : Capture
    grid : Grid
    """

    hybrid: Hybrid
    capture: Capture
    grid: Grid

    @cached_property
    def _band(self) -> Band:
        return unfolded_band(self.capture, self.grid, self.hybrid.pulse)

    @cached_property
    def _exposures(self) -> list[tuple[Exposure, Capture]]:
        return [(part, _alone(self.capture, part)) for part in exposures(self.capture)]

    @cached_property
    def outward(self) -> FloatArray:
        """Mean distance of every voxel from the laser spots, m, shape (z, y, x); 1 for a confocal scan."""
        return np.asarray(np.mean([self._outward(part) for part, _ in self._exposures], axis=0))

    def operator(self, dtype: DTypeLike = np.float32) -> LinearOperator:
        """Return the operator from volumes (z, y, x), albedo divided by `outward`, to `readings`."""
        return Stack([self._lit(part, alone, dtype) for part, alone in self._exposures])

    def readings(self) -> Array:
        """Return the phasors divided by ``sqrt(G_k)``, as the operator gives them, shape (n, 1), float32."""
        strength = np.sqrt(self._band.weights)
        parts = []
        for part, alone in self._exposures:
            late = (self.capture.axis.paths ** (part.passes + 1)).astype(np.float32)
            phasors = np.ascontiguousarray(self._band.phasors(alone.traces() * late) / strength, np.complex64)
            parts.append(phasors.view(np.float32).ravel())
        return np.concatenate(parts)[:, np.newaxis]

    def _lit(self, part: Exposure, alone: Capture, dtype: DTypeLike) -> LinearOperator:
        way = outgoing_way(self.hybrid, alone, self.grid, self._band)
        bare = HiddenToWall(alone.points, way, part, self._band, dtype)
        return bare @ Diagonal(self.outward / self._outward(part), dtype)

    def _outward(self, part: Exposure) -> FloatArray:
        if part.laser is None:
            return np.ones(self.grid.shape)
        z, y, x = np.meshgrid(self.grid.z, self.grid.y, self.grid.x, indexing="ij")
        return np.asarray(np.linalg.norm(np.stack([x, y, z], axis=-1) - part.laser, axis=-1))


def _alone(capture: Capture, part: Exposure) -> Capture:
    """Return what one exposure recorded as a capture of its own."""
    points = capture.points[part.members]
    laser = points if part.laser is None else part.laser
    signal = np.ascontiguousarray(capture.traces()[part.members].T)
    return Capture(signal, points, laser, capture.bin_width, capture.start, capture.provenance)
