"""Recording a source: its bytes are tapped before they are decoded, and written while it is read; and
measuring how fast and how well a source delivers.
"""

from __future__ import annotations

import contextlib
import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any

from devices.recording.write import RecordingWriter, make_head
from devices.source import Batch, DecodedSource, Piece, Source, Stats
from tofclip.errors import DeviceTimeoutError, InputError, TofclipError

# Seconds after which the recorder looks at the clock and at its file, though nothing came
POLL_INTERVAL_S = 0.25
END_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


@dataclass(frozen=True)
class Throughput:
    """What came of recording a source, or of reading it for a while."""

    seconds: float  # until the source was stopped, or at its end
    # that were recorded, without the file's own, or decoded in this time: as they came from the
    # instrument, or the records' where a source has no bytes
    bytes: int
    stats: Stats  # after everything that was left had been read and the source was closed

    @property
    def figures(self) -> dict[str, float]:
        """Everything by name but the bytes, and the rate."""
        known = self.stats.as_dict()
        acquired = known.pop("acquired")
        rate = {"bytes_per_second": self.bytes / self.seconds, "records": acquired}
        return {"seconds": self.seconds, **rate, **known}


def record_source(
    source: Source,
    path: Path,
    seconds: float = float("inf"),
    provenance: Mapping[str, Any] | None = None,
    watch: Callable[[float], None] | None = None,
    overwrite: bool = False,
) -> Throughput:
    """Read a source to its end, or for some time, and write everything that comes to `path`.

    However this ends (an exception, a signal, a killed program), the file holds what came until
    then, and can be opened. On Ctrl-C, SIGTERM and SIGHUP the instrument is stopped, and what it
    and the buffer still hold is recorded before `KeyboardInterrupt` is raised; a second signal
    gives that up. The source is closed. Memory: the source's.

    `source`: one that has bytes to tap: a live instrument, or another recording; `path`: locked
    meanwhile; a second recorder is refused; `provenance`: how it came about; `watch`: called with
    the seconds that have passed, now and then; `overwrite`: replace `path` if it exists.
    """
    with source:
        if not isinstance(source, DecodedSource):
            raise InputError(
                f"{source.info.instrument}: comes from a file already, there is nothing to record"
            )
        head = make_head(source.codec, source.info, source.calibration, dict(provenance or {}))
        begin = monotonic()
        with (
            _defer_end_signals() as interrupted,
            contextlib.closing(RecordingWriter(path, head, overwrite)) as writer,
        ):
            source.tap = writer.add

            def report() -> None:
                writer.check()
                if watch is not None:
                    watch(monotonic() - begin)

            fault = "interrupted"
            try:
                for _ in _read_until(source, begin + seconds, interrupted, report):
                    pass
                source.drain()
                fault = "interrupted" if interrupted.is_set() else ""
            except TofclipError as failure:
                fault = str(failure)
                raise
            finally:
                # Closed first: only then are the accounts that go into the file final.
                source.close()
                writer.finish(source.stats, fault, source.is_complete)
        if interrupted.is_set():
            raise KeyboardInterrupt
        return Throughput(monotonic() - begin, writer.bytes_written, source.stats)


def _read_until(
    source: Source, deadline: float, interrupted: threading.Event, report: Callable[[], None]
) -> Iterator[Batch]:
    """Yield batches until the deadline, the end or a signal."""
    while (left := deadline - monotonic()) > 0 and not interrupted.is_set():
        report()
        with contextlib.suppress(DeviceTimeoutError):
            batch = source.read(min(left, POLL_INTERVAL_S))
            if batch is None:
                return
            yield batch


@contextlib.contextmanager
def _defer_end_signals() -> Iterator[threading.Event]:
    """Yield an event that the first signal to end sets, so that no piece is cut in two; the second
    raises `KeyboardInterrupt`. Does nothing outside the main thread, which is the only one that
    gets signals, and leaves signals alone that the program was started to ignore.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    numbers = [getattr(signal, name) for name in END_SIGNALS if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    # A signal ignored by the parent (nohup) stays ignored.
    heeded = [number for number in numbers if before[number] is not signal.SIG_IGN]
    for number in heeded:
        signal.signal(number, interrupt)
    try:
        yield interrupted
    finally:
        for number in heeded:
            signal.signal(number, before[number] or signal.SIG_DFL)


def measure_throughput(
    source: Source, seconds: float, watch: Callable[[float], None] = lambda _: None
) -> Throughput:
    """Read a source for some seconds or to its end, decode everything, and close it."""
    if not 0 < seconds < math.inf:
        raise InputError(f"a trial takes a positive, finite number of seconds, got {seconds:g}")
    read = 0

    def count(piece: Piece) -> None:
        nonlocal read
        read += len(piece.data)

    with source:
        is_tapped = isinstance(source, DecodedSource)
        if isinstance(source, DecodedSource):
            source.tap = count
        begin, unlimited = monotonic(), threading.Event()
        report = lambda: watch(monotonic() - begin)  # noqa: E731
        for batch in _read_until(source, begin + seconds, unlimited, report):
            read += 0 if is_tapped else batch.records.nbytes
        # Measured before draining, whose bytes would flatter the rate.
        took, measured = max(monotonic() - begin, 1e-9), read
        source.drain()
    return Throughput(took, measured, source.stats)
