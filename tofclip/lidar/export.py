"""Tables of points in the formats that other programs read: PLY, PCD, CSV, NPZ, LAS and LAZ.

Every file says the units of its columns: PLY and PCD in a comment, CSV and NPZ in the columns'
names (``x_m``).
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from tofclip.errors import FileFormatError, InputError
from tofclip.lidar.column import Columns, Table
from tofclip.lidar.e57 import read_e57, write_e57
from tofclip.lidar.las import read_las, write_las
from tofclip.storage import atomic_path, translate_read_errors

PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}
PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8", ("U", "1"): "u1"}
MAX_HEADER_BYTES = 1 << 16


def write_table(path: str | Path, columns: Columns, shape: tuple[int, int] | None = None) -> None:
    """Write columns to the format that the suffix of `path` names, whole or not at all.

    Parameters
    ----------
    path : str or Path
    columns : sequence of Column
        With name, unit and (n,) values each.
    shape : (int, int), optional
        Rows and columns of a picture whose pixels the values are, in raster order. PCD and NPZ say
        so.

    Raises
    ------
    InputError
        There is no format of that suffix.
    """
    writer = _look_up_format(path)[0]
    with atomic_path(path) as temporary:
        # Only these formats can say where in a picture the points lie.
        if shape is not None and writer in (_write_pcd, _write_npz):
            writer(temporary, columns, shape)
        else:
            writer(temporary, columns)


def read_table(path: str | Path) -> Table:
    """Read a table that `write_table` wrote: its columns by their names, without units."""
    reader = _look_up_format(path)[1]
    with translate_read_errors(path):
        return reader(Path(path))


def _look_up_format(
    path: str | Path,
) -> tuple[Callable[..., None], Callable[[Path], Table]]:
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join([*FORMATS, ".h5"])
        raise InputError(f"{path}: no point cloud format is called '{suffix}'; use one of {known}")
    return FORMATS[suffix]


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


def _read_ply(path: Path) -> Table:
    with open(path, "rb") as file:
        lines = _read_header(file, path, "ply", "end_header")
        if ["format", "binary_little_endian", "1.0"] not in lines:
            raise FileFormatError(path, "is no binary little-endian PLY file")
        elements = [line for line in lines if line[0] == "element"]
        if len(elements) != 1 or elements[0][1] != "vertex":
            raise FileFormatError(path, "must hold vertices and nothing else")
        properties = [(line[-1], PLY_TYPES.get(line[1])) for line in lines if line[0] == "property"]
        return _read_rows(file, path, properties, elements[0][2])


def _read_pcd(path: Path) -> Table:
    with open(path, "rb") as file:
        entries = {line[0]: line[1:] for line in _read_header(file, path, "#", "DATA")}
        if entries["DATA"] != ["binary"]:
            raise FileFormatError(path, "is no binary PCD file")
        try:
            kinds = zip(entries["TYPE"], entries["SIZE"], strict=True)
            properties = list(zip(entries["FIELDS"], map(PCD_TYPES.get, kinds), strict=True))
            points = entries["POINTS"][0]
        except (KeyError, ValueError, IndexError) as fault:
            raise FileFormatError(path, "has an incomplete PCD header") from fault
        return _read_rows(file, path, properties, points)


def _read_csv(path: Path) -> Table:
    with open(path, encoding="ascii", errors="replace") as file:
        labels = file.readline().strip().split(",")
        lines = file.readlines()
    try:
        table = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, len(labels)))
    except ValueError as fault:
        raise FileFormatError(path, f"holds something that is no number ({fault})") from fault
    if table.shape[1] != len(labels):
        raise FileFormatError(path, f"names {len(labels)} columns, holds {table.shape[1]}")
    return {_strip_unit(label): column for label, column in zip(labels, table.T, strict=True)}


def _read_npz(path: Path) -> Table:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {_strip_unit(label): arrays[label] for label in arrays.files}
    except (ValueError, EOFError, zipfile.BadZipFile, AttributeError) as fault:
        raise FileFormatError(path, "is no NumPy archive, or a damaged one") from fault


def _strip_unit(label: str) -> str:
    name, _, unit = label.rpartition("_")
    return name if unit in ("m", "s", "count") else label


def _read_header(file: BinaryIO, path: Path, first: str, last: str) -> list[list[str]]:
    """Words of each header line, up to and including the one that begins with `last`."""
    lines: list[list[str]] = []
    while not lines or lines[-1][0] != last:
        line = file.readline(MAX_HEADER_BYTES)
        words = line.decode("ascii", errors="replace").split()
        if not words or (not lines and words[0] != first) or file.tell() > MAX_HEADER_BYTES:
            raise FileFormatError(
                path, f"is no {path.suffix[1:].upper()} file, or its header is damaged"
            )
        lines.append(words)
    return lines


def _read_rows(
    file: BinaryIO, path: Path, properties: list[tuple[str, str | None]], points: str
) -> Table:
    """Read the binary rows behind a header."""
    if any(code is None for _, code in properties) or not points.isdecimal():
        raise FileFormatError(path, "has columns of a type that tofclip does not write")
    layout = np.dtype([(name, str(code)) for name, code in properties])
    content = file.read()
    if len(content) != int(points) * layout.itemsize:
        raise FileFormatError(
            path,
            f"should hold {points} points of {layout.itemsize} bytes, found {len(content)} bytes",
        )
    rows = np.frombuffer(content, layout)
    return {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names or ()}


FORMATS: dict[str, tuple[Callable[..., None], Callable[[Path], Table]]] = {
    ".ply": (_write_ply, _read_ply),
    ".pcd": (_write_pcd, _read_pcd),
    ".csv": (_write_csv, _read_csv),
    ".npz": (_write_npz, _read_npz),
    ".las": (write_las, read_las),
    ".laz": (write_las, read_las),
    ".e57": (write_e57, read_e57),
}
