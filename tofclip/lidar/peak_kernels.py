"""The compiled search for candidates: some pixels' traces, one after another, by the steps of
`tofclip.lidar.search`.

Every function is serial and holds no interpreter lock; pixels are shared between threads. Loops over
bins take a vector of them at a time (`tofclip.vectors`): axes are a whole number of vectors long
(`tofclip.lidar.trace_search`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray
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
    store_vector,
    sum_vector,
)

# Of the share of the strongest return that a candidate needs before the fit, which does not make up
# for more than the rest.
PREFIT_THRESHOLD_FACTOR = 0.7
VECTORS_PER_WORD = 2
WORD_BINS = VECTORS_PER_WORD * LENGTH  # bins whose maxima are listed together, a bit for each
NEEDS_EXACT_FIT = -1  # in place of the number of returns of a trace

OFFSET, HEIGHT, MOVED, NOISE, PEAK_BIN, TRACE, FIRST_OFFSET = range(7)
CANDIDATE_COLUMNS = 8  # a line of the processor's cache
"""What is known of a candidate: by how many bins it arrives after the bin of its peak, height, by
how many bins it moved last, noise of its trace, bin of its peak, and its trace's place among those
searched together; and the first of these again, as it was before any fit."""

search_step = compile_loop(fastmath=SUMS_IN_ANY_ORDER)
search_part = compile_as_part(fastmath=SUMS_IN_ANY_ORDER, _nrt=False)


class Axis(NamedTuple):
    """The bins of traces and the filters for them."""

    times: FloatArray  # (bins,), s, increasing
    # (bins,), for how many bins each one stands where background and noise are concerned
    bin_weights: Float32Array
    sharp: Float32Array  # (width, bins), weight of bin ``j + w - width // 2`` for a return at bin j
    runs: IntArray  # first bins of the vectors in which it is applied, an even number
    edges: IntArray  # single bins in which it is applied
    words: IntArray  # first bins of the words in which maxima are sought
    matched: Float32Array  # (bins, width), filters of unit energy, nowhere negative
    starts: IntArray  # (bins,), first bin that each of them takes
    sums: FloatArray  # (bins,), over each of them
    windows: NDArray[np.int32]  # (bins, 4), `tofclip.lidar.pulse.list_windows`
    even: BoolArray  # (bins,), `tofclip.lidar.pulse.PhaseTable.find_even_bins`


class Limits(NamedTuple):
    """What a candidate needs."""

    reach: float  # of two pulses, s
    signal_to_noise: float
    pixel_fraction: float  # of the strongest return, with the fall-off with range undone
    last_instant: float  # at which a return may lie, s
    sharp_gain: float  # largest sums of the sharp filters and of the matched ones
    matched_gain: float
    background_gain: float  # that of the sharp filters, or 0 where nothing is known of interest
    lowest_response: float  # of interest
    # (bins + WORD_BINS,), by how much scores exceed that of the background
    of_interest: Float32Array
    # (bins,), response that a return must exceed; weaker peaks are kept only where one overlaps them
    least: Float32Array


class Room(NamedTuple):
    """What a thread's search overwrites, for some pixels of which each has at most `returns`."""

    # (1 + bins + WORD_BINS + 1,), zero where no sharp filter is applied; one bin late
    score: Float32Array
    places: NDArray[np.int32]  # (4, bins), of `list_maxima`; zeros become 1 where a peak is taken
    responses: Float32Array  # (bins,), of the matched filter at these maxima
    free: Float32Array  # (bins,), as `bin_weights`, before and afterwards
    peaks: FloatArray  # (returns, 2), bin, and response less that to the background
    moments: FloatArray  # (pixels, 2), background and noise
    candidates: FloatArray  # (pixels * returns, CANDIDATE_COLUMNS), a trace's side by side, in time
    # (pixels * returns, width), trace less background around each peak; zero where that fills up
    rests: Float32Array
    fitted: IntArray  # (pixels * returns,), candidates that the table fits
    estimates: FloatArray  # (returns, 5), of the exact fit
    level: FloatArray  # (bins,), background of the exact fit


