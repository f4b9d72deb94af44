"""LLVM's work beside numba's when kernels are compiled."""

from __future__ import annotations

import os
import threading

import pytest

from plow_twin.kernel import linked
from plow_twin.kernel.background import Background
from plow_twin.kernel.compiler import kernel


@kernel()
def _square(x: float) -> float:
    return x * x


@kernel(entry=True)
def _quartic(x: float) -> float:
    return _square(_square(x))


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> list[threading.Thread]:
    """Names of the threads in which LLVM works on what is linked."""
    found: list[threading.Thread] = []
    link = linked.LinkedLibrary._link

    def note(library, libraries) -> None:
        found.append(threading.current_thread())
        link(library, libraries)

    monkeypatch.setattr(linked.LinkedLibrary, "_link", note)
    # nothing that a former run has compiled
    for function in (_square, _quartic):
        monkeypatch.setattr(function._cache, "load_overload", lambda signature, target: None)
    return found


@pytest.mark.parametrize(("processors", "argument"), [(2, 3.0), (1, 3)])
def test_llvm_works_in_a_thread_where_there_is_a_second_processor(
    monkeypatch: pytest.MonkeyPatch, threads: list[threading.Thread], processors: int, argument: float
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    assert _quartic(argument) == 81
    assert threads and all((one is not threading.main_thread()) == (processors > 1) for one in threads)
    assert not any(one.is_alive() for one in threads if one is not threading.main_thread())


def test_an_error_in_the_background_is_raised_when_it_ends() -> None:
    background, done = Background(), []
    with pytest.raises(OSError, match="no space"), background.running():
        background.do(_fail)
        background.do(done.append, "what came after")
    assert done == ["what came after"]
    with pytest.raises(OSError, match="no space"):
        background.do(_fail)


def _fail() -> None:
    raise OSError("no space left")
