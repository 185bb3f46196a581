"""Read counted photons, whichever program wrote them: cubes of counts, lists of photon times for
every pixel, and events.

What a file holds is listed before a value is read, so that a damaged or malicious header costs no
memory: a size is believed only if the file can hold it and if it stays below a limit, see `tofclip.files`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray
from tofclip.errors import FileFormatError, InputError
from tofclip.files import (
    BoundedFile,
    guard,
    import_file_reader,
    iterate_members,
    require_bounded_dataset,
    require_bounded_size,
    translate_read_errors,
)
from tofclip.io.archive import (
    ArchiveEntry,
    list_mat_entries,
    list_npz_entries,
    read_npy_header,
)
from tofclip.io.hamamatsu import require_whole_chain
from tofclip.io.tcspc import TCSPC, PtuEvents, get_scan_shape, read_scan, read_sdt_blocks
from tofclip.lidar.photons.image import PhotonImage
from tofclip.storage import HDF5_SIGNATURE

PHOTON_SUFFIXES = (".npy", ".mat", ".ptu", ".sdt")  # counted photons or nothing of ours
MAX_IMAGE_BYTES = 1 << 32  # of a histogram that is made of a list of events
MAX_BINS = MAX_PIXELS = 1 << 26  # events may claim any; pictures and histograms are not larger
MIN_AXES_CERTAINTY = 2.0
"""Factor by which the time axis has to be ahead: the square of that by which it is longer, or light
more uneven along it, than another axis."""
MAX_LENGTH_RATIO = 3.0  # a line of pixels may be longer than time by any factor
MIN_UNEVENNESS = 0.03  # variance of light over its mean squared; what is less says nothing
# Pixels brighter than this many times the quantile of all weigh no more: up to a tenth may be hot.
BRIGHT_PIXEL_QUANTILE, BRIGHT_PIXEL_RATIO = 0.9, 2.0
MAX_LOOKED_AT = 1 << 25  # values, evenly chosen, that say which axis is time
MAX_SECONDS = 1e-3  # photon times that are all shorter and not whole are seconds, others bins

SUITABLE = (
    "a cube of counts (y, x, t), a list of photon times for each pixel (cells (y, x)) or of one "
    "(`time`), or events x, y, time would do"
)
CUBE_NAMES = ("counts", "histogram", "histograms", "cube", "photons", "spad", "data")
TIME_NAMES = ("time", "t", "bin", "tof", "times")
BIN_WIDTH_NAMES = {
    "bin_width_s": 1.0,
    "bin_width_ns": 1e-9,
    "bin_width_ps": 1e-12,
    "resolution_s": 1.0,
    "resolution_ps": 1e-12,
}


@dataclass(frozen=True)
class _PhotonFile:
    """What a file says it holds."""

    arrays: Mapping[str, ArchiveEntry]  # of objects where pixels have lists of times (cells)
    bin_width: float | None = None  # s, where the file says it
    axes: str = ""  # order of the axes of a cube where the format says it
    image_shape: tuple[int, int] | None = None  # of the picture of events where the format says it


_PhotonReader = Callable[[Path], _PhotonFile]


def read_photons(
    path: str | Path, bin_width: float | None = None, axes: str | None = None
) -> PhotonImage:
    """Read the photons that every pixel of a picture counted. `bin_width`: duration of a bin, or
    unit of the photon times, s; overrides the file's own; `axes`: order of a cube's axes, such as
    ``"yxt"`` or ``"txy"``, of a line's, such as ``"xt"``, of one histogram, ``"t"``, or of the columns
    of a list of events; by default that is time along which light is most concentrated and which is
    longest, `PhotonImage.axes` says how surely, and events are x, y, t. `path` may be a folder with a
    file for each row.
    """
    source = Path(path)
    if axes is not None and ("t" not in axes or len({*axes} & {*"yxt"}) != len(axes)):
        raise InputError(f"axes are an order of y, x and t such as yxt, got '{axes}'")
    opened = _open_photons(source)
    width = opened.bin_width if bin_width is None else bin_width
    if width is None:
        raise InputError(f"{source}: does not say how long a bin lasts; give `bin_width`")
    with guard(source, "is damaged"):
        return _read_layout(opened, source, width, axes)


def describe_photons(path: str | Path) -> dict[str, Any]:
    """Return what a file of photons holds, without reading its values."""
    opened = _open_photons(Path(path))
    axes = opened.axes
    try:
        layout = _find_layout(opened, Path(path))
    except FileFormatError:
        order = "yxt"[-max((len(one.shape) for one in opened.arrays.values()), default=0) :]
        # a picture of one row or one pixel, or a line, whose axes no shape tells: any order shows its array
        layout = _find_layout(opened, Path(path), order)
        axes = f"not recognised: tofclip lidar photons takes --axes, e.g. {order}"
    arrays = {
        name: f"{' x '.join(map(str, entry.shape))} {'cell' if _is_cell(entry) else entry.dtype}"
        for name, entry in opened.arrays.items()
    }
    found = {"kind": "photons", "layout": layout[0], "bin_width_s": opened.bin_width, "axes": axes}
    return {name: told for name, told in found.items() if told} | {"arrays": arrays}


def _open_photons(path: Path) -> _PhotonFile:
    """List the arrays of a file by the reader that its first bytes or its name ask for."""
    if path.is_dir():
        return _open_rows(path)
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(520)
    if not start:
        raise FileFormatError(path, "is empty")
    reader = READERS_BY_SUFFIX.get(path.suffix.lower())
    for signature, known in READERS_BY_SIGNATURE.items():
        # MATLAB's HDF5 files begin with a block of their own
        if start.startswith(signature) or start[512:] == signature:
            reader = known
    if reader is None:
        raise FileFormatError(
            path, f"is not NPY, NPZ, MAT, HDF5, TIFF, PTU or SDT with photons; {SUITABLE}"
        )
    with guard(path, f"is damaged; {SUITABLE}"):
        return reader(path)


def _open_rows(folder: Path) -> _PhotonFile:
    """A cube with a file for each row, in the order of their names, numbers in them as numbers."""

    def count(file: Path) -> list[tuple[int, str]]:
        words = re.split(r"(\d+)", file.stem)
        return [(int(word), "") if word.isdigit() else (-1, word) for word in words]

    files = sorted((one for one in folder.iterdir() if one.name[0] != "."), key=count)
    opened = [_open_photons(file) for file in files]
    rows = [one for each in opened for one in each.arrays.values() if len(one.shape) == 2]
    if len(rows) != len(files) or len({(one.shape, one.dtype) for one in rows}) != 1:
        raise FileFormatError(
            folder, "is no cube with an array of one shape (x, t) in a file for each row"
        )
    shape = len(rows), *rows[0].shape  # each file bounds its own
    entry = ArchiveEntry(shape, rows[0].dtype, lambda: np.stack([one.load() for one in rows]))
    return _PhotonFile({"rows": entry}, opened[0].bin_width)


def _is_cell(entry: ArchiveEntry) -> bool:
    return bool(entry.dtype.hasobject)


def _find_layout(
    opened: _PhotonFile, path: Path, axes: str | None = None
) -> tuple[str, list[ArchiveEntry]]:
    """Choose the arrays that hold the photons."""
    arrays, sides = opened.arrays, len(axes) if axes else 3
    cells = [one for one in arrays.values() if _is_cell(one) and len(one.shape) == 2]
    numbers = {name: one for name, one in arrays.items() if not _is_cell(one)}
    thick = {name: sum(length != 1 for length in one.shape) for name, one in numbers.items()}
    cubes = {name: one for name, one in numbers.items() if thick[name] == sides}
    if not cubes and (axes or opened.axes):  # known: there may be one row, or one pixel
        cubes = {name: one for name, one in numbers.items() if len(one.shape) == sides}
    named = {n: one for n, one in cubes.items() if n.rpartition("/")[2].lower() in CUBE_NAMES}
    for layout, found in (
        ("cube", [*named.values()]),
        ("cube", [*cubes.values()]),
        ("cells", cells),
    ):
        if len(found) == 1 and (layout == "cube" or not cubes):
            return layout, found
    if not cubes and not cells:
        flat = {name.lower(): one for name, one in numbers.items() if thick[name] == 1}
        times = [flat[name] for name in TIME_NAMES if name in flat]
        if times and "x" in flat and "y" in flat:
            return "events", [flat["y"], flat["x"], times[0]]
        # three rows may be a line of three pixels: that they are x, y and t has to be said
        first = 0 if sides == 3 and axes else 1
        tables = [one for one in numbers.values() if len(one.shape) == 2 and 3 in one.shape[first:]]
        if len(tables) == 1 and max(tables[0].shape) > 3:
            return "table", tables
        if len(flat) == 1:
            ((name, alone),) = flat.items()
            words = re.split(r"[^a-z]+", f"{name} {path.stem.lower()}")
            if {*words} & {*TIME_NAMES, "tdc", "stamps"}:
                return "times", [alone]
    held = ", ".join(f"{name} {one.shape}" for name, one in [*arrays.items()][:6]) or "no arrays"
    problem = "several cubes of photons" if len(cubes) > 1 else "no photons"
    remedy, shapes = SUITABLE, [one.shape for one in numbers.values()]
    if not cubes and len(shapes) == 1 and 1 <= len(shapes[0]) <= 3:
        line = "xyt of events" if shapes[0][0] == 3 else "xt of a line"
        fitting = "t of one histogram", line, "yxt of a picture of one row"
        remedy = f"give `axes`, e.g. {fitting[len(shapes[0]) - 1]}"
    raise FileFormatError(path, f"holds {problem} ({held}); {remedy}")


def _read_layout(
    opened: _PhotonFile, path: Path, bin_width: float, axes: str | None
) -> PhotonImage:
    layout, arrays = _find_layout(opened, path, axes)
    if layout == "cube":
        cube = arrays[0].load()
        sides = len(axes) if axes else 3
        if cube.ndim > sides:
            cube = np.squeeze(cube)
            cube = cube.reshape(cube.shape + (1,) * (sides - cube.ndim))
        if cube.dtype.kind not in "uifb":
            raise FileFormatError(path, f"its cube holds {cube.dtype}, not counts; {SUITABLE}")
        order, how = axes or opened.axes, ""
        if not order:
            order, certainty = recognise_axes(cube, path)
            how = f"{order}, ahead of the next axis by a factor of {certainty:.2g}"
        missing = "".join(axis for axis in "yx" if axis not in order)
        cube, order = cube.reshape((1,) * len(missing) + cube.shape), missing + order
        ordered = np.transpose(cube, [order.index(axis) for axis in "yxt"])
        return replace(PhotonImage.from_cube(ordered, bin_width), axes=how)
    if layout == "cells":
        cells = arrays[0].load()
        lists = [np.asarray(cell).ravel() for cell in cells.ravel()]
        pixel = np.repeat(np.arange(len(lists)), [one.size for one in lists])
        times = np.concatenate(lists) if pixel.size else np.zeros(0)
        rows, columns = cells.shape
    elif layout == "times":
        times = arrays[0].load().ravel()
        pixel, (rows, columns) = np.zeros(times.size, np.int64), (1, 1)
    else:
        if layout == "table":
            table = np.asarray(arrays[0].load())
            lines = table.T if table.shape[1] == 3 else table
            y, x, times = (lines[(axes or "xyt").index(axis)] for axis in "yxt")
        else:
            y, x, times = (np.squeeze(entry.load()) for entry in arrays)
        if not y.shape == x.shape == times.shape or min(y.min(initial=0), x.min(initial=0)) < 0:
            raise FileFormatError(path, "its x, y and time are not lists of the same events")
        seen = int(y.max(initial=0)) + 1, int(x.max(initial=0)) + 1
        rows, columns = opened.image_shape or seen
        if rows * columns > MAX_PIXELS:
            raise FileFormatError(path, f"claims a picture of {rows} x {columns} pixels")
        pixel = y.astype(np.int64) * columns + x.astype(np.int64)
    if times.dtype.kind not in "uif":
        raise FileFormatError(path, f"its photon times are {times.dtype}, not numbers")
    seconds = times.dtype.kind == "f" and times.size and 0 < np.max(times) < MAX_SECONDS
    number = times / bin_width if seconds else times
    if number.size and np.max(number) > MAX_BINS:
        raise InputError(f"{path}: its photons come as late as bin {np.max(number):.3g}")
    return PhotonImage.from_events(pixel, number, (rows, columns), bin_width)


def recognise_axes(cube: AnyArray, path: Path) -> tuple[str, float]:
    """Say which axis of a cube is time: light is concentrated along it, and it is long. Returns
    ``tyx``, ``ytx`` or ``yxt``, and by what factor it is ahead of the next axis.
    """
    step = math.ceil((cube.size / MAX_LOOKED_AT) ** (1 / 3))
    light, score = np.empty(3), np.empty(3)
    for axis in range(3):
        others = [cube.shape[other] for other in range(3) if other != axis]
        length = np.clip(cube.shape[axis] / max(others), 1 / MAX_LENGTH_RATIO, MAX_LENGTH_RATIO)
        light[axis] = _compare_concentration(cube[::step, ::step, ::step], axis)
        score[axis] = length * light[axis]
    second, first = np.argsort(score)[-2:]
    # Hot pixels in a short picture make light uneven along its long axis: then two are in question.
    rival = max(light[axis] for axis in range(3) if axis != first)
    certainty = float(score[first] / score[second] / max(rival, 1.0))
    order = "tyx", "ytx", "yxt"
    if certainty < MIN_AXES_CERTAINTY:
        raise InputError(
            f"{path}: neither its shape {cube.shape} nor its light says which axis is time ({order[int(first)]} "
            f"is ahead of {order[int(second)]} by a factor of {certainty:.2g}); give `axes`, e.g. yxt"
        )
    return order[int(first)], certainty


def _compare_concentration(cube: AnyArray, time: int) -> float:
    """Unevenness of light along an axis over that along the other two, were it the time axis: hot
    pixels, which rule every sum, then weigh no more than bright ones.
    """
    picture = cube.sum(axis=time, dtype=np.float64)
    bright = BRIGHT_PIXEL_RATIO * max(float(np.quantile(picture, BRIGHT_PIXEL_QUANTILE)), 1.0)
    weight = np.minimum(1.0, bright / np.maximum(picture, bright))
    axes = "yxt".replace("yxt"[time], "")
    along = np.einsum(f"yxt,{axes}->{'yxt'[time]}", cube, weight)
    weighted = picture * weight
    unevenness = []
    for profile in (along, weighted.sum(axis=0), weighted.sum(axis=1)):
        mean = max(profile.mean(), 1e-9)
        # photons alone make a profile uneven by one over their number in an entry
        unevenness.append(max((profile.var() / mean - 1) / mean, MIN_UNEVENNESS))
    return float(unevenness[0] / max(unevenness[1:]))


def _open_npy(path: Path) -> _PhotonFile:
    with BoundedFile(path) as file:
        shape, dtype = read_npy_header(file)
        held = path.stat().st_size - file.tell()
    require_bounded_size(path, "array", math.prod(shape) * dtype.itemsize, held)

    load = partial(np.load, path, mmap_mode="r", allow_pickle=False)
    return _PhotonFile({"array": ArchiveEntry(shape, dtype, load)})


def _open_archive(
    list_entries: Callable[[Path], Mapping[str, ArchiveEntry]], path: Path
) -> _PhotonFile:
    """Tell the bin width from the arrays of an NPZ file, or of a MAT file of version 5."""
    entries = list_entries(path)
    scalars = {
        name: entry.load()
        for name, entry in entries.items()
        if name in BIN_WIDTH_NAMES and math.prod(entry.shape) == 1 and entry.dtype.kind in "uif"
    }
    arrays = {n: entry for n, entry in entries.items() if entry.shape and n not in scalars}
    return _PhotonFile(arrays, _find_bin_width(scalars))


def _find_bin_width(scalars: Mapping[str, Any]) -> float | None:
    for name, unit in BIN_WIDTH_NAMES.items():
        if name in scalars and np.size(scalars[name]) == 1:
            value = float(np.asarray(scalars[name]).ravel()[0]) * unit
            if math.isfinite(value) and value > 0:
                return value
    return None


def _open_hdf5(path: Path) -> _PhotonFile:
    import h5py

    arrays, scalars = {}, {}
    with h5py.File(path, "r") as file:
        scalars.update(file.attrs)
        for name, dataset in _iterate_datasets(file, set()):
            scalars.update(dataset.attrs)
            is_cell = dataset.dtype.kind == "O" and dataset.attrs.get("MATLAB_class") == b"cell"
            if dataset.shape is None or not (is_cell or dataset.dtype.kind in "uif"):
                continue
            require_bounded_dataset(dataset, path, objects=is_cell)
            if dataset.size == 1 and not is_cell:
                scalars[name.rpartition("/")[2]] = dataset[()]
            elif dataset.shape:
                # MATLAB counts its axes from the other end.
                matlab = "MATLAB_class" in dataset.attrs
                shape = dataset.shape[::-1] if matlab else dataset.shape
                load = partial(_load_dataset, path, name, matlab)
                arrays[name] = ArchiveEntry(shape, dataset.dtype, load)
    return _PhotonFile(arrays, _find_bin_width(scalars))


def _iterate_datasets(group: Any, visited: set[int], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the datasets of a file that lie in it, each once: links to elsewhere are not followed."""
    import h5py

    for name, item in iterate_members(group, visited):
        if name == "#refs#":
            continue
        if isinstance(item, h5py.Dataset):
            if not (item.external or item.is_virtual):
                yield prefix + name, item
        elif isinstance(item, h5py.Group) and prefix.count("/") < 8:
            yield from _iterate_datasets(item, visited, f"{prefix}{name}/")


