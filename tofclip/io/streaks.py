"""Read a streak image, whichever program wrote it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from tofclip.errors import FileFormatError, require_path
from tofclip.io.itex import SIGNATURE as ITEX_SIGNATURE
from tofclip.io.itex import outline_itex, read_itex
from tofclip.io.lift import outline_lift, read_lift
from tofclip.io.tiff import outline_tiff, read_tiff
from tofclip.shots import Streak
from tofclip.storage import (
    HDF5_SIGNATURE,
    Record,
    collect_provenance,
    read_outline,
    translate_read_errors,
)

# A file is known by its first bytes: suffixes get lost and lie.
READERS: dict[bytes, tuple[Callable[[str | Path], Streak], Callable[[str | Path], Record]]] = {
    b"II*\0": (read_tiff, outline_tiff),
    b"MM\0*": (read_tiff, outline_tiff),
    b"PK\x03\x04": (read_lift, outline_lift),
    HDF5_SIGNATURE: (Streak.load, read_outline),
    ITEX_SIGNATURE: (read_itex, outline_itex),
}


def read_streak(path: str | Path, bin_width: float | None = None) -> Streak:
    """Read a streak image: rows are instants, columns are slit pixels.

    The format is recognised by content: a TIFF of Hamamatsu's HPD-TA with its text and time axis,
    the same program's ITEX (``.img``), any other grey TIFF (no time axis), a LIFT archive
    (``.npz``) with its camera, or a streak image of our own (HDF5).

    Parameters
    ----------
    path : path-like
    bin_width : float, optional
        Duration of a row, s. Overrides the file's own time axis: rows are then evenly spaced, the
        first at 0.

    Returns
    -------
    Streak
        Raw counts as the file has them: no background or offset is taken off. `Streak.times` raises
        `MissingTimeAxisError` where neither the file nor `bin_width` gives a time axis.

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is empty, truncated, damaged or of another format.
    InputError
        Its pixels hold NaN, are all zero, all saturated, or negative where counts cannot be.
    """
    require_path(path)
    streak = _select_reader(path)[0](path)
    if bin_width is not None:
        streak = streak.with_bin_width(bin_width)
    history = collect_provenance({"bin_width_s": bin_width}, path)
    if streak.provenance:
        # A file of our own brings its history, which must not be lost under the new entry.
        history["earlier"] = dict(streak.provenance)
    return replace(streak, provenance=history)


def outline_streak_file(path: str | Path) -> Record:
    """Describe the streak image in a file without reading its pixels.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Record
        See `tofclip.storage.read_outline`.

    Raises
    ------
    StorageError, FileFormatError
        See `read_streak`.
    """
    outline = _select_reader(path)[1](path)
    if outline.provenance:
        return outline
    return replace(outline, provenance=collect_provenance({"bin_width_s": None}, path))


def _select_reader(
    path: str | Path,
) -> tuple[Callable[[str | Path], Streak], Callable[[str | Path], Record]]:
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(8)
    if not start:
        raise FileFormatError(path, "is empty")
    for signature, readers in READERS.items():
        if start.startswith(signature):
            return readers
    size = os.path.getsize(path)
    raise FileFormatError(
        path,
        f"is not a TIFF, ITEX (.img), LIFT archive (.npz) or HDF5 streak image ({size} bytes of something else)",
    )
