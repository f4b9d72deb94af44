"""Between ROS messages and plain numbers. Messages to send are made once and written over."""

from __future__ import annotations

import struct
from array import array
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from plow_twin.record import messages as plain
from plow_twin.stream.intake import NS_PER_S

Wrench = tuple[float, float, float]

_QUANTITIES: Final = ("position", "velocity", "effort")
#: Stamp and length of the publication's name, then force and torque; big endian and little endian.
_WRENCH_LAYOUTS: Final = tuple((struct.Struct(f"{order}iII"), struct.Struct(f"{order}6d")) for order in "><")


def stamp_ns(header: Header) -> int:
    """Return the stamp of a header [ns]."""
    return int(header.stamp.sec * NS_PER_S + header.stamp.nanosec)


def set_stamp(header: Header, stamp: int) -> None:
    """Write a stamp [ns] into a header."""
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, NS_PER_S)


def read_wrench(data: bytes) -> tuple[int, Wrench, bool] | None:
    """Return stamp [ns], Fx, Fy [N] and M [N m], and whether a component outside the plane is not zero.

    `data` are the CDR bytes of a `WrenchStamped`; None when they do not hold one. One sample costs a tenth of what
    rclpy's own message objects cost.
    """
    try:
        start, numbers = _WRENCH_LAYOUTS[data[1] & 1]
        seconds, nanoseconds, length = start.unpack_from(data, 4)
        # numbers of 8 bytes are aligned to 8, counted from behind the 4 bytes of the encapsulation
        fx, fy, fz, mx, my, mz = numbers.unpack_from(data, 4 + (start.size + length + 7) // 8 * 8)
    except (struct.error, IndexError):
        return None
    return seconds * NS_PER_S + nanoseconds, (fx, fy, mz), fz != 0.0 or mx != 0.0 or my != 0.0


def ros_status(status: plain.DiagnosticStatus) -> DiagnosticStatus:
    """Return the ROS message of a status."""
    values = [KeyValue(key=key, value=value) for key, value in status.values]
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values=values,
    )


class JointStateWriter:
    """One `JointState` of named numbers that is written over for each message."""

    def __init__(self, first: plain.JointState) -> None:
        self.message = JointState(name=list(first.name))
        self.message.header.frame_id = first.frame_id
        self._views: list[tuple[str, NDArray[np.float64]]] = []
        for quantity in _QUANTITIES:
            if len(getattr(first, quantity)):
                setattr(self.message, quantity, array("d", bytes(8 * len(first.name))))
                # the message's own array, which need not be the one that was set
                self._views.append((quantity, np.frombuffer(getattr(self.message, quantity))))

    def write(self, message: plain.JointState) -> JointState:
        """Return the ROS message of the same numbers."""
        set_stamp(self.message.header, message.stamp_ns)
        for quantity, view in self._views:
            view[:] = getattr(message, quantity)
        return self.message


class OdometryWriter:
    """One `Odometry` that is written over; the covariances stay zero: unknown."""

    def __init__(self, first: plain.Odometry) -> None:
        self.message = Odometry(child_frame_id=first.child_frame_id)
        self.message.header.frame_id = first.frame_id

    def write(self, message: plain.Odometry) -> Odometry:
        """Return the ROS message of the same numbers."""
        set_stamp(self.message.header, message.stamp_ns)
        pose, twist = self.message.pose.pose, self.message.twist.twist
        pose.position.x, pose.position.y, pose.position.z = message.position
        turn = pose.orientation
        turn.x, turn.y, turn.z, turn.w = message.orientation
        twist.linear.x, twist.linear.y, twist.linear.z = message.linear
        twist.angular.x, twist.angular.y, twist.angular.z = message.angular
        return self.message
