"""The compiled fit of pulses to a trace.

A pulse is handed over in two parts, because arrays inside a tuple cost a lock each time they are
taken out: `curve`, (samples, 2) brightness and slope, and `scale`, samples per second, origin,
first and last instant that matter; see `tofclip.lidar.Pulse.kernel_table`.

The fit of returns on an even time axis, by a table of the pulse.

A Gauss-Newton step of `tofclip.lidar.fit_kernels.refine_returns` is two products of the table's rows
with the trace (`tofclip.lidar.pulse_tables`). A step from the nearest tabulated phase ends
where one from the exact phase would, but for the square of their distance, at most (1 / 128)^2 of a
bin: far below where the steps end (`CONVERGENCE_STEP_BINS`).

Nearly all returns of a shot have their pulse to themselves and are fitted side by side
(`fit_lone_returns`); those that overlap take turns, each against what the others leave
(`fit_crowded_returns`).

The fit of returns on an uneven time axis, and of those at the ends of an even one, where not all
bins of the table (`tofclip.lidar.fit_kernels`) are there: `tofclip.lidar.fit_kernels`, trace by
trace.
"""

from __future__ import annotations

import math

import numpy as np
from numba.core.types import Array
from numba.extending import overload

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
    is_near,
    search_step,
)
from tofclip.lidar.pulse_tables import MAX_OFFSET_BINS, PHASES_PER_BIN
from tofclip.vectors import STEP, choose, fill_vector, load_vector, store_vector, sum_vector

MAX_FIT_ROUNDS = (
    8  # from near the top it has converged after two; more are for returns that overlap
)
CONVERGENCE_STEP_BINS = 5e-3  # a return that moved by less is done: its next step is smaller by far
EVEN_VARIANCE = (
    1.0,
    0.0,
)  # variance of a bin, as constant and factor of its expected brightness: the same everywhere

# Without counts of the arrays' owners, which cost a lock for every array that is handed on; nothing
# here allocates.
loop_part = compile_as_part(_nrt=False)


@loop_part
def find_pulse_window(times, near, arrival, scale):
    """First bin and the bin after the last one that a return at `arrival` reaches; `near` guesses
    them.

    `times` (bins,): seconds, increasing; `near`: guesses of the two bins; `arrival`: seconds;
    `scale` (4,): samples per second, origin, first and last instant of the pulse.
    """
    return find_first_bin(times, near[0], arrival + scale[2]), find_first_bin(
        times, near[1], arrival + scale[3]
    )


@loop_part
def find_first_bin(times, near, instant):
    """First bin at `instant` or later, step by step from a bin near it.

    `times` (bins,): seconds, increasing; `near`: where the search starts; `instant`: seconds.
    """
    while near > 0 and times[near - 1] >= instant:
        near -= 1
    while near < times.size and times[near] < instant:
        near += 1
    return near


def get_level(background, i):
    """Background of bin i: the same in all bins, or an array of them."""
    return background if np.ndim(background) == 0 else background[i]


@overload(get_level, inline="always")
def _compile_get_level(background, i):
    if isinstance(background, Array):
        return lambda background, i: background[i]
    return lambda background, i: background


def get_variance(variance, i, expected):
    """Variance of bin i: linear in what is expected there, or that of photons after the correction
    of pile-up.

    A bin in which the detector was ready in a fraction 1 / s of the cycles tells its rate, photons
    in a cycle, with the variance ``s expm1(rate) / cycles`` (of a binomial law's logarithm).

    `variance`: constant and factor; or s of each bin and the number of cycles; `expected`: photons
    of all cycles.
    """
    if np.ndim(variance[0]) == 0:
        return variance[0] + variance[1] * expected
    return variance[0][i] * variance[1] * np.expm1(expected / variance[1])


@overload(get_variance, inline="always")
def _compile_get_variance(variance, i, expected):
    if isinstance(variance.types[0], Array):
        return lambda variance, i, expected: (
            variance[0][i] * variance[1] * np.expm1(expected / variance[1])
        )
    return lambda variance, i, expected: variance[0] + variance[1] * expected


