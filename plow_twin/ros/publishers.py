"""The outputs of a publication as ROS messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.ros.messages import JointStateWriter, OdometryWriter
from plow_twin.ros.qos import OUTPUT
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES, Publication

#: Output topics that follow from the motion, with their types.
TOPICS: Final[dict[str, type]] = {
    "contact_forces": JointState,
    "contact_peaks": JointState,
    "head_state": Odometry,
    "clearance": JointState,
    "wear_rate": JointState,
}


class OutputPublishers:
    """Publishers of all outputs of a publication; their messages are written over."""

    def __init__(self, node: Node, frame_id: str, child_frame_id: str) -> None:
        self._node = node
        self._publishers = {topic: node.create_publisher(kind, topic, OUTPUT) for topic, kind in TOPICS.items()}
        self._forces = JointStateWriter(frame_id, PAIR_NAMES)
        self._peaks = JointStateWriter(frame_id, PAIR_NAMES)
        self._head = OdometryWriter(frame_id, child_frame_id)
        self._clearance = JointStateWriter(frame_id, CLEARANCE_NAMES, ("position",))
        self._wear_rate = JointStateWriter(frame_id, PAD_NAMES, ("velocity",))
        self.published = 0

    def publish(self, publication: Publication, forces_sent: Callable[[], None]) -> None:
        """Send a publication, the forces first; `forces_sent` is called right after them."""
        stamp = publication.stamp_ns
        self._send(
            "contact_forces", self._forces.write(stamp, publication.penetration, publication.rate, publication.force)
        )
        forces_sent()
        self._send("contact_peaks", self._peaks.write(stamp, publication.makes, publication.impulse, publication.peak))
        self._send("head_state", self._head.write(publication))
        if publication.slow is not None:
            self._send("clearance", self._clearance.write(stamp, publication.slow.clearance))
            self._send("wear_rate", self._wear_rate.write(stamp, publication.slow.wear_rate))
        self.published += 1

    def close(self) -> None:
        """Take the publishers off the node."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)
