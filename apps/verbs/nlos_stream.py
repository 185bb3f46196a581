"""`tofclip nlos stream`: captures to hidden volumes while they come, by one plan; `tofclip nlos film`:
one capture while the laser's flash passes through the hidden scene.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from apps.options import (
    SETTINGS,
    arg,
    flag,
    opt,
    save_settings,
    settings_to_dict,
    take_settings,
)
from apps.progress import EXIT_SOME_FAILED, show_progress
from apps.report import (
    make_folder,
    place_settings,
    report,
    require_new,
    say,
    with_past,
)
from apps.verbs.nlos_imaging import (
    CAPTURE,
    GEOMETRY_FILE,
    PORTABLE_METHODS,
    choose_methods,
    is_capture_folder,
    list_captures,
    parse_method_names,
    prepare_imaging,
    require_valid_settings,
    show_settings,
)
from apps.verbs.recover import MAX_LATENCY_SAMPLES, compute_quantiles
from nlos.settings import METHODS, Settings, declare_setting
from tofclip.errors import InputError, TofclipError
from tofclip.files import require_apart
from tofclip.units import NANOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    from nlos import Capture, Volume
    from nlos.imaging import PreparedImaging

    Coming = tuple[str, Capture] | TofclipError  # with its name; or why it cannot be read

POLL_INTERVAL_S = 0.02
SETTINGS_NAME = "stream.toml"

FILM_METHODS = ("rsd", "hybrid")
"""They keep the band's frequencies apart from the laser's wave, the quicker one first."""

FILM_SUFFIXES = (".mp4", ".gif", ".h5")
FRAME_RATE_HZ = 12.5
MARGIN_SIGMAS = 2.0
"""Before the flash reaches the first voxel, and after it left the last: standard deviations of the
virtual pulse.
"""


@dataclass(frozen=True)
class StreamSettings(Settings):
    """How every capture of a stream is imaged."""

    average: int = declare_setting(
        "",
        "Captures averaged at the last depth, fewer nearer by: rsd, hybrid, backprojection.",
        1,
    )


@take_settings(StreamSettings)
def stream(
    wanted: StreamSettings,
    source: Path = arg("SOURCE", "A folder of captures, or a single one.", read=True),
    out: Path = opt("DIR", "Where the volumes go, one .h5 each.", ...),
    follow_s: float = opt(
        "S",
        "Wait for further captures until none has come for so long; what comes too fast is dropped.",
        0.0,
    ),
    captures: int | None = opt(
        "N", "Stop after this number of captures.", shown="at the source's end"
    ),
    view: bool = flag("--view", "Show the volumes on a page as they come."),
    settings: Path | None = SETTINGS,
) -> None:
    """Image every capture of a stream by one plan, and tell rate and latency.

    The settings are found from the first capture and hold for all, which have its wall, laser and
    time axis; what it has not is counted as failed. All of the box is imaged, since things move.
    Every capture is accounted for: acquired = delivered + dropped + failed. With --follow-s, one that
    cannot be read is tried again whenever its file changes: it may be half written.

    --average takes the noise off what is far without smearing what moves near by: the number of
    captures grows in proportion to the distance from the wall, as does what is resolved.

    Example: tofclip nlos stream captures/ --out volumes/
    """
    from nlos.method import PhasorPlan
    from nlos.video import DepthAverage

    wanted = replace(wanted, everywhere=True)
    _check_stream(wanted, follow_s, captures)
    renderings = (path.parent for path in source.glob(f"*/{GEOMETRY_FILE}"))
    existing = list(out.glob("*.h5"))
    require_apart([out, out / SETTINGS_NAME, *existing], [source, settings, *renderings])
    require_new(*existing)
    coming = islice(_read_captures(source, follow_s), captures)
    first = next(coming, None)  # those that cannot be read come last
    if first is None or isinstance(first, TofclipError):
        raise InputError(f"{source}: the source ended before it gave a capture that can be read")
    started = time.perf_counter()
    prepared = prepare_imaging(first[1], wanted)
    method = prepared.settings.method
    plan = prepared.settings.make_method().plan(prepared.capture, prepared.grid)
    planned = time.perf_counter() - started
    make_folder(out)  # only now: captures that cannot be imaged leave no empty folder
    heading = "tofclip nlos stream SOURCE --settings THIS --out FOLDER"
    save_settings(show_settings(prepared.settings, [method or ""]), out / SETTINGS_NAME, heading)
    imaging: Callable[[Capture], Volume] = plan.image
    if wanted.average > 1 and isinstance(plan, PhasorPlan):
        waves, far = plan.field, prepared.capture.points[:, 2].max()
        average = DepthAverage(plan.grid, far, wanted.average)
        imaging = lambda capture: average.add(waves(capture))  # noqa: E731
    made = VolumeStream(chain([first], coming), prepared, imaging, out, follow_s > 0)
    figures = _run_with_page(made, source) if view else made.run()
    figures = {"method": method, "voxels": prepared.grid.shape, **figures, "plan_s": planned}
    report(figures, [out])
    if figures["failed"]:
        raise typer.Exit(EXIT_SOME_FAILED)


def _check_stream(wanted: StreamSettings, follow_s: float, captures: int | None) -> None:
    names = choose_methods(wanted.method, tuple(METHODS.own))
    require_valid_settings(wanted, names)
    if wanted.average < 1:
        raise InputError(f"--average must be 1 or more, got {wanted.average}")
    if wanted.average > 1 and wanted.method not in (None, *PORTABLE_METHODS):
        raise InputError(
            f"--average adds up waves, which {wanted.method} has none of: use one of "
            f"{', '.join(PORTABLE_METHODS)}"
        )
    if not 0 <= follow_s < float("inf"):
        raise InputError(f"--follow-s must be 0 s or more, got {follow_s}")
    if captures is not None and captures < 1:
        raise InputError(f"--captures must be positive, got {captures}")


def _read_captures(source: Path, follow_s: float) -> Iterator[Coming]:
    """Read a folder's captures by name, and later ones; at last say what cannot be read."""
    from nlos.io import read_capture

    if not is_capture_folder(source):
        yield source.stem, read_capture(source)
        return
    done: set[Path] = set()
    unreadable: dict[Path, tuple[tuple[int, int], str]] = {}
    last = time.monotonic()
    while True:
        for path in list_captures(source, may_be_empty=follow_s > 0):
            try:
                known = path.stat()
            except OSError:  # it is gone since it was listed
                continue
            state = known.st_size, known.st_mtime_ns
            if path in done or state == unreadable.get(path, (None,))[0]:
                continue
            try:
                capture = read_capture(path)
            except TofclipError as fault:
                # Perhaps it is still being written: tried again when it has changed.
                unreadable[path] = state, str(fault)
            else:
                done.add(path)
                unreadable.pop(path, None)
                yield path.stem, capture
            last = time.monotonic()
        if time.monotonic() - last >= follow_s:
            break
        time.sleep(POLL_INTERVAL_S)
    for path, (_, problem) in unreadable.items():
        if path.exists():  # it may have been a name for the time of writing
            yield InputError(f"{path.stem}: {problem}")


