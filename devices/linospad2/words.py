"""Layout of the words of LinoSPAD2's stream; see `devices.linospad2.codec` for what the bits mean.

Apart from the compiled loops that read them, so that their names do not load a compiler.
"""

from __future__ import annotations

import numpy as np

CONVERTERS = 65
PIXEL_CONVERTERS = 64
ADDRESSES = 4
CODE_MASK = np.uint32(0x0FFFFFFF)
VALID_BIT = np.uint32(0x80000000)

ENCODED_OK, OUT_OF_ORDER, OVERFULL, COUNTERS_DIFFER = 0, 1, 2, 3
"""Outcomes of encoding."""
