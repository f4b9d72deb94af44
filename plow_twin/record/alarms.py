"""Configure the alarms of a run, write them as messages, and compare them with the alarms of a replay."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.cdr import encode
from plow_twin.record.entries import OutputRecord, first_difference
from plow_twin.record.header import RunHeader
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.record.times import time_text
from plow_twin.stream.alarms import Alarms, Thresholds
from plow_twin.stream.journal import Parameter, Pose
from plow_twin.stream.outputs import Published

ALARMS: Final = "alarms"
#: Name of the parameter whose entry in the journal means that an operator acknowledged the alarms.
ACKNOWLEDGED: Final = "alarms_acknowledged"
#: Unit in which an alarm's text gives each quantity, with the factor from SI to this unit.
_UNITS: Final = {
    "force": (1e-3, "kN"),
    "clearance": (1e3, "mm"),
    "clearance_rate": (3.6e6, "mm/h"),
    "wear_rate": (3.6e6, "mm/h"),
    "residual": (1e3, "mm"),
}
_NAMES: Final = ("force", "clearance", "clearance_rate", "wear_rate")

#: A field whose recorded and computed values differ: step, stamp [ns], topic, field, recorded value, computed value.
Difference = tuple[int, int, str, str, str, str]


def alarms_of(parameters: Mapping[str, Any]) -> Alarms:
    """Return new alarms with the thresholds and the duration from the node's parameters."""
    thresholds = {name: Thresholds(*parameters.get(f"alarm_{name}", ())) for name in _NAMES}
    residual = parameters.get("alarm_residual", ())
    if any(residual):
        thresholds["residual"] = Thresholds(*residual)
    return Alarms(thresholds, parameters.get("alarm_duration", 0.0))


def alarms_message(alarms: Alarms, node: str, hardware_id: str) -> DiagnosticStatus:
    """Return the status message that gives the level of each alarm and the cause of each latched alarm."""
    values: dict[str, str] = {}
    for name, alarm in alarms.alarms.items():
        raised = alarm.raised
        values |= {
            name: f"{alarm.value:.6g}",
            f"{name}_level": alarm.level.name.lower(),
            f"{name}_latched": alarm.latched.name.lower(),
            f"{name}_raised": f"{raised.value:.6g}" if raised else "",
            f"{name}_threshold": f"{raised.threshold:.6g}" if raised else "",
            f"{name}_place": raised.place if raised else "",
            f"{name}_stamp_ns": str(raised.stamp_ns) if raised else "",
        }
    text = "; ".join(alarm_texts(values)) or "none"
    return DiagnosticStatus(int(alarms.worst), f"{node}: {ALARMS}", text, hardware_id, tuple(values.items()))


def alarm_texts(values: Mapping[str, str], *, own_start: bool = False, newest: bool = False) -> list[str]:
    """Return a sentence for each latched alarm in the key-value pairs `values` of an alarms message.

    The argument `newest` adds the present value to each sentence, and `own_start` is passed to `time_text`.
    """
    texts = []
    for name, (factor, unit) in _UNITS.items():
        stamp = values.get(f"{name}_stamp_ns")
        if not stamp:
            continue
        raised, threshold = (float(values[f"{name}_{key}"]) * factor for key in ("raised", "threshold"))
        place, level = values[f"{name}_place"], values[f"{name}_latched"]
        place = f" {'at' if place in PAIR_NAMES else 'along'} {place}" if place else ""
        title = "error" if level == "error" else "warning"
        time = time_text(int(stamp), own_start=own_start)
        limit = f"{title} threshold {threshold:.4g} {unit}"
        now = f", now {float(values[name]) * factor:.4g} {unit}" if newest else ""
        texts.append(f"{name.replace('_', ' ')} {raised:.4g} {unit}{place}, {limit}, at {time}{now}")
    return texts


