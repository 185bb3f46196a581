"""A shot's camera and time zero are settled once, when it is opened."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from three_view_shot import CAMERA, make_streak

from tofclip.camera import Camera
from tofclip.errors import CalibrationError, InputError, MissingTimeAxisError
from tofclip.recovery import DepthLockedFocus, FixedFocus, open_shot, plan_recovery
from tofclip.recovery import shot as opening
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


def test_the_error_of_slit_centres_is_told_though_a_part_of_it_shows_in_no_shot(monkeypatch):
    """A displaced picture looks like displaced centres: of the errors of seven views a shot shows
    what is no displacement, and from that the error of each is known without bias.
    """
    centres = 40.0 + 60 * np.arange(7)
    angles = np.arctan([0.7, -0.4, 0.1, 0.9, -0.8, -0.1, 0.4])
    nominal = Camera(centres, angles, (16, 16), 440, time_zero=1e-9)
    looks = np.stack([np.ones(7), -np.tan(angles)], axis=1)
    random, squares = np.random.default_rng(0), []
    counts = np.ones((12, 440), np.float32)
    shot = open_shot(Streak(counts, np.arange(12) * 20e-12), nominal)
    for _ in range(2000):
        error = random.normal(0, 0.5, 7)
        shown = error - looks @ np.linalg.lstsq(looks, error)[0]
        found = nominal.replace(centres_px=centres + shown)
        monkeypatch.setattr(opening, "fit_camera_to_shot", lambda *_, found=found: found)
        squares.append(shot.fit_camera().centre_error_px ** 2)
    # 10,000 degrees of freedom know a variance to 1.4 %
    assert np.mean(squares) == pytest.approx(0.5**2, rel=0.05)


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
