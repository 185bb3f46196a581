"""The compiled fit of pulses to a trace.

On an even time axis a Gauss-Newton step is two products of the trace with rows of a table of the
pulse (`tofclip.lidar.pulse`). A step from the nearest tabulated phase ends where one from the
exact phase would, but for the square of their distance, at most (1 / 128)^2 of a bin: far below where
the steps end (`CONVERGENCE_STEP_BINS`). Returns that overlap take turns, each against what the others
leave, which undoes their pull on each other.

On an uneven axis, at the ends of an even one and wherever not all bins of the table are there, the
fit is exact (`fit_returns_exactly`), trace by trace; histograms of photons are fitted by the same
steps. There a pulse is handed over in two parts, because arrays inside a tuple cost a lock each time
they are taken out: `curve`, (samples, 2) brightness and slope, and `scale`, samples per second,
origin, first and last instant that matter (`tofclip.lidar.Pulse.kernel_table`). Estimates are
(returns, 5): arrival, height, first bin and the bin after the last one that a return reaches, or what
is near them, and by how many bins it moved last.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, compile_as_part, inlined
from tofclip.lidar.peak_kernels import (
    FIRST_OFFSET,
    HEIGHT,
    MOVED,
    NEEDS_EXACT_FIT,
    NOISE,
    OFFSET,
    PEAK_BIN,
    TRACE,
    cut_out,
    find_candidates,
    is_near,
    search_part,
    search_step,
)
from tofclip.lidar.pulse import MAX_OFFSET_BINS, PHASES_PER_BIN
from tofclip.vectors import STEP, fill_vector, load_vector, store_vector, sum_vector

# from near the top a fit has converged after two; more are for returns that overlap
MAX_FIT_ROUNDS = 8
CONVERGENCE_STEP_BINS = 5e-3  # a return that moved by less is done: its next step is smaller by far

# Without counts of the arrays' owners, which cost a lock for every array that is handed on; nothing
# here allocates.
loop_part = compile_as_part(_nrt=False)


@inlined
def find_phase(offset):
    """Row of the table nearest to an offset in bins."""
    return np.uintp((offset + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)


@search_step
def search_traces(traces, pixels, axis, limits, table, pulse, room, found, counts):
    """Find the returns of some traces, (n, bins): all steps, one after the other. `pixels` (n,): to
    which they belong; `found` (all pixels, most returns, 3) gets instants, s, sums over the bins
    and standard deviations, s, nearest first, and `counts` (all pixels,) how many.
    """
    listed, number = find_candidates(traces, pixels, axis, limits, table.half, room, counts)
    fit_returns(traces, table, axis.even, room, number)
    least = limits.signal_to_noise
    measure_returns_by_table(room, listed, least, pixels, axis.times, table, found, counts)
    exact = False
    for pixel in pixels:
        exact = exact or counts[pixel] == NEEDS_EXACT_FIT
    if exact:
        fit_returns_exactly(traces, pixels, axis, least, listed, pulse, room, found, counts)


@search_step
def fit_returns(traces, table, even, room, number):
    """Fit the first `number` returns of `room.fitted`, those that overlap together, by steps on one at
    a time. In the end `rests` is what the others leave. A return that moved no more and that no moving
    one reaches is left alone. Heights become 0 or less where there is no pulse, and NaN where a return
    moved to where the exact fit is needed; `PEAK_BIN` follows one that moves further than
    `MAX_OFFSET_BINS`.
    """
    candidates, fitted, half = room.candidates, room.fitted, table.half
    start = 0
    while start < number:
        end = start + 1
        while end < number and is_near(candidates, fitted[end - 1], fitted[end], half):
            end += 1
        group = fitted[start:end]
        for _ in range(MAX_FIT_ROUNDS):
            largest = 0.0
            for k in group:
                own, rest = candidates[k], room.rests[k]
                moved = 0.0
                for other in group:
                    if math.fabs(candidates[other, PEAK_BIN] - own[PEAK_BIN]) <= 2 * half:
                        moved = max(moved, candidates[other, MOVED])
                if moved < CONVERGENCE_STEP_BINS or math.isnan(own[HEIGHT]):
                    continue
                phase = find_phase(own[OFFSET])
                along_pulse = along_slope = fill_vector(np.float32(0))
                for w in range(np.uintp(0), np.uintp(rest.size), STEP):
                    left = subtract_others(load_vector(rest, w), w, candidates, group, k, table)
                    along_pulse += left * load_vector(table.shapes[phase], w)
                    along_slope += left * load_vector(table.slopes[phase], w)
                pr, dr = sum_vector(along_pulse), sum_vector(along_slope)
                take_table_step(own, phase, pr, dr, table.sums)
                follow_return(own, rest, traces, room.moments, even, half)
                largest = own[MOVED] if own[MOVED] > largest else largest
            if largest < CONVERGENCE_STEP_BINS:
                break
        for k in group:
            rest = room.rests[k]
            for w in range(np.uintp(0), np.uintp(rest.size), STEP):
                left = subtract_others(load_vector(rest, w), w, candidates, group, k, table)
                store_vector(rest, w, left)
        start = end


@inlined
def take_table_step(own, phase, pr, dr, sums):
    """Improve a candidate's offset and height by a Gauss-Newton step of at most a bin; `pr` and `dr`
    are products of what is left for it with pulse and slope.
    """
    pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
    across = dd * pr - pd * dr
    height, moved = 0.0, 0.0
    if across > 0:
        height = across / (pp * dd - pd * pd)
        # model: height * p(t - arrival), whose slope is -height * d
        step = phase / PHASES_PER_BIN - MAX_OFFSET_BINS - own[OFFSET]
        step -= (pp * dr - pd * pr) / across
        step = 1.0 if step > 1.0 else (-1.0 if step < -1.0 else step)
        own[OFFSET] += step
        moved = math.fabs(step)
    own[HEIGHT] = height
    own[MOVED] = moved


@inlined
def follow_return(own, rest, traces, moments, even, half):
    """Cut out the bins around a candidate again where it has moved away from the bin of its peak; its
    height becomes NaN where they are not all there.
    """
    if math.fabs(own[OFFSET]) <= MAX_OFFSET_BINS:
        return
    shift, place = round(own[OFFSET]), int(own[TRACE])
    j = int(own[PEAK_BIN]) + shift
    if 0 <= j < even.size and even[j]:
        own[PEAK_BIN] = j
        own[OFFSET] -= shift
        own[FIRST_OFFSET] -= shift
        cut_out(traces[place], moments[place, 0], j - half, 2 * half + 1, rest)
    else:
        own[HEIGHT] = np.nan
        own[MOVED] = 0.0


@inlined
def subtract_others(rest, w, candidates, group, k, table):
    """What the other returns of a group leave of a vector of bins, from bin w around return k on."""
    half, tails = table.half, table.tails
    for other in group:
        away = candidates[k, PEAK_BIN] - candidates[other, PEAK_BIN]
        if other != k and math.fabs(away) <= 2 * half and candidates[other, HEIGHT] > 0:
            # between two phases: an error of half a phase would be one of a bright neighbour's slope
            position = (candidates[other, OFFSET] + MAX_OFFSET_BINS) * PHASES_PER_BIN
            phase = min(int(position), tails.shape[0] - 2)
            later = fill_vector(np.float32(candidates[other, HEIGHT] * (position - phase)))
            earlier = fill_vector(np.float32(candidates[other, HEIGHT] * (phase + 1 - position)))
            there = w + np.uintp(int(away) + 2 * half)
            rest -= earlier * load_vector(tails[phase], there)
            rest -= later * load_vector(tails[phase + 1], there)
    return rest


@search_part
def measure_returns_by_table(room, listed, least, pixels, times, table, found, counts):
    """Write what is `found` of the returns that respond by `least` deviations: (all pixels, most
    returns, 3) instant, s, sum over the bins, standard deviation, s; nearest first. `pixels`
    (traces,): of the traces; `counts` (all pixels,) goes up by one for each return, and is
    `NEEDS_EXACT_FIT` where one of the pixel does.
    """
    candidates = room.candidates
    for k in range(listed):
        own, rest = candidates[k], room.rests[k]
        height, noise, offset = own[HEIGHT], own[NOISE], own[OFFSET]
        pixel, j = pixels[int(own[TRACE])], np.uintp(own[PEAK_BIN])
        number = counts[pixel]
        if number < 0:
            continue
        if math.isnan(height):
            counts[pixel] = NEEDS_EXACT_FIT
            continue
        phase = find_phase(offset)
        known = table.sums[phase]
        if height <= 0 or height * math.sqrt(known[0]) <= least * noise:
            continue
        later = np.float32(offset - (phase / PHASES_PER_BIN - MAX_OFFSET_BINS))
        high, misfit = np.float32(height), np.float32(0)
        for w in range(np.uintp(rest.size)):
            shape = table.shapes[phase, w]
            off = rest[w] - high * (shape - later * table.slopes[phase, w])
            misfit += off * off if shape > 0 else np.float32(0)
        misfit -= noise * noise * (known[6] - 2)
        energy = known[2] - known[1] * known[1] / known[0]
        width = times[j + ONE] - times[j]
        deviation = estimate_deviation(height, noise, misfit, energy, known[3], known[4], known[5])
        instant, total = times[j] + offset * width, height * known[3]
        insert_return(found[pixel], number, instant, total, deviation * width)
        counts[pixel] = number + 1


@inlined
def estimate_deviation(height, noise, misfit, energy, total, unfitted, weighted):
    """Standard deviation of a return's arrival, of which all are sums over its bins.

    The variance of a bin is taken as ``noise^2 + dispersion * brightness`` (quasi-Poisson). The
    dispersion is what makes the expected sum of squared residuals, ``sum_i variance_i (1 - h_i)``
    with the fit's leverages h, equal to the one found, noise and `misfit`; the variances are then
    carried through the least-squares fit. `energy`: of the slope across the pulse, the part that a
    change of height cannot mimic; `total`: of the pulse; `unfitted`: of the pulse as far as the fit
    leaves it; `weighted`: of the pulse times the square of the slope across it.
    """
    variance = noise * noise * energy
    if misfit > 0:
        least = 1e-3 * total
        variance += misfit / (unfitted if unfitted > least else least) * weighted
    return math.sqrt(variance) / (energy * height)


@inlined
def insert_return(found, number, instant, total, deviation):
    """Enter a return of a pixel in the order of time behind `number` others."""
    place = number
    while place > 0 and found[place - 1, 0] > instant:
        for column in range(3):
            found[place, column] = found[place - 1, column]
        place -= 1
    own = found[place]
    own[0] = instant
    own[1] = total
    own[2] = deviation


@search_part
def fit_returns_exactly(traces, pixels, axis, least, listed, pulse, room, found, counts):
    """Fit and measure the returns of the traces whose `counts` is `NEEDS_EXACT_FIT`; arguments as for
    `measure_returns_by_table`, and the pulse's `curve` and `scale`.
    """
    curve, scale = pulse
    times, candidates, level = axis.times, room.candidates, room.level
    start = 0
    while start < listed:
        place, end = int(candidates[start, TRACE]), start
        pixel, trace, background = pixels[place], traces[place], room.moments[place, 0]
        while end < listed and int(candidates[end, TRACE]) == place:
            j, guess = int(candidates[end, PEAK_BIN]), room.estimates[end - start]
            width = times[j + 1] - times[j]
            # from the beginning: what does not converge in so many steps is not given more of them
            guess[0] = times[j] + candidates[end, FIRST_OFFSET] * width
            guess[1] = max(trace[j] - background, 0.0)
            guess[2] = axis.windows[j, 0]
            guess[3] = axis.windows[j, 1]
            end += 1
        if counts[pixel] == NEEDS_EXACT_FIT:
            estimate, noise = room.estimates[: end - start], candidates[start, NOISE]
            level[:] = background
            even = level, 0.0
            refine_returns(trace, times, level, curve, scale, estimate, even, MAX_FIT_ROUNDS)
            counts[pixel] = measure_returns(
                trace, times, level, noise, curve, scale, estimate, least * noise, found[pixel]
            )
        start = end


@loop_part
def refine_returns(trace, times, background, curve, scale, estimate, variance, rounds):
    """Least-squares arrival and height of every return, by at most so many Gauss-Newton steps on one
    at a time; a return that moved no more and that no moving one reaches is left alone.

    A bin weighs as much as its variance (`get_variance`) is small; all weigh the same where the second
    number of `variance` is 0. With the variance of photon counts it is Fisher scoring, which ends at
    the Poisson likelihood's maximum.
    """
    for k in range(estimate.shape[0]):
        estimate[k, 4] = np.inf
    for _ in range(rounds):
        largest = 0.0
        for k in range(estimate.shape[0]):
            crowded, moving = check_overlap(estimate, k, curve, scale)
            if moving >= CONVERGENCE_STEP_BINS:
                sums = sum_normal_equations(
                    trace, times, background, curve, scale, estimate, k, crowded, variance
                )
                take_gauss_newton_step(times, sums, estimate[k])
                largest = estimate[k, 4] if estimate[k, 4] > largest else largest
        if largest < CONVERGENCE_STEP_BINS:
            break


@loop_part
def check_overlap(estimate, k, curve, scale):
    """Whether another return has light in bins of return k, and by how many bins one moved."""
    before = scale[1] / scale[0] + scale[3]
    after = (curve.shape[0] - 1 - scale[1]) / scale[0] - scale[2]
    crowded, moving = False, estimate[k, 4]
    for other in range(estimate.shape[0]):
        later = estimate[other, 0] - estimate[k, 0]
        if other != k and -after < later < before:
            crowded = True
            moving = estimate[other, 4] if estimate[other, 4] > moving else moving
    return crowded, moving


@inlined
def sum_normal_equations(trace, times, background, curve, scale, estimate, k, crowded, variance):
    """Sums over the bins of return k, which are entered, of their pulse p, its slope d and the rest r:
    pp, pd, dd, pr, dr. Only if it is `crowded` are the other returns taken off.
    """
    own = estimate[k]
    arrival, height = own[0], own[1]
    first, last = find_pulse_window(times, (int(own[2]), int(own[3])), arrival, scale)
    own[2] = first
    own[3] = last
    pp = pd = dd = pr = dr = 0.0
    for i in range(np.uintp(first), np.uintp(last)):
        p, d = interpolate_pulse(times[i] - arrival, curve, scale)
        rest, weight = trace[i] - background[i], 1.0
        if crowded:
            rest = subtract_returns(rest, times[i], curve, scale, estimate, k)
        if variance[1] != 0:
            weight /= get_variance(variance, i, trace[i] - rest + height * p)
        shape, slope = weight * p, weight * d
        pp += shape * p
        pd += shape * d
        dd += slope * d
        pr += shape * rest
        dr += slope * rest
    return pp, pd, dd, pr, dr


@inlined
def take_gauss_newton_step(times, sums, own):
    """Improve one return's row in place, by at most a bin; `sums` of `sum_normal_equations`."""
    pp, pd, dd, pr, dr = sums
    determinant = pp * dd - pd * pd
    own[4] = 0.0
    first, last = int(own[2]), int(own[3])
    # fewer than two bins see the pulse: nothing to improve, though rounding may say otherwise
    if last - first < 2 or determinant <= 0:
        return
    height = (dd * pr - pd * dr) / determinant
    if height <= 0:
        own[1] = 0.0
        return
    bin_width = (times[last - 1] - times[first]) / (last - 1 - first)
    # model: height * p(t - arrival), whose slope is -height * d
    step = -(pp * dr - pd * pr) / (determinant * height)
    if math.fabs(step) > bin_width:
        step = math.copysign(bin_width, step)
    own[0] += step
    own[1] = height
    own[4] = math.fabs(step) / bin_width


