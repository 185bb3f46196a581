"""The text that Hamamatsu's HPD-TA and HiPic leave in their pictures, and the time axis that it
points to.

The text is a row of sections, ``[Name],key=value,key="value, with commas"``; a section may start
without a line break. The time axis is a table of float32 somewhere behind the pixels: it is not
uniform, because no sweep voltage is a straight line.

Streak images in TIFF: Hamamatsu's HPD-TA, or plain grey pictures that bring no time axis.

ITEX, the ``.img`` format of Hamamatsu's HPD-TA and HiPic: a header, HPD-TA's text, pixels,
scaling tables.

Layout, little-endian: 64 bytes of header, the text, the pixels row by row, then one table of
float32 for each axis that has one. The text says at which byte of the file a table begins:
``ScalingXScalingFile="#0691078,0672"``.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError, ShapeError, TofclipError
from tofclip.files import (
    MAX_COMPRESSION,
    BoundedFile,
    atomic_path,
    format_error_line,
    translate_read_errors,
)
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Record

if TYPE_CHECKING:
    import tifffile


TIME_UNITS: Final = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    # The micro sign (U+00B5) and the Greek letter mu (U+03BC) look alike; both occur.
    "µs": 1e-6,
    "μs": 1e-6,
    "ns": 1e-9,
    "ps": 1e-12,
    "fs": 1e-15,
}

_TOKEN = re.compile(
    r'\[(?P<section>[^\]\r\n]*)\]|(?P<key>[^\s,=\[\]"][^,=\[\]"\r\n]*)=(?:"(?P<quoted>[^"]*)"|(?P<bare>[^,\[\r\n]*))'
)
_TABLE = re.compile(r"#(\d{1,15}),(\d{1,9})")
# Values of ScalingYType and of ScalingYScalingFile. In focus mode nothing is swept.
_LINEAR, _FOCUS_MODE = "1", "Focus mode"
_BYTES_PER_ENTRY = 4


def is_hpdta(text: str) -> bool:
    """Whether an image description is HPD-TA's or HiPic's."""
    return text.lstrip().startswith("[Application]")


def parse_text(text: str) -> dict[str, str]:
    """Split the text into ``{"Section/key": value}``, e.g. ``"Streak camera/Time Range": "20 ns"``."""
    found: dict[str, str] = {}
    section = ""
    for token in _TOKEN.finditer(text):
        if token["section"] is not None:
            section = token["section"].strip()
        else:
            value = token["bare"].strip() if token["quoted"] is None else token["quoted"]
            found[f"{section}/{token['key'].strip()}"] = value
    return found


def read_row_times(
    metadata: Mapping[str, str], path: str | Path, rows: int
) -> NDArray[np.float64] | None:
    """Return the instant of each row, s, counted from the start of the sweep.

    The table ``#offset,count`` covers the whole sweep; a picture of a part of the sensor
    (``areSource`` = left, top, width, height) begins at its row ``top``. In focus mode, or without
    a unit of time, there is no axis.

    `metadata`: what `parse_text` returned; `path`: the file that holds the table; `rows`: rows of
    the picture. Returns (rows,).
    """
    unit = TIME_UNITS.get(metadata.get("Scaling/ScalingYUnit", ""))
    if unit is None or metadata.get("Scaling/ScalingYScalingFile") == _FOCUS_MODE:
        return None
    table = find_table(metadata, "Y")
    if table:
        start, count = table
        # A table as long as the picture belongs to its own rows; a longer one covers the sensor.
        first = 0 if count == rows else _parse_first_row(metadata)
        if first + rows > count:
            raise FileFormatError(
                path,
                f"time axis (ScalingYScalingFile) has {count} entries, rows {first}..{first + rows - 1} need more",
            )
        return _read_table(path, start + first * _BYTES_PER_ENTRY, rows) * unit
    if metadata.get("Scaling/ScalingYType") == _LINEAR:
        return np.arange(rows, dtype=np.float64) * (
            _parse_positive(metadata, "Scaling/ScalingYScale", path) * unit
        )
    return None


def find_table(metadata: Mapping[str, str], axis: str) -> tuple[int, int] | None:
    """Return where in its file the scaling table of `axis` (``"X"`` or ``"Y"``) lies: first byte,
    float32 entries.

    None where the axis has no table: it is linear, or has no unit at all.

    `metadata`: ``Section/Key`` to value; `axis`: ``"X"`` or ``"Y"``.
    """
    found = _TABLE.fullmatch(metadata.get(f"Scaling/Scaling{axis}ScalingFile", ""))
    return (int(found[1]), int(found[2])) if found else None


def find_saturated_pixels(
    pixels: NDArray[Any], metadata: Mapping[str, str], path: str | Path
) -> NDArray[np.bool_] | None:
    """Mark the pixels that reached the sensor's limit; None for floating-point pictures, which have
    none.

    `pixels` (rows, columns): counts; `metadata`: gives the sensor's full scale; `path`: for the
    message. Returns (rows, columns).
    """
    if pixels.dtype.kind == "f":
        return None
    # A 12-bit converter in 16-bit pixels saturates long before the pixel type does.
    limit = min(np.iinfo(pixels.dtype).max, parse_full_scale(metadata))
    saturated: NDArray[np.bool_] = pixels >= limit
    if saturated.all():
        raise InputError(
            f"{path}: every pixel is saturated at {limit} counts; lower the gain or the exposure"
        )
    return saturated


def parse_full_scale(metadata: Mapping[str, str]) -> float:
    """Return the largest measurement that the camera can give, in counts; infinity where the text
    does not say.

    A sum over several exposures exceeds the converter's range, so that it says nothing there.
    """
    bits = metadata.get("Camera/Prop_BitPerChannel", "")
    single = metadata.get("Acquisition/NrExposure", "1") == "1"
    return (
        float(2 ** int(bits) - 1)
        if single and re.fullmatch(r"[1-9]|[12]\d|3[0-2]", bits)
        else math.inf
    )


def _parse_first_row(metadata: Mapping[str, str]) -> int:
    area = re.fullmatch(r"\d+,(\d{1,9}),\d+,\d+", metadata.get("Acquisition/areSource", ""))
    return int(area[1]) if area else 0


def _read_table(path: str | Path, start: int, count: int) -> NDArray[np.float64]:
    data = b""
    with translate_read_errors(path), open(path, "rb") as file:
        # Asking for more than there is would take the memory for it first.
        if start + count * _BYTES_PER_ENTRY <= os.fstat(file.fileno()).st_size:
            file.seek(start)
            data = file.read(count * _BYTES_PER_ENTRY)
    if len(data) < count * _BYTES_PER_ENTRY:
        raise FileFormatError(
            path,
            f"is truncated: its time axis of {count} entries at byte {start} (ScalingYScalingFile) is missing",
        )
    times = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise FileFormatError(
            path, "its time axis (ScalingYScalingFile) does not increase row by row"
        )
    return times


def _parse_positive(metadata: Mapping[str, str], key: str, path: str | Path) -> float:
    text = metadata.get(key, "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise FileFormatError(path, f"{key} must be a positive number, found '{text}'")
    return value


MAX_PIXELS = 1 << 28
"""A damaged header may claim any size; no streak camera has a sensor larger than this."""


def read_tiff(path: str | Path) -> Streak:
    """Read a streak image from a TIFF with one grey picture; see `tofclip.io.read_streak`.

    HPD-TA's text and time axis are used where present (`tofclip.io.hamamatsu`). Integer pixels at the
    sensor's limit are marked in ``Streak.saturated``; floating-point pictures have no such limit.
    """
    with _open_page(path) as page:
        pixels = page.asarray()
        metadata, times = _read_text(page, path)
    negative = int(np.count_nonzero(pixels < 0))
    if negative:
        raise InputError(
            f"{path}: {negative} pixels are negative, which raw counts cannot be; "
            "build a Streak yourself for a picture whose background is already subtracted"
        )
    return Streak(
        counts=pixels,
        row_times=times,
        saturated=find_saturated_pixels(pixels, metadata, path),
        metadata=metadata,
        source=str(path),
    )


def outline_tiff(path: str | Path) -> Record:
    """Describe what `read_tiff` would read, without reading a pixel."""
    with _open_page(path) as page:
        metadata, times = _read_text(page, path)
        has_limit = page.dtype is not None and page.dtype.kind != "f"
        return outline_streak(page.shape, times is not None, has_limit, metadata)


def _read_text(
    page: tifffile.TiffPage, path: str | Path
) -> tuple[dict[str, str], NDArray[np.float64] | None]:
    """Return what the file says in words, and the instants of the rows, s, where it has them."""
    date = page.tags.get("DateTime")
    metadata = {} if date is None or not date.value else {"DateTime": str(date.value)}
    if not is_hpdta(page.description):
        return metadata, None
    metadata |= parse_text(page.description)
    return metadata, read_row_times(metadata, path, page.shape[0])


@contextlib.contextmanager
def _open_page(path: str | Path) -> Iterator[tifffile.TiffPage]:
    """Open the only picture in the file."""
    import tifffile

    with translate_read_errors(path), BoundedFile(path) as file:
        try:
            with tifffile.TiffFile(file) as tiff:
                yield _check_only_page(tiff, path)
        except (TofclipError, MemoryError):
            raise
        except (
            Exception
        ) as fault:  # whatever the decoder stumbles over, it is the file that is damaged
            raise FileFormatError(
                path, f"is a damaged or unsupported TIFF ({format_error_line(fault)})"
            ) from fault


def _check_only_page(tiff: tifffile.TiffFile, path: str | Path) -> tifffile.TiffPage:
    """Hold what the header claims against the file before any memory is taken for it."""
    page = tiff.pages.first
    require_whole_chain(tiff, path)
    if len(tiff.pages) != 1:
        raise FileFormatError(path, f"holds {len(tiff.pages)} pictures, expected one streak image")
    if page.ndim != 2 or page.dtype is None or page.dtype.kind not in "uif":
        raise FileFormatError(
            path, f"holds a picture of shape {page.shape}, expected grey (rows, columns)"
        )
    require_bounded_page(page, path)
    return page


def require_whole_chain(tiff: tifffile.TiffFile, path: str | Path) -> None:
    """Refuse a file whose pictures follow each other in a circle, or on beyond its end; tifffile
    takes either for the end of the row.

    `path`: the file, for the message.
    """
    file, layout = tiff.filehandle, tiff.tiff
    seen: set[int] = set()

    def read_number(at: int, form: str) -> int:
        file.seek(at)
        content = file.read(struct.calcsize(form))
        if len(content) < struct.calcsize(form):
            raise FileFormatError(path, f"is truncated: its picture {len(seen)} is missing")
        return int(struct.unpack(form, content)[0])

    offset = tiff.pages.first.offset
    while offset:
        if offset in seen:
            raise FileFormatError(path, "is damaged: its pictures follow each other in a circle")
        tags = read_number(offset, layout.tagnoformat)
        seen.add(offset)
        offset = read_number(offset + layout.tagnosize + tags * layout.tagsize, layout.offsetformat)


def require_bounded_page(page: tifffile.TiffPage, path: str | Path) -> None:
    """Refuse a picture that claims more than its file can hold."""
    if not 0 < page.size <= MAX_PIXELS:
        raise FileFormatError(path, f"claims an impossible size of {page.shape} pixels")
    size, packed = page.parent.filehandle.size, page.compression != 1
    # Compressed strips may be shorter than the picture; uncompressed ones (TIFF compression 1) may
    # not.
    end = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)
    held = sum(page.databytecounts) * (MAX_COMPRESSION if packed else 1)
    if end > size or held < page.nbytes:
        raise FileFormatError(
            path, f"is truncated: {page.shape} pixels of {page.dtype} do not fit into {size} bytes"
        )


SIGNATURE = b"IM"
AXES = ("X", "Y")
# Type 1 of the format is a compressed picture, which is not supported.
PIXEL_TYPES: dict[int, np.dtype[Any]] = {0: np.dtype("u1"), 2: np.dtype("<u2"), 3: np.dtype("<u4")}

# Signature; length of the text, columns, rows, column and row offset, pixel type; then reserved
# bytes up to 64.
_HEADER = struct.Struct("<2s6H50x")
_MAX_FIELD = 65535  # what a field of the header can hold
_TABLE_ITEX: np.dtype[np.float32] = np.dtype("<f4")
_MAX_TRAILER_BYTES = 1 << 20  # scaling tables are a few kilobytes


@dataclass(frozen=True)
class ItexImage:
    """What an ITEX file holds."""

    pixels: NDArray[Any]  # (rows, columns)
    # HPD-TA's text, see `tofclip.io.hamamatsu.parse_text`. It has to name a place for every table in
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
        return parse_text(self.text)


def read_itex(path: str | Path) -> Streak:
    """Read a streak image from an ITEX file; see `tofclip.io.read_streak`."""
    image = decode_itex(_read_bytes(path), path)
    metadata = image.metadata
    return Streak(
        counts=image.pixels,
        row_times=read_row_times(metadata, path, image.pixels.shape[0]),
        saturated=find_saturated_pixels(image.pixels, metadata, path),
        metadata=metadata,
        source=str(path),
    )


def outline_itex(path: str | Path) -> Record:
    """Describe what `read_itex` would read, without reading a pixel."""
    with translate_read_errors(path):
        image = decode_itex(np.memmap(path, np.uint8, "r").data, path)
    rows = image.pixels.shape[0]
    has_times = read_row_times(image.metadata, path, rows) is not None
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
    return ItexImage(pixels, text, (x_offset, y_offset), _read_tables(data, parse_text(text), path))


def encode_itex(image: ItexImage) -> bytes:
    """Return the bytes of an ITEX file, the tables right behind the pixels, X first."""
    kind = next(number for number, dtype in PIXEL_TYPES.items() if dtype == image.pixels.dtype)
    text = _fill_table_offsets(image)
    if len(text) > _MAX_FIELD:
        raise InputError(f"an ITEX file's text takes at most {_MAX_FIELD} bytes, got {len(text)}")
    rows, columns = image.pixels.shape
    header = _HEADER.pack(SIGNATURE, len(text), columns, rows, *image.offset_px, kind)
    tables = [
        np.asarray(image.tables[axis], _TABLE_ITEX).tobytes()
        for axis in AXES
        if axis in image.tables
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
        place = find_table(metadata, axis)
        if place is None:
            continue
        start, count = place
        if start + count * _TABLE_ITEX.itemsize > len(data):
            raise FileFormatError(
                path,
                f"is truncated: the {axis} scaling of {count} entries at byte {start} lies beyond its end",
            )
        tables[axis] = np.frombuffer(data, _TABLE_ITEX, count, start)
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
                start += image.tables[axis].size * _TABLE_ITEX.itemsize
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
