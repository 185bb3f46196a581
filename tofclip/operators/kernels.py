"""Compiled inner loops of the operators.

The sparse product: a plain numba loop over the lanes of a block re-reads and re-writes the
accumulator for every nonzero, because the compiler cannot know that the arrays do not overlap. Here
the accumulator is a vector value that lives in registers: it makes the product two to three times
faster than scipy's on the sizes of a streak image.

Line projections of a lone picture need no matrix at all: where a pixel falls is computed in less
time than it would take to read it from memory. Positions are whole numbers of 2^-32 pixels, so that
both directions share every pixel alike to the last bit.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from tofclip.compiling import SUMS_AS_WRITTEN, compile_as_part, compile_loop, inlined
from tofclip.operators.sparse import FRACTION_BITS
from tofclip.threads import LANES

INDEX_TYPE = ir.IntType(64)


def _make_rows_product(lanes, unroll):
    """Make the product of a sparse matrix with some lanes of a block, for compiled loops; `unroll`
    accumulators for each lane hide the latency of the fused multiply-add.
    """

    def generate(context, builder, sig, arguments):
        def data(k):
            return context.make_array(sig.args[k])(context, builder, arguments[k]).data

        target, source, index, weight = data(0), data(3), data(4), data(5)
        offset, row_length, begin, end = (arguments[k] for k in (1, 2, 6, 7))
        vector = ir.VectorType(target.type.pointee, lanes)
        selector = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
        undefined = ir.Constant(vector, ir.Undefined)

        def lanes_at(base, place):
            return builder.bitcast(builder.gep(base, [place]), vector.as_pointer())

        def accumulate(position, accumulator):
            column = builder.zext(builder.load(builder.gep(index, [position])), INDEX_TYPE)
            scalar = builder.load(builder.gep(weight, [position]))
            lone = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
            broadcast = builder.shuffle_vector(lone, undefined, selector)
            operand = lanes_at(source, builder.mul(column, row_length))
            product = builder.fmul(broadcast, builder.load(operand, align=4), flags=("contract",))
            total = builder.fadd(product, builder.load(accumulator), flags=("contract",))
            builder.store(total, accumulator)

        destination = lanes_at(target, offset)
        zero = ir.Constant(vector, [0.0] * lanes)
        present = builder.select(arguments[8], builder.load(destination, align=4), zero)
        starts = [present] + [zero] * (unroll - 1)
        accumulators = [cgutils.alloca_once_value(builder, start) for start in starts]
        position = cgutils.alloca_once_value(builder, begin)
        for step in sorted({unroll, 1}, reverse=True):
            head, body, after = map(builder.append_basic_block, ("head", "body", "after"))
            builder.branch(head)
            builder.position_at_end(head)
            here = builder.load(position)
            next_one = builder.add(here, INDEX_TYPE(step))
            builder.cbranch(builder.icmp_signed("<=", next_one, end), body, after)
            builder.position_at_end(body)
            for number in range(step):
                accumulate(builder.add(here, INDEX_TYPE(number)), accumulators[number])
            builder.store(next_one, position)
            builder.branch(head)
            builder.position_at_end(after)
        total = builder.load(accumulators[0])
        for accumulator in accumulators[1:]:
            total = builder.fadd(total, builder.load(accumulator))
        builder.store(total, destination).align = 4
        return context.get_dummy_value()

    @intrinsic
    def add_row_product(typing, result, start, stride, block, columns, values, first, last, onto):
        """``result[start : start + lanes] = present + sum_q values[q] * block[columns[q], :lanes]``
        for q in [first, last), `result` flat and `stride` the distance of two rows of the block.
        `present` is 0, or what stands there already where the boolean `onto` says so.
        """
        given = result, start, stride, block, columns, values, first, last, onto
        return types.void(*given), generate

    @compile_as_part()
    def multiply(tile_starts, columns, values, block, first, result, place):
        """``result[:, place + j] = (M @ block)[:, first + j]`` for all lanes j and a sparse matrix
        M in column tiles; see `tofclip.operators.sparse.Tiles`. Rows of the block that begin at
        whole cache lines are read 1.6 times as fast; see `tofclip.arrays.empty_aligned`.
        """
        lanes, stride = block[:, first:], block.shape[1]
        for tile in range(tile_starts.shape[0]):
            # the first tile overwrites the result, the others add to it
            onto = tile > 0
            for row in range(tile_starts.shape[1] - 1):
                begin, end = tile_starts[tile, row], tile_starts[tile, row + 1]
                if begin < end or not onto:
                    target = row * result.shape[1] + place
                    add_row_product(
                        result, target, stride, lanes, columns, values, begin, end, onto
                    )

    return multiply


multiply_sparse_rows = _make_rows_product(LANES, 2)
# A nonzero is looked up once for as many lanes, which takes a fifth less time; there are enough sums
# that do not wait for each other.
WIDE_LANES = 4 * LANES
multiply_sparse_wide_rows = _make_rows_product(WIDE_LANES, 1)


@compile_loop()
def multiply_sparse_block(tile_starts, columns, values, block, result):
    """``result = M @ block`` for a block of `LANES` frames."""
    multiply_sparse_rows(tile_starts, columns, values, block, 0, result, 0)


fast_loop = compile_loop(fastmath=SUMS_AS_WRITTEN)

FRACTION_MASK = (1 << FRACTION_BITS) - 1


@inlined
def _deposit_light(line, position, light, light_step):
    """Share light between the bin of `position`, column 0, and the next one, column 1 there."""
    first = np.uint64(position >> FRACTION_BITS)
    # The rest, not a product of its own: together the two are the light that came.
    beyond = line.dtype.type(position & FRACTION_MASK) * light_step
    line[first, 0] += light - beyond
    line[first, 1] += beyond


@fast_loop
def project_onto_lines(picture, starts, rightward, downward, lines):
    """Project a (rows, columns) picture onto lines; adds to `lines`, (lines, bins, 2), which
    `_deposit_light` explains. `starts`, `rightward` and `downward`, (lines,) int64, are the
    position of the first pixel and the steps from pixel to pixel in units of 2^-32 bins; every
    position and the next bin must lie on the line. Two lines at a time keep the processor busy
    while a sum is on its way to memory.
    """
    # Light times 2^-32: the fraction stays a whole number until it is multiplied once.
    step = picture.dtype.type(1 / (1 << FRACTION_BITS))
    pairs = starts.size // 2
    for one in range(0, 2 * pairs, 2):
        other = one + 1
        line, next_line = lines[one], lines[other]
        right, next_right = rightward[one], rightward[other]
        for row in range(picture.shape[0]):
            here = starts[one] + row * downward[one]
            there = starts[other] + row * downward[other]
            for column in range(picture.shape[1]):
                light = picture[row, column]
                _deposit_light(line, here + column * right, light, light * step)
                _deposit_light(next_line, there + column * next_right, light, light * step)
    for last in range(2 * pairs, starts.size):
        line, right = lines[last], rightward[last]
        for row in range(picture.shape[0]):
            here = starts[last] + row * downward[last]
            for column in range(picture.shape[1]):
                light = picture[row, column]
                _deposit_light(line, here + column * right, light, light * step)


@fast_loop
def back_project_lines(lines, starts, rightward, downward, picture):
    """The adjoint of `project_onto_lines`, for lines of one value a bin; overwrites `picture`."""
    step = picture.dtype.type(1 / (1 << FRACTION_BITS))
    for row in range(picture.shape[0]):
        picture[row] = 0
        for number in range(starts.size):
            start, right = starts[number] + row * downward[number], rightward[number]
            line = lines[number]
            for column in range(picture.shape[1]):
                position = start + column * right
                first = np.uint64(position >> FRACTION_BITS)
                share = line.dtype.type(position & FRACTION_MASK) * step
                # interpolation between two bins is the transpose of sharing light between them
                picture[row, column] += line[first] + share * (
                    line[first + np.uint64(1)] - line[first]
                )


@fast_loop
def transform_walsh_hadamard(values):
    """Multiply (n, columns) values by Sylvester's Hadamard matrix of n = 2^k rows, in place."""
    count, columns = values.shape
    half = 1
    while 2 * half < count:
        # two levels of the butterfly at once: half as many passes through memory
        for start in range(0, count, 4 * half):
            for row in range(start, start + half):
                for column in range(columns):
                    a, b = values[row, column], values[row + half, column]
                    c, d = values[row + 2 * half, column], values[row + 3 * half, column]
                    values[row, column] = (a + b) + (c + d)
                    values[row + half, column] = (a - b) + (c - d)
                    values[row + 2 * half, column] = (a + b) - (c + d)
                    values[row + 3 * half, column] = (a - b) - (c - d)
        half *= 4
    if half < count:  # an odd number of levels leaves one
        for row in range(half):
            for column in range(columns):
                a, b = values[row, column], values[row + half, column]
                values[row, column] = a + b
                values[row + half, column] = a - b


@compile_loop(fastmath=SUMS_AS_WRITTEN, _nrt=True)
def shift_linearly(block, down, right, below, beside, shifted):
    """Shift a (rows, columns, lanes) block by ``down + below`` rows and ``right + beside`` columns;
    dark beyond. `below` and `beside` are the shares of the next row and column, from 0 to 1.
    """
    rows, columns, lanes = block.shape
    length, whole = columns * lanes, block.dtype.type(1)
    between, black = np.empty(length, block.dtype), np.zeros(length, block.dtype)
    near, far = right * lanes, (right + 1) * lanes
    for row in range(rows):
        upper, lower = row - down, row - down - 1
        first = block[upper].reshape(length) if 0 <= upper < rows else black
        second = block[lower].reshape(length) if 0 <= lower < rows else black
        # bilinear interpolation is separable: rows first, then columns
        for place in range(length):
            between[place] = (whole - below) * first[place] + below * second[place]
        target = shifted[row].reshape(length)
        target[:] = 0
        for offset, weight in ((near, whole - beside), (far, beside)):
            begin, end = max(offset, 0), min(length, length + offset)
            if begin < end:
                lit, source = target[begin:end], between[begin - offset : end - offset]
                for place in range(end - begin):
                    lit[place] += weight * source[place]
