"""Named arrays of NumPy's archives (``.npz``) and of MATLAB's files of version 5, of unknown origin.

What a file holds is listed before a value is read: an entry is looked at when it is asked for, and
only if its shape and type are the ones asked for.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import FileFormatError
from tofclip.files import BoundedFile, guard, require_bounded_size

NPY_SUFFIX = ".npy"
# Those that NumPy writes; others can claim to unpack to any size.
MEMBER_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
MAT_HEADER_BYTES, PEEKED_BYTES = 128, 1 << 12
# Of MATLAB's files: types of elements; classes of matrices; their types in memory and in the file.
MAT_MATRIX, MAT_COMPRESSED = 14, 15
MAT_CELL, MAT_STRUCT, MAT_COMPLEX = 1, 2, 0x0800
MAT_CLASSES = dict(
    enumerate(map(np.dtype, ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]), 6)
)
MAT_TYPES = dict(enumerate(["i1", "u1", "i2", "u2", "i4", "u4", "f4"], 1)) | {
    9: "f8",
    12: "i8",
    13: "u8",
}
DAMAGED_MAT = "is a truncated or damaged MAT file"


@dataclass(frozen=True)
class ArchiveEntry:
    """An array in a file that has not been read yet."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]  # objects for MATLAB's cells
    load: Callable[[], AnyArray]  # reads the values

    @classmethod
    def of(cls, values: Any) -> ArchiveEntry:
        """Make an entry of an array that is in memory."""
        array = np.asarray(values)
        return cls(array.shape, array.dtype, lambda: array)


