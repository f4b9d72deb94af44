"""Alarms for published values, with two levels, hysteresis and a minimum duration.

The highest level that an alarm has reached since its last acknowledgement is its *latched* level. Alarms read no clock,
so a replay raises the same alarms.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.solve.totals import summary
from plow_twin.stream.intake import NS_PER_S
from plow_twin.stream.outputs import CLEARANCE_NAMES, Published, Rows

#: An alarm leaves a level when its value falls below `HYSTERESIS` times the threshold of that level.
HYSTERESIS: Final = 0.95
#: Time [ns] over which the growth rate of the clearance is computed. Wear is too slow for a rate from two successive
#: clearances.
RATE_SPAN_NS: Final = 10 * NS_PER_S
#: Time [ns] for which the poses of the model are stored, so that a late measured pose can be compared with the model.
_KEPT_NS: Final = 2 * NS_PER_S
_PRUNED: Final = 500
_MOST_WAITING: Final = 1000


class Level(IntEnum):
    """Severity of an alarm; the numbers are the levels of a `diagnostic_msgs/DiagnosticStatus`."""

    NONE = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Thresholds:
    """Smallest values of an alarm with the level WARN and with the level ERROR; 0 disables a level."""

    warn: float = 0.0
    error: float = 0.0

    def level(self, value: float, before: Level) -> Level:
        """Return the level of an alarm with the new `value` and the previous level `before`, with hysteresis."""
        level_reached = Level.NONE
        for level, threshold in ((Level.WARN, self.warn), (Level.ERROR, self.error)):
            bound = threshold * HYSTERESIS if before >= level else threshold
            if threshold > 0.0 and value >= bound:
                level_reached = level
        return level_reached


@dataclass(frozen=True)
class Raised:
    """Cause of a latched level; `place` is the name of a pair or an axis, or empty for a quantity without a place."""

    value: float
    threshold: float
    stamp_ns: int
    place: str = ""


@dataclass
class Alarm:
    """Alarm for one quantity, with a present level and a latched level."""

    thresholds: Thresholds
    value: float = 0.0
    level: Level = Level.NONE
    latched: Level = Level.NONE
    raised: Raised | None = None
    _since_ns: int | None = None
    #: smallest threshold above 0; while the value is below this threshold, an alarm with the level NONE does not change
    lowest: float = field(init=False)

    def __post_init__(self) -> None:
        thresholds = (self.thresholds.warn, self.thresholds.error)
        self.lowest = min((threshold for threshold in thresholds if threshold > 0.0), default=math.inf)

    def feed(self, value: float, stamp_ns: int, duration_ns: int) -> bool:
        """Update the level for a new value, and return whether the level has changed.

        The level rises only after the value has stayed above a threshold for `duration_ns`.
        """
        self.value = value
        before = self.level
        if not before and value < self.lowest:
            self._since_ns = None
            return False
        level = self.thresholds.level(value, before)
        if level <= before:
            self.level, self._since_ns = level, None
            return level != before
        if self._since_ns is None or stamp_ns < self._since_ns:
            self._since_ns = stamp_ns
        if stamp_ns - self._since_ns < duration_ns:
            return False
        self.level, self._since_ns = level, None
        if level > self.latched:
            self.latched = level
            self.raised = Raised(value, self._threshold(), stamp_ns)
        return True

    def _threshold(self) -> float:
        return self.thresholds.error if self.latched is Level.ERROR else self.thresholds.warn

    def acknowledge(self) -> None:
        """Lower the latched level to the present level."""
        self.latched = self.level
        if not self.level:
            self.raised = None
        elif self.raised is not None:
            self.raised = replace(self.raised, threshold=self._threshold())

    def stays(self, values: NDArray[np.float64]) -> bool:
        """Return whether the level is NONE and all `values` leave it at NONE."""
        if self.level or self.lowest == math.inf:  # an alarm without a threshold never changes its level
            return not self.level
        return float(values.max(initial=-math.inf)) < self.lowest


class _Model:
    """Recent poses of the model, with which measured poses are compared.

    A measured pose that is newer than the model waits until the model reaches its stamp.
    """

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._q: list[tuple[float, float]] = []
        self._waiting: list[tuple[int, float, float]] = []

    def add(self, stamp_ns: int, x: float, y: float) -> list[tuple[int, float]]:
        """Add a pose of the model; return stamp [ns] and residual [m] of each measured pose that had to wait."""
        place = bisect_left(self._stamps_ns, stamp_ns)
        # if the stamp is not the newest, the motion is being computed again, so the old poses from this stamp on are
        # dropped
        del self._stamps_ns[place:], self._q[place:]
        self._stamps_ns.append(stamp_ns)
        self._q.append((x, y))
        kept = bisect_left(self._stamps_ns, stamp_ns - _KEPT_NS)
        if kept > _PRUNED:
            del self._stamps_ns[:kept], self._q[:kept]
        due, self._waiting = (
            [pose for pose in self._waiting if pose[0] <= stamp_ns],
            [pose for pose in self._waiting if pose[0] > stamp_ns],
        )
        return [residual for pose in due if (residual := self.residual(*pose)) is not None]

    def residual(self, stamp_ns: int, x: float, y: float) -> tuple[int, float] | None:
        """Return the stamp [ns] of a measured pose and its distance [m] from the model.

        The result is None for a pose that is too old, and for a pose that waits because it is newer than the model.
        """
        if not self._stamps_ns or stamp_ns > self._stamps_ns[-1]:
            if len(self._waiting) < _MOST_WAITING:
                self._waiting.append((stamp_ns, x, y))
            return None
        place = bisect_left(self._stamps_ns, stamp_ns)
        if place == 0 and stamp_ns < self._stamps_ns[0]:
            return None
        after_ns, before_ns = self._stamps_ns[place], self._stamps_ns[max(place - 1, 0)]
        share = 1.0 if after_ns == before_ns else (stamp_ns - before_ns) / (after_ns - before_ns)
        (x0, y0), (x1, y1) = self._q[max(place - 1, 0)], self._q[place]
        return stamp_ns, math.hypot(x0 + share * (x1 - x0) - x, y0 + share * (y1 - y0) - y)


class Alarms:
    """The alarms of one run.

    Parameters
    ----------
    thresholds
        Thresholds of each alarm, by the name of its quantity:

        - `force` [N]: largest force of a pair since the previous publication; advances without samples are ignored
        - `clearance` [m]: the larger of the horizontal and the vertical clearance
        - `clearance_rate` [m/s]: growth rate of the larger clearance over `RATE_SPAN_NS`
        - `wear_rate` [m/s]: largest wear rate of a pad
        - `residual` [m]: distance of a measured pose from the model
    duration_s
        Time [s] for which a value must stay above a threshold before the level rises.
    """

    def __init__(self, thresholds: Mapping[str, Thresholds], duration_s: float = 0.0) -> None:
        self.alarms = {name: Alarm(threshold) for name, threshold in thresholds.items()}
        self._duration_ns = round(duration_s * NS_PER_S)
        self._model = _Model() if "residual" in self.alarms else None
        self._clearances: deque[tuple[int, float]] = deque()
        #: names of the alarms with a latched level that the newest row or pose has raised
        self.raised: list[str] = []

    def feed(self, published: Published) -> Iterator[int]:
        """Update the alarms row by row, and yield the index of each row that changes a level.

        While the generator is paused at a row, the alarms have the levels at this row. Rows that were computed without
        a sample are skipped.
        """
        if len(published.rows) > 1 and self._feed_quiet(published):
            return
        slow = {int(row["row"]): row for row in published.slow} if len(published.slow) else {}
        for number in range(len(published.rows)):
            if self._feed_row(published.rows, number, slow.get(number)):
                yield number

    def _feed_row(self, rows: Rows, number: int, slow: np.void | None) -> bool:
        stamp_ns, _, held, samples, x, y, force, _ = summary(rows, number)
        if held and not samples:
            return False
        self.raised, changed = [], False
        if self._model is not None and not held:
            for at_ns, residual in self._model.add(stamp_ns, x, y):
                changed |= self._update("residual", residual, at_ns)
        changed |= self._update("force", force, stamp_ns)
        if slow is not None:
            clearance = float(slow["clearance"][:2].max())
            changed |= self._update("clearance", clearance, stamp_ns)
            changed |= self._update("wear_rate", float(slow["wear_rate"].max()), stamp_ns)
            changed |= self._update("clearance_rate", self._growth(stamp_ns, clearance), stamp_ns)
        if self.raised:
            self._place(rows[number], slow)
        return changed

    def _place(self, row: np.void, slow: np.void | None) -> None:
        where = {"force": PAIR_NAMES[int(row["measured_peak"].argmax())]}
        if slow is not None:
            axis = CLEARANCE_NAMES[int(slow["clearance"][:2].argmax())]
            pad = PAIR_NAMES[int(slow["wear_rate"].argmax())]
            where |= {"clearance": axis, "clearance_rate": axis, "wear_rate": pad}
        for name in self.raised:
            alarm = self.alarms[name]
            if alarm.raised is not None and name in where:
                alarm.raised = replace(alarm.raised, place=where[name])

    @property
    def follows_poses(self) -> bool:
        """Whether an alarm depends on measured poses."""
        return self._model is not None

    def _feed_quiet(self, published: Published) -> bool:
        """Update the alarms with many rows together; return False, without an effect, if a row might change a level."""
        rows, slow = published
        growth = self.alarms.get("clearance_rate")
        if self._model is not None or rows["held"].any() or (growth is not None and growth.lowest < math.inf):
            return False
        values = {"force": rows["measured_peak"], "wear_rate": slow["wear_rate"], "clearance": slow["clearance"][:, :2]}
        if not all(self.alarms[name].stays(found) for name, found in values.items() if name in self.alarms):
            return False
        rate, stamps_ns = 0.0, slow["stamp_ns"].tolist()
        for stamp_ns, clearance in zip(stamps_ns, values["clearance"].max(axis=1).tolist(), strict=True):
            rate = self._growth(stamp_ns, clearance)
        # no level changes, so only the newest values matter
        newest = {name: float(found[-1].max()) for name, found in values.items() if len(found)}
        for name, value in (newest | ({"clearance_rate": rate} if stamps_ns else {})).items():
            if name in self.alarms:
                self.alarms[name].feed(value, int(rows["stamp_ns"][-1]), self._duration_ns)
        return True

    def feed_pose(self, stamp_ns: int, pose: Sequence[float]) -> bool:
        """Compare a measured pose (x, y [m], theta [rad]) with the model; return whether a level has changed."""
        residual = None if self._model is None else self._model.residual(stamp_ns, pose[0], pose[1])
        if residual is None:
            return False
        self.raised = []
        return self._update("residual", residual[1], residual[0])

    def _update(self, name: str, value: float, stamp_ns: int) -> bool:
        alarm = self.alarms.get(name)
        if alarm is None:
            return False
        latched = alarm.latched
        changed = alarm.feed(value, stamp_ns, self._duration_ns)
        if alarm.latched > latched:
            self.raised.append(name)
        return changed

    def _growth(self, stamp_ns: int, clearance: float) -> float:
        """Return the growth rate of the clearance [m/s]; 0 until `RATE_SPAN_NS` has passed."""
        if self._clearances and stamp_ns <= self._clearances[-1][0]:
            self._clearances.clear()
        self._clearances.append((stamp_ns, clearance))
        while len(self._clearances) > 1 and self._clearances[1][0] <= stamp_ns - RATE_SPAN_NS:
            self._clearances.popleft()
        first_ns, first = self._clearances[0]
        span_ns = stamp_ns - first_ns
        return (clearance - first) / (span_ns * 1e-9) if span_ns >= RATE_SPAN_NS else 0.0

    @property
    def levels(self) -> dict[str, tuple[Level, Level]]:
        """Present and latched level of each alarm."""
        return {name: (alarm.level, alarm.latched) for name, alarm in self.alarms.items()}

    @property
    def worst(self) -> Level:
        """Highest present or latched level of all alarms."""
        return max((max(levels) for levels in self.levels.values()), default=Level.NONE)

    def acknowledge(self) -> list[str]:
        """Acknowledge all alarms; return the names of the alarms whose present level is above NONE."""
        for alarm in self.alarms.values():
            alarm.acknowledge()
        return [name for name, alarm in self.alarms.items() if alarm.level]
