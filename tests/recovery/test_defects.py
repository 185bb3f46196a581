"""Hot pixels, traces of particles and dead columns of a shot: found, masked and without effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from three_view_shot import CAMERA

from tofclip.camera.noise import MeasurementNoise
from tofclip.lidar import depth
from tofclip.recovery import open_shot, recover
from tofclip.recovery.defects import estimate_noise, find_clipping_level, find_defects
from tofclip.shots import Streak
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.demo import make_default_camera
from tofclip.simulate.patterns import make_plain_pattern
from tofclip.solvers import PlugAndPlay, TotalVariation

PULSE_ROWS = 3.0


@pytest.fixture(scope="module")
def clean() -> Streak:
    scene = Scene(
        (
            make_plate((-0.15, 0.0, 0.8), (0.2, 0.2), make_plain_pattern(0.8)),
            make_plate((0.15, 0.0, 1.1), (0.25, 0.25), make_plain_pattern(0.5)),
        )
    )
    detector = StreakDetector(300, 20e-12)
    camera = make_default_camera()
    near = camera.replace(time_zero=-2.5e-9, pulse_fwhm=60e-12)
    return simulate_shot(scene, Instrument(near, detector), 0).streak


@pytest.fixture(scope="module")
def ranges(clean) -> np.ndarray:
    return locate(clean)


def locate(streak: Streak) -> np.ndarray:
    return depth(recover(streak, streak.camera, method="linear")).image("range")


def count_errors(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Fractions of returns that are missed and that are false."""
    known, seen = np.isfinite(expected), np.isfinite(found)
    right = known & seen & (np.abs(found - expected) < 0.01)
    return 1 - right.sum() / known.sum(), 1 - right.sum() / max(seen.sum(), 1)


def change(streak: Streak, places: tuple[np.ndarray, np.ndarray], value: float) -> Streak:
    counts = streak.counts.astype(np.float32).copy()
    counts[places] = value
    return replace(streak, counts=counts)


def test_the_noise_of_the_dark_and_of_light_is_estimated() -> None:
    """Of so many measurements the deviation is known to less than a percent; a gain of 3 counts for
    each photon to a few, and never to less than it is: the careful side.
    """
    random = np.random.default_rng(0)
    dark_noise = random.normal(100, 7, (200, 300)).astype(np.float32)
    dark, noise, gain = estimate_noise(dark_noise)
    assert dark == pytest.approx(100, abs=0.2)
    assert noise == pytest.approx(7, rel=0.02)
    assert gain == 1
    photons = 400 * np.exp(-((np.arange(200) - 100) ** 2) / (2 * 12.0**2))
    lit = dark_noise + 3 * random.poisson(photons[:, np.newaxis], (200, 300))
    assert estimate_noise(lit.astype(np.float32))[2] == pytest.approx(3, rel=0.15)


def test_a_clean_shot_stays_as_it_is(clean, ranges) -> None:
    assert np.isfinite(ranges).sum() > 1000
    assert open_shot(clean).streak is clean


@pytest.mark.parametrize("number", [1, 60])
def test_hot_pixels_have_no_effect(clean, ranges, number) -> None:
    noise = np.random.default_rng(number)
    rows, columns = clean.counts.shape
    places = noise.integers(2, rows - 2, number), noise.integers(0, columns, number)
    hot = change(clean, places, 30 * float(clean.counts.max()))
    opened = open_shot(hot).streak
    assert opened.saturated is not None
    assert opened.saturated[places].all()
    assert opened.metadata["defective_readings"] == str(int(opened.saturated.sum()))
    missed, false = count_errors(locate(hot), ranges)
    assert missed <= 0.02
    assert false <= 0.02


def test_traces_of_particles_have_little_effect(clean, ranges) -> None:
    noise = np.random.default_rng(0)
    counts, peak = clean.counts.astype(np.float32).copy(), float(clean.counts.max())
    for _ in range(40):
        row, column = (noise.integers(20, size - 20) for size in counts.shape)
        angle, length = noise.uniform(0, np.pi), noise.integers(4, 15)
        for step in np.arange(0, length, 0.5):
            place = int(row + step * np.sin(angle)), int(column + step * np.cos(angle))
            counts[place] += peak * noise.uniform(0.5, 3)
    missed, false = count_errors(locate(replace(clean, counts=counts)), ranges)
    assert missed <= 0.12
    assert false <= 0.03


