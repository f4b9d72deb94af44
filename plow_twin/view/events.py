"""The event log: touches, changes of status, settings, silences and losses, one line each."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import DiagnosticStatus, JointState
from plow_twin.stream.journal import Entry, Hold, Loss, Parameter, Reset, Sample, Travel
from plow_twin.view.columns import Batches

_LEVELS = ("INFO", "WARN", "ERROR", "WARN")


class Events:
    """Write the log; `count` is the number of its lines."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.count = 0
        self._lines = Batches(stream, "events", rr.TextLog, ("text", "level"))
        self._touches: NDArray[np.float64] | None = None
        self._status: tuple[int, str] | None = None
        self._silent = False
        self._speed_m_s: float | None = None

    def add(self, stamp_ns: int, step: int, text: str, level: str = "INFO") -> None:
        """Write one line."""
        self.count += 1
        self._lines.add(stamp_ns, step, text=[text], level=[level])

    def entry(self, stamp_ns: int, step: int, entry: Entry | Dropped, excitation_source: str) -> None:
        """Write what an entry of the journal means, if it is an event."""
        match entry:
            case Sample():
                if self._silent:
                    self.add(stamp_ns, step, "excitation is back")
                self._silent = False
            case Hold():
                if not self._silent and excitation_source != "scene":
                    self.add(stamp_ns, step, "excitation silent: the last load is held", "WARN")
                    self._silent = True
            case Travel(_, speed):
                if speed != self._speed_m_s:  # sensors repeat it many times a second
                    self.add(stamp_ns, step, f"travel along the face at {speed:g} m/s")
                self._speed_m_s = speed
            case Reset(_, reason):
                self.add(stamp_ns, step, f"reset: {reason}", "WARN")
            case Parameter(name, value):
                self.add(stamp_ns, step, f"parameter {name} = {value}")
            case Loss(count):
                self.add(stamp_ns, step, f"{count} journal entries were lost before this", "ERROR")
            case Dropped(topic, count):
                self.add(stamp_ns, step, f"{count} messages on {topic} were not recorded before this", "ERROR")

    def peaks(self, stamp_ns: int, step: int, message: JointState) -> None:
        """Write the touches since the message before."""
        if self._touches is not None:
            for pair in np.flatnonzero(message.position > self._touches):
                touches = message.position[pair] - self._touches[pair]
                times = "" if touches == 1 else f", {touches:.0f} times"
                text = f"{PAIR_NAMES[pair]} touches{times}, up to {message.effort[pair] / 1e3:.1f} kN"
                self.add(stamp_ns, step, text)
        self._touches = message.position

    def status(self, stamp_ns: int, step: int, message: DiagnosticStatus) -> None:
        """Write a status when it differs from the one before."""
        now = (message.level, message.message)
        if now != self._status:
            self.add(stamp_ns, step, f"status: {message.message}", _LEVELS[min(message.level, 3)])
        self._status = now

    def flush(self) -> None:
        """Send what has been collected."""
        self._lines.flush()
