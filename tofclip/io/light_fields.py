"""Light fields in files: NumPy archives, our own HDF5, multi-part OpenEXR, and folders of pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.io.archive import Archive
from tofclip.io.light_field_exr import read_exr, write_exr
from tofclip.io.light_field_folder import read_folder
from tofclip.light_field import LightField
from tofclip.storage import collect_provenance


def read_light_field(path: str | Path) -> LightField:
    """Read a light field; the name's ending says how.

    Parameters
    ----------
    path : path-like
        ``.npz``: `lf` (v, u, y, x), `scale`, a factor for it, and the view numbers `v` and `u`.
        ``.h5``, ``.hdf5``: written by `write_light_field`. ``.exr``: one part for each view, named
        ``v=0,u=-1``. A folder: one picture for each view, see `tofclip.io.light_field_folder`.

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, is of another format, or lacks views.
    InputError
        The pictures hold NaN or are constant.
    """
    source = Path(path)
    if source.is_dir():
        return read_folder(source)
    if not source.exists():
        raise StorageError(f"{source}: no such file or folder")
    reader = _READERS.get(source.suffix.lower())
    if reader is None:
        raise FileFormatError(
            source, f"is not a light field; take a folder of pictures or {', '.join(_READERS)}"
        )
    return reader(source)


def write_light_field(light_field: LightField, path: str | Path) -> None:
    """Write a light field, whole or not at all, as ``.h5``, ``.hdf5`` or ``.exr`` (float32 values,
    ZIP compression).

    Parameters
    ----------
    light_field : LightField
    path : str or Path

    Raises
    ------
    InputError
        The name has another ending.
    StorageError
        The file cannot be written.
    """
    target = Path(path)
    writer = _WRITERS.get(target.suffix.lower())
    if writer is None:
        raise InputError(f"{target}: the name of a light field must end in {' or '.join(_WRITERS)}")
    writer(light_field, target)


def _read_archive(path: Path) -> LightField:
    archive = Archive(path)
    pictures = archive.array("lf", None, None, None, None)
    v, u = (
        archive.finite_array("v", pictures.shape[0]),
        archive.finite_array("u", pictures.shape[1]),
    )
    # Pictures may be stored as integers to save space; `scale` turns them into values.
    scaled = pictures.astype(np.float32) * np.float32(archive.finite_array("scale"))
    grid = np.stack(np.meshgrid(v, u, indexing="ij"), axis=-1)
    return LightField(scaled.reshape(-1, *pictures.shape[2:]), grid.reshape(-1, 2))


def _write_record(light_field: LightField, path: Path) -> None:
    replace(light_field.to_record(), provenance=collect_provenance({})).save(path)


_READERS: dict[str, Callable[[Path], LightField]] = {
    ".npz": _read_archive,
    ".h5": LightField.load,
    ".hdf5": LightField.load,
    ".exr": read_exr,
}
_WRITERS: dict[str, Callable[[LightField, Path], None]] = {
    ".h5": _write_record,
    ".hdf5": _write_record,
    ".exr": write_exr,
}
