"""The compiled search for returns in histograms of photons.

Positions below a bin and overlapping returns are treated by the steps of
`tofclip.lidar.fit_kernels`; here is what Poisson statistics add.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import compile_and_keep
from tofclip.lidar.fit_kernels import (
    find_pulse_window,
    get_variance,
    interpolate_pulse,
    refine_returns,
    subtract_returns,
)

MAX_ITERATIONS = (
    16  # the weights change with the estimate, which takes some rounds more than the plain fit
)
MIN_PHOTONS = 0.5  # lets an empty histogram have a background


@compile_and_keep()
def find_best_score(counts, weights, shade, first):
    """Largest log-matched filter response over all bins, and its bin.

    ``score[j] = sum_w weights[shade[j + first + w], w] * counts[j + first + w]``; photons are few,
    so each one adds to the bins it concerns. A photon where the background is bright says less.

    `counts` (bins,): photons; `weights` (shades, width): of the log-matched filter, for each
    brightness of the background; `shade` (bins,): row of `weights` for each bin; `first`: bin of
    the first weight, counted from the return's.
    """
    score = np.zeros(counts.size)
    for i in range(counts.size):
        if counts[i] > 0:
            own = weights[shade[i]]
            for w in range(own.size):
                j = i - first - w
                if 0 <= j < counts.size:
                    score[j] += counts[i] * own[w]
    best = np.argmax(score)
    return score[best], best


@compile_and_keep()
def find_best_scores(histograms, weights, shade, first, best):
    """Fill `best` with the largest response of each histogram.

    `histograms` (n, bins): photons; `weights, shade, first`: as for `find_best_score`; `best` (n,):
    overwritten.
    """
    table = spread_filter(weights, shade)
    score = np.zeros(shade.size)
    for row in range(histograms.shape[0]):
        best[row] = compute_best_score(histograms[row], table, first, score)


@compile_and_keep()
def spread_filter(weights, shade):
    """Weights that each bin has in the filter, (width, bins): as `compute_best_score` takes them.

    `weights, shade`: as for `find_best_score`.
    """
    table = np.empty((weights.shape[1], shade.size))
    for w in range(weights.shape[1]):
        for i in range(shade.size):
            table[w, i] = weights[shade[i], w]
    return table


@compile_and_keep()
def compute_best_score(counts, table, first, score):
    """What `find_best_score` says of histograms in which most bins hold photons, to the bit.

    Taking all bins at a time, one weight after the other, needs neither a question about each bin
    nor a search for what it reaches.

    `counts` (bins,): photons; `table` (width, bins): from `spread_filter`; `first`: bin of the
    first weight, counted from the return's; `score` (bins,): overwritten.
    """
    score[:] = 0
    for w in range(table.shape[0]):
        ahead = first + w
        begin, end = max(0, ahead), min(counts.size, counts.size + ahead)
        own, light, sums = (
            table[w, begin:end],
            counts[begin:end],
            score[begin - ahead : end - ahead],
        )
        for i in range(sums.size):
            sums[i] += own[i] * light[i]
    best = score[0]
    for value in score:
        if value > best:
            best = value
    return best


@compile_and_keep()
def simulate_best_scores(photons, arrived, noise, weights, shade, first, best):
    """Fill `best` with the best scores of histograms over which `photons` are thrown by a random
    generator as the background is distributed.

    `photons`: in each histogram; `arrived` (bins,): fraction of the background up to the end of
    each bin; the last is 1; `weights, shade, first`: as for `find_best_score`; `best` (trials,):
    overwritten.
    """
    bins = arrived.size
    counts, score, table = np.zeros(bins), np.zeros(bins), spread_filter(weights, shade)
    # where to begin the search for a photon's bin: hardly a step from where it ends
    begin = np.searchsorted(arrived, np.arange(bins) / bins, side="right")
    for trial in range(best.size):
        counts[:] = 0
        for _ in range(photons):
            place = noise.random()
            i = begin[int(place * bins)]
            while arrived[i] <= place:
                i += 1
            counts[i] += 1
        best[trial] = compute_best_score(counts, table, first, score)


@compile_and_keep()
def extract_strongest_returns(
    rest, free, dither, level, table, background, first, scale, times, peaks, numbers
):
    """Find the strongest return of each histogram and take its bins out, for the next one to be
    sought in the rest.

    `rest` (n, bins): photons that belong to no return yet; `free` (n,): background of the bins that
    belong to no return yet, relative to that of a usual bin; `dither` (n,): added to the scores, to
    decide ties; `level` (n,): row of the table for each histogram; negative: nothing is sought;
    `table` (levels,): threshold and filter weights; `background` (bins,): relative brightness of
    each bin, and its row of the filter; `first`: bin of the first weight relative to the return's;
    `scale, times`: as in `tofclip.lidar.fit_kernels`; `peaks` (n, most returns); `numbers` (n,).
    """
    (thresholds, weights), (relative, shade) = table, background
    for row in range(rest.shape[0]):
        if level[row] < 0:
            continue
        score, best = find_best_score(rest[row], weights[level[row]], shade, first)
        if score + dither[row] <= thresholds[level[row]]:
            continue
        peaks[row, numbers[row]] = best
        numbers[row] += 1
        begin, end = find_pulse_window(times, (best, best), times[best], scale)
        rest[row, begin:end] = 0
        free[row] -= relative[begin:end].sum()


@compile_and_keep()
def fit_histograms(
    histograms, arrived, live, cycles, peaks, numbers, relative, curve, scale, times, found
):
    """Refine the returns of each histogram to the likelihood's maximum.

    `histograms` (n, bins): photons counted; `arrived` (n, bins): photons with pile-up corrected;
    `live` (n, bins): fraction of the cycles in which the detector was ready; `peaks, numbers`: as
    `extract_strongest_returns` left them; `relative` (bins,): background of each bin, relative to
    that of a usual one; `curve, scale, times`: as in `tofclip.lidar.fit_kernels`; `found` (n, most
    returns, 3): overwritten with arrival, photons and standard deviation of the arrival where there
    is a return.
    """
    estimate = np.empty((peaks.shape[1], 5))
    for row in range(histograms.shape[0]):
        trace, number = arrived[row], numbers[row]
        # what was counted in the live cycles says more than a mean of corrected bins
        level = estimate_background(
            histograms[row], relative * live[row], times, peaks[row, :number], scale
        )
        background, variance = relative * level, (1 / live[row], cycles)
        for k in range(number):
            peak = peaks[row, k]
            estimate[k, 0], estimate[k, 2], estimate[k, 3] = times[peak], peak, peak
            estimate[k, 1] = estimate_height(trace, times, background, curve, scale, peak)
        refine_returns(
            trace,
            times,
            background,
            curve,
            scale,
            estimate[:number],
            variance,
            MAX_ITERATIONS,
        )
        for k in range(number):
            summarise_return(
                trace,
                times,
                background,
                curve,
                scale,
                estimate[:number],
                k,
                variance,
                found[row, k],
            )


@compile_and_keep()
def estimate_background(trace, relative, times, peaks, scale):
    """Background photons of a usual bin, from the bins that no return reaches.

    `trace` (bins,): photons; `relative` (bins,): background of each bin, relative to that of a
    usual one; `times` (bins,): seconds, increasing; `peaks`: bins of the returns; `scale` (4,): the
    pulse's; see `tofclip.lidar.fit_kernels`. Returns photons per bin, above zero.
    """
    free = np.ones(trace.size, np.bool_)
    for peak in peaks:
        first, last = find_pulse_window(times, (peak, peak), times[peak], scale)
        free[first:last] = False
    photons = bins = 0.0
    for i in range(trace.size):
        if free[i]:
            photons += trace[i]
            bins += relative[i]
    # a background of exactly zero would make a single photon infinitely surprising
    return (photons + MIN_PHOTONS) / max(bins, 1.0)


@compile_and_keep()
def estimate_height(trace, times, background, curve, scale, peak):
    """Height of a return from the photons around its bin; never less than half a photon's.

    `trace` (bins,): photons; `times` (bins,): seconds, increasing; `background` (bins,): photons
    per bin; `curve` (samples, 2): pulse and slope; `scale` (4,): the pulse's; see
    `tofclip.lidar.fit_kernels`; `peak`: bin of the return. Returns photons per bin at the pulse's
    peak.
    """
    arrival = times[peak]
    first, last = find_pulse_window(times, (peak, peak), arrival, scale)
    area = excess = 0.0
    for i in range(first, last):
        area += interpolate_pulse(times[i] - arrival, curve, scale)[0]
        excess += trace[i] - background[i]
    return max(excess, MIN_PHOTONS) / max(area, 1e-3)


@compile_and_keep()
def summarise_return(trace, times, background, curve, scale, estimate, k, variance, found):
    """Write arrival, photons and the arrival's Cramer-Rao deviation at the estimate to `found`.

    `trace` (bins,): photons; `times` (bins,): seconds, increasing; `background` (bins,): photons
    per bin; `curve` (samples, 2): pulse and slope; `scale` (4,): the pulse's; see
    `tofclip.lidar.fit_kernels`; `estimate` (returns, 5): see
    `tofclip.lidar.fit_kernels.refine_returns`; `k`: number of the return; `variance`: see
    `tofclip.lidar.fit_kernels.get_variance`; `found` (3,): overwritten: arrival in seconds, photons,
    standard deviation in seconds (infinite where the fit says nothing).
    """
    arrival, height = estimate[k, 0], estimate[k, 1]
    first, last = find_pulse_window(
        times, (int(estimate[k, 2]), int(estimate[k, 3])), arrival, scale
    )
    pp = pd = dd = total = 0.0
    for i in range(first, last):
        p, d = interpolate_pulse(times[i] - arrival, curve, scale)
        # the variance follows the expected count, which trace less residual is
        rest = subtract_returns(trace[i] - background[i], times[i], curve, scale, estimate, -1)
        expected = trace[i] - rest
        weight = 1 / get_variance(variance, i, expected)
        pp += weight * p * p
        pd += weight * p * d
        dd += weight * d * d
        total += height * p
    found[0], found[1], found[2] = arrival, total, np.inf
    determinant = pp * dd - pd * pd
    if height > 0 and determinant > 0:
        found[2] = np.sqrt(pp / determinant) / height


@compile_and_keep()
def compute_scores(histograms, weights, first, score):
    """Fill `score` with the log-matched filter's response of each histogram at each bin.

    `histograms` (n, bins): photons; `weights` (width,): of the filter; `first`: bin of the first
    weight, counted from the return's; `score` (n, bins): overwritten.
    """
    score[:] = 0
    for row in range(histograms.shape[0]):
        for i in range(histograms.shape[1]):
            if histograms[row, i] > 0:
                for w in range(weights.size):
                    j = i - first - w
                    if 0 <= j < histograms.shape[1]:
                        score[row, j] += histograms[row, i] * weights[w]


@compile_and_keep()
def add_path_scores(score, slope_cost, jump_cost, total):
    """Add to `total` the best score of all paths that reach each entry along the first axis.

    From one step to the next a path may keep its bin for nothing, change by one bin at
    `slope_cost`, or by any number at `jump_cost`: the recursion of semi-global matching. `score`
    and `total` are (steps, lanes, bins).

    `score` (steps, lanes, bins); `slope_cost, jump_cost`: in the score's unit, nats; `total`
    (steps, lanes, bins): added to, in place.
    """
    path, before = np.empty(score.shape[2]), np.empty(score.shape[2])
    for lane in range(score.shape[1]):
        before[:] = 0
        for step in range(score.shape[0]):
            highest = before.max()
            for t in range(path.size):
                best = max(before[t], highest - jump_cost)
                if t > 0:
                    best = max(best, before[t - 1] - slope_cost)
                if t + 1 < path.size:
                    best = max(best, before[t + 1] - slope_cost)
                # the subtraction keeps the numbers small and changes no comparison (H.
                # Hirschmueller, IEEE TPAMI 30, 328, 2008)
                path[t] = score[step, lane, t] + best - highest
                total[step, lane, t] += path[t]
            before[:] = path


@compile_and_keep()
def pool_neighbours(counts, label, reach, apart, pooled, contributors):
    """Sum each pixel's histogram with those of neighbours on the same surface, moved to the pixel's
    own bin.

    `counts` (rows, columns, bins); `label` (rows, columns): bin of the return; `reach`: neighbours
    up to this number of pixels away; `apart`: neighbours whose bins differ by more for each pixel
    of distance lie on another surface; `pooled` (rows, columns, bins); `contributors` (rows,
    columns).
    """
    rows, columns, bins = counts.shape
    pooled[:] = 0
    contributors[:] = 0
    for y in range(rows):
        for x in range(columns):
            for v in range(max(0, y - reach), min(rows, y + reach + 1)):
                for u in range(max(0, x - reach), min(columns, x + reach + 1)):
                    move = label[v, u] - label[y, x]
                    if abs(move) <= apart * max(abs(v - y), abs(u - x)):
                        contributors[y, x] += 1
                        for t in range(max(0, -move), min(bins, bins - move)):
                            pooled[y, x, t] += counts[v, u, t + move]
