"""Compiled inner loops of around-the-corner imaging."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# Only the fusing of multiply and add is let loose: exact zeros at the ends of the waveforms have to stay exact.
compiled = njit(nogil=True, cache=True, fastmath={"contract"}, error_model="numpy")

NEAREST = 1e-3
"""Distance in m below which the weight 1 / distance stops growing, for voxels that touch the wall."""


@compiled
def delayed_reading(signal, late_bins):
    """Read column p of `signal` (t, points) `late_bins[p]` bins later, linearly interpolated, 0 outside the record."""
    bins, points = signal.shape
    result = np.zeros_like(signal)
    for i in range(bins):
        for p in range(points):
            position = i + late_bins[p]
            if 0 <= position <= bins - 1:
                before = min(int(position), bins - 2)
                share = np.float32(position - before)
                result[i, p] = signal[before, p] + share * (signal[before + 1, p] - signal[before, p])
    return result


@compiled
def add_backprojection(waveforms, start, spacing, wall, lasers, x, y, z, powers, field):
    """Add every wall point's waveform, read at each voxel's path and divided by the last leg, to `field`.

    Meant for a brick of voxels so small that their paths to a wall point span a short piece of its waveform, which
    then stays in the first cache level while the voxels' sums stay in the second.

    Parameters
    ----------
    waveforms : (points, 2 * samples) float32 array
        Real and imaginary parts in turns; the first and the last two samples are 0.
    start, spacing : float32
        Path length of the first sample and path between samples, m.
    wall : (points, 3) float32 array
    lasers : (1, 3) or (points, 3) float32 array
        One laser spot for all wall points or one for each.
    x, y, z : float32 array
        Axes of the brick.
    powers : (2,) float32 array
        Further weights: powers of the last leg's length and of the cosine of its angle with z.
    field : (z, y, x) complex64 array
    """
    per_metre = np.float32(1) / spacing
    # Of every voxel: real and imaginary part of the sample before its path, then of the one after.
    sums = np.zeros((z.size, y.size, 4 * x.size), np.float32)
    outward = np.empty((z.size, y.size, x.size), np.float32)
    sample, before, after = np.empty(x.size, np.int32), np.empty(x.size, np.float32), np.empty(x.size, np.float32)
    weighted = powers[0] != 0 or powers[1] != 0
    for p in range(wall.shape[0]):
        if p == 0 or (p < lasers.shape[0] and _differ(lasers[p], lasers[p - 1])):
            _outward_samples(lasers[p], start, per_metre, x, y, z, outward)
        for iz in range(z.size):
            for iy in range(y.size):
                across = (y[iy] - wall[p, 1]) ** 2 + (z[iz] - wall[p, 2]) ** 2
                last = np.float32(waveforms.shape[1] // 2 - 2)
                _find_samples(x, wall[p, 0], across, outward[iz, iy], per_metre, last, sample, before, after)
                if weighted:
                    _weigh(x, wall[p, 0], across, max(z[iz] - wall[p, 2], np.float32(0)), powers, before, after)
                _add_samples(waveforms[p], sample, before, after, sums[iz, iy])
    for iz in range(z.size):
        for iy in range(y.size):
            row = sums[iz, iy].reshape(-1, 2, 2)
            for ix in range(x.size):
                field[iz, iy, ix] += complex(row[ix, 0, 0] + row[ix, 1, 0], row[ix, 0, 1] + row[ix, 1, 1])


@compiled
def _differ(one, other):
    """Whether two points do; in an exhaustive capture many in a row are the same."""
    return one[0] != other[0] or one[1] != other[1] or one[2] != other[2]


@compiled
def _outward_samples(laser, start, per_metre, x, y, z, outward):
    """Distance from the laser spot to every voxel, less `start`, in samples."""
    for iz in range(z.size):
        for iy in range(y.size):
            across = (y[iy] - laser[1]) ** 2 + (z[iz] - laser[2]) ** 2
            for ix in range(x.size):
                outward[iz, iy, ix] = (math.sqrt((x[ix] - laser[0]) ** 2 + across) - start) * per_metre


@compiled
def _find_samples(x, wall_x, across, outward, per_metre, last, sample, before, after):
    """Where a row of voxels reads a waveform: index of the sample before, and the weights of it and of the next."""
    across = max(across, np.float32(NEAREST * NEAREST))
    for ix in range(x.size):
        distance = math.sqrt((x[ix] - wall_x) ** 2 + across)
        position = min(max(outward[ix] + distance * per_metre, np.float32(0)), last)
        index = np.int32(position)
        sample[ix] = np.int32(2) * index
        weight = np.float32(1) / distance
        after[ix] = (position - np.float32(index)) * weight
        before[ix] = weight - after[ix]


@compiled
def _power(base, exponent):
    """Power of a number, quick for the exponents that occur most."""
    if exponent == 0:
        return np.float32(1)
    if exponent == 1:
        return base
    return base**exponent


@compiled
def _weigh(x, wall_x, across, ahead, powers, before, after):
    """Multiply the weights of a row of voxels by powers of their distance and of the cosine of their direction."""
    across = max(across, np.float32(NEAREST * NEAREST))
    for ix in range(x.size):
        distance = math.sqrt((x[ix] - wall_x) ** 2 + across)
        factor = _power(distance, powers[0]) * _power(ahead / distance, powers[1])
        before[ix] *= factor
        after[ix] *= factor


@compiled
def _add_samples(waveform, sample, before, after, sums):
    """Add two neighbouring complex samples per voxel: four adjacent numbers, one vector load, one multiply-add."""
    for ix in range(sample.size):
        first, place = np.uint32(sample[ix]), 4 * ix
        sums[place] += before[ix] * waveform[first]
        sums[place + 1] += before[ix] * waveform[first + 1]
        sums[place + 2] += after[ix] * waveform[first + 2]
        sums[place + 3] += after[ix] * waveform[first + 3]
