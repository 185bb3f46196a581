"""The compiled loops of counted photons: the search of each pixel's histogram, and the steps of the
search for a surface.

Of histograms, positions below a bin and overlapping returns are treated by the steps of
`tofclip.lidar.fit_kernels`, whose `curve`, `scale` and `times` (bins,) in s are here as there; this is
what Poisson statistics add. Of events all times are in bins, and a label is an instant that a surface
may have on a coarse time axis. A filter is given as `weights` (shades, width), log-likelihood ratios
for each brightness of the background, `shade` (bins,), the row for each bin, and `first`, the bin of
the first weight counted from the return's. Every function is serial and holds no interpreter lock.
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

compiled = compile_and_keep(error_model="numpy")
vectorised = compile_and_keep(error_model="numpy", fastmath=True)
per_histogram = compile_and_keep()

MAX_ITERATIONS = 16  # the weights change with the estimate: some rounds more than the plain fit
# Where a pixel's brightness has to be its own, that of its neighbours counts as so many photons.
NEIGHBOURS_PHOTONS = 10.0
MIN_PHOTONS = 0.5  # lets an empty histogram have a background
MIN_PLANE_PIXELS = 6  # a plane through fewer pixels is taken as level
MIN_DETERMINED_FRACTION = 1e-2  # of the information that must be left for the middle after slopes
SLOPE_RIDGE_FRACTION = 1e-3  # of it, for level planes: finite slopes where one row has photons


@per_histogram
def find_best_score(counts, weights, shade, first):
    """Largest log-matched filter response over all bins, and its bin. ``score[j] = sum_w
    weights[shade[j + first + w], w] * counts[j + first + w]``; photons are few, so each one adds to
    the bins it concerns. A photon where the background is bright says less.
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


@per_histogram
def find_best_scores(histograms, weights, shade, first, best):
    """Fill `best` (n,) with the largest response of each histogram, (n, bins)."""
    table = spread_filter(weights, shade)
    score = np.zeros(shade.size)
    for row in range(histograms.shape[0]):
        best[row] = compute_best_score(histograms[row], table, first, score)


@per_histogram
def spread_filter(weights, shade):
    """Weights that each bin has in the filter, (width, bins): as `compute_best_score` takes them."""
    table = np.empty((weights.shape[1], shade.size))
    for w in range(weights.shape[1]):
        for i in range(shade.size):
            table[w, i] = weights[shade[i], w]
    return table


@per_histogram
def compute_best_score(counts, table, first, score):
    """What `find_best_score` says of histograms in which most bins hold photons, to the bit. Taking
    all bins at a time, one weight after the other, needs neither a question about each bin nor a
    search for what it reaches.
    """
    score[:] = 0
    for w in range(table.shape[0]):
        ahead = first + w
        begin, end = max(0, ahead), min(counts.size, counts.size + ahead)
        own, light = table[w, begin:end], counts[begin:end]
        sums = score[begin - ahead : end - ahead]
        for i in range(sums.size):
            sums[i] += own[i] * light[i]
    best = score[0]
    for value in score:
        if value > best:
            best = value
    return best


@per_histogram
def simulate_best_scores(photons, arrived, noise, weights, shade, first, best):
    """Fill `best` (trials,) with the best scores of histograms over which so many photons are thrown
    as the background arrives, of which `arrived` (bins,) is the fraction up to the end of each bin.
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


@per_histogram
def extract_strongest_returns(
    rest, free, dither, level, table, background, first, scale, times, peaks, numbers
):
    """Find the strongest return of each histogram and take its bins out, for the next one to be
    sought in the rest. `rest` (n, bins): photons that belong to no return yet; `free` (n,):
    background of their bins, relative to that of a usual bin; `dither` (n,): decides ties; `level`
    (n,): row of the table of thresholds and weights, negative where nothing is sought;
    `background`: relative brightness of each bin, and its shade; `peaks` (n, most returns) and
    `numbers` (n,) are added to.
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


