"""Files of our own: HDF5 records that name their units and axes.

A *record* is a tree of named arrays. Each array carries its unit and the names of its axes; the
root carries what kind of thing it is and where it came from. Every class that can be saved turns
itself into a `Record` and back, so that the layout of the file is decided here and nowhere else. No
damaged byte of a record goes unnoticed.
"""

from __future__ import annotations

import contextlib
import datetime
import io
import json
import math
import numbers
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.errors import FileFormatError, StorageError, require_path
from tofclip.files import (
    atomic_path,
    compute_sha256,
    format_error_line,
    iterate_members,
    require_bounded_dataset,
    require_suffix,
    translate_read_errors,
)
from tofclip.version import __version__

if TYPE_CHECKING:
    import h5py

Scalar = str | int | float | bool

RECORD_SUFFIXES = (".h5", ".hdf5")
"""Of names under which a record is written: a file is not called what it is not."""

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""The first bytes of every HDF5 file."""

FORMAT_NAME = "tofclip"
FORMAT_VERSION = 1
# The layouts of HDF5 1.10 carry checksums; a damaged file of the older ones can hang the library.
LIBRARY_VERSIONS = ("v110", "v110")
CUBE_CHUNK_SHAPE = (64, 32, 32)
MIN_COMPRESSED_BYTES = 1 << 16

MAX_DEPTH = 16
"""Of records within records."""

MAX_OUTLINE_VALUES = 9
"""Arrays up to this size are part of a record's outline."""


@dataclass(frozen=True)
class Field:
    """An array with its unit and the names of its axes."""

    values: NDArray[Any]
    # SI unit (``"s"``, ``"m"``, ``"rad"``), ``"px"``, ``"count"``, or ``""`` for a pure number
    units: str = ""
    axes: tuple[str, ...] = ()  # one name per dimension, e.g. ``("time", "y", "x")``


@dataclass(frozen=True)
class Record:
    """A tree of arrays and scalars, as it lies in an HDF5 file.

    Parameters
    ----------
    kind : str
        What the record describes: ``"camera"``, ``"streak"``, ``"frames"``, ``"cloud"``,
        ``"capture"``, ``"volume"``.
    fields : mapping of str to Field
    attributes : mapping of str to str, int, float or bool
    children : mapping of str to Record
        Records that travel inside this one, such as a streak image's camera.
    provenance : mapping
        How it came about; any JSON-serialisable tree.
    origin : str
        The file it was read from, for error messages.
    """

    kind: str
    fields: Mapping[str, Field] = field(default_factory=dict)
    attributes: Mapping[str, Scalar] = field(default_factory=dict)
    children: Mapping[str, Record] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    origin: str = ""

    def array(self, name: str, dtype: DTypeLike, dimensions: int, units: str = "") -> NDArray[Any]:
        """Return field `name` as a checked array.

        Parameters
        ----------
        name : str
        dtype : dtype
            Type of the result; the stored one must convert to it.
        dimensions : int
        units : str

        Returns
        -------
        contiguous array

        Raises
        ------
        FileFormatError
            The field is absent, or has another number of dimensions, another unit, or another type.
        """
        if name not in self.fields:
            raise FileFormatError(self.origin, f"{self.kind} record has no field '{name}'")
        found = self.fields[name]
        if found.values.ndim != dimensions:
            raise FileFormatError(
                self.origin,
                f"field '{name}' must have {dimensions} dimensions, found shape {found.values.shape}",
            )
        if found.units != units:
            raise FileFormatError(
                self.origin, f"field '{name}' must be in '{units}', found '{found.units}'"
            )
        if not np.can_cast(found.values.dtype, dtype, casting="same_kind"):
            raise FileFormatError(
                self.origin,
                f"field '{name}' must convert to {np.dtype(dtype)}, found {found.values.dtype}",
            )
        return np.ascontiguousarray(found.values, dtype=dtype)

    def attribute(self, name: str, default: Scalar | None = None) -> Scalar:
        """Return scalar attribute `name`, or `default` if it is absent and a default is given.

        Parameters
        ----------
        name : str
        default : scalar, optional

        Returns
        -------
        scalar

        Raises
        ------
        FileFormatError
            It is absent and there is no default.
        """
        if name in self.attributes:
            return self.attributes[name]
        if default is None:
            raise FileFormatError(self.origin, f"{self.kind} record has no attribute '{name}'")
        return default

    def number(self, name: str, default: float | None = None) -> float:
        """Return scalar attribute `name` as a finite number.

        Parameters
        ----------
        name : str
        default : float, optional
            Returned where the attribute is absent.

        Returns
        -------
        float

        Raises
        ------
        FileFormatError
            It is something else, or absent and there is no default.
        """
        found = self.attribute(name, default)
        if not isinstance(found, numbers.Real) or not math.isfinite(found):
            raise FileFormatError(
                self.origin, f"attribute '{name}' must be a number, found {found}"
            )
        return float(found)

    def child(self, name: str, kind: str) -> Record:
        """Return the record that travels inside this one under `name`.

        Parameters
        ----------
        name : str
        kind : str

        Returns
        -------
        Record

        Raises
        ------
        FileFormatError
            There is none of that kind.
        """
        found = self.children.get(name)
        if found is None or found.kind != kind:
            raise FileFormatError(self.origin, f"{self.kind} record carries no {kind} '{name}'")
        return found

    def save(self, path: str | Path, compressed: bool = True) -> None:
        """Write the record to `path`, whole or not at all.

        Parameters
        ----------
        path : str or Path
        compressed : bool
            Whether large arrays are made smaller, which takes ten times as long as writing them.

        Raises
        ------
        StorageError
            The disk is full, the folder is missing or writing is not allowed; `path` is left as it
            was.
        """
        write_record(self, path, compressed)

    @classmethod
    def load(cls, path: str | Path, *kinds: str) -> Record:
        """Read a record, refusing any other kind than those named (none named: any kind)."""
        found = read_record(path)
        if kinds and found.kind not in kinds:
            wanted = " or ".join(kinds)
            raise FileFormatError(path, f"holds a {found.kind} record, expected {wanted}")
        return found


