"""Fields propagated from a plane to a grid's depths at every frequency, each step beside its
adjoint.

The same diffraction as `nlos.phasor.to_depths_compiled`, in plain matrix products of either precision: for
what needs the way back (iterative refinement) or the frequencies apart from the laser's wave
(transient video).

From a plane to all depths on the arrays of any library: the diffraction of
`nlos.phasor.to_depths_compiled` in matrix products.

Between lit voxels and a plane before the wall: the hidden scene's light on its way out, and
back.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from nlos.method import Progress, ignore_progress
from nlos.phasor.arrays import ArrayLibrary, remove_whole_turns
from nlos.phasor.depth_steps import DepthInterpolation, DiffractionPlan, Illumination
from nlos.phasor.to_depths_compiled import LaserSource
from nlos.phasor.to_depths_kernels import TAPS
from tofclip.arrays import Array
from tofclip.threads import run_blocks, split_blocks, thread_count

Array_depths = NDArray[Any]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DepthPropagator:
    """Plane waves between a plane and the depths of a grid.

    Memory: some 20 bytes per plane wave and frequency in single precision, as much again for every
    spectrum.
    """

    plan: DiffractionPlan
    # complex64 or complex128; the transfer functions are those of single precision in either
    dtype: DTypeLike = np.complex64

    def to_waves(self, values: Array_depths) -> Array_depths:
        """Return the plane waves (waves, frequencies) of a field (y, x, frequencies) on the plane."""
        along_y, along_x = self.from_plane
        half = (along_y @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])
        spectrum: Array_depths = (along_x @ half).reshape(-1, values.shape[-1])[self.cell_indices]
        return spectrum * self._wave_weights

    def to_waves_adjoint(self, spectrum: Array_depths) -> Array_depths:
        """Apply the adjoint of `to_waves`: the field (y, x, frequencies) on the plane."""
        along_y, along_x = self.from_plane
        full = np.zeros((len(along_y) * len(along_x), spectrum.shape[1]), self.dtype)
        full[self.cell_indices] = spectrum * self._wave_weights
        half = along_x.conj().T @ full.reshape(len(along_y), len(along_x), -1)
        values: Array_depths = along_y.conj().T @ half.reshape(len(along_y), -1)
        return values.reshape(*self.plan.plane.shape, -1)

    def transfer(self, depth: float, delay: FloatArray) -> Array_depths:
        """Return what every wave (waves, frequencies) is multiplied by on its way to a depth; see
        `Transfer.evaluate`.

        `depth`: z, m; `delay` (2,): path in m and the wavenumber k_0 in rad/m. Returns (waves,
        frequencies).
        """
        nodes = self.plan.transfer.evaluate(depth - self.plan.plane.z, delay)
        matrix, turn = self._node_interpolation
        values = (matrix @ nodes.reshape(len(nodes), -1)).reshape(-1, *nodes.shape[1:])
        return np.asarray(values[:, 0] + 1j * values[:, 1], self.dtype)[turn]

    def to_images(self, terms: Array_depths) -> Array_depths:
        """Return the images (m, y, x) on the voxels of sums (waves, m) of plane waves."""
        along_y, along_x = self.to_voxels
        spectra = np.zeros((terms.shape[1], len(along_y) * len(along_x)), self.dtype)
        spectra[:, self.cell_indices] = terms.T
        images: Array_depths = along_y.T @ spectra.reshape(-1, len(along_y), len(along_x)) @ along_x
        return images

    def to_images_adjoint(self, images: Array_depths) -> Array_depths:
        """Apply the adjoint of `to_images`: plane waves (waves, m) of images (m, y, x)."""
        along_y, along_x = self.to_voxels
        spectra = along_y.conj() @ images @ along_x.conj().T
        terms: Array_depths = spectra.reshape(len(images), -1)[:, self.cell_indices].T
        return terms

    @cached_property
    def _max_indices(self) -> tuple[int, int]:
        """Largest index of a wave along y and x."""
        waves = self.plan.plane_waves
        return int(np.abs(waves.row).max()), int(np.abs(waves.column).max())

    @cached_property
    def cell_indices(self) -> NDArray[np.int64]:
        """Place of every wave in a full rectangle of them."""
        waves, (rows, columns) = self.plan.plane_waves, self._max_indices
        return np.asarray((waves.row + rows) * (2 * columns + 1) + waves.column + columns)

    @cached_property
    def _wave_weights(self) -> Array_depths:
        """1 / area of a period, or 0 where a wave is too fine for a frequency, shape (waves,
        frequencies).
        """
        waves = self.plan.plane_waves
        travels = waves.lateral_limits >= waves.lateral_wavenumbers[:, np.newaxis]
        return (travels / np.prod(waves.period)).astype(np.zeros(0, self.dtype).real.dtype)

    @cached_property
    def from_plane(self) -> tuple[Array_depths, Array_depths]:
        """``exp(-1j * q * r)`` along y and along x of the plane's points."""
        return self._waves_at((self.plan.plane.y, self.plan.plane.x), -1)

    @cached_property
    def to_voxels(self) -> tuple[Array_depths, Array_depths]:
        """``exp(+1j * q * r)`` along y and along x of the voxels."""
        return self._waves_at((self.plan.grid.y, self.plan.grid.x), 1)

    def _waves_at(
        self, axes: tuple[FloatArray, FloatArray], sign: int
    ) -> tuple[Array_depths, Array_depths]:
        origin = (self.plan.grid.y[0], self.plan.grid.x[0])
        y, x = (
            np.exp(
                sign * 2j * np.pi / period * np.outer(np.arange(-reach, reach + 1), axis - start)
            ).astype(self.dtype)
            for axis, start, period, reach in zip(
                axes, origin, self.plan.plane_waves.period, self._max_indices, strict=True
            )
        )
        return y, x

    @cached_property
    def _node_interpolation(self) -> tuple[Any, NDArray[np.intp]]:
        """Matrix from nodes to the different lateral wavenumbers, and which of these every wave
        has.
        """
        from scipy.sparse import csr_array

        lateral, turn = np.unique(self.plan.plane_waves.lateral_wavenumbers, return_inverse=True)
        node, weight = self.plan.transfer.interpolation(lateral)
        index = (node[:, np.newaxis] + np.arange(TAPS)).ravel()
        shape = (lateral.size, len(self.plan.transfer.bessel_matrix))
        return csr_array(
            (weight.ravel(), index, TAPS * np.arange(lateral.size + 1)), shape=shape
        ), turn.ravel()


