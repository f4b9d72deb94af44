"""A node releases its resources. It runs in this process, in which threads, objects and topics can be counted."""

from __future__ import annotations

import gc
import math
import os
import shutil
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros_processes  # noqa: F401  (imports ROS without the warnings of its own modules)
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped, WrenchStamped
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from record_support import records_of
from sensor_msgs.msg import JointState
from waiting import until

from plow_twin.live.inputs import SILENT_NS
from plow_twin.live.parameters import ParameterError
from plow_twin.live.tool_forces import ToolForces
from plow_twin.model.scene import Constant, Table
from plow_twin.record.entries import EntryRecord
from plow_twin.record.measured import read_recording
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.ros.connections import Connections
from plow_twin.ros.input_loop import InputLoop, Turns
from plow_twin.ros.input_queue import InputQueue, Received
from plow_twin.ros.node import TwinNode
from plow_twin.ros.qos import OUTPUTS, sensor_input
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.intake import Verdict
from plow_twin.stream.journal import Pose


class _Flood:
    def __init__(self) -> None:
        self.fd = os.eventfd(1)
        self.taken = 0

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Received], bool]:
        return [Received(b"", 0, 0, b"")] * most, True

    def receive(self, topic: str, batch: list[Received]) -> None:
        self.taken += len(batch)

    def close(self) -> None:
        os.close(self.fd)


PAPER = load_scene(scene_path("paper"))


@contextmanager
def _node(**parameters: Any) -> Iterator[TwinNode]:
    context = Context()
    context.init(args=[])
    overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
    node = TwinNode(namespace=f"/r{os.getpid()}", context=context, parameter_overrides=overrides)
    try:
        yield node
    finally:
        node.release()
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize(("policy", "value"), [("reliability", "bogus"), ("depth", -1)])
def test_a_failed_configure_leaves_nothing_behind(policy: str, value: object, tmp_path: Path) -> None:
    # the node creates this input last, so the other inputs exist when it fails
    override = f"qos_overrides./r{os.getpid()}/head_pose.subscription"
    with _node(**{f"{override}.{policy}": value, "record_path": str(tmp_path / "run")}) as node:
        threads = set(threading.enumerate())
        topics = ("contact_forces", "head_state", "excitation", "travel")
        before = len(list(node.publishers)), len(list(node.subscriptions)), len(list(node.timers))
        for _ in range(2):
            assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
            assert f"{override}: got" in node.reason and str(value) in node.reason and "Trace" not in node.reason
            assert set(threading.enumerate()) == threads
            assert (len(list(node.publishers)), len(list(node.subscriptions)), len(list(node.timers))) == before
        assert [node.count_publishers(topic) for topic in topics] == [0] * len(topics)


def _refused(node: TwinNode, **values: Any) -> str:
    return str(node.set_parameters_atomically([Parameter(*item) for item in _typed(values)]).reason)


