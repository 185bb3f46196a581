"""Tables of points in the formats that other programs read, and depth pictures.

Every file says the units of its columns: PLY and PCD in a comment, CSV and NPZ in the columns'
names (``x_m``), LAS in the description of its dimensions. PLY and PCD are written and read here and
not by Open3D, which does not load on every machine; their comments hold the provenance as well.
PLY, PCD and LAS hold colours by brightness, for viewers alone: they are not read back.

LAS and its compressed form LAZ, through laspy: positions are whole multiples of a micrometre; all
other columns are extra dimensions in full precision, named ``tofclip_NAME``. The standard intensity
is theirs too, scaled to 16 bits for viewers.

E57 (ASTM E2807), through pye57: the scan holds positions and intensity, which every reader knows.
All other columns lie in a table of an extension beside it, ``tofclip:columns``, in the same order.
"""

from __future__ import annotations

import contextlib
import functools
import json
import struct
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.arrays import AnyArray
from tofclip.camera.model import compute_ray_directions
from tofclip.errors import FileFormatError, InputError
from tofclip.files import (
    BoundedFile,
    atomic_path,
    guard,
    import_file_reader,
    require_bounded_size,
    require_suffix,
    translate_read_errors,
)
from tofclip.io.archive import Archive, ArchiveEntry
from tofclip.notebook import paint
from tofclip.shots import Returns

BRIGHTNESS_COLUMNS = ("intensity", "brightness")
BRIGHTNESS_PALETTE, WHITE_QUANTILE = "viridis", 0.99  # its dark end is seen on black and on white
MAX_HEADER_BYTES = 1 << 16
MAX_COMMENT_BYTES = 500  # readers of PLY and PCD take lines of at most 1023
PROVENANCE = "provenance: "
PLY_WORDS = 3  # in a line of a header: what it is, type, name or number
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}
PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8", ("U", "1"): "u1", ("U", "4"): "<u4"}

COORDINATE_STEP_M = 1e-6  # of LAS; 32 bits then reach 2.1 km
LAS_HEADER_BYTES, LAS_RECORD_BYTES = 375, 54  # of version 1.4; of a record's own header
DIMENSION_PREFIX = "tofclip_"

EXTENSION, EXTENSION_URI = "tofclip", "urn:tofclip:cloud:1"
EXTRA_COLUMNS = f"{EXTENSION}:columns"
E57_NAMES = {"x": "cartesianX", "y": "cartesianY", "z": "cartesianZ", "intensity": "intensity"}


@dataclass(frozen=True)
class Column:
    """One property of all points, as files hold it, by its `name`: `values` (n,), float32, float64 or
    uint8, in a `unit` of the SI, empty for a pure number.
    """

    name: str
    unit: str
    values: AnyArray

    @property
    def label(self) -> str:
        """Name with its unit, as it heads a column."""
        return f"{self.name}_{self.unit}" if self.unit else self.name


Columns = Sequence[Column]
Entries = dict[str, ArchiveEntry]


