"""A real OPC UA server: `opcua_server.py PORT [CERTIFICATE KEY [USER]]`. It reads commands from standard input.

If the environment contains `MORE_NAMESPACES`, the namespace of the nodes has another number.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.history import HistoryDict
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

NODES = ("Load.Fx", "Load.Fy", "Load.M")
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class OneUser(UserManager):
    """Admit only the user `plough`, or the user of a certificate."""

    def __init__(self, certificate: Path | None) -> None:
        read = None if certificate is None else x509.load_pem_x509_certificate(certificate.read_bytes())
        self._known = None if read is None else read.public_bytes(Encoding.DER)

    def get_user(self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
        # without a user token, the certificate is the certificate of the client program
        admitted = (username, password) == ("plough", "s3cret") or (username is None and certificate == self._known)
        return User(UserRole.User) if admitted else None


class Plant:
    def __init__(self, server: Server, nodes: list[Any]) -> None:
        self._server, self._nodes = server, nodes

    async def forget(self) -> None:
        """Empty the history, and set the nodes to 0."""
        storage = HistoryDict()
        self._server.iserver.history_manager.set_storage(storage)
        for node in self._nodes:
            await storage.new_historized_node(node.nodeid, None)
            await node.write_value(0.0)

    async def write(self, stamp_ns: int, values: list[Any], status: str = "Good", keep: bool = True) -> None:
        time = EPOCH + timedelta(microseconds=stamp_ns // 1000)
        for node, value in zip(self._nodes, values, strict=True):
            if value is None:
                continue
            code = ua.StatusCode(getattr(ua.StatusCodes, status if node is self._nodes[0] else "Good"))
            data = ua.DataValue(ua.Variant(value), code, time, datetime.now(UTC))
            if keep:
                await self._server.iserver.history_manager.storage.save_node_value(node.nodeid, data)
            await node.write_value(data)

    async def rows(self, rows: list[list[Any]], pause_s: float = 0.0, **how: Any) -> None:
        for stamp_ns, *values in rows:
            await self.write(stamp_ns, values, **how)
            await asyncio.sleep(pause_s)

    async def number(self, more: int) -> None:
        """Let all subscriptions skip sequence numbers, as if messages were lost, or repeat a number."""
        for subscription in self._server.iserver.subscription_service.subscriptions.values():
            subscription._notification_seq += more

    async def lie(self, kind: str) -> None:
        """Answer requests of the history with data from the far future, or with endless data."""

        def answer(*asked: Any) -> Any:
            years = {"future": (2090, 9999), "endless": (2026,), "nothing": ()}[kind]
            times = [datetime(year, 1, 1, tzinfo=UTC) for year in years]
            values = [ua.DataValue(ua.Variant(1e9), ua.StatusCode(ua.StatusCodes.Good), time) for time in times]
            return values, None if kind == "future" else EPOCH

        async def read(*asked: Any) -> Any:
            return answer(*asked)

        self._server.iserver.history_manager.storage.read_node_history = read

    async def refuse(self, refused: bool) -> None:
        service = self._server.iserver.subscription_service
        if refused:

            async def create(*asked: Any, **more: Any) -> Any:
                raise ua.UaStatusCodeError(ua.StatusCodes.BadTooManySubscriptions)

            service.create_subscription = create
        else:
            del service.create_subscription


async def serve() -> None:
    logging.disable()
    port, *security = sys.argv[1:]
    server = Server(user_manager=OneUser(Path(security[2]) if security[2:] else None) if security else None)
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plant")
    if security:
        certificate, key = map(Path, security[:2])
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        await server.load_certificate(certificate)
        await server.load_private_key(key)
    if "MORE_NAMESPACES" in os.environ:
        await server.register_namespace("urn:other")
    index = await server.register_namespace("urn:plow-twin:test")
    nodes = [
        await server.nodes.objects.add_variable(ua.NodeId(name, index), name, 0.0, ua.VariantType.Double)
        for name in NODES
    ]
    plant = Plant(server, nodes)
    await plant.forget()
    async with server:
        print("ready", flush=True)
        while line := await asyncio.to_thread(sys.stdin.readline):
            name, arguments, how = json.loads(line)
            await getattr(plant, name)(*arguments, **how)
            print("done", flush=True)


if __name__ == "__main__":
    asyncio.run(serve())
