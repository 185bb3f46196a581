"""Read a capture, whichever laboratory or program wrote it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from nlos.capture import Capture
from nlos.io import labs
from nlos.io.arrays import NamedArrays, read_hdf5, read_matlab
from nlos.io.pictures import read_streak_folder
from tofclip.errors import FileFormatError
from tofclip.files import translate_read_errors
from tofclip.storage import HDF5_SIGNATURE, Record, collect_provenance


def read_native(path: str | Path) -> Capture | None:
    """Read a capture, or take one out of recovered frames; None if the HDF5 file is not one of
    ours.
    """
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


ZIP_SIGNATURE = b"PK\x03\x04"
# Of .mat files from version 5 to 7.3.
MATLAB_SIGNATURE = b"MATLAB"

Reader = Callable[[NamedArrays], Capture]

# A file is known by the names of its fields; the first format whose fields are all there is taken.
ARCHIVE_FORMATS: Mapping[tuple[str, ...], Reader] = {
    ("H", "wall_xyz", "laser_xyz", time): labs.read_numpy_archive
    for time in ("delta_t_s", "t_s", "t_m", "delta_t_m")
}
HDF5_FORMATS: Mapping[tuple[str, ...], Reader] = {
    ("H", "H_format", "sensor_grid_xyz", "laser_grid_xyz"): labs.read_tal,
    ("data", "cameraGridPositions", "laserGridPositions", "deltaT"): labs.read_zaragoza,
}
MATLAB_FORMATS: Mapping[tuple[str, ...], Reader] = {
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
    * a folder with one EXR streak image per wall row, and a ``geometry.toml``.

    Captures come back with the ways to and from the device taken off. The light that the wall
    returns at once is left in; see `nlos.preparation.remove_first_bounce`. All of a file is read
    into memory, as float32.

    Parameters
    ----------
    path : path-like
        A file, or a folder of EXR files.

    Returns
    -------
    Capture

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is empty, truncated, damaged, or of none of these formats.
    InputError
        What it holds is not a usable capture.
    """
    capture = read_streak_folder(path) if Path(path).is_dir() else _read_file(path)
    if capture.provenance:
        return capture
    return replace(capture, provenance=collect_provenance({"verb": "read_capture"}, path))


def _read_file(path: str | Path) -> Capture:
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(len(HDF5_SIGNATURE))
    if not start:
        raise FileFormatError(path, "is empty")
    if start.startswith(ZIP_SIGNATURE):
        archive = NamedArrays(path)
        if "streak_raw" in archive:
            return labs.read_lift_archive(path)
        return _read_fields(archive, ARCHIVE_FORMATS)
    if start.startswith(MATLAB_SIGNATURE):
        return _read_fields(read_matlab(path), MATLAB_FORMATS)
    if start == HDF5_SIGNATURE:
        return read_native(path) or _read_fields(read_hdf5(path), HDF5_FORMATS)
    raise FileFormatError(
        path, "is not a capture of a known format (HDF5, .npz, .mat, or a folder of EXR files)"
    )


def _read_fields(fields: NamedArrays, formats: Mapping[tuple[str, ...], Reader]) -> Capture:
    for names, read in formats.items():
        if fields.names.issuperset(names):
            return read(fields)
    known = "; or ".join(", ".join(names) for names in formats)
    found = ", ".join(sorted(fields.names)[:8]) or "nothing"
    raise FileFormatError(
        fields.path,
        f"holds {found}, but a capture needs the fields {known}; "
        "docs/own_wall.md shows how to write one",
    )
