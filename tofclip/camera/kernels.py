"""The compiled resampling of streak images."""

from __future__ import annotations

import numpy as np
from numba import njit

TILE = 32  # columns that are written together: reading goes along rows, writing along columns


@njit(nogil=True, cache=True)
def sample(signal, bad, raw_row, raw_column, late, readings, good):
    """Sample raw pixels bilinearly and write them transposed.

    Parameters
    ----------
    signal : (rows, columns) float32 array
    bad : (rows, columns) bool array
    raw_row, raw_column : (rows, some columns) float32 arrays
        Where each rectified pixel of these columns lies in the raw image.
    late : float
        Rows to add to all raw rows.
    readings : (some columns, rows) float32 array, overwritten
        0 beyond the raw image.
    good : (some columns, rows) bool array, overwritten
        False beyond the raw image and where a raw pixel that counts is bad.
    """
    rows, columns = signal.shape
    for start in range(0, raw_row.shape[1], TILE):
        for r in range(rows):
            for c in range(start, min(start + TILE, raw_row.shape[1])):
                y, x = raw_row[r, c] + late, raw_column[r, c]
                if y < 0 or y > rows - 1 or x < 0 or x > columns - 1:
                    readings[c, r] = 0
                    good[c, r] = False
                    continue
                top, left = max(min(int(y), rows - 2), 0), max(min(int(x), columns - 2), 0)
                down, right = np.float32(y - top), np.float32(x - left)
                below, beside = min(top + 1, rows - 1), min(left + 1, columns - 1)  # a picture may be one row high
                upper = signal[top, left] + right * (signal[top, beside] - signal[top, left])
                lower = signal[below, left] + right * (signal[below, beside] - signal[below, left])
                readings[c, r] = upper + down * (lower - upper)
                spoilt = bad[top, left] and down < 1 and right < 1
                spoilt |= bad[top, beside] and down < 1 and right > 0
                spoilt |= bad[below, left] and down > 0 and right < 1
                spoilt |= bad[below, beside] and down > 0 and right > 0
                good[c, r] = not spoilt
