"""Clouds with stamps as ROS 2 messages (sensor_msgs/PointCloud2), in a bag or in one MCAP file.

Through rosbags, an optional library that needs no ROS. Axes are those of an optical frame: x right,
y down, z forward. The time of flight is called ``time_of_flight`` there, because programs take a
field ``time`` for the instant at which a moving scanner saw the point.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.errors import InputError, StorageError
from tofclip.files import import_file_reader
from tofclip.lidar.cloud import PointCloud
from tofclip.lidar.export import make_rows

MCAP_SUFFIX = ".mcap"
TOPIC = "/tofclip/points"
FRAME_ID = "tofclip_optical"
MESSAGE_TYPE = "sensor_msgs/msg/PointCloud2"
FIELD_TYPES = {"<f4": 7, "|u1": 2}  # NumPy's name of a type and ROS's number for it

NANOSECONDS_PER_SECOND = 1_000_000_000


@dataclass(frozen=True)
class StampedCloud:
    """A cloud and when it was taken."""

    cloud: PointCloud
    stamp_ns: int  # nanoseconds since the epoch of the recording's clock


def write_bag(clouds: Iterable[StampedCloud], path: str | Path) -> int:
    """Write clouds as a ROS 2 recording, whole or not at all; return how many. `clouds` come in the
    order of their stamps. A `path` that ends in ``.mcap`` becomes one MCAP file, any other a
    folder, a bag in SQLite, which must not exist yet.
    """
    target = Path(path)
    single = target.suffix.lower() == MCAP_SUFFIX
    if not single and target.exists():
        raise StorageError(f"{target}: exists already; a bag is a new folder")
    import_file_reader("rosbags", "tofclip[exchange]")
    from rosbags import rosbag2, typesys

    typestore = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.MCAP if single else rosbag2.StoragePlugin.SQLITE3
    try:
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as scratch:
            bag = Path(scratch) / target.name
            # Version 8 is read by all present releases of ROS 2.
            with rosbag2.Writer(bag, version=8, storage_plugin=plugin) as writer:
                number = _write_messages(clouds, writer, typestore)
            if number == 0:
                raise InputError(f"{target}: there is no cloud to write")
            if single:
                (written,) = bag.glob(f"*{MCAP_SUFFIX}")
                written.replace(target)
            else:
                shutil.move(bag, target)
    except OSError as fault:
        raise StorageError(f"{target}: cannot be written: {fault.strerror or fault}") from fault
    return number


def _write_messages(clouds: Iterable[StampedCloud], writer: Any, typestore: Any) -> int:
    connection = writer.add_connection(TOPIC, MESSAGE_TYPE, typestore=typestore)
    number, latest = 0, 0
    for stamped in clouds:
        if stamped.stamp_ns < latest:
            raise InputError("stamps must not be negative, nor earlier than the one before")
        latest = stamped.stamp_ns
        message = _make_message(stamped, typestore.types)
        writer.write(connection, latest, typestore.serialize_cdr(message, MESSAGE_TYPE))
        number += 1
    return number


def _make_message(stamped: StampedCloud, types: Any) -> Any:
    rows = make_rows(
        {
            "time_of_flight" if column.name == "time" else column.name: column.values
            for column in stamped.cloud.columns
        }
    )
    fields = [
        types["sensor_msgs/msg/PointField"](
            name=name, offset=offset, datatype=FIELD_TYPES[kind.str], count=1
        )
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
    ]
    seconds, rest = divmod(stamped.stamp_ns, NANOSECONDS_PER_SECOND)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return types[MESSAGE_TYPE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID),
        height=1,
        width=rows.size,
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8).reshape(-1),
        is_dense=True,
    )
