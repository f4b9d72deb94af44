"""The outputs of a publication on ROS topics: the same plain messages that a recording holds, copied field by field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from plow_twin.live.runtime import QUALITY
from plow_twin.record import messages as plain
from plow_twin.record.outputs import PUBLICATION_TOPICS
from plow_twin.ros.messages import JointStateWriter, OdometryWriter
from plow_twin.ros.qos import KEPT_OUTPUT, OUTPUT

#: Output topics that follow from the motion, with their types.
TOPICS: Final[dict[str, type]] = {
    topic: Odometry if topic == "head_state" else JointState for topic in (*PUBLICATION_TOPICS, QUALITY)
}


class OutputPublishers:
    """Publishers of all outputs of a publication; their messages are written over."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers = {
            # sent on change only: a late reader gets those of before
            topic: node.create_publisher(kind, topic, KEPT_OUTPUT if topic == QUALITY else OUTPUT)
            for topic, kind in TOPICS.items()
        }
        self._writers: dict[str, JointStateWriter | OdometryWriter] = {}

    def publish(self, messages: Mapping[str, plain.Message], forces_sent: Callable[[], None]) -> None:
        """Publish the messages of a publication in their order; `forces_sent` is called right after the forces."""
        for topic, message in messages.items():
            writer: Any = self._writers.get(topic)
            if writer is None:
                kind = OdometryWriter if isinstance(message, plain.Odometry) else JointStateWriter
                writer = self._writers[topic] = kind(message)  # type: ignore[arg-type]
            self._publishers[topic].publish(writer.write(message))
            if topic == "contact_forces":
                forces_sent()

    def close(self) -> None:
        """Take the publishers off the node."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
