"""Compile what only kernels call to code for linking: numba would optimise it and make machine code of it once more.

A kernel is optimised as a whole, together with all that it calls, so whatever was done to the parts alone is done in
vain. It takes a quarter of the time of compiling, which is left out here by numba's own means: a compiler of one's own
(numba's manual, "Customizing the Compiler"), which lowers into a library of one's own.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import llvmlite.binding as llvm
import llvmlite.ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import IRLegalization

from plow_twin.kernel.quick import QuickPasses, caching_context, without_lock_events

_ENVIRONMENT = "_ZN08NumbaEnv"


class LinkedLibrary(JITCodeLibrary):
    """The code of a kernel, as its callers link it; its machine code holds nothing but the variables numba sets."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        whole, self._finalized = self._final_module, True
        self._get_module_for_linking()
        variables = self._codegen._create_empty_module(self.name)
        for variable in whole.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                _declare(variables, variable.name)
        self._final_module = llvm.parse_assembly(str(variables))
        self._final_module.name = self.name
        super()._finalize_final_module()


def _declare(module: llvmlite.ir.Module, name: str) -> None:
    pointer = llvmlite.ir.IntType(8).as_pointer()
    variable = llvmlite.ir.GlobalVariable(module, pointer, name)
    variable.linkage, variable.initializer = "common", llvmlite.ir.Constant(pointer, None)


class EntryLibrary(JITCodeLibrary):
    """The code of a kernel that Python calls, with all that it calls for itself alone.

    Otherwise the first entry loaded would lend its copies of them to the next: optimised for another caller, they may
    differ in the last bit.
    """

    def _optimize_final_module(self) -> None:
        super()._optimize_final_module()
        for function in self._final_module.functions:
            if function.linkage == llvm.Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = llvm.Linkage.internal


class _ChooseLibrary(AnalysisPass):
    library: type[JITCodeLibrary]

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return False


@register_pass(mutates_CFG=False, analysis_only=True)
class _LowerForLinking(_ChooseLibrary):
    _name = "lower_for_linking"
    library = LinkedLibrary


@register_pass(mutates_CFG=False, analysis_only=True)
class _LowerForPython(_ChooseLibrary):
    _name = "lower_for_python"
    library = EntryLibrary


class _Compiler(CompilerBase):
    choice: type[_ChooseLibrary]

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, result: Any, flags: Any, local: Any) -> None:
        super().__init__(caching_context(typing, flags), target, library, args, result, flags, local)

    def define_pipelines(self) -> list[Any]:
        passes = QuickPasses(DefaultPassBuilder.define_nopython_pipeline(self.state))
        passes.add_pass_after(self.choice, IRLegalization)
        passes.finalize()
        return [passes]


class LinkedCompiler(_Compiler):
    """numba's compiler, but for the library that it lowers into: for what kernels call."""

    choice = _LowerForLinking


class EntryCompiler(_Compiler):
    """numba's compiler, but for the library that it lowers into: for what Python calls, with all that it calls."""

    choice = _LowerForPython

    def compile_extra(self, func: Any) -> Any:
        """Compile, as numba's own."""
        with _garbage_kept(), without_lock_events():
            return super().compile_extra(func)


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """Pause the collection of garbage: compiling makes millions of objects that stay, looked at again and again."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


def keep_from_python(dispatcher: Any) -> None:
    """Make a call from Python an error: there is no machine code to go to."""

    def refuse(*arguments: Any, **named: Any) -> None:
        raise TypeError(f"{dispatcher.py_func.__qualname__} is for kernels to call: it would have to be an entry")

    dispatcher._insert, dispatcher._compile_for_args = lambda *overload, **options: None, refuse
