"""The compiled look for light in measurements summed over a pulse's length.

Sums are kept in blocks (blocks, columns, LANES) of instants side by side, as the operators take
them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.threads import LANES

vectorised = njit(nogil=True, cache=True, fastmath=True, error_model="numpy")


@vectorised
def sum_boxes(measurements, starts, length, blocks, sums):
    """``sums[b, c, lane] = measurements[starts[b, lane] : starts[b, lane] + length, c].sum()`` for the
    blocks given.

    Parameters
    ----------
    measurements : (rows, columns) float32 array
    starts : (blocks, LANES) int64 array
    length : int
    blocks : (int, int)
        First block, and the one after the last.
    sums : (blocks, columns, LANES) float32 array, overwritten in these blocks
    """
    total = np.empty(measurements.shape[1], np.float32)
    for block in range(blocks[0], blocks[1]):
        for lane in range(LANES):
            first = starts[block, lane]
            total[:] = measurements[first]
            for late in range(first + 1, first + length):
                row = measurements[late]
                for column in range(total.size):
                    total[column] += row[column]
            target = sums[block]
            for column in range(total.size):
                target[column, lane] = total[column]


@vectorised
def compute_energies(sums, energy):
    """Mean square of each instant's sums, (blocks, LANES); what is exactly zero was never measured.

    Parameters
    ----------
    sums : (blocks, columns, LANES) float32 array
    energy : (blocks, LANES) float32 array
        Overwritten.
    """
    for block in range(sums.shape[0]):
        total, number = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
        for column in range(sums.shape[1]):
            here = sums[block, column]
            for lane in range(LANES):
                total[lane] += here[lane] * here[lane]
                number[lane] += np.float32(here[lane] != 0)
        for lane in range(LANES):
            energy[block, lane] = total[lane] / max(number[lane], np.float32(1))


@vectorised
def standardise_columns(sums, quiet, columns):
    """Take off each column's mean over the quiet instants and divide by its standard deviation
    there, in place.

    Parameters
    ----------
    sums : (blocks, columns, LANES) float32 array, changed in these columns
        What is exactly zero was never measured and stays zero, and so does a column that never
        changes.
    quiet : (blocks, LANES) float32 array
        1 for a quiet instant, else 0.
    columns : (int, int)
    """
    for column in range(columns[0], columns[1]):
        number, total, square = (
            np.zeros(LANES, np.float32),
            np.zeros(LANES, np.float32),
            np.zeros(LANES, np.float32),
        )
        for block in range(sums.shape[0]):
            here, counted = sums[block, column], quiet[block]
            for lane in range(LANES):
                weight = counted[lane] * np.float32(here[lane] != 0)
                number[lane] += weight
                total[lane] += weight * here[lane]
                square[lane] += weight * here[lane] * here[lane]
        bins = max(number.sum(), np.float32(1))
        level = total.sum() / bins
        variance = square.sum() / bins - level * level
        scale = 1 / np.sqrt(variance) if variance > 0 else np.float32(0)
        for block in range(sums.shape[0]):
            here = sums[block, column]
            for lane in range(LANES):
                here[lane] = (here[lane] - level) * scale if here[lane] != 0 else np.float32(0)
