"""Sixteen numbers at once in compiled loops.

The compiler finds vectors by itself in long loops over bins of an array. In short ones, of which
the search for returns consists (a pulse is a dozen bins long), it finds none, or shuffles more than
it computes. Here they are written down: a `Vector` value is what a vector register holds, or
several of them on a processor whose registers are shorter. It exists in compiled code only.

`load_vector` and `store_vector` do not check that the array holds all lanes.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LENGTH = 16
"""Lanes of a vector: 64 bytes of float32."""

STEP = np.uintp(LENGTH)
"""Of loops over whole vectors of an array; unsigned, since no index counts from the end."""

INDEX = ir.IntType(32)
ANY_ORDER = ("contract", "reassoc", "nsz")
"""Products and sums may be joined and reordered; infinities and NaN stay what they are."""


class Vector(types.Type):  # type: ignore[misc]
    """Type of sixteen float32, int32 or bool. `dtype`: of one of them."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        super().__init__(name=f"Vector({dtype})")


FLOATS, INTEGERS, MASK = (
    Vector(types.float32),
    Vector(types.int32),
    Vector(types.boolean),
)
KINDS = {vector.dtype: vector for vector in (FLOATS, INTEGERS)}
ELEMENTS = {FLOATS: ir.FloatType(), INTEGERS: ir.IntType(32), MASK: ir.IntType(1)}


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, vector: Vector) -> None:
        super().__init__(manager, vector, ir.VectorType(ELEMENTS[vector], LENGTH))


def _point_at(context: Any, builder: Any, array_type: Any, array: Any, start: Any) -> Any:
    """Address of the sixteen entries from `start` on."""
    data = context.make_array(array_type)(context, builder, array).data
    lanes = context.get_value_type(KINDS[array_type.dtype])
    return builder.bitcast(builder.gep(data, [start]), lanes.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load_vector(typing: Any, array: Any, start: Any) -> Any:
    """Return entries ``start`` to ``start + 15`` of a contiguous float32 or int32 array."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return builder.load(_point_at(context, builder, called.args[0], *args), align=4)

    return KINDS[array.dtype](array, types.uintp), build


@intrinsic  # type: ignore[untyped-decorator]
def store_vector(typing: Any, array: Any, start: Any, lanes: Any) -> Any:
    """Write entries ``start`` to ``start + 15`` of a contiguous array of the lanes' dtype."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        builder.store(
            args[2], _point_at(context, builder, called.args[0], args[0], args[1]), align=4
        )
        return context.get_dummy_value()

    return types.void(array, types.uintp, lanes), build


@intrinsic  # type: ignore[untyped-decorator]
def fill_vector(typing: Any, value: Any) -> Any:
    """Return the same float32 or int32 in all lanes."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        lanes = context.get_value_type(called.return_type)
        nothing = ir.Constant(lanes, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(INDEX, 0))
        everywhere = ir.Constant(ir.VectorType(INDEX, LENGTH), [0] * LENGTH)
        return builder.shuffle_vector(first, nothing, everywhere)

    return KINDS[value](value), build


@intrinsic  # type: ignore[untyped-decorator]
def number_lanes(typing: Any) -> Any:
    """Return 0, 1, ... 15 as int32."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return ir.Constant(context.get_value_type(INTEGERS), list(range(LENGTH)))

    return INTEGERS(), build


@intrinsic  # type: ignore[untyped-decorator]
def choose(typing: Any, mask: Any, lanes: Any, others: Any) -> Any:
    """Return `lanes` where the mask is set, and `others` elsewhere."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return builder.select(*args)

    return lanes(mask, lanes, others), build


@intrinsic  # type: ignore[untyped-decorator]
def raise_vector(typing: Any, lanes: Any, others: Any) -> Any:
    """Return the higher of two float32 in each lane; neither is NaN."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args, flags=("nnan", "nsz")), *args)

    return lanes(lanes, others), build


