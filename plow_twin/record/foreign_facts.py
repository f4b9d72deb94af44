"""Summarize a recording of another program, which is read with the help of a mapping."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plow_twin.record.mapping import messages_of, read_map, readings, with_units
from plow_twin.record.sources import open_source


@dataclass
class _SignalStatistics:
    """Statistics of the messages of one role. The ranges are those of the `used` messages, which fit the role."""

    used: int = 0
    unfit: int = 0
    first_ns: int = 0
    last_ns: int = 0
    least: dict[str, float] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)

    def add(self, reading: tuple[int, dict[str, float]] | None) -> None:
        if reading is None:
            self.unfit += 1
            return
        stamp_ns, values = reading
        self.first_ns = min(self.first_ns, stamp_ns) if self.used else stamp_ns
        self.last_ns = max(self.last_ns, stamp_ns) if self.used else stamp_ns
        self.used += 1
        for name, value in values.items():
            if math.isfinite(value):
                self.least[name] = min(self.least.get(name, value), value)
                self.largest[name] = max(self.largest.get(name, value), value)

    def facts(self, topic: str) -> dict[str, Any]:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return {
            "topic": topic,
            "messages": self.used,
            "unfit": self.unfit,
            "span_s": span_s,
            "rate_hz": (self.used - 1) / span_s if span_s > 0.0 else None,
            "values": {name: [self.least[name], self.largest[name]] for name in self.least},
        }


def foreign_facts(path: Path, mapping: Path | None, units: Mapping[str, str]) -> tuple[dict[str, Any], bool]:
    """Read a recording of another program from front to back, and return a summary.

    Returns
    -------
    facts : dict
        Types of the topics, counts of losses, and a dictionary for each role. The dictionary contains:

        - the topic
        - the number of messages that fit the role, and the number of messages that do not fit it
        - the span [s], the rate [Hz] and the ranges of the quantities [SI units] of the messages that fit
    lossy : bool
        Whether a part of the recording could not be read, or messages do not fit their role.

    Raises
    ------
    RecordingError
        The recording or the mapping cannot be used.
    """
    source = open_source(path)
    topics = source.topics()
    roles = with_units(read_map(mapping, topics), units)
    signals = {name: _SignalStatistics() for name in roles}
    for name, _, reading in readings(messages_of(source, roles), roles):
        signals[name].add(reading)
    lost = {key: count for key, count in source.losses.counts.items() if count}
    facts = {
        "file": str(path),
        "topics": {topic: str(kind) for topic, kind in topics.items()},
        "roles": {name: seen_signal.facts(roles[name].topic) for name, seen_signal in signals.items()},
        "lost": lost,
    }
    return facts, bool(lost) or any(signal.unfit for signal in signals.values())
