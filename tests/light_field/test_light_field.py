"""Light fields of scenes with a known answer: the ray caster, refocusing, the cameras that encode them,
and depth from focus.
"""

import numpy as np
import pytest

from apps.studies.light_fields import compute_depth_accuracy
from tofclip.errors import TofclipError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import (
    FocalStack,
    LightField,
    compute_image_energy,
    compute_modified_laplacian,
    estimate_depth_from_focus,
    find_smooth_labels,
    make_focal_stack,
)
from tofclip.light_field.views import (
    CameraSetup,
    corrupt_measurement,
    measure,
)
from tofclip.metrics import nmse
from tofclip.simulate.bodies import Body, Box, Lambertian, Rectangle, Specular, Sphere
from tofclip.simulate.light_fields import (
    CameraArray,
    Scene,
    render_light_field,
    render_shear_map,
    render_view,
)
from tofclip.simulate.patterns import (
    make_mottled_pattern,
    make_plain_pattern,
    make_text_pattern,
)
from tofclip.simulate.scenes import SCENES, edit_scene, make_scene, remove_occluder

ARRAY = CameraArray((40, 48), 4, focal_length_px=60.0, view_step=0.05, samples=2)
HEAD_ON = (0.0, 0.0, -1.0)
PLAIN = make_plain_pattern(0.5)


def plate(shear, pattern, size=0.3):
    place = np.array([0.0, 0.0, ARRAY.depth(shear)])
    return Body(Rectangle(size, size), Lambertian(pattern), place)


def look(*bodies, lamp=HEAD_ON, array=ARRAY):
    return render_view(Scene(bodies, lamp), array, (0.0, 0.0))


@pytest.mark.parametrize("shear", [-2.0, 1.0])
def test_views_of_a_plate_are_shifted_by_whole_shears(shear):
    """p(x, y, u, v) = p_ref(x - s u, y - s v), to the sample where s is a whole number."""
    body = plate(shear, make_mottled_pattern(0.2, 0.9, 8, 0), 0.3137)
    found = render_light_field(Scene((body,)), ARRAY).light_field
    for picture, (v, u) in zip(found.pictures, found.views.astype(int), strict=True):
        moved = np.roll(found.pictures[10], (int(shear) * v, int(shear) * u), (0, 1))
        # a sample on a texel's border may fall to either side by rounding
        assert np.mean(np.abs(picture - moved) > 1e-5) < 0.01


NEAR, FAR = plate(-1.0, make_plain_pattern(0.8), 0.1), plate(0.5, make_plain_pattern(0.2), 3.0)


def test_the_shear_map_is_exact_and_the_nearer_body_hides_the_other_whatever_the_order():
    shears = render_shear_map(Scene((NEAR, FAR)), ARRAY)
    # the near plate is 0.1 * 60 / 0.75 = 8 px wide, about pixel 24 of row 20
    np.testing.assert_allclose(shears[17:23, 21:27], -1.0, atol=1e-6)
    np.testing.assert_allclose(shears[:15], 0.5, atol=1e-6)
    assert np.isinf(render_shear_map(Scene((NEAR,)), ARRAY)[0, 0])
    for picture in (look(NEAR, FAR), look(FAR, NEAR)):
        assert picture[20, 24] == pytest.approx(0.8)
        assert picture[5, 5] == pytest.approx(0.2)
    tilted = render_shear_map(Scene((plate(0.0, PLAIN, 0.4).tilt(0.5),)), ARRAY)
    assert tilted[20, 18] < tilted[20, 24] < tilted[20, 30]  # its right side is farther


def test_a_balls_nearest_point_and_a_boxs_front():
    for shape in (Sphere(0.2), Box(0.2, 0.2, 0.4)):
        body = Body(shape, Lambertian(PLAIN), np.array([0.0, 0.0, 1.0]))
        middle = render_shear_map(Scene((body,)), ARRAY)[20, 24]
        assert middle == pytest.approx(float(ARRAY.shear(0.8)), abs=1e-5)
        normal = body.intersect(np.zeros(3), np.array([[0.0, 0.0, 1.0]])).normal[0]
        np.testing.assert_allclose(normal, [0, 0, -1], atol=1e-12)


def test_a_matt_ball_is_bright_towards_the_lamp():
    """At the point that faces the lamp, cos = 1; at the ball's rim towards it, less; ambient light
    is 0.4.
    """
    ball = Body(Sphere(0.2), Lambertian(make_plain_pattern(1.0)), np.array([0.0, 0.0, 1.0]))
    assert look(ball)[20, 24] == pytest.approx(1.0, abs=0.01)
    left = look(ball, lamp=(-1.0, 0.0, -1.0))
    assert left[20, 18] > left[20, 30] + 0.2


