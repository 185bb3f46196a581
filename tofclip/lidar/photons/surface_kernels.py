"""The compiled steps of the search for a surface in photon events.

All times are in bins. Labels are the instants that a surface may have on a coarse time axis. Every
function is serial and holds no interpreter lock.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import compile_and_keep

compiled = compile_and_keep(error_model="numpy")
vectorised = compile_and_keep(error_model="numpy", fastmath=True)

MIN_PLANE_PIXELS = 6
"""A plane through fewer pixels is taken as level."""

MIN_DETERMINED_FRACTION = 1e-2
"""Of a pixel neighbourhood's information that must be left for its middle after the slopes."""

SLOPE_RIDGE_FRACTION = 1e-3
"""Of the information, in favour of level planes: keeps slopes finite where one row has photons."""


@compiled
def score_labels(offsets, coarse_bin, count, place, weights, first, score):
    """Log-likelihood ratio of a surface at each label against none: the log-matched filter.

    `offsets` (pixels + 1,); `coarse_bin` (events,): coarse bin of each event; `count` (events,);
    `place` (coarse bins,): label of each coarse bin, or -1 where no surface is looked for;
    `weights` (width,): log-likelihood ratio of a photon ``first + w`` coarse bins after the
    surface; `score` (pixels, labels).
    """
    for pixel in range(score.shape[0]):
        own = score[pixel]
        own[:] = 0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            for w in range(weights.size):
                label_bin = coarse_bin[event] - first - w
                if 0 <= label_bin < place.size and place[label_bin] >= 0:
                    own[place[label_bin]] += weights[w] * count[event]


@vectorised
def find_highest(values):
    """Largest of the values: four at a time, as one after the other each waits for the one before.

    `values` (n,): at least one.
    """
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
    """One step of semi-global matching; return the path's highest score.

    ``path[t] = score[t] + max(before[t], before[t -+ 1] - slope_cost, highest - jump_cost) -
    highest``; Hirschmueller, IEEE Trans. Pattern Anal. 30, 328 (2008), Eq. 13, with likelihoods
    where he has costs. `path` is overwritten and added to `total`.

    `score` (labels,): log-likelihood of each label at this pixel; `before` (labels,): the path at
    the pixel before; `highest`: its highest score; `slope_cost, jump_cost`: nats; `path` (labels,):
    overwritten; `total` (labels,): added to, in place.
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
    """Add the scores of the four paths that come from the left and from the row above.

    Called again with both picture axes reversed it adds the other four directions.

    `score` (rows, columns, labels); `slope_cost, jump_cost`: for a change of the label by one, and
    by any number; `total` (rows, columns, labels).
    """
    rows, columns, labels = score.shape
    above, here = (
        np.zeros((3, columns, labels), np.float32),
        np.zeros((3, columns, labels), np.float32),
    )
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

    `score, total` (pixels, labels); `extra_paths`: how often the paths counted a pixel's own score
    too often; `label` (pixels,); `margin` (pixels,).
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
def measure_events(offsets, bin_time, count, surface, table, start, step, brightness, sums):
    """What the photons of each pixel say about moving its surface.

    `offsets` (pixels + 1,); `bin_time, count` (events,); `surface` (pixels,): instant of the
    surface; `table` (n, 2): of the response, sampled from `start` by `step`: minus the slope of its
    logarithm, and its density over that of the background for one photon of signal; `start, step`:
    bins; `brightness` (pixels,): expected photons of the signal; `sums` (pixels, 3): slope of the
    log-likelihood with the instant, its Fisher information, photons of the signal.
    """
    for pixel in range(surface.size):
        slope = information = photons = 0.0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            position = (bin_time[event] - surface[pixel] - start) / step
            if not 0 <= position < table.shape[0] - 1:
                continue
            left = int(position)
            part = position - left
            push = table[left, 0] * (1 - part) + table[left + 1, 0] * part
            odds = brightness[pixel] * (table[left, 1] * (1 - part) + table[left + 1, 1] * part)
            # Probability that the photon is of the signal. The derivative of log(background +
            # signal) is the signal's own, weighted by it.
            belongs = odds / (1 + odds)
            slope += count[event] * belongs * push
            information += count[event] * (belongs * push) ** 2
            photons += count[event] * belongs
        sums[pixel, 0], sums[pixel, 1], sums[pixel, 2] = slope, information, photons


@compiled
def fit_planes(surface, sums, reach, gate, slopes, rows, fitted):
    """Move each pixel's surface to the most likely plane through the neighbours on the same one.

    Around the present surface the log-likelihood of every pixel is a parabola, so that a plane's
    is a weighted least-squares fit (one step of Fisher scoring).

    `surface` (rows, columns); `sums` (rows, columns, 3): see `measure_events`; `reach`: radius of
    the neighbourhood in pixels; 0: every pixel alone; `gate`: A neighbour further off the present
    plane lies on another surface; `slopes` (rows, columns, 2): of the plane, per column and per
    row; `rows`: first row and the one after the last; `fitted` (rows, columns, 3): instant, its
    standard deviation, and the mean photons of a neighbour.
    """
    height, width = surface.shape
    # of the rows of a disc
    half_widths = np.sqrt(reach * reach - np.arange(reach + 1.0) ** 2).astype(np.int64)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            slope_x, slope_y = slopes[y, x, 0], slopes[y, x, 1]
            here = surface[y, x]
            w = wx = wy = wxx = wxy = wyy = b = bx = by = photons = 0.0
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
            fitted[y, x, 2] = photons / max(pixels, 1)
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
    """Add to `lags` the histogram of the time between any two photons of a pixel, in whole bins.

    `offsets` (pixels + 1,): where each pixel's events begin; `bin_time` (events,): bins; `count`
    (events,): photons of each event; `lags` (lags,): added to, in place.
    """
    for pixel in range(offsets.size - 1):
        for one in range(offsets[pixel], offsets[pixel + 1]):
            # pairs within one event have lag 0
            lags[0] += count[one] * (count[one] - 1) / 2
            for other in range(one + 1, offsets[pixel + 1]):
                lag = int(abs(bin_time[one] - bin_time[other]) + 0.5)
                if lag < lags.size:
                    lags[lag] += count[one] * count[other]


@compiled
def sum_evidence(offsets, bin_time, count, surface, density, start, step, signal, evidence):
    """Log-likelihood ratio of the photons of each pixel: its surface against light at any instant.

    `offsets, bin_time, count, surface`: as for `measure_events`; `density` (n,): density of the
    response over that of light spread over the whole axis, sampled from `start` by `step`; `start,
    step`: bins; `signal` (pixels,): share of the pixel's photons that are signal; `evidence`
    (pixels,).
    """
    for pixel in range(surface.size):
        total = 0.0
        for event in range(offsets[pixel], offsets[pixel + 1]):
            position = (bin_time[event] - surface[pixel] - start) / step
            ratio = 0.0
            if 0 <= position < density.size - 1:
                left = int(position)
                part = position - left
                ratio = density[left] * (1 - part) + density[left + 1] * part
            total += count[event] * np.log(1 + signal[pixel] * (ratio - 1))
        evidence[pixel] = total
