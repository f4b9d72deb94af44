"""Messages of the node and of the journal as immutable Python objects, without a ROS installation.

Each class represents the ROS 2 message type `TYPE`. Stamps are integers in nanoseconds.
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
    """Named numbers. The arrays `position`, `velocity` and `effort` are as long as `name`, or empty.

    The arrays must not be changed after the message has been created.
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
    """Pose in the frame `frame_id`, and twist in the frame `child_frame_id`.

    `orientation` is the quaternion (x, y, z, w). A covariance is a row-major 6 x 6 matrix. Its rows belong to x, y, z
    and to the rotations about x, y, z. A matrix of zeros means that the covariance is unknown.
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
    """Status of a component. `level` is 0 (OK), 1 (WARN), 2 (ERROR) or 3 (STALE)."""

    TYPE: ClassVar = "diagnostic_msgs/msg/DiagnosticStatus"

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class WrenchStamped:
    """Force [N], and moment [N m] about the centre of the cavity."""

    TYPE: ClassVar = "geometry_msgs/msg/WrenchStamped"

    stamp_ns: int
    frame_id: str
    force: tuple[float, float, float]
    torque: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text."""

    TYPE: ClassVar = "std_msgs/msg/String"

    data: str


@dataclass(frozen=True, slots=True)
class Integers:
    """Unsigned 64-bit integers."""

    TYPE: ClassVar = "std_msgs/msg/UInt64MultiArray"

    data: tuple[int, ...]


Message = JointState | Odometry | DiagnosticStatus | WrenchStamped | Text | Integers
MESSAGE_TYPES: Final[dict[str, type[Message]]] = {
    kind.TYPE: kind for kind in (JointState, Odometry, DiagnosticStatus, WrenchStamped, Text, Integers)
}
