"""Subscribe to the inputs of a node, and pass the numbers in the messages to the runtime."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped, WrenchStamped
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from plow_twin.errors import ArgumentError
from plow_twin.live.publishing import Front
from plow_twin.live.runtime import Runtime
from plow_twin.live.tool_forces import ToolForces
from plow_twin.model.geometry import angle_of
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.ros.connections import Connections
from plow_twin.ros.input_loop import InputLoop, Turns
from plow_twin.ros.input_queue import InputQueue, Received
from plow_twin.ros.messages import UNREADABLE, Read, deviations, read_wrench, stamp_ns
from plow_twin.ros.qos import EXPECTED, OVERRIDABLE, sensor_input
from plow_twin.stream.driver import Arrival
from plow_twin.stream.intake import Intake, Verdict

#: Depth of the queues of the optional inputs.
_SLOW_DEPTH: Final = 200
#: Largest number of publishers whose names and sequence numbers are stored.
_MOST_PUBLISHERS: Final = 256
#: Number of samples from which the rate of a publisher is estimated.
_RATE_KNOWN: Final = 20
_PAIR_NUMBERS: Final = {name: number for number, name in enumerate(PAIR_NAMES)}


class Subscriptions:
    """All subscriptions of a configured node. Inputs in `elsewhere` have no subscription."""

    def __init__(
        self, node: Node, runtime: Runtime, front: Front, loop: InputLoop, turns: Turns, elsewhere: Collection[str]
    ) -> None:
        self._elsewhere = elsewhere
        self._node, self._runtime, self._front, self._loop, self._turns = node, runtime, front, loop, turns
        self._inputs, self._intake = runtime.inputs, runtime.driver.intake
        self._connections = Connections(node)
        self._taken_from: dict[str, Subscription] = {}
        self._queues: dict[str, InputQueue] = {}
        #: publishers of each input at the last lookup
        self._publishers: dict[str, list[bytes]] = {}
        self._tool_forces = ToolForces(runtime.scene)
        self._source, depth = runtime.settings.excitation_source, self._inputs.depth
        self._names: dict[tuple[str, bytes], str] = {}
        #: next expected sequence number, by topic and publisher
        self._following: dict[tuple[str, bytes], int] = {}
        self._since_ns = time.time_ns()  # time of the subscription to the load
        #: first message of each publisher that appeared after the subscription, and number of messages lost before it
        self._appeared: dict[bytes, tuple[Received, int]] = {}
        self._before: frozenset[bytes] = frozenset()
        with_covariance = runtime.settings.head_pose_type == "pose_with_covariance"
        self._pose = PoseWithCovarianceStamped if with_covariance else PoseStamped
        self._subscribe(WrenchStamped, "excitation", depth)
        self._subscribe(JointState, "tool_forces", depth)
        self._subscribe(TwistStamped, "travel", _SLOW_DEPTH)
        self._subscribe(self._pose, "head_pose", _SLOW_DEPTH)
        self._subscribe(JointState, "gaps", _SLOW_DEPTH)

    def look(self) -> None:
        """Update the publishers of all inputs. The lock is not held during the lookup, so that samples do not wait."""
        found = {topic: self._connections.publishers(subscription) for topic, subscription in self._taken_from.items()}
        present = {topic: self._noted(topic, publishers) for topic, (publishers, _) in found.items()}
        refused = sum(count for _, count in found.values())
        if present == self._publishers and not refused:
            return
        self._publishers = present
        with self._turns:
            self._inputs.refused_publishers += refused
            self._inputs.publishers |= {topic: len(publishers) for topic, publishers in present.items()}
            for topic in present:
                # messages of a new publisher may have arrived since the lookup
                self.look_for_senders(topic)
        self._front.changed()

    def look_for_senders(self, topic: str) -> None:
        """Check whether the followed publisher of an input still exists."""
        if topic in self._elsewhere:
            return
        if topic == self._source:
            self._inputs.senders.alive(self._present(topic))
        elif topic in self._inputs.optional:
            self._inputs.optional[topic].alive(self._present(topic))

    def _present(self, topic: str) -> list[bytes]:
        return self._noted(topic, self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic)))

    def _noted(self, topic: str, publishers: list[Any]) -> list[bytes]:
        present = [bytes(publisher.endpoint_gid) for publisher in publishers]
        for gid, publisher in zip(present, publishers, strict=True):
            space = publisher.node_namespace.rstrip("/")
            if (topic, gid) not in self._names and len(self._names) >= _MOST_PUBLISHERS:
                self._names.pop(next(iter(self._names)))
            self._names[topic, gid] = f"{space}/{publisher.node_name} {gid.hex()}"
        return present

    def name_of(self, topic: str, sender: bytes) -> str:
        """Return the node name and the identifier of a publisher, or only the identifier if the name is unknown."""
        if topic in self._elsewhere:
            return sender.decode(errors="replace")
        if (topic, sender) not in self._names:
            self._present(topic)
        return self._names.get((topic, sender), sender.hex())

    def _subscribe(self, kind: type, topic: str, depth: int) -> None:
        if topic in self._elsewhere:
            return
        try:
            subscription = self._node.create_subscription(
                kind,
                topic,
                lambda message: None,  # the input queue delivers the messages
                sensor_input(depth),
                qos_overriding_options=OVERRIDABLE,
                raw=True,
            )
        except (RuntimeError, TypeError, ParameterException) as error:
            prefix = f"qos_overrides.{self._node.resolve_topic_name(topic)}.subscription"
            names = self._node.get_parameters_by_prefix(prefix)
            policies = {name: self._node.get_parameter(f"{prefix}.{name}").value for name in names}
            raise ArgumentError(f"{prefix}: got {policies}, expected {EXPECTED} ({error})") from error
        if topic == self._source:
            self._since_ns, self._before = time.time_ns(), frozenset(self._present(topic))
            self._inputs.senders.start(self._before)
        self._taken_from[topic] = subscription
        self._queues[topic] = queue = InputQueue(self._node, subscription)
        self._loop.add(queue, self, topic)

    def receive(self, topic: str, batch: list[Received]) -> None:
        """Count the gaps in the sequence numbers of a batch, and process its messages."""
        inputs, following = self._inputs, self._following
        for message in batch:
            key, number = (topic, message.sender), message.number
            expected = following.get(key)
            if expected == number:
                following[key] = number + 1
                continue
            if expected is None:
                expected = number
                if topic == self._source and number > 1 and message.sender not in self._before:
                    inputs.senders.start_late(message.sender)
                    self._appeared[message.sender] = message, 0
                if len(following) >= _MOST_PUBLISHERS:
                    following.pop(next(iter(following)))
            if number != expected:
                missed = number - expected if number > expected else -1
                inputs.lost = max(0, inputs.lost + missed)
                if topic != self._source:
                    inputs.unused.note_lost(topic, message.sender, missed)
            following[key] = max(expected, number + 1)
        if topic == self._source:
            self._samples(topic, batch)
            if self._appeared:
                self._count_before_first(batch)
        elif topic == "travel":
            self._travel_speeds(batch)
        elif topic == "head_pose":
            self._measured_poses(batch)
        elif topic == "gaps":
            self._measured_gaps(batch)
        else:
            self._not_selected(topic, batch)

    def _count_before_first(self, batch: list[Received]) -> None:
        """Count the lost messages of a publisher before its first received message.

        A publisher that is new to the node may have started before the subscription. Its start is estimated from its
        rate, and no message is counted if the start is before the subscription.
        """
        newest = {message.sender: message for message in batch}
        for sender, (first, counted) in list(self._appeared.items()):
            last = newest.get(sender, first)
            span_of_numbers, missed = last.number - first.number, first.number - 1
            if span_of_numbers <= 0:
                continue
            sending_ns = missed * (last.sent_ns - first.sent_ns) / span_of_numbers
            lost = missed if sending_ns <= first.received_ns - self._since_ns else 0
            if lost != counted and self._inputs.lost_at_first(sender, lost - counted):
                self._appeared[sender] = first, lost
            if span_of_numbers >= _RATE_KNOWN:
                del self._appeared[sender]

    def _samples(self, topic: str, batch: list[Received]) -> None:
        inputs = self._inputs
        inputs.waited(len(batch) + self._queues[topic].waiting, (time.time_ns() - batch[0].received_ns) * 1e-9)
        arrived: list[Arrival] = []
        followed = inputs.senders.followed
        for message in batch:
            stamp, values, fits, out_of_plane = self._read(topic, message.data)
            is_used = inputs.wanted(message.sender, message.number, stamp, values, fits)
            if inputs.senders.followed != followed:
                # the samples in `arrived` are from the previously followed publisher
                self._step(arrived)
                arrived, followed = [], inputs.senders.followed
            if is_used:
                self._intake.out_of_plane += out_of_plane
                fx, fy, moment = values
                arrived.append((stamp, (fx, fy, moment)))
        self._step(arrived)

    def _step(self, arrived: list[Arrival]) -> None:
        if arrived:
            for topic, message in self._runtime.step(arrived):
                self._front.send(topic, message)

    def _not_selected(self, topic: str, batch: list[Received]) -> None:
        for message in batch:
            stamp, values, _, _ = self._read(topic, message.data)
            self._inputs.arriving = (topic, message.sender)
            self._intake.refuse(Verdict.NOT_SELECTED, stamp, values)

    def _read(self, topic: str, data: bytes) -> Read:
        return read_wrench(data) if topic == "excitation" else self._read_tool_forces(data)

    def _read_tool_forces(self, data: bytes) -> Read:
        message = _message(data, JointState)
        if message is None:
            return UNREADABLE
        wrench = self._tool_forces.wrench(message.name, message.effort)
        values = tuple(message.effort) if wrench is None else wrench
        return stamp_ns(message.header), values, wrench is not None, False

    def _travel_speeds(self, batch: list[Received]) -> None:
        for message in self._messages("travel", TwistStamped, self._inputs.travel, batch):
            self._runtime.add_travel(stamp_ns(message.header), message.twist.linear.z)

    def _measured_gaps(self, batch: list[Received]) -> None:
        for message in self._messages("gaps", JointState, self._inputs.gaps, batch):
            named, stamp = set(message.name), stamp_ns(message.header)
            if len(message.position) == len(message.name) == len(named) and named <= _PAIR_NUMBERS.keys():
                gaps = {_PAIR_NUMBERS[name]: gap for name, gap in zip(message.name, message.position, strict=True)}
                self._runtime.add_gaps(stamp, gaps)
            else:
                self._inputs.gaps.refuse(Verdict.MALFORMED, stamp, tuple(message.position))

    def _measured_poses(self, batch: list[Received]) -> None:
        for message in self._messages("head_pose", self._pose, self._inputs.head_pose, batch):
            with_covariance = self._pose is PoseWithCovarianceStamped
            pose = message.pose.pose if with_covariance else message.pose
            turn, stamp = pose.orientation, stamp_ns(message.header)
            # z and w are zero if the sender has not set the orientation, or for half a turn about x or y
            if turn.z == turn.w == 0.0:
                self._inputs.head_pose.refuse(Verdict.MALFORMED, stamp, (pose.position.x, pose.position.y))
                continue
            self._intake.out_of_plane += turn.x != 0.0 or turn.y != 0.0
            theta = float(angle_of(turn.z, turn.w))
            deviation = deviations(message.pose.covariance) if with_covariance else ()
            self._runtime.add_pose(stamp, (pose.position.x, pose.position.y, theta), deviation)

    def _messages(self, topic: str, kind: type, intake: Intake, batch: list[Received]) -> Iterator[Any]:
        for received in batch:
            self._inputs.arriving = (topic, received.sender)
            message = _message(received.data, kind)
            if message is None:
                intake.refuse(Verdict.MALFORMED)
            else:
                yield message


def _message(data: bytes, kind: type) -> Any | None:
    try:
        return deserialize_message(data, kind)
    except (RuntimeError, UnicodeDecodeError):
        return None
