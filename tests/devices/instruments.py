"""What tests of instruments share: reading a source, a feed that repeats itself, and emulated time
taggers with other habits.
"""

from time import monotonic, sleep

import numpy as np
import pytest

import devices
from devices.emulation.timetag import (
    CLOCK_HZ,
    MAX_TICK,
    EmulatedTimeTagger,
    EmulationOptions,
    PoissonStream,
)
from devices.source import Info, Ledger, as_bytes
from devices.stream import Transfer
from devices.timetag_codec import TimeTagCodec
from tofclip.errors import DeviceTimeoutError, InputError

TAGS = TimeTagCodec()


def make_tagger(base=EmulatedTimeTagger, seed=1, **unlike):
    """Return an emulated time tagger whose habits (attributes of its class) or options differ."""
    options = {name: unlike.pop(name) for name in list(unlike) if name in EmulationOptions.names()}
    rate = options.pop("rate", 1e6)
    light = lambda resets: PoissonStream(rate, CLOCK_HZ, seed + 100_000 * resets)  # noqa: E731
    return type("Tagger", (base,), unlike)(light, EmulationOptions(**options), "T1")


def true_records(seed, count, resets=0, rate=1e6):
    """Return what a `make_tagger` sees after its counter was reset so often."""
    words = PoissonStream(rate, CLOCK_HZ, seed + 100_000 * resets).next_words(count, MAX_TICK)
    return TAGS.decode(as_bytes(words), TAGS.start).records


class RepeatingFeed:
    """Pieces as they are made of their numbers, so many, and each not before it is due."""

    info, calibration = Info("pieces"), None

    def __init__(self, codec, make, pieces, interval=0.0):
        self.codec, self.ledger = codec, Ledger()
        self._make, self._pieces, self._interval, self._number = make, pieces, interval, 0

    def start(self):
        self._began = monotonic()

    def pull(self, timeout):
        if self._number >= self._pieces:
            return None
        self._number += 1
        sleep(max(0.0, self._began + self._number * self._interval - monotonic()))
        return Transfer(memoryview(self._make(self._number - 1)), taken_at=monotonic())

    def stop(self):
        self._pieces = 0

    def close(self):
        """Hold nothing."""


def refuse(address, said, error=InputError):
    """Require that an address is not opened, and what is said of it (a regular expression)."""
    with pytest.raises(error, match=said):
        devices.open(address)


def take(source, records):
    """Read so many records at least."""
    found = []
    while len(found) < records:
        batch = source.read(10)
        assert batch is not None
        found += list(batch.records)
    return found


def read_gaps(source, records):
    """Read so many records; return of each batch whether something is missing before it."""
    gaps = []
    while source.stats.delivered < records:
        batch = source.read(10)
        assert batch is not None
        gaps.append(batch.after_gap)
    return gaps


def finish(source):
    """Stop, read the rest and close; the accounts balance."""
    source.drain()
    source.close()
    assert source.stats.is_balanced, source.stats
    assert source.stats.unread == 0


def read_until_dark(source, patience=0.3):
    """Read until nothing more comes, then stop and read the rest."""
    found = []
    try:
        while (batch := source.read(patience)) is not None:
            found.append(batch)
    except DeviceTimeoutError:
        source.stop()
        found += list(source)
    return found


def joined(batches):
    """Return all time tags of batches."""
    return np.concatenate([np.empty(0, TAGS.dtype), *(batch.records for batch in batches)])
