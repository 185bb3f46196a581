"""Light fields in multi-part OpenEXR: one part for each view, as renderers write stereo pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.io.exr import Channels, read_exr_parts
from tofclip.io.light_field_folder import compute_luminance
from tofclip.light_field import LightField
from tofclip.storage import atomic_path

NUMBER_PATTERN = r"([-+]?\d+(?:\.\d+)?)"
PART_NAME_PATTERN = re.compile(rf"v={NUMBER_PATTERN},u={NUMBER_PATTERN}")


def read_exr(path: Path) -> LightField:
    """Read the parts named like ``v=-1,u=0``, with a channel Y or with R, G and B.

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, a part has another name or channels, or the parts differ in size.
    """
    named = read_exr_parts(path)
    pictures = [_read_luminance(path, name, channels) for name, channels in named]
    if len({picture.shape for picture in pictures}) != 1:
        raise FileFormatError(path, "its parts differ in size; every view must have as many pixels")
    return LightField(np.stack(pictures), np.array([_parse_view(path, name) for name, _ in named]))


def write_exr(light_field: LightField, path: Path) -> None:
    """Write one part for each view with a channel Y of float32.

    Parameters
    ----------
    light_field : LightField
    path : Path
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [
        # The library writes wrong pixels of arrays that are not contiguous, and the part's name
        # into the header.
        OpenEXR.Part(
            dict(header), {"Y": np.ascontiguousarray(picture, np.float32)}, f"v={v:g},u={u:g}"
        )
        for picture, (v, u) in zip(light_field.pictures, light_field.views.tolist(), strict=True)
    ]
    with atomic_path(path) as temporary:
        OpenEXR.File(parts).write(str(temporary))


def _parse_view(path: Path, name: str) -> tuple[float, float]:
    found = PART_NAME_PATTERN.fullmatch(name)
    if found is None:
        raise FileFormatError(
            path, f"part '{name}' does not say which view it is; name it like 'v=0,u=-1'"
        )
    return float(found[1]), float(found[2])


def _read_luminance(path: Path, name: str, channels: Channels) -> NDArray[Any]:
    if "Y" in channels:
        return channels["Y"].astype(np.float32)
    if not {"R", "G", "B"} <= channels.keys():
        raise FileFormatError(
            path, f"part '{name}' needs a channel Y or R, G and B, found {', '.join(channels)}"
        )
    return compute_luminance(np.stack([channels[colour] for colour in "RGB"], axis=-1))
