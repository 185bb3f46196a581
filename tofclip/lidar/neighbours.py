"""How far ranges are off, by what their neighbours on the same surface show.

A recovered frame's errors have two parts. Noise of the measurements is known from each pixel's own
trace, since it differs from bin to bin. What the recovery gets wrong (a prior that smooths, a
resolution that mixes neighbours, directions that no view sees) is alike in all bins of a pulse: it
moves the return without a trace in the fit's residual. On simulated shots it makes errors 1.7 to
2.5 times as large as the fit says, and a second recovery of what was recovered first (a parametric
bootstrap) does not show it either, because the first result already agrees with the prior.

But it changes from pixel to pixel along a surface. A plane in space is linear in inverse depth over
the picture, whatever its tilt, and what is round has curvature besides. So a quadratic is fitted
through the returns within `REACH_PX` of each, and what these scatter about it beyond their own noise is
the recovery's part. The quadratic takes up some of what is alike over its whole reach: `SHARE` makes
up for that. It was found on scenes of known surfaces by a forward model of its own at 50 to 2000
photons (`tests/lidar/physics_scenes.py`), with total variation: z-scores of walls, slanted plates, balls
and thick cylinders are 0.6 to 1.9 there. Thin rods have 1.2 to 2.4 and a level wire 4: stated too small.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.arrays import Float32Array, FloatArray, IntArray
from tofclip.compiling import compile_as_part, compile_loop, inlined
from tofclip.threads import run_blocks
from tofclip.units import MAD_TO_SIGMA
from tofclip.vectors import (
    STEP,
    choose,
    count_set_lanes,
    fill_vector,
    find_highest_lane,
    load_vector,
)

fit_part = compile_as_part(fastmath=True, _nrt=False)

# neighbours that share a surface, and their distance: errors of adjacent pixels are much alike
REACH_PX, STRIDE_PX = 8, 2
# distance of the pixels whose returns have fits of their own; those between take over what is known of
# one within a fit's reach on the same surface
FIT_STEP_PX = 4
# variance of the recovery's errors, relative to what a quadratic of this reach leaves of it
SHARE = 3.5
FIT_ROUNDS, MIN_NEIGHBOURS, OUTLIER_DEVIATIONS = 4, 12, 3.0
MIN_KNOWN = 20  # returns with enough neighbours that say how far the others are off
MEDIAN_PRECISION = 1e-4
INTERPOLATED_LOOKS = 5  # for a median, before intervals are halved: most often that is enough
RETURNS_PER_BLOCK = 2048  # some ms of fits: less is done before other threads have begun

MARGIN = REACH_PX // STRIDE_PX
SIDE = 2 * MARGIN + 1  # places for neighbours in a row of a window, and rows of a window
NEIGHBOURS = 96  # room for the SIDE^2 = 81 neighbours, in whole vectors
FAR = 1e20  # nearness of a neighbour that is not there, 1/m

TERMS = 6  # of a quadratic in column and row
LEAST_PIVOT = 1e-4  # of a term's sum of squares, below which the neighbours do not show it

# The first rows of a window, (30, NEIGHBOURS): by how much further off each neighbour is, m, whether it is
# used, 1 or 0, and how far from the surface, m. Then the terms at each, and from `PAIRS` on the products
# of any two of them: those of a term with itself and those after it, one term after another.
OFF, USED, RESIDUAL, FIRST_TERM, PAIRS = 0, 1, 2, 3, 3 + TERMS


def add_recovery_error(
    sigma: FloatArray,
    distance: FloatArray,
    along_axis: FloatArray,
    pixel: IntArray,
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

    def fit_surfaces(chosen: IntArray) -> None:
        def fit(piece: slice) -> None:
            returns = nearness, metres, pixel
            window = allocate_window()
            scatter_about_surfaces(*returns, columns, layers, gate, chosen[piece], window, scatter)

        run_blocks(fit, chosen.size, RETURNS_PER_BLOCK)

    # neighbours have nearly the same returns around them: one fit in sixteen does
    own = np.zeros(image_shape, bool)
    own[::FIT_STEP_PX, ::FIT_STEP_PX] = True
    fit_surfaces(np.flatnonzero(own.ravel().take(pixel)))
    memory = np.empty((2, 16 * int(each.max())))
    borrow_scatter(nearness, metres, starts, image_shape, gate, memory, scatter)
    fit_surfaces(np.flatnonzero(np.isnan(scatter)))
    known = scatter >= 0
    if np.count_nonzero(known) < MIN_KNOWN:
        return np.array(sigma)
    total: FloatArray = np.sqrt(sigma**2 + SHARE * np.maximum(scatter**2 - sigma**2, 0.0))
    alone = np.flatnonzero(~known)
    if alone.size:
        total[alone] = sigma[alone] * np.median(total[known] / sigma[known])
    return total


def layer_returns(
    nearness: FloatArray,
    pixel: IntArray,
    starts: IntArray,
    image_shape: tuple[int, int],
) -> Float32Array:
    """Lay out the returns so that those at the neighbours' distance lie side by side: (most returns of a
    pixel, 4, rows, columns) of `nearness` of each pixel's first, second, ... returns, `FAR` where there is
    none; of pixels of even rows and columns, even rows and odd columns, and so on, within a margin.
    """
    rows, columns = (-(-size // STRIDE_PX) + 2 * MARGIN for size in image_shape)
    shape = (int(np.diff(starts).max()), STRIDE_PX**2, rows, columns)
    y, x = np.arange(image_shape[0])[:, np.newaxis], np.arange(image_shape[1])
    part = y % STRIDE_PX * STRIDE_PX + x % STRIDE_PX
    place = (part * rows + y // STRIDE_PX + MARGIN) * shape[3] + x // STRIDE_PX + MARGIN
    layers = np.full((shape[0], math.prod(shape[1:])), FAR, np.float32)
    rank = np.arange(pixel.size) - starts.take(pixel)
    layers[rank, place.ravel().take(pixel)] = nearness
    return layers.reshape(shape)


def allocate_window() -> tuple[Float32Array, FloatArray]:
    """Return the memory of `scatter_about_surfaces`: a window, of whose rows the first three change, and
    room for the equations, (`TERMS`, `TERMS` + 1).
    """
    away = np.arange(-MARGIN, MARGIN + 1) / MARGIN
    x, y = np.tile(away, SIDE), np.repeat(away, SIDE)
    terms = np.stack([np.ones(SIDE**2), x, y, x * x, x * y, y * y])
    window = np.zeros((PAIRS + TERMS * (TERMS + 1) // 2, NEIGHBOURS), np.float32)
    window[FIRST_TERM:PAIRS, : SIDE**2] = terms
    i, j = np.triu_indices(TERMS)
    window[PAIRS:, : SIDE**2] = terms[i] * terms[j]
    window[OFF] = FAR
    return window, np.empty((TERMS, TERMS + 1))


@compile_loop(fastmath=True)
def scatter_about_surfaces(nearness, metres, pixel, columns, layers, gate, chosen, memory, scatter):
    """Robust deviation of the returns around each from a quadratic through them, m; -1 if they are few.
    `nearness` (n,): inverse depth along the optical axis, 1/m; `metres` (n,): change of a return's
    range for a change of its nearness, m^2; `pixel` (n,); `layers`: see `layer_returns`; `gate`: m;
    `chosen` (k,): returns for which `scatter` (n,) is overwritten; `memory`: of `allocate_window`.
    """
    window, system = memory
    for own in chosen:
        y, x = pixel[own] // columns, pixel[own] % columns
        here = np.float32(nearness[own]), np.float32(metres[own])
        take_nearest(layers, (y, x), here[0], here[1], window[OFF])
        deviation, most, count, shown = -1.0, gate, 0, 0
        median = np.float32(0)
        system[:, TERMS] = 0
        for rounds in range(FIT_ROUNDS + 1):
            measure_offsets(window, system)
            if rounds > 0:
                free = count / (count - float(shown))
                median = find_median(window, count, median)
                deviation = MAD_TO_SIGMA * median * math.sqrt(free)
                most = OUTLIER_DEVIATIONS * deviation
            changed = mark_near(window, most)
            # where nothing changed further rounds would find the same
            if rounds == FIT_ROUNDS or (rounds > 0 and not changed):
                break
            count, shown = fit_quadratic(window, system)
            if count < MIN_NEIGHBOURS or shown < TERMS:
                deviation = -1.0
                break
        scatter[own] = deviation


@inlined
def take_nearest(layers, own, nearness, metres, off):
    """Of each pixel around (row, column) `own`, take the return that is nearest in range to one of this
    `nearness`, and enter by how much further it is, m; beyond any gate where there is none.
    """
    top, left = own[0] // STRIDE_PX, own[1] // STRIDE_PX
    part = own[0] % STRIDE_PX * STRIDE_PX + own[1] % STRIDE_PX
    for j in range(SIDE):
        row = off[SIDE * j : SIDE * (j + 1)]
        row[:] = FAR
        for layer in range(layers.shape[0]):
            there = layers[layer, part, top + j, left : left + SIDE]
            for i in range(SIDE):
                away = (nearness - there[i]) * metres
                row[i] = away if abs(away) < abs(row[i]) else row[i]


@inlined
def measure_offsets(window, system):
    """Enter the distance, m, of each neighbour from the surface, whose terms stand in the last column."""
    off, residual = window[OFF], window[RESIDUAL]
    for t in range(NEIGHBOURS):
        residual[t] = off[t]
    for k in range(TERMS):
        share, term = np.float32(system[k, TERMS]), window[FIRST_TERM + k]
        for t in range(NEIGHBOURS):
            residual[t] -= share * term[t]
    for t in range(NEIGHBOURS):
        residual[t] = abs(residual[t])


@inlined
def mark_near(memory, most):
    """Use the neighbours that are off by at most so much, m; return whether others were used before."""
    used, residual, changed = memory[USED], memory[RESIDUAL], np.float32(0)
    for t in range(NEIGHBOURS):
        near = np.float32(residual[t] <= np.float32(most))
        changed += abs(near - used[t])
        used[t] = near
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


@fit_part
def find_residuals_beside(memory, limit):
    """The largest used residual up to `limit`, or 0, and the smallest above it, or `FAR`."""
    used, residual = memory[USED], memory[RESIDUAL]
    most, zero = fill_vector(limit), fill_vector(np.float32(0))
    last, first = zero, fill_vector(np.float32(FAR))
    for t in range(np.uintp(0), np.uintp(NEIGHBOURS), STEP):
        here, counted = load_vector(residual, t), load_vector(used, t) > zero
        last = choose(counted & (most >= here) & (here > last), here, last)
        first = choose(counted & (here > most) & (first > here), here, first)
    return find_highest_lane(last), -find_highest_lane(zero - first)


@fit_part
def fit_quadratic(window, system):
    """Least-squares quadratic through the neighbours that are used; return their number, and that of the
    terms that they show: those in one line say nothing of what is across it.
    """
    pair, shown = PAIRS, 0
    for i in range(TERMS):
        for j in range(i, TERMS):
            system[i, j] = sum_used(window, pair, USED)
            pair += 1
        system[i, TERMS] = sum_used(window, FIRST_TERM + i, OFF)
    count = int(system[0, 0] + 0.5)
    # Gauss's elimination; a term that the ones before it leave nothing of is left out
    for i in range(TERMS):
        own = sum_used(window, PAIRS + i * TERMS - i * (i - 1) // 2, USED)
        if system[i, i] <= LEAST_PIVOT * own or own == 0:
            system[i, i:] = 0
            continue
        shown += 1
        for j in range(i + 1, TERMS):
            factor = system[i, j] / system[i, i]
            for k in range(j, TERMS + 1):
                system[j, k] -= factor * system[i, k]
    for i in range(TERMS - 1, -1, -1):
        for j in range(i + 1, TERMS):
            system[i, TERMS] -= system[i, j] * system[j, TERMS]
        system[i, TERMS] = system[i, TERMS] / system[i, i] if system[i, i] > 0 else 0.0
    return count, shown


@fit_part
def sum_used(window, row, factor):
    """Sum over the neighbours that are used of the products of two rows; of one with `USED`, 1 there."""
    used, one, other, total = window[USED], window[row], window[factor], np.float32(0)
    for t in range(NEIGHBOURS):
        total += used[t] * one[t] * other[t]
    return float(total)


@compile_loop()
def borrow_scatter(nearness, metres, starts, image_shape, gate, memory, scatter):
    """Take over what is known of the return nearest in range, on the same surface, of those within a
    fit's reach whose row and column `FIT_STEP_PX` divides; NaN where there is none or it has few
    neighbours. All returns of a cell of ``FIT_STEP_PX**2`` pixels have the same ones around them.

    `starts` (pixels + 1,): first return of each pixel; `memory` (2, 16 * most returns of a pixel).
    """
    rows, columns = image_shape
    step, near, known = FIT_STEP_PX, memory[0], memory[1]
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
