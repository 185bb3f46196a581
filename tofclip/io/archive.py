"""NumPy archives (``.npz``) of unknown origin, with every entry checked as it is taken out.

Only headers are read when an archive is opened: an entry is looked at when it is asked for, and
only if its shape and type are the ones asked for.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.files import (
    BoundedFile,
    format_error_line,
    require_bounded_size,
    translate_read_errors,
)

NPY_SUFFIX = ".npy"
MEMBER_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those that NumPy writes; others can claim to unpack to any size."""


@dataclass(frozen=True)
class ArchiveEntry:
    """An array in a file that has not been read yet."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    load: Callable[[], NDArray[Any]]  # reads the values

    @classmethod
    def of(cls, values: Any) -> ArchiveEntry:
        """Make an entry of an array that is in memory."""
        array = np.asarray(values)
        return cls(array.shape, array.dtype, lambda: array)


def list_npz_entries(path: Path) -> dict[str, ArchiveEntry]:
    """List the arrays of an ``.npz`` file by name; pickled objects are refused."""
    entries = {}
    with BoundedFile(path) as opened, zipfile.ZipFile(opened) as archive:
        for member in archive.infolist():
            if not member.filename.endswith(NPY_SUFFIX):
                continue
            name = member.filename.removesuffix(NPY_SUFFIX)
            if member.compress_type not in MEMBER_COMPRESSIONS:
                raise FileFormatError(
                    path, f"'{name}' is compressed in a way that NumPy never uses"
                )
            with archive.open(member) as file:
                shape, dtype = read_npy_header(file)
            claimed = math.prod(shape) * dtype.itemsize
            packed = member.compress_type != zipfile.ZIP_STORED
            require_bounded_size(path, name, claimed, member.compress_size, packed)
            entries[name] = ArchiveEntry(shape, dtype, _make_loader(path, member))
    return entries


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read shape and type of an ``.npy`` file, up to its first value.

    `file`: at its beginning.
    """
    version = np.lib.format.read_magic(file)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds pickled Python objects, which are never loaded")
    return shape, dtype


def _make_loader(path: Path, member: zipfile.ZipInfo) -> Callable[[], NDArray[Any]]:
    def load() -> NDArray[Any]:
        with (
            BoundedFile(path) as opened,
            zipfile.ZipFile(opened) as archive,
            archive.open(member) as file,
        ):
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))

    return load


class Archive:
    """The arrays of an ``.npz`` file; pickled objects are never loaded."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._entries = self._list_entries()

    def _list_entries(self) -> Mapping[str, ArchiveEntry]:
        # A missing file is reported as such before the decoder turns it into a damaged one.
        with translate_read_errors(self.path):
            self.path.stat()
        entries: Mapping[str, ArchiveEntry] = self._guard(lambda: list_npz_entries(self.path))
        return entries

    def _guard(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (FileFormatError, MemoryError):
            raise
        except (
            Exception
        ) as fault:  # whatever the decoder stumbles over, it is the file that is damaged
            raise FileFormatError(
                self.path, f"is a truncated or damaged NumPy archive ({format_error_line(fault)})"
            ) from fault

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    @property
    def names(self) -> set[str]:
        """Names of all entries."""
        return set(self._entries)

    def describe(self, name: str) -> ArchiveEntry:
        """Return shape and type of entry `name`, without its values."""
        if name not in self:
            raise FileFormatError(self.path, f"has no field '{name}', which is needed here")
        return self._entries[name]

    def read(self, name: str) -> NDArray[Any]:
        """Return entry `name`, of whatever shape and type."""
        values: NDArray[Any] = self._guard(self.describe(name).load)
        return values

    def array(self, name: str, *shape: int | None) -> NDArray[Any]:
        """Return entry `name`, a numeric array of `shape`; None stands for any length but zero."""
        self.require_numbers(name, *shape)
        return self.read(name)

    def require_numbers(self, name: str, *shape: int | None) -> None:
        """Refuse an entry `name` that is not a numeric array of `shape`, without reading it."""
        found = self.describe(name)
        fits = len(shape) == len(found.shape) and all(
            n > 0 and wanted in (None, n) for wanted, n in zip(shape, found.shape, strict=True)
        )
        if not fits or found.dtype.kind not in "uif":
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise FileFormatError(
                self.path,
                f"field '{name}' must be numbers of shape {wanted}, found {found.dtype} of {found.shape}",
            )

    def finite_array(self, name: str, *shape: int | None) -> NDArray[np.float64]:
        """Return entry `name` in float64, refusing NaN and infinity; arguments as in `array`."""
        found = self.array(name, *shape).astype(np.float64)
        if not np.all(np.isfinite(found)):
            raise FileFormatError(self.path, f"field '{name}' must not hold NaN or infinity")
        return found

    def text(self, name: str) -> str:
        """Return entry `name`, a single string."""
        found = self._entries.get(name, ArchiveEntry.of(0))
        if found.shape or found.dtype.kind != "U":
            raise FileFormatError(
                self.path, f"field '{name}' must be a string, found {found.dtype} of {found.shape}"
            )
        return str(self.read(name))

    def scalars(self) -> dict[str, str]:
        """Return every single number or string as text, by name."""
        return {
            name: str(self.read(name)) for name, entry in self._entries.items() if not entry.shape
        }
