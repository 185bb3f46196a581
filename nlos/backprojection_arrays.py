"""Back-projection on the arrays of any library: every voxel looks up its paths in the wall points'
waveforms.
"""

from __future__ import annotations

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
    """Return the complex sum of `nlos.Backprojection` where the capture's signal lives. Memory: the
    volume, 64 MiB of waveforms, and five chunks (`ArrayLibrary.chunk_bytes`) for the pairs of voxel
    and wall point that are looked up at a time.
    """
    library = ArrayLibrary(capture.device)
    xp = library.xp
    z, y = (
        library.put(axis.reshape(-1, 1, 1)) for axis in np.meshgrid(grid.z, grid.y, indexing="ij")
    )
    x, rows = library.put(grid.x[:, np.newaxis]), grid.z.size * grid.y.size
    total = library.zeros((rows, grid.x.size))
    transform = BandTransform(band, capture.axis.bins, library)
    carriers, start, spacing = band.carriers
    carriers, samples = library.put(carriers), band.sample_count
    pairs = library.chunk_bytes // BYTES_PER_PAIR
    size = min(TABLE_BYTES // (8 * samples), max(1, pairs // grid.x.size))
    for points in split_blocks(len(capture.points), max(1, size)):
        # Waveforms of some wall points, one after the other in one flat array; the first and the
        # last two samples of each are 0.
        waveforms = xp.reshape(transform.of(get_traces(capture, points)) @ carriers, (-1,))
        count = points.stop - points.start
        first, wall = library.put(samples * np.arange(count)), library.put(capture.points[points].T)
        lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[points]
        laser = library.put(lasers.T)
        for some in split_blocks(rows, max(1, pairs // (grid.x.size * count))):
            ahead, across = z[some, ...] - wall[2, :], y[some, ...] - wall[1, :]
            squared = xp.clip(across**2 + ahead**2, MIN_DISTANCE_M**2, None)
            distance = xp.sqrt(squared + (x - wall[0, :]) ** 2)
            aside = (y[some, ...] - laser[1, :]) ** 2 + (z[some, ...] - laser[2, :]) ** 2
            outward = xp.sqrt((x - laser[0, :]) ** 2 + aside)
            # Samples that the path is late by, in the order in which single precision loses least.
            position = (outward - start) * (1 / spacing) + distance * (1 / spacing)
            position = xp.clip(position, 0.0, float(samples - 2))
            before = xp.astype(position, xp.int64)
            weight, index = position - xp.astype(before, position.dtype), before + first
            here, there = (
                xp.reshape(xp.take(waveforms, xp.reshape(one, (-1,))), weight.shape)
                for one in (index, index + 1)
            )
            factor = 1 / distance if weighting.falloff == 1 else distance**-weighting.falloff
            if weighting.obliquity != 0:
                cosine = xp.clip(ahead, 0.0, None) / distance
                factor = factor * cosine**weighting.obliquity
            total[some, :] += xp.sum((here + weight * (there - here)) * factor, axis=-1)
            progress((some.stop - some.start) * grid.x.size * count)
    return xp.reshape(total, grid.shape)
