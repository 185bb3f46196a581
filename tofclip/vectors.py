"""Sixteen numbers at once in compiled loops.

The compiler finds vectors by itself in long loops over bins of an array. In short ones, of which
the search for returns consists (a pulse is a dozen bins long), it finds none, or shuffles more than
it computes. Here they are written down: a `Vector` value is what a vector register holds, or
several of them on a processor whose registers are shorter. It exists in compiled code only.

`load_vector` and `store_vector` do not check that the array holds all lanes.
"""

from __future__ import annotations

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LENGTH = 16  # lanes of a vector: 64 bytes of float32
# Of loops over whole vectors of an array; unsigned, since no index counts from the end.
STEP = np.uintp(LENGTH)
INDEX = ir.IntType(32)
# Products and sums may be joined and reordered; infinities and NaN stay what they are.
ANY_ORDER = ("contract", "reassoc", "nsz")


class Vector(types.Type):  # type: ignore[misc]
    """Type of sixteen float32, int32 or bool. `dtype`: of one of them."""

    def __init__(self, dtype):
        self.dtype = dtype
        super().__init__(name=f"Vector({dtype})")


FLOATS, INTEGERS, MASK = map(Vector, (types.float32, types.int32, types.boolean))
KINDS = {vector.dtype: vector for vector in (FLOATS, INTEGERS)}
ELEMENTS = {FLOATS: ir.FloatType(), INTEGERS: ir.IntType(32), MASK: ir.IntType(1)}


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager, vector):
        super().__init__(manager, vector, ir.VectorType(ELEMENTS[vector], LENGTH))


def _point_at(context, builder, array_type, array, start):
    """Address of the sixteen entries from `start` on."""
    data = context.make_array(array_type)(context, builder, array).data
    lanes = context.get_value_type(KINDS[array_type.dtype])
    return builder.bitcast(builder.gep(data, [start]), lanes.as_pointer())


@intrinsic
def load_vector(typing, array, start):
    """Return entries ``start`` to ``start + 15`` of a contiguous float32 or int32 array."""

    def build(context, builder, called, args):
        return builder.load(_point_at(context, builder, called.args[0], *args), align=4)

    return KINDS[array.dtype](array, types.uintp), build


@intrinsic
def store_vector(typing, array, start, lanes):
    """Write entries ``start`` to ``start + 15`` of a contiguous array of the lanes' dtype."""

    def build(context, builder, called, args):
        builder.store(
            args[2], _point_at(context, builder, called.args[0], args[0], args[1]), align=4
        )
        return context.get_dummy_value()

    return types.void(array, types.uintp, lanes), build


@intrinsic
def fill_vector(typing, value):
    """Return the same float32 or int32 in all lanes."""

    def build(context, builder, called, args):
        lanes = context.get_value_type(called.return_type)
        nothing = ir.Constant(lanes, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(INDEX, 0))
        everywhere = ir.Constant(ir.VectorType(INDEX, LENGTH), [0] * LENGTH)
        return builder.shuffle_vector(first, nothing, everywhere)

    return KINDS[value](value), build


@intrinsic
def choose(typing, mask, lanes, others):
    """Return `lanes` where the mask is set, and `others` elsewhere."""

    def build(context, builder, called, args):
        return builder.select(*args)

    return lanes(mask, lanes, others), build


@intrinsic
def raise_vector(typing, lanes, others):
    """Return the higher of two float32 in each lane; neither is NaN."""

    def build(context, builder, called, args):
        return builder.select(builder.fcmp_ordered(">", *args, flags=("nnan", "nsz")), *args)

    return lanes(lanes, others), build


