"""The compiled resampling of streak images."""

from __future__ import annotations

import numpy as np
from numba import njit

TILE = 32  # columns that are written together: reading goes along rows, writing along columns


@njit(nogil=True, cache=True, error_model="numpy")
def sample(signal, bad, near_bad, raw_row, raw_column, late, readings, good):
    """Sample raw pixels bilinearly and write them transposed.

    Parameters
    ----------
    signal : (rows, columns) float32 array
    bad : (rows, columns) bool array
    near_bad : (rows, columns) bool array
        Whether the pixel, or the one below, beside, or below and beside it, is bad.
    raw_row, raw_column : (rows, some columns) float32 arrays
        Where each rectified pixel of these columns lies in the raw image.
    late : float32
        Rows to add to all raw rows.
    readings : (some columns, rows) float32 array, overwritten
        0 beyond the raw image.
    good : (some columns, rows) bool array, overwritten
        False beyond the raw image and where a raw pixel that counts is bad.
    """
    rows, columns = signal.shape
    lowest, rightmost = np.uintp(max(rows - 2, 0)), np.uintp(max(columns - 2, 0))
    one, last_row, last_column = np.uintp(1), np.uintp(rows - 1), np.uintp(columns - 1)
    for start in range(0, raw_row.shape[1], TILE):
        for r in range(rows):
            for c in range(start, min(start + TILE, raw_row.shape[1])):
                y, x = raw_row[r, c] + late, raw_column[r, c]
                if y < 0 or y > rows - 1 or x < 0 or x > columns - 1:
                    readings[c, r] = 0
                    good[c, r] = False
                    continue
                top, left = min(np.uintp(y), lowest), min(np.uintp(x), rightmost)
                below, beside = min(top + one, last_row), min(left + one, last_column)  # it may be one row high
                down, right = y - np.float32(top), x - np.float32(left)
                upper = signal[top, left] + right * (signal[top, beside] - signal[top, left])
                lower = signal[below, left] + right * (signal[below, beside] - signal[below, left])
                readings[c, r] = upper + down * (lower - upper)
                good[c, r] = True
                if near_bad[top, left]:
                    spoilt = bad[top, left] and down < 1 and right < 1
                    spoilt |= bad[top, beside] and down < 1 and right > 0
                    spoilt |= bad[below, left] and down > 0 and right < 1
                    spoilt |= bad[below, beside] and down > 0 and right > 0
                    good[c, r] = not spoilt
