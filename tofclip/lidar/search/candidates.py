"""The compiled search for candidates: some pixels' traces, one after another.

The steps are those of `tofclip.lidar.search`. Every function is serial and holds no interpreter
lock; `tofclip.lidar.search` shares the pixels between threads.
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, inlined
from tofclip.lidar.detection import PREFIT_THRESHOLD_FACTOR
from tofclip.lidar.search.peaks import (
    apply_filter,
    compute_response,
    list_maxima,
    search_step,
    sum_about,
    take_strongest_peaks,
)
from tofclip.vectors import (
    STEP,
    choose,
    fill_vector,
    load_vector,
    number_lanes,
    store_vector,
)

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
    `tofclip.lidar.search.windows.list_windows`; `limits` (5,): reach of two pulses, s, smallest
    signal-to-noise, smallest fraction of the strongest return, with the fall-off with range undone,
    the last instant at which a return may lie, s, and the lowest response of interest; `even`
    (bins,): see `tofclip.lidar.search.phase_table.PhaseTable.find_even_bins`; `half`: see
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
