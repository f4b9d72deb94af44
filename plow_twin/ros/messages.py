"""Convert ROS messages to numbers, and numbers to ROS messages."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from plow_twin.record import messages as plain
from plow_twin.stream.intake import NS_PER_S

#: Content of a message: the stamp [ns], the numbers, whether the numbers are a load, and whether the load has a
#: component out of the plane.
Read = tuple[int, tuple[float, ...], bool, bool]
#: Content of a message that cannot be decoded.
UNREADABLE: Final[Read] = (0, (), False, False)

#: Layouts of a wrench message (stamp and length of the frame name; force and torque), big-endian and little-endian.
_WRENCH_LAYOUTS: Final = tuple((struct.Struct(f"{order}iII"), struct.Struct(f"{order}6d")) for order in "><")


def stamp_ns(header: Header) -> int:
    """Return the stamp of a header [ns]."""
    return int(header.stamp.sec * NS_PER_S + header.stamp.nanosec)


def deviations(covariance: Sequence[float]) -> tuple[float, ...]:
    """Return the standard deviations of x, y [m] and theta [rad] from a row-major 6 x 6 covariance matrix.

    If the three variances are 0, they are unknown, and the result is empty. If a variance is negative, its result is
    NaN, so that the message is refused.
    """
    variances = [float(covariance[7 * axis]) for axis in (0, 1, 5)]
    values = tuple(math.sqrt(variance) if variance >= 0.0 else math.nan for variance in variances)
    return values if any(values) else ()


def set_stamp(header: Header, stamp: int) -> None:
    """Write a stamp [ns] to a header."""
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, NS_PER_S)


def read_wrench(data: bytes) -> Read:
    """Return the stamp [ns] and Fx, Fy [N], M [N m] from the CDR bytes of a `WrenchStamped`.

    The function is ten times as fast as rclpy.
    """
    try:
        start, numbers = _WRENCH_LAYOUTS[data[1] & 1]
        seconds, nanoseconds, length = start.unpack_from(data, 4)
        # the numbers are aligned to 8 bytes, counted from the end of the 4 bytes that identify the encoding
        fx, fy, fz, mx, my, mz = numbers.unpack_from(data, 4 + (start.size + length + 7) // 8 * 8)
    except (struct.error, IndexError):
        return UNREADABLE
    return seconds * NS_PER_S + nanoseconds, (fx, fy, mz), True, fz != 0.0 or mx != 0.0 or my != 0.0


def ros_status(status: plain.DiagnosticStatus) -> DiagnosticStatus:
    """Return the ROS message of a status message of this package."""
    values = [KeyValue(key=key, value=value) for key, value in status.values]
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values=values,
    )
