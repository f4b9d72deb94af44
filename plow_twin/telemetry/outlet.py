"""An output of a twin: a process, a feed to the process, and a part of the diagnostics."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from typing import Any, Final

from plow_twin.dashboard.beside import END_S, Beside
from plow_twin.dashboard.feed import Feed
from plow_twin.live.part import Part
from plow_twin.telemetry.access import OutputSpec
from plow_twin.telemetry.output import TelemetryError

#: Longest time in which an output must open [s]. Most of the time is needed to import the library of the output.
_START_S: Final = 60.0


class Outlet(Beside):
    """Context manager that runs an output in a separate process.

    The arguments `facts` and `answer` are described in `Feed`. The function `on_error` receives a text whenever the
    receiver of the output stops or resumes accepting messages. `TelemetryError` is raised if the output cannot be
    opened. `ModuleNotFoundError` is raised if the library of the output is missing.
    """

    def __init__(
        self,
        output: OutputSpec,
        facts: dict[str, Any],
        answer: Callable[[str, str], tuple[bool, str]] | None,
        on_error: Callable[[str], object],
    ) -> None:
        super().__init__("plow_twin.telemetry.process", {**output.first, "facts": facts}, output.modules)
        self.name, self.address, self._on_error = output.name, output.address, on_error
        ended = f"the process of {output.address}", "nothing is sent there any more"
        self.feed = Feed(self.link, facts, answer, None, on_error, *ended)
        self._trouble = ""
        give_up = time.monotonic() + _START_S
        while not (self.feed.report or self.link.broken) and time.monotonic() < give_up:
            select.select([self.link], [], [], 0.1)
            self.feed.receive()
        if not self.feed.report or "failed" in self.feed.report:
            failed = self.feed.report.get("failed", f"{self.address}: its process has ended")
            super().close()
            raise TelemetryError(failed)

    def turn(self) -> None:
        """Send an update. If the receiver has stopped or resumed accepting messages, report the change."""
        self.feed.turn()
        trouble = self.feed.report["trouble"]
        if trouble != self._trouble:
            self._on_error(f"{self.address}: {trouble or 'takes messages now'}")
            self._trouble = trouble

    def part(self) -> Part:
        """Return the level, the message and the values for the diagnostics."""
        report = self.feed.report
        values = {"address": self.address, "connected": str(report["connected"]).lower()}
        values |= {key: str(report[key]) for key in ("sent", "lost")}
        values |= {"not_taken": str(self.feed.not_taken), "trouble": report["trouble"]}
        trouble = "its process does not read updates" if self.feed.blocked else report["trouble"]
        message = "its process has ended" if self.link.broken else trouble
        return int(bool(message)), message, values

    def close(self) -> None:
        """Send the newest values, wait for the receiver, and end the process."""
        self.feed.send()
        give_up = time.monotonic() + END_S
        asked = False
        while not self.link.broken and time.monotonic() < give_up:
            asked = asked or self.link.send({"end": True})
            select.select([self.link], [], [], 0.1)
            self.feed.receive()
        super().close()
