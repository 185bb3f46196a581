"""Returns in histograms of photons, at a stated rate of false alarms, and of pixels that each stand
alone; what a detector that goes blind after each photon would have counted without (pile-up); and how well
a return can be located at all, the Cramer-Rao bound, with trials beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.arrays import BoolArray, FloatArray, IntArray
from tofclip.errors import InputError, ShapeError
from tofclip.lidar.photons.image import PhotonImage, SurfaceImage, add_errors
from tofclip.lidar.photons.scene import (
    even_out_bins,
    group_shades,
    learn_background,
    prepare_photons,
)
from tofclip.lidar.pulse import Pulse, Table
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT

CALIBRATION_HISTOGRAMS = 20_000  # for each threshold: a rate of 1 % is met to within 7 % of itself
CALIBRATION_SEED = 20220614
MIN_FALSE_ALARM_RATE = 20 / CALIBRATION_HISTOGRAMS
DITHER = 1e-6  # breaks ties between scores; far below any difference that photons make
HISTOGRAMS_PER_BATCH = 2000
DENSE_PHOTONS_PER_BIN = 8  # beyond, drawing the bins is quicker than throwing the photons
MAX_EXACT_PHOTONS = 40  # up to this number of photons every one has a threshold of its own
THRESHOLD_RATIO = 1.2  # beyond, of the numbers for which there is one: others lie between
PHOTON_LEVEL_RATIO = 1.03  # numbers that differ by less share a filter
PULSE_CUTOFF = 1e-4  # of its peak: what a pulse brings beyond it is not worth the bins
HISTOGRAMS_PER_BLOCK = 1024  # of a live picture of as many pixels no thread is started
MIN_RELATIVE_BACKGROUND = 1e-3  # of a usual bin; no bin is so dark that one photon decides
NO_PILE_UP = 1e15  # cycles: the rate of any bin is as good as zero
MAX_THRESHOLDS = 4096  # that are remembered, a number each
# Returns between two steps of a gate of which the error is found: photons of a picture in which a
# return is seen, background as a share of them, and how well noise lets their place in a step be known
STEP_PHASES, STEP_PHOTONS, STEP_BACKGROUND, STEP_BLUR = 64, 200.0, 0.02, 0.05
# a bin that hardly any cycle reaches says nothing, but not with infinite surety
MIN_LIVE_CYCLES = 0.5
SAMPLED_PIXELS = 8192  # that say what the pixels' background has in common


def correct_pile_up(
    counts: NDArray[np.integer] | NDArray[np.floating], cycles: int, dead_bins: int | None = None
) -> FloatArray:
    """Turn a histogram of a detector with dead time into the photons that arrived (Coates 1968).

    A bin counts only in the cycles in which no photon shortly before has blinded the detector. The
    fraction of these live cycles with a count is ``1 - exp(-rate)``, which is solved for the rate.
    Bins that few cycles reach become noisier than Poisson.

    Parameters
    ----------
    counts : (..., bins) array
        Photons counted in each bin; at most one a cycle and bin.
    cycles : int
        Laser cycles that made the histogram; every cycle starts with a ready detector.
    dead_bins : int, optional
        Bins after a count during which nothing is counted. By default the rest of the cycle: the
        detector counts only the first photon of a cycle.

    Returns
    -------
    (..., bins) float64 array
        Expected photons in each bin over all cycles; NaN in bins that no live cycle reached, and
        where every live cycle counted, which leaves the rate without a bound.

    Raises
    ------
    InputError
        Negative counts, no cycle, a dead time that is not positive, or more counts than live
        cycles.

    Notes
    -----
    P. B. Coates, "The correction for photon pile-up in the measurement of radiative lifetimes", J.
    Phys. E 1, 878 (1968), Eq. 4; for a dead time shorter than the cycle the sum runs over the dead
    time only (S. Isbaner et al., Opt. Express 24, 9429, 2016).
    """
    seen, live = count_live_cycles(counts, cycles, dead_bins)
    fraction = np.divide(seen, live, out=np.ones_like(seen), where=live > 0)
    arrived = np.full_like(seen, np.nan)
    np.log1p(-fraction, out=arrived, where=fraction < 1)
    return -cycles * arrived


def count_live_cycles(
    counts: NDArray[np.integer] | NDArray[np.floating], cycles: int, dead_bins: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return photons counted, and the cycles that no photon before had blinded, (..., bins) both."""
    seen = np.asarray(counts, dtype=np.float64)
    if cycles < 1 or not np.all(np.isfinite(seen) & (seen >= 0)):
        raise InputError(
            "pile-up needs a cycle or more and counts that are finite and not negative"
        )
    dead = seen.shape[-1] if dead_bins is None else dead_bins
    if dead < 1:
        raise InputError(f"a dead time lasts at least one bin, got {dead}")
    before = np.cumsum(seen, axis=-1) - seen
    live = cycles - before
    live[..., dead:] += before[..., :-dead]
    if np.any(seen > live):
        raise InputError(f"more photons than {cycles} cycles with this dead time allow")
    return seen, live


