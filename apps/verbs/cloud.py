"""`tofclip cloud`: recovered frames to a point cloud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.options import AsJson
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from tofclip.lidar import PointCloud, Returns
    from tofclip.transient import Frames

FORMATS = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".h5")
DEPTH_PICTURE = ".exr"


def cloud(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="Recovered frames (HDF5).")],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="Ends in .ply, .pcd, .csv, .npz, .las, .laz, .h5, or .exr for a depth picture."
        ),
    ],
    drop_outliers: Annotated[
        bool, typer.Option("--drop-outliers", help="Leave out points far from their neighbours.")
    ] = False,
    voxel_mm: Annotated[
        float | None,
        typer.Option(metavar="MM", help="One point for each cube of this side.", show_default="all points"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find each pixel's returns and place them in space: x right, y down, z forward, in metres.

    Example: tofclip cloud frames.h5 --out scene.ply
    """
    from apps.files import history, require_writable
    from tofclip.transient import Frames

    require_writable(out, *FORMATS, DEPTH_PICTURE, inputs=(frames,))
    recovered = Frames.load(frames)
    past = history({"verb": "cloud"}, frames, earlier=recovered.provenance)
    points, returns = _found(replace(recovered, provenance=past), str(frames))
    if drop_outliers or voxel_mm is not None:
        points = _tidied(points, drop_outliers, voxel_mm)
    if out.suffix.lower() == DEPTH_PICTURE:
        from tofclip.lidar.depth_exr import save_depth

        save_depth(returns, out)
    else:
        points.save(out)
    _report(points, returns, as_json, out)


def _tidied(points: PointCloud, drop_outliers: bool, voxel_mm: float | None) -> PointCloud:
    from tofclip.lidar.processing import downsampled, without_outliers

    cleaned = without_outliers(points) if drop_outliers else points
    return cleaned if voxel_mm is None else downsampled(cleaned, voxel_mm * MILLIMETRE)


def save_cloud(frames: Frames, out: Path) -> Path:
    """Write the point cloud of frames that were just recovered, and return where."""
    points, _ = _found(frames, "the recovered frames")
    points.save(out)
    return out


def _found(frames: Frames, origin: str) -> tuple[PointCloud, Returns]:
    from tofclip.errors import InputError
    from tofclip.lidar import depth, point_cloud

    returns = depth(frames)
    if len(returns) == 0:
        raise InputError(f"{origin}: no return stands out of the background, so there is no point to write")
    return replace(point_cloud(returns), provenance=frames.provenance), returns


def _report(points: PointCloud, returns: Returns, as_json: bool, out: Path) -> None:
    from apps.report import report

    rows, columns = returns.camera.image_shape
    figures = {
        "points": len(points),
        "range_m": [points.range.min(), points.range.max()],
        "returns_per_pixel_mean": len(points) / (rows * columns),
    }
    report(figures, as_json, [out])
