"""`nlos.Refinement`: the hybrid, iterated, with the wall's phasors as a linear function of the
hidden volume at the hybrid's speed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.illumination import IlluminationGroup, build_source, choose_roles, warn_of_aliasing
from nlos.method import (
    FEWER_VOXELS,
    Method,
    Plan,
    Progress,
    require_memory,
    require_numpy_signal,
)
from nlos.phasor.arrays import ArrayLibrary
from nlos.phasor.depth_steps import DiffractionPlan
from nlos.phasor.plan import Hybrid, WavePlan, find_distance, plan_waves
from nlos.phasor.propagate import sum_spherical_waves
from nlos.phasor.to_depths import PortableDiffraction
from nlos.plane import axis_step
from nlos.volume import Grid, Volume
from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import InputError
from tofclip.operators import Diagonal, LinearOperator, Stack
from tofclip.solvers import Method as Prior
from tofclip.solvers import Sparse
from tofclip.solvers.fista import LightFieldVariation
from tofclip.threads import limit_blas_threads


class HiddenToWall(LinearOperator):
    """From a hidden volume to the phasors that one exposure of wall points (n, 3), m, sees by way
    of a virtual plane, ``sqrt(G_k) * sum_r h(r) * exp(-1j * k * (|r_L - r| + |r - r_p|)) / |r -
    r_p|``, so weighted that the adjoint of the phasors over ``sqrt(G_k)`` is the real part of the
    hybrid's field; real and imaginary parts interleaved, by point and frequency.

    Memory beyond them: some 40 bytes per plane wave and frequency and thread.
    """

    def __init__(
        self,
        points: FloatArray,
        plan: DiffractionPlan,
        group: IlluminationGroup,
        band: Band,
    ) -> None:
        super().__init__(plan.grid.shape, (2 * len(points) * plan.waves.count,), np.float32)
        self.points, self.plane = points, plan.plane
        self.wavenumbers = group.legs * band.wavenumbers
        self._depths = PortableDiffraction(plan, build_source(group, band), ArrayLibrary(), True)
        area = float(np.prod(plan.plane.steps))
        # sqrt(G_k), and the area that a point of the virtual plane stands for
        self._strength = (np.sqrt(band.weights) * area).astype(self.dtype)

    def _forward(self, block: AnyArray) -> AnyArray:
        return self._apply_per_frame(self._to_phasors, block)

    def _adjoint(self, block: AnyArray) -> AnyArray:
        return self._apply_per_frame(self._to_volume, block)

    def _to_phasors(self, volume: AnyArray) -> AnyArray:
        # the adjoint of a wave that runs out is one that runs in: conjugate, propagate, conjugate
        waves = self._depths.to_plane(volume).reshape(-1, self.wavenumbers.size).conj()
        plane = self.plane.points.reshape(-1, 3)
        phasors = sum_spherical_waves(self.points, plane, waves, self.wavenumbers).conj()
        return np.asarray(phasors * self._strength).view(np.float32).ravel()

    def _to_volume(self, measurements: AnyArray) -> AnyArray:
        phasors = measurements.view(np.complex64).reshape(len(self.points), -1) * self._strength
        # the same sum with points and plane exchanged: a wave from r to s is one from s to r
        plane = self.plane.points.reshape(-1, 3)
        waves = sum_spherical_waves(plane, self.points, phasors, self.wavenumbers)
        return self._depths.to_volume(waves.reshape(*self.plane.shape, -1))

    def _apply_per_frame(self, work: Callable[[AnyArray], AnyArray], block: AnyArray) -> AnyArray:
        """Treat every frame alone: each is a volume, too large to gain from company."""
        # Depths and targets share the cores already: BLAS threads of its own would fight with ours.
        with limit_blas_threads():
            frames = np.moveaxis(block, -1, 0)
            return np.stack([work(np.ascontiguousarray(one)) for one in frames], axis=-1)


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

    @cached_property
    def laser_distance(self) -> AnyArray:
        """Mean distance of voxels (z, y, x) from the laser spots, m; 1 of a confocal scan."""
        distances = [find_distance(one.group.laser, self.plan.grid) for one in self.plan.groups]
        return np.mean(distances, axis=0)

    def operator(self) -> LinearOperator:
        """Return the operator from albedo over `laser_distance` (z, y, x) to `measurements`."""
        parts = []
        for one in self.plan.groups:
            points = self.capture.points[one.group.indices]
            bare = HiddenToWall(points, one.plane_to_depths, one.group, self.plan.band)
            relative = self.laser_distance / find_distance(one.group.laser, self.plan.grid)
            parts.append(bare @ Diagonal(relative))
        return Stack(parts)

    def measurements(self) -> AnyArray:
        """Return the phasors over ``sqrt(G_k)``, as the operator gives them, (n, 1) float32."""
        strength = np.sqrt(self.plan.band.weights)
        parts = []
        traces = self.capture.traces()
        for group in (one.group for one in self.plan.groups):
            weight = (self.capture.axis.paths ** (group.legs + 1)).astype(np.float32)
            phasors = self.plan.band.compute_phasors(traces[group.indices] * weight) / strength
            parts.append(phasors.astype(np.complex64).view(np.float32).ravel())
        return np.concatenate(parts)[:, np.newaxis]


# float32 volumes that the solver holds at once, with the duals of total variation.
SOLVER_VOLUMES = 12
# Voxels per carrier wavelength in depth: a point between two is off by less than 1.3 rad.
MIN_VOXELS_PER_WAVELENGTH = 5.0


def build_total_variation(
    grid: Grid, weight: float = 2e-2, iterations: int = 60
) -> LightFieldVariation:
    """Return the prior of even surfaces with sharp borders on an evenly spaced grid: total
    variation along x, y and z alike; weights as of `tofclip.solvers.TotalVariation`.
    """
    across = axis_step(grid.x) if grid.x.size > 1 else 1.0
    along = axis_step(grid.z) if grid.z.size > 1 else across
    # depths take the place of views; differences along z count by their distance in metres
    return LightFieldVariation(weight, iterations, grid=(grid.z.size, 1), angular=across / along)


@dataclass(frozen=True)
class Refinement(Method):
    """The hidden albedo that explains a capture best, among those that a prior prefers.

    Minimises ``1/2 |A h - f|^2 + prior(h)`` over h >= 0 by FISTA, with f the wall's phasors and A
    the hybrid's own way from a volume to the wall; A'f is the real part of the hybrid's field. The
    albedo is real and not negative, so that the phase of f tells where within a wave a point lies:
    voxels have to resolve the carrier in depth, with `MIN_VOXELS_PER_WAVELENGTH`. Takes NumPy's
    arrays of few laser spots only.

    Every step costs some four hybrid images. Memory: some 40 bytes per plane wave and frequency and
    thread, and twelve volumes.

    Parameters
    ----------
    hybrid : Hybrid
        Its wavelength, cycles, tolerance and virtual plane.
    prior : tofclip.solvers.Method
        A proximal method of `tofclip.solvers`; `Sparse` is l1, `build_total_variation` total
        variation.
    """

    hybrid: Hybrid
    prior: Prior = field(default_factory=lambda: Sparse(weight=2e-2, iterations=60))

    def plan(self, capture: Capture, grid: Grid) -> Plan:
        require_numpy_signal("iterative refinement", capture)
        hybrid = plan_waves(self.hybrid, choose_roles(capture), grid)
        coarsest = float(np.diff(grid.z).max()) if grid.z.size > 1 else 0.0
        allowed = self.hybrid.wavelength / MIN_VOXELS_PER_WAVELENGTH
        # Voxels drawn exactly at the limit must not be refused for a rounding error.
        if coarsest > allowed * (1 + 1e-6):
            raise InputError(
                f"voxels {coarsest:.3g} m apart in depth are too coarse to refine with waves of "
                f"{self.hybrid.wavelength:.3g} m: use at most {allowed:.3g} m"
            )
        what = f"{SOLVER_VOLUMES} volumes of {grid.size} voxels to refine"
        require_memory(4 * SOLVER_VOLUMES * grid.size, what, FEWER_VOXELS)
        return RefinementPlan(capture, grid, self, hybrid)


class RefinementPlan(Plan):
    """An iterative refinement of a hybrid's image, ready for captures of one geometry."""

    def __init__(self, capture: Capture, grid: Grid, method: Refinement, hybrid: WavePlan) -> None:
        super().__init__(capture, grid)
        self.method, self.hybrid = method, hybrid
        self.cost = method.prior.work(grid.size)  # voxels in all iterations
        self.memory_bytes = hybrid.memory_bytes + 4 * SOLVER_VOLUMES * grid.size

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        warn_of_aliasing(capture, self.hybrid.band)
        model = WallModel(self.hybrid, choose_roles(capture))
        prior, size = self.method.prior, self.grid.size
        operator, measured = model.operator(), model.measurements()
        result = prior.recover(operator, measured, progress=lambda n: progress(n * size))
        settings = {
            "method": "refinement",
            "wavelength_m": self.method.hybrid.wavelength,
            "cycles": self.method.hybrid.cycles,
            "prior": prior.name,
            "iterations": result.iterations,
            "stopped_because": result.stop_reason,
        }
        # the solver's unknown is the albedo over the laser's distance
        albedo = (result.frames[0] * model.laser_distance).astype(np.float32)
        return Volume(albedo, self.grid, {**capture.provenance, "imaging": settings})