class VolumeStream:
    """Captures imaged while others are read and written.

    `prepared`: of the first of them; `imaging`: from a capture to its volume; `live`: whether
    captures do not wait: then the oldest that waits is dropped.
    """

    def __init__(
        self,
        coming: Iterable[Coming],
        prepared: PreparedImaging[StreamSettings],
        imaging: Callable[[Capture], Volume],
        out: Path,
        live: bool,
    ) -> None:
        from nlos.preparation import MidpointJoin

        self._coming, self._settings = coming, prepared.settings
        self._image, self._out = imaging, out
        self._live, self._acquired = live, 0
        self._join = MidpointJoin(prepared.recorded).join
        self._imaging: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        self.latest: deque[Volume] = deque(maxlen=1)
        self.latency, self.failed, self.delivered = float("nan"), 0, 0
        self.ended, self.stopping = threading.Event(), threading.Event()

    def run(self) -> dict[str, Any]:
        from concurrent.futures import ThreadPoolExecutor

        from tofclip.sequences.streaming import run_in_order

        latencies: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        started = time.perf_counter()
        try:
            # One capture at a time on all cores; meanwhile the next is read, and the last written.
            with (
                ThreadPoolExecutor(1, "volumes") as worker,
                closing(
                    run_in_order(
                        self._count(),
                        self._image_named,
                        worker,
                        at_once=1 if self._live else 2,
                        policy="drop_oldest" if self._live else "block",
                        on_failure=self._note_failure,
                    )
                ) as made,
            ):
                for item in made:
                    began = time.perf_counter()
                    if self._write(item.number, *item.value):
                        self.latency = item.latency + time.perf_counter() - began
                        latencies.append(self.latency)
                    if self.stopping.is_set():
                        break
        finally:
            self.ended.set()
        seconds = time.perf_counter() - started
        latency = compute_quantiles(latencies)
        return {
            "acquired": self._acquired,
            "delivered": self.delivered,
            "dropped": self._acquired - self.delivered - self.failed,
            "failed": self.failed,
            "volumes_per_second": self.delivered / seconds,
            "latency_median_s": latency.get("median"),
            "latency_p95_s": latency.get("p95"),
            # What the plan alone takes: the rest is reading, preparing and writing.
            "plan_run_median_s": compute_quantiles(self._imaging).get("median"),
        }

    def _count(self) -> Iterator[Coming]:
        for one in self._coming:
            self._acquired += 1
            yield one

    def _image_named(self, named: tuple[str, Capture]) -> tuple[str, Volume]:
        name, capture = named
        try:
            capture = self._settings.prepare(capture, self._join)
            started = time.perf_counter()
            volume = self._image(capture)
            self._imaging.append(time.perf_counter() - started)
        except TofclipError as fault:
            raise InputError(f"{name}: {fault}") from fault
        return name, volume

    def _write(self, number: int, name: str, volume: Volume) -> bool:
        """Write a volume and show it; a disk that is full fails it alone."""
        try:
            volume.save(self._out / f"{name}.h5", compressed=False)
        except TofclipError as fault:
            self._note_failure(number, fault)
            return False
        self.latest.append(volume)
        self.delivered += 1
        return True

    def _note_failure(self, _: int, fault: TofclipError) -> None:
        self.failed += 1
        say("failed", fault)


