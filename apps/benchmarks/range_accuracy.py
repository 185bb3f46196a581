"""Study: how close ranges from counted photons come to the Cramer-Rao bound, over the span of use.

Where returns go unseen now and then (a detection rate below 0.999), the bound does not hold.
"""

from __future__ import annotations

import numpy as np

from apps.benchmarks.harness import Case, PreparedCase
from tofclip.lidar import Pulse
from tofclip.lidar.photons import PhotonDetector, measure_accuracy

PHOTONS = (20, 100, 500, 2000, 10_000)
BACKGROUNDS = (0.01, 0.03, 0.1, 0.3, 1.0)  # photons a bin
FALSE_ALARM_RATE = 0.01
TRIALS, BINS = 2000, 256
PULSE_FWHM_S, BIN_WIDTH_S = 60e-12, 20e-12


def prepare_accuracy(photons: int) -> PreparedCase:
    """Simulated histograms at the middle background are timed; every background is judged."""
    detector = PhotonDetector(Pulse.gaussian(PULSE_FWHM_S), BIN_WIDTH_S, BINS, FALSE_ALARM_RATE)
    random = np.random.default_rng(0)

    def judge() -> dict[str, float]:
        found = {}
        for seed, background in enumerate(BACKGROUNDS):
            accuracy = measure_accuracy(detector, photons, background, TRIALS, seed)
            found[f"error over bound at background {background:g}"] = accuracy.ratio
            found[f"detection rate at background {background:g}"] = accuracy.detection_rate
            found[f"false alarm rate at background {background:g}"] = accuracy.false_alarm_rate
        return found

    return PreparedCase(
        lambda: measure_accuracy(detector, photons, BACKGROUNDS[2], TRIALS, 0),
        lambda: random.poisson(BACKGROUNDS[2], (TRIALS, BINS)),
        TRIALS,
        figures=judge,
    )


CASES = (
    Case(
        "accuracy-photons",
        f"ranges from counted photons, {TRIALS} histograms of {BINS} bins",
        "signal photons",
        PHOTONS,
        "histograms",
        "drawing the background's photons",
        prepare_accuracy,
    ),
)
