"""The node as users run it, with real processes and real topics."""

from __future__ import annotations

import itertools
import json
import math
import re
import runpy
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import psutil
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from record_support import records_of
from ros_processes import ROOT, WAIT_S, Process, bench, value
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from websockets.sync.client import connect

from plow_twin.live.diagnostics import KEYS, SOURCE_KEYS, STATUS_KEYS
from plow_twin.model.loads import compile_loads
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene, Wear
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.record.unused import unused_messages
from plow_twin.ros.messages import stamp_ns
from plow_twin.run.advance import AdvanceSeries
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.stream.topics import TOPICS

T0 = 1_795_000_000_000_000_000
MS = 1_000_000
PAPER = load_scene(scene_path("paper"))
WEAR = Wear(coefficient_m2_n=1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0)

#: Settings for tests that need all samples. On a busy machine, a best-effort input may lose samples.
RELIABLE_INPUT = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}


def _scene_file(folder: Path, scene: Scene) -> Path:
    path = folder / "scene.yaml"
    path.write_text(dump_scene(scene), encoding="utf-8")
    return path


def _column(messages: list[JointState], name: str) -> np.ndarray:
    return np.array([getattr(message, name) for message in messages])


def _offline(scene: Scene, stamps: list[int], wrench: np.ndarray) -> AdvanceSeries:
    times = np.array([(stamp - stamps[0]) * 1e-9 for stamp in stamps])
    return Twin(scene, excitation="sampled").advance_samples(times, wrench)


def test_outputs_equal_an_offline_twin_on_the_same_samples_bit_for_bit(tmp_path: Path) -> None:
    scene = replace(PAPER, wear=WEAR)
    # the queue is long enough for all samples, because a busy machine may read it less than once per second
    settings = {"expected_rate": 1000.0, "excitation_timeout": 60.0, "input_depth": 10_000, **RELIABLE_INPUT}
    with bench(tmp_path, scene=_scene_file(tmp_path, scene), **settings) as running:
        probe = running.probe
        forces, peaks = probe.listen(JointState, "contact_forces"), probe.listen(JointState, "contact_peaks")
        heads, clearances = probe.listen(Odometry, "head_state"), probe.listen(JointState, "clearance")
        publisher = running.publisher("--seconds", "2")
        probe.until(lambda: not publisher.running, "the end of the publisher", 100.0)
        assert publisher.wait() == 0, publisher.output()
        assert json.loads(publisher.output().splitlines()[-1])["sent"] == 2000
        for name, received in (("forces", forces), ("peaks", peaks), ("heads", heads)):
            probe.until(lambda heard=received: len(heard) == 2000, f"2000 {name}")
        probe.until_figure("input", "samples_used", "2000")
        assert probe.figures("input")["samples_missing"] == "0"

    stamps = [stamp_ns(message.header) for message in forces]
    assert (np.diff(stamps) == MS).all()
    # the publisher sends the loads of the scene at the times of a grid
    wrench = compile_loads(scene.loads).at(np.arange(2000) * 1e-3)
    series = _offline(scene, stamps, wrench)
    assert tuple(forces[0].name) == PAIR_NAMES == tuple(peaks[0].name)
    for messages, names in (
        (forces, ("penetration", "rate", "force")),
        (peaks, (None, "impulse", "peak")),
    ):
        for quantity, name in zip(("position", "velocity", "effort"), names, strict=True):
            expected = np.cumsum(series.makes, axis=0) if name is None else getattr(series, name)
            assert (_column(messages, quantity) == expected).all(), quantity
    poses = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in heads])
    assert (poses == series.q[:, :2]).all()
    assert series.makes.sum() > 0 and series.force.max() > 1e5

    newest = dict(zip(clearances[-1].name, clearances[-1].position, strict=True))
    assert tuple(clearances[-1].name) == CLEARANCE_NAMES
    index = stamps.index(stamp_ns(clearances[-1].header))
    depth = series.wear_depth[index]
    assert newest["pad_top_right_top"] == depth[2] > 0.0
    assert newest["horizontal"] == 0.025 + depth[[1, 7]].mean() + depth[[3, 5]].mean()
    assert newest["horizontal/p05"] < newest["horizontal"] < newest["horizontal/p95"]


def test_a_fixed_rate_loses_no_impact(tmp_path: Path) -> None:
    wrench = compile_loads(PAPER.loads).at(np.arange(1500) * 1e-3)
    with bench(
        tmp_path, publish_mode="fixed_rate", publish_rate=20.0, excitation_timeout=60.0, **RELIABLE_INPUT
    ) as running:
        peaks = running.probe.listen(JointState, "contact_peaks")
        send = running.probe.excitation()
        for index, row in enumerate(wrench.tolist()):
            send(T0 + index * MS, row)
            running.probe.pace(index)
        running.probe.until(lambda: peaks and stamp_ns(peaks[-1].header) == T0 + 1499 * MS, "the last frame")
    series = _offline(PAPER, [T0 + index * MS for index in range(1500)], wrench)
    assert len(peaks) < 300
    assert (np.array(peaks[-1].position) == series.makes.sum(axis=0)).all()
    assert (_column(peaks, "effort").max(axis=0) == series.peak.max(axis=0)).all()
    np.testing.assert_allclose(_column(peaks, "velocity").sum(axis=0), series.impulse.sum(axis=0), rtol=1e-12)


