"""Recording a source: its bytes are tapped before they are decoded, and written while it is read."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from devices.decoded_source import DecodedSource
from devices.recording.writer import RecordingWriter, make_head
from devices.source import Source
from devices.statistics import Stats
from tofclip.errors import DeviceTimeoutError, InputError, TofclipError

POLL_INTERVAL_S = 0.25
"""Seconds after which the recorder looks at the clock, though nothing came."""

ProgressCallback = Callable[[float], None]


@dataclass(frozen=True)
class RecordingSummary:
    """What a recording came to.

    Parameters
    ----------
    seconds : float
    bytes : int
        Of the instrument, without the file's own.
    stats : Stats
    """

    seconds: float
    bytes: int
    stats: Stats


def record_source(
    source: Source, path: Path, seconds: float = float("inf"), provenance: Mapping[str, Any] | None = None,
    watch: ProgressCallback | None = None,
) -> RecordingSummary:  # fmt: skip
    """Read a source to its end, or for some time, and write everything that comes to `path`.

    However this ends (an exception, Ctrl-C, a killed program), the file holds what came until then,
    and can be opened. The source is closed. Memory: the source's.

    Parameters
    ----------
    source : Source
        One that has bytes to tap: a live instrument, or another recording.
    path : Path
    seconds : float
    provenance : mapping
        How it came about.
    watch : callable
        Called with the seconds that have passed, now and then.

    Raises
    ------
    InputError
        The source has no bytes to tap.
    StorageError
        The disk is full; what was recorded before is safe.
    DeviceError
        The instrument failed; what came before is in the file.
    """
    if not isinstance(source, DecodedSource):
        raise InputError(
            f"{source.info.instrument}: comes from a file already, there is nothing to record"
        )
    head = make_head(source.codec, source.info, source.calibration, dict(provenance or {}))
    begin = monotonic()
    with source, contextlib.closing(RecordingWriter(path, head)) as writer:
        source.tap = writer.add
        fault = "interrupted"
        try:
            _drain_source(
                source, begin + seconds, lambda: (watch or _ignore_progress)(monotonic() - begin)
            )
            fault = ""
        except TofclipError as failure:
            fault = str(failure)
            raise
        finally:
            source.close()
            writer.finish(source.stats, fault)
        return RecordingSummary(monotonic() - begin, writer.bytes_flushed, source.stats)


def _drain_source(source: Source, deadline: float, report: Callable[[], None]) -> None:
    """Read until the deadline or the end, then stop the source and read what is left."""
    while (left := deadline - monotonic()) > 0:
        report()
        with contextlib.suppress(DeviceTimeoutError):
            if source.read(min(left, POLL_INTERVAL_S)) is None:
                return
    source.stop()
    while source.read() is not None:
        pass


def _ignore_progress(seconds: float) -> None:
    """Nobody watches."""
