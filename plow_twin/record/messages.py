"""Messages of the node and of its journal, as plain immutable values without ROS.

Each class is one ROS 2 message type (`TYPE`). Stamps are integer nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

Float64s = NDArray[np.float64]

EMPTY: Final[Float64s] = np.zeros(0)
_ZERO36: Final[Float64s] = np.zeros(36)


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """Named numbers: `position`, `velocity` and `effort` each have the length of `name` or are empty.

    The sender must not change the arrays afterwards.
    """

    TYPE: ClassVar = "sensor_msgs/msg/JointState"

    stamp_ns: int
    frame_id: str
    name: tuple[str, ...]
    position: Float64s = field(default_factory=lambda: EMPTY)
    velocity: Float64s = field(default_factory=lambda: EMPTY)
    effort: Float64s = field(default_factory=lambda: EMPTY)


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Pose in the frame `frame_id` and twist in `child_frame_id`; `orientation` is the quaternion (x, y, z, w).

    Covariances are row-major 6 x 6 over (x, y, z, rotation about x, y, z); all zeros: unknown.
    """

    TYPE: ClassVar = "nav_msgs/msg/Odometry"

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    linear: tuple[float, float, float]
    angular: tuple[float, float, float]
    pose_covariance: Float64s = field(default_factory=lambda: _ZERO36)
    twist_covariance: Float64s = field(default_factory=lambda: _ZERO36)


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """A state: `level` 0 OK, 1 WARN, 2 ERROR, 3 STALE, a message, and key/value pairs."""

    TYPE: ClassVar = "diagnostic_msgs/msg/DiagnosticStatus"

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class WrenchStamped:
    """Force [N] and moment [N m] about the cavity's centre."""

    TYPE: ClassVar = "geometry_msgs/msg/WrenchStamped"

    stamp_ns: int
    frame_id: str
    force: tuple[float, float, float]
    torque: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Text:
    """One line of text."""

    TYPE: ClassVar = "std_msgs/msg/String"

    data: str


@dataclass(frozen=True, slots=True)
class Integers:
    """Unsigned integers of 64 bits."""

    TYPE: ClassVar = "std_msgs/msg/UInt64MultiArray"

    data: tuple[int, ...]


Message = JointState | Odometry | DiagnosticStatus | WrenchStamped | Text | Integers
MESSAGE_TYPES: Final[dict[str, type[Message]]] = {
    kind.TYPE: kind for kind in (JointState, Odometry, DiagnosticStatus, WrenchStamped, Text, Integers)
}
