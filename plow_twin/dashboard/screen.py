"""The screen beside a twin: its server as a process, and the feed that it is told by."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from importlib.util import find_spec
from types import TracebackType
from typing import Any, Final, Self

from plow_twin.dashboard.access import PageAccess, listening
from plow_twin.dashboard.feed import Array, Feed
from plow_twin.dashboard.link import pair

#: How long the server may take to end [s].
_END_S: Final = 3.0


class Screen:
    """A running server and its feed; a context that ends it.

    Parameters
    ----------
    access
        Address and token.
    facts, answer, load, on_error
        As of `Feed`.

    Raises
    ------
    DashboardError
        The address cannot be used.
    ModuleNotFoundError
        The server's libraries are not installed.
    """

    def __init__(
        self,
        access: PageAccess,
        facts: dict[str, Any],
        answer: Callable[[str, str], tuple[bool, str]] | None = None,
        load: Callable[[], Array] | None = None,
        on_error: Callable[[str], object] = lambda text: None,
    ) -> None:
        for name in ("starlette", "uvicorn", "websockets"):
            if find_spec(name) is None:
                raise ModuleNotFoundError(name, name=name)
        with listening(access) as page:
            self._link, theirs = pair()
            port = int(page.getsockname()[1])
            numbers = (theirs.fileno(), page.fileno())
            command = [sys.executable, "-m", "plow_twin.dashboard.server", *map(str, numbers)]
            # a session of its own: Ctrl-C is for the twin, whose end is the server's too
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=numbers,
                start_new_session=True,
            )
            theirs.close()
        self._link.send(asdict(access))
        host = f"[{access.host}]" if ":" in access.host else access.host
        #: address of the page
        self.url = f"http://{host}:{port}/"
        self.feed = Feed(self._link, facts, answer, load, on_error)

    @property
    def has_ended(self) -> bool:
        """Whether the server has gone: nothing is shown any more."""
        return self._link.broken

    def close(self) -> None:
        """End the server."""
        self._link.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
