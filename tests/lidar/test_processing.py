"""Clouds of known surfaces: cleaned, thinned, measured, laid over each other; and the lens undone."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera
from tofclip.errors import (
    CalibrationError,
    FileFormatError,
    InputError,
    MissingDependencyError,
    ShapeError,
)
from tofclip.lidar import PointCloud, Returns, compute_ray_directions, point_cloud, save_depth
from tofclip.lidar.geometry import distort_directions
from tofclip.lidar.processing import (
    align_clouds,
    downsample_cloud,
    estimate_normals,
    fit_plane,
    remove_outliers,
    select_points,
    transform_cloud,
)

NORMAL = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])


pytestmark = pytest.mark.usefixtures("open3d")


def cloud_of(xyz: np.ndarray) -> PointCloud:
    n = np.arange(len(xyz))
    return PointCloud(
        xyz,
        n + 1.0,
        1e-3 + 0 * n,
        np.linalg.norm(xyz, axis=1),
        1 + n % 3,
        1e-9 * n,
        {"of": "a test"},
    )


def plane_points(number: int, seed: int, noise: float = 1e-3) -> np.ndarray:
    """Points around a plane at 2 m whose normal is known."""
    random = np.random.default_rng(seed)
    across = np.linalg.svd(NORMAL[np.newaxis])[2][1:]
    points = random.uniform(-0.5, 0.5, (number, 2)) @ across
    return points + (-2.0 + noise * random.normal(size=(number, 1))) * NORMAL


def rotation(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


def test_a_plane_and_its_normals_are_found_among_strays():
    stray = np.random.default_rng(1).uniform(-1, 1, (60, 3)) + np.array([0, 0, 2])
    cloud = cloud_of(np.concatenate([plane_points(600, 0), stray]))
    plane = fit_plane(cloud, 5e-3, seed=3)
    # 1 mm over half a metre and 600 points: a tenth of a milliradian
    assert plane.normal @ NORMAL == pytest.approx(1, abs=1e-6)
    assert plane.offset == pytest.approx(-2.0, abs=3e-4)
    assert plane.rms == pytest.approx(1e-3, rel=0.15)
    assert plane.inliers[:600].mean() > 0.99
    assert np.median(estimate_normals(select_points(cloud, plane.inliers), 60) @ NORMAL) > 0.9998


def test_strays_are_left_out_and_columns_stay_with_their_points():
    random = np.random.default_rng(2)
    cloud = cloud_of(np.concatenate([plane_points(800, 0), random.uniform(-3, 3, (20, 3))]))
    kept = remove_outliers(cloud)
    assert (kept.intensity > 800).sum() <= 1
    assert len(kept) > 780
    assert np.array_equal(kept.xyz, cloud.xyz[(kept.intensity - 1).astype(int)])
    assert kept.provenance == cloud.provenance
    assert len(remove_outliers(select_points(cloud, np.arange(5)))) == 5


def test_a_distant_surface_is_as_good_as_a_near_one_and_strays_are_left_out():
    """The same grid of pixels sees a wall at 1 m and one at 8 m, whose points lie 8 times apart."""
    random = np.random.default_rng(3)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(40) - 20, np.arange(30) - 15))
    depth = np.where(x < 6, 1.0, 8.0) + random.normal(0, 2e-3, x.size)
    walls = np.stack([x * depth / 200, y * depth / 200, depth], axis=1)
    height = random.uniform(-0.5, 0.5, 25)
    strays = np.stack([np.linspace(-0.5, 0.5, 25), height, random.uniform(2, 6, 25)], axis=1)
    kept = remove_outliers(cloud_of(np.concatenate([walls, strays])))
    near = kept.xyz[:, 2] < 1.5
    far = kept.xyz[:, 2] > 7.5
    assert near.sum() >= 0.99 * np.sum(x < 6)
    assert far.sum() >= 0.99 * np.sum(x >= 6)
    assert np.sum(~near & ~far) <= 2


@settings(max_examples=20, deadline=None)
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


def test_a_cloud_is_laid_over_another_one():
    random = np.random.default_rng(5)
    corner = np.concatenate(
        [random.uniform(0, 1, (700, 3)) * side for side in ([1, 1, 0], [1, 0, 1], [0, 1, 1])]
    )
    target = cloud_of(corner + np.array([0, 0, 2.0]))
    pose = rotation(0.03)
    pose[:3, 3] = [0.02, -0.01, 0.015]
    source = transform_cloud(target, np.linalg.inv(pose))
    found = align_clouds(source, target, reach=0.1)
    assert found.overlap > 0.99
    assert found.rms < 1e-4
    np.testing.assert_allclose(found.pose, pose, atol=1e-4)
    np.testing.assert_allclose(transform_cloud(source, found.pose).xyz, target.xyz, atol=3e-4)
    np.testing.assert_array_equal(source.range, target.range)


def test_unusable_requests_are_refused(monkeypatch):
    cloud = cloud_of(plane_points(10, 0))
    few = select_points(cloud, np.arange(2))
    for call in (
        lambda: downsample_cloud(cloud, 0.0),
        lambda: remove_outliers(cloud, 0),
        lambda: estimate_normals(few),
        lambda: fit_plane(few, 0.1),
        lambda: align_clouds(few, cloud, 0.1),
        lambda: transform_cloud(cloud, 2 * np.eye(4)),
    ):
        with pytest.raises(InputError):
            call()
    with pytest.raises(ShapeError):
        transform_cloud(cloud, np.eye(3))
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependencyError, match="Open3D"):
        estimate_normals(cloud)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[las\]"):
        cloud.save("scene.las")


@settings(max_examples=30, deadline=None)
@given(
    k=st.tuples(*[st.floats(-0.2, 0.2)] * 2, *[st.floats(-0.01, 0.01)] * 2, st.floats(-0.05, 0.05)),
    row=st.floats(0, 127),
    column=st.floats(0, 95),
)
def test_the_lens_is_undone(k, row, column):
    camera = Camera(
        np.array([60.0]),
        np.array([0.0]),
        (128, 96),
        200,
        focal_length_px=200.0,
        distortion=np.array(k),
    )
    x, y, z = compute_ray_directions(camera, [row], [column])[0]
    right, down = distort_directions(np.array([x / z]), np.array([y / z]), np.array(k))
    assert right[0] * 200 + 48 == pytest.approx(column, abs=1e-6)
    assert down[0] * 200 + 64 == pytest.approx(row, abs=1e-6)


@pytest.mark.parametrize(
    ("coefficients", "expected"),
    [
        # OpenCV's order k1, k2, p1, p2, k3; by hand, at x = 0.3, y = -0.2, r^2 = 0.13
        ((1.0, 0, 0, 0, 0), (0.3 * 1.13, -0.2 * 1.13)),
        ((0, 1.0, 0, 0, 0), (0.3 * (1 + 0.13**2), -0.2 * (1 + 0.13**2))),
        ((0, 0, 1.0, 0, 0), (0.3 - 0.12, -0.2 + 0.13 + 0.08)),
        ((0, 0, 0, 1.0, 0), (0.3 + 0.13 + 0.18, -0.2 - 0.12)),
        ((0, 0, 0, 0, 1.0), (0.3 * (1 + 0.13**3), -0.2 * (1 + 0.13**3))),
    ],
)
def test_each_coefficient_of_the_lens_bends_as_published(coefficients, expected):
    found = distort_directions(np.array([0.3]), np.array([-0.2]), np.array(coefficients))
    assert np.ravel(found) == pytest.approx(expected, abs=1e-12)


def test_impossible_lenses_are_refused(tmp_path):
    camera = Camera(
        np.array([60.0]), np.array([0.0]), (128, 96), 200, distortion=np.array([-9.0, 0, 0, 0, 0])
    )
    with pytest.raises(CalibrationError, match="too strong"):
        compute_ray_directions(camera, [0], [0])
    camera.save(tmp_path / "camera.h5")
    assert Camera.load(tmp_path / "camera.h5").distortion.tolist() == [-9, 0, 0, 0, 0]
    for wrong in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(CalibrationError, match="5 finite numbers"):
            camera.replace(distortion=wrong)


def las_points(path) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Positions, extra columns' names and raw extra bytes, read by the LAS 1.4 specification alone."""
    content = path.read_bytes()
    assert content[:4] == b"LASF"
    start, records = struct.unpack_from("<II", content, 96)
    layout, size = struct.unpack_from("<BH", content, 104)
    scale, offset = np.array(struct.unpack_from("<6d", content, 131)).reshape(2, 3)
    (number,) = struct.unpack_from("<Q", content, 247)
    assert layout == 6
    at, names = struct.unpack_from("<H", content, 94)[0], []
    for _ in range(records):
        user, kind, length = struct.unpack_from("<16sHH", content, at + 2)
        if user.rstrip(b"\0") == b"LASF_Spec" and kind == 4:
            described = content[at + 54 : at + 54 + length]
            names = [
                described[i + 4 : i + 36].rstrip(b"\0").decode() for i in range(0, length, 192)
            ]
        at += 54 + length
    rows = np.frombuffer(content, np.uint8, number * size, start).reshape(number, size)
    return np.ascontiguousarray(rows[:, :12]).view("<i4") * scale + offset, names, rows[:, 30:]