Entries = Mapping[str, ArchiveEntry]


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
            entries[name] = ArchiveEntry(shape, dtype, partial(_load_npz_member, path, member))
    return entries


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read shape and type of an ``.npy`` file, up to its first value."""
    layout = np.lib.format
    is_first = layout.read_magic(file) == (1, 0)
    read = layout.read_array_header_1_0 if is_first else layout.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds pickled Python objects, which are never loaded")
    return shape, dtype


def _load_npz_member(path: Path, member: zipfile.ZipInfo) -> AnyArray:
    with BoundedFile(path) as opened, zipfile.ZipFile(opened) as archive:
        return np.lib.format.read_array(archive.open(member), allow_pickle=False)


def list_mat_entries(path: Path) -> dict[str, ArchiveEntry]:
    """List the numeric and cell arrays of a MAT file of version 5, those in its structs by names
    with dots.

    SciPy's reader trusts what a file says of itself, and a damaged one ends the program; here every
    size is held against the bytes that are there. The format is MathWorks' "MAT-File Format"
    (R2022a): elements with a tag of type and length, padded to eight bytes; a matrix holds flags,
    dimensions, name and values, a cell holds matrices, a struct the names of its fields and their
    matrices.
    """
    entries: dict[str, ArchiveEntry] = {}
    size = path.stat().st_size
    with guard(path, DAMAGED_MAT), open(path, "rb") as file:
        # The header ends in the characters MI as a 16-bit number: read back as IM, the file is
        # little-endian.
        order = {b"IM": "<", b"MI": ">"}[file.read(MAT_HEADER_BYTES)[126:]]
        while file.tell() + 8 <= size:
            kind, length = struct.unpack(f"{order}II", file.read(8))
            start = file.tell()
            if start + length > size:
                raise FileFormatError(path, DAMAGED_MAT)
            where = path, order, kind, start, length
            # Only the beginning is unpacked: name and shape are wanted here, not the values.
            matrix = _read_element(*where, PEEKED_BYTES)
            if matrix is not None and matrix.kind == MAT_STRUCT and math.prod(matrix.shape) == 1:
                for name, part in _read_element(*where).fields():
                    if part.is_readable:
                        entry = ArchiveEntry(part.shape, part.dtype, part.values)
                        entries[f"{matrix.name}.{name}"] = entry
            elif matrix is not None and matrix.is_readable:
                if matrix.kind != MAT_CELL:
                    # A number takes at least one byte in the file, whatever its class.
                    packed, number = kind == MAT_COMPRESSED, math.prod(matrix.shape)
                    require_bounded_size(path, matrix.name, number, length, packed)
                load = partial(_read_values, *where)
                entries[matrix.name] = ArchiveEntry(matrix.shape, matrix.dtype, load)
            file.seek(start + length)
    return entries


def _read_element(
    path: Path, order: str, kind: int, start: int, length: int, most: int | None = None
) -> Any:
    """Return the matrix of the element whose values begin at byte `start`, None where it is another;
    of no more than the first bytes, where `most` says how many.
    """
    with guard(path, DAMAGED_MAT), open(path, "rb") as file:
        file.seek(start)
        content = file.read(length if most is None else min(length, most))
        if kind == MAT_COMPRESSED:
            unpacker = zlib.decompressobj()
            kind, claimed = struct.unpack(f"{order}II", unpacker.decompress(content, 8))
            if most is None:
                require_bounded_size(path, "a variable", claimed, length, True)
            content = unpacker.decompress(unpacker.unconsumed_tail, most or claimed + 1)
        return _MatMatrix(path, order, content) if kind == MAT_MATRIX else None


def _read_values(*where: Any) -> AnyArray:
    matrix: _MatMatrix = _read_element(*where)
    return matrix.values()


class _MatMatrix:
    """A matrix at byte `at` of unpacked content; what is missing raises struct's errors or NumPy's."""

    def __init__(self, path: Path, order: str, content: bytes, at: int = 0) -> None:
        self._path, self._order, self._content = path, order, content
        self._tag = struct.Struct(f"{order}II")
        _, start, _, at = self._read_tag(at)
        flags = self._tag.unpack_from(content, start)[0]
        self.kind, self._is_complex = flags & 0xFF, bool(flags & MAT_COMPLEX)
        _, start, end, at = self._read_tag(at)
        self.shape = struct.unpack_from(f"{order}{(end - start) // 4}i", content, start)
        _, start, end, self._at = self._read_tag(at)
        self.name = content[start:end].decode("latin-1")
        if len(self.shape) < 2 or min(self.shape) < 0:
            raise FileFormatError(path, DAMAGED_MAT)

    @property
    def is_readable(self) -> bool:
        """Whether it holds numbers or cells."""
        return self.kind == MAT_CELL or self.kind in MAT_CLASSES

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its values, objects for cells."""
        return MAT_CLASSES.get(self.kind, np.dtype(object))

    def _read_tag(self, at: int) -> tuple[int, int, int, int]:
        """Return type, start and end of the element at a byte, and where the next one begins."""
        kind, length = self._tag.unpack_from(self._content, at)
        if kind >> 16:  # a short one, whose values are inside the tag
            return kind & 0xFFFF, at + 4, at + 4 + min(kind >> 16, 4), at + 8
        return kind, at + 8, at + 8 + length, at + 8 + length + (-length) % 8

    def values(self, is_cell: bool = False) -> AnyArray:
        """Return the numbers, or the contents of the cells, which hold no cells."""
        with nullcontext() if is_cell else guard(self._path, DAMAGED_MAT):
            number = math.prod(self.shape)
            if self.kind == MAT_CELL and not is_cell:
                # Every cell takes a tag of eight bytes at least, so that a damaged count is found
                # before the array is made.
                if 8 * number > len(self._content):
                    raise FileFormatError(self._path, DAMAGED_MAT)
                cells, at = np.empty(number, dtype=object), self._at
                for place in range(number):
                    cell, at = self._read_matrix(at)
                    cells[place] = np.zeros((0, 0)) if cell is None else cell.values(is_cell=True)
                return cells.reshape(self.shape, order="F")
            if self.kind not in MAT_CLASSES or self._is_complex:
                raise FileFormatError(self._path, f"'{self.name}' holds no real numbers")
            if number == 0:  # may come without an element for its values
                return np.zeros(self.shape, self.dtype)
            kind, start, end, _ = self._read_tag(self._at)
            stored = np.dtype(self._order + MAT_TYPES[kind])
            if end - start != number * stored.itemsize:
                raise FileFormatError(self._path, DAMAGED_MAT)
            values = np.frombuffer(self._content, stored, number, start)
            return values.astype(self.dtype, copy=False).reshape(self.shape, order="F")

    def fields(self) -> Iterator[tuple[str, _MatMatrix]]:
        """Yield names and contents of the fields of a struct."""
        _, start, _, at = self._read_tag(self._at)
        width = struct.unpack_from(f"{self._order}i", self._content, start)[0]
        _, start, end, at = self._read_tag(at)
        if width <= 0:
            raise FileFormatError(self._path, DAMAGED_MAT)
        for place in range(start, end, width):
            field, at = self._read_matrix(at)
            if field is not None:
                name = self._content[place : place + width].partition(b"\0")[0]
                yield name.decode("latin-1"), field

    def _read_matrix(self, at: int) -> tuple[_MatMatrix | None, int]:
        """Return the matrix inside at a byte, None for an empty one, and where the next begins."""
        kind, start, end, at = self._read_tag(at)
        if kind != MAT_MATRIX:
            raise FileFormatError(self._path, DAMAGED_MAT)
        if start == end:
            return None, at
        return _MatMatrix(self._path, self._order, self._content, start), at


