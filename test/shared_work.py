"""Kernels and results that the processes of a suite share: the first process that needs them makes them."""

from __future__ import annotations

import copyreg
import fcntl
import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, TypeVar

T = TypeVar("T")
#: Name of the environment variable that names the folder of the locks and results; the suite's first process makes it.
FOLDER = "PLOW_TWIN_SHARED_WORK"


def _read_only(content: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(content)


# scenes have read-only mappings
copyreg.pickle(MappingProxyType, lambda proxy: (_read_only, (dict(proxy),)))


@contextmanager
def _locked(name: str) -> Iterator[IO[bytes]]:
    place = Path(os.environ[FOLDER]) / hashlib.blake2b(name.encode(), digest_size=8).hexdigest()
    with place.open("a+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield file


def computed_once(name: str, compute: Callable[[], T]) -> T:
    """Return a result that can be pickled; other processes that need the result wait for it."""
    with _locked(name) as file:
        file.seek(0)
        if content := file.read():
            result: T = pickle.loads(content)
            return result
        result = compute()
        file.write(pickle.dumps(result))
        return result


def compile_once() -> None:
    """Let this process wait for kernels that another process of the suite compiles, instead of compiling them too.

    Each signature of a kernel has a lock. Locks are taken in the order of calls and by only one thread of a process, so
    that no two processes wait for each other.
    """
    if FOLDER not in os.environ:
        return
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile_alone = Dispatcher.compile

    def compile_or_load(dispatcher: Any, signature: Any) -> Any:
        name = f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__} {signature}"
        with global_compiler_lock, _locked(name):
            return compile_alone(dispatcher, signature)

    Dispatcher.compile = compile_or_load
