"""Encode messages as CDR bytes and decode them with the type store of rosbags, without a ROS installation.

Padding bytes are always zero, so that equal messages have equal bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.record.messages import (
    MESSAGE_TYPES,
    DiagnosticStatus,
    Integers,
    JointState,
    Message,
    Odometry,
    Text,
    WrenchStamped,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_SECOND_NS = 1_000_000_000
#: Offset of the characters in a string message [B].
_TEXT_AT = 8


@cache
def typestore() -> Typestore:
    """Return the rosbags type store with the message types of ROS 2 Jazzy."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@cache
def schema_text(message_type: str) -> str:
    """Return the `ros2msg` schema of a message type, including the types of its fields."""
    text, _ = typestore().generate_msgdef(message_type, ros_version=2)
    return text


@cache
def type_hash(message_type: str) -> str:
    """Return the REP-2016 hash of a message type."""
    return typestore().hash_rihs01(message_type)


def warm_up() -> None:
    """Fill the caches of schemas, type hashes and encoders, so that the first message is not 0.1 s late."""
    for message_type in MESSAGE_TYPES:
        schema_text(message_type)
        type_hash(message_type)
        typestore().get_msgdef(message_type)


def encode(message: Message) -> bytes:
    """Return the CDR bytes of a message."""
    if isinstance(message, Text):
        text = message.data.encode()
        return b"\x00\x01\x00\x00" + struct.pack("<I", len(text) + 1) + text + b"\x00"
    types = typestore().types
    encoded, _ = _CODECS[type(message)]
    return bytes(typestore().serialize_cdr(types[message.TYPE](*encoded(types, message)), message.TYPE))


def decode(data: bytes, message_type: str) -> Message:
    """Return the message that is encoded in CDR bytes.

    Raise `RecordingError` if the message type is unknown, or the bytes are not a message of the type.
    """
    kind = MESSAGE_TYPES.get(message_type)
    if kind is None:
        raise RecordingError(f"message type: got {message_type!r}, expected one of {', '.join(sorted(MESSAGE_TYPES))}")
    if kind is Text:
        return _decode_short_text(data)
    try:
        _, decoded = _CODECS[kind]
        return kind(*decoded(typestore().deserialize_cdr(data, message_type)))
    except Exception as error:  # for damaged bytes, rosbags may raise index, struct and assertion errors
        raise RecordingError(f"{message_type}: got {len(data)} bytes, expected one message ({error!r})") from error


def _header(types: Any, message: Any) -> Any:
    time = types["builtin_interfaces/msg/Time"](*divmod(message.stamp_ns, _SECOND_NS))
    return types["std_msgs/msg/Header"](time, message.frame_id)


def _stamped(wire: Any) -> tuple[int, str]:
    """Return the stamp [ns] and the frame in the header of a rosbags message."""
    stamp = wire.header.stamp
    return int(stamp.sec) * _SECOND_NS + int(stamp.nanosec), wire.header.frame_id


def _vector(types: Any, xyz: tuple[float, float, float]) -> Any:
    return types["geometry_msgs/msg/Vector3"](*xyz)


def _xyz(vector: Any) -> tuple[float, float, float]:
    return (vector.x, vector.y, vector.z)


def _odometry(types: Any, message: Odometry) -> tuple[Any, ...]:
    position = types["geometry_msgs/msg/Point"](*message.position)
    pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](*message.orientation))
    twist = types["geometry_msgs/msg/Twist"](_vector(types, message.linear), _vector(types, message.angular))
    return (
        _header(types, message),
        message.child_frame_id,
        types["geometry_msgs/msg/PoseWithCovariance"](pose, message.pose_covariance),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, message.twist_covariance),
    )


def _odometry_fields(wire: Any) -> tuple[Any, ...]:
    pose, twist = wire.pose.pose, wire.twist.twist
    quaternion = (*_xyz(pose.orientation), pose.orientation.w)
    place = (*_stamped(wire), wire.child_frame_id, _xyz(pose.position), quaternion)
    return (*place, _xyz(twist.linear), _xyz(twist.angular), wire.pose.covariance, wire.twist.covariance)


def _decode_short_text(data: bytes) -> Text:
    """Decode a string message without rosbags, which is too slow for the many strings of a journal."""
    (length,) = struct.unpack_from("<I", data, 4) if len(data) >= _TEXT_AT else (0,)
    if data[:2] != b"\x00\x01" or not 0 < length <= len(data) - _TEXT_AT:
        raise RecordingError(f"{Text.TYPE}: got {len(data)} bytes, expected one message")
    try:
        return Text(data[_TEXT_AT : _TEXT_AT + length - 1].decode())
    except UnicodeDecodeError as error:
        raise RecordingError(f"{Text.TYPE}: got {len(data)} bytes, expected one message ({error})") from error


#: For each message, the function that returns the fields of the rosbags message, and the function that returns the
#: fields of the message.
_CODECS: dict[type[Message], tuple[Callable[[Any, Any], tuple[Any, ...]], Callable[[Any], tuple[Any, ...]]]] = {
    JointState: (
        lambda types, message: (
            _header(types, message), message.name, message.position, message.velocity, message.effort,
        ),
        lambda wire: (*_stamped(wire), tuple(wire.name), wire.position, wire.velocity, wire.effort),
    ),
    Odometry: (_odometry, _odometry_fields),
    DiagnosticStatus: (
        lambda types, message: (
            message.level, message.name, message.message, message.hardware_id,
            [types["diagnostic_msgs/msg/KeyValue"](*item) for item in message.values],
        ),
        lambda wire: (
            wire.level, wire.name, wire.message, wire.hardware_id,
            tuple((item.key, item.value) for item in wire.values),
        ),
    ),
    WrenchStamped: (
        lambda types, message: (
            _header(types, message),
            types["geometry_msgs/msg/Wrench"](_vector(types, message.force), _vector(types, message.torque)),
        ),
        lambda wire: (*_stamped(wire), _xyz(wire.wrench.force), _xyz(wire.wrench.torque)),
    ),
    Integers: (
        lambda types, message: (types["std_msgs/msg/MultiArrayLayout"]([], 0), np.array(message.data, np.uint64)),
        lambda wire: (tuple(wire.data.tolist()),),
    ),
}  # fmt: skip
