"""Carrying plane waves to every depth, where they meet the laser's wave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, silent
from nlos.rsd.blas import one_thread
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.groups import Groups, Interpolation
from nlos.rsd.illumination import Illumination, constant, split
from nlos.rsd.inverse import inverse
from nlos.rsd.kernels import LANES, MIRRORED, carry, illuminate, scatter
from tofclip.threads import blocks, run_blocks

FloatArray = NDArray[np.float64]

PLANES_AT_A_TIME = 4

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
        return split(self.wavenumbers - self.centre, self.strength, span, ILLUMINATION_SHARE * way.tolerance)


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
    with one_thread():
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
            for i in range(planes.start, planes.stop):
                bench.image(spectrum, lights[i], float(way.grid.z[i]), total[i])
                progress(total[i].size)
            spare.append(bench)

        run_blocks(work, len(lights), size=PLANES_AT_A_TIME)


class _Bench:
    """One thread's memory, and what it does there."""

    def __init__(
        self, way: Diffraction, source: Source, groups: Groups, interpolation: Interpolation, terms: int
    ) -> None:
        self.way, self.source, self.groups, self.interpolation = way, source, groups, interpolation
        self.inverse = inverse(groups.indices, way.lattice, way.grid.shape[1:], terms)
        self.cell = np.where(groups.distinct, self.inverse.cell, self.inverse.spare)
        self.folded = np.unique(self.cell).size <= np.count_nonzero(groups.distinct)
        # The compiled loop takes two terms at a time.
        self.terms = np.empty((terms + terms % 2, len(groups.first), 2, MIRRORED, LANES), np.float32)

    def image(self, spectrum: NDArray[np.float32], light: Illumination, depth: float, field: NDArray[Any]) -> None:
        """Add one depth plane."""
        count = light.coefficients.shape[1]
        self._carry(spectrum, light, depth)
        for some in blocks(count, len(self.inverse.spectra)):
            scatter(self.terms[some], self.cell, self.folded, self.inverse.spectra)
            self.inverse.transform(some)
        images = self.inverse.images[:count]
        x, y = self.way.grid.x, self.way.grid.y
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        carrier = self.inverse.carrier
        illuminate(images, light.even, x, y, depth, laser, self.source.centre, light.table, light.span, carrier, field)

    def _carry(self, spectrum: NDArray[np.float32], light: Illumination, depth: float) -> None:
        """Leave the plane waves of all terms in `terms`."""
        frequencies, count = light.coefficients.shape
        ahead, between = self.groups.ahead, self.interpolation
        delay = np.array([light.span.mean(), self.source.centre])
        nodes = self.way.transfer.at(depth - self.way.plane.z, delay, ahead)
        coefficients = np.zeros((count + count % 2, ahead + frequencies), np.float32)
        coefficients[:count, ahead:] = light.coefficients.T
        terms = self.terms[: len(coefficients)]
        weights = (between.begin, between.offset, between.shares)
        carry(spectrum, self.groups.first, nodes, *weights, coefficients, terms)
