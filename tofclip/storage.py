"""Files of our own: HDF5 records that name their units and axes.

A *record* is a tree of named arrays. Each array carries its unit and the names of its axes; the
root carries what kind of thing it is and where it came from. The layout of the file is decided here
and nowhere else, and no damaged byte of a record goes unnoticed.

A class that can be saved derives from `Storable`, names the kind of its record, and declares in the
metadata of each field of the dataclass how it lies in a file::

    @dataclass(frozen=True)
    class Trace(Storable):
        RECORD_KIND = "trace"

        counts: Float32Array = field(metadata=stored_array("count", "time", dtype=np.float32))
        start: float = field(default=0.0, metadata=stored_value("start_s"))
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
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import AnyArray, to_numpy
from tofclip.errors import FileFormatError, require_path
from tofclip.files import (
    atomic_path,
    compute_sha256,
    guard,
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
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
FORMAT_NAME, FORMAT_VERSION = "tofclip", 1
# The layouts of HDF5 1.10 carry checksums; a damaged file of the older ones can hang the library.
LIBRARY_VERSIONS = ("v110", "v110")
CUBE_CHUNK_SHAPE = (64, 32, 32)
MIN_COMPRESSED_BYTES = 1 << 16
MAX_DEPTH = 16  # of records within records
MAX_OUTLINE_VALUES = 9  # arrays up to this size are part of a record's outline


@dataclass(frozen=True)
class Field:
    """An array with its unit and the names of its axes."""

    values: AnyArray
    # SI unit (``"s"``, ``"m"``, ``"rad"``), ``"px"``, ``"count"``, or ``""`` for a pure number
    units: str = ""
    axes: tuple[str, ...] = ()  # one name per dimension, e.g. ``("time", "y", "x")``


@dataclass(frozen=True)
class Record:
    """A tree of arrays and scalars, as it lies in an HDF5 file."""

    kind: str  # what it describes, such as ``"camera"`` or ``"streak"``
    fields: Mapping[str, Field] = field(default_factory=dict)
    attributes: Mapping[str, Scalar] = field(default_factory=dict)
    # records that travel inside this one, such as a streak image's camera
    children: Mapping[str, Record] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)  # any tree that JSON can hold
    origin: str = ""  # the file it was read from, for error messages

    def array(self, name: str, dtype: DTypeLike, dimensions: int, units: str = "") -> AnyArray:
        """Return field `name`, contiguous; `FileFormatError` where it is absent, of another number
        of dimensions or unit, or of a type that does not convert to `dtype`.
        """
        if name not in self.fields:
            raise FileFormatError(self.origin, f"{self.kind} record has no field '{name}'")
        values, stored_units = self.fields[name].values, self.fields[name].units
        problem = ""
        if values.ndim != dimensions:
            problem = f"have {dimensions} dimensions, found shape {values.shape}"
        elif stored_units != units:
            problem = f"be in '{units}', found '{stored_units}'"
        elif not np.can_cast(values.dtype, dtype, casting="same_kind"):
            problem = f"convert to {np.dtype(dtype)}, found {values.dtype}"
        if problem:
            raise FileFormatError(self.origin, f"field '{name}' must {problem}")
        return np.ascontiguousarray(values, dtype=dtype)

    def attribute(self, name: str, default: Scalar | None = None) -> Scalar:
        """Return scalar `name`, or `default`; `FileFormatError` where neither is there."""
        value = self.attributes.get(name, default)
        if value is None:
            raise FileFormatError(self.origin, f"{self.kind} record has no attribute '{name}'")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """As `attribute`, refusing what is not a finite number."""
        value = self.attribute(name, default)
        if not isinstance(value, numbers.Real) or not math.isfinite(value):
            problem = f"attribute '{name}' must be a number, found {value}"
            raise FileFormatError(self.origin, problem)
        return float(value)

    def child(self, name: str, kind: str) -> Record:
        """Return the record inside this one; `FileFormatError` where none of that kind is."""
        child = self.children.get(name)
        if child is None or child.kind != kind:
            raise FileFormatError(self.origin, f"{self.kind} record carries no {kind} '{name}'")
        return child

    def save(self, path: str | Path, compressed: bool = True) -> None:
        """Write the record to `path`, whole or not at all, large arrays `compressed`, which takes
        ten times as long as writing them. `StorageError` where that fails; `path` is left as it
        was.
        """
        import h5py

        if Path(path).suffix:
            require_suffix(path, *RECORD_SUFFIXES)
        with atomic_path(path) as temporary:
            # HDF5 crashes the process when the disk fills up under it: it writes to memory, and
            # Python to the disk.
            image = io.BytesIO()
            with h5py.File(image, "w", libver=LIBRARY_VERSIONS) as file:
                _write_attribute(file, "format", FORMAT_NAME)
                _write_attribute(file, "format_version", FORMAT_VERSION)
                _write_attribute(file, "provenance", json.dumps(dict(self.provenance), default=str))
                _write_group(file, self, compressed)
            with image.getbuffer() as content, temporary.open("wb") as target:
                target.write(content)

    @classmethod
    def load(cls, path: str | Path, *kinds: str) -> Record:
        """Read a record, refusing any other kind than those named (none named: any kind)."""
        require_path(path)
        wanted = f", expected {' or '.join(kinds)}" if kinds else ""
        for kind, verb in {"frames": "recover", "clip_measurement": "clip simulate"}.items():
            if kind in kinds and "streak" not in kinds:
                wanted += f" (run tofclip {verb} first)"
        record = _read_file(path, wanted=wanted)
        if kinds and record.kind not in kinds:
            raise FileFormatError(path, f"holds a {record.kind} record{wanted}")
        return record


def read_outline(path: str | Path) -> Record:
    """Read a record but for arrays of more than `MAX_OUTLINE_VALUES` values, in whose place are
    stand-ins (`make_stand_in`): no file is too large for this.
    """
    return _read_file(path, values=False)


def is_own_file(path: str | Path) -> bool:
    """Whether a file says that it is one of our HDF5 files, be it damaged otherwise."""
    import h5py

    faults = OSError, RuntimeError, TypeError, ValueError
    with contextlib.suppress(*faults), h5py.File(path, "r") as file:
        return _read_text(file, "format") == FORMAT_NAME
    return False


def make_stand_in(shape: Sequence[int], dtype: DTypeLike) -> AnyArray:
    """Return an array of that shape and type that takes no memory; all its values are the same."""
    return np.broadcast_to(np.zeros((), dtype), tuple(shape))


def is_stand_in(values: AnyArray) -> bool:
    """Whether an array came from `make_stand_in`."""
    return values.ndim > 0 and not any(values.strides)


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


def _storage_options(values: AnyArray, compressed: bool) -> dict[str, Any]:
    """Checksums for every array, compression for the large ones if it is asked for."""
    if values.size == 0 or values.ndim == 0:
        return {}
    if values.nbytes < MIN_COMPRESSED_BYTES:
        return {"chunks": values.shape, "fletcher32": True}
    options: dict[str, Any] = {"chunks": True, "fletcher32": True}
    if values.ndim == len(CUBE_CHUNK_SHAPE):
        options["chunks"] = tuple(map(min, CUBE_CHUNK_SHAPE, values.shape))
    if compressed:
        options |= {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    return options


def _read_file(path: str | Path, values: bool = True, wanted: str = "") -> Record:
    import h5py

    with translate_read_errors(path), open(path, "rb") as raw:
        start = raw.read(len(HDF5_SIGNATURE))
    if start != HDF5_SIGNATURE:
        raise FileFormatError(path, f"is not an HDF5 file{wanted}" if start else "is empty")
    with guard(path, "is damaged or incomplete"), h5py.File(path, "r") as file:
        if _read_text(file, "format") != FORMAT_NAME:
            raise FileFormatError(path, "is an HDF5 file, but not one of tofclip's")
        version = int(_to_scalar(file.attrs.get("format_version", 0)))
        if version > FORMAT_VERSION:
            raise FileFormatError(
                path, f"has format version {version}; this program reads {FORMAT_VERSION}"
            )
        record = _read_group(file, str(path), values, set())
        try:
            provenance = json.loads(_read_text(file, "provenance"))
        except json.JSONDecodeError as fault:
            raise FileFormatError(path, "its provenance is not JSON") from fault
    known = provenance if isinstance(provenance, dict) else {}
    return dataclasses.replace(record, provenance=known)


def _read_group(
    group: h5py.Group, origin: str, values: bool, visited: set[int], depth: int = 0
) -> Record:
    import h5py

    if depth > MAX_DEPTH:
        raise FileFormatError(origin, f"has records in each other, more than {MAX_DEPTH} deep")
    fields: dict[str, Field] = {}
    children: dict[str, Record] = {}
    for name, item in iterate_members(group, visited):
        if item is None:
            raise FileFormatError(origin, f"'{name}' cannot be read: links are not followed")
        if isinstance(item, h5py.Group):
            children[name] = _read_group(item, origin, values, visited, depth + 1)
        elif isinstance(item, h5py.Dataset):
            require_bounded_dataset(item, origin, at_once=None if values else 0)
            is_read = values or math.prod(item.shape) <= MAX_OUTLINE_VALUES
            content = item[()] if is_read else make_stand_in(item.shape, item.dtype)
            axes = _read_text(item, "axes")
            units = _read_text(item, "units")
            fields[name] = Field(content, units, tuple(axes.split(",")) if axes else ())
        else:
            raise FileFormatError(origin, f"is damaged: '{name}' cannot be read")
    for name in group.attrs:
        if group.attrs.get_id(name).get_storage_size() > os.path.getsize(origin):
            raise FileFormatError(origin, f"is damaged: attribute '{name}' is larger than the file")
    attributes = {
        name.removeprefix("value."): _to_scalar(value)
        for name, value in group.attrs.items()
        if name.startswith("value.")
    }
    return Record(_read_text(group, "kind"), fields, attributes, children, origin=origin)


def _read_text(item: h5py.Group | h5py.Dataset, name: str) -> str:
    return str(_to_scalar(item.attrs.get(name, "")))


def _to_scalar(value: Any) -> Scalar:
    """Turn an HDF5 attribute into a Python scalar."""
    plain = value.item() if isinstance(value, np.generic) else value
    plain = plain.decode() if isinstance(plain, bytes) else plain
    if not isinstance(plain, str | int | float | bool):
        raise TypeError(f"an attribute holds {type(plain).__name__}, not text or a number")
    return plain


def collect_provenance(settings: Mapping[str, Any], *inputs: str | Path) -> dict[str, Any]:
    """Describe how a result came about: version, time, settings, and each input's hash."""
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
    """A dataclass that can be turned into a `Record` and back. Every field is declared with one of
    the functions below, such as `stored_array` or `stored_value`; fields without a declaration are
    not stored.
    """

    RECORD_KIND: ClassVar[str]

    def to_record(self) -> Record:
        """Return everything that has to be stored."""
        record = Record(self.RECORD_KIND)
        _write_fields(self, record)
        return record

    @classmethod
    def from_record(cls: type[StorableType], record: Record) -> StorableType:
        """Rebuild an object from what was stored."""
        return _read_fields(cls, record)

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
    dtype: DTypeLike | None = np.float64,
    name: str = "",
    dimensions: int | None = None,
    layout: Callable[[int], tuple[str, ...]] | None = None,
    optional: bool = False,
    skip_empty: bool = False,
) -> Metadata:
    """Declare an array with its unit and the names of its axes (`dimensions` where they have none;
    `layout` of an array of any dimensions, from how many to their names). Without a `dtype` real and
    complex floating-point numbers stay as they are.
    `name` in the file is by default the dataclass field's; boolean arrays are stored as 0 and 1.
    Where it is `optional`, None is a value, and files without it get the field's default;
    `skip_empty` leaves an array without elements out of the file.
    """
    ndim = len(axes) if dimensions is None else dimensions
    kind = None if dtype is None else np.dtype(dtype)
    options = {"units": units, "layout": layout or (lambda _: axes), "dtype": kind, "name": name}
    options["ndim"] = None if layout else ndim
    return _declare("array", **options, optional=optional, skip_empty=skip_empty)