@loop_part
def get_variance(variance, i, expected):
    """Variance of the photons of bin i, of which so many are expected, after the correction of pile-up.

    A bin in which the detector was ready in a fraction 1 / s of the cycles tells its rate, photons in a
    cycle, with the variance ``s expm1(rate) / cycles`` (of a binomial law's logarithm). `variance`: s of
    each bin and the number of cycles.
    """
    return variance[0][i] * variance[1] * np.expm1(expected / variance[1])


@loop_part
def find_pulse_window(times, near, arrival, scale):
    """First bin, and the one after the last, of a return at `arrival`, from bins `near` them."""
    first, last = near
    while first > 0 and times[first - 1] >= arrival + scale[2]:
        first -= 1
    while first < times.size and times[first] < arrival + scale[2]:
        first += 1
    while last > 0 and times[last - 1] >= arrival + scale[3]:
        last -= 1
    while last < times.size and times[last] < arrival + scale[3]:
        last += 1
    return first, last


@loop_part
def interpolate_pulse(time, curve, scale):
    """Pulse and its slope per second at `time`, s, after the arrival; zero outside the samples."""
    position = time * scale[0] + scale[1]
    if not 0 <= position < curve.shape[0] - 1:
        return 0.0, 0.0
    number = np.uintp(position)  # no index that might count from the end
    share, left, right = position - number, curve[number], curve[number + np.uintp(1)]
    return left[0] + share * (right[0] - left[0]), left[1] + share * (right[1] - left[1])


