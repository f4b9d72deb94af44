"""Selection of one sender when several senders publish the same input, and the count of its lost samples.

The middleware numbers the messages of each publisher from 1, so a gap in the numbers shows lost messages.
"""

from __future__ import annotations

from collections.abc import Collection

#: Time [ns] without a message of the followed sender after which `OneSender` may follow a different sender.
_SILENT_NS = 10_000_000_000
#: Largest number of senders for which the next message number is stored. If there are more, the oldest entry is
#: dropped.
_MOST_SENDERS = 64


class Senders:
    """Follow the sender of the first sample until it disappears or the operator requests a switch."""

    def __init__(self) -> None:
        #: the followed sender; None before the first sample, and after the sender has disappeared
        self.followed: bytes | None = None
        #: number of lost samples of the followed sender
        self.lost = 0
        #: number of samples from senders that are not followed
        self.ignored = 0
        self._next: dict[bytes, int] = {}
        self._before: frozenset[bytes] = frozenset()
        self._listed: set[bytes] = set()
        self._other: bytes | None = None

    def start(self, present: Collection[bytes]) -> None:
        """Register the senders that exist at the start. Messages that they have already sent do not count as lost."""
        self._before = frozenset(present)

    def start_late(self, sender: bytes) -> None:
        """Register a sender. Its messages before the first received sample do not count as lost."""
        self._before |= {sender}

    def count_arrival(self, sender: bytes, number: int, count: int = 1) -> bool:
        """Count the arrival of `count` samples of a sender, and return whether the sender is followed.

        `number` is the message number of the first of these samples, counted from 1.
        """
        expected = self._next.get(sender)
        if expected is None:
            expected = number if sender in self._before else 1
            if len(self._next) >= _MOST_SENDERS:
                self._next.pop(next(name for name in self._next if name != self.followed))
        if self.followed is None:
            self.followed = sender
        followed = sender == self.followed
        if followed:
            # a message that arrives out of order was counted as lost, so it is subtracted
            self.lost += number - expected if number >= expected else -1 if self.lost else 0
        else:
            self.ignored += count
            self._other = sender
        self._next[sender] = number + count if number >= expected else expected
        return followed

    def alive(self, present: Collection[bytes]) -> None:
        """Update the set of present senders, and stop following a sender that has disappeared.

        A sender that was in no earlier set has not disappeared, because the middleware may not have discovered it yet.
        """
        gone = self._listed.difference(present)
        self._listed = set(present)
        if self.followed in gone:
            self.followed = None
        if self._other in gone:
            self._other = None

    def switch(self) -> bool:
        """Follow the newest active sender among those not followed; return False if there is none."""
        if self._other is None:
            return False
        self._other, self.followed = self.followed, self._other
        return True


class OneSender:
    """Follow the first sender until it disappears, or until it is silent for 10 s while another sender sends."""

    def __init__(self) -> None:
        self.followed: bytes | None = None
        self.ignored = 0
        self._heard_ns = 0
        self._listed: set[bytes] = set()

    def count_arrival(self, sender: bytes, now_ns: int) -> bool:
        """Register a message that arrived at `now_ns` of the steady clock; return whether its sender is followed."""
        if self.followed is None or now_ns - self._heard_ns > _SILENT_NS:
            self.followed = sender
        if sender != self.followed:
            self.ignored += 1
            return False
        self._heard_ns = now_ns
        return True

    def alive(self, present: Collection[bytes]) -> None:
        """Update the set of present senders, as `Senders.alive` does."""
        if self.followed in self._listed.difference(present):
            self.followed = None
        self._listed = set(present)
