"""Compiled inner loops of the solvers, on blocks of exactly `LANES` frames side by side.

Every array is C-contiguous with the frames as last axis, so that one vector instruction treats many frames at once and
every frame's result is independent of its neighbours in the block. Sums over a picture are taken row by row and added
up in float64, because a solver compares objectives that differ in the sixth digit.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.arrays import LANES

TILE = 32

compiled = njit(nogil=True, cache=True, fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy")


@compiled
def nonnegative_shrinkage(current, previous, momentum, gradient, step, threshold, total):
    """``previous = max(z - step * gradient - threshold, 0)`` with ``z = current + momentum * (current - previous)``.

    Pictures are (rows, columns, LANES), `momentum` is (LANES,); `total` (LANES,) float64 gets the sum of the result.
    """
    partial = np.empty(LANES, current.dtype)
    total[:] = 0
    for row in range(current.shape[0]):
        partial[:] = 0
        for column in range(current.shape[1]):
            for lane in range(LANES):
                here = current[row, column, lane]
                point = here + momentum[lane] * (here - previous[row, column, lane])
                value = max(point - step * gradient[row, column, lane] - threshold, np.float32(0))
                previous[row, column, lane] = value
                partial[lane] += value
        total += partial


@compiled
def gradient_step(current, previous, momentum, gradient, step):
    """``gradient = z - step * gradient`` with ``z = current + momentum * (current - previous)``."""
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(LANES):
                here = current[row, column, lane]
                point = here + momentum[lane] * (here - previous[row, column, lane])
                gradient[row, column, lane] = point - step * gradient[row, column, lane]


@compiled
def lanes_to_frames(block, frames):
    """``frames[lane, pixel] = block[pixel, lane]`` for as many lanes as there are frames; contiguous 2D arrays.

    Tile by tile, so that both sides move whole cache lines: several times faster than a strided copy.
    """
    pixels = block.shape[0]
    for first in range(0, pixels, TILE):
        last = min(first + TILE, pixels)
        for lane in range(frames.shape[0]):
            for pixel in range(first, last):
                frames[lane, pixel] = block[pixel, lane]


@compiled
def put_back(candidate, current, rejected):
    """``candidate = current`` in the lanes where `rejected` is 1; it is 0 elsewhere. Arrays are (..., LANES)."""
    for row in range(current.shape[0]):
        for column in range(current.shape[1]):
            for lane in range(LANES):
                here = candidate[row, column, lane]
                candidate[row, column, lane] = here + rejected[lane] * (current[row, column, lane] - here)


@compiled
def _primal_row(row, noisy, dual, weight, result):
    """One row of ``result = max(noisy + weight * div(dual), 0)``; `dual` is (2, rows, columns, LANES).

    The last row of the vertical and the last column of the horizontal dual are always zero (the difference across the
    border is), so only the first ones need care.
    """
    above = max(row - 1, 0)
    has_above = noisy.dtype.type(row > 0)
    for column in range(noisy.shape[1]):
        left = max(column - 1, 0)
        has_left = noisy.dtype.type(column > 0)
        for lane in range(LANES):
            divergence = dual[0, row, column, lane] - has_above * dual[0, above, column, lane]
            divergence += dual[1, row, column, lane] - has_left * dual[1, row, left, lane]
            result[row, column, lane] = max(noisy[row, column, lane] + weight * divergence, np.float32(0))


@compiled
def _dual_row(row, picture, dual, step):
    """One row of ``dual = project(dual + step * grad(picture))`` onto vectors of length at most 1."""
    below = min(row + 1, picture.shape[0] - 1)
    for column in range(picture.shape[1]):
        right = min(column + 1, picture.shape[1] - 1)
        for lane in range(LANES):
            here = picture[row, column, lane]
            vertical = dual[0, row, column, lane] + step * (picture[below, column, lane] - here)
            horizontal = dual[1, row, column, lane] + step * (picture[row, right, lane] - here)
            shrink = 1 / max(np.sqrt(vertical * vertical + horizontal * horizontal), np.float32(1))
            dual[0, row, column, lane] = vertical * shrink
            dual[1, row, column, lane] = horizontal * shrink


@compiled
def total_variation_dual_sweeps(noisy, dual, weight, sweeps, result):
    """Projected-gradient sweeps on the dual of ``1/2 |x - noisy|^2 + weight * TV(x), x >= 0`` (Chambolle 2004).

    The primal row below is made before a dual row changes, so that a sweep passes through memory once.
    """
    rows = noisy.shape[0]
    step = 1 / (8 * weight)
    for _ in range(sweeps):
        _primal_row(0, noisy, dual, weight, result)
        for row in range(rows):
            if row + 1 < rows:
                _primal_row(row + 1, noisy, dual, weight, result)
            _dual_row(row, result, dual, step)


@compiled
def total_variation_primal(noisy, dual, weight, result, total):
    """Make the picture that belongs to `dual`; `total` (LANES,) float64 gets its isotropic total variation."""
    rows, columns = noisy.shape[0], noisy.shape[1]
    partial = np.empty(LANES, noisy.dtype)
    total[:] = 0
    _primal_row(0, noisy, dual, weight, result)
    for row in range(rows):
        below = min(row + 1, rows - 1)
        if row + 1 < rows:
            _primal_row(row + 1, noisy, dual, weight, result)
        partial[:] = 0
        for column in range(columns):
            right = min(column + 1, columns - 1)
            for lane in range(LANES):
                here = result[row, column, lane]
                vertical = result[below, column, lane] - here
                horizontal = result[row, right, lane] - here
                partial[lane] += np.sqrt(vertical * vertical + horizontal * horizontal)
        total += partial
