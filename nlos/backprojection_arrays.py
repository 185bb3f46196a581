"""Back-projection on the arrays of any library: every voxel looks up its paths in the wall points'
waveforms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.kernels import MIN_DISTANCE_M
from nlos.method import Progress
from nlos.phasor.arrays import ArrayLibrary, BandTransform, get_traces
from nlos.volume import Grid
from tofclip.arrays import Array
from tofclip.threads import split_blocks

if TYPE_CHECKING:
    from nlos.backprojection import Weighting


# Waveforms held at a time.
TABLE_BYTES = 64 << 20
# A pair of voxel and wall point takes five times as much, in several arrays.
BYTES_PER_PAIR = 16


def backproject_on_device(
    capture: Capture, grid: Grid, band: Band, weighting: Weighting, progress: Progress
) -> Array:
    """Return the complex sum of `nlos.Backprojection` where the capture's signal lives.

    Memory: the volume, 64 MiB of waveforms, and five chunks (`ArrayLibrary.chunk_bytes`) for the
    pairs of voxel and wall point that are looked up at a time.

    Returns (z, y, x).
    """
    library = ArrayLibrary(capture.device)
    rows = _VoxelRows(grid, library, weighting)
    total = library.zeros((rows.count, grid.x.size))
    analysis, pairs = (
        BandTransform(band, capture.axis.bins, library),
        library.chunk_bytes // BYTES_PER_PAIR,
    )
    size = min(TABLE_BYTES // (8 * band.sample_count), max(1, pairs // grid.x.size))
    for points in split_blocks(len(capture.points), max(1, size)):
        waveforms = _Waveforms.of(capture, points, band, analysis)
        count = points.stop - points.start
        for some in split_blocks(rows.count, max(1, pairs // (grid.x.size * count))):
            total[some, :] += rows.look_up(some, waveforms)
            progress((some.stop - some.start) * grid.x.size * count)
    return library.xp.reshape(total, grid.shape)


@dataclass(frozen=True, eq=False)
class _Waveforms:
    """Waveforms of some wall points, one after the other in one flat array, and where these stand."""

    values: Array  # (points * samples,), the first and the last two samples of a point are 0
    sample_count: int
    start: float  # path length of the first sample, and path between samples, m
    spacing: float  # path length of the first sample, and path between samples, m
    first: Array  # (points,), index of each point's first sample
    wall: Array  # (3, points), m; one laser spot, or one for each point
    lasers: Array  # (3, points), m; one laser spot, or one for each point

    @classmethod
    def of(cls, capture: Capture, points: slice, band: Band, analysis: BandTransform) -> _Waveforms:
        """Return the waveforms of some wall points.

        `points`: of its valid wall points; `analysis`: from signals to the band's phasors.
        """
        library, (carriers, start, spacing) = ArrayLibrary(capture.device), band.carriers
        values = analysis.of(get_traces(capture, points)) @ library.put(carriers)
        first = band.sample_count * np.arange(values.shape[0])
        lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[points]
        return cls(
            library.xp.reshape(values, (-1,)),
            band.sample_count,
            start,
            spacing,
            library.put(first),
            library.put(capture.points[points].T),
            library.put(lasers.T),
        )


class _VoxelRows:
    """The rows of voxels along x of a grid, row after row."""

    def __init__(self, grid: Grid, library: ArrayLibrary, weighting: Weighting) -> None:
        self.library, self.weighting = library, weighting
        z, y = np.meshgrid(grid.z, grid.y, indexing="ij")
        self.count = y.size
        self.x = library.put(grid.x[:, np.newaxis])
        self.y, self.z = (library.put(axis.reshape(-1, 1, 1)) for axis in (y, z))

    def look_up(self, some: slice, waveforms: _Waveforms) -> Array:
        """Return what some rows (rows, x) find in the waveforms.

        `some`: of the rows.
        """
        xp, wall = self.library.xp, waveforms.wall
        y, z = self.y[some, ...], self.z[some, ...]
        squared = (
            xp.clip((y - wall[1, :]) ** 2 + (z - wall[2, :]) ** 2, MIN_DISTANCE_M**2, None)
            + (self.x - wall[0, :]) ** 2
        )
        distance, laser = xp.sqrt(squared), waveforms.lasers
        outward = xp.sqrt(
            (self.x - laser[0, :]) ** 2 + (y - laser[1, :]) ** 2 + (z - laser[2, :]) ** 2
        )
        # Samples that the path is late by, in the order in which single precision loses least.
        place = (outward - waveforms.start) * (1 / waveforms.spacing) + distance * (
            1 / waveforms.spacing
        )
        place = xp.clip(place, 0.0, float(waveforms.sample_count - 2))
        before = xp.astype(place, xp.int64)
        weight = place - xp.astype(before, place.dtype)
        index = xp.reshape(before + waveforms.first, (-1,))
        here, there = (
            xp.reshape(xp.take(waveforms.values, one), weight.shape) for one in (index, index + 1)
        )
        return xp.sum(
            (here + weight * (there - here)) * self._compute_weights(distance, z - wall[2, :]),
            axis=-1,
        )

    def _compute_weights(self, distance: Array, ahead: Array) -> Array:
        falloff, obliquity = self.weighting.falloff, self.weighting.obliquity
        weight = 1 / distance if falloff == 1 else distance**-falloff
        if obliquity == 0:
            return weight
        return weight * (self.library.xp.clip(ahead, 0.0, None) / distance) ** obliquity
