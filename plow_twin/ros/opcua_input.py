"""Receive inputs of the node from an OPC UA server instead of topics."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from plow_twin.live.bridge.access import read_access
from plow_twin.live.bridge.feeder import Feeder
from plow_twin.live.bridge.opcua.bridge import OpcUa
from plow_twin.live.bridge.source import BATCH
from plow_twin.live.front import roles_of
from plow_twin.live.load_model import read_load_model
from plow_twin.live.part import Part
from plow_twin.live.publishing import Front
from plow_twin.live.runtime import Runtime
from plow_twin.record.mapping import read_map
from plow_twin.record.sources import Arrived


class OpcUaInput:
    """Inputs from an OPC UA server. The object is the queue and the receiver of the inputs.

    The parameters of the node contain the server, the mapping and the credentials. At the start and after a broken
    connection, the object waits for the server. The function `warn` receives a text for each problem of the connection.
    Raise `BridgeError`, `RecordingError`, `InputError` or `OSError` if the address, the mapping or the credentials are
    invalid.
    """

    def __init__(self, runtime: Runtime, front: Front, warn: Callable[[str], None]) -> None:
        settings = runtime.settings
        mapping = Path(settings.opcua_map)
        access = read_access(settings.opcua_server, Path(settings.opcua_access) if settings.opcua_access else None)
        self._inputs, self._warn, self._said, self._lost = runtime.inputs, warn, "", 0
        self._bridge = OpcUa(
            access, read_map(mapping, None), settings.expected_rate, waits=True,
            on_arrival=lambda: os.eventfd_write(self.fd, 1),
        )  # fmt: skip
        model = read_load_model(mapping)
        roles = roles_of(self._bridge, mapping, "", model is not None)
        #: inputs that come from the server
        self.names = frozenset("excitation" if name == "drive" else name for name in roles)
        self._feeder = Feeder(roles, runtime, front.send, model if "drive" in roles else None)
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def start(self) -> None:
        """Begin to connect to the server."""
        self._bridge.start(list(self._bridge.topics()))

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Arrived], bool]:
        """Return messages that have arrived, and whether more messages may be waiting."""
        with suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        arrived = self._bridge.poll(0.0)
        return arrived, len(arrived) == BATCH

    def receive(self, topic: str, batch: list[Arrived]) -> None:
        """Pass a batch of messages to the twin."""
        self._inputs.waited(len(batch), (time.time_ns() - batch[0].log_time_ns) * 1e-9)
        self._feeder.feed(batch)

    def look(self) -> None:
        """Update the losses and the state of the connection. The method is called periodically."""
        bridge = self._bridge
        self._inputs.lost += bridge.lost - self._lost
        self._lost = bridge.lost
        self._inputs.publishers |= dict.fromkeys(self.names, int(bridge.connected))
        if bridge.trouble != self._said:
            self._said = bridge.trouble
            self._warn(self._said or "the OPC UA server is connected again")

    def part(self) -> Part:
        """Return the part `source` of the diagnostics."""
        return self._bridge.part()

    def close(self) -> None:
        """Disconnect."""
        self._bridge.close()
        os.close(self.fd)
