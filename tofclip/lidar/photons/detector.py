"""Find returns in histograms of photons, at a stated rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.lidar.pulse import Pulse, Table
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT

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

    No background need be known. Without a return the photons of a histogram lie evenly over its
    bins, however high the background; so a threshold for the number of photons found keeps the rate
    at any background (a test of Neyman structure). Thresholds come from simulated histograms. With
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

    Raises
    ------
    InputError
        A parameter outside its range, or histograms shorter than two pulses.
    """

    pulse: Pulse
    bin_width: float
    bins: int
    false_alarm_rate: float = 0.01
    max_returns: int = 1
    min_photons: float = 20.0

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
    def _threshold_cache(self) -> dict[int, float]:
        return {}

    def threshold(self, photons: int) -> float:
        """Least score of a return in a histogram of a given number of photons, by simulation;
        remembered.
        """
        from tofclip.lidar.photons.kernels import find_best_scores, simulate_best_scores

        if photons not in self._threshold_cache:
            best = np.empty(CALIBRATION_HISTOGRAMS)
            noise = np.random.default_rng(CALIBRATION_SEED + photons)
            filtering = self.weights(photons / self.bins), self.first_offset
            if photons <= DENSE_PHOTONS_PER_BIN * self.bins:
                simulate_best_scores(photons, self.bins, noise, *filtering, best)
            else:
                for piece in split_blocks(CALIBRATION_HISTOGRAMS, HISTOGRAMS_PER_BATCH):
                    thrown = noise.multinomial(
                        photons, np.full(self.bins, 1 / self.bins), best[piece].size
                    )
                    find_best_scores(thrown.astype(np.float64), *filtering, best[piece])
            best += noise.uniform(0, DITHER, best.size)
            self._threshold_cache[photons] = float(np.quantile(best, 1 - self.false_alarm_rate))
        return self._threshold_cache[photons]

    def locate(self, histograms: ArrayLike, seed: int = 0) -> Arrivals:
        """Find the returns of every histogram, below a bin.

        Parameters
        ----------
        histograms : (n, bins) array
            Photons counted in each bin.
        seed : int
            Of the chance that decides scores exactly at the threshold.

        Returns
        -------
        Arrivals
            Range in m, photons, and the range's Cramer-Rao deviation in m.

        Raises
        ------
        ShapeError, InputError
            Histograms of another length, or with counts that are negative or not finite.

        Notes
        -----
        Memory beyond the result is one float64 copy of the histograms.
        """
        counts = self.validate_histograms(histograms)
        dither = np.random.default_rng(seed).uniform(0, DITHER, size=counts.shape[:1])
        peaks, numbers = self._detect(counts, dither)
        return self.refine(counts, peaks, numbers)

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

        rest, free = counts.copy(), np.full(counts.shape[0], self.bins)
        peaks = np.zeros((counts.shape[0], self.max_returns), np.int64)
        numbers = np.zeros(counts.shape[0], np.int64)
        for turn in range(self.max_returns):
            sought = (numbers == turn) & (free > self.bins // 2)
            photons = _quantise_photons(rest.sum(axis=1) * self.bins / free)
            known, level = np.unique(photons[sought], return_inverse=True)
            if known.size == 0 or known[-1] == 0:
                break
            rows = np.full(sought.size, -1)
            rows[sought] = np.where(photons[sought] > 0, level, -1)
            table = self._build_table(known)
            arguments = table, self.first_offset, self.kernel_pulse[1], self.times
            extract_strongest_returns(rest, free, dither, rows, *arguments, peaks, numbers)
        return peaks, numbers

    def _build_table(self, levels: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Thresholds and filters for a given number of photons in a histogram; an empty one has
        none to pass.
        """
        thresholds = np.array([self.threshold(int(n)) if n else np.inf for n in levels])
        return thresholds, np.array([self.weights(max(n, 1) / self.bins) for n in levels])

    def refine(
        self, counts: FloatArray, peaks: NDArray[np.int64], numbers: NDArray[np.int64]
    ) -> Arrivals:
        """Move returns from the bins where they were found to the likelihood's maximum.

        Parameters
        ----------
        counts : (n, bins) array
        peaks : (n, returns) array
            Bins of the returns.
        numbers : (n,) array
            How many of them there are.

        Returns
        -------
        Arrivals
            Range in m, photons, and the range's Cramer-Rao deviation in m.
        """
        from tofclip.lidar.photons.kernels import fit_histograms

        found = np.full((*peaks.shape, 3), np.nan)

        def work(piece: slice) -> None:
            fit_histograms(
                counts[piece],
                peaks[piece],
                numbers[piece],
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
