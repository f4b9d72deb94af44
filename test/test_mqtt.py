"""MQTT inputs and outputs with a real broker in another process, with paho 2 and paho 1.6."""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from commands import plow_twin_here
from network import free_port
from record_support import records_of
from test_live import ROOT, _csv, _live, _row
from waiting import until

from plow_twin.cli.app import run as run_cli
from plow_twin.live.bridge import mqtt
from plow_twin.live.bridge.access import Access
from plow_twin.live.bridge.mqtt import Mqtt
from plow_twin.live.bridge.paho_client import make_client, use_tls
from plow_twin.live.bridge.source import BridgeError
from plow_twin.record.entries import EntryRecord
from plow_twin.stream.journal import Digest
from plow_twin.telemetry.mqtt import Broker, Message
from plow_twin.telemetry.sparkplug import Payload

#: Version of the broker. Versions before 0.12 close connections that they refuse.
AMQTT = tuple(map(int, version("amqtt").split(".")[:2]))
ONLINE = Message("online", b"true", True)
STALE = ("--set", "excitation_timeout=3600")


def _hash(password: str) -> str:
    try:
        from pwdlib import PasswordHash
    except ModuleNotFoundError:  # amqtt before 0.12
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            from passlib.apps import custom_app_context

        return str(custom_app_context.hash(password))
    return PasswordHash.recommended().hash(password)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Access]:
    """Yield a broker with TLS and one user, for whom it stores messages during a disconnection."""
    certificate, key = tmp_path / "broker.pem", tmp_path / "broker.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost", "-keyout", str(key),
         "-out", str(certificate)],
        check=True, capture_output=True,
    )  # fmt: skip
    (tmp_path / "users").write_text(f"plough:{_hash('s3cret')}\n")
    port = free_port()
    tls = {"ssl": True, "certfile": str(certificate), "keyfile": str(key)}
    config = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}", **tls}},
        "plugins": {
            "amqtt.plugins.authentication.FileAuthPlugin": {"password_file": str(tmp_path / "users")},
            "amqtt.plugins.topic_checking.TopicTabooPlugin": {},
        },
    }
    (tmp_path / "broker.yaml").write_text(json.dumps(config))
    with (tmp_path / "broker.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "test" / "mqtt_broker.py"), str(tmp_path / "broker.yaml")],
            stdout=subprocess.PIPE,
            stderr=log,
        )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n", (tmp_path / "broker.log").read_text()
        yield Access(f"mqtts://localhost:{port}", user="plough", password="s3cret", ca=certificate)
    finally:
        process.kill()
        process.communicate()


class Subscriber:
    """A client that stores the messages of all topics in order of arrival."""

    def __init__(self, port: int, access: Access | None = None, topics: str = "#") -> None:
        self.messages: list[tuple[str, bytes, bool]] = []
        self._subscribed = threading.Event()
        self.client = make_client("", clean=True)
        if access is not None:
            self.client.username_pw_set(access.user, access.password)
            use_tls(self.client, access.ca, None, None)
        self.client.on_connect = lambda client, *_: client.subscribe(topics, 1)
        self.client.on_subscribe = lambda *_: self._subscribed.set()
        self.client.on_message = lambda _, __, found: self.messages.append((found.topic, found.payload, found.retain))
        self.client.connect("localhost" if access else "127.0.0.1", port)
        self.client.loop_start()
        assert self._subscribed.wait(30.0)

    def until(self, reached: Callable[[], bool]) -> None:
        until(reached, self.messages)

    def newest(self, topic: str) -> Any:
        payloads = [payload for name, payload, _ in self.messages if name == topic]
        return json.loads(payloads[-1]) if payloads else None

    def all(self, topic: str) -> list[Any]:
        return [json.loads(payload) for name, payload, _ in self.messages if name == topic]

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


class Sender:
    """A telemetry device that sends numbered samples to the broker."""

    def __init__(self, access: Access) -> None:
        self.client = make_client("", clean=True)
        self.client.username_pw_set(access.user, access.password)
        use_tls(self.client, access.ca, None, None)
        self.client.connect("localhost", urlsplit(access.url).port or 0)
        self.client.loop_start()
        self.number = 0

    def send(self, count: int) -> None:
        for _ in range(count):
            t, fx, fy, m = _row(self.number)
            self.number += 1
            payload = {"t": t, "force": {"x": fx / 1e3, "y": fy / 1e3}, "moment": m, "n": self.number}
            self.raw(json.dumps(payload).encode())

    def raw(self, payload: bytes, *, retain: bool = False) -> None:
        self.client.publish("plough/load", payload, qos=1, retain=retain).wait_for_publish(30.0)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


