"""Clouds of known surfaces: cleaned, thinned, measured, and cut into objects."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError, MissingDependencyError
from tofclip.lidar import PointCloud
from tofclip.lidar.cloud import downsample_cloud, find_objects, find_outliers, fit_plane

NORMAL = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
pytestmark = pytest.mark.usefixtures("open3d")


def cloud_of(xyz):
    n, distance = np.arange(len(xyz)), np.linalg.norm(xyz, axis=1)
    return PointCloud(xyz, n + 1.0, 1e-3 + 0 * n, distance, 1 + n % 3, 1e-9 * n, {"of": "a test"})


def plane_points(number, seed, noise=1e-3):
    """Points around a plane at 2 m whose normal is known."""
    random = np.random.default_rng(seed)
    across = np.linalg.svd(NORMAL[np.newaxis])[2][1:]
    points = random.uniform(-0.5, 0.5, (number, 2)) @ across
    return points + (-2.0 + noise * random.normal(size=(number, 1))) * NORMAL


def test_a_plane_is_found_among_strays():
    stray = np.random.default_rng(1).uniform(-1, 1, (60, 3)) + np.array([0, 0, 2])
    cloud = cloud_of(np.concatenate([plane_points(600, 0), stray]))
    plane = fit_plane(cloud, 5e-3, seed=3)
    # 1 mm over half a metre and 600 points: a tenth of a milliradian
    assert plane.normal @ NORMAL == pytest.approx(1, abs=1e-6)
    assert plane.offset == pytest.approx(-2.0, abs=3e-4)
    assert plane.rms == pytest.approx(1e-3, rel=0.15)
    assert plane.inliers[:600].mean() > 0.99


def test_strays_are_left_out_and_columns_stay_with_their_points():
    strays = np.random.default_rng(2).uniform(-3, 3, (20, 3))
    cloud = cloud_of(np.concatenate([plane_points(800, 0), strays]))
    kept = cloud[~find_outliers(cloud)]
    assert (kept.intensity > 800).sum() <= 1
    assert len(kept) > 780
    assert np.array_equal(kept.xyz, cloud.xyz[(kept.intensity - 1).astype(int)])
    assert kept.provenance == cloud.provenance
    assert not find_outliers(cloud[np.arange(5)]).any()


def test_a_distant_surface_is_as_good_as_a_near_one_and_strays_are_left_out():
    """The same grid of pixels sees a wall at 1 m and one at 8 m, whose points lie 8 times apart."""
    random = np.random.default_rng(3)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(40) - 20, np.arange(30) - 15))
    depth = np.where(x < 6, 1.0, 8.0) + random.normal(0, 2e-3, x.size)
    walls = np.stack([x * depth / 200, y * depth / 200, depth], axis=1)
    height = random.uniform(-0.5, 0.5, 25)
    strays = np.stack([np.linspace(-0.5, 0.5, 25), height, random.uniform(2, 6, 25)], axis=1)
    cloud = cloud_of(np.concatenate([walls, strays]))
    kept = cloud[~find_outliers(cloud)]
    near = kept.xyz[:, 2] < 1.5
    far = kept.xyz[:, 2] > 7.5
    assert near.sum() >= 0.99 * np.sum(x < 6)
    assert far.sum() >= 0.99 * np.sum(x >= 6)
    assert np.sum(~near & ~far) <= 2


@settings(max_examples=20)
@given(points=st.integers(0, 60), voxel=st.floats(0.05, 3.0), seed=st.integers(0, 99))
def test_voxels_hold_one_point_each_and_keep_the_mean(points, voxel, seed):
    cloud = cloud_of(np.random.default_rng(seed).normal(size=(points, 3)))
    thin = downsample_cloud(cloud, voxel)
    cells = {tuple(cell) for cell in np.floor(cloud.xyz / voxel).astype(int)}
    assert len(thin) == len(cells)
    if points and len(cells) == 1:
        assert thin.xyz[0] == pytest.approx(cloud.xyz.mean(axis=0), abs=1e-5)
        assert thin.range_sigma[0] == pytest.approx(1e-3 / np.sqrt(points), rel=1e-4)
        assert thin.return_number[0] == cloud.return_number.min()
    if points:
        assert thin.intensity.min() >= cloud.intensity.min()
        assert thin.intensity.max() <= cloud.intensity.max()


def test_the_mean_of_points_is_known_better_than_each():
    cloud = cloud_of(np.full((4, 3), 0.5) + 1e-3 * np.eye(4, 3))
    assert downsample_cloud(cloud, 1.0).range_sigma == pytest.approx([0.5e-3])


CLOUD = cloud_of(plane_points(10, 0))
FEW = CLOUD[np.arange(2)]


@pytest.mark.parametrize(
    "ask",
    [
        lambda: downsample_cloud(CLOUD, 0.0),
        lambda: find_outliers(CLOUD, 0),
        lambda: fit_plane(FEW, 0.1),
        lambda: find_objects(CLOUD, 0.0, 1),
        lambda: find_objects(CLOUD, np.nan, 1),
        lambda: find_objects(CLOUD, 0.1, 0),
    ],
)
def test_unusable_requests_are_refused(ask):
    with pytest.raises(InputError):
        ask()


def test_without_open3d_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependencyError, match="Open3D"):
        fit_plane(CLOUD, 0.1)


def test_objects_are_listed_from_the_nearest_with_their_size():
    y, x = np.mgrid[-10:11, -15:16].reshape(2, -1) * 0.01
    far = np.stack([x + 0.4, y, np.full(x.size, 3.0)], axis=-1)
    near = np.stack([2 * x, y / 2, np.full(x.size, 1.5)], axis=-1)
    stray = np.array([[0.0, 0.5, 2.0], [0.1, -0.5, 2.0]])
    found = find_objects(cloud_of(np.concatenate([far, stray, near])), reach=0.03)
    assert [one.points.size for one in found] == [651, 651]
    first, second = found
    assert first.centre == pytest.approx((0.0, 0.0, 1.5))
    assert second.centre == pytest.approx((0.4, 0.0, 3.0), abs=1e-6)
    # the inner nine tenths of 31 columns and 21 rows
    sizes = [[one.width, one.height] for one in found]
    assert np.all(
        np.abs(np.subtract(sizes, [[0.54, 0.09], [0.27, 0.18]])) < [[0.03, 0.006], [0.02, 0.011]]
    )
    assert first.range == pytest.approx(1.51, abs=0.01)
    assert first.range_sigma == pytest.approx(1e-3)
    assert first.intensity > second.intensity  # they are numbered
    assert first.scatter < 0.02
    for few in (np.empty((0, 3)), np.eye(3)):
        assert find_objects(cloud_of(few), 0.1) == []


def test_scatter_is_a_standard_deviation_that_strays_do_not_raise():
    random = np.random.default_rng(0)
    direction = random.normal([0, 0, 1], 0.02, (3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = 2 + random.normal(0, 0.01, 3000)
    distance[:60] += 0.08
    (found,) = find_objects(cloud_of(direction * distance[:, np.newaxis]), reach=0.2)
    assert found.scatter == pytest.approx(0.01, rel=0.1)
