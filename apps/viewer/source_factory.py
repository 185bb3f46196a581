"""From what a user names to something that can be looked at."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import h5py

from apps.viewer.source import Gate
from apps.viewer.sources import (
    CLOUD_SUFFIXES,
    CloudSource,
    LiveShotSource,
    ShotRecovery,
    StoredShotSource,
    TransientSource,
    find_clouds,
)
from devices.recording.read import read_head_if_recording
from devices.transients import TrackedShots, read_transient, read_transients
from tofclip.camera import Camera, measure
from tofclip.errors import FileFormatError, InputError
from tofclip.files import translate_read_errors
from tofclip.io import read_streak
from tofclip.recovery import make_method, open_shot, plan_recovery
from tofclip.shots import Frames
from tofclip.solvers import Method
from tofclip.storage import HDF5_SIGNATURE, Record

if TYPE_CHECKING:
    from apps.viewer.source import Source
    from tofclip.io.streaks import StreakStack
    from tofclip.shots import Streak


# quick enough for shots that come one after the other, and to refocus by
LOOK_METHODS = ("tv", "l1", "linear", "adjoint")
SURFACES = "surfaces"  # takes some ten seconds, for which a single shot has the time
# enough to read what is written on a surface; `tofclip recover` takes 40
FIRST_LOOK_METHOD, FIRST_LOOK_ITERATIONS = "l1", 25
# Refinements of a camera whose sweep the shot itself has to tell; `tofclip recover` takes up to ten,
# which is most of its time. Two leave 0.2 rows and 0.6 px of them on a recorded shot: no letter moves.
FIRST_LOOK_ROUNDS = 2

FIRST_LOOK_NOTE = (
    f"quick look ({FIRST_LOOK_METHOD}, {FIRST_LOOK_ITERATIONS} iterations); "
    "for measurements run tofclip recover"
)


@dataclass(frozen=True)
class ShotOptions:
    """What has to be known about raw shots."""

    # the camera's file; by default the camera that travels with the shot
    camera: Path | None = None
    bin_width: float | None = None  # duration of a row, s; by default the shot's own time axis
    # reading of the time axis at which light of range 0 would arrive, s; by default the camera's
    time_zero: float | None = None
    # how shots are recovered: a name of `tofclip.recovery.plan.METHODS`, ``"surfaces"`` for a
    # single one. By default a single one by some iterations of ``"l1"``, and one after the other by
    # ``"linear"``
    method: str | None = None


# called with what is about to be done, before it takes seconds
Announce = Callable[[str], None]


def announce_nothing(_: str) -> None:
    """Take no notice."""


def open_source(
    name: str, options: ShotOptions | None = None, announce: Announce = announce_nothing
) -> Source:
    """Open a file, a folder of files, or the address of an instrument. `name`: frames, cloud,
    volume, shot or stack of shots (HDF5); a cloud of another format; a raw streak image; a range
    image or depth picture; a folder of clouds or of streak images; or an address such as
    ``sim+linospad2://?seed=1``; `announce`: called with what is done where it takes seconds, as
    soon as the inputs are known to be good.
    """
    options = options or ShotOptions()
    if "://" in name:
        return _open_instrument(name, options, announce)
    path = Path(name)
    if path.is_dir():
        return _open_folder(path, options, announce)
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(len(HDF5_SIGNATURE))
    if start == HDF5_SIGNATURE:
        return _open_hdf5(path, options, announce)
    if read_head_if_recording(path) is not None:
        return _open_instrument(f"file://{path}", options, announce)
    if path.suffix.lower() in (*CLOUD_SUFFIXES, ".exr") and not (
        path.suffix.lower() == ".npz" and _is_lift_archive(path)
    ):
        return CloudSource(path.name, [path])
    return _open_shots(path.name, [partial(_read_shot, path, options)], options, announce)


def _open_hdf5(path: Path, options: ShotOptions, announce: Announce) -> Source:
    if _is_stack(path):
        from tofclip.io.streaks import StreakStack

        stack = StreakStack(path)
        return _open_shots(
            path.name,
            [partial(_read_stacked_shot, stack, number, options) for number in range(len(stack))],
            options,
            announce,
        )
    record = Record.load(path)
    if record.kind == "frames":
        return TransientSource(
            path.name, Frames.from_record(record), method=_make_method(options.method)
        )
    if record.kind == "volume":
        from apps.viewer.sources import VolumeSource
        from nlos import Volume

        return VolumeSource(path.name, Volume.from_record(record))
    if record.kind == "cloud":
        return CloudSource(path.name, [path])
    if record.kind == "streak":
        return _open_shots(path.name, [partial(_read_shot, path, options)], options, announce)
    verb = {"camera": "tofclip info", "capture": "tofclip nlos reconstruct"}.get(record.kind)
    advice = f"; {verb} reads it" if verb else ""
    raise FileFormatError(
        path,
        f"holds a {record.kind} record; frames, clouds, volumes and shots can be looked at{advice}",
    )


def _open_folder(path: Path, options: ShotOptions, announce: Announce) -> Source:
    if clouds := find_clouds(path):
        return CloudSource(path.name, clouds)
    shots = sorted(entry for entry in path.iterdir() if entry.is_file() and entry.name[0] != ".")
    if not shots:
        raise InputError(f"{path}: the folder holds nothing to look at")
    readers = [partial(_read_shot, shot, options) for shot in shots]
    return _open_shots(path.name, readers, options, announce)


def _open_shots(
    title: str,
    shots: Sequence[Callable[[], Streak]],
    options: ShotOptions,
    announce: Announce,
) -> Source:
    """Shots in files. A single one becomes a transient, so that time can be walked through."""
    first = shots[0]()
    if options.method == SURFACES and len(shots) == 1:
        return _open_surfaces(title, first, options, announce)
    camera = _find_camera(title, first, options, announce)
    if len(shots) > 1:
        return StoredShotSource(title, shots, camera, _make_method(options.method))
    measured = measure(first.counts, first.saturated, camera)
    method = _make_method(options.method or FIRST_LOOK_METHOD)
    recovery = ShotRecovery(camera, first.times - camera.time_zero, method)
    frames = recovery.frames(measured.values, 0.0, Gate(0, first.times.size))
    source = TransientSource(title, frames, measured.values, method)
    if options.method is None:
        source.notes = (FIRST_LOOK_NOTE, *source.notes)
    return source


def _open_surfaces(title: str, shot: Streak, options: ShotOptions, announce: Announce) -> Source:
    """A single shot by its surfaces; a refocus, which shows frames, is quick."""
    opened = open_shot(shot, options.camera, options.time_zero)
    announce(f"recovering the surfaces of {title}")
    frames = plan_recovery(opened, SURFACES).run()
    measured = measure(shot.counts, shot.saturated, frames.camera)
    return TransientSource(title, frames, measured.values, _make_method(FIRST_LOOK_METHOD))


def _make_method(name: str | None) -> Method | None:
    """A method quick enough to look by; None where a source is to choose."""
    if name is None:
        return None
    if name == SURFACES:
        raise InputError(
            "surfaces take too long for shots one after the other, and need a shot; choose one of "
            f"{', '.join(LOOK_METHODS)}, or make frames by tofclip recover"
        )
    if name not in LOOK_METHODS:
        raise InputError(
            f"unknown method '{name}'; choose one of {', '.join((*LOOK_METHODS, SURFACES))}"
        )
    iterations = FIRST_LOOK_ITERATIONS if name in ("tv", "l1") else None
    return cast(Method, make_method(name, iterations=iterations))


def _open_instrument(address: str, options: ShotOptions, announce: Announce) -> Source:
    """An instrument that goes on, or a recording, which is gathered once."""
    if address.lower().startswith("file://"):
        reader = partial(read_transient, address, options.bin_width)
        return _open_shots(address, [reader], options, announce)
    shots = TrackedShots(read_transients(address, options.bin_width))
    first = shots.peek()
    if first is None:
        raise InputError(f"{address}: the source ended before it gave anything")
    camera = _find_camera(address, first, options, announce)
    return LiveShotSource(address, shots, camera, _make_method(options.method))


def _find_camera(title: str, shot: Streak, options: ShotOptions, announce: Announce) -> Camera:
    """The camera of a row of shots; a sweep that is not known is found from the first one."""
    opened = open_shot(shot, options.camera, options.time_zero)
    announce(f"recovering {title}")
    return opened.fit_camera(max_rounds=FIRST_LOOK_ROUNDS).camera


def _read_shot(path: Path, options: ShotOptions) -> Streak:
    return read_streak(path, options.bin_width)


def _read_stacked_shot(stack: StreakStack, number: int, options: ShotOptions) -> Streak:
    shot = stack.read_shot(number)
    return shot if options.bin_width is None else shot.with_bin_width(options.bin_width)


def _is_stack(path: Path) -> bool:
    """Whether an HDF5 file is a stack of shots, which any program may have written."""
    try:
        with h5py.File(path, "r") as file:
            return "format" not in file.attrs and "counts" in file
    except OSError as fault:
        raise FileFormatError(path, "is damaged or incomplete") from fault


def _is_lift_archive(path: Path) -> bool:
    """Whether an archive is a shot rather than a cloud."""
    try:
        with zipfile.ZipFile(path) as archive:
            return not {"x_m.npy", "x.npy", "range_m.npy"} & set(archive.namelist())
    except zipfile.BadZipFile as fault:
        raise FileFormatError(path, "is not a NumPy archive, or is damaged") from fault
