"""Sums of successive rectified rows, in one look at a raw streak image.

Of most shots few rows hold light. To find them, sums over a pulse's length do, for which no
rectified picture has to be written and read again; nor need the dark level be known beforehand,
which takes a look at all rows as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.camera.measurement import NO_LIGHT_MESSAGE, Rectifier, estimate_dark_level
from tofclip.errors import InputError
from tofclip.threads import LANES, count_block_threads, run_blocks


class RowSums:
    """What stays the same from shot to shot in sums of rectified rows.

    `starts` (sums,): first row of each sum; a multiple of `LANES` of them; `length`: rows of a sum.

    Memory: as much as the sums.
    """

    def __init__(self, rectifier: Rectifier, starts: NDArray[np.int64], length: int) -> None:
        self._rectifier, self._starts, self._length = rectifier, starts, length
        inside = np.pad(np.cumsum(rectifier.inside, axis=0, dtype=np.uint16), ((1, 0), (0, 0)))
        # how many rows of each sum lie within the raw image; differences are right beyond 65,535 too
        measured = (inside[starts + length] - inside[starts]).T
        self._measured = np.ascontiguousarray(measured, np.float32)
        self._measured[rectifier.camera.dead_columns] = 0

    def add_up(self, counts: NDArray[np.float32], sums: NDArray[np.float32]) -> float:
        """Add up the rows of a shot; return its dark level.

        `counts` (rows, columns): raw streak image; `sums` (columns, at least sums): overwritten as
        far as there are sums: of measurements, without the dark level; 0 where nothing was
        measured. Returns counts.
        """
        # the compiler takes as long to import as all else
        from tofclip.camera.kernels import subtract_dark_level

        number, threads = self._starts.size, count_block_threads()
        lanes = -(-number // (threads * LANES)) * LANES
        row_sums = self._rectifier.sum_rows(counts, self._starts, self._length, lanes, sums)
        dark = estimate_dark_level(counts, row_sums)
        lit = np.zeros(self._measured.shape[0], bool)
        run_blocks(
            lambda piece: subtract_dark_level(
                self._measured[piece], np.float32(dark), sums[piece], lit[piece]
            ),
            lit.size,
            -(-lit.size // threads),
        )
        if not lit.any():
            raise InputError(NO_LIGHT_MESSAGE)
        return dark
