"""Streak images of scenes so simple that every reading can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera, SkewSweep
from tofclip.errors import InputError
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_plate,
    render_true_frames,
    simulate_shot,
)
from tofclip.simulate.bodies import Body
from tofclip.simulate.patterns import cut_pattern, make_letter, make_plain_pattern, make_stripes
from tofclip.simulate.streak import cast_view_rays, render_streak
from tofclip.units import SPEED_OF_LIGHT

CENTRES = np.array([60.0, 170.3, 280.8])
ANGLES = np.radians([-35.0, 4.0, 40.0])
GAINS = np.array([0.8, 1.0, 1.3])
BIN = 20e-12
SIGMA_BIN = 60e-12 / (2 * np.sqrt(2 * np.log(2))) / BIN
FOCAL = 200.0
WIDE_PITCH = 20e-3  # metres; makes the parallax several pixels
FOCUS = 2.0


def instrument(rows: int = 200, around: float = 2.0, **camera: object) -> Instrument:
    """Three views of 48 x 64 pixels; light from range `around` arrives in row 60."""
    time_zero = 60 * BIN - 2 * around / SPEED_OF_LIGHT
    optics = {"focal_length_px": FOCAL, "lenslet_pitch": WIDE_PITCH, "focus_distance": FOCUS}
    settings = {"gains": GAINS, "time_zero": time_zero} | optics | camera
    made = Camera(CENTRES, ANGLES, (48, 64), 340, **settings)
    return Instrument(made, StreakDetector(rows=rows), rays_per_pixel_side=6)


def spot(x_px: float, y_px: float, depth: float) -> Body:
    """A square as large as a pixel, seen from the reference view at (x, y) from the optical axis."""
    pixel = depth / FOCAL
    return make_plate((x_px * pixel, y_px * pixel, depth), (pixel, pixel), np.ones((1, 1)))


def centroid(amounts: np.ndarray) -> float:
    return float(np.sum(amounts * np.arange(amounts.size)) / np.sum(amounts))


def plate(pattern: np.ndarray, size: tuple[float, float], depth: float = 2.0) -> Scene:
    return Scene((make_plate((0, 0, depth), size, pattern),))


def view_image(scene: Scene, made: Instrument, view: int) -> np.ndarray:
    position = float(made.camera.view_positions[view])
    return render_streak(cast_view_rays(scene, made, position), view, made)


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(-15, 15), y=st.floats(-15, 15), depth=st.floats(1.2, 3.0), view=st.integers(0, 2)
)
def test_a_point_falls_on_the_column_and_row_of_the_camera_s_formula(x, y, depth, view):
    made = instrument(around=depth)
    image = view_image(Scene((spot(x, y, depth),)), made, view)
    u = made.camera.view_positions[view]
    shear = -FOCAL * WIDE_PITCH * (1 / depth - 1 / FOCUS)
    assert made.camera.shear_at(depth) == pytest.approx(shear)
    column = CENTRES[view] + x - y * np.tan(ANGLES[view]) + shear * u
    # a spot of one pixel is sampled by 6 rays a side, so its centre is known to a twelfth of a
    # pixel a direction
    assert centroid(image.sum(axis=0)) == pytest.approx(
        column, abs=(1 + abs(np.tan(ANGLES[view]))) / 12 + 0.01
    )
    point = depth * np.array([x / FOCAL, y / FOCAL, 1.0])
    path = np.linalg.norm(point) + np.linalg.norm(point - [WIDE_PITCH * u, 0, 0])
    row = path / SPEED_OF_LIGHT / BIN + made.camera.time_zero / BIN
    # half a pixel beside the middle the way there and back differs by up to 2 * 2 mm * (15 +
    # 2)/200, 0.1 bin
    assert centroid(image.sum(axis=1)) == pytest.approx(row, abs=0.1)


def test_near_points_have_negative_shear():
    made = instrument()
    assert made.camera.shear_at(1.0) < 0 < made.camera.shear_at(3.0)
    assert made.camera.shear_at(FOCUS) == 0


def test_views_agree_at_the_focus_and_move_apart_in_front_of_it():
    columns = {}
    for depth in (FOCUS, 1.4):
        made, scene = instrument(around=depth), Scene((spot(0.2, 0.1, depth),))
        columns[depth] = [
            centroid(view_image(scene, made, k).sum(axis=0)) - CENTRES[k] for k in range(3)
        ]
    np.testing.assert_allclose(columns[FOCUS], 0.2 - 0.1 * np.tan(ANGLES), atol=0.2)
    # view 0 stands to the left: near things move to the right
    assert columns[1.4][0] > 0.5 > -0.5 > columns[1.4][2]


def test_the_pulse_has_its_width_and_a_sub_bin_delay():
    made = instrument()
    profile = view_image(Scene((spot(0.0, 0.0, 2.0),)), made, 1).sum(axis=1)
    # beside the middle of the spot its range is longer, by 2 m / (12 * 200^2) = 4 um or 1.4e-3 bin
    # on average
    assert centroid(profile) == pytest.approx(60.0 + 1.4e-3, abs=1e-4)
    spread = np.sum(profile * (np.arange(200) - 60.0) ** 2) / profile.sum()
    # a row integrates over its width
    assert spread == pytest.approx(SIGMA_BIN**2 + 1 / 12, rel=1e-3)
    further = Scene((spot(0.0, 0.0, 2.0 + 0.3 * SPEED_OF_LIGHT * BIN / 2),))
    later = view_image(further, made, 1).sum(axis=1)
    assert centroid(later) == pytest.approx(60.3 + 1.4e-3, abs=1e-4)


def test_no_light_is_lost_between_the_rays_and_the_slit():
    made = instrument()
    scene = Scene(
        (make_plate((0.02, -0.01, 2.1), (0.25, 0.2), make_stripes(3, 0.2, 0.9), yaw=0.2),)
    )
    for view in range(3):
        rays = cast_view_rays(scene, made, float(made.camera.view_positions[view]))
        # the pulse is cut at 5 standard deviations, 6e-7 of its energy
        expected = GAINS[view] * rays.brightness.sum()
        assert render_streak(rays, view, made).sum() == pytest.approx(expected, rel=1e-6)


def test_light_beyond_the_screen_is_lost_quietly():
    made = instrument(rows=61)  # the pulse's second half would fall on rows 61 and later
    late = view_image(Scene((spot(0.0, 0.0, 2.0),)), made, 1)
    whole = view_image(Scene((spot(0.0, 0.0, 2.0),)), instrument(), 1)
    np.testing.assert_allclose(late, whole[:61])
    aside = made.camera.replace(centres_px=np.array([1.0, 170.3, 338.0]))
    scene = plate(make_plain_pattern(0.8), (0.5, 0.4))
    edge = view_image(scene, replace(made, camera=aside), 0)
    assert 0 < edge.sum() < 0.7 * view_image(scene, made, 0).sum()


@pytest.mark.parametrize("depth", [1.7, 2.0, 2.6])
def test_recovery_s_operator_agrees_with_the_ray_caster(depth):
    # Two independent ways to the same picture; they differ by what a pixel's finite height spreads
    # on the slit.
    made = instrument(around=depth)
    pixel = depth / FOCAL
    letter = cut_pattern(make_letter("A"), make_plain_pattern(0.9))
    scene = plate(letter, (30 * pixel, 30 * pixel), depth)
    shot = simulate_shot(scene, made, 0)
    frames = np.moveaxis(render_true_frames(scene, made, shot.exposure).values, 0, -1)

    def mismatch(shear: float) -> float:
        predicted = made.camera.operator(shear)(np.ascontiguousarray(frames)).T
        return float(np.linalg.norm(predicted - shot.signal) / np.linalg.norm(shot.signal))

    shear = made.camera.shear_at(depth)
    assert mismatch(shear) < 0.05
    assert min(mismatch(shear - 1), mismatch(shear + 1)) > 2 * mismatch(shear)


def test_a_side_view_looks_behind_the_occluder():
    near = make_plate((0, 0, 1.0), (0.1, 0.3), np.full((1, 1), 0.5))
    hidden = make_plate((0, 0, 2.0), (0.1, 0.1), np.full((1, 1), 0.5))
    made = instrument(lenslet_pitch=0.12)
    behind = slice(45, 76)  # rows around range 2 m
    lamp = (0.0, -1.0, 0.0)
    for bodies in ((near, hidden), (hidden, near)):
        assert view_image(Scene(bodies, lamp), made, 1)[behind].sum() == 0
    alone = view_image(Scene((hidden,), lamp), made, 0)
    seen = view_image(Scene((near, hidden), lamp), made, 0)
    assert seen.sum() > 0.5 * alone.sum() > 0


def test_brightness_falls_with_the_square_of_the_range():
    flux = [
        view_image(Scene((spot(0.0, 0.0, depth),)), instrument(around=depth), 1).sum()
        for depth in (1.8, 3.6)
    ]
    # the spot fills the same pixel at both ranges
    assert flux[0] / flux[1] == pytest.approx(4.0, rel=1e-3)


def test_a_sweep_that_is_skewed_moves_and_stretches_the_rows():
    sweep = SkewSweep(CENTRES, np.array([-7.5, 0.0, 6.25]), np.array([0.02, 0.0, -0.05]))
    made = instrument(sweep=sweep)
    for view, (offset, stretch) in enumerate([(-7.5, 0.02), (0.0, 0.0), (6.25, -0.05)]):
        straight = view_image(Scene((spot(0.0, 0.0, 2.0),)), instrument(), view).sum(axis=1)
        skewed = view_image(Scene((spot(0.0, 0.0, 2.0),)), made, view).sum(axis=1)
        # the spot lies within a pixel of the view's centre, where the skew changes by 0.07 rows a
        # column
        assert centroid(skewed) == pytest.approx(
            offset + (1 + stretch) * centroid(straight), abs=0.04
        )
        width = np.sum(skewed * (np.arange(200) - centroid(skewed)) ** 2) / skewed.sum()
        assert width == pytest.approx(((1 + stretch) * SIGMA_BIN) ** 2 + 1 / 12, rel=5e-3)


@pytest.fixture(scope="module")
def flat_shot():
    scene, photons = plate(make_plain_pattern(0.8), (0.6, 0.5)), (500, 3.0, 480)
    made = replace(instrument(), detector=StreakDetector(200, BIN, *photons))
    return simulate_shot(scene, made, 7), scene, made


def test_noise_is_poisson_on_signal_and_background(flat_shot):
    shot = flat_shot[0]
    expected = shot.signal.astype(np.float64) + 3.0
    assert shot.signal.max() == pytest.approx(500, rel=1e-6)
    dark = shot.streak.counts[shot.signal == 0]
    assert dark.mean() == pytest.approx(3.0, abs=5 * np.sqrt(3.0 / dark.size))
    # variance of a Poisson variable's sample variance: (mu + 2 mu^2) / n
    assert dark.var() == pytest.approx(3.0, abs=5 * np.sqrt((3.0 + 18.0) / dark.size))
    safe = (shot.signal > 20) & (expected + 6 * np.sqrt(expected) < 480)
    score = (shot.streak.counts[safe] - expected[safe]) / np.sqrt(expected[safe])
    assert score.mean() == pytest.approx(0.0, abs=5 / np.sqrt(score.size))
    assert score.var() == pytest.approx(1.0, abs=5 * np.sqrt(2.1 / score.size))


def test_saturated_pixels_are_clipped_and_marked(flat_shot):
    streak = flat_shot[0].streak
    assert streak.counts.max() == 480
    assert streak.saturated is not None
    np.testing.assert_array_equal(streak.saturated, streak.counts == 480)
    assert 0 < streak.saturated.sum() < streak.counts.size / 10


def test_a_seed_gives_the_same_shot_again(flat_shot):
    shot, scene, made = flat_shot
    again, other = simulate_shot(scene, made, 7), simulate_shot(scene, made, 8)
    np.testing.assert_array_equal(shot.streak.counts, again.streak.counts)
    assert np.any(shot.streak.counts != other.streak.counts)
    np.testing.assert_array_equal(shot.signal, other.signal)
    assert shot.streak.provenance["settings"]["seed"] == 7


def test_a_shot_says_when_each_row_was_and_carries_its_camera(flat_shot):
    shot = flat_shot[0]
    np.testing.assert_allclose(shot.streak.times, BIN * np.arange(200), atol=1e-18)
    assert shot.streak.camera is shot.camera


def test_unusable_instruments_and_empty_shots_are_refused():
    behind, late = plate(make_plain_pattern(0.5), (1, 1), -2.0), Scene((spot(0, 0, 20.0),))
    for scene in (behind, late):
        with pytest.raises(InputError, match="no light of the scene"):
            simulate_shot(scene, instrument(), 0)
    for wrong, problem in (
        ({"rows": 0}, "rows and a positive bin width"),
        ({"bin_width": 0.0}, "rows and a positive bin width"),
        ({"bin_width": float("nan")}, "rows and a positive bin width"),
        ({"peak_photons": 0.0}, "photons"),
        ({"background_photons": -1.0}, "photons"),
        ({"full_scale_photons": float("nan")}, "photons"),
    ):
        with pytest.raises(InputError, match=problem):
            StreakDetector(**wrong)
    with pytest.raises(InputError, match="must be positive"):
        replace(instrument(), rays_per_pixel_side=0)
