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
NEEDS_EXACT_FIT = -1
"""In place of the number of returns of a trace."""

CANDIDATE_COLUMNS = 8  # a line of the processor's cache
"""What is known of a candidate: by how many bins it arrives after the bin of its peak, height, by
how many bins it moved last, noise of its trace, bin of its peak, and its trace's place among those
searched together; and the first of these again, as it was before any fit."""


@search_step
def find_candidates(
    traces,
    pixels,
    times,
    bin_weights,
    sharp,
    runs,
    edges,
    words,
    of_interest,
    least,
    matched,
    starts,
    sums,
    gains,
    windows,
    limits,
    even,
    half,
    score,
    places,
    maxima,
    free,
    peaks,
    moments,
    candidates,
    rests,
    counts,
    lone,
    crowded,
):
    """List the peaks of some traces that the matched filter confirms, and cut out the bins around.

    Peaks of a trace are taken as `take_strongest_peaks` says, judged as `confirm_peaks` says, and
    cut out as far as the table of the pulse reaches, while the trace is at hand.

    Parameters
    ----------
    traces : (n, bins) float32 array
        With memory for another trace after the last one.
    pixels : (n,) int64 array
        Number of the pixel to which each trace belongs.
    times : (bins,) array
        Seconds, increasing.
    bin_weights : (bins,) float32 array
        For how many bins each one stands where background and noise are concerned.
    sharp : (width, bins) float32 array
        Entry w holds the weight of bin ``j + w - width // 2`` for a return at bin j.
    runs, edges : (some,) int64 arrays
        First bins of the vectors, an even number of them, and single bins, in which that filter is
        applied.
    words : (some,) int64 array
        First bins of the words in which maxima are sought.
    of_interest : (bins + WORD_BINS,) float32 array
        By how much scores of interest exceed that of the background.
    least : (bins,) float32 array
        Response that a return at each bin must exceed to be of interest; weaker peaks are kept only
        where such a return overlaps them. 0 where nothing is known.
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
    even : (bins,) bool array
        See `tofclip.lidar.search.phase_table.PhaseTable.find_even_bins`.
    half : int
        See `PhaseTable`.
    score : (1 + bins + WORD_BINS + 1,) float32 array
        Zero where the sharp filter is not applied; overwritten elsewhere. One bin late.
    places : (2, bins) int32 array
        Overwritten.
    maxima : (2, bins) float32 array
        Overwritten.
    free : (bins,) float32 array
        As `bin_weights`, before and afterwards.
    peaks : (returns, 2) array
        Overwritten.
    moments : (n, 2) array
        Overwritten: background and noise.
    candidates : (n * returns, CANDIDATE_COLUMNS) array
        Overwritten; those of one trace side by side, in the order of time.
    rests : (n * returns, width) float32 array
        Overwritten: trace less background in the bins of the table around each peak; zero in those
        that fill up its width.
    counts : (all pixels,) int64 array
        Overwritten where `pixels` says: 0, or `NEEDS_EXACT_FIT` where a candidate's bins are not all
        there.
    lone, crowded : (n * returns,) int64 array
        Overwritten: numbers of candidates.

    Returns
    -------
    int, int, int
        How many candidates there are, and how many of them stand alone and do not.
    """
    listed = alone = others = 0
    all_bins = np.float32(0)
    for i in range(np.uintp(0), np.uintp(traces.shape[1])):
        all_bins += bin_weights[i]
    for place in range(traces.shape[0]):
        trace, first = traces[place], listed
        centre, sum_left, square_left = sum_about(trace, bin_weights)
        apply_filter(trace, sharp, runs, edges, score)
        level = np.float32(gains[2]) * (centre + np.float32(sum_left) / all_bins)
        number = list_maxima(score, of_interest, words, level, places, maxima[0])
        background, noise, number = take_strongest_peaks(
            trace,
            times,
            bin_weights,
            matched,
            starts,
            sums,
            gains,
            windows,
            limits,
            (centre, all_bins, sum_left, square_left),
            number,
            places,
            maxima,
            free,
            peaks,
        )
        moments[place, 0] = background
        moments[place, 1] = noise
        listed = confirm_peaks(
            trace,
            times,
            matched,
            starts,
            sums,
            limits,
            least,
            (background, noise, place),
            peaks[:number],
            candidates,
            first,
        )
        counts[pixels[place]] = 0
        for k in range(first, listed):
            j = int(candidates[k, PEAK_BIN])
            if not even[j]:
                counts[pixels[place]] = NEEDS_EXACT_FIT
                continue
            cut_out(trace, background, j - half, 2 * half + 1, rests[k])
            # light that ends before the other's begins, whatever both of them move
            near = k > 0 and is_near(candidates, k - 1, k, half)
            if near or (k + 1 < listed and is_near(candidates, k, k + 1, half)):
                crowded[others] = k
                others += 1
            else:
                lone[alone] = k
                alone += 1
    return listed, alone, others