class AlarmCheck:
    """Compute the alarms of a run from its journal, and compare each computed message with the recorded message.

    Alarms cannot be compared after a missing publication, because an alarm depends on all earlier publications.
    """

    def __init__(self, header: RunHeader, possible: bool) -> None:
        self._header = header
        self._alarms = alarms_of(header.parameters)
        self._computed: deque[tuple[int, int, DiagnosticStatus]] = deque()
        self._recorded: deque[OutputRecord] = deque()
        self.possible = possible
        #: number of recorded messages that were compared, and number of messages that could not be compared
        self.compared = self.not_compared = 0

    def give_up(self) -> None:
        """Stop the comparison, because a publication or a journal entry is missing."""
        self.possible = False
        self.not_compared += len(self._recorded)
        self._recorded.clear()
        self._computed.clear()

    def pose(self, sequence: int, step: int, pose: Pose) -> None:
        """Update the alarms with a measured pose from the journal."""
        if self.possible and self._alarms.feed_pose(pose.stamp_ns, pose.pose):
            self._say(sequence, step)

    def parameter(self, sequence: int, step: int, parameter: Parameter) -> None:
        """Update the alarms if the parameter is an acknowledgement."""
        if self.possible and parameter.name == ACKNOWLEDGED:
            self._alarms.acknowledge()
            self._say(sequence, step)

    def published(
        self,
        sequence: NDArray[np.int64],
        step: NDArray[np.int64],
        published: Published,
        poses: Sequence[tuple[int, int, Pose]] = (),
    ) -> None:
        """Update the alarms with publications and with the measured poses between the publications.

        `sequence` and `step`, shape (n,), are the number of the journal entry and the step number of each publication.
        The same two numbers precede each pose in `poses`.
        """
        if not self.possible:
            return
        if not self._alarms.follows_poses:
            self._take(sequence, step, published)
            return
        waiting = deque(poses)
        for index, place in enumerate(sequence.tolist()):
            while waiting and waiting[0][0] <= place:
                self.pose(*waiting.popleft())
            self._take(sequence[index:], step[index:], published.at(index))
        for pose in waiting:
            self.pose(*pose)

    def _take(self, sequence: NDArray[np.int64], step: NDArray[np.int64], published: Published) -> None:
        if len(published.rows) == 1 and not published.finite:
            return  # the twin does not send a publication that contains NaN or infinity
        for index in self._alarms.feed(published):
            self._say(int(sequence[index]), int(step[index]))

    def recorded(self, record: OutputRecord) -> None:
        """Queue a recorded message for comparison."""
        if self.possible:
            self._recorded.append(record)
        else:
            self.not_compared += 1

    def differences(self) -> Iterator[Difference]:
        """Yield the differences between recorded and computed messages.

        Each message waits in a queue until its counterpart exists.
        """
        while self._recorded and self._computed:
            record, (sequence, step, computed) = self._recorded.popleft(), self._computed.popleft()
            self.compared += 1
            if record.sequence != sequence:
                difference = "place in the journal", str(record.sequence), str(sequence)
            elif record.data != encode(computed):
                difference = first_difference(record, computed)
            else:
                continue
            yield step, record.publish_time_ns, ALARMS, *difference

    def left_over(self, step: int, newest: int) -> Iterator[Difference]:
        """Yield the messages that still have no counterpart at the end of a complete recording.

        A recorded message without a computed message gets the step number `step` of the last advance. The alarms of the
        newest publication, with the number `newest`, may be missing, because a kill can end the file before them.
        """
        for record in self._recorded:
            self.compared += 1
            yield step, record.publish_time_ns, ALARMS, "message", "a message", "none"
        for sequence, at, _ in self._computed:
            if sequence != newest % 2**32:
                yield at, 0, ALARMS, "message", "none", "a message"

    def _say(self, sequence: int, step: int) -> None:
        hardware_id = str(self._header.parameters.get("hardware_id", ""))
        self._computed.append((sequence, step, alarms_message(self._alarms, self._header.node, hardware_id)))
