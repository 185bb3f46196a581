"""From what a user names to something that can be looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.viewer.shots import LiveShots, StoredShots
from apps.viewer.sources import (
    LOOK_ITERATIONS,
    LOOK_METHOD,
    UNFOCUSED,
    CloudSource,
    PhotonSource,
    StreakSource,
    TransientSource,
    VolumeSource,
    make_look_method,
)
from devices.transients import TrackedShots, TransientStream, read_transient
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError
from tofclip.lidar.photons import PhotonCube
from tofclip.loading import CLOUD_SUFFIXES, load, outline
from tofclip.plugins import METHODS
from tofclip.recovery import open_shot, plan_recovery
from tofclip.sequences import Shot, is_sequence, list_shots, make_pipeline
from tofclip.shots import Streak
from tofclip.solvers import LinearInverse, ProximalMethod

if TYPE_CHECKING:
    from apps.viewer.source import Source

# Refinements of a camera whose sweep the shot itself has to tell; `tofclip recover` takes up to ten,
# which is most of its time. Two leave 0.2 rows and 0.6 px of them on a recorded shot: no letter moves.
FIRST_LOOK_ROUNDS = 2
FIRST_LOOK_NOTE = (
    f"quick look ({LOOK_METHOD}, {LOOK_ITERATIONS} iterations); "
    "for measurements run tofclip recover"
)
# called with what is about to be done, before it takes seconds
Announce = Callable[[str], None]


def check_method(name: str | None) -> str:
    """Return the name of a method to look by."""
    if name in UNFOCUSED:
        raise InputError(
            "surfaces take too long for shots one after the other, and need a shot; choose one of "
            f"{', '.join(one for one in METHODS if one not in UNFOCUSED)}, or make frames by tofclip recover"
        )
    make_look_method(name or LOOK_METHOD)  # refuses what is unknown
    return name or LOOK_METHOD


@dataclass(frozen=True)
class ShotOptions:
    """What has to be known about raw shots."""

    # the camera's file; by default the camera that travels with the shot
    camera: Path | None = None
    bin_width: float | None = None  # duration of a row, s; by default the shot's own time axis
    # reading of the time axis at which light of range 0 would arrive, s; by default the camera's
    time_zero: float | None = None
    # of `tofclip.plugins.METHODS`, ``"surfaces"`` for a single shot only. By default some iterations of
    # ``"l1"``, and frames as they were recovered
    method: str | None = None


def open_source(
    name: str, options: ShotOptions | None = None, announce: Announce = lambda _: None
) -> Source:
    """Open a file, a folder of files, or the address of an instrument. `name`: whatever
    `tofclip.load` opens and has points or light; another program's table of points; a folder of
    clouds; a folder, pattern or stack of shots; or an address such as ``sim+linospad2://?seed=1``;
    `announce`: called with what is done where it takes seconds, as soon as the inputs are known to
    be good.
    """
    options = options or ShotOptions()
    if "://" in name:
        return _open_instrument(name, options, announce)
    path = Path(name)
    if path.is_dir():
        entries = sorted(entry for entry in path.iterdir() if entry.name[0] != ".")
        if clouds := [entry for entry in entries if entry.suffix.lower() in CLOUD_SUFFIXES]:
            return CloudSource(path.name, clouds)
    if is_sequence(path):
        shots = list_shots(path, options.bin_width)
        return _open_shots(path.name, list(shots.values()), options, announce)
    try:
        kind = outline(path).kind
    except FileFormatError:  # a table of another program may have fewer columns than ours
        if path.suffix.lower() not in CLOUD_SUFFIXES:
            raise
        kind = "cloud"
    if kind in ("cloud", "range image", "depth picture"):
        return CloudSource(path.name, [path])
    if kind == "frames":
        frames = TransientSource(path.name, load(path))
        if options.method is not None:
            frames.method_choice.value = check_method(options.method)
        return frames
    if kind == "volume":
        return VolumeSource(path.name, load(path))
    if kind == "streak":
        return _open_shots(path.name, [Shot(path, options.bin_width)], options, announce)
    if kind == "recording":
        return _open_instrument(f"file://{path}", options, announce)
    verb = {"capture": "nlos reconstruct", "light_field": "clip simulate"}.get(kind, "info")
    raise FileFormatError(
        path,
        f"holds a {kind} record; frames, clouds, volumes and shots can be looked at; tofclip {verb} reads it",
    )


def _open_shots(
    title: str,
    shots: Sequence[Callable[[], Streak]],
    options: ShotOptions,
    announce: Announce,
) -> Source:
    """Shots in files. A single one becomes a transient, so that time can be walked through."""
    first = shots[0]()
    if len(shots) > 1:
        name = check_method(options.method)
        camera = _find_camera(title, first, options, announce)
        return StreakSource(title, StoredShots(shots), camera, first.times, name)
    name = options.method or LOOK_METHOD
    method: Any = name if name in UNFOCUSED else make_look_method(name)
    opened = open_shot(first, options.camera, options.time_zero)
    announce(f"recovering {title}")
    if name not in UNFOCUSED:
        opened = opened.fit_camera(max_rounds=FIRST_LOOK_ROUNDS)
    source = TransientSource(title, plan_recovery(opened, method).run())
    if options.method is None:
        source.notes = (FIRST_LOOK_NOTE, *source.notes)
    return source


def _open_instrument(address: str, options: ShotOptions, announce: Announce) -> Source:
    """An instrument that goes on, or a recording, of which streak images are gathered once."""
    name = check_method(options.method)
    announce(f"waiting for the first shot of {address}")
    shots = TrackedShots(TransientStream(address, options.bin_width))
    first = shots.peek()
    if first is None:
        raise InputError(f"{address}: the source ended before it gave anything")
    if isinstance(first, PhotonCube):
        announce(f"finding the ranges of {address}")
        pipeline = make_pipeline(first, options.camera, options.time_zero, method=options.method)
        return PhotonSource(address, LiveShots(address, shots, pipeline), pipeline.camera)
    if not shots.is_live:
        shots.close()
        whole = read_transient(address, options.bin_width)
        assert isinstance(whole, Streak)
        return _open_shots(address, [lambda: whole], options, announce)
    method = make_look_method(name)
    camera = _find_camera(address, first, options, announce)
    # by a method that makes no clouds while shots come, they are made when one looks
    by = method if isinstance(method, LinearInverse | ProximalMethod) else LinearInverse.name
    pipeline = make_pipeline(first, camera, options.time_zero, method=by)
    return StreakSource(address, LiveShots(address, shots, pipeline), camera, first.times, name)


def _find_camera(title: str, shot: Streak, options: ShotOptions, announce: Announce) -> Camera:
    """The camera of a row of shots; a sweep that is not known is found from the first one."""
    opened = open_shot(shot, options.camera, options.time_zero)
    announce(f"recovering {title}")
    return opened.fit_camera(max_rounds=FIRST_LOOK_ROUNDS).camera
