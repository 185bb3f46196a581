"""ITEX, the ``.img`` format of Hamamatsu's HPD-TA and HiPic: a header, HPD-TA's text, pixels,
scaling tables.

Layout, little-endian: 64 bytes of header, the text, the pixels row by row, then one table of
float32 for each axis that has one. The text says at which byte of the file a table begins:
``ScalingXScalingFile="#0691078,0672"``.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.files import atomic_path, translate_read_errors
from tofclip.io import hpdta
from tofclip.io.tiff import MAX_PIXELS
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Record

SIGNATURE = b"IM"
AXES = ("X", "Y")
# Type 1 of the format is a compressed picture, which is not supported.
PIXEL_TYPES: dict[int, np.dtype[Any]] = {0: np.dtype("u1"), 2: np.dtype("<u2"), 3: np.dtype("<u4")}

# Signature; length of the text, columns, rows, column and row offset, pixel type; then reserved
# bytes up to 64.
_HEADER = struct.Struct("<2s6H50x")
_MAX_FIELD = 65535  # what a field of the header can hold
_TABLE: np.dtype[np.float32] = np.dtype("<f4")
_MAX_TRAILER_BYTES = 1 << 20  # scaling tables are a few kilobytes


@dataclass(frozen=True)
class ItexImage:
    """What an ITEX file holds."""

    pixels: NDArray[Any]  # (rows, columns)
    # HPD-TA's text, see `tofclip.io.hpdta.parse_text`. It has to name a place for every table in
    # `tables` (``ScalingYScalingFile="..."``); `encode_itex` fills in where the table really lies
    text: str
    offset_px: tuple[int, int] = (0, 0)  # column and row of the sensor at which the picture begins
    # scaling of ``"X"`` (columns) and ``"Y"`` (rows), in the units that the text names
    tables: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.pixels.shape
        if len(shape) != 2 or not all(0 < length <= _MAX_FIELD for length in shape):
            raise ShapeError("an ITEX picture", f"(rows, columns), each 1..{_MAX_FIELD},", shape)
        if self.pixels.dtype not in PIXEL_TYPES.values():
            raise InputError(
                f"an ITEX picture is of uint8, uint16 or uint32, not of {self.pixels.dtype}"
            )
        if not all(0 <= offset <= _MAX_FIELD for offset in self.offset_px):
            raise InputError(
                f"an ITEX picture's offset must lie within 0..{_MAX_FIELD}, got {self.offset_px}"
            )

    @property
    def metadata(self) -> dict[str, str]:
        """The text, entry by entry: ``"Section/key": value``."""
        return hpdta.parse_text(self.text)


def read_itex(path: str | Path) -> Streak:
    """Read a streak image from an ITEX file; see `tofclip.io.read_streak`."""
    image = decode_itex(_read_bytes(path), path)
    metadata = image.metadata
    return Streak(
        counts=image.pixels,
        row_times=hpdta.read_row_times(metadata, path, image.pixels.shape[0]),
        saturated=hpdta.find_saturated_pixels(image.pixels, metadata, path),
        metadata=metadata,
        source=str(path),
    )


def outline_itex(path: str | Path) -> Record:
    """Describe what `read_itex` would read, without reading a pixel."""
    with translate_read_errors(path):
        image = decode_itex(np.memmap(path, np.uint8, "r").data, path)
    rows = image.pixels.shape[0]
    has_times = hpdta.read_row_times(image.metadata, path, rows) is not None
    return outline_streak(image.pixels.shape, has_times, True, image.metadata)


def write_itex(image: ItexImage, path: str | Path) -> None:
    """Write an ITEX file, whole or not at all."""
    data = encode_itex(image)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def decode_itex(data: bytes | memoryview, path: str | Path = "ITEX picture") -> ItexImage:
    """Take the bytes of an ITEX file apart.

    The pixels are a view of `data`; nothing else is larger than the text, so that a damaged header
    cannot make this allocate more than `data` itself takes.

    `path`: where they come from, for messages.
    """
    if len(data) < _HEADER.size or bytes(data[:2]) != SIGNATURE:
        raise FileFormatError(path, "has no ITEX header")
    _, text_length, columns, rows, x_offset, y_offset, kind = _HEADER.unpack_from(data)
    if kind not in PIXEL_TYPES:
        raise FileFormatError(
            path, f"has pixels of type {kind}, expected 0, 2 or 3 (8, 16 or 32 bit, not compressed)"
        )
    pixels_start = _HEADER.size + text_length
    needed = pixels_start + rows * columns * PIXEL_TYPES[kind].itemsize
    # The sizes in the header are checked against the bytes present before anything is built on
    # them.
    if rows * columns == 0 or needed > len(data):
        raise FileFormatError(
            path, f"is truncated: {columns} x {rows} pixels take {needed} bytes, found {len(data)}"
        )
    text = _decode_text(bytes(data[_HEADER.size : pixels_start]))
    pixels = np.frombuffer(data, PIXEL_TYPES[kind], rows * columns, pixels_start).reshape(
        rows, columns
    )
    return ItexImage(
        pixels, text, (x_offset, y_offset), _read_tables(data, hpdta.parse_text(text), path)
    )


def encode_itex(image: ItexImage) -> bytes:
    """Return the bytes of an ITEX file, the tables right behind the pixels, X first."""
    kind = next(number for number, dtype in PIXEL_TYPES.items() if dtype == image.pixels.dtype)
    text = _fill_table_offsets(image)
    if len(text) > _MAX_FIELD:
        raise InputError(f"an ITEX file's text takes at most {_MAX_FIELD} bytes, got {len(text)}")
    rows, columns = image.pixels.shape
    header = _HEADER.pack(SIGNATURE, len(text), columns, rows, *image.offset_px, kind)
    tables = [
        np.asarray(image.tables[axis], _TABLE).tobytes() for axis in AXES if axis in image.tables
    ]
    return b"".join([header, text, np.ascontiguousarray(image.pixels).tobytes(), *tables])


def _read_bytes(path: str | Path) -> bytes:
    with translate_read_errors(path), open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_PIXELS * PIXEL_TYPES[3].itemsize + _MAX_TRAILER_BYTES:
            raise FileFormatError(path, f"is larger than any streak image: {size} bytes")
        return file.read()


def _read_tables(
    data: bytes | memoryview, metadata: Mapping[str, str], path: str | Path
) -> dict[str, NDArray[np.float32]]:
    tables = {}
    for axis in AXES:
        # An axis without a table is legal: it is linear, or has no unit.
        place = hpdta.find_table(metadata, axis)
        if place is None:
            continue
        start, count = place
        if start + count * _TABLE.itemsize > len(data):
            raise FileFormatError(
                path,
                f"is truncated: the {axis} scaling of {count} entries at byte {start} lies beyond its end",
            )
        tables[axis] = np.frombuffer(data, _TABLE, count, start)
    return tables


def _decode_text(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")  # versions before 9 wrote in the code page of Western Windows


def _fill_table_offsets(image: ItexImage) -> bytes:
    """Fill in where the tables lie; again while a longer number has moved them."""
    text = image.text.encode()
    while True:
        filled = text
        start = _HEADER.size + len(text) + image.pixels.nbytes
        for axis in AXES:
            if axis in image.tables:
                filled = _fill_table_offset(filled, axis, start, image.tables[axis].size)
                start += image.tables[axis].size * _TABLE.itemsize
        if len(filled) == len(text):
            return filled
        text = filled


def _fill_table_offset(text: bytes, axis: str, start: int, count: int) -> bytes:
    entry = f"Scaling{axis}ScalingFile".encode()
    filled, found = re.subn(
        entry + b'="[^"]*"', entry + f'="#{start:07d},{count:04d}"'.encode(), text, count=1
    )
    if not found:
        raise InputError(
            f'the text must hold Scaling{axis}ScalingFile="", where the place of its table goes'
        )
    return filled
