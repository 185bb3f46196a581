"""Captures of other laboratories' formats: named arrays of their files, taken out with the same checks
as those of NumPy archives, and of each format a reader, which turns it so that the hidden scene lies
at larger z.

Field names, units and the order of axes of y-tal's own files, of the Zaragoza data set and of the
two of Wisconsin are those of y-tal 0.20 (``tal/io`` of https://github.com/diegoroyo/tal); of other
data sets those of the programs that came with the papers, which the readers name.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nlos.capture import Capture, remove_device_legs
from nlos.kernels import rebin, shift_signals
from tofclip.arrays import AnyArray, Float32Array, FloatArray
from tofclip.errors import FileFormatError, InputError
from tofclip.files import require_bounded_dataset, translate_read_errors
from tofclip.io.archive import Archive, ArchiveEntry, Entries, list_mat_entries
from tofclip.shots import RELAY_WALL
from tofclip.storage import HDF5_SIGNATURE
from tofclip.units import PICOSECOND, SPEED_OF_LIGHT

# Of a v7.3 file, before the HDF5 data begin.
MATLAB_HEADER_BYTES = 512


class NamedArrays(Archive):
    """Named arrays of a file in the orders and units that captures come in."""

    def fault(self, problem: str) -> FileFormatError:
        """What is wrong with the file."""
        return FileFormatError(self.path, problem)

    def read_numbers(self, name: str) -> AnyArray:
        """Return entry `name`, numbers of any shape but an empty one."""
        return self.array(name, *[None] * self._count_axes(name))

    def read_time_last(self, name: str) -> AnyArray:
        """Return signals (rows, columns, t); refuse rows and columns, two equal axes, after time."""
        signal = self.array(name, None, None, None)
        if signal.shape[1] == signal.shape[2] < signal.shape[0]:
            raise self.fault(
                f"{name} of shape {signal.shape} begins with time; put time last: "
                f"permute({name}, [2 3 1])"
            )
        return signal

    def read_coordinates(self, name: str, first: bool = False) -> FloatArray:
        """Return entry `name`, coordinates (..., 3), or (3, ...) where they come `first`, as (..., 3);
        NaN is allowed.
        """
        others = [None] * (self._count_axes(name) - 1)
        if first:
            return np.moveaxis(self.array(name, 3, *others), 0, -1).astype(np.float64)
        return self.array(name, *others, 3).astype(np.float64)

    def number(self, name: str, absent: float | None = None) -> float:
        """Return a single finite number, whatever its axes of length 1; `absent` without it."""
        if absent is not None and name not in self:
            return absent
        return float(self.finite_array(name, *[1] * self._count_axes(name)).squeeze())

    def flag(self, name: str) -> bool:
        """Whether entry `name` is there and true."""
        return name in self and bool(np.all(self.read(name)))

    def _count_axes(self, name: str) -> int:
        return len(self.describe(name).shape)


def read_hdf5(path: str | Path) -> NamedArrays:
    """List all arrays of an HDF5 file; groups become names with dots."""
    return NamedArrays(path, partial(_list_hdf5_entries, matlab=False))


def read_matlab(path: str | Path) -> NamedArrays:
    """List the numeric variables of a .mat file, version 5 to 7.3, structs by dotted names, in
    MATLAB's order of axes, without those of length 1.
    """
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(MATLAB_HEADER_BYTES + len(HDF5_SIGNATURE))
    if start[MATLAB_HEADER_BYTES:] == HDF5_SIGNATURE:
        return NamedArrays(path, partial(_list_hdf5_entries, matlab=True))
    return NamedArrays(path, _list_mat_entries)


def _list_hdf5_entries(path: Path, matlab: bool) -> Entries:
    import h5py

    entries: dict[str, ArchiveEntry] = {}

    def note(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#refs#"):
            return
        if item.shape is None or item.dtype.kind not in "uifbSO":
            return
        # Texts of variable length, references and MATLAB's cells are no numbers: never read.
        if not item.dtype.hasobject:
            require_bounded_dataset(item, path)
        shape = tuple(n for n in item.shape[::-1] if n != 1) if matlab else item.shape
        entry = ArchiveEntry(shape, item.dtype, partial(_load_hdf5, path, name, matlab))
        entries[name.replace("/", ".")] = entry

    with h5py.File(path, "r") as file:
        file.visititems(note)  # which follows no links
    return entries


def _load_hdf5(path: Path, name: str, matlab: bool) -> AnyArray:
    import h5py

    with h5py.File(path, "r") as file:
        values = np.asarray(file[name][()])
    return np.squeeze(values.T) if matlab else values


def _list_mat_entries(path: Path) -> Entries:
    def squeeze(entry: ArchiveEntry) -> ArchiveEntry:
        shape = tuple(n for n in entry.shape if n != 1)
        return ArchiveEntry(shape, entry.dtype, lambda: np.squeeze(entry.load()))

    return {name: squeeze(entry) for name, entry in list_mat_entries(path).items()}


# Cosine beyond which a direction counts as z.
MIN_Z_COSINE = 1 - 1e-6


def rotate_to_scene(capture: Capture, towards_scene: FloatArray) -> Capture:
    """Turn all coordinates so that a direction (3,), from the wall into the hidden scene, becomes
    +z: by half a turn around y if it is -z; else the old z, upright in most programs, becomes -y.
    """
    length = float(np.linalg.norm(towards_scene))
    if not 0 < length < np.inf:
        raise InputError(f"the direction towards the scene must not be 0, got {towards_scene}")
    forward = np.asarray(towards_scene, dtype=np.float64) / length
    if abs(forward[2]) > MIN_Z_COSINE:
        turn = np.diag([np.sign(forward[2]), 1.0, np.sign(forward[2])])
    else:
        down = forward * forward[2] - [0.0, 0.0, 1.0]
        down /= np.linalg.norm(down)
        turn = np.stack([np.cross(down, forward), down, forward])
    return replace(capture, wall=capture.wall @ turn.T, laser=capture.laser @ turn.T)


SETUP_FILE = "experimental_setup.m"
STEP_NAMES = ("bx", "by", "bz")
SETUP_NAMES = ("c", "delta_t", *STEP_NAMES)

# Where no script says otherwise.
BIN_WIDTH_S = 32e-12
# Where the script's c is larger, its delta_t is in s; else c is 1 and delta_t is a path, m.
MIN_SPEED_IN_SECONDS = 1e8
# Whole numbers that reach over less than this may be metres.
MIN_LATTICE_EXTENT = 8
# Turns (depth, to the left, up) into (x to the right, y down, z into the scene).
TO_SCENE = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
MAX_SCRIPT_BYTES = 1 << 20

OPERATIONS: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


def read_curvelet_data(fields: NamedArrays) -> Capture:
    """Read ``sub_Sig`` (pairs, t), with laser spots and wall points (pairs, 3) in ``C_i.mat`` and
    ``C_d.mat`` beside it, in steps (depth, to the left, up) of ``bx``, ``by`` and ``bz`` metres,
    which ``experimental_setup.m`` there or in the folder above sets, with ``c * delta_t``, the path
    of a bin: their letters N T read as N T only so. Without it points are metres: (depth, to the
    left, up) where the first does not vary, else (x, y, z).

    Liu et al., Nat. Commun. 14, 3230 (2023): CC-SOCR.
    """
    counts = fields.array("sub_Sig", None, None)
    laser, wall = (_read_points(fields, name, len(counts)) for name in ("C_i.mat", "C_d.mat"))
    folders = (fields.path.parent, fields.path.resolve().parent.parent)
    script = next((f / SETUP_FILE for f in folders if (f / SETUP_FILE).is_file()), None)
    if script is not None:
        found = parse_setup(script)
        steps = np.array([found[name] for name in STEP_NAMES])
        laser, wall = ((points * steps) @ TO_SCENE.T for points in (laser, wall))
        speed, bin_width = found["c"], found["delta_t"]
        if speed < MIN_SPEED_IN_SECONDS:
            bin_width *= speed / SPEED_OF_LIGHT
        return Capture(counts.T, wall, laser, bin_width)
    whole = bool(np.all(wall == np.round(wall)))
    if whole and float(np.ptp(wall, axis=0).max()) >= MIN_LATTICE_EXTENT:
        raise fields.fault(
            f"has pairs counted in steps of a lattice; it needs {SETUP_FILE} beside it or in the "
            "folder above, which sets c, delta_t, bx, by and bz; see docs/own_wall.md",
        )
    if np.ptp(wall[:, 0]) == 0 and np.ptp(laser[:, 0]) == 0:
        laser, wall = laser @ TO_SCENE.T, wall @ TO_SCENE.T
    return Capture(counts.T, wall, laser, BIN_WIDTH_S)


def parse_setup(path: str | Path) -> Mapping[str, float]:
    """Read the first value, a sum or product of numbers and names, of each of `SETUP_NAMES`."""
    with translate_read_errors(path), open(path, "rb") as file:
        text = file.read(MAX_SCRIPT_BYTES).decode(errors="replace")
    found: dict[str, float] = {}
    for line in text.splitlines():
        for name, value in re.findall(r"\b([a-z]\w*)\s*=([^=;]+);", line.split("%")[0]):
            if name in SETUP_NAMES and name not in found:
                found[name] = _evaluate(value.strip(), found)
    for name in SETUP_NAMES:
        if not found.get(name, 0.0) > 0 or not np.isfinite(found[name]):
            raise FileFormatError(path, f"does not set {name} to a positive number")
    return found


def _evaluate(text: str, known: Mapping[str, float]) -> float:
    """Evaluate a sum or product of numbers and known names; NaN for anything else."""

    def value_of(node: ast.expr) -> float:
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATIONS:
            return OPERATIONS[type(node.op)](value_of(node.left), value_of(node.right))
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return float(node.value)
        return known.get(node.id, np.nan) if isinstance(node, ast.Name) else np.nan

    try:
        return value_of(ast.parse(text, mode="eval").body)
    except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError):
        return np.nan


def _read_points(fields: NamedArrays, name: str, pairs: int) -> FloatArray:
    """Points (pairs, 3), as they stand in the file of that name beside the signals."""
    path = fields.path.with_name(name)
    if not path.is_file():
        raise fields.fault(
            f"holds sub_Sig of {pairs} pairs; it needs C_i.mat (laser spots) and C_d.mat (wall points) beside it, "
            "see docs/own_wall.md",
        )
    beside = read_matlab(path)
    for one in sorted(beside.names):
        points = beside.read_numbers(one).astype(np.float64)
        if points.shape == (pairs, 3):
            return points
    raise FileFormatError(path, f"holds no points of shape ({pairs}, 3)")


LIGHT_CONE_BIN_WIDTH_S = 4e-12
MIGRATION_BIN_WIDTH_S = 32e-12
MIGRATION_WALL_WIDTH_M = 2.0


def read_light_cone_data(fields: NamedArrays) -> Capture:
    """Read ``rect_data`` (x, y, t) with the light's way to the wall taken off, in bins of 4 ps, and
    ``width``, half the side of the wall in m, as ``cnlos_reconstruction.m`` of that paper's code
    takes them. x falls along the first axis: that code reverses x before it shows a volume, and only
    so their letter S reads as an S.

    O'Toole, Lindell, Wetzstein, Nature 555, 338 (2018).
    """
    counts, half = fields.read_time_last("rect_data"), fields.number("width")
    x, y = (np.linspace(-half, half, n) for n in counts.shape[:2])
    wall = np.swapaxes(_build_wall(x, y), 0, 1)[::-1]
    return Capture(np.moveaxis(counts, 2, 0), wall, wall, LIGHT_CONE_BIN_WIDTH_S)


def read_migration_data(fields: NamedArrays) -> Capture:
    """Read ``meas`` (y, x, t) in bins of 32 ps on a wall of 2 m x 2 m, and ``tofgrid`` (y, x), the
    arrival of the wall's own light in ps, from the same file or from a ``tof*.mat`` beside it, as
    ``demo.m`` of https://github.com/computational-imaging/nlos-fk takes them. Whether x or y run as
    in a photograph the data set does not say.

    Lindell, Wetzstein, O'Toole, ACM Trans. Graph. 38, 116 (2019).
    """
    counts, path = fields.read_time_last("meas"), fields.path
    source = fields
    if "tofgrid" not in fields:
        beside = [path.with_name(name) for name in (path.name.replace("meas", "tof"), "tof.mat")]
        found = next((one for one in beside if one != path and one.is_file()), None)
        if found is None:
            raise FileFormatError(
                path,
                "has no 'tofgrid', and there is no tof.mat beside it to tell when the wall lit up",
            )
        source = read_matlab(found)
    arrival = source.finite_array("tofgrid", *counts.shape[:2])
    delay_bins = arrival * PICOSECOND / MIGRATION_BIN_WIDTH_S
    by_bin = np.ascontiguousarray(
        np.moveaxis(counts, 2, 0).reshape(counts.shape[2], -1), dtype=np.float32
    )
    signal = shift_signals(by_bin, delay_bins.ravel()).reshape(counts.shape[2], *counts.shape[:2])
    half = MIGRATION_WALL_WIDTH_M / 2
    y, x = (np.linspace(-half, half, n) for n in counts.shape[:2])
    wall = _build_wall(x, y)
    return Capture(signal, wall, wall, MIGRATION_BIN_WIDTH_S)


def _build_wall(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack([*np.meshgrid(x, y), np.zeros((y.size, x.size))], axis=-1)


def read_tal(fields: NamedArrays) -> Capture:
    """Read ``H`` of the formats T_Sx_Sy, T_Lx_Ly_Sx_Sy, T_Si and T_Li_Si of y-tal, the toolkit of the
    University of Zaragoza; lengths and times in m of path, the scene at z > 0, as here.

    A lone laser point is a spot that stands still; as many as sensor points are paired with them,
    or confocal; other numbers are combined with all. Where ``t_accounts_first_and_last_bounces`` is
    true the ways to and from the devices are taken off.
    """
    sensor, laser = (fields.read_coordinates(f"{name}_grid_xyz") for name in ("sensor", "laser"))
    start = fields.number("t_start", 0.0)
    bin_width = fields.number("delta_t") / SPEED_OF_LIGHT
    capture = match_lasers_to_sensors(
        fields, fields.read_numbers("H"), sensor, laser, bin_width, start
    )
    if not fields.flag("t_accounts_first_and_last_bounces"):
        return capture
    source, camera = (fields.finite_array(f"{name}_xyz", 3) for name in ("laser", "sensor"))
    return remove_device_legs(capture, source, camera)


def match_lasers_to_sensors(
    fields: NamedArrays,
    signal: AnyArray,
    sensor: FloatArray,
    laser: FloatArray,
    bin_width: float,
    start: float,
) -> Capture:
    """Find out by the shapes which laser points belong to which sensor points, both (..., 3)."""
    sensors, lasers = sensor.shape[:-1], laser.shape[:-1]
    if not signal.ndim:
        raise fields.fault("holds a signal without a time axis")
    if signal.shape[1:] == sensors and laser.size == 3:
        return Capture(signal, sensor, laser.reshape(3), bin_width, start)
    if signal.shape[1:] == sensors == lasers:
        spots = sensor if np.allclose(sensor, laser) else laser
        return Capture(signal, sensor, spots, bin_width, start)
    if signal.shape[1:] == (*lasers, *sensors):
        return Capture.exhaustive(signal, sensor, laser, bin_width, start)
    raise fields.fault(
        f"a signal of shape {signal.shape} belongs neither to {sensors} wall points nor to {lasers} lasers",
    )


# Path per bin, m.
SURFACE_OPTIMISATION_BIN_M = 1.2e-3

# About z: from x to the left and y up to x to the right and y down.
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
# Of a bin's width, what even bins may differ by: times are often rounded.
EVEN_BINS_TOLERANCE = 1e-3
# Uneven bins become at most this number of times as many even ones.
MAX_EVEN_BINS_RATIO = 8


def read_numpy_archive(fields: NamedArrays) -> Capture:
    """Read ``H`` (t, ...), ``wall_xyz`` (..., 3), ``laser_xyz`` ((3,) or (..., 3)), and of the time
    axis either ``delta_t_s`` or ``delta_t_m`` and ``t_start_m``, 0 where it is absent, or the
    middle of every bin in ``t_s`` or ``t_m``.

    Lengths in m, durations in s; bin 0 holds the path ``t_start_m`` from the laser spot to the wall
    point. Bins of different widths are put into even ones. Lasers (lasers..., 3) of which each was
    combined with all wall points come with ``H`` (t, lasers..., points...).
    """
    signal = fields.read_numbers("H")
    wall, laser = (fields.read_coordinates(f"{name}_xyz") for name in ("wall", "laser"))
    points = wall.shape[:-1]
    if signal.shape[:-1] == points and signal.shape[1:] != points:
        raise fields.fault(
            f"H of shape {signal.shape} ends with time; put time first: np.moveaxis(H, -1, 0)",
        )
    times = next((name for name in ("t_m", "t_s") if name in fields), None)
    if times is not None:
        paths = fields.finite_array(times, len(signal)) * (1 if times == "t_m" else SPEED_OF_LIGHT)
        signal, start, spacing = resample_evenly(fields, signal, paths)
        return match_lasers_to_sensors(fields, signal, wall, laser, spacing / SPEED_OF_LIGHT, start)
    start = fields.number("t_start_m", 0.0)
    unit, per_second = ("s", 1.0) if "delta_t_s" in fields else ("m", SPEED_OF_LIGHT)
    bin_width = fields.number(f"delta_t_{unit}") / per_second
    return match_lasers_to_sensors(fields, signal, wall, laser, bin_width, start)


def resample_evenly(
    fields: NamedArrays, signal: AnyArray, paths: FloatArray
) -> tuple[AnyArray, float, float]:
    """Put counts (t, ...) of bins about `paths` (t,), m, evenly spread over each, into even bins of
    their median width; no photon is lost or doubled. Returns with them the path of the first bin
    and from one to the next, m.
    """
    widths = np.diff(paths)
    if len(paths) < 2 or not widths.min() > 0:
        raise fields.fault("has times that do not grow from bin to bin")
    spacing = float(widths.mean())
    if np.abs(widths - spacing).max() <= EVEN_BINS_TOLERANCE * spacing:
        return signal, float(paths[0]), spacing
    spacing = float(np.median(widths))
    middles = (paths[1:] + paths[:-1]) / 2
    edges = np.concatenate([[paths[0] - widths[0] / 2], middles, [paths[-1] + widths[-1] / 2]])
    bins = max(2, int(np.ceil((edges[-1] - edges[0]) / spacing)))
    if bins > MAX_EVEN_BINS_RATIO * len(paths):
        raise fields.fault(f"has time bins so uneven that {bins} even ones would be needed")
    even = edges[0] + spacing * np.arange(bins + 1)
    resampled = np.moveaxis(rebin(np.moveaxis(signal, 0, -1), edges, even), -1, 0)
    return resampled, float(even[0]) + spacing / 2, spacing


def read_surface_optimisation_data(fields: NamedArrays) -> Capture:
    """Read ``transient`` (points, t), in bins of 1.2 mm of path from 0, and ``lighting`` (points,
    3), m, of a confocal scan; x to the right and y down as their mannequin stands upright.

    Tsai, Sankaranarayanan, Gkioulekas, "Beyond volumetric albedo", CVPR 2019.
    """
    wall = fields.read_coordinates("lighting")
    counts = fields.array("transient", len(wall), None)
    return Capture(counts.T, wall, wall, SURFACE_OPTIMISATION_BIN_M / SPEED_OF_LIGHT)


def read_general_data(fields: NamedArrays) -> Capture:
    """Read ``data`` (rows, columns, t) of irregular pairs, with ``laserpoints`` and
    ``detectpoints`` (rows, columns, 3), m, in ``setup.mat`` beside it, or of ``data_NAME.mat`` in
    ``setup_NAME.mat``, as in https://github.com/hy520484/general-NLOS. The bin width, ``timeRes``
    s, has to stand in either: there it is 8.33, 16 or 32 ps. x runs to the left and y up: their
    script reverses both, and only so the letter and the number of "tuan" read as in their
    photograph.
    """
    counts = fields.read_time_last("data")
    own = fields.path.with_name(fields.path.name.replace("data", "setup", 1))
    setup = own if own != fields.path and own.is_file() else fields.path.with_name("setup.mat")
    if not setup.is_file():
        raise fields.fault(
            "holds data; it needs setup.mat beside it, with laserpoints and detectpoints; see docs/own_wall.md",
        )
    beside = read_matlab(setup)
    laser, wall = (
        beside.finite_array(name, *counts.shape[:2], 3) for name in ("laserpoints", "detectpoints")
    )
    stated = next((one for one in (fields, beside) if "timeRes" in one), None)
    if stated is None:
        raise fields.fault(
            "states no bin width; add it in seconds as timeRes to this file or to setup.mat, such as "
            "timeRes = 32e-12; see docs/own_wall.md",
        )
    bin_width = stated.number("timeRes")
    return Capture(np.moveaxis(counts, 2, 0), wall @ HALF_TURN, laser @ HALF_TURN, bin_width)


def read_lift_archive(path: str | Path) -> Capture:
    """Recover a LIFT streak image of a relay wall by the linear inverse, and take its wall out."""
    from tofclip.io import read_streak
    from tofclip.recovery import recover

    shot = read_streak(path)
    if RELAY_WALL not in shot.attachments:
        raise FileFormatError(path, "is a shot of no relay wall ('wall_grid_m'): no capture")
    return Capture.from_frames(recover(shot, method="linear"))


def read_phasor_field_data(fields: NamedArrays) -> Capture:
    """Read the struct ``dataset``: ``data`` (laser spot, camera spot, t), ``deltat`` and ``t0`` in m
    of path, positions of the spots and of the devices in m. One camera spot and many laser spots:
    their roles are exchanged here, which changes no path. The wall's normal becomes +z.

    Liu et al., "Non-line-of-sight imaging using phasor-field virtual wave optics", Nature 572, 620
    (2019).
    """
    wall, spots = (_read_spots(fields, f"dataset.{name}Pos") for name in ("laser", "camera"))
    data = fields.read_numbers("dataset.data").T
    if "dataset.t" in fields and data.shape[0] != fields.number("dataset.t"):
        raise fields.fault(
            f"'dataset.data' must end with {fields.number('dataset.t'):g} bins, found {data.T.shape}",
        )
    signal = np.ascontiguousarray(data, np.float32)
    bin_width = fields.number("dataset.deltat") / SPEED_OF_LIGHT
    start = fields.number("dataset.t0", 0.0)
    capture = match_lasers_to_sensors(fields, signal, wall, spots, bin_width, start)
    # The wall points' device is the laser here, and the lone spot's the camera.
    source, eye = (fields.finite_array(f"dataset.{name}Origin", 3) for name in ("camera", "laser"))
    capture = remove_device_legs(capture, source, eye)
    if "dataset.laserNorm" not in fields:
        return capture
    return rotate_to_scene(capture, _read_spots(fields, "dataset.laserNorm").mean(axis=0))


def read_rectified_data(fields: NamedArrays) -> Capture:
    """Read ``rect_data`` (y, x, t) without the ways to and from the devices, ``ts`` in s,
    ``sampling_spacing`` in m, and ``SPAD_index``, column and row of the one spot.

    Liu, Bauer, Velten, Nat. Commun. 11, 1645 (2020).
    """
    counts = fields.read_time_last("rect_data")
    rows, columns, _ = counts.shape
    spacing = fields.number("sampling_spacing")
    x, y = ((np.arange(n) - n / 2) * spacing for n in (columns, rows))
    wall = _build_wall(x, y)
    column, row = fields.finite_array("SPAD_index", 2).astype(int)
    if not (0 <= column < columns and 0 <= row < rows):
        raise fields.fault(
            f"'SPAD_index' names column {column}, row {row} of {columns} x {rows} points",
        )
    return Capture(np.moveaxis(counts, 2, 0), wall, wall[row, column], fields.number("ts"))


def _read_spots(fields: NamedArrays, name: str) -> FloatArray:
    """Points (n, 3), whichever way round they are stored."""
    points = np.atleast_2d(fields.read_numbers(name)).astype(np.float64)
    points = points.T if points.shape[0] == 3 and points.shape[1] != 3 else points
    if points.ndim != 2 or points.shape[1] != 3:
        raise fields.fault(
            f"field '{name}' must hold points in three dimensions, found {points.shape}",
        )
    return points


CONFOCAL_AXES, EXHAUSTIVE_AXES = 5, 7


def read_zaragoza(fields: NamedArrays) -> Capture:
    """Read a rendering; colours and bounces are added up, and the ways to and from the devices
    taken off. ``data`` is (colour, t, bounce, camera grid, laser grid) where positions are (3,
    ...), and the reverse where they are (..., 3); a confocal file has no laser grid. ``deltaT`` and
    ``t0`` are in m of path. The wall's normals, and the hidden volume where it is given, tell which
    way the scene lies.

    Galindo, Marco, O'Toole, Wetzstein, Gutierrez, Jarabo, "A dataset for benchmarking time-resolved
    non-line-of-sight imaging", SIGGRAPH 2019 posters; https://graphics.unizar.es/nlos_dataset.
    """
    first = fields.read_numbers("cameraGridPositions").shape[0] == 3
    signal = _add_up_bounces(fields, first)
    camera, laser = (
        fields.read_coordinates(f"{name}GridPositions", first) for name in ("camera", "laser")
    )
    bin_width, start = fields.number("deltaT") / SPEED_OF_LIGHT, fields.number("t0", 0.0)
    capture = match_lasers_to_sensors(fields, signal, camera, laser, bin_width, start)
    source, eye = (
        fields.read_numbers(f"{name}Position").astype(np.float64).reshape(3)
        for name in ("laser", "camera")
    )
    capture = remove_device_legs(capture, source, eye)
    if "cameraGridNormals" not in fields:
        return capture
    normals = fields.read_coordinates("cameraGridNormals", first)
    normal = normals.reshape(-1, 3).mean(axis=0)
    if "hiddenVolumePosition" in fields:
        hidden = fields.read_numbers("hiddenVolumePosition").reshape(3)
        hidden = hidden - camera.reshape(-1, 3).mean(axis=0)
        normal = normal * (np.sign(hidden @ normal) or 1.0)
    return rotate_to_scene(capture, normal)


def _add_up_bounces(fields: NamedArrays, first: bool) -> Float32Array:
    """Signal (t, lasers..., points...) of all colours and bounces; a lone laser has no axes."""
    data = fields.read_numbers("data")
    if data.ndim not in (CONFOCAL_AXES, EXHAUSTIVE_AXES):
        raise fields.fault(f"field 'data' must have 5 or 7 axes, found shape {data.shape}")
    if first:
        # (colour, t, bounce, camera..., laser...)
        signal = data.sum(axis=(0, 2), dtype=np.float32)
        lasers_last = signal.ndim == 1 + 4
        signal = np.moveaxis(signal, (3, 4), (1, 2)) if lasers_last else signal
    else:
        # (laser..., camera..., bounce, t, colour)
        signal = np.moveaxis(data.sum(axis=(-1, -3), dtype=np.float32), -1, 0)
    lone = signal.ndim == 1 + 4 and signal.shape[1:3] == (1, 1)
    return np.ascontiguousarray(signal[:, 0, 0] if lone else signal)
