from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos import Capture, Grid, Volume
from nlos.capture import TimeAxis
from tofclip.errors import InputError, ShapeError
from tofclip.units import SPEED_OF_LIGHT

metres = st.floats(-5, 5, allow_nan=False)


def test_shape_follows_z_y_x() -> None:
    grid = Grid(x=[0, 1, 2], y=[0, 1], z=[1, 2, 3, 4])
    assert grid.shape == (4, 2, 3)
    assert grid.size == 24
    assert grid.find_nearest((1.9, 0.2, 3.4)) == (2, 0, 2)


@given(ends=st.tuples(*[st.tuples(metres, metres)] * 3), voxel=st.floats(0.05, 2))
def test_a_box_holds_evenly_spaced_voxels_of_the_size_asked_for(
    ends: tuple[tuple[float, float], ...], voxel: float
) -> None:
    sides = [tuple(sorted(pair)) for pair in ends]
    grid = Grid.box(*sides, voxel)
    for axis, (first, last) in zip((grid.x, grid.y, grid.z), sides, strict=True):
        # 1e-6 of a voxel is the slack that lets a side of a whole number of voxels keep its last
        # one.
        slack = 1e-5 * voxel
        assert axis[0] >= first - slack
        assert axis[-1] <= last + slack
        assert axis[0] - first < voxel / 2 + slack
        assert np.allclose(np.diff(axis), voxel, rtol=1e-9, atol=1e-12)
        assert np.isclose(axis[0] - first, last - axis[-1], atol=1e-9)


def test_a_side_of_whole_voxels_keeps_both_ends() -> None:
    grid = Grid.box((-0.3, 0.3), (0.1, 0.1), (0.5, 0.7), (0.006, 1, 0.1))
    assert grid.shape == (3, 1, 101)
    assert grid.x[[0, -1]] == pytest.approx([-0.3, 0.3])
    assert grid.y == pytest.approx([0.1])


@pytest.mark.parametrize("axis", [[], [[0, 1]], 3.0])
def test_axes_are_one_dimensional(axis: object) -> None:
    with pytest.raises(ShapeError, match="grid axis y"):
        Grid([0], axis, [1])


@pytest.mark.parametrize("axis", [[0, 0], [1, 0], [0, np.nan], [np.inf]])
def test_axes_increase_and_are_finite(axis: object) -> None:
    with pytest.raises(InputError, match="grid axis z must be finite and strictly increasing"):
        Grid([0], [0], axis)


@pytest.mark.parametrize("voxel", [0, -1, np.nan, np.inf, (1, 1, 0)])
def test_voxels_have_a_positive_size(voxel: object) -> None:
    with pytest.raises(InputError, match="voxel size"):
        Grid.box((0, 1), (0, 1), (0, 1), voxel)


def test_a_voxel_in_the_wrong_unit_is_refused_before_memory_is_taken() -> None:
    with pytest.raises(InputError, match=r"side z of the box.* has millions of voxels"):
        Grid.box((0, 0), (0, 0), (0.5, 1), 1e-9)


@pytest.mark.parametrize("side", [(1, 0), (np.nan, 1), (0, np.inf)])
def test_a_box_runs_upwards(side: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="side y"):
        Grid.box((0, 1), side, (0, 1), 0.1)


def test_the_space_in_front_of_a_wall_is_as_wide_as_the_wall_and_as_deep_as_light_reaches(
    capture: Capture,
) -> None:
    grid = Grid.in_front_of(capture, 0.05)
    assert grid.x[[0, -1]] == pytest.approx([-0.6, 0.6])
    assert grid.y[[0, -1]] == pytest.approx([-0.5, 0.5])
    assert grid.z[0] >= 0.05 - 1e-9
    reach = capture.axis.paths[-1] / 2
    assert reach - 0.05 <= grid.z[-1] <= reach
    assert Grid.in_front_of(capture, 0.05, near=0.3, far=0.5).z[[0, -1]] == pytest.approx(
        [0.3, 0.5]
    )


def test_a_long_record_does_not_make_the_space_deeper_than_two_wall_widths(
    capture: Capture,
) -> None:
    later = Capture(capture.signal, capture.wall, capture.laser, capture.bin_width, start=100.0)
    assert Grid.in_front_of(later, 0.05).z[-1] == pytest.approx(2.4, abs=0.05)


def test_a_record_that_ends_at_the_wall_leaves_no_room(capture: Capture) -> None:
    early = Capture(capture.signal, capture.wall, capture.laser, capture.bin_width, start=-2.0)
    with pytest.raises(InputError, match="no room for a hidden scene"):
        Grid.in_front_of(early, 0.05)


def test_looking_closer_keeps_everything_bright_and_one_voxel_more() -> None:
    coarse = Grid.box((-1, 1), (-1, 1), (0.5, 1.5), 0.1)
    values = np.zeros(coarse.shape, np.float32)
    values[4, 7, 12] = 1.0  # z 0.9, y -0.3, x 0.2
    values[5, 20, 3] = 0.5  # z 1.0, y 1.0 (the last), x -0.7
    values[0, 0, 0] = 0.05
    fine = Grid.around(Volume(values, coarse), 0.025, fraction=0.1)
    assert fine.x[[0, -1]] == pytest.approx([-0.8, 0.3])
    assert fine.y[[0, -1]] == pytest.approx([-0.4, 1.0])
    assert fine.z[[0, -1]] == pytest.approx([0.8, 1.1])


def test_nothing_can_be_looked_at_in_the_dark() -> None:
    grid = Grid([0, 1], [0], [1])
    with pytest.raises(InputError, match="dark everywhere"):
        Grid.around(Volume(np.zeros(grid.shape), grid), 0.1)


def test_a_time_axis_is_told_in_path_lengths() -> None:
    axis = TimeAxis(3, 1e-12, 0.5)
    assert axis.paths == pytest.approx(0.5 + SPEED_OF_LIGHT * 1e-12 * np.arange(3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, 1e-12, 0.0), "at least 2 time bins"),
        ((9, 0.0, 0.0), "bin width must be a positive"),
        ((9, np.nan, 0.0), "bin width must be a positive"),
        ((9, 1e-12, np.inf), "path length of bin 0"),
    ],
)
def test_a_time_axis_refuses_nonsense(arguments: tuple[int, float, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TimeAxis(*arguments)
