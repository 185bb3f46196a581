"""From a wall to a plane at the band's frequencies, on the arrays of any library."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, ignore_progress
from nlos.phasor.arrays import ArrayLibrary, arrange_on_lattice
from nlos.phasor.to_depths_kernels import TAPS
from nlos.phasor.transfer import SphericalWaves
from nlos.phasor.wall_kernels import MIN_DISTANCE_M
from nlos.phasor.wall_to_plane import WallBeforePlane, WallToPlanePlan
from nlos.phasor.wall_to_plane_compiled import STRENGTH_POINTS, estimate_strength
from nlos.plane import Plane
from tofclip.arrays import Array, to_numpy
from tofclip.threads import split_blocks

FloatArray = NDArray[np.float64]


class PortablePropagation:
    """``sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|`` on a plane, within a tolerance.

    By Fourier matrices where the compiled loops take Fourier transforms, with the same terms of the
    wall's relief (see `nlos.phasor.wall_to_plane`), else by direct sums. The terms are chosen for the
    spectrum of the first phasors that come; they stay for later ones, so that a sequence of like
    signals is planned once.

    Memory beyond phasors and result: for the terms, some 8 bytes per wall point, term and six
    frequencies (20 MB for 128 x 128 points and 120 frequencies); and four chunks
    (`ArrayLibrary.chunk_bytes`) for what is treated together.

    `waves`: from points; `tolerance`: relative error allowed.
    """

    def __init__(
        self,
        geometry: WallBeforePlane,
        waves: SphericalWaves,
        tolerance: float,
        library: ArrayLibrary,
    ) -> None:
        self.geometry, self.waves, self.tolerance = geometry, waves, tolerance
        self.library = library
        self._propagator: _LowRankPropagator | _DirectPropagator | None = None

    def field(self, phasors: Array, progress: Progress = ignore_progress) -> Array:
        """Return the field (y, x, frequencies) on the plane of phasors (n, frequencies), complex64.

        Progress counts points of the plane times frequencies, all at once.

        `phasors` (n, frequencies). Returns (y, x, frequencies).
        """
        if self._propagator is None:
            self._propagator = self._choose_propagator(phasors)
        field = self._propagator.field(phasors)
        progress(field.shape[0] * field.shape[1] * field.shape[2])
        return field

    def _choose_propagator(self, phasors: Array) -> _LowRankPropagator | _DirectPropagator:
        some = np.arange(0, phasors.shape[0], phasors.shape[0] // STRENGTH_POINTS + 1)
        sample = to_numpy(self.library.xp.take(phasors, self.library.put(some), axis=0))
        plan = WallToPlanePlan.of(
            self.geometry, self.waves, estimate_strength(sample), self.tolerance
        )
        if plan is not None and plan.is_faster_than_direct:
            return _LowRankPropagator(plan, self.library)
        return _DirectPropagator(
            self.geometry.points, self.geometry.plane, self.waves, self.library
        )


@dataclass(frozen=True, eq=False)
class _FrequencyGroup:
    """Some neighbouring frequencies with their terms."""

    frequencies: slice
    point_factors: Array  # (m, n)
    node_factors: Array  # (frequencies, nodes, m)


class _LowRankPropagator:
    """A wall in relief: every term is one flat wall; see `nlos.phasor.wall_to_plane_compiled`."""

    def __init__(self, plan: WallToPlanePlan, library: ArrayLibrary) -> None:
        self.plan, self.library = plan, library

    def field(self, phasors: Array) -> Array:
        xp, shape = self.library.xp, self.plan.plane.shape
        field = self.library.zeros((*shape, phasors.shape[1]))
        for group in self._frequency_groups:
            values = xp.permute_dims(phasors[:, group.frequencies], (1, 0))
            field[:, :, group.frequencies] = xp.permute_dims(
                self._propagate_frequencies(group, values), (1, 2, 0)
            )
        return field

    def _propagate_frequencies(self, group: _FrequencyGroup, values: Array) -> Array:
        """Fields (frequencies, y, x) of phasors (frequencies, n)."""
        xp = self.library.xp
        (from_y, from_x), (to_y, to_x) = self._from_wall, self._to_plane
        on_wall = arrange_on_lattice(
            values[:, None, :] * group.point_factors, self.plan.wall, self.library
        )
        spectra = from_y @ on_wall @ from_x
        node, weights, corner = self._node_interpolation
        factors = weights[0] * xp.take(group.node_factors, node, axis=1)
        for tap in range(1, TAPS):
            factors = factors + weights[tap] * xp.take(group.node_factors, node + tap, axis=1)
        wave_factors = xp.permute_dims(xp.take(factors, corner, axis=1), (0, 2, 1))
        joined = xp.sum(xp.reshape(wave_factors, spectra.shape) * spectra, axis=1)
        return to_y @ (joined * self._wave_mask[group.frequencies, ...]) @ to_x

    @cached_property
    def _frequency_groups(self) -> list[_FrequencyGroup]:
        """All frequencies, in groups that share their functions of depth, and so few that their
        spectra fit.
        """
        low_rank_transfer, put = self.plan.low_rank_transfer, self.library.put
        rows, columns = (2 * reach + 1 for reach in self.plan.max_indices)
        groups = []
        for number, together in enumerate(low_rank_transfer.groups):
            terms = low_rank_transfer.terms(number)
            count = len(terms.point_factors)
            node_factors = (
                terms.wave_factors[..., :count] + 1j * terms.wave_factors[..., count : 2 * count]
            )
            point_factors = put(terms.point_factors)
            for some in split_blocks(
                len(node_factors), max(1, self.library.chunk_bytes // (8 * count * rows * columns))
            ):
                frequencies = slice(together.start + some.start, together.start + some.stop)
                groups.append(_FrequencyGroup(frequencies, point_factors, put(node_factors[some])))
        return groups

    @cached_property
    def _from_wall(self) -> tuple[Array, Array]:
        """Fourier matrices from the wall's rows (waves, rows) and columns (columns, waves)."""
        y, x = (
            np.exp(-2j * np.pi / length * np.outer(np.arange(-reach, reach + 1), np.arange(count)))
            for length, reach, count in zip(
                self.plan.lattice, self.plan.max_indices, self.plan.wall.shape, strict=True
            )
        )
        return self.library.put(y), self.library.put(x.T)

    @cached_property
    def _to_plane(self) -> tuple[Array, Array]:
        """Fourier matrices to the plane's rows (rows, waves) and columns (waves, columns)."""
        y, x = (
            np.exp(2j * np.pi / length * np.outer(np.arange(count), np.arange(-reach, reach + 1)))
            * shift
            for length, reach, count, shift in zip(
                self.plan.plane_lattice,
                self.plan.max_indices,
                self.plan.plane.shape,
                self.plan.phase_shifts,
                strict=True,
            )
        )
        return self.library.put(y), self.library.put(x.T)

    @cached_property
    def _node_interpolation(self) -> tuple[Array, list[Array], Array]:
        """First node and shares of the waves of one quadrant, and which of these every wave
        mirrors.
        """
        rows, columns = self.plan.max_indices
        y, x = (
            spacing * np.arange(n + 1)
            for spacing, n in zip(self.plan.steps, (rows, columns), strict=True)
        )
        # In the corners no wave counts, and no transfer function is known.
        lateral = np.minimum(np.hypot(y[:, np.newaxis], x), self.plan.lateral_limits[-1])
        node, weight = self.plan.low_rank_transfer.transfer.interpolation(lateral.ravel())
        row, column = (np.abs(np.arange(-n, n + 1)) for n in (rows, columns))
        corner = row[:, np.newaxis] * (columns + 1) + column
        weights = [self.library.put(weight[:, tap, np.newaxis]) for tap in range(TAPS)]
        return self.library.put(node), weights, self.library.put(corner.ravel())

    @cached_property
    def _wave_mask(self) -> Array:
        """1 where a wave counts at a frequency, else 0, shape (frequencies, rows, columns)."""
        row, column = (np.abs(np.arange(-n, n + 1)) for n in self.plan.max_indices)
        counted = np.zeros((self.plan.waves.count, row.size, column.size), np.float32)
        for frequency in range(len(counted)):
            tallest = self.plan.max_row_indices(frequency)
            tall = np.where(
                column < tallest.size, tallest[np.minimum(column, tallest.size - 1)], -1
            )
            counted[frequency] = row[:, np.newaxis] <= tall
        return self.library.put(counted)