def write_table(
    path: str | Path,
    columns: Columns,
    shape: tuple[int, int] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write columns to the format that the suffix of `path` names, whole or not at all. `shape`:
    rows and columns of a picture whose pixels the values are, in raster order; PCD and NPZ say so.
    `provenance`: kept in PLY and PCD, unless it is longer than their headers may be.
    """
    require_suffix(path, *FORMATS)
    writer = FORMATS[Path(path).suffix.lower()][0]
    with atomic_path(path) as temporary:
        writer(temporary, columns, shape, provenance or {})


def list_columns(path: str | Path) -> Entries:
    """List a table's columns by their names without units; the first that is loaded reads all."""
    require_suffix(path, *FORMATS)
    lister = FORMATS[Path(path).suffix.lower()][1]
    with translate_read_errors(path):
        listed = lister(Path(path))
    entries = {}
    for label, entry in listed.items():
        name, _, unit = label.rpartition("_")
        entries[name if unit in ("m", "s", "count", "percent") else label] = entry
    return entries


def read_table(path: str | Path) -> dict[str, AnyArray]:
    """Read a table that `write_table` wrote: its columns by their names, without units."""
    return {name: entry.load() for name, entry in list_columns(path).items()}


def _defer(points: int, types: Mapping[str, DTypeLike], read: Callable[[], Any]) -> Entries:
    """Entries of columns that are read together, when the first of them is loaded."""
    read_all = functools.cache(read)

    def load(name: str) -> AnyArray:
        return np.array(read_all()[name], types[name])

    return {
        name: ArchiveEntry((points,), np.dtype(types[name]), functools.partial(load, name))
        for name in types
    }


def paint_brightness(brightness: AnyArray) -> NDArray[np.uint8]:
    """Colours (n, 3) of points; the root, or all but the brightest would be of one colour."""
    light = np.nan_to_num(np.maximum(brightness, 0))
    white = np.quantile(light, WHITE_QUANTILE) if light.size else 1.0
    return paint(np.sqrt(np.minimum(light / (white or 1.0), 1)), BRIGHTNESS_PALETTE)


def _list_colours(columns: Columns) -> list[Column]:
    """Red, green and blue by the brightness; none where that is not among the columns."""
    light = [column.values for column in columns if column.name in BRIGHTNESS_COLUMNS]
    shades = paint_brightness(light[0]).T if light else ()
    return [Column(*one) for one in zip(("red", "green", "blue"), ("",) * 3, shades, strict=False)]


def _list_comments(columns: Columns, provenance: Mapping[str, Any]) -> list[str]:
    """Lines that say the units and, in pieces of JSON, how the points came about."""
    units = ", ".join(f"{column.name} {column.unit}" for column in columns if column.unit)
    text = json.dumps(provenance, default=str) if provenance else ""
    text = text if 2 * len(text) < MAX_HEADER_BYTES else ""
    pieces = range(0, len(text), MAX_COMMENT_BYTES)
    notes = [PROVENANCE + text[start : start + MAX_COMMENT_BYTES] for start in pieces]
    return [f"units: {units}", *notes]


def read_provenance(path: str | Path) -> dict[str, Any]:
    """Return what the comments of a PLY or PCD file say of how its points came about."""
    with open(path, "rb") as file:
        lines = file.read(MAX_HEADER_BYTES).decode("ascii", errors="replace").splitlines()
    marks = tuple(f"{mark} {PROVENANCE}" for mark in ("comment", "#"))
    text = "".join(line.partition(PROVENANCE)[2] for line in lines if line.startswith(marks))
    with guard(path, "has a provenance that is not JSON"):
        return dict(json.loads(text or "{}"))


def _write_ply(path: Path, columns: Columns, shape: Any, provenance: Mapping[str, Any]) -> None:
    names = {np.dtype(code): name for name, code in PLY_TYPES.items()}
    comments = [f"comment {one}" for one in _list_comments(columns, provenance)]
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    lines += [f"element vertex {columns[0].values.size}"]
    columns = [*columns, *_list_colours(columns)]
    lines += [f"property {names[column.values.dtype]} {column.name}" for column in columns]
    _write_binary(path, [*lines, "end_header"], columns)


def _write_pcd(path: Path, columns: Columns, shape: Any, provenance: Mapping[str, Any]) -> None:
    comments = [f"# {one}" for one in _list_comments(columns, provenance)]
    if colours := _list_colours(columns):
        red, green, blue = (colour.values.astype(np.uint32) for colour in colours)
        columns = [*columns, Column("rgb", "", red << 16 | green << 8 | blue)]
    points = columns[0].values.size
    height, width = (1, points) if shape is None else shape
    kinds = {np.dtype(code): kind for kind, code in PCD_TYPES.items()}
    types, sizes = zip(*(kinds[column.values.dtype] for column in columns), strict=True)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *comments,
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


def make_rows(columns: Columns) -> AnyArray:
    """Return columns as packed rows, little endian."""
    layout = np.dtype([(one.name, one.values.dtype.newbyteorder("<")) for one in columns])
    return np.rec.fromarrays([one.values for one in columns], dtype=layout)


def _write_binary(path: Path, header: list[str], columns: Columns) -> None:
    with open(path, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(make_rows(columns).tobytes())


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
        with guard(path, "has an incomplete PCD header"):
            kinds = zip(entries["TYPE"], entries["SIZE"], strict=True)
            properties = list(zip(entries["FIELDS"], map(PCD_TYPES.get, kinds), strict=True))
            points = entries["POINTS"][0]
        return _list_binary(path, file.tell(), properties, points)


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
    types = {name: str(code) for name, code in properties}
    if len(types) < len(properties):
        raise FileFormatError(path, "has two columns of one name")
    layout = np.dtype(list(types.items()))
    size = path.stat().st_size - start
    if size != int(points) * layout.itemsize:
        problem = f"should hold {points} points of {layout.itemsize} bytes, found {size} bytes"
        raise FileFormatError(path, problem)
    return _defer(int(points), types, functools.partial(np.fromfile, path, layout, offset=start))


def _write_csv(path: Path, columns: Columns, *_: Any) -> None:
    table = np.stack([column.values for column in columns], axis=-1)
    header = ",".join(column.label for column in columns)
    # Nine significant digits bring every float32 back exactly.
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=header, comments="", encoding="ascii")


def _list_csv(path: Path) -> Entries:
    with open(path, encoding="ascii", errors="replace") as file:
        labels = file.readline(MAX_HEADER_BYTES).strip().split(",")
        points = sum(1 for _ in file)

    def read() -> Mapping[str, Any]:
        table = np.empty((0, len(labels)))
        if points:
            with guard(path, "holds something that is not a number"):
                table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2, encoding="ascii")
        if table.shape[1] != len(labels):
            raise FileFormatError(path, f"names {len(labels)} columns, holds {table.shape[1]}")
        return dict(zip(labels, table.T, strict=True))

    return _defer(points, dict.fromkeys(labels, np.float64), read)


