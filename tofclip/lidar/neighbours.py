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
from numba import njit
from numpy.typing import NDArray

from tofclip.threads import run_blocks

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
RETURNS_PER_BLOCK = 512

NEIGHBOURS = 96
"""Room for the (2 * 8 / 2 + 1)^2 = 81 neighbours, in whole vectors."""

inlined = njit(inline="always")  # into the one loop that calls it


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
    starts = np.zeros(image_shape[0] * image_shape[1] + 1, np.int64)
    np.cumsum(np.bincount(pixel, minlength=starts.size - 1), out=starts[1:])
    nearness = 1 / (distance * along_axis)
    metres = distance / nearness
    scatter = np.empty(total.size)
    row, column = np.divmod(pixel, image_shape[1])
    first = (row % PLANE_STEP_PX == 0) & (column % PLANE_STEP_PX == 0)
    # neighbours have nearly the same returns around them: one plane in sixteen does
    chosen = np.flatnonzero(first)
    surface = nearness, metres, pixel, starts, image_shape, gate

    def fit(piece: slice) -> None:
        memory = np.zeros((5, NEIGHBOURS), np.float32)
        scatter_about_planes(*surface, chosen[piece], memory, scatter)

    def borrow(piece: slice) -> None:
        borrow_scatter(*surface, others[piece], scatter)

    run_blocks(fit, chosen.size, RETURNS_PER_BLOCK)
    others = np.flatnonzero(~first)
    run_blocks(borrow, others.size, RETURNS_PER_BLOCK)
    chosen = others[np.isnan(scatter[others])]
    run_blocks(fit, chosen.size, RETURNS_PER_BLOCK)
    known = scatter >= 0
    if np.count_nonzero(known) < MIN_KNOWN:
        return total
    excess = np.maximum(scatter[known] ** 2 - total[known] ** 2, 0)
    found = np.sqrt(total[known] ** 2 + PLANE_SHARE * excess)
    usual = float(np.median(found / total[known]))
    total *= usual
    total[known] = found
    return total


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def scatter_about_planes(
    nearness, metres, pixel, starts, image_shape, gate, chosen, memory, scatter
):
    """Robust deviation of the returns around each from a plane through them, -1 if they are few.

    Parameters
    ----------
    nearness : (n,) array
        Inverse depth along the optical axis, 1/m.
    metres : (n,) array
        Change of a return's range for a change of its nearness, m^2.
    pixel : (n,) int64 array
        Not decreasing.
    starts : (pixels + 1,) int64 array
        First return of each pixel.
    image_shape : (int, int)
    gate : float
        m.
    chosen : (k,) int64 array
        Numbers of the returns.
    memory : (5, NEIGHBOURS) float32 array
        Zeros; overwritten: columns and rows away, how much further off, whether it is used, and how
        far from the plane, in m.
    scatter : (n,) array
        Overwritten at the chosen: m.
    """
    for own in chosen:
        number = collect_neighbours(nearness, metres, pixel, starts, image_shape, own, memory)
        deviation, most, a, b, c, count = -1.0, gate, 0.0, 0.0, 0.0, 0
        for rounds in range(FIT_ROUNDS + 1):
            measure_offsets(memory, a, b, c)
            if rounds > 0:
                free = count / (count - 3.0)
                deviation = MAD_TO_SIGMA * find_median(memory, count) * math.sqrt(free)
                most = OUTLIER_DEVIATIONS * deviation
            changed = mark_near(memory, number, most)
            # where nothing changed further rounds would find the same
            if rounds == FIT_ROUNDS or (rounds > 0 and not changed):
                break
            a, b, c, count = fit_plane_around(memory)
            if count < MIN_NEIGHBOURS:
                deviation = -1.0
                break
        scatter[own] = deviation


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
    slope, fall, level = np.float32(a), np.float32(b), np.float32(c)
    for t in range(NEIGHBOURS):
        residual[t] = math.fabs(off[t] - slope * right[t] - fall * down[t] - level)