def test_at_a_fixed_rate_the_latency_includes_the_wait_for_the_publication(tmp_path: Path) -> None:
    settings = {"publish_mode": "fixed_rate", "publish_rate": 1.0, "step_rate": 1000.0, "excitation_timeout": 60.0}
    with bench(tmp_path, **settings, **RELIABLE_INPUT) as running:
        forces = running.probe.listen(JointState, "contact_forces")
        running.probe.excitation()(T0, (1.0, 2.0, 3.0))
        running.probe.until(lambda: forces, "a frame")
        figures = running.probe.figures("output")
        assert float(figures["latency_max_ms"]) > 0.0
        running.probe.until_figure("output", "periods_missed", "0", "1", "2", "3")
        running.probe.until(lambda: running.probe.figures("output")["period_mean_ms"] != "", "a period")


@pytest.mark.parametrize(
    ("mode", "rate"), [pytest.param("on_sample", 3000, marks=pytest.mark.stress), ("fixed_rate", 10000)]
)
def test_every_sample_sent_is_used_dropped_or_counted_as_lost(tmp_path: Path, mode: str, rate: int) -> None:
    # the publisher may overrun each queue, so samples may be lost, but each loss is counted
    with bench(tmp_path, publish_mode=mode, input_depth=200, excitation_timeout=60.0) as running:
        probe = running.probe
        publisher = running.publisher("--rate", str(rate), "--seconds", "1")
        probe.until(lambda: not publisher.running, "the end of the publisher", 100.0)
        sent = json.loads(publisher.output().splitlines()[-1])["sent"]
        for _ in range(5):  # on a busy machine, the last samples may still be in transit
            figures = probe.figures("input")
            counted = sum(int(count) for key, count in figures.items() if key.startswith("dropped_"))
            counted += int(figures["samples_used"]) + int(figures["samples_lost"])
            if counted == sent:
                break
    assert sent == rate
    # the loss of the last samples shows only at the next sample, so it is not counted yet
    assert 0 <= sent - counted <= 0.01 * sent
    assert int(figures["samples_missing"]) == 0  # no sample is missing, because no rate is expected


@pytest.mark.stress
def test_an_overrun_of_the_queue_is_counted_as_loss_and_reported(tmp_path: Path) -> None:
    with bench(tmp_path, input_depth=200, excitation_timeout=60.0, publish_mode="fixed_rate") as running:
        probe = running.probe
        send = probe.excitation()
        probe.figures("input")
        running.twin.send_signal(signal.SIGSTOP)
        for index in range(1000):
            send(T0 + index * MS, (1.0, 2.0, 3.0))
            if index % 50 == 49:
                probe.pause(0.05)
        running.twin.send_signal(signal.SIGCONT)
        sent, figures = 1000, probe.figures("input")

        def accounted() -> bool:
            """Send one more message, which reveals missing messages before it.

            A busy middleware may lose many messages.
            """
            nonlocal sent
            send(T0 + sent * MS, (1.0, 2.0, 3.0))
            sent += 1
            figures.update(probe.figures("input"))
            return (
                int(figures["samples_lost"]) > 0 and int(figures["samples_used"]) + int(figures["samples_lost"]) == sent
            )

        probe.until(accounted, "all that was sent, used or lost")
        said = [status.message for report in probe.reports for name, status in report.items() if name.endswith("input")]
    assert any("samples_lost" in message for message in said)


def test_one_publisher_is_followed_and_a_second_reported_until_a_switch(tmp_path: Path) -> None:
    with bench(tmp_path, excitation_timeout=60.0, record_path=tmp_path / "run") as running:
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        first, second = probe.excitation(), probe.excitation()
        for index in range(40):
            first(T0 + index * MS, (30e3, 0.0, 0.0))
            second(T0 + index * MS - 1_500_000_000, (-30e3, 0.0, 0.0))
        probe.until(lambda: len(forces) == 40, "answers to the first")
        probe.until_figure("input", "samples_not_followed", "40")
        assert (probe.figures("input")["samples_used"], probe.figures("state")["resets"]) == ("40", "0")
        probe.until(lambda: "not followed" in probe.status[-1].message, "the second said")
        assert probe.status[-1].level == b"\x01"
        assert probe.call(Trigger, f"{running.namespace}/plow_twin/switch_publisher", Trigger.Request()).success
        first(T0 + 40 * MS, (30e3, 0.0, 0.0))
        second(T0 + 41 * MS, (30e3, 0.0, 0.0))
        probe.until(lambda: len(forces) == 41, "an answer to the second")
        assert stamp_ns(forces[-1].header) == T0 + 41 * MS
        running.twin.stop()
    # the file names the sender of each message
    unused = list(unused_messages(tmp_path / "run"))
    assert {message["reason"] for message in unused} == {"not_followed"} and len(unused) == 41
    unused_values = [(entry["stamp_ns"], entry["values"][0]) for entry in unused]
    assert unused_values == [(T0 + index * MS - 1_500_000_000, -30e3) for index in range(40)] + [(T0 + 40 * MS, 30e3)]
    senders = [found["sender"] for found in unused]
    assert all(name.startswith(f"{running.namespace}/probe ") for name in senders)
    assert senders[0] == senders[39] != senders[40]