@intrinsic
def copy_transposed(typing, source, start, stride, target, place, step):
    """Write sixteen vectors side by side: of flat contiguous arrays of one dtype, ``target[place +
    lane * step + k] = source[start + k * stride + lane]`` for all lanes and sixteen k.
    """

    def exchange(builder, one, other, distance):
        """Swap the upper half of each `2 * distance` lanes of one with the lower half of the other."""
        lower = [LENGTH + lane - distance if lane & distance else lane for lane in range(LENGTH)]
        upper = [LENGTH + lane if lane & distance else lane + distance for lane in range(LENGTH)]
        kind = ir.VectorType(INDEX, LENGTH)
        return (
            builder.shuffle_vector(one, other, ir.Constant(kind, lower)),
            builder.shuffle_vector(one, other, ir.Constant(kind, upper)),
        )

    def build(context, builder, called, args):
        def point(k, base, distance, number):
            away = builder.mul(distance, ir.Constant(distance.type, number))
            return _point_at(context, builder, called.args[k], args[k], builder.add(base, away))

        places = (point(0, args[1], args[2], number) for number in range(LENGTH))
        rows = [builder.load(place, align=4) for place in places]
        distance = LENGTH // 2
        while distance:
            for number in range(LENGTH):
                if not number & distance:
                    other = number + distance
                    rows[number], rows[other] = exchange(
                        builder, rows[number], rows[other], distance
                    )
            distance //= 2
        for number, lanes in enumerate(rows):
            builder.store(lanes, point(3, args[4], args[5], number), align=4)
        return context.get_dummy_value()

    signs = types.uintp, types.uintp, target, types.uintp, types.uintp
    return types.void(source, *signs), build


@intrinsic
def sum_vector(typing, lanes):
    """Return the sum of float32 lanes."""

    def build(context, builder, called, args):
        one = ELEMENTS[FLOATS]
        kind = ir.FunctionType(one, [one, args[0].type])
        name = f"llvm.vector.reduce.fadd.v{LENGTH}f32"
        add_up = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(add_up, [ir.Constant(one, 0.0), args[0]], fastmath=ANY_ORDER)

    return types.float32(lanes), build


@intrinsic
def find_highest_lane(typing, lanes):
    """Return the highest of float32 or int32 lanes."""

    def build(context, builder, called, args):
        kind = called.args[0]
        name, number = ("fmax", "f32") if kind == FLOATS else ("smax", "i32")
        function = ir.FunctionType(ELEMENTS[kind], [args[0].type])
        name = f"llvm.vector.reduce.{name}.v{LENGTH}{number}"
        highest = cgutils.get_or_insert_function(builder.module, function, name)
        return builder.call(highest, args, fastmath=("nnan",) if kind == FLOATS else ())

    return lanes.dtype(lanes), build


@intrinsic
def list_set_lanes(typing, mask):
    """Return a whole number (uint64) whose bit k is set where lane k of the mask is."""

    def build(context, builder, called, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LENGTH)), ir.IntType(64))

    return types.uint64(mask), build


@intrinsic
def count_set_lanes(typing, mask):
    """Return how many lanes of the mask are set (int64)."""

    def build(context, builder, called, args):
        set_lanes = builder.ctpop(builder.bitcast(args[0], ir.IntType(LENGTH)))
        return builder.zext(set_lanes, ir.IntType(64))

    return types.int64(mask), build


@intrinsic
def find_first_bit(typing, bits):
    """Return the number of the lowest bit that is set (uint64)."""

    def build(context, builder, called, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), build


def _define(symbol, result, build):
    """Give an operator its meaning for two equal kinds of lanes."""

    @infer_global(symbol)
    class _Operator(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args, kws):
            if len(args) == 2 and args[0] == args[1] and isinstance(args[0], Vector):
                return signature(result or args[0], *args)
            return None

    lower_builtin(symbol, Vector, Vector)(build)


def _define_arithmetic(symbol, name):
    def build(context, builder, called, args):
        if called.args[0] == FLOATS:
            return getattr(builder, f"f{name}")(*args, flags=ANY_ORDER)
        return getattr(builder, name)(*args)

    _define(symbol, None, build)


def _define_comparison(symbol, sign):
    def build(context, builder, called, args):
        if called.args[0] == FLOATS:
            return builder.fcmp_ordered(sign, *args)
        return builder.icmp_signed(sign, *args)

    _define(symbol, MASK, build)


for _name in ("add", "sub", "mul"):
    for _symbol in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        _define_arithmetic(_symbol, _name)
for _symbol, _sign in ((operator.gt, ">"), (operator.ge, ">=")):
    _define_comparison(_symbol, _sign)
_define(operator.and_, MASK, lambda context, builder, called, args: builder.and_(*args))
