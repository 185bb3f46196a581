"""Open any of our files."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from tofclip.errors import FileFormatError, require_path
from tofclip.files import translate_read_errors
from tofclip.io import read_streak
from tofclip.lidar import PointCloud
from tofclip.storage import Record

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

HOMES = {
    "camera": ("tofclip.camera", "Camera"),
    "capture": ("nlos", "Capture"),
    "cloud": ("tofclip.lidar", "PointCloud"),
    "frames": ("tofclip.shots", "Frames"),
    "streak": ("tofclip.shots", "Streak"),
    "volume": ("nlos", "Volume"),
}
"""Where the object of each kind of record is made. `nlos` is named, not imported: it builds on this
package.
"""

CLOUD_SUFFIXES = (".ply", ".pcd", ".csv", ".npz", ".las", ".laz", ".e57")


def load(path: str | Path) -> Any:
    """Open a file of ours, whatever it holds, or a streak image of another program.

    Parameters
    ----------
    path : path-like
        HDF5, a point cloud in any format that `PointCloud.save` writes, or what `read_streak` reads.

    Returns
    -------
    Frames, PointCloud, Streak, Camera, nlos.Volume or nlos.Capture
        For another kind of record, a `tofclip.storage.Record`.

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
    require_path(path)
    file = Path(path)
    with translate_read_errors(file), open(file, "rb") as opened:
        start = opened.read(len(HDF5_SIGNATURE))
    if start != HDF5_SIGNATURE:
        if file.suffix.lower() not in CLOUD_SUFFIXES:
            return read_streak(file)
        try:
            return PointCloud.load(file)
        except FileFormatError:
            if file.suffix.lower() != ".npz":
                raise
            return read_streak(file)  # an archive that is not a point cloud may be a LIFT shot
    record = Record.load(file)
    if record.kind not in HOMES:
        return record
    module, name = HOMES[record.kind]
    return getattr(import_module(module), name).from_record(record)
