"""`tofclip nlos stream`: captures to hidden volumes while they come, by one plan."""

from __future__ import annotations

import sys
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from apps.conventions import JsonOption, make_folder, report
from apps.nlos.files import CAPTURE_SUFFIXES, GEOMETRY_FILE, is_capture_folder, list_captures
from apps.nlos.imaging import (
    METHODS,
    PORTABLE_METHODS,
    ImagingSettings,
    parse_method_names,
    prepare_imaging,
    require_valid_settings,
)
from apps.settings import (
    SettingsOption,
    add_setting_flags,
    load_settings,
    save_settings,
    setting_field,
)
from nlos.io import read_capture
from nlos.method import PhasorPlan
from nlos.preparation import MidpointJoin
from nlos.video import DepthAverage
from tofclip.errors import InputError, TofclipError
from tofclip.files import require_apart
from tofclip.sequences.streaming import run_in_order

if TYPE_CHECKING:
    from apps.nlos.imaging import PreparedImaging
    from nlos import Capture, Plan, Volume

POLL_INTERVAL_S = 0.02
MAX_LATENCY_SAMPLES = 10_000
"""Volumes over which medians are taken: a stream may run for days."""

EXIT_SOME_FAILED = 1
SETTINGS_NAME = "stream.toml"
SETTINGS_HEADING = "tofclip nlos stream SOURCE --settings THIS --out FOLDER"


@dataclass(frozen=True)
class StreamSettings(ImagingSettings):
    """How every capture of a stream is imaged."""

    method: str | None = setting_field(
        "NAME",
        f"One of {', '.join(METHODS)}.",
        shown="the quickest that suits the first capture",
        choices=METHODS,
    )
    average: int = setting_field(
        "N",
        "Captures averaged at the last depth, fewer nearer by: rsd, hybrid, backprojection.",
        1,
    )


class _NamedCapture(NamedTuple):
    """A capture as it comes, or why it cannot be read."""

    name: str
    capture: Capture | None
    problem: str = ""


@add_setting_flags(StreamSettings)
def stream(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A folder of captures, or a single one.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the volumes go, one .h5 each.")],
    follow_s: Annotated[
        float,
        typer.Option(
            metavar="S",
            help="Wait for further captures until none has come for so long; what comes too fast is dropped.",
        ),
    ] = 0.0,
    captures: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Stop after this number of captures.",
            show_default="at the source's end",
        ),
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the volumes on a page as they come.")
    ] = False,
    settings: SettingsOption = None,
    as_json: JsonOption = False,
    **flags: Any,
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
    wanted = replace(load_settings(StreamSettings, settings, flags), everywhere=True)
    _check_settings(wanted, follow_s, captures)
    renderings = (path.parent for path in source.glob(f"*/{GEOMETRY_FILE}"))
    require_apart([out, out / SETTINGS_NAME, *out.glob("*.h5")], [source, settings, *renderings])
    coming = islice(_read_captures(source, follow_s), captures)
    first = next((one for one in coming if one.capture is not None), None)
    if first is None or first.capture is None:
        raise InputError(f"{source}: the source ended before it gave a capture that can be read")
    started = time.perf_counter()
    prepared = prepare_imaging(first.capture, wanted)
    plan = prepared.settings.make_method().plan(prepared.capture, prepared.grid)
    planned = time.perf_counter() - started
    make_folder(out)  # only now: captures that cannot be imaged leave no empty folder
    save_settings(
        replace(prepared.shown, method=prepared.settings.method),
        out / SETTINGS_NAME,
        SETTINGS_HEADING,
    )
    imaging = _choose_imaging(plan, prepared, wanted.average)
    made = _VolumeStream(chain([first], coming), prepared, imaging, out, follow_s > 0)
    figures = _run_with_page(made, source) if view else made.run()
    figures = {
        "method": prepared.settings.method,
        "voxels": prepared.grid.shape,
        **figures,
        "plan_s": planned,
    }
    report(figures, as_json, [out])
    if figures["failed"]:
        raise typer.Exit(EXIT_SOME_FAILED)


def _check_settings(wanted: StreamSettings, follow_s: float, captures: int | None) -> None:
    names = METHODS if wanted.method is None else parse_method_names(wanted.method)
    if wanted.method is not None and len(names) > 1:
        raise InputError(f"one method images a stream, got '{wanted.method}'")
    require_valid_settings(wanted, names)
    if wanted.average < 1:
        raise InputError(f"--average must be 1 or more, got {wanted.average}")
    if wanted.average > 1 and wanted.method not in (None, *PORTABLE_METHODS):
        raise InputError(
            f"--average adds up waves, which {wanted.method} has none of: use one of "
            f"{', '.join(PORTABLE_METHODS)}"
        )
    if not (np.isfinite(follow_s) and follow_s >= 0):
        raise InputError(f"--follow-s must be 0 s or more, got {follow_s}")
    if captures is not None and captures < 1:
        raise InputError(f"--captures must be positive, got {captures}")


