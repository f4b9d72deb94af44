"""Determine the duration and the silences of a run from the journal. A silence is an interval without samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from plow_twin.record.entries import Entries, Holes
from plow_twin.record.journal_codec import Dropped
from plow_twin.stream.driver import Policy
from plow_twin.stream.journal import Entry, Hold, Loss, Parameter, Reset, Restore, SetWear, Unload
from plow_twin.stream.silences import Silences

_TIMEOUT = "excitation_timeout"


class RunTime:
    """Duration and silences of a run, from its journal entries in order.

    An interval without samples is a silence if it is longer than the parameter `excitation_timeout` of the node.
    """

    def __init__(self, parameters: Mapping[str, Any]) -> None:
        self.silences = Silences(float(parameters.get(_TIMEOUT, Policy.excitation_timeout_s)))
        self._holes = Holes()
        self._span_ns = 0
        self._reached_ns: int | None = None

    @property
    def span_s(self) -> float:
        """Time from the first advance to the last advance [s], without steps of the clock at resets."""
        return self._span_ns * 1e-9

    def add(self, entries: Entries) -> list[tuple[int, int, int]]:
        """Add entries, and return the silences that end at these entries.

        A silence is the index of the sample that ends it, its begin and its end [ns]. An interval with missing entries
        is not a silence.
        """
        found, done, missing = [], 0, self._holes.find(entries)
        samples = np.flatnonzero(entries.sample)
        for index in [*sorted({*entries.rest, *missing}), len(entries)]:
            part = samples[np.searchsorted(samples, done) : np.searchsorted(samples, index)]
            if len(part):
                stamps = entries.stamp_ns[part]
                self._reach(int(stamps[0]))
                self._reach(int(stamps.max()))
                found += [(int(part[place]), begin, end) for place, begin, end in self.silences.add(stamps)]
            done = index
            if index in missing:
                self.silences.restart()
            if index in entries.rest:
                self._add_entry(entries.rest[index])
        return found

    def _add_entry(self, entry: Entry | Dropped) -> None:
        match entry:
            case Hold(stamp_ns) | Unload(stamp_ns):
                self._reach(stamp_ns)
            case Reset() | SetWear() | Restore():
                self._reached_ns = None
                self.silences.restart()
            case Loss():  # a sample may be among the lost entries
                self.silences.restart()
            case Parameter(name, value) if name == _TIMEOUT:
                self.silences.timeout_s = float(value)

    def _reach(self, stamp_ns: int) -> None:
        if self._reached_ns is None:
            self._reached_ns = stamp_ns
        self._span_ns += max(0, stamp_ns - self._reached_ns)
        self._reached_ns = max(self._reached_ns, stamp_ns)
