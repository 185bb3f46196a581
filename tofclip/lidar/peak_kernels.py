"""Peaks of a trace, by the sharp filter: the parts of `tofclip.lidar.peak_kernels`.

Loops over bins take a vector of them at a time (`tofclip.vectors`): axes are a whole number of
vectors long (`tofclip.lidar.trace_search`).

The compiled search for candidates: some pixels' traces, one after another.

The steps are those of `tofclip.lidar.search`. Every function is serial and holds no interpreter
lock; `tofclip.lidar.search` shares the pixels between threads.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, SUMS_IN_ANY_ORDER, compile_as_part, compile_loop, inlined
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

# Of the share of the strongest return that a candidate needs before the fit, which does not make up
# for more than the rest.
PREFIT_THRESHOLD_FACTOR = 0.7

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
    for `tofclip.lidar.peak_kernels.find_candidates`; `above_centre` (float32, float32, float,
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

    `trace, sharp, runs, edges, score`: as for `tofclip.lidar.peak_kernels.find_candidates`.
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

    `score, of_interest, words`: as for `tofclip.lidar.peak_kernels.find_candidates`. Of a
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


NEEDS_EXACT_FIT = -1
"""In place of the number of returns of a trace."""

OFFSET, HEIGHT, MOVED, NOISE, PEAK_BIN, TRACE, FIRST_OFFSET = range(7)
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
    responses,
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

    `traces` (n, bins): with memory for another trace after the last one; `pixels` (n,): number of
    the pixel to which each trace belongs; `times` (bins,): seconds, increasing; `bin_weights`
    (bins,): for how many bins each one stands where background and noise are concerned; `sharp`
    (width, bins): entry w holds the weight of bin ``j + w - width // 2`` for a return at bin j;
    `runs, edges` (some,): first bins of the vectors, an even number of them, and single bins, in
    which that filter is applied; `words` (some,): first bins of the words in which maxima are
    sought; `of_interest` (bins + WORD_BINS,): by how much scores of interest exceed that of the
    background; `least` (bins,): response that a return at each bin must exceed to be of interest;
    weaker peaks are kept only where such a return overlaps them. 0 where nothing is known;
    `matched` (bins, width): A filter for each bin, of unit energy and nowhere negative; `starts`
    (bins,): first bin that each of them takes; `sums` (bins,): over each of them; `gains` (3,): of
    the sharp filter and of the matched one: largest sums; and the first again for the background's
    score, or 0 where nothing is known of what is of interest; `windows` (bins, 4): see
    `tofclip.lidar.pulse_tables.list_windows`; `limits` (5,): reach of two pulses, s, smallest
    signal-to-noise, smallest fraction of the strongest return, with the fall-off with range undone,
    the last instant at which a return may lie, s, and the lowest response of interest; `even`
    (bins,): see `tofclip.lidar.pulse_tables.PhaseTable.find_even_bins`; `half`: see
    `PhaseTable`; `score` (1 + bins + WORD_BINS + 1,): zero where the sharp filter is not applied;
    overwritten elsewhere. One bin late; `places` (4, bins): overwritten; `responses` (bins,):
    overwritten; `free` (bins,): as `bin_weights`, before and afterwards; `peaks` (returns, 2):
    overwritten; `moments` (n, 2): overwritten: background and noise; `candidates` (n * returns,
    CANDIDATE_COLUMNS): overwritten; those of one trace side by side, in the order of time; `rests`
    (n * returns, width): overwritten: trace less background in the bins of the table around each
    peak; zero in those that fill up its width; `counts` (all pixels,): overwritten where `pixels`
    says: 0, or `NEEDS_EXACT_FIT` where a candidate's bins are not all there; `lone, crowded` (n *
    returns,): overwritten: numbers of candidates. Returns how many candidates there are, and how
    many of them stand alone and do not.
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
        number = list_maxima(score, of_interest, words, level, places)
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
            responses,
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

    `trace` (bins,): with memory behind its last bin; `start, held`: first bin, and how many; `rest`
    (width,): overwritten, behind those bins with zero.
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

    `candidates` (n, CANDIDATE_COLUMNS); `k, other`: the later one last; `half`: see `PhaseTable`.
    """
    apart = candidates[other, PEAK_BIN] - candidates[k, PEAK_BIN]
    return candidates[other, TRACE] == candidates[k, TRACE] and apart < 2 * half + 1


@inlined
def confirm_peaks(
    trace, times, matched, starts, sums, limits, least, known, peaks, candidates, listed
):
    """List the peaks of a trace that the matched filter confirms, placed below a bin.

    `trace` (bins,); `times, matched, starts, sums, limits, least`: as for `find_candidates`;
    `known`: background and noise, and place of the trace among those searched together; `peaks` (n,
    2): of `take_strongest_peaks`; `candidates` (room, CANDIDATE_COLUMNS): overwritten from `listed`
    on; `listed`: how many there are. Returns how many there are now.
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

    `times, least`: as for `find_candidates`; `reach`: of two pulses, s; `peaks` (n, 2): of
    `take_strongest_peaks`.
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

    `before, here, after`: responses, the highest in the middle. Returns after the middle, as a part
    of the distance between the outer two; 0 where these are not above zero or one of them is
    higher.
    """
    rise = fall = 0.0
    if before > 0 and after > 0 and here >= before and here >= after:
        # ln(a / b) = 2 artanh((a - b) / (a + b)), by the first terms of its series: 2e-5 off where
        # the next bin has 0.6 of the response, as of most pulses; the fit only begins there
        rise, fall = (here - before) / (here + before), (here - after) / (here + after)
        rise *= 1 + rise * rise * (1 / 3 + rise * rise / 5)
        fall *= 1 + fall * fall * (1 / 3 + fall * fall / 5)
    return (rise - fall) / (4 * (rise + fall)) if rise + fall > 0 else 0.0


@compile_loop()
def pool_significance(pixel, at, distance, own, starts, image_shape, limits, pooled):
    """Add to each candidate's significance those of its neighbours at the same range.

    `pixel` (n,): not decreasing; `at` (n,): range at which neighbours are looked for, m; `distance`
    (n,): range of each candidate, m; `own` (n,); `starts` (pixels + 1,): first candidate of each
    pixel; `limits`: radius in pixels, and gate in m for each of them; `pooled` (n,): overwritten.
    """
    rows, columns = image_shape
    radius, gate = limits
    reach = int(radius)
    for number in range(pixel.size):
        y, x = pixel[number] // columns, pixel[number] % columns
        total = own[number]
        for j in range(-reach, reach + 1):
            for i in range(-reach, reach + 1):
                left = radius * radius - j * j - i * i
                inside = 0 <= y + j < rows and 0 <= x + i < columns
                if not inside or left < 0 or (j == 0 and i == 0):
                    continue
                # A ball, not a box: a neighbour farther across may differ less in range.
                most = gate * math.sqrt(left)
                there = (y + j) * columns + x + i
                for k in range(starts[there], starts[there + 1]):
                    if math.fabs(distance[k] - at[number]) <= most:
                        total += own[k]
        pooled[number] = total
