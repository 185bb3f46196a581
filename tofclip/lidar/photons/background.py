"""The background's shape over time, learnt from what the histograms of many pixels have in common.

Light that comes back from nearby, fog, the ramp of a detector that counts first photons only: none
of them is even over the bins, and a detector that takes it for even raises alarms where it is
bright. All pixels see it alike, while their returns come at times of their own. So the mean over
the pixels is the background's shape but for the returns, which are told in two ways:

* **Clumps.** Where some pixels have a return and others have none, photons of one pixel come in
  clumps: their number varies more than a Poisson law allows. There the background is the lower part
  of a mixture (`find_lower_mean`).
* **The pulse's shape.** A wall at the same distance in all pixels makes no clumps. Its bump is as
  wide as a few pulses at most and stands on a level that goes on to either side (`remove_bumps`). A
  single hot bin is narrower, a decay has no level before it.

The mean is noisy; `segment_counts` joins neighbouring bins that do not differ.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

WINDOW_WIDTHS = 2.0
"""Length of the windows in which clumps are looked for, in widths of the pulse."""

MIN_HISTOGRAMS = 500
"""Fewer say too little of what they have in common."""

CLUMP_SIGNIFICANCE = 5.0
BLOCK_COST = 6.0
"""Log-likelihood that a further block has to bring."""

MAX_USUAL_COUNT = 500
"""Photons of a window above four times the median: beyond, their number does not matter."""

MAX_COUNTED = 4000
"""Photons up to which numbers of them are told apart one by one; of more, they are rounded."""

BUMP_WIDTHS = (1.0, 1.6, 2.5)
"""Widths of a bump that a surface may make, in widths of the pulse."""

BUMP_SIGNIFICANCE = 5.0
MAX_MISFIT_SHARE = 0.1
"""Of a bump's energy that the pulse's shape may leave; a single bin leaves half of it."""

MIN_UNEVENNESS = 0.1
"""A background that differs by less, or by less than its noise, from an even one is even."""


def learn_background(histograms: FloatArray, width: float) -> FloatArray | None:
    """Estimate the background's shape.

    Parameters
    ----------
    histograms : (n, bins) array
        Photons.
    width : float
        Full width at half maximum of the pulse, bins.

    Returns
    -------
    (bins,) float64 array or None
        Relative to its mean. None where it is even as far as these histograms say, or where they
        are too few to say anything.
    """
    total = histograms.sum(axis=0)
    number, bins = histograms.shape
    if number < MIN_HISTOGRAMS or not total.any():
        return None
    length = max(2, round(WINDOW_WIDTHS * width))
    edges = np.arange(0, bins, length)
    # A short last window has too few photons of its own: it joins the one before.
    if bins - edges[-1] < length / 2 and edges.size > 1:
        edges = edges[:-1]
    counts = np.add.reduceat(histograms, edges, axis=1)
    sizes = np.diff(np.append(edges, bins))
    background = remove_bumps(segment_counts(total), total, width)
    for window in np.flatnonzero(find_clumps(counts)):
        # Where pixels come in clumps the mean holds returns; the background's own form within the
        # window stays, its level is that of the lower part of the mixture.
        here = slice(edges[window], edges[window] + sizes[window])
        lower = number * find_lower_mean(counts[:, window])
        background[here] *= min(1.0, lower / max(background[here].sum(), 1e-9))
    relative = background / background.mean()
    noise = 1 / np.sqrt(np.maximum(np.add.reduceat(background, edges), 1.0))
    unevenness = np.abs(np.add.reduceat(relative, edges) / sizes - 1)
    # A single bin may be uneven where no window is: the edge of a gate, or a hot bin.
    sharp = np.abs(relative - 1) > np.maximum(MIN_UNEVENNESS, 5 / np.sqrt(np.maximum(total, 1)))
    if np.all(unevenness < np.maximum(MIN_UNEVENNESS, 5 * noise)) and not sharp.any():
        return None
    return np.asarray(relative)


def segment_counts(counts: FloatArray) -> FloatArray:
    """Return the mean of each block of bins that do not differ.

    `counts` (bins,): Poisson distributed. Returns (bins,).

    J. D. Scargle and others, Astrophys. J. 764, 167 (2013): the most likely piecewise constant
    course, by dynamic programming. Memory and time grow with the square of the bins.
    """
    summed = np.concatenate([[0.0], np.cumsum(counts)])
    places = np.arange(counts.size + 1.0)
    best, last = np.zeros(counts.size + 1), np.zeros(counts.size, np.int64)
    for end in range(1, counts.size + 1):
        # N ln(N / T) of every block that ends here, Scargle's Eq. 19: the likelihood of a constant
        # rate at its best.
        photons = summed[end] - summed[:end]
        # 0 ln 0 is 0: a block without photons neither gains nor loses.
        gain = photons * np.log(np.maximum(photons, 1e-300) / (end - places[:end]))
        reached = gain + best[:end] - BLOCK_COST
        last[end - 1] = int(np.argmax(reached))
        best[end] = reached[last[end - 1]]
    level, end = np.empty(counts.size), counts.size
    # Backwards from the end: each block's best start says where the one before ends.
    while end > 0:
        start = int(last[end - 1])
        level[start:end] = (summed[end] - summed[start]) / (end - start)
        end = start
    return level


def find_clumps(counts: FloatArray) -> NDArray[np.bool_]:
    """Say in which windows the photons of a pixel vary more than a Poisson law allows.

    `counts` (n, windows): photons of each histogram. Returns (windows,).
    """
    whole = counts.sum(axis=1, keepdims=True)
    share = counts.sum(axis=0) / max(float(whole.sum()), 1.0)
    expected = whole * share
    # of photons thrown over the windows, those of one are binomial
    variance = (expected * (1 - share)).sum(axis=0)
    spread = ((counts - expected) ** 2).sum(axis=0) / np.maximum(variance, 1e-9)
    mean = np.maximum(expected.mean(axis=0), 1e-9)
    limit = 1 + CLUMP_SIGNIFICANCE * np.sqrt((2 + 1 / mean) / counts.shape[0])
    return np.asarray(spread > limit)


def find_lower_mean(counts: FloatArray) -> float:
    """Return the mean of the lower part of a mixture: background, and background with a return.

    Numbers of a return's photons are taken as geometrically distributed, so that returns of any
    strength find room; fraction and mean of either part are those of the largest likelihood.

    `counts` (n,): photons of a window.
    """
    # What is far beyond the usual is no background, and a list as long as its photons takes hours.
    limit = 4 * float(np.median(counts)) + MAX_USUAL_COUNT
    unit = max(1.0, limit / MAX_COUNTED)
    seen = np.bincount((np.minimum(counts, limit) / unit).astype(np.int64))
    several = np.arange(seen.size)
    logs = scipy.special.gammaln(several + 1)

    def misfit(parameters: FloatArray) -> float:
        share, lower, strength = unpack(parameters)
        dark = np.exp(several * np.log(lower) - lower - logs)
        odds = strength / (1 + strength)
        # the convolution with a geometric law, as a recursion
        bright = scipy.signal.lfilter([1 / (1 + strength)], [1.0, -odds], dark)
        return -float(seen @ np.log((1 - share) * dark + share * bright + 1e-300))

    def unpack(parameters: FloatArray) -> tuple[float, float, float]:
        share = 1 / (1 + np.exp(-np.clip(parameters[0], -20, 20)))
        lower, strength = np.exp(np.clip(parameters[1:], -20, 20))
        return float(share), float(lower), float(strength)

    mean = float(seen @ several) / counts.size
    # what the darkest quarter would have if it were all background
    quarter = int(np.searchsorted(np.cumsum(seen), counts.size / 4))
    reached = float(seen[: quarter + 1].sum()) / counts.size
    lower = float(scipy.special.gammainccinv(quarter + 1, min(reached, 0.999)))
    start = np.array([-1.0, np.log(max(lower, 1e-6)), np.log(max(mean - lower, 0.3) + 1.0)])
    found = scipy.optimize.minimize(misfit, start, method="Nelder-Mead").x
    return unit * min(unpack(found)[1], mean)


def remove_bumps(level: FloatArray, counts: FloatArray, width: float) -> FloatArray:
    """Take off what a surface at the same distance in all pixels brings.

    `level` (bins,): counts, smoothed; `counts` (bins,): of all pixels; `width`: full width at half
    maximum of the pulse, bins. Returns (bins,): `level`, with a straight line in place of each
    bump.
    """
    smooth = level.copy()
    for ratio in BUMP_WIDTHS:
        wide = ratio * width
        # At 1.3 widths from its middle a Gaussian is below 1 % of its height: the core holds the
        # bump, the flanks as much again of the level beside it.
        core, flank = int(np.ceil(1.3 * wide)), int(np.ceil(2.6 * wide))
        offsets = np.arange(-core, core + 1)
        shape = np.exp2(-((2 * offsets / wide) ** 2))
        if flank < 2 or 2 * flank >= counts.size:
            continue
        for middle in range(flank, counts.size - flank):
            # A bump has its middle at a local maximum.
            around = smooth[middle - core : middle + core + 1]
            if smooth[middle] < around.max():
                continue
            before = counts[middle - flank : middle - core].mean()
            after = counts[middle + core + 1 : middle + flank + 1].mean()
            line = before + (after - before) * (offsets + flank) / (2 * flank)
            excess = counts[middle - core : middle + core + 1] - line
            # Least squares for the height of a known shape; its noise is that of the line beneath
            # it.
            height = float(shape @ excess) / float(shape @ shape)
            noise = np.sqrt(max(float(shape**2 @ np.maximum(line, 1.0)), 1.0)) / (shape @ shape)
            if height < BUMP_SIGNIFICANCE * noise:
                continue
            # What the shape leaves, less what the photons' noise alone would: a decay or a lone bin
            # leaves much, a return little.
            left = float(np.sum((excess - height * shape) ** 2) - np.sum(line + height * shape))
            if left < MAX_MISFIT_SHARE * height**2 * float(shape @ shape):
                smooth[middle - core : middle + core + 1] = line
    return smooth
