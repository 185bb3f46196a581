"""A shot's camera and time zero are settled once, when it is opened; a plan checks before it runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import CalibrationError, InputError, MissingTimeAxisError
from tofclip.recovery import DepthLockedFocus, FixedFocus, open_shot, plan_recovery
from tofclip.shots import Streak
from tofclip.solvers import LinearInverse

CENTRES = np.array([20.0, 45.0, 70.0])
CAMERA = Camera(
    CENTRES,
    np.array([-0.5, 0.0, 0.5]),
    (16, 16),
    90,
    sweep=SkewSweep(CENTRES, np.zeros(3), np.zeros(3)),
    time_zero=1e-9,
)
OTHER = CAMERA.replace(gains=np.array([1.0, 2.0, 1.0]))
COUNTS = np.random.default_rng(0).poisson(40.0, (12, 90)).astype(np.float32)


@pytest.fixture
def streak() -> Streak:
    counts = COUNTS.copy()
    counts[5] += 100
    return Streak(counts, camera=CAMERA).with_bin_width(20e-12)


def test_the_camera_given_comes_before_the_one_that_the_shot_carries(streak, tmp_path):
    assert open_shot(streak).camera is CAMERA
    assert open_shot(streak, OTHER).camera is OTHER
    OTHER.save(tmp_path / "camera.h5")
    np.testing.assert_array_equal(
        open_shot(streak, tmp_path / "camera.h5").camera.gains, OTHER.gains
    )


def test_a_file_is_opened_like_a_streak_image(streak, tmp_path):
    streak.save(tmp_path / "shot.h5")
    shot = open_shot(tmp_path / "shot.h5", bin_width=30e-12)
    np.testing.assert_array_equal(shot.streak.counts, streak.counts)
    np.testing.assert_allclose(np.diff(shot.times), 30e-12)


def test_the_time_zero_given_comes_before_the_cameras(streak):
    assert open_shot(streak).times[0] == pytest.approx(-1e-9)
    shot = open_shot(streak, time_zero=-2e-9)
    assert shot.camera.time_zero == -2e-9
    assert shot.times[0] == pytest.approx(2e-9)
    frames = plan_recovery(shot, LinearInverse()).run()
    np.testing.assert_allclose(frames.times, shot.times)
    assert frames.camera.time_zero == -2e-9


def test_a_time_zero_of_nought_is_not_the_cameras(streak):
    assert open_shot(streak, time_zero=0.0).camera.time_zero == 0


def test_what_a_shot_lacks_is_said_when_it_is_opened(streak):
    with pytest.raises(MissingTimeAxisError, match="no time axis"):
        open_shot(replace(streak, row_times=None))
    with pytest.raises(InputError, match="carries no camera"):
        open_shot(replace(streak, camera=None))


def test_a_known_sweep_stays_as_it_is(streak):
    shot = open_shot(streak)
    assert shot.fit_camera() is shot


def test_a_plan_refuses_before_it_runs(streak):
    shot = open_shot(streak)
    with pytest.raises(InputError, match="unknown method"):
        plan_recovery(shot, "magic")
    with pytest.raises(InputError, match="focus"):
        plan_recovery(shot, "tv", "sharp")
    with pytest.raises(CalibrationError, match="lenslet pitch"):
        plan_recovery(shot, "tv", DepthLockedFocus())
    with pytest.raises(InputError, match="device"):
        plan_recovery(shot, device="abacus")


def test_a_plan_knows_its_work_and_its_memory(streak):
    plan = plan_recovery(open_shot(streak), "linear", FixedFocus(0.5))
    done: list[int] = []
    frames = plan.run(done.append)
    assert sum(done) == plan.work == 12
    assert plan.memory_bytes == frames.values.nbytes + 90 * 12 * (4 + 1)
    np.testing.assert_array_equal(frames.shears, np.full(12, 0.5))
    again = plan.run()
    np.testing.assert_array_equal(again.values, frames.values)
