"""Files of our own: HDF5 records that name their units and axes.

A *record* is a tree of named arrays. Each array carries its unit and the names of its axes; the
root carries what kind of thing it is and where it came from. Every class that can be saved turns
itself into a `Record` and back, so that the layout of the file is decided here and nowhere else. No
damaged byte of a record goes unnoticed.

Classes that can be saved: each field of a dataclass says once how it lies in a file.

A class derives from `Storable`, names the kind of its record, and declares unit, axes and type of
each field in the field's metadata. From this follow `Storable.to_record`, `Storable.from_record`,
`Storable.save` and `Storable.load`::

    @dataclass(frozen=True)
    class Trace(Storable):
        RECORD_KIND = "trace"

        counts: NDArray[np.float32] = field(metadata=stored_array("count", "time", dtype=np.float32))
        start: float = field(default=0.0, metadata=stored_value("start_s"))

The layout of the file itself is decided in `tofclip.storage`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import io
import json
import math
import numbers
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.arrays import to_numpy
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


Metadata = dict[str, Any]
StorableType = TypeVar("StorableType", bound="Storable")

_KEY = "tofclip.stored"


class Storable:
    """A dataclass that can be turned into a `Record` and back.

    Every field is declared with one of the functions of this module: `stored_array`,
    `stored_value`, `stored_part`, `stored_child`, `stored_attributes`, `stored_provenance` and so
    on; fields without a declaration are not stored.
    """

    RECORD_KIND: ClassVar[str]

    def to_record(self) -> Record:
        """Return everything that has to be stored."""
        contents = _Contents()
        _write_fields(self, contents)
        return Record(
            self.RECORD_KIND,
            contents.fields,
            contents.attributes,
            contents.children,
            contents.provenance,
        )

    @classmethod
    def from_record(cls: type[StorableType], record: Record) -> StorableType:
        """Rebuild an object from what was stored."""
        made: StorableType = _read_fields(cls, record)
        return made

    def save(self, path: str | Path) -> None:
        """Write everything to one HDF5 file, whole or not at all."""
        self.to_record().save(path)

    @classmethod
    def load(cls: type[StorableType], path: str | Path) -> StorableType:
        """Read what `save` wrote."""
        return cls.from_record(Record.load(path, cls.RECORD_KIND))


def stored_array(
    units: str = "",
    *axes: str,
    dtype: DTypeLike | tuple[DTypeLike, ...] = np.float64,
    name: str = "",
    dimensions: int | None = None,
    name_axes: Callable[[int], tuple[str, ...]] | None = None,
    optional: bool = False,
    skip_empty: bool = False,
) -> Metadata:
    """Declare an array.

    `units`: see `tofclip.storage.Field`; `*axes`: name of each axis; `dtype`: that of the array in
    memory. Of several, that of the file if it is one of them, else the first. Boolean arrays are
    stored as 0 and 1, uint8; `name`: in the file; by default the dataclass field's; `dimensions`:
    number of axes, where they have no names; `name_axes`: where the number of axes is free: from
    that number to their names; `optional`: whether None is a value, and whether files without the
    array get the field's default; `skip_empty`: whether an array without elements is left out of
    the file. Returns metadata for `dataclasses.field`.
    """
    kinds = dtype if isinstance(dtype, tuple) else (dtype,)
    return {
        _KEY: _StoredArray(units, axes, kinds, name, dimensions, name_axes, optional, skip_empty)
    }


def stored_value(
    *names: str, dtype: Callable[[Scalar], Any] = float, optional: bool = False
) -> Metadata:
    """Declare a number or a text, stored as an attribute; several names declare a tuple of them.

    `*names`: in the file; by convention they end in the unit (``time_zero_s``); `dtype`: ``float``,
    ``int``, ``str`` or ``bool``; `optional`: whether files without the attribute get the field's
    default. Returns metadata for `dataclasses.field`.
    """
    return {_KEY: _StoredValue(names, dtype, optional)}


def stored_part(part: type) -> Metadata:
    """Declare an object of dataclass `part` whose own declared fields lie in the same record."""
    return {_KEY: _StoredPart(part)}


def stored_child(
    read: Callable[[Record], Any], kind: str = "", optional: bool = False, name: str = ""
) -> Metadata:
    """Declare a `Storable` object that has a record of its own within this one.

    `read`: makes the object from its record; `kind`: of that record; empty: `read` looks at it
    itself; `optional`: whether None is a value; `name`: in the file; by default the dataclass
    field's. Returns metadata for `dataclasses.field`.
    """
    return {_KEY: _StoredChild(read, kind, optional, name)}


def stored_attributes() -> Metadata:
    """Declare a mapping that makes up all attributes of the record."""
    return {_KEY: _StoredAttributes()}


def stored_texts() -> Metadata:
    """Declare a mapping of str to str, stored as a child record of its own."""
    return {_KEY: _StoredTexts()}


def stored_attachments() -> Metadata:
    """Declare a mapping of all child records that no other field declares."""
    return {_KEY: _StoredAttachments()}


def stored_provenance() -> Metadata:
    """Declare the mapping that says how the object came about."""
    return {_KEY: _StoredProvenance()}


def stored_origin() -> Metadata:
    """Declare the name of the file from which the object was read; it is not written."""
    return {_KEY: _StoredOrigin()}


@dataclass
class _Contents:
    """A record while it is filled."""

    fields: dict[str, Field] = field(default_factory=dict)
    attributes: dict[str, Scalar] = field(default_factory=dict)
    children: dict[str, Record] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)


class _Declaration(Protocol):
    """How one field of a dataclass is stored."""

    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Put `value` of dataclass field `own_name` into the record.

        `own_name`: name of the dataclass field; `contents`: added to, in place.
        """
        ...

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the value that the record of a `kind` holds, or `MISSING` for the default.

        `own_name`: name of the dataclass field; `kind`: the class that is read.
        """
        ...


def _declarations(kind: type) -> dict[str, _Declaration]:
    return {
        item.name: item.metadata[_KEY] for item in dataclasses.fields(kind) if _KEY in item.metadata
    }


def _write_fields(item: Any, contents: _Contents) -> None:
    for name, declaration in _declarations(type(item)).items():
        declaration.write(name, getattr(item, name), contents)


def _read_fields(kind: type, record: Record) -> Any:
    found = {
        name: declaration.read(name, record, kind)
        for name, declaration in _declarations(kind).items()
    }
    return kind(**{name: value for name, value in found.items() if value is not MISSING})


@dataclass(frozen=True)
class _StoredArray:
    units: str
    axes: tuple[str, ...]
    dtypes: tuple[DTypeLike, ...]
    name: str
    dimensions: int | None
    name_axes: Callable[[int], tuple[str, ...]] | None
    optional: bool
    skip_empty: bool

    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store an array in its declared dtype, with its unit and axes; booleans as bytes."""
        if value is None and self.optional:
            return
        dtype = np.dtype(self.dtypes[0])
        values = to_numpy(value) if len(self.dtypes) > 1 else np.asarray(to_numpy(value), dtype)
        if dtype.kind == "b":
            values = values.astype(np.uint8)
        if self.skip_empty and values.size == 0:
            return
        axes = self.axes if self.name_axes is None else self.name_axes(values.ndim)
        contents.fields[self.name or own_name] = Field(values, self.units, axes)

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the array, checked for dtype, dimensions and unit."""
        name = self.name or own_name
        if self.optional and name not in record.fields:
            return MISSING
        dtype = np.dtype(self.dtypes[0])
        if name in record.fields and record.fields[name].values.dtype in self.dtypes:
            dtype = record.fields[name].values.dtype
        dimensions = len(self.axes) if self.dimensions is None else self.dimensions
        if self.name_axes is not None and name in record.fields:
            dimensions = record.fields[name].values.ndim
        if dtype.kind == "b":
            return record.array(name, np.uint8, dimensions, self.units).astype(bool)
        return record.array(name, dtype, dimensions, self.units)


@dataclass(frozen=True)
class _StoredValue:
    names: tuple[str, ...]
    dtype: Callable[[Scalar], Any]
    optional: bool

    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store one scalar, or several under a name each."""
        names = self.names or (own_name,)
        values = value if len(names) > 1 else (value,)
        contents.attributes.update(zip(names, values, strict=True))

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the scalar, or several as a tuple, in the declared type."""
        names = self.names or (own_name,)
        if self.optional and names[0] not in record.attributes:
            return MISSING
        try:
            values = tuple(self.dtype(record.attribute(name)) for name in names)
        except (TypeError, ValueError, OverflowError) as fault:
            if isinstance(fault, FileFormatError):
                raise
            raise FileFormatError(
                record.origin, f"attribute '{names[0]}' must be of type {self.dtype.__name__}"
            ) from fault
        return values if len(names) > 1 else values[0]


@dataclass(frozen=True)
class _StoredPart:
    part: type

    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store the fields of a part among those of the whole."""
        _write_fields(value, contents)

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the part, from fields of the whole."""
        return _read_fields(self.part, record)


@dataclass(frozen=True)
class _StoredChild:
    read_child: Callable[[Record], Any]
    kind: str
    optional: bool
    name: str

    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store an object as a record inside the record."""
        if value is not None or not self.optional:
            contents.children[self.name or own_name] = value.to_record()

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the object whose record lies inside the record."""
        name = self.name or own_name
        if name not in record.children and self.optional:
            return None
        return self.read_child(
            record.child(name, self.kind) if self.kind else record.children[name]
        )


class _StoredAttributes:
    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store a mapping as scalar attributes."""
        contents.attributes.update(value)

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return all scalar attributes."""
        return record.attributes


class _StoredTexts:
    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store a mapping of texts as a record of its own."""
        contents.children[own_name] = Record(own_name, attributes=dict(value))

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the mapping of texts."""
        if own_name not in record.children:
            return MISSING
        return {name: str(text) for name, text in record.children[own_name].attributes.items()}


class _StoredAttachments:
    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store records inside the record that no other field declares."""
        # what other fields declare comes first, whatever their order
        contents.children = {**value, **contents.children}

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the records inside the record that no other field declares."""
        declared = {
            (declaration.name if isinstance(declaration, _StoredChild) else "") or name
            for name, declaration in _declarations(kind).items()
            if isinstance(declaration, _StoredChild | _StoredTexts)
        }
        return {name: child for name, child in record.children.items() if name not in declared}


class _StoredProvenance:
    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store where an object came from."""
        contents.provenance = value

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return where the object came from."""
        return record.provenance


class _StoredOrigin:
    def write(self, own_name: str, value: Any, contents: _Contents) -> None:
        """Store nothing: the file's own name is its origin."""

    def read(self, own_name: str, record: Record, kind: type) -> Any:
        """Return the name of the file that the record came from."""
        return record.origin or MISSING
