"""Clouds with stamps as ROS 2 messages (sensor_msgs/PointCloud2), to and from a bag or an MCAP file.

Through rosbags, an optional library that needs no ROS. Axes are those of an optical frame: x right,
y down, z forward. The time of flight is called ``time_of_flight`` there, because programs take a
field ``time`` for the instant at which a moving scanner saw the point.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.errors import InputError, StorageError
from tofclip.files import explain_os_error, guard, import_file_reader
from tofclip.lidar.cloud import PointCloud, complete_cloud
from tofclip.lidar.export import make_rows

MCAP_SUFFIX = ".mcap"
TOPIC = "/tofclip/points"
FRAME_ID = "tofclip_optical"
MESSAGE_TYPE = "sensor_msgs/msg/PointCloud2"
FIELD_TYPES = {"<f4": 7, "|u1": 2}  # NumPy's name of a type and ROS's number for it
NUMBERED_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))

NAMES = {"time": "time_of_flight"}  # of columns, where messages have others
NANOSECONDS_PER_SECOND = 1_000_000_000


@dataclass(frozen=True)
class StampedCloud:
    """A cloud and when it was taken."""

    cloud: PointCloud
    stamp_ns: int  # nanoseconds since the epoch of the recording's clock


def write_bag(
    clouds: Iterable[StampedCloud], path: str | Path, topic: str = TOPIC, frame_id: str = FRAME_ID
) -> int:
    """Write clouds as a ROS 2 recording, whole or not at all; return how many. `clouds` come in the
    order of their stamps. A `path` that ends in ``.mcap`` becomes one MCAP file, any other a
    folder, a bag in SQLite, which must not exist yet.
    """
    if not topic.startswith("/"):
        raise InputError(f"a topic begins with a slash, as {TOPIC}, got '{topic}'")
    target = Path(path)
    single = target.suffix.lower() == MCAP_SUFFIX
    if not single and target.exists():
        raise StorageError(f"{target}: exists already; a bag is a new folder")
    import_file_reader("rosbags", "tofclip[exchange]")
    from rosbags import rosbag2, typesys

    typestore = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.MCAP if single else rosbag2.StoragePlugin.SQLITE3
    number = latest = 0
    try:
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as scratch:
            bag = Path(scratch) / target.name
            # Version 8 is read by all present releases of ROS 2.
            with rosbag2.Writer(bag, version=8, storage_plugin=plugin) as writer:
                connection = writer.add_connection(topic, MESSAGE_TYPE, typestore=typestore)
                for stamped in clouds:
                    if stamped.stamp_ns < latest:
                        raise InputError("stamps must not be negative, nor earlier than before")
                    message = _make_message(stamped, typestore.types, frame_id)
                    number, latest = number + 1, stamped.stamp_ns
                    writer.write(connection, latest, typestore.serialize_cdr(message, MESSAGE_TYPE))
            if number == 0:
                raise InputError(f"{target}: there is no cloud to write")
            if single:
                (written,) = bag.glob(f"*{MCAP_SUFFIX}")
                written.replace(target)
            else:
                shutil.move(bag, target)
    except OSError as fault:
        raise StorageError(f"{target}: cannot be written: {explain_os_error(fault)}") from fault
    return number


def read_bag(path: str | Path, topic: str | None = None) -> Iterator[StampedCloud]:
    """Read the clouds of a ROS 2 bag's folder or of an MCAP file, one after the other, whichever
    program wrote them. Points that are not finite are left out, and of columns those that `PointCloud`
    has. `topic`: by default the only one with clouds.
    """
    import_file_reader("rosbags", "tofclip[exchange]")
    from rosbags import rosbag2, typesys

    source = Path(path)
    typestore = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with guard(source, "is no ROS 2 bag, or damaged"), rosbag2.Reader(source) as reader:
        topics = [one for one in reader.connections if one.msgtype == MESSAGE_TYPE]
        chosen = [one for one in topics if topic in (None, one.topic)]
        if len({one.topic for one in chosen}) != 1:
            held = ", ".join(sorted({one.topic for one in topics})) or "none"
            raise InputError(f"{source}: choose one topic with point clouds (`topic`): {held}")
        for _, _, data in reader.messages(chosen):
            yield _read_message(typestore.deserialize_cdr(data, MESSAGE_TYPE))


def is_bag(path: Path) -> bool:
    """Return whether a path names an MCAP file or a bag's folder."""
    return path.suffix.lower() == MCAP_SUFFIX or (path / "metadata.yaml").exists()


def outline_bag(path: Path) -> dict[str, Any]:
    """Describe a bag or an MCAP file, of any messages, by its index: topics, when, how long."""
    import_file_reader("rosbags", "tofclip[exchange]")
    from rosbags import rosbag2

    with guard(path, "is no ROS 2 bag, or damaged"), rosbag2.Reader(path) as reader:
        topics = {
            name: {"type": one.msgtype, "messages": one.msgcount}
            for name, one in reader.topics.items()
        }
        start, seconds = (
            time / NANOSECONDS_PER_SECOND for time in (reader.start_time, reader.duration)
        )
        return {"kind": "ROS 2 bag", "topics": topics, "start_s": start, "seconds": seconds}


def _read_message(message: Any) -> StampedCloud:
    order = ">" if message.is_bigendian else "<"
    fields = [one for one in message.fields if one.count == 1]
    kinds = [order + NUMBERED_TYPES[one.datatype] for one in fields]
    names, offsets = [one.name for one in fields], [one.offset for one in fields]
    layout = np.dtype(
        {"names": names, "formats": kinds, "offsets": offsets, "itemsize": message.point_step}
    )
    lines = np.frombuffer(message.data, np.uint8)[: message.height * message.row_step]
    whole = lines.reshape(message.height, message.row_step)[:, : message.width * message.point_step]
    rows = np.ascontiguousarray(whole).ravel().view(layout)
    if missing := {"x", "y", "z"} - {*names}:
        raise InputError(f"its point clouds have no {', '.join(sorted(missing))}")
    xyz = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    there = np.isfinite(xyz).all(axis=1)
    known = {"time" if n == "time_of_flight" else n: rows[n][there] for n in names if n != "time"}
    stamp = message.header.stamp
    return StampedCloud(
        complete_cloud(xyz[there], known), stamp.sec * NANOSECONDS_PER_SECOND + stamp.nanosec
    )


def _make_message(stamped: StampedCloud, types: Any, frame_id: str) -> Any:
    rows = make_rows(
        [replace(one, name=NAMES.get(one.name, one.name)) for one in stamped.cloud.columns]
    )
    fields = [
        types["sensor_msgs/msg/PointField"](name, offset, FIELD_TYPES[kind.str], 1)
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
    ]
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamped.stamp_ns, NANOSECONDS_PER_SECOND))
    return types[MESSAGE_TYPE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id),
        height=1,
        width=rows.size,
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8).reshape(-1),
        is_dense=True,
    )
