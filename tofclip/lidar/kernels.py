"""The compiled search for returns in one pixel's trace after another.

Every function is serial and holds no interpreter lock; `tofclip.lidar.returns` shares the pixels between threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ROUNDS = 8  # Gauss-Newton from within half a bin has converged after three; more for returns that overlap
EVEN = (1.0, 0.0)  # variance of a bin, as constant and factor of its expected brightness: the same everywhere
HOPELESS = 0.5  # of the share of the strongest return that a candidate needs: the fit does not make up for so much
CONVERGED_BINS = 1e-4


@njit(nogil=True, cache=True)
def find_returns(traces, times, sharp, matched, pulse, limits, found, counts):
    """Find the returns of each trace.

    Candidates are the peaks of the trace under a sharp filter, which still shows two returns where the matched filter
    would merge them; whether one counts, the matched filter decides, and once more the fit.

    Parameters
    ----------
    traces : (pixels, bins) float32 array
    times : (bins,) float64 array
        Instant of each bin, increasing.
    sharp, matched : (width, bins) float32 array
        Filters of unit energy: row w holds the weight of bin ``j + w - width // 2`` for a return at bin j.
    pulse : tuple
        Samples, slopes, spacing, origin, first and last instant that matter: see `Pulse`.
    limits : (float, float, float)
        Smallest distance between two returns, s, smallest signal-to-noise, and smallest share of the strongest return,
        with the fall-off with range undone.
    found : (pixels, most returns, 3) float64 array, overwritten
        Instant, sum of the fitted pulse over the bins, standard deviation of the instant.
    counts : (pixels,) int64 array, overwritten
        Number of returns of each pixel.
    """
    score = np.empty(times.size, np.float32)
    peaks = np.empty(found.shape[1], np.int64)
    estimate = np.empty((found.shape[1], 2))
    strength = np.empty(found.shape[1])
    for pixel in range(traces.shape[0]):
        trace = traces[pixel]
        correlate(trace, sharp, score)
        number = strongest_peaks(score, times, limits[0], peaks)
        background, noise = quiet_level(trace, times, peaks[:number], pulse)
        kept, needed = 0, 0.0
        for k in range(number):
            strength[k] = response(trace, matched, background, peaks[k])
            needed = max(needed, HOPELESS * limits[2] * strength[k] * times[peaks[k]] ** 2)
        for k in range(number):
            if strength[k] > limits[1] * noise and strength[k] * times[peaks[k]] ** 2 >= needed:
                estimate[kept, 0] = times[peaks[k]]
                estimate[kept, 1] = max(trace[peaks[k]] - background, 0.0)
                kept += 1
        refine(trace, times, background, pulse, estimate[:kept], EVEN, ROUNDS)
        least = limits[1] * noise
        counts[pixel] = describe(trace, times, background, noise, pulse, estimate[:kept], least, found[pixel])


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
def strongest_peaks(score, times, distance, peaks):
    """Fill `peaks` with the highest local maxima that keep `distance` from each other; return how many there are.

    The first and the last bin are no peaks: whatever rises towards them has its maximum outside.
    """
    maxima = local_maxima(score)
    number = 0
    while number < peaks.size:
        best, height = -1, np.float32(0)
        for j in maxima:
            if score[j] > height and is_apart(times[j], times, peaks[:number], distance):
                best, height = j, score[j]
        if best < 0:
            break
        peaks[number] = best
        number += 1
    return number


@njit(nogil=True, cache=True)
def local_maxima(score):
    """Positions of the positive inner maxima; the last bin of a level top counts."""
    maxima = np.empty(score.size, np.int64)
    number = 0
    for j in range(1, score.size - 1):
        maxima[number] = j
        number += (score[j] > 0) & (score[j] >= score[j - 1]) & (score[j] > score[j + 1])
    return maxima[:number]


@njit(nogil=True, cache=True)
def is_apart(time, times, peaks, distance):
    """Whether `time` keeps `distance` from all `peaks`."""
    clash = False
    for peak in peaks:
        clash |= abs(times[peak] - time) < distance
    return not clash


@njit(nogil=True, cache=True)
def quiet_level(trace, times, peaks, pulse):
    """Mean and standard deviation of the bins that no peak claims.

    Peaks claim their surroundings from the strongest down, for as long as half of the bins stay free.
    """
    free = np.ones(trace.size, np.bool_)
    left = trace.size
    for peak in peaks:
        first, last = window(times, times[peak], pulse)
        claimed = 0
        for i in range(first, last):
            claimed += free[i]
        if 2 * (left - claimed) < trace.size:
            break
        free[first:last] = False
        left -= claimed
    total = square = 0.0
    for i in range(trace.size):
        if free[i]:
            value = float(trace[i])  # float32 squares would drown a small noise on a high background
            total += value
            square += value * value
    mean = total / left
    return mean, np.sqrt(max(square / left - mean * mean, 0.0))


@njit(nogil=True, cache=True)
def window(times, arrival, pulse):
    """First bin and the bin after the last one that a return at `arrival` reaches."""
    return np.searchsorted(times, arrival + pulse[4]), np.searchsorted(times, arrival + pulse[5])


@njit(nogil=True, cache=True)
def pulse_at(time, pulse):
    """Pulse and its slope at `time` after the arrival, by linear interpolation; zero outside the samples."""
    samples, slopes, spacing, origin = pulse[0], pulse[1], pulse[2], pulse[3]
    position = time / spacing + origin
    left = int(np.floor(position))
    if left < 0 or left + 1 >= samples.size:
        return 0.0, 0.0
    share = position - left
    return (
        (1 - share) * samples[left] + share * samples[left + 1],
        (1 - share) * slopes[left] + share * slopes[left + 1],
    )


@njit(nogil=True, cache=True)
def unexplained(trace, times, background, pulse, estimate, i, without):
    """Bin i less the background and all returns except number `without` (-1: less all of them)."""
    rest = trace[i] - background
    for k in range(estimate.shape[0]):
        if k != without:
            rest -= estimate[k, 1] * pulse_at(times[i] - estimate[k, 0], pulse)[0]
    return rest


@njit(nogil=True, cache=True)
def refine(trace, times, background, pulse, estimate, variance, rounds):
    """Least-squares arrival and height of every return, by Gauss-Newton steps on one return at a time.

    Taking turns, each against what the others leave, undoes the pull of returns that overlap. A bin weighs as much as
    its variance, ``variance[0] + variance[1] * expected``, is small. With `EVEN` that is the plain fit; with ``(0, 1)``
    and photon counts it is Fisher scoring, which ends at the Poisson likelihood's maximum.
    """
    for _ in range(rounds):
        largest = 0.0
        for k in range(estimate.shape[0]):
            largest = max(largest, gauss_newton_step(trace, times, background, pulse, estimate, k, variance))
        if largest < CONVERGED_BINS:
            break


@njit(nogil=True, cache=True)
def gauss_newton_step(trace, times, background, pulse, estimate, k, variance):
    """Improve return k in place; return by how many bins it moved (at most one)."""
    arrival, height = estimate[k, 0], estimate[k, 1]
    first, last = window(times, arrival, pulse)
    pp = pd = dd = pr = dr = 0.0
    for i in range(first, last):
        p, d = pulse_at(times[i] - arrival, pulse)
        rest = unexplained(trace, times, background, pulse, estimate, i, k)
        weight = 1 / (variance[0] + variance[1] * (trace[i] - rest + height * p))
        pp += weight * p * p
        pd += weight * p * d
        dd += weight * d * d
        pr += weight * p * rest
        dr += weight * d * rest
    determinant = pp * dd - pd * pd
    if determinant <= 0:
        return 0.0
    height = (dd * pr - pd * dr) / determinant
    if height <= 0:
        estimate[k, 1] = 0.0
        return 0.0
    bin_width = (times[-1] - times[0]) / (times.size - 1)
    step = -(pp * dr - pd * pr) / (determinant * height)  # model: height * p(t - arrival), whose slope is -height * d
    step = min(max(step, -bin_width), bin_width)
    estimate[k, 0], estimate[k, 1] = arrival + step, height
    return abs(step) / bin_width


@njit(nogil=True, cache=True)
def describe(trace, times, background, noise, pulse, estimate, least, found):
    """Write instant, sum and standard deviation of every return that proves itself; return their number.

    It has to lie on the time axis and to respond, height times root of the pulse's energy, by more than `least`.
    """
    number = 0
    for k in range(estimate.shape[0]):
        arrival, height = estimate[k, 0], estimate[k, 1]
        if height <= 0 or arrival < times[0] or arrival > times[-1]:
            continue
        first, last = window(times, arrival, pulse)
        pp = pd = dd = 0.0
        for i in range(first, last):
            p, d = pulse_at(times[i] - arrival, pulse)
            pp += p * p
            pd += p * d
            dd += d * d
        if height * np.sqrt(pp) <= least or pp * dd <= pd * pd:
            continue
        total, deviation = sum_and_deviation(trace, times, background, noise, pulse, estimate, k, (pp, pd, dd))
        found[number, 0], found[number, 1], found[number, 2] = arrival, total, deviation
        number += 1
    return number


@njit(nogil=True, cache=True)
def sum_and_deviation(trace, times, background, noise, pulse, estimate, k, products):
    """Sum of return k over its bins, and the standard deviation of its arrival.

    The variance of a bin is taken as ``noise^2 + dispersion * brightness`` (quasi-Poisson). The dispersion is what
    makes the expected sum of squared residuals, ``sum_i variance_i (1 - h_i)`` with the fit's leverages h, equal to
    the one found; the variances are then carried through the least-squares fit. `products` holds the sums of squared
    pulse, pulse times slope, and squared slope.
    """
    arrival, height = estimate[k, 0], estimate[k, 1]
    pp, pd, dd = products
    across_energy = dd - pd * pd / pp
    total = misfit = unfitted = weighted = 0.0
    first, last = window(times, arrival, pulse)
    for i in range(first, last):
        p, d = pulse_at(times[i] - arrival, pulse)
        across = d - p * pd / pp  # the part of the slope that a change of height cannot mimic
        total += height * p
        misfit += unexplained(trace, times, background, pulse, estimate, i, -1) ** 2 - noise * noise
        unfitted += height * p * (1 - p * p / pp - across * across / across_energy)
        weighted += across * across * height * p
    misfit += 2 * noise * noise  # two of the bins' worth of noise went into the fit
    variance = noise * noise * across_energy + max(misfit, 0.0) / max(unfitted, 1e-3 * total) * weighted
    return total, np.sqrt(variance) / (across_energy * height)