class Archive:
    """The arrays of a file of unknown origin, by default an ``.npz`` file."""

    def __init__(
        self,
        path: str | Path,
        list_entries: Callable[[Path], Entries] | None = None,
    ) -> None:
        self.path = Path(path)
        what = "is truncated or damaged"
        self._problem = what if list_entries else "is a truncated or damaged NumPy archive"
        with guard(self.path, self._problem):
            self._entries = (list_entries or list_npz_entries)(self.path)

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

    def read(self, name: str) -> AnyArray:
        """Return entry `name`, of whatever shape and type."""
        entry = self.describe(name)
        with guard(self.path, self._problem):
            return entry.load()

    def array(self, name: str, *shape: int | None) -> AnyArray:
        """Return entry `name`, a numeric array of `shape`; None stands for any length but zero."""
        self.require_numbers(name, *shape)
        return self.read(name)

    def require_numbers(self, name: str, *shape: int | None) -> None:
        """Refuse an entry `name` that is not a numeric array of `shape`, without reading it."""
        entry = self.describe(name)
        fits = len(shape) == len(entry.shape) and all(
            n > 0 and wanted in (None, n) for wanted, n in zip(shape, entry.shape, strict=True)
        )
        if not fits or entry.dtype.kind not in "uif":
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise FileFormatError(
                self.path,
                f"field '{name}' must be numbers of shape {wanted}, found {entry.dtype} of {entry.shape}",
            )

    def finite_array(self, name: str, *shape: int | None) -> FloatArray:
        """Return entry `name` in float64, refusing NaN and infinity; arguments as in `array`."""
        values = self.array(name, *shape).astype(np.float64)
        if not np.all(np.isfinite(values)):
            raise FileFormatError(self.path, f"field '{name}' must not hold NaN or infinity")
        return values

    def text(self, name: str) -> str:
        """Return entry `name`, a single string."""
        entry = self._entries.get(name, ArchiveEntry.of(0))
        if entry.shape or entry.dtype.kind != "U":
            raise FileFormatError(
                self.path, f"field '{name}' must be a string, found {entry.dtype} of {entry.shape}"
            )
        return str(self.read(name))

    def scalars(self) -> dict[str, str]:
        """Return every single number or string as text, by name."""
        return {
            name: str(self.read(name)) for name, entry in self._entries.items() if not entry.shape
        }
