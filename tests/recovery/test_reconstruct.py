"""The main path on the demonstration's scene, whose truth is known: the scene, depth from frames that
recovery had no part in, the camera found from the shot, and how a shot is opened and a plan made.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from three_view_shot import CAMERA, make_streak

from tofclip import Streak, depth, point_cloud, recover
from tofclip.camera import Camera, ProjectiveSweep, measure
from tofclip.camera.registration import estimate_skew, register_views
from tofclip.errors import CalibrationError, InputError, MissingTimeAxisError, ShapeError
from tofclip.recovery import (
    DepthLockedFocus,
    FixedFocus,
    compute_view_delays_bins,
    make_method,
    open_shot,
    plan_recovery,
)
from tofclip.simulate import (
    make_default_instrument,
    make_default_scene,
    render_true_frames,
    score_returns,
    simulate_shot,
)
from tofclip.solvers import LinearInverse, Sparse, TotalVariation
from tofclip.units import SPEED_OF_LIGHT

BIN_M = SPEED_OF_LIGHT * 20e-12 / 2


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(make_default_scene(), make_default_instrument(), seed=0)


@pytest.fixture(scope="module")
def true_frames(shot):
    return render_true_frames(make_default_scene(), make_default_instrument(), shot.exposure)


@pytest.fixture(scope="module")
def uncalibrated(shot):
    """The camera as focus pictures would give it: no sweep, no gains, no parallax."""
    return shot.camera.replace(sweep=None, gains=np.ones(7), lenslet_pitch=0.0)


@pytest.fixture(scope="module")
def frames(shot, uncalibrated):
    return recover(shot.streak, uncalibrated, "l1")


def test_the_scene_is_where_the_instrument_looks(shot):
    truth, full_scale = shot.truth, make_default_instrument().detector.full_scale_photons
    assert 1.7 < np.nanmin(truth.range) < 1.8
    assert 3.1 < np.nanmax(truth.range) < 3.25
    assert truth.target.sum() > 5000
    assert truth.reflectance.max() <= 1
    assert np.all(np.isfinite(truth.range[truth.target]))
    assert not shot.signal[[0, -1]].any()  # the sweep sees all of it
    assert shot.streak.counts.max() == pytest.approx(full_scale)


def test_a_flat_plate_s_truth_is_analytic_and_targets_keep_a_pixel_from_every_border(shot):
    truth = shot.truth
    rows, columns = np.indices((128, 128)) - 64
    wall = 3.18 * np.sqrt(1 + (rows**2 + columns**2) / 560.0**2)
    behind = truth.target & (truth.range > 3.15)
    # the mean over a pixel differs from its middle by the curvature only: 3.18 / (24 * 560^2),
    # below a micrometre
    np.testing.assert_allclose(truth.range[behind], wall[behind], atol=2e-6)
    jump = np.zeros((128, 128), bool)
    for axis in (0, 1):
        step = np.abs(np.diff(np.nan_to_num(truth.range), axis=axis)) > 0.05
        for end in (0, step.shape[axis]):
            jump |= np.insert(step, end, False, axis=axis)
    assert jump.any()
    assert not np.any(jump & truth.target)


def test_true_frames_give_the_true_depth_and_reflectance(shot, true_frames):
    returns, target = depth(true_frames), shot.truth.target
    figures = score_returns(returns, shot.truth)
    assert figures["bin_m"] == pytest.approx(BIN_M)
    assert figures["median_depth_error_m"] < 0.01 * BIN_M  # measured: 0.0003 bin
    assert figures["share_within_one_bin"] == figures["share_with_return"] == 1.0
    assert figures["false_return_share"] == 0.0
    # the tails beyond 1 % of the pulse's peak, 0.2 %, and the rows' own width, which spreads the
    # pulse by 2.5 %
    reflectance = shot.exposure * shot.truth.reflectance[target]
    np.testing.assert_allclose(returns.image("intensity")[target], reflectance, rtol=0.03)
    wall = point_cloud(returns).xyz[(target & (shot.truth.range > 3.15))[returns.y, returns.x]]
    assert len(wall) > 2000
    # range changes by up to 0.5 mm across a pixel at the rim, and the stripes' slope weighs its
    # sides unequally
    assert np.max(np.abs(wall[:, 2] - 3.18)) < 5e-5


def test_photon_noise_leaves_the_depth_far_below_half_a_bin(shot, true_frames):
    noisy = np.random.default_rng(0).poisson(true_frames.values + 0.05).astype(np.float32)
    figures = score_returns(depth(replace(true_frames, values=noisy)), shot.truth)
    # some 60 photons a pixel: 26 ps / sqrt(60) * c / 2 is 0.5 mm as a standard deviation; half a
    # bin is 1.5 mm
    assert figures["median_depth_error_m"] < 0.5 * BIN_M / 2
    assert figures["share_within_one_bin"] > 0.95


def test_the_score_tells_right_from_wrong(shot, true_frames):
    returns, truth = depth(true_frames), shot.truth

    def score(values):
        return score_returns(depth(replace(true_frames, values=values)), truth)

    shifted = score_returns(replace(returns, range=returns.range + 1.2 * BIN_M), truth)
    assert shifted["median_depth_error_m"] == pytest.approx(1.2 * BIN_M, rel=1e-3)
    assert shifted["share_within_one_bin"] == 0.0
    values = true_frames.values.copy()
    values[:, :64] = 0
    half, seen = score(values), truth.target[64:].sum() / truth.target.sum()
    assert half["share_with_return"] == half["share_within_one_bin"] == pytest.approx(seen)
    stray = true_frames.values.copy()
    stray[:, :2] = stray[:, 64:66]  # nothing of the scene reaches the uppermost rows
    assert score(stray)["false_return_share"] > 0.01
    with pytest.raises(InputError, match="no target pixel"):
        score(np.zeros_like(values))
    with pytest.raises(ShapeError, match="the returns' picture"):
        score_returns(returns, replace(truth, range=np.zeros((3, 3), np.float32)))


def test_skew_and_gains_are_found_from_the_shot(shot, frames):
    true, found = shot.camera, frames.camera
    # A quarter of a row and two percent: small beside the pulse (3 rows) and the photon noise.
    delays = (compute_view_delays_bins(camera) for camera in (found, true))
    np.testing.assert_allclose(*delays, atol=0.25)
    gains = (camera.gains / camera.gains.mean() for camera in (found, true))
    np.testing.assert_allclose(*gains, rtol=0.02)
    # Objects nearer or farther than the focus are displaced by up to a pixel in the outer views.
    np.testing.assert_allclose(found.centres_px, true.centres_px, atol=0.5)


@pytest.mark.nightly
def test_energy_curves_give_the_skew_to_a_row_and_registration_lowers_the_residual(
    shot, uncalibrated
):
    estimate = estimate_skew(shot.streak.counts, uncalibrated)
    np.testing.assert_allclose(estimate.sweep.offsets_bin, shot.camera.sweep.offsets_bin, atol=1.0)
    assert estimate.correlations.min() > 0.9
    coarse = uncalibrated.replace(sweep=estimate.sweep)
    found = register_views(shot.streak.counts, shot.streak.saturated, coarse)
    assert found.residuals.min() < 0.7 * found.residuals[0]
    # without times measured centres stay
    coarse = shot.camera.replace(sweep=estimate.sweep)
    found = register_views(shot.streak.counts, shot.streak.saturated, coarse)
    np.testing.assert_array_equal(found.camera.centres_px, shot.camera.centres_px)


@pytest.mark.nightly
@pytest.mark.parametrize("error_px", [0.4, 1.0, 3.0])
def test_slit_centres_are_found_from_the_shot(shot, error_px):
    """Of a camera that knows its parallax, from centres that are off by as much at the worst view.

    What shifts the pictures only, a common shift and one in proportion to tan(angle), no shot can
    tell.
    """
    true = shot.camera
    shifts = np.stack([np.ones(7), np.tan(true.angles)], axis=1)

    def leave_shifts_out(moves):
        return moves - shifts @ np.linalg.lstsq(shifts, moves, rcond=None)[0]

    errors = leave_shifts_out(np.random.default_rng(5).normal(size=7))
    errors *= error_px / np.abs(errors).max()
    nominal = true.replace(sweep=None, gains=np.ones(7), centres_px=true.centres_px + errors)
    found = open_shot(shot.streak, nominal).fit_camera().camera
    left = leave_shifts_out(found.centres_px - true.centres_px)
    assert np.sqrt(np.mean(left**2)) < 0.1
    # The pictures stay where the camera's own centres put them.
    np.testing.assert_allclose(shifts.T @ (found.centres_px - nominal.centres_px), 0, atol=1e-9)


def test_ranges_are_true_and_fitting_the_camera_costs_no_accuracy(shot, frames):
    figures = score_returns(depth(frames), shot.truth)
    assert figures["median_depth_error_m"] < figures["bin_m"] / 2
    assert figures["share_within_one_bin"] > 0.95
    # Errors are what each return says of its own, on its surface: 0.6 to 1.6 is what is promised.
    assert 0.6 < figures["range_z"] < 1.6
    # The fitted camera explains the measurements as well as the true one, to within photon noise.
    with_truth = recover(shot.streak, shot.camera, "l1")
    assert frames.figures["relative_residual"] < 1.05 * with_truth.figures["relative_residual"]


def test_frames_say_what_they_are(shot, frames):
    assert frames.values.shape == (shot.streak.counts.shape[0], 128, 128)
    assert frames.values.dtype == np.float32
    np.testing.assert_allclose(frames.times, shot.streak.times - shot.camera.time_zero)
    assert frames.figures["method"] == "l1"
    assert frames.figures["stopped_because"] == "iterations done"
    objective = frames.provenance["objective"]
    assert len(objective) == frames.figures["iterations"] + 1
    assert all(after <= before for before, after in itertools.pairwise(objective))


def test_progress_adds_up(shot, uncalibrated):
    counts, times = shot.streak.counts[:330], shot.streak.times[:330]
    few_rows = replace(shot.streak, counts=counts, row_times=times, saturated=None)
    for camera in (shot.camera, uncalibrated):
        done = []
        plan = plan_recovery(open_shot(few_rows, camera), LinearInverse())
        plan.run(done.append)
        assert 0 < sum(done) <= plan.work


def test_what_no_camera_can_be_fitted_to_is_refused(shot, uncalibrated):
    noise = np.random.default_rng(0).poisson(100, (300, 1344)).astype(np.float32)
    with pytest.raises(CalibrationError, match="does not follow the reference view"):
        estimate_skew(noise, uncalibrated)
    turned = shot.camera.replace(sweep=ProjectiveSweep(np.eye(3)))
    with pytest.raises(CalibrationError, match="only a skew"):
        register_views(shot.streak.counts, None, turned)
    narrow = Streak(shot.streak.counts[:, :-1], shot.streak.times)
    for camera in (shot.camera, shot.camera.replace(sweep=None)):
        with pytest.raises(CalibrationError, match="1343 columns"):
            recover(narrow, camera)


def test_the_measurement_of_the_true_frames_is_what_was_simulated(shot):
    """Rendering goes ray by ray and never through the projection; both must agree on where the
    light goes.
    """
    by_view = measure(shot.signal, None, shot.camera, dark=0.0).values.sum(axis=1)
    edges = ((shot.camera.centres_px[1:] + shot.camera.centres_px[:-1]) / 2).astype(int)
    energy = np.array([part.sum() for part in np.split(by_view, edges)])
    gains = shot.camera.gains / shot.camera.gains.mean()
    np.testing.assert_allclose(energy / energy.mean(), gains, rtol=0.1)


OTHER = CAMERA.replace(gains=np.array([1.0, 2.0, 1.0]))


@pytest.fixture
def streak():
    return make_streak()


def test_the_camera_given_comes_before_the_one_that_the_shot_carries(streak, tmp_path):
    assert open_shot(streak).camera is CAMERA
    assert open_shot(streak, OTHER).camera is OTHER
    OTHER.save(tmp_path / "camera.h5")
    read = open_shot(streak, tmp_path / "camera.h5").camera
    np.testing.assert_array_equal(read.gains, OTHER.gains)
    known = open_shot(streak)
    assert known.fit_camera() is known  # a known sweep stays as it is
    assert compute_view_delays_bins(Camera([20.0, 40.0], [0.0, 0.1], (9, 9), 61)) == [0, 0]


def test_a_file_is_opened_like_a_streak_image(streak, tmp_path):
    streak.save(tmp_path / "shot.h5")
    shot = open_shot(tmp_path / "shot.h5", bin_width=30e-12)
    np.testing.assert_array_equal(shot.streak.counts, streak.counts)
    np.testing.assert_allclose(np.diff(shot.times), 30e-12)


def test_the_time_zero_given_comes_before_the_cameras(streak):
    assert open_shot(streak).times[0] == pytest.approx(-1e-9)
    assert open_shot(streak, time_zero=0.0).camera.time_zero == 0
    shot = open_shot(streak, time_zero=-2e-9)
    assert shot.times[0] == pytest.approx(2e-9)
    with pytest.raises(InputError, match=r"ranges of 149.9 to .* m; check the unit"):
        open_shot(streak, time_zero=-1e-6)
    frames = plan_recovery(shot, LinearInverse()).run()
    np.testing.assert_allclose(frames.times, shot.times)
    assert frames.camera.time_zero == shot.camera.time_zero == -2e-9


def test_what_is_missing_or_unknown_is_said_before_anything_runs(streak):
    for part, fault, message in (
        ("row_times", MissingTimeAxisError, "no time axis.*bin_width"),
        ("camera", InputError, "carries no camera"),
    ):
        with pytest.raises(fault, match=message):
            open_shot(replace(streak, **{part: None}))
    shot = open_shot(streak)
    with pytest.raises(InputError, match="unknown method"):
        plan_recovery(shot, "magic")
    with pytest.raises(InputError, match="focus"):
        plan_recovery(shot, "tv", "sharp")
    with pytest.raises(CalibrationError, match="lenslet pitch"):
        plan_recovery(shot, "tv", DepthLockedFocus())
    with pytest.raises(InputError, match="device"):
        plan_recovery(shot, device="abacus")


def test_a_method_can_be_named():
    assert make_method("l1", iterations=7) == Sparse(iterations=7)
    assert make_method("tv") == TotalVariation()
    with pytest.raises(InputError, match="choose one of auto, tv, l1, linear, adjoint"):
        make_method("magic")
    with pytest.raises(InputError, match="does not take iterations"):
        make_method("linear", iterations=7)


def test_a_plan_knows_its_work_and_its_memory(streak):
    plan = plan_recovery(open_shot(streak), "linear", FixedFocus(0.5))
    done = []
    frames = plan.run(done.append)
    assert sum(done) == plan.work == 12
    surfaces = replace(plan, method=make_method("surfaces"))
    assert surfaces.memory_bytes - plan.memory_bytes > frames.values.nbytes
    np.testing.assert_array_equal(frames.shears, np.full(12, 0.5))
    np.testing.assert_array_equal(plan.run().values, frames.values)
