"""Streak images of Hamamatsu's HPD-TA and HiPic, in TIFF and in their own ITEX (``.img``); other
grey TIFFs, which bring no time axis.

Both programs leave a text in their pictures, a row of sections ``[Name],key=value,key="value, with
commas"``; a section may start without a line break. The time axis that it points to is a table of
float32 somewhere behind the pixels: it is not uniform, because no sweep voltage is a straight line.
``ScalingYScalingFile="#0691078,0672"`` says at which byte of the file it begins, and its length.

ITEX, little-endian: 64 bytes of header, the text, the pixels row by row, then one table of float32
for each axis that has one.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import FileFormatError, InputError, require
from tofclip.files import MAX_COMPRESSION, BoundedFile, guard, translate_read_errors
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Record

if TYPE_CHECKING:
    import tifffile

TIME_UNITS: Final = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "ps": 1e-12,
    "fs": 1e-15,
    # The micro sign (U+00B5) and the Greek letter mu (U+03BC) look alike; both occur.
    "µs": 1e-6,
    "μs": 1e-6,
}
_TOKEN = re.compile(
    r'\[(?P<section>[^\]\r\n]*)\]|(?P<key>[^\s,=\[\]"][^,=\[\]"\r\n]*)=(?:"(?P<quoted>[^"]*)"|(?P<bare>[^,\[\r\n]*))'
)
_TABLE = re.compile(r"#(\d{1,15}),(\d{1,9})")
_ENTRY_BYTES = 4

MAX_PIXELS = 1 << 28  # a damaged header may claim any size; no streak camera has a larger sensor

SIGNATURE = b"IM"
# Signature; length of the text, columns, rows, column and row offset, pixel type; then reserved
# bytes up to 64.
ITEX_HEADER = struct.Struct("<2s6H50x")
# Type 1 of the format is a compressed picture, which is not supported.
PIXEL_TYPES: dict[int, np.dtype[Any]] = {0: np.dtype("u1"), 2: np.dtype("<u2"), 3: np.dtype("<u4")}
MAX_ITEX_BYTES = 4 * MAX_PIXELS + (1 << 20)  # scaling tables are a few kilobytes

StreakFile = tuple[Callable[[], Record], Callable[[], Streak]]
"""What describes the streak image of a file that is open, and what reads it."""


def parse_text(text: str) -> dict[str, str]:
    """Split the text into ``{"Section/key": value}``, e.g. ``"Streak camera/Time Range": "20 ns"``."""
    entries: dict[str, str] = {}
    section = ""
    for token in _TOKEN.finditer(text):
        if token["section"] is not None:
            section = token["section"].strip()
        else:
            value = token["bare"].strip() if token["quoted"] is None else token["quoted"]
            entries[f"{section}/{token['key'].strip()}"] = value
    return entries


def read_row_times(metadata: Mapping[str, str], path: str | Path, rows: int) -> FloatArray | None:
    """Return the instant of each row, s, counted from the start of the sweep; None in focus mode,
    where nothing is swept, and without a unit of time. The table covers the whole sweep; a picture
    of a part of the sensor (``areSource`` = left, top, width, height) begins at its row ``top``.
    """
    unit = TIME_UNITS.get(metadata.get("Scaling/ScalingYUnit", ""))
    if unit is None or metadata.get("Scaling/ScalingYScalingFile") == "Focus mode":
        return None
    table = find_table(metadata, "Y")
    if table:
        start, count = table
        # A table as long as the picture belongs to its own rows; a longer one covers the sensor.
        area = re.fullmatch(r"\d+,(\d{1,9}),\d+,\d+", metadata.get("Acquisition/areSource", ""))
        first = int(area[1]) if area and count != rows else 0
        if first + rows > count:
            raise FileFormatError(
                path,
                f"time axis (ScalingYScalingFile) has {count} entries, rows {first}..{first + rows - 1} need more",
            )
        return _read_table(path, start + first * _ENTRY_BYTES, rows) * unit
    if metadata.get("Scaling/ScalingYType") != "1":  # which is linear
        return None
    text = metadata.get("Scaling/ScalingYScale", "")
    with contextlib.suppress(ValueError):
        if 0 < float(text) < math.inf:
            return np.arange(rows, dtype=np.float64) * (float(text) * unit)
    raise FileFormatError(path, f"Scaling/ScalingYScale must be a positive number, found '{text}'")


def find_table(metadata: Mapping[str, str], axis: str) -> tuple[int, int] | None:
    """Return where in its file the scaling table of an axis (X or Y) lies: first byte, entries.
    None where the axis has no table: it is linear, or has no unit at all.
    """
    place = _TABLE.fullmatch(metadata.get(f"Scaling/Scaling{axis}ScalingFile", ""))
    return (int(place[1]), int(place[2])) if place else None


def _read_table(path: str | Path, start: int, count: int) -> FloatArray:
    with translate_read_errors(path), BoundedFile(path) as file:
        file.seek(start)
        data = file.read(count * _ENTRY_BYTES)
    if len(data) < count * _ENTRY_BYTES:
        raise FileFormatError(
            path,
            f"is truncated: its time axis of {count} entries at byte {start} (ScalingYScalingFile) is missing",
        )
    times = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        problem = "its time axis (ScalingYScalingFile) does not increase row by row"
        raise FileFormatError(path, problem)
    return times


def parse_full_scale(metadata: Mapping[str, str]) -> float:
    """Return the largest measurement that the camera can give, in counts; infinity where the text
    does not say, as of a sum over several exposures.
    """
    bits = metadata.get("Camera/Prop_BitPerChannel", "")
    single = metadata.get("Acquisition/NrExposure", "1") == "1"
    is_known = single and re.fullmatch(r"[1-9]|[12]\d|3[0-2]", bits)
    return float(2 ** int(bits) - 1) if is_known else math.inf


def _make_streak(
    pixels: AnyArray,
    times: FloatArray | None,
    metadata: Mapping[str, str],
    path: str | Path,
) -> Streak:
    """Mark the pixels that reached the sensor's limit; floating-point pictures have none."""
    if negative := np.count_nonzero(pixels < 0):
        raise InputError(
            f"{path}: {negative} pixels are negative, which raw counts cannot be; build a Streak "
            "yourself for a picture whose background is already subtracted"
        )
    saturated = None
    if pixels.dtype.kind != "f":
        # A 12-bit converter in 16-bit pixels saturates long before the pixel type does.
        limit = min(np.iinfo(pixels.dtype).max, parse_full_scale(metadata))
        saturated = pixels >= limit
        require(
            not saturated.all(),
            f"{path}: every pixel is saturated at {limit} counts; lower the gain or the exposure",
        )
    return Streak(pixels, times, saturated, metadata, source=str(path))


