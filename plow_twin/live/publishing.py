"""Send and record the messages of a live twin, and update its alarms and counters."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Protocol

from plow_twin.live.parameters import Settings
from plow_twin.record.alarms import ALARMS, alarm_texts, alarms_message
from plow_twin.record.messages import Message
from plow_twin.solve.totals import summary
from plow_twin.stream.alarms import Alarms
from plow_twin.stream.health import DurationHistogram
from plow_twin.stream.outputs import Published, Rows
from plow_twin.stream.session import Series

if TYPE_CHECKING:
    from plow_twin.live.recording import Recording

#: Base name of a topic and a message. A message of the motion is represented by the buffer with its bytes.
Outgoing = tuple[str, memoryview | Message]


class Front(Protocol):
    """Interface of a live twin to its transport, which delivers the samples and sends the messages.

    `name` includes the namespace, and `topics` contains the resolved name of each output topic, by base name. With
    `follows_samples`, only samples advance the time, as with `/clock` or a file. Without `sends_motion`, messages of
    the motion are only recorded.
    """

    name: str
    topics: Mapping[str, str]
    follows_samples: bool
    sends_motion: bool

    def now_ns(self) -> int:
        """Return the time on the clock of the stamps [ns], or 0 if the time is still unknown."""

    def send(self, topic: str, message: memoryview | Message) -> None:
        """Send a message on the topic with the base name `topic`."""

    def look_for_senders(self, topic: str) -> None:
        """Check whether the followed sender of an input still exists."""

    def sender_name(self, topic: str, sender: bytes) -> str:
        """Return the name of the sender with the identifier `sender`."""

    def changed(self) -> None:
        """Update the status, because the state of the stream may have changed."""

    def time_text(self, stamp_ns: int) -> str:
        """Return a stamp as text, in the form of the times in the input."""

    def say_alarm(self, level: int, text: str) -> None:
        """Log an alarm with its level."""

    def say_error(self, text: str) -> None:
        """Log an error. The method may be called from another thread."""


class Publishing:
    """Output of a live twin.

    `on_alarm` receives a text when an alarm is latched. `catch_up` computes the intervals after the forces have been
    sent; it is None if they are computed with the forces.
    """

    def __init__(
        self,
        front: Front,
        settings: Settings,
        alarms: Alarms,
        recording: Recording | None,
        on_alarm: Callable[[str], object],
        catch_up: Callable[[], object] | None = None,
    ) -> None:
        self._front, self.alarms, self.recording, self._on_alarm = front, alarms, recording, on_alarm
        self._head = settings.hardware_id
        self._messages = None
        if front.sends_motion:
            from plow_twin.record.sending import Messages

            frames = settings.frame_id, settings.child_frame_id
            self._messages = Messages(*frames, intervals=settings.follows == "full")
        self.latency = DurationHistogram()
        self.age = DurationHistogram()
        #: number of publications that were sent, and number of publications that contain NaN or infinity
        self.published = self.withheld = 0
        #: number of publications at times without a sample, and number of publications that a late sample corrected
        self.held_publications = self.corrected_publications = 0
        #: monotonic time at which the samples of the next publication were received [ns]; 0 without samples
        self.received_ns = 0
        #: while a series is processed, the stamp of the sample that changed the alarms [ns]
        self.series_ns: int | None = None
        #: last published row, shape (1,), which the next publication overwrites
        self.newest: Rows | None = None
        self._catch_up = catch_up
        self.watch: Callable[[Published], object] | None = None

    @property
    def memory(self) -> Mapping[str, memoryview]:
        """Buffer of each message of the motion, by base name of the topic."""
        return {} if self._messages is None else self._messages.memory

    def messages(self, published: Published) -> Iterator[Outgoing]:
        """Yield the messages of a publication, which has at most one row.

        If a number is not finite, no message is yielded. The forces are yielded first, and the intervals last, because
        many twins are advanced for the intervals. After the last message, the publication is counted and recorded, and
        the alarms are updated.
        """
        rows, _ = published
        if not len(rows):
            return
        sent = () if self._messages is None else self._messages.write(published)
        if not (sent or (self._messages is None and published.finite)):
            self.withheld += 1
            return
        if sent:
            yield sent[0]
        if self.received_ns:
            self.latency.add((time.monotonic_ns() - self.received_ns) * 1e-9)
        yield from sent[1:]
        if self._catch_up is not None and self._messages is not None:
            self._catch_up()
            intervals = self._messages.intervals(published)
            yield from intervals
            sent += intervals
        self.newest, (stamp_ns, marked, held, *_) = rows, summary(rows, 0)
        self.published += 1
        if marked:
            self.held_publications += held
            self.corrected_publications += int(rows["corrected"][0])
        changed = list(self.alarms.feed(published))
        if self.received_ns and not self._front.follows_samples:
            self.age.add((time.time_ns() - stamp_ns) * 1e-9)
        if self.recording:
            self.recording.publication(published, {topic: data.tobytes() for topic, data in sent})
        if self.watch is not None:
            self.watch(published)
        if changed:
            yield from self.alarms_changed(stamp_ns)

    def series(self, series: Series, journal: Callable[[Series], object]) -> Iterator[Outgoing]:
        """Write a series of samples to the journal, record its publications, and yield the alarms that it changes."""
        published, begin = series.published, 0
        if not len(published.rows):
            journal(series)
            return
        stamps = series.stamps
        self.latency.add((time.monotonic_ns() - self.received_ns) * 1e-9, len(stamps))
        self.newest = published.rows[-1:]
        self.published += len(stamps)
        for row in self.alarms.feed(published):
            part, begin = series.part(begin, row + 1), row + 1
            self._record(part, journal)
            self.series_ns = stamps.item(row)
            yield from self.alarms_changed(self.series_ns)
        self.series_ns = None
        self._record(series.part(begin, len(stamps)) if begin else series, journal)

    def _record(self, series: Series, journal: Callable[[Series], object]) -> None:
        if len(series.stamps):
            journal(series)
            if self.recording:
                self.recording.publications(series.published)

    def alarms_changed(self, stamp_ns: int) -> Iterator[Outgoing]:
        """Yield the message with the alarms, and log each alarm that was raised."""
        yield self.alarms_now(stamp_ns)
        if self.alarms.raised:
            self._on_alarm(f"alarm: {', '.join(self.alarms.raised)}")
            for name in self.alarms.raised:
                self._front.say_alarm(self.alarms.alarms[name].latched, self._text(name))

    def _text(self, name: str) -> str:
        status = alarms_message(self.alarms, self._front.name, self._head)
        return next(text for text in alarm_texts(dict(status.values)) if text.startswith(name.replace("_", " ") + " "))

    def alarms_now(self, stamp_ns: int) -> Outgoing:
        """Record and return the message with the current alarms."""
        status = alarms_message(self.alarms, self._front.name, self._head)
        if self.recording:
            self.recording.message(ALARMS, stamp_ns, status)
        return ALARMS, status
