"""Outputs to a plant other than MQTT: real servers and clients in other processes receive the recorded numbers."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyAes256Sha256RsaPss
from asyncua.crypto.uacrypto import CertProperties
from commands import plow_twin_here
from network import free_port, make_certificate
from test_live import Live, _csv, _live
from test_mqtt import STALE, _entries

from plow_twin.live.bridge.source import BridgeError
from plow_twin.stream.journal import Parameter
from plow_twin.telemetry.access import AccessError, Credentials, influx_out, mqtt_out, opcua_out
from plow_twin.telemetry.influx import Influx
from plow_twin.telemetry.opcua.model import NAMESPACE
from plow_twin.telemetry.opcua.server import Trusted
from plow_twin.telemetry.values import Group, Newest


class Heard:
    def __init__(self) -> None:
        self.events: list[Any] = []

    def event_notification(self, event: Any) -> None:
        self.events.append(event)

    def states(self) -> list[tuple[bool, bool]]:
        """Return for each event whether the condition was active, and whether it was acknowledged."""
        return [(getattr(event, "ActiveState/Id"), getattr(event, "AckedState/Id")) for event in self.events]


async def _device(client: Client) -> tuple[Any, Callable[[str], Any]]:
    index = await client.get_namespace_index(NAMESPACE)
    return client.get_node(f"ns={index};s=plough"), lambda name: client.get_node(f"ns={index};s=plough.{name}")


async def _acknowledge(client: Client, listener: Heard, condition: Any, event_id: bytes | None = None) -> str:
    event = ua.Variant(event_id or listener.events[-1].EventId, ua.VariantType.ByteString)
    return await _call_acknowledge(condition, event, ua.Variant(ua.LocalizedText("seen")))


async def _call_acknowledge(condition: Any, *arguments: ua.Variant) -> str:
    method = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
    try:
        await condition.call_method(method, *arguments)
    except ua.UaStatusCodeError as error:
        return type(error).__name__
    return "Good"


async def _conditions(client: Client) -> Heard:
    """Subscribe to conditions, and request their present state."""
    listener = Heard()
    subscription = await client.create_subscription(50, listener)
    alarm_type = client.get_node(ua.NodeId(ua.ObjectIds.ExclusiveLevelAlarmType))
    await subscription.subscribe_alarms_and_conditions(client.nodes.server, alarm_type)
    conditions = client.get_node(ua.NodeId(ua.ObjectIds.ConditionType))
    number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
    await conditions.call_method("0:ConditionRefresh", number)
    await _soon(lambda: bool(listener.events))
    return listener


async def _soon(reached: Callable[[], Any]) -> None:
    give_up = time.monotonic() + 60.0
    while not (done := reached()) or (asyncio.iscoroutine(done) and not await done):
        assert time.monotonic() < give_up
        await asyncio.sleep(0.05)


def test_opcua_clients_read_a_typed_model_and_may_acknowledge_alarms(tmp_path: Path) -> None:
    path, run, url = _csv(tmp_path / "load.csv", 1500), tmp_path / "run", f"opc.tcp://127.0.0.1:{free_port()}"
    arguments = (str(path), "--follow", "--opcua", url, "--out-rate", "5", "--set", "alarm_force=[20e3,1e9]", *STALE)

    async def look(*, allowed: bool) -> None:
        async with Client(url) as client:
            device, node = await _device(client)
            kind = client.get_node(await device.read_type_definition())
            (supertype,) = await kind.get_referenced_nodes(ua.ObjectIds.HasSubtype, ua.BrowseDirection.Inverse)
            assert (await supertype.read_browse_name()).Name == "MiningEquipmentType"
            horizontal = node("clearance.horizontal")
            unit = await (await horizontal.get_child("0:EngineeringUnits")).read_value()
            await _soon(lambda: _is_good(horizontal))
            value, low = await horizontal.read_data_value(), await node("clearance.horizontal.p05").read_value()
            assert (value.Value.Value, low, unit.DisplayName.Text) == (pytest.approx(0.025), pytest.approx(0.025), "m")
            # the time of the last sample
            assert value.SourceTimestamp.timestamp() == pytest.approx(1.0 + 1499e-3, abs=0.01)
            assert not (await node("life.seconds.p50").read_data_value(raise_on_bad_status=False)).StatusCode.is_good()
            for written in (horizontal, node("flags.stream"), node("alarms.force")):
                with pytest.raises(ua.UaStatusCodeError):
                    await written.write_value(await written.read_value())
            listener, condition = await _conditions(client), node("alarms.force.condition")
            assert (
                listener.events[-1].ConditionName == "force"
                and not listener.states()[-1][1]
                and listener.events[-1].Retain
            )
            if not allowed:
                assert await _acknowledge(client, listener, condition) == "BadUserAccessDenied"
                return
            assert await _call_acknowledge(condition) == "BadArgumentsMissing"
            assert await _call_acknowledge(condition, *[ua.Variant(b"event")] * 3) == "BadTooManyArguments"
            assert await _acknowledge(client, listener, condition, b"another") == "BadEventIdUnknown"
            assert await _acknowledge(client, listener, condition) == "Good"
            await _soon(lambda: listener.states()[-1][1])

    for allowed, more in ((False, ()), (True, ("--opcua-acknowledge", "--record", str(run)))):
        with _live(*arguments, *more) as live:
            live.until_count("samples_used", 1500)
            _meanwhile(live, look(allowed=allowed))
            live.until(lambda listener: listener["opcua_out"]["values"]["sent"] > 2, "sent")
            assert live.stop() == 0
    assert [entry.name for entry in _entries(run) if isinstance(entry, Parameter)] == ["alarms_acknowledged"]


def _meanwhile(live: Live, work: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine while the output of the twin is read, because the twin would wait for its readers."""
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(asyncio.run, work)
        live.until(lambda _: done.done(), "done")
        return done.result()


