"""Colours, scales, filters and picks on clouds whose values are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from viewer_scenes import plane

from apps.viewer.look import (
    PALETTE_SIZE,
    PALETTES,
    QUANTITIES,
    Colouring,
    Scale,
    choose_ticks,
    colour_points,
    find_full_light,
    find_point_on_ray,
    format_length,
    load_palette,
    make_pick,
    make_scale,
)
from apps.viewer.panels import mark_times
from apps.viewer.session import Filters
from apps.viewer.source import make_cloud
from apps.viewer.viewpoint import (
    SCALE_BAR_DEPTH,
    SCALE_BAR_FRACTION,
    Box,
    place_viewpoint,
    round_length_down,
)
from tofclip.errors import InputError
from tofclip.lidar import PointCloud


def column(ranges: list[float]) -> PointCloud:
    """Points along the z axis at these ranges."""
    return make_cloud(np.column_stack([np.zeros((len(ranges), 2)), ranges]))


def test_limits_get_the_outermost_colours_and_the_middle_the_middle_one() -> None:
    cloud = column([0.5, 1.0, 2.0, 3.0, 9.0])
    scale = make_scale(cloud, Colouring("range", "grey", (1.0, 3.0), equalised=False))
    assert scale.limits == (1.0, 3.0)
    assert colour_points(cloud, scale)[:, 0].tolist() == [0, 0, 128, 255, 255]


def test_an_equalised_scale_gives_every_colour_equally_many_points() -> None:
    random = np.random.default_rng(1)
    cloud = column(np.exp(random.normal(size=20_000)).tolist())
    scale = make_scale(cloud, Colouring("range", "grey", equalised=True))
    inside = (cloud.range >= scale.limits[0]) & (cloud.range <= scale.limits[1])
    share = np.histogram(colour_points(cloud, scale)[inside, 0], 8, (0, 256))[0] / inside.sum()
    assert np.allclose(
        share, 1 / 8, atol=0.01
    )  # 20 000 points in 255 steps: 1/255 at either edge, and rounding
    assert np.all(np.diff(scale.values) >= 0)


def test_height_counts_upwards_and_time_is_in_nanoseconds() -> None:
    cloud = make_cloud(np.array([[0.0, -0.3, 1.0]]))
    assert QUANTITIES["height"].extract(cloud) == pytest.approx([0.3])
    # There and back at the speed of light: 6.67 ns for each metre.
    assert QUANTITIES["time"].extract(cloud) == pytest.approx(
        [6.671 * np.hypot(0.3, 1.0)], rel=1e-3
    )


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("equalised", [False, True])
def test_clouds_of_one_value_or_none_have_colours_too(quantity: str, equalised: bool) -> None:
    for cloud in (make_cloud(np.empty((0, 3))), column([2.0, 2.0])):
        scale = make_scale(cloud, Colouring(quantity, equalised=equalised))
        assert scale.limits[0] < scale.limits[1]
        assert colour_points(cloud, scale, find_full_light(cloud)).shape == (len(cloud), 3)


def test_palettes_grow_lighter_evenly() -> None:
    """Perceptually uniform ones rise in lightness; turbo and the two ends of others need not."""
    for name in set(PALETTES) - {"turbo"}:
        light = load_palette(name) @ np.array([0.2126, 0.7152, 0.0722])
        assert np.all(np.diff(light[::16]) > 0), name


def test_dim_points_are_darker_where_asked_for() -> None:
    cloud = make_cloud(np.ones((100, 3)), {"intensity": np.linspace(0, 99, 100)})
    scale = make_scale(cloud, Colouring("range", "grey", (0.0, 1.0), equalised=False))
    shaded = colour_points(cloud, scale, find_full_light(cloud))[:, 0]
    assert np.all(np.diff(shaded.astype(int)) >= 0)
    assert (shaded[0], shaded[-1]) == (38, 255)  # 15 % of the light stays
    assert colour_points(cloud, scale).min() == 255


@pytest.mark.parametrize(
    "wrong",
    [{"quantity": "weight"}, {"palette": "jet"}, {"limits": (2.0, 1.0)}, {"limits": (0.0, np.nan)}],
)
def test_wrong_colourings(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        Colouring(**wrong)  # type: ignore[arg-type]


def test_filters_keep_what_lies_within_all_limits() -> None:
    cloud = make_cloud(
        np.array([[0.0, 0, 1], [0, 0, 2], [1, 0, 2], [0, 0, 3]]),
        {"intensity": np.array([1, 2, 3, 4])},
    )
    assert Filters().select(cloud).all()
    assert Filters(range=(1.5, 2.1)).select(cloud).tolist() == [False, True, False, False]
    assert Filters(intensity=(2, 3)).select(cloud).tolist() == [False, True, True, False]
    assert Filters(z=(2, 3), x=(-0.5, 0.5)).select(cloud).tolist() == [False, True, False, True]
    assert Filters(time=(0, 7e-9)).select(cloud).tolist() == [True, False, False, False]
    with pytest.raises(InputError, match="limits of y"):
        Filters(y=(1, 0))


@given(st.integers(0, 399), st.tuples(*[st.floats(-3, 3)] * 2), st.floats(-3, 1))
def test_a_ray_at_a_point_finds_it(number: int, aside: tuple[float, float], back: float) -> None:
    cloud = plane(400)
    eye = np.array([*aside, back])
    found = find_point_on_ray(cloud.xyz, eye, cloud.xyz[number] - eye)
    assert found is not None
    seen = cloud.xyz[found] - eye
    aimed = cloud.xyz[number] - eye
    # Another point may lie within the reach of a click and nearer; it is never further off than
    # that.
    angle = np.linalg.norm(np.cross(seen, aimed)) / (np.linalg.norm(seen) * np.linalg.norm(aimed))
    assert angle < 0.0041


def test_the_point_in_front_is_meant_and_a_miss_means_none() -> None:
    cloud = column([2.0, 1.0, 3.0])
    assert find_point_on_ray(cloud.xyz, (0, 0, 0), (0, 0, 5)) == 1
    assert find_point_on_ray(cloud.xyz, (0, 0, 1.5), (0, 0, 1)) == 0
    assert find_point_on_ray(cloud.xyz, (0, 0, 4), (0, 0, 1)) is None  # all are behind the eye
    assert find_point_on_ray(cloud.xyz, (0, 0, 0), (0.2, 0, 1)) is None
    assert find_point_on_ray(make_cloud(np.empty((0, 3))).xyz, (0, 0, 0), (0, 0, 1)) is None


def test_what_is_known_about_a_pick() -> None:
    cloud = make_cloud(
        np.array([[0.3, 0.4, 1.2], [0.0, 0, 0]]), {"range_sigma": np.array([0.002, 0.0])}
    )
    first, second = replace(make_pick(cloud, 0), pixel=(3, 4)), make_pick(cloud, 1)
    assert first.description.splitlines()[:2] == [
        "x 0.3000, y 0.4000, z 1.2000 m",
        "range 1.3000 m ± 2 mm",
    ]
    assert first.description.endswith("pixel row 3, column 4")
    assert "pixel" not in second.description


@pytest.mark.parametrize(
    ("limits", "unit", "labels", "title"),
    [
        ((1.5889, 1.6848), "m", ["1.60", "1.62", "1.64", "1.66", "1.68"], "x (m)"),
        ((0.0, 0.00042), "m", ["0.0", "0.1", "0.2", "0.3", "0.4"], "x (mm)"),
        ((-1.0, 1.0), "", ["-1.0", "-0.5", "0.0", "0.5", "1.0"], "x"),
        ((0.0, 61234.0), "counts", ["0", "2.0e4", "4.0e4", "6.0e4"], "x (counts)"),
    ],
)
def test_ticks_are_round_numbers_in_a_suitable_unit(
    limits: tuple[float, float], unit: str, labels: list[str], title: str
) -> None:
    scale = Scale("x", unit, "grey", np.linspace(*limits, PALETTE_SIZE))
    ticks, words = choose_ticks(scale)
    assert ([label for _, label in ticks], words) == (labels, title)
    # Each lies where the colours have its value.
    factor = 1e-3 if "mm" in title else 1.0
    expected = [factor * float(label) for label in labels]
    low, high = limits
    assert [low + place * (high - low) for place, _ in ticks] == pytest.approx(expected)


def test_lengths_in_the_unit_that_a_person_would_use() -> None:
    lengths = (3.86e-6, 0.00042, 0.0314, 1.853)
    assert list(map(format_length, lengths)) == ["3.86 um", "0.42 mm", "31.4 mm", "1.85 m"]


@pytest.mark.parametrize(("longest", "bar"), [(1.0, 1.0), (0.43, 0.2), (0.0199, 0.01), (7.0, 5.0)])
def test_a_scale_bar_is_one_two_or_five(longest: float, bar: float) -> None:
    assert round_length_down(longest) == pytest.approx(bar)
    box = Box(np.zeros(3), np.array([longest / SCALE_BAR_FRACTION, 1.0, 2.0]))
    ends = box.scale_bar
    assert np.diff(ends, axis=0)[0] == pytest.approx([bar, 0, 0])
    assert ends.mean(axis=0) == pytest.approx(
        [longest / SCALE_BAR_FRACTION / 2, 1.0, 2.0 * SCALE_BAR_DEPTH]
    )


def test_a_time_line_has_round_instants_at_their_frames() -> None:
    times = 10.02e-9 + 20e-12 * np.arange(96)
    assert mark_times(times) == ((24, "10.5 ns"), (49, "11 ns"), (74, "11.5 ns"))
    assert mark_times(times[:1]) == ((0, "10.02 ns"),)


@pytest.mark.parametrize("aspect", [0.6, 1.23])
def test_an_arm_that_sticks_out_is_in_the_first_picture(aspect: float) -> None:
    """Four points in a thousand lie beside a near square, outside of its box."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 60), np.linspace(-0.3, 0.3, 60))
    arm = np.stack([np.linspace(-0.5, -0.4, 14), np.full(14, 0.3), np.full(14, 0.9)], axis=1)
    square = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.9)], axis=1)
    xyz = np.concatenate([square, arm]).astype(np.float32)
    shape = 600, round(600 * aspect)
    row, column, _ = place_viewpoint(xyz, aspect).project(xyz, shape)
    assert 0 < row.min() < row.max() < shape[0]
    assert 0 < column.min() < column.max() < shape[1]


@pytest.mark.parametrize("aspect", [0.6, 0.9, 1.6])
def test_the_scale_bar_is_in_the_first_picture(aspect: float) -> None:
    """Also of a deep cloud whose wide part is far away, so that the bar's place is the lowest."""
    random = np.random.default_rng(0)
    far = random.uniform((-0.5, -0.5, 3.0), (0.5, 0.5, 3.01), (400, 3))
    near = random.uniform((-0.05, -0.05, 1.0), (0.05, 0.05, 1.01), (400, 3))
    xyz = np.concatenate([far, near]).astype(np.float32)
    shape = 600, round(600 * aspect)
    row, column, _ = place_viewpoint(xyz, aspect).project(Box.around(xyz).scale_bar, shape)
    assert 0 < row.min() < row.max() < 0.97 * shape[0]  # its length is written below
    assert 0 < column.min() < column.max() < shape[1]
