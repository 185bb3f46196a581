"""The ray caster against geometry that is known without it."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.simulate.bodies import Body, Box, Lambertian, Rectangle, Specular, Sphere
from tofclip.simulate.light_fields import (
    CameraArray,
    Scene,
    render_light_field,
    render_shear_map,
    render_view,
)
from tofclip.simulate.patterns import (
    cut_pattern,
    make_checkerboard,
    make_letter,
    make_mottled_pattern,
    make_plain_pattern,
    make_text_pattern,
)
from tofclip.simulate.scenes import SCENES, edit_scene, make_scene, remove_occluder

ARRAY = CameraArray((40, 48), 4, focal_length_px=60.0, view_step=0.05, samples=2)
HEAD_ON = (0.0, 0.0, -1.0)


def plate(shear: float, pattern: np.ndarray, size: float = 0.3, x: float = 0.0) -> Body:
    depth = ARRAY.depth(shear)
    return Body(Rectangle(size, size), Lambertian(pattern), np.array([x, 0.0, depth]))


@pytest.mark.parametrize("shear", [-2.0, 1.0])
def test_views_of_a_plate_are_shifted_by_whole_shears(shear):
    """p(x, y, u, v) = p_ref(x - s u, y - s v), to the sample where s is a whole number."""
    found = render_light_field(
        Scene((plate(shear, make_mottled_pattern(0.2, 0.9, 8, 0), 0.3137),)), ARRAY
    )
    reference = found.light_field.pictures[10]
    for picture, (v, u) in zip(
        found.light_field.pictures, found.light_field.views.astype(int), strict=True
    ):
        moved = np.roll(reference, (int(shear) * v, int(shear) * u), (0, 1))
        # a sample on a texel's border may fall to either side by rounding
        assert np.mean(np.abs(picture - moved) > 1e-5) < 0.01


def test_the_shear_map_is_exact():
    near, far = plate(-1.0, make_plain_pattern(0.8), 0.1), plate(0.5, make_plain_pattern(0.2), 3.0)
    shears = render_shear_map(Scene((near, far)), ARRAY)
    # the near plate is 0.1 * 60 / 0.75 = 8 px wide, about pixel 24 of row 20
    np.testing.assert_allclose(shears[17:23, 21:27], -1.0, atol=1e-6)
    np.testing.assert_allclose(shears[:15], 0.5, atol=1e-6)
    assert np.isinf(render_shear_map(Scene((near,)), ARRAY)[0, 0])


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_body_hides_the_other_whatever_the_order(order):
    bodies = (plate(-1.0, make_plain_pattern(0.8), 0.1), plate(0.5, make_plain_pattern(0.2), 3.0))[
        ::order
    ]
    picture = render_view(Scene(bodies, HEAD_ON), ARRAY, (0.0, 0.0))
    assert picture[20, 24] == pytest.approx(0.8)
    assert picture[5, 5] == pytest.approx(0.2)


def test_letters_cut_out_let_the_ground_be_seen():
    front = plate(-1.0, cut_pattern(make_letter("L"), make_plain_pattern(0.9)), 0.3)
    picture = render_view(
        Scene((front, plate(0.5, make_plain_pattern(0.1), 4.0)), HEAD_ON), ARRAY, (0.0, 0.0)
    )
    assert picture[12, 17] == pytest.approx(0.9)  # the stem
    assert picture[12, 31] == pytest.approx(0.1)  # right of it
    assert ((picture > 0.15) & (picture < 0.85)).any()  # anti-aliased borders


def test_a_balls_nearest_point_and_a_boxs_front():
    ball = Body(Sphere(0.2), Lambertian(make_plain_pattern(0.5)), np.array([0.0, 0.0, 1.0]))
    box = Body(Box(0.2, 0.2, 0.4), Lambertian(make_plain_pattern(0.5)), np.array([0.0, 0.0, 1.0]))
    for body in (ball, box):
        assert render_shear_map(Scene((body,)), ARRAY)[20, 24] == pytest.approx(
            float(ARRAY.shear(0.8)), abs=1e-5
        )
    normal = ball.intersect(np.zeros(3), np.array([[0.0, 0.0, 1.0]])).normal[0]
    np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)


def test_a_matt_ball_is_bright_towards_the_lamp():
    """At the point that faces the lamp, cos = 1; at the ball's rim towards it, less; ambient light
    is 0.4.
    """
    ball = Body(Sphere(0.2), Lambertian(make_plain_pattern(1.0)), np.array([0.0, 0.0, 1.0]))
    picture = render_view(Scene((ball,), HEAD_ON), ARRAY, (0.0, 0.0))
    assert picture[20, 24] == pytest.approx(1.0, abs=0.01)
    left = render_view(Scene((ball,), (-1.0, 0.0, -1.0)), ARRAY, (0.0, 0.0))
    assert left[20, 18] > left[20, 30] + 0.2


def test_only_a_glossy_ball_looks_different_from_other_sides():
    """The lobe moves over the ball with the viewer: in a matt ball's picture nothing does
    (supplement Note 1).
    """

    def change(material: Lambertian) -> float:
        body = Body(Sphere(0.2), material, np.array([0.0, 0.0, 1.2]))
        centre = np.array([0.0, 0.0, 1.0])
        directions = np.array([centre, centre - (0.3, 0, 0)])
        origins = (np.zeros(3), np.array([0.3, 0, 0]))
        light = np.array([0.0, 0.0, -1.0])
        seen = []
        for origin, direction in zip(origins, directions, strict=True):
            hit = body.intersect(origin, direction[np.newaxis])
            seen.append(
                material.radiance(hit.pattern_position, hit.normal, direction[np.newaxis], light)[0]
            )
        return abs(seen[1] - seen[0])

    assert change(Lambertian(make_plain_pattern(0.5))) < 1e-6
    assert change(Specular(make_plain_pattern(0.5), gloss=0.5, exponent=50.0)) > 0.2


def test_flipping_and_turning_a_body_flips_and_turns_its_picture():
    array = CameraArray((41, 41), 1, focal_length_px=60.0)
    body = Body(
        Rectangle(0.3, 0.3), Lambertian(make_text_pattern("L", 0.9, 0.1)), np.array([0.0, 0.0, 1.0])
    )

    def seen(body: Body) -> np.ndarray:
        return render_view(Scene((body,), HEAD_ON), array, (0.0, 0.0))

    upright = seen(body)
    assert upright[20, 14] > upright[20, 26]  # the stem stands on the left
    assert upright[27, 24] > upright[13, 24]  # the foot lies below
    np.testing.assert_allclose(seen(body.flip()), upright[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(seen(body.rotate(np.pi / 2)), np.rot90(upright, -1), atol=1e-6)
    np.testing.assert_allclose(seen(body.shift(2 / 60, 0))[:, 2:], upright[:, :-2], atol=1e-6)


def test_a_tilted_plates_right_side_is_farther():
    shears = render_shear_map(Scene((plate(0.0, make_plain_pattern(0.5), 0.4).tilt(0.5),)), ARRAY)
    assert shears[20, 18] < shears[20, 24] < shears[20, 30]


def test_only_foreground_is_edited_and_occluders_can_be_taken_away():
    scene = make_scene("word-behind-bars", ARRAY)
    for edit in ("shift", "flip", "rotate"):
        changed = edit_scene(scene, edit)
        assert changed.bodies[0] is scene.bodies[0]
        assert changed.bodies[1] is not scene.bodies[1]
    bare = remove_occluder(scene)
    assert len(bare.bodies) == 2
    light = (render_view(some, ARRAY, (0.0, 0.0)).sum() for some in (scene, bare))
    assert next(light) < next(light)


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_covers_the_picture(name):
    array = CameraArray((32, 32), 2, focal_length_px=40.0, view_step=0.05, samples=1)
    found = render_light_field(make_scene(name, array), array)
    assert np.isfinite(found.shears).all()
    assert found.light_field.pictures.min() >= 0
    assert found.light_field.pictures.max() < 2


@pytest.mark.parametrize(
    "fault",
    [
        lambda: make_scene("nothing", ARRAY),
        lambda: edit_scene(make_scene("letters", ARRAY), "melt"),
        lambda: Scene(()),
        lambda: Scene((plate(0.0, make_plain_pattern(0.5)),), (0.0, 0.0, 0.0)),
        lambda: Lambertian(make_plain_pattern(1.5)),
        lambda: Lambertian(np.zeros(4)),
        lambda: CameraArray(view_step=0.0),
        lambda: ARRAY.depth(3.0),
        lambda: make_text_pattern("A\n ", 0.5),
        lambda: make_mottled_pattern(0.1, 0.9, 0, 0),
    ],
)
def test_what_makes_no_sense_is_refused(fault):
    with pytest.raises(InputError):
        fault()


def test_the_pattern_of_a_board_is_not_mirrored():
    board = plate(0.0, make_checkerboard(2, 0.1, 0.9), 0.4)
    picture = render_view(Scene((board,), HEAD_ON), ARRAY, (0.0, 0.0))
    assert picture[14, 18] == pytest.approx(0.9)
    assert picture[14, 30] == pytest.approx(0.1)
