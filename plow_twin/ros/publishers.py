"""The outputs of a publication on ROS topics: the same bytes that a recording holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from nav_msgs.msg import Odometry as RosOdometry
from rclpy.node import Node
from sensor_msgs.msg import JointState as RosJointState

from plow_twin.live.publishing import QUALITY
from plow_twin.record.messages import JointState
from plow_twin.record.sending import PublicationBytes
from plow_twin.ros.messages import ros_joint_state
from plow_twin.ros.qos import OUTPUTS
from plow_twin.ros.rcl import Sender
from plow_twin.stream.outputs import Publication
from plow_twin.stream.topics import JOINT_STATE, ODOMETRY, Cadence, topics_of

_CLASSES: Final[dict[str, type]] = {JOINT_STATE: RosJointState, ODOMETRY: RosOdometry}
#: Topics of a publication, with the classes of their messages.
PUBLISHED: Final = {topic.name: _CLASSES[topic.type] for topic in topics_of(Cadence.EACH, Cadence.SLOW, Cadence.MARKED)}


class OutputPublishers:
    """Publishers of all outputs of a publication.

    Parameters
    ----------
    node
        The node.
    frame_id, child_frame_id
        Frames named in the messages.
    kept
        Whether the bytes sent are wanted: for a recording.
    """

    def __init__(self, node: Node, frame_id: str, child_frame_id: str, *, kept: bool) -> None:
        self._node = node
        self._publishers = {
            topic: node.create_publisher(kind, topic, OUTPUTS[topic]) for topic, kind in PUBLISHED.items()
        }
        self._bytes, self._kept = PublicationBytes(frame_id, child_frame_id), kept
        self._senders = [Sender(self._publishers[topic], part) for topic, part in self._bytes.parts]

    def publish(self, publication: Publication, forces_sent: Callable[[], None]) -> dict[str, bytes] | None:
        """Publish the messages of a publication, forces first; `forces_sent` is called right after them.

        Returns their bytes where they are to be kept; None, and nothing is published, when a number is not finite.
        """
        if not self._bytes.fill(publication):
            return None
        forces, peaks, head = self._senders
        forces.send()
        forces_sent()
        peaks.send()
        head.send()
        found = self._bytes.taken() if self._kept else {}
        if publication.slow is not None:
            slow = self._bytes.slow(publication)
            for topic, data in slow.items():
                self._publishers[topic].publish(data)
            found |= slow
        return found

    def publish_quality(self, marks: JointState) -> None:
        """Publish the marks of a publication."""
        self._publishers[QUALITY].publish(ros_joint_state(marks))

    def close(self) -> None:
        """Take the publishers off the node."""
        self._senders.clear()
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
