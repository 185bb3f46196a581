"""The fit of returns by a table of the pulse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.lidar import Detection, Pulse, depth
from tofclip.lidar.fit_kernels import fit_returns
from tofclip.lidar.peak_kernels import (
    CANDIDATE_COLUMNS,
    FIRST_OFFSET,
    HEIGHT,
    MOVED,
    OFFSET,
    PEAK_BIN,
    Room,
)
from tofclip.lidar.pulse_tables import (
    MAX_OFFSET_BINS,
    PhaseTable,
    TraceBins,
)
from tofclip.shots import Frames

BIN, FWHM = 20e-12, 60e-12
SIDE, BINS = 8, 60
TIMES = 10e-9 + BIN * np.arange(BINS)


def look(arrivals_bins, times, noise=0.0):
    """One return in each pixel, this many bins after the first."""
    after = times[:, np.newaxis] - (times[0] + BIN * arrivals_bins)
    values = 100 * Pulse.gaussian(FWHM)(after) + 3.0
    values += np.random.default_rng(0).normal(0, 1, values.shape) * noise
    camera = Camera([20.0], [0.1], (SIDE, SIDE), 41, pulse_fwhm=FWHM)
    return Frames(values.reshape(-1, SIDE, SIDE).astype(np.float32), times, camera)


def test_a_return_is_where_it_arrives_whatever_part_of_a_bin_that_is():
    arrivals = 30 + np.linspace(-0.5, 0.5, SIDE * SIDE)
    found = depth(look(arrivals, TIMES), detection=Detection(min_time_bin_fraction=0))
    assert len(found) == SIDE * SIDE
    # (1 / 128)^2 of a bin, and the background's 3 counts in single precision
    np.testing.assert_allclose((found.time - TIMES[0]) / BIN, arrivals, atol=2e-4)


def test_it_agrees_with_the_exact_fit_which_an_uneven_axis_needs():
    arrivals = np.random.default_rng(1).uniform(20, 40, SIDE * SIDE)
    # a last bin that is longer, far from all light: the axis is uneven, and the fit exact
    uneven = np.append(TIMES[:-1], TIMES[-1] + 0.3 * BIN)
    assert PhaseTable.tabulate(Pulse.gaussian(FWHM), uneven).half == 0
    by_table, exact = (depth(look(arrivals, times, 3.0)) for times in (TIMES, uneven))
    assert len(by_table) == len(exact) == SIDE * SIDE
    apart = np.abs(by_table.time - exact.time) / BIN
    assert np.median(apart) < 1 / 128**2 * 10
    # where the last step is shorter than 5e-3 bins, one more would be a part of that
    assert apart.max() < 5e-3
    np.testing.assert_allclose(by_table.intensity, exact.intensity, rtol=1e-3)


@pytest.mark.parametrize("apart", [4.5, 6.0, 8.0])
def test_returns_that_overlap_are_fitted_as_exactly(apart):
    rng = np.random.default_rng(2)
    arrivals = rng.uniform(20, 30, SIDE * SIDE)
    uneven = np.append(TIMES[:-1], TIMES[-1] + 0.3 * BIN)
    # a bright one, and a dim one that lies on its slope: what the first one leaves must be right
    by_table, exact = (
        depth(
            add_dim(look(arrivals, times, 1.0), look(arrivals + apart, times)),
            detection=Detection(min_time_bin_fraction=0, min_scene_fraction=0),
        )
        for times in (TIMES, uneven)
    )
    assert len(by_table) == len(exact) >= 2 * SIDE * SIDE - 2
    near = np.abs(by_table.time - exact.time) / BIN
    # where the last step is shorter than 5e-3 bins, one more would be a part of that
    assert np.median(near) < 1e-3
    assert near.max() < 5e-3
    np.testing.assert_allclose(by_table.intensity, exact.intensity, rtol=5e-3)
    np.testing.assert_allclose(by_table.confidence, exact.confidence, rtol=2e-2)


def add_dim(bright, dim):
    return replace(bright, values=bright.values + np.float32(0.3) * dim.values)


def test_bins_whose_neighbours_are_not_held_are_left_to_the_exact_fit():
    table = PhaseTable.tabulate(Pulse.gaussian(FWHM), TIMES)
    numbers = np.r_[0:20, 22:60]
    bins = TraceBins(numbers, np.ones(58, bool), np.ones(58, np.float32))
    even = table.find_even_bins(bins)
    half = table.half
    assert np.flatnonzero(even).tolist() == [*range(half, 20 - half), *range(20 + half, 58 - half)]


@pytest.mark.parametrize(("peak", "there"), [(27, True), (33, True), (56, False)])
def test_a_return_is_followed_when_it_moves_away_from_its_peak(peak, there):
    """As far as the bins around it are held; beyond, the exact fit takes over, which begins where the
    return was before any fit.
    """
    table = PhaseTable.tabulate(Pulse.gaussian(FWHM), TIMES)
    arrival = 30.2 if there else peak + 2.0
    traces = np.zeros((2, 64), np.float32)
    traces[0, :BINS] = 100 * Pulse.gaussian(FWHM)(TIMES - TIMES[0] - BIN * arrival) + 3
    candidates = np.zeros((1, CANDIDATE_COLUMNS))
    candidates[0, [PEAK_BIN, MOVED, OFFSET, FIRST_OFFSET]] = peak, np.inf, 0.1, 0.1
    rests = np.zeros((1, table.shapes.shape[1]), np.float32)
    rests[0, : 2 * table.half + 1] = np.pad(traces[0] - 3, 9)[9 + peak - table.half :][
        : 2 * table.half + 1
    ]
    even = table.find_even_bins(TraceBins.all_bins(BINS))
    room = Room(
        **dict.fromkeys(("score", "responses", "free"), np.empty(0, np.float32)),
        **dict.fromkeys(("peaks", "estimates"), np.empty((0, 2))),
        fitted=np.zeros(1, np.int64),
        level=np.empty(0),
        places=np.empty((4, 0), np.int32),
        moments=np.array([[3.0, 1.0]]),
        candidates=candidates,
        rests=rests,
    )
    fit_returns(traces[:1], table, even, room, 1)
    assert candidates[0, PEAK_BIN] + candidates[0, FIRST_OFFSET] == pytest.approx(peak + 0.1)
    if there:
        assert candidates[0, PEAK_BIN] + candidates[0, OFFSET] == pytest.approx(30.2, abs=1e-3)
        assert abs(candidates[0, OFFSET]) <= MAX_OFFSET_BINS
        assert candidates[0, HEIGHT] == pytest.approx(100, rel=1e-3)
    else:
        assert np.isnan(candidates[0, HEIGHT])
