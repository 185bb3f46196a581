"""Shots by a forward model of their own (tests/oracles), clean and dirty, from counts to returns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import streak_shots as oracle

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import InputError
from tofclip.lidar import Returns, depth
from tofclip.recovery import make_method, open_shot, plan_recovery
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


def locate(counts: np.ndarray, method: str, iterations: int | None = None) -> Returns:
    streak = Streak(counts, np.arange(oracle.ROWS) * oracle.ROW_S, camera=make_camera())
    return depth(plan_recovery(open_shot(streak), make_method(method, iterations=iterations)).run())


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


RETRO_WALL = 0.12
EXPECTED = {
    # Fractions missed and false at most. 20 photons at the brightest: each wall pixel has 6 of 14.
    "clean": (0.08, 0.02),
    "retroreflector": (0.10, 0.08),
    "dark": (0.35, 0.10),
    "afterglow": (0.08, 0.03),
    "one hot pixel": (0.12, 0.03),
    "hot pixels": (0.12, 0.03),
    "tracks": (0.12, 0.03),
    "dead stripe": (0.12, 0.03),
    "clipped": (0.12, 0.03),
}
SLOW = pytest.mark.nightly


def take_shot(kind: str, room: oracle.Scene, light: np.ndarray) -> tuple[oracle.Scene, np.ndarray]:
    """Scene and counts. The image is a fifth of a whole one, so defects are five times as dense."""
    if kind == "retroreflector":
        scene = oracle.add_retroreflector(oracle.make_room(RETRO_WALL))
        bright = oracle.compute_light(scene)
        # The exposure of the others, at which the retroreflector has 20,000 photons.
        return scene, oracle.count_photons(bright, 1400 * bright.max() / light.max())
    if kind == "afterglow":
        return room, oracle.count_photons(oracle.add_afterglow(light))
    return room, spoil(kind, oracle.count_photons(light, 20.0 if kind == "dark" else 2000.0))


def spoil(kind: str, counts: np.ndarray) -> np.ndarray:
    """What goes wrong in the camera."""
    if kind == "one hot pixel":
        return oracle.add_hot_pixels(counts, 1)
    if kind == "hot pixels":
        return oracle.add_hot_pixels(counts, 60)
    if kind == "tracks":
        return oracle.add_tracks(counts, 40)
    if kind == "clipped":
        return np.minimum(counts, np.float32(0.15) * counts.max())
    spoilt = counts.copy()
    if kind == "dead stripe":
        spoilt[:, 200:212] = 0
    return spoilt


def check_returns(kind: str, method: str, scene: oracle.Scene, counts: np.ndarray) -> None:
    returns = locate(counts, method)
    missed, false = oracle.score(returns.y, returns.x, returns.range, scene)
    assert missed <= EXPECTED[kind][0]
    assert false <= EXPECTED[kind][1]
    assert 0.8 < compute_range_z(returns, scene) < (1.5 if kind in ("clean", "dark") else 2)
    assert np.all(returns.false_alarm <= 0.5)


FAST = {("clean", "l1"), ("dark", "l1"), ("tracks", "l1"), ("retroreflector", "l1")}
FAST |= {("dark", "tv"), ("clipped", "tv")}


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        pytest.param(kind, method, marks=[] if (kind, method) in FAST else SLOW)
        for kind in EXPECTED
        for method in ("tv", "l1")
    ],
)
def test_returns_are_found_and_few_are_false(room, light, kind, method) -> None:
    check_returns(kind, method, *take_shot(kind, room, light))


def test_another_scene_in_the_dark() -> None:
    """l1 ends before it follows the noise; with 40 iterations 0.40 were missed."""
    steps = oracle.make_steps()
    counts = oracle.count_photons(oracle.compute_light(steps), 20.0, seed=1)
    check_returns("dark", "l1", steps, counts)


@SLOW
@pytest.mark.parametrize("method", ["tv", "l1"])
@pytest.mark.parametrize("kind", ["hot pixels", "tracks", "dead stripe", "clipped"])
def test_another_scene_with_defects(kind, method) -> None:
    steps = oracle.make_steps()
    counts = spoil(kind, oracle.count_photons(oracle.compute_light(steps), seed=2))
    check_returns(kind, method, steps, counts)


@SLOW
@pytest.mark.parametrize("method", ["tv", "l1"])
@pytest.mark.parametrize(
    ("brightness", "corner"), [(20.0, (10, -30)), (100.0, (-20, -20)), (300.0, (5, 0))]
)
def test_glints_of_any_brightness_elsewhere(method, brightness, corner) -> None:
    plain = oracle.compute_light(oracle.make_steps())
    scene = oracle.add_retroreflector(oracle.make_steps(RETRO_WALL), brightness, corner)
    bright = oracle.compute_light(scene)
    counts = oracle.count_photons(bright, 1400 * bright.max() / plain.max(), seed=3)
    check_returns("retroreflector", method, scene, counts)


def test_a_bright_shot_is_iterated_until_the_rim_of_thin_bars_is_gone() -> None:
    """Its false returns lie above and below the bars, which the views see nearly along the columns.

    Over four seeds 2.0 to 2.1 % of all are false after 40 iterations, and 1.4 to 1.6 % when bright
    frames go on until their objective has settled.
    """
    steps = oracle.make_steps()
    counts = oracle.count_photons(oracle.compute_light(steps), seed=6)
    scores = []
    for iterations in (40, None):
        returns = locate(counts, "l1", iterations)
        scores.append(oracle.score(returns.y, returns.x, returns.range, steps))
    (_, usual), (missed, false) = scores
    assert false < 0.9 * usual
    assert false <= 0.018
    assert missed <= 0.02


def test_the_probability_of_a_false_alarm_is_kept(room, light) -> None:
    """In the dark, where noise is all there is; a third of the points said to be wrong with probability 1/3 are."""
    streak = Streak(
        oracle.count_photons(light, 20.0),
        np.arange(oracle.ROWS) * oracle.ROW_S,
        camera=make_camera(),
    )
    frames = plan_recovery(open_shot(streak), "l1").run()
    strict, lenient = depth(frames, false_alarm=0.1), depth(frames)
    assert len(strict) < len(lenient)
    assert strict.false_alarm.max() <= 0.1
    near = np.abs(lenient.range[:, None] - room.nearby_ranges[lenient.y, lenient.x]) < 0.009
    false = 1 - near.any(axis=1).mean()
    assert false <= lenient.false_alarm.mean()
    with pytest.raises(InputError, match="between 0 and 1"):
        depth(frames, false_alarm=0.0)
    with pytest.raises(InputError, match="recover them again"):
        depth(replace(frames, figures={}), false_alarm=0.1)
