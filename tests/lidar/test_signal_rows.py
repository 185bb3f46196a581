"""Rows with light separated from rows without, frames in which a pixel stands out, and what leaving
the dark ones out does to the returns.
"""

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.lidar.pulse import TraceBins
from tofclip.lidar.signal_rows import RowBlock, SignalRowFinder
from tofclip.recovery import DepthLockedFocus, FixedFocus
from tofclip.sequences.ranger import RangingPipeline
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_checkerboard
from tofclip.solvers import LinearInverse
from tofclip.solvers.direct import InverseTraces, order_by_patch
from tofclip.threads import LANES

CENTRES = 30.0 + 45 * np.arange(5)
ROWS, REACH = 600, 8
BIN = 20e-12
SHAPE = (32, 32)
NOISE = 3.0


def camera():
    sweep = SkewSweep(CENTRES, np.array([-2.0, 1.0, 0.0, 0.5, 3.0]), np.zeros(5))
    angles = np.arctan([0.6, -0.7, 0.3, -0.1, 0.9])
    optics = {"focal_length_px": 100.0, "lenslet_pitch": 2e-3, "focus_distance": 1.3}
    return Camera(CENTRES, angles, SHAPE, 240, sweep=sweep, time_zero=-6e-9, **optics)


@pytest.fixture(scope="module")
def inverse():
    return InverseTraces(LinearInverse().prepare(camera().operator()), order_by_patch(SHAPE))


@pytest.fixture(scope="module")
def find_bins(inverse):
    """What is looked at of some measurements, by a search with a limit."""

    def find(measurements, limit=5.0):
        finder = SignalRowFinder([RowBlock(slice(0, ROWS), inverse)], 3.0, limit, REACH)
        return finder.bins(measurements)

    return find


def dark(seed):
    """Noise about a level of its own in each column, as a sensor has it."""
    random = np.random.default_rng(seed)
    level = random.normal(0, 2 * NOISE, (240, 1))
    return (level + random.normal(0, NOISE, (240, ROWS))).astype(np.float32)


def with_pixel(measurements, pixel, row, strength):
    """Add a pulse of one pixel that stands out by `strength` where every reading of it is matched."""
    picture = np.zeros(SHAPE, np.float32)
    picture[pixel] = 1
    seen = np.asarray(camera().operator()(picture))
    pulse = np.exp2(-((2 * (np.arange(ROWS) - row) / 3.0) ** 2))
    light = np.outer(seen, pulse)
    return measurements + (strength * NOISE / np.linalg.norm(light) * light).astype(np.float32)


def test_noise_is_dark_whatever_the_level_of_each_column(find_bins):
    shares = []
    for seed in range(5):
        bins = find_bins(dark(seed))
        shares.append(bins.search_mask.sum() / ROWS)
        assert bins.numbers.size % LANES == 0
        assert bins.bin_weights.sum() == pytest.approx(ROWS)
        assert np.all(np.diff(bins.numbers) > 0)
    # 200 instants, of which the brightest of 1024 pixels exceeds 6 deviations once in 500
    assert np.mean(shares) < 0.05


@pytest.mark.parametrize("seed", range(12))
def test_the_light_of_a_single_pixel_is_seen_wherever_it_is(find_bins, seed):
    random = np.random.default_rng(100 + seed)
    pixel = int(random.integers(2, 30)), int(random.integers(2, 30))
    row = random.uniform(20, ROWS - 20)
    # half-way between two instants a pulse stands out by 0.74 of its strength, so by 8.9 +- 1 here,
    # with 6 needed
    bins = find_bins(with_pixel(dark(seed), pixel, row, 12.0))
    where = np.searchsorted(bins.numbers, round(row))
    assert bins.numbers[where] == round(row)
    assert bins.search_mask[where]
    around = np.arange(round(row) - REACH, round(row) + REACH + 1)
    assert np.isin(around, bins.numbers[bins.bin_weights == 1]).all()


@pytest.mark.parametrize("case", ["no limit", "nowhere dark", "nothing measured"])
def test_everything_is_searched_where_nothing_tells_the_dark(find_bins, case):
    measurements = np.zeros((240, ROWS), np.float32) if case == "nothing measured" else dark(0)
    for row in range(10, ROWS, 25) if case == "nowhere dark" else ():
        measurements = with_pixel(measurements, (16, 16), row, 200.0)
    bins = find_bins(measurements, 0.0 if case == "no limit" else 5.0)
    assert bins.search_mask.all()
    np.testing.assert_array_equal(bins.numbers, np.arange(ROWS))
    np.testing.assert_array_equal(bins.bin_weights, np.ones(ROWS))


def test_columns_and_rows_that_were_never_measured_are_not_taken_for_the_darkest(find_bins):
    measurements = dark(1)
    measurements[:, :60] = 0
    measurements[40:90] = 0
    bins = find_bins(with_pixel(measurements, (16, 16), 300.0, 40.0))
    assert bins.search_mask.sum() < 60
    assert 300 in bins.numbers[bins.search_mask]


def see_plates(seed, **settings):
    """A shot of three plates and what makes its cloud."""

    def make(distance, place):
        at = place * distance / 100
        return make_plate((at, at, distance), (0.08, 0.08), make_checkerboard(3, 0.3, 0.9))

    scene = Scene((make(1.05, -6), make(1.3, 7), make(1.6, 0)))
    made = Instrument(camera(), StreakDetector(ROWS, BIN, peak_photons=2000.0))
    shot = simulate_shot(scene, made, seed).streak
    pipeline = RangingPipeline(camera(), shot.times, **settings)
    return shot, pipeline, pipeline.rectifier.measure(shot.counts).values


@pytest.mark.parametrize("focus", [FixedFocus(), DepthLockedFocus()])
def test_returns_are_those_of_all_rows(focus, monkeypatch):
    _, pipeline, measurements = see_plates(0, focus=focus)
    some = pipeline.find_returns(measurements)
    monkeypatch.setattr(SignalRowFinder, "bins", lambda self, _: TraceBins.all_bins(self.rows))
    everything = pipeline.find_returns(measurements)
    places = [
        set(zip(one.y, one.x, np.round(one.time / BIN), strict=True)) for one in (some, everything)
    ]
    assert len(places[1]) > 300
    # background and noise come from a sample of the dark rows: a return at a limit may fall on its
    # other side
    assert len(places[0] ^ places[1]) <= 0.01 * len(places[1])
    if len(some) == len(everything):
        # 64 rows know the background of a pixel to an eighth of its noise, which moves no symmetric
        # pulse
        np.testing.assert_allclose(np.median(np.abs(some.range - everything.range)), 0, atol=1e-6)
        np.testing.assert_allclose(some.intensity, everything.intensity, rtol=0.05)