def test_las_holds_micrometres_and_all_columns(tmp_path):
    cloud = cloud_of(plane_points(50, 4))
    cloud.save(tmp_path / "scene.las")
    xyz, names, extra = las_points(tmp_path / "scene.las")
    np.testing.assert_allclose(xyz, cloud.xyz, atol=0.51e-6)
    assert names == [
        f"tofclip_{name}" for name in ("intensity", "range_sigma", "range", "return_number", "time")
    ]
    raw = np.ascontiguousarray(extra)
    np.testing.assert_array_equal(
        np.ascontiguousarray(raw[:, 0:4]).view("<f4")[:, 0], cloud.intensity
    )
    np.testing.assert_array_equal(np.ascontiguousarray(raw[:, 8:12]).view("<f4")[:, 0], cloud.range)
    np.testing.assert_array_equal(raw[:, 12], cloud.return_number)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_and_laz_are_read_by_laspy_and_by_us(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / f"scene{suffix}"
    cloud = cloud_of(plane_points(500, 4))
    cloud.save(path)
    seen, back = laspy.read(path), PointCloud.load(path)
    np.testing.assert_allclose(np.stack([seen.x, seen.y, seen.z], axis=-1), cloud.xyz, atol=0.51e-6)
    units = {
        d.name: bytes(d.description.encode()).rstrip(b"\0")
        for d in seen.point_format.extra_dimensions
    }
    assert (units["tofclip_range"], units["tofclip_time"]) == (b"m", b"s")
    assert seen.header.are_points_compressed == (suffix == ".laz")
    assert seen.intensity.max() == 65535
    np.testing.assert_allclose(back.xyz, cloud.xyz, atol=0.7e-6)
    for name in ("intensity", "range_sigma", "range", "return_number", "time"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
    content = path.read_bytes()
    for length in (0, 300, len(content) // 2, len(content) - 60):
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError, match="LAS"):
            PointCloud.load(path)
    far = cloud_of(np.array([[0.0, 0.0, 3000.0]]))
    with pytest.raises(InputError, match="2147 m"):
        far.save(path)


def exr_channels(path) -> dict[str, np.ndarray]:
    """An uncompressed scan-line OpenEXR file of 32-bit channels, read by the format's specification
    alone.
    """
    content = path.read_bytes()
    assert struct.unpack_from("<I", content)[0] == 20000630
    at, header = 8, {}
    while content[at]:
        name, kind, rest = content[at:].split(b"\0", 2)
        length = struct.unpack_from("<i", rest)[0]
        at += len(name) + len(kind) + 6
        header[name.decode()] = content[at : at + length]
        at += length
    names = [
        entry.split(b"\0")[0].decode()
        for entry in (header["channels"][i : i + 18] for i in (0, 18))
    ]
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    rows, columns = bottom - top + 1, right - left + 1
    lines = struct.unpack_from(f"<{rows}Q", content, at + 1)
    values = np.stack([np.frombuffer(content, "<f4", 2 * columns, line + 8) for line in lines])
    return {name: values[:, i * columns : (i + 1) * columns] for i, name in enumerate(names)}


def test_depth_pictures_hold_metres_along_the_axis(tmp_path):
    camera = Camera(np.array([20.0]), np.array([0.1]), (6, 9), 41, focal_length_px=10.0)
    y, x = np.array([0, 2, 2, 5]), np.array([8, 4, 4, 1])
    distance = np.array([2.0, 1.5, 3.0, 2.5])
    bright = np.array([5.0, 1.0, 7.0, 2.0], np.float32)
    number = np.array([1, 1, 2, 1], np.uint8)
    returns = Returns(y, x, distance, bright, bright, number, distance / 1.5e8, camera)
    save_depth(returns, tmp_path / "depth.exr")
    seen = exr_channels(tmp_path / "depth.exr")
    assert sorted(seen) == ["Y", "Z"]
    xyz = point_cloud(returns).xyz
    assert seen["Z"][0, 8] == pytest.approx(xyz[0, 2])
    assert seen["Z"][2, 4] == pytest.approx(
        3.0 * 10 / np.hypot(10, 1)
    )  # one row above the axis; the brighter return
    assert (seen["Y"][2, 4], seen["Y"][5, 1], seen["Y"][3, 3]) == (7, 2, 0)
    assert np.isinf(seen["Z"]).sum() == 6 * 9 - 3


def test_the_mean_of_points_is_known_better_than_each():
    cloud = cloud_of(np.full((4, 3), 0.5) + 1e-3 * np.eye(4, 3))
    (sigma,) = downsample_cloud(cloud, 1.0).range_sigma
    assert sigma == pytest.approx(0.5e-3)


def test_a_mirror_is_not_a_pose():
    with pytest.raises(InputError):
        transform_cloud(cloud_of(np.eye(3)), np.diag([-1.0, 1.0, 1.0, 1.0]))
