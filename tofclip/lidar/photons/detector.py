"""Pile-up: what a detector that goes blind after each photon would have counted without.

Find returns in histograms of photons, at a stated rate of false alarms.

The return of every pixel by its own photons alone.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.lidar.photons.background import learn_background
from tofclip.lidar.photons.image import PhotonImage, find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.response import (
    find_time_step,
    measure_pulse_width,
    require_plausible_pulse,
)
from tofclip.lidar.photons.surface import SurfaceImage
from tofclip.lidar.pulse import Pulse, Table
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT


def correct_pile_up(
    counts: NDArray[np.integer] | NDArray[np.floating], cycles: int, dead_bins: int | None = None
) -> NDArray[np.float64]:
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
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Count the cycles in which the detector was ready, bin by bin.

    `counts, cycles, dead_bins`: as for `correct_pile_up`. Returns `counts, live` (..., bins):
    photons counted, and cycles that no photon before had blinded.
    """
    seen = np.asarray(counts, dtype=np.float64)
    if cycles < 1 or not np.all(np.isfinite(seen) & (seen >= 0)):
        raise InputError(
            "pile-up needs at least one cycle and counts that are finite and not negative"
        )
    dead = seen.shape[-1] if dead_bins is None else dead_bins
    if dead < 1:
        raise InputError(f"a dead time lasts at least one bin, got {dead}")
    before = np.cumsum(seen, axis=-1) - seen
    blind = before.copy()
    blind[..., dead:] -= before[..., :-dead]
    live = cycles - blind
    if np.any(seen > live):
        raise InputError(
            f"more photons were counted than {cycles} cycles with this dead time allow"
        )
    return seen, live


FloatArray = NDArray[np.float64]

CALIBRATION_HISTOGRAMS = (
    20_000  # histograms for each threshold: a rate of 1 % is met to within 7 % of itself
)
CALIBRATION_SEED = 20220614
MIN_FALSE_ALARM_RATE = 20 / CALIBRATION_HISTOGRAMS
DITHER = 1e-6  # breaks ties between scores; far below any difference that photons make
HISTOGRAMS_PER_BATCH = 2000
DENSE_PHOTONS_PER_BIN = (
    8  # with more photons a bin, drawing the bins is quicker than throwing the photons
)
MAX_EXACT_PHOTONS = 40  # up to this number of photons every one has a threshold of its own
PHOTON_LEVEL_RATIO = 1.03  # beyond, numbers that differ by less share one
PULSE_CUTOFF = 1e-4  # of its peak: what a pulse brings beyond it is not worth the bins
HISTOGRAMS_PER_BLOCK = 256
SHADE_RATIO = 1.1  # backgrounds that differ by less share a filter; thresholds hold for any filter
MIN_RELATIVE_BACKGROUND = 1e-3  # of a usual bin; no bin is so dark that one photon decides
NO_PILE_UP = 1e15  # cycles: the rate of any bin is as good as zero
MAX_SHARED_THRESHOLDS = 32
"""Settings of detectors whose thresholds are remembered: some hundred numbers each."""

MIN_LIVE_CYCLES = (
    0.5  # a bin that hardly any cycle reaches says nothing, but not with infinite surety
)

_thresholds_lock = threading.Lock()
"""Held while a threshold is sought or found: detectors on several threads share them."""


@lru_cache(maxsize=MAX_SHARED_THRESHOLDS)
def _share_thresholds(
    weights: bytes, first_offset: int, background: bytes, false_alarm_rate: float
) -> dict[int, float]:
    """Return the same dictionary whenever the settings are the same: shots of a sequence are."""
    return {}


