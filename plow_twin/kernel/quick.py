"""Compile with less of numba's own work in Python, which is most of the time of compiling.

Four means, none of which changes what numba makes of a kernel: the same types, the same code.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import llvmlite.binding as llvm
from numba.core import types
from numba.core.compiler_machinery import PassManager
from numba.core.typing.context import Context

#: Numba's passes for what no kernel has: closures, `with`, loops over literals, array expressions, parallel loops,
#: overloads that are inlined; and those that only tell or check. One of a name that numba does not have is no matter;
#: a kernel that needs one of them does not compile.
UNUSED: Final = frozenset(
    {
        "AnnotateTypes",
        "DumpParforDiagnostics",
        "FindLiterallyCalls",
        "InlineClosureLikes",
        "InlineOverloads",
        "LiteralPropagationSubPipelinePass",
        "LiteralUnroll",
        "MakeFunctionToJitFunction",
        "NoPythonSupportedFeatureValidation",
        "NopythonRewrites",
        "RewriteDynamicRaises",
        "WithLifting",
    }
)


class QuickPasses(PassManager):
    """The passes of a pipeline of numba's that kernels need, without word of each: that writes all its types out."""

    def __init__(self, whole: PassManager) -> None:
        super().__init__(whole.pipeline_name)
        self.passes = [entry for entry in whole.passes if entry[0].__name__ not in UNUSED]

    def _runPass(self, index: int, pss: Any, internal_state: Any) -> None:
        pss.analysis = self._analysis
        pss.run_initialization(internal_state)
        pss.run_pass(internal_state)
        pss.run_finalizer(internal_state)


@contextmanager
def lock_untold() -> Iterator[None]:
    """Let LLVM's lock be taken without word of it: numba times it anew for each function within a function.

    Where llvmlite keeps whom to tell elsewhere, they are told.
    """
    told = getattr(getattr(llvm.ffi.lib, "_lock", None), "_cblist", [])
    kept = list(told)
    told.clear()
    try:
        yield
    finally:
        told[:] = kept


class RememberingContext(Context):
    """Numba's context of types, all of it, that remembers what operators and functions of numba's give for types.

    Numba tries dozens of candidates for each `+` in the text, and does so anew for the next one.
    """

    __slots__ = ("_given",)

    def __init__(self, shared: Context) -> None:
        self.__dict__ = shared.__dict__
        self._given: dict[Any, Any] = {}

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call, as numba's own does."""
        of_others = isinstance(func, types.Type) and not isinstance(func, types.Function)
        # a name stands for an access by a constant, which may be a slice
        if of_others or isinstance(func, str) or kws:
            return super().resolve_function_type(func, args, kws)
        call = func, tuple(args)
        found = self._given.get(call)
        if found is None:
            found = super().resolve_function_type(func, args, kws)
            if found is not None:
                self._given[call] = found
        return found


_CONTEXTS: Final[dict[Any, RememberingContext]] = {}


def remembering(context: Context, flags: Any) -> RememberingContext:
    """Return the context that remembers for one set of compiler flags, which numba's functions take over."""
    found = _CONTEXTS.get((context, flags))
    if found is None:
        found = _CONTEXTS[context, flags.copy()] = RememberingContext(context)
    return found
