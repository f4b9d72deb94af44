"""The subscriptions: from messages to calls with plain numbers; optional inputs are checked and counted here."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from plow_twin.model.scene import Scene
from plow_twin.ros.input_queue import InputQueue, Taken
from plow_twin.ros.messages import ToolForces, read_wrench, stamp_ns
from plow_twin.ros.qos import OVERRIDABLE, sensor_input
from plow_twin.stream.driver import Arrival
from plow_twin.stream.history import RecentStamps
from plow_twin.stream.intake import Intake, Verdict
from plow_twin.stream.limits import Limits
from plow_twin.stream.senders import Senders

#: Depth of the optional inputs' queues.
_SLOW_DEPTH = 200
#: The input topics.
TOPICS: Final = ("excitation", "tool_forces", "travel", "head_pose")
#: Another sender counts as there for so long after its last sample [ns].
_OTHER_SENDER_NS: Final = 3_000_000_000
#: An optional input that has been heard counts as silent after so long [ns].
_SILENT_NS: Final = 10_000_000_000


class Inputs:
    """All subscriptions of a configured node.

    Parameters
    ----------
    node
        The node.
    scene
        Names and directions of the loads for `tool_forces`.
    source
        `excitation`, `tool_forces` or `scene`: the one that drives the model.
    depth
        Queue depth of the excitation topics.
    intake
        Where samples that go no further are counted.
    on_samples
        Receives stamp [ns] and wrench of the samples that the followed publisher of the selected source sent, in order
        of arrival.
    on_travel
        Receives stamp [ns] and speed along the face [m/s].
    on_matched
        Called when the number of publishers of an input has changed.
    on_pose
        Receives stamp [ns] and x, y [m], theta [rad] of measured poses, late ones up to `pose_span_s` too; None: only
        the newest is kept.
    """

    def __init__(
        self,
        node: Node,
        scene: Scene,
        source: str,
        depth: int,
        intake: Intake,
        on_samples: Callable[[list[Arrival]], None],
        on_travel: Callable[[int, float], None],
        on_matched: Callable[[], None],
        on_pose: Callable[[int, tuple[float, float, float]], None] | None = None,
        pose_span_s: float = 0.0,
    ) -> None:
        self._node = node
        self._intake = intake
        self._on_samples = on_samples
        self._on_travel = on_travel
        self._on_matched = on_matched
        self._on_pose = on_pose
        self._poses = None if on_pose is None else RecentStamps(pose_span_s)
        self._tool_forces = ToolForces(scene)
        self.active = False
        #: publishers of the selected source
        self.senders = Senders()
        self.depth = depth
        #: most messages that waited in the queue, and their longest wait [s], since `take_queue_peak`
        self._queue_peak = (0, 0.0)
        self._heard_ns: dict[str, int] = {}
        self._other_heard_ns = -_OTHER_SENDER_NS
        #: messages that the middleware reports as lost before they could be read
        self.lost = 0
        self.travel = Intake()
        self.head_pose = Intake()
        #: newest measured pose x, y [m], theta [rad]
        self.measured: tuple[float, float, float] | None = None
        self.refused_publishers = 0
        #: publishers that each input is connected to
        self.publishers = dict.fromkeys(TOPICS, 0)
        self._source = source
        self._subscriptions: list[Any] = []
        self._queue: InputQueue | None = None
        try:
            for topic, kind in (("excitation", WrenchStamped), ("tool_forces", JointState)):
                subscription = self._subscribe(kind, topic, self._not_selected, depth, raw=True)
                if topic == source:
                    self.senders.start(self._present())
                    self._subscriptions.remove(subscription)
                    self._queue = InputQueue(node, subscription, depth, self._taken)
            self._subscribe(TwistStamped, "travel", self._travel_speed, _SLOW_DEPTH)
            self._subscribe(PoseStamped, "head_pose", self._measured_pose, _SLOW_DEPTH)
        except BaseException:  # an override of the quality of service may be wrong for any of them
            self.close()
            raise

    def set_limits(self, travel_m_s: float, pose_m: float) -> None:
        """Set the largest speed along the face [m/s] and the largest displacement of the head [m] that are used."""
        self.travel.limits = Limits((travel_m_s,), (math.inf,))
        self.head_pose.limits = Limits((pose_m, pose_m, math.pi), (math.inf,) * 3)

    @property
    def other_sender(self) -> bool:
        """Whether another publisher than the one followed sends on the selected source."""
        return time.monotonic_ns() - self._other_heard_ns < _OTHER_SENDER_NS

    def silent(self) -> list[str]:
        """Return the optional inputs that have been heard and are silent now."""
        now_ns = time.monotonic_ns()
        return [topic for topic, heard_ns in self._heard_ns.items() if now_ns - heard_ns > _SILENT_NS]

    def take_queue_peak(self) -> tuple[int, float]:
        """Return the most messages that waited in the queue, and their longest wait [s], since the last call."""
        peak, self._queue_peak = self._queue_peak, (0, 0.0)
        return peak

    def look_for_senders(self) -> None:
        """Find out whether the followed publisher is still there."""
        if self._queue is not None:
            self.senders.alive(self._present())

    def residual(self, q: NDArray[Any]) -> tuple[float, float, float] | None:
        """Return model minus measured pose, or None without a measurement."""
        if self.measured is None:
            return None
        x, y, theta = (float(model) - data for model, data in zip(q, self.measured, strict=True))
        # a quaternion and its negative are the same turn
        return x, y, math.remainder(theta, 2.0 * math.pi)

    def close(self) -> None:
        """Take the subscriptions off the node."""
        if self._queue is not None:
            self._queue.close()
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _present(self) -> list[bytes]:
        """Return the publishers of the selected source that there are."""
        topic = self._node.resolve_topic_name(self._source)
        return [bytes(found.endpoint_gid) for found in self._node.get_publishers_info_by_topic(topic)]

    def _subscribe(
        self, kind: type, topic: str, callback: Callable[[Any], None], depth: int, *, raw: bool = False
    ) -> Subscription:
        events = SubscriptionEventCallbacks(
            message_lost=self._message_lost,
            incompatible_qos=lambda event: self._incompatible(topic, event),
            matched=lambda event: self._matched(topic, event),
        )
        subscription = self._node.create_subscription(
            kind,
            topic,
            callback,
            sensor_input(depth),
            event_callbacks=events,
            qos_overriding_options=OVERRIDABLE,
            raw=raw,
        )
        self._subscriptions.append(subscription)
        return subscription

    def _message_lost(self, event: Any) -> None:
        self.lost += event.total_count_change

    def _incompatible(self, topic: str, event: Any) -> None:
        self.refused_publishers += event.total_count_change
        self._node.get_logger().warning(
            f"{topic}: nothing is received from a publisher of incompatible quality of service "
            f"({event.last_policy_kind})"
        )

    def _matched(self, topic: str, event: Any) -> None:
        self.publishers[topic] = event.current_count
        if topic == self._source:
            self.look_for_senders()
        self._on_matched()

    def _taken(self, batch: list[Taken]) -> None:
        """Take in what has been in the queue of the selected source."""
        wait_s = (time.time_ns() - batch[0].received_ns) * 1e-9
        self._queue_peak = (max(self._queue_peak[0], len(batch)), max(self._queue_peak[1], wait_s))
        read = self._read_wrench if self._source == "excitation" else self._read_tool_forces
        arrived: list[Arrival] = []
        for message in batch:
            if not self.senders.hear(message.sender, message.number):
                self._foreign()
            elif not self.active:
                self._intake.refuse(Verdict.INACTIVE)
            else:
                arrival = read(message.data)
                if arrival is None:
                    self._intake.refuse(Verdict.MALFORMED)
                else:
                    arrived.append(arrival)
        if arrived:
            self._on_samples(arrived)

    def _foreign(self) -> None:
        """Take note of a sample that another publisher than the one followed has sent."""
        if not self.other_sender:
            self.look_for_senders()
        self._other_heard_ns = time.monotonic_ns()

    def _read_wrench(self, data: bytes) -> Arrival | None:
        found = read_wrench(data)
        if found is None:
            return None
        stamp, wrench, out_of_plane = found
        self._intake.out_of_plane += out_of_plane
        return stamp, wrench

    def _read_tool_forces(self, data: bytes) -> Arrival | None:
        message = deserialize_message(data, JointState)
        wrench = self._tool_forces.wrench(message)
        return None if wrench is None else (stamp_ns(message.header), wrench)

    def _not_selected(self, message: Any) -> None:
        self._intake.refuse(Verdict.NOT_SELECTED)

    def _travel_speed(self, message: TwistStamped) -> None:
        speed, stamp = message.twist.linear.z, stamp_ns(message.header)
        if not self.active:
            self.travel.refuse(Verdict.INACTIVE)
        elif self.travel.judge(stamp, (speed,)).used:
            self._heard_ns["travel"] = time.monotonic_ns()
            self._on_travel(stamp, speed)

    def _measured_pose(self, message: PoseStamped) -> None:
        position, turn = message.pose.position, message.pose.orientation
        theta = 2.0 * math.atan2(turn.z, turn.w)
        values = (position.x, position.y, theta)
        if not self.active:
            self.head_pose.refuse(Verdict.INACTIVE)
            return
        stamp = stamp_ns(message.header)
        verdict = self.head_pose.judge(stamp, values, history=self._poses)
        if not verdict.used:
            return
        self._heard_ns["head_pose"] = time.monotonic_ns()
        if verdict is not Verdict.WORKED_IN:
            self.measured = values
        if self._on_pose is not None and self._poses is not None:
            if verdict.resets:
                self._poses.clear()
            self._poses.add(stamp)
            self._on_pose(stamp, values)