def stored_value(
    *names: str, dtype: Callable[[Scalar], Any] = float, optional: bool = False
) -> Metadata:
    """Declare a number or a text, stored as an attribute; several names declare a tuple of them. By
    convention names end in the unit (``time_zero_s``). Files without an `optional` one get the
    field's default.
    """
    return _declare("value", names=names, dtype=dtype, optional=optional)


def stored_part(part: type) -> Metadata:
    """Declare an object of dataclass `part` whose own declared fields lie in the same record."""
    return _declare("part", part=part)


def stored_child(read: Callable[[Record], Any], kind: str = "", optional: bool = False) -> Metadata:
    """Declare a `Storable` object that has a record of its own within this one. `read` makes it
    from its record; without a `kind` it looks at that itself.
    """
    return _declare("child", read=read, record_kind=kind, optional=optional)


def stored_mapping(what: str) -> Any:
    """Return the field of a mapping, empty by default: all ``"attributes"`` of the record; ``"texts"``, a
    child record of its own; ``"attachments"``, all child records that no other field declares; or
    ``"provenance"``, how the object came about.
    """
    return field(default_factory=dict, metadata=_declare(what))


def stored_origin() -> Metadata:
    """Declare the name of the file from which the object was read; it is not written."""
    return _declare("origin")


