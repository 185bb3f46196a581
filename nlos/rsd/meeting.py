"""Carrying plane waves to every depth, where they meet the laser's wave."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.kernels import illuminate
from nlos.method import Progress, silent
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.groups import Groups, Interpolation
from nlos.rsd.illumination import Illumination, constant, split
from nlos.rsd.inverse import inverse
from nlos.rsd.kernels import carry, scatter
from tofclip.threads import blocks, one_blas_thread, run_blocks

FloatArray = NDArray[np.float64]
Field = NDArray[np.complex64]
Parts = NDArray[np.float32]

PLANES_AT_A_TIME = 2
"""Depths that a group of plane waves is carried to while its spectrum is in cache."""

LADDER, NARROWEST = 1.05, 1e-3
"""Half the range of distances from the laser spot to a plane is rounded up to a power of the first, and at least the
second, m."""

ILLUMINATION_SHARE = 0.25
"""Of the error allowed, what splitting the illumination may take; where little is hidden it weighs more."""


@dataclass(frozen=True, eq=False)
class Source:
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
    def centre(self) -> float:
        """Wavenumber about which the illumination is expanded; 0 without one."""
        if self.laser is None:
            return 0.0
        return float(np.average(self.wavenumbers, weights=self.strength**2))

    def on_plane(self, way: Diffraction, depth: float) -> Illumination:
        """Split the illumination of the plane at one depth."""
        if self.laser is None:
            return constant(self.wavenumbers.size)
        y, x = (
            (np.clip(spot, axis[0], axis[-1]) - spot, max(spot - axis[0], axis[-1] - spot))
            for axis, spot in ((way.grid.y, self.laser[1]), (way.grid.x, self.laser[0]))
        )
        span = np.sqrt(np.array(y) ** 2 + np.array(x) ** 2 + (depth - self.laser[2]) ** 2)
        # One split serves all depths that differ by little: it takes as long as a small image.
        half = LADDER ** np.ceil(np.log(max(np.ptp(span) / 2, NARROWEST)) / np.log(LADDER))
        light = self._split(float(half), ILLUMINATION_SHARE * way.tolerance)
        return replace(light, span=span.mean() + light.span)

    def _split(self, half: float, tolerance: float) -> Illumination:
        key = half, tolerance
        if key not in self._splits:
            self._splits[key] = split(self.wavenumbers - self.centre, self.strength, half, tolerance)
        return self._splits[key]

    @cached_property
    def _splits(self) -> dict[tuple[float, float], Illumination]:
        return {}


def diffract(
    way: Diffraction,
    values: NDArray[np.complex64],
    source: Source,
    total: NDArray[np.complex64],
    progress: Progress = silent,
) -> None:
    """Add ``sum_k S_k(r) * exp(1j * k * |r_L - r|)`` to every voxel r, S_k the field carried there from the plane.

    Liu, Bauer, Velten, "Phasor field diffraction based reconstruction for fast non-line-of-sight imaging systems",
    Nat. Commun. 11, 1645 (2020); the illumination is split per depth, so that few inverse transforms replace one per
    frequency.

    Parameters
    ----------
    way : Diffraction
    values : (y, x, frequencies) complex64 array
        On the way's plane.
    source : Source
    total : (z, y, x) complex64 array
        Added to.
    progress : callable, optional
        Called with the number of voxels just done.
    """
    with one_blas_thread():
        groups = Groups(way.plane_waves)
        spectrum = groups.analysed(values, way.plane, (float(way.grid.y[0]), float(way.grid.x[0])))
        lights = [constant(1)] * way.grid.z.size

        def light(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                lights[i] = source.on_plane(way, float(way.grid.z[i]))

        run_blocks(light, len(lights), size=PLANES_AT_A_TIME)
        most = max(light.coefficients.shape[1] for light in lights)
        interpolation = groups.interpolation(way.transfer)
        _ = way.transfer.prepared, groups.first
        spare: list[_Bench] = []

        def work(planes: slice) -> None:
            bench = spare.pop() if spare else _Bench(way, source, groups, interpolation, most)
            bench.image(spectrum, lights[planes], planes, total)
            spare.append(bench)
            progress(total[planes].size)

        run_blocks(work, len(lights), size=PLANES_AT_A_TIME)


class _Bench:
    """One thread's memory, and what it does there."""

    def __init__(
        self, way: Diffraction, source: Source, groups: Groups, interpolation: Interpolation, terms: int
    ) -> None:
        self.way, self.source, self.groups, self.interpolation = way, source, groups, interpolation
        self.inverse = inverse(groups.indices, way.lattice, way.grid.shape[1:], terms)
        self.cell = np.where(groups.distinct, self.inverse.cell, self.inverse.spare)
        self.folded = bool(np.bincount(self.inverse.cell[groups.distinct]).max() > 1)
        self._room = np.empty(PLANES_AT_A_TIME * (terms + 1) * int(np.prod(groups.shape)), np.float32)

    def image(self, spectrum: Parts, lights: list[Illumination], planes: slice, total: Field) -> None:
        """Add a few depth planes."""
        depths = self.way.grid.z[planes]
        carried = self._carried(spectrum, lights, depths)
        for terms, light, depth, field in zip(carried, lights, depths, total[planes], strict=True):
            count = light.coefficients.shape[1]
            for some in blocks(count, len(self.inverse.spectra)):
                scatter(terms[some], self.cell, self.folded, self.inverse.spectra)
                self.inverse.transform(some)
            self._illuminate(self.inverse.images[:count], light, depth, field)

    def _carried(self, spectrum: Parts, lights: list[Illumination], depths: FloatArray) -> Parts:
        """Return the plane waves of all terms, (depths, m, groups, 2, MIRRORED, LANES)."""
        ahead, between = self.groups.ahead, self.interpolation
        most = max(light.coefficients.shape[1] for light in lights)
        # The compiled loop takes two terms at a time.
        coefficients = np.zeros((len(lights), most + most % 2, spectrum.shape[1]), np.float32)
        nodes = []
        for own, light, depth in zip(coefficients, lights, depths, strict=True):
            own[: light.coefficients.shape[1], ahead:] = light.coefficients.T
            delay = np.array([light.span.mean(), self.source.centre])
            nodes.append(self.way.transfer.at(depth - self.way.plane.z, delay, ahead))
        shape = (*coefficients.shape[:2], *self.groups.shape)
        terms = self._room[: int(np.prod(shape))].reshape(shape)
        weights = (between.begin, between.offset, between.shares)
        carry(spectrum, self.groups.first, np.stack(nodes), *weights, coefficients, terms)
        return terms

    def _illuminate(self, images: Field, light: Illumination, depth: float, field: Field) -> None:
        """Let the laser's wave meet the images of one depth plane."""
        x, y = self.way.grid.x, self.way.grid.y
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        table, carrier = np.ascontiguousarray(light.table.T), self.inverse.carrier
        illuminate(images, light.even, x, y, depth, laser, self.source.centre, table, light.span, carrier, field)
