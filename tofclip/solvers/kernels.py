"""Compiled inner loops of the solvers, on blocks of frames side by side: `LANES` of them, or a
single one.

Every array is C-contiguous with the frames as last axis, so that one vector instruction treats many
frames at once and every frame's result is independent of its neighbours in the block. Sums over a
picture are taken row by row and added up in float64, because a solver compares objectives that
differ in the sixth digit.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.operators.kernels import multiply_sparse_block
from tofclip.threads import LANES

TILE_PIXELS = 32

fast_njit = njit(
    nogil=True, cache=True, fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy"
)
inline_njit = njit(
    inline="always"
)  # so that a full block's number of lanes is a constant to the compiler


@fast_njit
def shrink_nonnegative(current, previous, momentum, gradient, step, threshold, total):
    """``previous = max(z - step * gradient - threshold, 0)`` with ``z = current + momentum *
    (current - previous)``.

    Pictures are (rows, columns, lanes), `momentum` is (lanes,); `total` (lanes,) float64 gets the
    sum of the result.

    Parameters
    ----------
    current : (rows, columns, lanes) array
    previous : (rows, columns, lanes) array
        Overwritten with the result.
    momentum : (lanes,) array
    gradient : (rows, columns, lanes) array
    step, threshold : scalar of the arrays' dtype
        Step size, and step size times weight.
    total : (lanes,) float64 array
        Overwritten with each lane's sum.
    """
    lanes = current.shape[2]
    partial = np.empty(lanes, current.dtype)
    total[:] = 0
    for row in range(current.shape[0]):
        # the dtype of the pictures within a row, float64 across rows: quick, and exact enough to
        # compare objectives
        partial[:] = 0
        for column in range(current.shape[1]):
            for lane in range(lanes):
                here = current[row, column, lane]
                point = here + momentum[lane] * (here - previous[row, column, lane])
                value = max(point - step * gradient[row, column, lane] - threshold, np.float32(0))
                previous[row, column, lane] = value
                partial[lane] += value
        total += partial


@fast_njit
def take_gradient_step(current, previous, momentum, gradient, step):
    """``gradient = z - step * gradient`` with ``z = current + momentum * (current - previous)``.

    Parameters
    ----------
    current, previous : (rows, columns, lanes) array
    momentum : (lanes,) array
    gradient : (rows, columns, lanes) array
        Overwritten.
    step : scalar of the arrays' dtype
    """
    lanes = current.shape[2]
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(lanes):
                here = current[row, column, lane]
                point = here + momentum[lane] * (here - previous[row, column, lane])
                gradient[row, column, lane] = point - step * gradient[row, column, lane]


@fast_njit
def copy_lanes_to_frames(block, frames):
    """``frames[lane, pixel] = block[pixel, lane]`` for as many lanes as there are frames;
    contiguous 2D arrays.

    Tile by tile, so that both sides move whole cache lines: several times faster than a strided
    copy.

    Parameters
    ----------
    block : (pixels, lanes) array
    frames : (frames, pixels) array
        Overwritten; not more frames than lanes.
    """
    pixels = block.shape[0]
    for first in range(0, pixels, TILE_PIXELS):
        last = min(first + TILE_PIXELS, pixels)
        for lane in range(frames.shape[0]):
            for pixel in range(first, last):
                frames[lane, pixel] = block[pixel, lane]


@fast_njit
def compute_traces(tile_starts, columns, values, weights, traces, span):
    """``traces[:, span[0] + t] = M @ weights[t // LANES, :, t % LANES]`` for a sparse matrix M in
    column tiles.

    Parameters
    ----------
    tile_starts, columns, values
        See `tofclip.operators.sparse.Tiles`; a row for each trace.
    weights : (blocks, M's columns, LANES) array
    traces : (M's rows, time) array
        Overwritten from column ``span[0]`` to below ``span[1]``.
    span : (int, int)
    """
    part = np.empty((traces.shape[0], LANES), traces.dtype)
    for block in range(weights.shape[0]):
        multiply_sparse_block(tile_starts, columns, values, weights[block], part)
        first = span[0] + block * LANES
        last = min(first + LANES, span[1])
        for row in range(part.shape[0]):
            for column in range(first, last):
                traces[row, column] = part[row, column - first]


@fast_njit
def update_peaks(tile_starts, columns, values, scales, block, highest):
    """Raise `highest` to the largest ``scales * (M @ block)`` over the rows of a sparse matrix M,
    lane by lane.

    Parameters
    ----------
    tile_starts, columns, values
        See `tofclip.operators.sparse.Tiles`.
    scales : (M's rows,) array
    block : (M's columns, LANES) array
    highest : (LANES,) array
    """
    # 16 kB in float32, which stay in the first-level cache
    part = np.empty((4 * TILE_PIXELS, LANES), block.dtype)
    for first in range(0, scales.size, part.shape[0]):
        rows = min(part.shape[0], scales.size - first)
        multiply_sparse_block(
            tile_starts[:, first : first + rows + 1], columns, values, block, part[:rows]
        )
        for row in range(0, rows, 4):  # four at a time, for one look at the highest so far
            second, third, fourth = (
                min(row + 1, rows - 1),
                min(row + 2, rows - 1),
                min(row + 3, rows - 1),
            )
            a, b, c, d = part[row], part[second], part[third], part[fourth]
            s, t, u, v = (
                scales[first + row],
                scales[first + second],
                scales[first + third],
                scales[first + fourth],
            )
            for lane in range(LANES):
                one, two, three, four = s * a[lane], t * b[lane], u * c[lane], v * d[lane]
                one, three = one if one > two else two, three if three > four else four
                one = one if one > three else three
                highest[lane] = one if one > highest[lane] else highest[lane]


@fast_njit
def restore_frames(candidate, current, rejected):
    """``candidate = current`` in the lanes where `rejected` is 1; it is 0 elsewhere. Arrays are
    (..., lanes).

    Parameters
    ----------
    candidate : (rows, columns, lanes) array
        Overwritten in rejected lanes.
    current : (rows, columns, lanes) array
    rejected : (lanes,) array of the pictures' dtype
        1 or 0.
    """
    lanes = candidate.shape[2]
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(lanes):
                here = candidate[row, column, lane]
                candidate[row, column, lane] = here + rejected[lane] * (
                    current[row, column, lane] - here
                )


@inline_njit
def _primal_row(row, noisy, dual, weight, result, lanes):
    """One row of ``result = max(noisy + weight * div(dual), 0)``; `dual` is (2, rows, columns,
    lanes).

    The last row of the vertical and the last column of the horizontal dual are always zero (the
    difference across the border is), so only the first ones need care.
    """
    above = max(row - 1, 0)
    # 0 or 1 as a factor: no branch inside the loops over columns and lanes
    has_above = noisy.dtype.type(row > 0)
    for column in range(noisy.shape[1]):
        left = max(column - 1, 0)
        has_left = noisy.dtype.type(column > 0)
        for lane in range(lanes):
            divergence = dual[0, row, column, lane] - has_above * dual[0, above, column, lane]
            divergence += dual[1, row, column, lane] - has_left * dual[1, row, left, lane]
            result[row, column, lane] = max(
                noisy[row, column, lane] + weight * divergence, np.float32(0)
            )


@inline_njit
def _dual_row(row, picture, dual, step, lanes):
    """One row of ``dual = project(dual + step * grad(picture))`` onto vectors of length at most 1."""
    below = min(row + 1, picture.shape[0] - 1)
    for column in range(picture.shape[1]):
        right = min(column + 1, picture.shape[1] - 1)
        for lane in range(lanes):
            here = picture[row, column, lane]
            vertical = dual[0, row, column, lane] + step * (picture[below, column, lane] - here)
            horizontal = dual[1, row, column, lane] + step * (picture[row, right, lane] - here)
            shrink = 1 / max(np.sqrt(vertical * vertical + horizontal * horizontal), np.float32(1))
            dual[0, row, column, lane] = vertical * shrink
            dual[1, row, column, lane] = horizontal * shrink


@inline_njit
def _dual_sweeps(noisy, dual, weight, sweeps, result, lanes):
    rows = noisy.shape[0]
    # the squared norm of the gradient is at most 8 (Chambolle 2004)
    step = 1 / (8 * weight)
    for _ in range(sweeps):
        _primal_row(0, noisy, dual, weight, result, lanes)
        for row in range(rows):
            # the next row is made from the old dual, before this row's dual changes
            if row + 1 < rows:
                _primal_row(row + 1, noisy, dual, weight, result, lanes)
            _dual_row(row, result, dual, step, lanes)


@fast_njit
def sweep_total_variation_dual(noisy, dual, weight, sweeps, result):
    """Projected-gradient sweeps on the dual of ``1/2 |x - noisy|^2 + weight * TV(x), x >= 0``
    (Chambolle 2004).

    The primal row below is made before a dual row changes, so that a sweep passes through memory
    once.

    Parameters
    ----------
    noisy : (rows, columns, lanes) array
    dual : (2, rows, columns, lanes) array
        Vertical and horizontal; updated in place.
    weight : scalar of the arrays' dtype
        Above zero.
    sweeps : int
    result : (rows, columns, lanes) array
        Overwritten; room for the primal picture.
    """
    # a constant number of lanes lets the compiler unroll the innermost loop
    if noisy.shape[2] == LANES:
        _dual_sweeps(noisy, dual, weight, sweeps, result, LANES)
    else:
        _dual_sweeps(noisy, dual, weight, sweeps, result, noisy.shape[2])


@inline_njit
def _primal_block(noisy, dual, weight, result, total, lanes):
    rows, columns = noisy.shape[0], noisy.shape[1]
    partial = np.empty(lanes, noisy.dtype)
    total[:] = 0
    _primal_row(0, noisy, dual, weight, result, lanes)
    for row in range(rows):
        below = min(row + 1, rows - 1)
        if row + 1 < rows:
            _primal_row(row + 1, noisy, dual, weight, result, lanes)
        partial[:] = 0
        for column in range(columns):
            right = min(column + 1, columns - 1)
            for lane in range(lanes):
                here = result[row, column, lane]
                vertical = result[below, column, lane] - here
                horizontal = result[row, right, lane] - here
                partial[lane] += np.sqrt(vertical * vertical + horizontal * horizontal)
        total += partial


@fast_njit
def compute_total_variation_primal(noisy, dual, weight, result, total):
    """Make the picture that belongs to `dual`; `total` (lanes,) float64 gets its isotropic total
    variation.

    Parameters
    ----------
    noisy : (rows, columns, lanes) array
    dual : (2, rows, columns, lanes) array
    weight : scalar of the arrays' dtype
    result : (rows, columns, lanes) array
        Overwritten with ``max(noisy + weight * div(dual), 0)``.
    total : (lanes,) float64 array
        Overwritten.
    """
    if noisy.shape[2] == LANES:
        _primal_block(noisy, dual, weight, result, total, LANES)
    else:
        _primal_block(noisy, dual, weight, result, total, noisy.shape[2])


@fast_njit
def compute_light_field_primal(noisy, dual, weight, angular, result):
    """``result = max(noisy + weight * div(dual), 0)``; arrays are (v, u, rows, columns, lanes),
    `dual` four of them.

    The last difference along every axis crosses the border and is always zero, so only the first
    needs care.

    Parameters
    ----------
    noisy : (v, u, rows, columns, lanes) array
    dual : (4, v, u, rows, columns, lanes) array
        Along rows, columns, v and u.
    weight : scalar of the arrays' dtype
    angular : scalar of the arrays' dtype
        How many times the differences between views count.
    result : (v, u, rows, columns, lanes) array
        Overwritten.
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


@inline_njit
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


@fast_njit
def update_light_field_dual(field, dual, step, angular):
    """``dual = project(dual + step * grad(field))`` onto vectors of length at most 1.

    Parameters
    ----------
    field : (v, u, rows, columns, lanes) array
    dual : (4, v, u, rows, columns, lanes) array
        Updated in place.
    step : scalar of the arrays' dtype
    angular : scalar of the arrays' dtype
        How many times the differences between views count.
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


@fast_njit
def sum_light_field_variation(field, angular, total):
    """Add the isotropic variation of each lane to `total` (lanes,), float64.

    Parameters
    ----------
    field : (v, u, rows, columns, lanes) array
    angular : scalar of the arrays' dtype
        How many times the differences between views count.
    total : (lanes,) float64 array
        Added to, in place.
    """
    down, across, rows, columns, lanes = field.shape
    for v in range(down):
        for u in range(across):
            for row in range(rows):
                for column in range(columns):
                    for lane in range(lanes):
                        a, b, c, d = _forward_differences(field, v, u, row, column, lane, angular)
                        total[lane] += np.sqrt(a * a + b * b + c * c + d * d)
