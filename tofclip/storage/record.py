"""Records: trees of named arrays that know their units and axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.errors import FileFormatError

Scalar = str | int | float | bool


@dataclass(frozen=True)
class Field:
    """An array with its unit and the names of its axes.

    Parameters
    ----------
    values : ndarray
    units : str
        SI unit (``"s"``, ``"m"``, ``"rad"``), ``"px"``, ``"count"``, or ``""`` for a pure number.
    axes : tuple of str
        One name per dimension, e.g. ``("time", "y", "x")``.
    """

    values: NDArray[Any]
    units: str = ""
    axes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Record:
    """A tree of arrays and scalars, as it lies in an HDF5 file.

    Parameters
    ----------
    kind : str
        What the record describes: ``"camera"``, ``"streak"``, ``"frames"``, ``"cloud"``, ``"capture"``, ``"volume"``.
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
            raise FileFormatError(self.origin, f"field '{name}' must be in '{units}', found '{found.units}'")
        if not np.can_cast(found.values.dtype, dtype, casting="same_kind"):
            raise FileFormatError(
                self.origin,
                f"field '{name}' must convert to {np.dtype(dtype)}, found {found.values.dtype}",
            )
        return np.ascontiguousarray(found.values, dtype=dtype)

    def attribute(self, name: str, default: Scalar | None = None) -> Scalar:
        """Return scalar attribute `name`, or `default` if it is absent and a default is given."""
        if name in self.attributes:
            return self.attributes[name]
        if default is None:
            raise FileFormatError(self.origin, f"{self.kind} record has no attribute '{name}'")
        return default

    def child(self, name: str, kind: str) -> Record:
        """Return the record that travels inside this one under `name`, refusing another kind."""
        found = self.children.get(name)
        if found is None or found.kind != kind:
            raise FileFormatError(self.origin, f"{self.kind} record carries no {kind} '{name}'")
        return found

    def save(self, path: str | Path) -> None:
        """Write the record to `path`, whole or not at all.

        Raises
        ------
        StorageError
            The disk is full, the folder is missing or writing is not allowed; `path` is left as it was.
        """
        from tofclip.storage import hdf5

        hdf5.write(self, path)

    @classmethod
    def load(cls, path: str | Path, *kinds: str) -> Record:
        """Read a record, refusing any other kind than those named (none named: any kind)."""
        from tofclip.storage import hdf5

        found = hdf5.read(path)
        if kinds and found.kind not in kinds:
            wanted = " or ".join(kinds)
            raise FileFormatError(path, f"holds a {found.kind} record, expected {wanted}")
        return found
