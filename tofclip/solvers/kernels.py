"""Compiled inner loops of the solvers, on blocks of frames side by side: `LANES` of them, or a
single one.

Every array is C-contiguous with the frames as last axis, so that one vector instruction treats many
frames at once and every frame's result is independent of its neighbours in the block. A row is one of
a picture with all its lanes; numbers that each lane has are repeated for every pixel of it. Sums over
a picture are taken row by row and added up in float64, because a solver compares objectives that
differ in the sixth digit. Throughout, ``z = current + momentum * (current - previous)``.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import SUMS_AS_WRITTEN, compile_as_part, compile_loop
from tofclip.operators.kernels import (
    WIDE_LANES,
    multiply_sparse_rows,
    multiply_sparse_wide_rows,
)
from tofclip.threads import LANES

TILE_PIXELS = 32
STRETCH_NUMBERS = 512  # worked on together, at most: nine arrays of them are 18 kB in float32
STRETCHES_PER_SUM = 128  # added up before they go to a sum of higher precision

fast_loop = compile_loop(fastmath=SUMS_AS_WRITTEN)
# For a row: a loop over few arrays is a vector loop, because the compiler checks only a few for
# overlap.
row_part = compile_as_part(fastmath=SUMS_AS_WRITTEN, _nrt=False)


@fast_loop
def shrink_nonnegative(
    current, previous, gradient, momentum, step, threshold, memory, total, distance
):
    """``previous = max(z - step * gradient - threshold, 0)`` of flat pictures; adds the sums of that
    and of its squared distance from z to `total` and `distance`.

    A stretch of pixels at a time, which stays in the first-level cache with all that lanes have for
    themselves, (stretch,): whole rows of a picture took twice as long. `memory` is three stretches of
    zeros.
    """
    result, some, far = memory[0], memory[1], memory[2]
    for number in range((current.size + result.size - 1) // result.size):
        first = number * result.size
        end = min(first + result.size, current.size)
        here, before, slope = current[first:end], previous[first:end], gradient[first:end]
        _shrink_row(here, before, momentum, slope, step, threshold, result)
        _add_distance(here, before, momentum, result, far)
        _put_row(result, before, some)
        if number % STRETCHES_PER_SUM == STRETCHES_PER_SUM - 1:
            _move_sum(some, total)
            _move_sum(far, distance)
    _move_sum(some, total)
    _move_sum(far, distance)


@row_part
def _shrink_row(current, previous, momentum, gradient, step, threshold, result):
    for i in range(current.size):
        point = current[i] + momentum[i] * (current[i] - previous[i])
        value = point - step[i] * gradient[i] - threshold[i]
        result[i] = value if value > 0 else np.float32(0)


@row_part
def _descend_row(current, previous, momentum, gradient, step):
    for i in range(current.size):
        point = current[i] + momentum[i] * (current[i] - previous[i])
        gradient[i] = point - step[i] * gradient[i]


@row_part
def _add_distance(current, previous, momentum, result, distance):
    """Add the squares of ``result - z``."""
    for i in range(current.size):
        moved = result[i] - (current[i] + momentum[i] * (current[i] - previous[i]))
        distance[i] += moved * moved


@row_part
def _put_row(row, target, total):
    """Copy as much of a row as the target holds, and add it to the sum of rows."""
    for i in range(target.size):
        target[i] = row[i]
        total[i] += row[i]


@row_part
def _move_sum(some, total):
    """Add to a sum of higher precision, and begin anew."""
    for i in range(some.size):
        total[i] += some[i]
        some[i] = 0


@fast_loop
def take_gradient_step(current, previous, momentum, step, gradient):
    """``gradient = z - step * gradient``, arrays (rows, row) and (row,)."""
    for row in range(current.shape[0]):
        _descend_row(current[row], previous[row], momentum, gradient[row], step)


@fast_loop
def copy_lanes_to_frames(block, start, frames):
    """``frames[lane, pixel] = block[pixel, start + lane]`` for as many lanes as there are frames.

    Tile by tile, so that both sides move whole cache lines: several times faster than a strided copy.
    """
    for first in range(0, block.shape[0], TILE_PIXELS):
        last = min(first + TILE_PIXELS, block.shape[0])
        for lane in range(frames.shape[0]):
            for pixel in range(first, last):
                frames[lane, pixel] = block[pixel, start + lane]


@compile_loop(fastmath=SUMS_AS_WRITTEN, _nrt=True)
def compute_traces(tile_starts, columns, values, rows, weights, traces, span):
    """``traces[:, span[0] : span[1]] = M[rows[0] : rows[1]] @ weights`` for a sparse matrix M in
    column tiles, see `tofclip.operators.sparse.Tiles`. `weights` (M's columns, time): rows are a
    multiple of `LANES` long at least; `traces` (rows[1] - rows[0], at least span[1]).
    """
    starts, time, done = tile_starts[:, rows[0] : rows[1] + 1], span[1] - span[0], 0
    while done + WIDE_LANES <= time:
        multiply_sparse_wide_rows(starts, columns, values, weights, done, traces, span[0] + done)
        done += WIDE_LANES
    while done + LANES <= time:
        multiply_sparse_rows(starts, columns, values, weights, done, traces, span[0] + done)
        done += LANES
    if done < time:
        # the last lanes lie beyond the span
        part = np.empty((traces.shape[0], LANES), traces.dtype)
        multiply_sparse_rows(starts, columns, values, weights, done, part, 0)
        first = span[0] + done
        for row in range(part.shape[0]):
            for column in range(first, span[1]):
                traces[row, column] = part[row, column - first]


@fast_loop
def descend_total_variation(
    lanes, current, previous, momentum, gradient, step, weight, dual, sweep, scratch, total
):
    """A gradient step from z, and one sweep towards the picture nearest to it in total variation.

    The sweep is one of projected gradient, of step size `sweep`, on the dual of ``1/2 |x - noisy|^2 +
    weight * TV(x), x >= 0`` (Chambolle 2004). Every row passes through memory once: the primal row
    below is made before a row's dual changes.

    Pictures are (rows, row), `lanes` numbers from pixel to pixel; numbers of lanes (row,). `previous`
    becomes the result, `gradient` ``noisy = z - step * gradient``, and the result's variation is added
    to `total` (row,). Of the `dual` (2, rows, row), vertical and horizontal, the last row of the one
    and the last column of the other stay zero: the difference across the border is. Of `scratch` (4,
    row) the first row is zero.
    """
    rows, dark, room = current.shape[0], scratch[0], scratch[1]
    for row in range(rows + 1):
        if row < rows:
            _descend_row(current[row], previous[row], momentum, gradient[row], step)
            above, made = dual[0, row - 1] if row > 0 else dark, scratch[2 + row % 2]
            _make_primal_row(lanes, gradient[row], weight, dual[0, row], above, dual[1, row], made)
        if row > 0:
            # The dual of a row needs the primal of the row below it, so that it follows one row
            # behind.
            done = row - 1
            made, below = scratch[2 + done % 2], scratch[2 + (row if row < rows else done) % 2]
            _update_dual_row(lanes, made, below, sweep, dual[0, done], dual[1, done], room)
            above = dual[0, done - 1] if done > 0 else dark
            _make_primal_row(
                lanes, gradient[done], weight, dual[0, done], above, dual[1, done], previous[done]
            )
            if done > 0:
                _add_variation(lanes, previous[done - 1], previous[done], total)
    _add_variation(lanes, previous[rows - 1], previous[rows - 1], total)


@row_part
def _make_primal_row(lanes, noisy, weight, down, above, across, result):
    """``result = max(noisy + weight * div(dual), 0)``; `above` is `down` one row higher."""
    # unsigned: an index with `lanes` taken off might be negative for all the compiler knows
    first, end = np.uintp(lanes), np.uintp(noisy.size)
    for i in range(first):
        value = noisy[i] + weight[i] * (down[i] - above[i] + across[i])
        result[i] = value if value > 0 else np.float32(0)
    for i in range(first, end):
        divergence = down[i] - above[i] + (across[i] - across[i - first])
        value = noisy[i] + weight[i] * divergence
        result[i] = value if value > 0 else np.float32(0)


@row_part
def _update_dual_row(lanes, here, below, sweep, down, across, shrink):
    """Projects ``dual + sweep * grad(picture)`` onto length 1 at most; `shrink`: room for a row."""
    one, step = np.float32(1), np.uintp(lanes)
    end = np.uintp(here.size)
    # The last pixel of a row has no right neighbour: its difference across is 0, and so is the dual
    # there.
    inner = end - step
    for i in range(inner):
        vertical = down[i] + sweep[i] * (below[i] - here[i])
        horizontal = across[i] + sweep[i] * (here[i + step] - here[i])
        length = vertical * vertical + horizontal * horizontal
        shrink[i] = one / math.sqrt(length if length > one else one)
    for i in range(inner, end):
        length = math.fabs(down[i] + sweep[i] * (below[i] - here[i]))
        shrink[i] = one / (length if length > one else one)
    for i in range(inner):
        across[i] = (across[i] + sweep[i] * (here[i + step] - here[i])) * shrink[i]
    for i in range(end):
        down[i] = (down[i] + sweep[i] * (below[i] - here[i])) * shrink[i]


@row_part
def _add_variation(lanes, here, below, total):
    step, end = np.uintp(lanes), np.uintp(here.size)
    for i in range(end - step):
        vertical, horizontal = below[i] - here[i], here[i + step] - here[i]
        total[i] += math.sqrt(vertical * vertical + horizontal * horizontal)
    for i in range(end - step, end):
        total[i] += math.fabs(below[i] - here[i])


@fast_loop
def compute_light_field_primal(lanes, noisy, dual, weight, angular, room, result):
    """``result = max(noisy + weight * div(dual), 0)``; arrays are (v, u, rows, row), `dual` four of
    them along rows, columns, v and u. `room` is two rows, the second one of zeros. The last
    difference along every axis crosses the border and is always zero.
    """
    down, across, rows, _ = noisy.shape
    between, dark = room[0], room[1]
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                before = dual[2, v - 1, u, row] if v > 0 else dark
                beside = dual[3, v, u - 1, row] if u > 0 else dark
                _subtract_rows(dual[2, v, u, row], before, dual[3, v, u, row], beside, between)
                above = dual[0, v, u, row - 1] if row > 0 else dark
                lines = dual[0, v, u, row], above, dual[1, v, u, row]
                made = result[v, u, row]
                _make_light_field_row(
                    lanes, noisy[v, u, row], weight, *lines, angular, between, made
                )


@row_part
def _subtract_rows(one, before, other, other_before, result):
    for i in range(result.size):
        result[i] = one[i] - before[i] + (other[i] - other_before[i])


@row_part
def _make_light_field_row(lanes, noisy, weight, down, above, across, angular, between, result):
    first, end = np.uintp(lanes), np.uintp(noisy.size)
    for i in range(first):
        divergence = down[i] - above[i] + across[i] + angular * between[i]
        value = noisy[i] + weight * divergence
        result[i] = value if value > 0 else np.float32(0)
    for i in range(first, end):
        divergence = down[i] - above[i] + (across[i] - across[i - first]) + angular * between[i]
        value = noisy[i] + weight * divergence
        result[i] = value if value > 0 else np.float32(0)


@fast_loop
def update_light_field_dual(lanes, field, dual, step, angular, square):
    """Projects ``dual + step * grad(field)`` onto length 1 at most; `square`: room for a row."""
    down, across, rows, end = field.shape
    inner = end - lanes
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                here = field[v, u, row]
                square[:] = 0
                # across the border the difference is zero, and the dual stays so
                if row + 1 < rows:
                    _ascend_row(dual[0, v, u, row], here, field[v, u, row + 1], step, square)
                right = dual[1, v, u, row, :inner]
                _ascend_row(right, here[:inner], here[lanes:], step, square[:inner])
                aside = step * angular
                if v + 1 < down:
                    _ascend_row(dual[2, v, u, row], here, field[v + 1, u, row], aside, square)
                if u + 1 < across:
                    _ascend_row(dual[3, v, u, row], here, field[v, u + 1, row], aside, square)
                for axis in range(4):
                    _shorten_row(dual[axis, v, u, row], square)


@row_part
def _ascend_row(dual, here, there, step, square):
    """A step of the dual along a difference; its squares are added up."""
    for i in range(dual.size):
        raised = dual[i] + step * (there[i] - here[i])
        dual[i] = raised
        square[i] += raised * raised


@row_part
def _shorten_row(dual, square):
    for i in range(dual.size):
        dual[i] /= math.sqrt(max(square[i], np.float32(1)))


@fast_loop
def sum_light_field_variation(lanes, field, angular, square, total):
    """Add the isotropic variation of all rows to `total` (row,), float64; `square` is room for a row."""
    down, across, rows, end = field.shape
    inner, whole = end - lanes, field.dtype.type(1)
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                here = field[v, u, row]
                square[:] = 0
                if row + 1 < rows:
                    _add_difference(here, field[v, u, row + 1], whole, square)
                _add_difference(here[:inner], here[lanes:], whole, square[:inner])
                if v + 1 < down:
                    _add_difference(here, field[v + 1, u, row], angular, square)
                if u + 1 < across:
                    _add_difference(here, field[v, u + 1, row], angular, square)
                for i in range(end):
                    total[i] += math.sqrt(square[i])


@row_part
def _add_difference(here, there, factor, square):
    for i in range(here.size):
        difference = factor * (there[i] - here[i])
        square[i] += difference * difference
