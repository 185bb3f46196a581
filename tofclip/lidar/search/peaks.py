"""Peaks of a trace, by the sharp filter: the parts of `tofclip.lidar.search.candidates`.

Loops over bins take a vector of them at a time (`tofclip.vectors`): axes are a whole number of
vectors long (`tofclip.lidar.search.trace_search`).
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, SUMS_IN_ANY_ORDER, compile_as_part, compile_loop, inlined
from tofclip.lidar.detection import PREFIT_THRESHOLD_FACTOR
from tofclip.vectors import (
    LENGTH,
    STEP,
    choose,
    count_set_lanes,
    fill_vector,
    find_first_bit,
    find_highest_lane,
    list_set_lanes,
    load_vector,
    number_lanes,
    store_vector,
    sum_vector,
)

search_step = compile_loop(fastmath=SUMS_IN_ANY_ORDER)
search_part = compile_as_part(fastmath=SUMS_IN_ANY_ORDER, _nrt=False)

VECTORS_PER_WORD = 2
WORD_BINS = VECTORS_PER_WORD * LENGTH
"""Bins whose maxima are listed together, a bit for each."""


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
    responses,
    free,
    peaks,
):
    """Take the highest maxima of the sharp filter's response that might count, in the order of time.

    Peaks are taken from the highest down, until not even bins all as bright as the next one says
    could count: because of the noise, or beside the strongest return.

    Background and noise are those of the bins that no peak claims. Peaks claim their surroundings
    from the strongest down, for as long as half of the bins stay free.

    `trace` (bins,); `times, bin_weights, matched, starts, sums, gains, windows, limits, free`: as
    for `tofclip.lidar.search.candidates.find_candidates`; `above_centre` (float32, float32, float,
    float): A brightness, number of bins, and sums over the bins of what is above it and of its
    square; `listed`: number of maxima; `places` (4, bins): of `list_maxima`; where a peak is taken
    its zero becomes 1; `responses` (bins,): overwritten at these: response of the matched filter;
    `peaks` (returns, 2): overwritten: bin, and response less that to the background. Returns
    `number`: of peaks.
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
        height, entry = take_highest(places[0], places[1], listed, low, high)
        brightest = ratio * height - gains[1] * background
        dim = height <= 0 or brightest <= limits[4] or brightest * brightest <= steepest * variance
        if number == len(peaks) or dim or brightest * limits[3] * limits[3] < needed:
            break
        best = np.uintp(places[0, entry])
        response = compute_response(trace, matched[best], starts[best])
        places[2, entry] = 1
        responses[entry] = response
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
        bits = list_set_lanes(load_vector(places[2], k) > fill_vector(np.int32(0)))
        while bits:
            entry = k + np.uintp(find_first_bit(bits))
            bits &= bits - np.uint64(1)
            best = np.uintp(places[0, entry])
            above = responses[entry] - background * sums[best]
            peaks[number, 0] = best
            peaks[number, 1] = above if above > 0 else 0.0
            number += 1
            for i in range(np.uintp(windows[best, 0]), np.uintp(windows[best, 1]), STEP):
                start = min(i, np.uintp(trace.size) - STEP)
                store_vector(free, start, load_vector(bin_weights, start))
    return background, math.sqrt(variance), number


@search_part
def sum_about(trace, bin_weights):
    """Sums over the bins, and of squares, of what is above a brightness that is usual there.

    `trace, bin_weights` (bins,). Returns that brightness, and the sums: float32 squares about zero
    would drown a small noise on a high background.
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


@search_part
def apply_filter(trace, sharp, runs, edges, score):
    """Filter a trace where `runs` and `edges` say.

    `trace, sharp, runs, edges, score`: as for `tofclip.lidar.search.candidates.find_candidates`.
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
def make_key(height, entry):
    """A whole number that is the larger the higher a maximum, to 2e-6 of it, and holds its lane.

    `height`: above zero: such numbers are in the order of their bits; `entry`: place in the list.
    """
    lane = np.int32(entry) & (LENGTH - 1)
    return np.int32((np.float32(height).view(np.int32) & -LENGTH) | lane)


