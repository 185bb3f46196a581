"""Evenly spaced points of a plane before the hidden scene, a planar wall or a virtual one: how they
are recognised, and fields there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tofclip.arrays import AnyArray, ComplexArray, Float32Array, FloatArray, IndexArray
from tofclip.errors import InputError, ShapeError, require

if TYPE_CHECKING:
    from nlos.phasor.transfer import SphericalWaves
    from nlos.volume import Grid


# Points may be off an even spacing by this fraction of it; at half a wavelength that is a phase of
# 3 mrad.
EVENNESS_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Plane:
    """Points at all combinations of x and y on the plane z = const.

    Parameters
    ----------
    x, y : (n,) array
        Evenly spaced and increasing, m; at least 2 of each.
    z : float
        m.

    Raises
    ------
    ShapeError, InputError
        An axis is too short, not evenly spaced or not increasing, or a number is not finite.
    """

    x: FloatArray
    y: FloatArray
    z: float

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            axis = np.array(getattr(self, name), dtype=np.float64)
            if axis.ndim != 1 or axis.size < 2:
                raise ShapeError(f"axis {name} of a plane", "(n,) with n >= 2", axis.shape)
            if not is_evenly_spaced(axis):
                raise InputError(
                    f"axis {name} of a plane must be finite, increasing and evenly spaced"
                )
            object.__setattr__(self, name, axis)
        object.__setattr__(self, "z", float(self.z))
        require(np.isfinite(self.z), f"a plane needs a finite z, got {self.z}")

    @property
    def shape(self) -> tuple[int, int]:
        """Points along (y, x)."""
        return self.y.size, self.x.size

    @property
    def steps(self) -> tuple[float, float]:
        """Distance of neighbouring points along y and x, m."""
        return axis_step(self.y), axis_step(self.x)

    @property
    def points(self) -> FloatArray:
        """Position of every point, m, shape (y, x, 3)."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return np.stack([x, y, np.full_like(x, self.z)], axis=-1)


def axis_step(axis: FloatArray) -> float:
    """Distance of neighbouring entries of an evenly spaced axis."""
    # from end to end, where rounding of single points matters least
    return float(axis[-1] - axis[0]) / (axis.size - 1)


def is_evenly_spaced(axis: FloatArray) -> bool:
    """Whether an axis increases in equal steps; a single entry does."""
    if not np.all(np.isfinite(axis)):
        return False
    if axis.size < 2:
        return True
    spacing = axis_step(axis)
    even = axis[0] + spacing * np.arange(axis.size)
    return bool(spacing > 0 and np.max(np.abs(axis - even)) <= EVENNESS_TOLERANCE * spacing)


# The virtual plane keeps this far from the foremost wall point, m.
MIN_GAP_M, MAX_GAP_M = 0.05, 0.1


@dataclass(frozen=True, eq=False)
class PlaneField:
    """Phasors of every frequency of a band on a plane.

    Parameters
    ----------
    values : (y, x, frequencies) complex64 array
        ``S_k(r_v) = sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|``, of the library of
        the capture's signal.
    plane : Plane
    wavenumbers : (frequencies,) array
        Of the waves on the plane, rad/m: the band's, doubled for a confocal scan.
    """

    values: ComplexArray
    plane: Plane
    wavenumbers: FloatArray


# Of the room beside the straight paths, over how much the field fades towards the rim.
FADE_FRACTION = 0.75


@dataclass(frozen=True, eq=False)
class VirtualPlane(Plane):
    """A plane on which a field is known, to be continued from there; towards its rim the field
    fades.

    A field cut off at the rim would send waves of its own from there, which weaken with the square
    root of the rim's distance only. Faded out as a raised cosine, whose second derivative jumps,
    they weaken with the third power of the fade's width.
    """

    fade: tuple[float, float] = (0.0, 0.0)  # width of the fade along y and x, m

    @property
    def weights(self) -> Float32Array:
        """What each point stands for in an integral over the plane: area times fade, m^2, shape (y,
        x).
        """
        along_y, along_x = (
            step * _fade_out(axis, width)
            for axis, step, width in zip((self.y, self.x), self.steps, self.fade, strict=True)
        )
        return np.outer(along_y, along_x).astype(np.float32)


def _fade_out(axis: FloatArray, width: float) -> FloatArray:
    """Return a raised cosine at both ends of an axis, 0 half a step outside of them."""
    half = axis_step(axis) / 2
    inward = np.minimum(axis - axis[0], axis[-1] - axis) + half
    return (1 - np.cos(np.pi * np.minimum(inward / (width + half), 1))) / 2


# Least distance from wall to plane by which Fresnel zones are measured, in wavelengths: before a wall
# that is closer, waves of noise and even backgrounds run along it. Measured with both.
MIN_ZONE_GAP = 1.5
# From so many zones on, that is, for tolerances below 3e-3, points of the plane are closer than half
# the shortest wavelength: waves that fade before the nearest voxel would show as others.
FINE_ZONES, FINE_SPACING = 3.0, 0.9


