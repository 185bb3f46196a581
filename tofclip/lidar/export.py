"""Tables of points in the formats that other programs read: PLY, PCD, CSV, NPZ, LAS and LAZ.

Every file says the units of its columns: PLY and PCD in a comment, CSV and NPZ in the columns'
names (``x_m``).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.files import atomic_path, require_suffix, translate_read_errors
from tofclip.io.archive import Archive, ArchiveEntry
from tofclip.lidar.column import Columns, Table
from tofclip.lidar.e57 import list_e57_columns, write_e57
from tofclip.lidar.las import list_las_columns, write_las

Entries = dict[str, ArchiveEntry]
ColumnWriter = Callable[..., None]
ColumnLister = Callable[[Path], Entries]

PLY_WORDS = 3
"""In a line of a header: what it is, type, name or number."""
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}
PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8", ("U", "1"): "u1"}
MAX_HEADER_BYTES = 1 << 16


def write_table(path: str | Path, columns: Columns, shape: tuple[int, int] | None = None) -> None:
    """Write columns to the format that the suffix of `path` names, whole or not at all.

    `columns`: with name, unit and (n,) values each; `shape`: rows and columns of a picture whose
    pixels the values are, in raster order. PCD and NPZ say so.
    """
    writer = _look_up_format(path)[0]
    with atomic_path(path) as temporary:
        # Only these formats can say where in a picture the points lie.
        if shape is not None and writer in (_write_pcd, _write_npz):
            writer(temporary, columns, shape)
        else:
            writer(temporary, columns)


def list_columns(path: str | Path) -> dict[str, ArchiveEntry]:
    """List the columns of a table that `write_table` wrote, by their names without units."""
    lister = _look_up_format(path)[1]
    with translate_read_errors(path):
        return {_strip_unit(label): entry for label, entry in lister(Path(path)).items()}


def read_table(path: str | Path) -> Table:
    """Read a table that `write_table` wrote: its columns by their names, without units."""
    return {name: entry.load() for name, entry in list_columns(path).items()}


def _look_up_format(path: str | Path) -> tuple[ColumnWriter, ColumnLister]:
    require_suffix(path, *FORMATS)
    return FORMATS[Path(path).suffix.lower()]


def _write_ply(path: Path, columns: Columns) -> None:
    names = {np.dtype(code): name for name, code in PLY_TYPES.items()}
    lines = ["ply", "format binary_little_endian 1.0", f"comment units: {_format_units(columns)}"]
    lines += [f"element vertex {columns[0].values.size}"]
    lines += [f"property {names[column.values.dtype]} {column.name}" for column in columns]
    _write_binary(path, [*lines, "end_header"], columns)


def _write_pcd(path: Path, columns: Columns, shape: tuple[int, int] | None = None) -> None:
    points = columns[0].values.size
    height, width = (1, points) if shape is None else shape
    kinds = {np.dtype(code): kind for kind, code in PCD_TYPES.items()}
    types, sizes = zip(*(kinds[column.values.dtype] for column in columns), strict=True)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        f"# units: {_format_units(columns)}",
        "VERSION 0.7",
        "FIELDS " + " ".join(column.name for column in columns),
        "SIZE " + " ".join(sizes),
        "TYPE " + " ".join(types),
        "COUNT " + " ".join("1" for _ in columns),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}",
        "DATA binary",
    ]
    _write_binary(path, lines, columns)


def _write_csv(path: Path, columns: Columns) -> None:
    table = np.stack([column.values for column in columns], axis=-1)
    header = ",".join(column.label for column in columns)
    # Nine significant digits bring every float32 back exactly.
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="", encoding="ascii")


def _write_npz(path: Path, columns: Columns, shape: tuple[int, int] | None = None) -> None:
    arrays: Mapping[str, Any] = {
        column.label: column.values if shape is None else column.values.reshape(shape)
        for column in columns
    }
    np.savez_compressed(path, **arrays)


def _format_units(columns: Columns) -> str:
    return ", ".join(f"{column.name} {column.unit}" for column in columns if column.unit)


def _write_binary(path: Path, header: list[str], columns: Columns) -> None:
    layout = np.dtype([(column.name, column.values.dtype.newbyteorder("<")) for column in columns])
    rows = np.empty(columns[0].values.size, layout)
    for column in columns:
        rows[column.name] = column.values
    with open(path, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def _list_ply(path: Path) -> Entries:
    with open(path, "rb") as file:
        lines = _read_header(file, path, "ply", "end_header")
        if ["format", "binary_little_endian", "1.0"] not in lines:
            raise FileFormatError(path, "is not a binary little-endian PLY file")
        elements = [line for line in lines if line[0] == "element"]
        if len(elements) != 1 or "vertex" not in elements[0]:
            raise FileFormatError(path, "must hold vertices and nothing else")
        listed = [line for line in lines if line[0] == "property"]
        if any(len(line) < PLY_WORDS for line in (*elements, *listed)):
            raise FileFormatError(path, "has an incomplete PLY header")
        properties = [(line[-1], PLY_TYPES.get(line[1])) for line in listed]
        return _list_binary(path, file.tell(), properties, elements[0][2])


def _list_pcd(path: Path) -> Entries:
    with open(path, "rb") as file:
        entries = {line[0]: line[1:] for line in _read_header(file, path, "#", "DATA")}
        if entries["DATA"] != ["binary"]:
            raise FileFormatError(path, "is not a binary PCD file")
        try:
            kinds = zip(entries["TYPE"], entries["SIZE"], strict=True)
            properties = list(zip(entries["FIELDS"], map(PCD_TYPES.get, kinds), strict=True))
            points = entries["POINTS"][0]
        except (KeyError, ValueError, IndexError) as fault:
            raise FileFormatError(path, "has an incomplete PCD header") from fault
        return _list_binary(path, file.tell(), properties, points)


def _list_csv(path: Path) -> Entries:
    with open(path, encoding="ascii", errors="replace") as file:
        labels = file.readline(MAX_HEADER_BYTES).strip().split(",")
        points = sum(1 for _ in file)
    read = functools.cache(lambda: _read_csv(path, labels))
    return {
        label: ArchiveEntry((points,), np.dtype(np.float64), lambda n=n: read()[:, n])  # type: ignore[misc]
        for n, label in enumerate(labels)
    }


def _read_csv(path: Path, labels: list[str]) -> NDArray[np.float64]:
    with open(path, encoding="ascii", errors="replace") as file:
        lines = file.readlines()[1:]
    try:
        table = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, len(labels)))
    except ValueError as fault:
        raise FileFormatError(path, f"holds something that is not a number ({fault})") from fault
    if table.shape[1] != len(labels):
        raise FileFormatError(path, f"names {len(labels)} columns, holds {table.shape[1]}")
    return table


def _list_npz(path: Path) -> Entries:
    archive = Archive(path)
    return {label: archive.describe(label) for label in sorted(archive.names)}


def _strip_unit(label: str) -> str:
    name, _, unit = label.rpartition("_")
    return name if unit in ("m", "s", "count", "percent") else label


def _read_header(file: BinaryIO, path: Path, first: str, last: str) -> list[list[str]]:
    """Words of each header line, up to and including the one that begins with `last`."""
    lines: list[list[str]] = []
    while not lines or lines[-1][0] != last:
        line = file.readline(MAX_HEADER_BYTES)
        words = line.decode("ascii", errors="replace").split()
        if not words or (not lines and words[0] != first) or file.tell() > MAX_HEADER_BYTES:
            raise FileFormatError(
                path, f"is not a {path.suffix[1:].upper()} file, or its header is damaged"
            )
        lines.append(words)
    return lines


def _list_binary(
    path: Path, start: int, properties: list[tuple[str, str | None]], points: str
) -> Entries:
    """List the columns of the binary rows from byte `start` on."""
    if any(code is None for _, code in properties) or not points.isdecimal():
        raise FileFormatError(path, "has columns of a type that tofclip does not write")
    if len({name for name, _ in properties}) < len(properties):
        raise FileFormatError(path, "has two columns of one name")
    layout = np.dtype([(name, str(code)) for name, code in properties])
    held = path.stat().st_size - start
    if held != int(points) * layout.itemsize:
        raise FileFormatError(
            path, f"should hold {points} points of {layout.itemsize} bytes, found {held} bytes"
        )

    @functools.cache
    def read() -> NDArray[Any]:
        return np.fromfile(path, layout, offset=start)

    return {
        name: ArchiveEntry(
            (int(points),),
            layout[name],
            lambda name=name: np.ascontiguousarray(read()[name]),  # type: ignore[misc]
        )
        for name in layout.names or ()
    }


FORMATS: dict[str, tuple[ColumnWriter, ColumnLister]] = {
    ".ply": (_write_ply, _list_ply),
    ".pcd": (_write_pcd, _list_pcd),
    ".csv": (_write_csv, _list_csv),
    ".npz": (_write_npz, _list_npz),
    ".las": (write_las, list_las_columns),
    ".laz": (write_las, list_las_columns),
    ".e57": (write_e57, list_e57_columns),
}