@contextlib.contextmanager
def open_tiff(path: str | Path) -> Iterator[StreakFile]:
    """Open a TIFF with one grey picture; HPD-TA's text and time axis are used where present."""
    import tifffile

    with (
        guard(path, "is a damaged or unsupported TIFF"),
        BoundedFile(path) as file,
        tifffile.TiffFile(file) as tiff,
    ):
        page = tiff.pages.first
        require_whole_chain(tiff, path)
        if (pages := len(tiff.pages)) != 1:
            raise FileFormatError(path, f"holds {pages} pictures, expected one streak image")
        if page.ndim != 2 or page.dtype is None or page.dtype.kind not in "uif":
            problem = f"holds a picture of shape {page.shape}, expected grey (rows, columns)"
            raise FileFormatError(path, problem)
        require_bounded_page(page, path)
        date, times = page.tags.get("DateTime"), None
        metadata = {} if date is None or not date.value else {"DateTime": str(date.value)}
        if page.description.lstrip().startswith("[Application]"):  # HPD-TA's or HiPic's
            metadata |= parse_text(page.description)
            times = read_row_times(metadata, path, page.shape[0])
        has_limit = page.dtype.kind != "f"
        yield (
            partial(outline_streak, page.shape, times is not None, has_limit, metadata),
            lambda: _make_streak(page.asarray(), times, metadata, path),
        )


def require_whole_chain(tiff: tifffile.TiffFile, path: str | Path) -> None:
    """Refuse a file whose pictures follow each other in a circle, or on beyond its end; tifffile
    takes either for the end of the row.
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
    # Compressed strips may be shorter than the picture; uncompressed ones (TIFF compression 1) may
    # not.
    size, packed = page.parent.filehandle.size, page.compression != 1
    end = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)
    held = sum(page.databytecounts) * (MAX_COMPRESSION if packed else 1)
    if end > size or held < page.nbytes:
        raise FileFormatError(
            path, f"is truncated: {page.shape} pixels of {page.dtype} do not fit into {size} bytes"
        )


@contextlib.contextmanager
def open_itex(path: str | Path) -> Iterator[StreakFile]:
    """Open an ITEX file; its pixels are mapped."""
    with translate_read_errors(path):
        size = os.path.getsize(path)
        if size > MAX_ITEX_BYTES:
            raise FileFormatError(path, f"is larger than any streak image: {size} bytes")
        pixels, metadata = decode_itex(np.memmap(path, np.uint8, "r").data, path)
        times = read_row_times(metadata, path, len(pixels))
        yield (
            partial(outline_streak, pixels.shape, times is not None, True, metadata),
            lambda: _make_streak(pixels, times, metadata, path),
        )


def decode_itex(
    data: bytes | memoryview, path: str | Path = "ITEX picture"
) -> tuple[AnyArray, dict[str, str]]:
    """Return the pixels of an ITEX file, (rows, columns), as a view of its bytes, and its text by
    `parse_text`; a damaged header cannot make this take more memory than `data` itself.
    """
    if len(data) < ITEX_HEADER.size or bytes(data[:2]) != SIGNATURE:
        raise FileFormatError(path, "has no ITEX header")
    _, text_length, columns, rows, _, _, kind = ITEX_HEADER.unpack_from(data)
    if kind not in PIXEL_TYPES:
        raise FileFormatError(
            path, f"has pixels of type {kind}, expected 0, 2 or 3 (8, 16 or 32 bit, not compressed)"
        )
    start = ITEX_HEADER.size + text_length
    needed = start + rows * columns * PIXEL_TYPES[kind].itemsize
    if rows * columns == 0 or needed > len(data):
        raise FileFormatError(
            path, f"is truncated: {columns} x {rows} pixels take {needed} bytes, found {len(data)}"
        )
    text = bytes(data[ITEX_HEADER.size : start])
    try:
        metadata = parse_text(text.decode())
    except UnicodeDecodeError:  # versions before 9 wrote in the code page of Western Windows
        metadata = parse_text(text.decode("latin-1"))
    for axis in "XY":
        first, count = find_table(metadata, axis) or (0, 0)
        if first + count * _ENTRY_BYTES > len(data):
            raise FileFormatError(
                path,
                f"is truncated: the {axis} scaling of {count} entries at byte {first} lies beyond its end",
            )
    pixels = np.frombuffer(data, PIXEL_TYPES[kind], rows * columns, start)
    return pixels.reshape(rows, columns), metadata
