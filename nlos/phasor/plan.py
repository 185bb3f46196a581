"""Imaging by waves: wall to plane to depths, the three steps that `PlanarRSD` and `Hybrid` share,
on NumPy's arrays or any other library's.

See ``docs/nlos_algorithm.md``: phasors P_k on the wall; the field S_k on a plane, the wall's own
(Rayleigh-Sommerfeld diffraction in the frequency domain) or a virtual one before a wall of any
shape; and the image, the sum over k of ``S_k(r) * exp(1j * k * |r_L - r|)``, at every depth. Laser
spots and wall points may take each other's place: light takes the same path either way.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.illumination import (
    IlluminationGroup,
    build_source,
    build_waves,
    choose_roles,
    choose_unaliased_band,
    group_by_illumination,
    swap_roles,
    warn_of_aliasing,
)
from nlos.kernels import MIN_DISTANCE_M
from nlos.method import PhasorPlan, Progress, PulsedMethod, SubProgress, require_imageable
from nlos.phasor.depth_steps import BYTES_PER_WAVE, DiffractionPlan
from nlos.phasor.propagate import (
    Backend,
    Diffraction,
    Propagation,
    WallToPlane,
    plan_wall_to_plane,
    require_in_front,
    require_tolerance,
)
from nlos.phasor.wall_to_plane import WallBeforePlane
from nlos.plane import (
    PlanarWall,
    StraightPaths,
    WallLattice,
    choose_virtual_plane,
    is_evenly_spaced,
)
from nlos.volume import Grid, Volume
from tofclip.arrays import Array, Float32Array, FloatArray
from tofclip.errors import InputError, require_known

# Per voxel: a complex64 sum, and, at most, the images of the depths from which the others follow; and
# per sample of the signal.
SUM_BYTES, COMPUTED_BYTES, SIGNAL_BYTES = 8, 8, 4
# Spectra are held before and after they are transformed.
SPECTRUM_COPIES = 2
# With fewer wall points per laser spot, a wave from each spot is not worth its own field.
MIN_POINTS_PER_SPOT = 4


@dataclass(frozen=True, eq=False)
class GroupPlan:
    """One illumination group's light from its wall points to a plane, and on to the voxels."""

    group: IlluminationGroup
    # The field S_k where `plane_to_depths` begins; on a virtual plane, times the area that each of
    # its points stands for, as the Rayleigh-Sommerfeld integral has it.
    wall_to_plane: WallToPlane
    plane_to_depths: DiffractionPlan  # from the plane, the wall's own or a virtual one
    wall_fraction: float = 0.0  # of all time, what the way from the wall to the plane takes


