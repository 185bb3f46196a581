"""What a picture's photons are made of: the response to a return, and the background.

**Response.** Two photons of one surface in one pixel differ in time by what the response spreads
them: the histogram of such differences is the response's autocorrelation, whatever the scene. It
gives the width; the shape is what photons show around a surface that other photons found.

**Background.** Light that comes back from nearby, fog, the ramp of a detector that counts first
photons only: none of them is even over the bins, and a detector that takes it for even raises alarms
where it is bright. All pixels see it alike, while their returns come at times of their own. So the
mean over the pixels is the background's shape but for the returns, which are told in two ways:

* **Clumps.** Where some pixels have a return and others have none, photons of one pixel come in
  clumps: their number varies more than a Poisson law allows. There the background is the lower part
  of a mixture (`find_lower_mean`).
* **The pulse's shape.** A wall at the same distance in all pixels makes no clumps. Its bump is as
  wide as a few pulses at most and stands on a level that goes on to either side (`remove_bumps`). A
  single hot bin is narrower, a decay has no level before it.

The mean is noisy; `segment_counts` joins neighbouring bins that do not differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import BoolArray, FloatArray, IntArray
from tofclip.errors import InputError
from tofclip.lidar.photons.image import PhotonImage, Shading, find_hot_pixels, leave_out_pixels
from tofclip.lidar.pulse import Pulse
from tofclip.units import PICOSECOND

MAX_LAG_FRACTION = 0.25  # of the time axis: photons further apart than this are not of one pulse
MAX_TAIL_RATIO = 4.0  # of a pulse with its tails over one without: beyond, the background is uneven
MIN_LAG_SIGNIFICANCE = 8.0  # standard deviations of pairs beyond those that meet by chance
SAMPLES_PER_WIDTH = 24
SMOOTHING_WIDTHS = 1 / 6
MIN_SHAPE_BINS = 2.5  # of a response at half of its height: fewer show no shape
# Full widths before and after the surface in which the response is learnt (tails are long), and
# where only background is expected.
EXTENT_WIDTHS, BACKGROUND_WIDTHS = (-3.0, 9.0), (-8.0, -4.0)
MIN_PULSE_S = 1e-12  # superconducting counters, the quickest there are, spread a pulse over 3 ps
# Of the gaps between bins with photons, the one that is taken for the counter's step; and how many
# such bins with how many photons each say that the bins between them stay empty for a reason.
STEP_QUANTILE, MIN_STEP_BINS, MIN_PHOTONS_PER_STEP = 0.05, 64, 4.0
SAMPLED_PIXELS = 1024  # whose background stands for that of all around surfaces
MAX_CELLS = 1 << 26  # bins of all pixels; longer time axes are put together, for memory's sake
DENSITY_FLOOR = 1e-4  # of the peak: no instant is impossible, so that no single photon decides
LEARNT_SLOPE_FLOOR = 0.03
MIN_SIGNAL_PHOTONS = 0.05
BACKGROUND_QUANTILE, BACKGROUND_GROUPS = 0.2, 64
SHADE_RATIO = 1.1  # backgrounds that differ by less share a filter; thresholds hold for any filter
# Cells of picture and time that show the background's course: pixels of a side; at most and at least so many
# stretches, none shorter than two pulses; photons of the background in a cell; and the stretches of which
# the median counts, as a surface fills less than half of them. What differs by less than the ratio is even.
MIN_CELL_PX, MAX_CELL_PX, MIN_CELL_PHOTONS = 8, 32, 16.0
STRETCHES, MIN_STRETCHES, STRETCH_WIDTHS, CELLS_AROUND = 64, 32, 2.0, 9
MIN_SHADING_RATIO, MIN_SHADE = 1.5, 1e-3
# Parts of the record in most of which bins have to be uneven; in so many widths of the pulse to either side no
# light varies as they do; and by how many standard deviations, and by how much, they have to.
UNEVEN_PARTS, UNEVEN_WIDTHS, UNEVEN_SIGMAS, MIN_UNEVEN_BINS = 16, 4.0, 5.0, 0.03
# of parts' variance over that around a cubic: one in a hundred of chance alone is beyond
MIN_SLOW_RATIO = 2.5
MIN_BIN, MAX_BIN = 0.05, 2.0  # lengths of bins that are believed, over their mean
MIN_BACKGROUND_PHOTONS = 1.0  # of the whole picture: no background is exactly zero


@dataclass(frozen=True)
class BinnedResponse:
    """Density of a signal photon's time around its surface, as bins show it."""

    pulse: Pulse  # shape of a return, bins included
    bin_width: float  # s
    slope_floor: float = 0.0  # of the peak: how bright it has to be for its slope to be known

    @property
    def step(self) -> float:
        """Time between two samples, in bins."""
        return self.pulse.spacing / self.bin_width

    @property
    def start(self) -> float:
        """Time of the first sample after the surface, in bins."""
        return -self.pulse.origin * self.step

    @property
    def width(self) -> float:
        """Full width at half maximum, in bins."""
        return self.pulse.fwhm / self.bin_width

    @cached_property
    def density(self) -> FloatArray:
        """Probability density of a photon's time at each sample, per bin."""
        samples = np.maximum(self.pulse.samples, DENSITY_FLOOR)
        return samples / (samples.sum() * self.step)

    @property
    def times(self) -> FloatArray:
        """Time of each sample after the surface, in bins."""
        return self.start + self.step * np.arange(self.density.size, dtype=np.float64)

    @cached_property
    def log_slope(self) -> FloatArray:
        """Minus the slope of the density's logarithm at each sample, per bin; where the response is
        faint, chance in what was learnt is not taken for a slope.
        """
        faint = self.slope_floor * self.density.max()
        return -np.gradient(np.log(self.density + faint), self.step)

    def coarse_shares(self, coarse: int) -> tuple[FloatArray, int]:
        """Share of the photons in each of the coarse bins, of so many bins, around the one that holds
        the surface, anywhere in it; and the number of the first relative to the surface's.
        """
        inside = np.arange(8) / 8 + 1 / 16 - 0.5  # eight places, in the middles of eighths
        number = np.floor(self.times[:, np.newaxis] / coarse + inside + 0.5).astype(np.int64)
        first = int(number.min())
        weight = np.repeat(self.density, inside.size)
        shares = np.bincount((number - first).ravel(), weight).astype(np.float64)
        shares /= shares.sum()
        # Shares of a thousandth of the greatest change no decision, but make every sum longer.
        kept = np.flatnonzero(shares > 1e-3 * shares.max())
        return shares[kept[0] : kept[-1] + 1], first + int(kept[0])


