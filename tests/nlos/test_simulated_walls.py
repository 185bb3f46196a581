from __future__ import annotations

import numpy as np
import pytest

from nlos.simulate import WALLS, build_relay_wall
from nlos.simulate.walls import compute_wall_normals
from tofclip.errors import InputError


@pytest.mark.parametrize("name", WALLS)
def test_walls_are_as_wide_as_asked_for(name: str) -> None:
    wall = build_relay_wall(name, 33, 1.6)
    assert wall.shape == (33, 33, 3)
    known = np.isfinite(wall).all(axis=-1)
    assert np.ptp(wall[known], axis=0)[:2] == pytest.approx([1.6, 1.6])
    # Columns go to the right, rows down.
    assert np.all(np.diff(wall[:, 0, 1]) > 0)
    assert np.nanmax(wall[..., 0]) == wall[0, -1, 0]
    assert known.all() == (name != "plates")


def test_the_five_shapes() -> None:
    assert np.all(build_relay_wall("planar")[..., 2] == 0)
    cylinder = build_relay_wall("cylinder", 65)
    assert np.hypot(cylinder[..., 0], cylinder[..., 2] + 2.5) == pytest.approx(
        np.full((65, 65), 2.5)
    )
    assert cylinder[..., 2].max() == pytest.approx(0)
    wavy = build_relay_wall("wavy", 201)[..., 2]
    assert (wavy.min(), wavy.max()) == pytest.approx((-0.1, 0.1), abs=1e-3)
    assert np.ptp(build_relay_wall("relief")[..., 2]) == pytest.approx(0.3)
    plates = build_relay_wall("plates")
    left, right = plates[plates[..., 0] < 0], plates[plates[..., 0] > 0]
    assert np.all(left[:, 2] == 0)
    assert right[:, 2].max() < -0.1
    assert right[:, 0].min() - left[:, 0].max() > 0.19


def test_normals_stand_on_the_wall_and_point_to_the_scene() -> None:
    wall = build_relay_wall("cylinder", 41)
    expected = (wall + np.array([0, 0, 2.5])) * [1, 0, 1] / 2.5
    # Central differences of a circle; the edges are one-sided.
    assert compute_wall_normals(wall)[1:-1, 1:-1] == pytest.approx(expected[1:-1, 1:-1], abs=1e-3)
    plates = compute_wall_normals(build_relay_wall("plates"))
    assert np.all(np.isfinite(plates))
    assert np.all(plates[..., 2] > 0)
    assert compute_wall_normals(np.zeros((5, 3))).tolist() == [[0, 0, 1]] * 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("chinese", 5), "choose one of planar, cylinder"),
        (("planar", 1), "at least 2 x 2"),
        (("planar", 5, -1.0), "positive width"),
        (("cylinder", 5, 6.0), "narrower than 6 m"),
    ],
)
def test_impossible_walls_are_refused(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build_relay_wall(*arguments)
