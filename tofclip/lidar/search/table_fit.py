"""The fit of returns on an even time axis, by a table of the pulse.

A Gauss-Newton step of `tofclip.lidar.pulse_fit.refine_returns` is two products of the table's rows
with the trace (`tofclip.lidar.search.phase_table`). A step from the nearest tabulated phase ends
where one from the exact phase would, but for the square of their distance, at most (1 / 128)^2 of a
bin: far below where the steps end (`CONVERGENCE_STEP_BINS`).

Nearly all returns of a shot have their pulse to themselves and are fitted side by side
(`fit_lone_returns`); those that overlap take turns, each against what the others leave
(`fit_crowded_returns`).
"""

from __future__ import annotations

import math

import numpy as np

from tofclip.compiling import ONE, inlined
from tofclip.lidar.detection import CONVERGENCE_STEP_BINS, MAX_FIT_ROUNDS
from tofclip.lidar.search.candidates import (
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
)
from tofclip.lidar.search.peaks import search_step
from tofclip.lidar.search.phase_table import MAX_OFFSET_BINS, PHASES_PER_BIN
from tofclip.vectors import (
    STEP,
    choose,
    fill_vector,
    load_vector,
    store_vector,
    sum_vector,
)


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

    `traces, moments, even, half`: as for `tofclip.lidar.search.candidates.find_candidates`;
    `candidates` (room, CANDIDATE_COLUMNS): column `OFFSET` is improved; `HEIGHT` is overwritten:
    not above zero where there is no pulse, NaN where the return moved to where the exact fit is
    needed. `PEAK_BIN` follows one that moves further than `MAX_OFFSET_BINS`; `rests` (room, width):
    of `tofclip.lidar.search.candidates.find_candidates`; what is around the peak bins; `active`
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
    even, half`: as for `tofclip.lidar.search.candidates.find_candidates`.
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

    `traces, moments, even, half`: as for `tofclip.lidar.search.candidates.find_candidates`;
    `candidates` (room, CANDIDATE_COLUMNS): columns `OFFSET`, `HEIGHT`, `MOVED` and `PEAK_BIN` are
    improved, as by `fit_lone_returns`; `rests` (room, width): of
    `tofclip.lidar.search.candidates.find_candidates`; in the end what the others leave of it;
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
