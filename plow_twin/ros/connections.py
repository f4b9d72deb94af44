"""Look up the publishers and subscribers on the topics of a node in the ROS graph.

The lookup replaces the events of the middleware, which can cause a deadlock in rmw_fastrtps (ros2/rmw_fastrtps#890).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.duration import Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import LivelinessPolicy, QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.service import Service
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

LOOK_S: Final = 0.2
#: Name of a node whose topics have been announced before its name, because rmw_dds_common announces them separately.
_UNNAMED: Final = "_NODE_NAME_UNKNOWN_"
#: Shortest interval between two error messages about `/clock` [s].
_ERRORS_APART_S: Final = 5.0
_TYPES: Final = frozenset(kind.value for kind in Parameter.Type)


class WithoutEvents(Node):
    """Node that uses no events of the middleware, not even for the topics that rclpy creates.

    The node refuses negative times on `/clock` and parameters that rclpy cannot read, which would end the program.
    """

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any) -> Service:
        """Create a service as rclpy does, but check requests to set parameters."""
        if srv_type in (SetParameters, SetParametersAtomically):
            callback = partial(_set_parameters, callback)
        return super().create_service(srv_type, srv_name, callback, **options)

    def create_publisher(self, *arguments: Any, **options: Any) -> Publisher:
        """Create a publisher as rclpy does, but without events."""
        events = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(*arguments, **{"event_callbacks": events, **options})

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[Any], None], *arguments: Any, **options: Any
    ) -> Subscription:
        """Create a subscription like rclpy, but without events. Times on `/clock` are checked first."""
        if msg_type is Clock:
            callback = partial(self._take_clock, callback)
        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        return super().create_subscription(
            msg_type, topic, callback, *arguments, **{"event_callbacks": events, **options}
        )

    def _take_clock(self, take: Callable[[Clock], None], message: Clock) -> None:
        if message.clock.sec < 0:
            text = f"/clock: got {message.clock.sec} s, expected a time >= 0: the message is ignored"
            self.get_logger().error(text, throttle_duration_sec=_ERRORS_APART_S)
        else:
            take(message)


def _set_parameters(callback: Callable[..., Any], request: Any, response: Any) -> Any:
    """Answer a request to set parameters, or refuse it if rclpy cannot read it."""
    wrong = [
        f"{parameter.name}: got type {parameter.value.type}"
        for parameter in request.parameters
        if parameter.value.type not in _TYPES
    ]
    reason = f"{'; '.join(wrong)}; expected one of {min(_TYPES)} to {max(_TYPES)}"
    if not wrong:
        try:
            return callback(request, response)
        except (ValueError, TypeError, ParameterException) as error:
            reason = str(error)
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "results"):
        response.results = [refused] * len(request.parameters)
    else:
        response.result = refused
    return response


class Connections:
    """Lookup of the publishers and subscribers on the topics of a node.

    Each publisher or subscriber that cannot connect to the node is reported once.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._said: set[tuple[str, bytes]] = set()
        self._unnamed: set[tuple[str, bytes]] = set()

    def publishers(self, subscription: Subscription) -> tuple[list[Any], int]:
        """Return the publishers that can connect to a subscription, and the number of new incompatible publishers."""
        topic, found = subscription.topic_name, []
        kind, refused = type_name(subscription.msg_type), 0
        for publisher in self._node.get_publishers_info_by_topic(topic):
            reason = _reason(publisher, kind, publisher.qos_profile, _in_full(subscription.qos_profile))
            if not reason:
                found.append(publisher)
            elif self._say(topic, publisher, f"nothing is received from the publisher {publisher.node_name}: {reason}"):
                refused += 1
        return found, refused

    def look_for_subscribers(self, publishers: Iterable[Publisher]) -> None:
        """Report the subscribers that cannot connect to the publishers of this node."""
        for publisher in publishers:
            topic, kind = publisher.topic_name, type_name(publisher.msg_type)
            for subscriber in self._node.get_subscriptions_info_by_topic(topic):
                reason = _reason(subscriber, kind, _in_full(publisher.qos_profile), subscriber.qos_profile)
                if reason:
                    self._say(topic, subscriber, f"nothing is sent to the subscriber {subscriber.node_name}: {reason}")

    def _say(self, topic: str, other: Any, text: str) -> bool:
        key = (topic, bytes(other.endpoint_gid))
        if key in self._said:
            return False
        if other.node_name == _UNNAMED and key not in self._unnamed:
            self._unnamed.add(key)  # the name may have been announced at the next lookup
            return False
        self._said.add(key)
        self._node.get_logger().warning(f"{topic}: {text}")
        return True


def type_name(message_class: Any) -> str:
    """Return the name of a message type in the form of the ROS graph."""
    package, folder = message_class.__module__.split(".")[:2]
    return f"{package}/{folder}/{message_class.__name__}"


def _in_full(own: QoSProfile) -> QoSProfile:
    """Return a profile of this node in which explicit values replace the defaults, as in the ROS graph."""
    return QoSProfile(
        depth=own.depth,
        reliability=own.reliability,
        durability=own.durability,
        deadline=Infinite,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Infinite,
    )


def _reason(other: Any, kind: str, offered: Any, requested: Any) -> str:
    if other.topic_type != kind:
        return f"type: got {other.topic_type}, expected {kind}"
    compatibility, reason = qos_check_compatible(offered, requested)
    return f"incompatible quality of service: {reason}" if compatibility == QoSCompatibility.ERROR else ""
