"""Sender of a twin's newest values and peaks to a separate process, at a fixed rate.

If an update does not fit in the buffer of the link, its peaks and newest values become part of the next update.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.dashboard.link import Link, number, numbers
from plow_twin.live.part import Part
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.stream.intake import NS_PER_S
from plow_twin.stream.outputs import CLEARANCE_NAMES, Published

Array = NDArray[np.float64]

RATE_HZ: Final = 10.0
#: Largest number of publications that wait to be summarised.
_MOST: Final = 256
_EVENTS: Final = 20
_LONGEST: Final = 1000
#: Largest number of operator requests that are handled in one call.
_MOST_REQUESTS: Final = 8
_NO_LOAD: Final = np.full(3, np.nan)
#: States of a clearance that has a measured value, written out because the import of `estimate` takes long.
_KNOWN_STATES: Final = ("estimated", "rough")


class Motion:
    """The newest motion, and the extremes since the last call of `clear`."""

    def __init__(self) -> None:
        #: Stamp [ns] that the motion has reached; 0 before the first stamp.
        self.stamp_ns = 0
        self.pose = np.full(3, np.nan)
        self.penetration = np.full(PAIR_COUNT, np.nan)
        self.force = np.full(PAIR_COUNT, np.nan)
        self.clearance: Array | None = None
        #: The newest estimate. It is empty if newer clearances have been published.
        self.estimate: Mapping[str, str] = {}
        self.status: Mapping[str, str] = {}
        self.load = _NO_LOAD
        self.held = False
        self.clear()

    def clear(self) -> None:
        """Reset the extremes."""
        self.peak = np.zeros(PAIR_COUNT)
        #: 5 % and 95 % points of the peaks, shape (2, 8), or None if the points are unknown.
        self.points: Array | None = None
        self.lowest = self.highest = self.load
        self.was_held = False

    def add_load(self, wrench: Array) -> None:
        """Add loads Fx, Fy [N], M [N m], shape (n, 3)."""
        self.load = wrench[-1]
        self.lowest = np.fmin(self.lowest, np.fmin.reduce(wrench))
        self.highest = np.fmax(self.highest, np.fmax.reduce(wrench))

    def add_peaks(self, peak: Array) -> None:
        """Add the largest forces [N] since the previous row, shape (n, 8)."""
        self.peak = np.maximum(self.peak, peak.max(axis=0))

    def add_points(self, low: Array, high: Array) -> None:
        """Add the 5 % and 95 % points [N] of the largest forces, shape (n, 8) each."""
        points = np.stack((low.max(axis=0), high.max(axis=0)))
        self.points = points if self.points is None else np.maximum(self.points, points)

    def add_rows(self, waiting: list[Published]) -> None:
        """Add publications of a twin."""
        # numpy concatenates single columns thirty times faster than records
        rows = [published.rows for published in waiting]
        newest = rows[-1][-1]
        self.stamp_ns = int(newest["stamp_ns"])
        self.pose, self.penetration, self.force = newest["q"], newest["penetration"], newest["force"]
        self.add_peaks(_joined(rows, "peak"))
        if waiting[-1].with_intervals:
            self.add_points(_joined(rows, "peak_low"), _joined(rows, "peak_high"))
        self.held = bool(newest["held"])
        self.was_held |= bool(_joined(rows, "held").any())
        slow = next((published.slow for published in reversed(waiting) if len(published.slow)), None)
        if slow is not None:
            self.set_clearance(slow["clearance"][-1])

    def set_clearance(self, values: Array) -> None:
        """Set the clearances of a publication [m], in the order of `CLEARANCE_NAMES`."""
        self.clearance, self.estimate = values, {}

    def _clearances(self, values: Array) -> dict[str, float | None]:
        clearance = {name: number(value) for name, value in zip(CLEARANCE_NAMES, values.tolist(), strict=True)}
        for axis in [axis for axis in ("horizontal", "vertical") if self.status.get(axis) in _KNOWN_STATES]:
            for name in (axis, f"{axis}/p05", f"{axis}/p95"):
                if name in self.estimate:
                    clearance[name] = number(float(self.estimate[name]))
        return clearance

    def update(self) -> dict[str, Any]:
        """Return the values for the page."""
        facts = {
            "t": self.stamp_ns * 1e-9,
            "pose": numbers(self.pose),
            "penetration": numbers(self.penetration),
            "force": numbers(self.force),
            "peak": numbers(self.peak),
            "load": numbers(self.load),
            "load_low": numbers(self.lowest),
            "load_high": numbers(self.highest),
            "held": self.held,
            "was_held": self.was_held,
        }
        if self.points is not None:
            facts["points"] = numbers(self.points.ravel())
        if self.clearance is not None:
            facts["clearance"] = self._clearances(self.clearance)
        return facts


class Feed:
    """Sender of updates to the screen, or to a receiver of telemetry.

    The updates come from a twin in this process, or from the topics or the recording of a twin in another process.

    Parameters
    ----------
    link
        Link to the process that receives the updates.
    facts
        Facts about the machine (`facts.facts_of`).
    answer
        Function that carries out the operator request `acknowledge`, or the request `mark` with a text. It returns
        whether the request succeeded, and an answer.
    load
        Function that returns the load Fx, Fy [N], M [N m] at the newest publication, shape (3,).
    on_error
        Callback that receives the reason when the feed has ended.
    process
        Name of the process.
    consequence
        Consequence for the user when the process ends.
    by_second
        Whether an update is sent for each second of the stamps, even if samples arrive faster than in real time.
    """

    def __init__(
        self,
        link: Link,
        facts: dict[str, Any],
        answer: Callable[[str, str], tuple[bool, str]] | None = None,
        load: Callable[[], Array] | None = None,
        on_error: Callable[[str], object] = lambda text: None,
        process: str = "the server of the screen",
        consequence: str = "nothing is shown any more",
        *,
        by_second: bool = False,
    ) -> None:
        self._link, self._answer, self._load, self._on_error = link, answer, load, on_error
        self._by_second = by_second
        self._end = f"{process} has ended: {consequence}, but the twin continues"
        self.report: dict[str, Any] = {}
        self._ended = False
        self._news: dict[str, Any] = {"facts": {**facts, "can_ask": answer is not None}}
        self._parts: dict[str, Part] = {}
        self._events: list[dict[str, Any]] = []
        self._waiting: list[Published] = []
        self._loads: list[Array] = []
        self.motion = Motion()
        self._second = 0
        #: Number of updates that were sent, and number of updates that did not fit in the buffer.
        self.taken = self.not_taken = 0
        #: Whether the newest update did not fit in the buffer.
        self.blocked = False

    def publication(self, published: Published) -> None:
        """Add a publication with at least one row to the next update."""
        second = int(published.rows["stamp_ns"][-1]) // NS_PER_S
        if self._by_second and second != self._second and self._waiting:
            self.send()
        self._second = second
        self._waiting.append(published)
        if self._load is not None:
            self._loads.append(self._load())
        if len(self._waiting) >= _MOST:
            self._sum_up()

    def part(self, name: str, part: Part) -> None:
        """Add a status, which replaces the previous status with the same name."""
        level, message, values = part
        # the diagnostics have a part `estimate` too, with the key `estimates`
        if name == "estimate" and "estimates" not in values:
            self._sum_up()  # publications before the estimate come first
            self.motion.estimate = values
        elif name == "status":
            self.motion.status = values
        self._parts[name] = level, message[:_LONGEST], {key: text[:_LONGEST] for key, text in values.items()}

    def event(self, kind: str, text: str, *, done: bool = True, stamp_ns: int | None = None) -> None:
        """Add an event, by default at the newest stamp."""
        at_ns = self.motion.stamp_ns if stamp_ns is None else stamp_ns
        self._events.append({"t": at_ns * 1e-9, "kind": kind, "text": text[:_LONGEST], "done": done})
        del self._events[:-_EVENTS]

    def turn(self) -> None:
        """Handle operator requests and send an update. Call this method at the rate of the updates."""
        self.receive()
        self.send()
        if self._link.broken and not self._ended:
            self._ended = True
            self._on_error(self._end)

    def receive(self) -> None:
        """Handle operator requests, and receive reports of the process."""
        for _ in range(_MOST_REQUESTS):
            request = self._link.receive()
            if request is None:
                break
            if request.get("do") == "report":
                self.report = request
            else:
                self._do(request)

    def send(self) -> bool:
        """Send an update. If the update does not fit in the buffer of the link, count it and return False."""
        self._sum_up()
        update: dict[str, Any] = {**self._news, "not_taken": self.not_taken}
        if self._parts:
            update["parts"] = self._parts
        if self._events:
            update["events"] = self._events
        if self.motion.stamp_ns:
            update["motion"] = self.motion.update()
        self.blocked = not self._link.send(update)
        if self.blocked:
            self.not_taken += 1
            return False
        self.taken += 1
        self._news, self._parts, self._events = {}, {}, []
        self.motion.clear()
        return True

    def _sum_up(self) -> None:
        if self._waiting:
            self.motion.add_rows(self._waiting)
            self._waiting = []
        if self._loads:
            self.motion.add_load(np.array(self._loads))
            self._loads = []

    def _do(self, request: dict[str, Any]) -> None:
        action, text = str(request.get("do")), str(request.get("text", ""))
        if self._answer is None or action not in ("acknowledge", "mark"):
            self.event(action, "not possible here", done=False)
            return
        done, answer = self._answer(action, text)
        self.event(action, f"{text}: {answer}" if text and done else answer, done=done)


def _joined(rows: list[NDArray[np.void]], name: str) -> NDArray[Any]:
    return np.concatenate([part[name] for part in rows])