@per_histogram
def fit_histograms(
    histograms, arrived, live, cycles, peaks, numbers, relative, curve, scale, times, found
):
    """Refine the returns of each histogram to the likelihood's maximum. `histograms, arrived` (n,
    bins): photons counted, and with pile-up corrected; `live` (n, bins): fraction of the cycles in
    which the detector was ready; `relative` (bins,): background over that of a usual bin; `found`
    (n, most returns, 3): arrival, photons and deviation of each return.
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
        own = estimate[:number]
        refine_returns(trace, times, background, curve, scale, own, variance, MAX_ITERATIONS)
        for k in range(number):
            around = trace, times, background, curve, scale
            summarise_return(around, own, k, variance, found[row, k])


@per_histogram
def estimate_background(trace, relative, times, peaks, scale):
    """Background photons of a usual bin, above zero, from the bins that no return reaches."""
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


@per_histogram
def estimate_height(trace, times, background, curve, scale, peak):
    """Height of a return, photons per bin, from the photons around its bin; at least half a one's."""
    arrival = times[peak]
    first, last = find_pulse_window(times, (peak, peak), arrival, scale)
    area = excess = 0.0
    for i in range(first, last):
        area += interpolate_pulse(times[i] - arrival, curve, scale)[0]
        excess += trace[i] - background[i]
    return max(excess, MIN_PHOTONS) / max(area, 1e-3)


@per_histogram
def summarise_return(around, estimate, k, variance, found):
    """Write arrival, photons and the arrival's Cramer-Rao deviation at the estimate to `found`; the
    deviation is infinite where the fit says nothing.
    """
    trace, times, background, curve, scale = around
    arrival, height = estimate[k, 0], estimate[k, 1]
    peaks = int(estimate[k, 2]), int(estimate[k, 3])
    first, last = find_pulse_window(times, peaks, arrival, scale)
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


@per_histogram
def weigh_shifts(histograms, arrival, photons, level, relative, curve, scale, times, found):
    """What each histogram, (n, bins), says about a shift of the return that is expected at `arrival`
    (n,), NaN where there is none, with so many `photons` and the background's `level` (n,): slope of
    the log-likelihood and its Fisher information, `found` (n, 2).
    """
    for row in range(histograms.shape[0]):
        slope = information = area = 0.0
        if arrival[row] == arrival[row]:
            first, last = find_pulse_window(times, (0, 0), arrival[row], scale)
            for i in range(first, last):
                area += interpolate_pulse(times[i] - arrival[row], curve, scale)[0]
            height = max(photons[row], MIN_PHOTONS) / max(area, 1e-3)
            for i in range(first, last):
                p, d = interpolate_pulse(times[i] - arrival[row], curve, scale)
                expected = max(relative[i] * level[row] + height * p, 1e-9)
                slope += (1 - histograms[row, i] / expected) * height * d
                information += (height * d) ** 2 / expected
        found[row, 0], found[row, 1] = slope, information


@compiled
def score_labels(offsets, coarse_bin, count, place, weights, shade, first, score):
    """Log-likelihood ratio of a surface at each label against none, `score` (pixels, labels).
    `place` (coarse bins,): label of each, or -1; `weights` (shades, width): log-likelihood ratio of a
    photon ``first + w`` coarse bins after the surface, where the background is as `shade` (events,).
    """
    for pixel in range(score.shape[0]):
        own = score[pixel]
        own[:] = 0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            for w in range(weights.shape[1]):
                label_bin = coarse_bin[event] - first - w
                if 0 <= label_bin < place.size and place[label_bin] >= 0:
                    own[place[label_bin]] += weights[shade[event], w] * count[event]


@vectorised
def find_highest(values):
    """Largest of the values: four at a time, as one after the other each waits for the one before."""
    first = second = third = fourth = values[0]
    whole = values.size - values.size % 8
    for t in range(0, whole, 8):
        first = max(first, max(values[t], values[t + 1]))
        second = max(second, max(values[t + 2], values[t + 3]))
        third = max(third, max(values[t + 4], values[t + 5]))
        fourth = max(fourth, max(values[t + 6], values[t + 7]))
    for t in range(whole, values.size):
        first = max(first, values[t])
    return max(max(first, second), max(third, fourth))


