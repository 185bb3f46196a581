"""How fast and how well a source delivers."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from devices.ledger import Stats
from devices.ring import Piece
from devices.source import Batch, DecodedSource, Source
from tofclip.errors import DeviceTimeoutError, InputError

POLL_INTERVAL_S = 0.25
"""Seconds after which the clock is looked at, though nothing came."""


@dataclass(frozen=True)
class Throughput:
    """What came of reading a source for a while."""

    seconds: float  # until the source was stopped, or at its end
    # that were decoded in this time: as they came from the instrument, or the records' where a
    # source has no bytes
    bytes: int
    stats: Stats  # after everything that was left had been read and the source was closed

    @property
    def figures(self) -> dict[str, float]:
        """Everything by name, and the rate."""
        known = self.stats.as_dict()
        acquired = known.pop("acquired")
        rate = {"bytes_per_second": self.bytes / self.seconds, "records": acquired}
        return {"seconds": self.seconds, **rate, **known}


def measure_throughput(
    source: Source, seconds: float, watch: Callable[[float], None] = lambda _: None
) -> Throughput:
    """Read a source for some seconds or to its end, decode everything, and close it.

    `watch`: called with the seconds that have passed, now and then.
    """
    if not 0 < seconds < math.inf:
        raise InputError(f"a trial takes a positive, finite number of seconds, got {seconds:g}")
    meter = _ByteMeter()
    with source:
        meter.attach(source)
        begin = now = monotonic()
        while now < begin + seconds:
            watch(now - begin)
            with contextlib.suppress(DeviceTimeoutError):
                if meter.read(source, min(POLL_INTERVAL_S, begin + seconds - now)) is None:
                    break
            now = monotonic()
        # Measured before draining, whose bytes would flatter the rate.
        took, read = max(monotonic() - begin, 1e-9), meter.bytes
        source.stop()
        while source.read() is not None:
            pass
    return Throughput(took, read, source.stats)


class _ByteMeter:
    """Counts bytes: tapped where they are bytes, else those of the records."""

    def __init__(self) -> None:
        self.bytes = 0
        self._is_tapped = False

    def attach(self, source: Source) -> None:
        if isinstance(source, DecodedSource):
            self._is_tapped, source.tap = True, self._tap

    def read(self, source: Source, timeout: float) -> Batch | None:
        """Read a batch and count its bytes.

        `timeout`: seconds.
        """
        batch = source.read(timeout)
        if batch is not None and not self._is_tapped:
            self.bytes += batch.records.nbytes
        return batch

    def _tap(self, piece: Piece) -> None:
        self.bytes += len(piece.data)
