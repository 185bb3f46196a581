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
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tofclip.compiling import compile_loop, inlined
from tofclip.threads import run_blocks
from tofclip.vectors import (
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

FloatArray = NDArray[np.float64]

REACH_PX, STRIDE_PX = 8, 2
"""Neighbours that share a plane, and their distance: errors of adjacent pixels are much alike."""

PLANE_STEP_PX = 4
"""Distance of the pixels whose returns have planes of their own; those between take over what is
known of one within a plane's reach on the same surface."""

PLANE_SHARE = 1.5
"""Variance of the recovery's errors, relative to what a plane of this reach leaves of it."""

FIT_ROUNDS = 4
MIN_NEIGHBOURS = 8
OUTLIER_DEVIATIONS = 3.0
MIN_KNOWN = 20
"""Returns with enough neighbours that say how far the others are off."""

MAD_TO_SIGMA = 1.4826
MEDIAN_PRECISION = 1e-4
RETURNS_PER_BLOCK = 2048
"""About 3 ms of planes: less than that is done before other threads have begun."""

MARGIN = REACH_PX // STRIDE_PX
SIDE = 2 * MARGIN + 1
"""Places for neighbours in a row of a window, and rows of a window."""

WIDTH = 12
"""Places of a row that are looked at, in whole vectors; those after `SIDE` are not used."""

NEIGHBOURS = 96
"""Room for the SIDE^2 = 81 neighbours, in whole vectors."""

CELL_LANES = 8
"""Returns of a cell are compared with those around in whole vectors."""

FAR = 1e20
"""Nearness of a neighbour that is not there, 1/m."""


def add_recovery_error(
    sigma: FloatArray,
    distance: FloatArray,
    along_axis: FloatArray,
    pixel: NDArray[np.int64],
    image_shape: tuple[int, int],
    gate: float,
) -> FloatArray:
    """Return the deviation of ranges with the recovery's own errors.

    Parameters
    ----------
    sigma : (n,) array
        Deviation that the noise in each pixel's trace explains, m.
    distance : (n,) array
        Range, m.
    along_axis : (n,) array
        Depth along the optical axis for a range of 1: the direction's z.
    pixel : (n,) int array
        Number of the pixel, not decreasing.
    image_shape : (int, int)
    gate : float
        A neighbour that is further away than this, m, is on another surface.

    Returns
    -------
    (n,) float64 array
        One standard deviation, m. Returns with few neighbours get what is usual for the others.
    """
    total = np.asarray(sigma, dtype=np.float64).copy()
    if pixel.size == 0:
        return total
    starts = np.zeros(image_shape[0] * image_shape[1] + 1, np.int64)
    np.cumsum(np.bincount(pixel, minlength=starts.size - 1), out=starts[1:])
    nearness = 1 / (distance * along_axis)
    metres = distance / nearness
    layers = layer_returns(nearness, pixel, starts, image_shape)
    scatter = np.full(total.size, np.nan)

    def fit_planes(chosen: NDArray[np.int64]) -> None:
        def fit(piece: slice) -> None:
            scatter_about_planes(
                nearness,
                metres,
                pixel,
                image_shape[1],
                layers,
                gate,
                chosen[piece],
                allocate_window(),
                scatter,
            )

        run_blocks(fit, chosen.size, RETURNS_PER_BLOCK)

    # neighbours have nearly the same returns around them: one plane in sixteen does
    fit_planes(np.flatnonzero(_lay_out(image_shape)[1].take(pixel)))
    # zeros, since numbers too small to be normal take a hundred times as long
    cell = np.zeros((3, PLANE_STEP_PX**2 * layers.shape[0] + CELL_LANES))
    borrow_scatter(nearness, metres, starts, image_shape, gate, cell, scatter)
    fit_planes(np.flatnonzero(np.isnan(scatter)))
    known = scatter >= 0
    if np.count_nonzero(known) < MIN_KNOWN:
        return total
    variance = total * total
    excess = np.maximum(scatter * scatter - variance, 0)
    found = np.sqrt(variance + PLANE_SHARE * excess)
    usual = float(np.median((found / total)[known]))
    return np.where(known, found, usual * total)


@lru_cache(maxsize=4)
def _lay_out(
    image_shape: tuple[int, int],
) -> tuple[NDArray[np.int64], NDArray[np.bool_], tuple[int, int, int]]:
    """Where each pixel lies in a layer of `layer_returns`, whether its returns have planes of their
    own, and a layer's shape.
    """
    y, x = np.indices(image_shape).reshape(2, -1)
    own_plane = (y % PLANE_STEP_PX == 0) & (x % PLANE_STEP_PX == 0)
    rows, columns = (-(-size // STRIDE_PX) + MARGIN for size in image_shape)
    shape = (STRIDE_PX**2, rows + MARGIN, columns + WIDTH)
    place = np.ravel_multi_index(
        (
            y % STRIDE_PX * STRIDE_PX + x % STRIDE_PX,
            y // STRIDE_PX + MARGIN,
            x // STRIDE_PX + MARGIN,
        ),
        shape,
    )
    return place, own_plane, shape


def layer_returns(
    nearness: FloatArray,
    pixel: NDArray[np.int64],
    starts: NDArray[np.int64],
    image_shape: tuple[int, int],
) -> FloatArray:
    """Lay out the returns so that those at the neighbours' distance lie side by side.

    Parameters
    ----------
    nearness : (n,) array
        Inverse depth along the optical axis, 1/m.
    pixel : (n,) int64 array
        Not decreasing.
    starts : (pixels + 1,) int64 array
        First return of each pixel.
    image_shape : (int, int)

    Returns
    -------
    (most returns of a pixel, 4, rows, columns) float64 array
        `nearness` of each pixel's first, second, ... returns, `FAR` where there is none; of pixels of
        even rows and columns, even rows and odd columns, and so on, within a margin.
    """
    place, _, shape = _lay_out(image_shape)
    number = np.arange(pixel.size) - starts.take(pixel)
    layers = np.full((int(number.max()) + 1, *shape), FAR)
    layers.reshape(-1)[place.take(pixel) + number * layers[0].size] = nearness
    return layers


def allocate_window() -> NDArray[np.float32]:
    """Return the memory of `scatter_about_planes`: columns and rows away, how much further off, whether
    it is used, and how far from the plane, in m, of each neighbour.
    """
    window = np.zeros((5, NEIGHBOURS), np.float32)
    away = STRIDE_PX * np.arange(-MARGIN, MARGIN + 1)
    window[0, : SIDE**2], window[1, : SIDE**2] = np.tile(away, SIDE), np.repeat(away, SIDE)
    window[2] = FAR
    return window


@compile_loop(fastmath=True, _nrt=True)
def scatter_about_planes(nearness, metres, pixel, columns, layers, gate, chosen, memory, scatter):
    """Robust deviation of the returns around each from a plane through them, -1 if they are few.

    Parameters
    ----------
    nearness : (n,) array
        Inverse depth along the optical axis, 1/m.
    metres : (n,) array
        Change of a return's range for a change of its nearness, m^2.
    pixel : (n,) int64 array
    columns : int
        Of the picture.
    layers : (most returns of a pixel, 4, rows, columns) array
        See `layer_returns`.
    gate : float
        m.
    chosen : (k,) int64 array
        Numbers of the returns.
    memory : (5, NEIGHBOURS) float32 array
        As `allocate_window` returns it; all but the first two rows are overwritten.
    scatter : (n,) array
        Overwritten at the chosen: m.
    """
    nearest = np.empty(SIDE * WIDTH)
    for own in chosen:
        y, x = pixel[own] // columns, pixel[own] % columns
        take_nearest(layers, (y, x), nearness[own], nearest)
        for j in range(SIDE):
            for i in range(SIDE):
                memory[2, j * SIDE + i] = np.float32(nearest[j * WIDTH + i] * metres[own])
        deviation, most, a, b, c, count = -1.0, gate, 0.0, 0.0, 0.0, 0
        for rounds in range(FIT_ROUNDS + 1):
            measure_offsets(memory, a, b, c)
            if rounds > 0:
                free = count / (count - 3.0)
                deviation = MAD_TO_SIGMA * find_median(memory, count) * math.sqrt(free)
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
def take_nearest(layers, own, nearness, nearest):
    """Of each pixel around, take the return that is nearest in range.

    Parameters
    ----------
    layers : (most returns of a pixel, 4, rows, columns) array
        See `layer_returns`.
    own : (int, int)
        Row and column of the pixel in the middle.
    nearness : float
        Of its return, 1/m.
    nearest : (SIDE * WIDTH,) array
        Overwritten: by how much its nearness is greater, 1/m; beyond any gate where there is none.
    """
    top, left = own[0] // STRIDE_PX, own[1] // STRIDE_PX
    part = own[0] % STRIDE_PX * STRIDE_PX + own[1] % STRIDE_PX
    for t in range(SIDE * WIDTH):
        nearest[t] = FAR
    for layer in range(layers.shape[0]):
        window = layers[layer, part, top : top + SIDE, left : left + WIDTH]
        for j in range(SIDE):
            for i in range(WIDTH):
                off, best = nearness - window[j, i], nearest[j * WIDTH + i]
                nearest[j * WIDTH + i] = off if math.fabs(off) < math.fabs(best) else best


@inlined
def measure_offsets(memory, a, b, c):
    """Distance of each neighbour from the plane ``a * right + b * down + c``.

    Parameters
    ----------
    memory : (5, NEIGHBOURS) float32 array
        See `scatter_about_planes`; the last row is overwritten, m.
    a, b, c : float
    """
    right, down, off, residual = memory[0], memory[1], memory[2], memory[4]
    slope, fall = fill_vector(np.float32(a)), fill_vector(np.float32(b))
    level, zero = fill_vector(np.float32(c)), fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        above = load_vector(off, t) - slope * load_vector(right, t)
        above -= fall * load_vector(down, t) + level
        store_vector(residual, t, choose(above > zero, above, zero - above))


@inlined
def mark_near(memory, most):
    """Use the neighbours that are off by at most so much; return whether others were used before.

    Parameters
    ----------
    memory : (5, NEIGHBOURS) float32 array
        See `scatter_about_planes`; 1 or 0 is written to the row that says which are used.
    most : float
        m.

    Returns
    -------
    bool
    """
    used, residual = memory[3], memory[4]
    farthest, changed = fill_vector(np.float32(most)), np.uint64(0)
    one, zero = fill_vector(np.float32(1)), fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        near = farthest >= load_vector(residual, t)
        changed |= list_set_lanes(near) ^ list_set_lanes(load_vector(used, t) > zero)
        store_vector(used, t, choose(near, one, zero))
    return changed != 0


@inlined
def find_median(memory, count):
    """Return the median of what is used, by halving an interval: each step is one look at all.

    Parameters
    ----------
    memory : (5, NEIGHBOURS) float32 array
        See `scatter_about_planes`.
    count : int
        Of those used, at least one.

    Returns
    -------
    float
        To `MEDIAN_PRECISION` of the largest.
    """
    used, residual = memory[3], memory[4]
    tops = zero = fill_vector(np.float32(0))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        here = load_vector(used, t) * load_vector(residual, t)
        tops = choose(here > tops, here, tops)
    low, high = np.float32(0), find_highest_lane(tops)
    precision, middle = np.float32(MEDIAN_PRECISION) * high, high
    while high - low > precision:
        middle, below = np.float32(0.5) * (low + high), 0
        limit = fill_vector(middle)
        for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
            near = limit >= load_vector(residual, t)
            below += count_set_lanes(near & (load_vector(used, t) > zero))
        if 2 * below == count:
            return middle
        # no branches: which half it is cannot be foreseen
        high = middle if 2 * below > count else high
        low = middle if 2 * below < count else low
        middle = high
    return middle


@inlined
def fit_plane_around(memory):
    """Least-squares plane ``a * right + b * down + c`` through the neighbours that are used.

    Parameters
    ----------
    memory : (5, NEIGHBOURS) float32 array
        See `scatter_about_planes`.

    Returns
    -------
    a, b, c : float
    count : int
        Neighbours used; 0 if they lie in one line, which says nothing of the slope across it.
    """
    right, down, off, used = memory[0], memory[1], memory[2], memory[3]
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
    """Take over what is known of the return nearest in range, on the same surface, of those within
    a plane's reach whose row and column `PLANE_STEP_PX` divides.

    All returns of a cell of ``PLANE_STEP_PX**2`` pixels have the same ones around them.

    Parameters
    ----------
    nearness, metres, gate
        As for `scatter_about_planes`.
    starts : (pixels + 1,) int64 array
        First return of each pixel.
    image_shape : (int, int)
    memory : (3, PLANE_STEP_PX**2 * most returns of a pixel + CELL_LANES) array
        Overwritten: nearness of a cell's returns, how far off the nearest is, and its scatter.
    scatter : (n,) array
        Known of the pixels whose row and column `PLANE_STEP_PX` divides; overwritten elsewhere: m,
        NaN where there is no such return or it has few neighbours.
    """
    rows, columns = image_shape
    step = PLANE_STEP_PX
    own, least, held = memory[0], memory[1], memory[2]
    for top in range(0, rows, step):
        for left in range(0, columns, step):
            right, below = min(left + step, columns), min(top + step, rows)
            number = open_cell(nearness, starts, columns, (top, below, left, right), memory)
            if number == 0:
                continue
            lanes = (number + CELL_LANES - 1) // CELL_LANES * CELL_LANES
            for y in range(max(top - step, 0), min(top + 3 * step, rows), step):
                for x in range(max(left - step, 0), min(left + 3 * step, columns), step):
                    for k in range(starts[y * columns + x], starts[y * columns + x + 1]):
                        there, known = nearness[k], scatter[k]
                        for lane in range(lanes):
                            off = math.fabs(own[lane] - there)
                            nearer = off < least[lane]
                            # in this order: the other way round no vectors are made of it
                            held[lane] = known if nearer else held[lane]
                            least[lane] = off if nearer else least[lane]
            number = starts[top * columns + left + 1] - starts[top * columns + left]
            for y in range(top, below):
                first = y * columns + left + (1 if y == top else 0)
                for k in range(starts[first], starts[y * columns + right]):
                    near = least[number] * metres[k] < gate and held[number] >= 0
                    scatter[k] = held[number] if near else np.nan
                    number += 1


@inlined
def open_cell(nearness, starts, columns, cell, memory):
    """Return how many returns a cell has, and list their nearness.

    Parameters
    ----------
    nearness, starts, memory
        As for `borrow_scatter`.
    columns : int
        Of the picture.
    cell : (int, int, int, int)
        First row and the one after the last, first column and the one after the last.
    """
    own, least, held = memory[0], memory[1], memory[2]
    top, below, left, right = cell
    number = 0
    for y in range(top, below):
        for k in range(starts[y * columns + left], starts[y * columns + right]):
            own[number], least[number], held[number] = nearness[k], np.inf, np.nan
            number += 1
    return number


@compile_loop()
def raise_to_maximum(index, values, maxima):
    """Raise each of some maxima to the largest of its values.

    Parameters
    ----------
    index : (n,) int64 array
        To which of the maxima each value belongs.
    values : (n,) array
    maxima : (m,) array
        Raised.
    """
    for number in range(index.size):
        maxima[index[number]] = max(maxima[index[number]], values[number])


@compile_loop()
def pool_significance(pixel, at, distance, own, starts, image_shape, limits, pooled):
    """Add to each candidate's significance those of its neighbours at the same range.

    Parameters
    ----------
    pixel : (n,) int64 array
        Not decreasing.
    at : (n,) array
        Range at which neighbours are looked for, m.
    distance : (n,) array
        Range of each candidate, m.
    own : (n,) array
    starts : (pixels + 1,) int64 array
        First candidate of each pixel.
    image_shape : (int, int)
    limits : (float, float)
        Radius in pixels, and gate in m for each of them.
    pooled : (n,) array
        Overwritten.
    """
    rows, columns = image_shape
    radius, gate = limits
    reach = int(radius)
    for number in range(pixel.size):
        y, x = pixel[number] // columns, pixel[number] % columns
        total = own[number]
        for j in range(-reach, reach + 1):
            for i in range(-reach, reach + 1):
                left = radius * radius - j * j - i * i
                inside = 0 <= y + j < rows and 0 <= x + i < columns
                if not inside or left < 0 or (j == 0 and i == 0):
                    continue
                most = gate * math.sqrt(left)
                there = (y + j) * columns + x + i
                for k in range(starts[there], starts[there + 1]):
                    if math.fabs(distance[k] - at[number]) <= most:
                        total += own[k]
        pooled[number] = total