def _run_with_page(made: VolumeStream, source: Path) -> dict[str, Any]:
    """Image on a thread of its own while the page shows the newest volume; ends with Ctrl-C."""
    import webbrowser

    from apps.viewer.page import Page
    from apps.viewer.session import Session
    from apps.viewer.sources import VolumeStreamSource

    figures: dict[str, Any] = {}
    thread = threading.Thread(target=lambda: figures.update(made.run()), daemon=True)
    thread.start()
    while not made.latest and not made.ended.wait(POLL_INTERVAL_S):
        pass
    if made.latest:
        shown = VolumeStreamSource(str(source), made)
        with closing(Page(Session(shown))) as page:
            print(f"tofclip: {page.address}", file=sys.stderr)
            webbrowser.open(page.address)
            try:
                page.run()
            except KeyboardInterrupt:
                made.stopping.set()
    thread.join()
    return figures


@dataclass(frozen=True)
class FilmSettings(Settings):
    """What is filmed, and when."""

    method: str | None = declare_setting(
        "",
        f"{' or '.join(FILM_METHODS)}.",
        shown="the quickest that suits the capture",
        choices=FILM_METHODS,
    )
    instants: int = declare_setting("", "How many.", 60)
    first: float | None = declare_setting(
        "s", "First instant after the flash.", written="ns", shown="before it meets the first voxel"
    )
    last: float | None = declare_setting(
        "s", "Last instant.", written="ns", shown="after it left the last voxel"
    )
    every_depth: bool = declare_setting(
        "", "Keep every depth, not only the brightest along every line of sight: .h5.", False
    )


