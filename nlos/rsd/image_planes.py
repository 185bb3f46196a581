"""Carrying plane waves to every depth, where they meet the laser's wave."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.kernels import add_illuminated_terms
from nlos.method import Progress, ignore_progress
from nlos.rsd.diffraction import DiffractionPlan
from nlos.rsd.groups import Interpolation, WaveGroups
from nlos.rsd.illumination import Illumination, build_constant_illumination, split_illumination
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


@dataclass(frozen=True, eq=False)
class LaserSource:
    """What shines on the hidden scene while the wall is watched.

    Parameters
    ----------
    laser : (3,) array or None
        A spot, m; None where its way is part of the field already (confocal).
    wavenumbers : (frequencies,) array
        rad/m.
    strength : (frequencies,) array
        Share of each frequency in the pulse; decides what may be neglected.
    """

    laser: FloatArray | None
    wavenumbers: FloatArray
    strength: FloatArray

    @property
    def centre_wavenumber(self) -> float:
        """Wavenumber about which the illumination is expanded; 0 without one."""
        if self.laser is None:
            return 0.0
        return float(np.average(self.wavenumbers, weights=self.strength**2))

    def illuminate_plane(self, plan: DiffractionPlan, depth: float) -> Illumination:
        """Split the illumination of the plane at one depth.

        Parameters
        ----------
        plan : DiffractionPlan
            Its grid and tolerance.
        depth : float
            z of the plane, m.

        Returns
        -------
        Illumination
            With ``span``, the smallest and largest distance of the spot from the plane's voxels, m.
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
        if key not in self._split_cache:
            self._split_cache[key] = split_illumination(
                self.wavenumbers - self.centre_wavenumber, self.strength, half, tolerance
            )
        return self._split_cache[key]

    @cached_property
    def _split_cache(self) -> dict[tuple[float, float], Illumination]:
        return {}


def diffract_to_grid(
    plan: DiffractionPlan,
    values: NDArray[np.complex64],
    source: LaserSource,
    total: NDArray[np.complex64],
    progress: Progress = ignore_progress,
) -> None:
    """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r, S_k the field propagated
    there from the plane.

    Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight
    imaging systems", Nat. Commun. 11, 1645 (2020); the illumination is split per depth, so that few
    inverse transforms replace one per frequency.

    Parameters
    ----------
    plan : DiffractionPlan
    values : (y, x, frequencies) complex64 array
        On the way's plane.
    source : Source
    total : (z, y, x) complex64 array
        Added to.
    progress : callable, optional
        Called with the number of voxels just done.
    """
    with limit_blas_threads():
        groups = WaveGroups(plan.plane_waves)
        spectrum = groups.to_plane_waves(
            values, plan.plane, (float(plan.grid.y[0]), float(plan.grid.x[0]))
        )
        lights = [build_constant_illumination(1)] * plan.grid.z.size

        def light(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                lights[i] = source.illuminate_plane(plan, float(plan.grid.z[i]))

        run_blocks(light, len(lights), size=PLANES_PER_BLOCK)
        max_terms = max(light.coefficients.shape[1] for light in lights)
        interpolation = groups.interpolation(plan.transfer)
        # both are computed here once: threads that ask first would each compute them
        _ = plan.transfer.bessel_matrix, groups.first_frequency
        spare: list[_Workspace] = []

        def process_block(planes: slice) -> None:
            workspace = (
                spare.pop() if spare else _Workspace(plan, source, groups, interpolation, max_terms)
            )
            workspace.image(spectrum, lights[planes], planes, total)
            spare.append(workspace)
            progress(total[planes].size)

        run_blocks(process_block, len(lights), size=PLANES_PER_BLOCK)


class _Workspace:
    """One thread's memory, and what it does there."""

    def __init__(
        self,
        plan: DiffractionPlan,
        source: LaserSource,
        groups: WaveGroups,
        interpolation: Interpolation,
        terms: int,
    ) -> None:
        self.plan, self.source, self.groups, self.interpolation = (
            plan,
            source,
            groups,
            interpolation,
        )
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
        self, spectrum: FloatParts, lights: list[Illumination], planes: slice, total: Field
    ) -> None:
        """Add a few depth planes.

        Parameters
        ----------
        spectrum : float32 array
            Plane waves of the wall's field at all frequencies.
        lights : list of Illumination
            One for each plane.
        planes : slice
            Depths of the grid.
        total : (z, y, x) complex64 array
            Added to, in place.
        """
        depths = self.plan.grid.z[planes]
        carried = self._propagate_terms(spectrum, lights, depths)
        for terms, light, depth, field in zip(carried, lights, depths, total[planes], strict=True):
            count = light.coefficients.shape[1]
            for some in split_blocks(count, len(self.inverse.spectra)):
                scatter_terms(terms[some], self.cell_indices, self.folded, self.inverse.spectra)
                self.inverse.transform(some)
            self._illuminate(self.inverse.images[:count], light, depth, field)

    def _propagate_terms(
        self, spectrum: FloatParts, lights: list[Illumination], depths: FloatArray
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
            delay = np.array([light.span.mean(), self.source.centre_wavenumber])
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

    def _illuminate(self, images: Field, light: Illumination, depth: float, field: Field) -> None:
        """Let the laser's wave meet the images of one depth plane."""
        x, y = self.plan.grid.x, self.plan.grid.y
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        table, carrier = np.ascontiguousarray(light.table.T), self.inverse.carrier
        add_illuminated_terms(
            images,
            light.even,
            x,
            y,
            depth,
            laser,
            self.source.centre_wavenumber,
            table,
            light.span,
            carrier,
            field,
        )
