"""OPC UA inputs from a real server in a separate process, with losses, breaks, history and certificates."""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from network import free_port, make_certificate
from record_support import PAPER_AMPLITUDE, records_of
from test_live import ROOT, _live
from waiting import until

from plow_twin.live.bridge.access import Access
from plow_twin.live.bridge.opcua.bridge import OpcUa
from plow_twin.live.bridge.opcua.link import Revised
from plow_twin.live.bridge.opcua.samples import NOT_MEASURED, Samples
from plow_twin.live.bridge.source import BridgeError
from plow_twin.live.diagnostics import SOURCE_KEYS
from plow_twin.record.entries import EntryRecord
from plow_twin.record.mapping import read_map
from plow_twin.record.replay import replay
from plow_twin.record.sources import Arrived
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.stream.journal import Entry, Hold, Sample
from plow_twin.stream.session import Session

MAP = "excitation: {fx: {node: 'ns=2;s=Load.Fx', unit: kN}, fy: {node: ns=2;s=Load.Fy}, m: {node: ns=2;s=Load.M}}\n"
MS = 1_000_000


class Plant:
    """The server, and a connection to it that can be interrupted."""

    def __init__(self, *security: str, **environment: str) -> None:
        self.port, server_port = free_port(), free_port()
        self._process = subprocess.Popen(
            [sys.executable, str(ROOT / "test" / "opcua_server.py"), str(server_port), *security],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | environment,
            text=True,
        )
        assert self._process.stdout is not None and self._process.stdout.readline() == "ready\n"
        self._server = self._own = ("127.0.0.1", server_port)
        self._sockets: list[socket.socket] = []
        self.mend()

    def do(self, name: str, *arguments: Any, **how: Any) -> None:
        """Send a command to the server, and wait until it has been carried out."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps([name, arguments, how]) + "\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n"

    def mend(self) -> None:
        self._door = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._let_in, args=(self._door,), daemon=True).start()

    def restart_as(self, other: Plant) -> None:
        """Close all connections, and forward new connections to another server."""
        self.cut()
        self._server = other._own
        self.mend()

    def cut(self) -> None:
        for server in (self._door, *self._sockets):
            with suppress(OSError):
                server.shutdown(socket.SHUT_RDWR)
            server.close()
        self._sockets = []

    def _let_in(self, door: socket.socket) -> None:
        while True:
            try:
                client, _ = door.accept()
                server = socket.create_connection(self._server)
            except OSError:
                return
            self._sockets += [client, server]
            for pair in ((client, server), (server, client)):
                threading.Thread(target=_pass_on, args=pair, daemon=True).start()

    def close(self) -> None:
        self.cut()
        self._process.kill()
        self._process.communicate()


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(1 << 16):
            sink.sendall(data)
    for found in (source, sink):
        with suppress(OSError):
            found.shutdown(socket.SHUT_RDWR)


@pytest.fixture(scope="module")
def running() -> Iterator[Plant]:
    """Yield a server for all tests. Its start takes 1.7 s of processor time."""
    plant = Plant()
    yield plant
    plant.close()


@pytest.fixture
def server(running: Plant) -> Iterator[Plant]:
    """Yield the server without connections and history, which would fill breaks in other tests."""
    running.do("forget")
    yield running
    running.restart_as(running)


@pytest.fixture
def roles(tmp_path: Path) -> Any:
    (tmp_path / "map.yaml").write_text(MAP)
    return read_map(tmp_path / "map.yaml", None)


def _rows(start_ns: int, first: int, last: int, step_ns: int = MS) -> list[list[float]]:
    """Return stamps and values of samples, with the force along x in kN."""
    samples = []
    for index in range(first, last):
        phase = float(np.sin(2e-9 * step_ns * index))
        fx, fy, m = (phase * amplitude for amplitude in PAPER_AMPLITUDE)
        samples.append([start_ns + index * step_ns, fx / 1e3, fy, m])
    return samples


@contextmanager
def _bridge(plant: Plant, roles: Any, **options: Any) -> Iterator[OpcUa]:
    bridge = OpcUa(Access(f"opc.tcp://127.0.0.1:{plant.port}/plant"), roles, **options)
    bridge.start(list(bridge.topics()))
    try:
        yield bridge
    finally:
        bridge.close()


def _until(bridge: OpcUa, enough: Callable[[list[Arrived]], bool]) -> list[Arrived]:
    arrived: list[Arrived] = []

    def poll() -> bool:
        arrived.extend(bridge.poll(0.1))
        return enough(arrived)

    until(poll, arrived)
    return arrived


def _stamps(found: list[Arrived]) -> list[int]:
    return [arrived.content["source"] for arrived in found]


def test_values_with_one_stamp_form_a_sample_and_unchanged_fields_are_repeated() -> None:
    samples = Samples(["a", "b"], wait_s=1.0)
    samples.add("a", 10, 1.0, 0.0)
    samples.add("b", 10, 2.0, 0.1)
    samples.add("a", 20, 3.0, 0.2)
    # the sample at 20 waits, because its value of b may still arrive
    assert samples.take(0.3) == [(10, {"a": 1.0, "b": 2.0})]
    samples.add("b", 30, 4.0, 0.4)
    samples.add("a", 30, 5.0, 0.4)
    assert samples.take(0.5) == [(20, {"a": 3.0, "b": 2.0}), (30, {"a": 5.0, "b": 4.0})]
    samples.add("b", 40, NOT_MEASURED, 0.6)
    assert samples.take(0.7) == [] and samples.take(1.7) == [(40, {"a": 5.0, "b": NOT_MEASURED})]
    # this value is late: the value of b at its stamp is no longer stored, so there is no sample
    samples.add("a", 35, 6.0, 2.0)
    samples.add("b", 25, 7.0, 2.0)
    samples.add("a", 25, 8.0, 2.0)
    assert samples.take(2.1) == [(25, {"a": 8.0, "b": 7.0})]
    assert samples.take(9.0) == []
    assert samples.take_incomplete() == 1
    samples.add("b", 40, 9.0, 9.0)  # the value of b at 40 is repeated
    assert samples.take(99.0) == []
    # a value with an impossible stamp changes nothing
    samples.add_stray("a", 10**18, 1.0, 9.0)
    samples.add("b", 50, 3.0, 9.0)
    samples.add("a", 50, 2.0, 9.0)
    assert samples.take(10.5) == [(50, {"a": 2.0, "b": 3.0}), (10**18, {"a": 1.0, "b": 3.0})]
    assert set(samples.newest_ns.values()) == {50}
    samples = Samples(["a", "b"], wait_s=1.0)
    samples.begin("a", 5, 1.0)
    samples.add("b", 7, 2.0, 0.0)
    assert samples.take(2.0) == [(7, {"a": 1.0, "b": 2.0})]


def test_a_wrong_mapping_of_nodes_names_the_key(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    for text, message in (
        ("excitation: {fx: {node: 5}, fy: {node: a}, m: {node: b}}", "excitation.fx"),
        ("head_pose: {x: {node: a, unit: kN}}", "unit.x: got 'kN', expected one of m"),
        ("head_pose: {x: {node: a}, stamp: t}", "stamp: got 't', expected source or server"),
        ("head_pose: {x: {node: a}, stamp_unit: ms}", "stamp_unit: got 'ms', expected no stamp_unit"),
        ("head_pose: {x: {node: a}, sequence: n}", "sequence: got 'n', expected no sequence"),
    ):
        path.write_text(text)
        with pytest.raises(Exception, match="got") as caught:
            read_map(path, None)
        assert message in str(caught.value)


def test_samples_have_source_stamps_and_bad_values_are_counted(server: Plant, roles: Any) -> None:
    start_ns = time.time_ns() // MS * MS
    with _bridge(server, roles) as bridge:
        server.do("rows", _rows(start_ns, 0, 200), 1e-3)
        arrived = _until(bridge, lambda found: len(found) >= 200)
        assert _stamps(arrived) == [row[0] for row in _rows(start_ns, 0, 200)]
        stamp_ns, values = roles["excitation"].read(arrived[77])
        assert (stamp_ns, values["fx"]) == (start_ns + 77 * MS, pytest.approx(1e3 * _rows(start_ns, 77, 78)[0][1]))
        for index, status in ((200, "BadSensorFailure"), (201, "UncertainLastUsableValue"), (202, "GoodClamped")):
            server.do("rows", _rows(start_ns, index, index + 1), status=status)
        server.do("write", start_ns + 203 * MS, [None, 7.0, None])  # the other values are unchanged
        *bad, good, last = (
            roles["excitation"].read(found)[1] for found in _until(bridge, lambda found: len(found) >= 4)
        )
        assert all(np.isnan(values["fx"]) for values in bad) and np.isfinite(good["fx"])
        assert last == good | {"fy": 7.0}
        level, message, facts = bridge.part()
        assert (facts["bad"], facts["uncertain"], facts["breaks"]) == ("1", "1", "0") and bridge.lost == 0
        assert facts["publishing_ms"] == "10" and (level, message) == (0, "")
        assert facts.keys() == SOURCE_KEYS.keys()


def test_a_lost_message_is_detected_and_read_from_the_history(server: Plant, roles: Any) -> None:
    start_ns = time.time_ns() // MS * MS
    with _bridge(server, roles) as bridge:
        server.do("rows", _rows(start_ns, 0, 5))
        _until(bridge, lambda found: start_ns + 4 * MS in _stamps(found))
        server.do("number", 1)
        server.do("rows", _rows(start_ns, 6, 8))
        arrived = _until(bridge, lambda found: start_ns + 7 * MS in _stamps(found))
        assert bridge.part()[2]["notifications_lost"] == "1" and bridge.lost == 0
        assert _stamps(arrived) == [start_ns + 6 * MS, start_ns + 7 * MS]


def test_the_server_s_grants_are_compared_with_the_requests() -> None:
    assert Revised(10.0, 1.0, 100).complaint(1.0) == ""
    assert Revised(10.0, 10.0, 100).complaint(0.0) == ""
    assert "samples every 100 ms, requested every 1 ms" in Revised(100.0, 100.0, 1000).complaint(1.0)
    assert "queues 1 values, but 100 arrive" in Revised(100.0, 1.0, 1).complaint(1.0)


def _without_undone_holds(entries: list[Entry]) -> list[Sample | Hold]:
    """Return samples and holds, without the holds that the session undoes because the next sample is late.

    On a busy machine, the hold policy may act for a few milliseconds between two samples. Such a hold is not undone.
    """
    kept: list[Sample | Hold] = []
    for entry in entries:
        if isinstance(entry, Sample | Hold):
            if isinstance(entry, Sample) and kept and kept[-1].stamp_ns >= entry.stamp_ns:
                while isinstance(kept[-1], Hold):
                    kept.pop()
            kept.append(entry)
    return kept


def test_a_minute_without_a_connection_is_filled_and_ends_in_the_digest_of_the_uninterrupted_run(
    server: Plant, tmp_path: Path
) -> None:
    """During the break, the hold policy drives the model. After the break, the model goes back to the last sample."""
    (tmp_path / "map.yaml").write_text(MAP)
    run, step_ns = tmp_path / "run", 10 * MS
    start_ns = time.time_ns() // MS * MS - 63_000 * MS
    arguments = (
        *(f"opc.tcp://127.0.0.1:{server.port}/plant", "--map", str(tmp_path / "map.yaml")),
        *("--scene", "paper", "--record", str(run), "--set", "excitation_timeout=0.3"),
    )
    with _live(*arguments) as live:
        live.until(lambda heard: "source" in heard, "connected")
        server.do("rows", _rows(start_ns, 0, 200, step_ns))
        live.until_count("samples_used", 200)
        server.cut()
        live.until(lambda heard: int(heard["input"]["values"]["holds"]) > 0, "holds")
        server.do("rows", _rows(start_ns, 200, 6200, step_ns))  # 60 s
        server.mend()
        values = live.until_count("samples_used", 6200)
        assert int(values["rolled_back"]) > 0 and values["samples_used"] == values["samples_in"] == "6200"
        live.until(lambda heard: int(heard["source"]["values"]["breaks_filled"]) == 1, "filled")
        assert float(live.heard["source"]["values"]["unfilled_s"]) == 0.0
        assert live.stop() == 0
    entries = [record.entry for record in records_of(run) if isinstance(record, EntryRecord)]
    interrupted, whole = (
        Session(Twin(load_scene("paper"), excitation="sampled"), rollback_span_s=2.0) for _ in range(2)
    )
    ends = 1 + max(index for index, entry in enumerate(entries) if isinstance(entry, Sample))
    for entry in entries[:ends]:
        interrupted.apply(entry)
    lasting = _without_undone_holds(entries[:ends])
    assert sum(isinstance(entry, Sample) for entry in lasting) == 6200
    last_before = next(place for place, entry in enumerate(lasting) if entry.stamp_ns == start_ns + 199 * step_ns)
    assert isinstance(lasting[last_before + 1], Sample)  # the holds of the break are undone
    for entry in lasting:
        whole.apply(entry)
    assert interrupted.twin.digest() == whole.twin.digest()
    assert replay(run).exit_code == 0


def test_a_break_without_history_is_a_loss(server: Plant, roles: Any) -> None:
    start_ns = time.time_ns() // MS * MS
    with _bridge(server, roles) as bridge:
        server.do("rows", _rows(start_ns, 0, 10))
        _until(bridge, lambda found: start_ns + 9 * MS in _stamps(found))
        # a single stamp that is a year ahead is passed on, but does not end the break
        year_ns = start_ns + 31_536_000 * 1000 * MS
        server.do("rows", _rows(year_ns, 9, 10), keep=False)
        _until(bridge, lambda found: year_ns + 9 * MS in _stamps(found))
        server.cut()
        until(lambda: not bridge.connected, "the end of the connection")
        broken = bridge.part()[2]
        assert broken["breaks"] == "1" and float(broken["unfilled_s"]) > 0.0
        server.do("rows", _rows(start_ns, 10, 20), keep=False)
        server.mend()
        _until(bridge, lambda found: start_ns + 19 * MS in _stamps(found))
        facts = bridge.part()[2]
        assert (facts["breaks"], facts["breaks_filled"], facts["unfilled_s"], bridge.lost) == ("1", "0", "0.01", 1)
        assert facts["no_history"] == "the history of the server is empty"


@pytest.mark.parametrize("kind", ["future", "endless", "nothing"])
def test_a_wrong_history_is_not_used(kind: str, server: Plant, roles: Any) -> None:
    start_ns = time.time_ns() // MS * MS
    with _bridge(server, roles) as bridge:
        server.do("rows", _rows(start_ns, 0, 5))
        _until(bridge, lambda found: start_ns + 4 * MS in _stamps(found))
        server.do("lie", kind)
        server.do("number", -1)  # a repeated sequence number is not a loss
        server.do("rows", _rows(start_ns, 5, 6))
        _until(bridge, lambda found: start_ns + 5 * MS in _stamps(found))
        assert bridge.part()[2]["notifications_lost"] == "0"
        server.do("number", 1)
        server.do("rows", _rows(start_ns, 9, 12))
        arrived = _until(bridge, lambda found: start_ns + 11 * MS in _stamps(found))
        assert _stamps(arrived) == [start_ns + index * MS for index in (9, 10, 11)]
        facts = bridge.part()[2]
        assert ((facts["history_strays"] != "0") is (kind == "future")) and bridge.lost == 1
        assert kind == "future" or "history" in facts["no_history"]
        # the clock of the server steps back by an hour
        server.do("rows", _rows(start_ns - 3_600_000 * MS, 0, 5))
        arrived = _until(bridge, lambda found: len(found) >= 5)
        assert _stamps(arrived) == [start_ns - 3_600_000 * MS + index * MS for index in range(5)]


def test_a_server_that_restarts_with_other_namespace_numbers_or_refuses_for_a_while_is_followed(
    server: Plant, roles: Any
) -> None:
    second = Plant(MORE_NAMESPACES="1")
    start_ns = time.time_ns() // MS * MS
    try:
        second.do("refuse", True)
        with _bridge(server, roles) as bridge:
            server.do("rows", _rows(start_ns, 0, 5))
            _until(bridge, lambda found: len(found) >= 5)
            server.restart_as(second)
            _until(bridge, lambda _: "BadTooManySubscriptions" in bridge.trouble)
            second.do("refuse", False)
            _until(bridge, lambda _: bridge.connected)
            second.do("rows", _rows(start_ns, 10, 15))
            arrived = _until(bridge, lambda found: start_ns + 14 * MS in _stamps(found))
            assert _stamps(arrived)[-5:] == [start_ns + index * MS for index in range(10, 15)]
    finally:
        second.close()


@pytest.mark.parametrize(
    "answer", [b"", b"ACKF\x1c", b"\0" * 100, b"MSGF\xff\xff\xff\xff" + bytes(3 << 20), b"MSGC\x08\0\0\0" * 1000]
)
def test_a_server_that_sends_nonsense_or_a_part_of_a_message_is_refused_in_bounded_memory(
    answer: bytes, roles: Any
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:

        def serve() -> None:
            with suppress(OSError):
                client, _ = door.accept()
                with client:
                    client.recv(1 << 16)
                    client.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        bridge = OpcUa(Access(f"opc.tcp://127.0.0.1:{door.getsockname()[1]}"), roles, connect_s=20.0)
        with pytest.raises(BridgeError, match=r"no server at|refused|no answer"):
            bridge.start([])
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates")
    for name, uri in (
        ("server", "urn:freeopcua:python:server"),
        ("client", "urn:plow-twin:client"),
        ("other", "urn:x"),
        ("user", "urn:y"),
    ):
        make_certificate(folder, name, uri)
        (folder / f"{name}.key").symlink_to(f"{name}.key.pem")  # a usual name of a key in PEM
    return folder


@pytest.fixture(scope="module")
def secured(certificates: Path) -> Iterator[tuple[Plant, Access]]:
    plant = Plant(*(str(certificates / name) for name in ("server.pem", "server.key.pem", "user.pem")))
    yield (
        plant,
        Access(
            f"opc.tcp://localhost:{plant.port}/plant",
            user="plough",
            password="s3cret",
            ca=certificates / "server.pem",
            certificate=certificates / "client.pem",
            key=certificates / "client.key",
        ),
    )
    plant.close()


def test_an_encrypted_session_of_a_user_leaves_no_secret_in_the_recording(
    secured: tuple[Plant, Access], tmp_path: Path
) -> None:
    plant, access = secured
    (tmp_path / "map.yaml").write_text(MAP)
    arguments = (
        *(access.url, "--map", str(tmp_path / "map.yaml"), "--user", access.user, "--record", str(tmp_path / "run")),
        *("--tls-ca", str(access.ca), "--tls-cert", str(access.certificate), "--tls-key", str(access.key)),
    )

    with _live(*arguments, env={"PLOW_TWIN_OPCUA_PASSWORD": access.password}) as live:
        live.until(lambda heard: "source" in heard, "connected")
        plant.do("rows", _rows(time.time_ns() // MS * MS, 0, 10))
        live.until_count("samples_used", 10)
        shown = Path(f"/proc/{live.process.pid}/cmdline").read_bytes()
        assert live.stop() == 0
    recorded = b"".join(path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file())
    key = Path(str(access.key)).read_bytes().splitlines()[5]
    assert access.password.encode() not in shown + recorded and key not in recorded


def test_only_the_user_with_the_certificate_can_log_in(
    secured: tuple[Plant, Access], certificates: Path, roles: Any, tmp_path: Path
) -> None:
    plant, access = secured
    access = replace(access, user="", password="")
    for name, admitted in (("user", True), ("other", False)):
        files = {"user_certificate": certificates / f"{name}.pem", "user_key": certificates / f"{name}.key"}
        bridge = OpcUa(replace(access, **files), roles)
        if not admitted:
            with pytest.raises(BridgeError, match="refused"):
                bridge.start(list(bridge.topics()))
            continue
        bridge.start(list(bridge.topics()))
        try:
            plant.do("rows", _rows(time.time_ns() // MS * MS, 0, 5))
            assert len(_until(bridge, lambda found: len(found) >= 5)) >= 5
        finally:
            bridge.close()
    # the client has a copied certificate, but not its key
    stolen = replace(access, user_certificate=certificates / "user.pem", user_key=certificates / "other.key.pem")
    bridge = OpcUa(stolen, roles)
    with pytest.raises(BridgeError, match="refused"):
        bridge.start(list(bridge.topics()))
    (tmp_path / "no.key").write_text("none")
    bridge = OpcUa(replace(stolen, user_key=tmp_path / "no.key"), roles)
    with pytest.raises(BridgeError, match="--user-key cannot be used"):
        bridge.start(list(bridge.topics()))
    for wrong in (replace(stolen, user_key=None), replace(stolen, user="a"), replace(stolen, ca=None)):
        with pytest.raises(BridgeError, match=r"expected --|--user-cert replaces"):
            OpcUa(wrong, roles)


def test_untrusted_and_unencrypted_connections_are_refused(
    secured: tuple[Plant, Access], certificates: Path, roles: Any, server: Plant
) -> None:
    _, access = secured
    for wrong, message in (
        ({"password": "guess"}, "refused"),
        ({"ca": certificates / "other.pem"}, "certificate verify failed"),
        ({"key": certificates / "other.key"}, "the key does not belong to the certificate"),
        ({"certificate": None, "key": None, "ca": None}, "refused|No matching"),
        ({"url": f"opc.tcp://127.0.0.1:{server.port}/plant"}, "offers no encryption"),
        ({"url": "opc.tcp://localhost:1"}, "no server at localhost:1"),
    ):
        with pytest.raises(BridgeError, match=message):
            OpcUa(replace(access, **wrong), roles).start([])  # type: ignore[arg-type]
    for wrong, message in (
        ({"url": "opc.tcp://plough.example", "certificate": None, "key": None, "ca": None}, "without certificates"),
        ({"url": "opc.tcp://user:secret@localhost"}, "user and topics are set by other options"),
        ({"key": None}, "together"),
    ):
        with pytest.raises(BridgeError, match=message) as caught:
            OpcUa(replace(access, **wrong), roles)  # type: ignore[arg-type]
        assert "secret" not in str(caught.value)


def test_a_missing_node_is_named(server: Plant, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP.replace("Load.Fy", "Load.Fz"))
    bridge = OpcUa(Access(f"opc.tcp://127.0.0.1:{server.port}"), read_map(tmp_path / "map.yaml", None))
    with pytest.raises(BridgeError, match=r"Load\.Fz, expected a node of the server: BadNodeIdUnknown"):
        bridge.start([])
    (tmp_path / "map.yaml").write_text(MAP.replace("ns=2;s=Load.Fy", "Load.Fy"))
    with pytest.raises(BridgeError, match=r"node: got 'Load\.Fy', expected an identifier"):
        OpcUa(Access("opc.tcp://127.0.0.1:1"), read_map(tmp_path / "map.yaml", None))
