"""Compiled loops over the words of LinoSPAD2's stream, and their layout; see `devices.linospad2` for
what the bits mean.
"""

from __future__ import annotations

import numpy as np

from tofclip.compiling import compile_and_keep

CONVERTERS = 65
PIXEL_CONVERTERS = 64
ADDRESSES = 4
CODE_MASK = np.uint32(0x0FFFFFFF)
VALID_BIT = np.uint32(0x80000000)

compiled = compile_and_keep(error_model="numpy")


@compiled
def count_stamps(cycles, header, kept_of_cycle):
    """Count the valid words of the converters that have pixels, for each cycle (cycles, words) with
    `header` words before the first converter's; return those of the converter that has none.
    """
    words = cycles.shape[1]
    # the last converter serves no pixels
    stray = words - (words - header) // CONVERTERS
    strays = 0
    for cycle in range(cycles.shape[0]):
        kept = 0
        for word in range(header, stray):
            # bit 31 says that the word holds a time stamp
            kept += cycles[cycle, word] >> np.uint32(31)
        kept_of_cycle[cycle] = kept
        for word in range(stray, words):
            strays += cycles[cycle, word] >> np.uint32(31)
    return strays


@compiled
def decode_stamps(cycles, header, first_cycle, pixel_of, records):
    """Write the valid words of all converters that have pixels, as rows of `records`.

    Every word is written to the next free row, and only a valid one moves on to the row behind it:
    no branch that the processor could guess wrong. It ends with the last row, behind which there
    are not valid words. A row gets header, cycle, code and pixel.
    """
    depth = (cycles.shape[1] - header) // CONVERTERS
    row = 0
    for cycle in range(cycles.shape[0]):
        words = cycles[cycle]
        number = np.uint32(first_cycle + cycle)
        for converter in range(PIXEL_CONVERTERS):
            pixels = pixel_of[converter]
            begin = header + converter * depth
            for place in range(begin, begin + depth):
                if row == records.shape[0]:
                    return
                word = words[place]
                for column in range(header):
                    records[row, column] = words[column]
                records[row, header] = number
                records[row, header + 1] = word & CODE_MASK
                records[row, header + 2] = pixels[(word >> np.uint32(28)) & np.uint32(3)]
                # every word is written, and the next one overwrites it if it was not valid: no
                # branch
                row += word >> np.uint32(31)
