"""Arrays inside kernels that are not reference counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


def _unowned(typingctx: Any, array: Any) -> Any:
    """Return the same array without a reference count; the caller must keep its memory alive. None stays None.

    With a reference count, each call that takes the array would increment and decrement it atomically, which costs a
    seventh of a run's time.
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
