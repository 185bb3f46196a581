"""Compiled inner loops of the solvers, on blocks of frames side by side: `LANES` of them, or a
single one.

Every array is C-contiguous with the frames as last axis, so that one vector instruction treats many
frames at once and every frame's result is independent of its neighbours in the block. Sums over a
picture are taken row by row and added up in float64, because a solver compares objectives that
differ in the sixth digit.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import compile_as_part, compile_loop, inlined
from tofclip.operators.kernels import (
    WIDE_LANES,
    multiply_sparse_rows,
    multiply_sparse_wide_rows,
)
from tofclip.threads import LANES

TILE_PIXELS = 32

STRETCH_NUMBERS = 512
"""At most so many numbers are worked on together: nine arrays of them are 18 kB in float32."""

STRETCHES_PER_SUM = 128
"""Stretches that are added up before they go to a sum of higher precision."""

FASTMATH = {"contract", "nsz", "arcp", "afn"}
fast_loop = compile_loop(fastmath=FASTMATH)


row_part = compile_as_part(fastmath=FASTMATH, _nrt=False)
"""For a row of a picture with all its lanes, one after the other: a loop over few arrays is a vector
loop, because the compiler checks only a few for overlap. Numbers that each lane has are repeated for
every pixel of a row.
"""


@fast_loop
def shrink_nonnegative(
    current, previous, momentum, gradient, step, threshold, memory, total, distance
):
    """``previous = max(z - step * gradient - threshold, 0)`` with ``z = current + momentum *
    (current - previous)``.

    A stretch of pixels at a time, which stays in the first-level cache with all that lanes have for
    themselves: whole rows of a picture took twice as long.

    `current` (n,): pictures, all lanes of a pixel side by side; `previous` (n,): overwritten with
    the result; `momentum` (stretch,); `gradient` (n,); `step, threshold` (stretch,): step size, and
    step size times weight; `memory` (3, stretch): zeros; overwritten; `total, distance` (stretch,):
    to which sums over stretches of the result, and of its squared difference from z, are added.
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
def take_gradient_step(current, previous, momentum, gradient, step):
    """``gradient = z - step * gradient`` with ``z = current + momentum * (current - previous)``.

    `current, previous` (rows, columns, lanes); `momentum` (lanes,); `gradient` (rows, columns,
    lanes): overwritten.
    """
    lanes = current.shape[2]
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(lanes):
                here = current[row, column, lane]
                point = here + momentum[lane] * (here - previous[row, column, lane])
                gradient[row, column, lane] = point - step * gradient[row, column, lane]


@fast_loop
def copy_lanes_to_frames(block, frames):
    """``frames[lane, pixel] = block[pixel, lane]`` for as many lanes as there are frames;
    contiguous 2D arrays.

    Tile by tile, so that both sides move whole cache lines: several times faster than a strided
    copy.

    `block` (pixels, lanes); `frames` (frames, pixels): overwritten; not more frames than lanes.
    """
    pixels = block.shape[0]
    # Tile by tile, as a transposition reads along one axis and writes along the other.
    for first in range(0, pixels, TILE_PIXELS):
        last = first + TILE_PIXELS if first + TILE_PIXELS < pixels else pixels
        for lane in range(frames.shape[0]):
            for pixel in range(first, last):
                frames[lane, pixel] = block[pixel, lane]


