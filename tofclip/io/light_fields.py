"""Light fields in files: NumPy archives, our own HDF5, multi-part OpenEXR (one part for each view, as
renderers write stereo pictures), and folders with one picture for each view.

The names of a folder's pictures end in a view's row and column, ``anything_03_05.png``, or, if
every name ends in one number only, in its place in raster order on a square grid,
``input_Cam027.png``. Numbers may start anywhere; n rows become views ``-(n // 2), ...``, so that 8
run from -4 to 3.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import FileFormatError, StorageError, explain_import
from tofclip.files import (
    BoundedFile,
    atomic_path,
    guard,
    require_bounded_size,
    require_suffix,
)
from tofclip.io.archive import NPY_SUFFIX, Archive
from tofclip.io.hamamatsu import MAX_PIXELS, require_bounded_page
from tofclip.light_field import LightField
from tofclip.storage import Record, collect_provenance

MAX_SAMPLE_BYTES = 4  # samples are half or single precision, or 32-bit integers
PART_NAME_PATTERN = re.compile("v={0},u={0}".format(r"([-+]?\d+(?:\.\d+)?)"))
TIFF_SUFFIXES = (".tif", ".tiff")
IMAGE_SUFFIXES = (".png", *TIFF_SUFFIXES, ".jpg", ".jpeg", ".bmp")
# Weights of linear red, green and blue in the luminance of ITU-R BT.709.
LUMA_WEIGHTS = np.array([0.2125, 0.7154, 0.0721])
GRID_NAME_PATTERN = re.compile(r"(?<!\d)(\d+)\D+(\d+)\D*$")
RASTER_NAME_PATTERN = re.compile(r"(?<!\d)(\d+)\D*$")

Channels = dict[str, AnyArray]


def read_exr_parts(path: Path) -> list[tuple[str, Channels]]:
    """Read name and channels of every part; pixels only if the file can hold them."""
    with explain_import(f"reading {path} needs OpenEXR"):
        import OpenEXR
    claimed, count = 0, 0
    with guard(path, "is a truncated or damaged EXR file"):
        held = os.path.getsize(path)
        with OpenEXR.File(str(path), header_only=True) as file:
            for count, part in enumerate(file.parts, 1):  # noqa: B007 - counted
                first, last = np.asarray(part.header["dataWindow"], np.int64)
                columns, rows = (last - first + 1).tolist()
                claimed += rows * columns * len(part.header["channels"]) * MAX_SAMPLE_BYTES
        require_bounded_size(path, "pixels", claimed, held, compressed=True)
        # the library prints which parts it leaves out
        with redirect_stdout(None), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [
                (part.name(), {name: part.channels[name].pixels for name in part.channels})
                for part in file.parts
            ]
    if len(parts) != count:  # the library leaves out the parts that it cannot decode
        raise FileFormatError(path, "is a truncated or damaged EXR file (a part cannot be decoded)")
    return parts


def write_exr_parts(parts: Mapping[str, Channels], path: str | Path) -> None:
    """Write the channels of parts by their names as 32-bit floats, whole or not at all."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    # The library writes wrong pixels of arrays that are not contiguous, and a part's name into its
    # header.
    made = [
        OpenEXR.Part(
            dict(header),
            {one: np.ascontiguousarray(pixels, np.float32) for one, pixels in channels.items()},
            name,
        )
        for name, channels in parts.items()
    ]
    with atomic_path(path) as temporary:
        OpenEXR.File(made).write(str(temporary))


