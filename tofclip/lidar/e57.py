"""E57 (ASTM E2807), through pye57 (an optional library).

The scan holds positions and intensity, which every reader of E57 knows. All other columns lie in a
table of an extension beside it, ``tofclip:columns``, row by row in the same order.
"""

from __future__ import annotations

import contextlib
import functools
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.errors import FileFormatError, MissingDependencyError, TofclipError
from tofclip.files import require_bounded_size
from tofclip.io.archive import ArchiveEntry
from tofclip.lidar.column import Columns, Table

EXTENSION = "tofclip"
EXTENSION_URI = "urn:tofclip:cloud:1"
EXTRA_COLUMNS = f"{EXTENSION}:columns"
STANDARD_NAMES = {
    "x": "cartesianX",
    "y": "cartesianY",
    "z": "cartesianZ",
    "intensity": "intensity",
}


def write_e57(path: Path, columns: Columns) -> None:
    """Write columns x, y, z, intensity and others to an E57 file of one scan.

    `columns`: float32 or uint8, (n,) values each.
    """
    pye57 = _import_pye57()
    # The library makes its files itself.
    path.unlink(missing_ok=True)
    file = pye57.E57(str(path), mode="w")
    try:
        _write_scan(pye57.libe57, file, columns)
        file.close()
    except Exception:
        # Closed once more when it is collected, it would print that it still cannot be written.
        vars(file).pop("image_file", None)
        raise


def _write_scan(lib: Any, file: Any, columns: Columns) -> None:
    image = file.image_file
    image.extensionsAdd(EXTENSION, EXTENSION_URI)
    scan = lib.StructureNode(image)
    scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}"))
    scan.set("name", lib.StringNode(image, "point cloud"))
    scan.set("cartesianBounds", _describe_bounds(lib, image, columns))
    standard = [column for column in columns if column.name in STANDARD_NAMES]
    own = [column for column in columns if column.name not in STANDARD_NAMES]
    points, fill_points = _prepare_vector(lib, image, standard)
    scan.set("points", points)
    file.data3d.append(scan)
    fill_points()
    extra, fill_extra = _prepare_vector(lib, image, own)
    file.root.set(EXTRA_COLUMNS, extra)
    fill_extra()


def list_e57_columns(path: Path) -> dict[str, ArchiveEntry]:
    """List the columns that `write_e57` wrote; the first that is loaded reads all points."""

    @functools.cache
    def read() -> Table:
        with _open_tables(path) as (lib, tables):
            return {
                name: values
                for image, table in tables
                for name, values in _read_vector(lib, image, table)
            }

    def make_entry(name: str, dtype: DTypeLike, points: int) -> ArchiveEntry:
        return ArchiveEntry((points,), np.dtype(dtype), lambda: read()[name])

    size = path.stat().st_size
    with _open_tables(path) as (lib, tables):
        entries = {}
        for _, table in tables:
            points = table.childCount()
            for _, name, dtype in _list_elements(lib, table):
                claimed = points * np.dtype(dtype).itemsize
                require_bounded_size(path, name, claimed, size, compressed=True)
                entries[name] = make_entry(name, dtype, points)
    return entries


@contextlib.contextmanager
def _open_tables(path: Path) -> Iterator[tuple[Any, list[tuple[Any, Any]]]]:
    """Open the scan's points and the extension's columns, each with the file that it is in."""
    pye57 = _import_pye57()
    try:
        with contextlib.closing(pye57.E57(str(path))) as file:
            tables = [(file.image_file, file.data3d[0]["points"])]
            if file.root.isDefined(EXTRA_COLUMNS):
                tables.append((file.image_file, file.root[EXTRA_COLUMNS]))
            yield pye57.libe57, tables
    except (TofclipError, MemoryError):
        raise
    except Exception as fault:  # the library raises whatever the damage happens to cause
        raise FileFormatError(
            path, f"is not an E57 file, or a damaged one ({type(fault).__name__})"
        ) from fault


def _prepare_vector(lib: Any, image: Any, columns: Columns) -> tuple[Any, Callable[[], None]]:
    """Return an empty table of columns, and what fills it once it is part of the file."""
    prototype, buffers = lib.StructureNode(image), lib.VectorSourceDestBuffer()
    # The library reads from this memory while it writes.
    held = [np.ascontiguousarray(column.values) for column in columns]
    for column, values in zip(columns, held, strict=True):
        name = STANDARD_NAMES.get(column.name, f"{EXTENSION}:{column.name}")
        prototype.set(name, _make_element(lib, image, values))
        buffers.append(lib.SourceDestBuffer(image, name, values, max(values.size, 1), True, False))
    table = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))

    def fill() -> None:
        writer = table.writer(buffers)
        if held[0].size:
            writer.write(held[0].size)
        writer.close()

    return table, fill


def _list_elements(lib: Any, table: Any) -> list[tuple[str, str, type]]:
    """Label in the file, name and type of each column."""
    names = {element: name for name, element in STANDARD_NAMES.items()}
    prototype = lib.StructureNode(table.prototype())
    found: list[tuple[str, str, type]] = []
    for number in range(prototype.childCount()):
        element = prototype.get(number)
        label = element.elementName()
        kind = np.uint8 if element.type() == lib.NodeType.E57_INTEGER else np.float32
        found.append((label, names.get(label, label.removeprefix(f"{EXTENSION}:")), kind))
    return found


def _read_vector(lib: Any, image: Any, table: Any) -> list[tuple[str, NDArray[Any]]]:
    found, buffers = [], lib.VectorSourceDestBuffer()
    for label, name, kind in _list_elements(lib, table):
        values = np.empty(table.childCount(), kind)
        found.append((name, values))
        if values.size:
            buffers.append(lib.SourceDestBuffer(image, label, values, values.size, True, False))
    if table.childCount():
        reader = table.reader(buffers)
        reader.read()
        reader.close()
    return found


def _make_element(lib: Any, image: Any, values: Any) -> Any:
    """Describe a column: its type and its bounds."""
    if values.dtype.kind == "f":
        return lib.FloatNode(image, 0.0, lib.E57_SINGLE, lib.E57_FLOAT_MIN, lib.E57_FLOAT_MAX)
    return lib.IntegerNode(image, 0, 0, int(np.iinfo(values.dtype).max))


def _describe_bounds(lib: Any, image: Any, columns: Columns) -> Any:
    bounds = lib.StructureNode(image)
    for column in columns:
        if column.name in "xyz":
            low, high = (
                (float(column.values.min()), float(column.values.max()))
                if column.values.size
                else (0.0, 0.0)
            )
            bounds.set(f"{column.name}Minimum", lib.FloatNode(image, low))
            bounds.set(f"{column.name}Maximum", lib.FloatNode(image, high))
    return bounds


def _import_pye57() -> Any:
    try:
        import pye57
    except ImportError as fault:
        raise MissingDependencyError("E57 needs pye57: pip install 'tofclip[exchange]'") from fault
    return pye57
