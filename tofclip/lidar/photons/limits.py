"""How well a return can be located at all: the Cramer-Rao bound of counted photons, and trials of
simulated histograms through the detector beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tofclip.errors import InputError
from tofclip.lidar.photons.detector import PhotonDetector
from tofclip.lidar.pulse import Pulse
from tofclip.units import SPEED_OF_LIGHT

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
