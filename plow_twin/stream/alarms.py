"""Alarms on what is published: two levels, hysteresis, minimum duration, latched until acknowledged.

They follow from the publications and the acknowledgements alone, so that a replay gives the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from plow_twin.stream.intake import NS_PER_S
from plow_twin.stream.outputs import Publication

#: A level is left below this share of its threshold.
HYSTERESIS: Final = 0.95


class Level(IntEnum):
    """How serious an alarm is, by the levels of a diagnostic status."""

    NONE = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Thresholds:
    """From which value on there is a warning and an error; 0: never."""

    warn: float = 0.0
    error: float = 0.0

    def level(self, value: float, before: Level) -> Level:
        """Return the level of a value; one that is left must be left clearly."""
        found = Level.NONE
        for level, threshold in ((Level.WARN, self.warn), (Level.ERROR, self.error)):
            bound = threshold * HYSTERESIS if before >= level else threshold
            if threshold > 0.0 and value >= bound:
                found = level
        return found


@dataclass
class Alarm:
    """One quantity: its value, its level now, and the highest one since it was acknowledged."""

    thresholds: Thresholds
    value: float = 0.0
    level: Level = Level.NONE
    latched: Level = Level.NONE
    _since_ns: int | None = None

    def take(self, value: float, stamp_ns: int, duration_ns: int) -> None:
        """Take in a value; a level higher than the present one must last for `duration_ns` first."""
        self.value = value
        level = self.thresholds.level(value, self.level)
        if level <= self.level:
            self.level, self._since_ns = level, None
            return
        if self._since_ns is None or stamp_ns < self._since_ns:
            self._since_ns = stamp_ns
        if stamp_ns - self._since_ns >= duration_ns:
            self.level, self._since_ns = level, None
            self.latched = max(self.latched, level)


class Alarms:
    """The alarms of one run.

    Parameters
    ----------
    thresholds
        By name: `force` [N], the largest of a pair since the publication before; `clearance` [m], the larger of
        horizontal and vertical; `wear_rate` [m/s], the largest of a pad.
    duration_s
        How long a level must last before there is an alarm [s].
    """

    def __init__(self, thresholds: Mapping[str, Thresholds], duration_s: float = 0.0) -> None:
        self.alarms = {name: Alarm(found) for name, found in thresholds.items()}
        self._duration_ns = round(duration_s * NS_PER_S)

    def take(self, publication: Publication) -> bool:
        """Take in a publication; True when a level has changed. One without samples says nothing of the machine."""
        if publication.held:
            return False
        before = self.levels
        values = {"force": float(publication.peak.max())}
        if publication.slow is not None:
            values["clearance"] = float(publication.slow.clearance[:2].max())
            values["wear_rate"] = float(publication.slow.wear_rate.max())
        for name, value in values.items():
            if name in self.alarms:
                self.alarms[name].take(value, publication.stamp_ns, self._duration_ns)
        return self.levels != before

    @property
    def levels(self) -> dict[str, tuple[Level, Level]]:
        """Present and latched level of each alarm."""
        return {name: (alarm.level, alarm.latched) for name, alarm in self.alarms.items()}

    @property
    def latched(self) -> dict[str, Level]:
        """Highest level of each alarm since it was acknowledged."""
        return {name: alarm.latched for name, alarm in self.alarms.items()}

    @property
    def worst(self) -> Level:
        """The highest level, latched ones included."""
        return max((max(levels) for levels in self.levels.values()), default=Level.NONE)

    def acknowledge(self) -> list[str]:
        """Let go what is latched; return the names of the alarms that are still there."""
        for alarm in self.alarms.values():
            alarm.latched = alarm.level
        return [name for name, alarm in self.alarms.items() if alarm.level]
