"""Depth-locked refocus: one shot of targets from 0.5 to 5 m, each recovered at the shear of its own
range; and shadows on a wall, which come out as holes in its part of the cloud, as in the paper's
Supplementary Figure 22: letters in front of a wall, lit from the side by a round, uneven beam.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from tofclip import depth, nmse, point_cloud
from tofclip.camera import Camera, SkewSweep, measure
from tofclip.errors import CalibrationError, InputError, ShapeError
from tofclip.lidar import Detection
from tofclip.recovery import (
    DepthLockedFocus,
    FixedFocus,
    SharpestFocus,
    fit_parallax_to_shot,
    open_shot,
    parse_focus,
    recover,
)
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_default_instrument,
    make_plate,
    render_true_frames,
    simulate_shot,
)
from tofclip.simulate.patterns import TEXELS, make_letter
from tofclip.simulate.streak import FOCAL_LENGTH_PX
from tofclip.solvers import Backprojection, Sparse
from tofclip.units import SPEED_OF_LIGHT

BIN = 20e-12
FOCAL = 280.0
RANGES = (0.5, 0.9, 1.6, 2.8, 5.0)
PLACES = ((-20, -18), (20, -18), (0, 0), (-20, 18), (20, 18))
TANGENTS = np.array([-0.94, -0.48, -0.22, 0.01, 0.42, 0.77, 1.11])
CENTRES = 60.0 + 90 * np.arange(7)
METHOD = Sparse(iterations=40)


def camera(order=(3, 0, 5, 1, 6, 2, 4)):
    """Seven views, their angles by default in an order that makes ranges defocus."""
    return Camera(
        CENTRES,
        np.arctan(TANGENTS[list(order)]),
        (64, 64),
        660,
        sweep=SkewSweep(CENTRES, np.zeros(7), np.zeros(7)),
        time_zero=-2 * 0.4 / SPEED_OF_LIGHT,
        focal_length_px=FOCAL,
        lenslet_pitch=5e-3,
        focus_distance=1.6,
    )


def make_facing_plate(pattern, place_px, side_px, distance, focal=FOCAL):
    """So many pixels large and aside, seen from the reference view."""
    x, y, side = (number * distance / focal for number in (*place_px, side_px))
    return make_plate((x, y, distance), (side, side), pattern)


SCENE = Scene(
    tuple(
        make_facing_plate(make_letter(name, 0.8), place, 18, distance)
        for name, place, distance in zip("UCLAU", PLACES, RANGES, strict=True)
    )
)


def instrument(made):
    return Instrument(made, StreakDetector(1560, BIN, peak_photons=2e5, full_scale_photons=1e9))


def gate(distance, made):
    row = round((2 * distance / SPEED_OF_LIGHT + made.time_zero) / BIN)
    return slice(row - 4, row + 9)


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(SCENE, instrument(camera()), seed=0)


@pytest.fixture(scope="module")
def locked(shot):
    return recover(shot.streak, shot.camera, METHOD, focus=DepthLockedFocus())


def test_every_range_is_as_good_as_alone_and_the_ends_are_better_than_any_fixed_shear(shot, locked):
    made = shot.camera
    truth = render_true_frames(SCENE, instrument(made), shot.exposure).values
    measurements = measure(shot.streak.counts, None, made).values
    shears = np.linspace(-2.0, 0.5, 6)

    def error(frames, distance):
        return nmse(frames.sum(axis=0), truth[gate(distance, made)].sum(axis=0))

    def alone(distance, shear):
        part = np.ascontiguousarray(measurements[:, gate(distance, made)])
        return error(METHOD.recover(made.operator(shear), part).frames, distance)

    found = {d: error(locked.values[gate(d, made)], d) for d in RANGES}
    fixed = np.array([[alone(d, s) for s in shears] for d in RANGES])
    best = fixed[:, fixed.mean(axis=0).argmin()]
    for distance in RANGES:
        assert found[distance] < 1.1 * alone(distance, float(made.shear_at(distance)))
    assert found[0.5] < best[0]
    assert found[5.0] < best[-1]


def test_pieces_cover_all_frames_within_the_tolerance(shot):
    made = shot.camera
    times = shot.streak.times - made.time_zero
    for tolerance in (0.1, 0.5):
        pieces = DepthLockedFocus(tolerance).plan_segments(made, times)
        assert pieces[0].frames.start == 0
        assert pieces[-1].frames.stop == times.size
        assert all(a.frames.stop == b.frames.start for a, b in pairwise(pieces))
        used = np.repeat([p.shear for p in pieces], [p.size for p in pieces])
        # three steps to the outermost view
        wrong = np.abs(used - made.shear_at(SPEED_OF_LIGHT * times / 2)) * 3
        # a piece spans twice the tolerance; its mean may lie off its middle
        assert wrong.max() < 2 * tolerance
        assert np.median(wrong) < tolerance
    assert np.all(np.diff([piece.brightness for piece in pieces]) < 0)


def test_frames_remember_their_shears(locked, shot):
    expected = shot.camera.shear_at(SPEED_OF_LIGHT * locked.times / 2)
    np.testing.assert_allclose(locked.shears, expected, atol=0.17)
    assert locked.figures["focus"] == "depth-locked"
    with pytest.raises(ShapeError, match="shears"):
        replace(locked, shears=np.zeros(3))


@pytest.mark.parametrize("focus", [FixedFocus(), DepthLockedFocus()])
@pytest.mark.nightly
def test_heights_come_out_true_in_the_depth_of_field_arrangement(focus):
    shot = simulate_shot(SCENE, instrument(camera(order=(0, 1, 2, 3, 4, 5, 6))), seed=0)
    frames = recover(shot.streak, shot.camera, METHOD, focus=focus)
    cloud = point_cloud(depth(frames))
    nearest = np.abs(cloud.range - 0.5) < 0.05
    as_seen = point_cloud(depth(frames, shot.camera.replace(lenslet_pitch=0.0)))
    height, seen = (np.median(one.xyz[nearest, 1]) * FOCAL / 0.5 for one in (cloud, as_seen))
    # the median height of the letter U's surface lies 1 px below its middle; noise and defocus cost
    # a pixel
    assert height == pytest.approx(-17, abs=2)
    assert np.abs(seen - height) > 4 if focus == FixedFocus() else np.abs(seen - height) < 0.5


def test_a_stack_finds_the_shears_that_the_ranges_ask_for(shot):
    made = shot.camera.replace(lenslet_pitch=0.0)
    counts, times = shot.streak.counts[:128], shot.streak.row_times[:128]
    part = replace(shot.streak, counts=counts, row_times=times, saturated=None)
    frames = recover(part, made, Backprojection(), focus=SharpestFocus(-2.5, 0.5, 7))
    assert frames.figures["focus"] == "stack:-2.5:0.5:7"
    # the target at 0.5 m lies in the first gate; light of the one at 0.9 m arrives later than both
    assert frames.shears[33] == pytest.approx(float(shot.camera.shear_at(0.5)), abs=0.2)


def test_the_parallax_is_found_from_the_shot(shot):
    unknown = shot.camera.replace(lenslet_pitch=0.0, focus_distance=np.inf)
    done = []
    found = fit_parallax_to_shot(open_shot(shot.streak, unknown), 5, (-2.4, 0.9, 6), done.append)
    strength = FOCAL * 5e-3
    assert found.parallax.strength == pytest.approx(strength, rel=0.1)
    for distance in (0.5, 5.0):
        assert float(found.camera.shear_at(distance)) == pytest.approx(
            float(shot.camera.shear_at(distance)), abs=0.2
        )
    assert sum(done) == 6 * 30 * shot.streak.counts.shape[0]


def test_names_of_foci():
    assert parse_focus("depth-locked") == DepthLockedFocus()
    assert parse_focus("fixed:-0.5") == FixedFocus(-0.5)
    assert parse_focus("stack:-2:1:7") == SharpestFocus(-2.0, 1.0, 7)
    wrong = ", fixed, fixed:a, fixed:nan, stack:0:1, stack:1:0:3, stack:0:1:1, depth-locked:1"
    for text in wrong.split(", "):
        with pytest.raises(InputError, match=r"focus|shear"):
            parse_focus(text)
    with pytest.raises(InputError, match="tolerance"):
        DepthLockedFocus(0.0)


def test_what_the_camera_does_not_know_is_said(shot):
    with pytest.raises(CalibrationError, match="lenslet pitch"):
        recover(shot.streak, shot.camera.replace(lenslet_pitch=0.0), focus=DepthLockedFocus())
    with pytest.raises(CalibrationError, match="time zero"):
        fit_parallax_to_shot(open_shot(shot.streak, shot.camera, time_zero=1e-9), 5, (-1.0, 1.0, 3))
    with pytest.raises(InputError, match="gates"):
        fit_parallax_to_shot(open_shot(shot.streak, shot.camera), 2, (-1.0, 1.0, 3))


WALL_DEPTH_M = 2.8
WALL_SIDE_PX = 112
BEAM_RADIUS_FRACTION = 0.46  # of the wall's side
RIM_BRIGHTNESS_FRACTION = 0.45  # of the middle's
LAMP_POSITION_M = (-0.14, -0.1, 0.0)
LETTERS = (("U", (-22, -18), 2.2), ("L", (24, -14), 2.35), ("C", (2, 22), 2.25))
LETTER_SIDE_PX = 30


def make_shadow_scene():
    """Three letters between 2.2 and 2.35 m, a wall at 2.8 m, a lamp 0.17 m up and to the left.

    The beam's profile is printed on the wall, where it matters; the letters are evenly bright.
    """
    across = (np.arange(TEXELS) + 0.5) / TEXELS - 0.5
    radius = np.hypot(across[:, np.newaxis], across) / BEAM_RADIUS_FRACTION
    beam = np.where(radius <= 1, 0.9 * RIM_BRIGHTNESS_FRACTION ** (radius**2), 0)
    plates = [(make_letter(name, 0.7), place, LETTER_SIDE_PX, z) for name, place, z in LETTERS]
    plates.append((beam.astype(np.float32), (0, 0), WALL_SIDE_PX, WALL_DEPTH_M))
    bodies = tuple(make_facing_plate(*one, FOCAL_LENGTH_PX) for one in plates)
    return Scene(bodies, LAMP_POSITION_M)


def find_lit_and_shadow():
    """Pixels whose whole neighbourhood is lit wall, or wall in shadow, by the ray caster."""
    scene, made = make_shadow_scene(), make_default_instrument().camera
    rows, columns = np.indices(made.image_shape).reshape(2, -1)
    down, right = rows - made.optical_axis_px[0], columns - made.optical_axis_px[1]
    ahead = np.full(rows.size, made.focal_length_px)
    hits = scene.trace(np.zeros(3), np.stack([right, down, ahead], axis=-1) / ahead[:, np.newaxis])
    wall = (hits.body == 3) & (np.hypot(right, down) < 0.9 * BEAM_RADIUS_FRACTION * WALL_SIDE_PX)
    around = np.ones((3, 3))
    return [
        binary_erosion((wall & chosen).reshape(made.image_shape), around)
        for chosen in (hits.reflectance > 0, hits.reflectance == 0)
    ]


def test_shadows_are_recovered_as_holes_in_the_wall():
    lit, shadow = find_lit_and_shadow()
    assert lit.sum() > 1500
    assert shadow.sum() > 150
    shot = simulate_shot(make_shadow_scene(), make_default_instrument(), seed=0)
    frames = recover(shot.streak, shot.camera, METHOD, focus=DepthLockedFocus())
    at_wall = np.abs(frames.times * SPEED_OF_LIGHT / 2 - WALL_DEPTH_M) < 0.06
    bright = np.tensordot(frames.times[at_wall] ** 2, frames.values[at_wall], 1)
    # light of the lit wall leaks into the shadows, a few pixels wide, through the seven views' blur
    assert np.median(bright[shadow]) < 0.45 * np.median(bright[lit])
    # the beam's rim is 0.45 as bright as its middle, so that a quarter lies between it and the
    # shadows
    found = depth(frames, detection=Detection(min_time_bin_fraction=0.25))
    on_wall = np.zeros(lit.shape, bool)
    at_wall = np.abs(found.range - WALL_DEPTH_M) < 0.1
    on_wall[found.y[at_wall], found.x[at_wall]] = True
    assert on_wall[lit].mean() > 0.9
    assert on_wall[shadow].mean() < 0.3
