"""ITEX pictures as HPD-TA writes them."""

import re

import numpy as np

from tofclip.io.hamamatsu import ITEX_HEADER, PIXEL_TYPES, SIGNATURE


def encode_itex(pixels, text, tables=None, offset_px=(0, 0)):
    """Return the bytes of an ITEX file, the tables (of X and Y) right behind the pixels, X first.

    The text names a place for each of them, ``ScalingYScalingFile="..."``; where the table really
    lies is filled in, again while a longer number has moved them.
    """
    tables = tables or {}
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
