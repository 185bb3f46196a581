"""One property of all points, as files hold it.

LAS and its compressed form LAZ, through laspy (an optional library).

Positions are whole multiples of a micrometre, as LAS wants them; all other columns are extra
dimensions in full precision, named ``tofclip_NAME`` and with their unit in the description. The
standard intensity is theirs too, scaled to 16 bits for viewers.

E57 (ASTM E2807), through pye57 (an optional library).

The scan holds positions and intensity, which every reader of E57 knows. All other columns lie in a
table of an extension beside it, ``tofclip:columns``, row by row in the same order.

Tables of points in the formats that other programs read: PLY, PCD, CSV, NPZ, LAS and LAZ.

Every file says the units of its columns: PLY and PCD in a comment, CSV and NPZ in the columns'
names (``x_m``).

Depth pictures in OpenEXR: what renderers and compositors read.
"""

from __future__ import annotations

import contextlib
import functools
import struct
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.errors import FileFormatError, InputError, MissingDependencyError, TofclipError
from tofclip.files import (
    BoundedFile,
    atomic_path,
    require_bounded_size,
    require_suffix,
    translate_read_errors,
)
from tofclip.io.archive import Archive, ArchiveEntry
from tofclip.lidar.geometry import compute_ray_directions
from tofclip.shots import Returns


@dataclass(frozen=True)
class Column:
    """One property of all points.

    Parameters
    ----------
    name : str
    unit : str
        SI unit, or empty for a pure number.
    values : (n,) array
        float32, float64 or uint8.
    """

    name: str
    unit: str
    values: NDArray[Any]

    @property
    def label(self) -> str:
        """Name with its unit, as it heads a column."""
        return f"{self.name}_{self.unit}" if self.unit else self.name


Columns = Sequence[Column]
Table = dict[str, NDArray[Any]]


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


def save_depth(returns: Returns, path: str | Path) -> None:
    """Write each pixel's most intense return to an OpenEXR file, whole or not at all.

    Channel ``Z`` is the depth along the optical axis in metres, infinite where nothing came back,
    as renderers have it; ``Y`` the intensity in counts referred to 1 m, 0 there. Both are 32-bit
    floats, uncompressed.

    Parameters
    ----------
    returns : Returns
    path : path-like
        Ends in ``.exr``.
    """
    import OpenEXR

    distance, intensity = returns.image("range"), returns.image("intensity")
    seen = np.isfinite(distance)
    rows, columns = np.nonzero(seen)
    depth = np.full(distance.shape, np.inf, dtype=np.float32)
    depth[seen] = distance[seen] * compute_ray_directions(returns.camera, rows, columns)[:, 2]
    brightness = np.where(seen, intensity, 0).astype(np.float32)
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Z": np.ascontiguousarray(depth), "Y": np.ascontiguousarray(brightness)}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))
