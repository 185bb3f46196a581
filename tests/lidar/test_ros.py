"""Clouds with stamps, read by programs of others."""

import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest

from tofclip.errors import InputError, MissingDependencyError, StorageError
from tofclip.lidar import PointCloud
from tofclip.lidar.ros import StampedCloud, read_bag, write_bag

pytest.importorskip("rosbags")


def make_cloud(xyz, seed=0, **others):
    random = np.random.default_rng(seed)
    columns = random.uniform(0.1, 5, (4, len(xyz))).astype(np.float32)
    number = random.integers(1, 4, len(xyz)).astype(np.uint8)
    return PointCloud(xyz, *columns[:3], number, 1e-9 * columns[3], **others)


@pytest.fixture(scope="module")
def cloud():
    return make_cloud(np.random.default_rng(1).normal(size=(40, 3)))


def test_mcap_reads_the_stamps_and_the_points(cloud, tmp_path):
    reading = pytest.importorskip("mcap_ros2.reader")
    doubt = {name: np.linspace(0, 0.5, 7) for name in ("false_alarm", "reflectance")}
    other = make_cloud(cloud.xyz[:7], 3, **doubt)
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
        kinds = [(field.name, {7: "<f4", 2: "u1"}[field.datatype]) for field in message.fields]
        layout = np.dtype(kinds)
        assert layout.itemsize == message.point_step
        assert [layout.fields[field.name][1] for field in message.fields] == [
            field.offset for field in message.fields
        ]
        rows = np.frombuffer(bytes(message.data), layout)
        np.testing.assert_array_equal(rows["y"], stamped.cloud.xyz[:, 1])
        np.testing.assert_array_equal(rows["return_number"], stamped.cloud.return_number)
        np.testing.assert_array_equal(rows["time_of_flight"], stamped.cloud.time)
        # Programs would take it for the instant at which a scanner saw the point.
        assert "time" not in layout.names
    np.testing.assert_array_equal(rows["false_alarm"], other.false_alarm)
    np.testing.assert_array_equal(rows["reflectance"], other.reflectance)


@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_what_was_written_is_read_back(name, cloud, tmp_path):
    stamps = [7, 5_000_000_001]
    clouds = [StampedCloud(cloud, stamps[0]), StampedCloud(cloud[:9], stamps[1])]
    write_bag(clouds, tmp_path / name, "/lidar", "mast")
    assert b"mast" in b"".join(one.read_bytes() for one in tmp_path.rglob("*") if one.is_file())
    found = list(read_bag(tmp_path / name))
    assert [one.stamp_ns for one in found] == stamps
    for one, written in zip(found, clouds, strict=True):
        for column, kept in zip(one.cloud.columns, written.cloud.columns, strict=True):
            np.testing.assert_array_equal(column.values, kept.values)
    with pytest.raises(InputError, match=r"choose one topic .*: /lidar"):
        list(read_bag(tmp_path / name, "/other"))


def test_messages_of_big_endian_machines_are_read(cloud, tmp_path):
    rosbag2, typesys = (
        pytest.importorskip("rosbags.rosbag2"),
        pytest.importorskip("rosbags.typesys"),
    )
    types, kind = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), "sensor_msgs/msg/PointCloud2"
    write_bag([StampedCloud(cloud, 5)], tmp_path / "little")
    with (
        rosbag2.Reader(tmp_path / "little") as reader,
        rosbag2.Writer(tmp_path / "big", version=8) as writer,
    ):
        ((_, _, data),) = reader.messages()
        message = types.deserialize_cdr(data, kind)
        layout = [(one.name, {7: "<f4", 2: "u1"}[one.datatype]) for one in message.fields]
        swapped = message.data.view(layout).byteswap().view(np.uint8)
        turned = replace(message, data=swapped, is_bigendian=True)
        own = writer.add_connection("/points", kind, typestore=types)
        writer.write(own, 5, types.serialize_cdr(turned, kind))
    (found,) = read_bag(tmp_path / "big")
    np.testing.assert_array_equal(found.cloud.xyz, cloud.xyz)
    np.testing.assert_array_equal(found.cloud.time, cloud.time)


def test_sqlite_and_the_standard_show_what_is_in_a_bag(cloud, tmp_path):
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


def test_recordings_that_cannot_be_are_refused(cloud, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="no cloud"):
        write_bag([], tmp_path / "none.mcap")
    with pytest.raises(InputError, match="stamps"):
        write_bag([StampedCloud(cloud, 5), StampedCloud(cloud, 4)], tmp_path / "back.mcap")
    assert not list(tmp_path.iterdir())
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[exchange\]"):
        write_bag([StampedCloud(cloud, 5)], tmp_path / "absent.mcap")
