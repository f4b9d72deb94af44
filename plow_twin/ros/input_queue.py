"""The queue of one input, emptied in one go, each message with the publisher it came from and its number there.

The C interface below rclpy tells it, and writes to an eventfd when something has come: that needs neither executor nor
interpreter. Of rclpy's own it touches `Node._subscriptions`, so that no executor takes from the queue as well.
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
    """One message: publisher, its number there (from 1), time of reception [ns], CDR bytes, time of sending [ns]."""

    sender: bytes
    number: int
    received_ns: int
    data: bytes
    sent_ns: int = 0


class _Info(ctypes.Structure):
    """`rmw_message_info_t`, with room behind for the longer ones of other versions."""

    _fields_ = [
        ("source_ns", ctypes.c_int64),
        ("received_ns", ctypes.c_int64),
        ("number", ctypes.c_uint64),
        ("reception_number", ctypes.c_uint64),
        ("implementation", ctypes.c_void_p),
        ("publisher", ctypes.c_uint8 * 16),
        ("room", ctypes.c_uint8 * 48),
    ]


#: Of `_Info`: times of sending and of reception, number, publisher; of `SerializedMessage`: where it is, and length.
_INFO, _PLACE = struct.Struct("=qqQ16x16s"), struct.Struct("=QQ")
#: What rcl answers when the queue is empty.
_NOTHING_TAKEN: Final = 401


@cache
def _count_up() -> ctypes.c_void_p:
    """Return `eventfd_write(fd, count)` as a callback of rcl.

    rcl calls it with what it was given, here the number of the eventfd, and the number of new messages: each in the
    register where the function expects it.
    """
    return ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)


def _new_buffer() -> SerializedMessage:
    """Return a buffer that rcl fills and grows."""
    _, rcutils = libraries()
    buffer, allocator = SerializedMessage(), rcutils.rcutils_get_default_allocator()
    if rcutils.rcutils_uint8_array_init(buffer, _FIRST_CAPACITY, allocator):
        raise MemoryError(f"input queue: no buffer of {_FIRST_CAPACITY} B")
    return buffer


class InputQueue:
    """Take a subscription out of the executor's hands, and tell by a file descriptor that something has arrived.

    Parameters
    ----------
    node
        The node that the subscription was made on; made in the thread of its executor, as the subscription.
    subscription
        The subscription; its own callback is never called.

    Attributes
    ----------
    fd : int
        Can be read once something has arrived.
    """

    def __init__(self, node: Node, subscription: Subscription) -> None:
        self._node, self._subscription = node, subscription
        rcl, _ = libraries()
        self._take, self._listen = rcl.rcl_take_serialized_message, rcl.rcl_subscription_set_on_new_message_callback
        self._buffer, self._info = _new_buffer(), _Info()
        self._places = ctypes.byref(self._buffer), ctypes.byref(self._info)
        self._signs = 0
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # no executor shall take from it as well
        node._subscriptions.remove(subscription)
        with subscription.handle:
            self._listen(subscription.handle.pointer, _count_up(), self.fd)

    def take(self, most: int, *, all_there_are: bool = False) -> tuple[list[Taken], bool]:
        """Return what waits now in order of arrival, up to `most` messages, and whether there are more.

        As many are asked for as signs have come, or `most` where `all_there_are` says so: to ask in vain takes a fifth
        of a sample's time.
        """
        try:
            signs = os.eventfd_read(self.fd)
        except BlockingIOError:  # asked without a sign
            signs = 0
        self._signs += signs
        wanted = most if all_there_are else min(most, self._signs)
        taken = self._taken(wanted)
        # where the queue has overrun there were more signs than messages
        self._signs = max(0, self._signs - len(taken)) if len(taken) == wanted else 0
        return taken, self._signs > 0 or (all_there_are and len(taken) == most)

    def close(self) -> None:
        """Take the subscription off the node."""
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
