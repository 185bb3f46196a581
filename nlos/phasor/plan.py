"""Wall to plane to depths: the three steps that `PlanarRSD` and `Hybrid` share, on any backend.

See ``docs/nlos_algorithm.md``: phasors P_k on the wall, the field S_k on a plane, and the image,
the sum over k of ``S_k(r) * exp(1j * k * |r_L - r|)``, at every depth.

Laser spots and wall points in each other's place: light takes the same path either way.

Phasor-field imaging from a planar wall, by Rayleigh-Sommerfeld diffraction in the frequency
domain.

Imaging from walls of any shape: onto a virtual plane first, then from plane to plane.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture
from nlos.illumination import (
    IlluminationGroup,
    build_source,
    build_waves,
    choose_roles,
    choose_unaliased_band,
    gather_by_points,
    group_by_illumination,
    require_few_spots,
    swap_roles,
    warn_of_aliasing,
)
from nlos.kernels import MIN_DISTANCE_M
from nlos.method import PhasorMethod, PhasorPlan, Progress, SubProgress, require_imageable
from nlos.phasor.depth_steps import BYTES_PER_WAVE, DiffractionPlan
from nlos.phasor.propagate import (
    Backend,
    Diffraction,
    Propagation,
    WallToPlane,
    choose_backend,
    plan_wall_to_plane,
    require_propagation,
    require_tolerance,
)
from nlos.phasor.wall_to_plane import WallBeforePlane
from nlos.plane import PlanarWall, Plane, WallLattice, choose_virtual_plane, is_evenly_spaced
from nlos.volume import FloatArray, Grid, StraightWays, Volume
from tofclip.arrays import Array
from tofclip.errors import InputError

# Per voxel: a complex64 sum, and its float32 magnitude.
SUM_BYTES, MAGNITUDE_BYTES = 8, 4
# Per voxel, at most: the complex64 images of those depths that are computed, from which the others
# follow.
COMPUTED_BYTES = 8
# Spectra are held before and after they are transformed.
SPECTRUM_COPIES = 2


@dataclass(frozen=True, eq=False)
class GroupPlan:
    """The road of one illumination group: from its wall points to a plane, and on to the voxels.

    Parameters
    ----------
    group : IlluminationGroup
    wall_to_plane : callable
        Gives the field S_k where `plane_to_depths` begins; on a virtual plane, times the area that
        each of its points stands for, as the Rayleigh-Sommerfeld integral has it.
    plane_to_depths : DiffractionPlan
        From the plane, the wall's own or a virtual one, to the voxels.
    wall_fraction : float
        Of all time, what the way from the wall to the plane takes, roughly.
    """

    group: IlluminationGroup
    wall_to_plane: WallToPlane
    plane_to_depths: DiffractionPlan
    wall_fraction: float = 0.0

    @property
    def memory_bytes(self) -> int:
        """What fields and plane waves take, all frequencies together, bytes; an estimate."""
        plan = self.plane_to_depths
        values = int(plan.plane_wave_count) + plan.plane.x.size * plan.plane.y.size
        return (values + len(self.group.indices)) * plan.waves.count * BYTES_PER_WAVE


class WavePlan(PhasorPlan):
    """Every illumination group's road, and the images at their ends added up.

    Parameters
    ----------
    capture : Capture
    grid : Grid
    band : Band
        The frequencies that are imaged.
    backend : Backend
        Of the capture's arrays.
    groups : sequence of GroupPlan
    settings : mapping
        What a volume reports of how it was imaged.
    """

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        band: Band,
        backend: Backend,
        groups: Sequence[GroupPlan],
        settings: Mapping[str, Any],
    ) -> None:
        super().__init__(capture, grid)
        self.band, self.groups, self.settings = band, groups, dict(settings)
        self._backend = backend
        self._memory_bytes = (
            grid.size * (SUM_BYTES + COMPUTED_BYTES + MAGNITUDE_BYTES)
            + MAGNITUDE_BYTES * capture.axis.bins * capture.valid.size
            + SPECTRUM_COPIES * groups[0].memory_bytes
        )
        self._held: tuple[DiffractionPlan | None, dict[int, Diffraction]] = None, {}
        self._warned = False

    @property
    def cost(self) -> int:
        return len(self.groups) * self.grid.size

    @property
    def images(self) -> int:
        """Images that are made and added up."""
        return len(self.groups)

    @property
    def memory_bytes(self) -> int:
        return self._memory_bytes

    @property
    def plane(self) -> Plane:
        """The plane of the first illumination group."""
        return self.groups[0].plane_to_depths.plane

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        if not self._warned:
            warn_of_aliasing(capture, self.band)
            self._warned = True
        total = self.zeros()
        for number in range(len(self.groups)):
            self.add_to_depths(
                number, self.propagate_to_plane(number, capture, progress), total, progress
            )
        return Volume(total, self.grid, {**capture.provenance, "imaging": self.settings})

    def zeros(self) -> Array:
        """Make a dark field (z, y, x) on the plan's device, complex64."""
        return self._backend.zeros(self.grid.shape)

    def propagate_to_plane(self, number: int, capture: Capture, progress: Progress) -> Array:
        """Return the field (y, x, frequencies) of one illumination group on its plane.

        Parameters
        ----------
        number : int
            Of the group.
        capture : Capture
        progress : callable
            Called with a part of the number of voxels.

        Returns
        -------
        (y, x, frequencies) complex64 array
        """
        group = self.groups[number]
        plane, waves = group.plane_to_depths.plane, group.plane_to_depths.waves
        points = plane.x.size * plane.y.size * waves.count
        return group.wall_to_plane(capture, SubProgress(progress, points, self._wall_work(number)))

    def add_to_depths(self, number: int, on_plane: Array, total: Array, progress: Progress) -> None:
        """Add what the field of one illumination group shows to a volume.

        Parameters
        ----------
        number : int
            Of the group.
        on_plane : (y, x, frequencies) complex64 array
        total : (z, y, x) complex64 array
            Added to, in place.
        progress : callable
            Called with the rest of the number of voxels.
        """
        work = self.grid.size - self._wall_work(number)
        diffraction = self._hold_diffraction(number)
        diffraction.add(on_plane, total, SubProgress(progress, self.grid.size, work))

    def _hold_diffraction(self, number: int) -> Diffraction:
        """Return what carries a group's field to the voxels.

        Tables and threads' memory are those of one plane at a time, which its groups share: a scan
        may have hundreds of planes.
        """
        group = self.groups[number]
        plane, made = self._held
        if plane is not group.plane_to_depths:
            plane, made = self._held = group.plane_to_depths, {}
        if not made:
            # a copy, whose tables end with it
            source = build_source(group.group, self.band)
            made[number] = self._backend.plane_to_depths(replace(plane), source)
        elif number not in made:
            made[number] = next(iter(made.values())).for_laser(group.group.laser)
        return made[number]

    def _wall_work(self, number: int) -> int:
        """How many voxels the way from the wall to the plane counts for."""
        return int(self.groups[number].wall_fraction * self.grid.size)


