"""The node with an OPC UA server instead of a topic, as a real node and a real server."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_processes import bench, value
from sensor_msgs.msg import JointState
from test_live_opcua import MAP, MS, Plant, _rows

from plow_twin.errors import InputError
from plow_twin.live.bridge.access import Access, read_access
from plow_twin.record.replay import replay
from plow_twin.ros.messages import stamp_ns


@pytest.fixture
def server() -> Iterator[Plant]:
    plant = Plant()
    yield plant
    plant.close()


def test_a_node_waits_for_its_server_and_fills_a_break_from_the_history(server: Plant, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP)
    start_ns, run = time.time_ns() // MS * MS - 6_000 * MS, tmp_path / "run"
    server.cut()  # a plant may start its server after the twin
    options = {
        "opcua_server": f"opc.tcp://127.0.0.1:{server.port}/plant",
        "opcua_map": tmp_path / "map.yaml",
        "record_path": run,
        "excitation_timeout": 0.3,
        "rollback_span": 60.0,
    }
    with bench(tmp_path, **options) as running:
        probe = running.probe
        probe.until_figure("source", "connected", "false")
        forces = probe.listen(JointState, "contact_forces")
        server.mend()
        probe.until_figure("source", "connected", "true")
        server.do("rows", _rows(start_ns, 0, 200, 10 * MS))
        probe.until_figure("input", "samples_used", "200")
        assert max(stamp_ns(message.header) for message in forces) >= start_ns + 1990 * MS
        server.cut()
        probe.until_figure("source", "connected", "false")
        server.do("rows", _rows(start_ns, 200, 500, 10 * MS))
        server.mend()
        probe.until_figure("source", "breaks_filled", "1")
        probe.until_figure("input", "samples_used", "500")
        figures = probe.figures("input")
        assert int(figures["rolled_back"]) > 0 and figures["messages_lost"] == "0"
        assert value(probe.status[-1], "publishers_excitation") == "1"
        # the parameter is read-only, so that another node cannot connect the twin to another server
        other = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="opc.tcp://127.0.0.1:1")
        request = SetParameters.Request(parameters=[Parameter(name="opcua_server", value=other)])
        answer = probe.call(SetParameters, f"{running.namespace}/plow_twin/set_parameters", request)
        assert not answer.results[0].successful
        assert running.twin.stop() == 0
    report = replay(run)
    assert (report.exit_code, report.samples) == (0, 500)


def test_credentials_of_a_server_come_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "secret").write_text("s3cret\nmore")
    path = tmp_path / "access.yaml"
    path.write_text("{user: plough, password_file: secret, ca: server.pem, certificate: a.pem, key: a.key}")
    access = read_access("opc.tcp://plant", path)
    files = {"ca": tmp_path / "server.pem", "certificate": tmp_path / "a.pem", "key": tmp_path / "a.key"}
    assert access == Access("opc.tcp://plant", "plough", "s3cret", **files)
    monkeypatch.setenv("PLOW_TWIN_OPCUA_PASSWORD", "other")
    assert read_access("opc.tcp://plant", None).password == "other"
    for text, message in (("{password: x}", "password"), ("{plain: 1}", "true or false"), ("[1]", r"got \[1\]")):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            read_access("opc.tcp://plant", path)
