"""Faults with real processes: every sent sample is accounted for, and the twin continues."""

from __future__ import annotations

import gc
import json
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_domain import claim_domain
from ros_processes import Bench, bench, value
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from plow_twin.live.service_names import SERVICES
from plow_twin.model.scene import Wear
from plow_twin.record.replay import replay
from plow_twin.ros.messages import set_stamp, stamp_ns
from plow_twin.ros.node import TwinNode
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path

pytestmark = [pytest.mark.stress, pytest.mark.timeout(600)]

T0 = 1_795_000_000_000_000_000
MS = 1_000_000
ROOT = Path(__file__).resolve().parent.parent
RELIABLE_INPUT = {"qos_overrides.{ns}/excitation.subscription.reliability": "reliable"}


def _accounted(figures: dict[str, str]) -> int:
    dropped = sum(int(count) for key, count in figures.items() if key.startswith("dropped_"))
    return int(figures["samples_used"]) + dropped + int(figures["samples_lost"])


def _until_accounted(running: Bench, sent: int) -> dict[str, str]:
    """Wait until all sent samples are accounted for. A later sample reveals the loss of the last samples."""
    figures: dict[str, str] = {}

    def reached() -> bool:
        figures.update(running.probe.figures("input"))
        return _accounted(figures) >= sent

    running.probe.until(reached, f"{sent} samples accounted for")
    assert _accounted(figures) == sent
    return figures


def _sent(publisher: Any) -> int:
    assert publisher.wait() == 0, publisher.output()
    return int(json.loads(publisher.output().splitlines()[-1])["sent"])


def test_late_samples_of_a_publisher_that_was_stopped_are_used(tmp_path: Path) -> None:
    with bench(tmp_path, rollback_span=30.0, jump_forward=60.0, **RELIABLE_INPUT) as running:
        publisher = running.publisher("--rate", "500", "--seconds", "8")
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 500, "samples")
        publisher.send_signal(signal.SIGSTOP)
        running.probe.until(lambda: value(running.probe.status[-1], "stream") == "stale", "the silence")
        running.probe.pause(2.0)
        publisher.send_signal(signal.SIGCONT)
        figures = _until_accounted(running, _sent(publisher))
        # the publisher's own queue may lose samples that are sent at the same time, so losses are counted too
        assert int(figures["samples_used"]) + int(figures["samples_lost"]) == 4000
        assert int(figures["rolled_back"]) > 0


def test_after_a_kill_of_its_publisher_the_node_follows_the_next_publisher(tmp_path: Path) -> None:
    with bench(tmp_path, **RELIABLE_INPUT) as running:
        first = running.publisher("--rate", "500", "--seconds", "60")
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 500, "samples")
        first.send_signal(signal.SIGKILL)
        first.wait()
        used = int(running.probe.figures("input")["samples_used"])
        second = running.publisher("--rate", "500", "--seconds", "40")
        running.probe.until(
            lambda: int(running.probe.figures("input")["samples_used"]) > used + 500, "the second one to be followed"
        )
        second.stop()


def test_a_paused_node_counts_the_overrun_of_its_queue_and_continues(tmp_path: Path) -> None:
    with bench(tmp_path, input_depth=200, jump_forward=60.0) as running:
        publisher = running.publisher("--rate", "1000", "--seconds", "8")
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 500, "samples")
        running.twin.send_signal(signal.SIGSTOP)
        time.sleep(3.0)
        running.twin.send_signal(signal.SIGCONT)
        figures = _until_accounted(running, _sent(publisher))
        assert int(figures["samples_lost"]) > 1000
        assert running.twin.stop() == 0


def test_the_publisher_waits_until_a_late_twin_has_used_the_last_sample(tmp_path: Path) -> None:
    settings = {"input_depth": 20000, "excitation_timeout": 60.0, "jump_forward": 60.0}
    with bench(tmp_path, **settings, **RELIABLE_INPUT) as running:
        publisher = running.publisher("--rate", "1000", "--seconds", "3")
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 200, "samples")
        running.twin.send_signal(signal.SIGSTOP)
        time.sleep(4.0)  # the publisher has sent its last sample at least 0.5 s before the end of this time
        running.twin.send_signal(signal.SIGCONT)
        figures = _until_accounted(running, _sent(publisher))
        assert figures["samples_used"] == "3000"


