"""Plane waves carried to every depth by compiled loops, where they meet the laser's wave.

Waves come in groups of a size that vector instructions like. The laser's wave on a depth plane is a
short sum over its frequencies' common part, so that few inverse transforms per depth replace one
per frequency; these leave out what is 0 or unwanted.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from nlos.kernels import add_illuminated_terms, add_with_carrier
from nlos.method import Progress, ignore_progress
from nlos.phasor.depth_steps import (
    AxialSpectrum,
    DepthInterpolation,
    DiffractionPlan,
    Illumination,
    PlaneWaves,
    build_constant_illumination,
    choose_depths,
    split_illumination,
)
from nlos.phasor.fourier import FourierPlan, allocate_zeros, plan_transform
from nlos.phasor.to_depths_kernels import (
    FREQUENCY_STEPS,
    LANES,
    MIRROR_IMAGES,
    TAPS,
    assemble_groups,
    propagate_spectrum,
    scatter_terms,
    transpose,
)
from nlos.phasor.transfer import VECTOR_LENGTH, TransferFunction
from nlos.plane import Plane
from tofclip.arrays import ComplexArray, Float32Array, FloatArray, IntArray
from tofclip.threads import limit_blas_threads, map_parallel, run_blocks, split_blocks

FREQUENCIES_PER_BLOCK = 4


class Interpolation(NamedTuple):
    """How every group finds a transfer function between its nodes."""

    begin: IntArray  # (groups,), first node
    # (groups + 1,), where a group's weights begin: a row of `weights` for each node
    offset: IntArray
    weights: Float32Array  # (some, LANES)


class WaveGroups:
    """Plane waves in groups of `LANES` neighbours in lateral wavenumber without negative indices,
    with their `MIRROR_IMAGES` images in the axes; repeated ones have a fraction of 0.
    """

    def __init__(self, waves: PlaneWaves) -> None:
        self.waves = waves
        row, column, lateral = waves.sort(signed=False)
        self._count = row.size
        places = np.arange(self._count + -self._count % LANES).reshape(-1, LANES)
        filled = np.minimum(places, self._count - 1)
        # Of the waves without a negative index, (groups, LANES).
        row, column, self._lateral = row[filled], column[filled], lateral[filled]
        self._row, self._column = row, column
        # Indices of all, and whether a wave stands there first, (groups, MIRRORED, LANES).
        rows = np.stack([row, -row, row, -row], axis=1)
        self.indices = rows, np.stack([column, column, -column, -column], axis=1)
        once = places < self._count
        self.is_distinct = np.stack(
            [once, once & (row > 0), once & (column > 0), once & (row > 0) & (column > 0)], axis=1
        )
        # Zeros before the lowest frequency that make their number a multiple of `FREQUENCY_STEPS`.
        self.leading_zeros = -waves.lateral_limits.size % FREQUENCY_STEPS
        # Where every group's frequencies begin, zeros included, in whole steps of the kernel.
        frequency = np.searchsorted(waves.lateral_limits, self._lateral[:, 0]) + self.leading_zeros
        self.first_frequency: IntArray = frequency // FREQUENCY_STEPS * FREQUENCY_STEPS
        # Of the real and imaginary parts of all waves.
        self.shape = (len(row), 2, MIRROR_IMAGES, LANES)

    def interpolation(self, transfer: TransferFunction) -> Interpolation:
        """Find the groups between the nodes of a transfer function."""
        lateral = self._lateral
        node, weight = (
            found.reshape(*lateral.shape, -1) for found in transfer.interpolation(lateral.ravel())
        )
        begin, end = node.min(axis=(1, 2)), node.max(axis=(1, 2)) + TAPS
        offset = np.concatenate([[0], np.cumsum(end - begin)])
        shares = np.zeros((offset[-1], LANES), np.float32)
        place = (offset[:-1] - begin)[:, np.newaxis, np.newaxis] + node + np.arange(TAPS)
        shares[place, np.arange(LANES)[:, np.newaxis]] = weight
        return Interpolation(begin, offset, shares)

    def to_plane_waves(
        self, values: ComplexArray, plane: Plane, origin: tuple[float, float]
    ) -> Float32Array:
        """Return ``sum_p values(p) * exp(-1j * q (r_p - origin)) / area`` of every wave q, 0 beyond
        their limits, of values (y, x, frequencies): (groups, ahead + frequencies, 2, MIRRORED,
        LANES). By matrix products: the plane's spacing need not fit the lattice.
        """
        waves, count, row, column = self.waves, values.shape[-1], self._row, self._column
        weight = (self.is_distinct / np.prod(waves.period)).astype(np.float32)
        lateral = self._lateral.ravel()[: self._count]
        lanes = np.searchsorted(lateral, waves.lateral_limits, side="right")
        y, x = (
            _AxisTransform.of(axis, start, 2 * np.pi / side, reach)
            for axis, start, side, reach in zip(
                (plane.y, plane.x), origin, waves.period, waves.max_indices, strict=True
            )
        )
        shape = (len(row), self.leading_zeros + count, 2, MIRROR_IMAGES, LANES)
        spectrum = np.zeros(shape, np.float32)

        def analyse(some: slice) -> None:
            widest = float(waves.lateral_limits[some][-1])
            high, wide = (reach + 1 for reach in waves.max_indices_within(widest))
            lines = y.project(np.ascontiguousarray(np.swapaxes(values[..., some], 1, 2)), high)
            parts = [
                part
                for line in lines
                for part in x.project(np.ascontiguousarray(np.swapaxes(line, 0, 2)), wide)
            ]
            at = self.leading_zeros + some.start
            assemble_groups(
                np.stack(parts), row, column, y.turns, x.turns, weight, lanes[some], at, spectrum
            )

        run_blocks(analyse, count, size=FREQUENCIES_PER_BLOCK)
        return spectrum


@dataclass(frozen=True, eq=False)
class _AxisTransform:
    """Waves along an axis of evenly spaced points, about its middle: real, and half as many points."""

    cosines: Float32Array  # (waves, half the points)
    sines: Float32Array  # (waves, half the points)
    turns: ComplexArray  # (waves,), waves at the middle

    @classmethod
    def of(cls, axis: FloatArray, origin: float, step: float, reach: int) -> _AxisTransform:
        """Return the transform of an even axis, m, for waves of index 0 to `reach`, phase 0 at
        `origin`; `step`: lateral wavenumber of index 1, rad/m.
        """
        numbers = step * np.arange(reach + 1)
        half = (axis.size + 1) // 2
        # mirror points' waves about the middle are conjugate: half the points suffice
        phases = np.outer(numbers, (axis[::-1] - axis)[:half] / 2)
        turns = np.exp(-1j * numbers * ((axis[0] + axis[-1]) / 2 - origin))
        cosines, sines = (wave(phases).astype(np.float32) for wave in (np.cos, np.sin))
        return cls(cosines, sines, turns.astype(np.complex64))

    def project(self, values: ComplexArray, count: int) -> list[ComplexArray]:
        """Sums of values (points, ...) with the first cosines, and sines, (count, ...)."""
        half = self.cosines.shape[1]
        before, after = values[:half], values[::-1][:half]
        even, odd = after + before, after - before
        if len(values) % 2:
            # the middle point of an odd number is its own mirror image and counts once
            even[-1] = before[-1]
        return [
            (waves[:count] @ part.reshape(half, -1).view(np.float32))
            .view(np.complex64)
            .reshape(count, *values.shape[1:])
            for waves, part in ((self.cosines, even), (self.sines, odd))
        ]


# Spectra that are transformed at a time: they stay in a core's second cache, and calls stay few.
CACHE_BYTES = 1 << 19
# Operations of a matrix product that take as long as one of a pruned Fourier transform; measured.
PRODUCT_SPEEDUP = 3


WaveIndices = tuple[IntArray, IntArray]
"""Of plane waves along y and x, in arrays of one shape; these reach as far below 0 as above."""


def choose_inverse(
    waves: WaveIndices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int
) -> InverseProduct | InverseTransform:
    """Choose the quicker way for voxels `wanted` from the origin on: few of a long period by matrix
    products, and where the `lattice`'s period is no whole number of them; else by Fourier
    transforms. `terms`: most spectra.
    """
    rows, columns = (2 * int(np.max(index)) + 1 for index in waves)
    high, wide = (int(length) for length in lattice)
    if (high, wide) != lattice:
        return InverseProduct(waves, lattice, wanted, terms)
    # real operations: 8 of a complex product and sum, 5 n log2 n of a Fourier transform
    products = 8 * columns * wanted[0] * (rows + wanted[1])
    transforms = 5 * (
        columns * lattice[0] * np.log2(lattice[0] + 1)
        + wanted[0] * lattice[1] * np.log2(lattice[1] + 1)
    )
    if products < PRODUCT_SPEEDUP * transforms:
        return InverseProduct(waves, lattice, wanted, terms)
    return InverseTransform(waves, (high, wide), wanted, terms)


class InverseProduct:
    """Inverse transforms of several spectra as two matrix products each; see `InverseTransform`."""

    def __init__(
        self, waves: WaveIndices, lattice: tuple[float, float], wanted: tuple[int, int], terms: int
    ) -> None:
        reach = rows, columns = tuple(int(np.max(index)) for index in waves)
        self._shape = (2 * columns + 1, 2 * rows + 1)
        self.spare = self._shape[0] * self._shape[1]
        self.cell_indices = (waves[1] + columns) * self._shape[1] + waves[0] + rows
        self.carrier = np.ones(wanted[1], np.complex64)
        self.spectra = np.zeros((_count_per_batch(self.spare, terms), self.spare + 1), np.complex64)
        self.images = np.empty((terms, *wanted), np.complex64)
        self._along_y, self._along_x = (
            np.exp(
                2j * np.pi / length * np.outer(np.arange(-reach, reach + 1), np.arange(count))
            ).astype(np.complex64)
            for reach, length, count in zip(reach, lattice, wanted, strict=True)
        )

    def transform(self, terms: slice) -> None:
        """Turn the first spectra into the images of these terms."""
        for spectrum, image in zip(self.spectra, self.images[terms], strict=False):
            # the transform is separable: y first, for every index along x
            half = spectrum[: self.spare].reshape(self._shape) @ self._along_y
            np.matmul(half.T, self._along_x, out=image)


class InverseTransform:
    """Inverse transforms of spectra (n, cells) by pruned Fourier transforms; not to be shared
    between threads. Waves go to `cell_indices`, `spare` belonging to none; `images` (terms, y, x)
    have still to be multiplied by `carrier`, by column. Waves too fine for the voxels are folded,
    as these see them.
    """

    def __init__(
        self, waves: WaveIndices, lattice: tuple[int, int], wanted: tuple[int, int], terms: int
    ) -> None:
        self._high, self._wide = high, wide = lattice
        reach = int(np.max(waves[1]))
        columns = min(2 * reach + 1, wide)
        # Unfolded columns are shifted so that none is negative; `carrier` takes the shift back.
        shift = reach if 2 * reach + 1 < wide else 0
        self.spare = columns * _pad_to_vector(high)
        tall = _pad_to_vector(high)
        self.cell_indices: IntArray = (waves[1] + shift) % wide * tall + waves[0] % high
        carrier = np.exp(-2j * np.pi * shift / wide * np.arange(wanted[1]))
        self.carrier = carrier.astype(np.complex64)
        some = _count_per_batch(self.spare, terms)
        self.spectra: ComplexArray = allocate_zeros((some, self.spare + VECTOR_LENGTH))
        cells = self.spectra[:, : self.spare].reshape(some, columns, tall)
        self._columns = cells[..., :high]
        self._lines = allocate_zeros((some, columns, tall))[..., :high]
        self._middle = allocate_zeros((some, wanted[0], _pad_to_vector(wide)))[..., :wide]
        self._rows = allocate_zeros((terms, wanted[0], _pad_to_vector(wide)))[..., :wide]
        self.images: ComplexArray = self._rows[..., : wanted[1]]
        self._plans: dict[int, tuple[FourierPlan, FourierPlan]] = {}

    def transform(self, terms: slice) -> None:
        """Turn the first spectra into the images of these terms."""
        count = terms.stop - terms.start
        along_y, along_x = self._get_plans(count)
        along_y.execute()
        # only the rows that voxels lie in are transformed along x
        wanted, columns = self._middle.shape[1], self._lines.shape[1]
        lines, middles = self._lines.view(np.float64), self._middle.view(np.float64)
        for line, middle in zip(lines[:count], middles, strict=False):
            transpose(line[:, :wanted], middle[:, :columns])
        along_x.update_arrays(self._middle[:count], self._rows[terms])
        along_x.execute()

    def _get_plans(self, count: int) -> tuple[FourierPlan, FourierPlan]:
        if count not in self._plans:
            arrays = (self._columns, self._lines), (self._middle, self._rows)
            y, x = (
                plan_transform(source[:count], target[:count], axis=2, inverse=True)
                for source, target in arrays
            )
            self._plans[count] = y, x
        return self._plans[count]


def _count_per_batch(cells: int, terms: int) -> int:
    # spectra that stay in cache between the two transforms
    return max(1, min(terms, CACHE_BYTES // (8 * cells)))


def _pad_to_vector(count: int) -> int:
    return -(-count // VECTOR_LENGTH) * VECTOR_LENGTH


# Depths that a group of plane waves is propagated to while its spectrum is in cache.
PLANES_PER_BLOCK = 2
# Half the range of distances is rounded up to a power of the first, at least the second, m.
HALF_RANGE_RATIO, MIN_HALF_RANGE_M = 1.05, 1e-3
# Of the error allowed, what splitting the illumination may take.
ILLUMINATION_ERROR_FRACTION = 0.25
# Of the error allowed, what interpolation between depths may take.
DEPTH_ERROR_FRACTION = 0.35


@dataclass(frozen=True, eq=False)
class LaserSource:
    """What shines on the hidden scene while the wall is watched."""

    # (3,), A spot, m; None where its way is part of the field already (confocal)
    laser: FloatArray | None
    wavenumbers: FloatArray  # (frequencies,), rad/m
    # (frequencies,), share of each frequency in the pulse; decides what may be neglected
    strength: FloatArray
    # illuminations split so far, which spots at other places share
    splits: dict[tuple[float, float], Illumination] = field(default_factory=dict, repr=False)

    @cached_property
    def centre_wavenumber(self) -> float:
        """Wavenumber about which the illumination is expanded; 0 without one."""
        if self.laser is None:
            return 0.0
        return float(np.average(self.wavenumbers, weights=self.strength**2))

    @property
    def position(self) -> FloatArray:
        """The spot (3,), m; anything without one, since its wavenumber is 0."""
        return np.zeros(3) if self.laser is None else self.laser

    def choose_depths(self, plan: DiffractionPlan) -> DepthInterpolation:
        """Choose which depths are computed, and how the others follow but for the carrier."""
        cosines = (0.0, 0.0)
        if self.laser is not None:
            # beyond the spot all light goes forward
            cosines = (0.0 if plan.grid.z[0] >= self.laser[2] else -1.0, 1.0)
        waves = plan.waves.wavenumbers, self.strength, self.centre_wavenumber
        spectrum = AxialSpectrum.of(*waves, cosines)
        return choose_depths(plan.grid.z, spectrum, DEPTH_ERROR_FRACTION * plan.tolerance)

    def illuminate_plane(self, plan: DiffractionPlan, depth: float) -> Illumination:
        """Split the illumination of the plane at one depth, m."""
        if self.laser is None:
            return build_constant_illumination(self.wavenumbers.size)
        y, x = (
            (np.clip(spot, axis[0], axis[-1]) - spot, max(spot - axis[0], axis[-1] - spot))
            for axis, spot in ((plan.grid.y, self.laser[1]), (plan.grid.x, self.laser[0]))
        )
        span = np.sqrt(np.array(y) ** 2 + np.array(x) ** 2 + (depth - self.laser[2]) ** 2)
        # Rounded up to a geometric series, so that one split serves many depths.
        half = HALF_RANGE_RATIO ** np.ceil(
            np.log(max(np.ptp(span) / 2, MIN_HALF_RANGE_M)) / np.log(HALF_RANGE_RATIO)
        )
        key = float(half), ILLUMINATION_ERROR_FRACTION * plan.tolerance
        light = self.splits.get(key)
        if light is None:
            offsets = self.wavenumbers - self.centre_wavenumber
            light = split_illumination(offsets, self.strength, *key)
            light = self.splits.setdefault(key, light)  # one step, as threads share the dictionary
        return replace(light, span=span.mean() + light.span)


class CompiledDiffraction:
    """Fields on one plane carried to all depths of a grid, where they meet the laser's wave.
    Illuminations, transforms and each thread's memory stay for the next field.

    Liu, Bauer, Velten, Nat. Commun. 11, 1645 (2020); the illumination is split per depth, so that
    few inverse transforms replace one per frequency.
    """

    def __init__(self, plan: DiffractionPlan, source: LaserSource) -> None:
        self.plan, self.source = plan, source
        self.groups = WaveGroups(plan.plane_waves)
        self._spare: list[_Workspace] = []

    def for_laser(self, laser: FloatArray | None) -> CompiledDiffraction:
        """Return the same for the light of another spot; both share tables and threads' memory."""
        _ = self._interpolation
        other = copy.copy(self)
        other.source = replace(self.source, laser=laser)
        for computed in ("_depths", "_lights"):
            other.__dict__.pop(computed, None)
        return other

    def add(
        self,
        values: ComplexArray,
        total: ComplexArray,
        progress: Progress = ignore_progress,
    ) -> None:
        """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r of `total` (z, y, x), of
        the field S_k (y, x, frequencies) on the plane; progress counts voxels.
        """
        plan = self.plan
        with limit_blas_threads():
            origin = float(plan.grid.y[0]), float(plan.grid.x[0])
            spectrum = self.groups.to_plane_waves(values, plan.plane, origin)
            # What threads share is made before they start.
            plan.transfer.tabulate()
            lights, interpolation = self._lights, self._interpolation
            nodes, blocks = self._depths.nodes, self._depths.blocks
            computed = np.zeros((nodes.size, *total.shape[1:]), np.complex64) if blocks else total
            shares = len(total) * np.arange(len(lights) + 1) // len(lights)

            def process_block(planes: slice) -> None:
                workspace = self._take_workspace(interpolation)
                depths = plan.grid.z[nodes[planes]]
                workspace.image(
                    spectrum, self.source, lights[planes], depths, computed[planes], bool(blocks)
                )
                self._spare.append(workspace)
                progress(int(shares[planes.stop] - shares[planes.start]) * total[0].size)

            def interpolate(some: slice) -> None:
                block, grid, source = blocks[some.start], plan.grid, self.source
                known, part = computed[block.nodes], total[block.depths]
                values = (block.weights @ known.reshape(len(known), -1)).reshape(part.shape)
                axes = grid.x, grid.y, grid.z[block.depths]
                add_with_carrier(values, *axes, source.position, source.centre_wavenumber, part)

            run_blocks(process_block, len(lights), size=PLANES_PER_BLOCK)
            run_blocks(interpolate, len(blocks), size=1)

    @cached_property
    def _depths(self) -> DepthInterpolation:
        """Which depths are computed, and how the others follow."""
        return self.source.choose_depths(self.plan)

    @cached_property
    def _lights(self) -> list[Illumination]:
        """The illumination of every computed depth."""
        depths = self.plan.grid.z[self._depths.nodes].tolist()
        split = partial(self.source.illuminate_plane, self.plan)
        return list(map_parallel(split, depths, len(depths)))

    @cached_property
    def _interpolation(self) -> Interpolation:
        return self.groups.interpolation(self.plan.transfer)

    def _take_workspace(self, interpolation: Interpolation) -> _Workspace:
        """Return a workspace that is not in use and holds all terms, or a new one."""
        max_terms = max(light.coefficients.shape[1] for light in self._lights)
        if self._spare:
            found = self._spare.pop()
            if found.max_terms >= max_terms:
                return found
        return _Workspace(self.plan, self.groups, interpolation, max_terms)


