"""Compiled inner loops between the albedo of voxels and the photons that a wall counts."""

from __future__ import annotations

import math

import numpy as np

from nlos.kernels import MIN_DISTANCE_M, compiled

# Voxels whose light is placed in time together: their edges stay in the first cache level.
VOXELS_PER_RUN = 256
# Light of one voxel is spread over at least a bin, so that its mean arrival is kept.
MIN_WIDTH_BINS = 1.0


@compiled
def _place_light(wall, laser, cell, start, per_metre, obliquity, voxels, bins, light):
    """When and how strongly the light of some voxels arrives by way of one pair of spots.

    A voxel's light is spread evenly over a time whose variance is that of the paths by way of its
    whole volume.

    `wall, laser` (3,): m; `cell` (3,): extent of a voxel along x, y and z, m; `start`: path at
    which the first bin begins, m; `per_metre`: bins per metre of path; `obliquity`: power of the
    cosines of both legs with z that light falls by: 0, 1 or 2; `voxels`: x, y and z (n,), m;
    `light`: overwritten: when it begins and ends (n,), in bins from the record's beginning, cut to
    it, and light per bin between the edges, of a voxel of albedo 1.
    """
    nearest = np.float32(MIN_DISTANCE_M * MIN_DISTANCE_M)
    (x, y, z), (begins, ends, rates) = voxels, light
    for i in range(x.size):
        out_x, out_y, out_z = x[i] - laser[0], y[i] - laser[1], z[i] - laser[2]
        back_x, back_y, back_z = x[i] - wall[0], y[i] - wall[1], z[i] - wall[2]
        outward = math.sqrt(max(out_x * out_x + out_y * out_y + out_z * out_z, nearest))
        back = math.sqrt(max(back_x * back_x + back_y * back_y + back_z * back_z, nearest))
        per_outward, per_back = np.float32(1) / outward, np.float32(1) / back
        # the path's gradient, times the voxel's extent
        along_x = (out_x * per_outward + back_x * per_back) * cell[0]
        along_y = (out_y * per_outward + back_y * per_back) * cell[1]
        along_z = (out_z * per_outward + back_z * per_back) * cell[2]
        # An even spread of this width has the variance of the three along the axes together.
        spread = math.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
        width = max(spread * per_metre, np.float32(MIN_WIDTH_BINS))
        middle = (outward + back - start) * per_metre
        half = np.float32(0.5) * width
        begins[i] = min(max(middle - half, np.float32(0)), np.float32(bins))
        ends[i] = min(max(middle + half, np.float32(0)), np.float32(bins))
        # Light falls with the square of either leg.
        fall = per_outward * per_back
        rates[i] = fall * fall / width
        if obliquity > 0:
            cosines = max(out_z * back_z, np.float32(0)) * fall
            rates[i] *= cosines if obliquity == 1 else cosines * cosines


@compiled
def add_expected_light(walls, lasers, cell, start, per_metre, obliquity, voxels, albedo, changes):
    """Add the light that voxels send to wall points, as changes from bin to bin. `walls` (points,
    3); `lasers` (1, 3); `cell, start, per_metre, obliquity`: as of `_place_light`; `voxels` (3, n):
    m; `albedo` (n,); `changes` (points, bins + 2): added to; its running sum is the light in every
    bin.
    """
    bins = changes.shape[1] - 2
    begins = np.empty(VOXELS_PER_RUN, np.float32)
    ends, rates = np.empty_like(begins), np.empty_like(begins)
    light = (begins, ends, rates)
    for p in range(walls.shape[0]):
        laser = lasers[min(p, lasers.shape[0] - 1)]
        for first in range(0, voxels.shape[1], VOXELS_PER_RUN):
            last = min(first + VOXELS_PER_RUN, voxels.shape[1])
            some = voxels[0, first:last], voxels[1, first:last], voxels[2, first:last]
            _place_light(walls[p], laser, cell, start, per_metre, obliquity, some, bins, light)
            for i in range(last - first):
                sent = np.float64(albedo[first + i] * rates[i])
                begin, end = np.int32(begins[i]), np.int32(ends[i])
                after = np.float64(begins[i] - np.float32(begin)) * sent
                # Only the two edges of the box are written, each shared between two bins; the
                # running sum afterwards fills what lies between, however wide.
                changes[p, begin] += sent - after
                changes[p, begin + 1] += after
                after = np.float64(ends[i] - np.float32(end)) * sent
                changes[p, end] -= sent - after
                changes[p, end + 1] -= after


@compiled
def add_backprojected_light(
    walls, lasers, cell, start, per_metre, obliquity, voxels, sums, squared, total
):
    """Add to every voxel what the bins hold that its light arrives in: the adjoint of
    `add_expected_light`. `walls` (points, 3); `lasers` (1, 3); `cell, start, per_metre, obliquity`:
    as of `_place_light`; `voxels` (3, n): m; `sums` (points, bins + 2): of every bin and all later
    ones; 0 behind the record; `squared`: whether every bin counts by the square of the light that a
    voxel sends it; `total` (n,): added to.
    """
    bins = sums.shape[1] - 2
    begins = np.empty(VOXELS_PER_RUN, np.float32)
    ends, rates = np.empty_like(begins), np.empty_like(begins)
    light = (begins, ends, rates)
    for first in range(0, voxels.shape[1], VOXELS_PER_RUN):
        last = min(first + VOXELS_PER_RUN, voxels.shape[1])
        for p in range(walls.shape[0]):
            laser = lasers[min(p, lasers.shape[0] - 1)]
            some = voxels[0, first:last], voxels[1, first:last], voxels[2, first:last]
            _place_light(walls[p], laser, cell, start, per_metre, obliquity, some, bins, light)
            for i in range(last - first):
                begin, end = np.int32(begins[i]), np.int32(ends[i])
                after = begins[i] - np.float32(begin)
                # The box's sum is the difference of two running sums, interpolated like the edges.
                value = sums[p, begin] + after * (sums[p, begin + 1] - sums[p, begin])
                after = ends[i] - np.float32(end)
                value -= sums[p, end] + after * (sums[p, end + 1] - sums[p, end])
                total[first + i] += value * (rates[i] * rates[i] if squared else rates[i])
