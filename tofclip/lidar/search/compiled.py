"""The compiled search for returns: some pixels' traces, one after another.

The steps are those of `tofclip.lidar.search`, and functions that do the same have the same names in
`tofclip.lidar.search.array_api`, where they take all pixels at once. Every function is serial and
holds no interpreter lock; `tofclip.lidar.search` shares the pixels between threads.

Each step is compiled by itself and its loops over bins stand in it, not in functions that it calls:
the compiler optimises what is called once for itself and once more in every caller.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tofclip.compiling import compile_as_part
from tofclip.lidar.detection import (
    MAX_FIT_ROUNDS,
    PREFIT_THRESHOLD_FACTOR,
)
from tofclip.lidar.pulse_fit import (
    EVEN_VARIANCE,
    measure_returns,
    refine_returns,
    sort_rows,
)
from tofclip.lidar.search.lone_fit import NOT_ALONE, search_step

WEIGHTS_PER_PASS = 4  # weights of a filter that are applied in one pass

ONE = np.uintp(1)  # a signed number beside an unsigned one would make both floats

vectorised_part = compile_as_part(fastmath=True, _nrt=False, forceinline=True)
inlined = njit(inline="always")  # into the one step that calls it


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def find_maxima(traces, bin_weights, sharp, least, gain, score, moments, maxima):
    """Filter traces with the sharp filter and find its inner local maxima that may be of interest.

    Parameters
    ----------
    traces : (n, bins) float32 array
    bin_weights : (bins,) float64 array
        For how many bins each one stands where background and noise are concerned.
    sharp : (width, bins) float32 array
        Entry w holds the weight of bin ``j + w - width // 2`` for a return at bin j; the width is a
        multiple of `WEIGHTS_PER_PASS`.
    least : (bins,) float32 array
        By how much scores of interest exceed that of the background.
    gain : float
        Of the filter, for the background's score; 0 where nothing is known of what is of interest.
    score : (bins,) float32 array
        Overwritten.
    moments : (n, 3) array
        Overwritten: sum, sum of squares and number of bins; float32 squares would drown a small
        noise on a high background.
    maxima : (n, bins) float32 array
        Overwritten: the score there, and zero elsewhere; of a level top the last bin.
    """
    width, bins = sharp.shape
    half, end = np.uintp(width // 2), np.uintp(bins)
    last = end - half + ONE if bins + 1 > 2 * (width // 2) else half
    edges = np.uintp(min(width - 1, bins))
    for place in range(traces.shape[0]):
        trace, found = traces[place], maxima[place]
        total = square = number = 0.0
        for i in range(bins):
            value, share = float(trace[i]), bin_weights[i]
            total += share * value
            square += share * value * value
            number += share
        moments[place, 0] = total
        moments[place, 1] = square
        moments[place, 2] = number
        for j in range(bins):
            score[j] = np.float32(0)
        # unsigned, as the compiler would ask of any other number whether it counts from the end
        for w in range(np.uintp(0), np.uintp(width), np.uintp(WEIGHTS_PER_PASS)):
            one, two, three, four = sharp[w], sharp[w + 1], sharp[w + 2], sharp[w + 3]
            for j in range(half, last):
                there = j + w - half
                score[j] += (
                    one[j] * trace[there]
                    + two[j] * trace[there + ONE]
                    + three[j] * trace[there + np.uintp(2)]
                    + four[j] * trace[there + np.uintp(3)]
                )
        for edge in range(edges):
            k = edge if edge < half else end - edges + edge
            start = half - k if k < half else np.uintp(0)
            for w in range(start, min(np.uintp(width), end + half - k)):
                score[k] += sharp[w, k] * trace[k + w - half]
        level = np.float32(gain * total / number)
        found[0] = found[bins - 1] = np.float32(0)
        for j in range(ONE, end - ONE):
            here = score[j]
            wanted = (here > least[j] + level) & (here > np.float32(0))
            highest = (here >= score[j - ONE]) & (here > score[j + ONE])
            found[j] = here if wanted & highest else np.float32(0)


@search_step
def find_strongest_peaks(
    traces,
    times,
    bin_weights,
    matched,
    gains,
    windows,
    limits,
    maxima,
    bits,
    moments,
    free,
    peaks,
):
    """List the highest maxima that might count, in the order of time.

    Peaks are taken from the highest down, until not even bins all as bright as the next one says
    could count: because of the noise, or beside the strongest return. The response is still that to
    peak and background together.

    Background and noise are those of the bins that no peak claims. Peaks claim their surroundings
    from the strongest down, for as long as half of the bins stay free.

    Parameters
    ----------
    traces : (n, bins) float32 array
    times : (bins,) array
        Seconds, increasing.
    bin_weights : (bins,) float32 array
        For how many bins each one stands where background and noise are concerned.
    matched : (bins, width + 1) float32 array
        As for `compute_response`.
    gains : (2,) floats
        Of the sharp filter and of the matched one: largest sums.
    windows : (bins, 4) int64 array
        See `tofclip.lidar.search.windows.list_windows`.
    limits : (5,) floats
        Reach of two pulses, s, smallest signal-to-noise, smallest fraction of the
        strongest return, with the fall-off with range undone, the last instant at which a return
        may lie, s, and the lowest of `least`.
    maxima : (n, bins) float32 array
        Of `find_maxima`; used up.
    bits : (n, bins) int32 array
        The same memory; see `find_highest`.
    moments : (n, 3) array
        Of `find_maxima`; overwritten with background, noise and number of peaks.
    free : (bins,) float32 array
        Equal to `bin_weights`, and again afterwards.
    peaks : (n, returns, 4) array
        Overwritten: bin, response, and bins that the peak claims: the first and the one after the
        last.
    """
    most, sums = peaks.shape[1], matched.shape[1] - 1
    for place in range(traces.shape[0]):
        trace, heights, own = traces[place], maxima[place], peaks[place]
        total, square, bins = moments[place, 0], moments[place, 1], moments[place, 2]
        left, number, best, needed, claiming = bins, 0, 0, 0.0, True
        while True:
            background = total / left
            # rounding may leave the difference slightly below zero
            noise = math.sqrt(max(square / left - background * background, 0.0))
            if number > 0:
                above = own[number - 1, 1] - background * matched[best, sums]
                # light falls with the square of the range: strengths count as if all stood at one
                share = PREFIT_THRESHOLD_FACTOR * limits[2] * above * times[best] * times[best]
                needed = share if share > needed else needed
            best = find_highest(bits[place])
            brightest = gains[1] * (heights[best] / gains[0] - background)
            least_bright = limits[1] * noise if limits[1] * noise > limits[4] else limits[4]
            dim = heights[best] <= 0 or brightest <= least_bright
            if number == most or dim or brightest * limits[3] * limits[3] < needed:
                break
            first, last = windows[best, 0], windows[best, 1]
            own[number, 0] = best
            own[number, 1] = compute_response(trace, matched, best)
            own[number, 2] = first
            own[number, 3] = last
            number += 1
            for j in range(windows[best, 2], windows[best, 3]):
                heights[j] = np.float32(0)
            claiming = claiming and 2 * (left - (last - first)) >= bins
            if claiming:
                for i in range(np.uintp(first), np.uintp(last)):
                    value = free[i] * float(trace[i])
                    total -= value
                    square -= value * trace[i]
                    left -= free[i]
                    free[i] = np.float32(0)
        for k in range(number):
            for i in range(int(own[k, 2]), int(own[k, 3])):
                free[i] = bin_weights[i]
        sort_rows(own, number)
        moments[place, 0] = background
        moments[place, 1] = noise
        moments[place, 2] = number


@inlined
def find_highest(bits):
    """Return the last bin of the highest maximum.

    Parameters
    ----------
    bits : (bins,) int32 array
        Of float32 numbers from zero up, which keep their order when their bits are read as whole
        numbers; the maximum of those is found in vectors.

    Returns
    -------
    int
    """
    highest = latest = np.int32(0)
    for i in range(bits.size):
        highest = bits[i] if bits[i] > highest else highest
    for i in range(bits.size):
        here = np.int32(i) if bits[i] == highest else np.int32(0)
        latest = here if here > latest else latest
    return np.int64(latest)


@search_step
def confirm_peaks(traces, times, matched, limits, least, moments, peaks, estimates):
    """Keep the peaks that the matched filter confirms, and place them below a bin.

    Parameters
    ----------
    traces, times, matched, limits
        As for `find_strongest_peaks`.
    least : (bins,) float32 array
        Response that a return at each bin must exceed to be of interest; weaker peaks are kept only
        where such a return overlaps them. 0 where nothing is known.
    moments : (n, 3) array
        Background, noise and number of peaks; the number of those kept takes the last one's place.
    peaks : (n, returns, 4) array
        Of `find_strongest_peaks`; the response to the background is taken off.
    estimates : (n, returns, 5) array
        Overwritten with first guesses: arrival and height, first bin and the bin after the last one
        that the pulse reaches, bin of the peak.
    """
    for place in range(traces.shape[0]):
        trace, own, guesses = traces[place], peaks[place], estimates[place]
        background, noise, number = moments[place, 0], moments[place, 1], int(moments[place, 2])
        needed, kept = 0.0, 0
        for k in range(number):
            best = int(own[k, 0])
            above = own[k, 1] - background * matched[best, matched.shape[1] - 1]
            own[k, 1] = above if above > 0 else 0.0
            share = PREFIT_THRESHOLD_FACTOR * limits[2] * own[k, 1] * times[best] * times[best]
            needed = share if share > needed else needed
        for k in range(number):
            best, strength = int(own[k, 0]), own[k, 1]
            if strength <= limits[1] * noise or strength * times[best] * times[best] < needed:
                continue
            wanted = False
            for other in range(number):
                j = int(own[other, 0])
                near = math.fabs(times[j] - times[best]) <= limits[0]
                wanted = wanted or (near and own[other, 1] >= least[j])
            if wanted:
                guess, height = guesses[kept], trace[best] - background
                guess[0] = interpolate_peak_time(trace, times, matched, background, best, strength)
                guess[1] = height if height > 0 else 0.0
                guess[2] = own[k, 2]
                guess[3] = own[k, 3]
                guess[4] = best
                kept += 1
        moments[place, 2] = kept


@vectorised_part
def compute_response(trace, matched, j):
    """Response of the matched filter at bin j.

    Parameters
    ----------
    trace : (bins,) float32 array
    matched : (bins, width + 1) array
        A filter for each bin, of unit energy and nowhere negative; its sum is the last entry.
    j : int
        Bin.

    Returns
    -------
    float
    """
    width = matched.shape[1] - 1
    start = j - width // 2
    weights, total = matched[j], np.float32(0)
    end = min(width, trace.size - start)
    for w in range(np.uintp(-start if start < 0 else 0), np.uintp(end)):
        total += weights[w] * trace[np.uintp(start + w)]
    return float(total)


@inlined
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
    sums = matched.shape[1] - 1
    before = compute_response(trace, matched, j - 1) - background * matched[j - 1, sums]
    after = compute_response(trace, matched, j + 1) - background * matched[j + 1, sums]
    if before <= 0 or after <= 0 or here < before or here < after:
        return times[j]
    # ln(a / b) = 2 artanh((a - b) / (a + b)), by the first terms of its series: 2e-5 off where the
    # next bin has 0.6 of the response, as of most pulses; the fit only begins there
    rise, fall = (here - before) / (here + before), (here - after) / (here + after)
    rise *= 1 + rise * rise * (1 / 3 + rise * rise / 5)
    fall *= 1 + fall * fall * (1 / 3 + fall * fall / 5)
    share = (rise - fall) / (2 * (rise + fall)) if rise + fall > 0 else 0.0
    return times[j] + share * (times[j + 1] - times[j - 1]) / 2


@search_step
def fit_crowded_returns(
    traces, pixels, times, moments, least, estimates, pulse, profile, found, counts
):
    """Fit and measure the returns of the traces in which one does not stand alone.

    Parameters
    ----------
    traces, pixels, times, moments, least, estimates
        As for `tofclip.lidar.search.lone_fit.list_lone_returns`.
    pulse : (curve, scale)
        See `tofclip.lidar.pulse_fit`.
    profile : (bins, 3) array
        Overwritten.
    found : (all pixels, most returns, 3) array
        Overwritten where `counts` is `NOT_ALONE`: instant, s, sum of the fitted pulse over the
        bins, standard deviation of the instant, s; nearest first.
    counts : (all pixels,) int64 array
        Number of returns of each pixel.
    """
    curve, scale = pulse
    for place in range(traces.shape[0]):
        pixel = pixels[place]
        if counts[pixel] != NOT_ALONE:
            continue
        trace, background, noise = traces[place], moments[place, 0], moments[place, 1]
        estimate = estimates[place, : int(moments[place, 2])]
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