def _load_dataset(path: Path, name: str, matlab: bool) -> AnyArray:
    import h5py

    with h5py.File(path, "r") as file:
        values: AnyArray = file[name][()]
        if values.dtype.kind == "O":
            total, cells = 0, np.empty(values.shape, dtype=object)
            for place in np.ndindex(values.shape):
                cell = file[values[place]]
                require_bounded_dataset(cell, path)
                total += cell.size * cell.dtype.itemsize
                require_bounded_size(path, name, total, path.stat().st_size, True)
                empty = bool(cell.attrs.get("MATLAB_empty", 0))
                cells[place] = np.zeros(0, np.uint8) if empty else cell[()]
            values = cells
    return values.T if matlab else values


def _open_tiff(path: Path) -> _PhotonFile:
    import tifffile

    with BoundedFile(path) as file, tifffile.TiffFile(file) as tiff:
        require_whole_chain(tiff, path)
        series = tiff.series[0]
        if len(series.shape) != 3 or series.dtype is None:
            problem = f"holds pictures of shape {series.shape}, not one page for each bin (t, y, x)"
            raise FileFormatError(path, problem)
        packed = sum(sum(page.databytecounts) for page in series.pages if page is not None)
        size = math.prod(series.shape) * series.dtype.itemsize
        require_bounded_size(path, "pictures", size, packed, series.keyframe.compression != 1)
        shape, dtype = tuple(series.shape), series.dtype

    def load() -> AnyArray:
        with BoundedFile(path) as reopened, tifffile.TiffFile(reopened) as again:
            return again.series[0].asarray()

    return _PhotonFile({"pages": ArchiveEntry(shape, dtype, load)}, axes="tyx")


