"""The product of a dense matrix that stays, in the matrix registers of processors that have them.

Of a matrix with 1,260 rows and columns and 256 operands it takes 0.55 times as long as
`tofclip.operators.panels.PanelMatrix`, and errs by half as much; for up to 16 operands the two take
alike. See `tofclip.operators.panels.tiles.kernels`.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import empty_aligned
from tofclip.operators.panels import PanelMatrix
from tofclip.threads import count_block_threads, run_blocks

FloatImage = NDArray[np.float32]

BLOCK_VECTORS = 16
"""Vectors that are multiplied at once: of 1,260 rows they are 1.9 MiB, of which half is in use at a
time."""

ARCH_PRCTL, REQUEST_STATE, TILE_STATE = 158, 0x1023, 18
"""Numbers of Linux on x86-64: a system call, what is asked of it, and the registers' state."""


@cache
def request_tile_registers() -> bool:
    """Ask for the processor's matrix registers; Linux gives them to processes that do, and to all
    threads of theirs.

    Returns whether compiled loops may use them.
    """
    # the compiler takes as long to import as all else
    from tofclip.operators.panels.kernels import CPU_FEATURES

    if sys.platform != "linux" or not {"+amx-tile", "+amx-bf16"} <= set(CPU_FEATURES.split(",")):
        return False
    system_call = ctypes.CDLL(None).syscall
    return bool(
        system_call(*(ctypes.c_long(k) for k in (ARCH_PRCTL, REQUEST_STATE, TILE_STATE))) == 0
    )


def arrange_matrix(matrix: FloatImage) -> PanelMatrix | TileMatrix:
    """Put a matrix into the order in which it is multiplied fastest on this computer."""
    return TileMatrix(matrix) if request_tile_registers() else PanelMatrix(matrix)


class TileMatrix:
    """A matrix in tiles of three parts, whose numbers have 8 digits each.

    `matrix` (rows, columns): finite.

    Memory: one and a half times the matrix, which is held on to as well.
    """

    def __init__(self, matrix: FloatImage) -> None:
        from tofclip.operators.panels.tiles.kernels import (
            PANEL_ROWS,
            PANEL_TILES,
            PARTS,
            TILE_DEPTH,
            TILE_ROWS,
            split_lanes,
        )

        if not request_tile_registers():  # the first instruction would end the process
            raise RuntimeError("this process may not use the processor's matrix registers")
        self.shape, self._matrix = matrix.shape, matrix
        rows, columns = matrix.shape
        number, depths = -(-rows // PANEL_ROWS), max(1, -(-columns // TILE_DEPTH))
        # Operands have rows two by two, a matrix has columns so: it is split as its transpose.
        tiles = number * PANEL_TILES
        lanes = np.zeros((tiles, TILE_ROWS, depths * TILE_DEPTH), np.float32)
        lanes.reshape(-1, depths * TILE_DEPTH)[:rows, :columns] = matrix
        parts = np.empty((tiles, depths, PARTS, TILE_DEPTH // 2, TILE_ROWS), np.uint32)
        split_lanes(np.ascontiguousarray(lanes.transpose(0, 2, 1)), parts)
        shape = number, depths, PARTS, PANEL_TILES, TILE_ROWS, TILE_DEPTH // 2
        self._panels: NDArray[np.uint32] = empty_aligned(shape, np.uint32)
        self._panels[:] = parts.reshape(
            number, PANEL_TILES, depths, PARTS, TILE_DEPTH // 2, TILE_ROWS
        ).transpose(0, 2, 3, 1, 5, 4)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[FloatImage]]:
        """Arranged anew where it arrives, which may be a computer without such registers."""
        return arrange_matrix, (self._matrix,)

    def multiply(self, operand: FloatImage, stretches: NDArray[np.int64], width: int) -> FloatImage:
        """Multiply with some rows of an operand; see `PanelMatrix.multiply`."""
        from tofclip.operators.panels.kernels import pack_lanes
        from tofclip.operators.panels.tiles.kernels import (
            PANEL_ROWS,
            PARTS,
            TILE_DEPTH,
            split_lanes,
        )
        from tofclip.vectors import LENGTH

        rows = np.ascontiguousarray(operand.T, np.float32)
        number, depths = self._panels.shape[:2]
        vectors, columns = -(-len(rows) // LENGTH), self.shape[1]
        lanes = empty_aligned((1, columns + columns % 2, LENGTH), np.float32)
        lanes[:, columns:] = 0
        result: FloatImage = empty_aligned((number * PANEL_ROWS, width), np.float32)
        result[:, vectors * LENGTH :] = 0
        for first in range(0, vectors, BLOCK_VECTORS):
            held = min(BLOCK_VECTORS, vectors - first)
            block = empty_aligned((held, depths, PARTS, TILE_DEPTH // 2, LENGTH), np.uint32)
            block[:, -1] = 0
            for place in range(held):  # one at a time, which stays in cache
                frame = (first + place) * LENGTH
                pack_lanes(rows[frame : frame + LENGTH], stretches, lanes)
                split_lanes(lanes, block[place : place + 1])
            self._multiply_block(block, first, result)
        return result[: self.shape[0]]

    def _multiply_block(self, block: NDArray[np.uint32], first: int, result: FloatImage) -> None:
        """Write the products with the vectors of a block, the first of which is number `first`."""
        from tofclip.operators.panels.tiles.kernels import PANEL_ROWS, multiply_tiles

        number = len(self._panels)

        def work(piece: slice) -> None:
            own = result[piece.start * PANEL_ROWS : piece.stop * PANEL_ROWS]
            multiply_tiles(self._panels[piece], block, first, own)

        run_blocks(work, number, max(1, -(-number // count_block_threads())))
