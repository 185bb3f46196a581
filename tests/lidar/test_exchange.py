"""Clouds in the formats of others, read back by programs of others."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, MissingDependencyError, StorageError
from tofclip.lidar import PointCloud, Returns, point_cloud
from tofclip.lidar.cloud import save_organised
from tofclip.lidar.ros import StampedCloud, write_bag


def make_cloud(xyz: np.ndarray, seed: int = 0) -> PointCloud:
    random = np.random.default_rng(seed)
    number = len(xyz)
    columns = random.uniform(0.1, 5, (4, number)).astype(np.float32)
    return PointCloud(
        xyz, columns[0], columns[1], columns[2], random.integers(1, 4, number).astype(np.uint8),
        1e-9 * columns[3],
    )  # fmt: skip


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return make_cloud(np.random.default_rng(1).normal(size=(40, 3)))


def test_pye57_reads_e57(cloud, tmp_path) -> None:
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "scene.e57"
    cloud.save(path)
    file = pye57.E57(str(path))
    seen = file.read_scan_raw(0)
    xyz = np.stack([seen[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_array_equal(xyz, cloud.xyz)
    np.testing.assert_array_equal(seen["intensity"], cloud.intensity)
    file.close()
    back = PointCloud.load(path)
    for name in ("intensity", "range_sigma", "range", "return_number", "time"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))
        assert getattr(back, name).dtype == getattr(cloud, name).dtype
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"ASTM-E57" + 200 * b"\0"):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"scene\.e57"):
            PointCloud.load(path)
    pye57.E57(str(path), mode="w").close()
    with pytest.raises(FileFormatError) as kept:  # with all that the failed frames hold
        PointCloud.load(path)
    assert str(path) not in {os.path.realpath(one) for one in Path("/proc/self/fd").iterdir()}
    assert "scene.e57" in str(kept.value)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv", ".npz", ".h5", ".las", ".laz", ".e57"])
def test_doubt_and_reflectance_travel_in_every_format(cloud, tmp_path, suffix) -> None:
    """Where they are known; files of clouds that do not know them have no such columns."""
    pytest.importorskip({".las": "laspy", ".laz": "lazrs", ".e57": "pye57"}.get(suffix, "h5py"))
    random = np.random.default_rng(2)
    doubt = random.uniform(0, 0.5, len(cloud)).astype(np.float32)
    percent = random.uniform(1, 90, len(cloud)).astype(np.float32)
    path = tmp_path / f"cloud{suffix}"
    replace(cloud, false_alarm=doubt, reflectance=percent).save(path)
    back = PointCloud.load(path)
    np.testing.assert_array_equal(back.false_alarm, doubt)
    np.testing.assert_array_equal(back.reflectance, percent)
    assert {"false_alarm", "reflectance"} <= set(PointCloud.read_outline(path).fields)
    cloud.save(path)
    assert not {"false_alarm", "reflectance"} & set(PointCloud.read_outline(path).fields)
    assert np.isnan(PointCloud.load(path).false_alarm).all()


def test_programs_of_others_see_doubt_and_reflectance(open3d, cloud, tmp_path) -> None:
    doubt = np.linspace(0, 0.5, len(cloud)).astype(np.float32)
    known = replace(cloud, false_alarm=doubt, reflectance=100 * doubt)
    known.save(tmp_path / "cloud.ply")
    seen = open3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply")).point
    np.testing.assert_array_equal(seen["false_alarm"].numpy().ravel(), doubt)
    np.testing.assert_array_equal(seen["reflectance"].numpy().ravel(), 100 * doubt)
    pytest.importorskip("rosbags")
    reading = pytest.importorskip("mcap_ros2.reader")
    write_bag([StampedCloud(known, 5)], tmp_path / "one.mcap")
    (one,) = reading.read_ros2_messages(tmp_path / "one.mcap")
    assert {"false_alarm", "reflectance"} <= {field.name for field in one.ros_msg.fields}


def test_mcap_reads_the_stamps_and_the_points(cloud, tmp_path) -> None:
    pytest.importorskip("rosbags")
    reading = pytest.importorskip("mcap_ros2.reader")
    other = make_cloud(cloud.xyz[:7], 3)
    stamps = (1_700_000_000_000_000_123, 1_700_000_000_100_000_000)
    clouds = [StampedCloud(cloud, stamps[0]), StampedCloud(other, stamps[1])]
    assert write_bag(clouds, tmp_path / "sequence.mcap") == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["sequence.mcap"]
    seen = list(reading.read_ros2_messages(tmp_path / "sequence.mcap"))
    assert [one.log_time_ns for one in seen] == list(stamps)
    for one, stamped in zip(seen, clouds, strict=True):
        message = one.ros_msg
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamped.stamp_ns
        assert (message.height, message.width) == (1, len(stamped.cloud))
        # The layout as the message itself describes it; 7 and 2 are ROS's float32 and uint8.
        layout = np.dtype(
            {
                "names": [field.name for field in message.fields],
                "formats": [{7: "<f4", 2: "u1"}[field.datatype] for field in message.fields],
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
        )
        rows = np.frombuffer(bytes(message.data), layout)
        np.testing.assert_array_equal(rows["y"], stamped.cloud.xyz[:, 1])
        np.testing.assert_array_equal(rows["return_number"], stamped.cloud.return_number)
        np.testing.assert_array_equal(rows["time_of_flight"], stamped.cloud.time)
        # Programs would take it for the instant at which a scanner saw the point.
        assert "time" not in layout.names


def test_sqlite_and_the_standard_show_what_is_in_a_bag(cloud, tmp_path) -> None:
    pytest.importorskip("rosbags")
    import sqlite3

    assert write_bag([StampedCloud(cloud, 5)], tmp_path / "bag") == 1
    assert "sensor_msgs/msg/PointCloud2" in (tmp_path / "bag" / "metadata.yaml").read_text()
    (database,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(database) as connection:
        ((stamp, data),) = connection.execute("select timestamp, data from messages")
    assert stamp == 5
    # CDR, little endian: the header's seconds and nanoseconds follow the four bytes of the encoding.
    assert data[:2] == b"\x00\x01"
    assert np.frombuffer(data[4:12], "<u4").tolist() == [0, 5]
    with pytest.raises(StorageError, match="new folder"):
        write_bag([StampedCloud(cloud, 5)], tmp_path / "bag")


def test_recordings_that_cannot_be_are_refused(cloud, tmp_path, monkeypatch) -> None:
    pytest.importorskip("rosbags")
    with pytest.raises(InputError, match="no cloud"):
        write_bag([], tmp_path / "none.mcap")
    with pytest.raises(InputError, match="stamps"):
        write_bag([StampedCloud(cloud, 5), StampedCloud(cloud, 4)], tmp_path / "back.mcap")
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[exchange\]"):
        write_bag([StampedCloud(cloud, 5)], tmp_path / "absent.mcap")
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[exchange\]"):
        cloud.save(tmp_path / "absent.e57")


def test_kiss_icp_follows_a_moving_camera(tmp_path, monkeypatch) -> None:
    """Its own reader of ROS 2 bags and its own pipeline, as they are."""
    pytest.importorskip("rosbags")
    loading = pytest.importorskip("kiss_icp.datasets.rosbag")
    pipeline = pytest.importorskip("kiss_icp.pipeline")
    random = np.random.default_rng(2)
    # A corner of a room, seen from a camera that goes forward.
    walls = [random.uniform(-6, 6, (3000, 3)) for _ in range(3)]
    for axis, wall in enumerate(walls):
        wall[:, axis] = (6, 2, 14)[axis]
    room = np.concatenate(walls) + np.array([0, 0, 2.0])
    step = np.array([0.05, 0.0, 0.2])
    clouds = [
        StampedCloud(
            make_cloud(room - number * step + random.normal(0, 0.01, room.shape)), number * 10**8
        )
        for number in range(6)
    ]
    write_bag(clouds, tmp_path / "drive")
    odometry = pipeline.OdometryPipeline(loading.RosbagDataset(tmp_path / "drive", ""))
    monkeypatch.chdir(tmp_path)  # it writes its results beside where it runs
    odometry.run()
    np.testing.assert_allclose(odometry.poses[:, :3, 3], np.arange(6)[:, None] * step, atol=0.05)


def make_two_walls() -> Returns:
    """Pixels of a picture of 4 x 6: a wall at 2 m with a window, one at 3 m, both in one pixel."""
    camera = Camera(np.array([20.0]), np.zeros(1), (4, 6), 41, focal_length_px=10.0)
    y = np.array([0, 1, 2, 2, 3], np.int32)
    x = np.array([5, 2, 3, 3, 0], np.int32)
    distance = np.array([2.0, 3.0, 2.0, 3.0, 2.0])
    bright = np.array([1.0, 2.0, 1.0, 4.0, 3.0], np.float32)
    number = np.array([1, 1, 1, 2, 1], np.uint8)
    return Returns(y, x, distance, bright, 0.01 * bright, number, 2 * distance / 3e8, camera)


def test_one_return_of_each_pixel_is_chosen() -> None:
    returns = make_two_walls()
    assert returns.select("all") is returns
    assert returns.select("first").range.tolist() == [2, 3, 2, 2]
    assert returns.select("last").range.tolist() == [2, 3, 3, 2]
    strongest = returns.select("strongest")
    assert strongest.intensity.tolist() == [1, 2, 4, 3]
    assert strongest.return_number.tolist() == [1, 1, 2, 1]
    with pytest.raises(InputError, match="first, strongest, last, all"):
        returns.select("second")


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npz", ".csv"])
def test_organised_clouds_have_a_place_for_every_pixel(open3d, tmp_path, suffix) -> None:
    returns, path = make_two_walls().select("first"), tmp_path / f"scene{suffix}"
    assert save_organised(returns, path) == 4
    there = point_cloud(returns)
    if suffix == ".pcd":
        assert b"\nWIDTH 6\nHEIGHT 4\n" in path.read_bytes()
        seen = open3d.t.io.read_point_cloud(str(path)).point.positions.numpy()
        assert seen.shape == (24, 3)
        assert np.isfinite(seen).all(axis=1).sum() == 4
        np.testing.assert_array_equal(seen.reshape(4, 6, 3)[3, 0], there.xyz[3])
    if suffix == ".npz":
        with np.load(path) as pictures:
            assert pictures["z_m"].shape == (4, 6)
            assert pictures["range_m"][1, 2] == 3
            assert np.isnan(pictures["range_sigma_m"][1, 3])
    back = PointCloud.load(path)
    np.testing.assert_allclose(back.xyz, there.xyz)
    np.testing.assert_allclose(back.range_sigma, there.range_sigma)


def test_what_cannot_be_organised_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="one point for a pixel"):
        save_organised(make_two_walls(), tmp_path / "scene.pcd")
    with pytest.raises(InputError, match=r"\.pcd, \.ply, \.npz, \.csv"):
        save_organised(make_two_walls().select("last"), tmp_path / "scene.las")
