"""The compiled look for light in measurements summed over a pulse's length.

Sums are (columns, instants): all instants of a column side by side, as the operators take them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

vectorised = njit(nogil=True, cache=True, fastmath=True, error_model="numpy")

TILE_INSTANTS = 16  # a cache line of each column's sums, which is written at once


@vectorised
def sum_boxes(measurements, starts, length, span, sums):
    """``sums[c, i] = measurements[starts[i] : starts[i] + length, c].sum()`` for the instants of a span.

    Parameters
    ----------
    measurements : (rows, columns) float32 array
    starts : (instants,) int64 array
    length : int
    span : (int, int)
        First instant, and the one after the last.
    sums : (columns, at least instants) float32 array, overwritten in this span
    """
    room = np.empty((TILE_INSTANTS, measurements.shape[1]), np.float32)
    for first in range(span[0], span[1], TILE_INSTANTS):
        number = min(TILE_INSTANTS, span[1] - first)
        for instant in range(number):
            total, start = room[instant], starts[first + instant]
            total[:] = measurements[start]
            for late in range(start + 1, start + length):
                row = measurements[late]
                for column in range(total.size):
                    total[column] += row[column]
        for column in range(room.shape[1]):
            target = sums[column, first : first + number]
            for instant in range(number):
                target[instant] = room[instant, column]


@vectorised
def compute_energies(sums, energy):
    """Mean square of each instant's sums; what is exactly zero was never measured.

    Parameters
    ----------
    sums : (columns, at least instants) float32 array
    energy : (instants,) float32 array
        Overwritten.
    """
    energy[:] = 0
    number = np.zeros(energy.size, np.float32)
    for column in range(sums.shape[0]):
        here = sums[column]
        for instant in range(energy.size):
            energy[instant] += here[instant] * here[instant]
            number[instant] += np.float32(here[instant] != 0)
    for instant in range(energy.size):
        energy[instant] /= max(number[instant], np.float32(1))


@vectorised
def standardise_columns(sums, quiet, columns):
    """Take off each column's mean over the quiet instants and divide by its standard deviation
    there, in place.

    Parameters
    ----------
    sums : (columns, at least instants) float32 array, changed in these columns
        What is exactly zero was never measured and stays zero, and so does a column that never
        changes.
    quiet : (instants,) float32 array
        1 for a quiet instant, else 0.
    columns : (int, int)
    """
    for column in range(columns[0], columns[1]):
        here = sums[column]
        bins, total, square = np.float32(0), np.float32(0), np.float32(0)
        for instant in range(quiet.size):
            weight = quiet[instant] * np.float32(here[instant] != 0)
            bins += weight
            total += weight * here[instant]
            square += weight * here[instant] * here[instant]
        bins = max(bins, np.float32(1))
        level = total / bins
        variance = square / bins - level * level
        scale = 1 / np.sqrt(variance) if variance > 0 else np.float32(0)
        for instant in range(quiet.size):
            value = (here[instant] - level) * scale
            here[instant] = value if here[instant] != 0 else np.float32(0)
