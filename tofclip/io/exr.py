"""OpenEXR files of unknown origin: header first, pixels only if the file can hold them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, MissingDependencyError
from tofclip.files import format_error_line, require_bounded_size, translate_read_errors

MAX_SAMPLE_BYTES = 4
"""Samples are half or single precision, or 32-bit integers."""

Channels = dict[str, NDArray[Any]]


def read_exr_parts(path: Path) -> list[tuple[str, Channels]]:
    """Read name and channels of every part."""
    try:
        import OpenEXR
    except ImportError as fault:
        raise MissingDependencyError(
            f"reading {path} needs OpenEXR: {format_error_line(fault)}"
        ) from fault
    with translate_read_errors(path):
        held = os.path.getsize(path)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            sizes = [_count_bytes(part.header) for part in file.parts]
        require_bounded_size(path, "pixels", sum(sizes), held, compressed=True)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [
                (part.name(), {name: part.channels[name].pixels for name in part.channels})
                for part in file.parts
            ]
    except (FileFormatError, MemoryError):
        raise
    except Exception as fault:  # whatever the decoder stumbles over, it is the file that is damaged
        raise FileFormatError(
            path, f"is a truncated or damaged EXR file ({format_error_line(fault)})"
        ) from fault
    if len(parts) != len(sizes):  # the library leaves out the parts that it cannot decode
        raise FileFormatError(path, "is a truncated or damaged EXR file (a part cannot be decoded)")
    return parts


def _count_bytes(header: dict[str, Any]) -> int:
    first, last = (np.asarray(corner, np.int64).tolist() for corner in header["dataWindow"])
    columns, rows = (b - a + 1 for a, b in zip(first, last, strict=True))
    return int(rows * columns * len(header["channels"]) * MAX_SAMPLE_BYTES)