@dataclass(frozen=True)
class Scene:
    """What a picture's photons are taken to be made of."""

    response: BinnedResponse
    background: float  # photons of a pixel in a bin

    @classmethod
    def start(cls, photons: PhotonImage, pulse: Pulse) -> Scene:
        """Take the pulse, spread over the bins, and as background what most instants have."""
        groups = min(BACKGROUND_GROUPS, photons.bins)
        edges = np.linspace(0, photons.bins, groups + 1).astype(np.int64)
        level = np.add.reduceat(photons.time_profile, edges[:-1]) / np.diff(edges)
        # a low quantile: bins with a surface in them are brighter than the background
        quiet = float(np.quantile(level, BACKGROUND_QUANTILE))
        background = max(quiet, MIN_BACKGROUND_PHOTONS / photons.bins) / photons.pixels
        if photons.shading is not None:
            background = photons.shading.mean
        shape = pulse.integrate_bins(photons.bin_width)
        return cls(BinnedResponse(shape, photons.bin_width), background)

    def scale(self, fraction: float) -> Scene:
        """Return what remains with a fraction of the photons."""
        return Scene(self.response, self.background * fraction)

    def count_signal(self, photons: PhotonImage) -> float:
        """Mean signal photons of a pixel."""
        mean = photons.photons / photons.pixels
        return max(mean - self.background * photons.bins, MIN_SIGNAL_PHOTONS)


def prepare_photons(
    photons: PhotonImage, pulse: Pulse | None, join: bool = True
) -> tuple[PhotonImage, Pulse, BoolArray]:
    """Return the photons of all but hot pixels, in bins that the counter tells apart if they are to
    be joined; the pulse, or the one as wide as pairs of photons say; and the hot pixels.
    """
    hot = find_hot_pixels(photons)
    photons = leave_out_pixels(photons, hot)
    if join:
        photons = photons.join_bins(find_time_step(photons))
    pulse = Pulse.gaussian(measure_pulse_width(photons)) if pulse is None else pulse
    require_plausible_pulse(photons, pulse)
    if join and photons.bins * photons.pixels > MAX_CELLS:
        # photons keep their times, and a pulse that is spread over a quarter of itself its width
        photons = photons.join_bins(max(int(pulse.fwhm / 4 / photons.bin_width), 1))
    return photons, pulse, hot


