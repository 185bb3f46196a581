"""Between lit voxels and a plane before the wall: the hidden scene's light on its way out, and
back.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from nlos.depths import DepthPropagator
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.illumination import Illumination
from nlos.rsd.image_planes import LaserSource
from tofclip.threads import run_blocks, thread_count

Array = NDArray[Any]


class IlluminatedDepthPropagator:
    """Volumes that the laser's wave lights, and their waves on a plane.

    `to_plane` is ``S_k(v) = sum_r h(r) * conj(exp(1j * k * |r_L - r|) * w_k(v, r))`` with w the
    wave that `plan` carries from point v of the plane to voxel r; `to_volume` is its adjoint, real
    since the volume is.

    `dtype`: complex64 or complex128.
    """

    def __init__(self, plan: DiffractionPlan, source: LaserSource, dtype: DTypeLike) -> None:
        self.depths, self.source, self.dtype = DepthPropagator(plan, dtype), source, np.dtype(dtype)
        self.lights = [source.illuminate_plane(plan, float(depth)) for depth in plan.grid.z]

    def to_plane(self, volume: Array) -> Array:
        """Return the field (y, x, frequencies) on the plane of a volume (z, y, x)."""
        run = -(-len(volume) // thread_count())
        parts: dict[int, Array] = {}

        def process_block(planes: slice) -> None:
            parts[planes.start] = self._to_plane_waves(volume, planes)

        run_blocks(process_block, len(volume), run)
        # In a fixed order, so that the same input gives the same sum.
        return self.depths.to_waves_adjoint(
            reduce(np.add, (parts[start] for start in sorted(parts)))
        )

    def to_volume(self, values: Array) -> Array:
        """Return the real volume (z, y, x) of a field (y, x, frequencies) on the plane: the adjoint
        of `to_plane`.
        """
        spectrum = self.depths.to_waves(values)
        volume = np.empty(self.depths.plan.grid.shape, self.dtype.type(0).real.dtype)

        def process_block(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                terms = (spectrum * self._evaluate_transfer(i)) @ self.lights[i].coefficients
                volume[i] = np.sum(
                    self._illumination_functions(i) * self.depths.to_images(terms), axis=0
                ).real

        run_blocks(process_block, len(volume), size=1)
        return volume

    def _to_plane_waves(self, volume: Array, planes: slice) -> Array:
        """Plane waves (waves, frequencies) of some depths together."""
        total: Any = 0
        for i in range(planes.start, planes.stop):
            terms = self.depths.to_images_adjoint(
                self._illumination_functions(i).conj() * volume[i]
            )
            total = (
                total + (terms @ self.lights[i].coefficients.T) * self._evaluate_transfer(i).conj()
            )
        return np.asarray(total)

    def _evaluate_transfer(self, i: int) -> Array:
        delay = np.array([self.lights[i].span.mean(), self.source.centre_wavenumber])
        return self.depths.transfer(float(self.depths.plan.grid.z[i]), delay)

    def _illumination_functions(self, i: int) -> Array:
        """What the terms of the illumination's split are multiplied by at every voxel of a depth,
        (m, y, x).
        """
        light, laser, grid = self.lights[i], self.source.laser, self.depths.plan.grid
        if laser is None:
            return np.ones((1, *grid.shape[1:]), self.dtype)
        across = (grid.y[:, np.newaxis] - laser[1]) ** 2 + (grid.x - laser[0]) ** 2
        distance = np.sqrt(across + (grid.z[i] - laser[2]) ** 2)
        functions = _sample_functions(light, distance) * np.exp(
            1j * self.source.centre_wavenumber * distance
        )
        functions[light.even :] *= 1j
        return np.asarray(functions, self.dtype)


def _sample_functions(light: Illumination, distance: NDArray[np.float64]) -> Array:
    """The functions of a split illumination at some distances (y, x), shape (m, y, x)."""
    place = (
        (distance - light.span[0])
        * (len(light.table) - 1)
        / max(light.span[1] - light.span[0], 1e-12)
    )
    before = np.clip(place.astype(np.intp), 0, len(light.table) - 2)
    weight = np.maximum(place - before, 0)[..., np.newaxis]
    values = light.table[before] + weight * (light.table[before + 1] - light.table[before])
    return np.moveaxis(values, -1, 0)
