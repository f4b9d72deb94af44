"""Work of LLVM on one function in a thread, while Python types and lowers the next one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Final

#: How soon Python's other threads let the worker go on after a call of LLVM, in s.
SWITCH_INTERVAL: Final = 2e-4


class Background:
    """One worker that does what it is given in that order; what it is given outside `running` is done at once."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._given: list[Future[Any]] = []

    def do(self, work: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Have work done, and return what waits for its end and returns or raises what came of it."""
        if self._pool is None:
            result = work(*arguments)
            return lambda: result
        given = self._pool.submit(work, *arguments)
        self._given.append(given)
        return given.result

    @contextmanager
    def running(self) -> Iterator[None]:
        """Keep a worker, and wait for all that it was given; its errors are raised here at the latest."""
        if self._pool is not None or (os.cpu_count() or 1) < 2:
            yield
            return
        interval = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_INTERVAL)
        try:
            with ThreadPoolExecutor(1) as self._pool:
                yield
                for given in self._given:
                    given.result()
        finally:
            sys.setswitchinterval(interval)
            self._pool, self._given = None, []