@loop_part
def interpolate_pulse(time, curve, scale):
    """Pulse and its slope at `time` after the arrival, by linear interpolation; zero outside the
    samples.

    `time`: seconds after the arrival; `curve` (samples, 2): pulse and slope; `scale` (4,): samples
    per second, origin, first and last instant of the pulse. Returns pulse, and its slope per
    second.
    """
    position = time * scale[0] + scale[1]
    if not 0 <= position < curve.shape[0] - 1:
        return 0.0, 0.0
    number = np.uintp(position)  # no index that might count from the end
    share, left, right = position - number, curve[number], curve[number + np.uintp(1)]
    return left[0] + share * (right[0] - left[0]), left[1] + share * (right[1] - left[1])


@loop_part
def subtract_returns(rest, time, curve, scale, estimate, without):
    """What is left of a bin's brightness less all returns except number `without` (-1: less all).

    `rest`: brightness less the background; `time`: instant of the bin, s; `curve` (samples, 2):
    pulse and slope; `scale` (4,): of the pulse; `estimate` (returns, 5): see `refine_returns`;
    `without`: return that is not taken off.
    """
    for k in range(estimate.shape[0]):
        if k != without:
            rest -= estimate[k, 1] * interpolate_pulse(time - estimate[k, 0], curve, scale)[0]
    return rest


