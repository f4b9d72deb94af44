"""The command `plow-twin`, whose subcommands (verbs) call the library.

Results are written to standard output. Progress and errors are written to standard error. The exit codes are 0 (done),
1 (failed), 2 (wrong usage or scene) and 3 (done, but data were lost and counted).
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
    """Run the command line, and exit with its exit code."""
    _open_what_is_closed()
    # the matrices of an estimate are so small that several threads would mostly wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        sys.exit("plow-twin: NUMBA_DISABLE_JIT is set, expected it unset, because the solver must be compiled")
    with _ending_at_once():
        # if an ImportError has a cause, the cause is reported, because it is more precise
        try:
            if not {"-h", "--help", "-V", "--version"} & {*(sys.argv[1:] if arguments is None else arguments)}:
                import plow_twin.run.twin  # noqa: F401
            from plow_twin.cli.app import main as run
        except (ImportError, OSError, MemoryError) as error:
            newer = (
                "" if sys.version_info < (3, 13) else f"; this is Python 3.{sys.version_info[1]}, expected 3.11 or 3.12"
            )
            reason = error.__context__ or error or "not enough memory"
            sys.exit(f"plow-twin: a library cannot be loaded: {reason}{newer}")

    run(arguments)


def _open_what_is_closed() -> None:
    """Open /dev/null for closed standard streams, so that no file of the program receives the descriptors 0 to 2."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, encoding="utf-8"))


@contextmanager
def _ending_at_once() -> Iterator[None]:
    """End the process at Ctrl-C without a traceback."""

    def end(*_: object) -> None:
        os.write(2, b"plow-twin: interrupted\n")
        os._exit(1)

    # the handler is not replaced if the calling program ignores or handles Ctrl-C
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
