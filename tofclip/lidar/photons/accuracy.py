"""Trials against the photon limit: simulated histograms through the detector, beside the Cramer-Rao
bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tofclip.errors import InputError
from tofclip.lidar.photons.detector import FloatArray, PhotonDetector
from tofclip.lidar.photons.limits import compute_range_bound
from tofclip.units import SPEED_OF_LIGHT

BINS_PER_BATCH = 1 << 22
"""Histogram bins that are held at a time: 32 MiB."""


@dataclass(frozen=True)
class Accuracy:
    """How the detector fared.

    Parameters
    ----------
    rms_m : float
        Root mean square range error of the detected returns, wrongly placed ones included, m; NaN
        without any.
    bound_m : float
        Cramer-Rao bound of the range, m.
    ratio : float
        The first over the second. Near 1 where the bound holds; more when noise is mistaken for the
        return.
    detection_rate : float
        Share of the histograms with a return in which one was found.
    false_alarm_rate : float
        Share of the histograms without a return in which one was found.
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
    """Simulate histograms with and without a return, and locate it.

    Parameters
    ----------
    detector : PhotonDetector
    photons : float
        Expected photons of the return, which arrives anywhere in the middle half of the histogram.
    background : float
        Expected background photons in a bin; the detector does not know it.
    trials : int
        Histograms with a return, and as many without.
    seed : int
        Of the photons' chance and of the detector's, independent of each other.
    progress : callable
        Called with the number of trials just done.

    Returns
    -------
    Accuracy

    Raises
    ------
    InputError
        No trial, or a number of photons that is not positive.
    """
    if trials < 1:
        raise InputError(f"at least one trial is needed, got {trials}")
    bound = compute_range_bound(detector.pulse, detector.bin_width, photons, background)
    present, absent, chance = (
        np.random.default_rng(one) for one in np.random.SeedSequence(seed).spawn(3)
    )
    # In batches: the memory does not depend on the number of trials.
    batch = max(1, BINS_PER_BATCH // detector.bins)
    detections = false_alarms = 0
    squared_error = 0.0
    for begin in range(0, trials, batch):
        count = min(batch, trials - begin)
        fractions = present.uniform(detector.bins / 4, 3 * detector.bins / 4, count)
        arrival = fractions * detector.bin_width
        found = detector.locate(
            draw_histograms(detector, arrival, photons, background, present), _draw_seed(chance)
        )
        false = detector.locate(
            absent.poisson(background, (count, detector.bins)), _draw_seed(chance)
        )
        detected = found.detected[:, 0]
        error = (found.range[:, 0] - SPEED_OF_LIGHT * arrival / 2)[detected]
        squared_error += float(np.sum(error**2))
        detections += int(np.count_nonzero(detected))
        false_alarms += int(np.count_nonzero(false.detected[:, 0]))
        progress(count)
    rms = float(np.sqrt(squared_error / detections)) if detections else float("nan")
    return Accuracy(rms, bound, rms / bound, detections / trials, false_alarms / trials)


def draw_histograms(
    detector: PhotonDetector,
    arrival: FloatArray,
    photons: float,
    background: float,
    noise: np.random.Generator,
) -> FloatArray:
    """Draw histograms with one return each, (n, bins).

    `arrival` (n,): instants of the returns, s; the middle of the first bin is 0; `photons,
    background`: expected photons of a return, and of the background in each bin. Returns (n, bins):
    photons.
    """
    shape = detector.shape
    share = shape(detector.times - arrival[:, np.newaxis]) * detector.bin_width / shape.area
    return noise.poisson(photons * share + background).astype(np.float64)


def _draw_seed(chance: np.random.Generator) -> int:
    return int(chance.integers(1 << 62))
