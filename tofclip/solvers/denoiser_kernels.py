"""Compiled loops of the denoisers."""

from __future__ import annotations

import numpy as np
from numba import njit

fast_njit = njit(
    nogil=True, cache=True, fastmath={"contract", "nsz", "arcp", "reassoc"}, error_model="numpy"
)


@fast_njit
def _patch_distances(pilot, row, column, patch, reach, distances, corners):
    """Squared distances of the patches around one; `corners` gets where they begin. Returns how
    many there are.

    The patch itself comes first, so that it is in its own group however many others are just like
    it.
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


@fast_njit
def _keep_nearest(distances, corners, count, wanted):
    """Move the `wanted` nearest corners to the front; returns how many there are."""
    if count <= wanted:
        return count
    # The limit alone, not the whole order: which of the nearest comes first does not matter.
    limit = np.partition(distances[:count], wanted - 1)[wanted - 1]
    kept = 0
    for candidate in range(count):
        if distances[candidate] <= limit and kept < wanted:
            corners[kept] = corners[candidate]
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
def _wiener_gain(centred, variance):
    """Return ``(C + variance I)^-1 C`` of the group's covariance C."""
    covariance = np.dot(centred.T, centred) / np.float32(centred.shape[0])
    # The pilot has no noise left, so that C is the signal alone; the noise is white and loads the
    # diagonal.
    loaded = covariance.copy()
    for pixel in range(loaded.shape[0]):
        loaded[pixel, pixel] += variance
    return np.linalg.solve(loaded, covariance)


@fast_njit
def _scatter_patches(group, corners, patch, weight, total, weights):
    for member in range(group.shape[0]):
        row, column = corners[member]
        for i in range(patch):
            for j in range(patch):
                total[row + i, column + j] += weight * group[member, i * patch + j]
                weights[row + i, column + j] += weight


@fast_njit
def filter_patch_groups(noisy, pilot, deviation, settings):
    """Filter groups of similar patches and average where they overlap, steadier groups counting
    more.

    `settings` is (side of a patch, stride, reach of the search, patches in a group); pictures are
    float32.

    Parameters
    ----------
    noisy : (rows, columns) float32 array
    pilot : (rows, columns) float32 array
        A first estimate, in which similar patches are looked for and the filter's gain is found.
    deviation : float32
        Standard deviation of the noise, in the pictures' unit.
    settings : (int, int, int, int)
        Side of a patch and stride in pixels, reach of the search in pixels, patches in a group.

    Returns
    -------
    (rows, columns) float32 array
        Weighted average of the overlapping patches.
    """
    patch, stride, reach, wanted = settings
    rows, columns = noisy.shape
    total, weights = np.zeros_like(noisy), np.zeros_like(noisy)
    around = (2 * reach + 1) ** 2
    distances, corners = np.empty(around, np.float32), np.empty((around, 2), np.int64)
    # a noise level of zero would make the gain's matrix singular
    variance = max(deviation * deviation, np.float32(1e-12))
    for step_row in range((rows - patch + stride - 1) // stride + 1):
        # The last patch ends at the border, so that no pixel is left without one.
        row = min(step_row * stride, rows - patch)
        for step_column in range((columns - patch + stride - 1) // stride + 1):
            column = min(step_column * stride, columns - patch)
            count = _patch_distances(pilot, row, column, patch, reach, distances, corners)
            members = _keep_nearest(distances, corners, count, wanted)
            alike, seen = (
                np.empty((members, patch * patch), np.float32),
                np.empty((members, patch * patch), np.float32),
            )
            _gather_patches(pilot, corners, patch, alike)
            _gather_patches(noisy, corners, patch, seen)
            # The gain is found on the pilot and applied to the noisy patches: their own noise would
            # look like signal.
            mean = alike.sum(axis=0) / np.float32(members)
            gain = _wiener_gain(alike - mean, variance)
            clean = np.dot(seen - mean, gain) + mean
            _scatter_patches(
                # The trace is the number of unknowns that the filter lets through; the fewer, the
                # less noise is left.
                clean,
                corners,
                patch,
                1 / (np.trace(gain) + np.float32(1)),
                total,
                weights,
            )
    return total / weights
