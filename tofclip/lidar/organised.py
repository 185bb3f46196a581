"""Organised clouds: one point for each pixel of the picture, row by row, NaN where nothing came back.

Programs that work on neighbours take these from the rows and columns, without a search in space.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofclip.errors import InputError
from tofclip.lidar import export
from tofclip.lidar.cloud import point_cloud
from tofclip.lidar.column import Column
from tofclip.shots import Returns

ORGANISED_SUFFIXES = (".pcd", ".ply", ".npz", ".csv")
"""Formats that can say what is missing; PCD says rows and columns as well."""


def save_organised(returns: Returns, path: str | Path) -> int:
    """Write a point for every pixel, whole or not at all; return how many there are.

    `returns`: at most one for each pixel, see `Returns.select`; `path`: ends in ``.pcd`` (WIDTH and
    HEIGHT are the picture's), ``.ply``, ``.npz`` (pictures, (rows, columns)) or ``.csv``. Returns
    pixels with a point.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in ORGANISED_SUFFIXES:
        raise InputError(
            f"{path}: a file of this kind cannot hold an organised cloud; use one of "
            f"{', '.join(ORGANISED_SUFFIXES)}"
        )
    shape = returns.camera.image_shape
    pixel = returns.y.astype(np.int64) * shape[1] + returns.x
    if np.unique(pixel).size < pixel.size:
        raise InputError("an organised cloud has one point for a pixel: first, strongest or last")
    columns = []
    for column in point_cloud(returns).columns:
        whole = column.values.dtype.kind == "u"
        values = np.full(shape[0] * shape[1], 0 if whole else np.nan, column.values.dtype)
        values[pixel] = column.values
        columns.append(Column(column.name, column.unit, values))
    export.write_table(path, columns, shape)
    return len(returns)