class _Workspace:
    """One thread's memory, and what it does there."""

    def __init__(
        self, plan: DiffractionPlan, groups: WaveGroups, interpolation: Interpolation, terms: int
    ) -> None:
        self.plan, self.groups, self.interpolation = plan, groups, interpolation
        self.max_terms = terms
        self.inverse = choose_inverse(groups.indices, plan.lattice, plan.grid.shape[1:], terms)
        # repeated waves are sent to a spare cell that nothing reads
        cells, distinct = self.inverse.cell_indices, groups.is_distinct
        self.cell_indices = np.where(distinct, cells, self.inverse.spare)
        # where several waves fall into one cell they have to be added, not written
        self.folded = bool(np.bincount(cells[distinct]).max() > 1)
        size = PLANES_PER_BLOCK * (terms + 1) * int(np.prod(groups.shape))
        self._term_buffer = np.empty(size, np.float32)

    def image(
        self,
        spectrum: Float32Array,
        source: LaserSource,
        lights: list[Illumination],
        depths: FloatArray,
        total: ComplexArray,
        without_carrier: bool,
    ) -> None:
        """Add depth planes to `total` (z, y, x), of plane waves, with or without the carrier."""
        wavenumber = 0.0 if without_carrier else source.centre_wavenumber
        grid, inverse = self.plan.grid, self.inverse
        carried = self._propagate_terms(spectrum, source, lights, depths)
        for terms, light, depth, image in zip(carried, lights, depths, total, strict=True):
            count = light.coefficients.shape[1]
            for some in split_blocks(count, len(inverse.spectra)):
                scatter_terms(terms[some], self.cell_indices, self.folded, inverse.spectra)
                inverse.transform(some)
            place = grid.x, grid.y, depth, source.position, wavenumber
            functions = np.ascontiguousarray(light.table.T), light.span
            add_illuminated_terms(
                inverse.images[:count], light.even, *place, *functions, inverse.carrier, image
            )

    def _propagate_terms(
        self,
        spectrum: Float32Array,
        source: LaserSource,
        lights: list[Illumination],
        depths: FloatArray,
    ) -> Float32Array:
        """Return the plane waves of all terms, (depths, m, groups, 2, MIRRORED, LANES)."""
        zeros, between = self.groups.leading_zeros, self.interpolation
        max_terms = max(light.coefficients.shape[1] for light in lights)
        # The compiled loop takes two terms at a time.
        padded = (len(lights), max_terms + max_terms % 2, spectrum.shape[1])
        coefficients, nodes = np.zeros(padded, np.float32), []
        for own, light, depth in zip(coefficients, lights, depths, strict=True):
            own[: light.coefficients.shape[1], zeros:] = light.coefficients.T
            delay = np.array([light.span.mean(), source.centre_wavenumber])
            nodes.append(self.plan.transfer.evaluate(depth - self.plan.plane.z, delay, zeros))
        shape = (*coefficients.shape[:2], *self.groups.shape)
        terms = self._term_buffer[: int(np.prod(shape))].reshape(shape)
        propagate_spectrum(
            spectrum, self.groups.first_frequency, np.stack(nodes), *between, coefficients, terms
        )
        return terms
