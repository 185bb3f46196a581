"""ITEX pictures as HPD-TA writes them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.io.hamamatsu import ITEX_HEADER, PIXEL_TYPES, SIGNATURE


def encode_itex(
    pixels: NDArray[Any],
    text: str,
    tables: Mapping[str, NDArray[Any]] = {},
    offset_px: tuple[int, int] = (0, 0),
) -> bytes:
    """Return the bytes of an ITEX file, the tables (of X and Y) right behind the pixels, X first.

    The text names a place for each of them, ``ScalingYScalingFile="..."``; where the table really
    lies is filled in, again while a longer number has moved them.
    """
    kind = next(number for number, dtype in PIXEL_TYPES.items() if dtype == pixels.dtype)
    own = text.encode()
    while True:
        filled, start = own, ITEX_HEADER.size + len(own) + pixels.nbytes
        for axis in sorted(tables):
            entry = f"Scaling{axis}ScalingFile".encode()
            place = entry + f'="#{start:07d},{tables[axis].size:04d}"'.encode()
            filled = re.sub(entry + b'="[^"]*"', place, filled, count=1)
            start += 4 * tables[axis].size
        if len(filled) == len(own):
            break
        own = filled
    rows, columns = pixels.shape
    header = ITEX_HEADER.pack(SIGNATURE, len(filled), columns, rows, *offset_px, kind)
    stored = [np.asarray(tables[axis], "<f4").tobytes() for axis in sorted(tables)]
    return b"".join([header, filled, np.ascontiguousarray(pixels).tobytes(), *stored])
