"""The demonstration's scene: its truth, and depth from frames that recovery had no part in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofclip.errors import InputError, ShapeError
from tofclip.lidar import depth, point_cloud
from tofclip.simulate import (
    make_default_instrument,
    make_default_scene,
    render_true_frames,
    score_returns,
    simulate_shot,
)
from tofclip.simulate.patterns import cut_pattern, make_letter, make_plain_pattern
from tofclip.units import SPEED_OF_LIGHT

BIN_M = SPEED_OF_LIGHT * 20e-12 / 2


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(make_default_scene(), make_default_instrument(), 0)


@pytest.fixture(scope="module")
def frames(shot):
    return render_true_frames(make_default_scene(), make_default_instrument(), shot.exposure)


def test_the_scene_is_where_the_instrument_looks(shot):
    truth = shot.truth
    assert 1.7 < np.nanmin(truth.range) < 1.8
    assert 3.1 < np.nanmax(truth.range) < 3.25
    assert truth.target.sum() > 5000
    assert truth.reflectance.max() <= 1
    assert np.all(np.isfinite(truth.range[truth.target]))
    assert not shot.signal[[0, -1]].any()  # the sweep sees all of it
    assert shot.streak.counts.max() == pytest.approx(
        make_default_instrument().detector.full_scale_photons
    )


def test_the_letters_are_upright_and_not_mirrored(shot):
    # the U, 34 pixels wide around (-25, -24) from the optical axis, is the nearest plate; compare
    # with its drawing
    seen = shot.truth.range[64 - 24 - 17 : 64 - 24 + 17, 64 - 25 - 17 : 64 - 25 + 17] < 1.9
    drawn = np.isfinite(cut_pattern(make_letter("U"), make_plain_pattern(0.5)))
    step = (np.arange(34) + 0.5) / 34 * drawn.shape[0]
    picture = drawn[np.ix_(step.astype(int), step.astype(int))]
    assert np.mean(seen == picture) > 0.93  # the borders lie half a pixel aside
    assert np.mean(seen == picture[::-1]) < 0.8
    # the L's foot points to the right: lower right is letter, upper right is not
    middle_row, middle_column = 64 + 22, 64 - 24
    is_l = np.abs(shot.truth.range - 2.36) < 0.03
    assert is_l[middle_row + 12, middle_column + 12]
    assert not is_l[middle_row - 12, middle_column + 12]


def test_true_frames_give_the_true_depth(shot, frames):
    returns = depth(frames)
    figures = score_returns(returns, shot.truth)
    assert figures["bin_m"] == pytest.approx(BIN_M)
    assert figures["median_depth_error_m"] < 0.01 * BIN_M  # measured: 0.0003 bin
    assert figures["share_within_one_bin"] == 1.0
    assert figures["share_with_return"] == 1.0
    assert figures["false_return_share"] == 0.0


def test_true_frames_give_the_reflectance(shot, frames):
    intensity = depth(frames).image("intensity")[shot.truth.target]
    reflectance = shot.exposure * shot.truth.reflectance[shot.truth.target]
    # the tails beyond 1 % of the pulse's peak, 0.2 %, and the rows' own width, which spreads the
    # pulse by 2.5 %
    np.testing.assert_allclose(intensity, reflectance, rtol=0.03)


def test_photon_noise_leaves_the_depth_far_below_half_a_bin(shot, frames):
    noisy = np.random.default_rng(0).poisson(frames.values + 0.05).astype(np.float32)
    figures = score_returns(depth(replace(frames, values=noisy)), shot.truth)
    # some 60 photons a pixel: 26 ps / sqrt(60) * c / 2 is 0.5 mm as a standard deviation; half a
    # bin is 1.5 mm
    assert figures["median_depth_error_m"] < 0.5 * BIN_M / 2
    assert figures["share_within_one_bin"] > 0.95


def test_the_wall_of_the_scene_comes_out_flat(shot, frames):
    returns = depth(frames)
    wall = point_cloud(returns).xyz[
        (shot.truth.target & (shot.truth.range > 3.15))[returns.y, returns.x]
    ]
    assert len(wall) > 2000
    # range changes by up to 0.5 mm across a pixel at the rim, and the stripes' slope weighs its
    # sides unequally
    assert np.max(np.abs(wall[:, 2] - 3.18)) < 5e-5


def test_a_flat_plate_s_truth_is_analytic(shot):
    rows, columns = np.indices((128, 128)) - 64
    wall = 3.18 * np.sqrt(1 + (rows**2 + columns**2) / 560.0**2)
    behind = shot.truth.target & (shot.truth.range > 3.15)
    # the mean over a pixel differs from its middle by the curvature only: 3.18 / (24 * 560^2),
    # below a micrometre
    np.testing.assert_allclose(shot.truth.range[behind], wall[behind], atol=2e-6)


def test_targets_keep_a_pixel_s_distance_from_every_border(shot):
    truth = shot.truth
    jump = np.zeros((128, 128), bool)
    for axis in (0, 1):
        step = np.abs(np.diff(np.nan_to_num(truth.range), axis=axis)) > 0.05
        for end in (0, step.shape[axis]):
            jump |= np.insert(step, end, False, axis=axis)
    assert jump.any()
    assert not np.any(jump & truth.target)


def test_the_score_tells_right_from_wrong(shot, frames):
    returns = depth(frames)
    shifted = replace(returns, range=returns.range + 1.2 * BIN_M)
    figures = score_returns(shifted, shot.truth)
    assert figures["median_depth_error_m"] == pytest.approx(1.2 * BIN_M, rel=1e-3)
    assert figures["share_within_one_bin"] == 0.0
    half = frames.values.copy()
    half[:, :64] = 0
    figures = score_returns(depth(replace(frames, values=half)), shot.truth)
    assert figures["share_with_return"] == pytest.approx(
        shot.truth.target[64:].sum() / shot.truth.target.sum()
    )
    assert figures["share_within_one_bin"] == figures["share_with_return"]
    stray = frames.values.copy()
    stray[:, :2] = stray[:, 64:66]  # nothing of the scene reaches the uppermost rows
    figures = score_returns(depth(replace(frames, values=stray)), shot.truth)
    assert figures["false_return_share"] > 0.01


def test_a_score_needs_something_to_compare(shot, frames):
    with pytest.raises(InputError, match="no target pixel"):
        score_returns(depth(replace(frames, values=np.zeros_like(frames.values))), shot.truth)
    with pytest.raises(ShapeError, match="the returns' picture"):
        score_returns(depth(frames), replace(shot.truth, range=np.zeros((3, 3), np.float32)))