def read_exr(path: Path) -> LightField:
    """Read the parts named like ``v=-1,u=0``, with a channel Y or with R, G and B."""
    pictures, views = [], []
    for name, channels in read_exr_parts(path):
        view = PART_NAME_PATTERN.fullmatch(name)
        if "Y" in channels:
            pictures.append(channels["Y"].astype(np.float32))
        elif {"R", "G", "B"} <= channels.keys():
            colours = np.stack([channels[colour] for colour in "RGB"], axis=-1)
            pictures.append(compute_luminance(colours))
        else:
            raise FileFormatError(
                path, f"part '{name}' needs a channel Y or R, G and B, found {', '.join(channels)}"
            )
        if view is None:
            raise FileFormatError(
                path, f"part '{name}' does not say which view it is; name it like 'v=0,u=-1'"
            )
        views.append([float(number) for number in view.groups()])
    if len({picture.shape for picture in pictures}) != 1:
        raise FileFormatError(path, "its parts differ in size; every view must have as many pixels")
    return LightField(np.stack(pictures), np.array(views))


def write_exr(light_field: LightField, path: Path) -> None:
    """Write one part for each view with a channel Y."""
    seen = zip(light_field.pictures, light_field.views.tolist(), strict=True)
    write_exr_parts({f"v={v:g},u={u:g}": {"Y": picture} for picture, (v, u) in seen}, path)


