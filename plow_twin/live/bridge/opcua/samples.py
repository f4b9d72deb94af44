"""Values of OPC UA nodes combined into samples by their stamps."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from typing import Final

#: Stands for a value that is not used and counts as not measured.
NOT_MEASURED: Final = ""
Value = float | str
#: A value this much after the newest of its node [ns] is believed if the next one stays there.
FAR_NS: Final = 10_000_000_000
#: Most stamps that wait for values.
_MOST_WAITING: Final = 10_000


class Samples:
    """Samples of one role: the values of its nodes at one stamp.

    A server does not resend an unchanged value: a node without a value at a stamp keeps the value before.
    A stamp is complete when each node has a value there or at a later stamp; otherwise it waits for `wait_s`.
    A single stamp far ahead is passed on and changes nothing else.

    Parameters
    ----------
    nodes
        The nodes of the role.
    wait_s
        How long the values of a stamp may be apart when they arrive [s].
    """

    def __init__(self, nodes: Sequence[str], wait_s: float) -> None:
        self._wait_s = wait_s
        self._stamps_ns: list[int] = []
        #: time of arrival of the first value [s], and the values by node
        self._waiting: dict[int, tuple[float, dict[str, Value]]] = {}
        #: stamp of the newest value of each node [ns]
        self.newest_ns = dict.fromkeys(nodes, 0)
        self._held: dict[str, Value] = {}
        #: nodes of which only the value before the first sample has come
        self._begun: set[str] = set()
        self._released_ns = 0
        #: stamp far ahead that the next stamp may confirm [ns]; such samples, and the values of the newest of them
        self._far_ns: int | None = None
        self._strays: dict[int, tuple[float, dict[str, Value]]] = {}
        self._stray_values: dict[str, Value] = {}
        #: late stamps that were dropped because the other values of that time had been used
        self._incomplete = 0

    def add(self, node: str, stamp_ns: int, value: Value, now_s: float, *, is_asked: bool = False) -> None:
        """Add a value; the same stamp of a node again is ignored. `is_asked`: of the history, in the time asked for."""
        if stamp_ns == self.newest_ns[node]:
            return
        if not (is_asked or self._is_believed(node, stamp_ns)):
            self._strays.setdefault(stamp_ns, (now_s, {}))[1].setdefault(node, value)
            return
        # the clock of the first value, perhaps that of the starting server, does not bind later values
        self.newest_ns[node] = stamp_ns if node in self._begun else max(stamp_ns, self.newest_ns[node])
        self._begun.discard(node)
        if stamp_ns not in self._waiting:
            insort(self._stamps_ns, stamp_ns)
            self._waiting[stamp_ns] = (now_s, {})
        self._waiting[stamp_ns][1].setdefault(node, value)

    def _is_believed(self, node: str, stamp_ns: int) -> bool:
        """Return whether a stamp is near the newest ones, or near the stamp far ahead that came just before it."""
        newest_ns, far_ns = max(self.newest_ns.values()), self._far_ns
        if far_ns == stamp_ns:
            return False
        self._far_ns = None
        if not newest_ns or node in self._begun or stamp_ns <= newest_ns + FAR_NS:
            return True
        if far_ns is not None and stamp_ns >= far_ns - FAR_NS:
            self._held |= self._stray_values
            return True
        self._far_ns = stamp_ns
        return False

    def begin(self, node: str, stamp_ns: int, value: Value) -> None:
        """Take the value that a node had before the first sample, to complete that sample."""
        self.newest_ns[node] = stamp_ns
        self._begun.add(node)
        self._held[node] = value

    def take(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        """Return in order the stamps [ns] that no longer wait at `now_s`, with the value of each node."""
        found = []
        while self._stamps_ns and self._is_due(self._stamps_ns[0], now_s):
            stamp_ns = self._stamps_ns.pop(0)
            late = stamp_ns <= self._released_ns
            values = self._waiting.pop(stamp_ns)[1] if late else self._with_held(stamp_ns)
            if len(values) == len(self.newest_ns):
                found.append((stamp_ns, values))
            else:  # without all values at the start is not a loss
                self._incomplete += late
        return found + self._take_strays(now_s)

    def _take_strays(self, now_s: float) -> list[tuple[int, dict[str, Value]]]:
        """Return the samples far ahead that no longer wait at `now_s`."""
        due = sorted(
            stamp_ns
            for stamp_ns, (arrived_s, values) in self._strays.items()
            if len(values) == len(self.newest_ns) or now_s - arrived_s > self._wait_s or len(self._strays) > 1
        )
        found = []
        for stamp_ns in due:
            self._stray_values = self._strays.pop(stamp_ns)[1]
            values = self._held | self._stray_values
            if len(values) == len(self.newest_ns):
                found.append((stamp_ns, values))
        return found

    def take_incomplete(self) -> int:
        """Return the number of late stamps since the last call that were dropped because values were missing."""
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