def _typed(values: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    return [(name, Parameter.Type.STRING, str(value)) for name, value in values.items()]


def test_participants_of_the_graph_cannot_name_files_outside_the_root(tmp_path: Path) -> None:
    with _node() as node:
        for name in ("scene", "record_path", "wear_state_path"):
            assert f"{name}: names a file, and is read-only without" in _refused(node, **{name: tmp_path / "x"})
        assert _refused(node, scene="bench_kv") == ""
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    with _node(file_root=str(root), services_off="set_wear, acknowledge_alarms") as node:
        for path in (tmp_path / "run", root / ".." / "run", root / "link" / "run", "/proc/self/wear"):
            for name in ("scene", "record_path", "wear_state_path"):
                assert "expected a path within file_root" in _refused(node, **{name: path}), (name, path)
        assert _refused(node, record_path=root / "run", wear_state_path=root / "wear") == ""
        assert node.set_parameters([Parameter("file_root", value="/")])[0].successful is False
        assert node.start()
        assert node._front is not None
        for name in ("set_wear", "acknowledge_alarms"):
            assert node._front.answer(name) == (False, f"{name}: switched off by the parameter services_off")
        assert node._front.answer("mark")[0]
    with (
        pytest.raises(ParameterError, match=r"record_path: got .*expected a path within file_root"),
        _node(file_root=str(root), record_path=str(tmp_path / "run")),
    ):
        pass
    with (
        pytest.raises(ParameterError, match="services_off: got 'set_waer', expected one of reset, "),
        _node(services_off="set_waer"),
    ):
        pass


def test_no_runtime_outlives_its_cycle() -> None:
    references: list[weakref.ref[Any]] = []
    with _node() as node:
        for _ in range(3):
            assert node.start()
            assert node.runtime is not None
            references.append(weakref.ref(node.runtime))
            assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
            assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
            gc.collect()
            assert [reference() for reference in references] == [None] * len(references)
        assert node.start()
        assert node.runtime is not None
        references.append(weakref.ref(node.runtime))
        node.release()  # the node is released while it is active
        gc.collect()
        assert references[-1]() is None
    assert gc.get_freeze_count() == 0


def test_an_incompatible_peer_is_named_although_its_topics_are_discovered_first(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    names = iter(["_NODE_NAME_UNKNOWN_", "sender", "sender", "_NODE_NAME_UNKNOWN_", "_NODE_NAME_UNKNOWN_"])
    with _node() as node:
        subscription = node.create_subscription(WrenchStamped, "excitation", lambda message: None, 10)
        identity = [1]

        def discovered(topic: str) -> list[TopicEndpointInfo]:
            return [TopicEndpointInfo(node_name=next(names), topic_type="std_msgs/msg/String", endpoint_gid=identity)]

        monkeypatch.setattr(node, "get_publishers_info_by_topic", discovered)
        connections = Connections(node)
        assert [connections.publishers(subscription) for _ in range(3)] == [([], 0), ([], 1), ([], 0)]
        identity = [2]  # a publisher without a name is reported too
        assert [connections.publishers(subscription) for _ in range(2)] == [([], 0), ([], 1)]
    lines = [line for line in capfd.readouterr().err.splitlines() if "nothing is received" in line]
    assert ["publisher sender: type" in line for line in lines] == [True, False]


def test_unsaved_wear_survives_a_cleanup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with _node(wear_state_path=str(tmp_path)) as node:
        assert node.start() and node.runtime is not None
        node.runtime.driver.set_wear(node.runtime.stamp_ns, (1e-4,) * 8, "test")
        assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert node.start() and node.runtime is not None
        node.runtime.driver.set_wear(node.runtime.stamp_ns, (2e-4,) * 8, "test")
        with monkeypatch.context() as disk:
            disk.setattr(os, "fsync", full)
            assert node.trigger_deactivate() == node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert node.start() and node.runtime is not None
        assert node.runtime.driver.session.wear_depth.tolist() == [2e-4] * 8


def test_a_ring_that_cannot_be_written_is_reported_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room, usage = threading.Event(), shutil.disk_usage
    monkeypatch.setattr(
        shutil, "disk_usage", lambda path: usage(path) if room.is_set() else usage(path)._replace(free=9)
    )
    folder = tmp_path / "ring"
    with _node(record_path=str(folder), record_ring=5.0) as node:
        assert node.start() and node._front is not None
        runtime = node._front.runtime
        assert runtime.recording is not None
        recorder = runtime.recording.recorder

        def mark(written: int, lost: int) -> None:
            assert node._front is not None and node._front.answer("mark")[0]
            until(lambda: (recorder.counters.marks, recorder.counters.marks_lost) == (written, lost), recorder.counters)

        mark(0, 1)
        level, message, values = node._health.recorder(runtime)
        assert (level, values["marks_lost"], runtime.recorder_state) == (2, "1", "trouble")
        assert message.startswith(f"{folder}: the last 5 s not written: ") and not folder.exists()
        room.set()
        mark(1, 1)
        reader = RunReader(folder)
        assert list(records_of(reader)) and reader.status is FileStatus.COMPLETE
        assert not recorder.close().complete


def test_a_pose_and_its_negative_quaternion_give_the_same_residual() -> None:
    with _node() as node:
        assert node.start()
        assert node.runtime is not None
        residuals = []
        for number, sign in enumerate((1.0, -1.0), 1):
            message = PoseStamped()
            message.header.stamp.sec = number
            message.pose.orientation.z, message.pose.orientation.w = sign * math.sin(5e-3), sign * math.cos(5e-3)
            front = node._front
            assert front is not None
            received = [Received(b"", number, 0, serialize_message(message))]
            front.subscriptions._measured_poses(received)
            residual = node.runtime.inputs.residual(np.array([0.0, 0.0, 0.002]))
            assert residual is not None
            residuals.append(residual[2])
            assert node.runtime.inputs.head_pose.used == number
    assert residuals == pytest.approx([-0.008, -0.008], abs=1e-12)


def test_the_covariance_of_each_pose_goes_into_the_journal_and_the_estimate(tmp_path: Path) -> None:
    covariances = [(1e-8, 4e-8, 9e-6), (0.0, 0.0, 0.0), (9e-8, 4e-8, 9e-6), (-1.0, 0.0, 0.0), (math.nan, 0.0, 0.0)]
    run = tmp_path / "run"
    with _node(head_pose_type="pose_with_covariance", record_path=str(run)) as node:
        assert node.start()
        front = node._front
        assert front is not None
        for number, variances in enumerate(covariances, 1):
            message = PoseWithCovarianceStamped()
            message.header.stamp.sec = number
            message.pose.pose.orientation.w = 1.0
            for axis, variance in zip((0, 1, 5), variances, strict=True):
                message.pose.covariance[7 * axis] = variance
            received = [Received(b"", number, 0, serialize_message(message))]
            front.subscriptions._measured_poses(received)
        assert front.runtime.inputs.head_pose.counts[Verdict.NON_FINITE] == 2
        # a quaternion of zeros must not be read as an angle of 0
        message.pose.pose.orientation.w = 0.0
        front.subscriptions._measured_poses([Received(b"", 6, 0, serialize_message(message))])
        assert front.runtime.inputs.head_pose.counts[Verdict.MALFORMED] == 1
        list(front.runtime.step([(stamp * 1_000_000_000, (0.0, 0.0, 0.0)) for stamp in (1, 2, 3)]))
        assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
        assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    entries = [record.entry for record in records_of(run) if isinstance(record, EntryRecord)]
    poses = [entry for entry in entries if isinstance(entry, Pose)]
    assert [pose.deviation for pose in poses] == [(1e-4, 2e-4, 3e-3), (), (3e-4, 2e-4, 3e-3)]
    mean = math.sqrt((1e-8 + 9e-8) / 2)
    assert read_recording(run).pose_deviation == pytest.approx((mean, 2e-4, 3e-3))
    assert replay(run).exit_code == 0


def test_loads_without_a_direction_may_be_named_and_have_no_effect() -> None:
    bias = Constant(name="bias", force_n=(0.0, 0.0))
    table = Table(name="cut", t=(0.0, 1.0), wrench=((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))
    tools = ToolForces(replace(PAPER, loads=(*PAPER.loads, bias, table)))
    required = [load.name for load in PAPER.loads]
    plain = tools.wrench(required, [2.0] * len(required))
    assert plain is not None
    every = [*required, "bias", "cut"]
    assert tools.wrench(every, [*[2.0] * len(required), 7.0, math.nan]) == plain
    for wrong in (every[1:], [*every, "cut"], [*every, "drum"], []):
        assert tools.wrench(wrong, [1.0] * len(wrong)) is None
    assert tools.wrench(every, [1.0]) is None


def test_a_flood_of_samples_delays_neither_timers_nor_other_threads() -> None:
    flood, turns, errors = _Flood(), Turns(), list[Exception]()
    done, at = threading.Semaphore(0), list[int]()
    loop = InputLoop(turns, errors.append)
    loop.add(flood, flood, "flood")  # type: ignore[arg-type]

    def due() -> None:
        at.append(flood.taken)
        done.release()

    loop.every(1e-3, due)
    loop.start()
    loop.run_timers(True)
    for _ in range(20):
        assert done.acquire(timeout=30.0)
        with turns, turns:
            inside = flood.taken
            time.sleep(1e-3)
            assert flood.taken == inside
    loop.close()
    assert not errors and len(set(at)) == len(at) and at[-1] > 20


def test_a_queue_that_fills_during_reading_is_read_completely() -> None:
    # a turn requests as many messages as were announced; newer messages must not displace the remaining ones
    with _node() as node:
        numbers: list[int] = []
        subscription = node.create_subscription(TwistStamped, "burst", lambda _: None, sensor_input(1000), raw=True)
        queue = InputQueue(node, subscription)
        publisher = node.create_publisher(TwistStamped, "burst", OUTPUTS["contact_forces"])

        def send(count: int) -> None:
            for _ in range(count):
                publisher.publish(TwistStamped())
            # the middleware has announced all messages, so every turn takes the requested number
            time.sleep(0.2)

        until(publisher.get_subscription_count, "a subscription")
        send(50)

        def take() -> bool:
            messages, more = queue.pop(20)
            numbers.extend(message.number for message in messages)
            return more

        assert take() and queue.waiting == 30
        send(3)
        while take():
            pass
        queue.close()
    assert numbers == list(range(1, 54))


def test_another_node_under_the_same_name_is_reported() -> None:
    with _node() as node:
        assert node.start()
        node._publish_diagnostics()
        assert "second twin" not in node._published_status[1]
        node.create_publisher(JointState, "contact_forces", 1)
        node._publish_diagnostics()
        assert node._published_status[0] == 1 and "second twin" in node._published_status[1]


def test_a_node_that_gets_no_sample_warns() -> None:
    with _node() as node:
        assert node.start() and node.runtime is not None
        node._publish_diagnostics()
        assert node._published_status[:2] == (0, "waiting for the first sample")
        node.runtime._active_since_ns -= SILENT_NS
        node._publish_diagnostics()
        assert node._published_status[:2] == (1, "waiting for the first sample; no sample has arrived")


def test_loss_is_counted_by_the_publishers_numbers() -> None:
    with _node() as node:
        assert node.start()
        assert node._front is not None and node.runtime is not None
        subscriptions = node._front.subscriptions
        for numbers in ((7, 8), (11,), (10,), (12,)):  # sequence number 9 never arrives, and 10 is late
            batch = [Received(b"one", number, 0, serialize_message(TwistStamped())) for number in numbers]
            subscriptions.receive("travel", batch)
        assert node.runtime.inputs.lost == 1


def test_messages_before_the_subscription_are_no_loss_at_any_time_of_discovery() -> None:
    period_ns = 5_000_000

    def hear(node: TwinNode, sender: bytes, after_s: float, *numbers: int) -> int:
        """Send samples, the first of them `after_s` after the subscription. Return the loss."""
        assert node._front is not None and node.runtime is not None
        subscriptions = node._front.subscriptions
        begun_ns = subscriptions._since_ns + round(after_s * 1e9) - numbers[0] * period_ns
        for number in numbers:
            # sender and receiver have different clocks
            received_ns, sent_ns = begun_ns + number * period_ns, number * period_ns
            batch = [Received(sender, number, received_ns, serialize_message(WrenchStamped()), sent_ns)]
            subscriptions.receive("excitation", batch)
        return node.runtime.inputs.senders.lost

    with _node() as node:
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        # the publisher has sent samples for 21 s, and is discovered 0.3 s after the subscription
        assert hear(node, b"before", 0.3, *range(4158, 4200), 4203) == 3
        assert node.trigger_cleanup() == node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        # a second publisher appears after an hour; it sent 60 messages before its connection, and three are lost after
        # it
        assert hear(node, b"after", 3600.0, 61) == 0
        assert hear(node, b"after", 3600.0, 62) == 60
        assert hear(node, b"after", 3600.0, *range(63, 100), 103) == 63


def test_no_events_of_the_middleware_are_used() -> None:
    with _node(estimate=True) as node:
        assert node.start()
        topics = [*node.publishers, *node.subscriptions, *node._front.subscriptions._taken_from.values()]  # type: ignore[union-attr]
        names = {topic.topic_name.rpartition("/")[2] for topic in topics}
        assert {"contact_forces", "excitation", "estimate", "status", "parameter_events"} <= names
        # rmw_fastrtps blocks if an event is taken while another event occurs, so no topic has event handlers
        assert [topic.topic_name for topic in topics if topic.event_handlers] == []


def test_an_error_in_the_thread_of_the_inputs_ends_the_program_with_a_message() -> None:
    with _node() as node:
        assert node.start()
        assert node.runtime is not None and node._front is not None

        def fail(*arguments: object) -> None:
            raise RuntimeError("not foreseen")

        node.runtime.inputs.uses_travel = fail  # type: ignore[method-assign,assignment]
        publisher = node.create_publisher(TwistStamped, "travel", 10)
        front = node._front
        until(lambda: front.error or publisher.publish(TwistStamped()), "an error", pause_s=0.05)
        with pytest.raises(RuntimeError, match="not foreseen"):
            node._publish_diagnostics()
