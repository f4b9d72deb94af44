"""Decorator that compiles functions by numba, with a disk cache that is invalidated when any kernel changes.

Numba's own cache checks only the file of the cached function, and misses changes in the functions that it calls. The
decorator adds to each cache entry a digest of the source of all kernels.
"""

from __future__ import annotations

import glob
import hashlib
import pickle
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any, Final, Literal

import numba
from numba.core import caching
from numba.core.registry import cpu_target
from numba.np import linalg

from plow_twin.kernel.linked import EntryCompiler, LinkedCompiler, for_any_value, garbage_kept, keep_from_python

#: Flags of LLVM for `fast` kernels. They allow LLVM to reorder and fuse sums, but not to neglect NaN or infinity.
FASTMATH: Final = frozenset({"contract", "reassoc", "nsz", "arcp"})

#: Text of the warning about the cache, once the warning has been issued.
_said: list[str] = []


def _load_numba() -> None:
    """Load numba's tables of types and of code without importing SciPy's linear algebra.

    Numba would import SciPy's linear algebra only to check that BLAS is available, which takes a third of the start
    time.
    """
    ensure_blas = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        with garbage_kept():
            cpu_target.target_context.refresh()
    finally:
        linalg.ensure_blas = ensure_blas


_load_numba()

#: Subpackages with compiled functions.
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
    """Return a decorator that compiles a function.

    Parameters
    ----------
    fast : bool
        Whether sums may be reordered and fused.
    inline : {"code", "source"}, optional
        "code" inlines the LLVM code of the function into its callers. "source" inlines the Python source. Only a
        function with inlined source can return records. Its compilation takes longer, and its sums are reordered if the
        caller is `fast`.
    entry : bool
        Whether the function can be called from Python, which adds a tenth to the compile time.
    """
    # without the option, numba would use the option of the caller for which the function is compiled first
    options: dict[str, Any] = {"fastmath": set(FASTMATH) if fast else False}
    if inline == "source":
        options["inline"] = "always"
    else:
        options["forceinline"] = inline == "code"
        options["no_cpython_wrapper"], options["no_cfunc_wrapper"] = not entry, True
        options["pipeline_class"] = EntryCompiler if entry else LinkedCompiler

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = kept(function, **options)
        if hasattr(dispatcher, "_compiler"):  # with NUMBA_DISABLE_JIT the dispatcher is the Python function
            for_any_value(dispatcher)
        cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if cache_file is not None:
            cache_file._source_stamp = SOURCE_DIGEST
            # numba compares the version before it unpickles the index, which would fail on a type that the sources no
            # longer contain
            cache_file._version = f"{numba.__version__} {SOURCE_DIGEST}"
            if inline != "source" and not entry:
                keep_from_python(dispatcher)
        compiled: Callable[..., Any] = dispatcher
        return compiled

    return decorate


def for_kernels(entry: Callable[..., Any]) -> Callable[..., Any]:
    """Return a copy of an entry (a kernel that Python calls) for calls from kernels.

    If a kernel called the entry itself, numba would generate machine code for the entry that is never run.
    """
    function = getattr(entry, "py_func", None)
    if function is None:
        return entry  # NUMBA_DISABLE_JIT: the entry is a plain Python function
    copy = FunctionType(function.__code__, function.__globals__, function.__name__)
    # numba derives the names of cache files from `__qualname__`, so the copy needs a different name
    copy.__qualname__ = f"{function.__qualname__}_for_kernels"
    return kernel()(copy)


@contextmanager
def _read_only_cache() -> Iterator[None]:
    """Make numba accept a read-only disk cache in the package's folder, for example from the installation."""
    locator: Any = caching._CacheLocator
    ensure_cache_path = locator.ensure_cache_path
    locator.ensure_cache_path = lambda its: None
    try:
        yield
    finally:
        locator.ensure_cache_path = ensure_cache_path


def kept(function: Callable[..., Any], **options: Any) -> Any:
    """Return numba's dispatcher with a disk cache. Warn once if the cache cannot be written."""
    compiler = numba.njit(cache=True, nogil=True, error_model="numpy", **options)
    try:
        dispatcher = compiler(function)
    except RuntimeError:  # neither the package's folder nor the user's cache folder is writable
        with _read_only_cache():
            dispatcher = compiler(function)
    if hasattr(dispatcher, "_cache"):  # with NUMBA_DISABLE_JIT the function has no `_cache`
        share(dispatcher._cache._cache_file)
        _save_or_warn(dispatcher._cache)
    return dispatcher


def share(cache_file: Any) -> None:
    """Make numba's disk cache of a function safe for processes that compile at the same time, and for damaged files.

    Numba numbers the files of machine code, and writes its index before the files, so two processes could store the
    code of one signature under another signature. Here the name of a file is a hash of its content, and the file is
    written before the index. If two processes write the index at the same time, one entry is lost and compiled again.

    Files that were not on the disk at a loss of power are empty or filled with zeros afterwards. An entry whose index
    cannot be read, or whose code does not have the hash in its name, is compiled and written again.

    Parameters
    ----------
    cache_file : numba.core.caching.IndexDataCacheFile
        Cache file of the function. Its methods `save`, `load` and `_load_index` are replaced.
    """
    stem = cache_file._index_name.removesuffix("nbi")
    read_index = cache_file._load_index

    def name_of(code: bytes) -> str:
        return f"{stem}{hashlib.blake2b(code, digest_size=8).hexdigest()}.nbc"

    def load_index() -> dict[Any, str]:
        try:
            return dict(read_index())
        except Exception:  # `pickle` raises errors of any type for damaged data
            return {}

    def load(key: Any) -> Any:
        name = cache_file._load_index().get(key)
        try:
            code = b"" if name is None else Path(cache_file._data_path(name)).read_bytes()
        except OSError:
            return None
        return pickle.loads(code) if name == name_of(code) else None

    def save(key: Any, data: Any) -> None:
        code = cache_file._dump(data)
        name = name_of(code)
        with cache_file._open_for_write(cache_file._data_path(name)) as file:
            file.write(code)
        overloads = cache_file._load_index()
        # the index of other sources is loaded as empty; delete its compiled files
        if not overloads and Path(cache_file._index_path).exists():
            for old in Path(cache_file._cache_path).glob(f"{glob.escape(stem)}*.nbc"):
                if old.name != name:
                    old.unlink(missing_ok=True)
        overloads[key] = name
        cache_file._save_index(overloads)

    cache_file.save, cache_file.load, cache_file._load_index = save, load, load_index


def kept_on_disk() -> bool:
    """Return whether all kernels compiled so far could be stored in the cache."""
    return not _said


def _save_or_warn(cache: Any) -> None:
    save = cache.save_overload

    def attempt(signature: Any, result: Any) -> None:
        try:
            save(signature, result)
        except OSError as error:
            place = Path(cache.cache_path).parent
            # numba resets Python's registry of issued warnings, so `_said` prevents a repetition
            if not _said:
                _said.append(f"compiled kernels are not kept for the next start: {place}: {error.strerror or error}")
                warnings.warn(_said[0], RuntimeWarning, stacklevel=1)

    cache.save_overload = attempt


def for_arguments(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., Any]:
    """Return the kernel compiled for the types of the given arguments, without a check of its arguments.

    Numba's check of nested tuples and records takes longer than a twin's advance by one sample.
    """
    compile_for = getattr(function, "compile", None)
    if compile_for is None:
        return function  # NUMBA_DISABLE_JIT: the function is plain Python
    compiled: Callable[..., Any] = compile_for(tuple(map(numba.typeof, arguments)))
    return compiled