@intrinsic  # type: ignore[untyped-decorator]
def copy_transposed(
    typing: Any, source: Any, start: Any, stride: Any, target: Any, place: Any, step: Any
) -> Any:
    """Write sixteen vectors side by side: of flat contiguous arrays of one dtype, ``target[place +
    lane * step + k] = source[start + k * stride + lane]`` for all lanes and sixteen k.
    """

    def exchange(builder: Any, one: Any, other: Any, distance: int) -> tuple[Any, Any]:
        """Swap the upper half of each `2 * distance` lanes of one with the lower half of the other."""
        lower = [LENGTH + lane - distance if lane & distance else lane for lane in range(LENGTH)]
        upper = [LENGTH + lane if lane & distance else lane + distance for lane in range(LENGTH)]
        kind = ir.VectorType(INDEX, LENGTH)
        return (
            builder.shuffle_vector(one, other, ir.Constant(kind, lower)),
            builder.shuffle_vector(one, other, ir.Constant(kind, upper)),
        )

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        def point(k: int, base: Any, distance: Any, number: int) -> Any:
            away = builder.mul(distance, ir.Constant(distance.type, number))
            return _point_at(context, builder, called.args[k], args[k], builder.add(base, away))

        rows = [
            builder.load(point(0, args[1], args[2], number), align=4) for number in range(LENGTH)
        ]
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


@intrinsic  # type: ignore[untyped-decorator]
def sum_vector(typing: Any, lanes: Any) -> Any:
    """Return the sum of float32 lanes."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        one = ELEMENTS[FLOATS]
        add_up = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(one, [one, args[0].type]),
            f"llvm.vector.reduce.fadd.v{LENGTH}f32",
        )
        return builder.call(add_up, [ir.Constant(one, 0.0), args[0]], fastmath=ANY_ORDER)

    return types.float32(lanes), build


@intrinsic  # type: ignore[untyped-decorator]
def find_highest_lane(typing: Any, lanes: Any) -> Any:
    """Return the highest of float32 or int32 lanes."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        kind = called.args[0]
        name, number = ("fmax", "f32") if kind == FLOATS else ("smax", "i32")
        highest = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ELEMENTS[kind], [args[0].type]),
            f"llvm.vector.reduce.{name}.v{LENGTH}{number}",
        )
        return builder.call(highest, args, fastmath=("nnan",) if kind == FLOATS else ())

    return lanes.dtype(lanes), build


@intrinsic  # type: ignore[untyped-decorator]
def list_set_lanes(typing: Any, mask: Any) -> Any:
    """Return a whole number (uint64) whose bit k is set where lane k of the mask is."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LENGTH)), ir.IntType(64))

    return types.uint64(mask), build


@intrinsic  # type: ignore[untyped-decorator]
def count_set_lanes(typing: Any, mask: Any) -> Any:
    """Return how many lanes of the mask are set (int64)."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        set_lanes = builder.ctpop(builder.bitcast(args[0], ir.IntType(LENGTH)))
        return builder.zext(set_lanes, ir.IntType(64))

    return types.int64(mask), build


@intrinsic  # type: ignore[untyped-decorator]
def find_first_bit(typing: Any, bits: Any) -> Any:
    """Return the number of the lowest bit that is set (uint64)."""

    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), build


def _define(symbol: Any, result: Any, build: Any) -> None:
    """Give an operator its meaning for two equal kinds of lanes."""

    @infer_global(symbol)
    class _Operator(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and args[0] == args[1] and isinstance(args[0], Vector):
                return signature(result or args[0], *args)
            return None

    lower_builtin(symbol, Vector, Vector)(build)


def _define_arithmetic(symbol: Any, name: str) -> None:
    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        if called.args[0] == FLOATS:
            return getattr(builder, f"f{name}")(*args, flags=ANY_ORDER)
        return getattr(builder, name)(*args)

    _define(symbol, None, build)


def _define_comparison(symbol: Any, sign: str) -> None:
    def build(context: Any, builder: Any, called: Any, args: Any) -> Any:
        if called.args[0] == FLOATS:
            return builder.fcmp_ordered(sign, *args)
        return builder.icmp_signed(sign, *args)

    _define(symbol, MASK, build)


for _symbols, _name in (
    ((operator.add, operator.iadd), "add"),
    ((operator.sub, operator.isub), "sub"),
    ((operator.mul, operator.imul), "mul"),
):
    for _symbol in _symbols:
        _define_arithmetic(_symbol, _name)
for _symbol, _sign in ((operator.gt, ">"), (operator.ge, ">=")):
    _define_comparison(_symbol, _sign)
_define(operator.and_, MASK, lambda context, builder, called, args: builder.and_(*args))