@compile_loop(fastmath=FASTMATH, _nrt=True)
def compute_traces(tile_starts, columns, values, rows, weights, traces, span):
    """``traces[:, span[0] : span[1]] = M[rows[0] : rows[1]] @ weights`` for a sparse matrix M in
    column tiles.

    `tile_starts, columns, values`: see `tofclip.operators.sparse.Tiles`; a row for each trace;
    `weights` (M's columns, time): its rows are a multiple of `LANES` long at least; `traces`
    (rows[1] - rows[0], time): overwritten from column ``span[0]`` to below ``span[1]``.
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
def restore_frames(candidate, current, rejected):
    """``candidate = current`` in the lanes where `rejected` is 1; it is 0 elsewhere. Arrays are
    (..., lanes).

    `candidate` (rows, columns, lanes): overwritten in rejected lanes; `current` (rows, columns,
    lanes); `rejected` (lanes,): 1 or 0.
    """
    lanes = candidate.shape[2]
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(lanes):
                here = candidate[row, column, lane]
                candidate[row, column, lane] = here + rejected[lane] * (
                    current[row, column, lane] - here
                )


@fast_loop
def descend_total_variation(
    lanes, current, previous, momentum, gradient, step, weight, dual, sweep, scratch, total
):
    """A gradient step from ``z = current + momentum * (current - previous)``, and one sweep towards
    the picture nearest to it in total variation.

    The sweep is one of projected gradient on the dual of ``1/2 |x - noisy|^2 + weight * TV(x), x >=
    0`` (Chambolle 2004). Every row passes through memory once: the primal row below is made before
    a row's dual changes.

    `lanes`: pixels of a row are `lanes` numbers apart; `current` (rows, row): pictures, all lanes
    of a pixel side by side; `previous` (rows, row): overwritten with the result; `momentum` (row,);
    `gradient` (rows, row): overwritten with ``noisy = z - step * gradient``; `step, weight` (row,):
    step size, and step size times the variation's weight; `dual` (2, rows, row): vertical and
    horizontal; updated in place. The last row of the one and the last column of the other stay
    zero: the difference across the border is; `sweep` (row,): step size of the dual; `scratch` (4,
    row): the first row is zero; the others are overwritten; `total` (row,): to which the sum over
    rows of the result's isotropic total variation is added.
    """
    rows, dark, room = current.shape[0], scratch[0], scratch[1]
    for row in range(rows + 1):
        if row < rows:
            _descend_row(current[row], previous[row], momentum, gradient[row], step)
            above = dual[0, row - 1] if row > 0 else dark
            _make_primal_row(
                lanes,
                gradient[row],
                weight,
                dual[0, row],
                above,
                dual[1, row],
                scratch[2 + row % 2],
            )
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
    """``dual = project(dual + sweep * grad(picture))`` onto vectors of length at most 1; `shrink` is
    room for a row.
    """
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
def compute_light_field_primal(noisy, dual, weight, angular, result):
    """``result = max(noisy + weight * div(dual), 0)``; arrays are (v, u, rows, columns, lanes),
    `dual` four of them.

    The last difference along every axis crosses the border and is always zero, so only the first
    needs care.

    `noisy` (v, u, rows, columns, lanes); `dual` (4, v, u, rows, columns, lanes): along rows,
    columns, v and u; `angular`: how many times the differences between views count; `result` (v, u,
    rows, columns, lanes): overwritten.
    """
    down, across, rows, columns, lanes = noisy.shape
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                for column in range(columns):
                    for lane in range(lanes):
                        divergence = (
                            dual[0, v, u, row, column, lane] + dual[1, v, u, row, column, lane]
                        )
                        between = (
                            dual[2, v, u, row, column, lane] + dual[3, v, u, row, column, lane]
                        )
                        if row > 0:
                            divergence -= dual[0, v, u, row - 1, column, lane]
                        if column > 0:
                            divergence -= dual[1, v, u, row, column - 1, lane]
                        if v > 0:
                            between -= dual[2, v - 1, u, row, column, lane]
                        if u > 0:
                            between -= dual[3, v, u - 1, row, column, lane]
                        value = noisy[v, u, row, column, lane] + weight * (
                            divergence + angular * between
                        )
                        result[v, u, row, column, lane] = max(value, np.float32(0))


@inlined
def _forward_differences(field, v, u, row, column, lane, angular):
    """The four forward differences at a sample, 0 across borders."""
    down, across, rows, columns = field.shape[:4]
    here = field[v, u, row, column, lane]
    return (
        field[v, u, min(row + 1, rows - 1), column, lane] - here,
        field[v, u, row, min(column + 1, columns - 1), lane] - here,
        angular * (field[min(v + 1, down - 1), u, row, column, lane] - here),
        angular * (field[v, min(u + 1, across - 1), row, column, lane] - here),
    )


@fast_loop
def update_light_field_dual(field, dual, step, angular):
    """``dual = project(dual + step * grad(field))`` onto vectors of length at most 1.

    `field` (v, u, rows, columns, lanes); `dual` (4, v, u, rows, columns, lanes): updated in place;
    `angular`: how many times the differences between views count.
    """
    down, across, rows, columns, lanes = field.shape
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                for column in range(columns):
                    for lane in range(lanes):
                        slope = _forward_differences(field, v, u, row, column, lane, angular)
                        a = dual[0, v, u, row, column, lane] + step * slope[0]
                        b = dual[1, v, u, row, column, lane] + step * slope[1]
                        c = dual[2, v, u, row, column, lane] + step * slope[2]
                        d = dual[3, v, u, row, column, lane] + step * slope[3]
                        shrink = 1 / max(np.sqrt(a * a + b * b + c * c + d * d), np.float32(1))
                        dual[0, v, u, row, column, lane] = a * shrink
                        dual[1, v, u, row, column, lane] = b * shrink
                        dual[2, v, u, row, column, lane] = c * shrink
                        dual[3, v, u, row, column, lane] = d * shrink


@fast_loop
def sum_light_field_variation(field, angular, total):
    """Add the isotropic variation of each lane to `total` (lanes,), float64.

    `field` (v, u, rows, columns, lanes); `angular`: how many times the differences between views
    count; `total` (lanes,): added to, in place.
    """
    down, across, rows, columns, lanes = field.shape
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                for column in range(columns):
                    for lane in range(lanes):
                        a, b, c, d = _forward_differences(field, v, u, row, column, lane, angular)
                        total[lane] += np.sqrt(a * a + b * b + c * c + d * d)
