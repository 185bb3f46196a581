"""Shots by a forward model of their own (tests/oracles), clean and dirty, from counts to returns."""

from __future__ import annotations

import numpy as np
import pytest
import streak_shots as oracle

from tofclip.camera import Camera, SkewSweep
from tofclip.lidar import Returns, depth
from tofclip.recovery import open_shot, plan_recovery
from tofclip.shots import Streak


def make_camera() -> Camera:
    return Camera(
        oracle.CENTRES,
        np.radians(oracle.DEGREES),
        (oracle.PICTURE, oracle.PICTURE),
        oracle.SLIT,
        gains=oracle.GAINS,
        sweep=SkewSweep(oracle.CENTRES, oracle.LATE_ROWS, 0 * oracle.LATE_ROWS),
        time_zero=-oracle.FIRST_ROW_S,
        pulse_fwhm=oracle.PULSE_S,
        focal_length_px=oracle.FOCAL_PX,
    )


def locate(counts: np.ndarray, method: str) -> Returns:
    streak = Streak(counts, np.arange(oracle.ROWS) * oracle.ROW_S, camera=make_camera())
    return depth(plan_recovery(open_shot(streak), method).run())


def compute_range_z(returns: Returns, scene: oracle.Scene) -> float:
    """Robust z-score of the returns that are of their pixel's surface."""
    error = returns.range - scene.pixel_range[returns.y, returns.x]
    own = np.abs(error) < 0.03
    return float(np.median(np.abs(error[own] / returns.confidence[own])) / 0.6745)


@pytest.fixture(scope="module")
def room() -> oracle.Scene:
    return oracle.make_room()


@pytest.fixture(scope="module")
def light(room) -> np.ndarray:
    return oracle.compute_light(room)


@pytest.mark.parametrize("method", ["tv", "l1"])
def test_ranges_are_off_by_what_they_say(room, light, method) -> None:
    returns = locate(oracle.count_photons(light), method)
    assert 0.8 < compute_range_z(returns, room) < 1.5
