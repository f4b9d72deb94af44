"""What is left out of numba's work when kernels are compiled."""

from __future__ import annotations

import operator
import subprocess
import sys
from copy import copy
from typing import Any

import llvmlite.binding as llvm
import llvmlite.ir
import numba
import pytest
from numba.core import postproc
from numba.core.compiler import DefaultPassBuilder, Flags
from numba.core.registry import cpu_target
from numba.core.typing.context import Context

from plow_twin.kernel.compiler import FASTMATH, kernel
from plow_twin.kernel.quick import UNUSED, QuickPasses, ask_llvm_once, caching_context, without_lock_events


def _flags(fastmath: bool) -> Flags:
    flags = Flags()
    flags.fastmath = set(FASTMATH) if fastmath else False
    return flags


def test_numba_has_every_pass_that_is_left_out() -> None:
    """A pass of another name would come back, and cost its time, unseen."""
    state = type("State", (), {"flags": _flags(False), "func_ir": None})()
    whole = DefaultPassBuilder.define_nopython_pipeline(state)
    names, left = ({one.__name__ for one, _ in passes.passes} for passes in (whole, QuickPasses(whole)))
    assert names - left == UNUSED


def test_a_sum_of_two_numbers_is_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_up, resolve = [], Context.resolve_function_type

    def count(self: Context, func: Any, args: Any, kws: Any) -> Any:
        looked_up.append(func)
        return resolve(self, func, args, kws)

    monkeypatch.setattr(Context, "resolve_function_type", count)
    cpu_target.target_context.refresh()
    context = caching_context(cpu_target.typing_context, Flags())
    context._signatures.clear()
    for kind in (numba.float64, numba.float64, numba.int64):
        assert context.resolve_function_type(operator.add, (kind, kind), {}).return_type == kind
    assert looked_up == [operator.add] * 2


def test_what_numba_made_for_fast_kernels_is_not_remembered_for_exact_ones() -> None:
    """Numba compiles its own `max` for the flags of the kernel that asks: its code may be reordered for one alone."""
    context = cpu_target.typing_context
    exact, fast = (caching_context(context, _flags(fastmath)) for fastmath in (False, True))
    assert exact is not fast
    assert caching_context(context, _flags(False)) is exact and caching_context(context, _flags(True)) is fast


def test_who_listens_to_llvms_lock_is_told_again_afterwards() -> None:
    told: list[str] = []
    listener = (lambda: told.append("taken"), lambda: told.append("released"))
    llvm.ffi.register_lock_callback(*listener)
    try:
        with pytest.raises(RuntimeError, match="parsing"), without_lock_events():
            llvm.parse_assembly("no module")
        assert not told
        llvm.parse_assembly("")
        assert set(told) == {"taken", "released"}
    finally:
        llvm.ffi.unregister_lock_callback(*listener)


def test_llvm_is_asked_once_for_the_size_of_a_type(monkeypatch: pytest.MonkeyPatch) -> None:
    """It parses a module for the answer, for each access to an array."""
    target = copy(cpu_target.target_context)
    target.__dict__.pop("get_abi_sizeof", None)
    asked: list[Any] = []
    parse = llvm.parse_assembly
    monkeypatch.setattr(llvm, "parse_assembly", lambda *text: asked.append(text) or parse(*text))
    ask_llvm_once(target)
    pair = llvmlite.ir.LiteralStructType([llvmlite.ir.DoubleType()] * 2)
    assert [target.get_abi_sizeof(pair) for _ in range(3)] == [16] * 3
    assert len(asked) == 1


def test_lifetimes_of_variables_are_found_once_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba finds them after each of six passes, and deletes variables after the last."""
    found, lifetime = [], postproc.VariableLifetime
    monkeypatch.setattr(postproc, "VariableLifetime", lambda blocks: found.append(len(blocks)) or lifetime(blocks))
    monkeypatch.setattr(sum_to._cache, "load_overload", lambda signature, target: None)
    assert sum_to(4) == 10
    assert len(found) == 1


@kernel(entry=True)
def sum_to(n: int) -> int:
    total = 0
    for k in range(n + 1):
        total += k
    return total


BLAS = (
    "import sys, numpy as np, numba; from plow_twin.kernel import compiler; "
    "print('scipy.linalg' in sys.modules, end=' '); "
    "print(numba.njit(lambda a: np.dot(a, a))(np.arange(4.0)), 'scipy.linalg.cython_blas' in sys.modules)"
)


def test_blas_is_loaded_where_it_is_used() -> None:
    """Numba loads it to see whether it is there: that took a fifth of a start."""
    done = subprocess.run([sys.executable, "-c", BLAS], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "14.0", "True"], done.stderr
