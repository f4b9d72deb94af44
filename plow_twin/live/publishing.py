"""From a publication of the session to the front, the recording and the alarms, with what is counted on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from plow_twin.live.parameters import Settings
from plow_twin.record.alarms import ALARMS, alarms_message
from plow_twin.record.messages import DiagnosticStatus, JointState
from plow_twin.record.outputs import quality
from plow_twin.stream.alarms import Alarms
from plow_twin.stream.health import DurationHistogram
from plow_twin.stream.outputs import Publication

if TYPE_CHECKING:
    from plow_twin.live.recording import Recording

#: Topic of the marks.
QUALITY: Final = "quality"


class Front(Protocol):
    """Where samples come from and messages go.

    Attributes
    ----------
    name : str
        Name of the twin, with its namespace.
    topics : mapping
        Resolved names of the outputs by their base names.
    follows_samples : bool
        Whether time is that of the samples alone (`/clock`, a file): nothing is held for want of them.
    """

    name: str
    topics: Mapping[str, str]
    follows_samples: bool

    def now_ns(self) -> int:
        """Return the time on the clock of the stamps [ns]."""

    def publish(self, publication: Publication, forces_sent: Callable[[], None]) -> Mapping[str, bytes] | None:
        """Send the messages of a publication; call `forces_sent` right after the forces.

        Returns the bytes that were sent by base name of the topic, none of them where nothing is recorded; None, and
        nothing is sent, when a number is not finite.
        """

    def publish_quality(self, marks: JointState) -> None:
        """Send the marks of a publication that has some, or follows one that had."""

    def publish_alarms(self, status: DiagnosticStatus) -> None:
        """Send the alarms."""

    def publish_estimate(self, topic: str, message: JointState) -> None:
        """Send an estimate, or what follows from it, on one of `ESTIMATES`."""

    def changed(self) -> None:
        """Take note that the state of the stream may have changed."""

    def say_error(self, text: str) -> None:
        """Log an error; may be called from another thread."""


class Publishing:
    """The way out of a live twin.

    Parameters
    ----------
    front
        Where messages go.
    settings
        Parameters of the twin.
    alarms
        What is watched.
    recording
        What was sent goes there, if anything is recorded.
    on_alarm
        Receives a text when an alarm is latched.
    """

    def __init__(
        self,
        front: Front,
        settings: Settings,
        alarms: Alarms,
        recording: Recording | None,
        on_alarm: Callable[[str], object],
    ) -> None:
        self._front, self.alarms, self.recording, self._on_alarm = front, alarms, recording, on_alarm
        self._frame_id, self._head = settings.frame_id, settings.hardware_id
        self.latency = DurationHistogram()
        self.age = DurationHistogram()
        #: publications, and those that were not published because a number was not finite
        self.published = self.withheld = 0
        #: frames computed without a sample, and frames after late samples have been worked in
        self.held_frames = self.corrected_frames = 0
        #: steady time at which what is published next was received [ns]; 0: it answers no message
        self.received_ns = 0
        self._newest: Publication | None = None

    @property
    def q(self) -> NDArray[np.float64] | None:
        """Newest pose that was published."""
        return None if self._newest is None else self._newest.q

    def publish(self, publication: Publication | None) -> None:
        """Send a publication, take note of its age and its alarms, and hand it to the recording."""
        if publication is None:
            return
        sent = self._front.publish(publication, self._forces_sent)
        if sent is None:
            self.withheld += 1
            return
        self._newest, marks = publication, None
        if publication.marked:
            self.held_frames += publication.held
            self.corrected_frames += publication.corrected
            marks = quality(publication, self._frame_id)
            self._front.publish_quality(marks)
        self.published += 1
        changed = self.alarms.take(publication)
        if self.received_ns and not self._front.follows_samples:
            self.age.add((time.time_ns() - publication.stamp_ns) * 1e-9)
        if self.recording:
            self.recording.publication(publication, sent)
            if marks is not None:
                self.recording.message(QUALITY, publication.stamp_ns, marks)
        if changed:
            self.alarms_changed(publication.stamp_ns)

    def alarms_changed(self, stamp_ns: int) -> None:
        """Send the alarms, a level of which has changed."""
        self.send_alarms(stamp_ns)
        if self.alarms.raised:
            self._on_alarm(f"alarm: {', '.join(self.alarms.raised)}")

    def send_alarms(self, stamp_ns: int) -> None:
        """Send the alarms as they are."""
        status = alarms_message(self.alarms, self._front.name, self._head)
        self._front.publish_alarms(status)
        if self.recording:
            self.recording.message(ALARMS, stamp_ns, status)

    def _forces_sent(self) -> None:
        if self.received_ns:
            self.latency.add((time.monotonic_ns() - self.received_ns) * 1e-9)
