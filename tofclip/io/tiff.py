"""Streak images in TIFF: Hamamatsu's HPD-TA, or plain grey pictures that bring no time axis."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError, InputError
from tofclip.io import hpdta
from tofclip.shots import Streak
from tofclip.storage import format_error_line, translate_read_errors

if TYPE_CHECKING:
    import tifffile

MAX_PIXELS = 1 << 28
"""A damaged header may claim any size; no streak camera has a sensor larger than this."""

NULL_LOG_HANDLER = logging.NullHandler()


def read_tiff(path: str | Path) -> Streak:
    """Read a streak image from a TIFF with one grey picture; see `tofclip.io.read_streak`.

    HPD-TA's text and time axis are used where present (`tofclip.io.hpdta`). Integer pixels at the
    sensor's limit are marked in ``Streak.saturated``; floating-point pictures have no such limit.
    """
    pixels, text, date = _decode_page(path)
    metadata: dict[str, str] = {"DateTime": date} if date else {}
    times = None
    if hpdta.is_hpdta(text):
        metadata |= hpdta.parse_text(text)
        times = hpdta.read_row_times(metadata, path, pixels.shape[0])
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


def _decode_page(path: str | Path) -> tuple[NDArray[Any], str, str]:
    """Return pixels, image description and date of the only picture in the file."""
    import tifffile

    # Without a handler its complaints go to standard error, ahead of the one line that we raise.
    logging.getLogger("tifffile").addHandler(NULL_LOG_HANDLER)
    with translate_read_errors(path), open(path, "rb") as file:
        try:
            with tifffile.TiffFile(file) as tiff:
                page = _check_only_page(tiff, path)
                date = page.tags.get("DateTime")
                return page.asarray(), page.description, "" if date is None else str(date.value)
        except FileFormatError:
            raise
        except (
            Exception
        ) as fault:  # whatever the decoder stumbles over, it is the file that is damaged
            raise FileFormatError(
                path, f"is a damaged or unsupported TIFF ({format_error_line(fault)})"
            ) from fault


def _check_only_page(tiff: tifffile.TiffFile, path: str | Path) -> tifffile.TiffPage:
    """Hold what the header claims against the file before any memory is taken for it."""
    page, size = tiff.pages.first, tiff.filehandle.size
    if len(tiff.pages) != 1:
        raise FileFormatError(path, f"holds {len(tiff.pages)} pictures, expected one streak image")
    if page.ndim != 2 or page.dtype is None or page.dtype.kind not in "uif":
        raise FileFormatError(
            path, f"holds a picture of shape {page.shape}, expected grey (rows, columns)"
        )
    if not 0 < page.size <= MAX_PIXELS:
        raise FileFormatError(path, f"claims an impossible size of {page.shape} pixels")
    # Compressed strips may be shorter than the picture; uncompressed ones (TIFF compression 1) may
    # not.
    end = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True)), default=0)
    if end > size or (page.compression == 1 and sum(page.databytecounts) < page.nbytes):
        raise FileFormatError(
            path, f"is truncated: {page.shape} pixels of {page.dtype} do not fit into {size} bytes"
        )
    return page