@take_settings(FilmSettings)
def film(
    wanted: FilmSettings,
    source: Path = CAPTURE,
    out: Path = opt("FILE", "The film to write, .mp4 or .gif; or its numbers, .h5.", ...),
    settings: Path | None = SETTINGS,
) -> None:
    """Film the hidden scene while the laser's flash passes through it.

    A hidden thing lights up when the flash reaches it, so that near things show before far ones;
    light that met several things shows once more at the last of them. Needs a capture of one laser
    spot, and rsd or hybrid. Times count from the moment when the flash leaves its spot on the wall.

    The part of the box that is bright is found as by nlos reconstruct. The settings that were given
    or found are written beside the film (.toml) and give the same one.

    Example: tofclip nlos film capture.h5 --out flash.gif
    """
    import numpy as np

    from nlos import TransientImaging
    from nlos.illumination import find_leg_bounds
    from nlos.io import read_capture

    beside = place_settings(out, *FILM_SUFFIXES, inputs=(source, settings))
    _check_film(wanted, out)
    capture = read_capture(source)
    # Reading the file does not count as imaging.
    started = time.perf_counter()
    prepared = prepare_imaging(capture, wanted)
    capture, grid, found = prepared.capture, prepared.grid, prepared.settings
    if found.method not in FILM_METHODS:  # back-projection is the quickest that remains
        found = replace(found, method=FILM_METHODS[-1])
    method: Any = found.make_method()
    imaging = TransientImaging(method)
    # The virtual pulse has a width, so that its flank arrives before its middle.
    nearest, farthest = find_leg_bounds(capture.lasers, grid)
    room = MARGIN_SIGMAS * method.pulse.sigma
    ends = ((nearest - room) / SPEED_OF_LIGHT, (farthest + room) / SPEED_OF_LIGHT)
    given = (found.first, found.last)
    first, last = (end if one is None else one for one, end in zip(given, ends, strict=True))
    if last < first:
        said = f"{first / NANOSECOND:.4g} to {last / NANOSECOND:.4g} ns"
        raise InputError(f"a film must begin before it ends, got {said}")
    found = replace(show_settings(found, [found.method or ""]), first=first, last=last)
    times = np.linspace(first, last, found.instants)
    take = imaging.video if found.every_depth else imaging.front_views
    with show_progress("filming", grid.size) as advance:
        video = take(capture, grid, times, advance)
    seconds = time.perf_counter() - started
    shown = settings_to_dict(found)
    video = with_past(video, {"verb": "nlos film", **shown}, source)
    suffix = out.suffix.lower()
    if suffix == ".h5":
        video.save(out)
    elif suffix == ".gif":
        video.save_film(out)
    else:
        from apps.figures.style import open_film
        from nlos.picture import render_frames

        with open_film(out, FRAME_RATE_HZ) as add:
            for picture in render_frames(video):
                add(picture)
    save_settings(found, beside, "tofclip nlos film CAPTURE --settings THIS --out FILM")
    figures = {
        **{name: shown.get(name) for name in ("method", "wavelength_mm", "voxel_mm")},
        "voxels": video.grid.shape,
        "instants": len(video.times),
        "first_ns": shown["first_ns"],
        "last_ns": shown["last_ns"],
        "seconds": seconds,
    }
    report(figures, [out, beside])


def _check_film(settings: FilmSettings, out: Path) -> None:
    """Refuse what no capture could be filmed by, before any is read."""
    names = FILM_METHODS if settings.method is None else parse_method_names(settings.method)
    if not set(names) <= set(FILM_METHODS):
        raise InputError(f"films are made by {' or '.join(FILM_METHODS)}, not by {settings.method}")
    require_valid_settings(settings, names)
    if settings.instants < 1:
        raise InputError(f"a film needs at least one instant, got {settings.instants}")
    if settings.every_depth and out.suffix.lower() != ".h5":
        raise InputError(
            f"{out}: a film shows one picture per instant; write every depth to a .h5 file"
        )
    if out.suffix.lower() == ".mp4":
        from apps.figures.style import import_opencv

        import_opencv()  # a missing library is reported before the film is computed
