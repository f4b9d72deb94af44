"""Values of OPC UA nodes combined into samples by their stamps."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from typing import Final

#: Marks a value that the twin does not use; it counts as not measured.
NOT_MEASURED: Final = ""
Value = float | str
#: Largest number of stamps that wait for values.
_MOST_WAITING: Final = 10_000


class Samples:
    """Samples of one role; a sample is the values of the role's nodes at one stamp.

    A server does not resend an unchanged value, so a node without a value at a stamp is assumed to keep its last value.
    A stamp is complete when each node has a value at this stamp or at a later stamp. An incomplete stamp waits for
    `wait_s`.

    Parameters
    ----------
    nodes
        The nodes of the role.
    wait_s
        Longest time between the arrivals of values with one stamp [s].
    """

    def __init__(self, nodes: Sequence[str], wait_s: float) -> None:
        self._wait_s = wait_s
        self._stamps_ns: list[int] = []
        #: for each stamp, the time at which its first value arrived [s], and its values by node
        self._waiting: dict[int, tuple[float, dict[str, Value]]] = {}
        #: stamp of the newest value of each node [ns]
        self.newest_ns = dict.fromkeys(nodes, 0)
        self._held: dict[str, Value] = {}
        #: nodes whose only value so far is from before the first sample
        self._begun: set[str] = set()
        self._released_ns = 0
        #: samples with impossible stamps (too far ahead of the system's time), by stamp
        self._strays: dict[int, tuple[float, dict[str, Value]]] = {}
        #: number of late stamps that were dropped because values were missing
        self._incomplete = 0

    def add(self, node: str, stamp_ns: int, value: Value, now_s: float) -> None:
        """Add a value; a second value of the same node at the same stamp is ignored."""
        if stamp_ns == self.newest_ns[node]:
            return
        # a starting server may stamp the first value by another clock, so later values may have older stamps
        self.newest_ns[node] = stamp_ns if node in self._begun else max(stamp_ns, self.newest_ns[node])
        self._begun.discard(node)
        if stamp_ns not in self._waiting:
            insort(self._stamps_ns, stamp_ns)
            self._waiting[stamp_ns] = (now_s, {})
        self._waiting[stamp_ns][1].setdefault(node, value)

    def add_stray(self, node: str, stamp_ns: int, value: Value, now_s: float) -> None:
        """Add a value with an impossible stamp; its sample is passed on separately, to be counted."""
        self._strays.setdefault(stamp_ns, (now_s, {}))[1].setdefault(node, value)

    def begin(self, node: str, stamp_ns: int, value: Value) -> None:
        """Store the value that a node had before the first sample; it completes the first sample."""
        self.newest_ns[node] = stamp_ns
        self._begun.add(node)
        self._held[node] = value

    def take(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        """Return the stamps [ns] that no longer wait at `now_s`, in order, each with all nodes' values."""
        found = []
        while self._stamps_ns and self._is_due(self._stamps_ns[0], now_s):
            stamp_ns = self._stamps_ns.pop(0)
            late = stamp_ns <= self._released_ns
            values = self._waiting.pop(stamp_ns)[1] if late else self._with_held(stamp_ns)
            if len(values) == len(self.newest_ns):
                found.append((stamp_ns, values))
            else:  # a sample that lacks values at the start is not a loss
                self._incomplete += late
        return found + self._take_strays(now_s)

    def _take_strays(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        """Return the samples with impossible stamps that no longer wait at `now_s`."""
        due = sorted(
            stamp_ns
            for stamp_ns, (arrived_s, values) in self._strays.items()
            if len(values) == len(self.newest_ns) or now_s - arrived_s > self._wait_s
        )
        found = []
        for stamp_ns in due:
            values = self._held | self._strays.pop(stamp_ns)[1]
            if len(values) == len(self.newest_ns):
                found.append((stamp_ns, values))
        return found

    def take_incomplete(self) -> int:
        """Return how many late stamps were dropped since the last call because values were missing."""
        found, self._incomplete = self._incomplete, 0
        return found

    def _is_due(self, stamp_ns: int, now_s: float) -> bool:
        arrived_s, values = self._waiting[stamp_ns]
        missing = self.newest_ns.keys() - values.keys()
        if not missing or now_s - arrived_s > self._wait_s or len(self._stamps_ns) > _MOST_WAITING:
            return True
        return stamp_ns > self._released_ns and all(self.newest_ns[node] > stamp_ns for node in missing)

    def _with_held(self, stamp_ns: int) -> dict[str, Value]:
        """Return the values at a stamp, completed by the unchanged values of the stamp before."""
        self._held |= self._waiting.pop(stamp_ns)[1]
        self._released_ns = stamp_ns
        return dict(self._held)
