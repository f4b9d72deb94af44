"""Alarms as OPC UA conditions, which are raised, acknowledged and ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from asyncua import ua
from asyncua.server.server import Server
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.status_codes import StatusCodes

from plow_twin.telemetry.opcua.model import Model
from plow_twin.telemetry.values import Group, Value

_ALARM_TYPE: Final = ObjectIds.ExclusiveLevelAlarmType
#: Severity (1 to 1000) of each alarm level.
_SEVERITY: Final = {"none": 1, "warn": 500, "error": 800}
_LIMIT: Final = {"warn": "High", "error": "HighHigh"}


@dataclass
class Condition:
    """The condition of one alarm. It contains the event generator, and the state of the alarm at the newest event."""

    events: Any
    node_id: ua.NodeId
    level: str = "none"
    acknowledged: bool = True
    #: Time at which the alarm was last raised.
    raised: object = None

    @property
    def event_id(self) -> bytes:
        """Identifier of the newest event, with which a client acknowledges the event."""
        condition = self.events.event.EventId
        return bytes(condition.Value) if isinstance(condition, ua.Variant) else b""


class Conditions:
    """The alarms of a twin as conditions of a server."""

    def __init__(self, server: Server, model: Model) -> None:
        self._server, self._model = server, model
        #: Function that requests the twin to acknowledge its alarms, and returns whether the request was sent. It is
        #: None if clients may not acknowledge alarms.
        self.acknowledge: Callable[[], bool] | None = None
        self._conditions: dict[str, Condition] = {}
        self._values: Mapping[str, Value] = {}

    async def build(self, names: Mapping[str, list[float]]) -> None:
        """Create a condition for each alarm; `names` contains the thresholds (warning, error) of each alarm."""
        alarms = self._server.get_node(self._model.nodes["alarms/message"])
        folder = await alarms.get_parent()
        assert folder is not None
        for name, thresholds in names.items():
            place = f"plough.alarms.{name}.condition"
            node_id = self._model.node_id(place)
            browse_name = ua.QualifiedName(f"{name}_condition", node_id.NamespaceIndex)
            await folder.add_object(node_id, browse_name, ua.NodeId(_ALARM_TYPE), instantiate_optional=False)
            acknowledge = self._server.get_node(self._model.node_id(f"{place}.Acknowledge"))
            self._server.link_method(acknowledge, self._called)
            events = await self._server.get_event_generator(ua.NodeId(_ALARM_TYPE))
            event = events.event
            event.SourceNode, event.SourceName = self._model.device.nodeid, "plough"
            event.NodeId, event.ConditionName, event.BranchId = node_id, name, ua.NodeId()
            event.ConditionClassId = ua.NodeId(ObjectIds.ProcessConditionClassType)
            event.ConditionClassName = ua.LocalizedText("ProcessConditionClass")
            event.InputNode = self._model.nodes[f"alarms/{name}"]
            event.SuppressedOrShelved = False
            event.EnabledState = ua.LocalizedText("Enabled")
            setattr(event, "EnabledState/Id", True)
            event.add_variable("LimitState/CurrentState", ua.LocalizedText(""), ua.VariantType.LocalizedText)
            for limit, value in zip(("HighLimit", "HighHighLimit"), thresholds, strict=True):
                event.add_property(limit, float(value), ua.VariantType.Double)
            self._conditions[name] = Condition(events, node_id)
        general = ua.NodeId(ObjectIds.AcknowledgeableConditionType_Acknowledge)
        self._server.link_method(self._server.get_node(general), self._called)

    async def update(self, alarms: Group) -> None:
        """Update the alarms, and send an event for each alarm that has changed."""
        self._values = values = alarms.values
        for name, condition in self._conditions.items():
            before = condition.level, condition.acknowledged
            condition.level = str(values[f"{name}_level"] or "none")
            raised = values[f"{name}_time"]
            # an alarm without a time is not latched and need not be acknowledged
            if raised != condition.raised:
                condition.raised, condition.acknowledged = raised, raised is None
            if (condition.level, condition.acknowledged) != before:
                await self._send(name, condition)

    async def _send(self, name: str, condition: Condition) -> None:
        values, event, active = self._values, condition.events.event, condition.level != "none"
        event.Retain = active or not condition.acknowledged
        event.Severity = _SEVERITY[condition.level]
        event.ActiveState = ua.LocalizedText("Active" if active else "Inactive")
        setattr(event, "ActiveState/Id", active)
        event.AckedState = ua.LocalizedText("Acknowledged" if condition.acknowledged else "Unacknowledged")
        setattr(event, "AckedState/Id", condition.acknowledged)
        setattr(event, "LimitState/CurrentState", ua.LocalizedText(_LIMIT.get(condition.level, "")))
        place = f" at {values[f'{name}_place']}" if values[f"{name}_place"] else ""
        await condition.events.trigger(datetime.now(UTC), message=f"{name} {values[name]}{place}, {condition.level}")

    async def _called(self, parent: ua.NodeId, *arguments: ua.Variant) -> ua.StatusCode:
        """Handle a call of the method Acknowledge of a condition, with the identifier of an event and a comment."""
        if len(arguments) != 2:
            missing = len(arguments) < 2
            return ua.StatusCode(StatusCodes.BadArgumentsMissing if missing else StatusCodes.BadTooManyArguments)
        if self.acknowledge is None:
            return ua.StatusCode(StatusCodes.BadUserAccessDenied)
        condition = next((found for found in self._conditions.values() if found.node_id == parent), None)
        if condition is None:
            return ua.StatusCode(StatusCodes.BadNodeIdUnknown)
        if arguments[0].Value != condition.event_id:
            return ua.StatusCode(StatusCodes.BadEventIdUnknown)
        if condition.acknowledged:
            return ua.StatusCode(StatusCodes.BadConditionBranchAlreadyAcked)
        if not self.acknowledge():
            return ua.StatusCode(StatusCodes.BadOutOfService)
        for name, found in self._conditions.items():  # the twin acknowledges all of its alarms at once
            if not found.acknowledged:
                found.acknowledged = True
                await self._send(name, found)
        return ua.StatusCode()
