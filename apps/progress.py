"""A progress bar on a terminal, a word elsewhere where work takes its time, and a quick end of the
work when Ctrl-C is pressed; the jobs of a sequence under it, with what became of them, and status 1
if some failed.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

from apps.report import REPLACES, name_options, report, say
from tofclip.errors import MissingDependencyError

if TYPE_CHECKING:
    from tofclip.sequences.jobs import Job, Report, Summary

Advance = Callable[[int], None]
STEPS = 1000  # of a bar for a share
MAX_SILENCE_S = 2.0  # where no bar is drawn

_screen_lock = threading.Lock()


@contextlib.contextmanager
def show_progress(title: str, total: int) -> Iterator[Advance]:
    """Yield a function to call with the amount of work just done, from any thread.

    The bar is drawn on standard error; where that is no terminal, one line says what goes on after
    `MAX_SILENCE_S`. Inside another bar, or off the main thread as on a cluster's worker, there is
    none. After Ctrl-C the function raises in every thread that calls it, so that none goes on
    computing for nothing.

    `total`: amount of work at which the bar is full.
    """
    with _watch_interrupt() as interrupted, _open_bar(title, total) as draw:

        def advance(amount: int) -> None:
            if interrupted.is_set():
                raise KeyboardInterrupt
            draw(amount)

        yield advance


@contextlib.contextmanager
def show_activity(title: str) -> Iterator[None]:
    """Show that work whose amount is not known goes on, and for how long; as `show_progress`."""
    with _open_bar(title, None):
        yield


@contextlib.contextmanager
def show_share(title: str, whole: float | None) -> Iterator[Callable[[float], None]]:
    """Show a bar for a part of a whole, such as seconds passed; none where that is not known."""
    if whole is None or not math.isfinite(whole):
        yield lambda _: None
        return
    with show_progress(title, STEPS) as advance:
        shown = 0

        def watch(done: float) -> None:
            nonlocal shown
            # A bar takes whole steps forward; the difference of rounded sums never drifts.
            step = round(STEPS * done / whole)
            advance(step - shown)
            shown = step

        yield watch


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Print nothing but errors: no figures, and no bars, as inside another one."""
    with _screen_lock, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield


@contextlib.contextmanager
def _open_bar(title: str, total: int | None) -> Iterator[Advance]:
    own_thread = threading.current_thread() is threading.main_thread()
    if not own_thread or not _screen_lock.acquire(blocking=False):
        yield lambda _: None
        return
    if not sys.stderr.isatty():
        say = partial(print, f"tofclip: {title} ...", file=sys.stderr, flush=True)
        timer = threading.Timer(MAX_SILENCE_S, say)
        timer.daemon = True
        timer.start()
        try:
            yield lambda _: None
        finally:
            timer.cancel()
            _screen_lock.release()
        return
    from rich import progress
    from rich.console import Console

    columns: tuple[progress.ProgressColumn, ...] = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(None),
        progress.TaskProgressColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    )
    if total is None:
        columns = columns[:2] + columns[3:4]  # nothing is known of what is left
    try:
        # Printed while the bar is there, a line goes above it; a pipe gets it as it is.
        with progress.Progress(
            *columns,
            console=Console(stderr=True),
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        ) as drawn:
            task = drawn.add_task(title, total=total)
            yield lambda amount: drawn.advance(task, amount)
    finally:
        _screen_lock.release()


@contextlib.contextmanager
def _watch_interrupt() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets before it raises `KeyboardInterrupt` in the main thread."""
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        signal.default_int_handler(number, frame)

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


EXIT_SOME_FAILED = 1
BYTES_PER_MIB = 1 << 20


def run_with_progress(
    title: str,
    jobs: Sequence[Job],
    cluster: str | None,
    watch: Callable[[Report], object] = lambda _: None,
) -> Summary:
    """Run the jobs that are not done yet under a bar; `watch` is called with reports."""
    from tofclip.sequences.jobs import run_jobs, select_unfinished

    if REPLACES.get():
        for job in jobs:
            job.result.unlink(missing_ok=True)
    missing = select_unfinished(jobs)
    with show_progress(title, len(missing)) as advance:

        def note(report: Report) -> None:
            watch(report)
            advance(1)

        return run_jobs(missing, cluster, note)


def resolve_device(device: str, cluster: str | None) -> str:
    """Return which device a name stands for here; workers on other machines look for it themselves."""
    from tofclip.arrays import parse_device

    try:
        found = str(parse_device(device))
    except MissingDependencyError:
        if cluster is None:
            raise
        return device
    return found if cluster is None else device


def report_summary(
    summary: Summary, total: int, out: Path, figures: Mapping[str, Any] | None = None
) -> None:
    """Print the figures of a sequence and its failures; `total`: of all its jobs."""
    failed = list_failures(summary)
    figures = {
        "results": summary.done,
        "kept_from_before": total - summary.done - len(failed),
        "failed": len(failed),
        "seconds": summary.seconds,
        "results_per_second": summary.done / summary.seconds,
        "processes": summary.processes,
        "peak_memory_mib_per_process": summary.peak_bytes / BYTES_PER_MIB,
        **(figures or {}),
    }
    listed = [{"name": name, "problem": problem} for name, problem in failed.items()]
    report(figures | {"failures": listed}, [out], json_only=["failures"])
    end_with(failed)


def list_failures(summary: Summary) -> dict[str, str]:
    """Return why jobs failed, by their names."""
    return {one.name: name_options(one.problem) for one in summary.failures}


def end_with(failed: Mapping[str, str]) -> None:
    """Say what failed, and let the exit status say that something did."""
    for name, problem in failed.items():
        say("failed", f"{name}: {problem}")
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)
