"""Which frame is due, which points are shown and in which colours, where they appear on a picture, and how
often they are drawn: all over values and times that the test sets.
"""

import asyncio
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from viewer_scenes import PlaneSource, column

from apps.viewer.look import (
    PALETTE_SIZE,
    QUANTITIES,
    Colouring,
    Scale,
    choose_ticks,
    colour_points,
    find_point_on_ray,
    format_length,
    list_quantities,
    make_scale,
    project_front,
)
from apps.viewer.panels import bind_user_input, mark_times
from apps.viewer.points import MIN_DRAWN_POINTS, DetailChooser
from apps.viewer.session import Filters, PlaybackClock, Section, Session
from apps.viewer.source import View, make_cloud
from apps.viewer.viewpoint import (
    MAX_FIELD_OF_VIEW_RAD,
    SCALE_BAR_DEPTH,
    SCALE_BAR_DROP,
    SCALE_BAR_FRACTION,
    Box,
    Viewpoint,
    place_viewpoint,
    round_length_down,
)
from tofclip.errors import InputError


def test_frames_follow_the_time_and_the_speed():
    clock = PlaybackClock(8.0, lambda: range(100), loop=False)
    clock.play()
    assert [clock.tick(now) for now in (5.0, 5.0625, 5.125, 6.0)] == [0, 0, 1, 8]
    clock.speed = 4.0
    assert clock.tick(7.0) == 40
    clock.pause()
    assert clock.tick(60.0) == 40
    clock.play()  # the pause does not count
    assert clock.tick(70.0) == 40
    assert (clock.tick(99.0), clock.playing) == (99, False)
    clock.play()
    assert clock.frame == 0


def test_a_loop_runs_through_the_frames_that_are_left_at_their_own_pace():
    """Of a live source the first ones are forgotten: frame 10 of 4 to 9 is 4, and so on."""
    clock = PlaybackClock(10.0, lambda: range(4, 10))
    clock.jump(4)
    clock.play()
    clock.tick(0.0)
    # In the middle of each frame's tenth of a second.
    due = [clock.tick(0.05 + number / 10) for number in range(15)]
    assert due == [4 + number % 6 for number in range(15)]


@given(st.floats(0, 1e3), st.integers(1, 50), st.lists(st.floats(0, 1e4), min_size=2, max_size=6))
def test_there_is_no_other_frame_than_those_that_exist(speed, count, times):
    clock = PlaybackClock(25.0, lambda: range(count), speed)
    clock.play()
    assert all(0 <= clock.tick(now) < count for now in sorted(times))


def test_a_number_that_was_typed_outlives_the_frame_that_is_being_shown():
    """viser calls coroutines at once, and functions from a thread of its own, later."""
    commands = []
    jumps = []
    told = []
    slider = SimpleNamespace(value=10, on_update=told.append)
    bind_user_input(slider, commands.append, jumps.append)
    asyncio.run(told[0](SimpleNamespace(client=object(), target=slider)))
    slider.value = 0  # the frame that the viewer was drawing, which its control then says
    asyncio.run(told[0](SimpleNamespace(client=None, target=slider)))
    for command in commands:
        command()
    assert jumps == [10]


def test_limits_get_the_outermost_colours_and_the_middle_the_middle_one():
    cloud = column([0.5, 1.0, 2.0, 3.0, 9.0])
    view = View(cloud)
    scale = make_scale(view, Colouring("range", "grey", (1.0, 3.0)))
    assert scale.limits == (1.0, 3.0)
    assert colour_points(view, scale)[:, 0].tolist() == [0, 0, 128, 255, 255]
    for limits in ((2.0, 1.0), (0.0, np.nan), (0.0, np.inf)):
        with pytest.raises(InputError, match="must rise"):
            Colouring(limits=limits)


def test_an_equalised_scale_gives_every_colour_equally_many_points():
    cloud = column(np.exp(np.random.default_rng(1).normal(size=20_000)).tolist())
    scale = make_scale(View(cloud), Colouring("range", "grey", equalised=True))
    inside = (cloud.range >= scale.limits[0]) & (cloud.range <= scale.limits[1])
    share = (
        np.histogram(colour_points(View(cloud), scale)[inside, 0], 8, (0, 256))[0] / inside.sum()
    )
    # 20 000 points in 255 steps: 1/255 at either edge, and rounding
    assert np.allclose(share, 1 / 8, atol=0.01)
    assert np.all(np.diff(scale.values) >= 0)


def test_height_counts_upwards_and_time_is_in_nanoseconds():
    view = View(make_cloud(np.array([[0.0, -0.3, 1.0]])))
    assert QUANTITIES["height"][1](view) == pytest.approx([0.3])
    # There and back at the speed of light: 6.67 ns for each metre.
    assert QUANTITIES["time"][1](view) == pytest.approx([6.671 * np.hypot(0.3, 1)], rel=1e-3)