@inlined
def cut_out(trace, background, start, held, rest):
    """Cut bins out of a trace, less its background.

    Parameters
    ----------
    trace : (bins,) float32 array
        With memory behind its last bin.
    background : float
    start, held : int
        First bin, and how many.
    rest : (width,) float32 array
        Overwritten, behind those bins with zero.
    """
    zero, level, lanes = (
        fill_vector(np.float32(0)),
        fill_vector(np.float32(background)),
        number_lanes(),
    )
    for w in range(np.uintp(0), np.uintp(rest.size), STEP):
        inside = fill_vector(np.int32(held - np.int64(w))) > lanes
        above = load_vector(trace, np.uintp(start) + w) - level
        store_vector(rest, w, choose(inside, above, zero))


@inlined
def is_near(candidates, k, other, half):
    """Whether two candidates are of the same trace and may share bins.

    Parameters
    ----------
    candidates : (n, CANDIDATE_COLUMNS) array
    k, other : int
        The later one last.
    half : int
        See `PhaseTable`.

    Returns
    -------
    bool
    """
    apart = candidates[other, PEAK_BIN] - candidates[k, PEAK_BIN]
    return candidates[other, TRACE] == candidates[k, TRACE] and apart < 2 * half + 1


@inlined
def take_strongest_peaks(
    trace,
    times,
    bin_weights,
    matched,
    starts,
    sums,
    gains,
    windows,
    limits,
    above_centre,
    listed,
    places,
    maxima,
    free,
    peaks,
):
    """Take the highest maxima of the sharp filter's response that might count, in the order of time.

    Peaks are taken from the highest down, until not even bins all as bright as the next one says
    could count: because of the noise, or beside the strongest return.

    Background and noise are those of the bins that no peak claims. Peaks claim their surroundings
    from the strongest down, for as long as half of the bins stay free.

    Parameters
    ----------
    trace : (bins,) float32 array
    times, bin_weights, matched, starts, sums, gains, windows, limits, free
        As for `find_candidates`.
    above_centre : (float32, float32, float, float)
        A brightness, number of bins, and sums over the bins of what is above it and of its square.
    listed : int
        Number of maxima.
    places : (2, bins) int32 array
        Their bins, and zeros; in place of these 1 where a peak was taken.
    maxima : (2, bins) float32 array
        Their heights; overwritten.
    peaks : (returns, 2) array
        Overwritten: bin, and response less that to the background.

    Returns
    -------
    background, noise : float
    number : int
        Of peaks.
    """
    centre, all_bins, sum_left, square_left = above_centre
    bins_left, background, variance = float(all_bins), 0.0, 0.0
    number, needed, claiming, best = 0, 0.0, True, np.uintp(0)
    low, high, response = np.int32(0), np.int32(0), np.float32(0)
    steepest, ratio = limits[1] * limits[1], gains[1] / gains[0]
    while True:
        part = 1 / bins_left
        background = sum_left * part
        # rounding may leave the difference slightly below zero
        variance = max(square_left * part - background * background, 0.0)
        background += centre
        if number > 0:
            above = response - background * sums[best]
            # light falls with the square of the range: strengths count as if all stood at one
            share = PREFIT_THRESHOLD_FACTOR * limits[2] * above * times[best] * times[best]
            needed = max(share, needed)
        height, entry = take_highest(places[0], maxima[0], listed, low, high)
        brightest = ratio * height - gains[1] * background
        dim = height <= 0 or brightest <= limits[4] or brightest * brightest <= steepest * variance
        if number == len(peaks) or dim or brightest * limits[3] * limits[3] < needed:
            break
        best = np.uintp(places[0, entry])
        response = compute_response(trace, matched[best], starts[best])
        places[1, entry] = 1
        maxima[1, entry] = response
        number += 1
        low, high = windows[best, 2], windows[best, 3]
        first, after = np.uintp(windows[best, 0]), np.uintp(windows[best, 1])
        claiming = claiming and bool(2 * (bins_left - (after - first)) >= all_bins)
        if claiming:
            taken, taken_square, taken_bins = claim_bins(trace, centre, free, first, after)
            sum_left -= taken
            square_left -= taken_square
            bins_left -= taken_bins
    number = 0
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        bits = list_set_lanes(load_vector(places[1], k) > fill_vector(np.int32(0)))
        while bits:
            entry = k + np.uintp(find_first_bit(bits))
            bits &= bits - np.uint64(1)
            best = np.uintp(places[0, entry])
            above = maxima[1, entry] - background * sums[best]
            peaks[number, 0] = best
            peaks[number, 1] = above if above > 0 else 0.0
            number += 1
            for i in range(np.uintp(windows[best, 0]), np.uintp(windows[best, 1]), STEP):
                start = min(i, np.uintp(trace.size) - STEP)
                store_vector(free, start, load_vector(bin_weights, start))
    return background, math.sqrt(variance), number


