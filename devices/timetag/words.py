"""Layout of the words of the time tagger's stream; see `devices.timetag.codec` for what the bits mean.

Apart from the compiled loops that read them, so that their names do not load a compiler.
"""

from __future__ import annotations

RECORD_BYTES = 6
TIME_BITS = 36
TIME_MASK = (1 << TIME_BITS) - 1
HALF_RANGE = 1 << (TIME_BITS - 1)
DELTA, WRAP, LOST = 1, 2, 4
