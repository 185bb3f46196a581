"""LAS and its compressed form LAZ, through laspy (an optional library).

Positions are whole multiples of a micrometre, as LAS wants them; all other columns are extra
dimensions in full precision, named ``tofclip_NAME`` and with their unit in the description. The
standard intensity is theirs too, scaled to 16 bits for viewers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofclip.errors import FileFormatError, InputError, MissingDependencyError
from tofclip.lidar.column import Columns, Table

COORDINATE_STEP_M = 1e-6  # m; 32 bits then reach 2.1 km
DIMENSION_PREFIX = "tofclip_"


def write_las(path: Path, columns: Columns) -> None:
    """Write columns x, y, z and others to LAS 1.4, compressed if the name ends in ``.laz``.

    Parameters
    ----------
    path : Path
    columns : sequence of Column
        With ``x``, ``y`` and ``z`` in m, ``intensity`` and ``return_number``.

    Raises
    ------
    MissingDependencyError
        laspy, or its LAZ backend, is not installed.
    InputError
        A position is further away than LAS can say.
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


def read_las(path: Path) -> Table:
    """Read what `write_las` wrote."""
    laspy = _import_laspy()
    try:
        with laspy.open(path) as reader:
            points, table = reader.header.point_count, reader.read()
        extra = [
            name
            for name in table.point_format.extra_dimension_names
            if name.startswith(DIMENSION_PREFIX)
        ]
        found: Table = {axis: np.asarray(table[axis], dtype=np.float32) for axis in "xyz"}
        found |= {name.removeprefix(DIMENSION_PREFIX): np.array(table[name]) for name in extra}
    except MemoryError:
        raise
    except Exception as fault:  # laspy and its backends raise whatever the damage happens to cause
        raise FileFormatError(
            path, f"is no LAS or LAZ file, or a damaged one ({type(fault).__name__})"
        ) from fault
    if len(table.points) != points:
        raise FileFormatError(
            path, f"is no complete LAS file: {len(table.points)} of {points} points are there"
        )
    return found


def _import_laspy() -> Any:
    try:
        import laspy
    except ImportError as fault:
        raise MissingDependencyError(
            "LAS and LAZ need laspy: pip install 'tofclip[las]'"
        ) from fault
    return laspy
