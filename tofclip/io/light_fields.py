"""Reading light fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofclip.io.archive import Archive
from tofclip.light_field import LightField


def read_light_field(path: str | Path) -> LightField:
    """Read an ``.npz`` light field.

    Parameters
    ----------
    path : path-like
        Holds `lf` (v, u, y, x), `scale`, a factor for it, and the view numbers `v` and `u`.

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, or an entry is absent or of another shape.
    InputError
        The pictures hold NaN or are constant.
    """
    archive = Archive(path)
    pictures = archive.array("lf", None, None, None, None)
    v, u = archive.finite("v", pictures.shape[0]), archive.finite("u", pictures.shape[1])
    scaled = pictures.astype(np.float32) * np.float32(archive.finite("scale"))
    grid = np.stack(np.meshgrid(v, u, indexing="ij"), axis=-1)
    return LightField(scaled.reshape(-1, *pictures.shape[2:]), grid.reshape(-1, 2))