def find_time_step(photons: PhotonImage) -> int:
    """Return the bins between the instants that a counter tells apart: photon times in units of
    1 ps come in steps of its converter, and pairs of equal times are no pulse.
    """
    filled = np.flatnonzero(photons.time_profile)
    if filled.size < MIN_STEP_BINS or photons.photons < MIN_PHOTONS_PER_STEP * filled.size:
        return 1
    return int(np.quantile(np.diff(filled), STEP_QUANTILE))


def require_plausible_pulse(photons: PhotonImage, pulse: Pulse) -> None:
    """Refuse a pulse that no counter shows, or that is longer than the record, as of a wrong unit."""
    if MIN_PULSE_S <= pulse.fwhm <= photons.bins * photons.bin_width:
        return
    is_short = pulse.fwhm < MIN_PULSE_S
    fault = "shorter than any counter's" if is_short else f"longer than all {photons.bins} bins"
    raise InputError(
        f"a pulse of {pulse.fwhm / PICOSECOND:.3g} ps in bins of {photons.bin_width / PICOSECOND:.4g} "
        f"ps is {fault}; check the unit of `bin_width`"
    )


def measure_pulse_width(photons: PhotonImage) -> float:
    """Estimate the full width at half maximum of the response, s, from pairs of photons: that of the
    Gaussian whose autocorrelation falls to half as soon.
    """
    from tofclip.lidar.photons.kernels import sum_pair_lags

    number = max(8, int(MAX_LAG_FRACTION * photons.bins))
    lags = np.zeros(number)
    sum_pair_lags(photons.offsets, photons.bin, photons.count, lags)
    lags[0] *= 2  # the others come with both signs
    # Photons that meet by chance: the further apart, the fewer bins there are for both.
    open_bins = photons.bins - np.arange(number)
    middle = np.median((lags / open_bins)[number // 2 :])
    group, found = 1, dict[bool, float]()
    while number // group >= 8 and True not in found:
        pieces = number // group
        pairs, rest = (
            part[: pieces * group].reshape(pieces, group).sum(axis=1) for part in (lags, open_bins)
        )
        reach = 1
        while True:
            # Where a background changes slowly, they are as many as a parabola through the lags
            # beyond the pulse says.
            outside, alone = slice(4 * reach, 8 * reach), 8 * reach > pieces
            level = np.full(pieces, middle)
            if not alone:
                squared, weight = (np.arange(pieces) + 0.5) ** 2, np.sqrt(rest[outside])
                fit = np.polyfit(squared[outside], (pairs / rest)[outside], 1, w=weight)
                level = np.polyval(fit, squared)
            expected = np.maximum(level * rest, 0)
            excess = pairs - expected
            # counts below one make negative pairs: a photon is none with itself
            if excess[0] > MIN_LAG_SIGNIFICANCE * np.sqrt(max(expected[0] + pairs[0], 0.0) + 1):
                below = np.flatnonzero(excess < excess[0] / 2)
                if below.size and (alone or below[0] <= 1.5 * reach):
                    last = int(below[0])
                    part = (excess[last - 1] - excess[0] / 2) / (excess[last - 1] - excess[last])
                    half = (last - 1 + part + (0.5 if group > 1 else 0.0)) * group
                    found.setdefault(alone, np.sqrt(2) * max(half, 0.5) * photons.bin_width)
            if alone:
                break
            reach *= 2
        group *= 2
    if found:
        # beyond the even background there are the pulse's own tails, unless they are much wider
        wide, narrow = found.get(True, np.inf), found.get(False, np.inf)
        return float(narrow if wide > MAX_TAIL_RATIO * narrow else wide)
    raise InputError(
        "no pulse stands out from the background in these photons; give its width (`pulse`)"
    )


def group_shades(relative: NDArray[np.floating]) -> tuple[FloatArray, IntArray]:
    """Return backgrounds over their mean that stand for the given ones, and which of them each has."""
    step = np.rint(np.log(relative) / np.log(SHADE_RATIO)).astype(np.int64)
    first = int(step.min())
    return SHADE_RATIO ** np.arange(first, int(step.max()) + 1.0), step - first


def learn_shading(photons: PhotonImage, width: float) -> Shading | None:
    """Find the course of the background over picture and time, of a pulse of `width` bins: the median
    of the cells around each, of which a surface fills few. None where it is even, or where too few
    photons say otherwise.
    """
    number, cell = int(min(STRETCHES, photons.bins / (STRETCH_WIDTHS * width))), MIN_CELL_PX
    while number >= MIN_STRETCHES:
        sides = *(-(-side // cell) for side in photons.image_shape), number
        y, x = (np.arange(n) * m // n for n, m in zip(photons.image_shape, sides[:2], strict=True))
        place = (y[:, np.newaxis] * sides[1] + x).ravel()
        late = ((photons.bin + 0.5) * (number / photons.bins)).astype(np.int64)
        own = place[photons.pixel] * number + np.clip(late, 0, number - 1)
        light = np.bincount(own, photons.count, math.prod(sides)).reshape(-1, number)
        # a third of a photon, by which the median of few lies below their mean
        density = (light + 1 / 3) / (np.bincount(place)[:, np.newaxis] * photons.bins / number)
        # A course that rises or falls goes on beyond the record.
        beyond = (0, 0), (0, 0), 2 * (CELLS_AROUND // 2,)
        padded = np.pad(np.log(density.reshape(sides)), beyond, "reflect", reflect_type="odd")
        usual = np.exp(scipy.ndimage.median_filter(padded, (3, 3, CELLS_AROUND)))
        usual = usual[..., CELLS_AROUND // 2 : -(CELLS_AROUND // 2)]
        mean = float(usual.mean())
        if mean * place.size * photons.bins >= MIN_CELL_PHOTONS * usual.size:
            level = np.maximum(usual / mean, MIN_SHADE)
            low, high = np.quantile(level, (0.05, 0.95))
            even = high < MIN_SHADING_RATIO * low
            return None if even else Shading(level, photons.image_shape, photons.bins, mean)
        cell, number = (2 * cell, number) if cell < MAX_CELL_PX else (cell, number // 2)
    return None


def even_out_bins(
    original: PhotonImage, photons: PhotonImage, layers: FloatArray, width: float
) -> PhotonImage | None:
    """Find where the bins of an uneven converter lie by the background that they count away from surfaces
    at `layers` (layers, rows, columns), in bins, of a pulse of `width` bins; return the `original`
    photons, hot pixels' among them, on an even axis. None where bins are even as far as the photons
    say, where the background is not, or where times are not in whole bins, the converter's own.
    """
    bins, whole = photons.bins, photons.bin.astype(np.int64)
    own = bins == original.bins and photons.bin_sigma is None and not photons.sampled
    if not own or np.any(photons.bin != whole):
        return None
    windows = [layers.reshape(len(layers), -1) + edge * width for edge in EXTENT_WIDTHS]
    free = np.ones(whole.size, np.bool_)
    for early, late in zip(*windows, strict=True):
        free &= ~((whole >= early[photons.pixel]) & (whole < late[photons.pixel]))
    light = photons.count * free
    level = photons.sum_by_pixel(light).ravel() / bins
    hidden = np.zeros(bins + 1)  # of the background, by windows around surfaces
    for ends, sign in zip(windows, (1, -1), strict=True):
        known = np.isfinite(ends)
        place = np.clip(np.ceil(ends[known]), 0, bins).astype(np.int64)
        hidden += sign * np.bincount(place, np.broadcast_to(level, ends.shape)[known], bins + 1)
    expected = np.maximum(level.sum() - np.cumsum(hidden[:-1]), MIN_BACKGROUND_PHOTONS / bins)
    seen = np.bincount(whole, light, bins)
    parts = np.array_split(np.arange(bins), UNEVEN_PARTS)
    counted, bright = np.array([[seen[p].sum(), expected[p].sum()] for p in parts]).T
    if counted.min() <= 0:
        return None
    # What changes slowly is light, unless parts differ as much from a cubic as they do from each other.
    ratio = counted / bright - counted.sum() / bright.sum()
    course = np.polyfit(np.arange(UNEVEN_PARTS), ratio, 3)
    smooth = np.polyval(course, np.arange(UNEVEN_PARTS))
    level = counted.sum() / bright.sum() + smooth
    if not 0 < level.max() < MIN_SHADING_RATIO * level.min():
        return None
    slow = np.sum(ratio**2) > MIN_SLOW_RATIO * np.sum((ratio - smooth) ** 2)
    if slow:
        where = (np.arange(bins) + 0.5) * UNEVEN_PARTS / bins - 0.5
        expected *= 1 + np.polyval(course, where) * bright.sum() / counted.sum()
    expected *= seen.sum() / expected.sum()
    noise, excess = 1 / expected, seen / expected - 1
    window = min(2 * round(UNEVEN_WIDTHS * width) + 1, bins // UNEVEN_PARTS)
    quick = excess - scipy.ndimage.uniform_filter1d(excess, window)

    def vary(values: FloatArray) -> float:
        # light that returns from one place in all pixels is uneven in one part
        return float(np.median([np.mean(values[part]) for part in parts]))

    chance = UNEVEN_SIGMAS * 1.25 * np.sqrt(2 / bins)
    if vary(quick**2 / noise) < 1 + chance or vary(quick**2 - noise) < MIN_UNEVEN_BINS**2:
        return None
    usual = max(vary(excess**2 - noise), MIN_UNEVEN_BINS**2)
    # Wiener's estimate, and what it leaves: of a slow course no share is known to be the bins'.
    trusted = usual / (usual + noise)
    edges = np.concatenate([[0], np.cumsum(np.clip(1 + excess * trusted, MIN_BIN, MAX_BIN))])
    left = np.concatenate([[0], np.cumsum(usual * (1 - trusted * (not slow)))])
    part = np.arange(bins + 1) / bins
    # of a sum of lengths whose total is known
    sigma = np.sqrt(left * (1 - part) ** 2 + (left[-1] - left) * part**2)
    return original.even_out(edges * (bins / edges[-1]), (sigma[1:] + sigma[:-1]) / 2)


def learn_response(
    test: PhotonImage, train: PhotonImage, scene: Scene, fitted: FloatArray
) -> tuple[Scene, float]:
    """Estimate the response from the photons `test` after a surface that others found, as of
    `matching.fit_surface`. Returns the scene with the response, whose arrival is its highest point,
    and by how many bins later this is than the arrival was before.
    """
    from tofclip.lidar.photons import kernels

    width, flat = scene.response.width, np.ascontiguousarray(fitted[..., 0]).ravel()
    step = width / SAMPLES_PER_WIDTH
    first, last = (round(edge * SAMPLES_PER_WIDTH) for edge in EXTENT_WIDTHS)
    early = [round(edge * SAMPLES_PER_WIDTH) for edge in BACKGROUND_WIDTHS]
    # of each slot: photons, how often it was open to them, and to how much signal
    sums = np.zeros((last - early[0] + 1, 3))
    if np.isinf(test.cycles):
        number = np.rint((test.bin - flat[test.pixel]) / step).astype(np.int64)
        known = (number >= early[0]) & (number <= last)
        sums[:, 0] = np.bincount(number[known] - early[0], test.count[known], len(sums))
        sums[:, 1:] = 1
    else:
        events, response = (test.offsets, test.bin, test.count, flat), scene.response
        density = response.density, response.start, response.step
        light, dark = fitted[..., 2].ravel() / train.cycles, scene.background / train.cycles
        dead = dark, test.cycles, (early[0], step)
        kernels.tally_first_photons(*events, light, *density, *dead, sums)
    if test.shading is not None:
        some = np.arange(0, flat.size, -(-flat.size // SAMPLED_PIXELS))
        slot = step * np.arange(early[0], last + 1)[:, np.newaxis]
        sums[:, 1] = test.shading.at(*np.broadcast_arrays(some, flat[some] + slot)).mean(axis=1)
    # Before the pulse there is only background; behind it its own tail would count as one.
    before = sums[: early[1] - early[0]].sum(axis=0)
    sums[:, 0] -= sums[:, 1] * before[0] / max(before[1], 1e-9)
    start, width_seen = first - early[0], float(SAMPLES_PER_WIDTH) / 2
    response, slots = scene.response, step * np.arange(early[0], last + 1)
    shares = np.interp(slots, response.times, response.density, 0, 0)
    known = np.maximum(shares, DENSITY_FLOOR / width)
    sums[:, 2] *= known
    # As smooth as its own width allows, which is not known before it has been smoothed once. What is
    # smooth is the ratio to the response known before: the response gets no wider.
    for _ in range(2):
        smooth = scipy.ndimage.gaussian_filter1d(sums, SMOOTHING_WIDTHS * width_seen, axis=0)
        # A density is not negative, whatever noise does to the tail.
        change = np.maximum(smooth[:, 0], 0.0) / np.maximum(smooth[:, 2], 1e-9)
        shape = (known * change)[start:]
        if not shape.any():
            raise InputError("there is no light around the surface to learn the pulse from")
        peak = int(np.argmax(shape))
        low = np.flatnonzero(np.pad(2 * shape <= shape[peak], 1, constant_values=True)) - 1
        after = int(np.searchsorted(low, peak))
        near = np.arange(low[after - 1] + 1, low[after])
        width_seen = float(near.size)
    # Vertex of the parabola through the logarithm of all that is above half of the peak, each sample
    # weighing as its photons: the highest sample alone moves by an eighth of the width with chance. Of
    # a response as short as a few bins, as a gate's in coarse steps, no shape is seen.
    part = 0.0
    if near.size * step > MIN_SHAPE_BINS:
        weight = np.sqrt(shape[near])
        bend, slope, _ = np.polyfit(near - peak, np.log(shape[near]), 2, w=weight)
        vertex = -slope / (2 * bend) if bend < 0 else 0.0
        part = float(np.clip(vertex, near[0] - peak, near[-1] - peak))
    pulse = Pulse(shape, step * test.bin_width, peak + part)
    learnt = BinnedResponse(pulse, test.bin_width, LEARNT_SLOPE_FLOOR)
    return Scene(learnt, scene.background), (first + peak + part) * step


WINDOW_WIDTHS = 2.0  # length of the windows in which clumps are looked for, in widths of the pulse
MIN_HISTOGRAMS = 500  # fewer say too little of what they have in common
CLUMP_SIGNIFICANCE = 5.0
BLOCK_COST = 6.0  # log-likelihood that a further block has to bring
MAX_USUAL_COUNT = 500  # photons of a window beyond four times the median: more say no more
MAX_COUNTED = 4000  # up to which numbers of photons are told apart one by one; more are rounded
BUMP_WIDTHS = (1.0, 1.6, 2.5)  # of what a surface may make, in widths of the pulse
BUMP_SIGNIFICANCE = 5.0
# of a bump's energy beside the pulse's shape; a single bin leaves half of it
MAX_MISFIT_SHARE = 0.1
MIN_UNEVENNESS = 0.1  # backgrounds that differ by less, or less than their noise, are even


def learn_background(histograms: FloatArray, width: float) -> FloatArray | None:
    """Estimate the background's shape, (bins,) relative to its mean, from `histograms` (n, bins) of
    photons, of pulses of full width at half maximum `width`, bins. None where it is even as far as
    these say, or where they are too few to say anything.
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
    return relative


def segment_counts(counts: FloatArray) -> FloatArray:
    """Return the most likely piecewise constant course of Poisson counts, (bins,), by dynamic
    programming (J. D. Scargle and others, Astrophys. J. 764, 167, 2013).
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


def find_clumps(counts: FloatArray) -> BoolArray:
    """Say in which windows photons of pixels, (n, windows), vary more than a Poisson law allows."""
    whole = counts.sum(axis=1, keepdims=True)
    share = counts.sum(axis=0) / max(float(whole.sum()), 1.0)
    expected = whole * share
    # of photons thrown over the windows, those of one are binomial
    variance = (expected * (1 - share)).sum(axis=0)
    spread = ((counts - expected) ** 2).sum(axis=0) / np.maximum(variance, 1e-9)
    mean = np.maximum(expected.mean(axis=0), 1e-9)
    limit = 1 + CLUMP_SIGNIFICANCE * np.sqrt((2 + 1 / mean) / counts.shape[0])
    return spread > limit


def find_lower_mean(counts: FloatArray) -> float:
    """Return the mean of the lower part of a mixture: background, and background with a return.
    Numbers of a return's photons are taken as geometrically distributed, so that returns of any
    strength find room; fraction and mean of either part are those of the largest likelihood.
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
    """Return the smoothed level with straight lines where a surface at the same distance in all
    pixels makes a bump, in pulses of `width` bins.
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
            # The means are those of the flanks' middles, core + flank + 1 bins apart.
            line = (before + after) / 2 + (after - before) * offsets / (core + flank + 1)
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
