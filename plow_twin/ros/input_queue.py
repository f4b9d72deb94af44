"""The queue of one input, read in batches; each message has its publisher and the publisher's sequence number.

Both come from the C interface below rclpy, which also signals new messages through an eventfd without executor and
interpreter. The subscription is removed from `Node._subscriptions`, so that no executor takes from its queue.
"""

from __future__ import annotations

import ctypes
import os
import struct
from functools import cache
from typing import Final, NamedTuple

from rclpy.node import Node
from rclpy.subscription import Subscription

from plow_twin.ros.rcl import SerializedMessage, libraries

_FIRST_CAPACITY: Final = 1024


class Taken(NamedTuple):
    """One message: publisher, sequence number (from 1), time of reception [ns], CDR bytes, time of sending [ns]."""

    sender: bytes
    number: int
    received_ns: int
    data: bytes
    sent_ns: int = 0


class _Info(ctypes.Structure):
    """`rmw_message_info_t`, with room at the end for the fields of other versions of ROS."""

    _fields_ = [
        ("source_ns", ctypes.c_int64),
        ("received_ns", ctypes.c_int64),
        ("number", ctypes.c_uint64),
        ("reception_number", ctypes.c_uint64),
        ("implementation", ctypes.c_void_p),
        ("publisher", ctypes.c_uint8 * 16),
        ("room", ctypes.c_uint8 * 48),
    ]


#: Layouts of `_Info` (times of sending and reception, sequence number, publisher), and of the address and length in
#: `SerializedMessage`.
_INFO, _PLACE = struct.Struct("=qqQ16x16s"), struct.Struct("=QQ")
#: Answer of rcl for an empty queue.
_NOTHING_TAKEN: Final = 401


@cache
def _count_up() -> ctypes.c_void_p:
    """Return `eventfd_write` as a callback of rcl, which passes the eventfd as user data and the number of messages."""
    return ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)


def _new_buffer() -> SerializedMessage:
    """Return a buffer that rcl fills and grows."""
    _, rcutils = libraries()
    buffer, allocator = SerializedMessage(), rcutils.rcutils_get_default_allocator()
    if rcutils.rcutils_uint8_array_init(buffer, _FIRST_CAPACITY, allocator):
        raise MemoryError(f"input queue: no buffer of {_FIRST_CAPACITY} B")
    return buffer


class InputQueue:
    """A queue that is taken away from the executor and signals arrivals: `fd` becomes readable.

    Node and subscription must be made in the thread of the executor; the subscription's own callback is never called.
    """

    def __init__(self, node: Node, subscription: Subscription) -> None:
        self._node, self._subscription = node, subscription
        rcl, _ = libraries()
        self._take, self._listen = rcl.rcl_take_serialized_message, rcl.rcl_subscription_set_on_new_message_callback
        self._buffer, self._info = _new_buffer(), _Info()
        self._places = ctypes.byref(self._buffer), ctypes.byref(self._info)
        self._signs = 0
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        node._subscriptions.remove(subscription)
        with subscription.handle:
            self._listen(subscription.handle.pointer, _count_up(), self.fd)

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Taken], bool]:
        """Return up to `most` waiting messages in order of arrival, and whether there are more.

        Only signalled messages are taken, unless `all_there_are`: reading an empty queue takes a fifth of the time of a
        sample.
        """
        try:
            signs = os.eventfd_read(self.fd)
        except BlockingIOError:
            signs = 0
        self._signs += signs
        wanted = most if all_there_are else min(most, self._signs)
        taken = self._taken(wanted)
        # a queue that has overflowed had more signals than messages
        self._signs = max(0, self._signs - len(taken)) if len(taken) == wanted else 0
        return taken, self._signs > 0 or (all_there_are and len(taken) == most)

    def close(self) -> None:
        """Remove the subscription from the node."""
        with self._subscription.handle:
            self._listen(self._subscription.handle.pointer, None, None)
        os.close(self.fd)
        self._node._subscriptions.append(self._subscription)
        self._node.destroy_subscription(self._subscription)
        libraries()[1].rcutils_uint8_array_fini(ctypes.byref(self._buffer))

    def _taken(self, most: int) -> list[Taken]:
        taken: list[Taken] = []
        handle, take = self._subscription.handle, self._take
        with handle:
            pointer = handle.pointer
            while len(taken) < most:
                answer = take(pointer, *self._places, None)
                if answer:
                    break
                sent_ns, received_ns, number, sender = _INFO.unpack_from(self._info)
                data = ctypes.string_at(*_PLACE.unpack_from(self._buffer))
                taken.append(Taken(sender, number, received_ns, data, sent_ns))
            else:
                answer = 0
        if answer not in (0, _NOTHING_TAKEN):
            raise RuntimeError(f"{self._subscription.topic_name}: rcl_take_serialized_message returned {answer}")
        return taken