class _DirectPropagator:
    """Every wall point's spherical wave, summed; see `nlos.phasor.wall_to_plane_compiled`."""

    def __init__(
        self, points: FloatArray, plane: Plane, waves: SphericalWaves, library: ArrayLibrary
    ) -> None:
        self.shape, self.library, self.count = plane.shape, library, waves.count
        targets = plane.points.reshape(-1, 3)
        # Distances are what counts: near the middle, single-precision coordinates have most digits.
        middle = targets.mean(axis=0)
        self._targets, self._sources = (
            library.put((ends - middle).T) for ends in (targets, points)
        )
        # Products of few coarse and few fine waves make up all frequencies: exponentials cost more
        # than products.
        fine = int(np.ceil(np.sqrt(waves.count)))
        coarse = -(-waves.count // fine)
        self._coarse = library.put(
            (waves.first + waves.step * fine * np.arange(coarse)) / (2 * np.pi)
        )
        self._fine = library.put(waves.step * np.arange(fine) / (2 * np.pi))

    def field(self, phasors: Array) -> Array:
        """Return the field (y, x, frequencies) of phasors (n, frequencies)."""
        xp, sources = self.library.xp, phasors.shape[0]
        coarse, fine = self._coarse.shape[0], self._fine.shape[0]
        missing = self.library.zeros((sources, coarse * fine - self.count))
        padded = xp.reshape(xp.concat([phasors, missing], axis=1), (sources, coarse, fine))
        targets = self._targets.shape[1]
        field = self.library.zeros((targets, coarse * fine))
        for some in split_blocks(
            targets, max(1, self.library.chunk_bytes // (8 * sources * coarse * fine))
        ):
            field[some, :] = xp.reshape(self._sum_waves(some, padded), (-1, coarse * fine))
        return xp.reshape(field[:, : self.count], (*self.shape, self.count))

    def _sum_waves(self, some: slice, phasors: Array) -> Array:
        """Field (targets, coarse, fine) at some targets."""
        xp = self.library.xp
        across = xp.sum((self._targets[:, some, None] - self._sources[:, None, :]) ** 2, axis=0)
        distance = xp.sqrt(xp.clip(across, MIN_DISTANCE_M**2, None))[:, :, None]
        coarse, fine = (
            self.library.exp_turns(distance * turns) for turns in (self._coarse, self._fine)
        )
        waves = (coarse / distance)[:, :, :, None] * fine[:, :, None, :]
        return xp.sum(waves * phasors, axis=1)
