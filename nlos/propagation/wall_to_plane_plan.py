"""What a way from a wall in relief to a plane by Fourier transforms consists of: lattices, plane
waves, and terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import StraightWays
from nlos.plane import Plane, WallLattice, axis_step
from nlos.propagation.analysis import LatticeAnalysis, PlaneWaveAnalysis
from nlos.propagation.low_rank_transfer import LowRankTransfer
from nlos.rsd.transfer import (
    Offsets,
    SphericalWaves,
    TransferFunction,
    Window,
    find_fast_length,
    find_lateral_limits,
    find_min_periods,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_PERIOD_RATIO = 1.25
"""Times the shortest period, that a lattice may be longer to suit both wall and plane."""

WHOLE_PERIOD_TOLERANCE = 1e-3
"""Points by which the far end of a plane may be off the lattice."""

MIN_FOURIER_TOLERANCE = 5e-4
"""Tolerance down to which Fourier transforms keep it; measured."""

PREPARATION_S, TERM_S, LATTICE_POINT_S, DIRECT_TERM_S = 0.02, 2e-5, 3e-9, 2e-10
"""Seconds on one core, roughly: for all transfer functions, and per term, lattice place, and term
of a direct sum.
"""

WAVES_ERROR_FRACTION = 2.0
"""Of the error allowed, what weak plane waves that are left out may hold: most of it passes beside all
voxels, or is on the edge of the window. Measured with noise."""


@dataclass(frozen=True, eq=False)
class WallBeforePlane:
    """Points of a wall, and the plane before it that their fields get to."""

    points: FloatArray  # (n, 3), m
    plane: Plane
    lattice: WallLattice | None  # that the points stand above; None where there is none
    # the only ones that the field on the plane is wanted for; by default all of the plane is
    ways: StraightWays | None = None

    @classmethod
    def of(cls, points: FloatArray, plane: Plane) -> WallBeforePlane:
        """Return any wall before any plane."""
        return cls(points, plane, WallLattice.find(points))


@dataclass(frozen=True, eq=False)
class WallToPlanePlan:
    """How fields get from the points of a wall to a plane before it."""

    geometry: WallBeforePlane
    wall: WallLattice  # places of the wall's points
    waves: SphericalWaves
    # (frequencies,), how strong the field is at each frequency; decides what may be neglected
    strength: FloatArray
    tolerance: float  # relative error allowed

    @classmethod
    def of(
        cls,
        geometry: WallBeforePlane,
        waves: SphericalWaves,
        strength: FloatArray,
        tolerance: float,
    ) -> WallToPlanePlan | None:
        """Return the plan for wall points, or None if they stand above no lattice.

        `strength` (frequencies,): relative amplitude of each frequency; `tolerance`: relative
        error.
        """
        wall = geometry.lattice
        return None if wall is None else cls(geometry, wall, waves, strength, tolerance)

    @property
    def points(self) -> FloatArray:
        """Of the wall (n, 3), m."""
        return self.geometry.points

    @property
    def plane(self) -> Plane:
        """Where the field is wanted."""
        return self.geometry.plane

    @cached_property
    def is_faster_than_direct(self) -> bool:
        """Whether Fourier transforms lead to the plane faster than a direct sum, and within the
        tolerance.
        """
        relief = float(np.ptp(self._plane_distances))
        terms = 4 + (self.waves.first + self.waves.max_wavenumber) / 2 * relief / (2 * np.pi)
        layers = PREPARATION_S + self.waves.count * terms * self.seconds_per_term
        direct = DIRECT_TERM_S * self.waves.count * len(self.points) * np.prod(self.plane.shape)
        return self.tolerance >= MIN_FOURIER_TOLERANCE and bool(layers < direct)

    @property
    def seconds_per_term(self) -> float:
        """Roughly, on one core."""
        return TERM_S + LATTICE_POINT_S * float(np.prod(self.lattice))

    def analysis(self, terms: int) -> PlaneWaveAnalysis:
        """Return what analyses a field on the wall, up to a number of terms at once; not to be
        shared between threads.
        """
        return LatticeAnalysis(self.wall, self.lattice, self.max_indices[1], terms)

    @cached_property
    def _plane_distances(self) -> FloatArray:
        distances: FloatArray = self.plane.z - self.points[:, 2]
        return distances

    @cached_property
    def _offsets(self) -> Offsets:
        wall, ways = Plane(self.wall.x, self.wall.y, 0.0), self.geometry.ways
        offsets = Offsets.between(wall, self.plane.y, self.plane.x)
        return offsets if ways is None else offsets.limit(ways.wall_to_plane, ways.rim)

    @cached_property
    def _lattices(self) -> tuple[tuple[int, float], tuple[int, float]]:
        """Places of the wall and of the plane in a period along y, and along x."""
        y, x = (
            find_common_period(side, axis_step(wall), axis_step(plane), plane.size)
            for side, wall, plane in zip(
                find_min_periods(self._offsets, self.tolerance),
                (self.wall.y, self.wall.x),
                (self.plane.y, self.plane.x),
                strict=True,
            )
        )
        return y, x

    @cached_property
    def lattice(self) -> tuple[int, int]:
        """Places of the wall in a period along y and x."""
        return self._lattices[0][0], self._lattices[1][0]

    @cached_property
    def plane_lattice(self) -> tuple[float, float]:
        """Points of the plane in a period along y and x."""
        return self._lattices[0][1], self._lattices[1][1]

    @cached_property
    def steps(self) -> tuple[float, float]:
        """Distance of neighbouring plane waves along y and x, rad/m."""
        y, x = (
            2 * np.pi / (count * axis_step(axis))
            for count, axis in zip(self.lattice, (self.wall.y, self.wall.x), strict=True)
        )
        return y, x

    @cached_property
    def _window(self) -> Window:
        y, x = (2 * np.pi / spacing for spacing in self.steps)
        return Window.within(self._offsets, (y, x), self.tolerance)

    @cached_property
    def lateral_limits(self) -> FloatArray:
        """Largest lateral wavenumber that counts at each frequency, rad/m."""
        ways = self.geometry.ways
        # what fades before the nearest voxels is not wanted on the plane either
        first = self.plane.z if ways is None else ways.first_depth
        return find_lateral_limits(
            self.waves,
            self._window,
            self.strength,
            first - float(self.points[:, 2].max()),
            WAVES_ERROR_FRACTION * self.tolerance,
        )

    @cached_property
    def max_indices(self) -> tuple[int, int]:
        """Largest indices of plane waves along y and x."""
        y, x = (int(self.lateral_limits[-1] / spacing) for spacing in self.steps)
        return y, x

    @cached_property
    def low_rank_transfer(self) -> LowRankTransfer:
        """The transfer functions from all depths."""
        finest = max(float(self._plane_distances.min()), axis_step(self.wall.x) / 2)
        transfer = TransferFunction(
            self.waves, self._window, float(self.lateral_limits[-1]), finest
        )
        return LowRankTransfer(
            transfer, self._plane_distances, self.lateral_limits, self.strength, self.tolerance
        )

    def max_row_indices(self, frequency: int) -> IntArray:
        """Largest index along y that counts in every column from 0 on."""
        columns = int(self.lateral_limits[frequency] / self.steps[1]) + 1
        rows: IntArray = self._max_row_indices[frequency, :columns]
        return rows

    @cached_property
    def _max_row_indices(self) -> IntArray:
        """Largest index along y that counts, (frequencies, columns)."""
        across = self.steps[1] * np.arange(self.max_indices[1] + 1)
        room = np.sqrt(np.maximum(self.lateral_limits[:, np.newaxis] ** 2 - across**2, 0))
        rows: IntArray = np.minimum(room / self.steps[0], self.max_indices[0]).astype(np.int64)
        return rows

    @cached_property
    def node_interpolation(self) -> tuple[IntArray, NDArray[np.float32]]:
        """Where waves without negative indices lie among the nodes of the transfer functions.

        First node (columns, rows) and the weights (columns, rows, taps) of those from it on.
        """
        y, x = (
            spacing * np.arange(reach + 1)
            for spacing, reach in zip(self.steps, self.max_indices, strict=True)
        )
        lateral = np.hypot(x[:, np.newaxis], y)
        # The corners beyond the limit are not looked at; the table ends before them.
        node, weight = self.low_rank_transfer.transfer.interpolation(
            np.minimum(lateral, self.lateral_limits[-1]).ravel()
        )
        return node.reshape(lateral.shape), weight.reshape(*lateral.shape, -1)

    @cached_property
    def phase_shifts(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Plane waves along y and x at the plane's first point, 0 at the wall's; divided by the
        lattice's period.
        """
        y, x = (
            (
                spacing
                / (2 * np.pi)
                * np.exp(1j * spacing * (plane[0] - wall[0]) * np.arange(-reach, reach + 1))
            ).astype(np.complex64)
            for spacing, plane, wall, reach in zip(
                self.steps,
                (self.plane.y, self.plane.x),
                (self.wall.y, self.wall.x),
                self.max_indices,
                strict=True,
            )
        )
        return y, x


def find_common_period(side: float, wall: float, plane: float, count: int) -> tuple[int, float]:
    """Return a period of at least `side` in steps of the wall and in steps of the plane.

    Whole numbers of both if there are such, so that Fourier transforms lead there and back; else of
    the wall's.

    `side`: shortest period, m; `wall, plane`: steps, m; `count`: steps of the plane over which the
    misfit adds up. Returns `length`: steps of the wall, of a length that Fourier transforms like;
    `places`: steps of the plane.
    """
    shortest = find_fast_length(side / wall)
    length = shortest
    while length * wall <= MAX_PERIOD_RATIO * side:
        places = length * wall / plane
        if abs(places - round(places)) * count < WHOLE_PERIOD_TOLERANCE * places:
            return length, float(round(places))
        length = find_fast_length(length + 1)
    return shortest, shortest * wall / plane
