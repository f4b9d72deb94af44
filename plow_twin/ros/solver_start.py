"""The solver compiled beside the main thread: a request to stop is seen while the compiler works."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Final

from plow_twin.errors import PlowTwinError
from plow_twin.run.twin import Twin

#: Longest time for which a request to stop is not seen [s].
_LOOK_S: Final = 0.05
_unfinished: list[Future[float]] = []


class StartAbandoned(PlowTwinError):
    """A stop was asked for while the solver was compiled."""


def warm_up(twin: Twin, stop_asked: Callable[[], bool]) -> float:
    """Compile or load every kernel of a twin; return the seconds it took.

    Raises
    ------
    StartAbandoned
        A stop was asked for; the compiler cannot be interrupted and still works.
    """
    compiler = ThreadPoolExecutor(1, thread_name_prefix="compiler")
    future = compiler.submit(twin.warm_up)
    compiler.shutdown(wait=False)
    while not wait((future,), _LOOK_S).done:
        if stop_asked():
            _unfinished.append(future)
            raise StartAbandoned("a stop was asked for while the solver was compiled")
    return future.result()


def leave(code: int) -> int:
    """Return the exit code; end the process here when an abandoned compiler would hold it up."""
    if all(future.done() for future in _unfinished):
        return code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
