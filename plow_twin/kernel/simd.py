"""A type for kernels that represents eight numbers as one SIMD vector. A lane is one of the eight positions.

The operators + - * / act on all eight numbers. The compiler splits the operations if the processor's vectors are
shorter.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

_WIDTH = 8
_VECTOR = ir.VectorType(ir.DoubleType(), _WIDTH)
_BITS = ir.VectorType(ir.IntType(64), _WIDTH)
#: Flags that allow LLVM to fuse and reorder sums, as for `kernel(fast=True)`.
_FLAGS = ("contract", "reassoc", "nsz", "arcp")


def _operation(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation for kernels from a function that emits its code."""
    operation: Callable[..., Any] = intrinsic(function)
    return operation


class Lanes(types.Type):
    """Numba type of eight float64 numbers."""

    #: LLVM flags that allow changes of the order and rounding of sums
    flags: tuple[str, ...] = _FLAGS

    def __init__(self, name: str = "Lanes") -> None:
        super().__init__(name=name)


class ExactLanes(Lanes):
    """Eight float64 numbers whose operations are rounded as written, independent of the surrounding code."""

    flags = ()

    def __init__(self) -> None:
        super().__init__(name="ExactLanes")


lanes = Lanes()
exact_lanes = ExactLanes()


@register_model(Lanes)
@register_model(ExactLanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    view = context.make_array(array_type)(context, builder, array)
    data = builder.bitcast(view.data, ir.DoubleType().as_pointer())
    first = builder.gep(data, [builder.mul(index, ir.Constant(index.type, _WIDTH))])
    return builder.bitcast(first, _VECTOR.as_pointer())


def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    place = context.cast(builder, arguments[1], signature.args[1], types.intp)
    return builder.load(_pointer(context, builder, signature.args[0], arguments[0], place), align=8)


@_operation
def row(typingctx: Any, array: Any, index: Any) -> Any:
    """Return row `index` of a contiguous array of shape (n, 8), or the whole array if its shape is (8,)."""
    return lanes(array, index), _load


@_operation
def exact_row(typingctx: Any, array: Any, index: Any) -> Any:
    """Return `row` with the type `ExactLanes`."""
    return exact_lanes(array, index), _load


def _from_places(context: Any, builder: Any, signature: Any, arguments: Any, places: Any) -> Any:
    """Return the code that loads a vector from eight offsets `places` from a row."""
    index = context.cast(builder, arguments[1], signature.args[1], types.intp)
    row_pointer = _pointer(context, builder, signature.args[0], arguments[0], index)
    first, vector = builder.bitcast(row_pointer, ir.DoubleType().as_pointer()), ir.Constant(_VECTOR, ir.Undefined)
    for lane, place in enumerate(places):
        number = builder.load(builder.gep(first, [place]))
        vector = builder.insert_element(vector, number, ir.Constant(ir.IntType(32), lane))
    return vector


@_operation
def gathered(typingctx: Any, array: Any, index: Any, places: Any) -> Any:
    """Return eight elements of a contiguous array of shape (n, 8), by their offsets `places` from row `index`."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        places = [builder.extract_value(arguments[2], lane) for lane in range(_WIDTH)]
        return _from_places(context, builder, signature, arguments, places)

    return exact_lanes(array, index, places), codegen


@_operation
def picked(typingctx: Any, array: Any, index: Any, order: Any) -> Any:
    """Return a row with element `order`[i] in lane i, for eight int64 numbers `order` that `exact_row` has loaded."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.bitcast(arguments[2], _BITS)
        if "+avx512f" in context.codegen().magic_tuple()[2]:
            # LLVM does not find this instruction if the loop is elsewhere than the loads of `order`
            kind, name = ir.FunctionType(_VECTOR, [_VECTOR, _BITS]), "llvm.x86.avx512.permvar.df.512"
            permute = cgutils.get_or_insert_function(builder.module, kind, name)
            return builder.call(permute, [_load(context, builder, signature, arguments), numbers])
        places = [builder.extract_element(numbers, ir.Constant(ir.IntType(32), i)) for i in range(_WIDTH)]
        return _from_places(context, builder, signature, arguments, places)

    return exact_lanes(array, index, order), codegen


@_operation
def set_row(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight numbers to row `index` of a contiguous array of shape (n, 8)."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = context.cast(builder, arguments[1], signature.args[1], types.intp)
        builder.store(arguments[2], _pointer(context, builder, signature.args[0], arguments[0], place), align=8)
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


def _splatted(builder: Any, value: Any) -> Any:
    single = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), [0] * _WIDTH)
    return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), zeros)