def test_one_of_several_publishers_of_an_optional_input_is_followed(tmp_path: Path) -> None:
    kinds = {"travel": TwistStamped, "head_pose": PoseStamped, "gaps": JointState}
    with bench(tmp_path, record_path=tmp_path / "run") as running:
        probe, node = running.probe, running.probe.node

        def publish(topic: str, publisher: Publisher, index: int, number: float) -> None:
            message = kinds[topic]()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(T0 + index * MS, 10**9)
            if topic == "travel":
                message.twist.linear.z = number
            elif topic == "head_pose":
                message.pose.position.x = number
            else:
                message.name, message.position = ["top_left_top"], [number]
            publisher.publish(message)

        pairs = {topic: [probe.publisher(kind, topic) for _ in range(2)] for topic, kind in kinds.items()}
        for index in range(20):
            for place, number in enumerate((0.001, 0.002)):
                for topic, publishers in pairs.items():
                    publish(topic, publishers[place], 2 * index + place, number)
                probe.pause(0.002)
        said = re.compile(r"another publisher of (.*) is also sending, and is not followed")
        probe.until(
            lambda: (found := said.search(probe.status[-1].message)) and {*found[1].split(", ")} == {*kinds},
            said.pattern,
        )
        for topic in kinds:
            probe.until_figure("input", f"{topic}_not_followed", "20")
        figures = probe.figures("input")
        assert [figures[f"{topic}_used"] for topic in kinds] == ["20"] * 3
        for first, _ in pairs.values():
            node.destroy_publisher(first)
        for topic, (_, second) in pairs.items():
            probe.until(lambda key=f"publishers_{topic}": value(probe.status[-1], key) == "1", "the end of the first")
            publish(topic, second, 100, 0.002)
        for topic in kinds:
            probe.until_figure("input", f"{topic}_used", "21")
        assert running.twin.stop() == 0
    unused = list(unused_messages(tmp_path / "run"))
    assert Counter(entry["input"] for entry in unused) == dict.fromkeys(kinds, 20)
    assert {(found["reason"], *found["values"][:1]) for found in unused} == {("not_followed", 0.002)}


def test_an_alarm_stays_until_it_is_acknowledged_and_writes_the_time_before_it(tmp_path: Path) -> None:
    ring = {"record_path": tmp_path / "run", "record_ring": 60.0}
    with bench(tmp_path, excitation_timeout=60.0, alarm_force="[1.0, 1e9]", **ring, **RELIABLE_INPUT) as running:
        probe = running.probe
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        alarms: list[DiagnosticStatus] = []
        probe.node.create_subscription(DiagnosticStatus, "alarms", alarms.append, latched)
        send = probe.excitation()
        for index in range(600):
            send(T0 + index * MS, (32e3, 0.0, -45e3))
            probe.pace(index)
        probe.until(lambda: alarms, "an alarm")
        assert alarms[0].level == b"\x01" and alarms[0].message.startswith("force ")
        logged = "plow_twin]: " + alarms[0].message  # the text of the alarm contains value, pad, threshold and time
        probe.until(lambda: logged in running.twin.output(), "the alarm in the log")
        assert value(alarms[0], "force_level") == "warn"
        send(T0 + 600 * MS, (0.0, 0.0, 0.0))
        # the operator's screen beside the node shows the alarm and calls services of the node
        options = ["dashboard", "--ros", "--namespace", running.namespace, "--listen", "127.0.0.1:0"]
        screen = Process("plow_twin", options, tmp_path / "screen.log")
        try:
            probe.until(lambda: "screen: " in screen.output(), "the screen")
            address = screen.output().partition("screen: http")[2].split()[0]
            with connect(f"ws{address}data", max_size=None, close_timeout=0.1) as page:
                latest: dict[str, Any] = {"events": []}

                def told(reached: Callable[[], bool]) -> None:
                    while not reached():
                        message = json.loads(page.recv(timeout=WAIT_S))
                        latest.update(message.get("parts", {}))
                        latest["events"] += message.get("events", [])
                        latest["motion"] = message.get("motion") or latest.get("motion")

                told(lambda: {"alarms", "input"} <= latest.keys())
                assert latest["alarms"][2]["force_latched"] == "warn" and latest["input"][2]["samples_used"] == "601"
                page.send(json.dumps({"do": "acknowledge"}))
                told(lambda: len(latest["events"]) == 1)
                probe.until(lambda: len(alarms) > 1, "what is left")
                page.send(json.dumps({"do": "mark", "text": "by the screen"}))
                told(lambda: len(latest["events"]) == 2)
                page.send(json.dumps({"do": "mark", "text": 201 * "x"}))
                told(lambda: len(latest["events"]) == 3)
                refused = latest["events"].pop()
                assert not refused["done"] and "at most 200" in refused["text"]
                send(T0 + 601 * MS, (0.0, 0.0, 0.0))
                told(lambda: latest["motion"] is not None)
            assert all(event["done"] for event in latest["events"]), latest["events"]
            assert str(tmp_path / "run_2") in latest["events"][1]["text"]
            assert screen.stop() == 0
        finally:
            screen.close()
        probe.until_figure("recorder", "marks", "2")
        publishers = {
            topic.name: probe.node.get_publishers_info_by_topic(f"{running.namespace}/{topic.name}") for topic in TOPICS
        }
        offered = {name: infos[0].qos_profile.durability.name.lower() for name, infos in publishers.items() if infos}
    stated = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    profiles = {
        found["topic_metadata"]["name"].rpartition("/")[2]: found["topic_metadata"]["offered_qos_profiles"][0]
        for found in stated["topics_with_message_count"]
    }
    # the recording states the same durability as the publisher of each topic
    recorded = {name: profiles[name]["durability"] for name in profiles.keys() & offered.keys()}
    assert recorded == {name: offered[name] for name in recorded}
    assert {*recorded.values()} == {"volatile", "transient_local"}
    assert (profiles["alarms"]["depth"], profiles["contact_forces"]["depth"]) == (1, 1000)
    before, after = replay(tmp_path / "run"), replay(tmp_path / "run_2")
    assert (before.exit_code, after.exit_code) == (0, 0)
    # the first ring ends at the alarm, and the second ring contains the time after it
    assert 0 < before.samples < 600 and before.samples + after.samples == 601
    # the first ring begins with the run, so its replay raises the alarm again; the second ring does not contain its
    # cause
    assert (before.compared["alarms"], after.compared["alarms"]) == (1, 0) and after.not_compared["alarms"] > 0
    kinds = [type(record.entry).__name__ for record in records_of(tmp_path / "run_2") if hasattr(record, "entry")]
    # the acknowledgement and the text of the mark are Parameter entries; the mark itself is a Mark entry
    assert (kinds.count("Parameter"), kinds.count("Mark")) == (2, 1)


