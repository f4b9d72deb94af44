"""A separate process beside a twin, whose failures do not affect the twin."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, Final, Self

from plow_twin.dashboard.link import LONGEST, Link, pair

#: Time within which the process must end after a request [s].
END_S: Final = 3.0


class Beside:
    """Context manager that runs a process and opens a link to it.

    The command-line arguments of the process are the file descriptor of the link, followed by `descriptors`. Secrets
    are sent in the message `first`, because all users of the machine can read the command line. Raise
    `ModuleNotFoundError` if one of the libraries `needed` is not installed.
    """

    def __init__(
        self, module: str, first: dict[str, Any], needed: Sequence[str], descriptors: Sequence[int] = ()
    ) -> None:
        for name in needed:
            if find_spec(name) is None:
                raise ModuleNotFoundError(name, name=name)
        self.link, theirs = pair()
        with theirs:
            numbers = (theirs.fileno(), *descriptors)
            # the process has its own session, so that Ctrl-C does not end it; `close` ends the process
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, numbers)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=numbers,
                start_new_session=True,
            )
        self.link.send(first)

    def close(self) -> None:
        """End the process."""
        self.link.close()
        try:
            self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def join_twin(nice: int) -> tuple[Link, dict[str, Any]]:
    """Return the link of this process to its twin, and the first message.

    The priority is reduced by `nice`, and Ctrl-C is ignored, because `Beside.close` ends the process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(nice)
    end = socket.socket(fileno=int(sys.argv[1]))
    first: dict[str, Any] = json.loads(end.recv(LONGEST))
    return Link(end), first