@inlined
def take_highest(bins, keys, listed, low, high):
    """Return height and place of the highest maximum, without those from bin `low` to before `high`.

    Every peak waits for the one before it, so that what counts is how soon it is found.

    `bins` (n,): of the maxima; `keys` (n,): of `make_key`; those left out are zero from now on.
    Returns height, or 0 where none is left; and place.
    """
    highest, entry, zero = np.int32(0), np.uintp(0), fill_vector(np.int32(0))
    first, after = fill_vector(low), fill_vector(high)
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        where = load_vector(bins, k)
        left = choose((where >= first) & (after > where), zero, load_vector(keys, k))
        store_vector(keys, k, left)
        top = find_highest_lane(left)
        if top > highest:
            entry = k + np.uintp(top & (LENGTH - 1))
            highest = top
    return np.int32(highest & -LENGTH).view(np.float32), entry


@search_part
def claim_bins(trace, centre, free, first, after):
    """Take the bins from `first` to before `after`, as far as they are free.

    `trace` (bins,); `free` (bins,): for how many bins each one stands that nothing claims yet;
    overwritten. Returns sums over them of what is above `centre`, of its square, and their number.
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

    `trace, bin_weights` (bins,).
    """
    total = others = fill_vector(np.float32(0))
    for first in range(np.uintp(0), np.uintp(trace.size), STEP + STEP):
        total += load_vector(bin_weights, first) * load_vector(trace, first)
        others += load_vector(bin_weights, first + STEP) * load_vector(trace, first + STEP)
    return sum_vector(total + others)


@search_part
def list_maxima(score, of_interest, words, level, places):
    """List bin and height of the local maxima of interest, in the order of time; return how many.

    `score, of_interest, words`: as for `tofclip.lidar.search.candidates.find_candidates`. Of a
    level top the last bin counts; `places` (4, bins): overwritten: bins of the maxima, keys of
    their scores (`make_key`) with zeros behind the last one, zeros, and what is only needed
    meanwhile; `level`: score of the background.
    """
    zero, background, filled, listed = fill_vector(np.float32(0)), fill_vector(level), 0, 0
    for word in range(np.uintp(0), np.uintp(words.size)):
        begin, bits = np.uintp(words[word]), np.uint64(0)
        for vector in range(VECTORS_PER_WORD):
            j = begin + np.uintp(LENGTH * vector)
            here = load_vector(score, j + ONE)
            wanted = (here > load_vector(of_interest, j) + background) & (here > zero)
            highest = (here >= load_vector(score, j)) & (here > load_vector(score, j + ONE + ONE))
            found = wanted & highest
            bits |= list_set_lanes(found) << np.uint64(LENGTH * vector)
            listed += count_set_lanes(found)
        places[2, filled] = np.int32(bits)  # all 32 of them
        places[3, filled] = begin
        filled += 1 if bits > np.uint64(0) else 0
    # One loop over the maxima of all words: a processor guesses only once where it ends.
    word, bits = 0, np.uint64(np.uint32(places[2, 0]))
    for entry in range(np.uintp(0), np.uintp(listed)):
        at = np.uintp(places[3, word]) + np.uintp(find_first_bit(bits))
        places[0, entry] = at
        places[1, entry] = make_key(score[at + ONE], entry)
        bits &= bits - np.uint64(1)
        word += 1 if bits == np.uint64(0) else 0
        following = np.uint64(np.uint32(places[2, word]))
        bits = following if bits == np.uint64(0) else bits
    none = fill_vector(np.int32(0))
    store_vector(places[1], np.uintp(listed), none)  # what fills up the last vector
    for k in range(np.uintp(0), np.uintp(listed), STEP):
        store_vector(places[2], k, none)
    return listed


@search_part
def compute_response(trace, weights, start):
    """Response of a filter whose first weight is for bin `start`.

    `trace` (bins,); `weights` (width,): of the matched filter.
    """
    total = fill_vector(np.float32(0))
    for w in range(np.uintp(0), np.uintp(weights.size), STEP):
        total += load_vector(weights, w) * load_vector(trace, np.uintp(start) + w)
    return sum_vector(total)
