"""Processes of the package, and a ROS node that observes them, for the tests of the ROS side."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import forge
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from plow_twin.ros.messages import set_stamp

with warnings.catch_warnings():
    # the message parser of the ROS wheels imports a deprecated module
    warnings.simplefilter("ignore", DeprecationWarning)
    import rosidl_generator_py  # noqa: F401

ROOT = Path(__file__).resolve().parent.parent
#: Time limit [s] that is sufficient for the first compilation of the solver on a slow machine.
START_S = 200.0
#: Time limit [s] that is sufficient for discovery on a busy machine.
WAIT_S = 60.0
#: Time limit [s] for the end of a process: twice the longest time measured with three processes on two cores.
STOP_S = 10.0
_numbers = itertools.count()


class Process:
    def __init__(self, module: str, arguments: Sequence[str], log: Path) -> None:
        self._log = log
        with log.open("wb") as stream:
            self._process = forge.start(module, arguments, stdout=stream, stderr=subprocess.STDOUT)

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def output(self) -> str:
        return self._log.read_text(errors="replace")

    def send_signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def wait(self, timeout_s: float = START_S) -> int:
        return self._process.wait(timeout_s)

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Send a signal and return the exit code. Fail if the process does not end within `STOP_S`."""
        self._process.send_signal(number)
        return self._process.wait(STOP_S)

    def stop_again_and_again(self, number: signal.Signals) -> int:
        """Send a signal repeatedly until the process has ended. Return its exit code."""
        while self.running:
            self._process.send_signal(number)
            time.sleep(0.002)
        return self._process.wait()

    def close(self) -> None:
        """End the process by a signal that it handles, because a killed process would not release its shared memory."""
        if self.running:
            self._process.terminate()
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()


@cache
def _context() -> Context:
    """Return the only ROS participant of this process: on localhost, at most 32 participants are discovered."""
    context = Context()
    context.init(args=[])
    return context


