"""The subscriptions: from messages to calls with plain numbers; optional inputs are checked and counted here."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import JointState

from plow_twin.model.scene import Scene
from plow_twin.ros.messages import ToolForces, Wrench, planar_wrench, stamp_ns
from plow_twin.ros.qos import OVERRIDABLE, sensor_input
from plow_twin.stream.intake import Intake, Verdict

#: Depth of the optional inputs' queues.
_SLOW_DEPTH = 200
#: The input topics.
TOPICS: Final = ("excitation", "tool_forces", "travel", "head_pose")


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
    on_sample
        Receives stamp [ns] and wrench of each sample from the selected source.
    on_travel
        Receives stamp [ns] and speed along the face [m/s].
    on_matched
        Called when the number of publishers of an input has changed.
    """

    def __init__(
        self,
        node: Node,
        scene: Scene,
        source: str,
        depth: int,
        intake: Intake,
        on_sample: Callable[[int, Wrench], None],
        on_travel: Callable[[int, float], None],
        on_matched: Callable[[], None],
    ) -> None:
        self._node = node
        self._intake = intake
        self._on_sample = on_sample
        self._on_travel = on_travel
        self._on_matched = on_matched
        self._tool_forces = ToolForces(scene)
        self.active = False
        #: messages that the middleware reports as lost before they could be read
        self.lost = 0
        self.travel = Intake()
        self.head_pose = Intake()
        #: newest measured pose x, y [m], theta [rad]
        self.measured: tuple[float, float, float] | None = None
        self.refused_publishers = 0
        #: publishers that each input is connected to
        self.publishers = dict.fromkeys(TOPICS, 0)
        excitation = self._excitation if source == "excitation" else self._not_selected
        tool_forces = self._tool_force_sample if source == "tool_forces" else self._not_selected
        self._subscriptions: list[Any] = []
        try:
            self._subscribe(WrenchStamped, "excitation", excitation, depth)
            self._subscribe(JointState, "tool_forces", tool_forces, depth)
            self._subscribe(TwistStamped, "travel", self._travel_speed, _SLOW_DEPTH)
            self._subscribe(PoseStamped, "head_pose", self._measured_pose, _SLOW_DEPTH)
        except BaseException:  # an override of the quality of service may be wrong for any of them
            self.close()
            raise

    def residual(self, q: NDArray[Any]) -> tuple[float, float, float] | None:
        """Return model minus measured pose, or None without a measurement."""
        if self.measured is None:
            return None
        x, y, theta = (float(model) - data for model, data in zip(q, self.measured, strict=True))
        # a quaternion and its negative are the same turn
        return x, y, math.remainder(theta, 2.0 * math.pi)

    def close(self) -> None:
        """Take the subscriptions off the node."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], depth: int) -> None:
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
        )
        self._subscriptions.append(subscription)

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
        self._on_matched()

    def _excitation(self, message: WrenchStamped) -> None:
        if not self.active:
            self._intake.refuse(Verdict.INACTIVE)
            return
        wrench, out_of_plane = planar_wrench(message)
        self._intake.out_of_plane += out_of_plane
        self._on_sample(stamp_ns(message.header), wrench)

    def _tool_force_sample(self, message: JointState) -> None:
        if not self.active:
            self._intake.refuse(Verdict.INACTIVE)
            return
        wrench = self._tool_forces.wrench(message)
        if wrench is None:
            self._intake.refuse(Verdict.MALFORMED)
        else:
            self._on_sample(stamp_ns(message.header), wrench)

    def _not_selected(self, message: Any) -> None:
        self._intake.refuse(Verdict.NOT_SELECTED)

    def _travel_speed(self, message: TwistStamped) -> None:
        speed, stamp = message.twist.linear.z, stamp_ns(message.header)
        if not self.active:
            self.travel.refuse(Verdict.INACTIVE)
        elif self.travel.judge(stamp, (speed,)).used:
            self._on_travel(stamp, speed)

    def _measured_pose(self, message: PoseStamped) -> None:
        position, turn = message.pose.position, message.pose.orientation
        theta = 2.0 * math.atan2(turn.z, turn.w)
        values = (position.x, position.y, theta)
        if not self.active:
            self.head_pose.refuse(Verdict.INACTIVE)
        elif self.head_pose.judge(stamp_ns(message.header), values).used:
            self.measured = values
