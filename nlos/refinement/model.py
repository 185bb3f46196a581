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
from nlos.geometry import Grid
from nlos.illumination_groups import IlluminationGroup, build_source
from nlos.refinement.illuminated_depths import IlluminatedDepthPropagator
from nlos.refinement.spherical import propagate_spherical_waves
from nlos.rsd.diffraction import DiffractionPlan
from nlos.wave_plan import GroupPlan, WavePlan
from tofclip.operators import Diagonal, LinearOperator, Stack
from tofclip.threads import limit_blas_threads

Array = NDArray[Any]
FloatArray = NDArray[np.float64]


class HiddenToWall(LinearOperator):
    """From a hidden volume to the phasors that one exposure of a wall sees, by way of a virtual
    plane.

    ``P_k(r_p) = sqrt(G_k) * sum_r h(r) * exp(-1j * k * (|r_L - r| + |r - r_p|)) / |r - r_p|``: the
    phasors of the conventions in `nlos`, weighted so that the adjoint of the phasors divided by
    ``sqrt(G_k)`` is the real part of the hybrid's field. Result: real and imaginary parts in turns,
    point by point, each at all frequencies.

    Memory beyond volume and phasors: some 40 bytes per plane wave and frequency and thread.

    `points` (n, 3): wall points, m; `plan`: from a virtual plane to the voxels; `dtype`: float32 or
    float64.
    """

    def __init__(
        self,
        points: FloatArray,
        plan: DiffractionPlan,
        group: IlluminationGroup,
        band: Band,
        dtype: DTypeLike = np.float32,
    ) -> None:
        super().__init__(plan.grid.shape, (2 * len(points) * plan.waves.count,), dtype)
        self.points, self.plane = points, plan.plane
        self.wavenumbers = group.legs * band.wavenumbers
        self._complex_dtype = np.result_type(self.dtype, np.complex64)
        self._depths = IlluminatedDepthPropagator(
            plan, build_source(group, band), self._complex_dtype
        )
        area = float(np.prod(plan.plane.steps))
        # sqrt(G_k) of the class's formula, and the area that a point of the virtual plane stands
        # for
        self._strength = (np.sqrt(band.weights) * area).astype(self.dtype)

    def _forward(self, block: Array) -> Array:
        return self._apply_per_frame(self._to_phasors, block)

    def _adjoint(self, block: Array) -> Array:
        return self._apply_per_frame(self._to_volume, block)

    def _to_phasors(self, volume: Array) -> Array:
        # the adjoint of a wave that runs out is one that runs in: conjugate, propagate, conjugate
        waves = self._depths.to_plane(volume).reshape(-1, self.wavenumbers.size).conj()
        phasors = propagate_spherical_waves(
            self.plane.points.reshape(-1, 3), waves, self.points, self.wavenumbers
        ).conj()
        return np.asarray(phasors * self._strength).view(self.dtype).ravel()

    def _to_volume(self, measurements: Array) -> Array:
        phasors = (
            measurements.view(self._complex_dtype).reshape(len(self.points), -1) * self._strength
        )
        # the same sum with points and plane exchanged: a wave from r to s is one from s to r
        waves = propagate_spherical_waves(
            self.points, phasors, self.plane.points.reshape(-1, 3), self.wavenumbers
        )
        return self._depths.to_volume(waves.reshape(*self.plane.shape, -1))

    def _apply_per_frame(self, work: Callable[[Array], Array], block: Array) -> Array:
        """Treat every frame alone: each is a volume, too large to gain from company."""
        # Depths and targets share the cores already: BLAS threads of its own would fight with ours.
        with limit_blas_threads():
            return np.stack(
                [work(np.ascontiguousarray(frame)) for frame in np.moveaxis(block, -1, 0)], axis=-1
            )


@dataclass(frozen=True, eq=False)
class WallModel:
    """A capture's phasors and the operator that makes them of a hidden volume.

    A hidden point of albedo a returns ``a / (d_L * d_p)^2`` after the path ``L = d_L + d_p``, while
    the operator's waves fall as ``1 / d_p``. Signals are therefore multiplied by L^2, or L^3 if
    confocal: what is left, ``(d_L + d_p)^2 / (d_L^2 * d_p)``, is ``4 / d_L`` for equal legs,
    changes by less than 8 % up to a ratio of 1.7, and is exactly 8 if confocal. The operator acts
    on volumes divided by `laser_distance`.
    """

    plan: WavePlan  # of the hybrid
    capture: Capture  # of the plan's geometry

    @property
    def grid(self) -> Grid:
        """The voxels of the hidden volume."""
        return self.plan.grid

    @property
    def _band(self) -> Band:
        return self.plan.band

    @cached_property
    def laser_distance(self) -> FloatArray:
        """Mean distance of every voxel from the laser spots, m, shape (z, y, x); 1 for a confocal
        scan.
        """
        return np.asarray(
            np.mean([self._compute_laser_distance(one.group) for one in self.plan.groups], axis=0)
        )

    def operator(self, dtype: DTypeLike = np.float32) -> LinearOperator:
        """Return the operator from volumes (z, y, x), albedo divided by `laser_distance`, to
        `measurements`.
        """
        return Stack([self._build_group_operator(one, dtype) for one in self.plan.groups])

    def measurements(self) -> Array:
        """Return the phasors divided by ``sqrt(G_k)``, as the operator gives them, shape (n, 1),
        float32.
        """
        strength = np.sqrt(self._band.weights)
        parts = []
        traces = self.capture.traces()
        for group in (one.group for one in self.plan.groups):
            path_weight = (self.capture.axis.paths ** (group.legs + 1)).astype(np.float32)
            phasors = np.ascontiguousarray(
                self._band.compute_phasors(traces[group.indices] * path_weight) / strength,
                np.complex64,
            )
            parts.append(phasors.view(np.float32).ravel())
        return np.concatenate(parts)[:, np.newaxis]

    def _build_group_operator(self, one: GroupPlan, dtype: DTypeLike) -> LinearOperator:
        points = self.capture.points[one.group.indices]
        bare = HiddenToWall(points, one.plane_to_depths, one.group, self._band, dtype)
        return bare @ Diagonal(self.laser_distance / self._compute_laser_distance(one.group), dtype)

    def _compute_laser_distance(self, group: IlluminationGroup) -> FloatArray:
        if group.laser is None:
            return np.ones(self.grid.shape)
        z, y, x = np.meshgrid(self.grid.z, self.grid.y, self.grid.x, indexing="ij")
        return np.asarray(np.linalg.norm(np.stack([x, y, z], axis=-1) - group.laser, axis=-1))
