"""`tofclip cloud`: recovered frames to a point cloud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.conventions import (
    ClusterOption,
    DeviceOption,
    JsonOption,
    build_provenance,
    describe_ranges,
    report,
    require_writable,
)
from apps.sequences import report_summary, resolve_device, run_with_progress
from tofclip.errors import InputError
from tofclip.files import require_apart
from tofclip.lidar.cloud import ORGANISED_SUFFIXES
from tofclip.sequences import CloudSettings, is_sequence, list_files
from tofclip.sequences.clouds import save_cloud
from tofclip.shots import Frames
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from tofclip.lidar import PointCloud, Returns

CLOUD_SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".e57", ".h5")
DEPTH_SUFFIX = ".exr"


def cloud(
    frames: Annotated[
        Path,
        typer.Argument(
            metavar="FRAMES",
            help="Recovered frames (HDF5). A sequence: a folder or a quoted pattern of them.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Ends in .ply, .pcd, .csv, .npz, .las, .laz, .e57, .h5, or .exr for a depth picture; of a sequence: a "
            "folder.",
        ),
    ],
    drop_outliers: Annotated[
        bool,
        typer.Option(
            "--drop-outliers", help="Leave out points further from their neighbours than these are."
        ),
    ] = False,
    returns: Annotated[
        str,
        typer.Option(metavar="WHICH", help="Of each pixel: first, strongest, last or all."),
    ] = "all",
    organised: Annotated[
        bool,
        typer.Option(
            "--organised",
            help="A point for every pixel, row by row, NaN where nothing came back (.pcd, .ply, .npz, .csv); of a "
            "pixel's returns the strongest, unless --returns says which.",
        ),
    ] = False,
    false_alarm: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Drop points that are noise with a higher probability.",
            show_default="0.5",
        ),
    ] = None,
    voxel_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="One point for each cube of this side.", show_default="all points"
        ),
    ] = None,
    suffix: Annotated[
        str, typer.Option(metavar=".EXT", help="Format of the clouds of a sequence.")
    ] = ".ply",
    cluster: ClusterOption = None,
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Find each pixel's returns and place them in space: x right, y down, z forward, in metres.

    Columns of a point: intensity, range with its standard deviation (range_sigma), number within the
    pixel, time of flight; where known the probability that it is noise (false_alarm) and the
    surface's reflectance in percent (see calibrate range).

    Of a sequence, clouds that are in the folder already are kept; frames of which none can be made
    are listed at the end, and the exit status is 1.

    Example: tofclip cloud frames.h5 --out scene.ply

    Example: tofclip cloud frames.h5 --out scene.pcd --returns first --organised

    Example: tofclip cloud 'frames/*.h5' --out clouds/ --cluster local
    """
    clouds = CloudSettings(
        drop_outliers,
        None if voxel_mm is None else voxel_mm * MILLIMETRE,
        device,
        # A pixel has one place in an organised cloud.
        "strongest" if organised and returns == "all" else returns,
        organised,
        false_alarm,
    )
    used = resolve_device(device, cluster)
    if is_sequence(frames):
        _convert_sequence(clouds, frames, out, suffix, (cluster, used, as_json))
        return
    # An option without effect is refused rather than ignored.
    if cluster is not None:
        raise InputError(
            f"{frames}: --cluster is for a sequence: a folder or a quoted pattern of frames"
        )
    _convert_single(clouds, frames, (out, used), as_json)


def require_format(suffix: str, *further: str) -> None:
    """Refuse an ending that names no format of clouds."""
    if suffix not in (*CLOUD_SUFFIXES, *further):
        raise InputError(
            f"no cloud format is called '{suffix}'; use one of {', '.join((*CLOUD_SUFFIXES, *further))}"
        )


def _convert_sequence(
    clouds: CloudSettings, frames: Path, out: Path, suffix: str, how: tuple[str | None, str, bool]
) -> None:
    require_format(suffix, DEPTH_SUFFIX)
    require_apart([out], [frames])
    cluster, device, as_json = how
    jobs = clouds.jobs(list_files(frames), out, suffix)
    points: list[int] = []
    summary = run_with_progress(
        "placing", jobs, cluster, lambda report: points.append(report.figures or 0)
    )
    report_summary(summary, len(jobs), as_json, out, {"points": sum(points), "device": device})


def _convert_single(
    clouds: CloudSettings, frames: Path, made: tuple[Path, str], as_json: bool
) -> None:
    out, _ = made
    suffixes = ORGANISED_SUFFIXES if clouds.organised else (*CLOUD_SUFFIXES, DEPTH_SUFFIX)
    require_writable(out, *suffixes, inputs=(frames,))
    recovered = Frames.load(frames)
    # The cloud carries the history of its frames, and so that of the shot.
    past = build_provenance({"verb": "cloud"}, frames, earlier=recovered.provenance)
    points, returns = clouds.make_cloud(replace(recovered, provenance=past), str(frames))
    save_cloud(points, returns, out, clouds.organised)
    _report_cloud(points, returns, as_json, made, describe_ranges(recovered))


def _report_cloud(
    points: PointCloud, returns: Returns, as_json: bool, made: tuple[Path, str], note: str
) -> None:
    (rows, columns), (out, device) = returns.camera.image_shape, made
    figures = {
        "points": len(points),
        "range_m": [points.range.min(), points.range.max()],
        "returns_per_pixel_mean": len(points) / (rows * columns),
        "device": device,
    }
    report(figures, as_json, [out], note)
