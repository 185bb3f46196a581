"""Numbers, cells and structs in MATLAB's files of version 5.

SciPy's reader trusts the sizes that a file states, and a damaged one ends the program; this one
holds every size against the bytes that are there.

The format is MathWorks' "MAT-File Format" (R2022a): elements with a tag of type and length, padded
to eight bytes; a matrix holds flags, dimensions, name and values, a cell holds matrices, a struct
the names of its fields and their matrices.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.files import require_bounded_size

HEADER_BYTES, PEEKED_BYTES = 128, 1 << 12
# Data types of an element: miMATRIX, miCOMPRESSED.
MATRIX, COMPRESSED = 14, 15
# Array classes: mxCELL_CLASS, mxSTRUCT_CLASS, and mxDOUBLE_CLASS to mxUINT64_CLASS.
CELL_CLASS, STRUCT_CLASS = 1, 2
NUMERIC_CLASSES = {
    number: np.dtype(name)
    for number, name in enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), 6)
}
PLAIN_CELL = (MATRIX, 6, 8, 5, 8, 1, 0)
"""Words of a matrix that are the same for every one of two dimensions without a name."""

EMPTY_CLASS = 6
COMPLEX_FLAG = 0x0800
VALUE_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}


@dataclass(frozen=True)
class MatVariable:
    """A variable that has not been read yet."""

    name: str  # with a dot for a field of a struct
    shape: tuple[int, ...]
    dtype: np.dtype[Any]  # objects for cells
    load: Callable[[], NDArray[Any]]  # returns its values: numbers, or an object array of arrays


def list_mat_variables(path: Path) -> list[MatVariable]:
    """List the numeric and cell arrays of a MAT file of version 5, and those in its structs."""
    size = path.stat().st_size
    found: list[MatVariable] = []
    with open(path, "rb") as file:
        header = file.read(HEADER_BYTES)
        # The header ends in the characters MI as a 16-bit number: read back as IM, the file is
        # little-endian.
        order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
        if order is None:
            raise FileFormatError(path, "is a truncated or damaged MAT file")
        while file.tell() + 8 <= size:
            kind, length = struct.unpack(f"{order}II", file.read(8))
            start = file.tell()
            if start + length > size:
                raise FileFormatError(path, "is a truncated or damaged MAT file")
            packed = kind == COMPRESSED
            first = file.read(min(length, PEEKED_BYTES))
            if packed:
                # Only the beginning is unpacked: name and shape are wanted here, not the values.
                first = zlib.decompressobj().decompress(first, PEEKED_BYTES)
                kind = struct.unpack(f"{order}I", first[:4])[0] if len(first) >= 8 else 0
                first = first[8:]
            if kind == MATRIX:
                element = _Element(path, order, start, length, packed)
                found += _list_matrix(_Matrix(path, order, memoryview(first)), element)
            file.seek(start + length)
    return found


@dataclass(frozen=True)
class _Element:
    """Where a matrix lies in a file: its bytes from `start` on, compressed ones where `packed`."""

    path: Path
    order: str
    start: int
    length: int
    packed: bool

    def read(self) -> _Matrix:
        with open(self.path, "rb") as file:
            file.seek(self.start)
            content = file.read(self.length)
        if self.packed:
            unpacker = zlib.decompressobj()
            claimed = struct.unpack(f"{self.order}I", unpacker.decompress(content, 8)[4:])[0]
            require_bounded_size(self.path, "a variable", claimed, self.length, True)
            content = unpacker.decompress(unpacker.unconsumed_tail, claimed + 1)
        return _Matrix(self.path, self.order, memoryview(content))


def _list_matrix(matrix: _Matrix, element: _Element) -> Iterator[MatVariable]:
    """List a variable, of a struct its fields; what is neither is left out."""
    if matrix.kind == STRUCT_CLASS and math.prod(matrix.shape) == 1:
        for name, part in element.read().fields():
            if part.is_readable:
                label = f"{matrix.name}.{name}"
                yield MatVariable(label, part.shape, part.dtype, part.values)
    elif matrix.is_readable:
        if matrix.kind != CELL_CLASS:
            # A number takes at least one byte in the file, whatever its class.
            number = math.prod(matrix.shape)
            require_bounded_size(element.path, matrix.name, number, element.length, element.packed)
        yield MatVariable(matrix.name, matrix.shape, matrix.dtype, lambda: element.read().values())


class _Matrix:
    """A matrix element whose parts are looked at one after the other.

    `path`: for messages; `order`: ``<`` or ``>``; `content`: the element without its tag, or its
    beginning, if only name and shape are wanted.
    """

    def __init__(self, path: Path, order: str, content: memoryview) -> None:
        self._path, self._order, self._content = path, order, content
        self._place, self._contents = 0, 0
        self.kind, self.shape, self.name = 0, (0, 0), ""
        if not content:  # MATLAB's empty cell
            self.kind = EMPTY_CLASS
            return
        flags = self._read_part()[1]
        dimensions = self._read_part()[1]
        name = self._read_part()[1]
        if len(flags) < 4 or len(dimensions) < 8:
            raise self._damage()
        word = struct.unpack(f"{order}I", flags[:4])[0]
        self.kind = word & 0xFF
        self._is_complex = bool(word & COMPLEX_FLAG)
        self.shape = tuple(np.frombuffer(dimensions, f"{order}i4").tolist())
        self.name = bytes(name).decode("latin-1")
        if min(self.shape) < 0:
            raise self._damage()
        self._contents = self._place

    @property
    def is_readable(self) -> bool:
        """Whether it holds numbers or cells."""
        return self.kind == CELL_CLASS or self.kind in NUMERIC_CLASSES

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its values, objects for cells."""
        return NUMERIC_CLASSES.get(self.kind, np.dtype(object))

    def _damage(self) -> FileFormatError:
        return FileFormatError(self._path, "is a truncated or damaged MAT file")

    def _read_part(self) -> tuple[int, memoryview]:
        """Return type and bytes of the next element inside."""
        tag = self._content[self._place : self._place + 8]
        if len(tag) < 8:
            raise self._damage()
        kind, length = struct.unpack(f"{self._order}II", tag)
        start = self._place + 8
        # A tag whose upper half is not zero is of the small data element format.
        if kind >> 16:  # a short one, whose values are inside the tag
            kind, length = kind & 0xFFFF, kind >> 16
            start = self._place + 4
            if length > 4:
                raise self._damage()
            self._place += 8
        else:
            self._place = start + length + (-length) % 8
        part = self._content[start : start + length]
        if len(part) < length:
            raise self._damage()
        return kind, part

    def values(self) -> NDArray[Any]:
        """Return the numbers, or the contents of the cells."""
        number = math.prod(self.shape)
        self._place = self._contents
        if self.kind == CELL_CLASS:
            # Every cell takes a tag of eight bytes at least, so that a damaged count is found
            # before the array is made.
            if 8 * number > len(self._content):
                raise self._damage()
            cells = np.empty(number, dtype=object)
            for place, cell in enumerate(self._iterate_cells(number)):
                cells[place] = cell
            return cells.reshape(self.shape, order="F")
        if self.kind not in NUMERIC_CLASSES:
            raise FileFormatError(self._path, f"'{self.name}' holds no numbers")
        # An empty array may come without an element for its values.
        if number == 0:
            return np.zeros(self.shape, self.dtype)
        kind, part = self._read_part()
        if kind not in VALUE_TYPES or self._is_complex:
            raise FileFormatError(self._path, f"'{self.name}' holds no real numbers")
        values = np.frombuffer(part, self._order + VALUE_TYPES[kind])
        if values.size != number:
            raise self._damage()
        return values.astype(self.dtype, copy=False).reshape(self.shape, order="F")

    def fields(self) -> Iterator[tuple[str, _Matrix]]:
        """Yield names and contents of the fields of a struct."""
        width_part, names = self._read_part()[1], bytes(self._read_part()[1])
        if len(width_part) < 4:
            raise self._damage()
        width = struct.unpack(f"{self._order}i", width_part[:4])[0]
        if width <= 0:
            raise self._damage()
        for start in range(0, len(names), width):
            name = names[start : start + width].partition(b"\0")[0].decode("latin-1")
            yield name, self._read_matrix()

    def _read_matrix(self) -> _Matrix:
        kind, part = self._read_part()
        if kind != MATRIX:
            raise self._damage()
        return _Matrix(self._path, self._order, part)

    def _iterate_cells(self, number: int) -> Iterator[NDArray[Any]]:
        usual = struct.Struct(f"{self._order}14I")
        for _ in range(number):
            plain = self._read_plain_cell(usual)
            if plain is not None:
                yield plain
                continue
            inner = self._read_matrix()
            if inner.kind == CELL_CLASS:
                raise FileFormatError(self._path, "holds cells inside cells")
            yield inner.values()

    def _read_plain_cell(self, usual: struct.Struct) -> NDArray[Any] | None:
        """Return the numbers of the next cell if it is written as most are, else None.

        Photon times of every pixel are a hundred thousand cells: to look at each as a whole takes a
        fifth of the time that part by part takes.

        `usual`: fourteen words: from a matrix's tag to that of its values, where it has two
        dimensions and no name.
        """
        start = self._place
        if start + usual.size > len(self._content):
            return None
        words = usual.unpack_from(self._content, start)
        length, flags, rows, columns, kind, size = (words[n] for n in (1, 4, 8, 9, 12, 13))
        first = start + usual.size
        if kind >> 16:  # a short one, whose values are inside the tag
            kind, size, first = kind & 0xFFFF, kind >> 16, first - 4
        if words[:1] + words[2:4] + words[6:8] + words[10:12] != PLAIN_CELL:
            return None
        own, stored = NUMERIC_CLASSES.get(flags & (COMPLEX_FLAG | 0xFF)), VALUE_TYPES.get(kind)
        if own is None or stored is None or length % 8 or first + size > start + 8 + length:
            return None
        if start + 8 + length > len(self._content) or size != rows * columns * int(stored[1]):
            return None
        self._place = start + 8 + length
        values = np.frombuffer(self._content, self._order + stored, rows * columns, first)
        return values.astype(own, copy=False).reshape((rows, columns), order="F")
