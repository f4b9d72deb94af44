"""Merge the messages from several files by their stamps."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, pairwise
from typing import Final, TypeAlias, TypeVar

T = TypeVar("T")

#: Function that returns the stamp of a message [ns], or None for a message without a stamp.
StampOf: TypeAlias = Callable[[T], int | None]

#: Largest delay [ns] of a late message behind the newest stamp. A larger delay means that the clock was set back.
_STEP_NS: Final = 1_000_000_000
#: Largest plausible increase from one stamp to the next [ns]. After a larger increase, the stamp of the next message
#: shows whether the increased stamp was wrong.
_JUMP_NS: Final = 10_000_000_000


def merged(streams: Iterable[Iterator[T]], stamp_ns: StampOf[T]) -> Iterator[T]:
    """Yield the messages of all streams in the order of their stamps, without a change of order within a stream.

    A message without a stamp, or with a single wrong stamp, follows its predecessor in the stream. If the clock steps
    back, all streams are read up to the step before any stream is read beyond the step.
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
    """Return whether a stamp is a single wrong stamp, after which the stamps continue as before."""
    if following is None:
        return False
    back = newest - stamp > _STEP_NS
    goes_on = newest - following <= _STEP_NS
    return goes_on if back else goes_on and stamp - newest > _JUMP_NS and stamp - following > following - newest