def _write_npz(path: Path, columns: Columns, shape: tuple[int, int] | None, _: Any) -> None:
    shape = columns[0].values.shape if shape is None else shape
    arrays: Any = {column.label: column.values.reshape(shape) for column in columns}
    np.savez_compressed(path, **arrays)


def _list_npz(path: Path) -> Entries:
    archive = Archive(path)
    return {label: archive.describe(label) for label in sorted(archive.names)}


def _write_las(path: Path, columns: Columns, *_: Any) -> None:
    laspy = import_file_reader("laspy", "tofclip[las]")
    values = {column.name: column.values for column in columns}
    reach = COORDINATE_STEP_M * 2**31
    if any(np.abs(values[axis]).max(initial=0) >= reach for axis in "xyz"):
        raise InputError(f"{path}: LAS reaches {reach:.0f} m at a micrometre; use another format")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, COORDINATE_STEP_M), np.zeros(3)
    extra = [column for column in columns if column.name not in "xyz"]
    for column in extra:
        name, kind = DIMENSION_PREFIX + column.name, column.values.dtype
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind, description=column.unit))
    table = laspy.LasData(header)
    table.x, table.y, table.z = (values[axis].astype(np.float64) for axis in "xyz")
    for column in extra:
        table[DIMENSION_PREFIX + column.name] = column.values
    for colour in _list_colours(columns):
        table[colour.name] = colour.values * np.uint16(257)  # 255 becomes 65535
    brightness = np.nan_to_num(np.maximum(values["intensity"], 0).astype(np.float64))
    scaled = np.rint(brightness * (65535 / (brightness.max(initial=0) or 1)))
    table.intensity = scaled.astype(np.uint16)
    table.return_number = np.minimum(values["return_number"], 15)
    table.number_of_returns = table.return_number
    with open(path, "wb") as file:
        table.write(file, do_compress=path.suffix.lower() == ".laz")


