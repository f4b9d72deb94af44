"""Output by Sparkplug B over MQTT.

A birth message contains all metrics, and a data message contains the changed metrics. A death message ends the session.
A new birth message is sent on request.

The messages have the format of `sparkplug_b.proto` of Eclipse Tahu. The format is built here from the published field
numbers, because the licence of `sparkplug_b.proto` differs from the licence of this package.

References
----------
Eclipse Sparkplug specification 3.0.0, sections 5 (sequence, birth and death) and 6 (payloads).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from plow_twin.dashboard.link import Link
from plow_twin.telemetry.mqtt import Broker, Message
from plow_twin.telemetry.values import UNITS, Group, Newest, Value

_UINT64, _STRING, _UINT32, _BOOL = 4, 9, 13, 8
_DOUBLE, _MESSAGE = 1, 11
_OPTIONAL, _REPEATED = 1, 3
#: Name, number and type of each field. A nested field has a message type in addition.
_FIELDS: Final = {
    "Payload": (
        ("timestamp", 1, _UINT64, ""), ("metrics", 2, _MESSAGE, "Metric"), ("seq", 3, _UINT64, ""),
    ),
    "Metric": (
        ("name", 1, _STRING, ""), ("timestamp", 3, _UINT64, ""), ("datatype", 4, _UINT32, ""),
        ("is_null", 7, _BOOL, ""), ("properties", 9, _MESSAGE, "PropertySet"),
        ("int_value", 10, _UINT32, ""), ("long_value", 11, _UINT64, ""),
        ("double_value", 13, _DOUBLE, ""), ("boolean_value", 14, _BOOL, ""), ("string_value", 15, _STRING, ""),
    ),
    "PropertySet": (("keys", 1, _STRING, ""), ("values", 2, _MESSAGE, "PropertyValue")),
    "PropertyValue": (("type", 1, _UINT32, ""), ("string_value", 8, _STRING, "")),
}  # fmt: skip
_INT32, _UINT64_TYPE, _DOUBLE_TYPE, _BOOLEAN, _TEXT = 3, 8, 10, 11, 12
#: The two metrics that the Sparkplug specification requires.
BIRTH_NUMBER: Final = "bdSeq"
REBIRTH: Final = "Node Control/Rebirth"


def _messages() -> tuple[Any, Any]:
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b.proto", package="plow_twin.sparkplug", syntax="proto2")
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind, of in fields:
            repeated = field in ("metrics", "keys", "values")
            added = message.field.add(name=field, number=number, type=kind, label=_REPEATED if repeated else _OPTIONAL)
            if kind == _MESSAGE:
                added.type_name = f".plow_twin.sparkplug.{of}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    # protobuf before 4.22 does not have the function `GetMessageClass`
    class_of = getattr(message_factory, "GetMessageClass", None) or message_factory.MessageFactory(pool).GetPrototype
    return tuple(class_of(pool.FindMessageTypeByName(f"plow_twin.sparkplug.{name}")) for name in ("Payload", "Metric"))


Payload, Metric = _messages()


class Sparkplug:
    """An edge node with metrics `<group>/<name>`. `options` are the arguments of `Broker`."""

    def __init__(self, group: str, node: str, **options: Any) -> None:
        self._topic = f"spBv1.0/{group}/{{}}/{node}"
        self._number = 0
        #: Number of the connection, which birth and death messages contain.
        self._connection = -1
        self._rebirth = False
        self._newest = Newest()
        self._sent: dict[tuple[str, str], Value] = {}
        # messages that are queued during a break are dropped, because the next birth contains all newest values
        self._broker = Broker(will=self._next_death, on_connected=self._born, keeps=False, **options)
        self._broker.client.on_message = self._on_command
        self.state = self._broker.state

    async def open(self, link: Link, newest: Newest) -> None:
        """Connect in the background."""
        self._newest = newest
        self._broker.open()

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Send the metrics that have changed."""
        with self._broker.lock:
            news = {name: self._news(name, group) for name, group in changed.items()}
            payload = _payload(news, with_units=False)
            if len(payload.metrics):
                self._broker.send(self._numbered("NDATA", payload))

    def _news(self, name: str, group: Group) -> Group:
        """Return the changed values of a group, and record them as sent."""
        values = {key: value for key, value in group.values.items() if self._sent.get((name, key), self) != value}
        self._sent |= {(name, key): value for key, value in values.items()}
        return group._replace(values=values)

    async def turn(self) -> None:
        """Send a new birth message if a rebirth was requested."""
        if self._rebirth:
            self._rebirth = False
            with self._broker.lock:
                self._broker.send(self._birth())

    async def close(self, patience_s: float) -> None:
        """Send the death message of the node."""
        await self._broker.close(self._death(), patience_s)

    def _born(self) -> list[Message]:
        self._broker.client.subscribe(self._topic.format("NCMD"), 1)
        return [self._birth()]

    def _birth(self) -> Message:
        self._number = 0
        for name, group in self._newest.groups.items():
            self._sent |= {(name, key): value for key, value in group.values.items()}
        payload = _payload(self._newest.groups, with_units=True)
        payload.metrics.append(_metric(BIRTH_NUMBER, _UINT64_TYPE, "long_value", self._connection))
        payload.metrics.append(_metric(REBIRTH, _BOOLEAN, "boolean_value", False))
        return self._numbered("NBIRTH", payload)

    def _next_death(self) -> Message:
        """Return the death message of the next connection. The broker receives it before the birth message."""
        self._connection = (self._connection + 1) % 256
        return self._death()

    def _death(self) -> Message:
        payload = Payload(metrics=[_metric(BIRTH_NUMBER, _UINT64_TYPE, "long_value", self._connection)])
        return Message(self._topic.format("NDEATH"), payload.SerializeToString())

    def _numbered(self, kind: str, payload: Any) -> Message:
        payload.seq, self._number = self._number, (self._number + 1) % 256
        return Message(self._topic.format(kind), payload.SerializeToString(), qos=0)

    def _on_command(self, client: Any, data: Any, message: Any) -> None:
        try:
            payload = Payload.FromString(message.payload)
        except DecodeError:
            return
        self._rebirth |= any(metric.name == REBIRTH and metric.boolean_value for metric in payload.metrics)


def _payload(groups: Mapping[str, Group], *, with_units: bool) -> Any:
    payload = Payload(timestamp=_now_ms())
    for group_name, group in groups.items():
        unit = UNITS.get(group_name, "") if with_units else ""
        for name, value in group.values.items():
            metric = _metric(f"{group_name}/{name}", *_typed(value))
            if group.time_s:
                metric.timestamp = round(group.time_s * 1e3)
            if unit:
                metric.properties.keys.append("engUnit")
                metric.properties.values.add(type=_TEXT, string_value=unit)
            payload.metrics.append(metric)
    return payload


def _typed(value: Value) -> tuple[int, str, Any]:
    """Return the type number of a value, the name of the message field for it, and the content of the field."""
    if value is None:
        return _DOUBLE_TYPE, "is_null", True
    if isinstance(value, str):
        return _TEXT, "string_value", value
    return (_INT32, "int_value", value) if isinstance(value, int) else (_DOUBLE_TYPE, "double_value", value)


def _metric(name: str, kind: int, field: str, content: Any) -> Any:
    return Metric(name=name, timestamp=_now_ms(), datatype=kind, **{field: content})


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
