"""Which of several senders of one input is followed, and how many of its samples never arrived.

A sender numbers its messages from 1 on, as the middleware does for each publisher: a gap in the numbers is loss, on the
way or in an overrun queue, at any rate and in bursts.
"""

from __future__ import annotations

from collections.abc import Collection

#: Silence after which another sender is followed, if no switch can be requested [ns].
_SILENT_NS = 10_000_000_000
#: Senders whose numbers are remembered; the oldest is forgotten.
_MOST_SENDERS = 64


class Senders:
    """Follow the first sender heard until it disappears or a switch is requested."""

    def __init__(self) -> None:
        #: the sender followed; None before the first sample and after it has gone
        self.followed: bytes | None = None
        #: samples that the followed sender sent and that never arrived
        self.lost = 0
        #: samples of the other senders, which are not used
        self.ignored = 0
        #: changes from one sender to another
        self.switches = 0
        self._next: dict[bytes, int] = {}
        self._before: frozenset[bytes] = frozenset()
        self._listed: set[bytes] = set()
        self._other: bytes | None = None

    def start(self, present: Collection[bytes]) -> None:
        """Note the senders that were present before: their messages until now are no loss."""
        self._before = frozenset(present)

    def start_late(self, sender: bytes) -> None:
        """Note that messages of a sender before the first heard sample need not be loss."""
        self._before |= {sender}

    def hear(self, sender: bytes, number: int, count: int = 1) -> bool:
        """Add the arrival of sample `number` (from 1) of a sender, or of `count` from there on.

        Return whether that sender is followed.
        """
        expected = self._next.get(sender)
        if expected is None:
            expected = number if sender in self._before else 1
            if len(self._next) >= _MOST_SENDERS:
                self._next.pop(next(name for name in self._next if name != self.followed))
        if self.followed is None:
            self._follow(sender)
        followed = sender == self.followed
        if followed:
            # a message that comes after all is no longer a loss
            self.lost += number - expected if number >= expected else -1 if self.lost else 0
        else:
            self.ignored += count
            self._other = sender
        self._next[sender] = number + count if number >= expected else expected
        return followed

    def alive(self, present: Collection[bytes]) -> None:
        """Note the present senders; when the followed sender has disappeared, the next sender heard is followed.

        A sender that was never in such a list may still be entering it, and has not disappeared.
        """
        gone = self._listed.difference(present)
        self._listed = set(present)
        if self.followed in gone:
            self.followed = None
        if self._other in gone:
            self._other = None

    def switch(self) -> bool:
        """Follow the other sender heard last; False without one."""
        if self._other is None:
            return False
        other, self._other = self._other, self.followed
        self._follow(other)
        return True

    def _follow(self, sender: bytes) -> None:
        self.switches += bool(self._next)
        self.followed = sender


class OneSender:
    """Follow the first sender heard until it disappears, or is silent for 10 s while another sends."""

    def __init__(self) -> None:
        #: the sender followed; None before the first message and after it has gone
        self.followed: bytes | None = None
        #: messages of the other senders, which are not used
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
