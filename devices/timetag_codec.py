"""The record stream of the FX2 time tagger (S. V. Polyakov, B. Gamari; gateware and format are
public).

A record is 6 bytes, the highest first::

    bit 47      records were lost right before this one (the instrument's memory was full)
    bit 46      the counter is at zero: it has wrapped
    bit 45      0: strobe, the channels that saw an edge
                1: delta, the new levels of the delta channels
    bits 44-40  unused, zero
    bits 39-36  channels 3..0
    bits 35-0   the counter, in ticks of the instrument's clock

The counter wraps every 2**36 ticks (about nine minutes at 128 MHz), and the instrument sends a
record each time it is at zero, whether or not a channel saw anything, so that none is missed.

The compiled loops that read them are apart, so that their names do not load a compiler.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from devices.source import ByteView, Codec, DecodeResult, Records
from tofclip.errors import InputError, require

RECORD_BYTES = 6
TIME_BITS = 36
TIME_MASK = (1 << TIME_BITS) - 1
HALF_RANGE = 1 << (TIME_BITS - 1)
DELTA, WRAP, LOST = 1, 2, 4


COUNTER_RANGE = 1 << TIME_BITS  # Ticks after which the counter begins at zero again
CHANNEL_MASK = 0xF
FLAG_MASK = DELTA | WRAP | LOST

# `time_ticks`: since the counter was reset, wraps added up. `channels`: one bit each. `flags`:
# DELTA, WRAP, LOST.
RECORD_DTYPE = np.dtype([("time_ticks", np.int64), ("channels", np.uint32), ("flags", np.uint32)])


class CounterState(NamedTuple):
    """How often the counter has wrapped, and its last value."""

    epoch: int = 0
    counter: int = 0


class TimeTagCodec(Codec):
    """Bytes of the time tagger to records and back.

    A record is malformed if an unused bit is set, if it reports nothing (no channel, no wrap), or
    if the counter goes back although it has not wrapped. After a loss, a counter that went back by
    more than half its range has wrapped.

    Decoding allocates 16 bytes for each 6 of the stream.
    """

    name: ClassVar[str] = "timetag"
    start: ClassVar[CounterState] = CounterState()
    dtype = RECORD_DTYPE
    unit_bytes = RECORD_BYTES

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole records; after a loss the counter may have wrapped unseen."""
        from devices.timetag_kernels import decode_timetags

        words = self._view_units(data).ravel()
        records = np.empty(words.size // RECORD_BYTES, RECORD_DTYPE)
        columns = (records[name] for name in ("time_ticks", "channels", "flags"))
        kept, *position = decode_timetags(words, *state, after_loss, *columns)
        return DecodeResult(records[:kept], len(records) - kept, CounterState(*position))

    def encode(self, records: Records) -> bytes:
        self._require_records(records)
        _require_valid(records)
        return pack_words(records).tobytes()


def pack_words(records: Records) -> ByteView:
    """Return valid records as 6-byte words, the highest byte first, in one row."""
    ticks, channels, flags = (records[name].astype(np.uint64) for name in RECORD_DTYPE.names or ())
    words = flags << 45 | channels << 36 | ticks & TIME_MASK
    return words.astype(">u8").view(np.uint8).reshape(-1, 8)[:, -RECORD_BYTES:].ravel()


def mark_wraps(records: Records) -> Records:
    """Add the records that the instrument sends each time its counter wraps: one of flag WRAP at
    every multiple of `COUNTER_RANGE` ticks; a record that is already there gets the flag instead.
    """
    ticks = records["time_ticks"]
    if len(ticks) == 0:
        return records.copy()
    marked = records.copy()
    _, firsts = np.unique(ticks, return_index=True)
    # a record at counter zero carries the wrap itself; only wraps without one need a record more
    at_zero = firsts[(ticks[firsts] % COUNTER_RANGE == 0) & (ticks[firsts] > 0)]
    marked["flags"][at_zero] |= WRAP
    wraps = np.arange(1, int(ticks[-1]) // COUNTER_RANGE + 1, dtype=np.int64) * COUNTER_RANGE
    missing = np.setdiff1d(wraps, ticks[at_zero])
    markers = np.zeros(len(missing), RECORD_DTYPE)
    markers["time_ticks"], markers["flags"] = missing, WRAP
    return np.insert(marked, np.searchsorted(ticks, missing), markers)


def _require_valid(records: Records) -> None:
    """Refuse records that would not come back from `TimeTagCodec.decode` as they are."""
    ticks, channels, flags = (records[name] for name in RECORD_DTYPE.names or ())
    if np.any(channels > CHANNEL_MASK) or np.any(flags > FLAG_MASK):
        raise InputError("a time tag has 4 channels and 3 flags")
    require(not np.any((channels == 0) & (flags & (DELTA | WRAP) == 0)), "a strobe needs a channel")
    steps = np.diff(ticks, prepend=0)
    require(not (np.any(ticks < 0) or np.any(steps < 0)), "time tags must not go back")
    marked = flags & WRAP != 0
    # A decoder counts wraps by their records; after a loss it may infer one from a counter that
    # went back.
    wraps = np.diff(ticks >> TIME_BITS, prepend=0)
    counter = ticks & TIME_MASK
    skipped = (flags & LOST != 0) & (steps < COUNTER_RANGE // 2) & ~marked
    if np.any(wraps != np.where(skipped, np.minimum(wraps, 1), marked)) or np.any(
        marked & (counter != 0)
    ):
        raise InputError("each wrap of the counter needs a record of its own; mark_wraps adds them")