def _list_las(path: Path) -> Entries:
    types: dict[str, DTypeLike] = dict.fromkeys("xyz", np.float32)
    with _open_las(path) as reader:
        layout, points = reader.header.point_format, reader.header.point_count
        packed = path.suffix.lower() == ".laz"
        require_bounded_size(path, "LAS points", points * layout.size, path.stat().st_size, packed)
        for name in layout.extra_dimension_names:
            if name.startswith(DIMENSION_PREFIX):
                kind = np.dtype(layout.dimension_by_name(name).dtype)
                if kind.shape:
                    raise FileFormatError(path, f"'{name}' has {kind.shape[0]} numbers for a point")
                types[name.removeprefix(DIMENSION_PREFIX)] = kind

    def read() -> Mapping[str, Any]:
        with _open_las(path) as reader:
            table = reader.read()
        if (held := len(table.points)) != points:
            raise FileFormatError(path, f"is no complete LAS file: {held} of {points} points")
        return {name: table[name if name in "xyz" else DIMENSION_PREFIX + name] for name in types}

    return _defer(points, types, read)


@contextlib.contextmanager
def _open_las(path: Path) -> Iterator[Any]:
    laspy = import_file_reader("laspy", "tofclip[las]")
    with (
        guard(path, "is not a LAS or LAZ file, or a damaged one"),
        BoundedFile(path) as file,
    ):
        # The library would look for as many records of variable length as a damaged header claims,
        # for hours. Where they are is said by table 3 of the specification of LAS 1.4.
        header = file.read(LAS_HEADER_BYTES).ljust(LAS_HEADER_BYTES, b"\0")
        start, records = struct.unpack_from("<II", header, 96)
        (extended,) = struct.unpack_from("<I", header, 243)
        records += extended if header[25] >= 4 else 0
        claimed = max(start, LAS_RECORD_BYTES * records)
        require_bounded_size(path, "LAS header", claimed, path.stat().st_size)
        file.seek(0)
        with laspy.open(file) as reader:
            yield reader


def _write_e57(path: Path, columns: Columns, *_: Any) -> None:
    pye57 = import_file_reader("pye57", "tofclip[exchange]")
    path.unlink(missing_ok=True)  # the library makes its files itself
    file = pye57.E57(str(path), mode="w")
    try:
        lib, image = pye57.libe57, file.image_file
        image.extensionsAdd(EXTENSION, EXTENSION_URI)
        scan = lib.StructureNode(image)
        scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}"))
        scan.set("name", lib.StringNode(image, "point cloud"))
        bounds = lib.StructureNode(image)
        for column in columns:
            if column.name in "xyz":
                values = column.values if column.values.size else np.zeros(1)
                for which, end in (("Minimum", values.min()), ("Maximum", values.max())):
                    bounds.set(column.name + which, lib.FloatNode(image, float(end)))
        scan.set("cartesianBounds", bounds)

        def attach_points(table: Any) -> None:
            scan.set("points", table)
            file.data3d.append(scan)

        standard = [column for column in columns if column.name in E57_NAMES]
        extra = [column for column in columns if column.name not in E57_NAMES]
        _write_vector(lib, image, standard, attach_points)
        _write_vector(lib, image, extra, lambda table: file.root.set(EXTRA_COLUMNS, table))
        file.close()
    except Exception:
        # Closed once more when it is collected, it would print that it still cannot be written.
        vars(file).pop("image_file", None)
        raise


def _write_vector(lib: Any, image: Any, columns: Columns, attach: Callable[[Any], None]) -> None:
    """Make a table of columns, attach it to the file, and fill it, which can only be done there."""
    prototype, buffers = lib.StructureNode(image), lib.VectorSourceDestBuffer()
    arrays = [np.ascontiguousarray(column.values) for column in columns]  # read while it writes
    for column, values in zip(columns, arrays, strict=True):
        name = E57_NAMES.get(column.name, f"{EXTENSION}:{column.name}")
        if values.dtype.kind == "f":
            limits = lib.E57_SINGLE, lib.E57_FLOAT_MIN, lib.E57_FLOAT_MAX
            prototype.set(name, lib.FloatNode(image, 0.0, *limits))
        else:
            prototype.set(name, lib.IntegerNode(image, 0, 0, int(np.iinfo(values.dtype).max)))
        buffers.append(lib.SourceDestBuffer(image, name, values, max(values.size, 1), True, False))
    table = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    attach(table)
    writer = table.writer(buffers)
    if arrays[0].size:
        writer.write(arrays[0].size)
    writer.close()


