"""Read a capture, whichever laboratory or program wrote it: one file, or a folder of streak images
from a transient renderer, one EXR per wall row, whose columns are time bins.

Renderers write a transient picture (row, column, t) as one picture (column, t) for each row,
numbered from the top; the geometry, which the pictures do not hold, stands in ``geometry.toml``
beside them::

    bin_width_ps = 10.0
    start_m = 0.0          # path that the first column holds, legs to and from the devices taken off
    wall_corners_m = [[-1, -1, 0], [1, -1, 0], [-1, 1, 0]]  # top left, top right, bottom left
    laser_m = [0, 0, 0]    # the spot on the wall; "confocal" where each point is lit in turn

(The layout is that of A. Jarabo, J. Marco et al., "A framework for transient rendering", ACM Trans.
Graph. 33, 177 (2014).)
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nlos.capture import Capture
from nlos.io import labs
from nlos.io.labs import NamedArrays, read_hdf5, read_matlab
from tofclip.arrays import Float32Array, FloatArray
from tofclip.errors import FileFormatError
from tofclip.files import read_toml
from tofclip.io.light_fields import read_exr_parts
from tofclip.plugins import Parts, Reader, read_by_signature
from tofclip.storage import HDF5_SIGNATURE, Record, collect_provenance
from tofclip.units import PICOSECOND


def read_native(path: str | Path) -> Capture | None:
    """Read a capture, or take one out of recovered frames; None of other HDF5 files."""
    import h5py

    from tofclip.shots import Frames

    try:
        with h5py.File(path, "r") as file:
            own = "format" in file.attrs
    except (OSError, KeyError, RuntimeError) as fault:
        raise FileFormatError(path, "is a truncated or damaged HDF5 file") from fault
    if not own:
        return None
    record = Record.load(path, "capture", "frames")
    if record.kind == "capture":
        return Capture.from_record(record)
    return Capture.from_frames(Frames.from_record(record))


FieldReader = Callable[[NamedArrays], Capture]

# A file is known by the names of its fields; the first format whose fields are all there is taken.
ARCHIVE_FORMATS: Mapping[tuple[str, ...], FieldReader] = {
    ("H", "wall_xyz", "laser_xyz", time): labs.read_numpy_archive
    for time in ("delta_t_s", "t_s", "t_m", "delta_t_m")
}
HDF5_FORMATS: Mapping[tuple[str, ...], FieldReader] = {
    ("H", "H_format", "sensor_grid_xyz", "laser_grid_xyz"): labs.read_tal,
    ("data", "cameraGridPositions", "laserGridPositions", "deltaT"): labs.read_zaragoza,
}
MATLAB_FORMATS: Mapping[tuple[str, ...], FieldReader] = {
    ("rect_data", "ts", "sampling_spacing"): labs.read_rectified_data,
    ("rect_data", "width"): labs.read_light_cone_data,
    ("dataset.data", "dataset.laserPos", "dataset.cameraPos"): labs.read_phasor_field_data,
    ("transient", "lighting"): labs.read_surface_optimisation_data,
    ("sub_Sig",): labs.read_curvelet_data,
    ("meas",): labs.read_migration_data,
    ("data",): labs.read_general_data,
}


def read_capture(path: str | Path) -> Capture:
    """Read the transients on a relay wall, with their geometry.

    The format is recognised by content:

    * our own HDF5: captures, and recovered frames that carry a relay wall;
    * NumPy archives with ``H``, ``wall_xyz``, ``laser_xyz``, and ``delta_t_s``, ``delta_t_m``,
      ``t_s`` or ``t_m``;
    * LIFT archives (Feng and Gao 2021), whose frames are recovered by the linear inverse;
    * HDF5 of y-tal, and of the Zaragoza NLOS data set;
    * .mat files, of any version, of O'Toole 2018, Lindell 2019, Tsai 2019, Liu 2019, Liu 2020 and
      Liu 2023;
    * a folder with one EXR streak image per wall row, and a ``geometry.toml``;
    * what a package offers a reader of, see `tofclip.plugins`.

    Captures come back with the ways to and from the device taken off. The light that the wall
    returns at once is left in; see `nlos.preparation.remove_first_bounce`. All of a file is read
    into memory, as float32.

    Parameters
    ----------
    path : path-like
        A file, or a folder of EXR files.

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is empty, truncated, damaged, or of none of these formats.
    InputError
        What it holds is not a usable capture.
    """
    capture: Capture = (
        read_streak_folder(path)
        if Path(path).is_dir()
        else read_by_signature(READERS, path, lambda one: one.read(Path(path)), "capture")
    )
    if capture.provenance:
        return capture
    return replace(capture, provenance=collect_provenance({"verb": "read_capture"}, path))


def list_capture_arrays(path: Path, start: bytes) -> NamedArrays | None:
    """List the arrays of a file of named arrays whose first bytes are `start`, none read, if their
    names say that it is a capture; ``data`` or ``meas`` alone may as well be counted photons.
    """
    for signature, list_arrays, formats in (
        (NPZ.signatures[0], NamedArrays, ARCHIVE_FORMATS),
        (MATLAB.signatures[0], read_matlab, MATLAB_FORMATS),
        (HDF5_SIGNATURE, read_hdf5, HDF5_FORMATS),
    ):
        with suppress(FileFormatError):  # its own reader says best what is damaged
            if start.startswith(signature):
                arrays = list_arrays(path)
                telling = set(formats) - {("data",), ("meas",)}
                return arrays if any(map(arrays.names.issuperset, telling)) else None
    return None


def _read_archive(path: Path) -> Capture:
    """Read a capture of NumPy's arrays, or a streak image of LIFT that brings its relay wall."""
    archive = NamedArrays(path)
    if "streak_raw" in archive:
        return labs.read_lift_archive(path)
    return _read_fields(archive, ARCHIVE_FORMATS)


