"""The OPC UA information model: a type for the twin of a plough head, and one instance of the type.

The type is derived from the type of mining equipment in the companion specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from asyncua import ua
from asyncua.common.instantiate_util import instantiate
from asyncua.common.node import Node
from asyncua.server.server import Server
from asyncua.ua.object_ids import ObjectIds

from plow_twin.telemetry.values import UNITS, Group

NAMESPACE: Final = "https://plow-twin.readthedocs.io/opcua"
_NODESETS: Final = Path(__file__).with_name("nodesets")
#: Nodeset files. Each file follows the files that it needs.
_FILES: Final = ("Opc.Ua.Di", "Opc.Ua.Machinery", "Opc.Ua.Mining.General")
_DI, _MINING = "http://opcfoundation.org/UA/DI/", "http://opcfoundation.org/UA/Mining/General/"
_FUNCTIONAL_GROUP, _DEVICE_SET, _EQUIPMENT, _IDENTIFICATION = 1005, 5001, 1002, 1003
#: UN/CEFACT code and name of each unit. OPC UA encodes the three characters of a code as a number.
_UNITS: Final = {"m": ("MTR", "metre"), "N": ("NEW", "newton")}
_POINTS: Final = ("p05", "p95")
_TYPE: Final = "PloughHeadTwinType"


class Model:
    """The types and the instance in an initialised server."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._index = 0
        self._di = 0
        #: Node of each value. The key is `<group>/<name>`.
        self.nodes: dict[str, ua.NodeId] = {}
        self.device: Node

    async def build(self, groups: Mapping[str, Group], facts: Mapping[str, Any]) -> None:
        """Create the types and the instance. `groups` must contain all names of the values."""
        for name in _FILES:
            await self._server.import_xml(str(_NODESETS / f"{name}.NodeSet2.xml"))
        self._index = await self._server.register_namespace(NAMESPACE)
        self._di = await self._server.get_namespace_index(_DI)
        mining = await self._server.get_namespace_index(_MINING)
        interval = await self._interval_type()
        equipment = self._server.get_node(ua.NodeId(_EQUIPMENT, mining))
        device_type = await equipment.add_object_type(self.node_id(_TYPE), self._name(_TYPE))
        for name, group in groups.items():
            await self._add_group(device_type, name, group, interval)
        devices = self._server.get_node(ua.NodeId(_DEVICE_SET, self._di))
        self.device = await devices.add_object(
            self.node_id("plough"), self._name("plough"), device_type.nodeid, instantiate_optional=False
        )
        for name, group in groups.items():
            self.nodes |= {
                f"{name}/{key}": self.node_id(f"plough.{name}.{key.replace('/', '.')}") for key in group.values
            }
        await self._identify(mining, facts)

    def node_id(self, text: str) -> ua.NodeId:
        """Return an identifier in the namespace of the model."""
        return ua.NodeId(text, self._index)

    def _name(self, text: str) -> ua.QualifiedName:
        return ua.QualifiedName(text, self._index)

    async def _interval_type(self) -> Node:
        analog = self._server.get_node(ua.NodeId(ObjectIds.AnalogUnitType))
        made = await analog.add_variable_type(
            self.node_id("IntervalType"), self._name("IntervalType"), ua.NodeId(ObjectIds.Double)
        )
        for point in _POINTS:
            node = await made.add_variable(
                self.node_id(f"IntervalType.{point}"), self._name(point), None, datatype=ua.NodeId(ObjectIds.Double)
            )
            await node.set_modelling_rule(True)
        return made

    async def _add_group(self, parent: Node, name: str, group: Group, interval: Node) -> None:
        begin = f"{_TYPE}.{name}"
        functional = ua.NodeId(_FUNCTIONAL_GROUP, self._di)
        folder = await parent.add_object(self.node_id(begin), self._name(name), functional, instantiate_optional=False)
        await folder.set_modelling_rule(True)
        for key, value in group.values.items():
            node_id, browse_name = self.node_id(f"{begin}.{key}"), self._name(key)
            if name in UNITS and "/" not in key:
                await instantiate(folder, interval, node_id, browse_name, instantiate_optional=False)
                node = self._server.get_node(node_id)
                # the points need a modelling rule, because the instance contains only nodes with a modelling rule
                for point in _POINTS:
                    await self._server.get_node(self.node_id(f"{begin}.{key}.{point}")).set_modelling_rule(True)
                await self._set_unit(node, UNITS[name])
            elif name in UNITS:
                continue
            else:
                kind = ObjectIds.String if isinstance(value, str) else ObjectIds.Double
                kind = ObjectIds.Int32 if isinstance(value, int) else kind
                browse_name = self._name(key.replace("/", "."))
                node_id = self.node_id(f"{begin}.{browse_name.Name}")
                node = await folder.add_variable(node_id, browse_name, None, datatype=ua.NodeId(kind))
            await node.set_modelling_rule(True)

    async def _set_unit(self, node: Node, unit: str) -> None:
        code, name = _UNITS[unit]
        number = int.from_bytes(code.encode(), "big")
        information = ua.EUInformation(
            "http://www.opcfoundation.org/UA/units/un/cefact", number, ua.LocalizedText(unit), ua.LocalizedText(name)
        )
        units = await node.get_child("0:EngineeringUnits")
        await units.write_value(information)
        await units.set_modelling_rule(True)

    async def _identify(self, mining: int, facts: Mapping[str, Any]) -> None:
        identification = await self.device.add_object(
            self.node_id("plough.MiningEquipmentIdentification"),
            ua.QualifiedName("MiningEquipmentIdentification", mining),
            ua.NodeId(_IDENTIFICATION, mining),
            instantiate_optional=False,
        )
        values = {"Model": ua.LocalizedText(f"plow_twin: {facts['scene']}"), "SerialNumber": facts["head"]}
        for name, value in values.items():
            await (await identification.get_child(f"{self._di}:{name}")).write_value(value)