@search_part
def find_candidates(traces, pixels, axis, limits, half, room, counts):
    """List the peaks of some traces that the matched filter confirms, and cut out the bins around.
    `traces` (n, bins) have memory for another one after the last; `pixels` (n,): their pixels;
    `half`: of the table of the pulse, which says how far to cut out. `counts` (all pixels,) become
    0, or `NEEDS_EXACT_FIT` where a candidate's bins are not all there. Returns how many candidates
    there are, and how many of them do not.
    """
    listed = number = 0
    candidates = room.candidates
    all_bins = np.float32(0)
    for i in range(np.uintp(0), np.uintp(traces.shape[1])):
        all_bins += axis.bin_weights[i]
    for place in range(traces.shape[0]):
        trace, first = traces[place], listed
        centre, sum_left, square_left = sum_about(trace, axis.bin_weights)
        apply_filter(trace, axis, room.score)
        level = np.float32(limits.background_gain) * (centre + np.float32(sum_left) / all_bins)
        maxima = list_maxima(room.score, limits.of_interest, axis.words, level, room.places)
        about = centre, all_bins, sum_left, square_left
        background, noise, peaks = take_strongest_peaks(trace, axis, limits, about, maxima, room)
        room.moments[place, 0] = background
        room.moments[place, 1] = noise
        known = background, noise, place
        listed = confirm_peaks(trace, axis, limits, known, room.peaks[:peaks], candidates, first)
        counts[pixels[place]] = 0
        for k in range(first, listed):
            j = int(candidates[k, PEAK_BIN])
            if not axis.even[j]:
                counts[pixels[place]] = NEEDS_EXACT_FIT
                continue
            cut_out(trace, background, j - half, 2 * half + 1, room.rests[k])
            room.fitted[number] = k
            number += 1
    return listed, number


@search_part
def sum_about(trace, bin_weights):
    """Sums over the bins, and of squares, of what is above a brightness that is usual there, which comes
    first: float32 squares about zero would drown a small noise on a high background.
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
def apply_filter(trace, axis, score):
    """Write the sharp filter's responses, one bin late, where `runs` and `edges` say."""
    sharp, runs, edges = axis.sharp, axis.runs, axis.edges
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


@search_part
def list_maxima(score, of_interest, words, level, places):
    """List bin and height of the local maxima of interest, in the order of time; return how many.
    Of a level top the last bin counts. Rows of `places` get bins, keys (`make_key`) with zeros
    behind the last one, zeros, and what is only needed meanwhile. `level`: score of the background.
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


@inlined
def make_key(height, entry):
    """A whole number that is the larger the higher a maximum, to 2e-6 of it, and holds its lane; heights
    are above zero: such numbers are in the order of their bits.
    """
    lane = np.int32(entry) & (LENGTH - 1)
    return np.int32((np.float32(height).view(np.int32) & -LENGTH) | lane)


@inlined
def take_strongest_peaks(trace, axis, limits, about, listed, room):
    """Take the highest maxima of the sharp filter's response that might count, in the order of time.

    Peaks are taken from the highest down, until not even bins all as bright as the next one says
    could count: because of the noise, or beside the strongest return. Background and noise are those
    of the bins that no peak claims. Peaks claim their surroundings from the strongest down, for as
    long as half of the bins stay free.

    `about`: a brightness, number of bins, and sums over the bins of what is above it and of its
    square; `listed`: number of maxima. Returns background, noise and how many peaks there are.
    """
    times, sums, windows, places = axis.times, axis.sums, axis.windows, room.places
    centre, all_bins, sum_left, square_left = about
    bins_left, background, variance = float(all_bins), 0.0, 0.0
    number, needed, claiming, best = 0, 0.0, True, np.uintp(0)
    low, high, response = np.int32(0), np.int32(0), np.float32(0)
    steepest = limits.signal_to_noise * limits.signal_to_noise
    ratio, last = limits.matched_gain / limits.sharp_gain, limits.last_instant
    while True:
        part = 1 / bins_left
        background = sum_left * part
        # rounding may leave the difference slightly below zero
        variance = max(square_left * part - background * background, 0.0)
        background += centre
        if number > 0:
            above = response - background * sums[best]
            # light falls with the square of the range: strengths count as if all stood at one
            share = PREFIT_THRESHOLD_FACTOR * limits.pixel_fraction * above
            needed = max(share * times[best] * times[best], needed)
        height, entry = take_highest(places[0], places[1], listed, low, high)
        brightest = ratio * height - limits.matched_gain * background
        dim = height <= 0 or brightest <= limits.lowest_response
        dim = dim or brightest * brightest <= steepest * variance
        if number == len(room.peaks) or dim or brightest * last * last < needed:
            break
        best = np.uintp(places[0, entry])
        response = compute_response(trace, axis.matched[best], axis.starts[best])
        places[2, entry] = 1
        room.responses[entry] = response
        number += 1
        low, high = windows[best, 2], windows[best, 3]
        first, after = np.uintp(windows[best, 0]), np.uintp(windows[best, 1])
        claiming = claiming and bool(2 * (bins_left - (after - first)) >= all_bins)
        if claiming:
            taken, taken_square, taken_bins = claim_bins(trace, centre, room.free, first, after)
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
            above = room.responses[entry] - background * sums[best]
            room.peaks[number, 0] = best
            room.peaks[number, 1] = above if above > 0 else 0.0
            number += 1
            for i in range(np.uintp(windows[best, 0]), np.uintp(windows[best, 1])):
                room.free[i] = axis.bin_weights[i]
    return background, math.sqrt(variance), number


@inlined
def take_highest(bins, keys, listed, low, high):
    """Height (0 where none is left) and place of the highest maximum, without those from bin `low`
    to before `high`, whose keys become zero. Every peak waits for the one before it, so that what
    counts is how soon it is found.
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
def compute_response(trace, weights, start):
    """Response of a filter whose first weight is for bin `start`."""
    total = fill_vector(np.float32(0))
    for w in range(np.uintp(0), np.uintp(weights.size), STEP):
        total += load_vector(weights, w) * load_vector(trace, np.uintp(start) + w)
    return sum_vector(total)


