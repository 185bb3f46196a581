"""From what a user names to something that can be looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from apps.viewer.clouds import SUFFIXES, CloudFiles, clouds_in
from tofclip.errors import FileFormatError, InputError
from tofclip.storage import SIGNATURE, Record, reading

if TYPE_CHECKING:
    from apps.viewer.source import Source
    from tofclip.camera import Camera
    from tofclip.shots import Streak
    from tofclip.shots.stack import StreakStack


@dataclass(frozen=True)
class Extras:
    """What has to be known about raw shots.

    Parameters
    ----------
    camera : Path, optional
        The camera's file; by default the camera that travels with the shot.
    bin_width : float, optional
        Duration of a row, s; by default the shot's own time axis.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; by default the camera's.
    """

    camera: Path | None = None
    bin_width: float | None = None
    time_zero: float | None = None


def open_source(name: str, extras: Extras | None = None) -> Source:
    """Open a file, a folder of files, or the address of an instrument.

    Parameters
    ----------
    name : str
        Frames, cloud, volume, shot or stack of shots (HDF5); a cloud of another format; a raw streak image; a folder
        of clouds or of streak images; or an address such as ``sim+linospad2://?seed=1``.
    extras : Extras, optional

    Raises
    ------
    InputError, StorageError, FileFormatError, DeviceError
        It cannot be opened, or is nothing to look at.
    """
    extras = extras or Extras()
    if "://" in name:
        return _instrument(name, extras)
    path = Path(name)
    if path.is_dir():
        return _folder(path, extras)
    with reading(path), open(path, "rb") as file:
        start = file.read(len(SIGNATURE))
    if start == SIGNATURE:
        return _hdf5(path, extras)
    if path.suffix.lower() in SUFFIXES and not (path.suffix.lower() == ".npz" and _is_lift(path)):
        return CloudFiles(path.name, [path])
    return _shots(path.name, [partial(_read_shot, path, extras)], extras)


def _hdf5(path: Path, extras: Extras) -> Source:
    from apps.viewer.transient import TransientSource
    from tofclip.shots import Frames

    if _is_stack(path):
        from tofclip.shots.stack import StreakStack

        stack = StreakStack(path)
        return _shots(path.name, [partial(_stacked, stack, number, extras) for number in range(len(stack))], extras)
    record = Record.load(path)
    if record.kind == "frames":
        return TransientSource(path.name, Frames.from_record(record))
    if record.kind == "volume":
        from apps.viewer.volume import VolumeSource
        from nlos import Volume

        return VolumeSource(path.name, Volume.from_record(record))
    if record.kind == "cloud":
        return CloudFiles(path.name, [path])
    if record.kind == "streak":
        return _shots(path.name, [partial(_read_shot, path, extras)], extras)
    raise FileFormatError(path, f"holds a {record.kind} record; frames, clouds, volumes and shots can be looked at")


def _folder(path: Path, extras: Extras) -> Source:
    if clouds := clouds_in(path):
        return CloudFiles(path.name, clouds)
    shots = sorted(entry for entry in path.iterdir() if entry.is_file() and entry.name[0] != ".")
    if not shots:
        raise InputError(f"{path}: the folder holds nothing to look at")
    return _shots(path.name, [partial(_read_shot, shot, extras) for shot in shots], extras)


def _shots(title: str, shots: Sequence[Callable[[], Streak]], extras: Extras) -> Source:
    """Shots in files. A single one becomes a transient, so that time can be walked through."""
    from apps.viewer.linear_path import LinearPath
    from apps.viewer.shots import StoredShots
    from apps.viewer.source import Gate
    from apps.viewer.transient import TransientSource
    from tofclip.camera import measure

    first = shots[0]()
    camera = _camera_of(first, extras)
    if len(shots) > 1:
        return StoredShots(title, shots, camera)
    measured = measure(first.counts, first.saturated, camera)
    linear = LinearPath(camera, first.times - camera.time_zero)
    return TransientSource(title, linear.frames(measured.readings, 0.0, Gate(0, first.times.size)), measured.readings)


def _instrument(address: str, extras: Extras) -> Source:
    """An instrument that goes on, or a recording, which is gathered once."""
    from apps.viewer.live import LiveShots, first_and_rest
    from devices.transients import read_transient, read_transients

    if address.lower().startswith("file://"):
        return _shots(address, [lambda: read_transient(address, extras.bin_width)], extras)
    first, rest = first_and_rest(read_transients(address, extras.bin_width), address)
    return LiveShots(address, rest, _camera_of(first, extras), first)


def _camera_of(shot: Streak, extras: Extras) -> Camera:
    """The camera of a row of shots; a sweep that is not known is found from the first one."""
    from tofclip.camera import Camera
    from tofclip.recovery import fitted_to_shot, prepare

    known = prepare(shot, None if extras.camera is None else Camera.load(extras.camera), "linear").camera
    if extras.time_zero is not None:
        known = known.replace(time_zero=extras.time_zero)
    return known if known.sweep is not None else fitted_to_shot(shot, known)


def _read_shot(path: Path, extras: Extras) -> Streak:
    from tofclip.io import read_streak

    return read_streak(path, extras.bin_width)


def _stacked(stack: StreakStack, number: int, extras: Extras) -> Streak:
    shot = stack.shot(number)
    return shot if extras.bin_width is None else shot.with_bin_width(extras.bin_width)


def _is_stack(path: Path) -> bool:
    """Whether an HDF5 file is a stack of shots, which any program may have written."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return "format" not in file.attrs and "counts" in file
    except OSError as fault:
        raise FileFormatError(path, "is damaged or incomplete") from fault


def _is_lift(path: Path) -> bool:
    """Whether an archive is a shot rather than a cloud."""
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            return not {"x_m.npy", "x.npy"} & set(archive.namelist())
    except zipfile.BadZipFile as fault:
        raise FileFormatError(path, "is no NumPy archive, or a damaged one") from fault
