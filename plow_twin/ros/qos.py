"""Quality of service of the topics."""

from __future__ import annotations

from typing import Final

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from plow_twin.stream.topics import TOPICS, Topic

#: Policies of inputs that the parameters `qos_overrides.<topic>.subscription.<policy>` can change.
OVERRIDABLE: Final = QoSOverridingOptions(
    policy_kinds=(QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
)
#: Values of these policies.
EXPECTED: Final = "history keep_last or keep_all, depth 0 .. 2147483647, reliability reliable or best_effort"


def sensor_input(depth: int) -> QoSProfile:
    """Return a best-effort profile, which can connect to reliable and to best-effort publishers."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def offered(topic: Topic) -> QoSProfile:
    """Return the reliable profile of an output topic."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


OUTPUTS: Final = {topic.name: offered(topic) for topic in TOPICS}
DIAGNOSTICS: Final = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE)
