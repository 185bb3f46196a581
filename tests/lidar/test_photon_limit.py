"""Counted photons: the bound, the detector that reaches it, pile-up, and pixels that need their
neighbours.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import binom, exponnorm

from tofclip.errors import InputError
from tofclip.lidar import Pulse
from tofclip.lidar.photons import (
    PhotonDetector,
    compute_range_bound,
    correct_pile_up,
    learn_background,
    measure_accuracy,
)
from tofclip.units import SPEED_OF_LIGHT

BIN = 20e-12
FWHM = 60e-12
BINS = 128
SIGMA = FWHM / np.sqrt(8 * np.log(2))
TRIALS = 1000
nightly = pytest.mark.nightly


def metres(time):
    return SPEED_OF_LIGHT * time / 2


def histograms(arrival, photons, background, seed, pulse=None):
    """Photons thrown one by one from the pulse and evenly over the bins, not by the package."""
    noise = np.random.default_rng(seed)
    counts = noise.poisson(background, (arrival.size, BINS)).astype(float)
    for row, number in enumerate(noise.poisson(photons, arrival.size)):
        after = noise.normal(0, SIGMA, number) if pulse is None else pulse(noise, number)
        counts[row] += np.histogram((arrival[row] + after) / BIN, np.arange(BINS + 1) - 0.5)[0]
    return counts


@pytest.fixture(scope="module")
def detector():
    return PhotonDetector(Pulse.gaussian(FWHM), BIN, BINS)


def compute_rms(values):
    return np.sqrt(np.mean(np.square(values)))


@pytest.mark.parametrize(
    ("decay", "width_ps", "background"), [(80e-12, 20, 0.0), (80e-12, 90, 0.5), (1e-12, 150, 50.0)]
)
def test_the_bound_is_that_of_the_whole_fisher_matrix(decay, width_ps, background):
    """Arrival and amount both unknown, over all places within a bin, by finite differences of the
    pulse's distribution function. Only in bins wider than the pulse do the two get into each
    other's way.
    """
    sigma, photons, width = 25e-12, 50.0, width_ps * 1e-12

    def expected(arrival, amount):
        edges = (np.arange(-15, 60) - 0.5) * width - arrival
        cumulative = exponnorm.cdf(edges, decay / sigma, scale=sigma)
        return amount * np.diff(cumulative)

    variances = []
    for phase in (np.arange(64) + 0.5) / 64 - 0.5:
        at, step = phase * width, 1e-4 * width
        slope = (expected(at + step, photons) - expected(at - step, photons)) / (2 * step)
        light = expected(at, photons)
        seen = light + background > 1e-9
        weight = 1 / (light + background)[seen]
        derivatives = np.stack([slope, light / photons])[:, seen]
        variances.append(np.linalg.inv(derivatives * weight @ derivatives.T)[0, 0])
    pulse = Pulse.exponentially_modified(sigma * np.sqrt(8 * np.log(2)), decay)
    found = compute_range_bound(pulse, width, photons, background)
    assert found == pytest.approx(metres(np.sqrt(np.mean(variances))), rel=0.02)


@pytest.mark.parametrize(
    ("photons", "background"),
    [(20, 0.01), (100, 0.1), (800, 50.0)],
)
def test_ranges_are_true_and_within_a_tenth_of_the_bound(detector, photons, background):
    """2000 returns: bias within four deviations of a mean, deviations within four of theirs."""
    trials = 2000
    arrival = np.random.default_rng(12).uniform(30, 90, trials) * BIN
    found = detector.locate(histograms(arrival, photons, background, seed=13))
    seen = found.detected[:, 0]
    assert seen.sum() > (1990 if background > 1 else trials - 1)
    error = (found.range[:, 0] - metres(arrival))[seen]
    bound = compute_range_bound(detector.pulse, BIN, photons, background)
    assert compute_rms(error) < 1.1 * bound
    assert abs(error.mean()) < 4 * bound / np.sqrt(trials)
    assert np.mean(found.photons[seen]) == pytest.approx(photons, rel=0.02)
    # A normal number's square has a variance of two.
    room = 4 * np.sqrt(2 / trials) if photons >= 500 else 0.22
    assert np.mean((error / found.confidence[seen, 0]) ** 2) == pytest.approx(1, abs=room)


@pytest.mark.parametrize("background", [0.01, 0.1, 1.0, 30.0])
@pytest.mark.parametrize("rate", [0.01, 0.1])
def test_false_alarms_come_at_the_stated_rate_at_any_background(background, rate):
    quiet = PhotonDetector(Pulse.gaussian(FWHM), BIN, BINS, rate)
    empty = np.random.default_rng(7).poisson(background, (TRIALS, BINS))
    alarms = int(quiet.locate(empty).detected.sum())
    silent = np.mean(empty.sum(axis=1) == 0)  # histograms without a photon raise no alarm
    # eight cases: one in a hundred runs would fail one of them
    low, high = binom.interval(0.999, TRIALS, rate)
    assert low - rate * silent * TRIALS <= alarms <= high


PROFILES = {
    "step": lambda time: np.where(time < 128, 1.0, 3.0),
    "fog": lambda time: np.exp(-time / 64),
    "ramp": lambda time: np.exp(-time / 128),
    "nearby": lambda time: 1 + 10 * np.exp(-time / 10),
    "hot bin": lambda time: np.where(time == 85, 5.0, 1.0),
}
CASES = [
    pytest.param(name, level, marks=[] if (name, level) == ("nearby", 0.05) else nightly)
    for name in PROFILES
    for level in (0.05, 0.5)
]


@pytest.mark.parametrize(("name", "level"), CASES)
def test_false_alarms_come_at_the_stated_rate_on_an_uneven_background(name, level):
    profile, trials = PROFILES[name](np.arange(256)), 3000
    counts = np.random.default_rng(3).poisson(profile / profile.mean() * level, (trials, 256))
    # thresholds are themselves known to 7 percent, a learnt shape to its own noise: a fifth of 30
    low, high = binom.interval(0.999, trials, 0.01)
    for background in (None, profile):
        uneven = PhotonDetector(Pulse.gaussian(FWHM), BIN, 256, background=background)
        assert low - 6 <= uneven.locate(counts).detected.sum() <= high + 6


def test_what_pixels_have_in_common_is_background_but_a_wall_is_not():
    noise, time = np.random.default_rng(1), np.arange(256)
    dark = 0.2 * (1 + 4 * np.exp(-time / 30))
    arrival = noise.uniform(60, 200, 2000)
    wall = 20 * np.exp(-0.5 * ((time - 120) / 1.3) ** 2) / 3.3
    own = 20 * np.exp(-0.5 * ((time - arrival[:, None]) / 1.3) ** 2) / 3.3
    for light in (wall, own):
        learnt = learn_background(noise.poisson(dark + light, (2000, 256)).astype(float), 3.0)
        assert learnt is not None
        wrong = np.abs(learnt * dark.mean() / dark - 1)
        # a decay in blocks, and a mixture told apart: the wall alone would be ten times too much
        assert np.median(wrong) < 0.1
        assert wrong.max() < 0.6
    hot = noise.poisson(dark + own, (2000, 256)).astype(float)
    hot[7, 100] = 1e6
    learnt = learn_background(hot, 3.0)  # within a second, and as without that pixel
    assert np.abs(learnt[:90] / (dark / dark.mean())[:90] - 1).max() < 0.6
    even = noise.poisson(0.2 + own).astype(float)
    assert learn_background(even[:100], 3.0) is None


@pytest.mark.parametrize(("signal", "dark"), [(0.5, 0.3), (5.0, 3.0)])
def test_deviations_hold_what_pile_up_costs(detector, signal, dark):
    """Of a detector that counts the first photon of each of 1000 cycles."""
    noise = np.random.default_rng(2)
    arrival = noise.uniform(30, 60, 300)
    edges = np.arange(BINS + 1) - 0.5
    light = signal * np.diff(ndtr((edges - arrival[:, None]) * BIN / SIGMA), axis=1)
    hazard = np.cumsum(dark / BINS + light, axis=1)
    missed = np.exp(-np.column_stack([np.zeros(arrival.size), hazard]))
    first = np.column_stack([-np.diff(missed, axis=1), missed[:, -1]])
    counts = np.stack([noise.multinomial(1000, one / one.sum())[:-1] for one in first])
    found = detector.locate(counts, cycles=1000)
    assert found.detected.all()
    error = found.range[:, 0] - metres(arrival * BIN)
    # 300 trials: 4 percent
    assert 0.9 <= compute_rms(error / found.confidence[:, 0]) <= 1.2
    assert abs(error.mean()) < metres(0.05 * BIN)


def test_an_exponentially_modified_pulse_has_its_shape_and_is_located():
    pulse = Pulse.exponentially_modified(FWHM, 100e-12)

    def draw(noise, number):
        return noise.normal(0, SIGMA, number) + noise.exponential(1e-10, number)

    drawn = draw(np.random.default_rng(0), 400_000)
    counted, edges = np.histogram(drawn, np.arange(-10, 40) * BIN)
    middle = (edges[1:] + edges[:-1]) / 2
    share = pulse.integrate_bins(BIN)(middle) / pulse.integrate_bins(BIN).area * BIN
    assert counted / drawn.size == pytest.approx(share, abs=5 * np.sqrt(share.max() / drawn.size))
    arrival = np.random.default_rng(4).uniform(30, 70, TRIALS) * BIN
    counts = histograms(arrival, 200, 0.1, 3, draw)
    error = PhotonDetector(pulse, BIN, BINS).locate(counts).range[:, 0] - metres(arrival)
    assert compute_rms(error) < 1.1 * compute_range_bound(pulse, BIN, 200, 0.1)


def test_two_returns_are_both_found_and_do_not_pull_each_other():
    detector = PhotonDetector(Pulse.gaussian(FWHM), BIN, BINS, max_returns=3)
    noise = np.random.default_rng(5)
    near = noise.uniform(30, 50, 300) * BIN
    far = near + 2.2 * FWHM
    counts = histograms(near, 400, 0.05, 6) + histograms(far, 150, 0.05, 7)
    found = detector.locate(counts)
    assert np.all(found.detected[:, :2])
    assert np.mean(found.detected[:, 2]) < 0.03  # a hundredth by chance
    for column, arrival, photons in ((0, near, 400), (1, far, 150)):
        error = found.range[:, column] - metres(arrival)
        bound = compute_range_bound(detector.pulse, BIN, photons, 0.1)
        # 300 trials: 4 percent; beside each other they know slightly less
        assert compute_rms(error) < 1.2 * bound
        assert abs(error.mean()) < 4 * bound / np.sqrt(300)


SETTINGS = {"pulse": Pulse.gaussian(FWHM), "bin_width": BIN, "bins": BINS}


@pytest.mark.parametrize(
    "ask",
    [
        lambda seen: seen.locate(np.zeros((3, BINS + 1))),
        lambda seen: seen.locate(np.full((1, BINS), -1.0)),
        lambda seen: seen.locate(np.full((1, BINS), np.nan)),
        lambda _: PhotonDetector(**SETTINGS, false_alarm_rate=1e-5),
        lambda _: PhotonDetector(**{**SETTINGS, "bins": 12}),
        lambda _: PhotonDetector(**SETTINGS, max_returns=0),
        lambda _: PhotonDetector(**{**SETTINGS, "bin_width": 0.0}),
        lambda _: PhotonDetector(**SETTINGS, background=np.ones(3)),
        lambda _: PhotonDetector(**SETTINGS, background=np.zeros(BINS)),
        lambda seen: measure_accuracy(seen, 100, 0.1, trials=0),
        *(
            lambda _, numbers=numbers: compute_range_bound(SETTINGS["pulse"], *numbers)
            for numbers in ((0, 1, 1), (BIN, 0, 1), (BIN, 1, -1), (BIN, np.nan, 1))
        ),
        lambda _: compute_range_bound(SETTINGS["pulse"], BIN, 1e300, 1),
        lambda _: compute_range_bound(SETTINGS["pulse"], BIN, 1, 1e19),
        lambda _: correct_pile_up([3], 2),
        lambda _: correct_pile_up([-1], 2),
        lambda _: correct_pile_up([1], 0),
        lambda _: correct_pile_up([1], 2, 0),
        lambda _: correct_pile_up([2, 2], 3, 1),
    ],
)
def test_what_cannot_be_is_refused(detector, ask):
    with pytest.raises(InputError, match=r"must|shape|positive|least|above|allow|between|needs"):
        ask(detector)


def test_histograms_without_a_photon_hold_no_return(detector):
    assert not detector.locate(np.zeros((3, BINS))).detected.any()


def test_accuracy_reports_what_was_asked(detector, monkeypatch):
    outcome = measure_accuracy(detector, 100, 0.1, trials=500, seed=3)
    assert outcome.ratio == pytest.approx(outcome.rms_m / outcome.bound_m)
    assert 0.85 < outcome.ratio < 1.1  # 500 trials: 3.2 percent, three of them on either side
    assert outcome.detection_rate == 1
    assert outcome == measure_accuracy(detector, 100, 0.1, trials=500, seed=3)
    assert outcome != measure_accuracy(detector, 100, 0.1, trials=500, seed=4)
    below = measure_accuracy(detector, 5, 3.0, trials=200)
    assert below.detection_rate < 0.5
    assert below.ratio > 3  # what is detected there is mostly noise
    # In batches memory does not grow with the number of trials, and every trial counts.
    monkeypatch.setattr("tofclip.lidar.photons.detector.BINS_PER_BATCH", 128 * BINS)
    done: list[int] = []
    pieces = measure_accuracy(detector, 100, 0.1, trials=500, seed=3, progress=done.append)
    assert done == [128, 128, 128, 116]
    assert pieces.rms_m == pytest.approx(outcome.rms_m, rel=0.3)
    assert pieces.detection_rate == pytest.approx(1, abs=0.05)


def count_blinded(rate, cycles, dead, seed):
    """Photon by photon: a detector that misses what comes within `dead` bins after a count."""
    arrivals = np.random.default_rng(seed).random((cycles, rate.size)) < 1 - np.exp(-rate)
    ready, counts = np.zeros(cycles, int), np.zeros(rate.size)
    for bin_ in range(rate.size):
        counted = arrivals[:, bin_] & (ready <= bin_)
        ready[counted] = bin_ + 1 + dead
        counts[bin_] = counted.sum()
    return counts


@pytest.mark.parametrize("dead", [None, 10])
def test_pile_up_is_undone(dead):
    rate = 0.01 + 0.3 * np.exp(-(((np.arange(60) - 25) / 3) ** 2))
    counts = count_blinded(rate, 100_000, 10_000 if dead is None else dead, 8)
    first = np.arange(32)  # beyond, few first photons are left
    arrived = correct_pile_up(counts, 100_000, dead)[:32] / 100_000
    assert abs(np.average(first, weights=counts[:32]) - 25) > 0.5
    assert arrived == pytest.approx(rate[:32], rel=0.12, abs=0.003)
    middle = np.average(first, weights=rate[:32])
    assert np.average(first, weights=arrived) == pytest.approx(middle, abs=0.1)


def test_pile_up_of_few_photons_changes_nothing_and_dead_bins_are_unknown():
    counts = np.array([0, 1, 0, 2, 0])
    assert correct_pile_up(counts, 10**9) == pytest.approx(counts, rel=1e-6)
    spent = correct_pile_up([5, 5, 0, 0], 10)
    assert spent[0] == pytest.approx(10 * np.log(2))
    assert np.isnan(spent[1:]).all()
