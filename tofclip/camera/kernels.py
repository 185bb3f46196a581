"""The compiled resampling of streak images.

Arrays are (rows, columns), as the sensor brings them. A sweep moves light by a few rows that change
slowly from column to column, so that neighbours in a rectified row come from a few raw rows, which
stay in cache.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import ONE, compile_loop, inlined
from tofclip.vectors import (
    LENGTH,
    STEP,
    copy_transposed,
    fill_vector,
    load_vector,
    store_vector,
)

fast_loop = compile_loop(fastmath=True)


@inlined
def sample_row(counts, dark, position, runs, reading):
    """Sample every column of a row linearly between two raw rows, and take off the dark level; 0
    beyond the raw image. `position` (columns,) says where each rectified pixel lies, pixels; `runs`
    (n, 3) the first column, the one after the last, and the upper of the two raw rows between which
    all of them lie: from the number of raw rows on, they lie beyond the image.
    """
    rows, columns = np.uintp(counts.shape[0]), np.uintp(counts.shape[1])
    below, level = np.uintp(min(1, counts.shape[0] - 1)), fill_vector(dark)
    for k in range(runs.shape[0]):
        first, end, top = runs[k, 0], runs[k, 1], runs[k, 2]
        if top >= rows:
            for column in range(first, end):
                reading[column] = np.float32(0)
            continue
        upper, lower, height = counts[top], counts[top + below], np.float32(top)
        # What a vector writes beyond its run is overwritten by the next one, and the last run ends
        # with single numbers.
        while first < end and first + STEP <= columns:
            here = load_vector(upper, first)
            part = load_vector(position, first) - fill_vector(height)
            store_vector(reading, first, here + part * (load_vector(lower, first) - here) - level)
            first += STEP
        while first < end:
            here = upper[first]
            reading[first] = here + (position[first] - height) * (lower[first] - here) - dark
            first += ONE


@fast_loop
def sample_rows(counts, dark, raw_row, runs, run_starts, measurements):
    """Sample some rows; `runs` are those of all, of which row r's begin at ``run_starts[r]``."""
    for row in range(raw_row.shape[0]):
        own = runs[run_starts[row] : run_starts[row + 1]]
        sample_row(counts, dark, raw_row[row], own, measurements[row])


@compile_loop(fastmath=True, _nrt=True)
def sample_delayed_rows(counts, dark, raw_row, delay, measurements):
    """Sample rows at ``raw_row + delay``, whose runs are found on the way."""
    rows, columns = counts.shape
    beyond, lowest, last = np.int32(rows), np.int32(max(rows - 2, 0)), np.float32(rows - 1)
    position, tops = np.empty(columns, np.float32), np.empty(columns, np.int32)
    runs = np.empty((columns, 3), np.uint64)
    for row in range(raw_row.shape[0]):
        for column in range(columns):
            y = position[column] = raw_row[row, column] + delay
            tops[column] = min(np.int32(y), lowest) if y >= 0 and y <= last else beyond
        first = found = 0
        for column in range(1, columns + 1):
            if column == columns or tops[column] != tops[first]:
                runs[found, 0], runs[found, 1], runs[found, 2] = first, column, tops[first]
                first, found = column, found + 1
        sample_row(counts, dark, position, runs[:found], measurements[row])


@inlined
def add_rows(rows, total):
    """``total = rows.sum(axis=0)``, for (rows, columns) float32 arrays."""
    columns, column = np.uintp(total.size), np.uintp(0)
    while column + STEP <= columns:
        here = load_vector(rows[0], column)
        for row in range(1, rows.shape[0]):
            here += load_vector(rows[row], column)
        store_vector(total, column, here)
        column += STEP
    while column < columns:
        total[column] = rows[0, column]
        for row in range(1, rows.shape[0]):
            total[column] += rows[row, column]
        column += ONE


@inlined
def write_transposed(rows, first, columns):
    """``columns[:, first : first + LENGTH] = rows.T``, for `LENGTH` rows of float32."""
    width, stride = np.uintp(rows.shape[1]), np.uintp(columns.shape[1])
    source, target, column = rows.reshape(rows.size), columns.reshape(columns.size), np.uintp(0)
    while column + STEP <= width:
        copy_transposed(source, column, width, target, column * stride + first, stride)
        column += STEP
    while column < width:
        for row in range(STEP):
            columns[column, first + row] = rows[row, column]
        column += ONE


@compile_loop(fastmath=True, _nrt=True)
def sum_boxes(measurements, starts, length, span, sums):
    """``sums[c, i] = measurements[starts[i] : starts[i] + length, c].sum()`` for the instants from
    ``span[0]`` to below ``span[1]``, whole vectors of them.
    """
    room = np.empty((LENGTH, measurements.shape[1]), np.float32)
    for first in range(np.uintp(span[0]), np.uintp(span[1]), STEP):
        for instant in range(STEP):
            start = starts[first + instant]
            add_rows(measurements[start : start + length], room[instant])
        write_transposed(room, first, sums)


@fast_loop
def sample_bilinear(counts, dark, raw_row, raw_column, delay, measurements):
    """Sample some rows bilinearly at (raw_row + delay, raw_column), pixels of the raw image, and take
    off the dark level; 0 beyond the raw image.
    """
    rows, columns = counts.shape
    flat, zero, width = counts.reshape(counts.size), np.int32(0), np.int32(columns)
    last_row, lowest = np.float32(rows - 1), np.int32(max(rows - 2, 0))
    last_column, rightmost = np.float32(columns - 1), np.int32(max(columns - 2, 0))
    # In an image of a single row or column the neighbour is the pixel itself, with any weight.
    below, beside = np.int32(min(1, rows - 1)) * width, np.int32(min(1, columns - 1))
    for row in range(raw_row.shape[0]):
        down, across, reading = raw_row[row], raw_column[row], measurements[row]
        for column in range(down.size):
            y, x = down[column] + delay, across[column]
            # Positions outside are moved inside before anything is read, and their values made 0
            # afterwards.
            top, left = min(max(np.int32(y), zero), lowest), min(max(np.int32(x), zero), rightmost)
            right, here = x - np.float32(left), top * width + left
            upper = flat[here] + right * (flat[here + beside] - flat[here])
            lower = flat[here + below] + right * (flat[here + beside + below] - flat[here + below])
            value = upper + (y - np.float32(top)) * (lower - upper) - dark
            inside = y >= 0 and y <= last_row and x >= 0 and x <= last_column
            reading[column] = value if inside else np.float32(0)
