"""Merging of the messages of separately written files by their stamps."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, pairwise
from typing import Final, TypeAlias, TypeVar

T = TypeVar("T")

#: A function that returns the stamp of a message [ns], or None.
StampOf: TypeAlias = Callable[[T], int | None]

#: A stamp older than the newest stamp by more than this [ns] is a step of the clock; otherwise the row is late.
_STEP_NS: Final = 1_000_000_000
#: A stamp newer than the newest stamp by more than this [ns] may be wrong; the next stamp decides.
_JUMP_NS: Final = 10_000_000_000


def merged(streams: Iterable[Iterator[T]], stamp_ns: StampOf[T]) -> Iterator[T]:
    """Yield the messages of all streams in the order of their stamps; each stream keeps its own order.

    A message without a stamp, or with a single wrong stamp, keeps its place in its stream. After its clock has stepped
    back, a stream waits until the clocks of the other streams have stepped back too.
    """
    for _, _, arrived in heapq.merge(*(_placed(stream, stamp_ns) for stream in streams), key=lambda item: item[:2]):
        yield arrived


def _placed(stream: Iterator[T], stamp_ns: StampOf[T]) -> Iterator[tuple[int, int, T]]:
    """Yield each message with the number of clock steps before it and the newest stamp so far."""
    steps, newest = 0, None
    stamped = ((arrived, stamp_ns(arrived)) for arrived in stream)
    for (arrived, stamp), (_, following) in pairwise(chain(stamped, [(None, None)])):
        assert arrived is not None
        if stamp is not None and newest is None:
            newest = stamp
        elif stamp is not None and newest is not None and not _is_stray(stamp, newest, following):
            back = newest - stamp > _STEP_NS
            steps, newest = steps + back, stamp if back else max(newest, stamp)
        yield steps, 0 if newest is None else newest, arrived


def _is_stray(stamp: int, newest: int, following: int | None) -> bool:
    """Return whether only this stamp is wrong: the next stamp continues the earlier stamps."""
    if following is None:
        return False
    back = newest - stamp > _STEP_NS
    goes_on = newest - following <= _STEP_NS
    return goes_on if back else goes_on and stamp - newest > _JUMP_NS and stamp - following > following - newest
