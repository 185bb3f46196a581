"""The compiled look for light in measurements summed over a pulse's length.

Sums are (columns, instants): all instants of a column side by side, as the operators take them.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import ONE, SUMS_IN_ANY_ORDER, compile_loop, inlined
from tofclip.lidar.signal_rows import FRACTION_SLACK, FRACTIONS
from tofclip.vectors import (
    LENGTH,
    STEP,
    choose,
    fill_vector,
    find_first_bit,
    list_set_lanes,
    load_vector,
    raise_vector,
    store_vector,
)

vectorised = compile_loop(fastmath=SUMS_IN_ANY_ORDER)
vectorised_with_room = compile_loop(fastmath=SUMS_IN_ANY_ORDER, _nrt=True)

VECTORS = 4
WORD_FRAMES = VECTORS * LENGTH
"""Frames whose marks are a bit each of a whole number."""


@vectorised
def compute_energies(sums, energy):
    """Mean square of each instant's sums; what is exactly zero was never measured.

    `sums` (columns, at least instants); `energy` (2, instants): the first row is overwritten with
    the energies, the second is room.
    """
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
    """Take off each column's mean over the quiet instants and divide by its standard deviation
    there, in place.

    `sums` (columns, at least instants): what is exactly zero was never measured and stays zero, and
    so does a column that never changes; `quiet` (instants,): 1 for a quiet instant, else 0.
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
def find_bright_frames(
    tile_starts,
    columns,
    values,
    scales,
    group_pixels,
    group_starts,
    windows,
    weights,
    block,
    begin,
    limit,
    bright,
):
    """Mark the frames in which ``scales * (M @ block)`` reaches the limit in any row of a sparse
    matrix M.

    Rows are ruled out in groups: where the bound of a group stays below the limit, so do its rows.
    A frame is done when one row has reached it, so that each frame's most promising group comes
    first.

    `tile_starts, columns, values`: see `tofclip.operators.sparse.Tiles`; no negative values;
    `scales` (M's rows,); `group_pixels`: successive rows of a group; `group_starts` (groups + 1,):
    where each group's windows begin; `windows` (n,): see `find_window_maxima`: numbers of its rows;
    `weights` (n,): the most that a window of ones adds to a row of the group, times its scale;
    `block` (M's columns, frames): whole words of frames from `begin` on lie within it; `begin`:
    first frame; `limit`: above zero; `bright` (frames to look at,).
    """
    groups = group_starts.size - 1
    highest = np.empty((VECTORS, FRACTIONS * block.shape[0], LENGTH), np.float32)
    marks, most_promising = np.empty(groups, np.uint64), np.empty(WORD_FRAMES, np.int32)
    for done in range(0, bright.size, WORD_FRAMES):
        frame = np.uintp(begin + done)
        wanted = min(bright.size - done, WORD_FRAMES)
        find_window_maxima(block, frame, highest)
        promising = mark_promising(
            highest, group_starts, windows, weights, limit, marks, most_promising
        )
        open_frames = promising
        for lane in range(wanted):
            if open_frames >> np.uint64(lane) & np.uint64(1):
                vector = np.uint64(lane) // np.uint64(LENGTH)
                open_frames &= ~find_reached(
                    tile_starts,
                    columns,
                    values,
                    scales,
                    group_pixels,
                    most_promising[lane],
                    block,
                    frame,
                    vector,
                    limit,
                )
        if wanted < WORD_FRAMES:
            open_frames &= (np.uint64(1) << np.uint64(wanted)) - np.uint64(1)
            promising &= (np.uint64(1) << np.uint64(wanted)) - np.uint64(1)
        for group in range(groups):
            word = marks[group] & open_frames
            while word:
                vector = find_first_bit(word) // np.uint64(LENGTH)
                reached = find_reached(
                    tile_starts,
                    columns,
                    values,
                    scales,
                    group_pixels,
                    group,
                    block,
                    frame,
                    vector,
                    limit,
                )
                open_frames &= ~reached
                word &= ~(np.uint64(0xFFFF) << (vector * np.uint64(LENGTH)))
        reached = promising & ~open_frames
        for lane in range(wanted):
            bright[done + lane] = reached >> np.uint64(lane) & np.uint64(1)