# Transfer functions and illuminations of all depths are kept for the next field if they take no
# more.
MAX_CACHE_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class _DepthBlock:
    """What some neighbouring depths need, as arrays of the library."""

    indices: slice  # of the computed depths
    transfer: Array  # (z, nodes, frequencies), at the nodes of the lateral wavenumber
    # (z, frequencies, m), of the illumination's functions, 0 where a depth has fewer
    coefficients: Array
    table: Array  # (z * samples, m), the functions themselves
    axial_distance: Array  # (z, 1, 1), distance along z from the laser spot, m
    turns: Array  # (z, 1, 1), what the illumination's carrier turns by over `axial_distance`
    # (z, 1, 1), of `axial_distance` in the table, and samples per metre
    table_position: tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class _BlockBetween:
    """Some neighbouring depths that follow from computed ones, as arrays of the library."""

    depths: slice  # of the wanted depths
    nodes: slice  # of the computed ones
    weights: Array  # (depths, nodes)
    axial_distance: Array  # (depths, 1, 1), as of `_DepthBlock`
    turns: Array  # (depths, 1, 1), as of `_DepthBlock`


class PortableDiffraction:
    """Fields on one plane propagated to all depths of a grid, where they meet the laser's wave.

    Holding one is the cache: the second field of the same geometry needs no planning. Transfer
    functions and illuminations of all depths are kept up to 1 GiB (50 MB for 128 depths, 120
    frequencies and 400 nodes), beyond that made anew for every field. Memory besides: four chunks
    (`ArrayLibrary.chunk_bytes`) for the depths that are treated together, and at least 60 bytes per
    plane wave and frequency.
    """

    def __init__(self, plan: DiffractionPlan, source: LaserSource, library: ArrayLibrary) -> None:
        self.plan, self.source, self.library = plan, source, library
        self._depths = DepthPropagator(plan)
        self._cached_blocks: list[_DepthBlock] = []
        self._keeps_blocks = True

    def for_laser(self, laser: FloatArray | None) -> PortableDiffraction:
        """Return the same for the light of another spot, which plans its depths for every field."""
        other = copy.copy(self)
        other.source = replace(self.source, laser=laser)
        other._cached_blocks, other._keeps_blocks = [], False
        for computed in ("_lateral_distance_squared", "_computed_depths", "_blocks_between"):
            other.__dict__.pop(computed, None)
        return other

    def add(self, values: Array, total: Array, progress: Progress = ignore_progress) -> None:
        """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r; see
        `nlos.phasor.to_depths_compiled.CompiledDiffraction`.

        `values` (y, x, frequencies): on the way's plane; `total` (z, y, x): added to; `progress`:
        called with the number of voxels just done.
        """
        spectrum, between = self._to_spectrum(values), self._blocks_between
        count, wanted = self._computed_depths.nodes.size, total.shape[0]
        computed = self.library.zeros((count, *total.shape[1:])) if between else total
        for planes in self._iterate_blocks():
            field = self._illuminate(planes, self._to_images(planes, spectrum))
            if not between:
                field = field * self._carrier(planes)
            computed[planes.indices, ...] += field
            shares = (wanted * end // count for end in (planes.indices.start, planes.indices.stop))
            progress(-int(np.subtract(*shares)) * total.shape[1] * total.shape[2])
        for some in between:
            known = self.library.xp.reshape(
                computed[some.nodes, ...], (some.nodes.stop - some.nodes.start, -1)
            )
            found = self.library.xp.reshape(some.weights @ known, (-1, *total.shape[1:]))
            total[some.depths, ...] += found * self._carrier(some)

    def _to_spectrum(self, values: Array) -> Array:
        """Plane waves (waves, frequencies) of a field (y, x, frequencies)."""
        xp, (along_y, along_x) = self.library.xp, self._from_plane
        rows, columns, count = values.shape
        half = xp.reshape(
            along_y @ xp.reshape(values, (rows, columns * count)), (-1, columns, count)
        )
        return (
            xp.take(xp.reshape(along_x @ half, (-1, count)), self._cell_indices, axis=0)
            * self._wave_weights
        )

    def _to_images(self, planes: _DepthBlock, spectrum: Array) -> Array:
        """Images (z, m, y, x) of the terms of some depths."""
        xp, (along_y, along_x) = self.library.xp, self._to_voxels
        node, weights, turn = self._node_interpolation
        at_laterals = weights[0] * xp.take(planes.transfer, node, axis=1)
        for tap in range(1, TAPS):
            at_laterals = at_laterals + weights[tap] * xp.take(planes.transfer, node + tap, axis=1)
        terms = (spectrum * xp.take(at_laterals, turn, axis=1)) @ planes.coefficients
        depths, _, count = terms.shape
        # One wave more, which is 0: that is what stands in the corners, where no wave travels.
        padded = xp.concat(
            [xp.permute_dims(terms, (0, 2, 1)), self.library.zeros((depths, count, 1))], axis=2
        )
        spectra = xp.take(padded, self._wave_in_cell, axis=2)
        return (
            along_y
            @ xp.reshape(spectra, (depths, count, along_y.shape[1], along_x.shape[0]))
            @ along_x
        )

    def _illuminate(self, planes: _DepthBlock, images: Array) -> Array:
        """Let the laser's wave, but for its carrier, meet the images: the field (z, y, x)."""
        xp = self.library.xp
        if self.source.laser is None:
            return images[:, 0, :, :]
        longer = self._extra_distance(planes)
        start, per_metre = planes.table_position
        # linear interpolation in the table of illumination functions
        place = xp.clip(start + longer * per_metre, 0.0, None)
        samples = planes.table.shape[0] // planes.axial_distance.shape[0]
        before = xp.clip(xp.astype(place, xp.int64), None, samples - 2)
        weight = (place - xp.astype(before, place.dtype))[:, None, :, :]
        first = before + samples * xp.reshape(
            self._depth_numbers[: planes.axial_distance.shape[0]], (-1, 1, 1)
        )
        here, there = (
            xp.permute_dims(
                xp.reshape(xp.take(planes.table, index, axis=0), (*before.shape, -1)), (0, 3, 1, 2)
            )
            for index in (xp.reshape(first, (-1,)), xp.reshape(first + 1, (-1,)))
        )
        return xp.sum(images * (here + weight * (there - here)), axis=1)

    def _extra_distance(self, planes: _DepthBlock | _BlockBetween) -> Array:
        """How much longer the way from the laser spot is than straight along z, (z, y, x), m:
        shorter than the way, and so with finer digits.
        """
        across, ahead = self._lateral_distance_squared, planes.axial_distance
        return across / (self.library.xp.sqrt(across + ahead**2) + ahead)

    def _carrier(self, planes: _DepthBlock | _BlockBetween) -> Array | float:
        """Carrier of the laser's wave at every voxel, (z, y, x); 1 without one."""
        if self.source.laser is None:
            return 1.0
        wavenumber = self.source.centre_wavenumber / (2 * np.pi)
        return self.library.exp_turns(planes.turns + self._extra_distance(planes) * wavenumber)

    def _iterate_blocks(self) -> Any:
        """Yield the depths, some at a time."""
        if self._cached_blocks:
            yield from self._cached_blocks
            return
        waves, frequencies = self._wave_weights.shape
        size = max(1, self.library.chunk_bytes // (8 * waves * frequencies))
        nodes = self.plan.transfer.nodes.size
        count = self._computed_depths.nodes.size
        size_bytes = 8 * count * nodes * frequencies
        is_cached = self._keeps_blocks and size_bytes <= MAX_CACHE_BYTES
        made = []
        for some in split_blocks(count, size):
            planes = self._plan_block(some)
            if is_cached:
                made.append(planes)
            yield planes
        self._cached_blocks = made

    def _plan_block(self, some: slice) -> _DepthBlock:
        """Plan some depths on this machine's processor, and bring what they need to the library."""
        depths = self.plan.grid.z[self._computed_depths.nodes[some]]
        count = depths.size
        lights: list[Any] = [None] * count
        transfer = np.empty(
            (count, self.plan.transfer.nodes.size, self.plan.waves.count), np.complex64
        )
        _ = self.plan.transfer.bessel_matrix

        def plan(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                light = lights[i] = self.source.illuminate_plane(self.plan, float(depths[i]))
                delay = np.array([light.span.mean(), self.source.centre_wavenumber])
                nodes = self.plan.transfer.evaluate(float(depths[i]) - self.plan.plane.z, delay)
                transfer[i].real, transfer[i].imag = nodes[:, 0], nodes[:, 1]

        run_blocks(plan, count, size=1)
        coefficients, table = _stack_illuminations(lights)
        put = self.library.put
        ahead, turns = self._measure_axially(depths)
        spans = np.array([light.span for light in lights])
        per_metre = (len(lights[0].table) - 1) / np.maximum(spans[:, 1] - spans[:, 0], 1e-12)
        ends = (ahead, turns, (ahead - spans[:, 0]) * per_metre, per_metre)
        far, turned, start, scale = (put(values[:, np.newaxis, np.newaxis]) for values in ends)
        return _DepthBlock(
            some, put(transfer), put(coefficients), put(table), far, turned, (start, scale)
        )

    def _measure_axially(self, depths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances of depths from the laser spot along z, m, and what its carrier turns by over
        them.
        """
        ahead = np.abs(depths - (0.0 if self.source.laser is None else self.source.laser[2]))
        # whole turns are taken off in double precision, before single precision would lose the
        # fraction
        return ahead, remove_whole_turns(self.source.centre_wavenumber / (2 * np.pi) * ahead)

    @cached_property
    def _computed_depths(self) -> DepthInterpolation:
        return self.source.choose_depths(self.plan)

    @cached_property
    def _blocks_between(self) -> list[_BlockBetween]:
        """All wanted depths; empty where every one is computed."""
        put, found = self.library.put, []
        for block in self._computed_depths.blocks:
            ahead, turns = self._measure_axially(self.plan.grid.z[block.depths])
            columns = (put(values[:, np.newaxis, np.newaxis]) for values in (ahead, turns))
            found.append(_BlockBetween(block.depths, block.nodes, put(block.weights), *columns))
        return found

    @cached_property
    def _depth_numbers(self) -> Array:
        return self.library.put(np.arange(self.plan.grid.z.size))

    @cached_property
    def _lateral_distance_squared(self) -> Array:
        """Squared distance of every column of voxels from the laser spot along x and y, (1, y, x),
        m^2.
        """
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        y, x = self.plan.grid.y[:, np.newaxis] - laser[1], self.plan.grid.x - laser[0]
        return self.library.put((y**2 + x**2)[np.newaxis])

    @cached_property
    def _wave_weights(self) -> Array:
        """1 / area of a period, or 0 where a wave is left out at a frequency, shape (waves,
        frequencies).
        """
        waves = self.plan.plane_waves
        counted = waves.lateral_wavenumbers[:, np.newaxis] <= waves.lateral_limits
        return self.library.put(counted.astype(np.float32) / np.float32(np.prod(waves.period)))

    @cached_property
    def _cell_indices(self) -> Array:
        return self.library.put(self._depths.cell_indices)

    @cached_property
    def _wave_in_cell(self) -> Array:
        """Number of the wave in every cell of a rectangle of them; one too many where there is
        none.
        """
        cell = self._depths.cell_indices
        along_y, along_x = self._depths.to_voxels
        wave = np.full(len(along_y) * len(along_x), cell.size)
        wave[cell] = np.arange(cell.size)
        return self.library.put(wave)

    @cached_property
    def _from_plane(self) -> tuple[Array, Array]:
        along_y, along_x = self._depths.from_plane
        return self.library.put(along_y), self.library.put(along_x)

    @cached_property
    def _to_voxels(self) -> tuple[Array, Array]:
        along_y, along_x = self._depths.to_voxels
        return self.library.put(along_y.T), self.library.put(along_x)

    @cached_property
    def _node_interpolation(self) -> tuple[Array, list[Array], Array]:
        """First node of every different lateral wavenumber, the shares of all taps, and which of
        these a wave has.
        """
        lateral, turn = np.unique(self.plan.plane_waves.lateral_wavenumbers, return_inverse=True)
        node, weight = self.plan.transfer.interpolation(lateral)
        weights = [self.library.put(weight[:, tap, np.newaxis]) for tap in range(TAPS)]
        return self.library.put(node), weights, self.library.put(turn.ravel())


def _stack_illuminations(
    lights: list[Illumination],
) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
    """Coefficients (z, frequencies, m) and functions (z * samples, m) of several depths, with 0 for
    missing ones.
    """
    max_terms = max(light.coefficients.shape[1] for light in lights)
    coefficients = np.zeros((len(lights), len(lights[0].coefficients), max_terms), np.complex64)
    table = np.zeros((len(lights), len(lights[0].table), max_terms), np.float32)
    for i, light in enumerate(lights):
        count = light.coefficients.shape[1]
        coefficients[i, :, :count], table[i, :, :count] = light.coefficients, light.table
        # odd functions carry a factor 1j
        coefficients[i, :, light.even : count] *= 1j
    return coefficients, table.reshape(-1, max_terms)


Array_illuminated_depths = NDArray[Any]


class IlluminatedDepthPropagator:
    """Volumes that the laser's wave lights, and their waves on a plane.

    `to_plane` is ``S_k(v) = sum_r h(r) * conj(exp(1j * k * |r_L - r|) * w_k(v, r))`` with w the
    wave that `plan` carries from point v of the plane to voxel r; `to_volume` is its adjoint, real
    since the volume is.

    `dtype`: complex64 or complex128.
    """

    def __init__(self, plan: DiffractionPlan, source: LaserSource, dtype: DTypeLike) -> None:
        self.depths, self.source, self.dtype = DepthPropagator(plan, dtype), source, np.dtype(dtype)
        self.lights = [source.illuminate_plane(plan, float(depth)) for depth in plan.grid.z]

    def to_plane(self, volume: Array_illuminated_depths) -> Array_illuminated_depths:
        """Return the field (y, x, frequencies) on the plane of a volume (z, y, x)."""
        run = -(-len(volume) // thread_count())
        parts: dict[int, Array_illuminated_depths] = {}

        def process_block(planes: slice) -> None:
            parts[planes.start] = self._to_plane_waves(volume, planes)

        run_blocks(process_block, len(volume), run)
        # In a fixed order, so that the same input gives the same sum.
        return self.depths.to_waves_adjoint(
            reduce(np.add, (parts[start] for start in sorted(parts)))
        )

    def to_volume(self, values: Array_illuminated_depths) -> Array_illuminated_depths:
        """Return the real volume (z, y, x) of a field (y, x, frequencies) on the plane: the adjoint
        of `to_plane`.
        """
        spectrum = self.depths.to_waves(values)
        volume = np.empty(self.depths.plan.grid.shape, self.dtype.type(0).real.dtype)

        def process_block(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                terms = (spectrum * self._evaluate_transfer(i)) @ self.lights[i].coefficients
                volume[i] = np.sum(
                    self._illumination_functions(i) * self.depths.to_images(terms), axis=0
                ).real

        run_blocks(process_block, len(volume), size=1)
        return volume

    def _to_plane_waves(
        self, volume: Array_illuminated_depths, planes: slice
    ) -> Array_illuminated_depths:
        """Plane waves (waves, frequencies) of some depths together."""
        total: Any = 0
        for i in range(planes.start, planes.stop):
            terms = self.depths.to_images_adjoint(
                self._illumination_functions(i).conj() * volume[i]
            )
            total = (
                total + (terms @ self.lights[i].coefficients.T) * self._evaluate_transfer(i).conj()
            )
        return np.asarray(total)

    def _evaluate_transfer(self, i: int) -> Array_illuminated_depths:
        delay = np.array([self.lights[i].span.mean(), self.source.centre_wavenumber])
        return self.depths.transfer(float(self.depths.plan.grid.z[i]), delay)

    def _illumination_functions(self, i: int) -> Array_illuminated_depths:
        """What the terms of the illumination's split are multiplied by at every voxel of a depth,
        (m, y, x).
        """
        light, laser, grid = self.lights[i], self.source.laser, self.depths.plan.grid
        if laser is None:
            return np.ones((1, *grid.shape[1:]), self.dtype)
        across = (grid.y[:, np.newaxis] - laser[1]) ** 2 + (grid.x - laser[0]) ** 2
        distance = np.sqrt(across + (grid.z[i] - laser[2]) ** 2)
        functions = _sample_functions(light, distance) * np.exp(
            1j * self.source.centre_wavenumber * distance
        )
        functions[light.even :] *= 1j
        return np.asarray(functions, self.dtype)


def _sample_functions(
    light: Illumination, distance: NDArray[np.float64]
) -> Array_illuminated_depths:
    """The functions of a split illumination at some distances (y, x), shape (m, y, x)."""
    place = (
        (distance - light.span[0])
        * (len(light.table) - 1)
        / max(light.span[1] - light.span[0], 1e-12)
    )
    before = np.clip(place.astype(np.intp), 0, len(light.table) - 2)
    weight = np.maximum(place - before, 0)[..., np.newaxis]
    values = light.table[before] + weight * (light.table[before + 1] - light.table[before])
    return np.moveaxis(values, -1, 0)
