"""Streak images in TIFF: Hamamatsu's HPD-TA, or plain grey pictures that bring no time axis."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError, TofclipError
from tofclip.files import MAX_COMPRESSION, BoundedFile, format_error_line, translate_read_errors
from tofclip.io import hpdta
from tofclip.shots import Streak, outline_streak
from tofclip.storage import Record

if TYPE_CHECKING:
    import tifffile

MAX_PIXELS = 1 << 28
"""A damaged header may claim any size; no streak camera has a sensor larger than this."""


def read_tiff(path: str | Path) -> Streak:
    """Read a streak image from a TIFF with one grey picture; see `tofclip.io.read_streak`.

    HPD-TA's text and time axis are used where present (`tofclip.io.hpdta`). Integer pixels at the
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
        saturated=hpdta.find_saturated_pixels(pixels, metadata, path),
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
    if not hpdta.is_hpdta(page.description):
        return metadata, None
    metadata |= hpdta.parse_text(page.description)
    return metadata, hpdta.read_row_times(metadata, path, page.shape[0])


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
