"""The subscriptions: from messages to calls with plain numbers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from plow_twin.live.runtime import Runtime
from plow_twin.live.tool_forces import ToolForces
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.ros.input_queue import InputQueue, Taken
from plow_twin.ros.messages import read_wrench, stamp_ns
from plow_twin.ros.qos import OVERRIDABLE, sensor_input
from plow_twin.stream.driver import Arrival
from plow_twin.stream.intake import Verdict

#: Depth of the optional inputs' queues.
_SLOW_DEPTH = 200


class Subscriptions:
    """All subscriptions of a configured node.

    Parameters
    ----------
    node
        The node.
    runtime
        Where samples go.
    on_matched
        Called when the number of publishers of an input has changed.
    """

    def __init__(self, node: Node, runtime: Runtime, on_matched: Callable[[], None]) -> None:
        self._node = node
        self._inputs, self._intake = runtime.inputs, runtime.driver.intake
        self._inputs.look_for_senders = self.look_for_senders
        self._on_samples = runtime.samples
        self._on_matched = on_matched
        self._tool_forces = ToolForces(runtime.scene)
        self._source, depth = runtime.source, self._inputs.depth
        self._subscriptions: list[Any] = []
        self._queue: InputQueue | None = None
        try:
            for topic, kind in (("excitation", WrenchStamped), ("tool_forces", JointState)):
                subscription = self._subscribe(kind, topic, self._not_selected, depth, raw=True)
                if topic == self._source:
                    self._inputs.senders.start(self._present())
                    self._subscriptions.remove(subscription)
                    self._queue = InputQueue(node, subscription, depth, self._taken)
            self._subscribe(TwistStamped, "travel", self._travel_speed, _SLOW_DEPTH)
            self._subscribe(PoseStamped, "head_pose", self._measured_pose, _SLOW_DEPTH)
            self._subscribe(JointState, "gaps", self._measured_gaps, _SLOW_DEPTH)
        except BaseException:  # an override of the quality of service may be wrong for any of them
            self.close()
            raise

    def look_for_senders(self) -> None:
        """Find out whether the followed publisher is still there."""
        if self._queue is not None:
            self._inputs.senders.alive(self._present())

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
        self._inputs.lost += event.total_count_change

    def _incompatible(self, topic: str, event: Any) -> None:
        self._inputs.refused_publishers += event.total_count_change
        self._node.get_logger().warning(
            f"{topic}: nothing is received from a publisher of incompatible quality of service "
            f"({event.last_policy_kind})"
        )

    def _matched(self, topic: str, event: Any) -> None:
        self._inputs.publishers[topic] = event.current_count
        if topic == self._source:
            self.look_for_senders()
        self._on_matched()

    def _taken(self, batch: list[Taken]) -> None:
        """Take in what has been in the queue of the selected source."""
        self._inputs.waited(len(batch), (time.time_ns() - batch[0].received_ns) * 1e-9)
        read = self._read_wrench if self._source == "excitation" else self._read_tool_forces
        arrived: list[Arrival] = []
        for message in batch:
            if not self._inputs.wanted(message.sender, message.number):
                continue
            arrival = read(message.data)
            if arrival is None:
                self._intake.refuse(Verdict.MALFORMED)
            else:
                arrived.append(arrival)
        if arrived:
            self._on_samples(arrived)

    def _read_wrench(self, data: bytes) -> Arrival | None:
        found = read_wrench(data)
        if found is None:
            return None
        stamp, wrench, out_of_plane = found
        self._intake.out_of_plane += out_of_plane
        return stamp, wrench

    def _read_tool_forces(self, data: bytes) -> Arrival | None:
        message = deserialize_message(data, JointState)
        wrench = self._tool_forces.wrench(message.name, message.effort)
        return None if wrench is None else (stamp_ns(message.header), wrench)

    def _not_selected(self, message: Any) -> None:
        self._intake.refuse(Verdict.NOT_SELECTED)

    def _travel_speed(self, message: TwistStamped) -> None:
        self._inputs.take_travel(stamp_ns(message.header), message.twist.linear.z)

    def _measured_gaps(self, message: JointState) -> None:
        numbers = {name: number for number, name in enumerate(PAIR_NAMES)}
        named = set(message.name)
        if len(message.position) != len(message.name) or len(named) != len(message.name) or not named <= numbers.keys():
            self._inputs.gaps.refuse(Verdict.MALFORMED)
            return
        gaps = {numbers[name]: gap for name, gap in zip(message.name, message.position, strict=True)}
        self._inputs.take_gaps(stamp_ns(message.header), gaps)

    def _measured_pose(self, message: PoseStamped) -> None:
        position, turn = message.pose.position, message.pose.orientation
        theta = 2.0 * math.atan2(turn.z, turn.w)
        self._inputs.take_pose(stamp_ns(message.header), (position.x, position.y, theta))
