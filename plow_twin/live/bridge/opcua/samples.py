"""Combine the values of OPC UA nodes into samples by their stamps."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from typing import Final

#: Value of a node that was not measured, or that the twin must not use.
NOT_MEASURED: Final = ""
Value = float | str
_MOST_WAITING: Final = 10_000


class Samples:
    """Samples of a role. A sample consists of the values of all nodes of the role at one stamp.

    A server does not send a value that has not changed, so the last value of a node replaces a missing value. A sample
    is complete when each node has a value at the stamp of the sample or at a later stamp. An incomplete sample is
    returned after `wait_s` [s].
    """

    def __init__(self, nodes: Sequence[str], wait_s: float) -> None:
        self._wait_s = wait_s
        self._stamps_ns: list[int] = []
        #: arrival time of the first value at each stamp [s], and the values at the stamp by node
        self._waiting: dict[int, tuple[float, dict[str, Value]]] = {}
        self.newest_ns = dict.fromkeys(nodes, 0)
        self._held: dict[str, Value] = {}
        #: nodes that have only a value from before the first sample
        self._begun: set[str] = set()
        self._released_ns = 0
        #: values with stamps too far ahead of the system time, in the form of `_waiting`
        self._strays: dict[int, tuple[float, dict[str, Value]]] = {}
        #: number of late samples that were dropped because values were missing
        self._incomplete = 0

    def add(self, node: str, stamp_ns: int, value: Value, now_s: float) -> None:
        """Add a value. A second value of the same node with the same stamp is ignored."""
        if stamp_ns == self.newest_ns[node]:
            return
        # the first stamp after the start of a server may be wrong, so an older stamp replaces it
        self.newest_ns[node] = stamp_ns if node in self._begun else max(stamp_ns, self.newest_ns[node])
        self._begun.discard(node)
        if stamp_ns not in self._waiting:
            insort(self._stamps_ns, stamp_ns)
            self._waiting[stamp_ns] = (now_s, {})
        self._waiting[stamp_ns][1].setdefault(node, value)

    def add_stray(self, node: str, stamp_ns: int, value: Value, now_s: float) -> None:
        """Add a value with an impossible stamp as a separate sample, which the intake will refuse."""
        self._strays.setdefault(stamp_ns, (now_s, {}))[1].setdefault(node, value)

    def begin(self, node: str, stamp_ns: int, value: Value) -> None:
        """Store the value of a node before the first sample, for samples without a value of the node."""
        self.newest_ns[node] = stamp_ns
        self._begun.add(node)
        self._held[node] = value

    def take(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        """Return the samples that are complete at the time `now_s` [s], or that have waited for `wait_s` [s], in order.

        A sample is a stamp [ns] and the values of all nodes.
        """
        samples = []
        while self._stamps_ns and self._is_due(self._stamps_ns[0], now_s):
            stamp_ns = self._stamps_ns.pop(0)
            late = stamp_ns <= self._released_ns
            values = self._waiting.pop(stamp_ns)[1] if late else self._with_held(stamp_ns)
            if len(values) == len(self.newest_ns):
                samples.append((stamp_ns, values))
            else:  # an incomplete sample at the start is not a loss
                self._incomplete += late
        return samples + self._take_strays(now_s)

    def _take_strays(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        due = sorted(
            stamp_ns
            for stamp_ns, (arrived_s, values) in self._strays.items()
            if len(values) == len(self.newest_ns) or now_s - arrived_s > self._wait_s
        )
        samples = []
        for stamp_ns in due:
            values = self._held | self._strays.pop(stamp_ns)[1]
            if len(values) == len(self.newest_ns):
                samples.append((stamp_ns, values))
        return samples

    def take_incomplete(self) -> int:
        """Return the number of late samples that were dropped since the last call."""
        sample, self._incomplete = self._incomplete, 0
        return sample

    def _is_due(self, stamp_ns: int, now_s: float) -> bool:
        arrived_s, values = self._waiting[stamp_ns]
        missing = self.newest_ns.keys() - values.keys()
        if not missing or now_s - arrived_s > self._wait_s or len(self._stamps_ns) > _MOST_WAITING:
            return True
        return stamp_ns > self._released_ns and all(self.newest_ns[node] > stamp_ns for node in missing)

    def _with_held(self, stamp_ns: int) -> dict[str, Value]:
        """Return the values at a stamp, and the last values of the nodes without a value at the stamp."""
        self._held |= self._waiting.pop(stamp_ns)[1]
        self._released_ns = stamp_ns
        return dict(self._held)
