"""Selection of one sender when several send the same input, and the count of its lost samples.

The middleware numbers the messages of each publisher from 1, so a gap in these numbers means that messages were lost.
"""

from __future__ import annotations

from collections.abc import Collection

#: Silence of the followed sender [ns] after which `OneSender` follows another sender.
_SILENT_NS = 10_000_000_000
#: Largest number of senders whose next number is stored; beyond it, the sender heard first is forgotten.
_MOST_SENDERS = 64


class Senders:
    """Follow the first sender heard until it disappears or a switch is requested."""

    def __init__(self) -> None:
        #: the followed sender; None before the first sample, and after the sender has disappeared
        self.followed: bytes | None = None
        #: number of samples of the followed sender that never arrived
        self.lost = 0
        #: number of unused samples of other senders
        self.ignored = 0
        self._next: dict[bytes, int] = {}
        self._before: frozenset[bytes] = frozenset()
        self._listed: set[bytes] = set()
        self._other: bytes | None = None

    def start(self, present: Collection[bytes]) -> None:
        """Register existing senders; messages that they have sent until now do not count as lost."""
        self._before = frozenset(present)

    def start_late(self, sender: bytes) -> None:
        """Register a sender; its messages before the first sample heard from it do not count as lost."""
        self._before |= {sender}

    def hear(self, sender: bytes, number: int, count: int = 1) -> bool:
        """Count the arrival of a sender's sample `number` (from 1), or of `count` samples from it on.

        Returns whether the sender is followed.
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
            # a late message was counted as lost before
            self.lost += number - expected if number >= expected else -1 if self.lost else 0
        else:
            self.ignored += count
            self._other = sender
        self._next[sender] = number + count if number >= expected else expected
        return followed

    def alive(self, present: Collection[bytes]) -> None:
        """Update the present senders; if the followed sender is gone, follow the next sender heard.

        A sender that was never among the present senders is not gone: it may not have been discovered yet.
        """
        gone = self._listed.difference(present)
        self._listed = set(present)
        if self.followed in gone:
            self.followed = None
        if self._other in gone:
            self._other = None

    def switch(self) -> bool:
        """Follow the most recently heard other sender; return False if there is no other sender."""
        if self._other is None:
            return False
        self._other, self.followed = self.followed, self._other
        return True


class OneSender:
    """Follow the first sender heard until it disappears, or is silent for 10 s while another sender sends."""

    def __init__(self) -> None:
        self.followed: bytes | None = None
        self.ignored = 0
        self._heard_ns = 0
        self._listed: set[bytes] = set()

    def hear(self, sender: bytes, now_ns: int) -> bool:
        """Register a message at a time [ns] of the steady clock; return whether its sender is followed."""
        if self.followed is None or now_ns - self._heard_ns > _SILENT_NS:
            self.followed = sender
        if sender != self.followed:
            self.ignored += 1
            return False
        self._heard_ns = now_ns
        return True

    def alive(self, present: Collection[bytes]) -> None:
        """Update the present senders, as in `Senders`."""
        if self.followed in self._listed.difference(present):
            self.followed = None
        self._listed = set(present)