def write_record(record: Record, path: str | Path, compressed: bool = True) -> None:
    """Write a record to `path`, whole or not at all; see `Record.save`."""
    import h5py

    if Path(path).suffix:
        require_suffix(path, *RECORD_SUFFIXES)
    with atomic_path(path) as temporary:
        # HDF5 crashes the process when the disk fills up under it: it writes to memory, and Python
        # to the disk.
        image = io.BytesIO()
        with h5py.File(image, "w", libver=LIBRARY_VERSIONS) as file:
            _write_attribute(file, "format", FORMAT_NAME)
            _write_attribute(file, "format_version", FORMAT_VERSION)
            _write_attribute(file, "provenance", json.dumps(dict(record.provenance), default=str))
            _write_group(file, record, compressed)
        with image.getbuffer() as content, temporary.open("wb") as target:
            target.write(content)


def read_record(path: str | Path) -> Record:
    """Read the record in `path`, of whatever kind; see `Record.load`."""
    require_path(path)
    return _read_file(path, _read_values)


def read_outline(path: str | Path) -> Record:
    """Read what kind of record `path` holds, its attributes, and shape, type, unit and axes of its
    arrays.

    Returns arrays of more than `MAX_OUTLINE_VALUES` values are stand-ins (`make_stand_in`): no file
    is too large for this.
    """
    return _read_file(path, _read_few_values)


def is_own_file(path: str | Path) -> bool:
    """Whether a file says that it is one of our HDF5 files, be it damaged otherwise."""
    import h5py

    with (
        contextlib.suppress(OSError, RuntimeError, TypeError, ValueError),
        h5py.File(path, "r") as file,
    ):
        return _read_text(file, "format") == FORMAT_NAME
    return False


