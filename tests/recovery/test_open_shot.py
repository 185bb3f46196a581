"""A shot's camera and time zero are settled once, when it is opened."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from three_view_shot import CAMERA, make_streak

from tofclip.errors import InputError, MissingTimeAxisError
from tofclip.recovery import open_shot, plan_recovery
from tofclip.shots import Streak
from tofclip.solvers import LinearInverse

OTHER = CAMERA.replace(gains=np.array([1.0, 2.0, 1.0]))


@pytest.fixture
def streak() -> Streak:
    return make_streak()


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
