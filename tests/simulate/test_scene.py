"""Rays that meet plates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.simulate import Scene, make_plate
from tofclip.simulate.bodies import Body
from tofclip.simulate.patterns import cut_pattern, make_letter, make_plain_pattern, make_rings
from tofclip.simulate.rays import NO_BODY, cast_rays, look_up_reflectance

ORIGIN = np.zeros(3)
AHEAD = np.array([[0.0, 0.0, 1.0]])


def wall(depth: float, side: float = 10.0, reflectance: float = 0.5, **turned: float) -> Body:
    return make_plate((0.0, 0.0, depth), (side, side), np.full((4, 4), reflectance), **turned)


@settings(max_examples=60, deadline=None)
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
    beside, above = np.array([[0.1, 0.0, 1.0]]), np.array([[0.0, -0.1, 1.0]])
    assert wall(2.0, yaw=0.3).intersect(ORIGIN, beside).distance[0] > 2.0
    assert wall(2.0, pitch=0.3).intersect(ORIGIN, above).distance[0] > 2.0


def test_the_pattern_is_upright_and_not_mirrored():
    pattern = np.array([[0.1, 0.2], [0.3, np.nan]])
    plate = make_plate((0, 0, 1), (0.2, 0.2), pattern)
    corners = np.array([[-0.05, -0.05, 1], [0.05, -0.05, 1], [-0.05, 0.05, 1], [0.05, 0.05, 1]])
    hits = cast_rays((plate,), ORIGIN, corners)
    reflectance = look_up_reflectance((plate,), hits)
    np.testing.assert_allclose(reflectance[:3], [0.1, 0.2, 0.3], rtol=1e-6)
    assert hits.distance.tolist() == [1.0, 1.0, 1.0, np.inf]


def test_the_nearest_plate_is_seen_through_the_holes_of_none():
    hole = make_plate((0, 0, 1), (1, 1), np.array([[np.nan, 0.9]]))
    scene = Scene((wall(3.0), hole, wall(2.0)))
    hits = scene.trace(ORIGIN, np.array([[0.1, 0, 1], [-0.1, 0, 1], [9.0, 0, 1]]))
    assert hits.body.tolist() == [1, 2, NO_BODY]
    np.testing.assert_allclose(hits.path[:2], np.hypot(1, 0.1) * np.array([1, 2]))
    assert hits.reflectance[2] == 0


def test_what_is_behind_the_camera_is_not_seen():
    assert Scene((wall(-1.0),)).trace(ORIGIN, AHEAD).body.tolist() == [NO_BODY]


def test_path_is_half_of_there_and_back_from_different_places():
    viewpoint = np.array([3.0, 0.0, 0.0])
    # hits (0, 0, 4): 4 m from the lamp
    hits = Scene((wall(4.0),)).trace(viewpoint, np.array([[-0.75, 0.0, 1.0]]))
    assert hits.path[0] == pytest.approx((4.0 + 5.0) / 2)
    assert hits.distance[0] == pytest.approx(4.0)


def test_a_slanted_surface_is_lit_by_the_cosine():
    hits = Scene((wall(2.0, yaw=np.pi / 3),)).trace(ORIGIN, AHEAD)
    assert hits.reflectance[0] == pytest.approx(0.5 * np.cos(np.pi / 3))


def test_a_plate_casts_a_shadow_that_a_distant_lamp_moves_aside():
    card = make_plate((0, 0, 1.0), (0.1, 0.1), make_plain_pattern(0.9))
    # points on the wall, as directions from the origin
    behind = np.array([[0.2, 0.0, 2.0], [0.0, 0.0, 2.0]])
    beside = Scene((card, wall(2.0)), lamp=(-0.2, 0.0, 0.0)).trace(ORIGIN, behind)
    assert beside.body.tolist() == [1, 0]
    assert beside.reflectance[0] == 0  # the way to (0.2, 0, 2) passes the card's middle
    colocated = Scene((card, wall(2.0))).trace(ORIGIN, behind)
    assert np.all(colocated.reflectance > 0)


def test_letters_have_their_shape():
    def at(name: str, x: float, y: float) -> bool:
        pattern = cut_pattern(make_letter(name), make_plain_pattern(0.8))
        return bool(np.isfinite(pattern[int(y * pattern.shape[0]), int(x * pattern.shape[1])]))

    # where each letter is, and where it is not
    for name, inside, outside in (
        ("U", [(0.1, 0.1), (0.9, 0.1), (0.5, 0.95)], [(0.5, 0.1)]),
        ("C", [(0.1, 0.5), (0.5, 0.1)], [(0.9, 0.5), (0.5, 0.5)]),
        ("L", [(0.2, 0.1), (0.9, 0.9)], [(0.9, 0.1)]),
        ("A", [(0.5, 0.1), (0.5, 0.7)], [(0.5, 0.4), (0.5, 0.95)]),
    ):
        assert all(at(name, *point) for point in inside)
        assert not any(at(name, *point) for point in outside)


def test_a_disc_of_rings_is_round():
    pattern = make_rings(3, 0.2, 0.8)
    assert np.mean(np.isfinite(pattern)) == pytest.approx(np.pi / 4, abs=0.02)
    limits = np.nanmin(pattern), np.nanmax(pattern)
    np.testing.assert_allclose(limits, (0.2, 0.8), atol=0.01)


@pytest.mark.parametrize(
    ("centre", "size", "pattern", "problem"),
    [
        ((0, 0, 1), (1, 1), np.zeros(3), "reflectance"),
        ((0, 0, 1), (1, 1), np.full((2, 2), 1.5), r"within 0\.\.1"),
        ((0, 0, 1), (1, 1), np.full((2, 2), np.nan), r"within 0\.\.1"),
        ((0, 0, 1), (0, 1), make_plain_pattern(0.5), "positive size"),
        ((0, 0, np.inf), (1, 1), make_plain_pattern(0.5), "finite position"),
    ],
)
def test_unusable_plates_are_refused(centre, size, pattern, problem):
    with pytest.raises(InputError, match=problem):
        make_plate(centre, size, pattern)


def test_unusable_scenes_are_refused():
    with pytest.raises(InputError, match="at least one body"):
        Scene(())
    with pytest.raises(InputError, match="no outline is known for 'Q'"):
        make_letter("Q")
