"""Between ROS messages and plain numbers. Those sent at each sample are bytes, written over."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from plow_twin.record import messages as plain
from plow_twin.record.template import STAMP_AT, Template
from plow_twin.stream.intake import NS_PER_S

Wrench = tuple[float, float, float]

_QUANTITIES: Final = ("position", "velocity", "effort")
_STAMP: Final = struct.Struct("<iI")
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


def ros_joint_state(message: plain.JointState) -> JointState:
    """Return the ROS message of named numbers."""
    found = JointState(name=list(message.name))
    found.header.frame_id = message.frame_id
    set_stamp(found.header, message.stamp_ns)
    for quantity in _QUANTITIES:
        setattr(found, quantity, array("d", getattr(message, quantity).tobytes()))
    return found


class Serializer:
    """The CDR bytes of messages of one template: rclpy sends them as they are, in a third of the time of an object."""

    def __init__(self, template: Template) -> None:
        self._bytes = bytearray(template.data.tobytes())
        # numbers that stand side by side are written at once
        begins = [0, *(1 + np.flatnonzero(np.diff(template.places) != 8)), template.count]
        self._views = [
            np.frombuffer(self._bytes, np.float64, end - begin, int(template.places[begin]))
            for begin, end in pairwise(begins)
        ]

    def write(self, message: plain.JointState | plain.Odometry) -> bytes:
        """Return the bytes of a message that has the template's names."""
        _STAMP.pack_into(self._bytes, STAMP_AT, *divmod(message.stamp_ns, NS_PER_S))
        for view, numbers in zip(self._views, _numbers(message), strict=True):
            view[:] = numbers
        return bytes(self._bytes)


def _numbers(message: plain.JointState | plain.Odometry) -> list[Sequence[float] | NDArray[np.float64]]:
    """Return the numbers of a message in the order of its template, those side by side together."""
    if isinstance(message, plain.JointState):
        return [part for part in (message.position, message.velocity, message.effort) if len(part)]
    return [message.position[:2], message.orientation[2:], message.linear[:2], message.angular[2:]]