def choose_virtual_plane(
    points: FloatArray,
    grid: Grid,
    waves: SphericalWaves,
    zones: float,
    z: float | None = None,
    wall: WallLattice | None = None,
) -> VirtualPlane:
    """Choose a plane between a wall and the hidden scene that misses little of what passes.

    It holds the straight way from every wall point to every voxel behind it, and around these some
    Fresnel zones of the middle wave, in which the field fades; its points are at most half the
    shortest wavelength apart. Where the wall's points stand above a lattice, their spacing is a
    multiple or a fraction of its step, so that Fourier transforms lead from one to the other.

    `points` (n, 3): wall points, m; `zones`: room beside the straight paths, in radii of the first
    Fresnel zone; `z`: where, m. Defaults to the shortest wavelength, but 5 to 10 cm, in front of
    the foremost wall point; `wall`: that the points stand above.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    shortest, middle = (
        2 * np.pi / waves.max_wavenumber,
        4 * np.pi / (waves.first + waves.max_wavenumber),
    )
    if z is None:
        z = float(high[2] + np.clip(shortest, MIN_GAP_M, MAX_GAP_M))
    gap = z - float(low[2])
    behind = grid.z[grid.z > z]
    depth = gap + float(behind[0]) - z if behind.size else gap
    axes, fades = [], []
    widest = shortest / 2 * (FINE_SPACING if zones > FINE_ZONES else 1.0)
    spacings = (widest, widest)
    if wall is not None:
        spacings = _fit_spacing(widest, wall.x), _fit_spacing(widest, wall.y)
    for first, last, voxels, spacing in zip(
        low[:2], high[:2], (grid.x, grid.y), spacings, strict=True
    ):
        before, beyond = max(0.0, first - voxels[0]), max(0.0, voxels[-1] - last)
        # Along a slanted way to voxels beside the wall, a zone's cut is longer: it grows with the
        # root of the way and is seen aslant.
        slant = 1 + (max(before, beyond) / depth) ** 2
        room = zones * np.sqrt(middle * max(gap, MIN_ZONE_GAP * middle)) * slant**0.75
        start, stop = first - before * gap / depth - room, last + beyond * gap / depth + room
        count = max(1, int(np.ceil((stop - start) / spacing)))
        if wall is not None:
            middle_place, half = (start + stop) / 2, count * spacing / 2
            start, stop = middle_place - half, middle_place + half
        axes.append(np.linspace(start, stop, count + 1))
        fades.append(float(FADE_FRACTION * room))
    return VirtualPlane(axes[0], axes[1], z, (fades[1], fades[0]))


def _fit_spacing(widest: float, axis: FloatArray) -> float:
    """Largest spacing up to a widest one that is a multiple or a fraction of an axis's step, m."""
    step = axis_step(axis)
    return step * int(widest / step) if step <= widest else step / int(np.ceil(step / widest))


# Of the longest path, what a window about wall points holds at least, for each digit of the tolerance:
# where the plane stands close to the wall, crossings are wide beside their distance. Measured with
# noise and even backgrounds, which come by all paths alike; errors of 1e-2 and 1e-3 ask for 0.7 and
# 1.0.
WALL_FRACTION_PER_DIGIT = 0.35
# And beyond the farthest crossing of a straight way, where voxels are close, of the longest path: an
# error of 1e-2 asks for 0.2 to 0.25.
CROSSING_FRACTION_PER_DIGIT = 0.125
# Of the fade towards the plane's rim, how wide a rim carries too little to be told from an image of
# it a period away: at most, and how much less for each digit of the tolerance. Measured with noise;
# none where the error is 1e-3.
MAX_RIM_FRACTION, RIM_FRACTION, RIM_FRACTION_PER_DIGIT = 0.7, 1.5, 0.5


@dataclass(frozen=True)
class StraightPaths:
    """How far across straight paths from wall points to voxels lead, before and behind a virtual
    plane. What the plane carries to a voxel comes from about their crossings: elsewhere the phases
    of both legs turn, and their sum cancels.
    """

    wall_to_plane: float  # along the plane, at most, m; with room about the crossings
    plane_to_voxels: float  # along the plane, at most, m; with room about the crossings
    # width along y and x of the plane's rim, where little of the field is left, m
    rim: tuple[float, float]
    first_depth: float  # z of the nearest voxels, m

    @classmethod
    def find(
        cls, points: FloatArray, plane: VirtualPlane, grid: Grid, tolerance: float
    ) -> StraightPaths | None:
        """Find the straight paths between wall points (n, 3), m, and voxels through a plane before the
        wall; None where voxels lie before it: no straight path to these crosses it.
        """
        first, last = float(grid.z[0]), float(grid.z[-1])
        if first <= plane.z:
            return None
        low, high = points.min(axis=0), points.max(axis=0)
        longest = np.hypot(
            max(grid.x[-1] - low[0], high[0] - grid.x[0]),
            max(grid.y[-1] - low[1], high[1] - grid.y[0]),
        )
        # Paths to the nearest voxels from the hindmost points cross the plane latest, those to the
        # farthest voxels from the foremost points soonest.
        before = (plane.z - low[2]) / (first - low[2])
        behind = (last - plane.z) / (last - high[2])
        digits = np.log10(1 / tolerance)
        reach = before + CROSSING_FRACTION_PER_DIGIT * digits
        rim = RIM_FRACTION - RIM_FRACTION_PER_DIGIT * digits
        rim = np.clip(rim, 0, MAX_RIM_FRACTION)
        fade_y, fade_x = plane.fade
        return cls(
            float(max(reach, WALL_FRACTION_PER_DIGIT * digits) * longest),
            float(behind * longest),
            (float(rim * fade_y), float(rim * fade_x)),
            first,
        )