def test_after_the_followed_publisher_has_left_a_new_publisher_is_followed(tmp_path: Path) -> None:
    with bench(tmp_path, excitation_timeout=60.0, **RELIABLE_INPUT) as running:
        probe = running.probe
        for _ in range(2):
            publisher = running.publisher("--seconds", "0.3", "--rate", "200")
            probe.until(lambda: not publisher.running, "the end of the publisher", 100.0)  # noqa: B023
            assert publisher.wait() == 0, publisher.output()
        probe.until_figure("input", "samples_used", "120")
        figures = probe.figures("input")
        assert (figures["samples_not_followed"], figures["samples_lost"]) == ("0", "0")


def test_samples_with_a_lasting_delay_are_inserted_marked_and_replayed_exactly(tmp_path: Path) -> None:
    scene = _scene_file(tmp_path, replace(PAPER, wear=WEAR))
    record = tmp_path / "run"
    with bench(tmp_path, scene=scene, excitation_timeout=0.2, record_path=record, **RELIABLE_INPUT) as running:
        probe = running.probe
        forces, quality = probe.listen(JointState, "contact_forces"), probe.listen(JointState, "quality")
        send = probe.excitation()
        wrench = compile_loads(PAPER.loads).at(np.arange(600) * 1e-3).tolist()
        for index in range(300):
            send(T0 + index * MS, wrench[index])
            probe.pace(index)
        # the model is so far ahead that the next sample is late even if it is sent at once
        probe.until(lambda: quality and stamp_ns(quality[-1].header) > T0 + 350 * MS, "advances without a sample")
        assert tuple(quality[0].name) == ("held", "corrected")
        for index in range(300, 600):  # from now on, all samples are late by the same time
            send(T0 + index * MS, wrench[index])
            probe.pace(index)
        probe.until(lambda: forces and stamp_ns(forces[-1].header) > T0 + 700 * MS, "silence again")
        figures = probe.figures("input")
        running.twin.stop()
    assert figures["samples_used"] == "600"
    assert 1 <= int(figures["rolled_back"]) < 300  # the first batch is late, and later batches are on time again
    marks = [tuple(message.position) for message in quality]
    turns = [mark for mark, _ in itertools.groupby(marks)]
    # on a busy machine, another silence may occur in between
    assert turns[:2] == [(1.0, 0.0), (0.0, 1.0)] and (0.0, 0.0) in turns and turns[-1] == (1.0, 0.0)
    held = {stamp_ns(message.header) for message in quality if message.position[0]}
    series = _offline(replace(PAPER, wear=WEAR), [T0 + index * MS for index in range(600)], np.array(wrench))
    sampled = [message for message in forces if stamp_ns(message.header) not in held]
    assert (np.array(sampled[-1].position) == series.penetration[-1]).all()
    report = replay(record)
    assert (report.exit_code, report.divergences) == (0, 0), report
    assert report.compared["contact_peaks"] >= len(forces) and not report.not_compared
    # the messages in the file are those that a subscriber has received
    topic = f"{running.namespace}/contact_forces"
    recorded = [item.message() for item in records_of(record) if getattr(item, "topic", "") == topic]
    assert len(recorded) >= len(forces)
    for ours, theirs in zip(forces, recorded, strict=False):
        assert stamp_ns(ours.header) == theirs.stamp_ns
        for quantity in ("position", "velocity", "effort"):
            assert np.array(getattr(ours, quantity)).tobytes() == getattr(theirs, quantity).tobytes()


def _pads(clearance: JointState) -> list[float]:
    return [float(value) for value in clearance.position[2:10]]


def test_wear_survives_reset_clock_step_cleanup_and_restart(tmp_path: Path) -> None:
    scene = _scene_file(tmp_path, replace(PAPER, wear=replace(WEAR, coefficient_m2_n=1e-12)))
    kept = {"scene": scene, "excitation_timeout": 0.2, "wear_state_path": tmp_path / "wear", **RELIABLE_INPUT}
    (tmp_path / "again").mkdir()
    with bench(tmp_path, **kept) as running:
        probe = running.probe
        clearances, send = probe.listen(JointState, "clearance"), probe.excitation()
        for index in range(600):
            send(T0 + index * MS, (32e3, 0.0, -45e3))
            probe.pace(index)
        probe.until(lambda: clearances and stamp_ns(clearances[-1].header) > T0 + 900 * MS, "half a second of silence")
        worn = _pads(clearances[-1])
        assert max(worn) > 0.0
        assert worn == _pads(next(item for item in clearances if stamp_ns(item.header) >= T0 + 700 * MS))
        service = f"{running.namespace}/plow_twin"
        assert probe.call(Trigger, f"{service}/reset", Trigger.Request()).success
        send(T0 - 3_000 * MS, (0.0, 0.0, 0.0))
        probe.until(lambda: stamp_ns(clearances[-1].header) < T0, "the step back")
        assert _pads(clearances[-1]) == worn
        for transition in (4, 2, 1, 3):  # deactivate, cleanup, configure, activate
            request = ChangeState.Request(transition=Transition(id=transition))
            assert probe.call(ChangeState, f"{service}/change_state", request).success
        running.twin.stop()
    saved = json.loads((tmp_path / "wear" / "wear.json").read_text())
    assert [saved["depth_m"][name] for name in PAIR_NAMES] == worn
    with bench(tmp_path / "again", **kept) as running:
        probe = running.probe
        clearances, send = probe.listen(JointState, "clearance"), probe.excitation()
        send(T0, (0.0, 0.0, 0.0))
        probe.until(lambda: clearances, "the wear of before")
        assert _pads(clearances[-1]) == worn
        assert probe.call(Trigger, f"{running.namespace}/plow_twin/set_wear", Trigger.Request()).success
        probe.until(lambda: send(T0, (0.0, 0.0, 0.0)) or max(_pads(clearances[-1])) == 0.0, "new pads")
        running.twin.stop()
    assert set(json.loads((tmp_path / "wear" / "wear.json").read_text())["depth_m"].values()) == {0.0}
    with bench(tmp_path / "again", "unconfigured", hardware_id="other", **kept) as running:
        running.probe.until(lambda: running.probe.status[-1].level == b"\x02", "a refusal")
        assert "wear of another head" in running.probe.status[-1].message