@inlined
def mark_near(memory, number, most):
    """Use the neighbours that are off by at most so much; return whether others were used before.

    Parameters
    ----------
    memory : (5, NEIGHBOURS) float32 array
        See `scatter_about_planes`; 1 or 0 is written to the row that says which are used.
    number : int
        Of neighbours.
    most : float
        m.

    Returns
    -------
    bool
    """
    used, residual = memory[3], memory[4]
    farthest, listed, changed = np.float32(most), np.int32(number), np.float32(0)
    for t in range(NEIGHBOURS):
        within = (residual[t] <= farthest) & (np.int32(t) < listed)
        near = np.float32(1) if within else np.float32(0)
        changed += math.fabs(near - used[t])
        used[t] = near
    return changed > 0


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
    high = low = middle = np.float32(0)
    for t in range(NEIGHBOURS):
        here = used[t] * residual[t]
        high = here if here > high else high
    precision = np.float32(MEDIAN_PRECISION) * high
    middle = high
    while high - low > precision:
        middle, below = np.float32(0.5) * (low + high), np.float32(0)
        for t in range(NEIGHBOURS):
            below += used[t] if residual[t] <= middle else np.float32(0)
        if 2 * below == count:
            break
        if 2 * below > count:
            high = middle
        else:
            low = middle
            middle = high
    return middle


@inlined
def collect_neighbours(nearness, metres, pixel, starts, image_shape, own, memory):
    """List the returns around one: columns and rows away, and how much further off, in m.

    Of several returns of a pixel the one that is nearest in range counts.

    Parameters
    ----------
    nearness, metres, pixel, starts, image_shape
        As for `scatter_about_planes`.
    own : int
        Number of the return.
    memory : (5, NEIGHBOURS) float32 array
        The first three rows are overwritten.

    Returns
    -------
    int
    """
    rows, columns = image_shape
    y, x = pixel[own] // columns, pixel[own] % columns
    number = 0
    for j in range(-REACH_PX, REACH_PX + 1, STRIDE_PX):
        for i in range(-REACH_PX, REACH_PX + 1, STRIDE_PX):
            if y + j < 0 or x + i < 0 or y + j >= rows or x + i >= columns:
                continue
            there = (y + j) * columns + x + i
            best, first = 0.0, starts[there]
            for k in range(first, starts[there + 1]):
                off = (nearness[own] - nearness[k]) * metres[own]
                if k == first or math.fabs(off) < math.fabs(best):
                    best = off
            if first < starts[there + 1]:
                memory[0, number] = i
                memory[1, number] = j
                memory[2, number] = best
                number += 1
    return number


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
    n = s = sx = sy = sxx = sxy = syy = sxv = syv = np.float32(0)
    for t in range(NEIGHBOURS):
        x, y, v = used[t] * right[t], used[t] * down[t], used[t] * off[t]
        n += used[t]
        s += v
        sx += x
        sy += y
        sxx += x * right[t]
        sxy += x * down[t]
        syy += y * down[t]
        sxv += x * off[t]
        syv += y * off[t]
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


@njit(nogil=True, cache=True, error_model="numpy")
def borrow_scatter(nearness, metres, pixel, starts, image_shape, gate, chosen, scatter):
    """Take over what is known of the return nearest in range, on the same surface, of those within
    a plane's reach whose row and column `PLANE_STEP_PX` divides.

    Parameters
    ----------
    nearness, metres, pixel, starts, image_shape, gate
        As for `scatter_about_planes`.
    chosen : (k,) int64 array
        Numbers of the returns.
    scatter : (n,) array
        Overwritten at the chosen: m, NaN where there is no such return or it has few neighbours.
    """
    rows, columns = image_shape
    for own in chosen:
        y, x = pixel[own] // columns, pixel[own] % columns
        found, least = -1, np.inf
        top, left = y - y % PLANE_STEP_PX - PLANE_STEP_PX, x - x % PLANE_STEP_PX - PLANE_STEP_PX
        for j in range(top, top + 4 * PLANE_STEP_PX, PLANE_STEP_PX):
            for i in range(left, left + 4 * PLANE_STEP_PX, PLANE_STEP_PX):
                if j < 0 or i < 0 or j >= rows or i >= columns:
                    continue
                there = j * columns + i
                for k in range(starts[there], starts[there + 1]):
                    off = math.fabs((nearness[own] - nearness[k]) * metres[own])
                    if off < least:
                        found, least = k, off
        scatter[own] = scatter[found] if found >= 0 and least < gate else np.nan
        if scatter[own] < 0:
            scatter[own] = np.nan


@njit(nogil=True, cache=True, error_model="numpy")
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
