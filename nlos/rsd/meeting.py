"""Carrying plane waves to every depth, where they meet the laser's wave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, silent
from nlos.rsd.blas import one_thread
from nlos.rsd.diffraction import Diffraction
from nlos.rsd.illumination import Illumination, constant, split
from nlos.rsd.inverse import inverse
from nlos.rsd.kernels import illuminate, scatter, transferred
from tofclip.threads import blocks, run_blocks

FloatArray = NDArray[np.float64]

WAVES_AT_A_TIME = 256
"""Plane waves whose products with the transfer function stay in cache until they are summed over the frequencies."""

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
        spectrum = way.plane_waves.analysed(values, way.plane, (float(way.grid.y[0]), float(way.grid.x[0])))
        spectrum /= np.float32(np.prod(way.plane_waves.period))
        lights = [constant(1)] * way.grid.z.size

        def light(planes: slice) -> None:
            for i in range(planes.start, planes.stop):
                lights[i] = source.on_plane(way, float(way.grid.z[i]))

        run_blocks(light, len(lights), size=PLANES_AT_A_TIME)
        most = max(light.coefficients.shape[1] for light in lights)
        _ = way.transfer.prepared
        spare: list[_Bench] = []

        def work(planes: slice) -> None:
            bench = spare.pop() if spare else _Bench(way, source, most)
            for i in range(planes.start, planes.stop):
                bench.image(spectrum, lights[i], float(way.grid.z[i]), total[i])
                progress(total[i].size)
            spare.append(bench)

        run_blocks(work, len(lights), size=PLANES_AT_A_TIME)


class _Bench:
    """One thread's memory, and what it does there."""

    def __init__(self, way: Diffraction, source: Source, terms: int) -> None:
        waves, frequencies = way.plane_waves, way.waves.count
        self.way, self.source = way, source
        self.inverse = inverse(waves, way.lattice, way.grid.shape[1:], terms)
        self.nodes = way.transfer.interpolation(waves.lateral)
        self.products = np.zeros((WAVES_AT_A_TIME, 2, frequencies), np.float32)
        self.weights = np.zeros((2, frequencies), np.float32)
        starts = np.arange(0, waves.lateral.size, WAVES_AT_A_TIME)
        self.firsts = np.searchsorted(waves.limits, np.minimum.reduceat(waves.lateral, starts))
        self.folded = np.unique(self.inverse.cell).size < waves.lateral.size

    def image(self, spectrum: NDArray[np.float32], light: Illumination, depth: float, field: NDArray[Any]) -> None:
        """Add one depth plane."""
        delay = np.array([light.span.mean(), self.source.centre])
        self._carry(spectrum, self.way.transfer.at(depth - self.way.plane.z, delay), light.coefficients)
        images = self.inverse.images(light.coefficients.shape[1])
        x, y = self.way.grid.x, self.way.grid.y
        laser = np.zeros(3) if self.source.laser is None else self.source.laser
        carrier = self.inverse.carrier
        illuminate(images, light.even, x, y, depth, laser, self.source.centre, light.table, light.span, carrier, field)

    def _carry(self, spectrum: NDArray[np.float32], transfer: NDArray[np.float32], sums: NDArray[np.float32]) -> None:
        """Leave the spectra of all terms in the inverse transform's memory."""
        spectra = self.inverse.spectra[: sums.shape[1]].reshape(sums.shape[1], -1)
        if self.folded:
            spectra[:] = 0
        for some, first in zip(blocks(len(spectrum), WAVES_AT_A_TIME), self.firsts, strict=True):
            products = self.products[: some.stop - some.start]
            transferred(spectrum, transfer, *self.nodes, some.start, first, self.weights, products)
            terms = sums[first:].T @ products.reshape(-1, sums.shape[0])[:, first:].T
            scatter(terms.reshape(-1, len(products), 2), self.inverse.cell, some.start, self.folded, spectra)
