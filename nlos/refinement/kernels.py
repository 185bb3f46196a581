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
    """Overwrite `light` with when the light of voxels, x, y and z (n,), m, begins and ends by way
    of one pair of spots, bins cut to the record, and its rate per bin of albedo 1: spread evenly
    over a time of the variance of paths by way of the whole voxel, of extent `cell` (3,), m.
    `start`: path of the first bin's beginning; `obliquity`: power of both legs' cosines with z, 0
    to 2.
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
    """Add the light that voxels (3, n), m, of an albedo (n,) send to wall points, as changes from
    bin to bin (points, bins + 2), whose running sum it is; other arguments as of `_place_light`.
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
                # Only the box's edges are written, shared between bins; the running sum fills it.
                changes[p, begin] += sent - after
                changes[p, begin + 1] += after
                after = np.float64(ends[i] - np.float32(end)) * sent
                changes[p, end] -= sent - after
                changes[p, end + 1] -= after


@compiled
def add_backprojected_light(
    walls, lasers, cell, start, per_metre, obliquity, voxels, sums, squared, total
):
    """Add to `total` (n,) what the bins hold that a voxel's light arrives in: the adjoint of
    `add_expected_light`. `sums` (points, bins + 2): of every bin and all later ones, 0 behind the
    record; `squared`: bins count by the square of the light.
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
