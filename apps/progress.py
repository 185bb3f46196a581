"""A progress bar on a terminal, and a quick end of the work when Ctrl-C is pressed."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Advance = Callable[[int], None]
STEPS = 1000  # of a bar for a share

_screen_lock = threading.Lock()


@contextlib.contextmanager
def show_progress(title: str, total: int) -> Iterator[Advance]:
    """Yield a function to call with the amount of work just done, from any thread.

    The bar is drawn on standard error, and only on a terminal; inside another bar, or off the main
    thread as on a cluster's worker, there is none. After Ctrl-C the function raises in every thread
    that calls it, so that none goes on computing for nothing.

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
    """Show that work whose amount is not known goes on, and for how long; as `show_progress`, on a
    terminal only.
    """
    with _open_bar(title, None):
        yield


@contextlib.contextmanager
def show_share(title: str, whole: float | None) -> Iterator[Callable[[float], None]]:
    """Show a bar for a part of a whole, such as seconds that have passed; none
    where the whole is not known.
    """
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
    watched = sys.stderr.isatty() and threading.current_thread() is threading.main_thread()
    if not watched or not _screen_lock.acquire(blocking=False):
        yield lambda _: None
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