def test_bad_samples_are_dropped_counted_and_never_published(tmp_path: Path) -> None:
    with bench(tmp_path, excitation_timeout=60.0, record_path=tmp_path / "run") as running:
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        send = probe.excitation()
        good = (30e3, 0.0, -40e3)
        other = probe.publisher(JointState, "tool_forces")
        send(T0, good)
        for bad in ((math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf)):
            send(T0 + MS, bad)
        send(0, good)
        send(T0, good)
        send(T0 + 3 * MS, good, force_z=1.0)
        send(T0 + 2 * MS, good)  # this sample is late, so the motion is corrected
        send(T0 + 4 * MS, (1e8, 0.0, 0.0))
        other.publish(JointState(name=["fx1"], effort=[1.0]))
        # these bytes are not a message of the topic's type
        for kind, topic in ((TwistStamped, "travel"), (PoseStamped, "head_pose"), (JointState, "gaps")):
            probe.publisher(kind, topic).publish(b"\x00\x01\x00\x00" + b"\xff" * 12)
        send(T0 + 4 * MS, good)
        probe.until(lambda: len(forces) == 4, "four good samples")
        probe.until_figure("input", "samples_in", "11")
        for topic in ("travel", "head_pose", "gaps"):
            probe.until_figure("input", f"{topic}_dropped", "1")
        figures = probe.figures("input")
        levels = {
            status.level for report in probe.reports for name, status in report.items() if name.endswith(": input")
        }
    dropped = {key: int(count) for key, count in figures.items() if key.startswith("dropped_")}
    assert {key: count for key, count in dropped.items() if count} == {
        "dropped_non_finite": 3,
        "dropped_unstamped": 1,
        "dropped_duplicate": 1,
        "dropped_implausible": 1,
        "dropped_not_selected": 1,
    }
    assert figures["rolled_back"] == "1"
    assert figures["out_of_plane"] == "1"
    drops = {key.removeprefix("dropped_"): count for key, count in dropped.items() if count}
    del drops["not_selected"]
    assert replay(tmp_path / "run").inputs == {
        "excitation": {"used": 4, **drops},
        "tool_forces": {"not_selected": 1},
        **{topic: {"malformed": 1} for topic in ("travel", "head_pose", "gaps")},
    }
    assert b"\x02" in levels  # a sample without a stamp is reported as an error
    assert [stamp_ns(message.header) - T0 for message in forces] == [0, 3 * MS, 3 * MS, 4 * MS]
    for quantity in ("position", "velocity", "effort"):
        assert np.isfinite(_column(forces, quantity)).all()


def test_an_absurd_load_gives_an_error_status_and_no_message(tmp_path: Path) -> None:
    no_limits = {"limit_force": "1e300", "limit_moment": "1e300"}
    with bench(tmp_path, excitation_timeout=60.0, failure_limit=3, **no_limits) as running:
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        send = probe.excitation()
        send(T0, (0.0, 0.0, 0.0))
        for index in (1, 2):
            send(T0 + index * MS, (1e200, 1e200, 1e200))
        probe.until(lambda: probe.status[-1].level == b"\x02", "status ERROR")
        assert value(probe.status[-1], "stream") == "failed"
        probe.until_figure("state", "solver_failures", "2")
        send(T0 + 3 * MS, (1e200, 1e200, 1e200))
        probe.until_figure("state", "resets", "1")
        send(T0 + 5 * MS, (0.0, 0.0, 0.0))
        probe.until(lambda: len(forces) == 2, "recovery")
        probe.until(lambda: probe.status[-1].level == b"\x00", "status OK")
        # the failure occurs again, and a good sample follows at once; the next report still contains the failure
        send(T0 + 6 * MS, (1e200, 1e200, 1e200))
        for index in (7, 8):
            send(T0 + index * MS, (0.0, 0.0, 0.0))
        probe.until_figure("state", "solver_failures", "5")
        parts = [report[f"{running.namespace}/plow_twin: state"] for report in probe.reports]
        levels = [part.level for part in parts if value(part, "solver_failures") == "5"]
        assert levels[0] == b"\x02"
        probe.until(
            lambda: probe.reports[-1][f"{running.namespace}/plow_twin: state"].level == b"\x00", "no failure since"
        )
    forces = forces[:2]
    assert [stamp_ns(message.header) - T0 for message in forces] == [0, 5 * MS]


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.stress), signal.SIGTERM])
def test_a_stop_under_load_is_clean_and_closes_the_recording(tmp_path: Path, number: signal.Signals) -> None:
    with bench(tmp_path, record_path=tmp_path / "run") as running:
        forces = running.probe.listen(JointState, "contact_forces")
        publisher = running.publisher("--seconds", "60")
        running.probe.until(lambda: len(forces) > 500, "a flow of messages", 60.0)
        # several signals arrive, for example from a terminal and from a launch
        assert running.twin.stop_again_and_again(number) == 0
        assert "Traceback" not in running.twin.output()
        assert publisher.running
        assert publisher.stop_again_and_again(number) == 0
        assert "Traceback" not in publisher.output()
    reader = RunReader(tmp_path / "run")
    used = sum(1 for record in records_of(reader) if type(getattr(record, "entry", None)).__name__ == "Sample")
    assert reader.status is FileStatus.COMPLETE
    assert used > 500 and not reader.lost
    report = replay(tmp_path / "run")
    assert report.first_divergence is None