def test_a_dead_stripe_is_masked(clean, ranges) -> None:
    dead = change(clean, (slice(None), slice(200, 212)), 0.0)
    assert find_defects(dead, PULSE_ROWS).columns[200:212].all()
    missed, false = count_errors(locate(dead), ranges)
    assert missed <= 0.08
    assert false <= 0.03


def test_a_point_that_lasts_as_long_as_the_pulse_is_light(clean) -> None:
    rows = np.arange(clean.counts.shape[0])
    pulse = np.exp2(-((2 * (rows - 150.3) / PULSE_ROWS) ** 2))
    counts = clean.counts.astype(np.float32).copy()
    counts[:, 300] += 40 * float(clean.counts.max()) * pulse
    assert find_defects(replace(clean, counts=counts), PULSE_ROWS).count == 0


def test_single_photons_are_light() -> None:
    counts = np.random.default_rng(0).poisson(0.02, (200, 300)).astype(np.float32)
    counts += np.random.default_rng(1).poisson(5, (200, 300)) * (np.arange(200) == 90)[:, None]
    shot = Streak(counts, np.arange(200) * 20e-12)
    assert find_defects(shot, PULSE_ROWS).count < 0.001 * np.count_nonzero(counts)


def test_a_plateau_is_the_sensors_limit_and_a_dim_shot_has_none(clean) -> None:
    counts = clean.counts.astype(np.float32)
    level = np.float32(0.3) * counts.max()
    assert find_clipping_level(np.minimum(counts, level)) == level
    dim = np.random.default_rng(0).poisson(0.5, (200, 300)).astype(np.float32)
    for whole in (counts, dim, np.ones((20, 30), np.float32)):
        assert find_clipping_level(whole) == np.inf


def test_what_strikes_the_sensor_is_not_taken_for_the_lights_own_noise() -> None:
    rows, columns = np.mgrid[:240, :300]
    light = 900 * np.exp(-0.5 * ((rows - 60 - columns / 3) / 1.5) ** 2) * (columns / 300)
    noise = np.random.default_rng(4)
    counts = (3 * noise.poisson(light + 2.0)).astype(np.float32)
    struck = counts.copy()
    struck[noise.integers(0, 240, 300), noise.integers(0, 300, 300)] = 30 * counts.max()
    gain, beside = (estimate_noise(image)[2] for image in (counts, struck))
    # three counts for a photon; what a pulse bends may add to it, what strikes the sensor may not
    assert gain >= 3
    assert beside == pytest.approx(gain, rel=0.25)


@pytest.mark.parametrize(
    "method",
    [TotalVariation(iterations=300), PlugAndPlay(TotalVariation(iterations=300), calls=1)],
    ids=lambda method: method.name,
)
def test_light_that_is_cut_off_is_recovered_whatever_the_dark_level_is(method) -> None:
    """Where the sensor ends there is as much light or more: a picture is not flattened to it."""
    picture = np.zeros((16, 16), np.float32)
    picture[3:13, 6:10] = 1
    pulse = np.exp(-(((np.arange(40) - 18.3) / 4) ** 2))
    light = pulse[:, np.newaxis] * CAMERA.operator()(picture) * 300
    light += np.random.default_rng(0).normal(0, 1, light.shape)
    limit = np.float32(0.7 * light.max())
    found = []
    for dark, most in ((0, np.inf), (0, limit), (800, limit)):
        counts = (np.minimum(light, most) + dark).astype(np.float32)
        streak = Streak(counts, camera=CAMERA).with_bin_width(20e-12)
        frames = recover(streak, method=method)
        assert MeasurementNoise.from_figures(frames.figures) is not None
        found.append(frames.values.max())
    whole, cut, raised = found
    assert cut == pytest.approx(whole, rel=0.1)
    assert raised == pytest.approx(cut, rel=0.01)
