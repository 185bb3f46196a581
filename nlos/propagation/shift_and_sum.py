"""From wall to plane in time, as the paper does it: signals shifted by their ways and added up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.band import Band
from nlos.geometry import Grid
from nlos.illumination_groups import find_leg_bounds
from nlos.method import Progress, ignore_progress
from nlos.plane import Plane
from nlos.propagation.kernels import shift_and_sum
from tofclip.threads import run_blocks

FloatArray = NDArray[np.float64]

POINTS_PER_BLOCK = 64


def propagate_in_time(
    points: FloatArray,
    traces: NDArray[np.float32],
    plane: Plane,
    band: Band,
    legs: int,
    progress: Progress = ignore_progress,
) -> NDArray[np.complex64]:
    """Return the band's phasors of transients propagated onto a plane bin by bin.

    Every signal arrives on the plane earlier by its way there, interpolated linearly between bins:
    an error of some
    0.5 % for 15 bins per wavelength, growing as the square of their width. Costs a product per pair
      of points and bin,
    and memory for a few transients.

    Supplementary Note 12 of X. Feng, Y. Ma, L. Gao, Nat. Commun. 13, 3333 (2022).

    `points` (n, 3): m; `traces` (n, t); `legs`: how often light runs between wall and plane: 2 in a
    confocal scan; `progress`: called with the number of values just done. Returns (y, x,
    frequencies).
    """
    targets = plane.points.reshape(-1, 3)
    scale = legs / band.axis.spacing
    nearest, farthest = find_leg_bounds(points, Grid(plane.x, plane.y, np.array([plane.z])))
    latest = np.ceil(farthest * scale)
    bins = traces.shape[1] + int(latest - np.floor(nearest * scale)) + 2
    paths = band.axis.start + band.axis.spacing * (np.arange(bins) - latest)
    analysis = (band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))).astype(np.complex64)
    field = np.empty((len(targets), band.wavenumbers.size), np.complex64)

    def process_block(some: slice) -> None:
        sums = np.zeros((some.stop - some.start, bins), np.float32)
        shift_and_sum(traces, points, targets[some], scale, float(latest), sums)
        field[some] = sums @ analysis
        progress(field[some].size)

    run_blocks(process_block, len(targets), size=POINTS_PER_BLOCK)
    return field.reshape(*plane.shape, -1)
