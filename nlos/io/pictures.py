"""Folders of streak images from transient renderers: one EXR per wall row, whose columns are time
bins.

Renderers write a transient picture (row, column, t) as one picture (column, t) for each row,
numbered from the top; the geometry, which the pictures do not hold, stands in ``geometry.toml``
beside them::

    bin_width_ps = 10.0
    start_m = 0.0          # path that the first column holds, legs to and from the devices taken off
    wall_corners_m = [[-1, -1, 0], [1, -1, 0], [-1, 1, 0]]  # top left, top right, bottom left
    laser_m = [0, 0, 0]    # the spot on the wall; "confocal" where each point is lit in turn

(The layout is that of A. Jarabo, J. Marco et al., "A framework for transient rendering", ACM Trans.
Graph. 33, 177 (2014).)
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from tofclip.errors import FileFormatError
from tofclip.files import format_error_line
from tofclip.io.light_fields import read_exr_parts
from tofclip.units import PICOSECOND

GEOMETRY_FILE = "geometry.toml"
GEOMETRY_KEYS = {"bin_width_ps", "start_m", "wall_corners_m", "laser_m"}
CONFOCAL_LASER = "confocal"


def read_streak_folder(folder: str | Path) -> Capture:
    """Read all EXR files of a folder, in the order of the numbers in their names; colours are
    averaged.
    """
    folder = Path(folder)
    files = sorted(folder.glob("*.exr"), key=_parse_file_number)
    if not files:
        raise FileFormatError(folder, "is a folder without EXR files: no capture")
    rows = [_read_picture(file) for file in files]
    for file, row in zip(files, rows, strict=True):
        if row.shape != rows[0].shape:
            raise FileFormatError(
                file, f"is {row.shape} pixels, but {files[0].name} is {rows[0].shape}"
            )
    geometry = _read_geometry(folder / GEOMETRY_FILE)
    signal = np.moveaxis(np.stack(rows), 2, 0)
    corners = _read_numbers(folder, geometry, "wall_corners_m", (3, 3))
    wall = _build_wall(corners, signal.shape[1:])
    laser = (
        wall
        if geometry["laser_m"] == CONFOCAL_LASER
        else _read_numbers(folder, geometry, "laser_m", (3,))
    )
    bin_width, start = (
        float(_read_numbers(folder, geometry, name, ())) for name in ("bin_width_ps", "start_m")
    )
    return Capture(signal, wall, laser, bin_width * PICOSECOND, start)


def _parse_file_number(path: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.stem


def _read_picture(path: Path) -> NDArray[np.float32]:
    """Brightness (column, t): mean of all channels but alpha and depth."""
    parts = read_exr_parts(path)
    channels = {name: pixels.astype(np.float32) for name, pixels in parts[0][1].items()}
    colours = [
        pixels for name, pixels in channels.items() if name.split(".")[-1] in ("R", "G", "B", "Y")
    ]
    if not colours:
        raise FileFormatError(
            path, f"holds the channels {', '.join(channels)}, none of which is R, G, B or Y"
        )
    return np.asarray(np.mean(colours, axis=0, dtype=np.float32))


def _read_geometry(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise FileFormatError(
            path.parent,
            f"has EXR files but no {GEOMETRY_FILE} with {', '.join(sorted(GEOMETRY_KEYS))}",
        )
    try:
        geometry = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise FileFormatError(path, f"is not TOML ({format_error_line(fault)})") from fault
    if set(geometry) != GEOMETRY_KEYS:
        wrong = ", ".join(sorted(set(geometry) ^ GEOMETRY_KEYS))
        raise FileFormatError(
            path,
            f"must hold exactly {', '.join(sorted(GEOMETRY_KEYS))}; lacking or unknown: {wrong}",
        )
    return geometry


def _read_numbers(
    folder: Path, geometry: Mapping[str, Any], name: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    try:
        values = np.array(geometry[name], dtype=np.float64)
    except (TypeError, ValueError):
        values = np.full((0,), np.nan)
    if values.shape != shape or not np.all(np.isfinite(values)):
        raise FileFormatError(
            folder / GEOMETRY_FILE,
            f"{name} must be numbers of shape {shape}, found {geometry[name]}",
        )
    return values


def _build_wall(corners: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    top_left, top_right, bottom_left = corners
    down, right = (np.linspace(0, 1, n) for n in shape)
    across = right[:, np.newaxis] * (top_right - top_left)
    return np.asarray(
        top_left + across + down[:, np.newaxis, np.newaxis] * (bottom_left - top_left)
    )
