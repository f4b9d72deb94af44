"""Quality of service: of the outputs as in their table, of the inputs with overrides by parameters."""

from __future__ import annotations

from typing import Final

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from plow_twin.stream.topics import TOPICS, Topic

#: Policies that parameters `qos_overrides.<topic>.subscription.<policy>` may override.
OVERRIDABLE: Final = QoSOverridingOptions(
    policy_kinds=(QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
)


def sensor_input(depth: int) -> QoSProfile:
    """Return a profile that connects to reliable and best-effort publishers, with room for a burst."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def offered(topic: Topic) -> QoSProfile:
    """Return the quality of service of an output: it is reliable; depth and durability come from its `Topic`."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


#: Profile of each output by its base name.
OUTPUTS: Final = {topic.name: offered(topic) for topic in TOPICS}
DIAGNOSTICS: Final = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE)
