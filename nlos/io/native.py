"""Our own HDF5 files: captures, and recovered frames of a relay wall."""

from __future__ import annotations

from pathlib import Path

from nlos.capture import Capture
from tofclip.errors import FileFormatError
from tofclip.storage import Record


def read_native(path: str | Path) -> Capture | None:
    """Read a capture, or take one out of recovered frames; None if the HDF5 file is not one of
    ours.
    """
    import h5py

    from tofclip.shots import Frames

    try:
        with h5py.File(path, "r") as file:
            own = "format" in file.attrs
    except OSError as fault:
        raise FileFormatError(path, "is a truncated or damaged HDF5 file") from fault
    if not own:
        return None
    record = Record.load(path, "capture", "frames")
    if record.kind == "capture":
        return Capture.from_record(record)
    return Capture.from_frames(Frames.from_record(record))