@vectorised
def extend_path(score, before, highest, slope_cost, jump_cost, path, total):
    """One step of semi-global matching; return the path's highest score. ``path[t] = score[t] +
    max(before[t], before[t -+ 1] - slope_cost, highest - jump_cost) - highest``; Hirschmueller,
    IEEE Trans. Pattern Anal. 30, 328 (2008), Eq. 13, with likelihoods where he has costs. `path` is
    overwritten and added to `total`.
    """
    last = score.size - 1
    floor = highest - jump_cost
    # The ends have one neighbour only. The highest score is taken off in every step, or sums would
    # grow along the path until single precision loses the differences.
    path[0] = score[0] + max(max(before[0], floor), before[min(1, last)] - slope_cost) - highest
    path[last] = (
        score[last] + max(max(before[last], floor), before[max(last - 1, 0)] - slope_cost) - highest
    )
    for t in range(1, last):
        beside = max(before[t - 1], before[t + 1]) - slope_cost
        path[t] = score[t] + max(max(before[t], floor), beside) - highest
    for t in range(score.size):
        total[t] += path[t]
    return find_highest(path)


@compiled
def add_path_scores(score, slope_cost, jump_cost, total):
    """Add to `total` the scores, (rows, columns, labels), of the four paths that come from the left
    and from the row above; called again with both picture axes reversed, of the other four.
    """
    rows, columns, labels = score.shape
    above = np.zeros((3, columns, labels), np.float32)
    here = np.zeros((3, columns, labels), np.float32)
    above_top, here_top = np.zeros((3, columns), np.float32), np.zeros((3, columns), np.float32)
    beside, start = np.zeros((2, labels), np.float32), np.zeros(labels, np.float32)
    for y in range(rows):
        beside[:] = 0
        beside_top = np.float32(0)
        for x in range(columns):
            own, summed = score[y, x], total[y, x]
            beside_top = extend_path(
                own, beside[x % 2], beside_top, slope_cost, jump_cost, beside[1 - x % 2], summed
            )
            # the three directions from the row above; the row itself is the fourth
            for way in range(3):
                u = x + way - 1
                before, top = start, np.float32(0)
                if y > 0 and 0 <= u < columns:
                    before, top = above[way, u], above_top[way, u]
                here_top[way, x] = extend_path(
                    own, before, top, slope_cost, jump_cost, here[way, x], summed
                )
        # two rows in turn: only the row above is looked back at
        above, here = here, above
        above_top, here_top = here_top, above_top


@compiled
def find_best_labels(score, total, extra_paths, apart, label, margin):
    """Best label of each pixel, and by how much it beats every label further than `apart` away.
    `score, total` (pixels, labels); the paths counted a pixel's own score `extra_paths` too often.
    """
    for pixel in range(score.shape[0]):
        best, highest = 0, np.float32(-np.inf)
        for t in range(score.shape[1]):
            # every path counted the pixel's own score: all but one are taken off
            value = total[pixel, t] - extra_paths * score[pixel, t]
            if value > highest:
                best, highest = t, value
        other = np.float32(-np.inf)
        for t in range(score.shape[1]):
            if abs(t - best) > apart:
                other = max(other, total[pixel, t] - extra_paths * score[pixel, t])
        label[pixel] = best
        margin[pixel] = highest - other if other > -np.inf else np.float32(0)


@compiled
def measure_events(
    offsets, bin_time, count, surface, table, start, step, brightness, relative, sums
):
    """What the photons of each pixel say about moving its surface, `sums` (pixels, 4): slope of the
    log-likelihood, its Fisher information, photons of the signal, and the share of the light that
    these would be of: all of it. `table` (n, 2): of the response,
    sampled from `start` by `step`: minus the slope of its logarithm, and its density over that of
    the background for one photon of signal, of which `brightness` (pixels,) are expected; `relative`
    (events,): the background over its mean.
    """
    for pixel in range(surface.size):
        slope = information = photons = 0.0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            position = (bin_time[event] - surface[pixel] - start) / step
            if 0 <= position < table.shape[0] - 1:
                push, odds = interpolate_rows(table, position)
                odds /= relative[event]
                # Probability that the photon is of the signal. The derivative of log(background +
                # signal) is the signal's own, weighted by it.
                belongs = brightness[pixel] * odds / (1 + brightness[pixel] * odds)
                slope += count[event] * belongs * push
                information += count[event] * (belongs * push) ** 2
                photons += count[event] * belongs
        sums[pixel, 0], sums[pixel, 1], sums[pixel, 2] = slope, information, photons
        sums[pixel, 3] = 1.0


@compiled
def interpolate_rows(table, position):
    """Both columns of a table between two of its rows."""
    left = int(position)
    part = position - left
    push = table[left, 0] * (1 - part) + table[left + 1, 0] * part
    return push, table[left, 1] * (1 - part) + table[left + 1, 1] * part