def test_a_tenfold_rate_of_samples_does_not_delay_outputs(tmp_path: Path) -> None:
    # a best-effort subscriber would not detect the loss of the last samples, so the subscriber is reliable
    settings = {"publish_mode": "fixed_rate", "publish_rate": 100.0, "input_depth": 20000}
    with bench(tmp_path, **settings, **RELIABLE_INPUT) as running:
        publisher = running.publisher("--rate", "10000", "--seconds", "5")
        _until_accounted(running, _sent(publisher))
        # an executor that serves timers only when no message waits would send 23 of 500 messages; test_ros_runtime
        # keeps the queue full, because at this rate the queue is sometimes empty
        figures = running.probe.figures("output")
        assert int(figures["published"]) - int(figures["held"]) > 60


def test_after_a_kill_the_recording_replays_and_the_wear_continues(tmp_path: Path) -> None:
    wear = Wear(coefficient_m2_n=1e-14, pad_area_m2=0.015, travel_speed_m_s=2.0)
    scene = tmp_path / "scene.yaml"
    scene.write_text(dump_scene(replace(load_scene(scene_path("paper")), wear=wear)))
    run, kept = tmp_path / "run", tmp_path / "wear"
    settings = {"scene": scene, "record_path": run, "wear_state_path": kept, "wear_save_period": 0.2, **RELIABLE_INPUT}
    with bench(tmp_path, **settings) as running:
        running.publisher("--scene", str(scene), "--rate", "1000", "--seconds", "30")
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 3000, "samples")
        running.probe.until((kept / "wear.json").is_file, "the wear on disk")
        running.twin.send_signal(signal.SIGKILL)
        running.twin.wait()
    report = replay(run)
    assert report.first_divergence is None and report.exit_code == 3 and report.samples > 1000
    saved = json.loads((kept / "wear.json").read_text())["depth_m"]
    assert max(saved.values()) > 0.0
    with bench(tmp_path, **settings) as running:
        clearances = running.probe.listen(JointState, "clearance")
        running.probe.excitation()(T0, (0.0, 0.0, 0.0))
        running.probe.until(lambda: clearances, "the clearance")
        clearance = dict(zip(clearances[0].name, clearances[0].position, strict=True))
        assert all(clearance[f"pad_{name}"] >= depth for name, depth in saved.items())


def test_a_full_disk_stops_the_recording_and_not_the_twin(tmp_path: Path) -> None:
    with bench(tmp_path, record_path=tmp_path / "run", **RELIABLE_INPUT) as running:
        # a write beyond this size fails, as on a full disk
        resource.prlimit(running.twin._process.pid, resource.RLIMIT_FSIZE, (200_000, 200_000))
        publisher = running.publisher("--rate", "1000", "--seconds", "120")
        # on a busy machine, other losses may be reported earlier, so the error of the recorder is awaited
        running.probe.until(lambda: running.probe.figures("recorder")["error"], "the full disk")
        running.probe.until(lambda: value(running.probe.status[-1], "recorder") == "trouble", "the full disk in status")
        assert running.probe.status[-1].level == b"\x02"
        used = int(running.probe.figures("input")["samples_used"])
        running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > used, "the twin to go on")
        publisher.send_signal(signal.SIGINT)
        _until_accounted(running, _sent(publisher))


def test_all_corrupt_samples_among_good_samples_are_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    expected = dict.fromkeys(("non_finite", "implausible", "unstamped", "duplicate"), 0)
    with bench(tmp_path, excitation_timeout=3600.0, **RELIABLE_INPUT) as running:
        send = running.probe.excitation()
        for index in range(10_000):
            stamp, wrench = T0 + index * MS, (30e3 * math.sin(2e-3 * index), 0.0, 0.0)
            if index and rng.random() < 0.01:
                kind = str(rng.choice(list(expected)))
                expected[kind] += 1
                if kind == "non_finite":
                    wrench = (0.0, float(rng.choice([np.nan, np.inf])), 0.0)
                elif kind == "implausible":
                    wrench = (1e8, 0.0, 0.0)
                elif kind == "duplicate":
                    send(stamp, wrench)
                else:
                    stamp = 0
            send(stamp, wrench)
            running.probe.pace(index)
        sent = 10_000 + expected["duplicate"]
        figures = _until_accounted(running, sent)
        assert {key: int(figures[f"dropped_{key}"]) for key in expected} == expected
        assert int(figures["samples_used"]) == sent - sum(expected.values())
    assert sum(expected.values()) > 60


