"""Choice of the sender to follow among several senders of one input, and the count of its lost samples.

The middleware numbers the messages of each publisher from 1 on. A gap in the numbers is a loss on the way or in an
overrun queue; this holds at any rate, and in bursts too.
"""

from __future__ import annotations

from collections.abc import Collection

#: Silence of the followed sender [ns] after which `OneSender` follows another sender.
_SILENT_NS = 10_000_000_000
#: Largest number of senders whose message numbers are kept; when there are more, the oldest sender is forgotten.
_MOST_SENDERS = 64


class Senders:
    """Follow the first sender heard until it disappears or a switch is requested."""

    def __init__(self) -> None:
        #: the followed sender; None before the first sample and after the sender has disappeared
        self.followed: bytes | None = None
        #: number of samples that the followed sender sent and that never arrived
        self.lost = 0
        #: number of samples of other senders, which are not used
        self.ignored = 0
        self._next: dict[bytes, int] = {}
        self._before: frozenset[bytes] = frozenset()
        self._listed: set[bytes] = set()
        self._other: bytes | None = None

    def start(self, present: Collection[bytes]) -> None:
        """Note the senders that are present already; their messages until now are not counted as lost."""
        self._before = frozenset(present)

    def start_late(self, sender: bytes) -> None:
        """Note a sender whose messages before its first heard sample are not counted as lost."""
        self._before |= {sender}

    def hear(self, sender: bytes, number: int, count: int = 1) -> bool:
        """Add the arrival of sample `number` (from 1) of a sender, or of `count` samples from this number on.

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
            # a message that arrives after all is no longer lost
            self.lost += number - expected if number >= expected else -1 if self.lost else 0
        else:
            self.ignored += count
            self._other = sender
        self._next[sender] = number + count if number >= expected else expected
        return followed

    def alive(self, present: Collection[bytes]) -> None:
        """Note the present senders; when the followed sender has disappeared, the next sender heard is followed.

        A sender that was never among the present senders may not have been discovered yet, and has not disappeared.
        """
        gone = self._listed.difference(present)
        self._listed = set(present)
        if self.followed in gone:
            self.followed = None
        if self._other in gone:
            self._other = None

    def switch(self) -> bool:
        """Follow the other sender that was heard last; return False if there is none."""
        if self._other is None:
            return False
        self._other, self.followed = self.followed, self._other
        return True


class OneSender:
    """Follow the first sender heard until it disappears, or is silent for 10 s while another sender sends."""

    def __init__(self) -> None:
        #: the followed sender; None before the first message and after the sender has disappeared
        self.followed: bytes | None = None
        #: number of messages of other senders, which are not used
        self.ignored = 0
        self._heard_ns = 0
        self._listed: set[bytes] = set()

    def hear(self, sender: bytes, now_ns: int) -> bool:
        """Add the arrival of a message at a steady time [ns]; return whether its sender is followed."""
        if self.followed is None or now_ns - self._heard_ns > _SILENT_NS:
            self.followed = sender
        if sender != self.followed:
            self.ignored += 1
            return False
        self._heard_ns = now_ns
        return True

    def alive(self, present: Collection[bytes]) -> None:
        """Note the present senders, as in `Senders`."""
        if self.followed in self._listed.difference(present):
            self.followed = None
        self._listed = set(present)
