"""Open any of our files."""

from __future__ import annotations

import math
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

from tofclip.errors import require_path
from tofclip.files import guard, translate_read_errors
from tofclip.io import read_streak
from tofclip.io.archive import Archive
from tofclip.io.light_fields import read_exr_parts, read_light_field
from tofclip.io.streaks import outline_streak_file
from tofclip.lidar import PointCloud
from tofclip.lidar.export import FORMATS
from tofclip.storage import (
    HDF5_SIGNATURE,
    Field,
    Record,
    is_own_file,
    make_stand_in,
    read_outline,
)

# Where the object of each kind of record is made; `nlos` is named, not imported: it builds on this
# package, as do recordings' readers.
HOMES = {
    "camera": ("tofclip.camera", "Camera"),
    "capture": ("nlos", "Capture"),
    "clip_measurement": ("tofclip.light_field", "ClipMeasurement"),
    "cloud": ("tofclip.lidar", "PointCloud"),
    "frames": ("tofclip.shots", "Frames"),
    "light_field": ("tofclip.light_field", "LightField"),
    "returns": ("tofclip.shots", "Returns"),
    "streak": ("tofclip.shots", "Streak"),
    "volume": ("nlos", "Volume"),
}
CLOUD_SUFFIXES = tuple(FORMATS)
EXR_SIGNATURE, NPZ_SIGNATURE = b"\x76\x2f\x31\x01", b"PK\x03\x04"


def load(path: str | Path) -> Any:
    """Open a file of ours, whatever it holds, or a streak image or capture of others.

    Parameters
    ----------
    path : path-like
        HDF5, a point cloud in any format that `PointCloud.save` writes, a range image of
        ``tofclip lidar photons``, a depth picture (OpenEXR), a recording, settings (TOML), a light
        field's ``.npz`` (`lf`, `u`, `v`, `scale`), or what `read_streak` and
        `nlos.io.read_capture` read.

    Returns
    -------
    Frames, PointCloud, Streak, Camera, LightField, nlos.Volume or nlos.Capture
        For another kind of record, such as a recording's head, a range image, a depth picture or
        settings, a `tofclip.storage.Record`.

    Raises
    ------
    StorageError
        The file cannot be read.
    FileFormatError
        It is damaged, or of an unknown format.

    Examples
    --------
    >>> import tofclip
    >>> frames = tofclip.load("frames.h5")  # doctest: +SKIP
    """
    record, content = _open(path, values=True)
    if content is not None:
        return content
    if record.kind not in HOMES:
        return record
    module, name = HOMES[record.kind]
    return getattr(import_module(module), name).from_record(record)


def outline(path: str | Path) -> Record:
    """Describe what `load` would open, without reading values that may not fit into memory."""
    return _open(path, values=False)[0]


def _open(path: str | Path, values: bool) -> tuple[Record, Any]:
    """Return a file's record; and where `values` of other formats are asked for, what they make,
    the record being empty then. The first line that fits says what a file is: by its content,
    because suffixes get lost.
    """
    require_path(path)
    file = Path(path)
    with translate_read_errors(file), open(file, "rb") as opened:
        start = opened.read(len(HDF5_SIGNATURE))
    head = import_module("devices.recording.read").read_head_if_recording(file)
    if head is not None:
        return head, None
    if start.startswith((NPZ_SIGNATURE, b"MATLAB")) or (
        start == HDF5_SIGNATURE and not is_own_file(file)
    ):
        captures = import_module("nlos.io.format_detection")
        if arrays := captures.list_capture_arrays(file, start):
            if values:
                return Record(""), captures.read_capture(file)
            return _describe_archive(arrays, "capture"), None
    if start == HDF5_SIGNATURE:
        return (Record.load if values else read_outline)(file), None
    if start.startswith(EXR_SIGNATURE):
        return _open_depth_picture(file), None
    if file.suffix.lower() == ".toml":
        with guard(file, "is not TOML"):
            settings = tomllib.loads(file.read_text("utf-8"))
        return Record("settings", provenance=settings, origin=str(file)), None
    is_cloud = file.suffix.lower() in CLOUD_SUFFIXES
    if start.startswith(NPZ_SIGNATURE):
        archive = Archive(file)
        is_cloud = is_cloud and not archive.names.isdisjoint(("x", "x_m"))  # else maybe a LIFT shot
        if not is_cloud and "range_m" in archive:
            return _describe_archive(archive, "range image", values, "y", "x", "return"), None
        if not is_cloud and archive.names.issuperset(("lf", "u", "v")):
            if values:
                return Record(""), read_light_field(file)
            return _describe_archive(archive, "light_field"), None
    if values:
        return Record(""), PointCloud.load(file) if is_cloud else read_streak(file)
    return PointCloud.read_outline(file) if is_cloud else outline_streak_file(file), None


def _describe_archive(archive: Archive, kind: str, values: bool = False, *axes: str) -> Record:
    """A file of named arrays, whose names end in units. Without `values` only numbers are read."""
    fields = {}
    for name in sorted(archive.names):
        entry = archive.describe(name)
        is_read = values or math.prod(entry.shape) == 1
        content = archive.read(name) if is_read else make_stand_in(entry.shape, entry.dtype)
        units = {"m": "m", "s": "s", "percent": "percent"}.get(name.rpartition("_")[2], "")
        fields[name] = Field(content, units, axes[: len(entry.shape)])
    return Record(kind, fields, origin=str(archive.path))


def _open_depth_picture(file: Path) -> Record:
    """Channels of an OpenEXR picture, such as depth (Z) and intensity (Y) of the returns."""
    (_, channels), *_ = read_exr_parts(file)
    units = {"Z": "m", "Y": "count"}
    fields = {
        name: Field(pixels, units.get(name, ""), ("y", "x")) for name, pixels in channels.items()
    }
    return Record("depth picture", fields, origin=str(file))