class Probe:
    """A ROS node of the test process that publishes, subscribes, calls services and waits."""

    def __init__(self, namespace: str) -> None:
        self.context = _context()
        self.node = rclpy.create_node("probe", namespace=namespace, context=self.context)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self.status: list[DiagnosticStatus] = []
        self.reports: list[dict[str, DiagnosticStatus]] = []
        # this queue is longer than that of the twin, so that no short change is missed
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(DiagnosticStatus, "status", self.status.append, latched)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._report, 100)

    def _report(self, message: DiagnosticArray) -> None:
        self.reports.append({status.name: status for status in message.status})

    def listen(self, kind: type, topic: str) -> list[Any]:
        """Return a list to which all further messages are appended."""
        messages: list[Any] = []
        subscription = self.node.create_subscription(kind, topic, messages.append, QoSProfile(depth=20000))
        self.until(lambda: subscription.get_publisher_count() > 0, f"a publisher of {topic}")
        self.pause(0.1)
        return messages

    def until(self, reached: Callable[[], Any], event: str, timeout_s: float = WAIT_S) -> None:
        give_up = time.monotonic() + timeout_s
        while not reached():
            assert time.monotonic() < give_up, f"{event}: not within {timeout_s} s; last status {self.status[-1:]}"
            self._executor.spin_once(timeout_sec=0.05)

    def until_lifecycle(self, state: str, timeout_s: float = WAIT_S) -> None:
        self.until(lambda: self.status and value(self.status[-1], "lifecycle") == state, state, timeout_s)

    def figures(self, part: str) -> dict[str, str]:
        """Return the values of a part of the diagnostics that was sent after this call."""
        count = len(self.reports)
        name = f"{self.node.get_namespace()}/plow_twin: {part}"
        self.until(lambda: any(name in report for report in self.reports[count:]), f"diagnostics {part}")
        return {item.key: item.value for item in self.reports[-1][name].values}

    def until_figure(self, part: str, key: str, *expected: str, timeout_s: float = WAIT_S) -> None:
        """Wait until a value of the diagnostics equals one of the expected values."""
        name = f"{self.node.get_namespace()}/plow_twin: {part}"
        try:
            self.until(
                lambda: self.reports and name in self.reports[-1] and value(self.reports[-1][name], key) in expected,
                f"{part} {key} = {expected}",
                timeout_s,
            )
        except AssertionError as error:
            raise AssertionError(f"{error}; last {part} {self.figures(part)}") from None

    def publisher(self, kind: type, topic: str, profile: QoSProfile | int = 1000) -> Any:
        """Return a publisher as soon as the twin reports that it is connected to it."""
        key = f"publishers_{topic}"
        before = value(self.status[-1], key)
        publisher = self.node.create_publisher(kind, topic, profile)
        self.until(lambda: value(self.status[-1], key) not in (before, "", "0"), f"the twin to read {topic}")
        self.until(lambda: publisher.get_subscription_count() > 0, f"a reader of {topic}")
        return publisher

    def excitation(self, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> Callable[..., None]:
        """Return a function that publishes a sample, as soon as the twin subscribes to the topic."""
        publisher = self.publisher(WrenchStamped, "excitation", QoSProfile(depth=5000, reliability=reliability))

        def send(stamp_ns: int, wrench: Sequence[float], **components: float) -> None:
            message = WrenchStamped()
            set_stamp(message.header, stamp_ns)
            message.wrench.force.x, message.wrench.force.y, message.wrench.torque.z = wrench
            for name, number in components.items():
                part, axis = name.split("_")
                setattr(getattr(message.wrench, part), axis, number)
            publisher.publish(message)

        return send

    def clock(self) -> Callable[[int], None]:
        """Return a function that publishes a time [ns] on `/clock`, as soon as the twin subscribes to the topic."""
        publisher = self.node.create_publisher(Clock, "/clock", 1000)
        self.until(lambda: publisher.get_subscription_count() > 0, "a reader of /clock")

        def show(time_ns: int) -> None:
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(time_ns, 10**9)
            publisher.publish(message)

        return show

    def pace(self, index: int) -> None:
        """Pause after every 50 samples, because best-effort subscribers drop messages if they cannot keep up."""
        if index % 50 == 49:
            self.pause(0.04)

    def pause(self, seconds: float) -> None:
        """Wait for discovery by the other process."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def call(self, kind: type, service: str, request: Any) -> Any:
        # a server loses the answer to a client that it has not discovered yet, so each service has one client for all
        # calls
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        client = self._clients[service]
        self.until(client.service_is_ready, service)
        future = client.call_async(request)
        self.until(future.done, f"an answer of {service}", START_S)
        return future.result()

    def close(self) -> None:
        self._executor.remove_node(self.node)
        self.node.destroy_node()


class Bench:
    """A twin in a separate process and namespace, with a probe in this process."""

    def __init__(self, folder: Path, parameters: dict[str, Any], arguments: Sequence[str] = ()) -> None:
        self.namespace = f"/t{os.getpid()}_{next(_numbers)}"
        # in names of parameters, {ns} is replaced by the namespace
        named = {name.replace("{ns}", self.namespace): value for name, value in parameters.items()}
        self.folder = folder
        self._publishers: list[Process] = []
        self.probe = Probe(self.namespace)
        settings = itertools.chain.from_iterable(("-p", f"{name}:={given}") for name, given in named.items())
        ros_arguments = ["--ros-args", "-r", f"__ns:={self.namespace}", *settings, *arguments]
        self.twin = Process("plow_twin.ros.main", ros_arguments, folder / "twin.log")

    def publisher(self, *arguments: str) -> Process:
        ros_arguments = [*arguments, "--ros-args", "-r", f"__ns:={self.namespace}"]
        self._publishers.append(
            Process("plow_twin.demo.excitation_publisher", ros_arguments, self.folder / "publisher.log")
        )
        return self._publishers[-1]

    def close(self) -> None:
        self.probe.close()
        for process in (self.twin, *self._publishers):
            process.close()


@contextmanager
def bench(folder: Path, lifecycle: str = "active", arguments: Sequence[str] = (), **parameters: Any) -> Iterator[Bench]:
    """Start a twin and wait until it is in the given lifecycle state."""
    running = Bench(folder, parameters, arguments)
    try:
        running.probe.until_lifecycle(lifecycle, START_S)
        yield running
    finally:
        running.close()


def value(status: DiagnosticStatus, key: str) -> str:
    return {item.key: item.value for item in status.values}[key]
