"""Fields carried from a plane to a grid's depths in matrix products, on the arrays of any library:
the diffraction of `nlos.phasor.to_depths_compiled`, each step beside its adjoint.

For arrays that are not NumPy's, for what needs the way back (iterative refinement), and for what
needs the frequencies apart from the laser's wave (transient video).
"""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np

from nlos.method import Progress, ignore_progress
from nlos.phasor.arrays import ArrayLibrary
from nlos.phasor.depth_steps import DepthInterpolation, DiffractionPlan, Illumination
from nlos.phasor.to_depths_compiled import LaserSource
from nlos.phasor.to_depths_kernels import TAPS
from tofclip.arrays import Array, ComplexArray, FloatArray
from tofclip.threads import map_parallel, run_blocks, split_blocks, thread_count

# Transfer functions and illuminations are kept for the next field if they take no more.
MAX_CACHE_BYTES = 1 << 30
# Spectra of the depths that a thread of a solver treats together: few calls, and still in cache.
SOLVER_BLOCK_BYTES = 2 << 20


class DepthPropagator:
    """Plane waves between a plane and depths. Memory: some 20 bytes per wave and frequency."""

    def __init__(self, plan: DiffractionPlan, library: ArrayLibrary) -> None:
        self.plan, self.library, self.xp = plan, library, library.xp
        row, column, lateral = plan.plane_waves.sort(signed=True)
        reach = int(np.abs(row).max()), int(np.abs(column).max())
        cell = (row + reach[0]) * (2 * reach[1] + 1) + column + reach[1]
        wave = np.full((2 * reach[0] + 1) * (2 * reach[1] + 1), cell.size)
        wave[cell] = np.arange(cell.size)
        # Cell of every wave in a full rectangle, and wave in every cell, one too many for none.
        self._cells = library.put(cell), library.put(wave)
        counted = lateral[:, np.newaxis] <= plan.plane_waves.lateral_limits
        # 1 / area of a period, or 0 where a wave is left out, (waves, frequencies).
        self.wave_weights = library.put(counted / np.prod(plan.plane_waves.period))
        grid, plane = plan.grid, plan.plane
        (plane_y, voxels_y), (plane_x, voxels_x) = (
            [
                np.exp(2j * np.pi / period * np.outer(np.arange(-n, n + 1), axis - voxels[0]))
                for axis in (points, voxels)
            ]
            for points, voxels, period, n in zip(
                (plane.y, plane.x), (grid.y, grid.x), plan.plane_waves.period, reach, strict=True
            )
        )
        self._from_plane = library.put(plane_y.conj()), library.put(plane_x.conj())
        self._to_voxels = library.put(voxels_y.T), library.put(voxels_x)
        self._lateral = lateral

    def to_waves(self, values: Array) -> Array:
        """Return the plane waves (waves, frequencies) of a field (y, x, frequencies) on the plane."""
        xp, (along_y, along_x) = self.xp, self._from_plane
        rows, columns, count = values.shape
        half = xp.reshape(along_y @ xp.reshape(values, (rows, -1)), (-1, columns, count))
        waves = xp.take(xp.reshape(along_x @ half, (-1, count)), self._cells[0], axis=0)
        return waves * self.wave_weights

    def to_waves_adjoint(self, waves: Array) -> Array:
        """Return the field (y, x, frequencies) on the plane: the adjoint of `to_waves`."""
        xp, (along_y, along_x) = self.xp, self._from_plane
        cells = self._place_in_cells(xp.permute_dims(waves * self.wave_weights, (1, 0)))
        cells = xp.reshape(xp.permute_dims(cells, (1, 0)), (along_y.shape[0], along_x.shape[0], -1))
        half = xp.conj(along_x.T) @ cells
        values = xp.conj(along_y.T) @ xp.reshape(half, (along_y.shape[0], -1))
        return xp.reshape(values, (*self.plan.plane.shape, -1))

    def transfer(self, nodes: Array) -> Array:
        """Return what every wave (z, waves, frequencies) is multiplied by, of `transfer_nodes`."""
        node, weights, wave = self._node_interpolation
        values = weights[0] * self.xp.take(nodes, node, axis=1)
        for tap in range(1, TAPS):
            values += weights[tap] * self.xp.take(nodes, node + tap, axis=1)
        return self.xp.take(values, wave, axis=1)

    def transfer_nodes(self, depth: float, delay: FloatArray) -> ComplexArray:
        """Return the transfer function to a depth, m, at its nodes (nodes, frequencies)."""
        parts = self.plan.transfer.evaluate(depth - self.plan.plane.z, delay)
        nodes = np.empty((len(parts), parts.shape[2]), np.complex64)
        nodes.real, nodes.imag = parts[:, 0], parts[:, 1]
        return nodes

    def to_images(self, terms: Array) -> Array:
        """Return the images (z, m, y, x) on the voxels of sums (z, waves, m) of plane waves."""
        xp, (along_y, along_x) = self.xp, self._to_voxels
        cells = self._place_in_cells(xp.permute_dims(terms, (0, 2, 1)))
        cells = xp.reshape(cells, (*cells.shape[:2], along_y.shape[1], along_x.shape[0]))
        return along_y @ cells @ along_x

    def to_images_adjoint(self, images: Array) -> Array:
        """Return plane waves (z, waves, m) of images (z, m, y, x): the adjoint of `to_images`."""
        xp, (along_y, along_x) = self.xp, self._to_voxels
        cells = xp.conj(along_y.T) @ images @ xp.conj(along_x.T)
        waves = xp.take(xp.reshape(cells, (*images.shape[:2], -1)), self._cells[0], axis=2)
        return xp.permute_dims(waves, (0, 2, 1))

    def _place_in_cells(self, waves: Array) -> Array:
        """Put plane waves (..., waves) into a full rectangle of them, (..., cells)."""
        # One wave more, which is 0: that is what stands in the corners, where no wave travels.
        zeros = self.library.zeros((*waves.shape[:-1], 1))
        return self.xp.take(self.xp.concat([waves, zeros], axis=-1), self._cells[1], axis=-1)

    @cached_property
    def _node_interpolation(self) -> tuple[Array, list[Array], Array]:
        """First node of every lateral wavenumber, weights of all taps, and which a wave has."""
        lateral, wave = np.unique(self._lateral, return_inverse=True)
        node, weight = self.plan.transfer.interpolation(lateral)
        weights = [self.library.put(weight[:, tap, np.newaxis]) for tap in range(TAPS)]
        return self.library.put(node), weights, self.library.put(wave.ravel())


