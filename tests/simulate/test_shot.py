"""Rays that meet plates, and streak images of scenes so simple that every reading can be worked out by
hand.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
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
from tofclip.simulate.bodies import NO_BODY, cast_rays, look_up_reflectance
from tofclip.simulate.patterns import (
    make_letter,
    make_plain_pattern,
    make_stripes,
)
from tofclip.simulate.streak import render_streak
from tofclip.units import SPEED_OF_LIGHT

ORIGIN = np.zeros(3)
AHEAD = np.array([[0.0, 0.0, 1.0]])


def wall(depth, side=10.0, **turned):
    return make_plate((0.0, 0.0, depth), (side, side), np.full((4, 4), 0.5), **turned)


@given(
    yaw=st.floats(-1.0, 1.0), pitch=st.floats(-1.0, 1.0), depth=st.floats(0.5, 5.0),
    right=st.floats(-0.2, 0.2), down=st.floats(-0.2, 0.2),
)  # fmt: skip
def test_a_turned_plate_is_met_in_its_plane(yaw, pitch, depth, right, down):
    plate = wall(depth, 100.0, yaw=yaw, pitch=pitch)
    distance = plate.intersect(ORIGIN, np.array([[right, down, 1.0]])).distance
    across, along, normal = plate.axes.T
    np.testing.assert_allclose([across @ along, across @ normal, along @ normal], 0, atol=1e-12)
    point = distance[0] * np.array([right, down, 1.0])
    assert (point - [0, 0, depth]) @ normal == pytest.approx(0, abs=1e-9 * depth)


def test_positive_yaw_turns_the_right_side_back_and_positive_pitch_the_upper_side():
    for turn, beside in (("yaw", [[0.1, 0.0, 1.0]]), ("pitch", [[0.0, -0.1, 1.0]])):
        assert wall(2.0, **{turn: 0.3}).intersect(ORIGIN, np.array(beside)).distance[0] > 2.0


def test_the_pattern_is_upright_and_not_mirrored():
    plate = make_plate((0, 0, 1), (0.2, 0.2), np.array([[0.1, 0.2], [0.3, np.nan]]))
    corners = np.array([[-0.05, -0.05, 1], [0.05, -0.05, 1], [-0.05, 0.05, 1], [0.05, 0.05, 1]])
    hits = cast_rays((plate,), ORIGIN, corners)
    reflectance = look_up_reflectance((plate,), hits)
    np.testing.assert_allclose(reflectance[:3], [0.1, 0.2, 0.3], rtol=1e-6)
    assert hits.distance.tolist() == [1.0, 1.0, 1.0, np.inf]


def test_the_nearest_plate_is_seen_through_the_holes_of_none():
    hole = make_plate((0, 0, 1), (1, 1), np.array([[np.nan, 0.9]]))
    scene = Scene((wall(3.0), hole, wall(2.0), wall(-1.0)))  # what is behind is not seen
    hits = scene.trace(ORIGIN, np.array([[0.1, 0, 1], [-0.1, 0, 1], [9.0, 0, 1]]))
    assert hits.body.tolist() == [1, 2, NO_BODY]
    np.testing.assert_allclose(hits.path[:2], np.hypot(1, 0.1) * np.array([1, 2]))
    assert hits.reflectance[2] == 0


def test_path_is_half_of_there_and_back_from_different_places():
    # hits (0, 0, 4): 4 m from the lamp
    hits = Scene((wall(4.0),)).trace(np.array([3.0, 0.0, 0.0]), np.array([[-0.75, 0.0, 1.0]]))
    assert hits.path[0] == pytest.approx((4.0 + 5.0) / 2)
    assert hits.distance[0] == pytest.approx(4.0)


def test_a_slanted_surface_is_lit_by_the_cosine():
    hits = Scene((wall(2.0, yaw=np.pi / 3),)).trace(ORIGIN, AHEAD)
    assert hits.reflectance[0] == pytest.approx(0.5 * np.cos(np.pi / 3))


def test_a_plate_casts_a_shadow_that_a_distant_lamp_moves_aside():
    bodies = make_plate((0, 0, 1.0), (0.1, 0.1), make_plain_pattern(0.9)), wall(2.0)
    # points on the wall, as directions from the origin
    behind = np.array([[0.2, 0.0, 2.0], [0.0, 0.0, 2.0]])
    beside = Scene(bodies, lamp=(-0.2, 0.0, 0.0)).trace(ORIGIN, behind)
    assert beside.body.tolist() == [1, 0]
    assert beside.reflectance[0] == 0  # the way to (0.2, 0, 2) passes the card's middle
    assert np.all(Scene(bodies).trace(ORIGIN, behind).reflectance > 0)


@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        ("U", [(0.1, 0.1), (0.9, 0.1), (0.5, 0.95)], [(0.5, 0.1)]),
        ("C", [(0.1, 0.5), (0.5, 0.1)], [(0.9, 0.5), (0.5, 0.5)]),
        ("L", [(0.2, 0.1), (0.9, 0.9)], [(0.9, 0.1)]),
        ("A", [(0.5, 0.1), (0.5, 0.7)], [(0.5, 0.4), (0.5, 0.95)]),
    ],
)
def test_letters_have_their_shape(name, inside, outside):
    lit = np.isfinite(make_letter(name, 0.8))
    rows, columns = lit.shape
    assert all(lit[int(y * rows), int(x * columns)] for x, y in inside)
    assert not any(lit[int(y * rows), int(x * columns)] for x, y in outside)


CENTRES = np.array([60.0, 170.3, 280.8])
ANGLES = np.radians([-35.0, 4.0, 40.0])
GAINS = np.array([0.8, 1.0, 1.3])
BIN = 20e-12
SIGMA_BIN = 60e-12 / (2 * np.sqrt(2 * np.log(2))) / BIN
FOCAL = 200.0
WIDE_PITCH = 20e-3  # metres; makes the parallax several pixels
FOCUS = 2.0


def instrument(rows=200, around=2.0, **camera):
    """Three views of 48 x 64 pixels; light from range `around` arrives in row 60."""
    time_zero = 60 * BIN - 2 * around / SPEED_OF_LIGHT
    optics = {"focal_length_px": FOCAL, "lenslet_pitch": WIDE_PITCH, "focus_distance": FOCUS}
    settings = {"gains": GAINS, "time_zero": time_zero} | optics | camera
    made = Camera(CENTRES, ANGLES, (48, 64), 340, **settings)
    return Instrument(made, StreakDetector(rows=rows), rays_per_pixel_side=6)


def spot(x_px=0.0, y_px=0.0, depth=2.0):
    """A square as large as a pixel, seen from the reference view at (x, y) from the optical axis."""
    pixel = depth / FOCAL
    place = (x_px * pixel, y_px * pixel, depth)
    return Scene((make_plate(place, (pixel, pixel), np.ones((1, 1))),))


def centroid(amounts):
    return float(np.sum(amounts * np.arange(amounts.size)) / np.sum(amounts))


def width(amounts, middle):
    return np.sum(amounts * (np.arange(amounts.size) - middle) ** 2) / amounts.sum()


def plate(pattern, size, depth=2.0):
    return Scene((make_plate((0, 0, depth), size, pattern),))


@given(
    x=st.floats(-15, 15), y=st.floats(-15, 15), depth=st.floats(1.2, 3.0), view=st.integers(0, 2)
)
def test_a_point_falls_on_the_column_and_row_of_the_camera_s_formula(x, y, depth, view):
    made = instrument(around=depth)
    image = render_streak(spot(x, y, depth), made, view)
    u = made.camera.view_positions[view]
    shear = -FOCAL * WIDE_PITCH * (1 / depth - 1 / FOCUS)
    assert made.camera.shear_at(depth) == pytest.approx(shear)
    column = CENTRES[view] + x - y * np.tan(ANGLES[view]) + shear * u
    # a spot of one pixel is sampled by 6 rays a side, so its centre is known to a twelfth of a
    # pixel a direction
    bound = (1 + abs(np.tan(ANGLES[view]))) / 12 + 0.01
    assert centroid(image.sum(axis=0)) == pytest.approx(column, abs=bound)
    point = depth * np.array([x / FOCAL, y / FOCAL, 1.0])
    path = np.linalg.norm(point) + np.linalg.norm(point - [WIDE_PITCH * u, 0, 0])
    row = path / SPEED_OF_LIGHT / BIN + made.camera.time_zero / BIN
    # half a pixel beside the middle the way there and back differs by up to 2 * 2 mm * (15 +
    # 2)/200, 0.1 bin
    assert centroid(image.sum(axis=1)) == pytest.approx(row, abs=0.1)


def test_the_pulse_has_its_width_and_a_sub_bin_delay():
    made = instrument()
    profile = render_streak(spot(), made, 1).sum(axis=1)
    # beside the middle of the spot its range is longer, by 2 m / (12 * 200^2) = 4 um or 1.4e-3 bin
    # on average
    assert centroid(profile) == pytest.approx(60.0 + 1.4e-3, abs=1e-4)
    # a row integrates over its width
    assert width(profile, 60.0) == pytest.approx(SIGMA_BIN**2 + 1 / 12, rel=1e-3)
    later = render_streak(spot(depth=2.0 + 0.3 * SPEED_OF_LIGHT * BIN / 2), made, 1).sum(axis=1)
    assert centroid(later) == pytest.approx(60.3 + 1.4e-3, abs=1e-4)


def test_no_light_is_lost_between_the_rays_and_the_slit():
    made, pattern = instrument(), make_stripes(3, 0.2, 0.9)
    scene = Scene((make_plate((0.02, -0.01, 2.1), (0.25, 0.2), pattern, yaw=0.2),))
    for view in range(3):
        hits = made.look_at(scene, float(made.camera.view_positions[view]))
        seen, rays = hits.reflectance > 0, made.rays_per_pixel_side**2
        light = np.sum(hits.reflectance[seen] / hits.distance[seen] ** 2) / rays
        # the pulse is cut at 5 standard deviations, 6e-7 of its energy
        expected = pytest.approx(GAINS[view] * light, rel=1e-6)
        assert render_streak(scene, made, view).sum() == expected


@pytest.mark.parametrize("depth", [1.7, 2.0, 2.6])
def test_recovery_s_operator_agrees_with_the_ray_caster(depth):
    # Two independent ways to the same picture; they differ by what a pixel's finite height spreads
    # on the slit.
    made, side = instrument(around=depth), 30 * depth / FOCAL
    letter = make_letter("A", 0.9)
    scene = plate(letter, (side, side), depth)
    shot = simulate_shot(scene, made, 0)
    frames = np.moveaxis(render_true_frames(scene, made, shot.exposure).values, 0, -1)

    def mismatch(shear):
        predicted = made.camera.operator(shear)(np.ascontiguousarray(frames)).T
        return float(np.linalg.norm(predicted - shot.signal) / np.linalg.norm(shot.signal))

    shear = made.camera.shear_at(depth)
    assert mismatch(shear) < 0.05
    assert min(mismatch(shear - 1), mismatch(shear + 1)) > 2 * mismatch(shear)


def test_a_side_view_looks_behind_the_occluder():
    near = make_plate((0, 0, 1.0), (0.1, 0.3), np.full((1, 1), 0.5))
    hidden = make_plate((0, 0, 2.0), (0.1, 0.1), np.full((1, 1), 0.5))
    made, lamp = instrument(lenslet_pitch=0.12), (0.0, -1.0, 0.0)
    behind = slice(45, 76)  # rows around range 2 m
    for bodies in ((near, hidden), (hidden, near)):
        assert render_streak(Scene(bodies, lamp), made, 1)[behind].sum() == 0
    alone, seen = (render_streak(Scene(b, lamp), made, 0) for b in ((hidden,), (near, hidden)))
    assert seen.sum() > 0.5 * alone.sum() > 0


def test_a_sweep_that_is_skewed_moves_and_stretches_the_rows():
    sweep = SkewSweep(CENTRES, np.array([-7.5, 0.0, 6.25]), np.array([0.02, 0.0, -0.05]))
    for view, (offset, stretch) in enumerate(zip(sweep.offsets_bin, sweep.stretches, strict=True)):
        straight, skewed = (
            render_streak(spot(), made, view).sum(axis=1)
            for made in (instrument(), instrument(sweep=sweep))
        )
        # the spot lies within a pixel of the view's centre, where the skew changes by 0.07 rows a
        # column
        expected = offset + (1 + stretch) * centroid(straight)
        assert centroid(skewed) == pytest.approx(expected, abs=0.04)
        expected = ((1 + stretch) * SIGMA_BIN) ** 2 + 1 / 12
        assert width(skewed, centroid(skewed)) == pytest.approx(expected, rel=5e-3)


@pytest.fixture(scope="module")
def flat_shot():
    scene, photons = plate(make_plain_pattern(0.8), (0.6, 0.5)), (500, 3.0, 480)
    made = replace(instrument(), detector=StreakDetector(200, BIN, *photons))
    return simulate_shot(scene, made, 7), scene, made


def test_noise_is_poisson_on_signal_and_background_and_saturated_pixels_are_marked(flat_shot):
    shot, counts = flat_shot[0], flat_shot[0].streak.counts
    expected = shot.signal.astype(np.float64) + 3.0
    assert shot.signal.max() == pytest.approx(500, rel=1e-6)
    dark = counts[shot.signal == 0]
    assert dark.mean() == pytest.approx(3.0, abs=5 * np.sqrt(3.0 / dark.size))
    # variance of a Poisson variable's sample variance: (mu + 2 mu^2) / n
    assert dark.var() == pytest.approx(3.0, abs=5 * np.sqrt((3.0 + 18.0) / dark.size))
    safe = (shot.signal > 20) & (expected + 6 * np.sqrt(expected) < 480)
    score = (counts[safe] - expected[safe]) / np.sqrt(expected[safe])
    assert score.mean() == pytest.approx(0.0, abs=5 / np.sqrt(score.size))
    assert score.var() == pytest.approx(1.0, abs=5 * np.sqrt(2.1 / score.size))
    assert counts.max() == 480
    np.testing.assert_array_equal(shot.streak.saturated, counts == 480)
    assert 0 < shot.streak.saturated.sum() < counts.size / 10


def test_a_seed_gives_the_same_shot_again_and_a_shot_says_what_it_is(flat_shot):
    shot, scene, made = flat_shot
    again, other = simulate_shot(scene, made, 7), simulate_shot(scene, made, 8)
    np.testing.assert_array_equal(shot.streak.counts, again.streak.counts)
    assert np.any(shot.streak.counts != other.streak.counts)
    np.testing.assert_array_equal(shot.signal, other.signal)
    assert shot.streak.provenance["settings"]["seed"] == 7
    np.testing.assert_allclose(shot.streak.times, BIN * np.arange(200), atol=1e-18)
    assert shot.streak.camera is shot.camera


PLAIN = make_plain_pattern(0.5)


@pytest.mark.parametrize(
    ("attempt", "problem"),
    [
        (lambda: make_plate((0, 0, 1), (1, 1), np.zeros(3)), "reflectance"),
        (lambda: make_plate((0, 0, 1), (1, 1), np.full((2, 2), 1.5)), r"within 0\.\.1"),
        (lambda: make_plate((0, 0, 1), (1, 1), np.full((2, 2), np.nan)), r"within 0\.\.1"),
        (lambda: make_plate((0, 0, 1), (0, 1), PLAIN), "positive size"),
        (lambda: make_plate((0, 0, np.inf), (1, 1), PLAIN), "finite position"),
        (lambda: Scene(()), "at least one body"),
        (lambda: make_letter("Q", 0.5), "unknown letter 'Q'"),
        (
            lambda: simulate_shot(plate(PLAIN, (1, 1), -2.0), instrument(), 0),
            "no light of the scene",
        ),
        (lambda: simulate_shot(spot(depth=20.0), instrument(), 0), "no light of the scene"),
        (lambda: StreakDetector(rows=0), "rows and a positive bin width"),
        (lambda: StreakDetector(bin_width=0.0), "rows and a positive bin width"),
        (lambda: StreakDetector(bin_width=np.nan), "rows and a positive bin width"),
        (lambda: StreakDetector(peak_photons=0.0), "photons"),
        (lambda: StreakDetector(background_photons=-1.0), "photons"),
        (lambda: StreakDetector(full_scale_photons=np.nan), "photons"),
        (lambda: replace(instrument(), rays_per_pixel_side=0), "must be positive"),
    ],
)
def test_unusable_plates_scenes_and_instruments_are_refused(attempt, problem):
    with pytest.raises(InputError, match=problem):
        attempt()
