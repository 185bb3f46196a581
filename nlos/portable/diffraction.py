"""From a plane to all depths on the arrays of any library: the diffraction of
`nlos.rsd.image_planes` in matrix products.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.depths import DepthPropagator
from nlos.method import Progress, ignore_progress
from nlos.portable.library import ArrayLibrary, remove_whole_turns
from nlos.rsd.diffraction import DepthInterpolation, DiffractionPlan
from nlos.rsd.illumination import Illumination
from nlos.rsd.image_planes import LaserSource
from nlos.rsd.kernels import TAPS
from tofclip.arrays import Array
from tofclip.threads import run_blocks, split_blocks

FloatArray = NDArray[np.float64]

MAX_CACHE_BYTES = 1 << 30
"""Transfer functions and illuminations of all depths are kept for the next field if they take no
more.
"""


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
        `nlos.rsd.image_planes.CompiledDiffraction`.

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
