"""The product of a dense matrix that stays with operands that come again and again.

A BLAS puts both of its operands into an order of its own at every call, which for a few hundred
columns takes a fifth of the time. Here the matrix is put into it once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import empty_aligned
from tofclip.threads import count_block_threads, run_blocks

FloatImage = NDArray[np.float32]

BLOCK_VECTORS = 16
"""Vectors of a block that is multiplied at once: 1,344 rows of them are 1.3 MiB of a core's
second-level cache."""


class PanelMatrix:
    """A matrix in panels: a few rows at a time, all their entries in a column side by side.

    `matrix` (rows, columns).
    """

    def __init__(self, matrix: FloatImage) -> None:
        # the compiler takes as long to import as all else
        from tofclip.operators.panels.kernels import PANEL_ROWS

        self.shape = matrix.shape
        rows, columns = matrix.shape
        number = -(-rows // PANEL_ROWS)
        padded = np.zeros((number * PANEL_ROWS, columns), np.float32)
        padded[:rows] = matrix
        self._panels: FloatImage = empty_aligned((number, columns, PANEL_ROWS), np.float32)
        self._panels[:] = padded.reshape(number, PANEL_ROWS, columns).transpose(0, 2, 1)

    def multiply(self, operand: FloatImage, stretches: NDArray[np.int64], width: int) -> FloatImage:
        """Multiply with some rows of an operand.

        `operand` (all rows, frames): cheapest where a frame's numbers lie side by side; `stretches`
        (n, 2): first row, and the one after the last, of neighbours that are taken; as many rows in
        all as the matrix has columns; `width`: of the result, not less than the frames and a
        multiple of 16. Returns (matrix's rows, width): aligned, with zeros behind the frames.
        """
        from tofclip.operators.panels.kernels import multiply_panels, pack_lanes
        from tofclip.vectors import LENGTH

        rows = np.ascontiguousarray(operand.T, np.float32)
        number, columns, panel_rows = self._panels.shape
        result: FloatImage = empty_aligned((number * panel_rows, width), np.float32)
        vectors = -(-len(rows) // LENGTH)
        result[:, vectors * LENGTH :] = 0
        block = empty_aligned((vectors, columns, LENGTH), np.float32)
        pack_lanes(rows, stretches, block)

        def work(piece: slice) -> None:
            for first in range(0, vectors, BLOCK_VECTORS):
                own = result[piece.start * panel_rows : piece.stop * panel_rows]
                multiply_panels(
                    self._panels[piece], block[first : first + BLOCK_VECTORS], first, own
                )

        run_blocks(work, number, max(1, -(-number // count_block_threads())))
        return result[: self.shape[0]]
