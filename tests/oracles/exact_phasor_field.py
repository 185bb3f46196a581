"""The definition of the phasor-field image, summed term by term in float64: what methods answer to."""

import numpy as np

from nlos.band import Band
from nlos.capture import TimeAxis
from nlos.method import require_imageable
from nlos.volume import Volume

TERMS_PER_BLOCK = 1 << 15
"""Distances held at a time, so that what is computed of them stays in the processor's cache."""


def compute_exact_phasor_field(capture, grid, pulse):
    """Sum ``P_k(r_p) * exp(1j * k * (|r_L - r| + |r - r_p|)) / |r - r_p|`` over the band and the
    wall.

    The record is followed by silence. Frequencies are evenly spaced, so that each one's waves are
    the last one's turned by the same angle: in float64 a thousand turns leave 1e-13.
    """
    require_imageable(capture, grid)
    band = Band(pulse, follow_by_silence(capture, grid))
    phasors = band.compute_phasors(capture.traces().astype(np.float64))
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    voxels = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    field = np.empty(len(voxels), np.complex128)
    count = max(1, TERMS_PER_BLOCK // len(capture.points))
    for first in range(0, len(voxels), count):
        some = slice(first, first + count)
        field[some] = _sum_over_wall(capture, voxels[some], band.wavenumbers, phasors)
    return Volume(field.reshape(grid.shape), grid, capture.provenance)


def follow_by_silence(capture, grid):
    """The record's axis and twice as much again, beyond every path: evenly spaced frequencies repeat a
    record with their period, and what was not recorded is dark.
    """
    corners = np.array([(axis[0], axis[-1]) for axis in (grid.x, grid.y, grid.z)])
    ends = np.concatenate([capture.points, capture.lasers, corners.T])
    longest = 2 * float(np.linalg.norm(np.ptp(ends, axis=0)))
    bins = max(capture.axis.bins, int(longest / capture.axis.spacing))
    return TimeAxis(2 * bins, capture.axis.bin_width, capture.axis.start)


def _sum_over_wall(capture, voxels, wavenumbers, phasors):
    last_leg = np.linalg.norm(voxels[:, np.newaxis] - capture.points, axis=-1)
    path = last_leg + np.linalg.norm(voxels[:, np.newaxis] - capture.lasers, axis=-1)
    step = np.diff(wavenumbers).mean()
    np.testing.assert_allclose(np.diff(wavenumbers), step, rtol=1e-9)
    waves, turn = np.exp(1j * wavenumbers[0] * path) / last_leg, np.exp(1j * step * path)
    field = np.zeros(len(voxels), np.complex128)
    for at_k in phasors.T:
        field += waves @ at_k
        waves *= turn
    return field