@dataclass(frozen=True)
class Arrivals:
    """Returns of histograms, (n, returns), the strongest first; NaN where there are fewer: `range` for a
    co-located source, m, the middle of the first bin being range 0; its `photons`; and `confidence`,
    the range's expected standard deviation, m, the Cramer-Rao bound at the estimate.
    """

    range: FloatArray
    photons: FloatArray
    confidence: FloatArray

    @property
    def detected(self) -> BoolArray:
        """Whether there is a return, (n, returns)."""
        return ~np.isnan(self.range)


@dataclass(frozen=True)
class LogMatchedFilter:
    """Log-likelihood ratios of photons around a return of the weakest strength, for each
    background. Of hashable fields only, so that thresholds of the same filter are simulated once.
    """

    share: tuple[float, ...]  # of a return's photons, in the bins from `first` on
    first: int  # bin of the first weight relative to the return's
    min_photons: float
    background: tuple[float, ...]  # of each bin, relative to the mean

    @cached_property
    def shades(self) -> tuple[FloatArray, IntArray]:
        """Backgrounds for which there are weights, and which of them each bin has."""
        return group_shades(np.array(self.background))

    def weigh(self, photons: int) -> FloatArray:
        """Weights of each shade, (shades, width), where a histogram has so many photons."""
        level = max(photons, 1) / len(self.background) * self.shades[0]
        odds = self.min_photons * np.array(self.share) / level[:, np.newaxis]
        return np.log1p(odds)


@lru_cache(maxsize=MAX_THRESHOLDS)
def _simulate_threshold(matched: LogMatchedFilter, photons: int, false_alarm_rate: float) -> float:
    """Score that the background alone exceeds at the stated rate where there are so many photons."""
    from tofclip.lidar.photons import kernels

    bins, best = len(matched.background), np.empty(CALIBRATION_HISTOGRAMS)
    share = np.array(matched.background) / bins
    noise = np.random.default_rng(CALIBRATION_SEED + photons)
    filtering = matched.weigh(photons), matched.shades[1], matched.first
    if photons <= DENSE_PHOTONS_PER_BIN * bins:
        arrived = np.cumsum(share)
        arrived[-1] = 1.0  # whatever rounding left
        kernels.simulate_best_scores(photons, arrived, noise, *filtering, best)
    else:
        for piece in split_blocks(CALIBRATION_HISTOGRAMS, HISTOGRAMS_PER_BATCH):
            thrown = noise.multinomial(photons, share, best[piece].size)
            kernels.find_best_scores(thrown.astype(np.float64), *filtering, best[piece])
    best += noise.uniform(0, DITHER, best.size)
    return float(np.quantile(best, 1 - false_alarm_rate))


