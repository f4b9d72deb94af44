"""Outputs of a node to a plant: a separate process sends the values of its topics and calls its service."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from network import free_port
from ros_processes import Process, bench
from test_mqtt import Subscriber, _open_broker

MS = 1_000_000
RELIABLE_INPUT = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}


def test_the_telemetry_of_a_node_sends_its_results_and_ends_cleanly(tmp_path: Path) -> None:
    port = free_port()
    parameters = {"alarm_force": "[1.0, 1e9]", "excitation_timeout": 60.0, **RELIABLE_INPUT}
    with _open_broker(tmp_path, port), bench(tmp_path, **parameters) as running:
        probe, subscriber = running.probe, Subscriber(port)
        words = ["telemetry", "--namespace", running.namespace, "--mqtt-out", f"mqtt://127.0.0.1:{port}/face"]
        words += ["--influx", f"http://127.0.0.1:{free_port()}/org/bucket", "--out-rate", "5"]
        beside = Process("plow_twin", words, tmp_path / "telemetry.log")
        try:
            probe.until(lambda: subscriber.newest("face/status") is not None, "the status")
            send, begin_ns = probe.excitation(), time.time_ns()
            for index in range(600):
                send(begin_ns + index * MS, (32e3, 0.0, -45e3))
                probe.pace(index)
            alarms = lambda: (subscriber.newest("face/alarms") or {"values": {}})["values"]  # noqa: E731
            probe.until(lambda: alarms().get("force_level") == "warn", "the alarm")
            peaks = max(
                max(filter(None, message["values"].values()), default=0.0) for message in subscriber.all("face/peaks")
            )
            assert peaks > 1e4 and subscriber.newest("face/clearance")["values"]["horizontal"] == pytest.approx(0.025)
            # the message names the unreachable receiver
            assert "influx" in beside.output() or "http" in beside.output()
            # points for the unreachable database are lost, and the exit code shows a loss
            assert beside.stop() == 3
            probe.until(lambda: subscriber.newest("face/online") is False, "the end")
        finally:
            beside.close()
            subscriber.close()


def test_a_missing_node_is_named(tmp_path: Path) -> None:
    words = ["telemetry", "--namespace", f"/none_{os.getpid()}", "--wait", "0.5"]
    for more, code, message in (
        (["--mqtt-out", f"mqtt://127.0.0.1:{free_port()}/face"], 2, "a running node within 0.5 s"),
        ([], 2, "expected --mqtt-out, --influx or --opcua"),
    ):
        process = Process("plow_twin", [*words, *more], tmp_path / f"{len(more)}.log")
        assert process.wait() == code and message in process.output()