def _declare(kind: str, **options: Any) -> Metadata:
    return {_KEY: SimpleNamespace(**{"kind": kind, "optional": False, **options})}


def _declarations(kind: Any) -> Iterator[tuple[str, Any]]:
    return (
        (item.name, item.metadata[_KEY])
        for item in dataclasses.fields(kind)
        if _KEY in item.metadata
    )


def _write_fields(item: Any, record: Any) -> None:
    """Add the declared fields of an object to a record whose mappings are dictionaries."""
    for name, how in _declarations(item):
        value = getattr(item, name)
        if value is None and how.optional:
            continue
        match how.kind:
            case "array":
                values = np.asarray(to_numpy(value), how.dtype)
                if how.dtype == bool:
                    values = values.astype(np.uint8)
                if values.size or not how.skip_empty:
                    axes = how.layout(values.ndim)
                    record.fields[how.name or name] = Field(values, how.units, axes)
            case "value":
                names = how.names or (name,)
                several = value if len(names) > 1 else (value,)
                record.attributes.update(zip(names, several, strict=True))
            case "part":
                _write_fields(value, record)
            case "child":
                record.children[name] = value.to_record()
            case "texts":
                record.children[name] = Record(name, attributes=dict(value))
            case "attributes":
                record.attributes.update(value)
            case "attachments":  # what other fields declare comes first, whatever their order
                record.children.update({**value, **record.children})
            case "provenance":
                record.provenance.update(value)