@pytest.mark.parametrize("quantity", list_quantities(View(column([]))))
@pytest.mark.parametrize("equalised", [False, True])
def test_clouds_of_one_value_or_none_have_colours_too(quantity, equalised):
    for cloud in (column([]), column([2.0, 2.0])):
        scale = make_scale(View(cloud), Colouring(quantity, equalised=equalised))
        assert scale.limits[0] < scale.limits[1]
        assert colour_points(View(cloud), scale).shape == (len(cloud), 3)


def test_dim_points_are_darker_where_asked_for():
    view = View(make_cloud(np.ones((100, 3)), {"intensity": np.linspace(0, 99, 100)}))
    colouring = Colouring("range", "grey", (0.0, 1.0), shaded=True)
    shaded = colour_points(view, make_scale(view, colouring))[:, 0]
    assert np.all(np.diff(shaded.astype(int)) >= 0)
    assert (shaded[0], shaded[-1]) == (38, 255)  # 15 % of the light stays
    plain = make_scale(view, replace(colouring, shaded=False))
    assert colour_points(view, plain).min() == 255


def test_filters_keep_what_lies_within_all_limits():
    xyz = np.array([[0.0, 0, 1], [0, 0, 2], [1, 0, 2], [0, 0, 3]])
    cloud = make_cloud(xyz, {"intensity": np.array([1, 2, 3, 4])})
    for filters, kept in (
        (Filters(), [0, 1, 2, 3]),
        (Filters({"range": (1.5, 2.1)}), [1]),
        (Filters({"intensity": (2, 3)}), [1, 2]),
        (Filters({"z": (2, 3), "x": (-0.5, 0.5)}), [1, 3]),
        (Filters({"time": (0, 7)}), [0]),
        (Filters({"false alarm": (0, 0.1)}), [0, 1, 2, 3]),  # of nobody known
        (Filters(section=Section((0.6, 0.0, 0.8), 1.6, 0.02)), [1]),  # a plane aslant
    ):
        assert np.flatnonzero(filters.select(View(cloud))).tolist() == kept
    with pytest.raises(InputError, match="limits of y"):
        Filters({"y": (1, 0)})


def test_the_point_in_front_is_meant_and_a_miss_means_none():
    xyz = column([2.0, 1.0, 3.0]).xyz
    for origin, direction, hit in (
        ((0, 0, 0), (0, 0, 5), 1),
        ((0, 0, 1.5), (0, 0, 1), 0),
        ((0, 0, 4), (0, 0, 1), None),  # all are behind the eye
        ((0, 0, 0), (0.2, 0, 1), None),
    ):
        assert find_point_on_ray(xyz, origin, direction) == hit
    assert find_point_on_ray(xyz[:0], (0, 0, 0), (0, 0, 1)) is None


@pytest.mark.parametrize(
    ("limits", "unit", "labels", "title"),
    [
        ((1.5889, 1.6848), "m", ["1.60", "1.62", "1.64", "1.66", "1.68"], "x (m)"),
        ((0.0, 0.00042), "m", ["0.0", "0.1", "0.2", "0.3", "0.4"], "x (mm)"),
        ((-1.0, 1.0), "", ["-1.0", "-0.5", "0.0", "0.5", "1.0"], "x"),
        ((0.0, 61234.0), "counts", ["0", "2.0e4", "4.0e4", "6.0e4"], "x (counts)"),
    ],
)
def test_ticks_are_round_numbers_in_a_suitable_unit(limits, unit, labels, title):
    low, high = limits
    ticks, words = choose_ticks(Scale("x", unit, "grey", np.linspace(low, high, PALETTE_SIZE)))
    assert ([label for _, label in ticks], words) == (labels, title)
    # Each lies where the colours have its value.
    factor = 1e-3 if "mm" in title else 1.0
    expected = [factor * float(label) for label in labels]
    assert [low + place * (high - low) for place, _ in ticks] == pytest.approx(expected)


def test_lengths_and_instants_are_round_and_in_the_unit_that_a_person_would_use():
    lengths = (3.86e-6, 0.00042, 0.0314, 1.853)
    assert list(map(format_length, lengths)) == ["3.86 um", "0.42 mm", "31.4 mm", "1.85 m"]
    times = 10.02e-9 + 20e-12 * np.arange(96)
    assert mark_times(times) == ((25, "10.5 ns"), (50, "11 ns"), (75, "11.5 ns"))
    assert mark_times(times[:1]) == ((1, "10.02 ns"),)


