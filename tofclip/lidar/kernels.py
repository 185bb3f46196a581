"""The compiled search for returns in one pixel's trace after another.

Every function is serial and holds no interpreter lock; `tofclip.lidar.search` shares the pixels between threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.lidar.fit.kernels import EVEN, describe, nearest_first, refine, window

ROUNDS = 8  # Gauss-Newton from within half a bin has converged after three; more for returns that overlap
HOPELESS = 0.5  # of the share of the strongest return that a candidate needs: the fit does not make up for so much
GROUP = 32  # bins of which one bound on their peaks is kept


@njit(nogil=True, cache=True)
def find_returns(traces, pixels, times, sharp, matched, curve, scale, limits, found, counts):
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
    sharp, matched : (width, bins) float32 array
        Filters of unit energy: row w holds the weight of bin ``j + w - width // 2`` for a return at bin j.
    curve, scale
        The pulse: see `Pulse.table`.
    limits : (float, float, float)
        Smallest distance between two returns, s, smallest signal-to-noise, and smallest share of the strongest return,
        with the fall-off with range undone.
    found : (all pixels, most returns, 3) float64 array, overwritten where `pixels` says
        Instant, sum of the fitted pulse over the bins, standard deviation of the instant; nearest first.
    counts : (all pixels,) int64 array, overwritten where `pixels` says
        Number of returns of each pixel.
    """
    score = np.zeros(-(-times.size // GROUP) * GROUP, np.float32)
    bounds = np.empty(score.size // GROUP, np.float32)
    free = np.ones(times.size, np.float32)
    peaks = np.empty(found.shape[1], np.int64)
    estimate = np.empty((found.shape[1], 2))
    strength = np.empty(found.shape[1])
    for place in range(traces.shape[0]):
        trace, pixel = traces[place], pixels[place]
        correlate(trace, sharp, score[: times.size])
        number = strongest_peaks(score, times, limits[0], bounds, peaks)
        background, noise = quiet_level(trace, times, peaks[:number], scale, free)
        peaks[:number].sort()
        kept, needed = 0, 0.0
        for k in range(number):
            strength[k] = response(trace, matched, background, peaks[k])
            needed = max(needed, HOPELESS * limits[2] * strength[k] * times[peaks[k]] ** 2)
        for k in range(number):
            if strength[k] > limits[1] * noise and strength[k] * times[peaks[k]] ** 2 >= needed:
                estimate[kept, 0] = times[peaks[k]]
                estimate[kept, 1] = max(trace[peaks[k]] - background, 0.0)
                kept += 1
        refine(trace, times, background, curve, scale, estimate[:kept], EVEN, ROUNDS)
        least = limits[1] * noise
        counts[pixel] = describe(trace, times, background, noise, curve, scale, estimate[:kept], least, found[pixel])
        nearest_first(found[pixel, : counts[pixel]])


@njit(nogil=True, cache=True)
def response(trace, filters, background, j):
    """Response of a filter at bin j to what exceeds the background; never below zero."""
    total, half = 0.0, filters.shape[0] // 2
    for w in range(filters.shape[0]):
        if 0 <= j + w - half < trace.size:
            total += filters[w, j] * (trace[j + w - half] - background)
    return max(total, 0.0)


@njit(nogil=True, cache=True, fastmath=True)
def correlate(trace, filters, score):
    """Filter a trace: ``score[j] = sum_w filters[w, j] * trace[j + w - width // 2]``."""
    score[:] = 0
    bins, half = trace.size, filters.shape[0] // 2
    for w in range(filters.shape[0]):
        first, last = max(0, half - w), min(bins, bins + half - w)
        weight, there = filters[w, first:last], trace[first + w - half : last + w - half]
        here = score[first:last]
        for j in range(here.size):
            here[j] += weight[j] * there[j]


@njit(nogil=True, cache=True)
def strongest_peaks(score, times, distance, bounds, peaks):
    """Fill `peaks` with the highest local maxima that keep `distance` from each other; return how many there are.

    The first and the last bin are no peaks: whatever rises towards them has its maximum outside. No maximum of a group
    of bins is higher than its highest bin. Only the group with the highest bound is looked into; if its best maximum
    is lower, that is its new bound, and otherwise no other group can have a higher one.
    """
    highest_of_groups(score, bounds)
    number = 0
    while number < peaks.size:
        group = np.argmax(bounds)
        if bounds[group] <= 0:
            break
        best = highest_maximum(score, times, distance, peaks[:number], group)
        height = score[best] if best >= 0 else np.float32(0)
        if height < bounds[group]:
            bounds[group] = height
        else:
            peaks[number] = best
            number += 1
    return number


@njit(nogil=True, cache=True, fastmath=True)
def highest_of_groups(score, bounds):
    """Largest value of each group of bins, or 0."""
    for group in range(bounds.size):
        highest = np.float32(0)
        for j in range(group * GROUP, (group + 1) * GROUP):
            highest = score[j] if score[j] > highest else highest
        bounds[group] = highest


@njit(nogil=True, cache=True)
def highest_maximum(score, times, distance, peaks, group):
    """Highest inner maximum of a group that keeps `distance` from all peaks, or -1; of a level top the last bin."""
    best, height = -1, np.float32(0)
    for j in range(max(group * GROUP, 1), min((group + 1) * GROUP, times.size - 1)):
        highest = score[j] > height and score[j] >= score[j - 1] and score[j] > score[j + 1]
        if highest and is_apart(times[j], times, peaks, distance):
            best, height = j, score[j]
    return best


@njit(nogil=True, cache=True)
def is_apart(time, times, peaks, distance):
    """Whether `time` keeps `distance` from all `peaks`."""
    clash = False
    for peak in peaks:
        clash |= abs(times[peak] - time) < distance
    return not clash


@njit(nogil=True, cache=True)
def quiet_level(trace, times, peaks, scale, free):
    """Mean and standard deviation of the bins that no peak claims.

    Peaks claim their surroundings from the strongest down, for as long as half of the bins stay free. `free` is 1
    everywhere, and again afterwards.
    """
    left = float(trace.size)
    for peak in peaks:
        first, last = window(times, times[peak], scale)
        claimed = 0.0
        for i in range(first, last):
            claimed += free[i]
        if 2 * (left - claimed) < trace.size:
            break
        free[first:last] = 0
        left -= claimed
    total, square = sums_of_free(trace, free)
    for peak in peaks:
        first, last = window(times, times[peak], scale)
        free[first:last] = 1
    mean = total / left
    return mean, np.sqrt(max(square / left - mean * mean, 0.0))


@njit(nogil=True, cache=True, fastmath=True)
def sums_of_free(trace, free):
    """Sum and sum of squares of the free bins; float32 squares would drown a small noise on a high background."""
    total = square = 0.0
    for i in range(trace.size):
        value = float(free[i]) * float(trace[i])
        total += value
        square += value * value
    return total, square
