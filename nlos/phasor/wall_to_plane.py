"""How waves depend on the depth of the wall point that they come from, as short sums of products.

From wall points to the plane waves of a periodic lattice.

What a way from a wall in relief to a plane by Fourier transforms consists of: lattices, plane
waves, and terms.

From scattered wall points to a plane by Fourier transforms that ask for no lattice.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from nlos.phasor.fourier import FourierPlan, allocate_zeros, plan_transform
from nlos.phasor.to_depths_kernels import transpose
from nlos.phasor.transfer import (
    NODE_OVERSAMPLING,
    Offsets,
    SphericalWaves,
    TransferFunction,
    Window,
    find_fast_length,
    find_lateral_limits,
    find_min_periods,
)
from nlos.phasor.wall_kernels import VECTOR_FLOATS
from nlos.plane import Plane, WallLattice, axis_step
from nlos.volume import StraightWays
from tofclip.threads import run_blocks, split_blocks

if TYPE_CHECKING:
    import finufft


FloatArray = NDArray[np.float64]

# Neighbouring frequencies that share their functions of depth.
FREQUENCIES_PER_GROUP = 6
# Of the error allowed, what interpolation between depths and leaving out terms may take; they are
# independent, and their squares add up.
INTERPOLATION_ERROR_FRACTION, TERMS_ERROR_FRACTION = 0.2, 0.6
# Depths closer than this are one, m.
MIN_DEPTH_RANGE_M = 1e-5
# Wavenumber along z, relative to the band's highest, about which the waves vary least with depth.
CARRIER_FRACTION = 0.4
# Combinations of depths that hold less than this fraction of the wall points are none.
EIGENVALUE_CUTOFF = 1e-10


@dataclass(frozen=True, eq=False)
class LowRankTerms:
    """``K_k(q, d_p) ~ sum_m over_waves[k, q, m] * over_points[m, p]`` at some frequencies."""

    # (frequencies, nodes, n), at the nodes of the transfer functions: all real, then all imaginary
    # parts, then 0
    wave_factors: NDArray[np.float32]
    point_factors: NDArray[np.complex64]  # (m, points)


@dataclass(frozen=True, eq=False)
class LowRankTransfer:
    """The transfer functions from wall points at many distances to one plane.

    They are known at Chebyshev nodes of the distance. The fewest products that make them up at the
    distances that occur, weighted as they occur, come from an eigenvalue problem per group of
    frequencies: about one for each half turn that the waves differ by over the relief, and one for
    each piece of a wall of flat pieces.
    """

    transfer: TransferFunction
    distances: FloatArray  # (points,), along z, m
    # (frequencies,), largest lateral wavenumber that counts at each frequency, rad/m
    lateral_limits: FloatArray
    # (frequencies,), how strong the field is at each frequency; decides what may be neglected
    strength: FloatArray
    tolerance: float  # relative error allowed

    @cached_property
    def groups(self) -> list[slice]:
        """Frequencies that are treated together."""
        return list(split_blocks(self.lateral_limits.size, FREQUENCIES_PER_GROUP))

    @cached_property
    def _distance_span(self) -> tuple[float, float]:
        """Middle and half the extent of the distances, m."""
        low, high = float(self.distances.min()), float(self.distances.max())
        return (low + high) / 2, (high - low) / 2

    @cached_property
    def nodes(self) -> FloatArray:
        """Distances at which the transfer functions are sampled, m."""
        middle, half = self._distance_span
        if half < MIN_DEPTH_RANGE_M:
            return np.array([middle])
        count = count_nodes(
            self.transfer.waves.wavenumbers,
            self.strength,
            middle,
            half,
            INTERPOLATION_ERROR_FRACTION * self.tolerance,
        )
        # Chebyshev nodes: interpolation between them is close to the best polynomial's
        return middle + half * np.cos(np.pi * (np.arange(count) + 0.5) / count)

    @property
    def _carrier_wavenumber(self) -> float:
        """Wavenumber along z that is taken out of all waves, rad/m; they have 0 to their own."""
        return CARRIER_FRACTION * self.transfer.waves.max_wavenumber

    @cached_property
    def _distance_basis(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Functions of distance, orthonormal over the wall's points: from nodes (nodes, n), and at
        points (n, points).

        A wall of few depths has few.
        """
        middle, half = self._distance_span
        count = self.nodes.size
        places = (self.distances - middle) / max(half, MIN_DEPTH_RANGE_M)
        at_nodes = np.cos(np.outer(np.arange(count), np.pi * (np.arange(count) + 0.5) / count)) * (
            2 / count
        )
        at_nodes[0] /= 2
        # Lagrange polynomials of the nodes, at the points' distances
        weights = np.polynomial.chebyshev.chebvander(places, count - 1) @ at_nodes
        # orthogonal combinations: distances where no point lies get no term of their own
        values, vectors = np.linalg.eigh(weights.T @ weights / len(weights))
        kept = values > EIGENVALUE_CUTOFF * values[-1]
        root = np.sqrt(values[kept])
        # a carrier wave is taken off, so that less phase is left to interpolate
        from_nodes = (
            vectors[:, kept]
            * root
            * np.exp(-1j * self._carrier_wavenumber * self.nodes)[:, np.newaxis]
        )
        at_points = np.ascontiguousarray((weights @ (vectors[:, kept] / root)).T, np.float32)
        carrier = np.exp(1j * self._carrier_wavenumber * self.distances).astype(np.complex64)
        return from_nodes.astype(np.complex64), at_points * carrier

    @cached_property
    def _transfer_table(self) -> NDArray[np.complex64]:
        """Transfer functions as combinations of `_distance_basis`, shape (n, nodes, frequencies)."""
        samples = np.empty(
            (self.nodes.size, self.transfer.nodes.size, self.lateral_limits.size), np.complex64
        )
        # computed once here, before threads ask for it
        _ = self.transfer.bessel_matrix

        def sample(some: slice) -> None:
            for i in range(some.start, some.stop):
                parts = self.transfer.evaluate(float(self.nodes[i]), np.zeros(2))
                samples[i].real, samples[i].imag = parts[:, 0], parts[:, 1]

        run_blocks(sample, len(samples), size=1)
        flat = self._distance_basis[0].T @ samples.reshape(len(samples), -1)
        table: NDArray[np.complex64] = flat.reshape(-1, *samples.shape[1:])
        return table

    def _compute_energies(self, group: slice) -> tuple[FloatArray, NDArray[np.complex64]]:
        """Energies, increasing, and combinations of `_distance_basis` (n, n) that carry them."""
        # The nodes are closer than energies need.
        lateral = np.maximum(self.transfer.nodes[:: int(NODE_OVERSAMPLING)], 0)[:, np.newaxis]
        # a ring of lateral wavenumbers holds waves in proportion to its radius
        weights = np.sqrt(lateral * (lateral <= self.lateral_limits[group])) * self.strength[group]
        weighted = self._transfer_table[:, :: int(NODE_OVERSAMPLING), group] * weights.astype(
            np.float32
        )
        flat = weighted.reshape(len(weighted), -1)
        values, vectors = np.linalg.eigh(flat.conj() @ flat.T)
        return np.maximum(values, 0).astype(np.float64), vectors

    @cached_property
    def _leading_combinations(self) -> list[NDArray[np.complex64]]:
        """Combinations (n, m) of every group that have to be kept."""
        energies = [(np.empty(0), np.empty((0, 0), np.complex64))] * len(self.groups)
        _ = self._transfer_table

        def decompose(some: slice) -> None:
            for i in range(some.start, some.stop):
                energies[i] = self._compute_energies(self.groups[i])

        run_blocks(decompose, len(self.groups), size=1)
        every = np.sort(np.concatenate([values for values, _ in energies]))
        allowed = (TERMS_ERROR_FRACTION * self.tolerance) ** 2 * every.sum()
        # the weakest term kept: all below it hold the allowed energy, over all groups together
        weakest = every[np.searchsorted(np.cumsum(every), allowed)]
        return [vectors[:, values >= min(weakest, values[-1])] for values, vectors in energies]

    @property
    def term_counts(self) -> list[int]:
        """Number of terms of every group."""
        return [vectors.shape[1] for vectors in self._leading_combinations]

    def terms(self, number: int) -> LowRankTerms:
        """Return the terms of one group."""
        kept, table = (
            self._leading_combinations[number],
            self._transfer_table[..., self.groups[number]],
        )
        terms = kept.shape[1]
        wave_factors = (kept.T @ table.reshape(len(table), -1)).reshape(terms, *table.shape[1:]).T
        # Padded to whole vectors.
        parts = np.zeros(
            (*wave_factors.shape[:-1], -(-2 * terms // VECTOR_FLOATS) * VECTOR_FLOATS), np.float32
        )
        parts[..., :terms], parts[..., terms : 2 * terms] = wave_factors.real, wave_factors.imag
        return LowRankTerms(parts, kept.conj().T @ self._distance_basis[1])


def count_nodes(
    wavenumbers: FloatArray, strength: FloatArray, middle: float, half: float, error: float
) -> int:
    """Return how many Chebyshev nodes of the distance interpolate waves to a relative error.

    Enough for the phase, which runs through ``k * half`` about its middle (Jacobi-Anger expansion),
    and for the fall with distance, which is singular at distance 0.

    `wavenumbers` (frequencies,): rad/m, ascending; `strength` (frequencies,): relative amplitude of
    each frequency; `middle, half`: middle and half width of the range of distances, m; `error`:
    relative.
    """
    from scipy.special import jv

    # Strong frequencies decide, and neighbours hardly differ.
    some = slice(None, None, max(1, wavenumbers.size // 16))
    carrier = CARRIER_FRACTION * wavenumbers[-1]
    phases = half * np.maximum(carrier, wavenumbers[some] - carrier)
    orders = np.arange(4, 24 + int(1.5 * phases.max()))
    rest = 2 * np.abs(jv(orders, phases[:, np.newaxis])) * strength[some, np.newaxis]
    # five beyond the last coefficient that counts: the expansion falls faster than exponentially
    # from there
    phase = int(np.flatnonzero(rest.max(axis=0) > error).max(initial=-1)) + 5
    # 1 / R is singular at R = 0: Chebyshev coefficients fall like exp(-n arccosh(middle / half))
    # (Bernstein ellipse)
    fall = np.arccosh(middle / half)
    return max(phase, int(np.ceil(np.log(1 / error) / fall)) + 1)


# Columns from one plan for Fourier transforms to the next.
COLUMN_STEP = 8


class PlaneWaveAnalysis(Protocol):
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, on one thread."""

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x, (terms, columns, rows); see
        `LatticeAnalysis`.

        `values` (points,); `weights` (terms, points); `reach`: largest index along x. Returns
        (terms, columns, rows).
        """
        ...


class LatticeAnalysis:
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, for points that stand above an
    even lattice.

    Along x only the rows with points in them are transformed, along y only the columns that count.
    Not to be shared between threads.

    `lattice`: places in a period along y and x; at least the wall's; `reach`: largest index along
    x; `terms`: at most.
    """

    def __init__(self, wall: WallLattice, lattice: tuple[int, int], reach: int, terms: int) -> None:
        high, wide = lattice
        self._wide, self._shape = wide, wall.shape
        rows, columns = wall.shape
        self._place = None if wall.is_complete else wall.row * columns + wall.column
        most = min(2 * self._count_columns(reach), wide)
        shapes = ((rows, wide), (rows, wide), (most, high), (terms * most, high))
        arrays = [allocate_zeros(shape) for shape in shapes]
        self._points, self._lines, self._middle = arrays[:3]
        self._spectra: NDArray[np.complex64] = arrays[3]
        self._along_x = plan_transform(self._points, self._lines, axis=1)
        self._along_y: dict[int, FourierPlan] = {}

    def _count_columns(self, reach: int) -> int:
        """How many columns from index 0 on are transformed; as many before it, unless these are
        all.
        """
        needed = -(-(reach + 1) // COLUMN_STEP) * COLUMN_STEP
        return needed if 2 * needed < self._wide else self._wide

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x.

        Arguments and result are those of `PlaneWaveAnalysis.spectra`.
        """
        columns, (rows, wide) = self._count_columns(reach), self._lines.shape
        ends = (
            (slice(0, columns), slice(wide - columns, wide))
            if columns < wide
            else (slice(0, wide),)
        )
        # indices from -reach to reach only: they lie at both ends of a Fourier transform
        count = len(ends) * columns
        plan, middle = self._get_plan(count), self._middle[:count]
        # In one piece, whatever its size: compiled loops are quicker then.
        spectra = self._spectra[: len(weights) * count].reshape(len(weights), count, -1)
        for spectrum, weight in zip(spectra, weights, strict=True):
            self._place_values(values, weight)
            self._along_x.execute()
            for number, end in enumerate(ends):
                turned = middle[number * columns : (number + 1) * columns, :rows]
                # along y in contiguous memory: quicker than a transform with a stride
                transpose(self._lines[:, end].view(np.float64), turned.view(np.float64))
            plan.update_arrays(middle, spectrum)
            plan.execute()
        return spectra

    def _place_values(self, values: NDArray[np.complex64], weight: NDArray[np.complex64]) -> None:
        """Put weighted values into their places."""
        rows, columns = self._shape
        if self._place is None:
            np.multiply(
                values.reshape(self._shape),
                weight.reshape(self._shape),
                out=self._points[:, :columns],
            )
        else:
            flat = np.zeros(rows * columns, np.complex64)
            flat[self._place] = values * weight
            self._points[:, :columns] = flat.reshape(self._shape)

    def _get_plan(self, columns: int) -> FourierPlan:
        if columns not in self._along_y:
            arrays = self._middle[:columns], self._spectra[:columns]
            self._along_y[columns] = plan_transform(*arrays, axis=1)
        return self._along_y[columns]


IntArray = NDArray[np.int64]

# Times the shortest period, that a lattice may be longer to suit both wall and plane.
MAX_PERIOD_RATIO = 1.25
# Points by which the far end of a plane may be off the lattice.
WHOLE_PERIOD_TOLERANCE = 1e-3
# Tolerance down to which Fourier transforms keep it; measured.
MIN_FOURIER_TOLERANCE = 5e-4
# Seconds on one core, roughly: for all transfer functions, and per term, lattice place, and term of
# a direct sum.
PREPARATION_S, TERM_S, LATTICE_POINT_S, DIRECT_TERM_S = 0.02, 2e-5, 3e-9, 2e-10
# Of the error allowed, what weak plane waves that are left out may hold: most of it passes beside
# all voxels, or is on the edge of the window. Measured with noise.
WAVES_ERROR_FRACTION = 2.0


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


# Of the error allowed, what the transforms of scattered points may take.
ANALYSIS_ERROR_FRACTION = 0.1
# Of the transforms' own grids; half as slow as the usual 2 for as few points as walls have.
UPSAMPLING = 1.25
# Indices along an axis from one plan to the next: a plan serves several frequencies.
INDEX_STEP = 8
# Seconds on one core per term, roughly, for a wall point and for a plane wave.
POINT_S, WAVE_S = 2.5e-8, 9e-9


def has_finufft() -> bool:
    """Whether the library for them, finufft, is installed."""
    return importlib.util.find_spec("finufft") is not None


class ScatteredWallToPlanePlan(WallToPlanePlan):
    """How fields get from scattered points to a plane: as from a lattice, but for the first step.

    Parameters are those of `WallToPlanePlan`; no point need stand on the lattice `wall`, which only
    says where they begin and how long a period is.
    """

    @classmethod
    def of(
        cls,
        geometry: WallBeforePlane,
        waves: SphericalWaves,
        strength: FloatArray,
        tolerance: float,
    ) -> WallToPlanePlan:
        """Return the plan for any wall points, in the steps of the plane.

        `strength` (frequencies,): relative amplitude of each frequency; `tolerance`: relative
        error.
        """
        points, plane = geometry.points, geometry.plane
        x, y = (
            low + step * np.arange(max(2, int(np.ceil((high - low) / step)) + 1))
            for low, high, step in zip(
                points[:, :2].min(axis=0), points[:, :2].max(axis=0), plane.steps[::-1], strict=True
            )
        )
        nowhere = np.zeros(0, np.intp)
        return cls(geometry, WallLattice(x, y, nowhere, nowhere), waves, strength, tolerance)

    @property
    def seconds_per_term(self) -> float:
        """Roughly, on one core."""
        y, x = self.max_indices
        return TERM_S + POINT_S * len(self.points) + WAVE_S * 4 * y * x

    def analysis(self, terms: int) -> ScatteredAnalysis:
        """Return what analyses a field on the wall; not to be shared between threads."""
        along_y, along_x = (
            spacing * (self.points[:, axis] - start)
            for spacing, axis, start in zip(
                self.steps, (1, 0), (self.wall.y[0], self.wall.x[0]), strict=True
            )
        )
        return ScatteredAnalysis(
            along_y,
            along_x,
            self.steps[1] / self.steps[0],
            ANALYSIS_ERROR_FRACTION * self.tolerance,
        )


class ScatteredAnalysis:
    """Sums ``sum_p values(p) * exp(-1j * q r_p)`` of several terms, for points anywhere: what
    `LatticeAnalysis` gives.

    `along_y, along_x` (points,): phase of the wave of index 1 along each axis at every point, rad;
    `tall`: indices along y for each one along x; `tolerance`: relative error allowed.

    A. H. Barnett, J. Magland, L. af Klinteberg, "A parallel nonuniform fast Fourier transform
    library based on an 'exponential of semicircle' kernel", SIAM J. Sci. Comput. 41, C479 (2019).
    """

    def __init__(
        self, along_y: FloatArray, along_x: FloatArray, tall: float, tolerance: float
    ) -> None:
        self._places = [
            np.asarray((phase + np.pi) % (2 * np.pi) - np.pi, np.float32)
            for phase in (along_x, along_y)
        ]
        # float32 cannot give what is finer than some of its own steps
        self._tall, self._tolerance = tall, max(tolerance, 10 * float(np.finfo(np.float32).eps))
        self._plans: dict[tuple[int, int, int], finufft.Plan] = {}

    def spectra(
        self, values: NDArray[np.complex64], weights: NDArray[np.complex64], reach: int
    ) -> NDArray[np.complex64]:
        """Analyse ``values * weights[m]`` up to an index along x.

        `values` (points,); `weights` (terms, points). Returns (terms, columns, rows): columns and
        rows in the order of Fourier transforms, first 0 and last -1.
        """
        # whole steps, so that neighbouring frequencies share a plan
        sizes = (
            2 * INDEX_STEP * (int(largest) // INDEX_STEP + 1)
            for largest in (reach + 1, (reach + 1) * self._tall + 1)
        )
        columns, rows = sizes
        spectra: NDArray[np.complex64] = self._get_plan(len(weights), columns, rows).execute(
            values * weights
        )
        return spectra.reshape(len(weights), columns, rows)

    def _get_plan(self, terms: int, columns: int, rows: int) -> finufft.Plan:
        import finufft

        if (terms, columns, rows) not in self._plans:
            options = {
                "isign": -1,
                "dtype": "complex64",
                "nthreads": 1,
                "modeord": 1,
                "upsampfac": UPSAMPLING,
            }
            plan = finufft.Plan(1, (columns, rows), n_trans=terms, eps=self._tolerance, **options)
            plan.setpts(*self._places)
            # Frequencies come in order: only the latest plan will be asked for again.
            self._plans = {(terms, columns, rows): plan}
        return self._plans[terms, columns, rows]