MAP = """
excitation: {topic: plough/load, fields: {fx: force.x, fy: force.y, m: moment}, unit: {fx: kN, fy: kN}, sequence: n}
"""


def test_a_broker_keeps_messages_for_an_absent_twin_and_garbage_is_counted(broker: Access, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP)
    (tmp_path / "password").write_text(broker.password + "\n")
    arguments = (
        *(broker.url, "--map", str(tmp_path / "map.yaml"), "--set", "excitation_timeout=3600"),
        *("--user", broker.user, "--password-file", str(tmp_path / "password"), "--tls-ca", str(broker.ca)),
    )
    sender = Sender(broker)
    old = {"t": 3.0, "force": {"x": 1.0, "y": 1.0}, "moment": 1.0, "n": 9000}
    # this message was sent before the start of the twin, so the count of numbers does not begin with it
    sender.raw(json.dumps(old).encode(), retain=True)
    with _live(*arguments) as live:
        live.until_count("dropped_inactive", 1)
        sender.send(50)
        for payload in (b"{nonsense", b"\xff\xfe", b"[" * 60000, b'{"n": 51}', b"x" * 100000):
            sender.raw(payload)
        values = live.until_count("samples_in", 56)
        assert (values["samples_used"], values["dropped_malformed"], values["samples_lost"]) == ("50", "5", "0")
        assert live.stop() == 3
    sender.client.publish("plough/load", b"", qos=0, retain=True).wait_for_publish(30.0)
    sender.send(50)
    with _live(*arguments) as live:
        values = live.until_count("samples_used", 50)
        # the broker also delivers the empty message that removes the retained message
        assert (values["samples_lost"], values["dropped_malformed"]) == ("0", "1")
        assert live.stop() == 3
    sender.close()


