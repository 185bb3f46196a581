"""Phasor-field imaging from a planar wall, by Rayleigh-Sommerfeld diffraction in the frequency
domain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

from nlos.backends import Backend, choose_backend
from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.geometry import Grid
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
from nlos.plane import PlanarWall, is_evenly_spaced
from nlos.propagation.propagate import require_tolerance
from nlos.reciprocity import ReciprocalPlan
from nlos.rsd.diffraction import DiffractionPlan
from nlos.wave_plan import GroupPlan, WavePlan
from tofclip.arrays import Array
from tofclip.errors import InputError


@dataclass(frozen=True)
class PlanarRSD(PhasorMethod):
    """Diffraction from a planar wall to all depths: the image of `Backprojection`, thousands of
    times faster.

    ``I(r) = | sum_k exp(1j * k * |r_L - r|) * sum_p P_k(r_p) * exp(1j * k * |r_p - r|) / |r_p - r|
    |``: the inner sum is a convolution over the wall, done in the frequency domain; the outer one
    takes a few inverse Fourier transforms per depth, since the laser's wave varies little across
    the band. For a confocal scan the wavenumber is doubled and the laser's wave drops out; several
    laser spots add up.

    Errs by less than `tolerance` at depths of a wavelength and more where the record holds every
    path by way of the voxels, in noise as well; nearer to the wall, waves that fade within a
    wavelength are missing. Light or background that the record's end cuts off adds an error that no
    tolerance makes smaller: 0.3 % for points on a background, 1.2 % for an even background alone.
    Holds the wall's spectrum, 8 bytes per plane wave and
    frequency (60 MB for 128 x 128 points and 120 frequencies), the volume, and per thread the waves
    of all terms of two depths (30 MB). A capture of another library's arrays is imaged in that
    library; see `nlos.portable`.

    Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight
    imaging systems", Nat. Commun. 11, 1645 (2020).

    Parameters
    ----------
    wavelength : float
        Carrier wavelength of the virtual pulse, m of path.
    cycles : float
        Length of the pulse in wavelengths; see `nlos.band.VirtualPulse`.
    tolerance : float
        Relative error of the image that is allowed for the sake of speed, 1e-4 to 0.1.

    Examples
    --------
    >>> import numpy as np
    >>> import nlos
    >>> from nlos.simulate.points import PointScene
    >>> from nlos.capture import TimeAxis
    >>> x, y = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    >>> wall, hidden = np.stack([x, y, 0 * x], axis=-1), PointScene([[0.1, -0.2, 0.8]])
    >>> capture = hidden.simulate_capture(wall, np.zeros(3), TimeAxis(256, 40e-12), jitter=60e-12)
    >>> grid = nlos.Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.6, 1.0), voxel=0.1)
    >>> volume = nlos.PlanarRSD(wavelength=0.28).reconstruct(capture, grid)
    >>> volume.values.shape
    (5, 9, 9)
    """

    wavelength: float
    cycles: float = 3.0
    tolerance: float = 1e-2
    pulse: VirtualPulse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pulse", VirtualPulse(self.wavelength, self.cycles))
        require_tolerance(self.tolerance)

    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            Of a planar, evenly sampled wall at z = const and few laser spots; or the other way round.
        grid : Grid
            In front of the wall, evenly spaced along x and y.

        Returns
        -------
        WavePlan or ReciprocalPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid, or not within memory.
        """
        quicker = choose_roles(capture)
        if quicker is not capture:
            return ReciprocalPlan(capture, grid, self._plan_waves(quicker, grid))
        return self._plan_waves(capture, grid)

    def _plan_waves(self, capture: Capture, grid: Grid) -> WavePlan:
        require_imageable(capture, grid)
        require_even_grid(grid)
        band = choose_unaliased_band(capture, grid, self.pulse)
        backend = choose_backend(capture, band)
        groups = self.plan_groups(capture, grid, band, backend)
        return WavePlan(capture, grid, band, backend, groups, self.settings)

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
            The wall is not planar or not evenly sampled, or the grid does not lie in front of it.
        """
        groups = group_by_illumination(capture)
        require_few_spots(capture, groups)
        plans: list[GroupPlan] = []
        for same in gather_by_points(capture, groups):
            plans += self._plan_groups_at(capture, same, grid, band, backend)
        return plans

    @property
    def settings(self) -> dict[str, str | float]:
        """What a volume reports of how it was imaged."""
        return {
            "method": "rsd",
            "wavelength_m": self.wavelength,
            "cycles": self.cycles,
            "tolerance": self.tolerance,
        }

    def _plan_groups_at(
        self,
        capture: Capture,
        groups: Sequence[IlluminationGroup],
        grid: Grid,
        band: Band,
        backend: Backend,
    ) -> list[GroupPlan]:
        """Plan groups of the same wall points, whose ways differ in the laser spot only."""
        wall = PlanarWall.of(capture.points[groups[0].indices])
        if grid.z[0] <= wall.plane.z:
            raise InputError(
                f"the grid must begin in front of the wall, which is at z = {wall.plane.z:.4g} m"
            )
        waves = build_waves(groups[0], band, continued=False)
        plane_to_depths = DiffractionPlan(wall.plane, grid, waves, band.strength, self.tolerance)
        plane_to_depths.require_memory()

        def place_phasors(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            return backend.place_on_lattice(backend.compute_phasors(one, group), wall.lattice)

        return [
            GroupPlan(group, partial(place_phasors, group=group), plane_to_depths)
            for group in groups
        ]


def require_even_grid(grid: Grid) -> None:
    """Refuse voxels that Fourier transforms cannot reach."""
    for name in ("x", "y"):
        if not is_evenly_spaced(getattr(grid, name)):
            raise InputError(
                f"the voxels are not evenly spaced along {name}: Fourier transforms need them to be"
            )
