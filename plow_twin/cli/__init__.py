"""The command `plow-twin`, whose verbs call the library.

Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss. Results go to standard output, progress
and errors to standard error.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit code."""
    _open_what_is_closed()
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        sys.exit("plow-twin: NUMBA_DISABLE_JIT is set, expected it unset, as the solver is compiled")
    with _ending_at_once():
        # an interrupted import may raise another error
        try:
            import plow_twin.run.twin  # noqa: F401
            from plow_twin.cli.app import main as run
        except (ImportError, OSError, MemoryError) as error:
            newer = (
                "" if sys.version_info < (3, 13) else f"; this is Python 3.{sys.version_info[1]}, expected 3.11 or 3.12"
            )
            why = error.__context__ or error or "not enough memory"
            sys.exit(f"plow-twin: a library cannot be loaded: {why}{newer}")

    run(arguments)


def _open_what_is_closed() -> None:
    """Open /dev/null for closed standard streams, so that no file gets their descriptors."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, encoding="utf-8"))


@contextmanager
def _ending_at_once() -> Iterator[None]:
    """End the process on Ctrl-C without a traceback; no work has begun."""

    def end(*_: object) -> None:
        os.write(2, b"plow-twin: interrupted\n")
        os._exit(1)

    # a caller may ignore or handle Ctrl-C
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
