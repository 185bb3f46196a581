"""What tests of instruments share: reading a source, and emulated time taggers with other habits."""

from __future__ import annotations

from typing import Any

import numpy as np

from devices.emulation.timetag import (
    CLOCK_HZ,
    MAX_TICK,
    EmulatedTimeTagger,
    EmulationOptions,
    PoissonStream,
)
from devices.source import Batch, Records, Source, as_bytes
from devices.timetag_codec import TimeTagCodec
from tofclip.errors import DeviceTimeoutError

TAGS = TimeTagCodec()
KIND: dict[str, Any] = {
    "clear_is_level": False,
    "holds_packets": False,
    "stale_replies": 0,
    "old_records": 0,
    "jammed_bytes": 0,
}
"""Habits of the instrument that the first driver was written for."""


def make_tagger(
    base: type[EmulatedTimeTagger] = EmulatedTimeTagger, seed: int = 1, **unlike: Any
) -> EmulatedTimeTagger:
    """Return an emulated time tagger whose habits (attributes of its class) or options differ."""
    options = {name: unlike.pop(name) for name in list(unlike) if name in EmulationOptions.names()}
    rate = options.pop("rate", 1e6)
    kind = type("Tagger", (base,), unlike)
    light = lambda resets: PoissonStream(rate, CLOCK_HZ, seed + 100_000 * resets)  # noqa: E731
    made: EmulatedTimeTagger = kind(light, EmulationOptions(**options), "T1")
    return made


def true_records(seed: int, count: int, resets: int = 0, rate: float = 1e6) -> Records:
    """Return what a `make_tagger` sees after its counter was reset so often."""
    words = PoissonStream(rate, CLOCK_HZ, seed + 100_000 * resets).next_words(count, MAX_TICK)
    return TAGS.decode(as_bytes(words), TAGS.start).records


def take(source: Source, records: int) -> list[Any]:
    """Read so many records at least."""
    found: list[Any] = []
    while len(found) < records:
        batch = source.read(10)
        assert batch is not None
        found += list(batch.records)
    return found


def read_gaps(source: Source, records: int) -> list[bool]:
    """Read so many records; return of each batch whether something is missing before it."""
    gaps = []
    while source.stats.delivered < records:
        batch = source.read(10)
        assert batch is not None
        gaps.append(batch.after_gap)
    return gaps


def finish(source: Source) -> None:
    """Stop, read the rest and close; the accounts balance."""
    source.stop()
    while source.read(10) is not None:
        pass
    source.close()
    assert source.stats.is_balanced, source.stats
    assert source.stats.unread == 0


def read_until_dark(source: Source, patience: float = 0.3) -> list[Batch]:
    """Read until nothing more comes, then stop and read the rest."""
    found = []
    try:
        while (batch := source.read(patience)) is not None:
            found.append(batch)
    except DeviceTimeoutError:
        source.stop()
        found += list(source)
    return found


def joined(batches: list[Batch]) -> Any:
    """Return all time tags of batches."""
    return np.concatenate([np.empty(0, TAGS.dtype), *(batch.records for batch in batches)])
