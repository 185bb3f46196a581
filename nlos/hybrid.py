"""Imaging from walls of any shape: onto a virtual plane first, then from plane to plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from nlos.backends import Backend, choose_backend
from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.geometry import Grid, StraightWays
from nlos.illumination_groups import (
    IlluminationGroup,
    build_waves,
    choose_roles,
    choose_unaliased_band,
    gather_by_points,
    group_by_illumination,
    require_few_spots,
)
from nlos.method import PhasorMethod, PhasorPlan, Progress, require_imageable
from nlos.plane import WallLattice, choose_virtual_plane
from nlos.propagation.propagate import (
    Propagation,
    plan_wall_to_plane,
    require_propagation,
    require_tolerance,
)
from nlos.propagation.wall_to_plane_plan import WallBeforePlane
from nlos.reciprocity import ReciprocalPlan
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.planar import require_even_grid
from nlos.wave_plan import GroupPlan, WavePlan
from tofclip.arrays import Array
from tofclip.errors import InputError

RIM_ERROR = 0.016
"""Relative error of the image where one Fresnel zone has room on the virtual plane beside the
straight ways; that of n zones is n^3 times less. Measured, for fields that fade as `VirtualPlane`'s.
"""

RIM_ERROR_FRACTION = 0.3
"""Of the error allowed, what the virtual plane's rim may take."""

WALL_TO_PLANE_ERROR_FRACTION = 0.6
"""Of the error allowed, what the way from the wall to the plane may take."""

WALL_TO_PLANE_TIME_FRACTIONS = {"spectral": 0.4, "time": 0.95}
"""Of all time, what the way from the wall to the plane takes, roughly."""


@dataclass(frozen=True)
class Hybrid(PhasorMethod):
    """The hybrid frequency-time solver: curved, disconnected and scattered walls at nearly the
    speed of planar ones.

    What the wall recorded is propagated onto a virtual plane, on which it is the field of the same
    outgoing waves; from there Rayleigh-Sommerfeld diffraction carries it to all depths, as
    `PlanarRSD` does. The image is that of `Backprojection`. Several laser spots add up; confocal
    scans run at doubled wavenumbers.

    Errs by less than `tolerance` at voxels a wavelength and more from the wall where the record
    holds every path by way of them, in noise as well unless the wall is planar; nearer to the wall,
    waves that fade within a wavelength are missing. Of noise or an even background alone the error
    before a planar wall is 3 to 4 times the tolerance (`PlanarRSD` keeps it). Light or background
    that the record's end cuts off adds an error that no tolerance makes smaller: 0.1 to 0.6 % for
    points on a background, 1.1 to 1.6 % for an even background alone.

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

    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            Of few laser spots, or of few wall points.
        grid : Grid
            Evenly spaced along x and y.

        Returns
        -------
        WavePlan or ReciprocalPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid, or not within memory, or the virtual
            plane would not stand in front of the wall.
        """
        quicker = choose_roles(capture)
        if quicker is not capture:
            return ReciprocalPlan(capture, grid, self.plan_waves(quicker, grid))
        return self.plan_waves(capture, grid)

    def plan_waves(self, capture: Capture, grid: Grid) -> WavePlan:
        """Make the method ready for captures like `capture`, a wave for every laser spot; see
        `plan`.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        WavePlan

        Raises
        ------
        InputError
            As of `plan`.
        """
        require_imageable(capture, grid)
        require_even_grid(grid)
        band = choose_unaliased_band(capture, grid, self.pulse)
        backend = choose_backend(capture, band)
        groups = self.plan_groups(capture, grid, band, backend)
        settings = {**self.settings, "plane_z_m": groups[-1].plane_to_depths.plane.z}
        return WavePlan(capture, grid, band, backend, groups, settings)

    def plan_groups(
        self, capture: Capture, grid: Grid, band: Band, backend: Backend
    ) -> list[GroupPlan]:
        """Return the road of every illumination group to the voxels, at a band's frequencies.

        Parameters
        ----------
        capture : Capture
        grid : Grid
        band : Band
        backend : Backend

        Returns
        -------
        list
            One plan for each illumination group.

        Raises
        ------
        InputError
            The virtual plane would not stand in front of the wall, or memory does not suffice.
        """
        groups = group_by_illumination(capture)
        require_few_spots(capture, groups)
        foremost = float(capture.points[:, 2].max())
        if self.plane_z is not None and self.plane_z <= foremost:
            raise InputError(
                f"the virtual plane must lie in front of the wall, which reaches up to z = {foremost:.4g} m"
            )
        return [
            plan
            for same in gather_by_points(capture, groups)
            for plan in self._plan_groups_at(capture, same, grid, band, backend)
        ]

    def _plan_groups_at(
        self,
        capture: Capture,
        groups: Sequence[IlluminationGroup],
        grid: Grid,
        band: Band,
        backend: Backend,
    ) -> list[GroupPlan]:
        """Plan groups of the same wall points, whose ways differ in the laser spot only."""
        waves = build_waves(groups[0], band, continued=True)
        zones = (RIM_ERROR / (RIM_ERROR_FRACTION * self.tolerance)) ** (1 / 3)
        points = capture.points[groups[0].indices]
        lattice = WallLattice.find(points)
        plane = choose_virtual_plane(points, grid, waves, zones, self.plane_z, lattice)
        ways = StraightWays.find(points, plane, grid, self.tolerance)
        plane_to_depths = DiffractionPlan(plane, grid, waves, band.strength, self.tolerance, ways)
        plane_to_depths.require_memory()
        tolerance = WALL_TO_PLANE_ERROR_FRACTION * self.tolerance
        carry = plan_wall_to_plane(
            capture,
            WallBeforePlane(points, plane, lattice, ways),
            groups[0],
            band,
            backend,
            self.propagation,
            tolerance,
        )
        # The Rayleigh-Sommerfeld integral over the plane, as a sum over its points.
        weights = capture.device.put(plane.weights[..., np.newaxis])

        def wall_to_plane(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            field = carry(one, progress, group)
            field *= weights  # in place: nobody else has it
            return field

        fraction = WALL_TO_PLANE_TIME_FRACTIONS[self.propagation]
        return [
            GroupPlan(group, partial(wall_to_plane, group=group), plane_to_depths, fraction)
            for group in groups
        ]

    @property
    def settings(self) -> dict[str, str | float]:
        """What a volume reports of how it was imaged."""
        return {
            "method": "hybrid",
            "wavelength_m": self.wavelength,
            "cycles": self.cycles,
            "propagation": self.propagation,
            "tolerance": self.tolerance,
        }