async def _is_good(node: Any) -> bool:
    data_value = await node.read_data_value(raise_on_bad_status=False)
    return bool(data_value.StatusCode.is_good())


def test_an_opcua_server_for_other_machines_encrypts_and_admits_trusted_clients(tmp_path: Path) -> None:
    for name, program in (("server", "server"), ("client", "client"), ("other", "client")):
        make_certificate(tmp_path, name, f"urn:plow-twin:{program}")
    (tmp_path / "trusted").mkdir()
    (tmp_path / "client.pem").rename(tmp_path / "trusted" / "client.crt")
    (tmp_path / "trusted" / "note.txt").write_text("for the operator")
    (tmp_path / "secret").write_text("s3cret\n")
    (tmp_path / "out.yaml").write_text(
        "opcua: {certificate: server.pem, key: server.key.pem, trusted: trusted, user: plant, password_file: secret}\n"
    )
    path, port = _csv(tmp_path / "load.csv", 100), free_port()
    arguments = (str(path), "--follow", "--opcua", f"opc.tcp://0.0.0.0:{port}")

    async def connects(certificate: Path | None, password: str) -> bool:
        client = Client(f"opc.tcp://localhost:{port}", timeout=20)
        client.application_uri = "urn:plow-twin:client"
        client.set_user("plant")
        client.set_password(password)
        try:
            if certificate is not None:
                key = CertProperties(tmp_path / f"{certificate.stem}.key.pem")
                await client.set_security(
                    SecurityPolicyAes256Sha256RsaPss, CertProperties(certificate, "pem"), key,
                    server_certificate=CertProperties(tmp_path / "server.pem"),
                )  # fmt: skip
            async with client:
                await (await _device(client))[0].read_browse_name()
        except (ua.UaError, ConnectionError, TimeoutError, asyncio.CancelledError):
            return False
        return True

    done = plow_twin_here("live", *arguments, "--quiet")
    assert done.returncode == 2 and "certificate and key in --out-access for other machines" in done.stderr
    with _live(*arguments, "--out-access", str(tmp_path / "out.yaml"), *STALE) as live:
        live.until_count("samples_used", 100)
        trusted, other = tmp_path / "trusted" / "client.crt", tmp_path / "other.pem"
        cases = ((trusted, "s3cret"), (trusted, "guess"), (other, "s3cret"), (None, "s3cret"))
        connected = [_meanwhile(live, connects(*case)) for case in cases]
        assert connected == [True, False, False, False]
        live.process.terminate()
        output = live.process.communicate(timeout=60.0)[1]
        assert live.process.returncode == 0 and b"Traceback" not in output
    (tmp_path / "trusted" / "bad.pem").write_text("none")
    with pytest.raises(BridgeError, match=r"bad\.pem: got no certificate"):
        asyncio.run(Trusted([tmp_path / "trusted"], []).load())


