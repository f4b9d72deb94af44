"""Interface of an output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from plow_twin.dashboard.link import Link
from plow_twin.errors import PlowTwinError
from plow_twin.telemetry.values import Group, Newest


class TelemetryError(PlowTwinError):
    """An output cannot be opened."""


@dataclass
class State:
    """State of an output.

    `sent` and `lost` count messages (or points, or updates) that the receiver has taken, and those dropped. `trouble`
    is empty, or says why the receiver takes no messages.
    """

    connected: bool = False
    sent: int = 0
    lost: int = 0
    trouble: str = ""


class Way(Protocol):
    """An output."""

    state: State

    async def open(self, link: Link, newest: Newest) -> None:
        """Open the output for the machine of `newest.facts`; operators' requests go through `link`."""

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Send the groups that have changed."""

    async def turn(self) -> None:
        """Do pending work, at least twice a second."""

    async def close(self, patience_s: float) -> None:
        """Send waiting messages within `patience_s` [s], and close."""