@search_part
def claim_bins(trace, centre, free, first, after):
    """Take the bins from `first` to before `after`, as far as they are free; return sums over them of
    what is above `centre`, of its square, and their number.
    """
    total = square = number = np.float32(0)
    for i in range(first, after):
        above, taken = trace[i] - centre, free[i]
        total += taken * above
        square += taken * above * above
        number += taken
        free[i] = 0
    return total, square, number


@inlined
def confirm_peaks(trace, axis, limits, known, peaks, candidates, listed):
    """List the peaks of a trace that the matched filter confirms, placed below a bin, from `listed`
    on; return how many candidates there are now. `known`: background and noise, and place of the
    trace among those searched together.
    """
    times, sums, matched, starts = axis.times, axis.sums, axis.matched, axis.starts
    background, noise, place = known
    needed = 0.0
    for k in range(len(peaks)):
        best = np.uintp(peaks[k, 0])
        share = PREFIT_THRESHOLD_FACTOR * limits.pixel_fraction * peaks[k, 1]
        share *= times[best] * times[best]
        needed = share if share > needed else needed
    for k in range(len(peaks)):
        best, strength = np.uintp(peaks[k, 0]), peaks[k, 1]
        weak = strength <= limits.signal_to_noise * noise
        if weak or strength * times[best] * times[best] < needed:
            continue
        # a return of interest lies there, or overlaps it
        wanted = strength >= limits.least[best]
        if not wanted:
            for other in range(len(peaks)):
                j = np.uintp(peaks[other, 0])
                near = math.fabs(times[j] - times[best]) <= limits.reach
                wanted = wanted or (near and peaks[other, 1] >= limits.least[j])
        if not wanted:
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
def interpolate_peak(before, here, after):
    """Where between three neighbours a response is highest, after the middle, as a part of the distance
    between the outer two: by a parabola in its logarithm; 0 where these are not above zero or higher.
    """
    rise = fall = 0.0
    if before > 0 and after > 0 and here >= before and here >= after:
        # ln(a / b) = 2 artanh((a - b) / (a + b)), by the first terms of its series: 2e-5 off where
        # the next bin has 0.6 of the response, as of most pulses; the fit only begins there
        rise, fall = (here - before) / (here + before), (here - after) / (here + after)
        rise *= 1 + rise * rise * (1 / 3 + rise * rise / 5)
        fall *= 1 + fall * fall * (1 / 3 + fall * fall / 5)
    return (rise - fall) / (4 * (rise + fall)) if rise + fall > 0 else 0.0


@inlined
def is_near(candidates, k, other, half):
    """Whether a candidate and a later one are of the same trace and may share bins."""
    apart = candidates[other, PEAK_BIN] - candidates[k, PEAK_BIN]
    return candidates[other, TRACE] == candidates[k, TRACE] and apart < 2 * half + 1


@inlined
def cut_out(trace, background, start, held, rest):
    """Cut `held` bins from `start` on out of a trace, less its background, and fill up with zeros. The
    trace has memory behind its last bin.
    """
    level, first = np.float32(background), np.uintp(start)
    for w in range(np.uintp(rest.size)):
        rest[w] = trace[first + w] - level if w < np.uintp(held) else np.float32(0)