def _read_hdf5(path: Path) -> Capture:
    """Read a capture or recovered frames of our own, or a capture of y-tal or of Zaragoza."""
    return read_native(path) or _read_fields(read_hdf5(path), HDF5_FORMATS)


def _read_matlab(path: Path) -> Capture:
    """Read a capture of MATLAB's arrays, as eight laboratories publish theirs."""
    return _read_fields(read_matlab(path), MATLAB_FORMATS)


NPZ = Reader((b"PK\x03\x04",), _read_archive)
MATLAB = Reader((b"MATLAB",), _read_matlab)  # .mat files from version 5 to 7.3
HDF5 = Reader((HDF5_SIGNATURE,), _read_hdf5)
READERS = Parts(
    "nlos.readers",
    "reader",
    {name: f"{__name__}:{name.upper()}" for name in ("npz", "matlab", "hdf5")},
)


def _read_fields(fields: NamedArrays, formats: Mapping[tuple[str, ...], FieldReader]) -> Capture:
    for names, read in formats.items():
        if fields.names.issuperset(names):
            return read(fields)
    known = "; or ".join(", ".join(names) for names in formats)
    found = ", ".join(sorted(fields.names)[:8]) or "nothing"
    raise fields.fault(
        f"holds {found}, but a capture needs the fields {known}; docs/own_wall.md shows how to write one"
    )


GEOMETRY_FILE = "geometry.toml"
GEOMETRY_KEYS = {"bin_width_ps", "start_m", "wall_corners_m", "laser_m"}
CONFOCAL_LASER = "confocal"


def read_streak_folder(folder: str | Path) -> Capture:
    """Read a folder's EXR files by the numbers in their names; colours are averaged."""
    folder = Path(folder)
    number = lambda file: ([int(digits) for digits in re.findall(r"\d+", file.stem)], file.stem)  # noqa: E731
    files = sorted(folder.glob("*.exr"), key=number)
    if not files:
        raise FileFormatError(folder, "is a folder without EXR files: no capture")
    rows = [_read_picture(file) for file in files]
    size = rows[0].shape
    for file, row in zip(files, rows, strict=True):
        if row.shape != size:
            raise FileFormatError(file, f"is {row.shape} pixels, but {files[0].name} is {size}")
    geometry = _read_geometry(folder / GEOMETRY_FILE)
    signal = np.moveaxis(np.stack(rows), 2, 0)
    corner, *ends = _read_numbers(folder, geometry, "wall_corners_m", (3, 3))
    right, down = (
        np.linspace(0, 1, n)[:, np.newaxis] * (end - corner)
        for n, end in zip(signal.shape[:0:-1], ends, strict=True)
    )
    wall = corner + right + down[:, np.newaxis]
    laser = wall
    if geometry["laser_m"] != CONFOCAL_LASER:
        laser = _read_numbers(folder, geometry, "laser_m", (3,))
    bin_width, start = (
        float(_read_numbers(folder, geometry, name, ())) for name in ("bin_width_ps", "start_m")
    )
    return Capture(signal, wall, laser, bin_width * PICOSECOND, start)


def _read_picture(path: Path) -> Float32Array:
    """Brightness (column, t): mean of all channels but alpha and depth."""
    parts = read_exr_parts(path)
    channels = parts[0][1]
    colours = [channels[name] for name in channels if name.split(".")[-1] in ("R", "G", "B", "Y")]
    if not colours:
        names = ", ".join(channels)
        raise FileFormatError(path, f"holds the channels {names}, none of which is R, G, B or Y")
    return np.mean(colours, axis=0, dtype=np.float32)


def _read_geometry(path: Path) -> Mapping[str, Any]:
    known = ", ".join(sorted(GEOMETRY_KEYS))
    if not path.is_file():
        raise FileFormatError(path.parent, f"has EXR files but no {GEOMETRY_FILE} with {known}")
    geometry = read_toml(path, "a wall's geometry")
    if set(geometry) != GEOMETRY_KEYS:
        wrong = ", ".join(sorted(set(geometry) ^ GEOMETRY_KEYS))
        raise FileFormatError(path, f"must hold exactly {known}; lacking or unknown: {wrong}")
    return geometry


def _read_numbers(
    folder: Path, geometry: Mapping[str, Any], name: str, shape: tuple[int, ...]
) -> FloatArray:
    try:
        values = np.array(geometry[name], dtype=np.float64)
    except (TypeError, ValueError):
        values = np.full((0,), np.nan)
    if values.shape != shape or not np.all(np.isfinite(values)):
        raise FileFormatError(
            folder / GEOMETRY_FILE,
            f"{name} must be numbers of shape {shape}, found {geometry[name]}",
        )
    return values
