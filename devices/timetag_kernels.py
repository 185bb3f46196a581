"""Compiled loops over the words of the time tagger's stream, and those that make them for its
emulation; see `devices.timetag_codec` for what the bits mean.
"""

from __future__ import annotations

import math

import numpy as np

from devices.timetag_codec import (
    DELTA,
    HALF_RANGE,
    LOST,
    RECORD_BYTES,
    TIME_BITS,
    TIME_MASK,
    WRAP,
)
from tofclip.compiling import compile_and_keep

compiled = compile_and_keep(error_model="numpy")

# The 53 upper bits of a word fill the mantissa of a double.
_DOUBLE_STEP = 2.0**-53


@compiled
def decode_timetags(data, epoch, previous, after_loss, ticks, channels, flags):
    """Decode 6-byte words into three arrays. Returns how many records were written (all other words
    are malformed), how often the counter has wrapped, and its last value.
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
            # The counter was at zero: the word says so itself, or its time is below the last one's.
            good = time == 0 or time < previous
            epoch += good
        elif good and time < previous:
            # Time falls only where words were lost, the wrap's among them, and then by more than
            # half the range; a smaller fall is a damaged word.
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
def _next_random(state):
    """One step of splitmix64 (Steele, Lea, Flood, OOPSLA 2014): new state, 64 random bits."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    mixed = state
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state, mixed ^ (mixed >> np.uint64(31))


@compiled
def fill_poisson_words(state, now, scale, last, words):
    """Write the words of photons that arrive at random on four channels, one at most per tick, none
    later than tick `last`; return how many. `state` of the random numbers and `now`, tick of the
    last record, change in place; `scale`: of the exponential distribution of which the whole part
    is the number of ticks between two photons.
    """
    written = 0
    while written < words.size // RECORD_BYTES:
        after, bits = _next_random(state[0])
        # One is added before the logarithm, which zero would not have.
        gap = -math.log(((bits >> np.uint64(11)) + np.uint64(1)) * _DOUBLE_STEP) * scale
        tick = now[0] + 1 + np.int64(gap)
        after, bits = _next_random(after)
        wrap = ((now[0] >> TIME_BITS) + 1) << TIME_BITS
        # The counter wraps unless the photon comes first.
        lines, kind = np.int64(1) << np.int64(bits >> np.uint64(62)), 0
        if tick >= wrap:
            lines, kind, tick, after = np.int64(0), WRAP, wrap, state[0]
        # State is not advanced: the next call draws this record again.
        if tick > last:
            break
        state[0], now[0] = after, tick
        at = written * RECORD_BYTES
        time = tick & TIME_MASK
        # Six bytes, the highest first; see devices.timetag_codec.
        words[at] = kind << 5
        words[at + 1] = (lines << 4) | (time >> 32)
        words[at + 2] = (time >> 24) & 0xFF
        words[at + 3] = (time >> 16) & 0xFF
        words[at + 4] = (time >> 8) & 0xFF
        words[at + 5] = time & 0xFF
        written += 1
    return written
