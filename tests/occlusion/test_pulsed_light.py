"""The inactive region, and time of flight and shadows of cast rays, against geometry that is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError, ShapeError
from tofclip.occlusion import InactiveRegion
from tofclip.simulate.bodies import Body, Lambertian, Rectangle
from tofclip.simulate.light_fields import (
    CameraArray,
    PulsedScene,
    TimeAxis,
    render_flash,
    render_flash_view,
)
from tofclip.simulate.patterns import make_plain_pattern
from tofclip.simulate.rays import cast_rays, compute_irradiance
from tofclip.units import SPEED_OF_LIGHT

MILLIMETRE = 1e-3


@pytest.mark.parametrize(
    ("width", "distance", "length"),
    [(6, 50, 33.3), (10, 40, 80.0)],  # supplement Note 10
)
def test_the_papers_examples(width, distance, length):
    found = InactiveRegion(15 * MILLIMETRE, width * MILLIMETRE, distance * MILLIMETRE)
    assert found.length == pytest.approx(length * MILLIMETRE, rel=2e-3)
    assert found.is_bounded


@given(
    baseline=st.floats(5, 30),
    share=st.floats(0.05, 1.6),
    distance=st.floats(20, 80),
    across=st.floats(-20, 20),
    behind=st.floats(0.5, 300),
)
@settings(max_examples=200, deadline=None)
def test_a_point_is_inside_exactly_if_cast_rays_reach_it_from_no_view(
    baseline, share, distance, across, behind
):
    region = InactiveRegion(baseline, share * baseline, distance)
    plate = Body(
        Rectangle(region.width, 100.0),
        Lambertian(make_plain_pattern(0.5)),
        np.array([0.0, 0.0, distance]),
    )
    point = np.array([across, 0.0, distance + behind])
    places = np.linspace(-0.5, 0.5, 7) * baseline
    passed = (across * distance + places * behind) / (distance + behind)
    if np.any(abs(abs(passed) - region.width / 2) < 1e-9):
        return  # a ray along the very edge may go either way
    origins = [np.array([place, 0.0, 0.0]) for place in places]
    reached = [
        bool(np.isinf(plate.intersect(origin, (point - origin)[np.newaxis]).distance[0]))
        for origin in origins
    ]
    np.testing.assert_array_equal(region.sees(places, across, behind), reached)
    assert bool(region.contains(across, behind)) is not any(reached)


@given(share=st.floats(0.05, 0.95), distance=st.floats(20, 80), place=st.floats(0.01, 3))
def test_on_the_axis_the_region_ends_at_its_length(share, distance, place):
    region = InactiveRegion(15.0, 15.0 * share, distance)
    assert bool(region.contains(0.0, place * region.length)) == (place < 1) or math.isclose(
        place, 1, rel_tol=1e-9
    )


@pytest.mark.parametrize("width", [15.0, 20.0])
def test_behind_a_wide_occluder_nothing_is_promised(width):
    region = InactiveRegion(15.0, width, 50.0)
    assert (region.is_bounded, region.length) == (False, math.inf)
    assert region.contains(0.0, 1e6)


@pytest.mark.parametrize("lengths", [(0.0, 6.0, 50.0), (15.0, -1.0, 50.0), (15.0, 6.0, math.nan)])
def test_lengths_must_be_positive(lengths):
    with pytest.raises(InputError, match="positive length"):
        InactiveRegion(*lengths)


ARRAY = CameraArray(
    (21, 21), 3, focal_length_px=60.0, view_step=5e-3, focus=0.1, samples=1, view_rows=1
)
AT_HOME = np.zeros((1, 3))
CLOCK = TimeAxis.for_ranges(0.02, 0.2, 20e-12, 60e-12)


def plate(side: float, z: float, x: float = 0.0) -> Body:
    return Body(Rectangle(side, side), Lambertian(make_plain_pattern(0.5)), np.array([x, 0.0, z]))


def test_a_row_of_cameras_has_views_to_both_sides():
    np.testing.assert_array_equal(ARRAY.views, [[0, -1], [0, 0], [0, 1]])
    np.testing.assert_allclose(ARRAY.position((0.0, 1.0)), [5e-3, 0, 0])


@pytest.mark.parametrize("z", [0.06, 0.15])
def test_light_from_a_plate_arrives_after_the_way_there_and_back_and_fades_with_distance(z):
    seen = render_flash_view(PulsedScene((plate(0.4, z),), AT_HOME), ARRAY, CLOCK, (0.0, 0.0))
    middle = seen[10, 10]
    # half the field is 1/6 of the distance: its corners lie 2.7 % further, and half a bin at most
    # cut off
    assert middle @ CLOCK.times / middle.sum() == pytest.approx(2 * z / SPEED_OF_LIGHT, abs=1e-13)
    assert middle.sum() == pytest.approx(0.5 * (ARRAY.focus / z) ** 2, rel=1e-5)
    corner = seen[0, 0]
    far = z * np.sqrt(1 + 2 / 36)
    assert corner @ CLOCK.times / corner.sum() == pytest.approx(2 * far / SPEED_OF_LIGHT, abs=1e-13)
    assert corner.sum() == pytest.approx(0.5 * ARRAY.focus**2 * z / far**3, rel=1e-5)


def test_a_lamp_to_the_side_throws_the_shadow_to_the_other_side():
    lamp = np.array([[-0.05, 0.0, 0.0]])
    seen = render_flash_view(
        PulsedScene((plate(0.01, 0.05), plate(0.4, 0.1)), lamp), ARRAY, CLOCK, (0.0, 0.0)
    )
    total = seen[10].sum(axis=-1)
    # the plate's edges at -5 and 5 mm throw shadows to 40 and 60 mm; a pixel of the wall is 1/600 m
    # wide
    wall = (np.arange(21) - 10) * 0.1 / 60
    assert not total[(wall > 0.041) & (wall < 0.059)].any()
    assert (total[wall < -0.011] > 0).all()


def test_a_lamp_beside_the_only_view_shows_it_no_shadow():
    bodies = (plate(0.01, 0.05), plate(0.4, 0.1))
    assert (
        render_flash_view(PulsedScene(bodies, AT_HOME), ARRAY, CLOCK, (0.0, 0.0)).sum(axis=-1).min()
        > 0
    )


@given(
    width=st.floats(1, 14),
    distance=st.floats(30, 60),
    factor=st.floats(0.3, 4),
    across=st.floats(-0.4, 0.4),
)
@settings(max_examples=40, deadline=None)
def test_lamps_at_the_views_light_a_point_as_often_as_views_see_it(width, distance, factor, across):
    """With a lamp at each view, light gets there and back by the same lines of sight, or not at
    all.
    """
    region = InactiveRegion(15e-3, width * 1e-3, distance * 1e-3)
    behind, x = factor * region.length, across * region.width
    lamps = np.stack([2.5e-3 * np.arange(-3, 4), np.zeros(7), np.zeros(7)], axis=-1)
    passed = (x * region.distance + lamps[:, 0] * behind) / (region.distance + behind)
    if np.any(abs(abs(passed) - region.width / 2) < 1e-7):
        return  # along the very edge
    speck = Body(
        Rectangle(1e-7, 1e-7),
        Lambertian(make_plain_pattern(1.0)),
        np.array([x, 0.0, region.distance + behind]),
    )
    bar = Body(
        Rectangle(region.width, 1.0),
        Lambertian(make_plain_pattern(0.5)),
        np.array([0.0, 0.0, region.distance]),
    )
    sights = [cast_rays((speck, bar), lamp, (speck.centre - lamp)[np.newaxis]) for lamp in lamps]
    facing, point = np.array([[0.0, 0.0, -1.0]]), speck.centre[np.newaxis]
    lit = [compute_irradiance((speck, bar), lamp, point, facing)[0] > 0 for lamp in lamps]
    views = region.sees(lamps[:, 0], x, behind)
    np.testing.assert_array_equal([sight.body[0] == 0 for sight in sights], views)
    np.testing.assert_array_equal(lit, views)
    assert region.contains(x, behind) == (not views.any())


def test_every_view_is_rendered_on_its_own():
    scene = PulsedScene((plate(0.01, 0.05), plate(0.4, 0.1)), AT_HOME)
    all_views = render_flash(scene, ARRAY, CLOCK)
    assert all_views.shape == (3, 21, 21, CLOCK.bins)
    np.testing.assert_array_equal(all_views[2], render_flash_view(scene, ARRAY, CLOCK, (0.0, 1.0)))


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (lambda: PulsedScene((), AT_HOME), InputError),
        (lambda: PulsedScene((plate(0.1, 0.1),), np.zeros(3)), ShapeError),
        (lambda: TimeAxis(0.0, 0.0, 5, 1e-12), InputError),
        (lambda: TimeAxis(np.nan, 1e-12, 5, 1e-12), InputError),
        (lambda: CameraArray(view_rows=0), InputError),
    ],
)
def test_nonsense_is_refused(fault, kind):
    with pytest.raises(kind):
        fault()