def test_all_damaged_messages_on_every_input_are_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(12)

    def damaged(message: Any) -> bytes:
        data = np.frombuffer(serialize_message(message), np.uint8).copy()
        data[rng.integers(4, len(data), 3)] = rng.integers(0, 256, 3)
        return data[: rng.integers(4, len(data) + 1)].tobytes()

    reliable = {"qos_overrides.{ns}/tool_forces.subscription.reliability": "reliable"}
    settings = {"excitation_source": "tool_forces", "record_path": tmp_path / "run", "excitation_timeout": 3600.0}
    with bench(tmp_path, **settings, **reliable) as running:
        probe = running.probe
        tools = probe.publisher(JointState, "tool_forces", 5000)
        kinds = {"excitation": WrenchStamped, "travel": TwistStamped, "head_pose": PoseStamped, "gaps": JointState}
        others = [probe.publisher(kind, topic, 1000) for topic, kind in kinds.items()]
        for index in range(3000):
            message = JointState(name=["fx1", "fx2", "fx3", "fy"], effort=[1e4 * math.sin(2e-3 * index)] * 4)
            set_stamp(message.header, T0 + index * MS)
            tools.publish(damaged(message) if rng.random() < 0.02 else message)
            if index % 10 == 0:
                for publisher in others:
                    publisher.publish(damaged(publisher.msg_type()))
            probe.pace(index)

        def sent() -> int:
            figures = probe.figures("input")
            return _accounted(figures) - int(figures["dropped_not_selected"])

        probe.until(lambda: sent() == 3000, "all that was sent")
        assert running.twin.stop() == 0
    report = replay(tmp_path / "run")
    assert report.exit_code == 0 and report.samples > 2900
    # the sum of the counts in the file is the number of messages sent
    assert sum(report.inputs["tool_forces"].values()) == 3000


@pytest.mark.parametrize("step_s", [-10.0, 30.0])
def test_a_step_of_the_sender_s_clock_causes_one_reset_and_no_loss(tmp_path: Path, step_s: float) -> None:
    with bench(tmp_path, excitation_timeout=3600.0, **RELIABLE_INPUT) as running:
        send = running.probe.excitation()
        for index in range(1000):
            send(T0 + index * MS + (round(step_s * 1e9) if index >= 500 else 0), (30e3, 0.0, 0.0))
            running.probe.pace(index)
        figures = _until_accounted(running, 1000)
        assert figures["samples_used"] == "1000"
        assert running.probe.figures("state")["resets"] == "1"


def test_a_clock_that_is_paused_looped_and_fast_moves_the_twin_with_its_samples(tmp_path: Path) -> None:
    with bench(tmp_path, use_sim_time="true", **RELIABLE_INPUT) as running:
        probe = running.probe
        show, send = probe.clock(), probe.excitation()

        def play(first: int, last: int, every: int) -> None:
            for index in range(first, last):
                if index % every == 0:
                    show(T0 + index * MS)
                send(T0 + index * MS, (30e3, 0.0, 0.0))
                probe.pace(index)

        play(0, 500, 10)
        _until_accounted(running, 500)
        busy = psutil.Process(running.twin._process.pid).cpu_times()
        probe.pause(3.0)  # while /clock stops, the twin must be idle
        idle = psutil.Process(running.twin._process.pid).cpu_times()
        assert (idle.user + idle.system) - (busy.user + busy.system) < 1.0
        play(500, 3000, 500)  # the clock advances in large steps
        play(0, 500, 10)  # the clock restarts
        figures = _until_accounted(running, 3500)
        assert (figures["samples_used"], figures["holds"]) == ("3500", "0")
        assert probe.figures("state")["resets"] == "1"


