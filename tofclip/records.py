"""Classes that can be saved: each field of a dataclass says once how it lies in a file.

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

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import to_numpy
from tofclip.errors import FileFormatError
from tofclip.storage import Field, Record, Scalar

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