@dataclass(frozen=True)
class PhotonDetector:
    """Log-matched filter with a threshold for a stated false-alarm rate, then the maximum of the
    Poisson likelihood.

    Only the shape of the background need be known, not how bright it is. Without a return the
    photons of a histogram lie over its bins as the background does, however high that is; so a
    threshold for the number of photons found keeps the rate at any background (a test of Neyman
    structure). Thresholds come from simulated histograms. With
    few photons the scores are so coarse that no threshold alone meets the rate; ties are then
    decided by chance (Neyman and Pearson's randomised test). An empty histogram never raises an
    alarm.

    Parameters
    ----------
    pulse : Pulse
        Shape of a return: Gaussian, exponentially modified, or measured.
    bin_width : float
        Duration of a bin, s.
    bins : int
        Bins of a histogram.
    false_alarm_rate : float
        Share of the histograms without a return in which one is announced, 0.001 or more.
    max_returns : int
        Maximum number of returns of one histogram. Two are separated when they are further apart
        than the pulse's support.
    min_photons : float
        The filter is the most powerful one for returns of this number of photons; stronger ones pass it
        anyway.
    background : (bins,) array, optional
        Shape of the background over the bins, in any unit: of a dark frame, of fog, of light that
        comes back from nearby. Even by default; `learn_background` finds it from many histograms.

    Raises
    ------
    InputError
        A parameter outside its range, a background of another length or without light, or
        histograms shorter than two pulses.
    """

    pulse: Pulse
    bin_width: float
    bins: int
    false_alarm_rate: float = 0.01
    max_returns: int = 1
    min_photons: float = 20.0
    background: ArrayLike | None = None

    def __post_init__(self) -> None:
        if not (self.bin_width > 0 and self.min_photons > 0 and self.max_returns >= 1):
            raise InputError("bin width, weakest return and number of returns must be positive")
        if not MIN_FALSE_ALARM_RATE <= self.false_alarm_rate < 1:
            raise InputError(
                f"the false-alarm rate must lie between {MIN_FALSE_ALARM_RATE:g} and 1"
            )
        if self.bins < 2 * self._offsets.size:
            raise InputError(
                f"a histogram needs at least {2 * self._offsets.size} bins, two pulses long; got {self.bins}"
            )
        shape = np.asarray(np.ones(self.bins) if self.background is None else self.background)
        if shape.shape != (self.bins,):
            raise ShapeError("the background of a histogram", (self.bins,), shape.shape)
        if not (np.all(np.isfinite(shape)) and shape.min() >= 0 and shape.any()):
            raise InputError("a background must be finite, not negative, and somewhere above 0")

    @cached_property
    def shape(self) -> Pulse:
        """The pulse as bins show it."""
        return self.pulse.integrate_bins(self.bin_width)

    @property
    def times(self) -> FloatArray:
        """Instant of each bin's middle, s; the first is 0."""
        return np.arange(self.bins) * np.float64(self.bin_width)

    @cached_property
    def relative_background(self) -> FloatArray:
        """Background of each bin, (bins,), relative to the mean."""
        if self.background is None:
            return np.ones(self.bins)
        shape = np.asarray(self.background, dtype=np.float64)
        relative = np.maximum(shape / shape.mean(), MIN_RELATIVE_BACKGROUND)
        return relative / relative.mean()

    @cached_property
    def _kernel_pulse(self) -> Table:
        return self.shape.kernel_table(PULSE_CUTOFF)

    @cached_property
    def _offsets(self) -> IntArray:
        """Bins of a pulse, relative to its arrival."""
        first, last = np.array(self.shape.extent(PULSE_CUTOFF)) / self.bin_width
        return np.arange(int(np.ceil(first)), int(np.floor(last)) + 1)

    @cached_property
    def _filter(self) -> LogMatchedFilter:
        share = self.shape(self._offsets * self.bin_width) * self.bin_width / self.shape.area
        background = tuple(self.relative_background.tolist())
        first = int(self._offsets[0])
        return LogMatchedFilter(tuple(share.tolist()), first, self.min_photons, background)

    def threshold(self, photons: int) -> float:
        """Least score of a return in a histogram of a given number of photons, by simulation;
        remembered. Many photons have theirs between those of numbers that are a fifth apart.
        """
        nodes = [photons]
        if photons > MAX_EXACT_PHOTONS:
            step = np.floor(np.log(photons / MAX_EXACT_PHOTONS) / np.log(THRESHOLD_RATIO))
            nodes = [round(MAX_EXACT_PHOTONS * THRESHOLD_RATIO**k) for k in (step, step + 1)]
        known = [_simulate_threshold(self._filter, n, self.false_alarm_rate) for n in nodes]
        return float(np.interp(photons, nodes, known))

    def adapt(self, histograms: FloatArray) -> PhotonDetector:
        """Return a detector for the background that these `histograms` (n, bins) have in common; this
        one where its background is given already, or where they are too few to tell it from an even
        one; see `tofclip.lidar.photons.scene`.
        """
        if self.background is not None:
            return self
        learnt = learn_background(histograms, self.shape.fwhm / self.bin_width)
        return self if learnt is None else replace(self, background=learnt)

    def learn(self, photons: PhotonImage) -> PhotonDetector:
        """Return a detector for the background that the pixels of a picture have in common, which is
        not asked for again; this one where its background is given already.
        """
        if self.background is not None:
            return self
        if photons.sampled:
            # A gate is open as long at every step: what looks uneven are returns, which last as long.
            return replace(self, background=np.ones(self.bins))
        # all over the picture
        some = photons.histograms(slice(0, photons.pixels, -(-photons.pixels // SAMPLED_PIXELS)))
        return replace(self, background=self.adapt(some).relative_background)

    def locate_pixels(
        self, read: Callable[[slice], NDArray[np.floating]], pixels: int, cycles: int | None = None
    ) -> FloatArray:
        """Find the returns of all pixels of a picture whose histograms, of so many `cycles`, are read
        piece by piece: range and its deviation, m, photons, and the probability of a false alarm,
        (most returns, pixels, 4); NaN where there is none.
        """
        found = np.full((self.max_returns, pixels, 4), np.nan)

        def work(piece: slice) -> None:
            arrivals = self.locate(read(piece), piece.start, cycles)
            located = np.stack([arrivals.range, arrivals.confidence, arrivals.photons], axis=-1)
            found[:, piece, :3] = located.swapaxes(0, 1)

        run_blocks(work, pixels, HISTOGRAMS_PER_BLOCK)
        for layer in found:
            seen = np.isfinite(layer[:, 0])
            layer[seen, 3] = min(self.false_alarm_rate * pixels / max(int(seen.sum()), 1), 1.0)
        return found

    def locate(
        self,
        histograms: ArrayLike,
        seed: int = 0,
        cycles: int | None = None,
        dead_bins: int | None = None,
    ) -> Arrivals:
        """Find the returns of every one of the `histograms` (n, bins), below a bin.

        The chance that decides scores exactly at the threshold is that of a `seed`. With the laser
        `cycles` that made a histogram, of a detector that is blind after a photon for `dead_bins` (see
        `correct_pile_up`), pile-up is corrected, and what it costs is in the deviations; without, no
        photon was missed. Memory beyond the result is one float64 copy of the histograms, with pile-up
        three. `ShapeError` or `InputError` for histograms of another length, with counts that are negative
        or not finite, or with more photons than the cycles allow.
        """
        counts = np.ascontiguousarray(histograms, dtype=np.float64)
        if counts.ndim != 2 or counts.shape[1] != self.bins:
            raise ShapeError("histograms", f"(n, {self.bins})", counts.shape)
        if not np.all(np.isfinite(counts) & (counts >= 0)):
            raise InputError("photon counts must be finite and not negative")
        dither = np.random.default_rng(seed).uniform(0, DITHER, size=counts.shape[:1])
        detector = self.adapt(counts)
        if cycles is None:
            return detector._refine(counts, *detector._detect(counts, dither))
        _, live = count_live_cycles(counts, cycles, dead_bins)
        live = np.maximum(live, MIN_LIVE_CYCLES) / cycles
        # Counts fall as fewer cycles are left, with and without a return. A background that was
        # learnt from them falls with them, a given one does not.
        ready = live.mean(axis=0)
        if detector is self:
            own, ramp = self, replace(self, background=self.relative_background * ready)
        else:
            own, ramp = replace(self, background=detector.relative_background / ready), detector
        return own._refine(counts, *ramp._detect(counts, dither), live, cycles)

    def _detect(self, counts: FloatArray, dither: FloatArray) -> tuple[IntArray, IntArray]:
        """Bins of the returns, (n, most returns), and how many there are."""
        from tofclip.lidar.photons.kernels import extract_strongest_returns

        rest, free = counts.copy(), np.full(counts.shape[0], float(self.bins))
        matched, background = self._filter, (self.relative_background, self._filter.shades[1])
        peaks = np.zeros((counts.shape[0], self.max_returns), np.int64)
        numbers = np.zeros(counts.shape[0], np.int64)
        for turn in range(self.max_returns):
            sought = (numbers == turn) & (free > self.bins / 2)
            photons = _quantise_photons(rest.sum(axis=1) * self.bins / free)
            known, level = np.unique(photons[sought], return_inverse=True)
            if known.size == 0 or known[-1] == 0:
                break
            rows = np.full(sought.size, -1)
            rows[sought] = np.where(photons[sought] > 0, level, -1)
            # an empty histogram has no threshold to pass
            thresholds = np.array([self.threshold(int(n)) if n else np.inf for n in known])
            table = thresholds, np.array([matched.weigh(int(n)) for n in known])
            arguments = table, background, matched.first, self._kernel_pulse[1], self.times
            extract_strongest_returns(rest, free, dither, rows, *arguments, peaks, numbers)
        return peaks, numbers

    def _refine(
        self,
        counts: FloatArray,
        peaks: IntArray,
        numbers: IntArray,
        live: FloatArray | None = None,
        cycles: float = NO_PILE_UP,
    ) -> Arrivals:
        """Move returns from the bins where they were found to the likelihood's maximum. `live` (n,
        bins): fraction of the cycles in which the detector was ready; all by default.
        """
        from tofclip.lidar.photons.kernels import fit_histograms

        found = np.full((*peaks.shape, 3), np.nan)
        pulse = self.relative_background, *self._kernel_pulse, self.times

        def work(piece: slice) -> None:
            some = counts[piece]
            ready, arrived = np.ones_like(some), some
            if live is not None:
                ready = live[piece]
                # where every live cycle counted, half a cycle is taken not to have
                most = 1 - 0.5 / np.maximum(ready * cycles, 1)
                arrived = -cycles * np.log1p(-np.minimum(some / (ready * cycles), most))
            seen = some, arrived, ready, float(cycles), peaks[piece], numbers[piece]
            fit_histograms(*seen, *pulse, found[piece])

        run_blocks(work, counts.shape[0], HISTOGRAMS_PER_BLOCK)
        arrival, photons, deviation = np.moveaxis(found, -1, 0)
        return Arrivals(SPEED_OF_LIGHT / 2 * arrival, photons, SPEED_OF_LIGHT / 2 * deviation)

    def add_step_errors(self, layers: FloatArray) -> FloatArray:
        """Add to the deviations of layers, (..., 4) as of `locate_pixels`, what a gate's steps leave
        unknown of ranges, however many photons there are.
        """
        step = SPEED_OF_LIGHT / 2 * self.bin_width
        phase = np.nan_to_num(layers[..., 0] / step % 1 * STEP_PHASES)
        return add_errors(layers, self._step_errors[phase.astype(np.int64) % STEP_PHASES])

    @cached_property
    def _step_errors(self) -> FloatArray:
        """By how far two thirds of the returns between two steps of a gate err, m, by where in the step
        they seem to be, (STEP_PHASES,): a picture shows the gate at one instant, not its mean over a
        step.
        """
        phase = (np.arange(STEP_PHASES) + 0.5) / STEP_PHASES
        truth = (self.bins // 2 + phase) * self.bin_width
        light = self.pulse(self.times - truth[:, np.newaxis])
        found = self.locate(STEP_PHOTONS * (light + STEP_BACKGROUND)).range[:, 0]
        step = SPEED_OF_LIGHT / 2 * self.bin_width
        apart = (found / step - phase[:, np.newaxis] + 0.5) % 1 - 0.5
        weight = np.exp(-((apart / STEP_BLUR) ** 2) / 2)
        error = (found - SPEED_OF_LIGHT / 2 * truth) ** 2
        # two thirds of what is spread evenly lie within 2 / sqrt(3) of its root mean square
        return np.sqrt(4 / 3 * (weight @ error) / weight.sum(axis=1))


def _quantise_photons(photons: FloatArray) -> IntArray:
    """Numbers of photons that have filters of their own, nearest to those found."""
    many = np.maximum(photons, MAX_EXACT_PHOTONS) / MAX_EXACT_PHOTONS
    steps = np.rint(np.log(many) / np.log(PHOTON_LEVEL_RATIO))
    coarse = MAX_EXACT_PHOTONS * PHOTON_LEVEL_RATIO**steps
    return np.rint(np.where(photons <= MAX_EXACT_PHOTONS, photons, coarse)).astype(np.int64)


def estimate_pixels(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    false_alarm_rate: float = 0.01,
    background: ArrayLike | None = None,
    cycles: int | None = None,
    max_returns: int = 1,
) -> SurfaceImage:
    """Find the strongest returns of every pixel by its own `photons` alone, `max_returns` at most: NaN where
    none stands out, and in hot pixels. The probability of an outlier is that of a false alarm.

    `pulse` is the shape of a return, by default as wide as pairs of photons say; `false_alarm_rate` the
    share of the pixels without a return in which one is announced, see `PhotonDetector`; `background`
    (bins,) its shape over the bins, as of a dark frame, by default what the pixels have in common;
    `cycles` the laser cycles of each pixel, of a detector that counts the first photon of a cycle only.
    `InputError` where no pulse is given and none can be recognised, or the time axis is shorter than two
    pulses.
    """
    counted = photons
    # a background that is given has the photons' own bins
    photons, shape, hot = prepare_photons(photons, pulse, join=background is None)
    settings = shape, photons.bin_width, photons.bins, false_alarm_rate, max_returns
    detector = PhotonDetector(*settings, background=background).learn(photons)
    found = detector.locate_pixels(photons.histograms, photons.pixels, cycles)
    if background is None and cycles is None:
        places = found[..., 0] / (SPEED_OF_LIGHT / 2 * photons.bin_width)
        even = even_out_bins(counted, photons, places, shape.fwhm / photons.bin_width)
        if even is not None:
            return estimate_pixels(even, pulse, false_alarm_rate, max_returns=max_returns)
    learnt = "learnt" if np.ptp(detector.relative_background) else "even"
    chosen: dict[str, float | str] = {
        "response": "learnt" if pulse is None else "given",
        "pulse_fwhm_ps": detector.shape.fwhm * 1e12,
        "false_alarm_rate": false_alarm_rate,
        "background": learnt if background is None else "given",
        "hot_pixels": int(hot.sum()),
        "uneven_bins_sigma_m": photons.bins_sigma_m,
    }
    layers = photons.add_bin_errors(found.reshape(max_returns, *photons.image_shape, 4))
    if photons.sampled:
        layers = detector.add_step_errors(layers)
    return SurfaceImage.from_layers(layers, detector.shape, chosen, hot)


BIN_PHASES = 16  # positions of the arrival within a bin that the bound is averaged over
MAX_PHOTONS = 1e15  # sums of counts up to here are exact, and generators of chance take them
BINS_PER_BATCH = 1 << 22  # of histograms that are held at a time: 32 MiB


def compute_range_bound(pulse: Pulse, bin_width: float, photons: float, background: float) -> float:
    """Return the least standard deviation of the range, m, that an unbiased estimate can have (Cramer-Rao), of
    a return of the shape `pulse` in bins of `bin_width`, s, of which so many `photons` are expected, and
    so many of the `background` in a bin: the bound of the time of flight times half the speed of light.

    Photons are Poisson distributed; arrival and number of photons are unknown, the background is
    known. The variance is averaged over where in a bin the pulse arrives. `InputError` for a bin width or
    number of photons that is not positive, a negative background, or more than `MAX_PHOTONS` of either.
    """
    if not (bin_width > 0 and 0 < photons <= MAX_PHOTONS and 0 <= background <= MAX_PHOTONS):
        raise InputError(
            "bin width and photons must be positive, the background not negative, and either at most "
            f"{MAX_PHOTONS:g}; got {bin_width}, {photons} and {background}"
        )
    shape = pulse.integrate_bins(bin_width)
    first, last = shape.extent(0.0)
    bins = np.arange(np.floor(first / bin_width) - 1, np.ceil(last / bin_width) + 2) * bin_width
    # Where the pulse lies in its bin decides how well it can be located: all places count alike.
    late = bins - ((np.arange(BIN_PHASES) + 0.5) / BIN_PHASES - 0.5)[:, np.newaxis] * bin_width
    height = photons * bin_width / shape.area
    signal, slope = height * shape(late), height * shape.slope_at(late)
    expected = signal + background
    # Fisher's information of Poisson counts: derivatives squared over the expected number. A bin in
    # which nothing is expected says nothing.
    weight = np.divide(1.0, expected, out=np.zeros_like(expected), where=expected > 0)
    delay, mixed, amount = (
        np.sum(weight * term, axis=1) for term in (slope**2, slope * signal, signal**2)
    )
    # The number of photons has to be found as well: what it shares with the arrival is lost (Schur
    # complement of the 2 x 2 information matrix).
    variance = 1 / (delay - mixed**2 / amount)
    return float(SPEED_OF_LIGHT / 2 * np.sqrt(variance.mean()))


@dataclass(frozen=True)
class Accuracy:
    """How the detector fared: `rms_m`, root mean square range error of the detected returns, wrongly
    placed ones included, m, NaN without any; `bound_m`, the Cramer-Rao bound of the range, m; their
    `ratio`, near 1 where the bound holds, more when noise is mistaken for the return;
    `detection_rate` and `false_alarm_rate`, shares of the histograms with and without a return in
    which one was found.
    """

    rms_m: float
    bound_m: float
    ratio: float
    detection_rate: float
    false_alarm_rate: float


def measure_accuracy(
    detector: PhotonDetector,
    photons: float,
    background: float,
    trials: int = 2000,
    seed: int = 0,
    progress: Callable[[int], None] = lambda _: None,
) -> Accuracy:
    """Simulate as many histograms with and without a return as `trials` and locate it by the `detector`:
    `photons` are expected of the return, which arrives anywhere in the middle half of the histogram, and
    of a `background` that the detector does not know so many in a bin. The photons' chance and the
    detector's are independent, both of the `seed`; `progress` is called with the number of trials just
    done. `InputError` for no trial, or a number of photons that is not positive.
    """
    if trials < 1:
        raise InputError(f"at least one trial is needed, got {trials}")
    bound = compute_range_bound(detector.pulse, detector.bin_width, photons, background)
    seeds = np.random.SeedSequence(seed).spawn(3)
    present, absent, chance = (np.random.default_rng(one) for one in seeds)
    # In batches: the memory does not depend on the number of trials.
    batch = max(1, BINS_PER_BATCH // detector.bins)
    sums = np.zeros(3)  # squared errors, detections, false alarms
    for begin in range(0, trials, batch):
        count = min(batch, trials - begin)
        fractions = present.uniform(detector.bins / 4, 3 * detector.bins / 4, count)
        arrival = fractions * detector.bin_width
        share = detector.shape(detector.times - arrival[:, np.newaxis]) / detector.shape.area
        expected = photons * detector.bin_width * share + background
        found = detector.locate(present.poisson(expected), int(chance.integers(1 << 62)))
        dark = absent.poisson(background, (count, detector.bins))
        false = detector.locate(dark, int(chance.integers(1 << 62)))
        error = found.range[:, 0] - SPEED_OF_LIGHT * arrival / 2
        alarms = found.detected[:, 0].sum(), false.detected[:, 0].sum()
        sums += np.nansum(error**2), *alarms
        progress(count)
    squares, detections, false_alarms = sums.tolist()
    rms = float(np.sqrt(squares / detections)) if detections else float("nan")
    return Accuracy(rms, bound, rms / bound, detections / trials, false_alarms / trials)