class ReciprocalPlan(PhasorPlan):
    """A plan for captures whose roles are swapped, for captures as they come.

    Of the swapped capture come waves ``s(L) / |r_L - r|`` that fall with the distance from the
    laser spots. As the path is ``L = |r_L - r| + |r - r_p|``, the same waves of signals times their
    path, less those waves times ``|r - r_p|``, fall with neither distance; divided by ``|r - r_p|``
    they are those of the capture as it came.

    `capture`: as it comes; `swapped`: for the capture whose roles are swapped.
    """

    def __init__(self, capture: Capture, grid: Grid, swapped: WavePlan) -> None:
        super().__init__(capture, grid)
        self.swapped = swapped

    @property
    def cost(self) -> int:
        return 2 * self.swapped.cost

    @property
    def images(self) -> int:
        """Images that are made and added up."""
        return 2 * self.swapped.images

    @property
    def memory_bytes(self) -> int:
        return self.swapped.memory_bytes + 2 * SUM_BYTES * self.grid.size

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        plain, device = swap_roles(capture), capture.device
        paths = capture.axis.paths.reshape(-1, *[1] * (capture.wall.ndim - 1))
        longer = replace(plain, signal=plain.signal * device.put(paths.astype(np.float32)))
        band = self.swapped.band
        # i dG/dk / G of the pulse's weights G_k, whose phasors of L * H are not those of L * s
        detuning = band.wavenumbers - band.pulse.wavenumber
        slopes = device.put((-1j * band.pulse.sigma**2 * detuning).astype(np.complex64))
        total, without = self.swapped.zeros(), self.swapped.zeros()
        for number, one in enumerate(self.swapped.groups):
            plane_field = self.swapped.propagate_to_plane(number, plain, progress)
            self.swapped.add_to_depths(number, plane_field, without, progress)
            plane_field = self.swapped.propagate_to_plane(number, longer, progress) + (
                plane_field * slopes
            )
            own = self.swapped.zeros()
            self.swapped.add_to_depths(number, plane_field, own, progress)
            total += own / device.put(_find_distance(one.group.laser, self.grid))
        history = {**capture.provenance, "imaging": self.swapped.settings}
        return Volume(total - without, self.grid, history)


def _find_distance(spot: FloatArray | None, grid: Grid) -> NDArray[np.float32]:
    """Distance of every voxel (z, y, x) from a spot, m."""
    x, y, z = np.zeros(3) if spot is None else spot
    across = (grid.y[:, np.newaxis] - y) ** 2 + (grid.x - x) ** 2
    squared = (grid.z[:, np.newaxis, np.newaxis] - z) ** 2 + across
    return np.asarray(np.sqrt(np.maximum(squared, MIN_DISTANCE_M**2)), np.float32)


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


# Relative error of the image where one Fresnel zone has room on the virtual plane beside the
# straight ways; that of n zones is n^3 times less. Measured, for fields that fade as
# `VirtualPlane`'s.
RIM_ERROR = 0.016
# Of the error allowed, what the virtual plane's rim may take.
RIM_ERROR_FRACTION = 0.3
# Of the error allowed, what the way from the wall to the plane may take.
WALL_TO_PLANE_ERROR_FRACTION = 0.6
# Of all time, what the way from the wall to the plane takes, roughly.
WALL_TO_PLANE_TIME_FRACTIONS = {"spectral": 0.4, "time": 0.95}


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
