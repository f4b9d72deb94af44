"""The outputs of a publication on ROS topics: the same bytes that a recording holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from nav_msgs.msg import Odometry as RosOdometry
from rclpy.node import Node
from sensor_msgs.msg import JointState as RosJointState

from plow_twin.live.runtime import QUALITY
from plow_twin.record.messages import JointState, Message, Odometry
from plow_twin.record.outputs import PUBLICATION_TOPICS, publication_templates, quality_template
from plow_twin.ros.messages import Serializer
from plow_twin.ros.qos import KEPT_OUTPUT, OUTPUT

#: Output topics that follow from the motion, with their types.
TOPICS: Final[dict[str, type]] = {
    topic: RosOdometry if topic == "head_state" else RosJointState for topic in (*PUBLICATION_TOPICS, QUALITY)
}


class OutputPublishers:
    """Publishers of all outputs of a publication."""

    def __init__(self, node: Node, frame_id: str, child_frame_id: str) -> None:
        self._node = node
        self._publishers = {
            # sent on change only: a late reader gets those of before
            topic: node.create_publisher(kind, topic, KEPT_OUTPUT if topic == QUALITY else OUTPUT)
            for topic, kind in TOPICS.items()
        }
        templates = publication_templates(frame_id, child_frame_id) | {QUALITY: quality_template(frame_id)}
        self._serializers = {topic: Serializer(template) for topic, template in templates.items()}

    def publish(self, messages: Mapping[str, Message], forces_sent: Callable[[], None]) -> None:
        """Publish the messages of a publication in their order; `forces_sent` is called right after the forces."""
        for topic, message in messages.items():
            assert isinstance(message, JointState | Odometry)
            self._publishers[topic].publish(self._serializers[topic].write(message))
            if topic == "contact_forces":
                forces_sent()

    def close(self) -> None:
        """Take the publishers off the node."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