class _DepthBlock(NamedTuple):
    """What some neighbouring depths need, as arrays of the library."""

    depths: FloatArray  # (z,), m, on this machine's processor
    transfer: Array  # (z, nodes, frequencies), at the nodes of the lateral wavenumber
    # (z, frequencies, m), of the illumination's functions, 0 where a depth has fewer
    coefficients: Array
    table: Array  # (z * samples, m), the functions themselves
    samples: int
    start: Array  # (z, 1, 1), of the axial distance in the table
    per_metre: Array  # (z, 1, 1), samples


class PortableDiffraction:
    """Fields on one plane carried to all depths, where they meet the laser's wave. Transfer
    functions and illuminations stay for the next field, up to 1 GiB (50 MB for 128 depths, 120
    frequencies and 400 nodes). Memory besides: four chunks (`ArrayLibrary.chunk_bytes`), and 60
    bytes per plane wave and frequency. `for_solver`: all depths are computed, a block for every
    thread.
    """

    def __init__(
        self,
        plan: DiffractionPlan,
        source: LaserSource,
        library: ArrayLibrary,
        for_solver: bool = False,
    ) -> None:
        self.plan, self.source, self.library = plan, source, library
        self.waves, self._for_solver = DepthPropagator(plan, library), for_solver
        self._cached_blocks: dict[int, _DepthBlock] = {}
        self._keeps_blocks = True

    def for_laser(self, laser: FloatArray | None) -> PortableDiffraction:
        """Return the same for the light of another spot, which plans its depths for every field."""
        other = copy.copy(self)
        other.source = replace(self.source, laser=laser)
        other._cached_blocks, other._keeps_blocks = {}, False
        for computed in ("_lateral_distance_squared", "_computed_depths"):
            other.__dict__.pop(computed, None)
        return other

    def add(self, values: Array, total: Array, progress: Progress = ignore_progress) -> None:
        """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r of `total`."""
        xp, waves = self.library.xp, self.waves.to_waves(values)
        between, wanted = self._computed_depths.blocks, total.shape[0]
        count = self._computed_depths.nodes.size
        computed = self.library.zeros((count, *total.shape[1:])) if between else total
        for some in self._block_slices:
            block = self._get_block(some)
            field = self._illuminate(block, waves)
            computed[some, ...] += field if between else field * self._carrier(block.depths)
            done = wanted * some.stop // count - wanted * some.start // count
            progress(done * total.shape[1] * total.shape[2])
        for part in between:
            nodes, weights = computed[part.nodes, ...], self.library.put(part.weights)
            found = weights @ xp.reshape(nodes, (nodes.shape[0], -1))
            found = xp.reshape(found, (-1, *total.shape[1:]))
            total[part.depths, ...] += found * self._carrier(self.plan.grid.z[part.depths])

    def to_volume(self, values: Array) -> Array:
        """Return the real part (z, y, x) of what `add` gives for a field (y, x, frequencies)."""
        waves, planes = self.waves.to_waves(values), self._block_slices
        xp = self.library.xp

        def process_block(some: slice) -> Array:
            block = self._get_block(some)
            return xp.real(self._illuminate(block, waves) * self._carrier(block.depths))

        return xp.concat(list(map_parallel(process_block, planes, len(planes))), axis=0)

    def to_plane(self, volume: Array) -> Array:
        """Return the field (y, x, frequencies) of a real volume (z, y, x): the adjoint of
        `to_volume`.
        """
        xp, planes, parts = self.library.xp, self._block_slices, {}

        def process_blocks(own: slice) -> None:
            total: Any = 0
            for some in planes[own]:
                block = self._get_block(some)
                lit = volume[some, ...] * xp.conj(self._carrier(block.depths))
                terms = self.waves.to_images_adjoint(lit[:, None, ...] * self._functions(block))
                waves = terms @ xp.conj(xp.permute_dims(block.coefficients, (0, 2, 1)))
                waves *= xp.conj(self.waves.transfer(block.transfer))
                total = total + xp.sum(waves, axis=0)
            parts[own.start] = total

        run_blocks(process_blocks, len(planes), -(-len(planes) // thread_count()))
        # In a fixed order, so that the same input gives the same sum.
        return self.waves.to_waves_adjoint(reduce(xp.add, (parts[i] for i in sorted(parts))))

    def _illuminate(self, block: _DepthBlock, waves: Array) -> Array:
        """Let plane waves meet the laser's wave, but for its carrier: the field (z, y, x)."""
        terms = (waves * self.waves.transfer(block.transfer)) @ block.coefficients
        images = self.waves.to_images(terms)
        return self.library.xp.sum(images * self._functions(block), axis=1)

    def _functions(self, block: _DepthBlock) -> Array | float:
        """The functions f_m of the illumination at every voxel (z, m, y, x), from tables."""
        if self.source.laser is None:
            return 1.0
        xp, samples = self.library.xp, block.samples
        extra = self._extra_distance(self.library.put(self._measure_ahead(block.depths)))
        position = xp.clip(block.start + extra * block.per_metre, 0.0, None)
        before = xp.clip(xp.astype(position, xp.int64), None, samples - 2)
        weight = (position - xp.astype(before, position.dtype))[:, None, :, :]
        first = self.library.put(samples * np.arange(block.depths.size)[:, np.newaxis, np.newaxis])
        index = xp.reshape(before + first, (-1,))
        rows = (xp.take(block.table, some, axis=0) for some in (index, index + 1))
        shaped = (xp.reshape(row, (*before.shape, -1)) for row in rows)
        here, there = (xp.permute_dims(one, (0, 3, 1, 2)) for one in shaped)
        return here + weight * (there - here)

    def _measure_ahead(self, depths: FloatArray) -> FloatArray:
        """Distance of depths along z from the spot (z, 1, 1), m."""
        return np.abs(depths - self.source.position[2])[:, np.newaxis, np.newaxis]

    def _extra_distance(self, ahead: Array) -> Array:
        """Path from the spot less its part along z (z, y, x), m: with finer digits than it."""
        across = self._lateral_distance_squared
        return across / (self.library.xp.sqrt(across + ahead**2) + ahead)

    def _carrier(self, depths: FloatArray) -> Array:
        """Carrier of the laser's wave at every voxel, (z, y, x); 1 without one."""
        ahead, wavenumber = self._measure_ahead(depths), self.source.centre_wavenumber / (2 * np.pi)
        distance = self.library.put(ahead)
        if self.source.laser is None:
            return self.library.xp.ones_like(distance)
        # whole cycles are taken off before single precision would lose the fraction
        cycles = wavenumber * ahead
        cycles = self.library.put(cycles - np.round(cycles))
        return self.library.exp_cycles(cycles + self._extra_distance(distance) * wavenumber)

    @cached_property
    def _computed_depths(self) -> DepthInterpolation:
        if self._for_solver:
            return DepthInterpolation(np.arange(self.plan.grid.z.size), [])
        return self.source.choose_depths(self.plan)

    @property
    def _block_slices(self) -> list[slice]:
        """The computed depths, some at a time."""
        waves, frequencies = self.waves.wave_weights.shape
        size = SOLVER_BLOCK_BYTES if self._for_solver else self.library.chunk_bytes
        count = self._computed_depths.nodes.size
        return list(split_blocks(count, max(1, size // (8 * waves * frequencies))))

    def _get_block(self, some: slice) -> _DepthBlock:
        block = self._cached_blocks.get(some.start)
        if block is None:
            block = self._plan_block(some)
            nodes = self.plan.transfer.nodes.size * self._computed_depths.nodes.size
            if self._keeps_blocks and 8 * nodes * self.plan.waves.count <= MAX_CACHE_BYTES:
                self._cached_blocks[some.start] = block
        return block

    def _plan_block(self, some: slice) -> _DepthBlock:
        """Plan some depths on this machine's processor, and bring what they need to the library."""
        depths = self.plan.grid.z[self._computed_depths.nodes[some]]
        self.plan.transfer.tabulate()

        def plan(depth: float) -> tuple[Illumination, ComplexArray]:
            light = self.source.illuminate_plane(self.plan, depth)
            delay = np.array([light.span.mean(), self.source.centre_wavenumber])
            return light, self.waves.transfer_nodes(depth, delay)

        lights, nodes = zip(*map_parallel(plan, depths.tolist(), depths.size), strict=True)
        max_terms = max(light.coefficients.shape[1] for light in lights)
        samples = len(lights[0].table)
        shape = len(lights), len(lights[0].coefficients), max_terms
        coefficients = np.zeros(shape, np.complex64)
        table = np.zeros((len(lights), samples, max_terms), np.float32)
        for i, light in enumerate(lights):
            count = light.coefficients.shape[1]
            coefficients[i, :, :count], table[i, :, :count] = light.coefficients, light.table
            # odd functions carry a factor 1j
            coefficients[i, :, light.even : count] *= 1j
        starts, ends = np.array([light.span for light in lights]).T[..., np.newaxis, np.newaxis]
        per_metre = (samples - 1) / np.maximum(ends - starts, 1e-12)
        start, put = (self._measure_ahead(depths) - starts) * per_metre, self.library.put
        tables = put(np.stack(nodes)), put(coefficients), put(table.reshape(-1, max_terms))
        return _DepthBlock(depths, *tables, samples, put(start), put(per_metre))

    @cached_property
    def _lateral_distance_squared(self) -> Array:
        """Squared distance of columns of voxels from the spot across, (1, y, x), m^2."""
        laser = self.source.position
        y, x = self.plan.grid.y[:, np.newaxis] - laser[1], self.plan.grid.x - laser[0]
        return self.library.put((y**2 + x**2)[np.newaxis])