class WavePlan(PhasorPlan):
    """The images of all illumination groups, added up."""

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        band: Band,
        backend: Backend,
        groups: Sequence[GroupPlan],
        settings: Mapping[str, Any],  # what a volume reports of how it was imaged
    ) -> None:
        super().__init__(capture, grid)
        self.band, self.groups, self.settings = band, groups, dict(settings)
        self._backend, self.images, self.cost = backend, len(groups), len(groups) * grid.size
        self.plane = groups[0].plane_to_depths.plane
        # What fields and plane waves of a group take, all frequencies together.
        depths = groups[0].plane_to_depths
        values = int(depths.plane_wave_count) + math.prod(self.plane.shape)
        values += len(groups[0].group.indices)
        self.memory_bytes += (
            grid.size * COMPUTED_BYTES + SIGNAL_BYTES * capture.axis.bins * capture.valid.size
        )
        self.memory_bytes += SPECTRUM_COPIES * values * depths.waves.count * BYTES_PER_WAVE
        self._held: tuple[DiffractionPlan | None, dict[int, Diffraction]] = None, {}

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        warn_of_aliasing(capture, self.band)
        total = self.zeros()
        for number in range(len(self.groups)):
            on_plane = self.propagate_to_plane(number, capture, progress)
            self.add_to_depths(number, on_plane, total, progress)
        return Volume(total, self.grid, {**capture.provenance, "imaging": self.settings})

    def zeros(self) -> Array:
        """Make a dark field (z, y, x) on the plan's device, complex64."""
        return self._backend.zeros(self.grid.shape)

    def propagate_to_plane(self, number: int, capture: Capture, progress: Progress) -> Array:
        """Return a group's field (y, x, frequencies) on its plane, complex64."""
        group = self.groups[number]
        depths = group.plane_to_depths
        points = math.prod(depths.plane.shape) * depths.waves.count
        part = SubProgress(progress, points, self._wall_work(number))
        return group.wall_to_plane(capture, part, group.group)

    def add_to_depths(self, number: int, on_plane: Array, total: Array, progress: Progress) -> None:
        """Add what the field of one illumination group shows to a volume, in place."""
        work = self.grid.size - self._wall_work(number)
        diffraction = self._hold_diffraction(number)
        diffraction.add(on_plane, total, SubProgress(progress, self.grid.size, work))

    def _hold_diffraction(self, number: int) -> Diffraction:
        """Return what carries a group's field to the voxels. Groups share the tables of one plane,
        held at a time: a scan may have hundreds.
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
    """A plan by swapped roles, for captures as they come. Swapped waves ``s(L) / |r_L - r|`` fall
    with the distance from the laser spots. As ``L = |r_L - r| + |r - r_p|``, those of signals times
    L, less the waves times ``|r - r_p|``, fall with neither distance; over ``|r - r_p|`` they are
    the capture's.
    """

    def __init__(self, capture: Capture, grid: Grid, swapped: WavePlan) -> None:
        super().__init__(capture, grid)
        self.swapped, self.cost, self.images = swapped, 2 * swapped.cost, 2 * swapped.images
        self.memory_bytes = swapped.memory_bytes + 2 * SUM_BYTES * grid.size

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        plain, device = swap_roles(capture), capture.device
        paths = capture.axis.paths.reshape(-1, *[1] * (capture.wall.ndim - 1))
        longer = replace(plain, signal=plain.signal * device.put(paths.astype(np.float32)))
        band = self.swapped.band
        # i dG/dk / G of the pulse's weights G_k, whose phasors of L * H are not those of L * s
        slopes = device.put((1j * band.pulse.slope(band.wavenumbers)).astype(np.complex64))
        total, without = self.swapped.zeros(), self.swapped.zeros()
        for number, one in enumerate(self.swapped.groups):
            plane_field = self.swapped.propagate_to_plane(number, plain, progress)
            self.swapped.add_to_depths(number, plane_field, without, progress)
            plane_field = plane_field * slopes
            plane_field += self.swapped.propagate_to_plane(number, longer, progress)
            own = self.swapped.zeros()
            self.swapped.add_to_depths(number, plane_field, own, progress)
            total += own / device.put(find_distance(one.group.laser, self.grid))
        history = {**capture.provenance, "imaging": self.swapped.settings}
        return Volume(total - without, self.grid, history)


def find_distance(spot: FloatArray | None, grid: Grid) -> Float32Array:
    """Distance of every voxel (z, y, x) from a laser spot, m; 1 without one."""
    if spot is None:
        return np.ones(grid.shape, np.float32)
    x, y, z = spot
    across = (grid.y[:, np.newaxis] - y) ** 2 + (grid.x - x) ** 2
    squared = (grid.z[:, np.newaxis, np.newaxis] - z) ** 2 + across
    return np.asarray(np.sqrt(np.maximum(squared, MIN_DISTANCE_M**2)), np.float32)


PointsPlan = tuple[DiffractionPlan, WallToPlane, float]
"""Of groups of the same wall points: their way from a plane to the voxels, what carries each to that
plane, and the fraction of time that this takes.
"""


class WaveMethod(PulsedMethod):
    """Imaging by waves, a field for every laser spot; `_plan_points` is what methods differ by."""

    tolerance: float
    name: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        require_tolerance(self.tolerance)

    @property
    def settings(self) -> dict[str, str | float]:
        """What a volume reports of how it was imaged."""
        pulse: dict[str, str | float] = {"wavelength_m": self.wavelength, "cycles": self.cycles}
        return {"method": self.name, **pulse, "tolerance": self.tolerance}

    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan:
        quicker = choose_roles(capture)
        plan = plan_waves(self, quicker, grid)
        return plan if quicker is capture else ReciprocalPlan(capture, grid, plan)

    @abstractmethod
    def _plan_points(
        self, capture: Capture, group: IlluminationGroup, grid: Grid, band: Band, backend: Backend
    ) -> PointsPlan:
        """Plan groups of the same wall points."""


def plan_waves(method: WaveMethod, capture: Capture, grid: Grid) -> WavePlan:
    """Make a method ready for captures like `capture`, a wave for every laser spot."""
    require_imageable(capture, grid)
    require_even_grid(grid)
    band = choose_unaliased_band(capture, grid, method.pulse)
    backend = Backend(band, capture)
    groups = plan_groups(method, capture, grid, band, backend)
    settings = dict(method.settings)
    if isinstance(method, Hybrid):
        settings["plane_z_m"] = groups[-1].plane_to_depths.plane.z
    return WavePlan(capture, grid, band, backend, groups, settings)


def plan_groups(
    method: WaveMethod, capture: Capture, grid: Grid, band: Band, backend: Backend
) -> list[GroupPlan]:
    """Plan the way of every illumination group to the voxels, at a band's frequencies."""
    groups = group_by_illumination(capture)
    if len(groups) * MIN_POINTS_PER_SPOT > len(capture.points):
        raise InputError(
            f"{len(groups)} laser spots for {len(capture.points)} wall points: a field per spot needs at least "
            f"{MIN_POINTS_PER_SPOT} points each; image such pairs by back-projection"
        )
    # One plan serves all groups that share their wall points.
    gathered: dict[bytes, list[IlluminationGroup]] = {}
    for group in groups:
        gathered.setdefault(capture.points[group.indices].tobytes(), []).append(group)
    plans = []
    for same in gathered.values():
        depths, carry, fraction = method._plan_points(capture, same[0], grid, band, backend)
        depths.require_memory()
        plans += [GroupPlan(one, carry, depths, fraction) for one in same]
    return plans


