"""Compile what only kernels call to code for linking: numba would optimise it and make machine code of it once more.

A kernel is optimised as a whole, together with all that it calls, so whatever was done to the parts alone is done in
vain. It takes a quarter of the time of compiling, which is left out here by numba's own means: a compiler of one's own
(numba's manual, "Customizing the Compiler"), which lowers into a library of one's own.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import llvmlite.ir
from numba.core.cgutils import normalize_ir_text
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

from plow_twin.kernel.background import Background
from plow_twin.kernel.quick import QuickPasses, ask_llvm_once, caching_context, garbage_kept, without_lock_events

_ENVIRONMENT = "_ZN08NumbaEnv"

#: What LLVM does to linked code, beside the typing and lowering of what calls it.
background = Background()


class LinkedLibrary(JITCodeLibrary):
    """The code of a kernel, as its callers link it; its machine code holds nothing but the variables numba sets."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._texts: list[tuple[str, str]] = []
        self._exported: list[str] = []
        #: whether sums may be reordered and fused: what it is inlined into may change its bits
        self.fast = False

    def add_ir_module(self, ir_module: llvmlite.ir.Module) -> None:
        """Take functions as text."""
        self._texts.append((ir_module.name, normalize_ir_text(str(ir_module))))
        defined = (function for function in ir_module.functions if not function.is_declaration)
        self._exported += [function.name for function in defined if not function.linkage]

    def finalize(self) -> None:
        """Have LLVM make of the text what callers link, in the background."""
        self._finalized = True
        self._wait = background.do(self._link, list(dict.fromkeys(self._linking_libraries)))

    def _link(self, libraries: list[JITCodeLibrary]) -> None:
        for name, text in self._texts:
            functions = llvm.parse_assembly(text)
            functions.name = name
            functions.verify()
            self.add_llvm_module(functions)
        self._texts.clear()
        whole = self._final_module
        self._finalize_dynamic_globals()
        environments = _environments(whole)
        for library in libraries:
            whole.link_in(library._get_module_for_linking(), preserve=True)
            self._dynamic_globals += library._dynamic_globals
            environments |= _environments(library._final_module)
        for name in self._exported:
            # a caller holds it, or leaves it out
            whole.get_function(name).linkage = "linkonce_odr" if self.fast else "weak_odr"
        self._shared_module = whole
        self._final_module = _variables(self._codegen._create_empty_module(self.name), environments)
        self._set_compiled_object(self._codegen._tm.emit_object(self._final_module))

    def _get_module_for_linking(self) -> llvm.ModuleRef:
        self._ensure_finalized()
        self._wait()
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
    """The code of a kernel that Python calls, with all that it calls for itself alone.

    Otherwise the first entry loaded would lend its copies of them to the next: optimised for another caller, they may
    differ in the last bit. LLVM knows it before it optimises, and inlines what is called at one place, but for `fast`
    code, which is left its size as the only reason: elsewhere its sums would be reordered in other ways.
    """

    def _optimize_final_module(self) -> None:
        self._keep(llvm.Linkage.weak_odr)
        super()._optimize_final_module()
        self._keep(llvm.Linkage.linkonce_odr)

    def _keep(self, linkage: llvm.Linkage) -> None:
        """Keep the functions of a linkage for this entry."""
        for function in self._final_module.functions:
            if function.linkage == linkage and not function.is_declaration:
                function.linkage = llvm.Linkage.internal


def _new_library(state: Any, kind: type[JITCodeLibrary]) -> JITCodeLibrary:
    library = kind(state.targetctx.codegen(), state.func_id.func_qualname)
    library.enable_object_caching()
    return library


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerForLinking(NativeLowering):
    """Numba's pass, but that nothing is made ready to be called."""

    _name = "lower_for_linking"

    def run_pass(self, state: Any) -> bool:
        state.library = _new_library(state, LinkedLibrary)
        state.library.fast = bool(state.flags.fastmath)
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        # stands for the function wherever a caller is lowered
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

    def __init__(self, typing: Any, target: Any, library: Any, args: Any, result: Any, flags: Any, local: Any) -> None:
        ask_llvm_once(target)
        super().__init__(caching_context(typing, flags), target, library, args, result, flags, local)

    def define_pipelines(self) -> list[Any]:
        passes = QuickPasses(DefaultPassBuilder.define_nopython_pipeline(self.state))
        passes.passes = [(self.lowering if one is NativeLowering else one, said) for one, said in passes.passes]
        passes.finalize()
        return [passes]


class LinkedCompiler(_Compiler):
    """numba's compiler, but for the library that it lowers into: for what kernels call."""

    lowering = _LowerForLinking


class EntryCompiler(_Compiler):
    """numba's compiler, but for the library that it lowers into: for what Python calls, with all that it calls."""

    lowering = _LowerForPython

    def compile_extra(self, func: Any) -> Any:
        """Compile, as numba's own."""
        with garbage_kept(), without_lock_events(), background.running():
            return super().compile_extra(func)


def keep_from_python(dispatcher: Any) -> None:
    """Make a call from Python an error: there is no machine code to go to."""

    def refuse(*arguments: Any, **named: Any) -> None:
        raise TypeError(f"{dispatcher.py_func.__qualname__} is for kernels to call: it would have to be an entry")

    dispatcher._insert, dispatcher._compile_for_args = lambda *overload, **options: None, refuse
