"""Groups of points whose places and sizes are known."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.lidar.processing import find_objects


def cloud(xyz: np.ndarray) -> PointCloud:
    n = len(xyz)
    number = np.ones(n, np.uint8)
    return PointCloud(
        xyz, np.full(n, 5.0), np.full(n, 2e-3), np.linalg.norm(xyz, axis=1), number, np.zeros(n)
    )


def test_objects_are_listed_from_the_nearest_with_their_size():
    y, x = np.mgrid[-10:11, -15:16].reshape(2, -1) * 0.01
    far = np.stack([x + 0.4, y, np.full(x.size, 3.0)], axis=-1)
    near = np.stack([2 * x, y / 2, np.full(x.size, 1.5)], axis=-1)
    stray = np.array([[0.0, 0.5, 2.0], [0.1, -0.5, 2.0]])
    found = find_objects(cloud(np.concatenate([far, stray, near])), reach=0.03)
    assert [one.points.size for one in found] == [651, 651]
    first, second = found
    assert first.centre == pytest.approx((0.0, 0.0, 1.5))
    assert second.centre == pytest.approx((0.4, 0.0, 3.0), abs=1e-6)
    # the inner nine tenths of 31 columns and 21 rows
    assert (first.width, first.height) == (
        pytest.approx(0.54, abs=0.03),
        pytest.approx(0.09, abs=0.006),
    )
    assert (second.width, second.height) == (
        pytest.approx(0.27, abs=0.02),
        pytest.approx(0.18, abs=0.011),
    )
    assert first.range == pytest.approx(1.51, abs=0.01)
    assert (first.range_sigma, first.intensity) == (pytest.approx(2e-3), 5.0)
    assert first.scatter < 0.02


def test_nothing_and_nonsense():
    assert find_objects(cloud(np.empty((0, 3))), 0.1) == []
    assert find_objects(cloud(np.eye(3)), 0.1) == []
    for reach, fewest in ((0.0, 1), (np.nan, 1), (0.1, 0)):
        with pytest.raises(InputError, match="positive reach"):
            find_objects(cloud(np.eye(3)), reach, fewest)


def test_scatter_is_a_standard_deviation_that_strays_do_not_raise():
    random = np.random.default_rng(0)
    direction = random.normal([0, 0, 1], 0.02, (3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = 2 + random.normal(0, 0.01, 3000)
    distance[:60] += 0.08
    (found,) = find_objects(cloud(direction * distance[:, np.newaxis]), reach=0.2)
    assert found.scatter == pytest.approx(0.01, rel=0.1)
