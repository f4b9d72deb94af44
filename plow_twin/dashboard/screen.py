"""The operator's screen of a twin: a server process, and the feed that sends updates to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from plow_twin.access import in_url
from plow_twin.dashboard.access import PageAccess, listening
from plow_twin.dashboard.beside import Beside
from plow_twin.dashboard.feed import Array, Feed


class Screen(Beside):
    """Context manager that runs the server of the screen and the feed.

    The arguments after `access` are those of `Feed`. Raise `DashboardError` if the address cannot be used, and
    `ModuleNotFoundError` if a library of the server is not installed.
    """

    def __init__(
        self,
        access: PageAccess,
        facts: dict[str, Any],
        answer: Callable[[str, str], tuple[bool, str]] | None = None,
        load: Callable[[], Array] | None = None,
        on_error: Callable[[str], object] = lambda text: None,
    ) -> None:
        with listening(access) as page:
            port = int(page.getsockname()[1])
            needed = "starlette", "uvicorn", "websockets"
            super().__init__("plow_twin.dashboard.server", asdict(access), needed, (page.fileno(),))
        self.url = f"http://{in_url(access.host)}:{port}/"
        self.feed = Feed(self.link, facts, answer, load, on_error, by_second=True)

    @property
    def has_ended(self) -> bool:
        """True if the server has ended."""
        return self.link.broken
