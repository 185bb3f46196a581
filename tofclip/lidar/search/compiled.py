"""The compiled search for returns: one pixel's trace after another.

The steps are those of `tofclip.lidar.search`, and functions that do the same have the same names in
`tofclip.lidar.search.array_api`, where they take all pixels at once. Every function is serial and
holds no interpreter lock; `tofclip.lidar.search` shares the pixels between threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tofclip.compiling import compile_as_part
from tofclip.lidar.detection import MAX_FIT_ROUNDS, PREFIT_THRESHOLD_FACTOR
from tofclip.lidar.pulse_fit import (
    EVEN_VARIANCE,
    find_pulse_window,
    loop_part,
    measure_returns,
    refine_returns,
    sort_rows,
)
from tofclip.lidar.search.lone_fit import (
    LEAST,
    LONE_COLUMNS,
    NOISE,
    OFFSET,
    PEAK_BIN,
    TRACE,
    copy_rest,
    fit_lone_returns,
    measure_lone_returns,
    stand_alone,
)

NEIGHBOUR_FRACTION = 0.5  # of what is of interest: weaker peaks do not move a return beside them
LONE_ROOM = 256  # returns that are fitted together; what is known of them stays in cache
WEIGHTS_PER_PASS = 4  # weights of a filter that are applied in one pass

vectorised_part = compile_as_part(fastmath=True, _nrt=False, forceinline=True)


@njit(nogil=True, cache=True)
def find_returns(
    traces, pixels, times, bin_weights, filters, pulse, phases, limits, least, found, counts
):
    """Find the returns of each trace.

    Candidates are the peaks of the trace under a sharp filter, which still shows two returns where
    the matched filter would merge them; whether one counts, the matched filter decides, and once
    more the fit.

    Parameters
    ----------
    traces : (n, bins) float32 array
    pixels : (n,) int64 array
        Number of the pixel to which each trace belongs.
    times : (bins,) float64 array
        Instant of each bin, increasing.
    bin_weights : (bins,) float32 array
        For how many bins each one stands where background and noise are concerned.
    filters : tuple
        A sharp filter, (width, bins), and the matched one, (bins, width + 1), float32 arrays of
        unit energy, nowhere negative: entry w holds the weight of bin ``j + w - width // 2`` for a
        return at bin j, and the width of the sharp one is a multiple of four. The last column holds
        the sum over the others. Then the largest sum of either.
    pulse : tuple
        See `Pulse.kernel_table`.
    phases : tuple
        Even bins, and shapes, slopes, sums and half of a `tofclip.lidar.search.lone_fit.PhaseTable`.
    limits : (float, float, float, float, float)
        Smallest distance between two returns, s, smallest signal-to-noise, smallest fraction of
        the strongest return, with the fall-off with range undone, the last instant at which a
        return may lie, s, and the lowest of `least`.
    least : (bins,) float32 array
        Response that a return at each bin must exceed to be of interest; weaker peaks are fitted
        only where such a return overlaps them. 0 where nothing is known.
    found : (all pixels, most returns, 3) float64 array, overwritten where `pixels` says
        Instant, sum of the fitted pulse over the bins, standard deviation of the instant; nearest
        first.
    counts : (all pixels,) int64 array, overwritten where `pixels` says
        Number of returns of each pixel.
    """
    bins, most, shapes = times.size, found.shape[1], phases[1]
    memory = (
        np.empty(bins, np.float32),
        np.empty(bins, np.float32),
        bin_weights.copy(),
        np.empty((most, 4)),
        np.empty((most, 5)),
        np.empty((bins, 3)),
        np.empty((bins, 4), np.int64),
        bin_weights.astype(np.float64),
    )
    list_windows(times, pulse[1], limits[0], memory[6])
    room = LONE_ROOM + most
    lone, rests = np.empty((room, LONE_COLUMNS)), np.empty((room, shapes.shape[1]), np.float32)
    search_traces(
        traces,
        pixels,
        times,
        bin_weights,
        filters,
        pulse,
        phases,
        limits,
        least,
        memory,
        (lone, rests, np.empty(room, np.int64)),
        found,
        counts,
    )


@loop_part
def search_traces(
    traces,
    pixels,
    times,
    bin_weights,
    filters,
    pulse,
    phases,
    limits,
    least,
    memory,
    lone_memory,
    found,
    counts,
):
    """Find the returns of each trace, in memory that is there already.

    Parameters
    ----------
    traces, pixels, times, bin_weights, filters, pulse, phases, limits, least, found, counts
        See `find_returns`.
    memory : tuple
        See `select_peaks`.
    lone_memory : (lone, rests, active)
        See `fit_lone_returns`; room for `LONE_ROOM` returns and those of one more trace.
    """
    even, shapes, slopes, sums, half = phases
    lone, rests, active = lone_memory
    estimate = memory[4]
    # light that ends before the other's begins, whatever both of them move
    distance, listed, begun = 2 * half + 1, 0, 0
    for place in range(traces.shape[0]):
        trace, pixel = traces[place], pixels[place]
        kept, background, noise = select_peaks(
            trace, times, bin_weights, filters, pulse, limits, least, memory
        )
        counts[pixel] = 0
        if stand_alone(estimate, kept, even, distance):
            for k in range(kept):
                j = int(estimate[k, 4])
                copy_rest(trace, np.uintp(j - half), np.uintp(distance), background, rests[listed])
                lone[listed, OFFSET] = (estimate[k, 0] - times[j]) / (times[j + 1] - times[j])
                lone[listed, NOISE] = noise
                lone[listed, LEAST] = limits[1] * noise
                lone[listed, PEAK_BIN], lone[listed, TRACE] = j, place
                listed += 1
        else:
            counts[pixel] = fit_crowded_returns(
                trace, times, background, noise, pulse, limits, memory, kept, found[pixel]
            )
        if listed < LONE_ROOM and place < traces.shape[0] - 1:
            continue
        fit_lone_returns(lone[:listed], rests, active, shapes, slopes, sums)
        measure_lone_returns(
            lone[:listed], rests, pixels, times, shapes, slopes, sums, found, counts
        )
        for again in range(begun, place + 1):
            if counts[pixels[again]] < 0:
                trace, pixel = traces[again], pixels[again]
                kept, background, noise = select_peaks(
                    trace, times, bin_weights, filters, pulse, limits, least, memory
                )
                counts[pixel] = fit_crowded_returns(
                    trace,
                    times,
                    background,
                    noise,
                    pulse,
                    limits,
                    memory,
                    kept,
                    found[pixel],
                )
        listed, begun = 0, place + 1


@loop_part
def select_peaks(trace, times, bin_weights, filters, pulse, limits, least, memory):
    """List the peaks of one trace that may be returns, in the order of time.

    Parameters
    ----------
    trace : (bins,) float32 array
        Brightness.
    times : (bins,) array
        Seconds, increasing.
    bin_weights : (bins,) array
        1 for bins that count towards background and noise.
    filters : (sharp, matched, gains)
        See `tofclip.lidar.search`.
    pulse : (curve, scale)
        See `tofclip.lidar.pulse_fit`.
    limits : (5,) floats
    least : (bins,) array
        See `find_returns`.
    memory : eight arrays
        Overwritten; the fifth holds a first guess of each return: arrival, s, height, bins that
        it reaches, and the peak's bin.

    Returns
    -------
    number : int
    background, noise : float
    """
    (sharp, matched, gains), scale = filters, pulse[1]
    score, maxima, free, peaks, estimate, _, windows, weights = memory
    correlate_trace(trace, sharp, score)
    total, square, bins = sum_moments(trace, weights)
    # the sharp filter's response to the background, below which nothing of interest can lie
    level = gains[0] * total / bins if limits[4] > 0 else 0.0
    copy_local_maxima(score, least, gains[0] / gains[1] * NEIGHBOUR_FRACTION, level, maxima)
    number, background, noise = find_strongest_peaks(
        (total, square, bins),
        trace,
        times,
        bin_weights,
        matched,
        gains,
        windows,
        limits,
        maxima,
        free,
        peaks,
    )
    needed, above_noise, kept = 0.0, limits[1] * noise, 0
    for k in range(number):
        j = int(peaks[k, 0])
        peaks[k, 1] = max(peaks[k, 1] - background * matched[j, -1], 0.0)
        # light falls with the square of the range, so strengths are compared as if all stood at one
        needed = max(needed, PREFIT_THRESHOLD_FACTOR * limits[2] * peaks[k, 1] * times[j] ** 2)
    reach = 2 * (scale[3] - scale[2])
    for k in range(number):
        j, strength = int(peaks[k, 0]), peaks[k, 1]
        if strength > above_noise and strength * times[j] ** 2 >= needed:
            if not is_wanted(peaks[:number], k, times, least, reach):
                continue
            estimate[kept, 0] = interpolate_peak_time(
                trace, times, matched, background, j, strength
            )
            estimate[kept, 1] = max(trace[j] - background, 0.0)
            estimate[kept, 2], estimate[kept, 3], estimate[kept, 4] = peaks[k, 2], peaks[k, 3], j
            kept += 1
    return kept, background, noise


@loop_part
def fit_crowded_returns(trace, times, background, noise, pulse, limits, memory, kept, found):
    """Fit the returns of one trace by the exact fit, in which they may overlap.

    Parameters
    ----------
    trace : (bins,) float32 array
    times : (bins,) array
        Seconds.
    background, noise : float
    pulse, limits, memory
        As for `select_peaks`.
    kept : int
        Peaks that `select_peaks` listed.
    found : (returns, 3) array
        Overwritten: seconds, sum over the bins, standard deviation in seconds.

    Returns
    -------
    int
        Number of returns.
    """
    (curve, scale), estimate, profile = pulse, memory[4][:kept], memory[5]
    refine_returns(trace, times, background, curve, scale, estimate, EVEN_VARIANCE, MAX_FIT_ROUNDS)
    number = measure_returns(
        trace, times, background, noise, curve, scale, estimate, limits[1] * noise, profile, found
    )
    sort_rows(found[:number])
    return number


@loop_part
def is_wanted(peaks, k, times, least, reach):
    """Whether a peak, or one within `reach` of it, exceeds what is of interest there.

    Parameters
    ----------
    peaks : (returns, 4) array
        Bin and response.
    k : int
        Number of the peak.
    times : (bins,) array
        Seconds.
    least : (bins,) array
        See `find_returns`.
    reach : float
        Seconds.
    """
    own = times[int(peaks[k, 0])]
    for other in range(peaks.shape[0]):
        j = int(peaks[other, 0])
        if peaks[other, 1] >= least[j] and abs(times[j] - own) <= reach:
            return True
    return False


@vectorised_part
def correlate_trace(trace, filters, score):
    """Filter a trace: ``score[j] = sum_w filters[w, j] * trace[j + w - width // 2]``.

    Parameters
    ----------
    trace : (bins,) float32 array
    filters : (width, bins) float32 array
        One filter for each bin; the width is a multiple of `WEIGHTS_PER_PASS`.
    score : (bins,) float32 array
        Overwritten.
    """
    width, bins = filters.shape
    half = width // 2
    first, last = min(half, bins), max(bins - half + 1, min(half, bins))
    here = score[first:last]
    for w in range(0, width, WEIGHTS_PER_PASS):
        one, two = filters[w, first:last], filters[w + 1, first:last]
        three, four = filters[w + 2, first:last], filters[w + 3, first:last]
        there = trace[first + w - half : last + w - half + WEIGHTS_PER_PASS - 1]
        if w == 0:
            for j in range(here.size):
                here[j] = (
                    one[j] * there[j]
                    + two[j] * there[j + 1]
                    + three[j] * there[j + 2]
                    + four[j] * there[j + 3]
                )
        else:
            for j in range(here.size):
                here[j] += (
                    one[j] * there[j]
                    + two[j] * there[j + 1]
                    + three[j] * there[j + 2]
                    + four[j] * there[j + 3]
                )
    for edge in (range(first), range(last, bins)):
        for j in edge:
            score[j] = 0
            for w in range(max(0, half - j), min(width, bins + half - j)):
                score[j] += filters[w, j] * trace[j + w - half]


@vectorised_part
def compute_response(trace, matched, j):
    """Response of the matched filter at bin j.

    Parameters
    ----------
    trace : (bins,) float32 array
    matched : (bins, width + 1) array
        A filter for each bin; its sum is the last entry.
    j : int
        Bin.

    Returns
    -------
    float
    """
    width = matched.shape[1] - 1
    start = j - width // 2
    weights, total = matched[j], np.float32(0)
    for w in range(np.uintp(max(0, -start)), np.uintp(min(width, trace.size - start))):
        total += weights[w] * trace[np.uintp(start + w)]
    return float(total)


@loop_part
def interpolate_peak_time(trace, times, matched, background, j, here):
    """Instant near bin j at which the response, `here` at the bin, is highest: by a parabola in its
    logarithm.

    Parameters
    ----------
    trace, times : (bins,) array
        Brightness, and seconds.
    matched : (bins, width + 1) array
        As for `compute_response`.
    background : float
    j : int
        Bin of the highest response.
    here : float
        Response there, less that to the background.

    Returns
    -------
    float
        Seconds.
    """
    before = compute_response(trace, matched, j - 1) - background * matched[j - 1, -1]
    after = compute_response(trace, matched, j + 1) - background * matched[j + 1, -1]
    if before <= 0 or after <= 0 or here < before or here < after:
        return times[j]
    rise, fall = np.log(here / before), np.log(here / after)
    share = (rise - fall) / (2 * (rise + fall)) if rise + fall > 0 else 0.0
    return times[j] + share * (times[j + 1] - times[j - 1]) / 2


@loop_part
def find_strongest_peaks(
    moments, trace, times, bin_weights, matched, gains, windows, limits, maxima, free, peaks
):
    """Fill `peaks` with the highest maxima that might count, in the order of time: bin, response,
    and bins they claim.

    Returns their number, the background and the noise. Peaks keep ``limits[0]`` from each other.
    They are taken from the highest down, until not even bins all as bright as the next one says
    could count: because of the noise, or beside the strongest return. The response is still that to
    peak and background together.

    Background and noise are those of the bins that no peak claims. Peaks claim their surroundings
    from the strongest down, for as long as half of the bins stay free. `free` is equal to
    `bin_weights`, and again afterwards.

    Parameters
    ----------
    moments : three floats
        Of `sum_moments`.
    trace, times : (bins,) array
        Brightness, and seconds.
    bin_weights : (bins,) array
        1 for bins that count towards background and noise.
    matched : (bins, width + 1) array
        As for `compute_response`.
    gains : (2,) floats
        Gains of the sharp filter and of the matched one.
    windows : (bins, 4) int64 array
        See `list_windows`.
    limits : (5,) floats
        See `find_returns`.
    maxima : (bins,) float32 array
        Local maxima of the score; used up.
    free : (bins,) array
    peaks : (returns, 4) array
        Overwritten.

    Returns
    -------
    number : int
    background, noise : float
    """
    total, square, bins = moments
    left, number, needed, claiming = bins, 0, 0.0, True
    background, noise = compute_mean_and_deviation(total, square, left)
    while number < peaks.shape[0]:
        best = find_highest(maxima)
        brightest = gains[1] * (maxima[best] / gains[0] - background)
        if (
            maxima[best] <= 0
            or brightest <= max(limits[1] * noise, limits[4])
            or brightest * limits[3] ** 2 < needed
        ):
            break
        first, last = windows[best, 0], windows[best, 1]
        strength = compute_response(trace, matched, best)
        peaks[number, 0], peaks[number, 1], peaks[number, 2], peaks[number, 3] = (
            best,
            strength,
            first,
            last,
        )
        number += 1
        for j in range(np.uintp(windows[best, 2]), np.uintp(windows[best, 3])):
            maxima[j] = 0
        claiming = claiming and 2 * (left - (last - first)) >= bins
        if claiming:
            for i in range(np.uintp(first), np.uintp(last)):
                value = free[i] * float(trace[i])
                total, square, left = total - value, square - value * trace[i], left - free[i]
                free[i] = 0
            background, noise = compute_mean_and_deviation(total, square, left)
        needed = max(
            needed,
            PREFIT_THRESHOLD_FACTOR
            * limits[2]
            * (strength - background * matched[best, -1])
            * times[best] ** 2,
        )
    for k in range(number):
        for i in range(int(peaks[k, 2]), int(peaks[k, 3])):
            free[i] = bin_weights[i]
    sort_rows(peaks[:number])
    return number, background, noise


@vectorised_part
def copy_local_maxima(score, least, factor, level, maxima):
    """Copy the inner local maxima above zero that may be of interest, and zero for all other
    scores; of a level top the last bin.

    Parameters
    ----------
    score : (bins,) float32 array
    least : (bins,) float32 array
        Scores of interest exceed ``factor * least + level``.
    factor, level : float
    maxima : (bins,) float32 array
        Overwritten.
    """
    zero, factor, level = np.float32(0), np.float32(factor), np.float32(level)
    maxima[0] = maxima[score.size - 1] = zero
    before, here, after, kept = score[:-2], score[1:-1], score[2:], maxima[1 : score.size - 1]
    wanted = least[1:-1]
    for j in range(here.size):
        floor = max(factor * wanted[j] + level, zero)
        kept[j] = (
            here[j] if here[j] > floor and here[j] >= before[j] and here[j] > after[j] else zero
        )


@loop_part
def list_windows(times, scale, distance, windows):
    """List the bins that a return at each bin reaches, and those too near for another return.

    Parameters
    ----------
    times : (bins,) array
        Seconds, increasing.
    scale : (4,) array or tuple
        Of the pulse.
    distance : float
        Seconds.
    windows : (bins, 4) int64 array
        Overwritten: first bin reached and the one after the last; first bin nearer than `distance`
        and the one after the last.
    """
    for j in range(times.size):
        windows[j, 0], windows[j, 1] = find_pulse_window(times, (j, j), times[j], scale)
        first = last = j
        while first > 0 and times[j] - times[first - 1] < distance:
            first -= 1
        while last < times.size - 1 and times[last + 1] - times[j] < distance:
            last += 1
        windows[j, 2], windows[j, 3] = first, last + 1


@vectorised_part
def sum_moments(trace, bin_weights):
    """Sum, sum of squares and number of bins; float32 squares would drown a small noise on a high
    background.

    Parameters
    ----------
    trace : (bins,) float32 array
    bin_weights : (bins,) float64 array

    Returns
    -------
    three floats
    """
    total = square = bins = 0.0
    for i in range(trace.size):
        value, share = float(trace[i]), bin_weights[i]
        total += share * value
        square += share * value * value
        bins += share
    return total, square, bins


@loop_part
def compute_mean_and_deviation(total, square, bins):
    """Mean and standard deviation from sum, sum of squares and number.

    Parameters
    ----------
    total, square : float
        Sums of values and of squares.
    bins : float
        Number of values.

    Returns
    -------
    (float, float)
    """
    mean = total / bins
    # rounding may leave the difference slightly below zero
    return mean, np.sqrt(max(square / bins - mean * mean, 0.0))


@vectorised_part
def find_highest(maxima):
    """Return the last bin of the highest maximum.

    Numbers from zero up keep their order when their bits are read as whole numbers, whose maximum
    is found in vectors.

    Parameters
    ----------
    maxima : (bins,) float32 array
        Not negative.

    Returns
    -------
    int
    """
    bits = maxima.view(np.int32)
    highest = place = np.int32(0)
    for j in range(bits.size):
        highest = max(highest, bits[j])
    for j in range(bits.size):
        place = max(place, np.int32(j) if bits[j] == highest else np.int32(0))
    return place
