"""LAS and its compressed form LAZ, through laspy (an optional library).

Positions are whole multiples of a micrometre, as LAS wants them; all other columns are extra
dimensions in full precision, named ``tofclip_NAME`` and with their unit in the description. The
standard intensity is theirs too, scaled to 16 bits for viewers.
"""

from __future__ import annotations

import contextlib
import functools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.errors import FileFormatError, InputError, MissingDependencyError, TofclipError
from tofclip.files import BoundedFile, require_bounded_size
from tofclip.io.archive import ArchiveEntry
from tofclip.lidar.column import Columns

COORDINATE_STEP_M = 1e-6  # m; 32 bits then reach 2.1 km
# Places in the header of LAS 1.4, table 3 of its specification, and the size of a record's own one.
HEADER_BYTES, VERSION_PLACE, RECORD_COUNT_PLACES = 375, 25, (100, 243)
POINTS_PLACE, VERSION_WITH_EXTENDED_RECORDS, RECORD_BYTES = 96, 4, 54
DIMENSION_PREFIX = "tofclip_"


def write_las(path: Path, columns: Columns) -> None:
    """Write columns x, y, z and others to LAS 1.4, compressed if the name ends in ``.laz``.

    `columns`: with ``x``, ``y`` and ``z`` in m, ``intensity`` and ``return_number``.
    """
    laspy = _import_laspy()
    values = {column.name: column.values for column in columns}
    if any(np.abs(values[axis]).max(initial=0) >= COORDINATE_STEP_M * 2**31 for axis in "xyz"):
        raise InputError(
            f"{path}: LAS reaches {COORDINATE_STEP_M * 2**31:.0f} m at a micrometre; use another format"
        )
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, COORDINATE_STEP_M), np.zeros(3)
    others = [column for column in columns if column.name not in "xyz"]
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                DIMENSION_PREFIX + one.name, one.values.dtype, description=one.unit
            )
            for one in others
        ]
    )
    table = laspy.LasData(header)
    table.x, table.y, table.z = (values[axis].astype(np.float64) for axis in "xyz")
    for one in others:
        table[DIMENSION_PREFIX + one.name] = one.values
    brightness = np.maximum(values["intensity"], 0).astype(np.float64)
    table.intensity = np.rint(brightness * (65535 / (brightness.max(initial=0) or 1))).astype(
        np.uint16
    )
    table.return_number = np.minimum(values["return_number"], 15)
    table.number_of_returns = table.return_number
    with open(path, "wb") as file:
        table.write(file, do_compress=path.suffix.lower() == ".laz")


def list_las_columns(path: Path) -> dict[str, ArchiveEntry]:
    """List the columns that `write_las` wrote; the first that is loaded reads all points."""
    read_points = functools.cache(lambda: _read_points(path))
    names = {axis: axis for axis in "xyz"}
    with _open_reader(path) as reader:
        layout, points = reader.header.point_format, reader.header.point_count
        packed = path.suffix.lower() == ".laz"
        require_bounded_size(path, "LAS points", points * layout.size, path.stat().st_size, packed)
        for name in layout.extra_dimension_names:
            if name.startswith(DIMENSION_PREFIX):
                names[name.removeprefix(DIMENSION_PREFIX)] = name
        types = {
            name: np.dtype(np.float32) if name in "xyz" else layout.dimension_by_name(name).dtype
            for name in names.values()
        }
    return {
        column: ArchiveEntry(
            (points,),
            types[name],
            lambda name=name: np.array(read_points()[name], types[name]),  # type: ignore[misc]
        )
        for column, name in names.items()
    }


def _read_points(path: Path) -> Any:
    with _open_reader(path) as reader:
        points, table = reader.header.point_count, reader.read()
    if len(table.points) != points:
        raise FileFormatError(
            path, f"is not a complete LAS file: {len(table.points)} of {points} points are there"
        )
    return table


@contextlib.contextmanager
def _open_reader(path: Path) -> Iterator[Any]:
    laspy = _import_laspy()
    _require_bounded_records(path)
    try:
        with BoundedFile(path) as file, laspy.open(file) as reader:
            yield reader
    except TofclipError:
        raise
    # laspy and its backends raise whatever the damage happens to cause, want of memory included:
    # what the points take is known to be there
    except Exception as fault:
        raise FileFormatError(
            path, f"is not a LAS or LAZ file, or a damaged one ({type(fault).__name__})"
        ) from fault


def _require_bounded_records(path: Path) -> None:
    """Refuse a header that claims more records of variable length than the file can hold.

    The library would look for each of them, for hours.
    """
    with open(path, "rb") as file:
        header = file.read(HEADER_BYTES).ljust(HEADER_BYTES, b"\0")
    records, extended = (struct.unpack_from("<I", header, at)[0] for at in RECORD_COUNT_PLACES)
    claimed = records * RECORD_BYTES
    if header[VERSION_PLACE] >= VERSION_WITH_EXTENDED_RECORDS:
        claimed += extended * RECORD_BYTES
    size = path.stat().st_size
    require_bounded_size(path, "LAS records of variable length", claimed, size)
    require_bounded_size(
        path, "LAS header", struct.unpack_from("<I", header, POINTS_PLACE)[0], size
    )


def _import_laspy() -> Any:
    try:
        import laspy
    except ImportError as fault:
        raise MissingDependencyError(
            "LAS and LAZ need laspy: pip install 'tofclip[las]'"
        ) from fault
    return laspy
