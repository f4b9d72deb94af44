"""The screen of a ROS node: a separate process subscribes to the topics of the node and calls its services."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from plow_twin.dashboard.access import DashboardError, PageAccess
from plow_twin.dashboard.facts import facts_of
from plow_twin.dashboard.feed import RATE_HZ, Feed, Motion
from plow_twin.dashboard.screen import Screen
from plow_twin.live.part import Part, part_of
from plow_twin.live.timer import Timer
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record import messages as plain
from plow_twin.record.cdr import decode
from plow_twin.record.rows import poses_of
from plow_twin.ros.connections import WithoutEvents
from plow_twin.ros.main import make_executor
from plow_twin.ros.messages import UNREADABLE, read_wrench
from plow_twin.ros.publishers import CLASSES
from plow_twin.ros.qos import DIAGNOSTICS, OUTPUTS, sensor_input
from plow_twin.ros.start import ros
from plow_twin.scene_file import load_scene
from plow_twin.stream.topics import TOPICS, Cadence, names_of

#: Parameters of the node that the page shows.
_SHOWN: Final = (
    "scene", "hardware_id", "excitation_source", "forecast_limits", "alarm_force", "alarm_clearance",
    "alarm_clearance_rate", "alarm_wear_rate", "alarm_residual", "alarm_duration",
)  # fmt: skip
#: Longest time to wait for the answer of a service [s].
_PATIENCE_S: Final = 5.0
#: Depths of the queues for topics from which only the newest message is needed, or all messages.
_NEWEST, _ALL = 1, 1000
_TYPES: Final = {topic.name: topic.type for topic in TOPICS}


class NodeWatch:
    """Client of a node.

    `DashboardError` is raised if the node is not found within `wait_s` [s], or if `stopped` returns True.
    """

    def __init__(self, namespace: str, name: str, wait_s: float, stopped: Callable[[], bool]) -> None:
        self.node = WithoutEvents(
            "plow_twin_screen", namespace=namespace, start_parameter_services=False, enable_rosout=False
        )
        self._executor = make_executor()
        self._executor.add_node(self.node)
        space = self.node.get_namespace().rstrip("/")
        self.name = f"{space}/{name}"
        self._ask = self.node.create_client(GetParameters, f"{self.name}/get_parameters")
        self._set = self.node.create_client(SetParameters, f"{self.name}/set_parameters")
        self._services = {
            service: self.node.create_client(Trigger, f"{self.name}/{service}")
            for service in ("acknowledge_alarms", "mark")
        }
        self.feed: Feed  # `listen` sets the attribute
        self._source: str | None = None
        waited = 0.0
        while not self._ask.service_is_ready():
            if waited >= wait_s or stopped():
                raise DashboardError("--ros", self.name, f"a running node within {wait_s:g} s")
            self.spin()
            waited += 0.1

    def spin(self) -> None:
        """Process messages, and wait up to 0.1 s for a message."""
        self._executor.spin_once(timeout_sec=0.1)

    def facts(self, scene: str | None) -> dict[str, Any]:
        """Return the facts of the node. If its scene file cannot be read on this machine, `scene` is needed.

        Raise `DashboardError` if the node does not answer, and `SceneError` if the scene cannot be read.
        """
        answer = self._called(self._ask, GetParameters.Request(names=list(_SHOWN)))
        if answer is None:
            raise DashboardError("--ros", self.name, f"an answer within {_PATIENCE_S:g} s")
        values = map(parameter_value_to_python, answer.values)
        parameters = {name: value for name, value in zip(_SHOWN, values, strict=False) if value is not None}
        self._source = parameters.get("excitation_source")
        found = load_scene(scene or str(parameters.get("scene", "")))
        return facts_of(found, parameters, f"node {self.name}")

    def listen(self, feed: Feed) -> None:
        """Pass all messages that arrive after this call to a feed."""
        self.feed = feed
        newest = sensor_input(_NEWEST)
        self._subscribe("contact_forces", newest, self._forces)
        self._subscribe("contact_peaks", OUTPUTS["contact_peaks"], self._peaks)
        self._subscribe("peak_intervals", OUTPUTS["peak_intervals"], self._points)
        self._subscribe("head_state", newest, self._pose)
        self._subscribe("clearance", newest, self._clearance)
        self._subscribe("quality", OUTPUTS["quality"], self._quality)
        for topic in names_of(Cadence.ESTIMATE, Cadence.CHANGE):
            self._subscribe(topic, OUTPUTS[topic], partial(self._said, topic))
        if self._source == "excitation":
            self.node.create_subscription(WrenchStamped, "excitation", self._load, sensor_input(_ALL), raw=True)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnostics, DIAGNOSTICS)

    def answer(self, action: str, text: str) -> tuple[bool, str]:
        """Call the service for an operator request. Return whether the request succeeded, and the answer."""
        service = "acknowledge_alarms" if action == "acknowledge" else "mark"
        if service == "mark":
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
            done = self._called(self._set, SetParameters.Request(parameters=[Parameter(name="mark", value=value)]))
            if done is None:
                return False, f"mark: no answer to set_parameters within {_PATIENCE_S:g} s"
            if not done.results[0].successful:
                return False, str(done.results[0].reason)
        answer = self._called(self._services[service], Trigger.Request())
        return (False, f"no answer within {_PATIENCE_S:g} s") if answer is None else (answer.success, answer.message)

    def close(self) -> None:
        """Destroy the ROS node of the screen."""
        self._executor.remove_node(self.node)
        self.node.destroy_node()  # type: ignore[no-untyped-call]

    def _called(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self._executor.spin_until_future_complete(future, timeout_sec=_PATIENCE_S)
        return future.result() if future.done() else None

    def _subscribe(self, topic: str, quality: QoSProfile, take: Callable[[Any], None]) -> None:
        """Subscribe to an output, decoded to the classes that recordings use."""
        kind = _TYPES[topic]
        self.node.create_subscription(CLASSES[kind], topic, lambda data: take(decode(data, kind)), quality, raw=True)

    @property
    def _motion(self) -> Motion:
        return self.feed.motion

    def _forces(self, message: plain.JointState) -> None:
        motion = self._motion
        motion.stamp_ns, motion.penetration, motion.force = message.stamp_ns, message.position, message.effort

    def _peaks(self, message: plain.JointState) -> None:
        if len(message.effort) == PAIR_COUNT:
            self._motion.add_peaks(message.effort[None])

    def _points(self, message: plain.JointState) -> None:
        if len(message.effort) == 3 * PAIR_COUNT:
            _, low, high = message.effort.reshape(3, 1, PAIR_COUNT)
            self._motion.add_points(low, high)

    def _pose(self, message: plain.Odometry) -> None:
        self._motion.pose = poses_of(np.array([*message.position[:2], *message.orientation[2:]]))

    def _clearance(self, message: plain.JointState) -> None:
        self._motion.set_clearance(message.position)

    def _quality(self, message: plain.JointState) -> None:
        motion = self._motion
        motion.held = bool(len(message.position) and message.position[0])
        motion.was_held |= motion.held

    def _load(self, data: bytes) -> None:
        wrench = read_wrench(data)
        if wrench is not UNREADABLE:
            self._motion.add_load(np.array([wrench[1]]))

    def _said(self, topic: str, message: plain.Message) -> None:
        self.feed.part(topic, part_of(message))

    def _diagnostics(self, message: Any) -> None:
        for status in message.status:
            name, _, part = status.name.partition(": ")
            if name == self.name:
                values = {item.key: item.value for item in status.values}
                part_of_twin: Part = (int.from_bytes(status.level, "little"), status.message, values)
                self.feed.part(part, part_of_twin)


def show_node(
    namespace: str,
    name: str,
    scene: str | None,
    access: PageAccess,
    wait_s: float,
    stopped: Callable[[], bool],
    on_open: Callable[[Screen], object],
) -> None:
    """Show a node until `stopped` returns True. The errors are those of `NodeWatch`, `NodeWatch.facts` and `Screen`."""
    with ExitStack() as opened:
        opened.enter_context(ros())
        watch = opened.enter_context(closing(NodeWatch(namespace, name, wait_s, stopped)))
        with Screen(access, watch.facts(scene), watch.answer) as screen:
            watch.listen(screen.feed)
            on_open(screen)
            timer = Timer(1.0 / RATE_HZ, screen.feed.turn)
            while not (stopped() or screen.has_ended):
                watch.spin()
                timer.look()
