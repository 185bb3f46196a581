"""The compiled product of a dense matrix in a processor's matrix registers (Intel AMX), to the
precision of float32.

A number of 24 digits is the sum of three of 8, which is what these registers multiply (bfloat16).
Of the nine products of two such sums the six largest are added up; the other three lie below the
last digit. On a core that has them six take half the time of one in float32
(2.3 instead of 4.6 ms for a matrix with 1,260 rows and columns and 256 operands).

Written down for the compiler, which does not use these registers by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from tofclip.compiling import ONE, compile_loop, inlined
from tofclip.vectors import LENGTH

BYTE, INDEX_TYPE = ir.IntType(8), ir.IntType(64)

PARTS = 3
TILE_ROWS, TILE_DEPTH = 16, 32
"""Rows of a tile, and products that one instruction adds to each sum."""
TILE_WORDS = TILE_ROWS * TILE_DEPTH // 2
"""Of 32 bits, two numbers each."""
TILE_LINE = INDEX_TYPE(4 * TILE_WORDS // TILE_ROWS)
"""Bytes of a tile's row."""
PANEL_TILES = 2
"""Tiles one above the other that are multiplied together."""
PANEL_ROWS = PANEL_TILES * TILE_ROWS
PAIRS = ((0, 2), (0, 1), (1, 1), (1, 0), (2, 0), (0, 0))
"""Parts of the matrix and of the operand that are multiplied, in an order that changes one at a
time and adds the smallest first within a depth."""

TWO, ROWS = np.uintp(2), np.uintp(TILE_ROWS)
HALF = np.uint32(16)

SUM_DEPTHS = 20
"""Depths of tiles that are added up in registers: of 256 frames they are 1 MiB of a core's
second-level cache."""


class _Registers:
    """Writes down what is done with the registers: four sums, two tiles of a panel, two of a block.

    `vectors`: one or two.
    """

    def __init__(self, builder: Any, vectors: int) -> None:
        self.builder, self.vectors = builder, vectors
        self.sums = [(row, vector) for row in range(PANEL_TILES) for vector in range(vectors)]

    def call(self, name: str, *operands: Any) -> None:
        """Call an instruction; registers are given by their numbers."""
        known = [ir.Constant(BYTE, one) if isinstance(one, int) else one for one in operands]
        kind = ir.FunctionType(ir.VoidType(), [one.type for one in known])
        module = self.builder.module
        self.builder.call(cgutils.get_or_insert_function(module, kind, f"llvm.x86.{name}"), known)

    def find_address(self, base: Any, *offsets: Any) -> Any:
        """Address of an entry, given the sum of its number's parts."""
        for offset in offsets:
            base = self.builder.gep(base, [offset])
        return self.builder.bitcast(base, BYTE.as_pointer())

    def move_sums(self, name: str, result: Any, place: Any, stride: Any) -> None:
        """Load or store all sums."""
        line = self.builder.mul(stride, INDEX_TYPE(4))
        for row, vector in self.sums:
            down = self.builder.mul(stride, INDEX_TYPE(TILE_ROWS * row))
            where = self.find_address(result, place, down, INDEX_TYPE(LENGTH * vector))
            self.call(name, 2 * row + vector, where, line)

    def clear_sums(self) -> None:
        """Set all sums to zero."""
        for row, vector in self.sums:
            self.call("tilezero", 2 * row + vector)

    def load_panel(self, part: int, panel: Any, depth: Any) -> None:
        """Load a part of the matrix, given where its depth begins."""
        for row in range(PANEL_TILES):
            away = INDEX_TYPE((part * PANEL_TILES + row) * TILE_WORDS)
            self.call("tileloadd64", 4 + row, self.find_address(panel, depth, away), TILE_LINE)

    def load_block(self, part: int, block: Any, depth: Any, plane: Any) -> None:
        """Load a part of the operands, given where the first vector's depth begins."""
        for vector in range(self.vectors):
            away = INDEX_TYPE(part * TILE_WORDS)
            behind = self.builder.mul(plane, INDEX_TYPE(vector))
            where = self.find_address(block, depth, behind, away)
            self.call("tileloadd64", 6 + vector, where, TILE_LINE)

    def add_products(self) -> None:
        """Add the products of what is loaded to the sums."""
        for row, vector in self.sums:
            self.call("tdpbf16ps", 2 * row + vector, 4 + row, 6 + vector)