@loop_part
def subtract_returns(rest, time, curve, scale, estimate, without):
    """What all returns but number `without` (-1: all) leave of the brightness of a bin at `time`, s."""
    for k in range(estimate.shape[0]):
        if k != without:
            rest -= estimate[k, 1] * interpolate_pulse(time - estimate[k, 0], curve, scale)[0]
    return rest


@loop_part
def measure_returns(trace, times, background, noise, curve, scale, estimate, least, found):
    """Write instant, sum and standard deviation of every return that proves itself, nearest first;
    return their number. It has to lie on the time axis and to respond, height times root of the
    pulse's energy, by more than `least`.
    """
    number = 0
    for k in range(estimate.shape[0]):
        arrival, height = estimate[k, 0], estimate[k, 1]
        if height <= 0 or arrival < times[0] or arrival > times[times.size - 1]:
            continue
        crowded, _ = check_overlap(estimate, k, curve, scale)
        near = int(estimate[k, 2]), int(estimate[k, 3])
        first, last = find_pulse_window(times, near, arrival, scale)
        misfit = total = pp = pd = dd = ppp = ppd = pdd = 0.0
        for i in range(np.uintp(first), np.uintp(last)):
            p, d = interpolate_pulse(times[i] - arrival, curve, scale)
            rest = trace[i] - background[i]
            if crowded:
                rest = subtract_returns(rest, times[i], curve, scale, estimate, k)
            misfit += (rest - height * p) * (rest - height * p) - noise * noise
            total += p
            pp += p * p
            pd += p * d
            dd += d * d
            ppp += p * p * p
            ppd += p * p * d
            pdd += p * d * d
        # The normal equations have no solution where pulse and slope are alike, as in a window that
        # holds the pulse's edge only.
        if height * math.sqrt(pp) <= least or pp * dd <= pd * pd:
            continue
        slant = pd / pp
        energy = dd - pd * slant
        weighted = pdd - 2 * slant * ppd + slant * slant * ppp
        unfitted = total - ppp / pp - weighted / energy
        misfit += 2 * noise * noise  # two of the bins' worth of noise went into the fit
        deviation = estimate_deviation(height, noise, misfit, energy, total, unfitted, weighted)
        insert_return(found, number, arrival, height * total, deviation)
        number += 1
    return number


@search_step
def list_returns(found, counts, pixel, values):
    """List the returns of all pixels, in order: pixel, (n,), and their three values, (3, n)."""
    listed = np.uintp(0)
    for p in range(counts.size):
        for k in range(counts[p]):
            pixel[listed] = p
            for column in range(3):
                values[column, listed] = found[p, k, column]
            listed += ONE
