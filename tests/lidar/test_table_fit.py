"""The fit of returns by a table of the pulse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.lidar import Detection, Pulse, depth
from tofclip.lidar.pulse import PhaseTable
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