def _make_tile_product(vectors: int) -> Any:
    """Make the product of a panel with some vectors of a packed block.

    `vectors`: one or two. Returns ``(shapes, panel, first, block, start, plane, result, place,
    stride, count, onto)``, for compiled loops: writes to `PANEL_ROWS` rows of `result`, `stride`
    apart, from entry `place` on, the products of `count` depths of the panel, from entry `first`
    on, with as many of the block; where `onto` says so they are added to what stands there. Of the
    block a vector's depths lie one behind the other from entry `start` on, the next vector's
    `plane` entries behind them. `shapes` is `TILE_SHAPES`. All arrays are flat.
    """

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        shapes, panel, block, result = (
            context.make_array(sig.args[k])(context, builder, arguments[k]).data
            for k in (0, 1, 3, 6)
        )
        first, start, plane, place, stride, count = (arguments[k] for k in (2, 4, 5, 7, 8, 9))
        registers = _Registers(builder, vectors)
        registers.call("ldtilecfg", registers.find_address(shapes))
        with builder.if_else(arguments[10]) as (add, begin):
            with add:
                registers.move_sums("tileloadd64", result, place, stride)
            with begin:
                registers.clear_sums()
        with cgutils.for_range(builder, count) as loop:
            own = builder.mul(loop.index, INDEX_TYPE(PARTS * PANEL_TILES * TILE_WORDS))
            theirs = builder.mul(loop.index, INDEX_TYPE(PARTS * TILE_WORDS))
            held = (-1, -1)
            for one, other in PAIRS:
                if one != held[0]:
                    registers.load_panel(one, panel, builder.add(first, own))
                if other != held[1]:
                    registers.load_block(other, block, builder.add(start, theirs), plane)
                registers.add_products()
                held = one, other
        registers.move_sums("tilestored64", result, place, stride)
        registers.call("tilerelease")
        return context.get_dummy_value()

    def emit(
        typing_context: Any,
        shapes: Any,
        panel: Any,
        first: Any,
        block: Any,
        start: Any,
        plane: Any,
        result: Any,
        place: Any,
        stride: Any,
        count: Any,
        onto: Any,
    ) -> Any:
        whole = types.int64
        return types.void(
            shapes, panel, whole, block, whole, whole, result, whole, whole, whole, types.boolean
        ), generate

    return intrinsic(emit)


TILE_SHAPES = np.zeros(64, np.uint8)
"""Eight registers of 16 rows of 64 bytes, as the processor wants to have it."""
TILE_SHAPES[0] = 1
TILE_SHAPES[16:32].view(np.uint16)[:] = 2 * TILE_DEPTH
TILE_SHAPES[48:56] = TILE_ROWS

_emit_wide_tile_product = _make_tile_product(2)
_emit_tile_product = _make_tile_product(1)


@compile_loop()
def split_lanes(lanes, parts):
    """Split numbers into parts of 8 digits, and put two rows' side by side.

    `lanes` (vectors, rows, LENGTH): an even number of rows; `parts` (vectors, depths, PARTS,
    TILE_ROWS, LENGTH): as far as there are rows. The even row's part is the lower half of a number,
    and the odd row's the upper one.
    """
    for vector in range(lanes.shape[0]):
        for pair in range(np.uintp(lanes.shape[1] // 2)):
            even, odd = lanes[vector, TWO * pair], lanes[vector, TWO * pair + ONE]
            target = parts[vector, pair // ROWS]
            high, middle, low = (
                target[0, pair % ROWS],
                target[1, pair % ROWS],
                target[2, pair % ROWS],
            )
            for lane in range(LENGTH):
                a, b, c = split_number(even[lane])
                d, e, f = split_number(odd[lane])
                high[lane] = a >> HALF | d
                middle[lane] = b >> HALF | e
                low[lane] = c >> HALF | f


@inlined
def split_number(value):
    """Return three bfloat16, in the upper halves of whole numbers, whose sum is a float32."""
    first = round_number(value)
    rest = value - np.uint32(first).view(np.float32)
    second = round_number(rest)
    return first, second, round_number(rest - np.uint32(second).view(np.float32))


@inlined
def round_number(value):
    """Round a float32 to 8 digits; return its bits."""
    return np.uint32(
        (np.float32(value).view(np.uint32) + np.uint32(0x8000)) & np.uint32(0xFFFF0000)
    )


@compile_loop()
def multiply_tiles(panels, block, before, result):
    """Multiply a matrix in panels of tiles with the vectors of a block.

    `panels` (panels, depths, PARTS, PANEL_TILES, TILE_ROWS, TILE_DEPTH // 2): each number holds two
    columns' parts, the even one's in its lower half; `block` (vectors, depths, PARTS, TILE_ROWS,
    LENGTH): of `split_lanes`; `before`: vectors of the result before those of the block; `result`
    (PANEL_ROWS * panels, lanes): overwritten in the lanes of the vectors.
    """
    depths, stride, vectors = panels.shape[1], result.shape[1], block.shape[0]
    matrix, target = panels.reshape(panels.size), result.reshape(result.size)
    lanes, own, theirs = (
        block.reshape(block.size),
        PARTS * PANEL_TILES * TILE_WORDS,
        PARTS * TILE_WORDS,
    )
    plane = depths * theirs
    for depth in range(0, depths, SUM_DEPTHS):
        count, onto = min(SUM_DEPTHS, depths - depth), depth > 0
        for panel in range(panels.shape[0]):
            first = (panel * depths + depth) * own
            place = panel * PANEL_ROWS * stride + before * LENGTH
            for vector in range(0, vectors - 1, 2):
                _emit_wide_tile_product(
                    TILE_SHAPES,
                    matrix,
                    first,
                    lanes,
                    vector * plane + depth * theirs,
                    plane,
                    target,
                    place + vector * LENGTH,
                    stride,
                    count,
                    onto,
                )
            if vectors % 2:
                vector = vectors - 1
                _emit_tile_product(
                    TILE_SHAPES,
                    matrix,
                    first,
                    lanes,
                    vector * plane + depth * theirs,
                    plane,
                    target,
                    place + vector * LENGTH,
                    stride,
                    count,
                    onto,
                )
