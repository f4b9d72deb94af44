"""The decorator of every compiled function: numba with a cache on disk that notices a change in any kernel.

Numba's own cache looks at the file of the function that is called, not at those of the functions it calls: a change
there would go unseen. Here the stamp of each cached function stands for the text of all kernels.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal

import numba

from plow_twin.kernel.linked import EntryCompiler, LinkedCompiler, background, keep_from_python
from plow_twin.kernel.quick import load_numba

#: Value-preserving relaxations only: sums may be reordered and fused, but NaN and infinity keep their meaning.
FASTMATH: Final = frozenset({"contract", "reassoc", "nsz", "arcp"})

_said: set[str] = set()

load_numba()

#: Subpackages that hold compiled functions, with all their folders.
KERNEL_FOLDERS: Final = ("kernel", "model", "solve")


def _source_digest() -> str:
    package = Path(__file__).resolve().parent.parent
    digest = hashlib.blake2b(digest_size=16)
    for folder in KERNEL_FOLDERS:
        for source in sorted((package / folder).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


SOURCE_DIGEST: Final = _source_digest()


def kernel(
    *, fast: bool = False, inline: Literal["code", "source"] | None = None, entry: bool = False
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function.

    Parameters
    ----------
    fast : bool
        Allow reordered and fused sums.
    inline : {"code", "source"}, optional
        Inline it into its callers: its code, or its source, which compiles more slowly but follows the caller's `fast`
        and may return records, which numba's functions cannot.
    entry : bool
        Python calls it too, not kernels alone: that takes a wrapper, which costs a tenth of the time of compiling.
    """
    options: dict[str, Any] = {"fastmath": set(FASTMATH)} if fast else {}
    if inline == "source":
        options["inline"] = "always"
    else:
        options["forceinline"] = inline == "code"
        options["no_cpython_wrapper"], options["no_cfunc_wrapper"] = not entry, True
        options["pipeline_class"] = EntryCompiler if entry else LinkedCompiler

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        # absent when numba is told not to compile
        cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if cache_file is not None:
            cache_file._source_stamp = SOURCE_DIGEST
            # read before the rest of an index, which cannot be read once a type that it names is gone
            cache_file._version = f"{numba.__version__} {SOURCE_DIGEST}"
            linked = inline != "source" and not entry
            if linked:
                keep_from_python(dispatcher)
            save_or_warn(dispatcher, later=linked)
        compiled: Callable[..., Any] = dispatcher
        return compiled

    return decorate


def save_or_warn(dispatcher: Any, *, later: bool = False) -> None:
    """Let a disk that does not take the cache be a warning, and no error: what is compiled works without it.

    `later` : written when LLVM is done with what goes into it.
    """
    cache = dispatcher._cache
    save = cache.save_overload

    def attempt(signature: Any, result: Any) -> None:
        try:
            save(signature, result)
        except OSError as error:
            place = Path(cache.cache_path).parent
            text = f"compiled kernels are not kept for the next start: {place}: {error.strerror or error}"
            if text not in _said:  # numba makes Python forget which warnings it has given
                _said.add(text)
                warnings.warn(text, RuntimeWarning, stacklevel=1)

    if later:
        cache.save_overload = lambda signature, result: background.do(attempt, signature, result)
    else:
        cache.save_overload = attempt


def for_arguments(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., Any]:
    """Return an entry compiled for the types of some arguments; a call of it looks at no types.

    For calls whose types never change: to look at those of nested tuples and records takes longer than a sample's work.
    """
    compile_for = getattr(function, "compile", None)
    if compile_for is None:
        return function  # numba is told not to compile
    found: Callable[..., Any] = compile_for(tuple(map(numba.typeof, arguments)))
    return found