def _list_e57(path: Path) -> Entries:
    def read() -> Mapping[str, Any]:
        found: dict[str, AnyArray] = {}
        with _open_e57(path) as (lib, image, tables):
            for table, elements in tables:
                points, buffers = table.childCount(), lib.VectorSourceDestBuffer()
                found |= {name: np.empty(points, kind) for _, name, kind in elements}
                if not points:
                    continue
                for label, name, _ in elements:
                    to = lib.SourceDestBuffer(image, label, found[name], points, True, False)
                    buffers.append(to)
                reader = table.reader(buffers)
                reader.read()
                reader.close()
        return found

    types: dict[str, DTypeLike] = {}
    with _open_e57(path) as (_, _, tables):
        for table, elements in tables:
            points = table.childCount()
            for _, name, kind in elements:
                claimed = points * np.dtype(kind).itemsize
                require_bounded_size(path, name, claimed, path.stat().st_size, compressed=True)
                types[name] = kind
    return _defer(points, types, read)


@contextlib.contextmanager
def _open_e57(path: Path) -> Iterator[tuple[Any, Any, list[tuple[Any, Any]]]]:
    """Open the scan's points and the extension's columns: each table with the label in the file, name
    and type of its columns.
    """
    pye57 = import_file_reader("pye57", "tofclip[exchange]")
    names = {label: name for name, label in E57_NAMES.items()}
    with (
        guard(path, "is not an E57 file, or a damaged one"),
        contextlib.closing(pye57.E57(str(path))) as file,
    ):
        lib, tables = pye57.libe57, [file.data3d[0]["points"]]
        if file.root.isDefined(EXTRA_COLUMNS):
            tables.append(file.root[EXTRA_COLUMNS])
        listed = []
        for table in tables:
            prototype = lib.StructureNode(table.prototype())
            elements = []
            for number in range(prototype.childCount()):
                element = prototype.get(number)
                label = element.elementName()
                whole = element.type() == lib.NodeType.E57_INTEGER
                name = names.get(label, label.removeprefix(f"{EXTENSION}:"))
                elements.append((label, name, np.uint8 if whole else np.float32))
            listed.append((table, elements))
        yield lib, file.image_file, listed


FORMATS: dict[str, tuple[Callable[..., None], Callable[[Path], Entries]]] = {
    ".ply": (_write_ply, _list_ply),
    ".pcd": (_write_pcd, _list_pcd),
    ".csv": (_write_csv, _list_csv),
    ".npz": (_write_npz, _list_npz),
    ".las": (_write_las, _list_las),
    ".laz": (_write_las, _list_las),
    ".e57": (_write_e57, _list_e57),
}


def save_depth(returns: Returns, path: str | Path) -> None:
    """Write each pixel's most intense return of `returns` to an OpenEXR file, `path`, whole or not at
    all. Channel ``Z`` is the depth along the optical axis in metres, infinite where nothing came
    back, as renderers have it; ``Y`` the intensity in counts referred to 1 m, 0 there. Both are
    32-bit floats.
    """
    from tofclip.io.light_fields import write_exr_parts

    distance, intensity = returns.image("range"), returns.image("intensity")
    seen = np.isfinite(distance)
    depth = np.full(distance.shape, np.inf, dtype=np.float32)
    directions = compute_ray_directions(returns.camera, *np.nonzero(seen))
    depth[seen] = distance[seen] * directions[:, 2]
    write_exr_parts({"": {"Z": depth, "Y": np.where(seen, intensity, 0)}}, path)
