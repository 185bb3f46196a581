"""The compiled look for light in measurements summed over a pulse's length.

Sums are (columns, instants): all instants of a column side by side, as the operators take them; what
is exactly zero was never measured.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import ONE, SUMS_IN_ANY_ORDER, compile_loop
from tofclip.lidar.signal_rows import FRACTION_SLACK, FRACTIONS
from tofclip.vectors import (
    LENGTH,
    fill_vector,
    list_set_lanes,
    load_vector,
    raise_vector,
    store_vector,
)

vectorised = compile_loop(fastmath=SUMS_IN_ANY_ORDER)
vectorised_with_room = compile_loop(fastmath=SUMS_IN_ANY_ORDER, _nrt=True)


@vectorised
def compute_energies(sums, energy):
    """Mean square of each instant's sums, in the first row of `energy`; the second is room."""
    total, number = energy[0], energy[1]
    total[:] = 0
    number[:] = 0
    for column in range(sums.shape[0]):
        here = sums[column]
        for instant in range(total.size):
            total[instant] += here[instant] * here[instant]
            number[instant] += np.float32(here[instant] != 0)
    for instant in range(total.size):
        total[instant] /= max(number[instant], np.float32(1))


@vectorised
def standardise_columns(sums, quiet, columns):
    """Take off each column's mean over the instants where `quiet` is 1, not 0, and divide by its
    standard deviation there, in place; a column that never changes becomes zero.
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


@vectorised_with_room
def find_bright_frames(tiles, scales, group_pixels, groups, block, begin, limit, bright):
    """Mark the frames, from `begin` on, in which ``scales * (M @ block)`` reaches the limit in any row
    of a sparse matrix M without negative entries (`tofclip.operators.sparse.Tiles`).

    Rows are ruled out in `groups` of successive ones: where the bound of a group stays below the limit,
    so do its rows. `groups`: where each one's windows begin; the windows, rows of `highest`; and the
    most that a window of ones adds to a row of the group, times its scale.
    """
    starts, windows, weights = groups
    measurements, zero, level = block.shape[0], fill_vector(np.float32(0)), fill_vector(limit)
    highest = np.empty((FRACTIONS * measurements, LENGTH), np.float32)
    for done in range(0, bright.size, LENGTH):
        frame = np.uintp(begin + done)
        find_window_maxima(block, frame, highest)
        dark = (1 << min(bright.size - done, LENGTH)) - 1  # a bit for each frame
        for group in range(starts.size - 1):
            bound = zero
            for k in range(starts[group], starts[group + 1]):
                bound += fill_vector(weights[k]) * load_vector(highest[windows[k]], np.uintp(0))
            if not np.int64(list_set_lanes(bound >= level)) & dark:
                continue
            most = zero
            for row in range(group * group_pixels, min((group + 1) * group_pixels, scales.size)):
                response = zero
                for tile in range(tiles.starts.shape[0]):
                    for k in range(tiles.starts[tile, row], tiles.starts[tile, row + 1]):
                        measured = load_vector(block[tiles.columns[k]], frame)
                        response += fill_vector(tiles.values[k]) * measured
                most = raise_vector(most, fill_vector(scales[row]) * response)
            dark &= ~np.int64(list_set_lanes(most >= level))
            if dark == 0:
                break
        for lane in range(min(bright.size - done, LENGTH)):
            bright[done + lane] = not (dark >> lane) & 1


@vectorised
def find_window_maxima(block, frame, highest):
    """Find the highest value between neighbouring measurements under windows, of a vector of frames.

    Row ``part * measurements + column`` is for what lies between the measurement of `column`, or one of
    the next ``WINDOW - 1``, and the one behind it, at any fraction of that part of the way. Nothing is
    below zero.
    """
    number, zero, first = np.uintp(block.shape[0]), fill_vector(np.float32(0)), np.uintp(0)
    for part in range(np.uintp(FRACTIONS)):
        target = highest[part * number : (part + ONE) * number]
        low = fill_vector(np.float32((np.float32(part) - FRACTION_SLACK) / FRACTIONS))
        high = fill_vector(np.float32((np.float32(part) + 1 + FRACTION_SLACK) / FRACTIONS))
        # From the last measurement on: of the ones behind it, pairs' maxima are at hand.
        value = pair = pair_behind = zero
        behind = load_vector(block[number - ONE], frame)
        for back in range(number):
            column = number - ONE - back
            here = load_vector(block[column], frame)
            rise, value_behind = behind - here, value
            value = raise_vector(zero, raise_vector(here + low * rise, here + high * rise))
            two_behind, pair_behind, pair = pair_behind, pair, raise_vector(value, value_behind)
            store_vector(target[column], first, raise_vector(pair, two_behind))
            behind = here
