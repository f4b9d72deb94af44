"""Output to an MQTT broker as JSON, with one topic for each group of values."""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from plow_twin.dashboard.link import Link
from plow_twin.live.bridge.paho_client import end_of, make_client, refusal, use_tls
from plow_twin.telemetry.output import State, TelemetryError
from plow_twin.telemetry.values import UNITS, Group, Newest

#: Largest number of messages in the queue: ten minutes of all numeric groups at 1 Hz. The oldest messages are dropped.
_WAITING: Final = 2000
_UNACKNOWLEDGED: Final = 20
#: Keep-alive interval [s]. After 1.5 intervals without a message, the connection to the broker is treated as broken.
_KEEPALIVE_S: Final = 10


class Message(NamedTuple):
    """A message. The broker stores a retained message, and sends it to clients that subscribe later."""

    topic: str
    payload: bytes
    retain: bool = False
    qos: int = 1


class Broker:
    """A connection to a broker that is restored after a break, with a queue of messages.

    If the queue has more than `waiting` messages, the oldest messages are dropped and counted as lost. If `keeps` is
    False, a break drops all queued messages. `will` returns the message that the broker publishes if the next
    connection breaks. `on_connected` returns the messages that are sent before the queue after each connection. Without
    the paths `tls` (`ca`, `certificate`, `key`), the connection is not encrypted.
    """

    def __init__(
        self,
        *,
        host: str,
        port: int,
        client_id: str,
        user: str,
        password: str,
        tls: dict[str, str | None] | None,
        will: Callable[[], Message],
        on_connected: Callable[[], list[Message]],
        waiting: int = _WAITING,
        keeps: bool = True,
    ) -> None:
        self.state = State(trouble="no connection yet")
        self._address, self._will, self._on_connected = (host, port), will, on_connected
        self._most, self._keeps = waiting, keeps
        self._waiting: deque[Message] = deque()
        self._unacknowledged: set[int] = set()
        self._acknowledged: deque[int] = deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        #: held while messages are numbered and queued, so that they are queued in the order of their numbers
        self.lock = threading.RLock()
        self.client = make_client(client_id, clean=True)
        self._set_will()
        if user:
            self.client.username_pw_set(user, password or None)
        if tls is not None:
            try:
                use_tls(self.client, tls["ca"], tls["certificate"], tls["key"])
            except (OSError, ValueError) as error:
                raise TelemetryError(f"{host}:{port}: the TLS files cannot be used: {error}") from error
        self.client.on_connect, self.client.on_disconnect = self._connected, self._disconnected
        self.client.on_connect_fail, self.client.on_publish = self._failed, self._published

    def open(self) -> None:
        """Connect in the background, and reconnect after each break. Call this method in the event loop of `send`."""
        self._loop = asyncio.get_running_loop()
        self.client.connect_async(*self._address, keepalive=_KEEPALIVE_S)
        self.client.loop_start()

    def send(self, message: Message) -> None:
        """Send a message, or queue it until the broker answers."""
        with self.lock:
            self._waiting.append(message)
            self._pass_on()
            self._drop(len(self._waiting) - (self._most if self._keeps or self.state.connected else 0))

    async def close(self, last: Message, patience_s: float) -> None:
        """Send the queued messages and the last message, and disconnect."""
        self.send(last)
        give_up = time.monotonic() + patience_s
        while self.state.connected and (self._waiting or self._unacknowledged) and time.monotonic() < give_up:
            await asyncio.sleep(0.01)
        with self.lock:
            unsent = [message for message in self._waiting if message is not last]
            self.state.lost += len(unsent) + len(self._unacknowledged)
        self.client.on_disconnect = None
        self.client.disconnect()
        self.client.loop_stop()

    def _pass_on(self) -> None:
        while self.state.connected and self._waiting and len(self._unacknowledged) < _UNACKNOWLEDGED:
            topic, payload, retain, qos = self._waiting.popleft()
            self._unacknowledged.add(self.client.publish(topic, payload, qos, retain).mid)

    def _drop(self, count: int) -> None:
        for _ in range(count):
            self._waiting.popleft()
            self.state.lost += 1

    def _set_will(self) -> None:
        topic, payload, retain, qos = self._will()
        self.client.will_set(topic, payload, qos, retain)

    def _connected(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any = None) -> None:
        if refused := refusal(reason):
            self.state.trouble = f"refused: {refused}"
            return
        with self.lock:
            self.state.connected, self.state.trouble = True, ""
            self._waiting.extendleft(reversed(self._on_connected()))
            self._pass_on()

    def _failed(self, client: Any, data: Any) -> None:
        self.state.trouble = f"no broker at {self._address[0]}:{self._address[1]}: {sys.exc_info()[1]}"

    def _disconnected(self, client: Any, data: Any, *facts: Any) -> None:
        self.state.connected = False
        with self.lock:
            if not self._keeps:
                self._drop(len(self._waiting))
                self.state.lost += len(self._unacknowledged)
                self._unacknowledged.clear()
            self._set_will()
        self.state.trouble = self.state.trouble or f"the connection broke: {end_of(*facts)}; reconnecting"

    def _published(self, client: Any, data: Any, number: int, *facts: Any) -> None:
        # paho calls this method with a lock that `publish` takes too, so this method must not wait for our lock
        self._acknowledged.append(number)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._acknowledge)

    def _acknowledge(self) -> None:
        with self.lock:
            while self._acknowledged:
                self._unacknowledged.discard(self._acknowledged.popleft())
                self.state.sent += 1
            self._pass_on()


class MqttOut:
    """Output of JSON messages to the topics `<prefix>/<group>`. All messages except `peaks` are retained.

    The messages on the topic `<prefix>/online` are true or false. `options` are the arguments of `Broker`.
    """

    def __init__(self, prefix: str, **options: Any) -> None:
        online = f"{prefix}/online"
        self._prefix, self._gone = prefix, Message(online, b"false", True)
        present = Message(online, b"true", True)
        self._broker = Broker(will=lambda: self._gone, on_connected=lambda: [present], **options)
        self.state = self._broker.state

    async def open(self, link: Link, newest: Newest) -> None:
        """Connect in the background."""
        self._broker.open()

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Send the groups that have changed."""
        for name, group in changed.items():
            self._broker.send(Message(f"{self._prefix}/{name}", _payload(name, group), name != "peaks"))

    async def turn(self) -> None:
        """Do nothing, because the connection has its own thread."""

    async def close(self, patience_s: float) -> None:
        """Send the queued messages, followed by the message that the twin is offline."""
        await self._broker.close(self._gone, patience_s)


def _payload(name: str, group: Group) -> bytes:
    unit = {"unit": UNITS[name]} if name in UNITS else {}
    content = {"t": group.time_s or None, **unit, "held": group.held, "values": group.values}
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