# paho does not close the socket of a failed handshake; the garbage collector does
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_misspelt_topic_of_a_broker_is_an_error(
    broker: Access, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PLOW_TWIN_MQTT_PASSWORD", broker.password)
    mapping = tmp_path / "map.yaml"
    mapping.write_text("excitation: {topic: plough/mistaken, fields: {fx: fx, fy: fy, m: m}}\n")
    access = ["--user", broker.user, "--tls-ca", str(broker.ca)]
    arguments = ["live", broker.url, "--map", str(mapping), "--scene", "paper", "--seconds", "1", "--quiet"]
    assert run_cli([*arguments, *access]) == 3
    assert "topic plough/mistaken: got no sample" in capsys.readouterr().err
    gc.collect()  # the socket is closed here, where its warning is ignored, and not during another test


# paho does not close the socket of a failed handshake; the garbage collector does
@pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_wrong_password_a_strange_certificate_and_a_broker_without_tls_are_refused(broker: Access) -> None:
    for wrong, message in (
        ({"password": "guess"}, "refused" if AMQTT >= (0, 12) else "the connection broke"),
        ({"ca": None}, "certificate verify failed"),
        ({"url": broker.url.replace("mqtts", "mqtt")}, "no answer"),
    ):
        bridge = Mqtt(
            replace(broker, **wrong), connect_s=60.0 if message in ("refused", "certificate verify failed") else 2.0
        )
        with pytest.raises(BridgeError, match=message):
            bridge.start(["plough/load"])
        assert not bridge.connected
    for topic, message in (
        ("prohibited", "refused: prohibited"),
        ("plough/+/load", r"topic: got 'plough/\+/load'"),
        ("p" * 70_000, r"70000 characters\)', expected one topic of up to 65,535"),
    ):
        with pytest.raises(BridgeError, match=message):
            Mqtt(replace(broker, client_id="other"), connect_s=60.0).start(["plough/load", topic])


@contextmanager
def _hostile(*answers: bytes) -> Iterator[Access]:
    """Yield a broker that answers the packets of each connection by `answers`, and closes it at the next packet."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listening.accept()
                with connection, suppress(OSError):
                    for answer in answers:
                        connection.recv(4096)
                        connection.sendall(answer)
                    if answers[-1]:
                        connection.recv(4096)

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield Access(f"mqtt://127.0.0.1:{listening.getsockname()[1]}")
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"\x20\x02\x00\x05", "refused: .*not authori[sz]ed"),
        (b"", "no answer within 1 s; the connection broke"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "no answer within 1 s$"),
    ],
    ids=["refuses", "closes", "is none"],
)
def test_a_refusal_by_the_broker_is_reported(answer: bytes, message: str) -> None:
    with _hostile(answer) as access, pytest.raises(BridgeError, match=f"(?i){message}"):
        Mqtt(access, connect_s=1.0).start(["a"])


def test_a_flood_of_messages_from_a_broker_takes_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "_QUEUED_BYTES", 500_000)

    def published(size: int) -> bytes:
        length = size + 3
        return bytes([0x30, length & 127 | 128, length >> 7 & 127 | 128, length >> 14]) + b"\0\1a" + bytes(size)

    flood = published(100_000) * 5 + published(60_000) * 20 + published(1)
    with _hostile(b"\x20\x02\x00\x00", b"\x90\x03\x00\x01\x01" + flood) as access:
        bridge = Mqtt(access)
        bridge.start(["a"])
        until(lambda: (bridge.lost, len(bridge._queue)) == (12, 14))
        waiting = [len(payload) for _, payload, _, _ in bridge._queue]
        assert waiting == [0] * 5 + [60_000] * 8 + [1]
        assert [message.content for message in bridge.poll(0.0)] == [None] * 14
        bridge.close()


@pytest.mark.parametrize(
    "url", ["mqtt://plough.example:1883", "http://localhost", "mqtt://user:secret@localhost", "mqtt://localhost/topic"]
)
def test_another_machine_without_tls_and_passwords_in_the_address_are_refused(url: str) -> None:
    with pytest.raises(BridgeError) as caught:
        Mqtt(Access(url))
    assert "secret" not in str(caught.value)


@contextmanager
def _open_broker(folder: Path, port: int) -> Iterator[None]:
    config = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    (folder / "open.yaml").write_text(json.dumps(config))
    command = [sys.executable, str(ROOT / "test" / "mqtt_broker.py"), str(folder / "open.yaml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            yield
        finally:
            process.kill()


def test_a_broker_receives_all_groups_with_tls_and_reports_the_end_of_the_twin(broker: Access, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text(broker.password + "\n")
    (tmp_path / "out.yaml").write_text(f"mqtt: {{user: plough, password_file: secret, ca: '{broker.ca}'}}\n")
    path, url = _csv(tmp_path / "load.csv", 1500), f"{broker.url}/face/plough"
    port = urlsplit(broker.url).port or 0
    arguments = (str(path), "--follow", "--mqtt-out", url, "--out-access", str(tmp_path / "out.yaml"), *STALE)
    alarm = ("--set", "alarm_force=[20e3,1e9]", "--set", "alarm_duration=0.0")
    early = Subscriber(port, broker)
    # with a variable of its own the twin is started, not forked, so that its command line is its own
    with _live(*arguments, *alarm, "--out-rate", "5", env={"OF_THIS_TEST": "1"}) as live:
        live.until_count("samples_used", 1500)
        live.until(lambda heard: heard.get("mqtt_out", {}).get("values", {}).get("sent", 0) > 8, "sent")
        assert broker.password not in Path(f"/proc/{live.process.pid}/cmdline").read_text()
        # a late subscriber gets the newest message of each topic except the peaks, which are not retained
        late = Subscriber(port, broker)
        late.until(lambda: late.newest("face/plough/alarms") is not None and len(late.messages) >= 7)
        groups = {"clearance", "wear", "life", "flags", "status", "alarms", "online"}
        assert {topic.removeprefix("face/plough/") for topic, _, _ in late.messages} == groups
        clearance, alarms = late.newest("face/plough/clearance"), late.newest("face/plough/alarms")["values"]
        assert clearance["unit"] == "m" and clearance["values"]["horizontal/p05"] == pytest.approx(0.025)
        assert alarms["force_latched"] == "warn" and alarms["force_raised"] > alarms["force_threshold"] == 20e3
        peaks = [json.loads(message) for topic, message, _ in early.messages if topic == "face/plough/peaks"]
        largest = max(max(filter(None, found["values"].values()), default=0.0) for found in peaks)
        assert largest == pytest.approx(alarms["force_raised"], rel=1e-6) or largest > alarms["force_raised"]
        assert late.newest("face/plough/online") is True
        live.process.kill()
        late.until(lambda: late.newest("face/plough/online") is False)
    for subscriber in (early, late):
        subscriber.close()


def test_an_output_process_that_does_not_read_updates_is_reported(tmp_path: Path) -> None:
    path, url = _csv(tmp_path / "load.csv", 100), f"mqtt://127.0.0.1:{free_port()}/plough"
    with _live(str(path), "--follow", "--mqtt-out", url, "--out-rate", "500", *STALE) as live:
        live.until(lambda heard: "no broker" in heard.get("mqtt_out", {}).get("message", ""), "no broker")
        children = Path(f"/proc/{live.process.pid}/task").glob("*/children")
        numbers = [int(number) for found in children for number in found.read_text().split()]
        (output,) = (n for n in numbers if b"telemetry.process" in Path(f"/proc/{n}/cmdline").read_bytes())
        os.kill(output, signal.SIGSTOP)
        live.until(lambda heard: heard["mqtt_out"]["message"] == "its process does not read updates", "stopped")
        assert int(live.heard["mqtt_out"]["values"]["not_taken"]) > 0
        os.kill(output, signal.SIGKILL)


def test_a_run_that_ends_without_its_broker_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP.replace(", sequence: n", ""))
    port, client, broker = free_port(), make_client("", clean=True), ExitStack()
    broker.enter_context(_open_broker(tmp_path, port))

    def connected(parts: dict[str, dict[str, Any]]) -> bool:
        return "status" in parts and parts["status"]["values"]["publishers_excitation"] == 1

    with broker, _live(f"mqtt://127.0.0.1:{port}", "--map", str(tmp_path / "map.yaml")) as live:
        live.until(connected, "connected")
        client.connect("127.0.0.1", port)
        client.loop_start()
        sample = {"t": time.time(), "force": {"x": 1.0, "y": 1.0}, "moment": 1.0}
        client.publish("plough/load", json.dumps(sample).encode(), qos=1).wait_for_publish(30.0)
        live.until_count("samples_used", 1)
        client.disconnect()
        client.loop_stop()
        broker.close()
        live.until(lambda heard: not connected(heard), "the broker is gone")
        live.process.terminate()
        output = live.process.communicate(timeout=60.0)[1].decode()
    assert live.process.returncode == 3 and "not connected at the end: the connection broke" in output, output


def test_a_missing_broker_is_reported_and_does_not_affect_the_twin(tmp_path: Path) -> None:
    path, runs = _csv(tmp_path / "load.csv", 2000), [tmp_path / "alone", tmp_path / "with"]
    url = f"mqtt://127.0.0.1:{free_port()}/plough"
    done = [
        plow_twin_here("live", path, "--record", run, "--json", *more)
        for run, more in zip(runs, ((), ("--mqtt-out", url)), strict=True)
    ]
    assert [process.returncode for process in done] == [0, 0], done[1].stderr
    part = json.loads(done[1].stdout)["mqtt_out"]
    assert part["connected"] == "false" and part["sent"] == "0" and int(part["lost"]) > 0
    assert "mqtt_out" not in json.loads(done[0].stdout)
    digests = [[entry for entry in _entries(run) if isinstance(entry, Digest)] for run in runs]
    assert digests[0] == digests[1] and digests[0]


def _entries(run: Path) -> list[object]:
    return [record.entry for record in records_of(run) if isinstance(record, EntryRecord)]


def _output(port: int, **options: Any) -> Broker:
    return Broker(
        host="127.0.0.1", port=port, client_id="out", user="", password="", tls=None, will=lambda: ONLINE,
        on_connected=lambda: [ONLINE], **options,
    )  # fmt: skip


async def _reached(condition: Callable[[], object], event: object) -> None:
    await asyncio.to_thread(until, condition, event)


def test_messages_for_a_broker_are_limited_counted_and_sent_in_order(tmp_path: Path) -> None:
    port = free_port()

    async def send() -> None:
        output = _output(port, waiting=5)
        output.open()
        for number in range(8):
            output.send(Message("n", str(number).encode(), False))
        await _reached(lambda: output.state.trouble.startswith("no broker at 127.0.0.1"), output.state)
        assert (output.state.sent, output.state.lost, output.state.connected) == (0, 3, False)
        with _open_broker(tmp_path, port):
            subscriber = Subscriber(port)
            await _reached(lambda: output.state.sent == 6, output.state)
            subscriber.until(lambda: len(subscriber.messages) == 6)
            assert [payload for _, payload, _ in subscriber.messages] == [b"true", b"3", b"4", b"5", b"6", b"7"]
            assert (output.state.lost, output.state.trouble) == (3, "")
            subscriber.close()
        await _reached(lambda: not output.state.connected, output.state)
        await output.close(ONLINE, 0.0)

    asyncio.run(send())


def test_an_acknowledgement_that_arrives_while_a_message_is_sent_does_not_block_the_output(tmp_path: Path) -> None:
    port = free_port()

    async def send() -> None:
        output = _output(port)
        output.open()
        await _reached(lambda: output.state.sent == 1, output.state)
        with output.lock:
            output.send(Message("n", b"0"))
            until(lambda: output._acknowledged, output.state)  # the thread of paho is in the callback
            output.send(Message("n", b"1"))
        await _reached(lambda: output.state.sent == 3, output.state)
        await output.close(ONLINE, 10.0)

    with _open_broker(tmp_path, port):
        asyncio.run(send())


class EdgeNode:
    """The messages of the node `mine/plough`, as a Sparkplug B host receives them."""

    def __init__(self, port: int) -> None:
        self.subscriber = Subscriber(port, topics="spBv1.0/#")

    def messages(self, kind: str) -> list[Any]:
        topic = f"spBv1.0/mine/{kind}/plough"
        return [Payload.FromString(payload) for name, payload, _ in self.subscriber.messages if name == topic]

    def until(self, kind: str, count: int) -> Any:
        self.subscriber.until(lambda: len(self.messages(kind)) >= count)
        return self.messages(kind)[count - 1]

    def ask_for_rebirth(self) -> None:
        # field 2 of the payload is a metric with name (1), data type (4, here boolean) and value (14)
        name = b"Node Control/Rebirth"
        metric = bytes([0x0A, len(name)]) + name + bytes([0x20, 11, 0x70, 1])
        for payload in (b"\xff\xff", bytes([0x12, len(metric)]) + metric):
            self.subscriber.client.publish("spBv1.0/mine/NCMD/plough", payload, 1).wait_for_publish(30.0)


def _metrics(payload: Any) -> dict[str, Any]:
    return {metric.name: metric for metric in payload.metrics}


def test_a_sparkplug_host_receives_birth_data_rebirth_and_death_in_sequence(tmp_path: Path) -> None:
    port, path = free_port(), _csv(tmp_path / "load.csv", 500)
    arguments = (str(path), "--follow", "--mqtt-out", f"mqtt://127.0.0.1:{port}", "--sparkplug", "mine/plough")
    with ExitStack() as opened:
        opened.enter_context(_open_broker(tmp_path, port))
        host = EdgeNode(port)
        live = opened.enter_context(_live(*arguments, "--out-rate", "10", "--set", "excitation_timeout=0.1"))
        live.until_count("samples_used", 500)
        birth, data = host.until("NBIRTH", 1), host.until("NDATA", 5)
        born = _metrics(birth)
        assert birth.seq == 0 and born["bdSeq"].long_value == 0 and not born["Node Control/Rebirth"].boolean_value
        assert born["clearance/horizontal"].datatype == 10 and born["flags/stream"].datatype == 12
        assert [value.string_value for value in born["wear/top_left_top/p05"].properties.values] == ["m"]
        assert _metrics(data).keys() <= born.keys()
        numbers = [message.seq for message in host.messages("NDATA")]
        assert numbers == list(range(1, len(numbers) + 1))
        host.ask_for_rebirth()
        assert host.until("NBIRTH", 2).seq == 0
        again = _metrics(host.messages("NBIRTH")[1])
        assert again.keys() == born.keys() and again["bdSeq"].long_value == 0
        assert again["clearance/horizontal"].double_value == pytest.approx(0.025)
        live.process.kill()
        assert _metrics(host.until("NDEATH", 1))["bdSeq"].long_value == 0
        host.subscriber.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("mqtt://plant.example/plough", "mqtts:// for another machine, or --plain"),
        ("mqtt://user:secret@localhost/plough", "user and password in --out-access"),
        ("mqtt://localhost", "expected mqtt[s]://HOST:PORT/PREFIX"),
        ("mqtt://localhost/a/+/b", "the prefix without + and #"),
    ],
)
def test_a_bad_address_is_refused_with_the_expected_form(url: str, message: str, tmp_path: Path) -> None:
    done = plow_twin_here("live", _csv(tmp_path / "load.csv", 3), "--mqtt-out", url, "--quiet")
    assert done.returncode == 2 and message in " ".join(done.stderr.split()) and "secret" not in done.stderr