@compiled
def interpolate_density(density, position):
    """Density between two of its samples; none beyond them."""
    if not 0 <= position < density.size - 1:
        return 0.0
    left = int(position)
    return density[left] + (position - left) * (density[left + 1] - density[left])


@compiled
def measure_first_photons(
    offsets, bin_time, count, surface, table, start, step, brightness, around, dark, cycles, sums
):
    """The same of a detector that counts the first photon of each of so many cycles, whose photons
    come in whole bins, in order. A bin sees ``1 - exp(-rate)`` of the cycles that reach it (Coates
    1968, Eq. 4), `dark` being the background's rate. Where the late side of a pulse is missing, its
    instant is known as well as its brightness only (Schur complement), which is each pixel's own,
    though that of its neighbours, `around` (pixels,), counts as `NEIGHBOURS_PHOTONS`.
    """
    for pixel in range(surface.size):
        begin, bright = surface[pixel] + start, brightness[pixel]
        event, end, live = offsets[pixel], offsets[pixel + 1], cycles
        number = np.int64(np.ceil(begin))
        while event < end and bin_time[event] < number:
            live -= count[event]
            event += 1
        slope = information = mixed = seen = ready = 0.0
        light = NEIGHBOURS_PHOTONS / bright**2
        excess = NEIGHBOURS_PHOTONS * (1 / bright - 1 / around[pixel])
        while number < begin + (table.shape[0] - 1) * step:
            photons = 0.0
            if event < end and bin_time[event] == number:
                photons = count[event]
                event += 1
            push, odds = interpolate_rows(table, (number - begin) / step)
            share = odds * dark  # of a photon of signal, in a cycle
            chance = -np.expm1(-dark - bright * share)
            live = max(live, photons)
            told, known = photons / chance - live, live * (1 - chance) / chance
            slope += told * bright * share * push
            excess += told * share
            information += known * (bright * share * push) ** 2
            light += known * share**2
            mixed += known * bright * push * share**2
            seen += photons / chance * bright * share
            ready += live * share
            live -= photons
            number += 1
        sums[pixel, 0] = slope - mixed / light * excess
        sums[pixel, 1] = information - mixed**2 / light
        sums[pixel, 2], sums[pixel, 3] = seen, ready


@compiled
def tally_first_photons(
    offsets, bin_time, count, surface, brightness, density, start, step, dark, cycles, slots, sums
):
    """Tell the response of a detector as of `measure_first_photons` by time after the surface, in
    slots of ``slots[1]`` bins from ``slots[0]`` slots on: what was counted, as if no cycle had ended,
    cycles that were open, and signal photons that these would have seen of a response of density
    one; `brightness` (pixels,): signal photons of a cycle; `sums` (slots, 3) is added to.
    """
    for pixel in range(surface.size):
        event, end, live = offsets[pixel], offsets[pixel + 1], cycles
        number = np.int64(np.ceil(surface[pixel] + slots[0] * slots[1]))
        while event < end and bin_time[event] < number:
            live -= count[event]
            event += 1
        while number < surface[pixel] + (slots[0] + sums.shape[0] - 1) * slots[1]:
            late = number - surface[pixel]
            rate = dark + brightness[pixel] * interpolate_density(density, (late - start) / step)
            own = sums[int(late / slots[1] - slots[0] + 0.5)]
            own[1] += live
            own[2] += live * brightness[pixel]
            if event < end and bin_time[event] == number:
                own[0] += count[event] * rate / -np.expm1(-rate)
                live -= count[event]
                event += 1
            number += 1


@compiled
def choose_cycles(offsets, count, cycles, fraction, noise, chosen):
    """Fill `chosen` (events,) with the photons of a fraction of the cycles, one or none in each."""
    for pixel in range(offsets.size - 1):
        left, needed = cycles, np.floor(fraction * cycles + noise.random())
        for event in range(offsets[pixel], offsets[pixel + 1]):
            for _ in range(int(count[event])):
                if noise.random() * left < needed:
                    chosen[event] += 1
                    needed -= 1
                left -= 1


