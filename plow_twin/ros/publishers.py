"""Publish the outputs on ROS topics. A message has the same bytes as in a recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import JointState

from plow_twin.record.cdr import encode
from plow_twin.record.messages import Message
from plow_twin.ros.qos import OUTPUTS
from plow_twin.ros.rcl import Sender
from plow_twin.stream.topics import JOINT_STATE, ODOMETRY, STATUS, TOPICS

CLASSES: Final[dict[str, type]] = {JOINT_STATE: JointState, ODOMETRY: Odometry, STATUS: DiagnosticStatus}


class OutputPublishers:
    """Publishers of all outputs except the topics in `without`.

    `memory` contains the buffers of the messages that are sent after each sample, by base name of the topic.
    """

    def __init__(self, node: Node, without: Collection[str], memory: Mapping[str, memoryview]) -> None:
        self._node = node
        self._publishers: dict[str, Any] = {
            topic.name: node.create_publisher(CLASSES[topic.type], topic.name, OUTPUTS[topic.name])
            for topic in TOPICS
            if topic.name not in without
        }
        self._senders = {topic: Sender(self._publishers[topic], data) for topic, data in memory.items()}

    def send(self, topic: str, message: memoryview | Message) -> None:
        """Send a message. If `message` is the topic's buffer, its bytes are sent."""
        if isinstance(message, memoryview):
            self._senders[topic].send()
        else:
            self._publishers[topic].publish(encode(message))

    def close(self) -> None:
        """Destroy the publishers."""
        self._senders.clear()
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
