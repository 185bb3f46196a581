"""Plane waves carried to every depth, where they meet the laser's wave.

The laser's wave on a depth plane is a short sum over its frequencies' common part, so that few
inverse transforms per depth replace one per frequency.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.kernels import add_illuminated_terms, add_with_carrier
from nlos.method import Progress, ignore_progress
from nlos.rsd.diffraction import (
    AxialSpectrum,
    DepthInterpolation,
    DiffractionPlan,
    InterpolatedBlock,
    choose_depths,
)
from nlos.rsd.groups import Interpolation, WaveGroups
from nlos.rsd.illumination import (
    Illumination,
    build_constant_illumination,
    split_illumination,
)
from nlos.rsd.inverse import choose_inverse
from nlos.rsd.kernels import propagate_spectrum, scatter_terms
from tofclip.threads import limit_blas_threads, run_blocks, split_blocks

FloatArray = NDArray[np.float64]
Field = NDArray[np.complex64]
FloatParts = NDArray[np.float32]

PLANES_PER_BLOCK = 2
"""Depths that a group of plane waves is propagated to while its spectrum is in cache."""

HALF_RANGE_RATIO, MIN_HALF_RANGE_M = 1.05, 1e-3
"""Half the range of distances from the laser spot to a plane is rounded up to a power of the first, and at least the
second, m."""

ILLUMINATION_ERROR_FRACTION = 0.25
"""Of the error allowed, what splitting the illumination may take; where little is hidden it weighs
more.
"""

DEPTH_ERROR_FRACTION = 0.35
"""Of the error allowed, what interpolation between depths may take."""


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

    def choose_depths(self, plan: DiffractionPlan) -> DepthInterpolation:
        """Choose which depths are computed, and how the others follow from these without the
        laser's carrier.
        """
        cosines = (0.0, 0.0)
        if self.laser is not None:
            # beyond the spot all light goes forward
            cosines = (0.0 if plan.grid.z[0] >= self.laser[2] else -1.0, 1.0)
        spectrum = AxialSpectrum.of(
            plan.waves.wavenumbers, self.strength, self.centre_wavenumber, cosines
        )
        return choose_depths(plan.grid.z, spectrum, DEPTH_ERROR_FRACTION * plan.tolerance)

    def illuminate_plane(self, plan: DiffractionPlan, depth: float) -> Illumination:
        """Split the illumination of the plane at one depth.

        `plan`: its grid and tolerance; `depth`: z of the plane, m. Returns with ``span``, the
        smallest and largest distance of the spot from the plane's voxels, m.
        """
        if self.laser is None:
            return build_constant_illumination(self.wavenumbers.size)
        y, x = (
            (np.clip(spot, axis[0], axis[-1]) - spot, max(spot - axis[0], axis[-1] - spot))
            for axis, spot in ((plan.grid.y, self.laser[1]), (plan.grid.x, self.laser[0]))
        )
        span = np.sqrt(np.array(y) ** 2 + np.array(x) ** 2 + (depth - self.laser[2]) ** 2)
        # One split serves all depths that differ by little: it takes as long as a small image.
        # rounded up to a geometric series of half ranges, so that one split serves many depths
        half = HALF_RANGE_RATIO ** np.ceil(
            np.log(max(np.ptp(span) / 2, MIN_HALF_RANGE_M)) / np.log(HALF_RANGE_RATIO)
        )
        light = self._split_range(float(half), ILLUMINATION_ERROR_FRACTION * plan.tolerance)
        return replace(light, span=span.mean() + light.span)

    def _split_range(self, half: float, tolerance: float) -> Illumination:
        key = half, tolerance
        if found := self.splits.get(key):
            return found
        offsets = self.wavenumbers - self.centre_wavenumber
        made = split_illumination(offsets, self.strength, half, tolerance)
        return self.splits.setdefault(key, made)  # one step, as threads share the dictionary


class CompiledDiffraction:
    """Fields on one plane carried to all depths of a grid, where they meet the laser's wave.

    The counterpart of `nlos.portable.diffraction.PortableDiffraction`. Holding one is the cache:
    illuminations, transforms and each thread's memory stay for the next field.

    Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight
    imaging systems", Nat. Commun. 11, 1645 (2020); the illumination is split per depth, so that few
    inverse transforms replace one per frequency.
    """

    def __init__(self, plan: DiffractionPlan, source: LaserSource) -> None:
        self.plan, self.source = plan, source
        self.groups = WaveGroups(plan.plane_waves)
        self.table_bytes = 0
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
        values: NDArray[np.complex64],
        total: NDArray[np.complex64],
        progress: Progress = ignore_progress,
    ) -> None:
        """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r, S_k the field carried
        there from the plane.

        `values` (y, x, frequencies): on the plan's plane; `total` (z, y, x): added to; `progress`:
        called with the number of voxels just done.
        """
        plan = self.plan
        with limit_blas_threads():
            spectrum = self.groups.to_plane_waves(
                values, plan.plane, (float(plan.grid.y[0]), float(plan.grid.x[0]))
            )
            # What threads share is made before they start.
            self.table_bytes = self.table_bytes or plan.transfer.tabulate()
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

            run_blocks(process_block, len(lights), size=PLANES_PER_BLOCK)
            run_blocks(
                lambda some: self._interpolate(blocks[some.start], computed, total), len(blocks), 1
            )

    def _interpolate(self, block: InterpolatedBlock, computed: Field, total: Field) -> None:
        """Add some depths that follow from computed ones without the laser's carrier."""
        grid, shape = self.plan.grid, (-1, *total.shape[1:])
        known = computed[block.nodes].reshape(block.nodes.stop - block.nodes.start, -1)
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        add_with_carrier(
            (block.weights @ known).reshape(shape),
            grid.x,
            grid.y,
            grid.z[block.depths],
            laser,
            self.source.centre_wavenumber,
            total[block.depths],
        )

    @cached_property
    def _depths(self) -> DepthInterpolation:
        """Which depths are computed, and how the others follow."""
        return self.source.choose_depths(self.plan)

    @cached_property
    def _lights(self) -> list[Illumination]:
        """The illumination of every computed depth."""
        depths = self.plan.grid.z[self._depths.nodes]
        lights: dict[int, Illumination] = {}

        def split(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                lights[i] = self.source.illuminate_plane(self.plan, float(depths[i]))

        run_blocks(split, depths.size, size=PLANES_PER_BLOCK)
        return [lights[i] for i in range(depths.size)]

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
        self,
        plan: DiffractionPlan,
        groups: WaveGroups,
        interpolation: Interpolation,
        terms: int,
    ) -> None:
        self.plan, self.groups, self.interpolation = plan, groups, interpolation
        self.max_terms = terms
        self.inverse = choose_inverse(groups.indices, plan.lattice, plan.grid.shape[1:], terms)
        # repeated waves are sent to a spare cell that nothing reads
        self.cell_indices = np.where(
            groups.is_distinct, self.inverse.cell_indices, self.inverse.spare
        )
        # where several waves fall into one cell they have to be added, not written
        self.folded = bool(np.bincount(self.inverse.cell_indices[groups.is_distinct]).max() > 1)
        self._term_buffer = np.empty(
            PLANES_PER_BLOCK * (terms + 1) * int(np.prod(groups.shape)), np.float32
        )

    def image(
        self,
        spectrum: FloatParts,
        source: LaserSource,
        lights: list[Illumination],
        depths: FloatArray,
        total: Field,
        without_carrier: bool,
    ) -> None:
        """Add a few depth planes.

        `spectrum`: plane waves of the wall's field at all frequencies; `lights`: one for each
        plane; `depths` (z,): m; `total` (z, y, x): added to, in place; `without_carrier`: leave out
        the laser's carrier wave.
        """
        wavenumber = 0.0 if without_carrier else source.centre_wavenumber
        carried = self._propagate_terms(spectrum, source, lights, depths)
        for terms, light, depth, image in zip(carried, lights, depths, total, strict=True):
            count = light.coefficients.shape[1]
            for some in split_blocks(count, len(self.inverse.spectra)):
                scatter_terms(terms[some], self.cell_indices, self.folded, self.inverse.spectra)
                self.inverse.transform(some)
            self._illuminate(self.inverse.images[:count], source, light, depth, wavenumber, image)

    def _propagate_terms(
        self,
        spectrum: FloatParts,
        source: LaserSource,
        lights: list[Illumination],
        depths: FloatArray,
    ) -> FloatParts:
        """Return the plane waves of all terms, (depths, m, groups, 2, MIRRORED, LANES)."""
        leading_zeros, between = self.groups.leading_zeros, self.interpolation
        max_terms = max(light.coefficients.shape[1] for light in lights)
        # The compiled loop takes two terms at a time.
        coefficients = np.zeros(
            (len(lights), max_terms + max_terms % 2, spectrum.shape[1]), np.float32
        )
        nodes = []
        for own, light, depth in zip(coefficients, lights, depths, strict=True):
            own[: light.coefficients.shape[1], leading_zeros:] = light.coefficients.T
            delay = np.array([light.span.mean(), source.centre_wavenumber])
            nodes.append(
                self.plan.transfer.evaluate(depth - self.plan.plane.z, delay, leading_zeros)
            )
        shape = (*coefficients.shape[:2], *self.groups.shape)
        terms = self._term_buffer[: int(np.prod(shape))].reshape(shape)
        weights = (between.begin, between.offset, between.weights)
        propagate_spectrum(
            spectrum, self.groups.first_frequency, np.stack(nodes), *weights, coefficients, terms
        )
        return terms

    def _illuminate(
        self,
        images: Field,
        source: LaserSource,
        light: Illumination,
        depth: float,
        wavenumber: float,
        field: Field,
    ) -> None:
        """Let the laser's wave meet the images of one depth plane."""
        x, y = self.plan.grid.x, self.plan.grid.y
        laser = np.zeros(3) if source.laser is None else source.laser
        table, carrier = np.ascontiguousarray(light.table.T), self.inverse.carrier
        add_illuminated_terms(
            images,
            light.even,
            x,
            y,
            depth,
            laser,
            wavenumber,
            table,
            light.span,
            carrier,
            field,
        )