def read_folder(folder: Path) -> LightField:
    """Read a folder of pictures; whole numbers are scaled to 0..1, colours become luminance."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise FileFormatError(folder, f"holds no pictures ({', '.join(IMAGE_SUFFIXES)})")
    places = _parse_grid_positions(folder, paths)
    shape = places.max(axis=0) + 1
    number = np.zeros(shape, np.int64)
    np.add.at(number, tuple(places.T), 1)
    if number.max() > 1:
        raise FileFormatError(folder, "two pictures have the same view's number")
    missing = np.argwhere(number == 0)
    if missing.size:
        raise FileFormatError(
            folder,
            f"{len(missing)} of {shape[0]} x {shape[1]} views are missing, the first in row "
            f"{missing[0, 0]}, column {missing[0, 1]} (counted from 0)",
        )
    order = np.lexsort(places.T[::-1])  # by rows, then by columns
    pictures = [_read_picture(paths[n]) for n in order]
    for n, picture in zip(order, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            problem = f"is {picture.shape} px, but the first view is {pictures[0].shape} px"
            raise FileFormatError(paths[n], problem)
    return LightField(np.stack(pictures), (places - shape // 2)[order].astype(np.float64))


def compute_luminance(picture: AnyArray) -> AnyArray:
    """Return the luminance (rows, columns), float32, of a picture; alpha is dropped."""
    if picture.ndim == 2:
        return picture.astype(np.float32)
    if picture.shape[-1] < 3:
        return picture[..., 0].astype(np.float32)
    return np.asarray(picture[..., :3] @ LUMA_WEIGHTS, np.float32)


def _parse_grid_positions(folder: Path, paths: list[Path]) -> IntArray:
    """Row and column of each picture on the grid, from 0, (pictures, 2)."""
    groups = []
    for path in paths:
        found = GRID_NAME_PATTERN.search(path.stem) or RASTER_NAME_PATTERN.search(path.stem)
        if found is None:
            problem = "its name must end in the view's row and column, as in view_03_05"
            raise FileFormatError(path, problem)
        groups.append(found.groups())
    if all(len(group) == 2 for group in groups):
        places = np.array(groups, np.int64)
        return places - places.min(axis=0)
    numbers = np.array([group[-1] for group in groups], np.int64)
    numbers -= numbers.min()
    # One number says nothing about the width of the grid, so that only a square one is certain.
    side = math.isqrt(len(paths))
    if side * side != len(paths):
        raise FileFormatError(
            folder,
            f"{len(paths)} pictures in raster order make no square grid; name them by row and column",
        )
    return np.stack(np.divmod(numbers, side), axis=-1)


def _read_picture(path: Path) -> AnyArray:
    with guard(path, "is a damaged picture"), BoundedFile(path) as file:
        is_tiff = path.suffix.lower() in TIFF_SUFFIXES
        picture = _decode_tiff(path, file) if is_tiff else _decode(path, file)
    if picture.ndim not in (2, 3):
        raise FileFormatError(path, f"must be one grey or colour picture, found {picture.shape}")
    scale = np.iinfo(picture.dtype).max if picture.dtype.kind in "ui" else 1
    return compute_luminance(picture) / np.float32(scale)


def _decode_tiff(path: Path, file: BoundedFile) -> AnyArray:
    import tifffile

    with tifffile.TiffFile(file) as tiff:
        if len(tiff.pages) != 1:
            raise FileFormatError(path, f"holds {len(tiff.pages)} pictures, expected one view")
        require_bounded_page(tiff.pages.first, path)
        return tiff.pages.first.asarray()


def _decode(path: Path, file: BoundedFile) -> AnyArray:
    from matplotlib.image import imread
    from PIL import Image

    header = Image.open(file)  # reads no pixels yet
    claimed = math.prod(header.size) * len(header.getbands())
    if claimed > MAX_PIXELS:
        raise FileFormatError(path, f"claims an impossible size of {header.size} pixels")
    # JPEG is no deflate, but no photograph is smaller than this either.
    require_bounded_size(path, "pixels", claimed, path.stat().st_size, compressed=True)
    file.seek(0)
    return np.asarray(imread(file, format=path.suffix[1:].lower()))


def read_light_field(path: str | Path) -> LightField:
    """Read a light field; the name's ending says how. `path`: ``.npz``: `lf` (v, u, y, x), `scale`,
    a factor for it, and the view numbers `v` and `u`. ``.h5``, ``.hdf5``: written by
    `write_light_field`. ``.exr``: one part for each view, named ``v=0,u=-1``.
    """
    source = Path(path)
    if source.is_dir():
        return read_folder(source)
    if not source.exists():
        raise StorageError(f"{source}: no such file or folder")
    reader = _READERS.get(source.suffix.lower())
    if reader is None:
        raise FileFormatError(
            source, f"is not a light field; take a folder of pictures or {', '.join(_READERS)}"
        )
    return reader(source)


def write_light_field(light_field: LightField, path: str | Path) -> None:
    """Write a light field, whole or not at all, as ``.h5``, ``.hdf5`` or ``.exr`` (float32)."""
    target = Path(path)
    require_suffix(target, *_WRITERS)
    _WRITERS[target.suffix.lower()](light_field, target)


def read_depth_map(path: str | Path) -> FloatArray:
    """Read the shear of each pixel of the reference view, (rows, columns), pixels per view step,
    infinite where there is nothing: ``.npy``, or ``.h5`` written by ``tofclip clip recover
    --all-in-focus``.
    """
    source = Path(path)
    if source.suffix.lower() != NPY_SUFFIX:
        return Record.load(source, "picture").array("shears", np.float64, 2, "px")
    with guard(source):
        # mapped, so that a header that claims more than there is takes no memory
        mapped = np.load(source, mmap_mode="r", allow_pickle=False)
    if mapped.ndim != 2 or mapped.dtype.kind not in "fiu":
        problem = f"a map of depths is (rows, columns) numbers, found {mapped.shape}"
        raise FileFormatError(source, problem)
    return np.array(mapped, np.float64)


def _read_archive(path: Path) -> LightField:
    archive = Archive(path)
    pictures = archive.array("lf", None, None, None, None)
    v, u = map(archive.finite_array, "vu", pictures.shape[:2])
    # Pictures may be stored as integers to save space; `scale` turns them into values.
    scaled = pictures.astype(np.float32) * np.float32(archive.finite_array("scale"))
    grid = np.stack(np.meshgrid(v, u, indexing="ij"), axis=-1)
    return LightField(scaled.reshape(-1, *pictures.shape[2:]), grid.reshape(-1, 2))


def _write_record(light_field: LightField, path: Path) -> None:
    replace(light_field.to_record(), provenance=collect_provenance({})).save(path)


_READERS: dict[str, Callable[[Path], LightField]] = {
    ".npz": _read_archive,
    ".h5": LightField.load,
    ".hdf5": LightField.load,
    ".exr": read_exr,
}
_WRITERS: dict[str, Callable[[LightField, Path], None]] = {
    ".h5": _write_record,
    ".hdf5": _write_record,
    ".exr": write_exr,
}