def make_stand_in(shape: Sequence[int], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of that shape and type that takes no memory; all its values are the same."""
    return np.broadcast_to(np.zeros((), dtype), tuple(shape))


def is_stand_in(values: NDArray[Any]) -> bool:
    """Whether an array came from `make_stand_in`."""
    return values.ndim > 0 and not any(values.strides)


def _read_file(path: str | Path, read_dataset: Callable[[h5py.Dataset, str], Any]) -> Record:
    with _open_file(path) as file:
        found = _read_group(file, str(path), read_dataset)
        return replace(found, provenance=_parse_provenance(_read_text(file, "provenance"), path))


def _read_values(dataset: h5py.Dataset, origin: str) -> Any:
    require_bounded_dataset(dataset, origin)
    return dataset[()]


def _read_few_values(dataset: h5py.Dataset, origin: str) -> Any:
    require_bounded_dataset(dataset, origin, at_once=0)
    if math.prod(dataset.shape) > MAX_OUTLINE_VALUES:
        return make_stand_in(dataset.shape, dataset.dtype)
    return dataset[()]


@contextlib.contextmanager
def _open_file(path: str | Path) -> Iterator[h5py.File]:
    """Open one of our HDF5 files for reading; anything else is a clear error."""
    import h5py

    with translate_read_errors(path), open(path, "rb") as raw:
        start = raw.read(len(HDF5_SIGNATURE))
    if start != HDF5_SIGNATURE:
        raise FileFormatError(path, "is not an HDF5 file" if start else "is empty")
    try:
        with h5py.File(path, "r") as file:
            if _read_text(file, "format") != FORMAT_NAME:
                raise FileFormatError(path, "is an HDF5 file, but not one of tofclip's")
            version = int(_to_scalar(file.attrs.get("format_version", 0)))
            if version > FORMAT_VERSION:
                raise FileFormatError(
                    path, f"has format version {version}; this program reads {FORMAT_VERSION}"
                )
            yield file
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, OverflowError) as fault:
        if isinstance(fault, FileFormatError):
            raise
        raise FileFormatError(
            path, f"is damaged or incomplete ({format_error_line(fault)})"
        ) from fault
    except MemoryError as fault:
        raise StorageError(f"{path}: does not fit into this computer's memory") from fault


def _write_group(group: h5py.Group, record: Record, compressed: bool) -> None:
    _write_attribute(group, "kind", record.kind)
    for name, value in record.attributes.items():
        _write_attribute(group, f"value.{name}", value)
    for name, entry in record.fields.items():
        options = _storage_options(entry.values, compressed)
        dataset = group.create_dataset(name, data=entry.values, **options)
        _write_attribute(dataset, "units", entry.units)
        _write_attribute(dataset, "axes", ",".join(entry.axes))
    for name, child in record.children.items():
        _write_group(group.create_group(name), child, compressed)


def _write_attribute(item: h5py.Group | h5py.Dataset, name: str, value: Scalar) -> None:
    import h5py

    if isinstance(value, str):
        # Of fixed length, because strings of variable length lie in a heap without checksums.
        length = max(1, len(value.encode()))
        item.attrs.create(name, value.encode(), dtype=h5py.string_dtype("utf-8", length))
    else:
        item.attrs[name] = value


def _storage_options(values: NDArray[Any], compressed: bool) -> dict[str, Any]:
    """Checksums for every array, compression for the large ones if it is asked for."""
    if values.size == 0 or values.ndim == 0:
        return {}
    if values.nbytes < MIN_COMPRESSED_BYTES:
        return {"chunks": values.shape, "fletcher32": True}
    chunks: tuple[int, ...] | bool = True
    if values.ndim == len(CUBE_CHUNK_SHAPE):
        chunks = tuple(min(c, n) for c, n in zip(CUBE_CHUNK_SHAPE, values.shape, strict=True))
    if not compressed:
        return {"chunks": chunks, "fletcher32": True}
    return {
        "chunks": chunks,
        "compression": "gzip",
        "compression_opts": 4,
        "shuffle": True,
        "fletcher32": True,
    }


def _read_group(
    group: h5py.Group,
    origin: str,
    read_dataset: Callable[[h5py.Dataset, str], Any],
    visited: set[int] | None = None,
    depth: int = 0,
) -> Record:
    import h5py

    if depth > MAX_DEPTH:
        raise FileFormatError(origin, f"has records in each other, more than {MAX_DEPTH} deep")
    fields: dict[str, Field] = {}
    children: dict[str, Record] = {}
    visited = set() if visited is None else visited
    for name, item in iterate_members(group, visited):
        if item is None:
            raise FileFormatError(origin, f"'{name}' cannot be read: links are not followed")
        if isinstance(item, h5py.Dataset):
            axes = _read_text(item, "axes")
            fields[name] = Field(
                read_dataset(item, origin),
                _read_text(item, "units"),
                tuple(axes.split(",")) if axes else (),
            )
        elif isinstance(item, h5py.Group):
            children[name] = _read_group(item, origin, read_dataset, visited, depth + 1)
        else:
            raise FileFormatError(origin, f"is damaged: '{name}' cannot be read")
    _require_bounded_attributes(group, origin)
    attributes = {
        name.removeprefix("value."): _to_scalar(value)
        for name, value in group.attrs.items()
        if name.startswith("value.")
    }
    return Record(_read_text(group, "kind"), fields, attributes, children, origin=origin)


def _require_bounded_attributes(item: h5py.Group | h5py.Dataset, origin: str) -> None:
    """Refuse attributes larger than the file that they are in."""
    size = os.path.getsize(origin)
    for name in item.attrs:
        if item.attrs.get_id(name).get_storage_size() > size:
            raise FileFormatError(origin, f"is damaged: attribute '{name}' is larger than the file")


def _read_text(item: h5py.Group | h5py.Dataset, name: str) -> str:
    return str(_to_scalar(item.attrs.get(name, "")))


def _to_scalar(value: Any) -> Scalar:
    """Turn an HDF5 attribute into a Python scalar."""
    plain = value.item() if isinstance(value, np.generic) else value
    found = plain.decode() if isinstance(plain, bytes) else plain
    if not isinstance(found, str | int | float | bool):
        raise TypeError(f"an attribute holds {type(found).__name__}, not text or a number")
    return found


def _parse_provenance(text: str, path: str | Path) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError as fault:
        raise FileFormatError(path, "its provenance is not JSON") from fault
    return found if isinstance(found, dict) else {}


def collect_provenance(settings: Mapping[str, Any], *inputs: str | Path) -> dict[str, Any]:
    """Describe how a result came about: program version, time, settings, and a hash of every input
    file.
    """
    return {
        "software": f"tofclip {__version__}",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "settings": dict(settings),
        "inputs": [
            {"name": Path(path).name, "sha256": compute_sha256(path)}
            for path in inputs
            if Path(path).is_file()
        ],
    }
