"""`nlos.Refinement`: the hybrid, iterated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.hybrid import Hybrid
from nlos.illumination_groups import choose_roles, warn_of_aliasing
from nlos.method import MEMORY_LIMIT_BYTES, Method, Plan, Progress, require_numpy_signal
from nlos.plane import axis_step
from nlos.refinement.model import WallModel
from nlos.volume import Volume
from nlos.wave_plan import WavePlan
from tofclip.errors import InputError
from tofclip.solvers import Method as Prior
from tofclip.solvers import Sparse
from tofclip.solvers.light_field_variation import LightFieldVariation

SOLVER_VOLUMES = 12
"""float32 volumes that the solver holds at once, with the duals of total variation."""

MIN_VOXELS_PER_WAVELENGTH = 5.0
"""Voxels per carrier wavelength in depth: a point between two of them is then off by less than 1.3
rad.
"""


def build_total_variation(
    grid: Grid, weight: float = 2e-2, iterations: int = 60
) -> LightFieldVariation:
    """Return the prior of even surfaces with sharp borders: total variation along x, y and z alike.

    `grid`: what will be imaged on; evenly spaced; `weight, iterations`: as of
    `tofclip.solvers.TotalVariation`.
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
    voxels have to resolve the carrier in depth.

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

    def plan(self, capture: Capture, grid: Grid) -> RefinementPlan:
        """Make the refinement ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            A NumPy array, of few laser spots.
        grid : Grid
            Evenly spaced along x and y; at least `MIN_VOXELS_PER_WAVELENGTH` voxels per wavelength
            in depth.

        Returns
        -------
        RefinementPlan

        Raises
        ------
        InputError
            The hybrid cannot image such a capture on the grid, the voxels are too coarse in depth,
            or memory does not suffice.
        """
        require_numpy_signal("iterative refinement", capture)
        hybrid = self.hybrid.plan_waves(choose_roles(capture), grid)
        _require_fine_depths(grid, self.hybrid.wavelength)
        _require_memory(grid)
        return RefinementPlan(capture, grid, self, hybrid)


class RefinementPlan(Plan):
    """An iterative refinement, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    method : Refinement
    hybrid : WavePlan
        The plan of the image that is iterated.
    """

    def __init__(self, capture: Capture, grid: Grid, method: Refinement, hybrid: WavePlan) -> None:
        super().__init__(capture, grid)
        self.method, self.hybrid = method, hybrid

    @property
    def cost(self) -> int:
        """Voxels in all iterations."""
        return self.method.prior.work(self.grid.size)

    @property
    def memory_bytes(self) -> int:
        return self.hybrid.memory_bytes + 4 * SOLVER_VOLUMES * self.grid.size

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        warn_of_aliasing(capture, self.hybrid.band)
        model = WallModel(self.hybrid, choose_roles(capture))
        prior, size = self.method.prior, self.grid.size
        result = prior.recover(
            model.operator(), model.measurements(), progress=lambda done: progress(done * size)
        )
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


def _require_fine_depths(grid: Grid, wavelength: float) -> None:
    coarsest = float(np.diff(grid.z).max()) if grid.z.size > 1 else 0.0
    allowed = wavelength / MIN_VOXELS_PER_WAVELENGTH
    # Voxels drawn exactly at the limit must not be refused for a rounding error.
    if coarsest > allowed * (1 + 1e-6):
        raise InputError(
            f"voxels {coarsest:.3g} m apart in depth are too coarse to refine with waves of "
            f"{wavelength:.3g} m: use at most {allowed:.3g} m"
        )


def _require_memory(grid: Grid) -> None:
    needed = 4 * SOLVER_VOLUMES * grid.size
    if needed > MEMORY_LIMIT_BYTES:
        raise InputError(
            f"{grid.size} voxels need {needed / 2**30:.1f} GiB to refine, more than the {MEMORY_LIMIT_BYTES >> 30} GiB "
            "allowed: use larger voxels or a smaller box"
        )
