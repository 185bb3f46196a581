"""Records as HDF5 files, in which no damaged byte goes unnoticed."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.storage.files import SIGNATURE, atomic_path, one_line, reading
from tofclip.storage.record import Field, Record, Scalar

FORMAT_NAME = "tofclip"
FORMAT_VERSION = 1
# The layouts of HDF5 1.10 carry checksums; a damaged file of the older ones can hang the library.
LIBRARY_VERSIONS = ("v110", "v110")
CHUNK_CUBE = (64, 32, 32)
COMPRESS_FROM_BYTES = 1 << 16


def write(record: Record, path: str | Path) -> None:
    """Write a record to `path`, whole or not at all; see `Record.save`."""
    with atomic_path(path) as temporary:
        # HDF5 crashes the process when the disk fills up under it: it writes to memory, and Python to the disk.
        image = io.BytesIO()
        with h5py.File(image, "w", libver=LIBRARY_VERSIONS) as file:
            _write_attribute(file, "format", FORMAT_NAME)
            _write_attribute(file, "format_version", FORMAT_VERSION)
            _write_attribute(file, "provenance", json.dumps(dict(record.provenance), default=str))
            _write_group(file, record)
        temporary.write_bytes(image.getbuffer())


def read(path: str | Path) -> Record:
    """Read the record in `path`, of whatever kind; see `Record.load`."""
    with _opened(path) as file:
        found = _read_group(file, str(path))
        return replace(found, provenance=_parse_provenance(_text(file, "provenance"), path))


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[h5py.File]:
    """Open one of our HDF5 files for reading; anything else is a clear error."""
    with reading(path), open(path, "rb") as raw:
        start = raw.read(len(SIGNATURE))
    if start != SIGNATURE:
        raise FileFormatError(path, "is not an HDF5 file" if start else "is empty")
    try:
        with h5py.File(path, "r") as file:
            if _text(file, "format") != FORMAT_NAME:
                raise FileFormatError(path, "is an HDF5 file, but not one of tofclip's")
            version = int(file.attrs.get("format_version", 0))
            if version > FORMAT_VERSION:
                raise FileFormatError(path, f"has format version {version}; this program reads {FORMAT_VERSION}")
            yield file
    except (OSError, KeyError, RuntimeError) as fault:
        raise FileFormatError(path, f"is damaged or incomplete ({one_line(fault)})") from fault


def _write_group(group: h5py.Group, record: Record) -> None:
    _write_attribute(group, "kind", record.kind)
    for name, value in record.attributes.items():
        _write_attribute(group, f"value.{name}", value)
    for name, entry in record.fields.items():
        dataset = group.create_dataset(name, data=entry.values, **_storage_options(entry.values))
        _write_attribute(dataset, "units", entry.units)
        _write_attribute(dataset, "axes", ",".join(entry.axes))
    for name, child in record.children.items():
        _write_group(group.create_group(name), child)


def _write_attribute(item: h5py.Group | h5py.Dataset, name: str, value: Scalar) -> None:
    if isinstance(value, str):
        # Of fixed length, because strings of variable length lie in a heap without checksums.
        length = max(1, len(value.encode()))
        item.attrs.create(name, value.encode(), dtype=h5py.string_dtype("utf-8", length))
    else:
        item.attrs[name] = value


def _storage_options(values: NDArray[Any]) -> dict[str, Any]:
    """Checksums for every array, compression for the large ones."""
    if values.size == 0 or values.ndim == 0:
        return {}
    if values.nbytes < COMPRESS_FROM_BYTES:
        return {"chunks": values.shape, "fletcher32": True}
    chunks: tuple[int, ...] | bool = True
    if values.ndim == len(CHUNK_CUBE):
        chunks = tuple(min(c, n) for c, n in zip(CHUNK_CUBE, values.shape, strict=True))
    return {
        "chunks": chunks,
        "compression": "gzip",
        "compression_opts": 4,
        "shuffle": True,
        "fletcher32": True,
    }


def _read_group(group: h5py.Group, origin: str) -> Record:
    fields: dict[str, Field] = {}
    children: dict[str, Record] = {}
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            axes = _text(item, "axes")
            fields[name] = Field(item[()], _text(item, "units"), tuple(axes.split(",")) if axes else ())
        elif isinstance(item, h5py.Group):
            children[name] = _read_group(item, origin)
        else:
            raise FileFormatError(origin, f"is damaged: '{name}' cannot be read")
    attributes = {
        name.removeprefix("value."): _plain(value) for name, value in group.attrs.items() if name.startswith("value.")
    }
    return Record(_text(group, "kind"), fields, attributes, children, origin=origin)


def _text(item: h5py.Group | h5py.Dataset, name: str) -> str:
    return str(_plain(item.attrs.get(name, "")))


def _plain(value: Any) -> Scalar:
    """Turn an HDF5 attribute into a Python scalar."""
    plain = value.item() if isinstance(value, np.generic) else value
    text_or_number: Scalar = plain.decode() if isinstance(plain, bytes) else plain
    return text_or_number


def _parse_provenance(text: str, path: str | Path) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError as fault:
        raise FileFormatError(path, "its provenance is not JSON") from fault
    return found if isinstance(found, dict) else {}