def require_even_grid(grid: Grid) -> None:
    """Refuse voxels that Fourier transforms cannot reach."""
    for name in ("x", "y"):
        if not is_evenly_spaced(getattr(grid, name)):
            raise InputError(
                f"the voxels are not evenly spaced along {name}: Fourier transforms need them to be"
            )


@dataclass(frozen=True)
class PlanarRSD(WaveMethod):
    """Diffraction from a planar wall to all depths: the image of `Backprojection`, thousands of
    times faster.

    ``I(r) = | sum_k exp(1j * k * |r_L - r|) * sum_p P_k(r_p) * exp(1j * k * |r_p - r|) / |r_p - r|
    |``: the inner sum is a convolution over the wall, done in the frequency domain; the outer one
    takes a few inverse Fourier transforms per depth, since the laser's wave varies little across
    the band. For a confocal scan the wavenumber is doubled and the laser's wave drops out; several
    laser spots add up.

    Errs by less than `tolerance` at depths of a wavelength and more, of photons on any background
    as well, whether or not the record holds every path; nearer to the wall, waves that fade within
    a wavelength are missing. Below 1e-3 what the ends of a record cut off of a bright background is
    not kept: its echoes are up to 3e-4 of it.
    Holds the wall's spectrum, 8 bytes per plane wave and frequency (60 MB for 128 x 128 points and
    120 frequencies), the volume, and per thread the waves of all terms of two depths (30 MB). A
    capture of another library's arrays is imaged in that library.

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
    >>> from nlos.simulate import PointScene
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
    name = "rsd"

    def _plan_points(
        self, capture: Capture, group: IlluminationGroup, grid: Grid, band: Band, backend: Backend
    ) -> PointsPlan:
        wall = PlanarWall.of(capture.points[group.indices])
        if grid.z[0] <= wall.plane.z:
            raise InputError(
                f"the grid must begin in front of the wall, which is at z = {wall.plane.z:.4g} m"
            )
        waves = build_waves(group, band, continued=False)
        depths = DiffractionPlan(wall.plane, grid, waves, band.strength, self.tolerance)

        def place_phasors(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            return backend.place_on_lattice(backend.compute_phasors(one, group), wall.lattice)

        return depths, place_phasors, 0.0


# Relative error of the image where one Fresnel zone has room on the virtual plane beside the
# straight paths; that of n zones is n^2.1 times less. Measured with noise and even backgrounds, which a
# wall's rim cuts off, for fields that fade as `VirtualPlane`'s.
RIM_ERROR, RIM_POWER = 0.01, 0.47
# Of the error allowed, what the virtual plane's rim, and the way from the wall to it, may take.
RIM_ERROR_FRACTION, WALL_TO_PLANE_ERROR_FRACTION = 0.25, 0.6
# Of all time, what the way from the wall to the plane takes, roughly.
WALL_TO_PLANE_TIME_FRACTIONS = {"spectral": 0.4, "time": 0.95}


@dataclass(frozen=True)
class Hybrid(WaveMethod):
    """The hybrid frequency-time solver: curved, disconnected and scattered walls at nearly the
    speed of planar ones.

    What the wall recorded is propagated onto a virtual plane, on which it is the field of the same
    outgoing waves; from there Rayleigh-Sommerfeld diffraction carries it to all depths, as
    `PlanarRSD` does. The image is that of `Backprojection`. Several laser spots add up; confocal
    scans run at doubled wavenumbers.

    Errs by less than `tolerance` at voxels a wavelength and more from the wall, of photons on any
    background as well; see `PlanarRSD`.

    Voxels between wall and virtual plane are reached backwards, without the waves that left the
    plane's rim. A capture of another library's arrays is imaged in that library.

    Supplementary Note 12 of X. Feng, Y. Ma, L. Gao, "Compact light field photography towards
    versatile three-dimensional vision", Nat. Commun. 13, 3333 (2022).

    Parameters
    ----------
    wavelength, cycles, tolerance
        As of `PlanarRSD`.
    propagation : {"spectral", "time"}
        From wall to plane; see `nlos.propagate`. "time" is the paper's, slow and as coarse as the
        time bins.
    plane_z : float, optional
        Where the virtual plane stands, m. Defaults to 5 to 10 cm in front of the foremost wall
        point.
    """

    wavelength: float
    cycles: float = 3.0
    propagation: Propagation = "spectral"
    tolerance: float = 1e-2
    plane_z: float | None = None
    name = "hybrid"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_known("propagation", self.propagation, WALL_TO_PLANE_TIME_FRACTIONS)

    @property
    def settings(self) -> dict[str, str | float]:
        """What a volume reports of how it was imaged."""
        return {**super().settings, "propagation": self.propagation}

    def _plan_points(
        self, capture: Capture, group: IlluminationGroup, grid: Grid, band: Band, backend: Backend
    ) -> PointsPlan:
        points = capture.points[group.indices]
        if self.plane_z is not None:
            require_in_front(self.plane_z, points)
        waves = build_waves(group, band, continued=True)
        zones = (RIM_ERROR / (RIM_ERROR_FRACTION * self.tolerance)) ** RIM_POWER
        lattice = WallLattice.find(points)
        plane = choose_virtual_plane(points, grid, waves, zones, self.plane_z, lattice)
        paths = StraightPaths.find(points, plane, grid, self.tolerance)
        depths = DiffractionPlan(plane, grid, waves, band.strength, self.tolerance, paths)
        geometry = WallBeforePlane(points, plane, lattice, paths)
        tolerance = WALL_TO_PLANE_ERROR_FRACTION * self.tolerance
        carry = plan_wall_to_plane(
            capture, geometry, group, band, backend, self.propagation, tolerance
        )
        # The Rayleigh-Sommerfeld integral over the plane, as a sum over its points.
        weights = capture.device.put(plane.weights[..., np.newaxis])

        def carry_weighted(one: Capture, progress: Progress, group: IlluminationGroup) -> Array:
            field = carry(one, progress, group)
            field *= weights  # in place: nobody else has it
            return field

        return depths, carry_weighted, WALL_TO_PLANE_TIME_FRACTIONS[self.propagation]
