"""A process beside a twin, whose faults do not affect the twin."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from typing import Any, Final, Self

from plow_twin.dashboard.link import pair

#: Longest time that the process may take to end [s].
END_S: Final = 3.0


class Beside:
    """A running process and the link to it, as a context manager that ends the process.

    The arguments of the module are the descriptor of the link, then `descriptors`. The message `first` carries the
    secrets, because other users can read a command line.
    """

    def __init__(self, module: str, first: dict[str, Any], descriptors: Sequence[int] = ()) -> None:
        self.link, theirs = pair()
        with theirs:
            numbers = (theirs.fileno(), *descriptors)
            # in its own session, the process gets no Ctrl-C; it ends with the twin
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
