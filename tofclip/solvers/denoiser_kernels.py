"""Compiled loops of the denoisers."""

from __future__ import annotations

import numpy as np

from tofclip.compiling import SUMS_IN_ANY_ORDER, compile_and_keep

fast_njit = compile_and_keep(fastmath=SUMS_IN_ANY_ORDER, error_model="numpy")


@fast_njit
def _patch_distances(pilot, row, column, patch, reach, distances, corners):
    """Squared distances of the patches around one; `corners` gets where they begin. Returns how
    many there are. The patch itself comes first, so that it is in its own group however many others
    are just like it.
    """
    distances[0] = -1
    corners[0, 0], corners[0, 1] = row, column
    count = 1
    last_row, last_column = pilot.shape[0] - patch, pilot.shape[1] - patch
    for other_row in range(max(0, row - reach), min(last_row, row + reach) + 1):
        for other_column in range(max(0, column - reach), min(last_column, column + reach) + 1):
            if other_row == row and other_column == column:
                continue
            distance = np.float32(0)
            for i in range(patch):
                for j in range(patch):
                    difference = pilot[other_row + i, other_column + j] - pilot[row + i, column + j]
                    distance += difference * difference
            distances[count] = distance
            corners[count, 0], corners[count, 1] = other_row, other_column
            count += 1
    return count


# Plain loops, where NumPy has functions: numba took 26 s to compile its partition, its solve and its
# sums over axes with all that they check. Compiled loops are as quick, after 6 s.
@fast_njit
def _find_smallest(values, count, wanted):
    """Return the `wanted`-th smallest of the first `count` values, in any order left in `values`."""
    first, last = 0, count - 1
    while first < last:
        pivot = values[(first + last) // 2]
        low, high = first, last
        while low <= high:
            while values[low] < pivot:
                low += 1
            while values[high] > pivot:
                high -= 1
            if low <= high:
                values[low], values[high] = values[high], values[low]
                low += 1
                high -= 1
        if wanted - 1 <= high:
            last = high
        elif wanted - 1 >= low:
            first = low
        else:
            break
    return values[wanted - 1]


@fast_njit
def _keep_nearest(distances, corners, count, wanted):
    """Move the `wanted` nearest corners to the front; returns how many there are."""
    if count <= wanted:
        return count
    # The limit alone, not the whole order: which of the nearest comes first does not matter.
    limit = _find_smallest(distances[:count].copy(), count, wanted)
    kept = 0
    for candidate in range(count):
        if distances[candidate] <= limit and kept < wanted:
            corners[kept, 0], corners[kept, 1] = corners[candidate, 0], corners[candidate, 1]
            kept += 1
    return kept


@fast_njit
def _gather_patches(picture, corners, patch, group):
    for member in range(group.shape[0]):
        row, column = corners[member]
        for i in range(patch):
            for j in range(patch):
                group[member, i * patch + j] = picture[row + i, column + j]


@fast_njit
def _subtract_row(matrix, row, factor, other):
    for column in range(matrix.shape[1]):
        matrix[row, column] -= factor * matrix[other, column]


@fast_njit
def _scale_row(matrix, row, factor):
    for column in range(matrix.shape[1]):
        matrix[row, column] *= factor


@fast_njit
def _wiener_gain(centred, variance):
    """Return ``(C + variance I)^-1 C`` of the group's covariance C, by Cholesky's factors."""
    # The pilot has no noise left, so that C is the signal alone; the noise is white and loads the
    # diagonal.
    gain = np.dot(centred.T, centred) / np.float32(centred.shape[0])
    factor = gain.copy()
    pixels = gain.shape[0]
    greatest = np.float32(0)
    for i in range(pixels):
        greatest = max(greatest, gain[i, i])
    # what rounding adds in this many sums would make the matrix indefinite
    load = max(variance, pixels * np.float32(1e-7) * greatest)
    for i in range(pixels):
        factor[i, i] += load
    for i in range(pixels):
        for k in range(i + 1):
            rest = factor[i, k]
            for j in range(k):
                rest -= factor[i, j] * factor[k, j]
            factor[i, k] = np.sqrt(max(rest, load)) if i == k else rest / factor[k, k]
    for i in range(pixels):
        for k in range(i):
            _subtract_row(gain, i, factor[i, k], k)
        _scale_row(gain, i, 1 / factor[i, i])
    for i in range(pixels - 1, -1, -1):
        for k in range(i + 1, pixels):
            _subtract_row(gain, i, factor[k, i], k)
        _scale_row(gain, i, 1 / factor[i, i])
    return gain


@fast_njit
def _subtract_mean(alike, seen, mean):
    """Take the mean of the members of one group off those of both."""
    mean[:] = 0
    for member in range(alike.shape[0]):
        for pixel in range(mean.size):
            mean[pixel] += alike[member, pixel]
    for pixel in range(mean.size):
        mean[pixel] /= np.float32(alike.shape[0])
    for member in range(alike.shape[0]):
        for pixel in range(mean.size):
            alike[member, pixel] -= mean[pixel]
            seen[member, pixel] -= mean[pixel]


@fast_njit
def _scatter_patches(group, mean, corners, patch, weight, total, weights):
    for member in range(group.shape[0]):
        row, column = corners[member]
        for i in range(patch):
            for j in range(patch):
                pixel = i * patch + j
                total[row + i, column + j] += weight * (group[member, pixel] + mean[pixel])
                weights[row + i, column + j] += weight


@fast_njit
def filter_patch_groups(noisy, pilot, deviation, settings):
    """Filter groups of similar patches and average where they overlap, steadier groups counting
    more. `settings` are the side of a patch and the stride in pixels, the reach of the search in
    pixels, and the patches in a group. Groups and the filter's gain are found in the pilot.
    Pictures are float32.
    """
    patch, stride, reach, wanted = settings
    rows, columns = noisy.shape
    total, weights = np.zeros_like(noisy), np.zeros_like(noisy)
    around = (2 * reach + 1) ** 2
    distances, corners = np.empty(around, np.float32), np.empty((around, 2), np.int64)
    mean = np.empty(patch * patch, np.float32)
    # a noise level of zero would make the gain's matrix singular
    variance = max(deviation * deviation, np.float32(1e-12))
    for step_row in range((rows - patch + stride - 1) // stride + 1):
        # The last patch ends at the border, so that no pixel is left without one.
        row = min(step_row * stride, rows - patch)
        for step_column in range((columns - patch + stride - 1) // stride + 1):
            column = min(step_column * stride, columns - patch)
            count = _patch_distances(pilot, row, column, patch, reach, distances, corners)
            members = _keep_nearest(distances, corners, count, wanted)
            alike = np.empty((members, patch * patch), np.float32)
            seen = np.empty((members, patch * patch), np.float32)
            _gather_patches(pilot, corners, patch, alike)
            _gather_patches(noisy, corners, patch, seen)
            # The gain is found on the pilot and applied to the noisy patches: their own noise would
            # look like signal.
            _subtract_mean(alike, seen, mean)
            gain = _wiener_gain(alike, variance)
            clean = np.dot(seen, gain)
            # The trace is the number of unknowns that the filter lets through, beside the mean; the
            # fewer, the less noise is left.
            kept = np.float32(1)
            for pixel in range(patch * patch):
                kept += gain[pixel, pixel]
            _scatter_patches(clean, mean, corners, patch, 1 / kept, total, weights)
    for row in range(rows):
        for column in range(columns):
            total[row, column] /= weights[row, column]
    return total
