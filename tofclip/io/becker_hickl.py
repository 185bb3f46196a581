"""Becker & Hickl's ``.sdt`` files: what their blocks claim is checked before `sdtfile` reads them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.dependencies import import_file_reader
from tofclip.errors import FileFormatError
from tofclip.files import BoundedFile, require_bounded_size
from tofclip.io.archive import MEMBER_COMPRESSIONS

LAST_OLD_REVISION = 14
# `no_of_data_blocks` has 16 bits; where they do not suffice it says this, and the number is in
# `reserved1`.
EXTENDED_COUNT = 0x7FFF


def read_sdt_blocks(path: Path) -> tuple[list[NDArray[Any]], float]:
    """Read all histograms of a file.

    Returns (..., bins) counts of each block: (rows, columns, bins) of an image; duration of a bin,
    s.
    """
    sdtfile = import_file_reader("sdtfile", "tofclip[tcspc]")
    require_bounded_sdt(path)
    with BoundedFile(path) as opened, sdtfile.SdtFile(opened) as file:
        blocks = [np.asarray(block) for block in file.data]
        steps = {float(times[1] - times[0]) for times in file.times if len(times) > 1}
    if len(steps) != 1:
        raise FileFormatError(
            path, f"has blocks of {len(steps)} different resolutions, expected one"
        )
    return blocks, steps.pop()


def require_bounded_sdt(path: Path) -> None:
    """Refuse a file that claims more in its blocks than it can hold."""
    from sdtfile import sdtfile

    layout = np.dtype(sdtfile.FILE_HEADER).newbyteorder("<")
    size = path.stat().st_size
    if size < layout.itemsize:
        raise FileFormatError(path, "is truncated: it is shorter than an SDT header")
    header = np.fromfile(path, layout, 1)[0]
    revision = sdtfile.FileRevision(int(header["revision"])).revision
    names = sdtfile.BLOCK_HEADER if revision > LAST_OLD_REVISION else sdtfile.BLOCK_HEADER_OLD
    layout = np.dtype(names).newbyteorder("<")
    number, place = int(header["no_of_data_blocks"]), int(header["data_block_offs"])
    if number == EXTENDED_COUNT:
        number = int(header["reserved1"])
    require_bounded_size(path, "blocks", number * layout.itemsize, size)
    for block in range(number):
        if place + layout.itemsize > size:
            raise FileFormatError(path, f"is truncated: block {block} lies beyond its end")
        found = np.fromfile(path, layout, 1, offset=place)[0]
        packed = bool(sdtfile.BlockType(int(found["block_type"])).compress)
        require_bounded_size(path, f"block {block}", int(found["block_length"]), size, packed)
        begin, place = int(found["data_offs"]), int(found["next_block_offs"])
        if packed:
            _require_bounded_archive(path, f"block {block}", begin, place)


def _require_bounded_archive(path: Path, name: str, begin: int, end: int) -> None:
    """Refuse a packed block, a ZIP archive of one member, that would unpack to any size."""
    if not 0 <= begin < end <= path.stat().st_size:
        raise FileFormatError(path, f"is truncated or damaged: {name} lies beyond its end")
    with BoundedFile(path) as opened:
        opened.seek(begin)
        content = opened.read(end - begin)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.filelist[:1]:
            if member.compress_type not in MEMBER_COMPRESSIONS:
                raise FileFormatError(path, f"{name} is packed in a way that is not read")
            require_bounded_size(path, name, member.file_size, member.compress_size, True)
