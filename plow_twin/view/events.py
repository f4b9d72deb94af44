"""The event log of a recording: touches, changes of status, parameter changes, silences and losses."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.alarms import ALARMS
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.stream.journal import Entry, Failed, Hold, Loss, Mark, Parameter, Reset, SetWear, Travel, Unload, Unused
from plow_twin.view.columns import Array, Batches, Indexes, TimeAxis

_LEVELS = ("INFO", "WARN", "ERROR", "WARN")


class Events:
    """Writer of the event log."""

    def __init__(self, stream: rr.RecordingStream, axis: TimeAxis) -> None:
        #: Number of lines, and number of failed advances.
        self.count = self.failed = 0
        self._lines = Batches(stream, axis, "events", rr.TextLog, ("text", "level"))
        self._makes_before: NDArray[np.float64] | None = None
        self._status: dict[str, tuple[int, str]] = {}
        self.silent = False
        self._speed_m_s: float | None = None

    def add(self, stamp_ns: int, step: int, text: str, level: str = "INFO") -> None:
        """Write a line."""
        self.count += 1
        self._lines.add(stamp_ns, step, text=[text], level=[level])

    def sample(self, stamp_ns: int, step: int) -> None:
        """Write that the excitation has returned, if it was silent before."""
        if self.silent:
            self.add(stamp_ns, step, "excitation is back")
        self.silent = False

    def entry(self, stamp_ns: int, step: int, entry: Entry | Dropped, excitation_source: str) -> None:
        """Write an entry of the journal if it is an event."""
        match entry:
            case Hold() | Unload():
                if not self.silent and excitation_source != "scene":
                    subject = "the last load is held" if isinstance(entry, Hold) else "the load falls to zero"
                    self.add(stamp_ns, step, f"excitation silent: {subject}", "WARN")
                    self.silent = True
            case Travel(_, speed):
                # sensors repeat an unchanged speed many times per second
                if speed != self._speed_m_s:
                    self.add(stamp_ns, step, f"travel along the face at {speed:g} m/s")
                self._speed_m_s = speed
            case Reset(_, reason):
                self.add(stamp_ns, step, f"reset: {reason}", "WARN")
            case SetWear(_, _, reason):
                self.add(stamp_ns, step, f"wear of the pads set: {reason}", "WARN")
            case Parameter(name, value):
                self.add(stamp_ns, step, f"parameter {name} = {value}")
            case Failed(stamp_ns, since_ns, advances, reason):
                self.failed += advances
                more = "an advance failed" if stamp_ns == since_ns else f"{advances} more advances failed after this"
                self.add(stamp_ns, step, f"{more}: {reason}", "ERROR")
            case Mark(_, text):
                self.add(stamp_ns, step, f"mark: {text}", "WARN")
            case Unused(topic, sender, reason, count):
                self.add(stamp_ns, step, f"{count} on {topic} from {sender} not used: {reason}", "WARN")
            case Loss(count):
                self.add(stamp_ns, step, f"{count} journal entries were lost before this", "ERROR")
            case Dropped(topic, count):
                self.add(stamp_ns, step, f"{count} messages on {topic} were not recorded before this", "ERROR")

    def peaks(self, stamps: Indexes, steps: Indexes, makes: Array, peak: Array) -> None:
        """Write the touches in rows of `contact_peaks`.

        `makes`, shape (n, 8), are cumulative numbers of touches. `peak`, shape (n, 8), are the largest forces [N].
        """
        if not len(stamps):
            return
        before = makes[:1] if self._makes_before is None else self._makes_before[None]
        new = np.diff(np.concatenate((before, makes)), axis=0)
        self._makes_before = makes[-1].copy()
        for row, pair in zip(*np.nonzero(new > 0.0), strict=True):
            count = new[row, pair]
            times = "" if count == 1 else f", {count:.0f} times"
            text = f"{PAIR_NAMES[pair]} touches{times}, up to {peak[row, pair] / 1e3:.1f} kN"
            self.add(int(stamps[row]), int(steps[row]), text)

    def forget(self) -> None:
        """Restart the count of touches at the next row, because rows are missing before it."""
        self._makes_before = None

    def status(self, stamp_ns: int, step: int, message: DiagnosticStatus) -> None:
        """Write a status or the alarms if they have changed."""
        now = (message.level, message.message)
        if now != self._status.get(message.name):
            subject = "alarms" if message.name.endswith(f": {ALARMS}") else "status"
            self.add(stamp_ns, step, f"{subject}: {message.message}", _LEVELS[min(message.level, 3)])
        self._status[message.name] = now

    def flush(self) -> None:
        """Send the buffered lines."""
        self._lines.flush()
