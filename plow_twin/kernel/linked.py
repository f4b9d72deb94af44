"""Compile what only kernels call to code for linking: numba would optimise it and make machine code of it once more.

A kernel is optimised as a whole, together with all that it calls, so whatever was done to the parts alone is done in
vain. It takes a quarter of the time of compiling, which is left out here by numba's own means: a compiler of one's own
(numba's manual, "Customizing the Compiler"), which lowers into a library of one's own.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import llvmlite.ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import AnnotateTypes

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


@register_pass(mutates_CFG=False, analysis_only=True)
class _LowerForLinking(AnalysisPass):
    _name = "lower_for_linking"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return False


class LinkedCompiler(CompilerBase):
    """numba's compiler, but for the library that it lowers into."""

    def define_pipelines(self) -> list[Any]:
        """Give numba's passes, with the choice of the library before lowering."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_LowerForLinking, AnnotateTypes)
        passes.finalize()
        return [passes]


def keep_from_python(dispatcher: Any) -> None:
    """Make a call from Python an error: there is no machine code to go to."""

    def refuse(*arguments: Any, **named: Any) -> None:
        raise TypeError(f"{dispatcher.py_func.__qualname__} is for kernels to call: it would have to be an entry")

    dispatcher._insert, dispatcher._compile_for_args = lambda *overload, **options: None, refuse
