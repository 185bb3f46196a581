"""Numbers and cells in MATLAB's files of version 5.

SciPy's reader trusts the sizes that a file states, and a damaged one ends the program; this one
holds every size against the bytes that are there.

The format is MathWorks' "MAT-File Format" (R2022a): elements with a tag of type and length, padded
to eight bytes; a matrix holds flags, dimensions, name and values, a cell holds matrices.
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

# A few kilobytes of zlib can claim to unpack to terabytes.
MAX_UNPACKED_BYTES = 1 << 32
HEADER_BYTES, PEEKED_BYTES = 128, 1 << 12
# Data types of an element (miINT8, miMATRIX, miCOMPRESSED), then array classes: mxCELL_CLASS, and
# mxDOUBLE_CLASS to mxUINT64_CLASS.
INT8, MATRIX, COMPRESSED = 1, 14, 15
CELL_CLASS, NUMERIC_CLASSES = 1, range(6, 16)
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
    """A variable that has not been read yet.

    Parameters
    ----------
    name : str
    shape : tuple of int
    is_cell : bool
    load : callable
        Returns its values: numbers, or an object array of arrays.
    """

    name: str
    shape: tuple[int, ...]
    is_cell: bool
    load: Callable[[], NDArray[Any]]


def list_mat_variables(path: Path) -> list[MatVariable]:
    """List the numeric and cell arrays of a MAT file of version 5.

    Parameters
    ----------
    path : Path

    Raises
    ------
    FileFormatError
        The file is truncated or damaged.
    """
    size, found = path.stat().st_size, []
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
                matrix = _Matrix(path, order, memoryview(first), complete=False)
                if matrix.kind == CELL_CLASS or matrix.kind in NUMERIC_CLASSES:
                    load = _make_loader(path, order, (start, length, packed))
                    found.append(
                        MatVariable(matrix.name, matrix.shape, matrix.kind == CELL_CLASS, load)
                    )
            file.seek(start + length)
    return found


def _make_loader(
    path: Path, order: str, place: tuple[int, int, bool]
) -> Callable[[], NDArray[Any]]:
    start, length, packed = place

    def load() -> NDArray[Any]:
        with open(path, "rb") as file:
            file.seek(start)
            content = file.read(length)
        if packed:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(content, MAX_UNPACKED_BYTES)
            if unpacker.unconsumed_tail:
                raise FileFormatError(path, "holds more than can be read at once")
            content = content[8:]
        return _Matrix(path, order, memoryview(content), complete=True).values()

    return load


class _Matrix:
    """A matrix element whose parts are looked at one after the other.

    Parameters
    ----------
    path : Path
        For messages.
    order : str
        ``<`` or ``>``.
    content : memoryview
        The element without its tag; if not `complete`, its beginning.
    complete : bool
    """

    def __init__(self, path: Path, order: str, content: memoryview, complete: bool) -> None:
        self._path, self._order, self._content = path, order, content
        self._place, self.kind, self.shape, self.name = 0, 0, (0, 0), ""
        if complete and not content:  # MATLAB's empty cell
            self.kind = NUMERIC_CLASSES[-1]
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
        if min(self.shape) < 0 or math.prod(self.shape) > MAX_UNPACKED_BYTES:
            raise self._damage()

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
            return np.zeros(self.shape, np.uint8)
        kind, part = self._read_part()
        if kind not in VALUE_TYPES or self._is_complex:
            raise FileFormatError(self._path, f"'{self.name}' holds no real numbers")
        values = np.frombuffer(part, self._order + VALUE_TYPES[kind])
        if values.size != number:
            raise self._damage()
        return values.reshape(self.shape, order="F")

    def _iterate_cells(self, number: int) -> Iterator[NDArray[Any]]:
        for _ in range(number):
            kind, part = self._read_part()
            if kind != MATRIX:
                raise self._damage()
            inner = _Matrix(self._path, self._order, part, complete=True)
            if inner.kind == CELL_CLASS:
                raise FileFormatError(self._path, "holds cells inside cells")
            yield inner.values()