# Coordinates nearer to each other than this fraction of the widest gap are one.
SAME_COORDINATE_FRACTION = 0.02


@dataclass(frozen=True, eq=False)
class WallLattice:
    """Wall points above the places of an even lattice, at whatever depth; some places may stay
    empty.
    """

    # (n,), coordinates of the places, m
    x: FloatArray
    y: FloatArray
    # (points,), place of every wall point
    row: IndexArray
    column: IndexArray

    @classmethod
    def of(cls, points: FloatArray, evenness: float = EVENNESS_TOLERANCE) -> WallLattice:
        """Find the lattice that wall points (n, 3) stand above; `evenness`: how far off its place a
        point may be, in steps of the lattice.
        """
        x, column = _fit_lattice_axis(points[:, 0], "x", evenness)
        y, row = _fit_lattice_axis(points[:, 1], "y", evenness)
        places = row * x.size + column
        # Points are mostly listed in order, which tells without sorting that none stands twice.
        if not np.all(np.diff(places) > 0) and not np.all(np.diff(np.sort(places)) > 0):
            raise InputError(
                "two wall points stand in one place; use the hybrid method, which takes them as they are"
            )
        return cls(x, y, row, column)

    @property
    def shape(self) -> tuple[int, int]:
        """Places along (y, x)."""
        return self.y.size, self.x.size

    @classmethod
    def find(cls, points: FloatArray) -> WallLattice | None:
        """Find the lattice that wall points (n, 3) stand above, if there is one."""
        try:
            return cls.of(points)
        except InputError:
            return None

    @cached_property
    def is_complete(self) -> bool:
        """Whether the points are all places in C order."""
        places = self.row * self.x.size + self.column
        return places.size == self.x.size * self.y.size and bool(np.all(np.diff(places) == 1))

    @cached_property
    def point_numbers(self) -> IndexArray:
        """Number of the wall point in every place, in C order; one too many where none stands."""
        occupants = np.full(self.x.size * self.y.size, self.row.size)
        occupants[self.row * self.x.size + self.column] = np.arange(self.row.size)
        return occupants

    def place(self, samples: AnyArray) -> AnyArray:
        """Put phasors (points, frequencies), or signals (points, t), into their places, shape (y,
        x, ...); places without a point are 0.
        """
        if self.is_complete:
            return samples.reshape(*self.shape, -1)
        values = np.zeros((*self.shape, samples.shape[1]), samples.dtype)
        values[self.row, self.column] = samples
        return values


@dataclass(frozen=True, eq=False)
class PlanarWall:
    """Wall points as a lattice of a plane; places where no point is known stay dark."""

    plane: Plane
    lattice: WallLattice

    @classmethod
    def of(cls, points: FloatArray, evenness: float = EVENNESS_TOLERANCE) -> PlanarWall:
        """Find the lattice that wall points (n, 3) stand on; see `WallLattice.of`."""
        lattice = WallLattice.of(points, evenness)
        plane = Plane(lattice.x, lattice.y, float(points[:, 2].mean()))
        relief = float(np.ptp(points[:, 2]))
        if relief > 2 * evenness * min(plane.steps):
            raise InputError(
                f"the wall is not a plane z = const: it is {relief:.3g} m deep; use the hybrid method, which carries "
                "its signals onto one"
            )
        return cls(plane, lattice)


def _fit_lattice_axis(
    coordinates: FloatArray, name: str, evenness: float
) -> tuple[FloatArray, IndexArray]:
    """Even axis that all coordinates lie on, and the place of each."""
    ordered = np.sort(coordinates)
    gaps = np.diff(ordered)
    # Points of one column differ by far less than columns, even where some columns between are
    # missing.
    apart = gaps[gaps > SAME_COORDINATE_FRACTION * gaps.max(initial=0)]
    require(apart.size != 0, f"the wall's points need at least two different {name}")
    steps = round(float((ordered[-1] - ordered[0]) / np.median(apart)))
    axis = np.linspace(ordered[0], ordered[-1], steps + 1)
    place = np.rint((coordinates - axis[0]) / (axis[1] - axis[0])).astype(np.intp)
    if np.max(np.abs(coordinates - axis[place])) > evenness * (axis[1] - axis[0]):
        raise InputError(
            f"the wall's points are not evenly spaced along {name}; use the hybrid method, which takes them as they are"
        )
    return axis, place