@compiled
def fit_planes(surface, sums, reach, gate, slopes, rows, fitted):
    """Move each pixel's surface to the most likely plane through the neighbours on the same one.

    Around the present surface the log-likelihood of every pixel is a parabola, so that a plane's
    is a weighted least-squares fit (one step of Fisher scoring). `sums`: as of `measure_events`; a
    neighbour further than `gate` off the present plane, of `slopes` (rows, columns, 2), lies on
    another surface; `rows`: first and the one after the last; `fitted` (rows, columns, 3): instant,
    its standard deviation, and the mean photons of a neighbour.
    """
    height, width = surface.shape
    # of the rows of a disc
    half_widths = np.sqrt(reach * reach - np.arange(reach + 1.0) ** 2).astype(np.int64)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            slope_x, slope_y = slopes[y, x, 0], slopes[y, x, 1]
            here = surface[y, x]
            w = wx = wy = wxx = wxy = wyy = b = bx = by = photons = ready = 0.0
            pixels = 0
            for v in range(max(0, y - reach), min(height, y + reach + 1)):
                dy = v - y
                wide = half_widths[abs(dy)]
                row_w = row_wx = row_wxx = row_b = row_bx = 0.0
                for u in range(max(0, x - wide), min(width, x + wide + 1)):
                    dx = np.float64(u - x)
                    later = surface[v, u] - here
                    # pixels beyond a border belong to another surface
                    if abs(later - slope_x * dx - slope_y * dy) > gate:
                        continue
                    weight = sums[v, u, 1]
                    moment = weight * later + sums[v, u, 0]
                    row_w += weight
                    row_wx += weight * dx
                    row_wxx += weight * dx * dx
                    row_b += moment
                    row_bx += moment * dx
                    photons += sums[v, u, 2]
                    ready += sums[v, u, 3]
                    pixels += 1
                w += row_w
                wx += row_wx
                wxx += row_wxx
                b += row_b
                bx += row_bx
                wy += dy * row_w
                wxy += dy * row_wx
                wyy += dy * dy * row_w
                by += dy * row_b
            fitted[y, x, 0], fitted[y, x, 1] = surface[y, x], np.inf
            fitted[y, x, 2] = photons / max(ready, 1e-9)
            if w <= 0:
                continue
            move, information = b / w, w
            # a ridge on the slopes keeps the fit determined where pixels lie in a row
            wxx += SLOPE_RIDGE_FRACTION * w
            wyy += SLOPE_RIDGE_FRACTION * w
            determinant = wxx * wyy - wxy * wxy
            if pixels >= MIN_PLANE_PIXELS and determinant > 0:
                xx, yy, xy = wyy / determinant, wxx / determinant, -wxy / determinant
                # information on the middle that is left when the slopes are unknown too (Schur
                # complement)
                left = w - (wx * (xx * wx + xy * wy) + wy * (xy * wx + yy * wy))
                if left > MIN_DETERMINED_FRACTION * w:
                    move = (b - (bx * (xx * wx + xy * wy) + by * (xy * wx + yy * wy))) / left
                    information = left
                    slopes[y, x, 0] = xx * (bx - wx * move) + xy * (by - wy * move)
                    slopes[y, x, 1] = xy * (bx - wx * move) + yy * (by - wy * move)
            fitted[y, x, 0] = surface[y, x] + min(max(move, -gate), gate)
            fitted[y, x, 1] = 1 / np.sqrt(information)


@compiled
def sum_pair_lags(offsets, bin_time, count, lags):
    """Add to `lags` the histogram of the time between any two photons of a pixel, in whole bins."""
    for pixel in range(offsets.size - 1):
        for one in range(offsets[pixel], offsets[pixel + 1]):
            # pairs within one event have lag 0
            lags[0] += count[one] * (count[one] - 1) / 2
            for other in range(one + 1, offsets[pixel + 1]):
                lag = int(abs(bin_time[one] - bin_time[other]) + 0.5)
                if lag < lags.size:
                    lags[lag] += count[one] * count[other]


@compiled
def sum_evidence(
    offsets, bin_time, count, relative, surface, density, start, step, signal, evidence
):
    """Log-likelihood ratio of the photons of each pixel: its surface against light at any instant.
    `density` (n,): of the response over that of light spread over the whole axis, sampled from
    `start` by `step`; `relative` (events,): that light's course over the axis; `signal` (pixels,):
    share of the pixel's photons that are signal.
    """
    for pixel in range(surface.size):
        total = 0.0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            late = bin_time[event] - surface[pixel]
            ratio = interpolate_density(density, (late - start) / step) / relative[event]
            total += count[event] * np.log(1 + signal[pixel] * (ratio - 1))
        evidence[pixel] = total
