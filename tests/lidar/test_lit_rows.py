"""Rows with light separated from rows without, and what leaving the dark ones out does to the returns."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.camera.kernels import sum_boxes
from tofclip.lidar import Detection, depth
from tofclip.lidar.pulse_tables import TraceBins
from tofclip.lidar.signal_rows import RowBlock, SignalRowFinder
from tofclip.recovery import DepthLockedFocus, FixedFocus, recover
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


def camera() -> Camera:
    sweep = SkewSweep(CENTRES, np.array([-2.0, 1.0, 0.0, 0.5, 3.0]), np.zeros(5))
    angles = np.arctan([0.6, -0.7, 0.3, -0.1, 0.9])
    optics = {"focal_length_px": 100.0, "lenslet_pitch": 2e-3, "focus_distance": 1.3}
    return Camera(CENTRES, angles, SHAPE, 240, sweep=sweep, time_zero=-6e-9, **optics)


@pytest.fixture(scope="module")
def inverse() -> InverseTraces:
    return InverseTraces(LinearInverse().prepare(camera().operator()), order_by_patch(SHAPE))


@pytest.fixture(scope="module")
def lit_rows(inverse) -> SignalRowFinder:
    return SignalRowFinder([RowBlock(slice(0, ROWS), inverse)], 3.0, 5.0, REACH)


def find_bins(finder: SignalRowFinder, measurements: np.ndarray) -> TraceBins:
    return finder.bins(finder.sum_measurements(measurements))


def dark(seed: int) -> np.ndarray:
    """Noise about a level of its own in each column, as a sensor has it."""
    random = np.random.default_rng(seed)
    level = random.normal(0, 2 * NOISE, (240, 1))
    return (level + random.normal(0, NOISE, (240, ROWS))).astype(np.float32)


def with_pixel(
    measurements: np.ndarray, pixel: tuple[int, int], row: float, strength: float
) -> np.ndarray:
    """Add a pulse of one pixel that stands out by `strength` where every reading of it is matched."""
    picture = np.zeros(SHAPE, np.float32)
    picture[pixel] = 1
    seen = np.asarray(camera().operator()(picture))
    pulse = np.exp2(-((2 * (np.arange(ROWS) - row) / 3.0) ** 2))
    light = np.outer(seen, pulse)
    return measurements + (strength * NOISE / np.linalg.norm(light) * light).astype(np.float32)


def test_noise_is_dark_whatever_the_level_of_each_column(lit_rows):
    shares = []
    for seed in range(5):
        bins = find_bins(lit_rows, dark(seed))
        shares.append(bins.search_mask.sum() / ROWS)
        assert bins.numbers.size % LANES == 0
        assert bins.bin_weights.sum() == pytest.approx(ROWS)
        assert np.all(np.diff(bins.numbers) > 0)
    # 200 instants, of which the brightest of 1024 pixels exceeds 6 deviations once in 500
    assert np.mean(shares) < 0.05


@pytest.mark.parametrize("seed", range(12))
def test_the_light_of_a_single_pixel_is_seen_wherever_it_is(lit_rows, seed):
    random = np.random.default_rng(100 + seed)
    pixel = int(random.integers(2, 30)), int(random.integers(2, 30))
    row = random.uniform(20, ROWS - 20)
    # half-way between two instants a pulse stands out by 0.74 of its strength, so by 8.9 +- 1 here,
    # with 6 needed
    bins = find_bins(lit_rows, with_pixel(dark(seed), pixel, row, 12.0))
    where = np.searchsorted(bins.numbers, round(row))
    assert bins.numbers[where] == round(row)
    assert bins.search_mask[where]
    around = np.arange(round(row) - REACH, round(row) + REACH + 1)
    assert np.isin(around, bins.numbers[bins.bin_weights == 1]).all()


def test_a_higher_limit_looks_at_less_and_none_at_everything(inverse):
    measurements = with_pixel(dark(3), (16, 16), 300.0, 12.0)
    places = [RowBlock(slice(0, ROWS), inverse)]
    assert not find_bins(SignalRowFinder(places, 3.0, 15.0, REACH), measurements).search_mask.any()
    everything = find_bins(SignalRowFinder(places, 3.0, 0.0, REACH), measurements)
    assert everything.search_mask.all()
    np.testing.assert_array_equal(everything.numbers, np.arange(ROWS))


def test_a_shot_that_is_nowhere_dark_is_searched_everywhere(lit_rows):
    measurements = dark(0)
    for row in range(10, ROWS, 25):
        measurements = with_pixel(measurements, (16, 16), row, 200.0)
    bins = find_bins(lit_rows, measurements)
    assert bins.search_mask.all()
    np.testing.assert_array_equal(bins.bin_weights, np.ones(ROWS))


def test_a_shot_without_any_reading_is_searched_everywhere(lit_rows):
    assert find_bins(lit_rows, np.zeros((240, ROWS), np.float32)).search_mask.all()


def test_columns_and_rows_that_were_never_measured_are_not_taken_for_the_darkest(lit_rows):
    measurements = dark(1)
    measurements[:, :60] = 0
    measurements[40:90] = 0
    bins = find_bins(lit_rows, with_pixel(measurements, (16, 16), 300.0, 40.0))
    assert bins.search_mask.sum() < 60
    assert 300 in bins.numbers[bins.search_mask]


def test_places_with_an_operator_of_their_own_have_their_own_instants(inverse):
    cuts = [0, 7, 150, 151, 400, ROWS]
    places = [RowBlock(slice(first, last), inverse) for first, last in pairwise(cuts)]
    bins = find_bins(
        SignalRowFinder(places, 3.0, 5.0, REACH), with_pixel(dark(4), (10, 20), 150.0, 20.0)
    )
    assert 150 in bins.numbers[bins.search_mask]
    assert bins.bin_weights.sum() == pytest.approx(ROWS)


def test_boxes_are_sums_of_successive_rows():
    measurements = np.random.default_rng(0).random((50, 70)).astype(np.float32)
    starts = np.random.default_rng(1).integers(0, 45, 3 * LANES)
    sums = np.full((70, starts.size + 3), -1, np.float32)
    sum_boxes(measurements, starts, 5, (LANES, 3 * LANES), sums)
    expected = measurements[starts[:, np.newaxis] + np.arange(5)].sum(axis=1).T
    np.testing.assert_allclose(sums[:, LANES:-3], expected[:, LANES:], rtol=1e-6)
    assert np.all(sums[:, :LANES] == -1)
    assert np.all(sums[:, -3:] == -1)


SCENE = Scene(
    tuple(
        make_plate(
            (place * distance / 100, place * distance / 100, distance),
            (0.08, 0.08),
            make_checkerboard(3, 0.3, 0.9),
        )
        for distance, place in ((1.05, -6), (1.3, 7), (1.6, 0))
    )
)


@pytest.mark.parametrize("focus", [FixedFocus(), DepthLockedFocus()])
def test_returns_are_those_of_all_rows(focus, monkeypatch):
    made = simulate_shot(
        SCENE, Instrument(camera(), StreakDetector(ROWS, BIN, peak_photons=2000.0)), 0
    ).streak
    pipeline = RangingPipeline(camera(), made.times, focus=focus)
    measurements = pipeline.rectifier.measure(made.counts).values
    some = pipeline.find_returns(measurements)
    monkeypatch.setattr(SignalRowFinder, "bins", lambda self, _: TraceBins.all_bins(self.rows))
    everything = pipeline.find_returns(measurements)
    places = [
        {
            (int(y), int(x), round(float(time) / BIN))
            for y, x, time in zip(one.y, one.x, one.time, strict=True)
        }
        for one in (some, everything)
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


def test_frames_that_are_there_are_searched_everywhere():
    made = simulate_shot(
        SCENE, Instrument(camera(), StreakDetector(ROWS, BIN, peak_photons=2000.0)), 1
    ).streak
    pipeline = RangingPipeline(
        camera(), made.times, detection=replace(Detection(), signal_to_noise=0.0)
    )
    frames = recover(made, camera(), method="linear")
    alone = depth(frames, detection=replace(Detection(), signal_to_noise=0.0))
    found = pipeline.find_returns(pipeline.rectifier.measure(made.counts).values)
    assert abs(len(found) - len(alone)) <= 2