@inlined
def sum_about(trace, bin_weights):
    """Sums over the bins, and of squares, of what is above a brightness that is usual there.

    Parameters
    ----------
    trace, bin_weights : (bins,) float32 array

    Returns
    -------
    float32, float, float
        That brightness, and the sums: float32 squares about zero would drown a small noise on a high
        background.
    """
    # what the first bins have
    weights, other = load_vector(bin_weights, np.uintp(0)), load_vector(bin_weights, STEP)
    total = weights * load_vector(trace, np.uintp(0)) + other * load_vector(trace, STEP)
    centre = sum_vector(total) / sum_vector(weights + other)
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
    return centre, float(sum_vector(total + totals)), float(sum_vector(square + squares))


@inlined
def apply_filter(trace, sharp, runs, edges, score):
    """Filter a trace where `runs` and `edges` say.

    Parameters
    ----------
    trace, sharp, runs, edges, score
        As for `find_candidates`.
    """
    width = np.uintp(sharp.shape[0])
    half = width // np.uintp(2)
    for r in range(0, runs.size, 2):
        j, i, zero = np.uintp(runs[r]), np.uintp(runs[r + 1]), fill_vector(np.float32(0))
        responses = others = zero
        for w in range(width):
            responses += load_vector(sharp[w], j) * load_vector(trace, j + w - half)
            others += load_vector(sharp[w], i) * load_vector(trace, i + w - half)
        store_vector(score, j + ONE, responses)
        store_vector(score, i + ONE, others)
    for e in range(edges.size):
        j, here = np.uintp(edges[e]), np.float32(0)
        for w in range(width):
            i = j + w - half  # below zero it is beyond all bins
            here += sharp[w, j] * trace[i] if i < np.uintp(trace.size) else np.float32(0)
        score[j + ONE] = here


@inlined
def take_highest(bins, heights, listed, low, high):
    """Return height and place of the highest maximum, without those from bin `low` to before `high`.

    Parameters
    ----------
    bins : (n,) int32 array
        Of the maxima.
    heights : (n,) float32 array
        Those left out are zero from now on.
    listed : int
    low, high : int32

    Returns
    -------
    float32, int
        The last one's where several are equally high.
    """
    height, entry, zero = np.float32(0), np.uintp(0), fill_vector(np.float32(0))
    first, after = fill_vector(low), fill_vector(high)
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        where = load_vector(bins, k)
        left = choose((where >= first) & (after > where), zero, load_vector(heights, k))
        store_vector(heights, k, left)
        top = find_highest_lane(left)
        if top >= height:
            entry = k + np.uintp(find_last_bit(list_set_lanes(left >= fill_vector(top))))
            height = top
    return height, entry


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
def list_maxima(score, of_interest, words, level, places, heights):
    """List bin and height of the local maxima of interest, in the order of time; return how many.

    Parameters
    ----------
    score, of_interest, words
        As for `find_candidates`. Of a level top the last bin counts.
    places : (2, bins) int32 array
        Overwritten: bins of the maxima, and zeros.
    heights : (bins,) float32 array
        Overwritten: their scores, with zeros behind the last one.
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
            places[0, listed] = at
            heights[listed] = score[at + ONE]
            listed += 1
    store_vector(heights, np.uintp(listed), zero)  # what fills up the last vector
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        store_vector(places[1], k, fill_vector(np.int32(0)))
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


@inlined
def confirm_peaks(
    trace, times, matched, starts, sums, limits, least, known, peaks, candidates, listed
):
    """List the peaks of a trace that the matched filter confirms, placed below a bin.

    Parameters
    ----------
    trace : (bins,) float32 array
    times, matched, starts, sums, limits, least
        As for `find_candidates`.
    known : (float, float, int)
        Background and noise, and place of the trace among those searched together.
    peaks : (n, 2) array
        Of `take_strongest_peaks`.
    candidates : (room, CANDIDATE_COLUMNS) array
        Overwritten from `listed` on.
    listed : int
        How many there are.

    Returns
    -------
    int
        How many there are now.
    """
    background, noise, place = known
    needed = 0.0
    for k in range(len(peaks)):
        best = np.uintp(peaks[k, 0])
        share = PREFIT_THRESHOLD_FACTOR * limits[2] * peaks[k, 1] * times[best] * times[best]
        needed = share if share > needed else needed
    for k in range(len(peaks)):
        best, strength = np.uintp(peaks[k, 0]), peaks[k, 1]
        if strength <= limits[1] * noise or strength * times[best] * times[best] < needed:
            continue
        if not is_wanted(times, limits[0], least, peaks, k):
            continue
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
def is_wanted(times, reach, least, peaks, k):
    """Whether a return of interest lies at a peak, or overlaps it.

    Parameters
    ----------
    times, least
        As for `find_candidates`.
    reach : float
        Of two pulses, s.
    peaks : (n, 2) array
        Of `take_strongest_peaks`.
    k : int

    Returns
    -------
    bool
    """
    best = np.uintp(peaks[k, 0])
    wanted = peaks[k, 1] >= least[best]
    if not wanted:
        for other in range(len(peaks)):
            j = np.uintp(peaks[other, 0])
            near = math.fabs(times[j] - times[best]) <= reach
            wanted = wanted or (near and peaks[other, 1] >= least[j])
    return wanted


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
