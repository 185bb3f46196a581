"""`nlos.Refinement`: the hybrid, iterated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.hybrid import Hybrid
from nlos.illumination_groups import choose_unaliased_band
from nlos.method import MEMORY_LIMIT_BYTES, Progress, Support, check_numpy_support, ignore_progress
from nlos.plane import axis_step
from nlos.refinement.model import WallModel
from nlos.sampling import warn_of_aliasing
from nlos.volume import Volume
from tofclip.solvers import Method, Sparse
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

    Parameters
    ----------
    grid : Grid
        What will be imaged on; evenly spaced.
    weight, iterations
        As of `tofclip.solvers.TotalVariation`.

    Returns
    -------
    LightFieldVariation
    """
    across = axis_step(grid.x) if grid.x.size > 1 else 1.0
    along = axis_step(grid.z) if grid.z.size > 1 else across
    # depths take the place of views; differences along z count by their distance in metres
    return LightFieldVariation(weight, iterations, grid=(grid.z.size, 1), angular=across / along)


@dataclass(frozen=True)
class Refinement:
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
    prior : Method
        A proximal method of `tofclip.solvers`; `Sparse` is l1, `build_total_variation` total
        variation.
    """

    hybrid: Hybrid
    prior: Method = field(default_factory=lambda: Sparse(weight=2e-2, iterations=60))

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether `capture` can be imaged on `grid`, and if not, why: a condition, with
        ``.reason``.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Support
        """
        arrays = check_numpy_support("iterative refinement", capture)
        return (
            arrays
            and self.hybrid.supports(capture, grid)
            and self._check_depth_support(grid)
            and _check_size_support(grid)
        )

    def lookups(self, capture: Capture, grid: Grid) -> int:
        """Number of voxels in all iterations; what `progress` counts up to.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        int
        """
        return self.prior.work(grid.size)

    def reconstruct(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Image the hidden scene.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable, optional
            Called with the number of voxels after every iteration.

        Returns
        -------
        Volume
            Albedo up to one factor, float32, not negative.

        Raises
        ------
        InputError
            `supports` says no.
        """
        self.supports(capture, grid).require()
        warn_of_aliasing(capture, choose_unaliased_band(capture, grid, self.hybrid.pulse))
        model = WallModel(self.hybrid, capture, grid)
        result = self.prior.recover(
            model.operator(), model.measurements(), progress=lambda done: progress(done * grid.size)
        )
        settings = {
            "method": "refinement",
            "wavelength_m": self.hybrid.wavelength,
            "cycles": self.hybrid.cycles,
            "prior": self.prior.name,
            "iterations": result.iterations,
            "stopped_because": result.stop_reason,
        }
        # the solver's unknown is the albedo over the laser's distance
        albedo = (result.frames[0] * model.laser_distance).astype(np.float32)
        return Volume(albedo, grid, {**capture.provenance, "imaging": settings})

    def _check_depth_support(self, grid: Grid) -> Support:
        coarsest = float(np.diff(grid.z).max()) if grid.z.size > 1 else 0.0
        allowed = self.hybrid.wavelength / MIN_VOXELS_PER_WAVELENGTH
        # Voxels drawn exactly at the limit must not be refused for a rounding error.
        if coarsest > allowed * (1 + 1e-6):
            return Support(
                f"voxels {coarsest:.3g} m apart in depth are too coarse to refine with waves of "
                f"{self.hybrid.wavelength:.3g} m: use at most {allowed:.3g} m"
            )
        return Support()


def _check_size_support(grid: Grid) -> Support:
    needed = 4 * SOLVER_VOLUMES * grid.size
    if needed > MEMORY_LIMIT_BYTES:
        return Support(
            f"{grid.size} voxels need {needed / 2**30:.1f} GiB to refine, more than the {MEMORY_LIMIT_BYTES >> 30} GiB "
            "allowed: use larger voxels or a smaller box"
        )
    return Support()
