"""Send and receive serialized messages through rcl, the public C interface below rclpy.

rcl is used because rclpy does not provide the publisher of a received message, and because rclpy converts each message
to a Python object.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any


class Allocator(ctypes.Structure):
    """The C structure `rcutils_allocator_t`."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")]


class SerializedMessage(ctypes.Structure):
    """The C structure `rcutils_uint8_array_t`."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", Allocator),
    ]


@cache
def libraries() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    """Return the libraries rcl and rcutils, which rclpy has already loaded."""
    rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
    rcutils.rcutils_get_default_allocator.restype = Allocator
    rcutils.rcutils_uint8_array_init.argtypes = [
        ctypes.POINTER(SerializedMessage),
        ctypes.c_size_t,
        ctypes.POINTER(Allocator),
    ]
    rcl.rcl_take_serialized_message.argtypes = [ctypes.c_void_p] * 4
    rcl.rcl_subscription_set_on_new_message_callback.argtypes = [ctypes.c_void_p] * 3
    return rcl, rcutils


@cache
def _publish() -> Any:
    # PyDLL does not release the interpreter lock, because releasing the lock takes longer than sending a message
    publish = ctypes.PyDLL("librcl.so").rcl_publish_serialized_message
    publish.argtypes = [ctypes.c_void_p] * 3
    return publish


class Sender:
    """Sender of the CDR message in a buffer.

    The method `send` sends the present content of the buffer. After the publisher is destroyed, nothing is sent.
    """

    def __init__(self, publisher: Any, data: memoryview) -> None:
        self._publisher, self._data = publisher, (ctypes.c_uint8 * len(data)).from_buffer(data)
        self._message = SerializedMessage(ctypes.addressof(self._data), len(data), len(data))
        self._arguments = ctypes.c_void_p(publisher.handle.pointer), ctypes.byref(self._message), None
        self._publish = _publish()

    def send(self) -> None:
        """Send the message in the buffer."""
        if self._publish(*self._arguments):
            self._publisher.publish(bytes(self._data))  # rclpy raises an error with the reason of the failure
