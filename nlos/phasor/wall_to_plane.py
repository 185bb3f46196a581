"""From a wall in relief to a plane by Fourier transforms: lattices and plane waves, and how waves
depend on the depth of the wall point that they come from, as short sums of products.

A wall whose points stand above a lattice is transformed on it; scattered points by transforms that
ask for no lattice, if finufft is installed. Where direct sums are faster there is no plan.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nlos.phasor.fourier import FourierPlan, allocate_zeros, plan_transform
from nlos.phasor.to_depths_kernels import transpose
from nlos.phasor.transfer import (
    Offsets,
    SphericalWaves,
    TransferFunction,
    Window,
    choose_oversampling,
    find_fast_length,
    find_lateral_limits,
    find_min_periods,
)
from nlos.phasor.wall_kernels import VECTOR_FLOATS
from nlos.plane import Plane, StraightPaths, WallLattice, axis_step
from tofclip.arrays import ComplexArray, Float32Array, FloatArray, IntArray
from tofclip.threads import map_parallel, run_blocks, split_blocks

if TYPE_CHECKING:
    import finufft


# Neighbouring frequencies that share their functions of depth.
FREQUENCIES_PER_GROUP = 6
# Of the error allowed, what interpolation between depths and leaving out terms may take: on average,
# which photons on a curved wall of many points exceed up to six times.
INTERPOLATION_ERROR_FRACTION, TERMS_ERROR_FRACTION = 0.2, 0.1
# Depths closer than this are one, m.
MIN_DEPTH_RANGE_M = 1e-5
# Wavenumber along z, relative to the band's highest, about which the waves vary least with depth.
CARRIER_FRACTION = 0.4
# Combinations of depths that hold less than this fraction of the wall points are none.
EIGENVALUE_CUTOFF = 1e-10
# Times the shortest period, that a lattice may be longer to suit both wall and plane.
MAX_PERIOD_RATIO = 1.25
# Points by which the far end of a plane may be off the lattice.
WHOLE_PERIOD_TOLERANCE = 1e-3
# Tolerance down to which Fourier transforms keep it; measured.
MIN_FOURIER_TOLERANCE = 5e-4
# Seconds on one core, roughly: for all transfer functions, and per term, lattice place, and term of
# a direct sum.
PREPARATION_S, TERM_S, LATTICE_POINT_S, DIRECT_TERM_S = 0.02, 2e-5, 3e-9, 2e-10
# The same per term for a scattered wall point and for a plane wave of it.
POINT_S, WAVE_S = 2.5e-8, 9e-9
# Of the error allowed, what weak plane waves that are left out may hold: before voxels, where most
# of it passes beside all of them, or is on the edge of the window, measured with noise; and on a
# plane, which may hold all of it and, beside that, less of the rest than the window.
VOXEL_WAVES_ERROR_FRACTION, PLANE_WAVES_ERROR_FRACTION = 1.5, 0.75


@dataclass(frozen=True, eq=False)
class WallBeforePlane:
    """Points of a wall, and the plane before it that their fields get to."""

    points: FloatArray  # (n, 3), m
    plane: Plane
    lattice: WallLattice | None  # that the points stand above; None where there is none
    # the only ones that the field on the plane is wanted for; by default all of the plane is
    paths: StraightPaths | None = None

    @classmethod
    def of(cls, points: FloatArray, plane: Plane) -> WallBeforePlane:
        """Return any wall before any plane."""
        return cls(points, plane, WallLattice.find(points))


@dataclass(frozen=True, eq=False)
class WallToPlanePlan:
    """Tables with which fields get from the points of a wall to a plane by Fourier transforms."""

    geometry: WallBeforePlane
    # places of the wall's points; of scattered points only where they begin
    wall: WallLattice
    tolerance: float  # relative error allowed
    lattice: tuple[int, int]  # places of the wall in a period along y and x
    plane_lattice: tuple[float, float]  # points of the plane in a period along y and x
    steps: tuple[float, float]  # distance of neighbouring plane waves along y and x, rad/m
    lateral_limits: FloatArray  # (frequencies,), largest that counts at each frequency, rad/m
    max_indices: tuple[int, int]  # of plane waves along y and x
    low_rank_transfer: LowRankTransfer  # from all depths
    # Where waves without negative indices lie among the nodes of the transfer functions: first node
    # (columns, rows) and the weights (columns, rows, taps) of those from it on.
    node_interpolation: tuple[IntArray, Float32Array]

    @property
    def plane(self) -> Plane:
        """Where the field is wanted."""
        return self.geometry.plane

    def analysis(self, terms: int) -> PlaneWaveAnalysis:
        """Return what analyses a field on the wall, up to a number of terms at once; not to be
        shared between threads.
        """
        if self.geometry.lattice is not None:
            return LatticeAnalysis(self.wall, self.lattice, self.max_indices[1], terms)
        origin, points = (self.wall.x[0], self.wall.y[0]), self.geometry.points
        along_x, along_y = (self.steps[1 - i] * (points[:, i] - origin[i]) for i in range(2))
        tall = self.steps[1] / self.steps[0]
        return ScatteredAnalysis(along_y, along_x, tall, ANALYSIS_ERROR_FRACTION * self.tolerance)

    def max_row_indices(self, frequency: int) -> IntArray:
        """Return the largest index along y that counts in every column from 0 on."""
        limit = self.lateral_limits[frequency]
        across = self.steps[1] * np.arange(int(limit / self.steps[1]) + 1)
        room = np.sqrt(np.maximum(limit**2 - across**2, 0))
        return np.asarray(np.minimum(room / self.steps[0], self.max_indices[0]), np.int64)

    def phase_shifts(self) -> tuple[ComplexArray, ComplexArray]:
        """Return plane waves along y and x at the plane's first point, 0 at the wall's; divided by
        the lattice's period.
        """
        starts = (self.plane.y[0] - self.wall.y[0], self.plane.x[0] - self.wall.x[0])
        y, x = (
            step / (2 * np.pi) * np.exp(1j * step * start * np.arange(-reach, reach + 1))
            for step, start, reach in zip(self.steps, starts, self.max_indices, strict=True)
        )
        return y.astype(np.complex64), x.astype(np.complex64)


def plan_transforms(
    geometry: WallBeforePlane,
    waves: SphericalWaves,
    strength: FloatArray,
    tolerance: float,
    scattered: bool = False,
) -> WallToPlanePlan | None:
    """Plan the way from wall points to a plane by Fourier transforms; None where direct sums are
    faster, or needed. `strength` (frequencies,): relative amplitude of each frequency, decides what
    may be neglected; `tolerance`: relative error allowed; `scattered`: whether points may stand
    above no lattice.
    """
    points, plane, paths = geometry.points, geometry.plane, geometry.paths
    wall = geometry.lattice
    if wall is None and scattered:
        wall = _cover_with_lattice(points, plane)
    if wall is None:
        return None
    offsets = Offsets.between(Plane(wall.x, wall.y, 0.0), plane.y, plane.x)
    if paths is not None:
        offsets = offsets.limit(paths.wall_to_plane, paths.rim)
    (high, tall), (wide, broad) = (
        find_common_period(side, axis_step(own), axis_step(other), other.size)
        for side, own, other in zip(
            find_min_periods(offsets, tolerance), (wall.y, wall.x), (plane.y, plane.x), strict=True
        )
    )
    periods = high * axis_step(wall.y), wide * axis_step(wall.x)
    steps = 2 * np.pi / periods[0], 2 * np.pi / periods[1]
    window = Window.within(offsets, periods, tolerance)
    # what fades before the nearest voxels is not wanted on the plane either
    first = plane.z if paths is None else paths.first_depth
    ahead = first - float(points[:, 2].max())
    # So near before a wall more waves that fade count than Fourier transforms are quick at.
    if ahead < axis_step(wall.x) / 2:
        return None
    fraction = PLANE_WAVES_ERROR_FRACTION if paths is None else VOXEL_WAVES_ERROR_FRACTION
    limits = find_lateral_limits(
        waves, window, strength, ahead, fraction * tolerance, fading=paths is None
    )
    rows, columns = (int(limits[-1] / step) for step in steps)
    seconds = TERM_S + LATTICE_POINT_S * max(high * wide, 4 * rows * columns)
    if geometry.lattice is None:
        seconds = TERM_S + POINT_S * len(points) + WAVE_S * 4 * rows * columns
    if not is_faster_than_direct(geometry, waves, tolerance, seconds):
        return None
    distances = plane.z - points[:, 2]
    finest = max(float(distances.min()), axis_step(wall.x) / 2)
    density = choose_oversampling(tolerance)
    transfer = TransferFunction(waves, window, float(limits[-1]), finest, density)
    lateral = np.hypot(
        steps[1] * np.arange(columns + 1)[:, np.newaxis], steps[0] * np.arange(rows + 1)
    )
    # The corners beyond the limit are not looked at; the table ends before them.
    node, weight = transfer.interpolation(np.minimum(lateral, limits[-1]).ravel())
    return WallToPlanePlan(
        geometry,
        wall,
        tolerance,
        (high, wide),
        (tall, broad),
        steps,
        limits,
        (rows, columns),
        LowRankTransfer.of(transfer, distances, limits, strength, tolerance),
        (node.reshape(lateral.shape), weight.reshape(*lateral.shape, -1)),
    )


def is_faster_than_direct(
    geometry: WallBeforePlane, waves: SphericalWaves, tolerance: float, seconds_per_term: float
) -> bool:
    """Whether Fourier transforms lead to the plane faster than a direct sum, and within the
    tolerance.
    """
    relief = float(np.ptp(geometry.points[:, 2]))
    terms = 4 + (waves.first + waves.max_wavenumber) / 2 * relief / (2 * np.pi)
    layers = PREPARATION_S + waves.count * terms * seconds_per_term
    direct = DIRECT_TERM_S * waves.count * len(geometry.points) * np.prod(geometry.plane.shape)
    return tolerance >= MIN_FOURIER_TOLERANCE and bool(layers < direct)


def has_finufft() -> bool:
    """Whether the library for scattered points, finufft, is installed."""
    return importlib.util.find_spec("finufft") is not None


def _cover_with_lattice(points: FloatArray, plane: Plane) -> WallLattice:
    """A lattice in the steps of the plane that reaches as far as scattered points, none of which
    need stand on it.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    counts = np.maximum(2, np.ceil((high - low) / plane.steps[::-1]).astype(int) + 1)
    x, y = (low[i] + plane.steps[1 - i] * np.arange(counts[i]) for i in range(2))
    nowhere = np.zeros(0, np.intp)
    return WallLattice(x, y, nowhere, nowhere)


