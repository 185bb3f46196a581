"""The main path on a simulated shot whose truth is known."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tofclip import Frames, Streak, depth, recover
from tofclip.camera import Camera, ProjectiveSweep, measure
from tofclip.camera.registration import estimate_skew, register_views
from tofclip.errors import CalibrationError, InputError, MissingTimeAxisError
from tofclip.recovery import compute_view_delays_bins, make_method, open_shot, plan_recovery
from tofclip.simulate import (
    SimulatedShot,
    make_default_instrument,
    make_default_scene,
    score_returns,
    simulate_shot,
)
from tofclip.solvers import LinearInverse, Sparse, TotalVariation


@pytest.fixture(scope="module")
def shot() -> SimulatedShot:
    return simulate_shot(make_default_scene(), make_default_instrument(), seed=0)


@pytest.fixture(scope="module")
def uncalibrated(shot) -> Camera:
    """The camera as focus pictures would give it: no sweep, no gains, no parallax."""
    return shot.camera.replace(sweep=None, gains=np.ones(7), lenslet_pitch=0.0)


@pytest.fixture(scope="module")
def frames(shot, uncalibrated) -> Frames:
    return recover(shot.streak, uncalibrated)


def test_skew_and_gains_are_found_from_the_shot(shot, frames):
    true, found = shot.camera, frames.camera
    # A quarter of a row and two percent: small beside the pulse (3 rows) and the photon noise.
    np.testing.assert_allclose(
        compute_view_delays_bins(found), compute_view_delays_bins(true), atol=0.25
    )
    np.testing.assert_allclose(
        found.gains / found.gains.mean(), true.gains / true.gains.mean(), rtol=0.02
    )
    # Objects nearer or farther than the focus are displaced by up to a pixel in the outer views.
    np.testing.assert_allclose(found.centres_px, true.centres_px, atol=0.5)


def test_energy_curves_give_the_skew_to_a_row(shot, uncalibrated):
    estimate = estimate_skew(shot.streak.counts, uncalibrated)
    np.testing.assert_allclose(estimate.sweep.offsets_bin, shot.camera.sweep.offsets_bin, atol=1.0)
    assert estimate.correlations.min() > 0.9


def test_registration_lowers_the_residual(shot, uncalibrated):
    coarse = uncalibrated.replace(sweep=estimate_skew(shot.streak.counts, uncalibrated).sweep)
    found = register_views(shot.streak.counts, shot.streak.saturated, coarse)
    assert found.residuals.min() < 0.7 * found.residuals[0]


@pytest.mark.parametrize(
    "error_px", [*(pytest.param(error, marks=pytest.mark.nightly) for error in (0.4, 1.0)), 3.0]
)
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


def test_without_times_measured_centres_stay(shot):
    coarse = shot.camera.replace(sweep=estimate_skew(shot.streak.counts, shot.camera).sweep)
    found = register_views(shot.streak.counts, shot.streak.saturated, coarse)
    np.testing.assert_array_equal(found.camera.centres_px, shot.camera.centres_px)


def test_ranges_are_true(shot, frames):
    figures = score_returns(depth(frames), shot.truth)
    assert figures["median_depth_error_m"] < figures["bin_m"] / 2
    assert figures["share_within_one_bin"] > 0.95
    # Robust errors are what each return says of its own: 1.0 over seeds.
    assert 0.8 < figures["range_z"] < 1.5


def test_fitting_the_camera_costs_no_accuracy(shot, frames):
    """The fitted camera explains the measurements as well as the true one, to within photon noise."""
    with_truth = recover(shot.streak, shot.camera)
    assert frames.figures["relative_residual"] < 1.05 * with_truth.figures["relative_residual"]


def test_frames_say_what_they_are(shot, frames):
    rows = shot.streak.counts.shape[0]
    assert frames.values.shape == (rows, 128, 128)
    assert frames.values.dtype == np.float32
    np.testing.assert_allclose(frames.times, shot.streak.times - shot.camera.time_zero)
    assert frames.figures["method"] == "tv"
    assert frames.figures["stopped_because"] == "iteration limit"
    objective = frames.provenance["objective"]
    assert len(objective) == frames.figures["iterations"] + 1
    assert all(after <= before for before, after in itertools.pairwise(objective))


def test_progress_adds_up(shot, uncalibrated):
    few_rows = replace(
        shot.streak,
        counts=shot.streak.counts[:330],
        row_times=shot.streak.times[:330],
        saturated=None,
    )
    for camera in (shot.camera, uncalibrated):
        done: list[int] = []
        plan = plan_recovery(open_shot(few_rows, camera), LinearInverse())
        plan.run(done.append)
        assert 0 < sum(done) <= plan.work


def test_a_method_can_be_named():
    assert make_method("l1", iterations=7) == Sparse(iterations=7)
    assert make_method("tv") == TotalVariation()
    with pytest.raises(InputError, match="choose one of tv, l1, linear, adjoint"):
        make_method("magic")
    with pytest.raises(InputError, match="does not take iterations"):
        make_method("linear", iterations=7)


def test_a_camera_without_a_sweep_is_not_late():
    camera = Camera([20.0, 40.0], [0.0, 0.1], (9, 9), 61)
    assert compute_view_delays_bins(camera) == [0, 0]


def test_what_is_missing_is_asked_for(shot):
    with pytest.raises(InputError, match="carries no camera"):
        recover(replace(shot.streak, camera=None))
    with pytest.raises(MissingTimeAxisError, match="bin_width"):
        recover(replace(shot.streak, row_times=None))
    narrow = Streak(shot.streak.counts[:, :-1], shot.streak.times)
    for camera in (shot.camera, shot.camera.replace(sweep=None)):
        with pytest.raises(CalibrationError, match="1343 columns"):
            recover(narrow, camera)


def test_views_that_do_not_belong_together_are_refused(uncalibrated):
    noise = np.random.default_rng(0).poisson(100, (300, 1344)).astype(np.float32)
    with pytest.raises(CalibrationError, match="does not follow the reference view"):
        estimate_skew(noise, uncalibrated)


def test_only_a_skew_can_be_refined(shot):
    with pytest.raises(CalibrationError, match="only a skew"):
        register_views(
            shot.streak.counts, None, shot.camera.replace(sweep=ProjectiveSweep(np.eye(3)))
        )


def test_the_measurement_of_the_true_frames_is_what_was_simulated(shot):
    """Rendering goes ray by ray and never through the projection; both must agree on where the
    light goes.
    """
    measured = measure(shot.signal, None, shot.camera, dark=0.0)
    by_view = measured.values.sum(axis=1)
    edges = ((shot.camera.centres_px[1:] + shot.camera.centres_px[:-1]) / 2).astype(int)
    energy = np.array([part.sum() for part in np.split(by_view, edges)])
    np.testing.assert_allclose(
        energy / energy.mean(), shot.camera.gains / shot.camera.gains.mean(), rtol=0.1
    )
