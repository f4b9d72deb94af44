"""Receive messages with JSON payloads from an MQTT broker."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Final

from plow_twin.access import is_loopback
from plow_twin.live.bridge.access import Access, host_and_port
from plow_twin.live.bridge.paho_client import end_of, is_resumed, make_client, refusal, subscription_refusal, use_tls
from plow_twin.live.bridge.source import LONGEST, Bridge, BridgeError, read_json
from plow_twin.record.merging import StampOf
from plow_twin.record.sources import Arrived

#: Largest number of messages in the queue. If the queue is full, new messages are counted as lost.
_QUEUE: Final = 100_000
#: Largest total size of the messages in the queue [B]. If the size is reached, new messages are counted as lost.
_QUEUED_BYTES: Final = 2**26
#: Largest length of the name of a topic in MQTT [B].
_LONGEST_TOPIC: Final = 65_535
_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}


class Mqtt(Bridge):
    """Persistent session at an MQTT broker. While the connection is broken, the broker stores messages with QoS 1.

    Raise `BridgeError` if the address is invalid, the broker refuses the connection, or no broker answers within
    `connect_s` [s].
    """

    def __init__(self, access: Access, connect_s: float = 10.0) -> None:
        super().__init__()
        self._access, self._connect_s = access, connect_s
        self.host, self.port, tls = _address(access)
        self._topics: list[str] = []
        self._subscribed = False
        #: whether a message with the flag `retain` is older than the subscription
        self._from_before = True
        self._queue: deque[tuple[str, bytes, int, bool]] = deque()
        #: total sizes of the payloads that entered the queue and left it [B]; only one thread changes each number
        self._bytes_received = self._bytes_taken = 0
        self._arrived = threading.Event()
        self._answer = threading.Event()
        self._client = self._make_client(tls)

    def topics(self) -> None:
        """Return None, because the mapping may contain any topic of the broker."""
        return

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Connect to the broker and subscribe to the topics."""
        for topic in topics:
            if any(sign in topic for sign in "+#\0") or not 0 < len(topic.encode()) <= _LONGEST_TOPIC:
                got = topic if len(topic) < 200 else f"{topic[:20]}... ({len(topic)} characters)"
                raise BridgeError(f"topic: got {got!r}, expected one topic of up to 65,535 bytes, without + and #")
        self._topics = topics
        try:
            self._client.connect(self.host, self.port)
        except (OSError, ValueError) as error:
            raise BridgeError(f"{self._access.url}: no broker at {self.host}:{self.port}: {error}") from error
        self._client.loop_start()
        answered = self._answer.wait(self._connect_s)
        trouble = self.trouble if answered else f"no answer within {self._connect_s:g} s"
        if trouble:
            reason = f"; {self.trouble}" if self.trouble and not answered else ""
            self.close()
            raise BridgeError(f"{self._access.url}: {trouble}{reason}")

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return the messages that have arrived."""
        if not self._queue:
            self._arrived.wait(timeout_s)
        self._arrived.clear()
        messages = [self._queue.popleft() for _ in range(len(self._queue))]
        self._bytes_taken += sum(len(payload) for _, payload, _, _ in messages)
        return [Arrived(topic, time_ns, read_json(payload), retained) for topic, payload, time_ns, retained in messages]

    def close(self) -> None:
        """Disconnect. The broker stores messages until the session is resumed."""
        self._client.disconnect()
        self._client.loop_stop()

    def _make_client(self, tls: bool) -> Any:
        access = self._access
        client = make_client(access.client_id, clean=False)
        if access.user:
            client.username_pw_set(access.user, access.password or None)
        if tls:
            try:
                use_tls(client, access.ca, access.certificate, access.key)
            except (OSError, ValueError) as error:
                raise BridgeError(f"{access.url}: the TLS files cannot be used: {error}") from error
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_subscribe, client.on_message = self._on_subscribe, self._on_message
        return client

    def _on_connect(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any = None) -> None:
        if refused := refusal(reason):
            self.trouble = f"refused: {refused}"
            self._answer.set()
            return
        # in a resumed session, a message that the broker stored for the session may have the flag `retain`
        resumed = is_resumed(flags)
        self._from_before = not resumed
        if self._subscribed and resumed:
            self.connected, self.trouble = True, ""
        else:
            client.subscribe([(topic, 1) for topic in self._topics])

    def _on_subscribe(self, client: Any, data: Any, number: Any, reasons: Any, properties: Any = None) -> None:
        answers = zip(self._topics, map(subscription_refusal, reasons), strict=False)
        refused = [f"{topic}: {text}" for topic, text in answers if text]
        self.connected = self._subscribed = not refused
        self.trouble = f"refused: {'; '.join(refused)}" if refused else ""
        self._answer.set()

    def _on_disconnect(self, client: Any, data: Any, *facts: Any) -> None:
        self.connected = False
        self.trouble = self.trouble or f"the connection broke: {end_of(*facts)}; reconnecting"

    def _on_message(self, client: Any, data: Any, message: Any) -> None:
        # a payload that is too long is replaced by an empty payload, which is counted as an invalid message
        payload = message.payload if len(message.payload) <= LONGEST else b""
        if len(self._queue) >= _QUEUE or self._bytes_received - self._bytes_taken + len(payload) > _QUEUED_BYTES:
            self.lost += 1
            return
        self._bytes_received += len(payload)
        self._queue.append((message.topic, payload, time.time_ns(), message.retain and self._from_before))
        self._arrived.set()


def _address(access: Access) -> tuple[str, int, bool]:
    scheme, host, port = host_and_port(access, _PORTS)
    tls = scheme == "mqtts"
    if not tls and not access.plain and not is_loopback(host):
        raise BridgeError(f"{access.url}: got another machine without TLS, expected mqtts:// or this machine")
    return host, port, tls