def test_the_scene_s_loads_follow_a_clock_that_is_paused_looped_and_fast(tmp_path: Path) -> None:
    with bench(tmp_path, use_sim_time="true", excitation_source="scene") as running:
        probe = running.probe
        show, forces = probe.clock(), probe.listen(JointState, "contact_forces")

        def reach(time_ns: int) -> None:
            probe.until(lambda: show(time_ns) or (forces and stamp_ns(forces[-1].header) == time_ns), "that time")

        reach(T0)
        reach(T0 + 20 * MS)
        count = len(forces)
        for _ in range(3):  # while the clock is paused, three reports arrive, and none contains motion
            probe.figures("output")
        assert len(forces) == count and probe.figures("state")["resets"] == "0"
        # each message advances the clock by one second, and the next message waits for its answer
        for second in range(1, 8):
            reach(T0 + second * 1000 * MS)
        assert probe.figures("state")["resets"] == "0"
        reach(T0)  # the clock restarts
        reach(T0 + 20 * MS)
        figures = probe.figures("state")
        assert (figures["resets"], figures["solver_failures"]) == ("1", "0")


@pytest.mark.parametrize("source", ["scene", "excitation"])
def test_any_sequence_on_clock_is_survived_counted_and_repeated_by_the_journal(source: str, tmp_path: Path) -> None:
    rng = random.Random(f"clock {source}")
    with bench(
        tmp_path, use_sim_time="true", excitation_source=source, record_path=tmp_path / "run", **RELIABLE_INPUT
    ) as running:
        probe = running.probe
        show = probe.clock()
        send = probe.excitation() if source == "excitation" else None
        forces = probe.listen(JointState, "contact_forces")
        time_ns, sent = T0, 0
        for index in range(3000):
            draw = rng.random()
            if draw < 0.9:
                steps = (0, 1, 10, 100, 100, 10, 1, -1, -100, -900, -5000, 1000, 11_000, 3_600_000)
                time_ns += rng.choice(steps) * MS
            elif draw < 0.95:
                show(rng.choice((0, -5 * 10**9, -(2**31) * 10**9, 1, (2**31 - 1) * 10**9)))
            else:
                time_ns = T0
            show(time_ns)
            if send is not None and rng.random() < 0.8:
                send(max(1, time_ns + rng.choice((0, 0, 0, -5, -2000)) * MS), (30e3, 0.0, 0.0))
                sent += 1
            if rng.random() < 0.01:
                service = rng.choice(("reset", "set_wear", "snapshot", "restore", "mark"))
                probe.call(Trigger, f"{running.namespace}/plow_twin/{service}", Trigger.Request())
            probe.pace(index)
        # when the clock advances steadily again, the twin follows it again
        probe.pause(10.0)
        time_ns, count = T0, len(forces)

        def steadily() -> bool:
            nonlocal time_ns, sent
            time_ns += 10 * MS
            show(time_ns)
            if send is not None:
                send(time_ns, (30e3, 0.0, 0.0))
                sent += 1
            return len(forces) >= count + 20

        probe.until(steadily, "answers under a steady clock")
        if sent:
            _until_accounted(running, sent)
        assert running.twin.stop() == 0 and "Traceback" not in running.twin.output()
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.divergences) == (0, 0)


