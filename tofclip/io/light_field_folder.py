"""Light fields as folders with one picture for each view.

Names end in a view's row and column, ``anything_03_05.png``, or, if every name ends in one number
only, in its place in raster order on a square grid, ``input_Cam027.png``. Numbers may start
anywhere; n rows become views ``-(n // 2), ...``, so that 8 run from -4 to 3.
"""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.file_limits import BoundedFile, require_bounded_size
from tofclip.io.tiff import MAX_PIXELS, NULL_LOG_HANDLER, require_bounded_page
from tofclip.light_field import LightField
from tofclip.storage import format_error_line

TIFF_SUFFIXES = (".tif", ".tiff")
IMAGE_SUFFIXES = (".png", *TIFF_SUFFIXES, ".jpg", ".jpeg", ".bmp")
# Weights of linear red, green and blue in the luminance of ITU-R BT.709.
LUMA_WEIGHTS = np.array([0.2125, 0.7154, 0.0721])
GRID_NAME_PATTERN = re.compile(r"(\d+)\D+(\d+)\D*")
RASTER_NAME_PATTERN = re.compile(r"(\d+)\D*")


def read_folder(folder: Path) -> LightField:
    """Read a folder of pictures; whole numbers are scaled to 0..1, colours become luminance.

    Raises
    ------
    FileFormatError
        There are no pictures, names carry no numbers, views are missing, or pictures differ in
        size.
    """
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise FileFormatError(folder, f"holds no pictures ({', '.join(IMAGE_SUFFIXES)})")
    places = _parse_grid_positions(folder, paths)
    _check_complete_grid(folder, places)
    pictures = [_read_picture(path) for path in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise FileFormatError(
                path, f"is {picture.shape} px, but the first view is {pictures[0].shape} px"
            )
    views = places - (places.max(axis=0) + 1) // 2
    # The last key of lexsort counts most: rows first, then columns.
    order = np.lexsort((places[:, 1], places[:, 0]))
    return LightField(np.stack([pictures[n] for n in order]), views[order].astype(np.float64))


def compute_luminance(picture: NDArray[Any]) -> NDArray[Any]:
    """Return the luminance (rows, columns), float32, of a grey or colour picture; an alpha channel
    is dropped.
    """
    if picture.ndim == 2:
        return picture.astype(np.float32)
    if picture.shape[-1] < 3:
        return picture[..., 0].astype(np.float32)
    grey: NDArray[Any] = (picture[..., :3] @ LUMA_WEIGHTS).astype(np.float32)
    return grey


def _parse_grid_positions(folder: Path, paths: list[Path]) -> NDArray[np.int64]:
    """Row and column of each picture on the grid, from 0, (pictures, 2)."""
    both = [_match_at_end(GRID_NAME_PATTERN, path.stem) for path in paths]
    if all(both):
        found = np.array([[int(n) for n in match.groups()] for match in both if match])
        places: NDArray[np.int64] = found - found.min(axis=0)
        return places
    one = [_match_at_end(RASTER_NAME_PATTERN, path.stem) for path in paths]
    if not all(one):
        unnamed = paths[[bool(match) for match in one].index(False)]
        raise FileFormatError(
            unnamed, "its name must end in the view's row and column, as in view_03_05"
        )
    numbers = np.array([int(match[1]) for match in one if match])
    numbers -= numbers.min()
    # One number says nothing about the width of the grid, so that only a square one is certain.
    side = math.isqrt(len(paths))
    if side * side != len(paths):
        raise FileFormatError(
            folder,
            f"{len(paths)} pictures in raster order make no square grid; name them by row and column",
        )
    return np.stack(np.divmod(numbers, side), axis=-1)


def _match_at_end(pattern: re.Pattern[str], stem: str) -> re.Match[str] | None:
    """Match `pattern` at the end of a name, as many digits as there are."""
    found = None
    for match in re.finditer(r"(?<!\d)\d", stem):
        found = pattern.fullmatch(stem, match.start()) or found
    return found


def _check_complete_grid(folder: Path, places: NDArray[np.int64]) -> None:
    rows, columns = (int(n) + 1 for n in places.max(axis=0))
    have = {(int(row), int(column)) for row, column in places}
    if len(have) < len(places):
        raise FileFormatError(folder, "two pictures have the same view's number")
    if rows * columns != len(have):
        row, column = next(
            (r, c) for r in range(rows) for c in range(columns) if (r, c) not in have
        )
        raise FileFormatError(
            folder,
            f"{rows * columns - len(have)} of {rows} x {columns} views are missing, the first in row {row}, "
            f"column {column} (counted from 0)",
        )


def _read_picture(path: Path) -> NDArray[Any]:
    try:
        picture = _decode_tiff(path) if path.suffix.lower() in TIFF_SUFFIXES else _decode(path)
    except (FileFormatError, MemoryError):
        raise
    except Exception as fault:  # whatever the decoder stumbles over, it is the file that is damaged
        raise FileFormatError(path, f"is a damaged picture ({format_error_line(fault)})") from fault
    if picture.ndim not in (2, 3):
        raise FileFormatError(path, f"must be one grey or colour picture, found {picture.shape}")
    scale = np.iinfo(picture.dtype).max if picture.dtype.kind in "ui" else 1
    return compute_luminance(picture) / np.float32(scale)


def _decode_tiff(path: Path) -> NDArray[Any]:
    import tifffile

    logging.getLogger("tifffile").addHandler(NULL_LOG_HANDLER)
    with BoundedFile(path) as file, tifffile.TiffFile(file) as tiff:
        if len(tiff.pages) != 1:
            raise FileFormatError(path, f"holds {len(tiff.pages)} pictures, expected one view")
        require_bounded_page(tiff.pages.first, path)
        return np.asarray(tiff.pages.first.asarray())


def _decode(path: Path) -> NDArray[Any]:
    from matplotlib.image import imread
    from PIL import Image

    with BoundedFile(path) as file, Image.open(file) as header:  # reads no pixels yet
        claimed = math.prod(header.size) * len(header.getbands())
    if claimed > MAX_PIXELS:
        raise FileFormatError(path, f"claims an impossible size of {header.size} pixels")
    # JPEG is no deflate, but no photograph is smaller than this either.
    require_bounded_size(path, "pixels", claimed, path.stat().st_size, compressed=True)
    with BoundedFile(path) as file:
        return np.asarray(imread(file, format=path.suffix[1:].lower()))