@dataclass(frozen=True)
class Arrivals:
    """Returns of histograms, the strongest first; NaN where there are fewer.

    Parameters
    ----------
    range : (n, returns) array
        Distance for a co-located source, m; the middle of the first bin is range 0.
    photons : (n, returns) array
        Photons of the return.
    confidence : (n, returns) array
        Expected standard deviation of the range, m: the Cramer-Rao bound at the estimate.
    """

    range: FloatArray
    photons: FloatArray
    confidence: FloatArray

    @property
    def detected(self) -> NDArray[np.bool_]:
        """Whether there is a return, (n, returns)."""
        return ~np.isnan(self.range)


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
        if self.background is not None:
            shape = np.asarray(self.background, dtype=np.float64)
            if shape.shape != (self.bins,):
                raise ShapeError("the background of a histogram", (self.bins,), shape.shape)
            if not (np.all(np.isfinite(shape)) and shape.min() >= 0 and shape.any()):
                raise InputError("a background must be finite, not negative, and somewhere above 0")

    @cached_property
    def shape(self) -> Pulse:
        """The pulse as bins show it."""
        return self.pulse.integrate_bins(self.bin_width)

    @cached_property
    def kernel_pulse(self) -> Table:
        """The binned pulse as the compiled loops take it."""
        return self.shape.kernel_table(PULSE_CUTOFF)

    @property
    def times(self) -> FloatArray:
        """Instant of each bin's middle, s; the first is 0."""
        times: FloatArray = np.arange(self.bins) * np.float64(self.bin_width)
        return times

    @cached_property
    def _offsets(self) -> NDArray[np.int64]:
        """Bins of a pulse, relative to its arrival."""
        first, last = self.shape.extent(PULSE_CUTOFF)
        return np.arange(
            int(np.ceil(first / self.bin_width)), int(np.floor(last / self.bin_width)) + 1
        )

    @property
    def first_offset(self) -> int:
        """Bin of the filter's first weight relative to the return's."""
        return int(self._offsets[0])

    def weights(self, background: float) -> FloatArray:
        """Log-matched filter for the weakest return on a background of a given number of photons
        per bin.
        """
        share = self.shape(self._offsets * self.bin_width) * self.bin_width / self.shape.area
        return np.log1p(self.min_photons * share / background)

    @cached_property
    def relative_background(self) -> FloatArray:
        """Background of each bin, (bins,), relative to the mean."""
        if self.background is None:
            return np.ones(self.bins)
        shape = np.asarray(self.background, dtype=np.float64)
        relative = np.maximum(shape / shape.mean(), MIN_RELATIVE_BACKGROUND)
        even: FloatArray = relative / relative.mean()
        return even

    @cached_property
    def _shades(self) -> tuple[FloatArray, NDArray[np.int64]]:
        """Backgrounds for which there is a filter, and which of them each bin has."""
        step = np.rint(np.log(self.relative_background) / np.log(SHADE_RATIO)).astype(np.int64)
        known, shade = np.unique(step, return_inverse=True)
        return SHADE_RATIO ** known.astype(np.float64), shade.ravel()

    def _build_filter(self, background: float) -> FloatArray:
        """Log-matched filter for each shade of a background of this many photons in a usual bin."""
        return np.array([self.weights(background * shade) for shade in self._shades[0]])

    @cached_property
    def _threshold_cache(self) -> dict[int, float]:
        """Thresholds by number of photons, shared by all detectors that would simulate the same."""
        background = self.relative_background
        filtering = self.weights(1.0).tobytes(), self.first_offset
        return _share_thresholds(*filtering, background.tobytes(), self.false_alarm_rate)

    def threshold(self, photons: int) -> float:
        """Least score of a return in a histogram of a given number of photons, by simulation;
        remembered.
        """
        from tofclip.lidar.photons.kernels import find_best_scores, simulate_best_scores

        with _thresholds_lock:
            if photons in self._threshold_cache:
                return self._threshold_cache[photons]
            best = np.empty(CALIBRATION_HISTOGRAMS)
            noise = np.random.default_rng(CALIBRATION_SEED + photons)
            share = self.relative_background / self.bins
            filtering = (
                self._build_filter(photons / self.bins),
                self._shades[1],
                self.first_offset,
            )
            if photons <= DENSE_PHOTONS_PER_BIN * self.bins:
                arrived = np.cumsum(share)
                arrived[-1] = 1.0  # whatever rounding left
                simulate_best_scores(photons, arrived, noise, *filtering, best)
            else:
                for piece in split_blocks(CALIBRATION_HISTOGRAMS, HISTOGRAMS_PER_BATCH):
                    thrown = noise.multinomial(photons, share, best[piece].size)
                    find_best_scores(thrown.astype(np.float64), *filtering, best[piece])
            best += noise.uniform(0, DITHER, best.size)
            found = float(np.quantile(best, 1 - self.false_alarm_rate))
            self._threshold_cache[photons] = found
            return found

    def adapt(self, histograms: FloatArray) -> PhotonDetector:
        """Return a detector for the background that these histograms have in common.

        Parameters
        ----------
        histograms : (n, bins) array
            Photons counted in each bin.

        Returns
        -------
        PhotonDetector
            This one where its background is given already, or where the histograms are too few
            to tell it from an even one; see `tofclip.lidar.photons.background`.
        """
        if self.background is not None:
            return self
        learnt = learn_background(histograms, self.shape.fwhm / self.bin_width)
        return self if learnt is None else replace(self, background=learnt)

    def locate(
        self,
        histograms: ArrayLike,
        seed: int = 0,
        cycles: int | None = None,
        dead_bins: int | None = None,
    ) -> Arrivals:
        """Find the returns of every histogram, below a bin.

        Parameters
        ----------
        histograms : (n, bins) array
            Photons counted in each bin.
        seed : int
            Of the chance that decides scores exactly at the threshold.
        cycles : int, optional
            Laser cycles that made a histogram, of a detector that is blind after a photon: pile-up
            is corrected, and what it costs is in the deviations. Without, no photon was missed.
        dead_bins : int, optional
            See `correct_pile_up`.

        Returns
        -------
        Arrivals
            Range in m, photons, and the range's Cramer-Rao deviation in m.

        Raises
        ------
        ShapeError, InputError
            Histograms of another length, with counts that are negative or not finite, or with more
            photons than the cycles allow.

        Notes
        -----
        Memory beyond the result is one float64 copy of the histograms, with pile-up three.
        """
        counts = self.validate_histograms(histograms)
        dither = np.random.default_rng(seed).uniform(0, DITHER, size=counts.shape[:1])
        detector = self.adapt(counts)
        if cycles is None:
            return detector.refine(counts, *detector._detect(counts, dither))
        _, live = count_live_cycles(counts, cycles, dead_bins)
        live = np.maximum(live, MIN_LIVE_CYCLES) / cycles
        # Counts fall as fewer cycles are left, with and without a return. A background that was
        # learnt from them falls with them, a given one does not.
        ready = live.mean(axis=0)
        if detector is self:
            own, ramp = self, replace(self, background=self.relative_background * ready)
        else:
            own, ramp = replace(self, background=detector.relative_background / ready), detector
        return own.refine(counts, *ramp._detect(counts, dither), live, cycles)

    def validate_histograms(self, histograms: ArrayLike) -> FloatArray:
        """Return histograms as float64, refusing what is none."""
        counts = np.ascontiguousarray(histograms, dtype=np.float64)
        if counts.ndim != 2 or counts.shape[1] != self.bins:
            raise ShapeError("histograms", f"(n, {self.bins})", counts.shape)
        if not np.all(np.isfinite(counts) & (counts >= 0)):
            raise InputError("photon counts must be finite and not negative")
        return counts

    def _detect(
        self, counts: FloatArray, dither: FloatArray
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Bins of the returns, (n, most returns), and how many there are."""
        from tofclip.lidar.photons.kernels import extract_strongest_returns

        rest, free = counts.copy(), np.full(counts.shape[0], float(self.bins))
        background = self.relative_background, self._shades[1]
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
            table = self._build_table(known)
            arguments = table, background, self.first_offset, self.kernel_pulse[1], self.times
            extract_strongest_returns(rest, free, dither, rows, *arguments, peaks, numbers)
        return peaks, numbers

    def _build_table(self, levels: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Thresholds and filters for a given number of photons in a histogram; an empty one has
        none to pass.
        """
        thresholds = np.array([self.threshold(int(n)) if n else np.inf for n in levels])
        return thresholds, np.array([self._build_filter(max(n, 1) / self.bins) for n in levels])

    def refine(
        self,
        counts: FloatArray,
        peaks: NDArray[np.int64],
        numbers: NDArray[np.int64],
        live: FloatArray | None = None,
        cycles: float = NO_PILE_UP,
    ) -> Arrivals:
        """Move returns from the bins where they were found to the likelihood's maximum.

        Parameters
        ----------
        counts : (n, bins) array
        peaks : (n, returns) array
            Bins of the returns.
        numbers : (n,) array
            How many of them there are.
        live : (n, bins) array, optional
            Fraction of the cycles in which the detector was ready; all by default.
        cycles : float
            Laser cycles of a histogram.

        Returns
        -------
        Arrivals
            Range in m, photons, and the range's Cramer-Rao deviation in m.
        """
        from tofclip.lidar.photons.kernels import fit_histograms

        found = np.full((*peaks.shape, 3), np.nan)

        def work(piece: slice) -> None:
            some = counts[piece]
            ready, arrived = np.ones_like(some), some
            if live is not None:
                ready = live[piece]
                # where every live cycle counted, half a cycle is taken not to have
                counted = np.minimum(
                    some / (ready * cycles), 1 - 0.5 / np.maximum(ready * cycles, 1)
                )
                arrived = -cycles * np.log1p(-counted)
            fit_histograms(
                some,
                arrived,
                ready,
                float(cycles),
                peaks[piece],
                numbers[piece],
                self.relative_background,
                *self.kernel_pulse,
                self.times,
                found[piece],
            )

        run_blocks(work, counts.shape[0], HISTOGRAMS_PER_BLOCK)
        arrival, photons, deviation = np.moveaxis(found, -1, 0)
        return Arrivals(SPEED_OF_LIGHT / 2 * arrival, photons, SPEED_OF_LIGHT / 2 * deviation)


def _quantise_photons(photons: FloatArray) -> NDArray[np.int64]:
    """Numbers of photons that have thresholds of their own, nearest to those found."""
    steps = np.log(np.maximum(photons, MAX_EXACT_PHOTONS) / MAX_EXACT_PHOTONS) / np.log(
        PHOTON_LEVEL_RATIO
    )
    coarse = MAX_EXACT_PHOTONS * PHOTON_LEVEL_RATIO ** np.rint(steps)
    return np.rint(np.where(photons <= MAX_EXACT_PHOTONS, photons, coarse)).astype(np.int64)


SAMPLED_PIXELS = 8192
"""That say what the pixels' background has in common."""

DETECTED_PIXELS_PER_BLOCK = 1 << 10


def estimate_pixels(
    photons: PhotonImage,
    pulse: Pulse | None = None,
    false_alarm_rate: float = 0.01,
    background: ArrayLike | None = None,
    cycles: int | None = None,
    max_returns: int = 1,
) -> SurfaceImage:
    """Find the strongest returns of every pixel by its own photons alone.

    Parameters
    ----------
    photons : PhotonImage
    pulse : Pulse, optional
        Shape of a return; by default as wide as pairs of photons say.
    false_alarm_rate : float
        Share of the pixels without a return in which one is announced; see `PhotonDetector`.
    background : (bins,) array, optional
        Shape of the background over the bins, as of a dark frame; by default what the pixels have
        in common.
    cycles : int, optional
        Laser cycles of each pixel, of a detector that counts the first photon of a cycle only.
    max_returns : int
        Returns looked for in every pixel.

    Returns
    -------
    SurfaceImage
        NaN where no return stands out, and in hot pixels. The probability of an outlier is that of a false alarm.

    Raises
    ------
    InputError
        No pulse is given and none can be recognised, or the time axis is shorter than two pulses.
    """
    hot = find_hot_pixels(photons)
    photons = leave_out_pixels(photons, hot)
    if background is None:  # which has the photons' own bins
        photons = photons.join_bins(find_time_step(photons))
    shape = Pulse.gaussian(measure_pulse_width(photons)) if pulse is None else pulse
    require_plausible_pulse(photons, shape)
    detector = PhotonDetector(
        shape,
        photons.bin_width,
        photons.bins,
        false_alarm_rate,
        max_returns,
        background=background,
    )
    pixels = photons.offsets.size - 1
    if background is None:
        # once for the whole picture, from pixels all over it
        some = photons.histograms(slice(0, pixels, -(-pixels // SAMPLED_PIXELS)))
        learnt = detector.adapt(some).relative_background
        detector = replace(detector, background=learnt)
    found = np.full((max_returns, 3, pixels), np.nan)
    for piece in split_blocks(pixels, DETECTED_PIXELS_PER_BLOCK):
        arrivals = detector.locate(photons.histograms(piece), piece.start, cycles)
        located = np.stack([arrivals.range, arrivals.confidence, arrivals.photons])
        found[..., piece] = np.moveaxis(located, -1, 0)
    settings: dict[str, float | str] = {
        "response": "learnt" if pulse is None else "given",
        "pulse_fwhm_ps": detector.shape.fwhm * 1e12,
        "false_alarm_rate": false_alarm_rate,
        "background": "given"
        if background is not None
        else "learnt"
        if np.ptp(detector.relative_background)
        else "even",
        "hot_pixels": int(hot.sum()),
    }
    images = []
    for distance, sigma, signal in found.reshape(max_returns, 3, *photons.image_shape):
        seen = np.isfinite(distance)
        false_share = min(false_alarm_rate * pixels / max(int(seen.sum()), 1), 1.0)
        doubt = np.where(seen, false_share, np.nan)
        images.append(SurfaceImage(distance, sigma, signal, doubt, detector.shape, settings))
    return replace(images[0], further=tuple(images[1:]), hot_pixels=hot)
