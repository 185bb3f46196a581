"""The compiled search for returns in one pixel's trace after another.

Every function is serial and holds no interpreter lock; `tofclip.lidar.search` shares the pixels between threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.lidar.fit.kernels import EVEN, compiled, describe, refine, sort_rows, window

ROUNDS = 8  # Gauss-Newton from near the top has converged after two; more for returns that overlap
HOPELESS = 0.7  # of the share of the strongest return that a candidate needs: the fit does not make up for so much
GROUP = 32  # bins of which one bound on their peaks is kept
TOGETHER = 4  # weights of a filter that are applied in one pass

vectorised = njit(nogil=True, cache=True, fastmath=True, error_model="numpy", _nrt=False)


@njit(nogil=True, cache=True)
def find_returns(traces, pixels, times, filters, pulse, limits, found, counts):
    """Find the returns of each trace.

    Candidates are the peaks of the trace under a sharp filter, which still shows two returns where the matched filter
    would merge them; whether one counts, the matched filter decides, and once more the fit.

    Parameters
    ----------
    traces : (n, bins) float32 array
    pixels : (n,) int64 array
        Number of the pixel to which each trace belongs.
    times : (bins,) float64 array
        Instant of each bin, increasing.
    filters : tuple
        A sharp filter and the matched one, (width, bins) float32 arrays of unit energy, nowhere negative: row w holds
        the weight of bin ``j + w - width // 2`` for a return at bin j, and the width is a multiple of four. Then
        the largest sum of the weights for one bin, of either.
    pulse : tuple
        See `Pulse.table`.
    limits : (float, float, float)
        Smallest distance between two returns, s, smallest signal-to-noise, and smallest share of the strongest return,
        with the fall-off with range undone.
    found : (all pixels, most returns, 3) float64 array, overwritten where `pixels` says
        Instant, sum of the fitted pulse over the bins, standard deviation of the instant; nearest first.
    counts : (all pixels,) int64 array, overwritten where `pixels` says
        Number of returns of each pixel.
    """
    groups = -(-times.size // GROUP)
    memory = (
        np.zeros(groups * GROUP, np.float32),
        np.empty(groups, np.float32),
        np.ones(times.size, np.bool_),
        np.empty((found.shape[1], 2)),
        np.empty((found.shape[1], 3)),
        np.empty((times.size, 3)),
    )
    for place in range(traces.shape[0]):
        pixel = pixels[place]
        counts[pixel] = returns_of(traces[place], times, filters, pulse, limits, memory, found[pixel])


@compiled
def returns_of(trace, times, filters, pulse, limits, memory, found):
    """Find the returns of one trace and return their number; `memory` is overwritten."""
    (sharp, matched, gains), (curve, scale) = filters, pulse
    score, bounds, free, peaks, estimate, profile = memory
    correlate(trace, sharp, score)
    number, background, noise = strongest_peaks(trace, times, matched, gains, scale, limits, score, bounds, free, peaks)
    needed, least, kept = 0.0, limits[1] * noise, 0
    for k in range(number):
        j = int(peaks[k, 0])
        peaks[k, 1] = response(trace, matched, background, j)
        needed = max(needed, HOPELESS * limits[2] * peaks[k, 1] * times[j] ** 2)
    for k in range(number):
        j, strength = int(peaks[k, 0]), peaks[k, 1]
        if strength > least and strength * times[j] ** 2 >= needed:
            estimate[kept, 0] = top(trace, times, matched, background, j, strength)
            estimate[kept, 1] = max(trace[j] - background, 0.0)
            kept += 1
    refine(trace, times, background, curve, scale, estimate[:kept], EVEN, ROUNDS)
    number = describe(trace, times, background, noise, curve, scale, estimate[:kept], least, profile, found)
    sort_rows(found[:number])
    return number


@vectorised
def correlate(trace, filters, score):
    """Filter a trace: ``score[j] = sum_w filters[w, j] * trace[j + w - width // 2]``."""
    width, bins = filters.shape
    half = width // 2
    first, last = min(half, bins), max(bins - half + 1, min(half, bins))
    here = score[first:last]
    for w in range(0, width, TOGETHER):
        one, two = filters[w, first:last], filters[w + 1, first:last]
        three, four = filters[w + 2, first:last], filters[w + 3, first:last]
        there = trace[first + w - half : last + w - half + TOGETHER - 1]
        if w == 0:
            for j in range(here.size):
                here[j] = one[j] * there[j] + two[j] * there[j + 1] + three[j] * there[j + 2] + four[j] * there[j + 3]
        else:
            for j in range(here.size):
                here[j] += one[j] * there[j] + two[j] * there[j + 1] + three[j] * there[j + 2] + four[j] * there[j + 3]
    for j in range(first):
        score[j] = response(trace, filters, 0.0, j)
    for j in range(last, bins):
        score[j] = response(trace, filters, 0.0, j)


@compiled
def response(trace, filters, background, j):
    """Response of a filter at bin j to what exceeds the background; never below zero."""
    half = filters.shape[0] // 2
    first, last = max(0, half - j), min(filters.shape[0], trace.size + half - j)
    total = 0.0
    for w in range(first, last):
        total += filters[w, j] * (trace[j + w - half] - background)
    return max(total, 0.0)


@compiled
def top(trace, times, matched, background, j, here):
    """Instant near bin j at which the response, `here` at the bin, is highest: by a parabola in its logarithm."""
    before, after = response(trace, matched, background, j - 1), response(trace, matched, background, j + 1)
    if before <= 0 or after <= 0 or here < before or here < after:
        return times[j]
    rise, fall = np.log(here / before), np.log(here / after)
    share = (rise - fall) / (2 * (rise + fall)) if rise + fall > 0 else 0.0
    return times[j] + share * (times[j + 1] - times[j - 1]) / 2


@compiled
def strongest_peaks(trace, times, matched, gains, scale, limits, score, bounds, free, peaks):
    """Fill the first column of `peaks` with the bins of the highest peaks that might count.

    Returns their number, the background and the noise. Peaks are the local maxima of the score that keep ``limits[0]``
    from each other; the first and the last bin are none, for whatever rises towards them has its maximum outside. Of
    each group of bins the highest score bounds what is to be found there; only the group with the highest bound is
    looked into, and what its best maximum lacks to the bound is taken off. What is left cannot count when not even
    bins all as bright as the bound says would: because of the noise, or beside the strongest return.

    Background and noise are those of the bins that no peak claims. Peaks claim their surroundings from the strongest
    down, for as long as half of the bins stay free. `free` is true everywhere, and again afterwards.
    """
    bound_groups(score, bounds)
    total, square = sums(trace)
    left, number, needed, claiming = trace.size, 0, 0.0, True
    background, noise = level(total, square, left)
    while number < peaks.shape[0]:
        group = highest_place(bounds)
        brightest = gains[1] * (bounds[group] / gains[0] - background)
        if bounds[group] <= 0 or brightest <= limits[1] * noise or brightest * times[-1] ** 2 < needed:
            break
        best = highest_maximum(score, times, limits[0], peaks[:number], group)
        if best < 0 or score[best] < bounds[group]:
            bounds[group] = score[best] if best >= 0 else np.float32(0)
            continue
        peaks[number, 0] = best
        number += 1
        first, last = window(times, times[best], scale)
        claiming = claiming and 2 * (left - (last - first)) >= trace.size
        if claiming:
            for i in range(first, last):
                value = free[i] * float(trace[i])
                total, square, left = total - value, square - value * value, left - free[i]
                free[i] = False
            background, noise = level(total, square, left)
        needed = max(needed, HOPELESS * limits[2] * response(trace, matched, background, best) * times[best] ** 2)
    for k in range(number):
        first, last = window(times, times[int(peaks[k, 0])], scale)
        free[first:last] = True
    sort_rows(peaks[:number])
    return number, background, noise


@vectorised
def bound_groups(score, bounds):
    """Largest score of each group of bins, or 0.

    Numbers above zero keep their order when their bits are read as whole numbers, whose maximum is found in vectors.
    """
    bits, highest_bits = score.view(np.int32), bounds.view(np.int32)
    for group in range(bounds.size):
        highest = np.int32(0)
        for j in range(group * GROUP, (group + 1) * GROUP):
            highest = max(highest, bits[j])
        highest_bits[group] = highest


@vectorised
def sums(trace):
    """Sum and sum of squares; float32 squares would drown a small noise on a high background."""
    total = square = 0.0
    for i in range(trace.size):
        value = float(trace[i])
        total += value
        square += value * value
    return total, square


@compiled
def level(total, square, bins):
    """Mean and standard deviation from sum, sum of squares and number."""
    mean = total / bins
    return mean, np.sqrt(max(square / bins - mean * mean, 0.0))


@compiled
def highest_place(values):
    """Return where the first of the highest values stands."""
    place = 0
    for other in range(1, values.size):
        if values[other] > values[place]:
            place = other
    return place


@compiled
def highest_maximum(score, times, distance, peaks, group):
    """Highest inner maximum of a group that keeps `distance` from all peaks, or -1; of a level top the last bin."""
    best, height = -1, np.float32(0)
    for j in range(max(group * GROUP, 1), min((group + 1) * GROUP, times.size - 1)):
        if score[j] > height and score[j] >= score[j - 1] and score[j] > score[j + 1]:
            clash = False
            for k in range(peaks.shape[0]):
                clash |= abs(times[int(peaks[k, 0])] - times[j]) < distance
            if not clash:
                best, height = j, score[j]
    return best
