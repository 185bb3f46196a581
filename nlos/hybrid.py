"""Imaging from walls of any shape: onto a virtual plane first, then from plane to plane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nlos.band import VirtualPulse
from nlos.capture import Capture
from nlos.geometry import Grid
from nlos.illumination_groups import (
    IlluminationGroup,
    check_illumination_support,
    choose_unaliased_band,
    group_by_illumination,
)
from nlos.method import (
    PhasorMethod,
    Progress,
    SubProgress,
    Support,
    check_common_support,
    check_numpy_support,
    ignore_progress,
)
from nlos.plane import Plane
from nlos.propagation.plane_field import choose_virtual_plane
from nlos.propagation.propagate import Propagation, propagate_group, require_propagation
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.image_planes import diffract_to_grid
from nlos.rsd.planar import build_source, build_waves, check_grid_support, require_tolerance
from nlos.sampling import warn_of_aliasing
from nlos.volume import Volume
from tofclip.arrays import is_numpy
from tofclip.errors import InputError

FRESNEL_ZONES, STRICT_FRESNEL_ZONES = 2.0, 4.0
"""Room on the virtual plane beside the straight ways, in Fresnel zones; the second below
`STRICT_TOLERANCE`.
"""

WALL_TO_PLANE_ERROR_FRACTION = 0.6
"""Of the error allowed, what the way from the wall to the plane may take."""

WALL_TO_PLANE_TIME_FRACTIONS = {"spectral": 0.4, "time": 0.95}
"""Of all time, what the way from the wall to the plane takes, roughly."""

STRICT_TOLERANCE = 3e-3
"""Tolerance."""


@dataclass(frozen=True)
class Hybrid(PhasorMethod):
    """The hybrid frequency-time solver: curved, disconnected and scattered walls at nearly the
    speed of planar ones.

    What the wall recorded is propagated onto a virtual plane, on which it is the field of the same
    outgoing waves; from there Rayleigh-Sommerfeld diffraction carries it to all depths, as
    `PlanarRSD` does. The image is that of `Backprojection`. Several laser spots add up; confocal
    scans run at doubled wavenumbers.

    Voxels between wall and virtual plane are reached backwards, without the waves that left the
    plane's rim. A capture of another library's arrays is imaged in that library; see
    `nlos.portable`.

    Supplementary Note 12 of X. Feng, Y. Ma, L. Gao, "Compact light field photography towards
    versatile three-dimensional vision", Nat. Commun. 13, 3333 (2022).

    Parameters
    ----------
    wavelength : float
        Carrier wavelength of the virtual pulse, m of path.
    cycles : float
        Length of the pulse in wavelengths; see `nlos.band.VirtualPulse`.
    propagation : {"spectral", "time"}
        From wall to plane; see `nlos.propagate`. "time" is the paper's, slow and as coarse as the
        time bins.
    tolerance : float
        Relative error of the image that is allowed for the sake of speed, 1e-4 to 0.1.
    plane_z : float, optional
        Where the virtual plane stands, m. Defaults to 5 to 10 cm in front of the foremost wall
        point.
    """

    wavelength: float
    cycles: float = 3.0
    propagation: Propagation = "spectral"
    tolerance: float = 1e-2
    plane_z: float | None = None
    pulse: VirtualPulse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pulse", VirtualPulse(self.wavelength, self.cycles))
        require_tolerance(self.tolerance)
        require_propagation(self.propagation)

    def supports(self, capture: Capture, grid: Grid) -> Support:
        """Say whether `capture` can be imaged on `grid`, and if not, why.

        True in a condition if it can; ``.reason`` says why not. Needed are voxels evenly spaced
        along x and y, few laser spots, a virtual plane in front of the wall, and memory.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Support
        """
        general = (
            check_common_support(capture, grid)
            and check_grid_support(grid)
            and check_illumination_support(capture)
        )
        if self.propagation == "time":
            general = general and check_numpy_support("propagation in time", capture)
        if not general:
            return general
        foremost = float(capture.points[:, 2].max())
        if self.plane_z is not None and self.plane_z <= foremost:
            return Support(
                f"the virtual plane must lie in front of the wall, which reaches up to z = {foremost:.4g} m"
            )
        try:
            plans = [plan for _, plan in self.plans(capture, grid)]
        except InputError as problem:
            return Support(str(problem))
        return plans[0].supports()

    def phasor_field(
        self, capture: Capture, grid: Grid, progress: Progress = ignore_progress
    ) -> Volume:
        """Return the complex sum whose magnitude `reconstruct` gives, complex64; linear within the
        tolerance.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        progress : callable
            Called with the number of voxels just done, once for each laser spot.

        Returns
        -------
        Volume
            (z, y, x) complex64.

        Raises
        ------
        InputError
            `supports` says no.
        """
        self.supports(capture, grid).require()
        band = choose_unaliased_band(capture, grid, self.pulse)
        warn_of_aliasing(capture, band)
        if not is_numpy(capture.signal):
            from nlos.portable.prepared import PreparedField

            prepared = PreparedField(self, capture, grid)
            total = prepared.of(capture, progress)
            return Volume(total, grid, {**capture.provenance, "imaging": prepared.settings})
        total = np.zeros(grid.shape, np.complex64)
        wall_to_plane_work = int(WALL_TO_PLANE_TIME_FRACTIONS[self.propagation] * grid.size)
        for group, plan in self.plans(capture, grid):
            wall_progress = SubProgress(
                progress, int(np.prod(plan.plane.shape)) * plan.waves.count, wall_to_plane_work
            )
            depth_progress = SubProgress(progress, grid.size, grid.size - wall_to_plane_work)
            tolerance = WALL_TO_PLANE_ERROR_FRACTION * self.tolerance
            on_plane = propagate_group(
                capture, group, plan.plane, band, self.propagation, tolerance, wall_progress
            ).values
            diffract_to_grid(
                plan,
                # the sum over points stands for the Rayleigh-Sommerfeld integral over the plane
                on_plane * np.float32(np.prod(plan.plane.steps)),
                build_source(group, band),
                total,
                depth_progress,
            )
        return Volume(
            total,
            grid,
            {**capture.provenance, "imaging": {**self.settings, "plane_z_m": plan.plane.z}},
        )

    @property
    def settings(self) -> dict[str, str | float]:
        """How a volume was imaged, for its provenance."""
        return {
            "method": "hybrid",
            "wavelength_m": self.wavelength,
            "cycles": self.cycles,
            "propagation": self.propagation,
            "tolerance": self.tolerance,
        }

    def virtual_plane(self, capture: Capture, grid: Grid) -> Plane:
        """Return the virtual plane of a capture's first laser spot.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        Plane
        """
        return self.plans(capture, grid)[0][1].plane

    def plans(
        self, capture: Capture, grid: Grid
    ) -> list[tuple[IlluminationGroup, DiffractionPlan]]:
        """Return every illumination group, and the plan from a virtual plane of its own to the
        grid.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        list of (IlluminationGroup, DiffractionPlan)
        """
        band = choose_unaliased_band(capture, grid, self.pulse)
        zones = STRICT_FRESNEL_ZONES if self.tolerance < STRICT_TOLERANCE else FRESNEL_ZONES
        plans = []
        for group in group_by_illumination(capture):
            waves = build_waves(group, band, continued=True)
            points = capture.points[group.indices]
            plane = choose_virtual_plane(points, grid, waves, zones, self.plane_z)
            plans.append((group, DiffractionPlan(plane, grid, waves, self.tolerance)))
        return plans
