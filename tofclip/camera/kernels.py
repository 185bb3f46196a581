"""The compiled resampling of streak images.

Pictures are (columns, rows) here: a view's sweep moves along the rows of the sensor, so that
successive measurements of one column lie side by side, before and after.
"""

from __future__ import annotations

import numpy as np
from numba import njit

fast_njit = njit(nogil=True, cache=True, fastmath=True, error_model="numpy")


@fast_njit
def sample_in_time(counts, dark, raw_row, delay, measurements):
    """Sample every column linearly between two of its rows, and take off the dark level.

    Parameters
    ----------
    counts : (columns, rows) float32 array
    dark : float32
    raw_row : (columns, rows) float32 array
        Where each rectified pixel lies in the raw image.
    delay : float32
        Rows to add to all raw rows.
    measurements : (columns, rows) float32 array, overwritten
        0 beyond the raw image.
    """
    rows, zero = counts.shape[1], np.int32(0)
    last, lowest, below = (
        np.float32(rows - 1),
        np.int32(max(rows - 2, 0)),
        np.int32(min(1, rows - 1)),
    )
    for column in range(counts.shape[0]):
        raw, position, reading = counts[column], raw_row[column], measurements[column]
        for row in range(position.size):
            y = position[row] + delay
            top = min(max(np.int32(y), zero), lowest)
            upper, lower = raw[top], raw[top + below]
            value = upper + (y - np.float32(top)) * (lower - upper) - dark
            reading[row] = value if y >= 0 and y <= last else np.float32(0)


@fast_njit
def sample_bilinear(counts, dark, raw_row, raw_column, delay, measurements):
    """Sample bilinearly; see `sample_in_time`.

    Parameters
    ----------
    counts : (raw columns, rows) float32 array
    dark : float
        Level that is taken off, counts.
    raw_row, raw_column : (some columns, rows) float32 array
        Where each measurement lies in the raw image, pixels.
    delay : float
        Rows by which the light comes later than the sweep says.
    measurements : (some columns, rows) float32 array
        Overwritten.
    """
    columns, rows = counts.shape
    flat, zero, length = counts.reshape(counts.size), np.int32(0), np.int32(rows)
    last_row, lowest, below = (
        np.float32(rows - 1),
        np.int32(max(rows - 2, 0)),
        np.int32(min(1, rows - 1)),
    )
    last_column, rightmost = np.float32(columns - 1), np.int32(max(columns - 2, 0))
    beside = np.int32(min(1, columns - 1)) * length
    for column in range(raw_row.shape[0]):
        down, across, reading = raw_row[column], raw_column[column], measurements[column]
        for row in range(down.size):
            y, x = down[row] + delay, across[row]
            top, left = min(max(np.int32(y), zero), lowest), min(max(np.int32(x), zero), rightmost)
            right, here = x - np.float32(left), left * length + top
            upper = flat[here] + right * (flat[here + beside] - flat[here])
            lower = flat[here + below] + right * (flat[here + beside + below] - flat[here + below])
            value = upper + (y - np.float32(top)) * (lower - upper) - dark
            inside = y >= 0 and y <= last_row and x >= 0 and x <= last_column
            reading[row] = value if inside else np.float32(0)


@njit(nogil=True, cache=True, error_model="numpy")
def mark_valid(bad, raw_row, raw_column, delay, valid):
    """Mark the measurements that lie within the raw image and to which no bad pixel contributes.

    Parameters
    ----------
    bad : (rows, raw columns) bool array
    raw_row, raw_column, delay
        As for `sample_bilinear`.
    valid : (some columns, rows) bool array, overwritten
    """
    rows, columns = bad.shape
    for column in range(valid.shape[0]):
        for row in range(valid.shape[1]):
            y, x = raw_row[column, row] + delay, raw_column[column, row]
            valid[column, row] = 0 <= y <= rows - 1 and 0 <= x <= columns - 1
            if valid[column, row]:
                top, left = np.uintp(y), np.uintp(x)
                # a pixel right on another one has nothing of the next
                below, beside = (
                    top + np.uintp(y > np.float32(top)),
                    left + np.uintp(x > np.float32(left)),
                )
                if bad[top, left] or bad[top, beside] or bad[below, left] or bad[below, beside]:
                    valid[column, row] = False