def launched(monkeypatch: pytest.MonkeyPatch, **given: str) -> dict[str, Any]:
    """Return what the launch file requests for its node, if these launch arguments are given.

    `launch` is not on PyPI, so mocks replace it.
    """
    modules = {name: MagicMock() for name in ("launch", "launch_ros")}
    for package, names in (("launch", "actions substitutions"), ("launch_ros", "actions substitutions")):
        for name in ("", *names.split(), *(("parameter_descriptions",) if package == "launch_ros" else ())):
            monkeypatch.setitem(
                sys.modules,
                f"{package}.{name}".rstrip("."),
                getattr(modules[package], name) if name else modules[package],
            )
    modules["launch"].substitutions.LaunchConfiguration = lambda name: MagicMock(
        perform=lambda context: given.get(name, ""), text=given.get(name, "")
    )
    modules["launch_ros"].parameter_descriptions.ParameterValue = lambda value, value_type: (value.text, value_type)
    runpy.run_path(str(ROOT / "launch" / "twin.launch.py"))["generate_launch_description"]()
    modules["launch"].actions.OpaqueFunction.call_args.kwargs["function"](MagicMock())
    return dict(modules["launch_ros"].actions.Node.call_args.kwargs)


def test_the_launch_overrides_only_the_parameters_that_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    file, overrides = launched(monkeypatch, params_file="mine.yaml")["parameters"]
    assert (file, overrides) == ("mine.yaml", {})
    # without a file, the node has its defaults, and warns that the scene is a preset if no scene is given
    (overrides,) = launched(monkeypatch, scene="paper", autostart="false")["parameters"]
    assert overrides == {"scene": ("paper", str), "autostart": ("false", bool)}


def test_the_launch_shows_only_a_recording_that_it_names(monkeypatch: pytest.MonkeyPatch) -> None:
    assert launched(monkeypatch, view="false")["parameters"]
    assert launched(monkeypatch, view="true", record_path="runs/monday")["parameters"][-1]
    with pytest.raises(ValueError, match="view: got true without record_path"):
        launched(monkeypatch, view="true")


def test_a_twin_ends_cleanly_with_its_launch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # `launch` ends at SIGTERM without passing the signal on
    prefix = shlex.split(launched(monkeypatch)["prefix"])
    twin = [sys.executable, "-m", "plow_twin.ros.main", "--ros-args", "-p", f"record_path:={tmp_path / 'run'}"]
    launch = subprocess.Popen(
        [sys.executable, "-c", "import subprocess, sys; subprocess.run(sys.argv[1:])", *prefix, *twin],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert launch.stderr is not None
    assert any("solver ready" in line for line in launch.stderr)
    children = psutil.Process(launch.pid).children(recursive=True)
    launch.kill()
    ended, running_children = psutil.wait_procs(children, 10.0)
    for process in running_children:
        process.kill()
    launch.communicate()
    assert ended and not running_children
    reader = RunReader(tmp_path / "run")
    assert list(records_of(reader)) and reader.status is FileStatus.COMPLETE


def test_a_stop_while_the_solver_is_compiled_is_clean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "empty cache"))
    with bench(tmp_path, "unconfigured") as running:
        running.probe.until(lambda: "preparing the solver" in running.twin.output(), "the start of compiling")
        running.probe.pause(1.0)
        assert "solver ready" not in running.twin.output()
        # the node answers while the solver compiles
        count = len(running.probe.reports)
        service = f"{running.namespace}/plow_twin/get_state"
        assert running.probe.call(GetState, service, GetState.Request()).current_state.label == "unconfigured"
        running.probe.until(lambda: len(running.probe.reports) >= count + 2, "reports while compiling")
        assert "preparing the solver" in running.probe.status[-1].message
        assert "solver ready" not in running.twin.output()
        assert running.twin.stop_again_and_again(signal.SIGINT) == 0
        assert "Traceback" not in running.twin.output()


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE])
def test_best_effort_and_reliable_publishers_connect(tmp_path: Path, reliability: ReliabilityPolicy) -> None:
    with bench(tmp_path) as running:
        forces = running.probe.listen(JointState, "contact_forces")
        send, stamps = running.probe.excitation(reliability), itertools.count(T0, MS)
        send(next(stamps), (1.0, 2.0, 3.0))
        # a best-effort subscriber that has not discovered its publisher yet loses the message, so it is sent again
        again = reliability is ReliabilityPolicy.BEST_EFFORT
        running.probe.until(lambda: forces or (again and send(next(stamps), (1.0, 2.0, 3.0))), "an answer")
        assert running.probe.figures("input")["refused_publishers"] == "0"