def _splat(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _splatted(builder, context.cast(builder, arguments[0], signature.args[0], types.float64))


@_operation
def splat(typingctx: Any, value: Any) -> Any:
    """Return a vector with the same number in all lanes."""
    return lanes(value), _splat


@_operation
def exact_splat(typingctx: Any, value: Any) -> Any:
    """Return `splat` with the type `ExactLanes`."""
    return exact_lanes(value), _splat


@_operation
def pack(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """Return a vector of the eight numbers."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.Constant(_VECTOR, ir.Undefined)
        for lane, (kind, value) in enumerate(zip(signature.args, arguments, strict=True)):
            number = context.cast(builder, value, kind, types.float64)
            vector = builder.insert_element(vector, number, ir.Constant(ir.IntType(32), lane))
        return vector

    return lanes(a, b, c, d, e, f, g, h), codegen


def permutation(*places: int) -> Callable[..., Any]:
    """Return an operation whose result contains lane places[i] of its argument in lane i."""

    @_operation
    def permuted(typingctx: Any, value: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            order = ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), places)
            return builder.shuffle_vector(arguments[0], ir.Constant(_VECTOR, ir.Undefined), order)

        return lanes(value), codegen

    return permuted


@_operation
def lane(typingctx: Any, value: Any, index: Any) -> Any:
    """Return the number in lane `index`."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        position = context.cast(builder, arguments[1], signature.args[1], types.int32)
        return builder.extract_element(arguments[0], position)

    return types.float64(value, index), codegen


@_operation
def with_lane(typingctx: Any, value: Any, index: Any, number: Any) -> Any:
    """Return a vector with a number in lane `index`, and the lanes of `value` elsewhere."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        position = context.cast(builder, arguments[1], signature.args[1], types.int32)
        return builder.insert_element(arguments[0], arguments[2], position)

    return value(value, index, types.float64), codegen


@_operation
def total(typingctx: Any, value: Any) -> Any:
    """Return the sum of the eight lanes."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType(), _VECTOR])
        reduce = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fadd.v8f64")
        return builder.call(reduce, [ir.Constant(ir.DoubleType(), 0.0), arguments[0]], fastmath=_FLAGS)

    return types.float64(lanes), codegen


@_operation
def three_totals(typingctx: Any, first: Any, second: Any, third: Any) -> Any:
    """Return a vector of three vectors' sums in lanes 2, 3 and 4, and 0 in the other lanes.

    It is faster than three calls of `total`.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def shuffled(left: Any, right: Any, *places: int) -> Any:
            order = ir.Constant(ir.VectorType(ir.IntType(32), len(places)), places)
            return builder.shuffle_vector(left, right, order)

        def added(left: Any, right: Any) -> Any:
            return builder.fadd(left, right, flags=_FLAGS)

        one, two, three = (
            added(shuffled(value, value, 0, 1, 2, 3), shuffled(value, value, 4, 5, 6, 7)) for value in arguments
        )
        both = added(shuffled(one, two, 0, 1, 4, 5), shuffled(one, two, 2, 3, 6, 7))
        both = added(shuffled(both, both, 0, 2), shuffled(both, both, 1, 3))
        last = added(shuffled(three, three, 0, 1), shuffled(three, three, 2, 3))
        last = added(last, shuffled(last, last, 1, 0))
        zeros = ir.Constant(both.type, [0.0, 0.0])
        low = shuffled(zeros, both, 0, 1, 2, 3)
        high = shuffled(last, zeros, 0, 2, 2, 2)
        return shuffled(low, high, *range(_WIDTH))

    return lanes(first, second, third), codegen


@_operation
def below(typingctx: Any, left: Any, right: Any) -> Any:
    """Return an integer whose bit i is set if left < right in lane i. A NaN leaves bit i unset."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        comparison = builder.fcmp_ordered("<", *arguments)
        return builder.zext(builder.bitcast(comparison, ir.IntType(_WIDTH)), ir.IntType(64))

    return types.int64(left, right), codegen


@_operation
def equal(typingctx: Any, array: Any, index: Any, number: Any) -> Any:
    """Return an integer whose bit i is set if element i of row `index` of a contiguous int64 array equals `number`."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place, sought = (context.cast(builder, arguments[i], signature.args[i], types.int64) for i in (1, 2))
        pointer = _pointer(context, builder, signature.args[0], arguments[0], place)
        loaded = builder.load(builder.bitcast(pointer, _BITS.as_pointer()), align=8)
        pattern = builder.bitcast(_splatted(builder, builder.bitcast(sought, ir.DoubleType())), _BITS)
        same = builder.icmp_signed("==", loaded, pattern)
        return builder.zext(builder.bitcast(same, ir.IntType(_WIDTH)), ir.IntType(64))

    return types.int64(array, index, number), codegen


@_operation
def transpose(typingctx: Any, target: Any, source: Any) -> Any:
    """Write the transpose of a contiguous array of shape (8, 8) to a different contiguous array of this shape."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def place(i: int, row_index: int) -> Any:
            index = ir.Constant(ir.IntType(64), row_index)
            return _pointer(context, builder, signature.args[i], arguments[i], index)

        rows = [builder.load(place(1, i), align=8) for i in range(_WIDTH)]
        distance = 1
        while distance < _WIDTH:
            # exchange the two off-diagonal blocks of size `distance` in each block of twice the size
            low = [i if i & distance == 0 else _WIDTH + i - distance for i in range(_WIDTH)]
            high = [i + distance if i & distance == 0 else _WIDTH + i for i in range(_WIDTH)]
            for i in range(_WIDTH):
                if i & distance == 0:
                    pair = rows[i], rows[i + distance]
                    for row_index, places in ((i, low), (i + distance, high)):
                        order = ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), places)
                        rows[row_index] = builder.shuffle_vector(*pair, order)
            distance *= 2
        for i, value in enumerate(rows):
            builder.store(value, place(0, i), align=8)
        return context.get_dummy_value()

    return types.void(target, source), codegen


