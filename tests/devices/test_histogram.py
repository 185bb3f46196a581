"""Histograms of photons, against sums over each bin's overlap with each photon's interval."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose

from devices.files import PHOTON_DTYPE
from devices.histogram import BinAxis, BinHistogram, StampHistogram, TagHistogram
from devices.linospad2 import (
    CLOCK_PERIOD_S,
    CODES_PER_PERIOD,
    STAMP_DTYPE,
    BoardCalibration,
)
from devices.timetag_codec import DELTA, RECORD_DTYPE
from tofclip.errors import InputError
from tofclip.threads import THREADS_VARIABLE

PS = 1e-12


def overlaps(first, last, axis):
    """Share of each interval in each bin, (photons, bins), straight from the definition; all
    periods added up.
    """
    edges = axis.start + (np.arange(axis.bins + 1) - 0.5) * axis.bin_width
    total = np.zeros((len(first), axis.bins))
    turns = range(-8, 9) if axis.period else (0,)
    for turn in turns:
        shift = turn * (axis.period or 0)
        inside = np.clip(edges, (first + shift)[:, None], (last + shift)[:, None])
        total += np.diff(inside, axis=1) / (last - first)[:, None]
    return total


axes = st.builds(
    BinAxis,
    st.sampled_from([20 * PS, 31.7 * PS, 900 * PS]),
    st.integers(1, 12),
    st.floats(-30 * PS, 4000 * PS),
    st.sampled_from([None, 12_500 * PS, 11_003.3 * PS]),
)


@given(axes, st.integers(0, 2**32 - 1), st.sampled_from([5 * PS, 250 * PS, 5000 * PS]))
def test_times_are_shared_out_over_the_bins_they_cover(axis, seed, resolution):
    random = np.random.default_rng(seed)
    photons = np.zeros(40, PHOTON_DTYPE)
    photons["channel"] = pixels = random.integers(0, 3, 40)
    photons["bin"] = random.integers(0, 60e-9 / resolution, 40)
    times = photons["bin"] * resolution
    histogram = BinHistogram(3, axis, resolution)
    histogram.add(photons)
    shares = overlaps(times, times + resolution, axis)
    expected = np.stack([shares[pixels == pixel].sum(axis=0) for pixel in range(3)], axis=1)
    # Positions of 60 ns / 20 ps = 3000 bins in float64 and widths of a quarter bin, summed 40
    # times; see NOTHING.
    assert_allclose(histogram.counts, expected, atol=1e-6)


@pytest.fixture(scope="module")
def board():
    """Codes of very uneven widths, some of them empty, and pixels out of step."""
    random, shape = np.random.default_rng(3), (256, CODES_PER_PERIOD)
    ends = np.cumsum(random.uniform(0, 2, shape) * (random.random(shape) < 0.9), axis=1)
    ends *= CLOCK_PERIOD_S / ends[:, -1:]
    return BoardCalibration(ends, random.uniform(-6e-9, 4e-9, 256), np.array([17, 200]))


def stamps_at(times, pixels, board):
    """What the board stamps on photons that come at `times`, s since the cycle began."""
    local = times - board.offsets[pixels]
    periods, phase = np.divmod(local, CLOCK_PERIOD_S)
    codes = [
        int(np.searchsorted(board.code_ends[pixel], at, side="right"))
        for pixel, at in zip(pixels, phase, strict=True)
    ]
    records, last = np.zeros(len(times), STAMP_DTYPE), CODES_PER_PERIOD - 1
    records["pixel"] = pixels
    records["code"] = periods.astype(int) * CODES_PER_PERIOD + np.minimum(codes, last)
    return records


@pytest.mark.parametrize("period", [None, 25e-9, 17.3e-9])
def test_stamps_are_shared_out_over_their_codes(board, period):
    random = np.random.default_rng(5)
    pixels = random.integers(0, 256, 500)
    records = stamps_at(random.uniform(10e-9, 120e-9, 500), pixels, board)
    axis = BinAxis(37 * PS, 400, 300 * PS, period)
    histogram = StampHistogram(axis, board)
    histogram.add(records)
    last = board.times(records)
    width = (board.code_ends - board.code_begins)[pixels, records["code"] % CODES_PER_PERIOD]
    shares = overlaps(last - width, last, axis)
    expected = np.zeros((400, 256))
    np.add.at(expected.T, pixels, shares)
    # float32 tables: 700 bins to 6e-8 of their value, divided by codes as narrow as a hundredth of
    # a bin.
    assert_allclose(histogram.counts, expected, atol=5e-3)
    assert_allclose(histogram.counts.sum(), expected.sum(), rtol=1e-5)


def tags(rows):
    return np.array(rows, RECORD_DTYPE)


def test_tags_count_from_the_last_pulse():
    histogram = TagHistogram(BinAxis(1e-9, 10, 0.5e-9), 0, (2, 1), 1e-9)
    rows = [
        (3, 0b100, 0),  # before the first pulse
        (10, 0b001, 0),
        (12, 0b100, 0),
        (15, 0b110, 0),
        (16, 0b010, DELTA),  # a level, not an edge
        (16, 0b001, DELTA),
        (30, 0b101, 0),  # a photon together with a pulse
        (99, 0b100, 0),  # beyond the bins
    ]
    histogram.add(tags(rows))
    expected = np.zeros((10, 2))
    expected[[2, 5, 0], 0] = 1
    expected[5, 1] = 1
    assert_allclose(histogram.counts, expected, atol=1e-9)


def test_tags_on_threads_know_the_pulse_before_their_piece(monkeypatch):
    """Pulses are so rare that a piece may hold none."""
    random = np.random.default_rng(4)
    records = np.zeros(300_000, RECORD_DTYPE)
    records["time_ticks"] = np.cumsum(random.integers(0, 3, 300_000))
    records["channels"] = random.choice([2, 4], 300_000)
    records["channels"][[5, 120_000]] |= 1
    axis = BinAxis(1e-6, 400)
    found = []
    for threads in ("1", "4"):
        monkeypatch.setenv(THREADS_VARIABLE, threads)
        histogram = TagHistogram(axis, 0, (1, 2), 1e-9)
        histogram.add(records)
        found.append(histogram.counts)
    assert_allclose(found[1], found[0], atol=1e-6)
    # An interval at either end may stick out.
    assert found[0].sum() == pytest.approx(300_000 - 5, abs=1)


def test_the_sum_is_a_streak_image_that_does_not_trust_hot_pixels(board):
    histogram = StampHistogram(BinAxis(20 * PS, 100, 1e-9, 25e-9), board)
    pixels = np.arange(256)
    histogram.add(stamps_at(np.full(256, 27e-9), pixels, board))
    streak = histogram.to_streak()
    assert_allclose(streak.times, 1e-9 + np.arange(100) * 20 * PS, rtol=1e-12)
    assert streak.saturated is not None
    assert np.flatnonzero(streak.saturated.any(axis=0)).tolist() == [17, 200]
    # All at 2 ns after a pulse: row 50, and no code is longer than three rows.
    assert np.abs(np.argmax(streak.counts, axis=0) - 50).max() <= 2


AXIS = BinAxis(1e-9, 5)
BINS = BinHistogram(2, AXIS, 1e-12)
STAMPS = StampHistogram(AXIS, BoardCalibration.ideal())
LONG_AXIS = BinAxis(1e-9, 1 << 20)


@pytest.mark.parametrize(
    ("attempt", "said"),
    [
        (lambda: BINS.to_streak(), "every pixel is zero"),
        (lambda: BinAxis(0.0, 5), "positive width"),
        (lambda: BinAxis(np.nan, 5), "positive width"),
        (lambda: BinAxis(1e-9, 0), "a number"),
        (lambda: BinAxis(1e-9, 5, np.inf), "a start"),
        (lambda: BinAxis(1e-9, 5, 0.0, -1.0), "must be a positive number"),
        (lambda: BinAxis(1e-9, 5, 0.0, 4e-9), "longer than the laser's period"),
        (lambda: BinHistogram(256, LONG_AXIS, 1e-12), "more than"),
        (lambda: BinHistogram(0, LONG_AXIS, 1e-12), "are none"),
        (lambda: TagHistogram(AXIS, 1, (1, 2), 1e-9), "channels of their own"),
        (lambda: TagHistogram(AXIS, 0, (1, 2), 0.0), "a tick must be"),
        (lambda: BinHistogram(2, AXIS, -1.0), "a resolution must be"),
        (lambda: BINS.add(np.array([(0, 0, 2)], PHOTON_DTYPE)), r"2 pixels, got 2\.\.2"),
        (lambda: STAMPS.add(tags([(3, 1, 0)])), "end in code and pixel"),
        (
            lambda: STAMPS.add(np.array([(0, 5, 256), (0, 5, 255)], STAMP_DTYPE)),
            "256 pixels; 1 time stamps",
        ),
    ],
)
def test_what_cannot_be_is_refused(attempt, said):
    with pytest.raises(InputError, match=said):
        attempt()