@pytest.mark.parametrize(("longest", "bar"), [(1.0, 1.0), (0.43, 0.2), (0.0199, 0.01), (7.0, 5.0)])
def test_a_scale_bar_is_one_two_or_five(longest, bar):
    assert round_length_down(longest) == pytest.approx(bar)
    width = longest / SCALE_BAR_FRACTION
    box = Box(np.zeros(3), np.array([width, 1.0, width]))
    # it faces the viewer, in front and from the side
    for eye, along in (((0, 0, -9), 0), ((9, 0, 0), 2)):
        ends = box.scale_bar(box.middle + eye)
        assert np.abs(np.diff(ends, axis=0)[0]) == pytest.approx(bar * np.eye(3)[along])
        near = np.where(np.array(eye) > 0, 1 - SCALE_BAR_DEPTH, SCALE_BAR_DEPTH)
        middle = np.where(eye, near * width, width / 2)
        assert ends.mean(axis=0) == pytest.approx([middle[0], 1 + SCALE_BAR_DROP, middle[2]])


def test_right_is_right_and_down_is_down():
    ahead = Viewpoint(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.deg2rad(90.0))
    places = np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [0, 0, -1]])
    expected = [[50, 50, 75.25, np.nan], [100, 125.25, 100, np.nan], [2, 2, 2, np.nan]]
    np.testing.assert_allclose(ahead.project(places, (101, 201)), expected)


def find_inside(xyz, framed, aspect, floor=1.0):
    """Which points are in the first picture of a cloud."""
    shape = 600, round(600 * aspect)
    row, column, _ = place_viewpoint(framed, aspect).project(xyz, shape)
    with np.errstate(invalid="ignore"):
        return (row > 0) & (row < floor * shape[0]) & (column > 0) & (column < shape[1])


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.5, 8)),
    st.floats(0.05, 3),
    st.floats(1.0, 2.0),
)
def test_a_cloud_is_seen_whole(middle, size, aspect):
    xyz = (size * np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) + middle).astype(np.float32)
    # a hundredth at either end is let go
    assert find_inside(xyz, xyz, aspect).mean() > 0.97
    assert place_viewpoint(xyz, aspect).field_of_view <= MAX_FIELD_OF_VIEW_RAD


@pytest.mark.parametrize("aspect", [0.6, 1.23])
def test_an_arm_that_sticks_out_is_in_the_first_picture(aspect):
    """Four points in a thousand lie beside a near square, outside of its box."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 60), np.linspace(-0.3, 0.3, 60))
    arm = np.stack([np.linspace(-0.5, -0.4, 14), np.full(14, 0.3), np.full(14, 0.9)], axis=1)
    square = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.9)], axis=1)
    xyz = np.concatenate([square, arm]).astype(np.float32)
    assert find_inside(xyz, xyz, aspect).all()


def test_a_camera_with_few_pixels_leaves_no_seams_in_the_panes():
    """A surface of 90 x 90 points in a picture of 128 x 128 pixels, but for a hole in it."""
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(-0.5, 0.5, 90)] * 2))
    xyz = np.column_stack([x, y, np.full(x.size, 2.0)])[np.hypot(x, y) > 0.15]
    made = project_front(make_cloud(xyz, {"intensity": np.ones(len(xyz))}))
    radius = np.hypot(*np.meshgrid(*[np.arange(128) / 127 - 0.5] * 2))
    inside = np.s_[2:-2, 2:-2]  # the outermost points lie outside of the percentiles
    assert np.isfinite(made["depth"])[inside][radius[inside] > 0.17].all()
    assert np.isnan(made["depth"])[radius < 0.12].all()
    assert (made["intensity"][np.isfinite(made["depth"])] == 1).all()


def test_the_slowest_browser_decides_how_many_points_are_drawn():
    detail = DetailChooser()
    assert detail.count(2_000_000, moving=False) == MIN_DRAWN_POINTS  # nothing is known yet
    assert detail.count(100, moving=True) == 100
    detail.points_per_s[1] = 50e6
    assert detail.count(2_000_000, moving=True) == 2_000_000
    detail.points_per_s[2] = 1e6
    assert detail.count(2_000_000, moving=False) == 500_000  # in half a second
    assert detail.count(2_000_000, moving=True) == 80_000
    detail.points_per_s[2] = 100.0
    assert detail.count(2_000_000, moving=True) == MIN_DRAWN_POINTS


def test_a_large_cloud_is_thinned_while_frames_pass():
    session = Session(PlaneSource(points=4000))
    session.max_playing_points = 500
    assert len(session.frame_at(0.0).cloud) == 4000
    session.clock.play()
    playing = session.frame_at(0.1)
    # drawn by lot with replacement: of 500 about 30 meet another one
    assert 440 < len(playing.cloud) <= 500
    assert playing.points == 4000
    whole = session.source.view(playing.frame).cloud.xyz
    assert set(map(tuple, playing.cloud.xyz.tolist())) <= set(map(tuple, whole.tolist()))
    assert np.allclose(playing.cloud.xyz.mean(axis=0), whole.mean(axis=0), atol=0.06)
    session.clock.pause()
    assert session.frame_at(0.2).points == len(session.frame_at(0.2).cloud) == 4000