def _open_ptu(path: Path) -> _PhotonFile:
    """PicoQuant's images: markers make lines and frames; frames and channels are summed."""
    ptufile = import_file_reader("ptufile", TCSPC)
    with BoundedFile(path) as opened, ptufile.PtuFile(opened) as file:
        if not file.is_image:
            remedy = "tofclip recover reads lone pixels (file://run.ptu)"
            raise FileFormatError(path, f"holds no image; {remedy}")
        if not file.is_t3:
            return _open_scan(path)
        _, rows, columns, _, bins = file.shape
        shape, claimed = (rows, columns, bins), rows * columns * bins * 4
        if claimed > MAX_IMAGE_BYTES:  # the file does not bound it: it is sparse
            problem = f"'image' claims {claimed} bytes, more than the {MAX_IMAGE_BYTES}"
            raise FileFormatError(path, f"{problem} that are read")
        width = float(file.tcspc_resolution)
        start = int(file.record_offset)
        # Where the end was cut off, what is there counts.
        count = max(0, min(int(file.number_records), (path.stat().st_size - start) // 4))

    def load() -> AnyArray:
        # Mapped by NumPy: ptufile's own ways of it differ between its versions.
        words = np.memmap(path, "<u4", "r", start, (count,)) if count else np.empty(0, "<u4")
        with BoundedFile(path) as reopened, ptufile.PtuFile(reopened) as again:
            cube = again.decode_image(records=words, frame=-1, channel=-1, dtype=np.uint32)
        summed: AnyArray = np.asarray(cube).sum(axis=(0, 3), dtype=np.uint32)
        return summed

    return _PhotonFile({"image": ArchiveEntry(shape, np.dtype(np.uint32), load)}, width, "yxt")


def _open_scan(path: Path) -> _PhotonFile:
    """PicoQuant's images in T2 mode: markers make lines and frames; frames are put together."""
    events = PtuEvents(path)
    rows, columns = get_scan_shape(events)
    if rows * columns > MAX_PIXELS:
        raise FileFormatError(path, f"claims a picture of {rows} x {columns} pixels")
    scan = read_scan(events)  # only then it is known which events are photons in a line
    found = {"x": scan.x, "y": scan.y, "time": scan.time}
    arrays = {name: ArchiveEntry.of(values) for name, values in found.items()}
    return _PhotonFile(arrays, events.tick, "", (rows, columns))


def _open_sdt(path: Path) -> _PhotonFile:
    """Becker & Hickl's images; those of several channels are summed."""
    blocks, width = read_sdt_blocks(path)
    # Before the last three axes some have those of routed detectors.
    images = [
        part for block in blocks if block.ndim >= 3 for part in block.reshape(-1, *block.shape[-3:])
    ]
    if not images:
        raise FileFormatError(path, "holds no image, only single histograms; " + SUITABLE)
    shape = images[0].shape
    if any(image.shape != shape for image in images):
        shapes = ", ".join(" x ".join(map(str, image.shape)) for image in images)
        raise FileFormatError(path, f"holds images of different shapes ({shapes})")
    dtype = np.dtype(np.uint32) if len(images) > 1 else images[0].dtype
    load = partial(np.sum, images, axis=0, dtype=dtype)
    return _PhotonFile({"image": ArchiveEntry(shape, dtype, load)}, width, "yxt")


_open_mat = partial(_open_archive, list_mat_entries)
READERS_BY_SIGNATURE: dict[bytes, _PhotonReader] = {
    b"\x93NUMPY": _open_npy,
    b"PK\x03\x04": partial(_open_archive, list_npz_entries),
    b"MATLAB 5": _open_mat,
    HDF5_SIGNATURE: _open_hdf5,
    b"II*\0": _open_tiff,
    b"MM\0*": _open_tiff,
    b"II+\0": _open_tiff,
    b"PQTTTR": _open_ptu,
}
READERS_BY_SUFFIX: dict[str, _PhotonReader] = {".mat": _open_mat, ".sdt": _open_sdt}
