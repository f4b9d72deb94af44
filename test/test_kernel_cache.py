"""The cache of compiled kernels on disk."""

from __future__ import annotations

import ast
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import IndexDataCacheFile

from plow_twin.kernel.compiler import KERNEL_FOLDERS, kernel, share
from plow_twin.model import contact

ROOT = Path(__file__).resolve().parent.parent
#: Program that prints the number of machine-code functions of the kernel `mode_inside`, which only `settle_modes`
#: calls.
LINKED = (
    "from plow_twin import load_scene; from plow_twin.solve import compiled_scene, modes; "
    "compiled_scene.compile_scene(load_scene('paper'), 1e-6).initial_state(); "
    "(overload,) = modes.mode_inside.overloads.values(); print(len(list(overload.library.get_defined_functions())))"
)
#: Second part of the program. It prints whether a kernel called by Python contains copies of the kernels that it calls.
ENTRY = (
    "; (overload,) = modes.settle_modes.overloads.values(); "
    "held = [function.linkage.name for function in overload.library.get_defined_functions()]; "
    "print(bool(held), 'linkonce_odr' in held or 'weak_odr' in held)"
)
MISSES = (
    "import numpy as np; from plow_twin.model.contact import power_term; a = np.ones((1, 8)); "
    "power_term(a, a, 0, 0, 1.5, 0); print(sum(power_term.stats.cache_misses.values()))"
)


def run(cache: Path, program: str = MISSES) -> str:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    completed = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    return completed.stdout.strip()


def test_an_index_of_other_sources_is_replaced_unread(tmp_path: Path) -> None:
    """After an upgrade, an index may name removed types. Reading it would raise an error."""
    assert run(tmp_path) == "1" and run(tmp_path) == "0"
    (index,) = tmp_path.rglob("contact.power_term*.nbi")
    index.write_bytes(pickle.dumps("another version") + b"cannot be read")
    assert run(tmp_path) == "1" and run(tmp_path) == "0"


def cache_file(folder: Path, sources: str) -> Any:
    file = IndexDataCacheFile(str(folder), "module.kernel[1].py311", sources)
    share(file)
    return file


def test_processes_that_save_at_once_do_not_exchange_code(tmp_path: Path) -> None:
    """The second process reads the index first, and writes between the two writes of the first process."""
    first, second = (cache_file(tmp_path, "sources") for _ in range(2))
    write, opened = first._open_for_write, []

    def interrupted(path: str) -> Any:
        opened.append(path)
        if len(opened) == 2:
            second.save("signature 2", "code 2")
        return write(path)

    first._open_for_write = interrupted
    second._load_index = dict
    first.save("signature 1", "code 1")
    del second._load_index
    signatures = {number: second.load(f"signature {number}") for number in (1, 2)}
    assert (
        signatures[1] in (None, "code 1") and signatures[2] in (None, "code 2") and set(signatures.values()) != {None}
    )


def test_code_of_other_sources_is_removed(tmp_path: Path) -> None:
    old, new = (cache_file(tmp_path, sources) for sources in ("old", "new"))
    old.save("signature", "old code")
    new.save("signature", "new code")
    new.save("another", "other code")
    assert len(list(tmp_path.glob("*.nbc"))) == 2 and new.load("signature") == "new code"
    assert old.load("signature") is None


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["empty", "zeros", "half", "bit"])
def test_a_damaged_file_is_compiled_and_written_again(suffix: str, damage: str, tmp_path: Path) -> None:
    """After a loss of power, each command would otherwise end with an error of `pickle`, or run damaged code."""
    cache_file(tmp_path, "sources").save("signature", "code")
    (path,) = tmp_path.glob(f"*.{suffix}")
    whole = path.read_bytes()
    flipped = bytes(byte ^ (16 * (place == len(whole) - 3)) for place, byte in enumerate(whole))
    path.write_bytes(
        {"empty": b"", "zeros": bytes(len(whole)), "half": whole[: len(whole) // 2], "bit": flipped}[damage]
    )
    file = cache_file(tmp_path, "sources")
    assert file.load("signature") is None
    file.save("signature", "code")
    assert cache_file(tmp_path, "sources").load("signature") == "code"


def test_an_inner_kernel_is_copied_into_each_entry_and_has_no_machine_code(tmp_path: Path) -> None:
    """Separate compilation of such a kernel, in addition to its callers, would take a third of the time.

    Without copies, bits would depend on the entry that a process loads first, and on whether it compiles or loads
    entries.
    """
    assert run(tmp_path, LINKED + ENTRY).splitlines() == ["0", "True False"]


def test_a_call_from_python_of_a_kernel_without_machine_code_is_an_error() -> None:
    assert normal_force(1e-3, 0.0, 1e7, 1.0, 0.0, 0.0, 0.0) == 1e4  # this call compiles the kernel for its caller
    with pytest.raises(TypeError, match="normal_force is for kernels to call"):
        contact.normal_force(1e-3, 0.0, 1e7, 1.0, 0.0, 0.0, 0.0)


@kernel(entry=True)
def normal_force(*numbers: float) -> float:
    return contact.normal_force(*numbers)


@kernel()
def twice(number: int) -> int:
    return 2 * number


@kernel(entry=True)
def twice_both(number: int) -> int:
    return twice(number) + twice(3)


def test_a_kernel_is_compiled_once_for_numbers_and_constants(tmp_path: Path) -> None:
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'test')!r}); from test_kernel_cache import twice, twice_both; "
        "print(twice_both(4), len(twice.signatures))"
    )
    assert run(tmp_path, program) == "14 1"


def test_an_unwritable_cache_gives_one_warning_and_the_run_continues(tmp_path: Path) -> None:
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); "
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    completed = subprocess.run([sys.executable, "-c", full + LINKED], env=environment, capture_output=True, text=True)
    assert (completed.returncode, completed.stdout) == (0, "0\n"), completed.stderr
    errors = [line for line in completed.stderr.splitlines() if "RuntimeWarning:" in line]
    assert len(errors) == 1 and errors[0].endswith(f"{tmp_path}: File too large"), completed.stderr


def test_no_kernel_assigns_an_array_to_a_slice() -> None:
    """Numba would also compile the formatting of its error message, which takes 2 s in each process.

    `copy_into` has none.
    """
    mistakes = []
    for folder in KERNEL_FOLDERS:
        for source in sorted((ROOT / "plow_twin" / folder).rglob("*.py")):
            kernels = [node for node in ast.walk(ast.parse(source.read_text())) if _is_kernel(node)]
            inside = (node for function in kernels for node in ast.walk(function))
            mistakes += [f"{source.name}:{node.lineno}" for node in inside if _assigns_a_slice(node)]
    assert mistakes == []


def _is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(one) for one in node.decorator_list)


def _assigns_a_slice(node: ast.AST) -> bool:
    if not isinstance(node, ast.Assign) or isinstance(node.value, ast.Constant):
        return False
    return any(isinstance(part, ast.Slice) for target in node.targets for part in ast.walk(target))
