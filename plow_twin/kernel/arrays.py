"""Functions by which kernels view, copy, search and check arrays and records.

They compile faster than numba's own code. For example, numba's assignment to a slice takes 2 s in each process that
compiles a twin, because it formats an error message.
"""

from __future__ import annotations

import ctypes
import math
import operator
from collections.abc import Callable
from typing import Any, Final, cast

import numba.core.boxing  # noqa: F401
from llvmlite import ir
from numba.core import cgutils, pythonapi, types
from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
from numba.core.typing.templates import infer_global
from numba.extending import NativeValue, intrinsic

from plow_twin.kernel.compiler import kernel

#: Metadata of templates (numba's typing rules of operations) that numba tries before all general templates, which saves
#: a fifth of the compile time.
_FIRST: Final = {"target": "cpu"}


@infer_global(operator.getitem)  # type: ignore[no-untyped-call]
class _ArrayItem(GetItemBuffer):
    metadata = _FIRST


@infer_global(operator.setitem)  # type: ignore[no-untyped-call]
class _SetArrayItem(SetItemBuffer):
    metadata = _FIRST


def _unowned(typingctx: Any, array: Any) -> Any:
    """Return a view of an array without a reference count, or None for None. The caller must keep the memory alive.

    Counting the references in each call would take a seventh of a run's time.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if not isinstance(signature.args[0], types.Array):
            return arguments[0]
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        view.meminfo = ir.Constant(view.meminfo.type, None)
        view.parent = ir.Constant(view.parent.type, None)
        return view._getvalue()

    return array(array), codegen


unowned = cast("Callable[[Any], Any]", intrinsic(_unowned))


def _copy_record(typingctx: Any, target: Any, source: Any) -> Any:
    """Copy a record to a record of the same type.

    Numba's assignment loads the record as an array of bytes, which takes LLVM 0.8 s to compile.
    """
    if not isinstance(target, types.Record) or target != source:
        return None

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        size = context.get_constant(types.intp, signature.args[0].size)
        cgutils.raw_memcpy(builder, arguments[0], arguments[1], size, 1)  # type: ignore[no-untyped-call]
        return context.get_dummy_value()

    return types.void(target, source), codegen


copy_record = cast("Callable[[Any, Any], None]", intrinsic(_copy_record))


def _copy_part(typingctx: Any, target: Any, source: Any, first: Any, last: Any) -> Any:
    """Copy the bytes `first` to `last` - 1 of a record to the same offsets in a record of a different type."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        begin, end = (context.cast(builder, arguments[i], signature.args[i], types.intp) for i in (2, 3))
        there, here = (builder.gep(builder.bitcast(argument, cgutils.voidptr_t), [begin]) for argument in arguments[:2])
        cgutils.raw_memcpy(builder, there, here, builder.sub(end, begin), 1)  # type: ignore[no-untyped-call]
        return context.get_dummy_value()

    return types.void(target, source, first, last), codegen


copy_part = cast("Callable[[Any, Any, int, int], None]", intrinsic(_copy_part))


def _unbox_record(kind: Any, record: Any, c: Any) -> Any:
    """Return a record argument from Python as a pointer to its data, the first field of numpy's `PyVoidScalarObject`.

    Numba requests the data as a buffer, for which numpy describes all fields as text. This takes 20 us a call of
    `integrate`.
    """
    fields = c.builder.bitcast(record, cgutils.voidptr_t.as_pointer())
    data = c.builder.load(c.builder.gep(fields, [c.context.get_constant(types.intp, _WORDS_OF_HEAD)]))
    return NativeValue(c.builder.bitcast(data, c.context.get_value_type(kind)))  # type: ignore[no-untyped-call]


#: Size of Python's head of an object of variable size, in pointers.
_WORDS_OF_HEAD: Final = tuple.__basicsize__ // ctypes.sizeof(ctypes.c_void_p)
# `unbox` would refuse to replace numba's own function, which the import of `boxing` has registered
pythonapi._unboxers.functions[types.Record] = _unbox_record


@kernel()
def copy_into(target: Any, source: Any) -> None:
    """Copy the elements of an array to an array of the same size."""
    for i in range(target.size):
        target[i] = source[i]


@kernel()
def all_finite(numbers: Any) -> bool:
    """Return whether all numbers are finite."""
    finite = True
    for number in numbers:
        finite = finite and math.isfinite(number)
    return finite


@kernel()
def count_up_to(rising: Any, limit: float) -> int:
    """Return how many of the ascending numbers are at most `limit`."""
    low, high = 0, rising.size
    while low < high:
        middle = (low + high) // 2
        if rising[middle] <= limit:
            low = middle + 1
        else:
            high = middle
    return low
