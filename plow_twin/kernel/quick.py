"""Compile with less of numba's own work in Python, which is most of the time of compiling.

Seven means, none of which changes what numba makes of a kernel: the same types, the same code.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any, Final

import llvmlite.binding as llvm
from numba.core import types
from numba.core.compiler_machinery import PassManager
from numba.core.postproc import PostProcessor
from numba.core.registry import cpu_target
from numba.core.transforms import canonicalize_cfg
from numba.core.typing.context import Context
from numba.np import linalg

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


#: Passes after which numba finds the lifetime of each variable anew; only that of the last one is used.
_WITHOUT_LIFETIMES: Final = frozenset(
    {"DeadBranchPrune", "GenericRewrites", "InlineInlinables", "IRProcessing", "PreLowerStripPhis", "ReconstructSSA"}
)


@contextmanager
def without_lifetimes() -> Iterator[None]:
    """Leave out lifetimes where numba deletes no variable after it has found them."""
    processor: Any = PostProcessor
    find = processor.run

    def run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        if emit_dels or self.func_ir.is_generator:
            find(self, emit_dels, extend_lifetimes)
            return
        self.func_ir.blocks = canonicalize_cfg(self.func_ir.blocks)
        self.func_ir.generator_info = None

    processor.run = run
    try:
        yield
    finally:
        processor.run = find


class QuickPasses(PassManager):
    """A pipeline of numba's without the passes that no kernel needs and without their events, which print all types."""

    def __init__(self, whole: PassManager) -> None:
        super().__init__(whole.pipeline_name)
        self.passes = [entry for entry in whole.passes if entry[0].__name__ not in UNUSED]

    def _runPass(self, index: int, pss: Any, internal_state: Any) -> None:
        pss.analysis = self._analysis
        pss.run_initialization(internal_state)
        with without_lifetimes() if type(pss).__name__ in _WITHOUT_LIFETIMES else nullcontext():
            pss.run_pass(internal_state)
        pss.run_finalizer(internal_state)


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Pause the collection of garbage: numba makes millions of objects that stay, looked at again and again."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


def load_numba() -> None:
    """Load what numba compiles with, but for scipy's BLAS: numba only looks whether it is there, and loads it for that.

    Compiled functions that use it load it themselves.
    """
    found = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        with garbage_kept():
            cpu_target.target_context.refresh()
    finally:
        linalg.ensure_blas = found


@contextmanager
def without_lock_events() -> Iterator[None]:
    """Take LLVM's lock without numba's events, whose timers nest as deep as functions do.

    Where an llvmlite keeps its callbacks elsewhere the events stay.
    """
    callbacks = getattr(getattr(llvm.ffi.lib, "_lock", None), "_cblist", [])
    kept = list(callbacks)
    callbacks.clear()
    try:
        yield
    finally:
        callbacks[:] = kept


class CachingContext(Context):
    """Numba's typing context with a cache of the signatures of operators and of numba's own functions.

    Numba itself tries dozens of candidates for each `+`, and does so again for the next one.
    """

    __slots__ = ("_signatures",)

    def __init__(self, shared: Context) -> None:
        self.__dict__ = shared.__dict__
        self._signatures: dict[Any, Any] = {}

    def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
        """Return the signature of a call, as numba's own does."""
        of_others = isinstance(func, types.Type) and not isinstance(func, types.Function)
        # a name stands for an access by a constant, which may be a slice
        if of_others or isinstance(func, str) or kws:
            return super().resolve_function_type(func, args, kws)
        call = func, tuple(args)
        found = self._signatures.get(call)
        if found is None:
            found = super().resolve_function_type(func, args, kws)
            if found is not None:
                self._signatures[call] = found
        return found


_CONTEXTS: Final[dict[Any, CachingContext]] = {}


def caching_context(context: Context, flags: Any) -> CachingContext:
    """Return the caching context for one set of compiler flags, which numba's functions inherit."""
    found = _CONTEXTS.get((context, flags))
    if found is None:
        found = _CONTEXTS[context, flags.copy()] = CachingContext(context)
    return found


def ask_llvm_once(target: Any) -> None:
    """Let numba's target remember what it compiles for and how large types are: for each LLVM has to parse a module."""
    codegen = target.codegen()
    target.__dict__.setdefault("get_abi_sizeof", cache(target.get_abi_sizeof))
    codegen.__dict__.setdefault("magic_tuple", cache(codegen.magic_tuple))