def test_only_a_glossy_ball_looks_different_from_other_sides():
    """The lobe moves over the ball with the viewer: in a matt ball's picture nothing does
    (supplement Note 1).
    """

    def change(material):
        body = Body(Sphere(0.2), material, np.array([0.0, 0.0, 1.2]))
        seen = []
        for origin in (np.zeros(3), np.array([0.3, 0, 0])):
            ray = np.array([[0.0, 0.0, 1.0]]) - origin
            hit = body.intersect(origin, ray)
            light = np.array(HEAD_ON)
            seen.append(material.radiance(hit.pattern_position, hit.normal, ray, light)[0])
        return abs(seen[1] - seen[0])

    assert change(Lambertian(PLAIN)) < 1e-6
    assert change(Specular(PLAIN, gloss=0.5, exponent=50.0)) > 0.2


def test_flipping_and_turning_a_body_flips_and_turns_its_picture():
    array = CameraArray((41, 41), 1, focal_length_px=60.0)
    pattern = Lambertian(make_text_pattern("L", 0.9, 0.1))
    body = Body(Rectangle(0.3, 0.3), pattern, np.array([0.0, 0.0, 1.0]))
    upright, flipped, turned, shifted = (
        look(one, array=array)
        for one in (body, body.flip(), body.rotate(np.pi / 2), body.shift(2 / 60, 0))
    )
    assert upright[20, 14] > upright[20, 26]  # the stem stands on the left
    assert upright[27, 24] > upright[13, 24]  # the foot lies below
    np.testing.assert_allclose(flipped, upright[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(turned, np.rot90(upright, -1), atol=1e-6)
    np.testing.assert_allclose(shifted[:, 2:], upright[:, :-2], atol=1e-6)


def test_only_foreground_is_edited_and_occluders_can_be_taken_away():
    scene = make_scene("word-behind-bars", ARRAY)
    for edit in ("shift", "flip", "rotate"):
        changed = edit_scene(scene, edit)
        assert changed.bodies[0] is scene.bodies[0]
        assert changed.bodies[1] is not scene.bodies[1]
    bare = remove_occluder(scene)
    assert len(bare.bodies) == 2
    covered, open_ = (render_view(one, ARRAY, (0.0, 0.0)).sum() for one in (scene, bare))
    assert covered < open_


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_covers_the_picture(name):
    array = CameraArray((32, 32), 2, focal_length_px=40.0, view_step=0.05, samples=1)
    found = render_light_field(make_scene(name, array), array)
    assert np.isfinite(found.shears).all()
    assert 0 <= found.light_field.pictures.min() < found.light_field.pictures.max() < 2


VIEWS = np.stack(np.meshgrid([-1.0, 0, 1], [-1.0, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
SHEAR, SHAPE = -2.0, (31, 34)
CARD = np.zeros(SHAPE, np.float32)
CARD[10:18, 9:13] = 1
CARD[14:18, 13:25] = 0.6
# Rolled by whole pixels: no interpolation is shared with what is tested.
MOVED = [np.roll(CARD, (int(SHEAR * v), int(SHEAR * u)), (0, 1)) for v, u in VIEWS]
LIGHT_FIELD = LightField(np.stack(MOVED), VIEWS)


def encode(encoder="line", ratio=1.0, seed=0):
    return measure(LIGHT_FIELD, CameraSetup(encoder, ratio, seed))


def test_refocusing_at_the_cards_depth_makes_it_sharp():
    np.testing.assert_allclose(LIGHT_FIELD.refocus(SHEAR), CARD, atol=1e-6)
    assert nmse(LIGHT_FIELD.refocus(0.0), CARD) > 0.1
    # another reference sees the card where that view does
    elsewhere = LIGHT_FIELD.refocus(SHEAR, (1.0, -1.0))
    np.testing.assert_allclose(elsewhere, LIGHT_FIELD.pictures[6], atol=1e-6)


def test_the_older_name_of_even_angles_is_still_read():
    assert CameraSetup("line-spread", 0.5, 0) == CameraSetup("line-even", 0.5, 0)


def test_bad_readings_and_photons_are_as_many_as_asked():
    made = encode()
    changed = corrupt_measurement(made, None, 0.1).values != made.values
    assert 0 < changed.sum() <= round(0.1 * made.values.size)
    noisy = corrupt_measurement(made, 1000, 0.0).values
    # Poisson noise of the mean reading f: variance f * largest / photons; the bound is loose by a
    # factor of 1.3.
    expected = np.sqrt(made.values.mean() * made.values.max() / 1000)
    assert expected / 1.3 < np.std(noisy - made.values) < 1.3 * expected


SHEARS = np.arange(-1.4, 1.01, 0.2)
FINE = CameraArray((64, 64), 8, focal_length_px=80.0, view_step=0.025)


@pytest.mark.parametrize("name", ["render_letters", "render_planes"])
def test_textured_pixels_get_the_right_plane(shared_data, name):
    """95 % is what was asked for; 98 and 100 % were measured."""
    path = shared_data / "lightfields" / f"{name}.npz"
    light_field, shears = read_light_field(path), np.load(path)["shear"]
    labels = estimate_depth_from_focus(make_focal_stack(light_field, SHEARS))
    assert compute_depth_accuracy(SHEARS[labels], shears, light_field.pictures[36], 0.2) >= 0.95


@pytest.mark.parametrize("measure", [compute_image_energy, compute_modified_laplacian])
def test_depth_survives_noise_and_focus_is_better_everywhere_than_at_one_depth(measure):
    rendered = render_light_field(make_scene("letters", FINE), FINE)
    truth = rendered.light_field.pictures[36]
    stack = make_focal_stack(rendered.light_field, SHEARS)
    noise = 0.01 * np.random.default_rng(0).standard_normal(stack.pictures.shape)
    labels = estimate_depth_from_focus(FocalStack(stack.pictures + noise, stack.shears), measure)
    assert compute_depth_accuracy(SHEARS[labels], rendered.shears, truth, 0.2) >= 0.9
    best = min(nmse(picture, truth, 6) for picture in stack.pictures)
    assert nmse(stack.all_in_focus(labels), truth, 6) < 0.5 * best


def test_a_fractional_viewpoint_is_what_a_camera_there_sees():
    """Within the views' range; 6 % was measured, and 35 % for the reference view taken for it."""
    scene, viewpoint = make_scene("letters", FINE), (-1.5, 2.5)
    light_field = render_light_field(scene, FINE).light_field
    truth = render_view(scene, FINE, viewpoint)
    stack = make_focal_stack(light_field, SHEARS, viewpoint)
    seen = stack.all_in_focus(estimate_depth_from_focus(stack))
    assert nmse(seen, truth, 6) < 0.1
    assert nmse(light_field.pictures[36], truth, 6) > 0.1


def test_focus_measures_know_a_ramp_an_edge_and_their_shapes():
    ramp = np.tile(np.arange(8.0), (3, 7, 1))
    np.testing.assert_array_equal(compute_modified_laplacian(ramp)[:, :, 1:-1], 0)
    np.testing.assert_array_equal(compute_image_energy(ramp), 1)
    point = np.zeros((5, 5))
    point[2, 2] = 1
    assert compute_modified_laplacian(point)[2, 2] == 4


TWO = np.array([0.0, 1.0])


@pytest.mark.parametrize(
    "fault",
    [
        lambda: make_scene("nothing", ARRAY),
        lambda: edit_scene(make_scene("letters", ARRAY), "melt"),
        lambda: Scene(()),
        lambda: Scene((plate(0.0, PLAIN),), (0.0, 0.0, 0.0)),
        lambda: Lambertian(make_plain_pattern(1.5)),
        lambda: Lambertian(np.zeros(4)),
        lambda: CameraArray(view_step=0.0),
        lambda: ARRAY.depth(3.0),
        lambda: make_text_pattern("A\n ", 0.5),
        lambda: make_mottled_pattern(0.1, 0.9, 0, 0),
        lambda: LightField(np.zeros((9, 4, 4)), VIEWS),
        lambda: LightField(np.full((9, 4, 4), np.nan), VIEWS),
        lambda: LightField(np.eye(9)[:, :, None], VIEWS[:4]),
        lambda: CameraSetup("nothing", 0.5, 0).camera(SHAPE, VIEWS),
        lambda: corrupt_measurement(encode(), None, 1.5),
        lambda: corrupt_measurement(encode(), -1.0, 0.0),
        lambda: FocalStack(np.zeros((3, 4, 4)), TWO),
        lambda: FocalStack(np.zeros((2, 4, 4)), TWO[::-1]),
        lambda: FocalStack(np.full((2, 4, 4), np.nan), TWO),
        lambda: FocalStack(np.zeros((2, 4, 4)), TWO).all_in_focus(np.zeros((3, 4), int)),
        lambda: find_smooth_labels(np.zeros((4, 4)), 1.0),
        lambda: find_smooth_labels(np.zeros((2, 4, 4)), -1.0),
        lambda: estimate_depth_from_focus(FocalStack(np.ones((2, 20, 20)), TWO)),  # no texture
    ],
)
def test_what_makes_no_sense_is_refused(fault):
    with pytest.raises(TofclipError):
        fault()