def test_silence_is_held_and_reported(tmp_path: Path) -> None:
    started_ns = time.time_ns()
    with bench(tmp_path, excitation_timeout=0.2) as running:
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        send = probe.excitation()
        send(T0, (30e3, 0.0, 0.0))
        probe.until(lambda: len(forces) > 20, "advances under the hold policy")
        send(T0 + 9_000 * MS, (30e3, 0.0, 0.0))
        probe.until(lambda: stamp_ns(forces[-1].header) >= T0 + 9_000 * MS, "the sample after it")
        probe.until(lambda: sum(status.level == b"\x01" for status in probe.status) == 2, "silence again")
        streams = (value(status, "stream") for status in probe.status if value(status, "lifecycle") == "active")
        states = [state for state, _ in itertools.groupby(streams)]
        assert states == ["waiting", "running", "stale", "running", "stale"]
        assert [status.level for status in probe.status[-3:]] == [b"\x01", b"\x00", b"\x01"]
        assert value(probe.status[-1], "stale_inputs") == "excitation"
        # the stamps of held messages follow the clock, although no new sample has arrived
        probe.until(lambda: stamp_ns(forces[-1].header) > T0 + 9_200 * MS, "held frames")
        sent_ns = T0 + 9_000 * MS
        assert float(probe.figures("input")["newest_sample_age_s"]) <= (time.time_ns() - sent_ns) * 1e-9
        assert float(probe.figures("input")["newest_sample_age_s"]) > (started_ns - sent_ns) * 1e-9
        assert {key: value(probe.status[-1], key) for key in ("horizontal", "vertical", "pads")} == {
            "horizontal": "prior",
            "vertical": "prior",
            "pads": "prior",
        }
        assert [item.key for item in probe.status[-1].values] == list(STATUS_KEYS)
        assert value(probe.status[-1], "scene") == "paper"


def test_under_sim_time_the_model_does_not_advance_in_a_silence(tmp_path: Path) -> None:
    run = tmp_path / "run"
    settings = {"use_sim_time": "true", "record_path": str(run), "input_depth": 200}
    with bench(tmp_path, excitation_timeout=0.05, **settings, **RELIABLE_INPUT) as running:
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        send = probe.excitation()
        # without /clock, the node waits and prints a message; samples that do not fit in the queue are counted
        for index in range(210):
            send(T0 + index * MS, (30e3, 0.0, 0.0))
            probe.pace(index)
        probe.until_figure("input", "dropped_without_clock", "10")
        assert "no message has arrived on /clock" in probe.status[-1].message and probe.status[-1].level == b"\x01"
        assert not probe.call(Trigger, f"{running.namespace}/plow_twin/reset", Trigger.Request()).success
        assert (len(forces), probe.figures("recorder")["written"]) == (0, "0")
        show, time_ns = probe.clock(), T0
        # a time before 0 is invalid
        probe.until(lambda: show(-5 * 10**9) or "/clock: got -5 s" in running.twin.output(), "a wrong time said")
        assert value(probe.status[-1], "clock") == "waiting" and not forces
        probe.until(lambda: show(time_ns) or len(forces) == 200, "200 answers")
        for _ in range(2):
            assert probe.figures("input")["holds"] == "0"
        probe.until(lambda: value(probe.status[-1], "clock") == "paused", "the clock stands still")
        assert value(probe.status[-1], "stream") == "running" and probe.status[-1].level == b"\x00"
        assert "/clock is paused" in probe.status[-1].message

        def tick() -> bool:
            nonlocal time_ns
            time_ns += MS
            show(time_ns)
            return value(probe.status[-1], "clock") == "running"

        probe.until(tick, "the clock goes on")
        assert running.twin.stop() == 0
    report = replay(run)
    assert (report.exit_code, report.samples) == (0, 200)
    assert all(record.log_time_ns >= T0 for record in records_of(run))


def test_diagnostics_are_published_without_a_clock_and_have_every_documented_key(tmp_path: Path) -> None:
    with bench(tmp_path, use_sim_time="true", hardware_id="head 7") as running:
        probe = running.probe
        count = len(probe.reports)
        probe.until(lambda: len(probe.reports) >= count + 3, "three reports with /clock silent")
        report = probe.reports[-1]
        found = {name.partition(": ")[2]: [item.key for item in status.values] for name, status in report.items()}
        assert {part: sorted(keys) for part, keys in found.items()} == {
            part: sorted(keys) for part, keys in KEYS.items()
        }
        assert {status.hardware_id for status in report.values()} == {"head 7"}


def test_reset_restores_the_initial_state(tmp_path: Path) -> None:
    with bench(tmp_path, excitation_timeout=60.0, **RELIABLE_INPUT) as running:
        probe = running.probe
        heads = probe.listen(Odometry, "head_state")
        send = probe.excitation()
        for index in range(300):
            send(T0 + index * MS, (30e3, 0.0, -40e3))
            probe.pace(index)
        probe.until(lambda: len(heads) == 300, "300 answers")
        answer = probe.call(Trigger, f"{running.namespace}/plow_twin/reset", Trigger.Request())
        assert answer.success, answer.message
        send(T0 + 300 * MS, (0.0, 0.0, 0.0))
        probe.until(lambda: len(heads) == 301, "the sample after the reset")
        position = heads[-1].pose.pose.position
        assert heads[-2].pose.pose.position.x != 0.0
        assert (position.x, position.y, heads[-1].twist.twist.angular.z) == PAPER.initial.q


