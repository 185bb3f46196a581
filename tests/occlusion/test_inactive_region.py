"""The formula of the inactive region against rays that are cast."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.occlusion import InactiveRegion
from tofclip.simulate.bodies import Body, Lambertian, Rectangle
from tofclip.simulate.patterns import make_plain_pattern

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
