"""Two numba compilers: `LinkedCompiler` for kernels that only kernels call, `EntryCompiler` for calls from Python.

LLVM optimises a kernel together with every kernel that it calls. By default, numba also optimises each called kernel
alone and generates machine code for it, which takes a quarter of the compile time. `LinkedCompiler` omits these steps
(numba's manual, "Customizing the Compiler").
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import llvmlite.binding as llvm
import llvmlite.ir
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

_ENVIRONMENT = "_ZN08NumbaEnv"


class LinkedLibrary(JITCodeLibrary):
    """LLVM code of a kernel that its callers link. Only numba's global variables become machine code."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._exported: list[str] = []
        #: whether sums may be reordered and fused; if so, the last bits of a sum may depend on the caller
        self.fast = False

    def add_ir_module(self, ir_module: llvmlite.ir.Module) -> None:
        """Add a module, and store the names of the functions that callers use."""
        super().add_ir_module(ir_module)
        defined = (function for function in ir_module.functions if not function.is_declaration)
        self._exported += [function.name for function in defined if not function.linkage]

    def finalize(self) -> None:
        """Link the code of all called functions into this library."""
        self._finalized = True
        whole = self._final_module
        self._finalize_dynamic_globals()
        environments = _environments(whole)
        for library in dict.fromkeys(self._linking_libraries):
            whole.link_in(library._get_module_for_linking(), preserve=True)
            self._dynamic_globals += library._dynamic_globals
            environments |= _environments(library._final_module)
        for name in self._exported:
            # each caller gets its own copy of the kernel, which LLVM can delete after inlining
            whole.get_function(name).linkage = "linkonce_odr" if self.fast else "weak_odr"
        self._shared_module = whole
        self._final_module = _variables(self._codegen._create_empty_module(self.name), environments)
        self._set_compiled_object(self._codegen._tm.emit_object(self._final_module))

    def _get_module_for_linking(self) -> llvm.ModuleRef:
        self._ensure_finalized()
        return self._shared_module


def _environments(module: llvm.ModuleRef) -> set[str]:
    return {variable.name for variable in module.global_variables if variable.name.startswith(_ENVIRONMENT)}


def _variables(module: llvmlite.ir.Module, names: set[str]) -> llvm.ModuleRef:
    pointer = llvmlite.ir.IntType(8).as_pointer()
    for name in sorted(names):
        variable = llvmlite.ir.GlobalVariable(module, pointer, name)
        variable.linkage, variable.initializer = "common", llvmlite.ir.Constant(pointer, None)
    return llvm.parse_assembly(str(module))


class EntryLibrary(JITCodeLibrary):
    """Code of a kernel that Python calls, with its own copy of every kernel that it calls.

    Shared copies would be optimised for the entry that is loaded first, so the last bits of results would depend on the
    order of loading. The copies become internal before LLVM's optimisation, so that LLVM inlines kernels with one
    caller. Copies of `fast` kernels become internal only afterwards, because inlining may change the order of their
    sums.
    """

    def _optimize_final_module(self) -> None:
        self._keep(llvm.Linkage.weak_odr)
        super()._optimize_final_module()
        self._keep(llvm.Linkage.linkonce_odr)

    def _keep(self, linkage: llvm.Linkage) -> None:
        """Change the linkage of all defined functions with the given linkage to internal."""
        for function in self._final_module.functions:
            if function.linkage == linkage and not function.is_declaration:
                function.linkage = llvm.Linkage.internal


def _new_library(state: Any, kind: type[JITCodeLibrary]) -> JITCodeLibrary:
    library = kind(state.targetctx.codegen(), state.func_id.func_qualname)
    library.enable_object_caching()
    return library


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerForLinking(NativeLowering):
    """Numba's lowering without a wrapper for Python."""

    _name = "lower_for_linking"

    def run_pass(self, state: Any) -> bool:
        state.library = _new_library(state, LinkedLibrary)
        state.library.fast = bool(state.flags.fastmath)
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        # numba finds the function by this object, which is never called
        entry_point = object()
        state.targetctx.insert_user_function(entry_point, state.cr.fndesc, [state.library])
        state["cr"] = state.cr._replace(cfunc=entry_point)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerForPython(NativeLowering):
    _name = "lower_for_python"

    def run_pass(self, state: Any) -> bool:
        state.library = _new_library(state, EntryLibrary)
        return bool(super().run_pass(state))


class _Compiler(CompilerBase):
    lowering: type[NativeLowering]

    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(self.lowering if pass_ is NativeLowering else pass_, text) for pass_, text in passes.passes]
        passes.finalize()
        return [passes]


class LinkedCompiler(_Compiler):
    """Numba's compiler with `LinkedLibrary`, for kernels that only kernels call."""

    lowering = _LowerForLinking


class EntryCompiler(_Compiler):
    """Numba's compiler with `EntryLibrary`, for kernels that Python calls."""

    lowering = _LowerForPython

    def compile_extra(self, func: Any) -> Any:
        """Compile without garbage collection, which would take a seventh of the time and free little memory."""
        with garbage_kept():
            return super().compile_extra(func)


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Pause Python's garbage collection within the context."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


def keep_from_python(dispatcher: Any) -> None:
    """Make calls from Python raise a `TypeError`, because the kernel has no machine code."""

    def refuse(*arguments: Any, **named: Any) -> None:
        raise TypeError(
            f"{dispatcher.py_func.__qualname__} is for kernels to call; only a kernel with entry=True can be called"
        )

    dispatcher._insert, dispatcher._compile_for_args = lambda *overload, **options: None, refuse


def for_any_value(dispatcher: Any) -> None:
    """Make numba compile a kernel once for the types of its arguments, not again for each constant argument."""
    fold = dispatcher._compiler.fold_argument_types

    def fold_without_values(arguments: Any, named: Any) -> Any:
        signature, library = fold(arguments, named)
        return signature, tuple(map(types.unliteral, library))

    dispatcher._compiler.fold_argument_types = fold_without_values
