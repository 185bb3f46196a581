"""The compiled search for peaks: some pixels' traces, one after another.

The steps are those of `tofclip.lidar.search`. Every function is serial and holds no interpreter lock;
`tofclip.lidar.search` shares the pixels between threads.

All loops over bins take a vector of them at a time (`tofclip.vectors`): axes are a whole number of
vectors long (`tofclip.lidar.search.trace_search`).
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import compile_loop, inlined
from tofclip.lidar.detection import PREFIT_THRESHOLD_FACTOR
from tofclip.vectors import (
    LENGTH,
    STEP,
    choose,
    fill_vector,
    find_first_bit,
    find_highest_lane,
    find_last_bit,
    list_set_lanes,
    load_vector,
    number_lanes,
    store_vector,
    sum_vector,
)

SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
"""What sums in vectors need; unlike all of ``fastmath`` it leaves infinities and NaN what they are."""

search_step = compile_loop(fastmath=SUMS_IN_ANY_ORDER)

ONE = np.uintp(1)  # a signed number beside an unsigned one would make both floats
VECTORS_PER_WORD = 4
WORD_BINS = VECTORS_PER_WORD * LENGTH
"""Bins whose maxima are listed together, a bit for each."""

OFFSET, HEIGHT, MOVED, NOISE, PEAK_BIN, TRACE, FIRST_OFFSET = range(7)
CANDIDATE_COLUMNS = 8  # a line of the processor's cache
"""What is known of a candidate: by how many bins it arrives after the bin of its peak, height, by
how many bins it moved last, noise of its trace, bin of its peak, and its trace's place among those
searched together; and the first of these again, as it was before any fit."""


@search_step
def find_strongest_peaks(
    traces,
    times,
    bin_weights,
    sharp,
    runs,
    edges,
    words,
    of_interest,
    matched,
    starts,
    sums,
    gains,
    windows,
    limits,
    score,
    maxima,
    free,
    moments,
    peaks,
):
    """List the highest maxima of the sharp filter's response that might count, in the order of time.

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
    sharp : (width, bins) float32 array
        Entry w holds the weight of bin ``j + w - width // 2`` for a return at bin j.
    runs, edges : (some,) int64 arrays
        First bins of the vectors, and single bins, in which that filter is applied.
    words : (some,) int64 array
        First bins of the words in which maxima are sought.
    of_interest : (bins + WORD_BINS,) float32 array
        By how much scores of interest exceed that of the background.
    matched : (bins, width) float32 array
        A filter for each bin, of unit energy and nowhere negative.
    starts : (bins,) int64 array
        First bin that each of them takes.
    sums : (bins,) array
        Over each of them.
    gains : (3,) floats
        Of the sharp filter and of the matched one: largest sums; and the first again for the
        background's score, or 0 where nothing is known of what is of interest.
    windows : (bins, 4) int64 array
        See `tofclip.lidar.search.windows.list_windows`.
    limits : (5,) floats
        Reach of two pulses, s, smallest signal-to-noise, smallest fraction of the
        strongest return, with the fall-off with range undone, the last instant at which a return
        may lie, s, and the lowest response of interest.
    score : (1 + bins + WORD_BINS + 1,) float32 array
        Zero where the sharp filter is not applied; overwritten elsewhere. One bin late.
    maxima : (2, bins) float32 array
        Overwritten: bin and score of the maxima, with zeros behind the last one.
    free : (bins,) float32 array
        Overwritten.
    moments : (n, 3) array
        Overwritten: background, noise and number of peaks.
    peaks : (n, returns, 2) array
        Overwritten: bin and response.
    """
    bins, all_bins = np.uintp(traces.shape[1]), np.float32(0)
    for i in range(bins):
        all_bins += bin_weights[i]
    for place in range(traces.shape[0]):
        trace, own = traces[place], peaks[place]
        # about the mean: float32 squares would drown a small noise on a high background
        centre = sum_weighted(trace, bin_weights) / all_bins
        sum_left, square_left = sum_about(trace, bin_weights, centre)
        bins_left = float(all_bins)
        apply_filter(trace, sharp, runs, edges, score)
        listed = list_maxima(score, of_interest, words, np.float32(gains[2]) * centre, maxima)
        for i in range(np.uintp(0), bins, STEP):
            store_vector(free, i, load_vector(bin_weights, i))
        number, needed, claiming, best = 0, 0.0, True, np.uintp(0)
        low = high = response = np.float32(0)
        while True:
            background = sum_left / bins_left
            # rounding may leave the difference slightly below zero
            noise = math.sqrt(max(square_left / bins_left - background * background, 0.0))
            background += centre
            if number > 0:
                above = response - background * sums[best]
                # light falls with the square of the range: strengths count as if all stood at one
                share = PREFIT_THRESHOLD_FACTOR * limits[2] * above * times[best] * times[best]
                needed = max(share, needed)
            height, at = take_highest(maxima, listed, low, high)
            brightest = gains[1] * (height / gains[0] - background)
            dim = height <= 0 or brightest <= max(limits[1] * noise, limits[4])
            if number == own.shape[0] or dim or brightest * limits[3] * limits[3] < needed:
                break
            best = np.uintp(at)
            response = compute_response(trace, matched[best], starts[best])
            insert_peak(own, number, best, response)
            number += 1
            low, high = np.float32(windows[best, 2]), np.float32(windows[best, 3])
            first, after = np.uintp(windows[best, 0]), np.uintp(windows[best, 1])
            claiming = claiming and bool(2 * (bins_left - (after - first)) >= all_bins)
            if claiming:
                taken, taken_square, taken_bins = claim_bins(trace, centre, free, first, after)
                sum_left -= taken
                square_left -= taken_square
                bins_left -= taken_bins
        moments[place, 0] = background
        moments[place, 1] = noise
        moments[place, 2] = number


@inlined
def sum_about(trace, bin_weights, centre):
    """Sums over the bins, and of squares, of what is above `centre`.

    Parameters
    ----------
    trace, bin_weights : (bins,) float32 array
    centre : float32

    Returns
    -------
    float, float
    """
    total = square = totals = squares = fill_vector(np.float32(0))
    middle = fill_vector(centre)
    # two at a time: a sum waits for the one before it
    for first in range(np.uintp(0), np.uintp(trace.size), STEP + STEP):
        above, beside = load_vector(trace, first), load_vector(trace, first + STEP)
        above -= middle
        beside -= middle
        part, other = load_vector(bin_weights, first), load_vector(bin_weights, first + STEP)
        part *= above
        other *= beside
        total += part
        totals += other
        square += part * above
        squares += other * beside
    return float(sum_vector(total + totals)), float(sum_vector(square + squares))


@inlined
def apply_filter(trace, sharp, runs, edges, score):
    """Filter a trace where `runs` and `edges` say.

    Parameters
    ----------
    trace, sharp, runs, edges, score
        As for `find_strongest_peaks`.
    """
    width = np.uintp(sharp.shape[0])
    half = width // np.uintp(2)
    for r in range(runs.size):
        j, responses = np.uintp(runs[r]), fill_vector(np.float32(0))
        for w in range(width):
            responses += load_vector(sharp[w], j) * load_vector(trace, j + w - half)
        store_vector(score, j + ONE, responses)
    for e in range(edges.size):
        j, here = np.uintp(edges[e]), np.float32(0)
        for w in range(width):
            i = j + w - half  # below zero it is beyond all bins
            here += sharp[w, j] * trace[i] if i < np.uintp(trace.size) else np.float32(0)
        score[j + ONE] = here


@inlined
def take_highest(maxima, listed, low, high):
    """Return height and bin of the highest maximum, without those from bin `low` to before `high`.

    Parameters
    ----------
    maxima
        As for `find_strongest_peaks`; those left out are zero from now on.
    listed : int
    low, high : float32

    Returns
    -------
    float32, float32
        The last one's where several are equally high.
    """
    height = at = np.float32(0)
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        where, heights = load_vector(maxima[0], k), load_vector(maxima[1], k)
        near = (where >= fill_vector(low)) & (fill_vector(high) > where)
        heights = choose(near, fill_vector(np.float32(0)), heights)
        store_vector(maxima[1], k, heights)
        top = find_highest_lane(heights)
        if top >= height:
            at = maxima[0, k + find_last_bit(list_set_lanes(heights >= fill_vector(top)))]
            height = top
    return height, at


@inlined
def insert_peak(own, number, best, response):
    """Enter a peak among those of a trace, in the order of time.

    Parameters
    ----------
    own : (returns, 2) array
    number : int
        Of peaks that are there.
    best : int
        Bin.
    response : float32
    """
    place = number
    while place > 0 and own[place - 1, 0] > best:
        own[place, 0] = own[place - 1, 0]
        own[place, 1] = own[place - 1, 1]
        place -= 1
    own[place, 0] = best
    own[place, 1] = response


@inlined
def claim_bins(trace, centre, free, first, after):
    """Take the bins from `first` to before `after`, as far as they are free.

    Parameters
    ----------
    trace : (bins,) float32 array
    centre : float32
    free : (bins,) float32 array
        For how many bins each one stands that nothing claims yet; overwritten.
    first, after : int

    Returns
    -------
    three floats
        Sums over them of what is above `centre`, of its square, and their number.
    """
    total = square = number = zero = fill_vector(np.float32(0))
    last = np.uintp(trace.size) - STEP
    for begin in range(first, after, STEP):
        start = begin if begin < last else last
        numbers = number_lanes() + fill_vector(np.int32(start))
        inside = (numbers >= fill_vector(np.int32(begin))) & (
            fill_vector(np.int32(after)) > numbers
        )
        still_free = load_vector(free, start)
        taken = choose(inside, still_free, zero)
        store_vector(free, start, still_free - taken)
        above = load_vector(trace, start) - fill_vector(centre)
        total += taken * above
        square += taken * above * above
        number += taken
    return sum_vector(total), sum_vector(square), sum_vector(number)


@inlined
def sum_weighted(trace, bin_weights):
    """Sum over the bins, each for as many as it stands for.

    Parameters
    ----------
    trace, bin_weights : (bins,) float32 array

    Returns
    -------
    float32
    """
    total = others = fill_vector(np.float32(0))
    for first in range(np.uintp(0), np.uintp(trace.size), STEP + STEP):
        total += load_vector(bin_weights, first) * load_vector(trace, first)
        others += load_vector(bin_weights, first + STEP) * load_vector(trace, first + STEP)
    return sum_vector(total + others)


@inlined
def list_maxima(score, of_interest, words, level, maxima):
    """List bin and height of the local maxima of interest, in the order of time; return how many.

    Parameters
    ----------
    score, of_interest, words, maxima
        As for `find_strongest_peaks`. Of a level top the last bin counts.
    level : float32
        Score of the background.

    Returns
    -------
    int
    """
    zero, background, listed = fill_vector(np.float32(0)), fill_vector(level), 0
    for number in range(words.size):
        begin, bits = np.uintp(words[number]), np.uint64(0)
        for vector in range(VECTORS_PER_WORD):
            j = begin + np.uintp(LENGTH * vector)
            here = load_vector(score, j + ONE)
            wanted = (here > load_vector(of_interest, j) + background) & (here > zero)
            highest = (here >= load_vector(score, j)) & (here > load_vector(score, j + ONE + ONE))
            bits |= list_set_lanes(wanted & highest) << np.uint64(LENGTH * vector)
        while bits:
            at = begin + np.uintp(find_first_bit(bits))
            bits &= bits - np.uint64(1)
            maxima[0, listed] = at
            maxima[1, listed] = score[at + ONE]
            listed += 1
    store_vector(maxima[1], np.uintp(listed), zero)  # what fills up the last vector
    return listed


@inlined
def compute_response(trace, weights, start):
    """Response of a filter whose first weight is for bin `start`.

    Parameters
    ----------
    trace : (bins,) float32 array
    weights : (width,) float32 array
        Of the matched filter.
    start : int

    Returns
    -------
    float32
    """
    total = fill_vector(np.float32(0))
    for w in range(np.uintp(0), np.uintp(weights.size), STEP):
        total += load_vector(weights, w) * load_vector(trace, np.uintp(start) + w)
    return sum_vector(total)


@search_step
def confirm_peaks(traces, times, matched, starts, sums, limits, least, moments, peaks, candidates):
    """List the peaks that the matched filter confirms, placed below a bin; return how many.

    Parameters
    ----------
    traces, times, matched, starts, sums, limits
        As for `find_strongest_peaks`.
    least : (bins,) float32 array
        Response that a return at each bin must exceed to be of interest; weaker peaks are kept only
        where such a return overlaps them. 0 where nothing is known.
    moments : (n, 3) array
        Background, noise and number of peaks.
    peaks : (n, returns, 2) array
        Of `find_strongest_peaks`; the response to the background is taken off.
    candidates : (n * returns, CANDIDATE_COLUMNS) array
        Overwritten; those of one trace side by side, in the order of time.

    Returns
    -------
    int
    """
    listed = 0
    for place in range(traces.shape[0]):
        trace, own = traces[place], peaks[place]
        background, noise, number = moments[place, 0], moments[place, 1], int(moments[place, 2])
        needed = 0.0
        for k in range(number):
            best = np.uintp(own[k, 0])
            above = own[k, 1] - background * sums[best]
            own[k, 1] = above if above > 0 else 0.0
            share = PREFIT_THRESHOLD_FACTOR * limits[2] * own[k, 1] * times[best] * times[best]
            needed = share if share > needed else needed
        for k in range(number):
            best, strength = np.uintp(own[k, 0]), own[k, 1]
            if strength <= limits[1] * noise or strength * times[best] * times[best] < needed:
                continue
            wanted = False
            for other in range(number):
                j = np.uintp(own[other, 0])
                near = math.fabs(times[j] - times[best]) <= limits[0]
                wanted = wanted or (near and own[other, 1] >= least[j])
            if wanted:
                candidate = candidates[listed]
                before = compute_response(trace, matched[best - ONE], starts[best - ONE])
                after = compute_response(trace, matched[best + ONE], starts[best + ONE])
                candidate[OFFSET] = interpolate_peak(
                    before - background * sums[best - ONE],
                    strength,
                    after - background * sums[best + ONE],
                ) * ((times[best + ONE] - times[best - ONE]) / (times[best + ONE] - times[best]))
                candidate[FIRST_OFFSET] = candidate[OFFSET]
                height = trace[best] - background
                candidate[HEIGHT] = height if height > 0 else 0.0
                candidate[MOVED] = np.inf
                candidate[NOISE] = noise
                candidate[PEAK_BIN] = best
                candidate[TRACE] = place
                listed += 1
    return listed


@inlined
def interpolate_peak(before, here, after):
    """Where between three neighbours a response is highest: by a parabola in its logarithm.

    Parameters
    ----------
    before, here, after : float
        Responses, the highest in the middle.

    Returns
    -------
    float
        After the middle, as a part of the distance between the outer two; 0 where these are not
        above zero or one of them is higher.
    """
    rise = fall = 0.0
    if before > 0 and after > 0 and here >= before and here >= after:
        # ln(a / b) = 2 artanh((a - b) / (a + b)), by the first terms of its series: 2e-5 off where
        # the next bin has 0.6 of the response, as of most pulses; the fit only begins there
        rise, fall = (here - before) / (here + before), (here - after) / (here + after)
        rise *= 1 + rise * rise * (1 / 3 + rise * rise / 5)
        fall *= 1 + fall * fall * (1 / 3 + fall * fall / 5)
    return (rise - fall) / (4 * (rise + fall)) if rise + fall > 0 else 0.0