@compile_loop()
def pool_neighbours(pixel, distance, own, starts, image_shape, limits, sums):
    """Add to each candidate's sums what its neighbours at the same range have of `own`, both (n, values).
    `pixel` (n,) does not decrease; `distance` (n,): range, m; `starts` (pixels + 1,): first candidate of each
    pixel; `limits`: radius in pixels, and gate in m for each of them.
    """
    rows, columns = image_shape
    radius, gate = limits
    reach = int(radius)
    for number in range(pixel.size):
        y, x = pixel[number] // columns, pixel[number] % columns
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
                    if math.fabs(distance[k] - distance[number]) <= most:
                        for value in range(own.shape[1]):
                            sums[number, value] += own[k, value]


# Which candidates of a pixel are one surface, whose light the recovery spread over time. The views are
# projections along lines within some angle of the vertical. Where a surface's lines of equal range run
# level in the picture, as a table top's or a slanted roof's do, light of an instant can move up and down
# along them without a view that notices. At one pixel the pulse becomes a hump, many pulses long, on
# which each ripple looks like a return: none is, and their middle is.

spread_part = compile_as_part(_nrt=False)

# of a candidate's light, below which its own part of the trace ends
EDGE_FRACTION = 0.1
# of the lower of two, from which the light between them says that they are one
VALLEY_FRACTION = 0.35
# distance of two humps, in sums of their deviations, up to which they are one: 1.7 if they touch
REACH_DEVIATIONS = 4.0


@compile_loop()
def join_spread(values, times, pixel, place, half, own_variance, joined, moments):
    """Number the surfaces that candidates belong to. `values` (time, pixels): light; `times` (time,);
    `pixel, place` (n,): pixel and bin of each, in the order of both; `half`: bins on either side over
    which ripples are evened out; `own_variance`: of the squared pulse. Overwritten are, of each
    candidate, `joined` (n,): the first one of its surface; and of these `moments` (3, n): sum of the
    squares of the surface's light, and by these the mean and the variance of its time.
    """
    weight, middle, variance = moments
    for k in range(place.size):
        own, here = pixel[k], place[k]
        follows = k > 0 and pixel[k - 1] == own
        ahead = k + 1 < place.size and pixel[k + 1] == own
        low = find_end(values, own, here, place[k - 1] if follows else -1, -1)
        high = find_end(values, own, here, place[k + 1] if ahead else times.size, 1)
        total, mean, square = 1e-30, 0.0, 0.0
        for t in range(low, high + 1):
            light, late = max(values[t, own], np.float32(0)), times[t] - times[here]
            light *= light * (1.0 if low < t < high else 0.5)  # its neighbour has the other half
            total, mean, square = total + light, mean + light * late, square + light * late**2
        mean /= total
        first = k
        weight[k], middle[k], variance[k] = total, times[here] + mean, square / total - mean**2
        shallow = follows and is_shallow(values, own, place[k - 1], here, half)
        while follows:
            last = joined[first - 1]
            apart = middle[first] - middle[last]
            reach = np.sqrt(max(variance[last] - own_variance, 0.0))
            reach += np.sqrt(max(variance[first] - own_variance, 0.0))
            if not shallow and apart > REACH_DEVIATIONS * reach:
                break
            total, part = weight[last] + weight[first], weight[first]
            variance[last] = weight[last] * variance[last] + part * variance[first]
            variance[last] = variance[last] / total + weight[last] * part * (apart / total) ** 2
            weight[last], middle[last] = total, middle[last] + apart * part / total
            first, shallow = last, False
            follows = first > 0 and pixel[first - 1] == own
        joined[first : k + 1] = first


@spread_part
def find_end(values, own, here, stop, step):
    """The bin of least light between `here` and `stop`, at most where hardly any is left."""
    end, least = here, values[here, own]
    enough = EDGE_FRACTION * least
    for t in range(here + step, stop, step):
        if values[t, own] < least:
            end, least = t, values[t, own]
        if least < enough:
            break
    return end


@spread_part
def is_shallow(values, own, first, last, half):
    """Whether the light between two candidates does not fall far below that of the lower one."""
    ends, least = np.inf, np.inf
    for t in range(first, last + 1):
        light = 0.0
        for s in range(max(t - half, 0), min(t + half + 1, len(values))):
            light += values[s, own]
        ends, least = min(ends, light) if t in (first, last) else ends, min(least, light)
    return least >= VALLEY_FRACTION * ends