def find_common_period(side: float, wall: float, plane: float, count: int) -> tuple[int, float]:
    """Return a period of at least `side`, m, in steps of the wall, as many as Fourier transforms like,
    and in steps of the plane; whole numbers of both if there are such, so that transforms lead there
    and back. `wall, plane`: steps, m; `count`: steps of the plane over which the misfit adds up.
    """
    shortest = find_fast_length(side / wall)
    length = shortest
    while length * wall <= MAX_PERIOD_RATIO * side:
        places = length * wall / plane
        if abs(places - round(places)) * count < WHOLE_PERIOD_TOLERANCE * places:
            return length, float(round(places))
        length = find_fast_length(length + 1)
    return shortest, shortest * wall / plane


@dataclass(frozen=True, eq=False)
class LowRankTransfer:
    """The transfer functions from wall points at many distances to one plane.

    They are known at Chebyshev nodes of the distance. The fewest products that make them up at the
    distances that occur, weighted as they occur, come from an eigenvalue problem per group of
    frequencies: about one for each half cycle that the waves differ by over the relief, and one for
    each piece of a wall of flat pieces.
    """

    groups: list[slice]  # frequencies that are treated together
    # (n, nodes, frequencies), as combinations of functions of distance that are orthonormal over
    # the wall's points
    table: ComplexArray
    at_points: ComplexArray  # (n, points), these functions
    combinations: list[ComplexArray]  # (n, m) of every group, of what has to be kept

    @classmethod
    def of(
        cls,
        transfer: TransferFunction,
        distances: FloatArray,
        lateral_limits: FloatArray,
        strength: FloatArray,
        tolerance: float,
    ) -> LowRankTransfer:
        """Split the transfer functions from wall points at some distances (points,) along z, m."""
        groups = list(split_blocks(lateral_limits.size, FREQUENCIES_PER_GROUP))
        error = INTERPOLATION_ERROR_FRACTION * tolerance
        nodes, from_nodes, at_points = _find_distance_basis(
            transfer.waves, distances, strength, error
        )
        samples = np.empty((nodes.size, transfer.nodes.size, lateral_limits.size), np.complex64)
        transfer.tabulate()

        def sample(block: slice) -> None:
            for i in range(block.start, block.stop):
                parts = transfer.evaluate(float(nodes[i]), np.zeros(2))
                samples[i].real, samples[i].imag = parts[:, 0], parts[:, 1]

        run_blocks(sample, len(samples), size=1)
        flat = from_nodes.T @ samples.reshape(len(samples), -1)
        table: ComplexArray = flat.reshape(-1, *samples.shape[1:])
        # Energies need no nodes so close. A ring of lateral wavenumbers holds waves in proportion
        # to its radius.
        every = int(transfer.oversampling)
        lateral = np.maximum(transfer.nodes[::every], 0)[:, np.newaxis]
        weights = np.sqrt(lateral * (lateral <= lateral_limits)) * strength
        coarse = table[:, ::every]

        def decompose(group: slice) -> tuple[FloatArray, ComplexArray]:
            weighted = coarse[..., group] * weights[:, group]
            flat = weighted.reshape(len(weighted), -1)
            # in double precision: of all energy as little as 2.5e-9 may be left out
            values, vectors = np.linalg.eigh(flat.conj() @ flat.T)
            return np.maximum(values, 0), vectors.astype(np.complex64)

        energies = list(map_parallel(decompose, groups, len(groups)))
        ordered = np.sort(np.concatenate([values for values, _ in energies]))
        allowed = (TERMS_ERROR_FRACTION * tolerance) ** 2 * ordered.sum()
        # the weakest term kept: all below it hold the allowed energy, over all groups together
        weakest = ordered[np.searchsorted(np.cumsum(ordered), allowed)]
        kept = [vectors[:, values >= min(weakest, values[-1])] for values, vectors in energies]
        return cls(groups, table, at_points, kept)

    @property
    def term_counts(self) -> list[int]:
        """Number of terms of every group."""
        return [vectors.shape[1] for vectors in self.combinations]

    def terms(self, number: int) -> tuple[Float32Array, ComplexArray]:
        """Return the terms of one group, ``K_k(q, d_p) ~ sum_m over_waves[k, q, m] * over_points[m,
        p]``: factors of waves (frequencies, nodes, n) at the nodes of the transfer functions, all
        real, then all imaginary parts, then 0; and factors of points (m, points).
        """
        kept, table = self.combinations[number], self.table[..., self.groups[number]]
        terms = kept.shape[1]
        wave_factors = (kept.T @ table.reshape(len(table), -1)).reshape(terms, *table.shape[1:]).T
        # Padded to whole vectors.
        padded = -(-2 * terms // VECTOR_FLOATS) * VECTOR_FLOATS
        parts = np.zeros((*wave_factors.shape[:-1], padded), np.float32)
        parts[..., :terms], parts[..., terms : 2 * terms] = wave_factors.real, wave_factors.imag
        return parts, kept.conj().T @ self.at_points


def _find_distance_basis(
    waves: SphericalWaves, distances: FloatArray, strength: FloatArray, error: float
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Distances at which waves are sampled (nodes,), m, and functions of distance, orthonormal over
    the wall's points: from these (nodes, n), and at points (n, points). A wall of few depths has
    few.
    """
    low, high = float(distances.min()), float(distances.max())
    middle, half = (low + high) / 2, (high - low) / 2
    nodes = np.array([middle])
    if half >= MIN_DEPTH_RANGE_M:
        count = count_nodes(waves.wavenumbers, strength, middle, half, error)
        # Chebyshev nodes: interpolation between them is close to the best polynomial's
        nodes = middle + half * np.cos(np.pi * (np.arange(count) + 0.5) / count)
    count = nodes.size
    at_nodes = np.cos(np.outer(np.arange(count), np.pi * (np.arange(count) + 0.5) / count))
    at_nodes *= 2 / count
    at_nodes[0] /= 2
    # Lagrange polynomials of the nodes, at the points' distances
    positions = (distances - middle) / max(half, MIN_DEPTH_RANGE_M)
    weights = np.polynomial.chebyshev.chebvander(positions, count - 1) @ at_nodes
    # orthogonal combinations: distances where no point lies get no term of their own
    values, vectors = np.linalg.eigh(weights.T @ weights / len(weights))
    kept = values > EIGENVALUE_CUTOFF * values[-1]
    root = np.sqrt(values[kept])
    # a carrier wave is taken off, so that less phase is left to interpolate
    carrier = CARRIER_FRACTION * waves.max_wavenumber
    from_nodes = vectors[:, kept] * root * np.exp(-1j * carrier * nodes)[:, np.newaxis]
    at_points = np.ascontiguousarray((weights @ (vectors[:, kept] / root)).T, np.float32)
    turned = at_points * np.exp(1j * carrier * distances).astype(np.complex64)
    return nodes, from_nodes.astype(np.complex64), turned


def count_nodes(
    wavenumbers: FloatArray, strength: FloatArray, middle: float, half: float, error: float
) -> int:
    """Return how many Chebyshev nodes of the distance interpolate waves to a relative error, at
    whatever distances points are.

    Enough for the phase, which runs through ``k * half`` about its middle (Jacobi-Anger expansion),
    and for the fall with distance, which is singular at distance 0.

    `strength` (frequencies,): amplitude of each, of any scale; `middle, half`: middle and half
    width of the range of distances, m; `error`: relative.
    """
    from scipy.special import jv

    carrier = CARRIER_FRACTION * wavenumbers[-1]
    phases = half * np.maximum(carrier, wavenumbers - carrier)
    orders = np.arange(24 + int(1.5 * phases.max()))
    # a coefficient, 2 J_n, that has no node is missing, and nodes take it for another one's
    coefficients = 4 * np.abs(jv(orders, phases[:, np.newaxis]))
    rest = np.cumsum(coefficients[:, ::-1], axis=1)[:, ::-1]
    relative = strength / np.linalg.norm(strength)
    phase = int(np.argmax(np.linalg.norm(rest * relative[:, np.newaxis], axis=0) <= error))
    # 1 / R is singular at R = 0: Chebyshev coefficients fall like exp(-n arccosh(middle / half))
    # (Bernstein ellipse)
    fall = np.arccosh(middle / half)
    return max(phase, int(np.ceil(np.log(1 / error) / fall)) + 1)


# Columns from one plan for Fourier transforms to the next.
COLUMN_STEP = 8


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
        self._spectra: ComplexArray = arrays[3]
        self._along_x = plan_transform(self._points, self._lines, axis=1)
        self._along_y: dict[int, FourierPlan] = {}

    def _count_columns(self, reach: int) -> int:
        """How many columns from index 0 on are transformed; as many before it, unless these are
        all.
        """
        needed = -(-(reach + 1) // COLUMN_STEP) * COLUMN_STEP
        return needed if 2 * needed < self._wide else self._wide

    def spectra(self, values: ComplexArray, weights: ComplexArray, reach: int) -> ComplexArray:
        """Analyse ``values * weights[m]``, values (points,) and weights (terms, points), up to an
        index along x; (terms, columns, rows), both in the order of Fourier transforms.
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
            if self._place is None:
                pair = values.reshape(self._shape), weight.reshape(self._shape)
                np.multiply(*pair, out=self._points[:, : self._shape[1]])
            else:
                flat = np.zeros(self._shape[0] * self._shape[1], np.complex64)
                flat[self._place] = values * weight
                self._points[:, : self._shape[1]] = flat.reshape(self._shape)
            self._along_x.execute()
            for number, end in enumerate(ends):
                turned = middle[number * columns : (number + 1) * columns, :rows]
                # along y in contiguous memory: quicker than a transform with a stride
                transpose(self._lines[:, end].view(np.float64), turned.view(np.float64))
            plan.update_arrays(middle, spectrum)
            plan.execute()
        return spectra

    def _get_plan(self, columns: int) -> FourierPlan:
        if columns not in self._along_y:
            arrays = self._middle[:columns], self._spectra[:columns]
            self._along_y[columns] = plan_transform(*arrays, axis=1)
        return self._along_y[columns]


# Of the error allowed, what the transforms of scattered points may take.
ANALYSIS_ERROR_FRACTION = 0.1
# Of the transforms' own grids; half as slow as the usual 2 for as few points as walls have.
UPSAMPLING = 1.25
# Indices along an axis from one plan to the next: a plan serves several frequencies.
INDEX_STEP = 8


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

    def spectra(self, values: ComplexArray, weights: ComplexArray, reach: int) -> ComplexArray:
        """Analyse ``values * weights[m]`` up to an index along x; see `LatticeAnalysis.spectra`."""
        # whole steps, so that neighbouring frequencies share a plan
        sizes = (
            2 * INDEX_STEP * (int(largest) // INDEX_STEP + 1)
            for largest in (reach + 1, (reach + 1) * self._tall + 1)
        )
        columns, rows = sizes
        spectra: ComplexArray = self._get_plan(len(weights), columns, rows).execute(
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


PlaneWaveAnalysis = LatticeAnalysis | ScatteredAnalysis