@vectorised
def find_window_maxima(block, frame, highest):
    """Find the highest value between neighbouring measurements under windows.

    Row ``part * measurements + column`` is for what lies between the measurement of `column`, or one of
    the next ``WINDOW - 1``, and the one behind it, at any fraction of that part of the way. Nothing
    is below zero.

    `block` (measurements, frames); `frame`: first of the frames; `highest` (VECTORS, FRACTIONS *
    measurements, LENGTH).
    """
    number, parts, zero = np.uintp(block.shape[0]), np.uintp(FRACTIONS), fill_vector(np.float32(0))
    for vector in range(VECTORS):
        at = frame + np.uintp(vector * LENGTH)
        for part in range(parts):
            target = highest[vector, part * number : (part + ONE) * number]
            low = fill_vector(np.float32((np.float32(part) - FRACTION_SLACK) / FRACTIONS))
            high = fill_vector(np.float32((np.float32(part) + 1 + FRACTION_SLACK) / FRACTIONS))
            # From the last measurement on: of the ones behind it, pairs' maxima are at hand.
            value = pair = pair_behind = zero
            behind = load_vector(block[number - ONE], at)
            for back in range(number):
                column = number - ONE - back
                here = load_vector(block[column], at)
                rise, value_behind = behind - here, value
                value = raise_vector(zero, raise_vector(here + low * rise, here + high * rise))
                two_behind, pair_behind, pair = pair_behind, pair, raise_vector(value, value_behind)
                store_vector(target[column], np.uintp(0), raise_vector(pair, two_behind))
                behind = here


@inlined
def mark_promising(highest, group_starts, windows, weights, limit, marks, most_promising):
    """Mark in which frames the bound of each group reaches the limit; return those of any group.

    `highest` (VECTORS, FRACTIONS * measurements, LENGTH): of `find_window_maxima`; `group_starts,
    windows, weights, limit`: as for `find_bright_frames`; `marks` (groups,): A bit for each frame;
    `most_promising` (WORD_FRAMES,): the group with the highest bound in each frame.
    """
    zero, level = fill_vector(np.float32(0)), fill_vector(limit)
    best_a = best_b = best_c = best_d = zero
    group_a = group_b = group_c = group_d = fill_vector(np.int32(0))
    for group in range(group_starts.size - 1):
        a = b = c = d = zero
        for k in range(group_starts[group], group_starts[group + 1]):
            window, weight = np.uintp(windows[k]), fill_vector(weights[k])
            a += weight * load_vector(highest[0, window], np.uintp(0))
            b += weight * load_vector(highest[1, window], np.uintp(0))
            c += weight * load_vector(highest[2, window], np.uintp(0))
            d += weight * load_vector(highest[3, window], np.uintp(0))
        marks[group] = (
            list_set_lanes(a >= level)
            | list_set_lanes(b >= level) << np.uint64(16)
            | list_set_lanes(c >= level) << np.uint64(32)
            | list_set_lanes(d >= level) << np.uint64(48)
        )
        number = fill_vector(np.int32(group))
        group_a, best_a = choose(a > best_a, number, group_a), raise_vector(a, best_a)
        group_b, best_b = choose(b > best_b, number, group_b), raise_vector(b, best_b)
        group_c, best_c = choose(c > best_c, number, group_c), raise_vector(c, best_c)
        group_d, best_d = choose(d > best_d, number, group_d), raise_vector(d, best_d)
    store_vector(most_promising, np.uintp(0), group_a)
    store_vector(most_promising, np.uintp(16), group_b)
    store_vector(most_promising, np.uintp(32), group_c)
    store_vector(most_promising, np.uintp(48), group_d)
    return (
        list_set_lanes(best_a >= level)
        | list_set_lanes(best_b >= level) << np.uint64(16)
        | list_set_lanes(best_c >= level) << np.uint64(32)
        | list_set_lanes(best_d >= level) << np.uint64(48)
    )


@vectorised
def find_reached(
    tile_starts, columns, values, scales, group_pixels, group, block, frame, vector, limit
):
    """Return in which frames of a vector a row of a group reaches the limit, as bits of a word.

    `tile_starts, columns, values, scales, group_pixels, block, limit`: as for `find_bright_frames`;
    `frame`: first frame of the word; `vector`: number of the vector in the word.
    """
    at, highest = frame + np.uintp(vector) * STEP, fill_vector(np.float32(0))
    for row in range(group * group_pixels, min((group + 1) * group_pixels, scales.size)):
        response = fill_vector(np.float32(0))
        for tile in range(tile_starts.shape[0]):
            for k in range(tile_starts[tile, row], tile_starts[tile, row + 1]):
                response += fill_vector(values[k]) * load_vector(block[columns[k]], at)
        highest = raise_vector(highest, fill_vector(scales[row]) * response)
    reached = list_set_lanes(highest >= fill_vector(limit))
    return reached << (np.uint64(vector) * np.uint64(LENGTH))