def _choose_imaging(
    plan: Plan, prepared: PreparedImaging[StreamSettings], captures: int
) -> Callable[[Capture], Volume]:
    """Return what images a capture: the plan, or the plan and an average over depth."""
    if captures == 1 or not isinstance(plan, PhasorPlan):
        return plan.image
    average = DepthAverage(plan.grid, float(prepared.capture.points[:, 2].max()), captures)
    return lambda capture: average.add(plan.field(capture))


def _read_captures(source: Path, follow_s: float) -> Iterator[_NamedCapture]:
    """Read the captures of a folder in the order of their names, and those that come later."""
    if not is_capture_folder(source):
        yield _NamedCapture(source.stem, read_capture(source))
        return
    done: set[Path] = set()
    unreadable: dict[Path, tuple[tuple[int, int], str]] = {}
    last = time.monotonic()
    waiting = follow_s > 0
    while True:
        # A folder that is waited for may be empty yet.
        found = _list_present(source) if waiting else list_captures(source)
        for path in found:
            state = _read_state(path)
            if path in done or state is None or state == unreadable.get(path, (None,))[0]:
                continue
            try:
                capture = read_capture(path)
            except TofclipError as fault:
                # Perhaps it is still being written: tried again when it has changed.
                unreadable[path] = state, str(fault)
            else:
                done.add(path)
                unreadable.pop(path, None)
                yield _NamedCapture(path.stem, capture)
            last = time.monotonic()
        if time.monotonic() - last >= follow_s:
            break
        time.sleep(POLL_INTERVAL_S)
    for path, (_, problem) in unreadable.items():
        if path.exists():  # it may have been a name for the time of writing
            yield _NamedCapture(path.stem, None, problem)


def _read_state(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written to; None if it is gone since it was listed."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _list_present(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in CAPTURE_SUFFIXES and not path.name.startswith(".")
    )


class _VolumeStream:
    """Captures imaged while others are read and written.

    `prepared`: of the first of them; `imaging`: from a capture to its volume; `live`: whether
    captures do not wait: then the oldest that waits is dropped.
    """

    def __init__(
        self,
        coming: Iterable[_NamedCapture],
        prepared: PreparedImaging[StreamSettings],
        imaging: Callable[[Capture], Volume],
        out: Path,
        live: bool,
    ) -> None:
        self._coming, self._prepared, self._image, self._out = coming, prepared, imaging, out
        self._live, self._acquired = live, 0
        self._midpoints = MidpointJoin(prepared.recorded)
        self.latest: deque[Volume] = deque(maxlen=1)
        self._imaging: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        self.latency, self.failed, self.delivered = float("nan"), 0, 0
        self.ended, self.stopping = threading.Event(), threading.Event()

    def run(self) -> dict[str, Any]:
        """Image all that comes; return the figures."""
        latencies: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        policy: Any = "drop_oldest" if self._live else "block"
        started = time.perf_counter()
        try:
            # One capture at a time on all cores: the next is read meanwhile.
            with (
                ThreadPoolExecutor(1, "volumes") as worker,
                closing(
                    run_in_order(self._count(), self._work, worker, at_once=1, policy=policy)
                ) as made,
            ):
                for item in made:
                    if item.value:
                        self.latency = item.latency
                        latencies.append(item.latency)
                    if self.stopping.is_set():
                        break
        finally:
            self.ended.set()
        seconds = time.perf_counter() - started
        median, late = np.quantile(latencies, (0.5, 0.95)) if latencies else (None, None)
        return {
            "acquired": self._acquired,
            "delivered": self.delivered,
            "dropped": self._acquired - self.delivered - self.failed,
            "failed": self.failed,
            "volumes_per_second": self.delivered / seconds,
            "latency_median_s": None if median is None else float(median),
            "latency_p95_s": None if late is None else float(late),
            # What the plan alone takes: the rest is reading, preparing and writing.
            "plan_run_median_s": float(np.median(self._imaging)) if self._imaging else None,
        }

    def _count(self) -> Iterator[_NamedCapture]:
        for one in self._coming:
            self._acquired += 1
            yield one

    def _work(self, one: _NamedCapture) -> bool:
        """Image a capture and write its volume; return whether that was possible."""
        try:
            if one.capture is None:
                raise InputError(one.problem)
            capture = self._prepared.settings.prepare(one.capture, self._midpoints.join)
            started = time.perf_counter()
            volume = self._image(capture)
            self._imaging.append(time.perf_counter() - started)
            volume.save(self._out / f"{one.name}.h5", compressed=False)
        except TofclipError as fault:
            self.failed += 1
            print(f"tofclip: failed: {one.name}: {fault}", file=sys.stderr)
            return False
        self.latest.append(volume)
        self.delivered += 1
        return True


def _run_with_page(made: _VolumeStream, source: Path) -> dict[str, Any]:
    """Image on a thread of its own while the page shows the newest volume; ends with Ctrl-C."""
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
