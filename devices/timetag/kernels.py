"""Compiled loops over the words of the time tagger's stream; see `devices.timetag.codec` for what
the bits mean.
"""

from __future__ import annotations

import numpy as np
from numba import njit

compiled = njit(nogil=True, cache=True, error_model="numpy")

RECORD_BYTES = 6
TIME_BITS = 36
TIME_MASK = (1 << TIME_BITS) - 1
HALF_RANGE = 1 << (TIME_BITS - 1)
DELTA, WRAP, LOST = 1, 2, 4


@compiled
def decode_timetags(data, epoch, previous, after_loss, ticks, channels, flags):
    """Decode the 6-byte words in `data` (bytes) into three arrays; see `TimeTagCodec.decode`.

    Parameters
    ----------
    data : (bytes,) uint8 array
    epoch, previous : int
        State of the counter.
    after_loss : bool
    ticks : (words,) int64 array
        Overwritten.
    channels, flags : (words,) array
        Overwritten.

    Returns
    -------
    kept : int
        Records written; all other words are malformed.
    epoch, previous : int
        How often the counter has wrapped, and its last value.
    """
    kept = 0
    expects_loss = after_loss
    for word in range(data.size // RECORD_BYTES):
        at = word * RECORD_BYTES
        high = (np.int64(data[at]) << 8) | np.int64(data[at + 1])
        low = (
            (np.int64(data[at + 2]) << 24)
            | (np.int64(data[at + 3]) << 16)
            | (np.int64(data[at + 4]) << 8)
            | np.int64(data[at + 5])
        )
        time = ((high & 0xF) << 32) | low
        lines = (high >> 4) & 0xF
        kind = high >> 13
        good = (high & 0x1F00) == 0 and (lines != 0 or kind & (DELTA | WRAP) != 0)
        if good and kind & WRAP:
            good = time == 0 or time < previous
            epoch += good
        elif good and time < previous:
            good = (kind & LOST != 0 or expects_loss) and previous - time > HALF_RANGE
            epoch += good
            previous = time  # one wrong word must not make all that follow look wrong
        if good:
            ticks[kept] = (epoch << TIME_BITS) | time
            channels[kept] = lines
            flags[kept] = kind
            kept += 1
            previous = time
            expects_loss = False
    return kept, epoch, previous


@compiled
def encode_timetags(ticks, channels, flags, data):
    """Write records as 6-byte words, the highest byte first.

    Parameters
    ----------
    ticks, channels, flags : (records,) array
    data : (6 * records,) uint8 array
        Overwritten.
    """
    for number in range(ticks.size):
        time = ticks[number] & TIME_MASK
        at = number * RECORD_BYTES
        data[at] = flags[number] << 5
        data[at + 1] = (channels[number] << 4) | (time >> 32)
        data[at + 2] = (time >> 24) & 0xFF
        data[at + 3] = (time >> 16) & 0xFF
        data[at + 4] = (time >> 8) & 0xFF
        data[at + 5] = time & 0xFF
