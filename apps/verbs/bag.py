"""`tofclip lidar bag`: a sequence of clouds as one recording for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from apps.conventions import JsonOption, report, require_writable
from apps.progress import show_progress
from apps.verbs.cloud import CLOUD_SUFFIXES
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.lidar.ros import MCAP_SUFFIX, NANOSECONDS_PER_SECOND, StampedCloud, write_bag
from tofclip.sequences import list_files
from tofclip.sequences.ranging import PLAN_NAME


def bag(
    clouds: Annotated[
        Path,
        typer.Argument(metavar="CLOUDS", help="A folder or quoted pattern of point clouds."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="BAG",
            help="Ends in .mcap for one MCAP file; any other name is a new folder, a ROS 2 bag.",
        ),
    ],
    rate_hz: Annotated[
        float, typer.Option(metavar="HZ", help="Clouds a second, in the order of their names.")
    ] = 10.0,
    start_s: Annotated[
        float, typer.Option(metavar="S", help="Stamp of the first cloud, since the epoch.")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Write clouds with stamps as ROS 2 messages (sensor_msgs/PointCloud2 in an optical frame).

    Needs no ROS, but rosbags: pip install 'tofclip[exchange]'.

    Example: tofclip lidar bag clouds/ --out drive.mcap --rate-hz 25
    """
    if not (rate_hz > 0 and start_s >= 0):
        raise InputError("the rate must be positive and the start not negative")
    files = [
        file
        for file in list_files(clouds).values()
        if file.suffix.lower() in CLOUD_SUFFIXES and file.name != PLAN_NAME
    ]
    if not files:
        raise InputError(f"{clouds}: there is no cloud; names end in {', '.join(CLOUD_SUFFIXES)}")
    if out.suffix.lower() == MCAP_SUFFIX:
        require_writable(out, inputs=files)
    points = 0

    def read() -> Iterator[StampedCloud]:
        nonlocal points
        for number, file in enumerate(files):
            cloud = PointCloud.load(file)
            points += len(cloud)
            yield StampedCloud(cloud, round((start_s + number / rate_hz) * NANOSECONDS_PER_SECOND))
            advance(1)

    with show_progress("writing", len(files)) as advance:
        number = write_bag(read(), out)
    figures = {"clouds": number, "points": points, "seconds": (number - 1) / rate_hz}
    report(figures, as_json, [out])
