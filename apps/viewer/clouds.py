"""Point clouds in files, one or many in a row."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.verbs.photons import DEFAULT_FIELD_OF_VIEW_DEG
from apps.viewer.shot_recovery import find_min_intensity
from apps.viewer.source import Source, View
from tofclip.errors import FileFormatError, InputError
from tofclip.lidar import PointCloud
from tofclip.lidar.cloud import OPTIONAL_COLUMNS
from tofclip.lidar.export import read_table
from tofclip.lidar.geometry import compute_ray_directions
from tofclip.lidar.photons import make_pinhole
from tofclip.loading import load, outline
from tofclip.storage import Record
from tofclip.units import SPEED_OF_LIGHT

CLOUD_SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".e57")
CLOUD_RATE_HZ = 10.0
MAX_CACHED_CLOUDS = 32


class CloudSource(Source):
    """Clouds in files, shown one after the other.

    `paths`: in order.

    Memory: the last 32 clouds looked at.
    """

    def __init__(self, title: str, paths: Sequence[Path]) -> None:
        super().__init__(title, CLOUD_RATE_HZ, frame_name="cloud")
        self._paths = list(paths)
        self._cache: OrderedDict[int, View] = OrderedDict()
        if not self._paths:
            raise InputError(f"{title}: there is no cloud to show")
        cloud = self.view(0).cloud
        # Of a cloud of this program: the dim rays that few views leave around bright things would
        # hide the others. What intensities of other programs mean is not known.
        if np.any(cloud.range_sigma > 0):
            self.min_intensity = find_min_intensity(cloud)

    def __len__(self) -> int:
        return len(self._paths)

    def describe_frame(self, number: int) -> str:
        """Name the file of cloud `number`."""
        return self._paths[number].name if len(self._paths) > 1 else ""

    def view(self, number: int) -> View:
        if number not in self._cache:
            self._cache[number] = View(read_cloud(self._paths[number]))
            if len(self._cache) > MAX_CACHED_CLOUDS:
                # The entry that was read first.
                self._cache.popitem(last=False)
        return self._cache[number]


def find_clouds(folder: Path) -> list[Path]:
    """Return the files of a folder that are clouds by their names, in order."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in CLOUD_SUFFIXES and path.name[0] != "."
    )


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud of this program, or another's table of points with at least x, y and z in
    metres.
    """
    if path.suffix.lower() == ".h5":
        return PointCloud.load(path)
    record = None if path.suffix.lower() not in (".npz", ".exr") else outline(path)
    if record is not None and record.kind in ("range image", "depth picture"):
        return _place_pixels(load(path))
    table = read_table(path)
    if missing := [axis for axis in "xyz" if axis not in table]:
        raise FileFormatError(path, f"has no column '{missing[0]}', so it is not a point cloud")
    xyz = np.stack([table[axis] for axis in "xyz"], axis=-1)
    return make_cloud(xyz[np.all(np.isfinite(xyz), axis=1)] if len(table) == 3 else xyz, table)


def _place_pixels(picture: Record) -> PointCloud:
    """Points of a picture that does not say its camera, seen by a pinhole of the field of view that
    `tofclip lidar photons` takes where none is given: ranges are the file's, widths are not.
    """
    fields = {name: one.values for name, one in picture.fields.items()}
    distance = fields["range_m"] if "range_m" in fields else fields.get("Z")
    if distance is None or distance.ndim != 2:
        raise FileFormatError(picture.origin, "has no picture of ranges or depths to show")
    rows, columns = np.nonzero(np.isfinite(distance) & (distance > 0))
    focal_length_px = distance.shape[1] / 2 / np.tan(np.deg2rad(DEFAULT_FIELD_OF_VIEW_DEG) / 2)
    camera = make_pinhole(distance.shape, float(focal_length_px), 1e-10)
    rays = compute_ray_directions(camera, rows, columns)
    rays /= rays[:, 2:] if "range_m" not in fields else 1
    brightness = fields.get("intensity", fields.get("Y", np.ones_like(distance)))
    return make_cloud(
        distance[rows, columns, np.newaxis] * rays, {"intensity": brightness[rows, columns]}
    )


def make_cloud(xyz: NDArray[Any], known: dict[str, NDArray[Any]] | None = None) -> PointCloud:
    """Make a cloud of positions; what is not known follows from them, or is 0.

    `xyz` (n, 3): m; `known`: columns by their names; ``"brightness"`` counts as intensity.
    """
    known = known or {}
    distance = np.linalg.norm(xyz, axis=1)
    nothing = np.zeros(len(xyz), np.float32)
    columns: dict[str, Any] = {
        "intensity": known.get("intensity", known.get("brightness", nothing)),
        # Files of earlier versions call it confidence.
        "range_sigma": known.get("range_sigma", known.get("confidence", nothing)),
        "range": known.get("range", distance),
        "return_number": known.get("return_number", np.ones(len(xyz), np.uint8)),
        # Light travels the range twice.
        "time": known.get("time", 2 * distance / SPEED_OF_LIGHT),
        **{name: known[name] for name in OPTIONAL_COLUMNS if name in known},
    }
    return PointCloud(xyz=xyz, **columns)
