"""Read the queue of a subscription in batches, with the publisher and the sequence number of each message.

The queue is read through rcl, the C interface below rclpy, because rclpy does not provide the publisher. rcl signals
new messages through an eventfd, without an executor. The subscription is removed from `Node._subscriptions`, so that
no executor reads its queue.
"""

from __future__ import annotations

import ctypes
import os
import struct
import time
from collections import Counter
from functools import cache
from typing import Final, NamedTuple

from rclpy.node import Node
from rclpy.subscription import Subscription

from plow_twin.ros.rcl import SerializedMessage, libraries

_FIRST_CAPACITY: Final = 1024


class Received(NamedTuple):
    """A received message.

    `sender` is the identifier of the publisher. `number` is the sequence number of the message, counted from 1 for each
    publisher. If the middleware does not number messages, the received messages are counted, so a loss is not noticed.
    `data` contains the CDR bytes, and the times are in ns.
    """

    sender: bytes
    number: int
    received_ns: int
    data: bytes
    sent_ns: int = 0


class _Info(ctypes.Structure):
    """The C structure `rmw_message_info_t`, with spare bytes at the end for the fields of other versions of ROS."""

    _fields_ = [
        ("source_ns", ctypes.c_int64),
        ("received_ns", ctypes.c_int64),
        ("number", ctypes.c_uint64),
        ("reception_number", ctypes.c_uint64),
        ("implementation", ctypes.c_void_p),
        ("publisher", ctypes.c_uint8 * 16),
        ("room", ctypes.c_uint8 * 48),
    ]


#: Layouts of `_Info` (times of sending and reception, sequence number, publisher) and of `SerializedMessage` (address
#: and length of the bytes).
_INFO, _PLACE = struct.Struct("=qqQ16x16s"), struct.Struct("=QQ")
#: Sequence number from a middleware that does not number messages.
_NO_NUMBER: Final = 2**64 - 1
#: Return code of rcl for an empty queue.
_EMPTY_QUEUE: Final = 401


@cache
def _count_up() -> ctypes.c_void_p:
    """Return the address of the C function `eventfd_write`, which rcl calls with the descriptor and a count."""
    return ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)


def _new_buffer() -> SerializedMessage:
    _, rcutils = libraries()
    buffer, allocator = SerializedMessage(), rcutils.rcutils_get_default_allocator()
    if rcutils.rcutils_uint8_array_init(buffer, _FIRST_CAPACITY, allocator):
        raise MemoryError(f"input queue: no buffer of {_FIRST_CAPACITY} B")
    return buffer


class InputQueue:
    """Queue of a subscription that is read without an executor.

    The file descriptor `fd` becomes readable when a message has arrived. The node and the subscription must be created
    in the thread of the executor. The callback of the subscription is never called.
    """

    def __init__(self, node: Node, subscription: Subscription) -> None:
        self._node, self._subscription = node, subscription
        rcl, _ = libraries()
        self._take, self._listen = rcl.rcl_take_serialized_message, rcl.rcl_subscription_set_on_new_message_callback
        self._buffer, self._info = _new_buffer(), _Info()
        self._places = ctypes.byref(self._buffer), ctypes.byref(self._info)
        self._signs = 0
        #: number of messages of each publisher, if the middleware does not number them
        self._counted: Counter[bytes] = Counter()
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        node._subscriptions.remove(subscription)
        with subscription.handle:
            self._listen(subscription.handle.pointer, _count_up(), self.fd)

    def pop(self, most: int, *, all_there_are: bool = False) -> tuple[list[Received], bool]:
        """Return at most `most` messages in the order of arrival, and whether the queue contains more messages.

        By default, as many messages are read as were signalled, which saves a read of the empty queue. With
        `all_there_are`, the queue is read until it is empty.
        """
        try:
            signs = os.eventfd_read(self.fd)
        except BlockingIOError:
            signs = 0
        self._signs += signs
        count = most if all_there_are else min(most, self._signs)
        received = self._read(count)
        # if the queue has overflowed, it contains fewer messages than were signalled
        self._signs = max(0, self._signs - len(received)) if len(received) == count else 0
        return received, self._signs > 0 or (all_there_are and len(received) == most)

    @property
    def waiting(self) -> int:
        """Number of messages that were signalled and have not been read."""
        return self._signs

    def close(self) -> None:
        """Destroy the subscription."""
        with self._subscription.handle:
            self._listen(self._subscription.handle.pointer, None, None)
        os.close(self.fd)
        self._node._subscriptions.append(self._subscription)
        self._node.destroy_subscription(self._subscription)
        libraries()[1].rcutils_uint8_array_fini(ctypes.byref(self._buffer))

    def _read(self, most: int) -> list[Received]:
        received: list[Received] = []
        handle, take = self._subscription.handle, self._take
        with handle:
            pointer = handle.pointer
            while len(received) < most:
                answer = take(pointer, *self._places, None)
                if answer:
                    break
                sent_ns, received_ns, number, sender = _INFO.unpack_from(self._info)
                if number == _NO_NUMBER:
                    number = self._counted[sender] = self._counted[sender] + 1
                data = ctypes.string_at(*_PLACE.unpack_from(self._buffer))
                received.append(Received(sender, number, received_ns or time.time_ns(), data, sent_ns))
            else:
                answer = 0
        if answer not in (0, _EMPTY_QUEUE):
            raise RuntimeError(f"{self._subscription.topic_name}: rcl_take_serialized_message returned {answer}")
        return received
