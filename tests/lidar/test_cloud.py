"""Where returns are placed in space, and the files that hold them."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError
from tofclip.lidar import PointCloud, Returns, compute_ray_directions, export, point_cloud
from tofclip.units import SPEED_OF_LIGHT

SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".h5")
PROPERTIES = ("intensity", "range_sigma", "range", "return_number", "time")


def camera(rows: int = 128, columns: int = 96, focal_length_px: float = 560.0) -> Camera:
    return Camera(
        np.array([60.0]), np.array([0.0]), (rows, columns), 200, focal_length_px=focal_length_px
    )


def returns_at(distance: np.ndarray, seen_by: Camera) -> Returns:
    """One return in each pixel, at a radial distance given as a picture."""
    y, x = np.indices(distance.shape).reshape(2, -1)
    flat = distance.ravel().astype(np.float64)
    ones = np.ones(flat.size, np.float32)
    return Returns(
        y.astype(np.int32), x.astype(np.int32), flat, ones, 1e-3 * ones, ones.astype(np.uint8),
        2 * flat / SPEED_OF_LIGHT, seen_by, {"origin": "a test"},
    )  # fmt: skip


def random_cloud(points: int, seed: int) -> PointCloud:
    random = np.random.default_rng(seed)
    column = random.normal(size=(4, points)).astype(np.float32)
    numbers = random.integers(1, 5, points).astype(np.uint8)
    return PointCloud(
        random.normal(size=(points, 3)),
        column[0],
        column[1],
        column[2],
        numbers,
        1e-8 * column[3],
        {"seed": seed},
    )


def test_a_wall_across_the_axis_comes_out_flat():
    wall, seen_by = 2.5, camera()
    rows, columns = np.indices(seen_by.image_shape)
    right, down = (columns - 48) / 560.0, (rows - 64) / 560.0
    distance = wall * np.sqrt(1 + right**2 + down**2)
    cloud = point_cloud(returns_at(distance, seen_by))
    # float32 positions are rounded to 0.12 um at 2.5 m
    np.testing.assert_allclose(cloud.xyz[:, 2], wall, atol=0.5e-6)
    np.testing.assert_allclose(cloud.xyz[:, 0], wall * right.ravel(), atol=0.5e-6)
    np.testing.assert_allclose(cloud.xyz[:, 1], wall * down.ravel(), atol=0.5e-6)


def test_x_is_right_y_is_down_and_the_axis_looks_forward():
    seen_by = camera(10, 20, focal_length_px=100.0)
    axis, right, below = compute_ray_directions(seen_by, [5, 5, 15], [10, 20, 10])
    np.testing.assert_allclose(axis, [0, 0, 1])
    np.testing.assert_allclose(right, np.array([0.1, 0, 1]) / np.sqrt(1.01))
    np.testing.assert_allclose(below, np.array([0, 0.1, 1]) / np.sqrt(1.01))


@settings(max_examples=50, deadline=None)
@given(
    row=st.floats(-500, 500),
    column=st.floats(-500, 500),
    focal=st.floats(10, 5000),
    distance=st.floats(0.1, 100),
)
def test_points_lie_at_their_range(row, column, focal, distance):
    direction = compute_ray_directions(camera(focal_length_px=focal), [row], [column])[0]
    assert np.linalg.norm(distance * direction) == pytest.approx(distance, rel=1e-12)


def test_a_cloud_keeps_what_was_known_of_its_returns():
    returns = returns_at(np.array([[1.0, 2.0]]), camera(1, 2))
    cloud = point_cloud(returns)
    assert len(cloud) == 2
    np.testing.assert_allclose(cloud.range, [1.0, 2.0])
    np.testing.assert_allclose(np.linalg.norm(cloud.xyz, axis=1), [1.0, 2.0], rtol=1e-6)
    np.testing.assert_allclose(cloud.time, [2 / SPEED_OF_LIGHT, 4 / SPEED_OF_LIGHT], rtol=1e-6)
    assert cloud.range_sigma.tolist() == pytest.approx([1e-3, 1e-3])
    assert cloud.return_number.tolist() == [1, 1]
    assert cloud.provenance == {"origin": "a test"}


@settings(max_examples=8, deadline=None)
@given(points=st.integers(0, 40), seed=st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_brings_every_bit_back(tmp_path_factory, suffix, points, seed):
    cloud = random_cloud(points, seed)
    path = tmp_path_factory.mktemp("cloud") / f"scene{suffix}"
    cloud.save(path)
    back = PointCloud.load(path)
    np.testing.assert_array_equal(back.xyz, cloud.xyz)
    for name in PROPERTIES:
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    assert back.provenance == (cloud.provenance if suffix == ".h5" else {})


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_two_columns_of_one_name_are_refused(tmp_path, suffix):
    path = tmp_path / f"scene{suffix}"
    ones = np.ones(3, np.float32)
    PointCloud(np.ones((3, 3), np.float32), ones, ones, ones, np.ones(3, np.uint8), ones).save(path)
    before, after = {
        ".ply": (b"property float y\n", b"property float x\n"),
        ".pcd": (b"FIELDS x y z", b"FIELDS x x z"),
    }[suffix]
    content = path.read_bytes()
    assert before in content
    path.write_bytes(content.replace(before, after))
    with pytest.raises(FileFormatError, match="two columns of one name"):
        PointCloud.load(path)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_the_same_points(open3d, tmp_path, suffix):
    cloud = random_cloud(200, 1)
    cloud.save(tmp_path / f"scene{suffix}")
    seen = open3d.t.io.read_point_cloud(str(tmp_path / f"scene{suffix}"))
    np.testing.assert_array_equal(seen.point.positions.numpy(), cloud.xyz)
    np.testing.assert_array_equal(seen.point["intensity"].numpy().ravel(), cloud.intensity)
    np.testing.assert_array_equal(seen.point["range_sigma"].numpy().ravel(), cloud.range_sigma)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_the_same_points_into_its_plain_clouds(open3d, tmp_path, suffix):
    cloud = random_cloud(50, 2)
    cloud.save(tmp_path / f"scene{suffix}")
    seen = open3d.io.read_point_cloud(str(tmp_path / f"scene{suffix}"))
    np.testing.assert_allclose(np.asarray(seen.points), cloud.xyz, rtol=1e-7)


def test_files_say_their_units(tmp_path):
    cloud = random_cloud(3, 0)
    for suffix in (".ply", ".pcd"):
        cloud.save(tmp_path / f"scene{suffix}")
        header = (
            (tmp_path / f"scene{suffix}")
            .read_bytes()
            .split(b"0 0 0 1" if suffix == ".pcd" else b"element")[0]
        )
        assert b"units: x m, y m, z m, intensity count, range_sigma m, range m, time s\n" in header
    cloud.save(tmp_path / "scene.csv")
    assert (tmp_path / "scene.csv").read_text().splitlines()[0] == (
        "x_m,y_m,z_m,intensity_count,range_sigma_m,range_m,return_number,time_s"
    )
    cloud.save(tmp_path / "scene.npz")
    with np.load(tmp_path / "scene.npz") as arrays:
        np.testing.assert_array_equal(arrays["z_m"], cloud.xyz[:, 2])


def test_numpy_reads_the_same_numbers_from_text(tmp_path):
    cloud = random_cloud(50, 3)
    cloud.save(tmp_path / "scene.csv")
    table = np.genfromtxt(tmp_path / "scene.csv", delimiter=",", names=True, dtype=np.float64)
    np.testing.assert_allclose(
        np.stack([table["x_m"], table["y_m"], table["z_m"]], axis=1), cloud.xyz, rtol=1e-6
    )
    np.testing.assert_allclose(table["intensity_count"], cloud.intensity, rtol=1e-6)
    np.testing.assert_allclose(table["range_m"], cloud.range, rtol=1e-6)


def test_saving_is_all_or_nothing(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    random_cloud(5, 0).save(path)
    before = path.read_bytes()

    def interrupted(file: Path, *_: object) -> None:
        file.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "_write_binary", interrupted)
    with pytest.raises(KeyboardInterrupt):
        random_cloud(9, 1).save(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["scene.ply"]
    assert stat.S_IMODE(path.stat().st_mode) & stat.S_IRUSR


def test_unknown_formats_and_places_are_refused(tmp_path):
    cloud = random_cloud(2, 0)
    with pytest.raises(
        InputError,
        match=r"must end in \.ply or \.pcd or \.csv or \.npz or \.las or \.laz or \.e57 or \.h5",
    ):
        cloud.save(tmp_path / "scene.xyz")
    with pytest.raises(InputError, match="must end in"):
        PointCloud.load(tmp_path / "scene")
    with pytest.raises(StorageError, match="folder does not exist"):
        cloud.save(tmp_path / "nowhere" / "scene.ply")
    for suffix in SUFFIXES:
        with pytest.raises(StorageError, match="no such file"):
            PointCloud.load(tmp_path / f"absent{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("damage", ["truncated", "empty", "foreign"])
def test_damaged_files_are_refused_in_one_line(tmp_path, suffix, damage):
    path = tmp_path / f"scene{suffix}"
    random_cloud(20, 0).save(path)
    content = path.read_bytes()
    cut = (
        content.rsplit(b",", 1)[0] if suffix == ".csv" else content[:-7]
    )  # a CSV row without its last column
    path.write_bytes({"truncated": cut, "empty": b"", "foreign": b"\x00GIF89a" * 9}[damage])
    with pytest.raises(FileFormatError) as caught:
        PointCloud.load(path)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


HEADERS = {
    "ascii.ply": b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n",
    "faces.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nelement face 0\nend_header\n",
    "integers.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty int x\nend_header\n",
    "bare.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n",
    "endless.ply": b"ply\n" + b"comment x\n" * 9000,
    "ascii.pcd": b"# .PCD v0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nPOINTS 0\nDATA ascii\n",
    "nameless.pcd": b"# .PCD v0.7\nSIZE 4\nTYPE F\nPOINTS 0\nDATA binary\n",
    "uneven.pcd": b"# .PCD v0.7\nFIELDS x y\nSIZE 4\nTYPE F\nPOINTS 0\nDATA binary\n",
    "words.csv": b"x_m,y_m\none,two\n",
    "narrow.csv": b"x_m,y_m\n1,2,3\n",
}


@pytest.mark.parametrize("name", HEADERS)
def test_tables_of_another_kind_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(HEADERS[name])
    with pytest.raises(FileFormatError, match=name):
        PointCloud.load(tmp_path / name)


def test_columns_that_do_not_fit_are_refused():
    good = random_cloud(3, 0)
    with pytest.raises(
        ShapeError, match=r"positions of a point cloud must have shape \(points, 3\)"
    ):
        PointCloud(np.zeros((3, 2)), *(getattr(good, name) for name in PROPERTIES))
    with pytest.raises(ShapeError, match="intensity of a point cloud"):
        PointCloud(np.zeros((4, 3)), *(getattr(good, name) for name in PROPERTIES))
    with pytest.raises(InputError, match="must be finite"):
        PointCloud(np.full((3, 3), np.nan), *(getattr(good, name) for name in PROPERTIES))
