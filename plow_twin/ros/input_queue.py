"""The queue of one input, emptied in one go, each message with the publisher it came from and its number there.

rclpy hands messages over one by one and without the publisher's identity; the C interface below it (rcl, a public and
stable one) tells it. The reader is an rclpy `Waitable`, which any executor takes. Of rclpy's own it touches
`Node._subscriptions`, so that no executor takes from the queue as well.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities, Waitable

_FIRST_CAPACITY: Final = 1024


class Taken(NamedTuple):
    """One message: publisher, its number there (from 1), time of reception [ns], CDR bytes, time of sending [ns]."""

    sender: bytes
    number: int
    received_ns: int
    data: bytes
    sent_ns: int = 0


class _Allocator(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")]


class _Bytes(ctypes.Structure):
    """`rcutils_uint8_array_t`."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    ]


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


#: What rcl answers when the queue is empty.
_NOTHING_TAKEN: Final = 401


@cache
def _libraries() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    """Return rcl and rcutils, which rclpy has loaded already."""
    rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
    rcutils.rcutils_get_default_allocator.restype = _Allocator
    rcutils.rcutils_uint8_array_init.argtypes = [
        ctypes.POINTER(_Bytes),
        ctypes.c_size_t,
        ctypes.POINTER(_Allocator),
    ]
    rcl.rcl_take_serialized_message.argtypes = [
        ctypes.c_void_p,
        ctypes.POINTER(_Bytes),
        ctypes.POINTER(_Info),
        ctypes.c_void_p,
    ]
    return rcl, rcutils


def _new_buffer() -> _Bytes:
    """Return a buffer that rcl fills and grows."""
    _, rcutils = _libraries()
    buffer, allocator = _Bytes(), rcutils.rcutils_get_default_allocator()
    if rcutils.rcutils_uint8_array_init(buffer, _FIRST_CAPACITY, allocator):
        raise MemoryError(f"input queue: no buffer of {_FIRST_CAPACITY} B")
    return buffer


class InputQueue(Waitable):
    """Take a subscription out of the executor's hands and empty its queue whenever something has arrived.

    Parameters
    ----------
    node
        The node that the subscription was made on.
    subscription
        The subscription; its own callback is never called.
    depth
        Most messages taken at once.
    on_batch
        Receives the messages in order of arrival.
    """

    def __init__(
        self, node: Node, subscription: Subscription, depth: int, on_batch: Callable[[list[Taken]], None]
    ) -> None:
        super().__init__(node.default_callback_group)
        self._node, self._subscription, self._depth, self._on_batch = node, subscription, depth, on_batch
        self._take = _libraries()[0].rcl_take_serialized_message
        self._buffer, self._info = _new_buffer(), _Info()
        self._index: int | None = None
        # no executor shall take from it as well
        node._subscriptions.remove(subscription)
        node.add_waitable(self)

    def flush(self) -> None:
        """Hand over what waits now."""
        while taken := self.take_data():
            self._on_batch(taken)

    def close(self) -> None:
        """Take the subscription off the node."""
        self._node.remove_waitable(self)
        self._node._subscriptions.append(self._subscription)
        self._node.destroy_subscription(self._subscription)
        _libraries()[1].rcutils_uint8_array_fini(ctypes.byref(self._buffer))

    def get_num_entities(self) -> NumberOfEntities:
        """Return what the wait set must have room for."""
        return NumberOfEntities(num_subs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add the subscription to a wait set."""
        with self._subscription.handle:
            self._index = wait_set.add_subscription(self._subscription.handle)

    def is_ready(self, wait_set: Any) -> bool:
        """Tell whether something has arrived."""
        return self._index is not None and bool(wait_set.is_ready("subscription", self._index))

    def take_data(self) -> list[Taken]:
        """Empty the queue."""
        taken: list[Taken] = []
        info, buffer, take = self._info, self._buffer, self._take
        with self._subscription.handle:
            pointer = self._subscription.handle.pointer
            while len(taken) < self._depth:
                answer = take(pointer, buffer, info, None)
                if answer:
                    break
                data = ctypes.string_at(buffer.buffer, buffer.length)
                taken.append(Taken(bytes(info.publisher), info.number, info.received_ns, data, info.source_ns))
            else:
                answer = 0
        if answer not in (0, _NOTHING_TAKEN):
            raise RuntimeError(f"{self._subscription.topic_name}: rcl_take_serialized_message returned {answer}")
        return taken

    async def execute(self, taken: list[Taken]) -> None:
        """Hand over what was taken."""
        if taken:
            self._on_batch(taken)

    def __enter__(self) -> None:
        self._subscription.handle.__enter__()

    def __exit__(self, *error: object) -> None:
        self._subscription.handle.__exit__(*error)
