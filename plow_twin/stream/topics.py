"""The table of topics that a live twin publishes. The node, the recorder, the replay and the documentation use it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.solve.state import ROW
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES, SLOW, Published

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
STATUS: Final = "diagnostic_msgs/msg/DiagnosticStatus"
#: Depth of a publisher's history. At 1 kHz, a subscriber that reads once per second misses no message.
_DEPTH: Final = 1000


class Cadence(Enum):
    """When a message is sent."""

    EACH = "each publication"
    FOLLOWED = "each publication, with `follow: full`"
    SLOW = "every 0.1 s of stamps"
    #: with each marked publication, and with the first publication that is no longer marked
    MARKED = "marked publications"
    ESTIMATE = "each estimate"
    CHANGE = "on change"


@dataclass(frozen=True, eq=False)
class Topic:
    """Description of one topic."""

    #: base name, and ROS 2 message type
    name: str
    type: str
    #: when a message is sent
    cadence: Cadence
    #: content of a message, with units
    content: str
    #: whether a message depends on the previous publication; if it does, a replay cannot compare the topic after a lost
    #: message
    cumulative: bool = False
    #: whether a subscriber that joins late receives earlier messages (durability `transient_local`)
    latched: bool = False
    #: number of messages in the publisher's history
    depth: int = _DEPTH
    #: names in a `JointState`
    names: tuple[str, ...] = ()
    #: fields of the record that fill each field of the message, in order, as (name, count of numbers); empty if a
    #: record does not contain all data of the message
    columns: Mapping[str, tuple[tuple[str, int], ...]] = field(default_factory=dict)

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """Fields of the record as (name, count of numbers), in the order of the message."""
        return tuple(part for parts in self.columns.values() for part in parts)

    @property
    def count(self) -> int:
        """Count of numbers in the message that come from the record."""
        return sum(count for _, count in self.parts)

    def record_of(self, published: Published) -> NDArray[np.void]:
        """Return the records from which the messages of this topic are made."""
        return published.slow if self.cadence is Cadence.SLOW else published.rows

    @property
    def record_type(self) -> np.dtype[np.void]:
        """Type of the records that `record_of` returns."""
        return SLOW if self.cadence is Cadence.SLOW else ROW

    def numbers(self, records: NDArray[np.void]) -> list[NDArray[np.float64]]:
        """Return the numbers of messages, an array (n, count) for each of `parts`; floats are not copied."""
        columns = ((records[name], count) for name, count in self.parts)
        return [
            np.asarray(column[:, :count] if column.ndim > 1 else column[:, None], np.float64)
            for column, count in columns
        ]


_INTERVALS: Final = (*PAIR_NAMES, *(f"{name}/{point}" for point in ("p05", "p95") for name in PAIR_NAMES))

TOPICS: Final = (
    Topic(
        "contact_forces", JOINT_STATE, Cadence.EACH,
        "position = penetration [m] (negative: gap), velocity = its rate [m/s], effort = force [N], all at the stamp",
        names=PAIR_NAMES,
        columns={"position": (("penetration", 8),), "velocity": (("rate", 8),), "effort": (("force", 8),)},
    ),
    Topic(
        "contact_peaks", JOINT_STATE, Cadence.EACH,
        "position = touches since configure, velocity = impulse [N s] and effort = largest force [N] since the last "
        "message, or, after late samples, since the time to which the model went back",
        names=PAIR_NAMES,
        columns={"position": (("makes", 8),), "velocity": (("impulse", 8),), "effort": (("peak", 8),)},
        cumulative=True,
    ),
    Topic(
        "force_intervals", JOINT_STATE, Cadence.FOLLOWED,
        "effort = force [N] of `contact_forces` as `<pair>`, its 5 % and 95 % points as `<pair>/p05`, `<pair>/p95`",
        names=_INTERVALS, columns={"effort": (("force", 8), ("force_low", 8), ("force_high", 8))},
    ),
    Topic(
        "peak_intervals", JOINT_STATE, Cadence.FOLLOWED,
        "velocity = impulse [N s] and effort = largest force [N] of `contact_peaks`, with the same points",
        names=_INTERVALS,
        columns={
            "velocity": (("impulse", 8), ("impulse_low", 8), ("impulse_high", 8)),
            "effort": (("peak", 8), ("peak_low", 8), ("peak_high", 8)),
        },
        cumulative=True,
    ),
    Topic(
        "head_state", ODOMETRY, Cadence.EACH,
        "pose in `frame_id`, twist in the head's own axes; zero covariances mean that they are not known",
        columns={"position": (("q", 2),), "orientation": (("orientation", 2),), "twist": (("twist", 3),)},
    ),
    Topic(
        "clearance", JOINT_STATE, Cadence.SLOW,
        "position [m] of `horizontal`, `vertical`, then `pad_<pair>` (wear depth), then `<name>/p05`, `<name>/p95` of "
        "each",
        names=CLEARANCE_NAMES, columns={"position": (("clearance", len(CLEARANCE_NAMES)),)}, cumulative=True,
    ),
    Topic(
        "wear_rate", JOINT_STATE, Cadence.SLOW,
        "velocity = growth of each pad's wear since the previous message [m/s]",
        names=PAD_NAMES, columns={"velocity": (("wear_rate", 8),)}, cumulative=True,
    ),
    Topic(
        "quality", JOINT_STATE, Cadence.MARKED,
        "position is 1 or 0 for `held` (the state at the stamp was computed without a sample) and `corrected` (late "
        "samples were inserted); also sent once after the last mark",
        names=("held", "corrected"), columns={"position": (("held", 1), ("corrected", 1))}, latched=True,
    ),
    Topic(
        "estimate", JOINT_STATE, Cadence.ESTIMATE,
        "if `estimate` is true, position of `horizontal`, `vertical` [m], `stiffness`, `damping`, `gain_fx`, "
        "`gain_fy`, `gain_m` [1], `bias_x`, `bias_y` [m], `bias_theta` [rad], `delay` [s], each followed by its "
        "`<name>/p05`, `<name>/p95`",
        latched=True, depth=1,
    ),
    Topic(
        "window_forces", JOINT_STATE, Cadence.ESTIMATE,
        "if `estimate_forces` is set, velocity = impulse [N s] and effort = largest force [N] in the last "
        "`estimate_interval`, over twins drawn from the estimate: median `<pair>`, points `<pair>/p05`, `<pair>/p95`",
        latched=True, depth=1,
    ),
    Topic(
        "forecast", JOINT_STATE, Cadence.ESTIMATE,
        "if `forecast_limits` are set, position of `seconds`, `metres`, `passes`, `shifts` of operation until a "
        "clearance reaches its limit, each as `/p10`, `/p50`, `/p90` (left out beyond the horizon), then "
        "`not_reached_in_horizon` and, with `forecast_stop`, `probability_before_stop` [1]",
        latched=True, depth=1,
    ),
    Topic(
        "alarms", STATUS, Cadence.CHANGE,
        "for `force` [N], `clearance` [m], `clearance_rate` and `wear_rate` [m/s] and, with a threshold, `residual` "
        "[m]: value (`<name>`), level (`<name>_level`) and latched level (`<name>_latched`); a latched alarm also has "
        "`<name>_raised` (its value then), `<name>_threshold`, `<name>_place` (pad or axis) and `<name>_stamp_ns`; "
        "message = the same in words",
        latched=True, depth=1,
    ),
    Topic("status", STATUS, Cadence.CHANGE, "state of node, stream and inputs", latched=True, depth=1),
)  # fmt: skip


def topics_of(*cadences: Cadence) -> tuple[Topic, ...]:
    """Return the topics with one of the given cadences, in the order of the table."""
    return tuple(topic for topic in TOPICS if topic.cadence in cadences)


def names_of(*cadences: Cadence) -> tuple[str, ...]:
    """Return the base names of the topics with one of the given cadences."""
    return tuple(topic.name for topic in topics_of(*cadences))
