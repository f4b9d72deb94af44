"""Functions with which compiled code reads or writes eight bytes of an array as one integer.

The integers are little-endian, like the numbers in MCAP files and in CDR messages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

_WORD = ir.IntType(64)


def _place(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    view = context.make_array(signature.args[0])(context, builder, arguments[0])
    place = context.cast(builder, arguments[1], signature.args[1], types.intp)
    first = builder.gep(builder.bitcast(view.data, ir.IntType(8).as_pointer()), [place])
    return builder.bitcast(first, _WORD.as_pointer())


def _word(typingctx: Any, data: Any, place: Any) -> Any:
    """Return the eight bytes at offset `place` of a contiguous array as an int64. Bounds are not checked."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_place(context, builder, signature, arguments), align=1)

    return types.int64(data, place), codegen


def _set_word(typingctx: Any, data: Any, place: Any, value: Any) -> Any:
    """Write an int64 to the eight bytes at offset `place` of a contiguous array. Bounds are not checked."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[2], signature.args[2], types.int64)
        builder.store(number, _place(context, builder, signature, arguments), align=1)
        return context.get_dummy_value()

    return types.void(data, place, value), codegen


def _bits(typingctx: Any, number: Any) -> Any:
    """Return the bits of a float64 as an int64."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], _WORD)

    return types.int64(types.float64), codegen


def _word_at(typingctx: Any, address: Any) -> Any:
    """Return the eight bytes at a memory address as an int64."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], _WORD.as_pointer()), align=8)

    return types.int64(types.int64), codegen


word = cast("Callable[[Any, Any], Any]", intrinsic(_word))
set_word = cast("Callable[[Any, Any, Any], None]", intrinsic(_set_word))
bits = cast("Callable[[float], int]", intrinsic(_bits))
word_at = cast("Callable[[int], int]", intrinsic(_word_at))