def test_travel_determines_the_wear_and_a_measured_pose_is_compared(tmp_path: Path) -> None:
    scene = _scene_file(tmp_path, replace(PAPER, wear=WEAR))
    with bench(tmp_path, scene=scene, excitation_timeout=60.0, **RELIABLE_INPUT) as running:
        probe = running.probe
        clearances, rates = probe.listen(JointState, "clearance"), probe.listen(JointState, "wear_rate")
        send = probe.excitation()
        travel, pose = probe.publisher(TwistStamped, "travel"), probe.publisher(PoseStamped, "head_pose")
        for index in range(1000):
            send(T0 + index * MS, (32e3, 0.0, -45e3))
            probe.pace(index)
        probe.until(lambda: clearances and stamp_ns(clearances[-1].header) == T0 + 900 * MS, "a second of wear")
        stopped, measured = TwistStamped(), PoseStamped()
        for message in (stopped, measured):
            message.header.stamp.sec = T0 // 1_000_000_000
        measured.pose.position.x = 0.1
        measured.pose.orientation.w = 1.0
        travel.publish(stopped)
        pose.publish(measured)
        probe.until_figure("input", "travel_used", "1")
        for index in range(1000, 1301):
            send(T0 + index * MS, (32e3, 0.0, -45e3))
            probe.pace(index)
        probe.until(lambda: stamp_ns(clearances[-1].header) == T0 + 1300 * MS, "the time after it")
        figures = probe.figures("input")
    assert max(rates[-4].velocity) > 0.0
    assert max(rates[-1].velocity) == 0.0
    assert clearances[-1].position == clearances[-2].position
    assert figures["head_pose_used"] == "1"
    x, y, theta = (float(number) for number in figures["head_pose_residual"].split())
    assert -0.15 < x < -0.05 and abs(y) < 0.05 and abs(theta) < 0.3


def test_tool_forces_have_the_effect_of_their_sum(tmp_path: Path) -> None:
    scale = np.sin(np.linspace(0.0, 1.5, 200))
    amplitudes = {load.name: float(np.hypot(*load.force_n)) for load in PAPER.loads}
    reliable = {"qos_overrides.{ns}/tool_forces.subscription.reliability": "reliable"}
    with bench(tmp_path, excitation_source="tool_forces", excitation_timeout=60.0, **reliable) as running:
        probe = running.probe
        heads = probe.listen(Odometry, "head_state")
        publisher = probe.publisher(JointState, "tool_forces")
        for index, share in enumerate(scale):
            # the names may have any order
            names = sorted(amplitudes, reverse=bool(index % 2))
            message = JointState(name=names, effort=[amplitudes[name] * share for name in names])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(T0 + index * MS, 1_000_000_000)
            publisher.publish(message)
            probe.pace(index)
        publisher.publish(JointState(name=["fx1", "unknown"], effort=[1.0, 2.0]))
        probe.until(lambda: len(heads) == 200, "200 answers")
        probe.until_figure("input", "dropped_malformed", "1")
    per_unit = compile_loads(PAPER.loads).sine.sum(axis=0)
    series = _offline(PAPER, [T0 + index * MS for index in range(200)], scale[:, None] * per_unit)
    poses = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in heads])
    np.testing.assert_allclose(poses, series.q[:, :2], rtol=1e-9, atol=1e-15)


def _at(heads: list[Odometry], stamp: int) -> bool:
    return bool(heads) and stamp_ns(heads[-1].header) == stamp


def test_the_scenes_own_loads_follow_the_nodes_clock(tmp_path: Path) -> None:
    with bench(tmp_path, excitation_source="scene", use_sim_time="true") as running:
        probe = running.probe
        heads = probe.listen(Odometry, "head_state")
        show = probe.clock()
        for time_ns in range(T0, T0 + 1500 * MS, 300 * MS):
            # the twin may discover the clock later than this process does, so the clock is published repeatedly
            probe.until(lambda: show(time_ns) or _at(heads, time_ns), "its answer")  # noqa: B023
    twin = Twin(PAPER)
    for index, head in enumerate(heads):
        q = twin.advance((stamp_ns(head.header) - T0) * 1e-9).q
        assert (head.pose.pose.position.x, head.pose.pose.position.y) == tuple(q[:2]), index


def test_twins_in_two_namespaces_are_independent(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    with bench(tmp_path / "one") as one, bench(tmp_path / "two") as two:
        first, second = (running.probe.listen(JointState, "contact_forces") for running in (one, two))
        send = one.probe.excitation()
        for index in range(50):
            send(T0 + index * MS, (30e3, 0.0, 0.0))
        one.probe.until(lambda: len(first) >= 50, "answers of the first")
        assert second == []
        topics = {name for name, _ in one.probe.node.get_topic_names_and_types()}
        own = {"excitation", "tool_forces", "contact_forces", "head_state", "clearance", "status"}
        assert {f"{one.namespace}/{name}" for name in own} <= topics
        absolute = {name for name in topics if name.count("/") == 1}
        assert absolute <= {"/diagnostics", "/clock", "/parameter_events", "/rosout"}


def test_the_documentation_names_every_topic_parameter_and_key() -> None:
    from plow_twin.live.diagnostics import keys_text
    from plow_twin.live.parameters import yaml_text

    text = (ROOT / "docs" / "node.md").read_text(encoding="utf-8")
    for file, made in (("twin.yaml", yaml_text()), ("diagnostics.yaml", keys_text())):
        assert f"<!-- file: config/{file} -->" in text
        assert (ROOT / "config" / file).read_text(encoding="utf-8") == made
    assert yaml.safe_load(keys_text()) == {"status": STATUS_KEYS, **KEYS, "source": SOURCE_KEYS}
