"""From what a user names to something that can be looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from apps.viewer.shots import LiveShots, StoredShots
from apps.viewer.sources import (
    CloudSource,
    PhotonSource,
    StreakSource,
    TransientSource,
    VolumeSource,
)
from devices.tracking import TrackedShots
from devices.transients import read_transient, read_transients
from tofclip.camera import Camera, measure
from tofclip.errors import FileFormatError, InputError
from tofclip.io import read_streak
from tofclip.io.streaks import StreakStack
from tofclip.lidar.photons import PhotonCube
from tofclip.loading import CLOUD_SUFFIXES, load, outline
from tofclip.plugins import METHODS, list_settings
from tofclip.recovery import make_method, open_shot, plan_recovery
from tofclip.sequences import make_pipeline
from tofclip.shots import Streak
from tofclip.solvers import LinearInverse, Method, ProximalMethod

if TYPE_CHECKING:
    from apps.viewer.source import Source

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
# called with what is about to be done, before it takes seconds
Announce = Callable[[str], None]


def make_look_method(name: str | None) -> Method | None:
    """Return a method quick enough to look by; None where a source is to choose."""
    if name is None:
        return None
    if name == SURFACES:
        raise InputError(
            "surfaces take too long for shots one after the other, and need a shot; choose one of "
            f"{', '.join(one for one in METHODS if one != SURFACES)}, or make frames by tofclip recover"
        )
    takes = list_settings(METHODS[name])
    iterations = FIRST_LOOK_ITERATIONS if {"iterations", "start"} & takes.keys() else None
    return cast(Method, make_method(name, iterations=iterations))


@dataclass(frozen=True)
class ShotOptions:
    """What has to be known about raw shots."""

    # the camera's file; by default the camera that travels with the shot
    camera: Path | None = None
    bin_width: float | None = None  # duration of a row, s; by default the shot's own time axis
    # reading of the time axis at which light of range 0 would arrive, s; by default the camera's
    time_zero: float | None = None
    # of `tofclip.plugins.METHODS`, ``"surfaces"`` for a single shot only. By default a single one by some
    # iterations of ``"l1"``, and one after the other by ``"linear"``
    method: str | None = None


def open_source(
    name: str, options: ShotOptions | None = None, announce: Announce = lambda _: None
) -> Source:
    """Open a file, a folder of files, or the address of an instrument. `name`: whatever
    `tofclip.load` opens and has points or light; another program's table of points; a stack of
    shots; a folder of clouds or of shots; or an address such as ``sim+linospad2://?seed=1``;
    `announce`: called with what is done where it takes seconds, as soon as the inputs are known to
    be good.
    """
    options = options or ShotOptions()
    if "://" in name:
        return _open_instrument(name, options, announce)
    path = Path(name)
    read = partial(read_streak, bin_width=options.bin_width)
    if path.is_dir():
        entries = sorted(entry for entry in path.iterdir() if entry.name[0] != ".")
        if clouds := [entry for entry in entries if entry.suffix.lower() in CLOUD_SUFFIXES]:
            return CloudSource(path.name, clouds)
        shots = [partial(read, entry) for entry in entries if entry.is_file()]
        if not shots:
            raise InputError(f"{path}: the folder holds nothing to look at")
        return _open_shots(path.name, shots, options, announce)
    if StreakStack.is_one(path):
        stack = StreakStack(path)

        def read_stacked(number: int) -> Streak:
            shot = stack.read_shot(number)
            return shot if options.bin_width is None else shot.with_bin_width(options.bin_width)

        shots = [partial(read_stacked, number) for number in range(len(stack))]
        return _open_shots(path.name, shots, options, announce)
    try:
        kind = outline(path).kind
    except FileFormatError:  # a table of another program may have fewer columns than ours
        if path.suffix.lower() not in CLOUD_SUFFIXES:
            raise
        kind = "cloud"
    if kind in ("cloud", "range image", "depth picture"):
        return CloudSource(path.name, [path])
    if kind == "frames":
        return TransientSource(path.name, load(path), method=make_look_method(options.method))
    if kind == "volume":
        return VolumeSource(path.name, load(path))
    if kind == "streak":
        return _open_shots(path.name, [partial(read, path)], options, announce)
    if kind == "recording":
        return _open_instrument(f"file://{path}", options, announce)
    verb = {"camera": "tofclip info", "capture": "tofclip nlos reconstruct"}.get(kind)
    advice = f"; {verb} reads it" if verb else ""
    raise FileFormatError(
        path, f"holds a {kind} record; frames, clouds, volumes and shots can be looked at{advice}"
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
        camera = _find_camera(title, first, options, announce)
        method = make_look_method(options.method)
        return StreakSource(title, StoredShots(shots), camera, first.times, method)
    if options.method == SURFACES:
        opened = open_shot(first, options.camera, options.time_zero)
        announce(f"recovering the surfaces of {title}")
        frames = plan_recovery(opened, SURFACES).run()
        measured = measure(first.counts, first.saturated, frames.camera).values
        # a refocus, which shows frames, is quick
        return TransientSource(title, frames, measured, make_look_method(FIRST_LOOK_METHOD))
    camera = _find_camera(title, first, options, announce)
    method = make_look_method(options.method or FIRST_LOOK_METHOD)
    shot = StreakSource(title, StoredShots([lambda: first]), camera, first.times, method)
    source = TransientSource(title, shot.recover_frames(0), shot.measurements(0), method)
    if options.method is None:
        source.notes = (FIRST_LOOK_NOTE, *source.notes)
    return source


def _open_instrument(address: str, options: ShotOptions, announce: Announce) -> Source:
    """An instrument that goes on, or a recording, of which streak images are gathered once."""
    shots = TrackedShots(read_transients(address, options.bin_width))
    first = shots.peek()
    if first is None:
        raise InputError(f"{address}: the source ended before it gave anything")
    if isinstance(first, PhotonCube):
        announce(f"finding the ranges of {address}")
        pipeline = make_pipeline(first, options.camera, options.time_zero)
        return PhotonSource(address, LiveShots(address, shots, pipeline), pipeline.camera)
    if not shots.is_live:
        shots.close()
        whole = read_transient(address, options.bin_width)
        assert isinstance(whole, Streak)
        return _open_shots(address, [lambda: whole], options, announce)
    method = make_look_method(options.method or LinearInverse.name)
    camera = _find_camera(address, first, options, announce)
    # by a method that makes no clouds while shots come, they are made when one looks
    by = method if isinstance(method, LinearInverse | ProximalMethod) else LinearInverse.name
    pipeline = make_pipeline(first, camera, options.time_zero, method=by)
    return StreakSource(address, LiveShots(address, shots, pipeline), camera, first.times, method)


def _find_camera(title: str, shot: Streak, options: ShotOptions, announce: Announce) -> Camera:
    """The camera of a row of shots; a sweep that is not known is found from the first one."""
    opened = open_shot(shot, options.camera, options.time_zero)
    announce(f"recovering {title}")
    return opened.fit_camera(max_rounds=FIRST_LOOK_ROUNDS).camera
