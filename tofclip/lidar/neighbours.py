"""How far ranges are off, by what their neighbours on the same surface show.

A recovered frame's errors have two parts. Noise of the measurements is known from each pixel's own
trace, since it differs from bin to bin. What the recovery gets wrong (a prior that smooths, a
resolution that mixes neighbours, directions that no view sees) is alike in all bins of a pulse: it
moves the return without a trace in the fit's residual. On simulated shots it makes errors 1.7 to
2.5 times as large as the fit says, and a second recovery of what was recovered first (a parametric
bootstrap) does not show it either, because the first result already agrees with the prior.

But it changes from pixel to pixel along a surface. A plane in space is linear in inverse depth over
the picture, whatever its tilt. So a plane is fitted through the returns within `REACH_PX` of each,
and what these scatter about it beyond their own noise is the recovery's part. A plane takes up some
of what is alike over its whole reach: `PLANE_SHARE` makes up for that. It was found on two scenes, a
recorded shot's geometry and one by another forward model, with total variation and l1; z-scores are
0.9 to 1.07 there.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.compiling import compile_as_part, compile_loop, inlined
from tofclip.threads import run_blocks
from tofclip.units import MAD_TO_SIGMA
from tofclip.vectors import (
    LENGTH,
    STEP,
    choose,
    count_set_lanes,
    fill_vector,
    find_highest_lane,
    list_set_lanes,
    load_vector,
    store_vector,
    sum_vector,
)

plane_part = compile_as_part(fastmath=True, _nrt=False)

# neighbours that share a plane, and their distance: errors of adjacent pixels are much alike
REACH_PX, STRIDE_PX = 8, 2
# distance of the pixels whose returns have planes of their own; those between take over what is known
# of one within a plane's reach on the same surface
PLANE_STEP_PX = 4
# variance of the recovery's errors, relative to what a plane of this reach leaves of it
PLANE_SHARE = 1.5
FIT_ROUNDS, MIN_NEIGHBOURS, OUTLIER_DEVIATIONS = 4, 8, 3.0
MIN_KNOWN = 20  # returns with enough neighbours that say how far the others are off
MEDIAN_PRECISION = 1e-4
INTERPOLATED_LOOKS = 5  # for a median, before intervals are halved: most often that is enough
RETURNS_PER_BLOCK = 2048  # about 3 ms of planes: less is done before other threads have begun

MARGIN = REACH_PX // STRIDE_PX
SIDE = 2 * MARGIN + 1  # places for neighbours in a row of a window, and rows of a window
NEIGHBOURS = 96  # room for the SIDE^2 = 81 neighbours, in whole vectors
FAR = 1e20  # nearness of a neighbour that is not there, 1/m

# The rows of a window, (5, NEIGHBOURS): columns and rows away, by how much further off each neighbour
# is, m, whether it is used, 1 or 0, and how far from the plane, m.
RIGHT, DOWN, OFF, USED, RESIDUAL = range(5)


def add_recovery_error(
    sigma: FloatArray,
    distance: FloatArray,
    along_axis: FloatArray,
    pixel: NDArray[np.int64],
    image_shape: tuple[int, int],
    gate: float,
) -> FloatArray:
    """Return one standard deviation of ranges, m, with the recovery's own errors. `sigma` (n,):
    deviation that the noise in each pixel's trace explains, m; `distance` (n,): range, m;
    `along_axis` (n,): depth along the optical axis for a range of 1; `pixel` (n,): number of the
    pixel, not decreasing. A neighbour that is further away than `gate`, m, is on another surface.
    Returns with few neighbours get what is usual for the others.
    """
    if pixel.size == 0:
        return np.array(sigma)
    rows, columns = image_shape
    each = np.bincount(pixel, minlength=rows * columns)  # returns of each pixel
    starts = np.append(0, np.cumsum(each))
    nearness = 1 / (distance * along_axis)
    metres = distance / nearness
    layers = layer_returns(nearness, pixel, starts, image_shape)
    scatter = np.full(pixel.size, np.nan)

    def fit_planes(chosen: NDArray[np.int64]) -> None:
        def fit(piece: slice) -> None:
            returns = nearness, metres, pixel
            window = allocate_window()
            scatter_about_planes(*returns, columns, layers, gate, chosen[piece], window, scatter)

        run_blocks(fit, chosen.size, RETURNS_PER_BLOCK)

    # neighbours have nearly the same returns around them: one plane in sixteen does
    own = np.zeros(image_shape, bool)
    own[::PLANE_STEP_PX, ::PLANE_STEP_PX] = True
    fit_planes(np.flatnonzero(own.ravel().take(pixel)))
    memory = np.empty((2, 16 * int(each.max())))
    borrow_scatter(nearness, metres, starts, image_shape, gate, memory, scatter)
    fit_planes(np.flatnonzero(np.isnan(scatter)))
    known = scatter >= 0
    if np.count_nonzero(known) < MIN_KNOWN:
        return np.array(sigma)
    total: FloatArray = np.sqrt(sigma**2 + PLANE_SHARE * np.maximum(scatter**2 - sigma**2, 0.0))
    alone = np.flatnonzero(~known)
    if alone.size:
        total[alone] = sigma[alone] * np.median(total[known] / sigma[known])
    return total


def layer_returns(
    nearness: FloatArray,
    pixel: NDArray[np.int64],
    starts: NDArray[np.int64],
    image_shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Lay out the returns so that those at the neighbours' distance lie side by side: (most returns of a
    pixel, 4, rows, columns) of `nearness` of each pixel's first, second, ... returns, `FAR` where there is
    none; of pixels of even rows and columns, even rows and odd columns, and so on, within a margin.
    """
    rows, columns = (-(-size // STRIDE_PX) + 2 * MARGIN for size in image_shape)
    shape = (int(np.diff(starts).max()), STRIDE_PX**2, rows, columns + LENGTH - SIDE)
    y, x = np.arange(image_shape[0])[:, np.newaxis], np.arange(image_shape[1])
    part = y % STRIDE_PX * STRIDE_PX + x % STRIDE_PX
    place = (part * rows + y // STRIDE_PX + MARGIN) * shape[3] + x // STRIDE_PX + MARGIN
    layers = np.full((shape[0], math.prod(shape[1:])), FAR, np.float32)
    rank = np.arange(pixel.size) - starts.take(pixel)
    layers[rank, place.ravel().take(pixel)] = nearness
    return layers.reshape(shape)


def allocate_window() -> NDArray[np.float32]:
    """Return the memory of `scatter_about_planes`; its first two rows stay as they are."""
    window = np.zeros((5, NEIGHBOURS), np.float32)
    away = STRIDE_PX * np.arange(-MARGIN, MARGIN + 1)
    window[RIGHT, : SIDE**2], window[DOWN, : SIDE**2] = np.tile(away, SIDE), np.repeat(away, SIDE)
    window[OFF] = FAR
    return window


@compile_loop(fastmath=True)
def scatter_about_planes(nearness, metres, pixel, columns, layers, gate, chosen, memory, scatter):
    """Robust deviation of the returns around each from a plane through them, m; -1 if they are few.
    `nearness` (n,): inverse depth along the optical axis, 1/m; `metres` (n,): change of a return's
    range for a change of its nearness, m^2; `pixel` (n,); `layers`: see `layer_returns`; `gate`: m;
    `chosen` (k,): returns for which `scatter` (n,) is overwritten; `memory`: of `allocate_window`.
    """
    for own in chosen:
        y, x = pixel[own] // columns, pixel[own] % columns
        take_nearest(
            layers, (y, x), np.float32(nearness[own]), np.float32(metres[own]), memory[OFF]
        )
        deviation, most, a, b, c, count = -1.0, gate, 0.0, 0.0, 0.0, 0
        median = np.float32(0)
        for rounds in range(FIT_ROUNDS + 1):
            measure_offsets(memory, a, b, c)
            if rounds > 0:
                free = count / (count - 3.0)
                median = find_median(memory, count, median)
                deviation = MAD_TO_SIGMA * median * math.sqrt(free)
                most = OUTLIER_DEVIATIONS * deviation
            changed = mark_near(memory, most)
            # where nothing changed further rounds would find the same
            if rounds == FIT_ROUNDS or (rounds > 0 and not changed):
                break
            a, b, c, count = fit_plane_around(memory)
            if count < MIN_NEIGHBOURS:
                deviation = -1.0
                break
        scatter[own] = deviation


@inlined
def take_nearest(layers, own, nearness, metres, off):
    """Of each pixel around (row, column) `own`, take the return that is nearest in range to one of this
    `nearness`, and enter by how much further it is, m; beyond any gate where there is none.
    """
    top, left = own[0] // STRIDE_PX, np.uintp(own[1] // STRIDE_PX)
    part = own[0] % STRIDE_PX * STRIDE_PX + own[1] % STRIDE_PX
    here, scale, zero = fill_vector(nearness), fill_vector(metres), fill_vector(np.float32(0))
    for j in range(SIDE):
        nearest = far = fill_vector(np.float32(FAR))
        for layer in range(layers.shape[0]):
            away = here - load_vector(layers[layer, part, top + j], left)
            distance = choose(away > zero, away, zero - away)
            nearest = choose(far > distance, away, nearest)
            far = choose(far > distance, distance, far)
        # the lanes behind the row's last place are overwritten by the next row
        store_vector(off, np.uintp(SIDE * j), nearest * scale)
    for t in range(SIDE * SIDE, NEIGHBOURS):
        off[t] = FAR


@inlined
def measure_offsets(memory, a, b, c):
    """Enter the distance, m, of each neighbour from the plane ``a * right + b * down + c``."""
    right, down, off, residual = memory[RIGHT], memory[DOWN], memory[OFF], memory[RESIDUAL]
    slope, fall = fill_vector(np.float32(a)), fill_vector(np.float32(b))
    level, zero = fill_vector(np.float32(c)), fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        above = load_vector(off, t) - slope * load_vector(right, t)
        above -= fall * load_vector(down, t) + level
        store_vector(residual, t, choose(above > zero, above, zero - above))


@inlined
def mark_near(memory, most):
    """Use the neighbours that are off by at most so much, m; return whether others were used before."""
    used, residual = memory[USED], memory[RESIDUAL]
    farthest, changed = fill_vector(np.float32(most)), np.uint64(0)
    one, zero = fill_vector(np.float32(1)), fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        near = farthest >= load_vector(residual, t)
        changed |= list_set_lanes(near) ^ list_set_lanes(load_vector(used, t) > zero)
        store_vector(used, t, choose(near, one, zero))
    return changed != 0


@inlined
def find_median(memory, count, guess):
    """Median of what is used, `count` numbers of which there is at least one, by narrowing an interval:
    each step is one look at all, the first one at a `guess` above zero. It is right to
    `MEDIAN_PRECISION` of the largest where some in the middle are that close together.
    """
    low, high = np.float32(0), find_residuals_beside(memory, np.float32(FAR))[0]
    precision, middle = np.float32(MEDIAN_PRECISION) * high, high
    half, below_low, below_high = np.float32(0.5 * count), np.float32(0), np.float32(count)
    looks = 0
    while high - low > precision:
        # as if residuals lay evenly between the two, at first
        part = (half - below_low) / (below_high - below_low)
        part = part if looks < INTERPOLATED_LOOKS else np.float32(0.5)
        middle = low + part * (high - low)
        middle = guess if looks == 0 and 0 < guess < high else middle
        looks += 1
        below = count_used_below(memory, middle)
        if -1 <= 2 * below - count <= 1:
            last, first = find_residuals_beside(memory, middle)
            last = first if 2 * below < count else last
            first = last if 2 * below > count else first
            return np.float32(0.5) * (last + first)
        # no branches: which half it is cannot be foreseen
        above, number = 2 * below > count, np.float32(below)
        high, low = (middle if above else high), (low if above else middle)
        below_high, below_low = (number if above else below_high), (below_low if above else number)
        middle = high
    return middle


@inlined
def count_used_below(memory, limit):
    """How many of those used are off by at most `limit`."""
    used, residual, below = memory[USED], memory[RESIDUAL], 0
    most, zero = fill_vector(limit), fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        near = most >= load_vector(residual, t)
        below += count_set_lanes(near & (load_vector(used, t) > zero))
    return below


@plane_part
def find_residuals_beside(memory, limit):
    """The largest residual of those used that is at most `limit`, or 0, and the smallest above it, or
    `FAR`.
    """
    used, residual = memory[USED], memory[RESIDUAL]
    most, zero = fill_vector(limit), fill_vector(np.float32(0))
    last, first = zero, fill_vector(np.float32(FAR))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        here, counted = load_vector(residual, t), load_vector(used, t) > zero
        last = choose(counted & (most >= here) & (here > last), here, last)
        first = choose(counted & (here > most) & (first > here), here, first)
    return find_highest_lane(last), -find_highest_lane(zero - first)


@plane_part
def fit_plane_around(memory):
    """Least-squares plane ``a * right + b * down + c`` through the neighbours that are used, and their
    number; 0 if they lie in one line, which says nothing of the slope across it.
    """
    right, down, off, used = memory[RIGHT], memory[DOWN], memory[OFF], memory[USED]
    number = total = along = across = zero = fill_vector(np.float32(0))
    xx = xy = yy = xv = yv = zero
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        weight, here = load_vector(used, t), load_vector(off, t)
        to_right, downward = load_vector(right, t), load_vector(down, t)
        x, y = weight * to_right, weight * downward
        number += weight
        total += weight * here
        along += x
        across += y
        xx += x * to_right
        xy += x * downward
        yy += y * downward
        xv += x * here
        yv += y * here
    n, s, sx, sy = sum_vector(number), sum_vector(total), sum_vector(along), sum_vector(across)
    sxx, sxy, syy = sum_vector(xx), sum_vector(xy), sum_vector(yy)
    sxv, syv = sum_vector(xv), sum_vector(yv)
    if n < MIN_NEIGHBOURS:
        return 0.0, 0.0, 0.0, 0
    cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    cxv, cyv = sxv - sx * s / n, syv - sy * s / n
    determinant = cxx * cyy - cxy * cxy
    if determinant <= np.float32(1e-5) * cxx * cyy:  # in single precision
        return 0.0, 0.0, 0.0, 0
    a = (cyy * cxv - cxy * cyv) / determinant
    b = (cxx * cyv - cxy * cxv) / determinant
    return float(a), float(b), float((s - a * sx - b * sy) / n), int(n)


@compile_loop()
def borrow_scatter(nearness, metres, starts, image_shape, gate, memory, scatter):
    """Take over what is known of the return nearest in range, on the same surface, of those within a
    plane's reach whose row and column `PLANE_STEP_PX` divides; NaN where there is none or it has few
    neighbours. All returns of a cell of ``PLANE_STEP_PX**2`` pixels have the same ones around them.

    `starts` (pixels + 1,): first return of each pixel; `memory` (2, 16 * most returns of a pixel).
    """
    rows, columns = image_shape
    step, near, known = PLANE_STEP_PX, memory[0], memory[1]
    for top in range(0, rows, step):
        for left in range(0, columns, step):
            number = 0
            for y in range(max(top - step, 0), min(top + 3 * step, rows), step):
                for x in range(max(left - step, 0), min(left + 3 * step, columns), step):
                    for k in range(starts[y * columns + x], starts[y * columns + x + 1]):
                        near[number], known[number] = nearness[k], scatter[k]
                        number += 1
            for y in range(top, min(top + step, rows)):
                first = y * columns + left + (1 if y == top else 0)
                for k in range(starts[first], starts[y * columns + min(left + step, columns)]):
                    least, best = np.inf, np.nan
                    for place in range(number):
                        off = math.fabs(nearness[k] - near[place])
                        best = known[place] if off < least else best
                        least = off if off < least else least
                    scatter[k] = best if least * metres[k] < gate and best >= 0 else np.nan
