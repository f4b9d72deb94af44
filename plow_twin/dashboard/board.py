"""State of the server of the screen: the newest values, and the history of the last hour."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Any, Final

from plow_twin.dashboard.history import History

_EVENTS: Final = 200


class Board:
    """The newest values. Each value is stored with the number of the update that contained it."""

    def __init__(self) -> None:
        self.version = 0
        self._facts: dict[str, Any] = {}
        self._facts_version = self._anew_version = 0
        self._parts: dict[str, tuple[int, Any]] = {}
        self._events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_EVENTS)
        self._motion: dict[str, Any] | None = None
        self._history = History()
        self._not_taken = 0
        self._updated_s = time.monotonic()
        #: Event that the next update sets and replaces.
        self.news = asyncio.Event()
        self.pages = 0

    def add(self, update: dict[str, Any]) -> None:
        """Add an update of the feed."""
        self.version = version = self.version + 1
        self._updated_s = time.monotonic()
        self._not_taken = update["not_taken"]
        if "facts" in update:
            self._facts, self._facts_version = update["facts"], version
        for name, part in update.get("parts", {}).items():
            self._parts[name] = (version, part)
        if "motion" in update:
            self._motion = update["motion"]
            if self._history.add(self._motion, version):
                self._anew_version = version
        self._events.extend((version, event) for event in update.get("events", ()))
        self.wake()

    def wake(self) -> None:
        """Wake all pages that wait for an update."""
        news, self.news = self.news, asyncio.Event()
        news.set()

    def since(self, version: int) -> dict[str, Any]:
        """Return all values that are newer than the update `version`."""
        facts: dict[str, Any] = {
            "version": self.version,
            "age": round(time.monotonic() - self._updated_s, 2),
            "not_taken": self._not_taken,
            "pages": self.pages,
        }
        if self.version == version:
            return facts
        if self._facts_version > version:
            facts["facts"] = self._facts
        facts["parts"] = {name: part for name, (at, part) in self._parts.items() if at > version}
        facts["events"] = [event for at, event in self._events if at > version]
        facts["anew"] = self._anew_version > version
        facts["seconds"] = self._history.since(0 if facts["anew"] else version)
        facts["motion"] = self._motion
        return facts