def _read_fields(kind: type, record: Record) -> Any:
    declarations = dict(_declarations(kind))
    values: dict[str, Any] = {}
    for name, how in declarations.items():
        match how.kind:
            case "array":
                stored = how.name or name
                if stored in record.fields or not how.optional:
                    held = record.fields.get(stored, Field(np.zeros(0))).values
                    kept = held.dtype if held.dtype.kind in "fc" else np.dtype(np.float32)
                    wanted = how.dtype or kept
                    dtype = np.uint8 if wanted.kind == "b" else wanted
                    ndim = held.ndim if how.ndim is None else how.ndim
                    array = record.array(stored, dtype, ndim, how.units)
                    values[name] = array.astype(wanted, copy=False)
            case "value":
                names = how.names or (name,)
                if names[0] in record.attributes or not how.optional:
                    several = tuple(_convert(record, each, how.dtype) for each in names)
                    values[name] = several if len(names) > 1 else several[0]
            case "part":
                values[name] = _read_fields(how.part, record)
            case "child":
                if name in record.children or not how.optional:
                    child = record.child(name, how.record_kind or record.children[name].kind)
                    values[name] = how.read(child)
            case "texts":
                if name in record.children:
                    texts = record.children[name].attributes
                    values[name] = {key: str(text) for key, text in texts.items()}
            case "attributes" | "provenance":
                values[name] = getattr(record, how.kind)
            case "attachments":
                own = {key for key, one in declarations.items() if one.kind in ("child", "texts")}
                values[name] = {
                    key: child for key, child in record.children.items() if key not in own
                }
            case "origin":
                if record.origin:
                    values[name] = record.origin
    return kind(**values)


def _convert(record: Record, name: str, dtype: Callable[[Scalar], Any]) -> Any:
    value = record.attribute(name)
    try:
        return dtype(value)
    except (TypeError, ValueError, OverflowError) as fault:
        raise FileFormatError(
            record.origin, f"attribute '{name}' must be of type {dtype.__name__}"
        ) from fault