class Database(BaseHTTPRequestHandler):
    """A handler with the write interface of InfluxDB 2."""

    def do_POST(self) -> None:
        server: Any = self.server
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        right = self.headers["Authorization"] == "Token a-token" and "org=mine&bucket=face" in self.path
        self.send_response(204 if right and server.open else 503 if right else 401)
        self.end_headers()
        if right and server.open:
            server.lines += text.splitlines()

    def log_message(self, *_: Any) -> None:
        """Log nothing."""


def test_influxdb_receives_the_lines_of_its_downtime(tmp_path: Path) -> None:
    path = _csv(tmp_path / "load.csv", 500)
    (tmp_path / "token").write_text("a-token\n")
    (tmp_path / "out.yaml").write_text("influx: {token_file: token}\n")
    with ThreadingHTTPServer(("127.0.0.1", 0), Database) as database:
        database.lines, database.open = [], False  # type: ignore[attr-defined]
        threading.Thread(target=database.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{database.server_address[1]}/mine/face"
        arguments = (str(path), "--follow", "--influx", url, "--out-access", str(tmp_path / "out.yaml"), *STALE)
        with _live(*arguments, "--out-rate", "5") as live:
            live.until(lambda listener: "503" in str(listener.get("influx", {}).get("message")), "trouble")
            database.open = True  # type: ignore[attr-defined]
            values = live.until(lambda events: events["influx"]["values"]["sent"] > 5, "sent")
            assert live.heard["influx"]["values"]["lost"] == 0 and values["samples_used"] == "500"
            assert live.stop() == 0
        lines = database.lines  # type: ignore[attr-defined]
        database.shutdown()
    clearance = [line for line in lines if line.startswith("plow_twin_clearance,head=plough_head ")][-1]
    fields, _, stamp = clearance.partition(" ")[2].rpartition(" ")
    assert "horizontal=0.025," in fields and "horizontal/p05=" in fields
    assert int(stamp) == 1_000_000_000 + 499 * 1_000_000  # the time of the last sample
    assert any('stream="running"' in line for line in lines if line.startswith("plow_twin_flags"))


def test_points_that_a_silent_or_absurd_database_has_not_confirmed_count_as_lost() -> None:
    groups = {"peaks": Group(1.0, {"top_left_top": 1.0}), "wear": Group(1.0, {"top_left_top": 1.0})}

    async def write(port: int) -> Any:
        output = Influx(f"http://127.0.0.1:{port}", "mine", "face", "a-token", None)
        await output.send(groups, Newest())
        await output.turn()  # does not wait for the answer
        await asyncio.sleep(0.2)
        await output.close(0.2)
        return output.state

    for answer, message in (
        (b"", "no connection yet"),
        (b"HTTP/1.1 500 x\r\nContent-Length: %d\r\n\r\n" % 2**60, "Memory"),
    ):
        with socket.create_server(("127.0.0.1", 0)) as listening:
            threading.Thread(target=_answer, args=(listening, answer), daemon=True).start()
            state = asyncio.run(write(listening.getsockname()[1]))
        assert (state.sent, state.lost, state.connected) == (0, 2, False) and message in state.trouble


def _answer(listening: socket.socket, answer: bytes) -> None:
    connection, _ = listening.accept()
    with connection:
        connection.recv(65536)
        connection.sendall(answer)
        time.sleep(1.0)


def test_an_ipv6_address_keeps_its_brackets_and_a_bad_token_is_refused_without_printing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PLOW_TWIN_INFLUX_TOKEN", "a-token")
    assert influx_out("http://[::1]:8086/mine/face", Credentials(), plain=False).first["url"] == "http://[::1]:8086"
    served = opcua_out("opc.tcp://[::1]:4841", Credentials(), plain=False, acknowledges=False)
    assert served.address == served.first["endpoint"] == "opc.tcp://[::1]:4841"
    with pytest.raises(AccessError, match="the prefix without"):
        mqtt_out(f"mqtt://localhost/{'p' * 70_000}", Credentials(), plain=False)
    for token in ("t\N{EURO SIGN}ken", "a-token\n"):
        monkeypatch.setenv("PLOW_TWIN_INFLUX_TOKEN", token)
        with pytest.raises(AccessError) as caught:
            influx_out("http://localhost/mine/face", Credentials(), plain=False)
        assert token.strip() not in str(caught.value)
