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

    `sent` and `lost` count messages, points or updates that the receiver has accepted, and that were dropped. `trouble`
    is the reason why the receiver accepts no messages, or empty.
    """

    connected: bool = False
    sent: int = 0
    lost: int = 0
    trouble: str = ""


class Output(Protocol):
    """Interface of an output."""

    state: State

    async def open(self, link: Link, newest: Newest) -> None:
        """Open the output for the machine of `newest.facts`. Operator requests are sent through `link`."""

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Send the groups that have changed."""

    async def turn(self) -> None:
        """Do pending work. This method is called at least twice per second."""

    async def close(self, patience_s: float) -> None:
        """Send queued messages within `patience_s` [s], and close the output."""