@_operation
def choose(typingctx: Any, bits: Any, there: Any, elsewhere: Any) -> Any:
    """Return a vector with lane i of `there` if bit i of `bits` is set, and lane i of `elsewhere` if not."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[0], signature.args[0], types.int64)
        mask = builder.bitcast(builder.trunc(number, ir.IntType(_WIDTH)), ir.VectorType(ir.IntType(1), _WIDTH))
        return builder.select(mask, arguments[1], arguments[2])

    return there(bits, there, elsewhere), codegen


@_operation
def lowest_bit(typingctx: Any, bits: Any) -> Any:
    """Return the index of the lowest set bit. `bits` must not be zero."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


def _called(builder: Any, name: str, arguments: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v8f64"), arguments)


@_operation
def fused(typingctx: Any, factor: Any, other: Any, term: Any) -> Any:
    """Return factor * other + term, rounded once if the processor has fused operations."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _called(builder, "fmuladd", arguments)

    return factor(factor, other, term), codegen


@_operation
def magnitude(typingctx: Any, value: Any) -> Any:
    """Return the absolute value of each lane."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _called(builder, "fabs", arguments)

    return value(value), codegen


@_operation
def square_root(typingctx: Any, value: Any) -> Any:
    """Return the square root of each lane."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _called(builder, "sqrt", arguments)

    return value(value), codegen


def _each(number: int) -> Any:
    return ir.Constant(_BITS, [number] * _WIDTH)


@_operation
def exponent_of(typingctx: Any, value: Any) -> Any:
    """Return the binary exponent of the positive number in each lane, as float64. The exponent of inf is 1024."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.lshr(builder.bitcast(arguments[0], _BITS), _each(52))
        return builder.sitofp(builder.sub(builder.and_(bits, _each(0x7FF)), _each(1023)), _VECTOR)

    return value(value), codegen


@_operation
def significand_of(typingctx: Any, value: Any) -> Any:
    """Return the significand in [1, 2) of the positive number in each lane."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.and_(builder.bitcast(arguments[0], _BITS), _each(2**52 - 1))
        return builder.bitcast(builder.or_(bits, _each(1023 << 52)), _VECTOR)

    return value(value), codegen


@_operation
def power_of_two(typingctx: Any, exponent: Any) -> Any:
    """Return 2 to the power of the integer in each lane, a float64 from -1022 to 1023."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = builder.add(builder.fptosi(arguments[0], _BITS), _each(1023))
        return builder.bitcast(builder.shl(number, _each(52)), _VECTOR)

    return exponent(exponent), codegen


def _elementwise(operation: Callable[..., Any], emit: str) -> None:
    @infer_global(operation)
    class _Typing(AbstractTemplate):
        # numba tries templates of the processor before its twenty general templates of an operator
        metadata = {"target": "cpu"}  # noqa: RUF012

        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            supported = all(isinstance(kind, (Lanes, types.Float, types.Integer)) for kind in args)
            lane_types = {kind for kind in args if isinstance(kind, Lanes)}
            if len(args) == 2 and supported and len(lane_types) == 1:
                return signature(*lane_types, *args)
            return None

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sides = [
            value if isinstance(kind, Lanes) else _splatted(builder, context.cast(builder, value, kind, types.float64))
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        return getattr(builder, emit)(*sides, flags=signature.return_type.flags)

    for left, right in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(operation, left, right)(codegen)


for _sign, _emit in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
):  # fmt: skip
    _elementwise(_sign, _emit)