@loop_part
def refine_returns(trace, times, background, curve, scale, estimate, variance, rounds):
    """Least-squares arrival and height of every return, by Gauss-Newton steps on one return at a
    time.

    Taking turns, each against what the others leave, undoes the pull of returns that overlap. A bin
    weighs as much as its variance (`get_variance`) is small. With `EVEN_VARIANCE` that is the plain
    fit; with that of photon counts it is Fisher scoring, which ends at the Poisson likelihood's
    maximum. A return that moved no more and that no moving
    one reaches is left alone.

    `estimate` is (returns, 5): arrival, height, first bin and the bin after the last one that it
    reaches, or what is near them, and by how many bins it moved last, which is overwritten.

    `trace, times` (bins,): brightness, and seconds; `curve` (samples, 2): pulse and slope; `scale`
    (4,): of the pulse; `estimate` (returns, 5): updated in place; `variance`: see `get_variance`;
    `rounds`: maximum number of steps for each return.
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
    """Whether another return reaches return k, and the most that one of them moved.

    One reaches the other if it has light in bins that count for the other.

    `estimate` (returns, 5); `k`: number of the return; `curve` (samples, 2): pulse and slope;
    `scale` (4,): of the pulse. Returns `moving`: bins.
    """
    before, after = (
        scale[1] / scale[0] + scale[3],
        (curve.shape[0] - 1 - scale[1]) / scale[0] - scale[2],
    )
    crowded, moving = False, estimate[k, 4]
    for other in range(estimate.shape[0]):
        later = estimate[other, 0] - estimate[k, 0]
        if other != k and -after < later < before:
            crowded = True
            moving = estimate[other, 4] if estimate[other, 4] > moving else moving
    return crowded, moving


@inlined
def sum_normal_equations(trace, times, background, curve, scale, estimate, k, crowded, variance):
    """Sums over the bins of return k, of their pulse p, its slope d and the rest r: pp, pd, dd, pr,
    dr; see `refine_returns`.

    The bins are entered in `estimate`. Only if it is `crowded` are the other returns taken off.

    `trace, times` (bins,): brightness, and seconds; `curve` (samples, 2): pulse and slope; `scale`
    (4,): of the pulse; `estimate` (returns, 5): columns 2 and 3 of row k are overwritten; `k`:
    number of the return; `variance`: see `refine_returns`.
    """
    own = estimate[k]
    arrival, height = own[0], own[1]
    first = find_first_bin(times, int(own[2]), arrival + scale[2])
    last = find_first_bin(times, int(own[3]), arrival + scale[3])
    own[2] = first
    own[3] = last
    pp = pd = dd = pr = dr = 0.0
    for i in range(np.uintp(first), np.uintp(last)):
        p, d = interpolate_pulse(times[i] - arrival, curve, scale)
        rest, weight = trace[i] - get_level(background, i), 1.0
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
    """Improve one return's arrival and height in place, and enter by how many bins it moved (at
    most one).

    `times` (bins,): seconds; `sums`: from `sum_normal_equations`; `own` (5,): the return's row of
    the estimate, updated in place.
    """
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
    step = -(pp * dr - pd * pr) / (
        determinant * height
    )  # model: height * p(t - arrival), whose slope is -height * d
    if math.fabs(step) > bin_width:
        step = math.copysign(bin_width, step)
    own[0] += step
    own[1] = height
    own[4] = math.fabs(step) / bin_width


@loop_part
def measure_returns(trace, times, background, noise, curve, scale, estimate, least, profile, found):
    """Write instant, sum and standard deviation of every return that proves itself; return their
    number.

    It has to lie on the time axis and to respond, height times root of the pulse's energy, by more
    than `least`. `profile`, (bins, 3), is overwritten.

    `trace, times` (bins,): brightness, and seconds; `background, noise`: mean and standard
    deviation of the bins without a return; `curve` (samples, 2): pulse and slope; `scale` (4,): of
    the pulse; `estimate` (returns, 5); `least`: response that a return must exceed; `profile`
    (bins, 3): overwritten; `found` (returns, 3): overwritten: seconds, sum over the bins, standard
    deviation in seconds.
    """
    number = 0
    for k in range(estimate.shape[0]):
        arrival, height = estimate[k, 0], estimate[k, 1]
        if height <= 0 or arrival < times[0] or arrival > times[times.size - 1]:
            continue
        crowded, _ = check_overlap(estimate, k, curve, scale)
        first = find_first_bin(times, int(estimate[k, 2]), arrival + scale[2])
        last = find_first_bin(times, int(estimate[k, 3]), arrival + scale[3])
        pp = pd = dd = 0.0
        for i in range(np.uintp(first), np.uintp(last)):
            p, d = interpolate_pulse(times[i] - arrival, curve, scale)
            rest = trace[i] - background
            if crowded:
                rest = subtract_returns(rest, times[i], curve, scale, estimate, k)
            bin_profile = profile[i]
            bin_profile[0] = p
            bin_profile[1] = d
            bin_profile[2] = rest - height * p
            pp += p * p
            pd += p * d
            dd += d * d
        # The normal equations have no solution where pulse and slope are alike, as in a window that
        # holds the pulse's edge only.
        if height * math.sqrt(pp) <= least or pp * dd <= pd * pd:
            continue
        total, deviation = estimate_sum_and_deviation(
            profile[first:last], height, noise, pp, pd, dd
        )
        own = found[number]
        own[0] = arrival
        own[1] = total
        own[2] = deviation
        number += 1
    return number


@inlined
def estimate_sum_and_deviation(profile, height, noise, pp, pd, dd):
    """Sum of a return over its bins, and the standard deviation of its arrival.

    The variance of a bin is taken as ``noise^2 + dispersion * brightness`` (quasi-Poisson). The
    dispersion is what makes the expected sum of squared residuals, ``sum_i variance_i (1 - h_i)``
    with the fit's leverages h, equal to the one found; the variances are then carried through the
    least-squares fit.

    `profile` (bins, 3): pulse, slope and residual in each bin that the return reaches; `pp, pd,
    dd`: sums of squared pulse, pulse times slope, and squared slope.
    """
    slant, per_pp = pd / pp, 1 / pp
    across_energy = dd - pd * slant
    per_across = 1 / across_energy
    total = misfit = unfitted = weighted = 0.0
    for i in range(profile.shape[0]):
        p, d, residual = profile[i, 0], profile[i, 1], profile[i, 2]
        across = d - p * slant  # the part of the slope that a change of height cannot mimic
        total += height * p
        misfit += residual * residual - noise * noise
        unfitted += height * p * (1 - p * p * per_pp - across * across * per_across)
        weighted += across * across * height * p
    misfit += 2 * noise * noise  # two of the bins' worth of noise went into the fit
    variance = noise * noise * across_energy
    if misfit > 0:
        least = 1e-3 * total
        variance += misfit / (unfitted if unfitted > least else least) * weighted
    return total, math.sqrt(variance) / (across_energy * height)


@loop_part
def sort_rows(table, number):
    """Sort the first few rows of a table by their first column, in place.

    `table` (rows, columns); `number`: of rows that are sorted.
    """
    for last in range(1, number):
        place = last
        while place > 0 and table[place - 1, 0] > table[place, 0]:
            for column in range(table.shape[1]):
                value = table[place, column]
                table[place, column] = table[place - 1, column]
                table[place - 1, column] = value
            place -= 1


@inlined
def find_phase(offset):
    """Row of the table nearest to an offset.

    `offset`: bins, at most `MAX_OFFSET_BINS` either way.
    """
    return np.uintp((offset + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)


@search_step
def fit_lone_returns(
    traces, moments, even, half, candidates, rests, active, moving, shapes, slopes, sums
):
    """Fit returns that stand alone, of many traces: each round takes one step of every return that
    still moves.

    A step waits for the one before it. Steps of different returns do not, so that the processor
    works on several at a time.

    `traces, moments, even, half`: as for `tofclip.lidar.peak_kernels.find_candidates`;
    `candidates` (room, CANDIDATE_COLUMNS): column `OFFSET` is improved; `HEIGHT` is overwritten:
    not above zero where there is no pulse, NaN where the return moved to where the exact fit is
    needed. `PEAK_BIN` follows one that moves further than `MAX_OFFSET_BINS`; `rests` (room, width):
    of `tofclip.lidar.peak_kernels.find_candidates`; what is around the peak bins; `active`
    (room,): numbers of the returns; overwritten; `moving`: how many; `shapes, slopes, sums`: see
    `PhaseTable`.
    """
    for _ in range(MAX_FIT_ROUNDS):
        still = 0
        for a in range(moving):
            k = active[a]
            own, rest = candidates[k], rests[k]
            phase = find_phase(own[OFFSET])
            along_pulse = along_slope = fill_vector(np.float32(0))
            for w in range(np.uintp(0), np.uintp(rest.size), STEP):
                left = load_vector(rest, w)
                along_pulse += left * load_vector(shapes[phase], w)
                along_slope += left * load_vector(slopes[phase], w)
            take_table_step(own, phase, sum_vector(along_pulse), sum_vector(along_slope), sums)
            follow_return(own, rest, traces, moments, even, half)
            active[still] = k
            still += 1 if own[MOVED] >= CONVERGENCE_STEP_BINS else 0
        moving = still
        if moving == 0:
            break


@inlined
def take_table_step(own, phase, pr, dr, sums):
    """Improve one return's offset and height in place by a Gauss-Newton step, of at most a bin.

    `own` (CANDIDATE_COLUMNS,); `phase`: row of the table nearest to its offset; `pr, dr`: products
    of what is left for it with pulse and slope; `sums` (phases, 7): see `PhaseTable`.
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
    """Cut out the bins around a return again where it has moved away from the bin of its peak.

    `own` (CANDIDATE_COLUMNS,): the bin and what is relative to it are overwritten. `HEIGHT` becomes
    NaN where the bins around are not all there; `rest` (width,): overwritten; `traces, moments,
    even, half`: as for `tofclip.lidar.peak_kernels.find_candidates`.
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


@search_step
def fit_crowded_returns(
    traces, moments, even, half, candidates, rests, crowded, number, shapes, slopes, tails, sums
):
    """Fit returns that overlap, by steps on one at a time.

    Taking turns, each against what the others leave, undoes the pull of returns on each other. A
    return that moved no more and that no moving one reaches is left alone.

    `traces, moments, even, half`: as for `tofclip.lidar.peak_kernels.find_candidates`;
    `candidates` (room, CANDIDATE_COLUMNS): columns `OFFSET`, `HEIGHT`, `MOVED` and `PEAK_BIN` are
    improved, as by `fit_lone_returns`; `rests` (room, width): of
    `tofclip.lidar.peak_kernels.find_candidates`; in the end what the others leave of it;
    `crowded` (room,): numbers of the returns, increasing; `number`: how many; `shapes, slopes,
    tails, sums`: see `PhaseTable`.
    """
    start = 0
    while start < number:
        end = start + 1
        while end < number and is_near(candidates, crowded[end - 1], crowded[end], half):
            end += 1
        for _ in range(MAX_FIT_ROUNDS):
            largest = 0.0
            for place in range(start, end):
                own, rest = candidates[crowded[place]], rests[crowded[place]]
                moved = find_largest_move(candidates, crowded[start:end], own, half)
                if moved < CONVERGENCE_STEP_BINS or math.isnan(own[HEIGHT]):
                    continue
                phase = find_phase(own[OFFSET])
                along_pulse = along_slope = fill_vector(np.float32(0))
                for w in range(np.uintp(0), np.uintp(rest.size), STEP):
                    left = subtract_others(
                        load_vector(rest, w),
                        w,
                        candidates,
                        crowded[start:end],
                        crowded[place],
                        half,
                        tails,
                    )
                    along_pulse += left * load_vector(shapes[phase], w)
                    along_slope += left * load_vector(slopes[phase], w)
                take_table_step(own, phase, sum_vector(along_pulse), sum_vector(along_slope), sums)
                follow_return(own, rest, traces, moments, even, half)
                largest = own[MOVED] if own[MOVED] > largest else largest
            if largest < CONVERGENCE_STEP_BINS:
                break
        for place in range(start, end):
            own, rest = candidates[crowded[place]], rests[crowded[place]]
            for w in range(np.uintp(0), np.uintp(rest.size), STEP):
                left = subtract_others(
                    load_vector(rest, w),
                    w,
                    candidates,
                    crowded[start:end],
                    crowded[place],
                    half,
                    tails,
                )
                store_vector(rest, w, left)
        start = end


@inlined
def find_largest_move(candidates, numbers, own, half):
    """By how many bins a return, or one of those that reach it, moved last.

    `candidates` (room, CANDIDATE_COLUMNS); `numbers` (n,): of the returns; that of `own` among
    them; `own` (CANDIDATE_COLUMNS,); `half`: see `PhaseTable`.
    """
    moved = 0.0
    for other in numbers:
        if math.fabs(candidates[other, PEAK_BIN] - own[PEAK_BIN]) <= 2 * half:
            moved = max(moved, candidates[other, MOVED])
    return moved


@inlined
def subtract_others(rest, w, candidates, numbers, k, half, tails):
    """What the other returns leave of a vector of bins.

    `rest`: trace less background, from bin w of those around the peak of return k on; `candidates`
    (room, CANDIDATE_COLUMNS); `numbers` (n,): of the returns; that of `own` among them; `own`
    (CANDIDATE_COLUMNS,); `tails`: see `PhaseTable`.
    """
    for other in numbers:
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


@search_step
def measure_returns_by_table(
    candidates, listed, rests, least, pixels, times, shapes, slopes, sums, found, counts
):
    """Write instant, sum and standard deviation of the returns that prove themselves.

    `candidates` (room, CANDIDATE_COLUMNS): fitted; those of one trace side by side; `listed`: how
    many; `rests` (room, width): what is left of the trace for each of them; `least`: standard
    deviations that a return's response must exceed; `pixels` (traces,): number of the pixel to
    which each trace belongs; `times` (bins,): seconds; `shapes, slopes, sums`: see `PhaseTable`;
    `found` (all pixels, most returns, 3): overwritten: seconds, sum over the bins, standard
    deviation in seconds; nearest first; `counts` (all pixels,): goes up by one for each;
    `NEEDS_EXACT_FIT` where a return of the pixel does.
    """
    zero = fill_vector(np.float32(0))
    for k in range(listed):
        own, rest = candidates[k], rests[k]
        height, noise, offset = own[HEIGHT], own[NOISE], own[OFFSET]
        pixel, j = pixels[int(own[TRACE])], np.uintp(own[PEAK_BIN])
        number = counts[pixel]
        if number < 0:
            continue
        if math.isnan(height):
            counts[pixel] = NEEDS_EXACT_FIT
            continue
        phase = find_phase(offset)
        known = sums[phase]
        if height <= 0 or height * math.sqrt(known[0]) <= least * noise:
            continue
        later = fill_vector(np.float32(offset - (phase / PHASES_PER_BIN - MAX_OFFSET_BINS)))
        high, misfits = fill_vector(np.float32(height)), zero
        for w in range(np.uintp(0), np.uintp(rest.size), STEP):
            shape = load_vector(shapes[phase], w)
            off = load_vector(rest, w) - high * (shape - later * load_vector(slopes[phase], w))
            misfits += choose(shape > zero, off * off, zero)
        excess = sum_vector(misfits) - noise * noise * (known[6] - 2)
        excess = excess if excess > 0 else 0.0
        across_energy, total = known[2] - known[1] * known[1] / known[0], height * known[3]
        unfitted = height * known[4] if height * known[4] > 1e-3 * total else 1e-3 * total
        variance = noise * noise * across_energy + excess / unfitted * height * known[5]
        width = times[j + ONE] - times[j]
        instant = times[j] + offset * width
        place = number
        while place > 0 and found[pixel, place - 1, 0] > instant:  # overtaken by a crowded one
            for column in range(3):
                found[pixel, place, column] = found[pixel, place - 1, column]
            place -= 1
        result = found[pixel, place]
        result[0] = instant
        result[1] = total
        result[2] = math.sqrt(variance) / (across_energy * height) * width
        counts[pixel] = number + 1


@search_step
def list_returns(found, counts, pixel, values):
    """List what was found in all pixels, in their order.

    `found` (all pixels, most returns, 3); `counts` (all pixels,): number of returns of each pixel;
    `pixel` (n,): overwritten: number of the pixel of each return; `values` (3, n): overwritten:
    what is known of each return.
    """
    listed = np.uintp(0)
    for p in range(counts.size):
        for k in range(counts[p]):
            pixel[listed] = p
            for column in range(3):
                values[column, listed] = found[p, k, column]
            listed += ONE


@search_step
def fit_returns_exactly(
    traces,
    pixels,
    times,
    moments,
    least,
    windows,
    candidates,
    listed,
    pulse,
    estimates,
    profile,
    found,
    counts,
):
    """Fit and measure the returns of the traces that the table does not do.

    `traces` (n, bins); `pixels` (n,): number of the pixel to which each trace belongs; `times`
    (bins,): seconds, increasing; `moments` (n, 2): mean and standard deviation of the bins without
    a return; `least`: standard deviations that a return's response must exceed; `windows` (bins,
    4): see `tofclip.lidar.pulse_tables.list_windows`; `candidates` (room, CANDIDATE_COLUMNS):
    those of one trace side by side; see `tofclip.lidar.peak_kernels`; `listed`: how many;
    `pulse` (curve, scale): see `tofclip.lidar.fit_kernels`; `estimates` (most returns, 5):
    overwritten; `profile` (bins, 3): overwritten; `found` (all pixels, most returns, 3):
    overwritten where `counts` is `NEEDS_EXACT_FIT`: instant, s, sum of the fitted pulse over the
    bins, standard deviation of the instant, s; nearest first; `counts` (all pixels,): number of
    returns of each pixel.
    """
    curve, scale = pulse
    start = 0
    while start < listed:
        place, end = int(candidates[start, TRACE]), start
        pixel, trace, background = pixels[place], traces[place], moments[place, 0]
        while end < listed and int(candidates[end, TRACE]) == place:
            j, guess = int(candidates[end, PEAK_BIN]), estimates[end - start]
            width = times[j + 1] - times[j]
            # from the beginning: what does not converge in so many steps is not given more of them
            guess[0] = times[j] + candidates[end, FIRST_OFFSET] * width
            guess[1] = max(trace[j] - background, 0.0)
            guess[2] = windows[j, 0]
            guess[3] = windows[j, 1]
            end += 1
        if counts[pixel] == NEEDS_EXACT_FIT:
            estimate, noise = estimates[: end - start], candidates[start, NOISE]
            refine_returns(
                trace, times, background, curve, scale, estimate, EVEN_VARIANCE, MAX_FIT_ROUNDS
            )
            number = measure_returns(
                trace,
                times,
                background,
                noise,
                curve,
                scale,
                estimate,
                least * noise,
                profile,
                found[pixel],
            )
            sort_rows(found[pixel], number)
            counts[pixel] = number
        start = end
