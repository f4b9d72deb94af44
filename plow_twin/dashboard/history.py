"""History of the last hour for the screen: the extremes in each second of the stamps."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

SPAN_S: Final = 3600
#: Largest number of seconds by which an update may be older than the newest second. In a recording, the messages of a
#: second may follow the samples of the next second. A clock that steps back by more than `jump_back` resets the motion.
_BEHIND_S: Final = 2
#: Names of the clearances of each second, in the order in which the page reads them.
_CLEARANCES: Final = tuple(f"{name}{point}" for name in ("horizontal", "vertical") for point in ("", "/p05", "/p95"))


class History:
    """The seconds of the last hour. A page can request the seconds that have changed since its last update.

    A second is a list of the time [s], eight peaks, six extremes of the load, six clearances, and 1 if the load was
    held. If the intervals of the peaks are known, the list ends with the 5 % and the 95 % points of the peaks.
    """

    def __init__(self) -> None:
        self._seconds: deque[list[Any]] = deque()
        self._versions: deque[int] = deque()

    def add(self, motion: dict[str, Any], version: int) -> bool:
        """Add the motion of an update. If the stamps step back by seconds, clear the history and return True."""
        second = int(motion["t"])
        stepped_back = bool(self._seconds) and second < self._seconds[-1][0] - _BEHIND_S
        if stepped_back:
            self._seconds.clear()
            self._versions.clear()
        clearance = motion.get("clearance", {})
        row = [
            second,
            *motion["peak"],
            *motion["load_low"],
            *motion["load_high"],
            *(clearance.get(name) for name in _CLEARANCES),
            int(motion["was_held"]),
            *motion.get("points", ()),
        ]
        later = list[list[Any]]()
        while self._seconds and self._seconds[-1][0] >= second:
            later.append(self._seconds.pop())
            self._versions.pop()
        if later and later[-1][0] == second:
            row = _joined(later.pop(), row)
        # a page replaces all seconds from the changed one on
        self._seconds += [row, *reversed(later)]
        self._versions += [version] * (1 + len(later))
        while self._seconds[0][0] <= self._seconds[-1][0] - SPAN_S:
            self._seconds.popleft()
            self._versions.popleft()
        return stepped_back

    def since(self, version: int) -> list[list[Any]]:
        """Return the seconds that have changed since the update `version`."""
        count = 0
        for older in reversed(self._versions):
            if older <= version:
                break
            count += 1
        return list(self._seconds)[len(self._seconds) - count :]


def _joined(before: list[Any], now: list[Any]) -> list[Any]:
    """Merge a second with later values. The result has the extremes of peaks and loads, and the newest clearances."""
    largest = [_extreme(max, *pair) for pair in zip(before[1:9], now[1:9], strict=True)]
    lowest = [_extreme(min, *pair) for pair in zip(before[9:12], now[9:12], strict=True)]
    highest = [_extreme(max, *pair) for pair in zip(before[12:15], now[12:15], strict=True)]
    clearances = [
        later if later is not None else earlier for earlier, later in zip(before[15:21], now[15:21], strict=True)
    ]
    points = [_extreme(max, *pair) for pair in zip(before[22:], now[22:], strict=False)] or before[22:] or now[22:]
    return [now[0], *largest, *lowest, *highest, *clearances, before[21] | now[21], *points]


def _extreme(choose: Any, first: float | None, second: float | None) -> float | None:
    if first is None or second is None:
        return second if first is None else first
    extreme: float = choose(first, second)
    return extreme
