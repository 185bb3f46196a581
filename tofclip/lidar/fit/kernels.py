"""The compiled fit of pulses to a trace.

A pulse is handed over in two parts, because arrays inside a tuple cost a lock each time they are taken out: `curve`,
(samples, 2) brightness and slope, and `scale`, samples per second, origin, first and last instant that matter; see
`tofclip.lidar.Pulse.table`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

EVEN = (1.0, 0.0)  # variance of a bin, as constant and factor of its expected brightness: the same everywhere
CONVERGED_BINS = 1e-4


@njit(nogil=True, cache=True)
def window(times, arrival, scale):
    """First bin and the bin after the last one that a return at `arrival` reaches."""
    return first_from(times, arrival + scale[2]), first_from(times, arrival + scale[3])


@njit(nogil=True, cache=True)
def first_from(times, instant):
    """First bin at `instant` or later: where it were if bins were even, and from there step by step."""
    share = (instant - times[0]) / (times[-1] - times[0])
    bin_number = int(min(max(share, 0.0), 1.0) * (times.size - 1))
    while bin_number > 0 and times[bin_number - 1] >= instant:
        bin_number -= 1
    while bin_number < times.size and times[bin_number] < instant:
        bin_number += 1
    return bin_number


@njit(nogil=True, cache=True)
def pulse_at(time, curve, scale):
    """Pulse and its slope at `time` after the arrival, by linear interpolation; zero outside the samples."""
    position = time * scale[0] + scale[1]
    if position < 0 or position >= curve.shape[0] - 1:
        return 0.0, 0.0
    left = int(position)
    share = position - left
    return (
        (1 - share) * curve[left, 0] + share * curve[left + 1, 0],
        (1 - share) * curve[left, 1] + share * curve[left + 1, 1],
    )


@njit(nogil=True, cache=True)
def unexplained(trace, times, background, curve, scale, estimate, i, without):
    """Bin i less the background and all returns except number `without` (-1: less all of them)."""
    rest = trace[i] - background
    for k in range(estimate.shape[0]):
        if k != without:
            rest -= estimate[k, 1] * pulse_at(times[i] - estimate[k, 0], curve, scale)[0]
    return rest


@njit(nogil=True, cache=True)
def refine(trace, times, background, curve, scale, estimate, variance, rounds):
    """Least-squares arrival and height of every return, by Gauss-Newton steps on one return at a time.

    Taking turns, each against what the others leave, undoes the pull of returns that overlap. A bin weighs as much as
    its variance, ``variance[0] + variance[1] * expected``, is small. With `EVEN` that is the plain fit; with ``(0, 1)``
    and photon counts it is Fisher scoring, which ends at the Poisson likelihood's maximum. A return whose neighbours
    and which itself moved no more is left alone.
    """
    moved = np.full(estimate.shape[0], np.inf)
    for _ in range(rounds):
        largest = 0.0
        for k in range(estimate.shape[0]):
            if is_unsettled(estimate, k, moved, scale):
                moved[k] = gauss_newton_step(trace, times, background, curve, scale, estimate, k, variance)
                largest = max(largest, moved[k])
        if largest < CONVERGED_BINS:
            break


@njit(nogil=True, cache=True)
def is_unsettled(estimate, k, moved, scale):
    """Whether return k, or one that overlaps it, moved when last looked at."""
    reach = 2 * (scale[3] - scale[2])
    unsettled = False
    for other in range(estimate.shape[0]):
        unsettled |= moved[other] >= CONVERGED_BINS and abs(estimate[other, 0] - estimate[k, 0]) < reach
    return unsettled


@njit(nogil=True, cache=True)
def gauss_newton_step(trace, times, background, curve, scale, estimate, k, variance):
    """Improve return k in place; return by how many bins it moved (at most one)."""
    arrival, height = estimate[k, 0], estimate[k, 1]
    first, last = window(times, arrival, scale)
    pp = pd = dd = pr = dr = 0.0
    for i in range(first, last):
        p, d = pulse_at(times[i] - arrival, curve, scale)
        rest = unexplained(trace, times, background, curve, scale, estimate, i, k)
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
def describe(trace, times, background, noise, curve, scale, estimate, least, found):
    """Write instant, sum and standard deviation of every return that proves itself; return their number.

    It has to lie on the time axis and to respond, height times root of the pulse's energy, by more than `least`.
    """
    number = 0
    for k in range(estimate.shape[0]):
        arrival, height = estimate[k, 0], estimate[k, 1]
        if height <= 0 or arrival < times[0] or arrival > times[-1]:
            continue
        first, last = window(times, arrival, scale)
        pp = pd = dd = 0.0
        for i in range(first, last):
            p, d = pulse_at(times[i] - arrival, curve, scale)
            pp += p * p
            pd += p * d
            dd += d * d
        if height * np.sqrt(pp) <= least or pp * dd <= pd * pd:
            continue
        total, deviation = sum_and_deviation(trace, times, background, noise, curve, scale, estimate, k, (pp, pd, dd))
        found[number, 0], found[number, 1], found[number, 2] = arrival, total, deviation
        number += 1
    return number


@njit(nogil=True, cache=True)
def nearest_first(found):
    """Sort a few returns by their instant, in place; they nearly are."""
    for last in range(1, found.shape[0]):
        place = last
        while place > 0 and found[place - 1, 0] > found[place, 0]:
            for column in range(found.shape[1]):
                value = found[place, column]
                found[place, column] = found[place - 1, column]
                found[place - 1, column] = value
            place -= 1


@njit(nogil=True, cache=True)
def sum_and_deviation(trace, times, background, noise, curve, scale, estimate, k, products):
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
    first, last = window(times, arrival, scale)
    for i in range(first, last):
        p, d = pulse_at(times[i] - arrival, curve, scale)
        across = d - p * pd / pp  # the part of the slope that a change of height cannot mimic
        total += height * p
        misfit += unexplained(trace, times, background, curve, scale, estimate, i, -1) ** 2 - noise * noise
        unfitted += height * p * (1 - p * p / pp - across * across / across_energy)
        weighted += across * across * height * p
    misfit += 2 * noise * noise  # two of the bins' worth of noise went into the fit
    variance = noise * noise * across_energy + max(misfit, 0.0) / max(unfitted, 1e-3 * total) * weighted
    return total, np.sqrt(variance) / (across_energy * height)