@pytest.fixture
def stepped_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Set a clock that only later processes use. Return a function that shifts this clock by seconds.

    The system clock is shifted, but not the steady clock, as in a step of NTP.
    """
    compiler, library, offset = shutil.which("cc"), tmp_path / "stepped_clock.so", tmp_path / "offset"
    if compiler is None:
        pytest.skip("there is no C compiler")
    source = Path(__file__).parent / "data" / "stepped_clock.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl", "-lpthread"], check=True)
    offset.write_bytes(bytes(8))
    monkeypatch.setenv("LD_PRELOAD", str(library))
    monkeypatch.setenv("STEPPED_CLOCK", str(offset))

    def step(seconds: float) -> None:
        with offset.open("r+b", buffering=0) as file:
            file.write(round(seconds * 1e9).to_bytes(8, "little", signed=True))

    return step


def test_steps_of_the_node_s_own_clock_have_no_effect_on_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stepped_clock: Callable[[float], None]
) -> None:
    settings = {"record_path": tmp_path / "run", "excitation_timeout": 60.0, **RELIABLE_INPUT}
    with bench(tmp_path, **settings) as running:
        # processes that start later have the true clock; only the node has the shifted clock
        monkeypatch.delenv("LD_PRELOAD")
        probe = running.probe
        send = probe.excitation()
        sent = 0
        for off_s in (0.0, -10.0, 25.0, 0.0):
            stepped_clock(off_s)
            for _ in range(500):
                send(T0 + sent * MS, (30e3 * math.sin(2e-3 * sent), 0.0, 0.0))
                sent += 1
                probe.pace(sent)
            figures = _until_accounted(running, sent)
            age_s = float(figures["newest_sample_age_s"]) - (time.time_ns() - T0 - sent * MS) * 1e-9
            # the age in the report contains the shift of the node's clock; on a busy machine, the report may be read
            # late
            assert abs(age_s - off_s) < 5.0
            assert (figures["samples_used"], figures["holds"]) == (str(sent), "0")
        counters = probe.figures("state")
        assert (counters["resets"], counters["solver_failures"]) == ("0", "0")
        assert running.twin.stop() == 0
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.samples) == (0, sent)


def test_the_scene_s_loads_restart_at_a_step_of_the_node_s_own_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stepped_clock: Callable[[float], None]
) -> None:
    with bench(tmp_path, excitation_source="scene", record_path=tmp_path / "run") as running:
        monkeypatch.delenv("LD_PRELOAD")
        probe = running.probe
        forces = probe.listen(JointState, "contact_forces")
        for resets, off_s in enumerate((0.0, -10.0, 25.0)):
            stepped_clock(off_s)
            probe.until_figure("state", "resets", str(resets))
            count = len(forces)
            probe.until(lambda: len(forces) > count + 50, "the motion to go on")  # noqa: B023
            assert abs(stamp_ns(forces[-1].header) - time.time_ns() - off_s * 1e9) < 5e9
        assert running.twin.stop() == 0
    assert replay(tmp_path / "run").exit_code == 0


SUBSCRIBER = """
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("slow", namespace={namespace!r})
node.create_subscription(JointState, "contact_forces", lambda _: None, QoSProfile(depth=10))
print("ready", flush=True)
rclpy.spin(node)
"""


def test_a_stopped_subscriber_does_not_delay_the_twin(tmp_path: Path) -> None:
    # the queue is long enough for all samples, because on a busy machine the twin may pause for more than a second
    with bench(tmp_path, jump_forward=60.0, input_depth=10_000, **RELIABLE_INPUT) as running:
        slow = subprocess.Popen(
            [sys.executable, "-c", SUBSCRIBER.format(namespace=running.namespace)], stdout=subprocess.PIPE
        )
        try:
            assert slow.stdout is not None and slow.stdout.readline() == b"ready\n"
            publisher = running.publisher("--rate", "1000", "--seconds", "6")
            running.probe.until(lambda: int(running.probe.figures("input")["samples_used"]) > 500, "samples")
            slow.send_signal(signal.SIGSTOP)
            figures = _until_accounted(running, _sent(publisher))
            assert figures["samples_used"] == "6000"
        finally:
            slow.kill()
            slow.communicate()


@contextmanager
def _context() -> Iterator[Context]:
    context = Context()
    context.init(args=[])
    try:
        yield context
    finally:
        context.try_shutdown()


def test_a_hundred_lifecycles_leave_nothing_behind(tmp_path: Path) -> None:
    done = TransitionCallbackReturn.SUCCESS
    process = psutil.Process()
    sizes: list[tuple[int, int, int]] = []
    with _context() as context:
        overrides = [Parameter("record_path", value=str(tmp_path / "run"))]
        node = TwinNode(namespace=f"/l{os.getpid()}", context=context, parameter_overrides=overrides)
        for cycle in range(100):
            assert node.trigger_configure() == done and node.trigger_activate() == done
            assert node.trigger_deactivate() == done and node.trigger_cleanup() == done
            if cycle % 10 == 9:
                gc.collect()
                sizes.append((process.memory_info().rss, process.num_fds(), threading.active_count()))
        node.destroy_node()
    first, last = sizes[2], sizes[-1]
    assert last[1:] == first[1:]
    assert last[0] - first[0] < 8 * 2**20, f"grown by {(last[0] - first[0]) / 2**20:.1f} MiB in 70 cycles"


def test_two_twins_in_one_process_do_not_disturb_each_other() -> None:
    with _context() as context:
        spaces = [f"/p{os.getpid()}_{index}" for index in range(2)]
        nodes = [TwinNode(namespace=space, context=context) for space in spaces]
        executor = SingleThreadedExecutor(context=context)
        for node in nodes:
            executor.add_node(node)
            assert node.start()
        senders = [node.create_publisher(WrenchStamped, "excitation", QoSProfile(depth=100)) for node in nodes]
        messages_of_node: list[list[JointState]] = [[], []]
        for node, messages in zip(nodes, messages_of_node, strict=True):
            node.create_subscription(JointState, "contact_forces", messages.append, QoSProfile(depth=1000))

        def spin_until(reached: Callable[[], bool]) -> None:
            give_up = time.monotonic() + 60.0
            while not reached():
                assert time.monotonic() < give_up, [len(messages) for messages in messages_of_node]
                executor.spin_once(timeout_sec=0.05)

        spin_until(lambda: all(sender.get_subscription_count() == 1 for sender in senders))
        message = WrenchStamped()
        for index in range(50):
            set_stamp(message.header, T0 + index * MS)
            for sender, force in zip(senders, (3e4, -3e4), strict=True):
                message.wrench.force.x = force
                sender.publish(message)
            spin_until(lambda index=index: all(len(messages) == index + 1 for messages in messages_of_node))  # type: ignore[misc]
        first, second = (np.array(messages[-1].position) for messages in messages_of_node)
        assert not np.allclose(first, second)
        for node in nodes:
            executor.remove_node(node)
            node.release()
            node.destroy_node()


def test_two_minutes_of_recording_account_for_every_message_in_constant_memory() -> None:
    command = [sys.executable, str(ROOT / "benchmark" / "live_load.py"), "--minutes", "2", "--rate", "500"]
    # a separate ROS domain, because other nodes publish reports too
    environment = os.environ | {"ROS_DOMAIN_ID": claim_domain()}
    completed = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400.0)
    rows = [json.loads(line) for line in completed.stdout.splitlines() if line.startswith("{")]
    assert completed.returncode == 0, completed.stdout[-2000:] + completed.stderr[-2000:]
    assert len(rows) >= 10 and all(row["age_p50_ms"] is not None for row in rows[1:-1])
    first, last = rows[2], rows[-1]
    assert (last["threads"], last["files"]) == (first["threads"], first["files"])
    assert last["rss_mib"] - first["rss_mib"] < 4.0


def test_a_flood_of_requests_loses_nothing_and_the_journal_repeats_them(tmp_path: Path) -> None:
    run, chance = tmp_path / "run", random.Random(2)
    requests: Counter[str] = Counter()
    numbers = {
        "clearance_horizontal": (-1.0, 0.022, 0.03),
        "limit_force": (0.0, 5e4, 1e6),
        "excitation_timeout": (0.02, 0.3),
        "jump_back": (0.0, 1.0),
    }
    settings = {"record_path": run, "wear_state_path": tmp_path / "wear", "alarm_force": "[1000.0, 2000.0]"}
    with bench(tmp_path, **settings, **RELIABLE_INPUT) as running:
        probe, name = running.probe, f"{running.namespace}/plow_twin"
        publisher = running.publisher("--rate", "500", "--seconds", "20")
        give_up = time.monotonic() + 12.0
        while time.monotonic() < give_up:
            action = chance.choice([*SERVICES, *numbers, "stop", "cycle"])
            requests[action] += 1
            if action in SERVICES:
                probe.call(Trigger, f"{name}/{action}", Trigger.Request())
            elif action in numbers:
                number = ParameterValue(
                    type=ParameterType.PARAMETER_DOUBLE, double_value=chance.choice(numbers[action])
                )
                request = SetParameters.Request(parameters=[ParameterMessage(name=action, value=number)])
                assert probe.call(SetParameters, f"{name}/set_parameters", request).results[0].successful
            elif action == "stop":
                publisher.send_signal(signal.SIGSTOP)
                time.sleep(chance.random())
                publisher.send_signal(signal.SIGCONT)
            else:
                for number in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
                    change = ChangeState.Request(transition=Transition(id=number))
                    assert probe.call(ChangeState, f"{name}/change_state", change).success
        sent = _sent(publisher)
        _until_accounted(running, sent)
        output = running.twin.output()
        # the forces cause alarms
        errors = [line for line in output.splitlines() if "[ERROR]" in line and "error threshold 2 kN" not in line]
        assert not errors and "Traceback" not in output
        assert running.twin.stop() == 0
    assert len(requests) == len(SERVICES) + len(numbers) + 2, requests
    assert replay(run).exit_code == 0
