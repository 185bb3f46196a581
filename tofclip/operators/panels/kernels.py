"""The compiled product of a dense matrix in panels, a few rows at a time, with packed operands.

A block of the result stays in registers while sums are added up: the compiler does not find this by
itself, so that the block's loop is written down for it.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from tofclip.compiling import compile_loop
from tofclip.vectors import LENGTH, STEP, copy_transposed

INDEX_TYPE = ir.IntType(64)

PANEL_ROWS = 6
CPU_FEATURES = get_host_cpu_features() if config.CPU_FEATURES is None else config.CPU_FEATURES
PANEL_VECTORS = 4 if "+avx512f" in CPU_FEATURES else 1
"""Rows and vectors of a block of a dense product that is added up in registers: 24 of 32 for AVX-512;
elsewhere a vector of `LENGTH` lanes takes two registers or more, and 12 to 24 of them hold the rows'."""

SUM_LENGTH = 320
"""Products that are added up before the sum goes to memory: short sums keep their digits."""


def _make_panel_product(vectors: int) -> Any:
    """Make the product of a panel with some vectors of a packed block.

    Returns ``(panel, first, block, start, plane, result, place, stride, count)``, for compiled
    loops: adds to `PANEL_ROWS` rows of `result`, `stride` apart, from entry `place` on, the
    products of `count` columns of the panel, from entry `first` on, with as many rows of the block.
    Of the block a vector's rows lie side by side from entry `start` on, the next vector's `plane`
    entries behind them. All arrays are flat float32.
    """
    vector = ir.VectorType(ir.FloatType(), LENGTH)
    undefined, zero = ir.Constant(vector, ir.Undefined), ir.Constant(vector, [0.0] * LENGTH)
    selector = ir.Constant(ir.VectorType(ir.IntType(32), LENGTH), [0] * LENGTH)

    def generate(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        panel, block, result = (
            context.make_array(sig.args[k])(context, builder, arguments[k]).data for k in (0, 2, 5)
        )
        first, start, plane, place, stride, count = (arguments[k] for k in (1, 3, 4, 6, 7, 8))

        def away(base: Any, *offsets: Any) -> Any:
            for offset in offsets:
                base = builder.gep(base, [offset])
            return base

        def vector_at(base: Any, *offsets: Any) -> Any:
            return builder.bitcast(away(base, *offsets), vector.as_pointer())

        def add_product(one: Any, other: Any, total: Any) -> None:
            both = builder.fmul(one, other, flags=("contract",))
            builder.store(builder.fadd(both, builder.load(total), flags=("contract",)), total)

        totals = [
            [cgutils.alloca_once_value(builder, zero) for _ in range(vectors)]
            for _ in range(PANEL_ROWS)
        ]
        with cgutils.for_range(builder, count) as loop:
            row = builder.add(start, builder.mul(loop.index, INDEX_TYPE(LENGTH)))
            lanes = [
                builder.load(vector_at(block, row, builder.mul(plane, INDEX_TYPE(number))), align=4)
                for number in range(vectors)
            ]
            column = builder.add(first, builder.mul(loop.index, INDEX_TYPE(PANEL_ROWS)))
            for number, own in enumerate(totals):
                scalar = builder.load(away(panel, column, INDEX_TYPE(number)))
                lone = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
                weight = builder.shuffle_vector(lone, undefined, selector)
                for here, total in zip(lanes, own, strict=True):
                    add_product(weight, here, total)
        for number, vector_number in product(range(PANEL_ROWS), range(vectors)):
            row = builder.add(place, builder.mul(stride, INDEX_TYPE(number)))
            target = vector_at(result, row, INDEX_TYPE(LENGTH * vector_number))
            total = builder.load(totals[number][vector_number])
            builder.store(builder.fadd(total, builder.load(target, align=4)), target).align = 4
        return context.get_dummy_value()

    def emit(
        typing_context: Any,
        panel: Any,
        first: Any,
        block: Any,
        start: Any,
        plane: Any,
        result: Any,
        place: Any,
        stride: Any,
        count: Any,
    ) -> Any:
        whole = types.int64
        return types.void(panel, whole, block, whole, whole, result, whole, whole, whole), generate

    return intrinsic(emit)


_emit_wide_panel_product = _make_panel_product(PANEL_VECTORS)
_emit_panel_product = _make_panel_product(1)


@compile_loop()
def pack_lanes(rows, stretches, block):
    """Write some columns of the rows of an array as vectors of lanes, a row for each lane.

    `rows` (lanes, columns); `stretches` (n, 2): first column, and the one after the last, of
    neighbours that are taken; `block` (vectors, columns that are taken, LENGTH): lanes beyond the
    last row are zero.
    """
    source, target = rows.reshape(rows.size), block.reshape(block.size)
    width, taken = np.uintp(rows.shape[1]), np.uintp(block.shape[1])
    for vector in range(block.shape[0]):
        lanes = min(rows.shape[0] - vector * LENGTH, LENGTH)
        first, place = np.uintp(vector * LENGTH) * width, np.uintp(vector) * taken * STEP
        for k in range(stretches.shape[0]):
            column, end = np.uintp(stretches[k, 0]), np.uintp(stretches[k, 1])
            while column + STEP <= end and lanes == LENGTH:
                copy_transposed(source, first + column, width, target, place, STEP)
                column += STEP
                place += STEP * STEP
            while column < end:
                for lane in range(STEP):
                    inside = lane < np.uintp(lanes)
                    target[place + lane] = (
                        source[first + lane * width + column] if inside else np.float32(0)
                    )
                column += np.uintp(1)
                place += STEP


@compile_loop()
def multiply_panels(panels, block, before, result):
    """``result[PANEL_ROWS * p + r, LENGTH * (before + v) + j] = sum_k panels[p, k, r] * block[v, k, j]``.

    `panels` (panels, columns, PANEL_ROWS): A matrix, some rows at a time; `block` (vectors,
    columns, LENGTH): at most so many vectors that it stays in the second-level cache; `before`:
    vectors of the result before those of the block; `result` (PANEL_ROWS * panels, lanes):
    overwritten in the lanes of these vectors.
    """
    columns, stride, vectors = panels.shape[1], result.shape[1], block.shape[0]
    matrix, lanes = panels.reshape(panels.size), block.reshape(block.size)
    target, plane = result.reshape(result.size), columns * LENGTH
    for panel in range(panels.shape[0]):
        first = panel * columns * PANEL_ROWS
        place = panel * PANEL_ROWS * stride + before * LENGTH
        for row in range(panel * PANEL_ROWS, (panel + 1) * PANEL_ROWS):
            for lane in range(before * LENGTH, (before + vectors) * LENGTH):
                result[row, lane] = 0
        for column in range(0, columns, SUM_LENGTH):
            count, own = min(SUM_LENGTH, columns - column), first + column * PANEL_ROWS
            vector = 0
            while vector + PANEL_VECTORS <= vectors:
                start = vector * plane + column * LENGTH
                _emit_wide_panel_product(
                    matrix, own, lanes, start, plane, target, place + vector * LENGTH, stride, count
                )
                vector += PANEL_VECTORS
            while vector < vectors:
                start = vector * plane + column * LENGTH
                _emit_panel_product(
                    matrix, own, lanes, start, plane, target, place + vector * LENGTH, stride, count
                )
                vector += 1
