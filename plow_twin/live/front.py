"""Run a live twin without ROS. A bridge provides the messages, and a function receives the reports."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Protocol

from plow_twin.errors import UnitError
from plow_twin.live import diagnostics
from plow_twin.live.bridge.feeder import Feeder
from plow_twin.live.bridge.source import Bridge, BridgeError, Messages, Reporting
from plow_twin.live.load_model import read_load_model
from plow_twin.live.parameters import Settings
from plow_twin.live.part import Part, part_of
from plow_twin.live.runtime import Runtime
from plow_twin.live.solver_start import Prepared
from plow_twin.live.timer import Timer
from plow_twin.record.alarms import ALARMS, alarms_message
from plow_twin.record.map_file import OPCUA
from plow_twin.record.mapping import Role, read_map, stamps_by, with_units
from plow_twin.record.messages import DiagnosticStatus, JointState, Message
from plow_twin.record.times import time_text
from plow_twin.record.unit_check import CHECKED, check_units
from plow_twin.stream.intake import Verdict
from plow_twin.stream.outputs import Published
from plow_twin.stream.topics import TOPICS

NAME: Final = "/plow_twin"
#: Longest wait for a message [s], which is the largest delay of a requested stop.
_POLL_S: Final = 0.1
_REPORT_S: Final = 1.0
#: Share of unused samples above which a probable cause is reported.
_MANY: Final = 0.01

#: Function that receives the name and the content of a report: `status`, `alarms`, or a part of the diagnostics.
Say = Callable[[str, Part], None]


class Watcher(Protocol):
    """Receiver of all reports and publications."""

    def publication(self, published: Published) -> None:
        """Receive a publication with at least one row."""

    def part(self, name: str, part: Part) -> None:
        """Receive a report: `status`, `alarms`, or a part of the diagnostics."""


class BridgeFront:
    """Live twin that receives its messages from a bridge.

    Without the file `mapping`, columns are recognised by their names. `units` replaces units in the mapping, by name of
    the quantity (`t` for the time). `say` receives the status and the alarms when they change, and the diagnostics once
    a second. `on_error` receives errors, from any thread. Raise `BridgeError` if the source cannot be used or the
    mapping assigns no load, and `RecordingError`, `WearStateError` or `OSError` if the mapping, the recording or the
    saved wear cannot be used.
    """

    def __init__(
        self,
        bridge: Bridge,
        mapping: Path | None,
        settings: Settings,
        prepared: Prepared,
        say: Say,
        on_error: Callable[[str], None],
        units: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.name = NAME
        self.topics: Mapping[str, str] = {topic.name: f"/{topic.name}" for topic in TOPICS}
        self.follows_samples, self.sends_motion = bridge.ends, False
        self._bridge, self._settings, self._say = bridge, settings, say
        self.say_error = on_error
        self._said: Part | None = None
        model = read_load_model(mapping)
        self.roles = roles_of(bridge, mapping, settings.excitation_source, model is not None, units)
        bridge.start([role.topic for role in self.roles.values()], stamps_by(self.roles))
        self._first = deque(_first_messages(bridge) if bridge.ends else ())
        try:
            check_units(chain.from_iterable(self._first), self.roles, prepared.scene, "input")
        except UnitError:
            bridge.close()
            raise
        self._connected = {"excitation" if name == "drive" else name for name in self.roles}
        self.runtime = Runtime(self, settings, prepared)
        self._feeder = Feeder(self.roles, self.runtime, self.send, model if "drive" in self.roles else None)
        self._health = diagnostics.Health()
        #: functions that are called periodically in addition to the functions of the runtime
        self.timers: list[Timer] = []
        self._watchers: list[Watcher] = []
        self.more_parts: dict[str, Callable[[], Part]] = {}

    def attach(self, watcher: Watcher) -> None:
        """Add a watcher, which receives the present alarms, and later all reports and publications."""
        watcher.part(ALARMS, part_of(alarms_message(self.runtime.alarms, self.name, "")))
        self._watchers.append(watcher)
        self.runtime.publishing.watch = self._published

    def _published(self, published: Published) -> None:
        for watcher in self._watchers:
            watcher.publication(published)

    def now_ns(self) -> int:
        """Return the system time [ns], or the newest stamp if the samples advance the time.

        The result is never 0, because 0 means that the time is unknown.
        """
        return (self._feeder.newest_ns or 1) if self.follows_samples else time.time_ns()

    def send(self, topic: str, message: memoryview | Message) -> None:
        """Report the message if it contains alarms or an estimate. Messages of the motion are only recorded."""
        if isinstance(message, DiagnosticStatus | JointState):
            self._send_report(topic, part_of(message))

    def _send_report(self, name: str, part: Part) -> None:
        self._say(name, part)
        for watcher in self._watchers:
            watcher.part(name, part)

    def look_for_senders(self, topic: str) -> None:
        """Do nothing, because the feeder has only one sender."""

    def sender_name(self, topic: str, sender: bytes) -> str:
        """Return the name of the sender with the identifier `sender`."""
        return sender.decode(errors="replace")

    def say_alarm(self, level: int, text: str) -> None:
        """Do nothing, because the function `say` receives the alarms."""

    def time_text(self, stamp_ns: int) -> str:
        """Return a stamp as text: a date, or seconds as in the input."""
        return time_text(stamp_ns, own_start=True)

    def changed(self) -> None:
        """Report the status if it has changed."""
        level, message, values = diagnostics.summary("active", "", self.runtime)
        if (level, message, values) == self._said:
            return
        self._said = level, message, values
        self._send_report("status", self._said)
        head = self._settings.hardware_id
        self.runtime.record_status(DiagnosticStatus(level, self.name, message, head, tuple(values.items())))

    def run(self, stop_asked: Callable[[], bool], seconds: float = float("inf")) -> list[str]:
        """Process messages until the source ends, a stop is requested, or `seconds` have passed; return the losses."""
        runtime, bridge = self.runtime, self._bridge
        lost: list[str] = []
        broken = ""
        try:
            self._feeder.begin(chain.from_iterable(self._first))
            runtime.start()
            runtime.activate()
            self._loop(stop_asked, time.monotonic() + seconds)
            if not (bridge.connected or bridge.finished):
                broken = f"not connected at the end: {bridge.trouble}"
        finally:
            bridge.close()
            lost = runtime.close()
        return [*([broken] if broken else []), *self._not_read(stop_asked()), *diagnostics.failures(runtime), *lost]

    def _not_read(self, stopped: bool) -> list[str]:
        if self._settings.excitation_source != "excitation":
            return []
        intake, topic = self.runtime.driver.intake, self.roles["drive" if "drive" in self.roles else "excitation"].topic
        if not sum(intake.counts.values()):
            return [f"topic {topic}: got no sample, expected at least one"]
        if stopped and self._bridge.ends and (self._first or not self._bridge.finished):
            return [f"stopped before the end of {topic}"]
        estimation = self.runtime.estimation
        if estimation is not None and self._bridge.finished:
            if not estimation.done:
                return ["stopped before the estimate of the last window"]
            return [f"estimate: {estimation.shortage}"] if estimation.shortage else []
        return []

    def causes(self) -> list[str]:
        """Return texts about silences, and about probable causes of unused samples and resets."""
        counts, found = self.runtime.driver.intake.counts, []
        many = _MANY * max(1, sum(counts.values()))
        if self._feeder.unfit:
            found.append(f"{counts[Verdict.MALFORMED]} malformed; the first: {self._feeder.unfit}")
        # late samples of a network can also be in order, whereas the rows of a file are in the order of the measurement
        steps = self.runtime.driver.intake.steps_back if self._bridge.ends else 0
        if steps:
            largest_s = self.runtime.driver.intake.largest_step_back_ns * 1e-9
            found.append(
                f"the stamps stepped back ({steps}) by up to {largest_s:.4g} s, so the samples after a step are mixed "
                f"with earlier samples ({counts[Verdict.INSERTED]}) or dropped ({counts[Verdict.DUPLICATE]} duplicate, "
                f"{counts[Verdict.OUT_OF_ORDER]} out of order): was a clock set? Expected rising stamps"
            )
        if counts[Verdict.DUPLICATE] > many and not steps:
            found.append(
                f"{counts[Verdict.DUPLICATE]} samples have the stamp or number of another sample: "
                "do the times have too few digits?"
            )
        if counts[Verdict.UNSTAMPED]:
            found.append(
                f"{counts[Verdict.UNSTAMPED]} samples have a time that is zero, negative or after January 2038: "
                "check the unit of the time, or set clock_offset"
            )
        if counts[Verdict.NON_FINITE] > many:
            found.append(f"{counts[Verdict.NON_FINITE]} loads have a number that is not finite (nan or inf)")
        if counts[Verdict.IMPLAUSIBLE] > many:
            most = self.runtime.driver.intake.limits
            force = "" if most is None else f" (forces to {most.largest[0]:.3g} N, by {most.fastest[0]:.3g} N/s)"
            found.append(
                f"{counts[Verdict.IMPLAUSIBLE]} loads are larger or change faster than plausible{force}: "
                "check the units of load and time, or set limit_force and related limits"
            )
        estimation = self.runtime.estimation
        if estimation is not None and not (estimation.count or self._bridge.ends):
            found.append("no estimate was made, because the run ended too early")
        if silence := self.runtime.driver.silences.text():
            found.append(silence)
        if jumps := counts[Verdict.JUMP_FORWARD]:
            found.append(
                f"the stamps jumped forward ({jumps}) by more than jump_forward "
                f"({self.runtime.settings.jump_forward:g} s), and the motion was reset: are samples missing?"
            )
        if jumps := counts[Verdict.JUMP_BACK]:
            found.append(
                f"the stamps jumped back ({jumps}), and the motion was reset: are they in local time "
                "at the end of summer time, or was a clock set? Expected stamps in UTC, or with an offset"
            )
        return found

    def parts(self) -> dict[str, Part]:
        """Return the diagnostics by part."""
        parts = self._health.parts("active", "", self.runtime, time.monotonic_ns())
        parts |= {"source": self._bridge.part()} if isinstance(self._bridge, Reporting) else {}
        return parts | {name: part() for name, part in self.more_parts.items()}

    def _loop(self, stop_asked: Callable[[], bool], give_up: float) -> None:
        inputs, bridge, trouble = self.runtime.inputs, self._bridge, ""
        periodic = [Timer(1.0 / rate, do) for rate, do in self.runtime.periodic()] + [Timer(_REPORT_S, self._report)]
        periodic += self.timers
        while not stop_asked() and (self._first or not bridge.finished) and time.monotonic() < give_up:
            next_due = min(timer.due for timer in periodic)
            wait_s = max(0.0, min(_POLL_S, next_due - time.monotonic()))
            messages = self._first.popleft() if self._first else bridge.poll(wait_s)
            inputs.lost = bridge.lost
            if bridge.trouble != trouble:
                trouble = bridge.trouble
                self.say_error(trouble or "the source is connected again")
            inputs.publishers |= dict.fromkeys(self._connected, int(bridge.connected))
            if len(messages):
                if not bridge.ends:
                    inputs.waited(len(messages), (time.time_ns() - next(iter(messages)).log_time_ns) * 1e-9)
                self._feeder.feed(messages)
            for timer in periodic:
                timer.look()
        if self._settings.publish_mode == "fixed_rate":
            self.runtime.publish_due()
        estimation = self.runtime.estimation
        if estimation is not None and bridge.finished and not stop_asked():
            inputs.ended = True
            estimation.finish()
            while not (estimation.done or stop_asked() or time.monotonic() >= give_up):
                time.sleep(_POLL_S)
                for timer in periodic:
                    timer.look()
        self.changed()
        for name, part in self.parts().items() if self._watchers else ():
            for watcher in self._watchers:
                watcher.part(name, part)

    def _report(self) -> None:
        self.changed()
        # the alarms are sent here because the twin sends them only when a level changes
        self.send(ALARMS, alarms_message(self.runtime.alarms, self.name, self._settings.hardware_id))
        for name, part in self.parts().items():
            self._send_report(name, part)


def _first_messages(bridge: Bridge) -> Iterator[Messages]:
    count = 0
    while count < CHECKED and len(arrived := bridge.poll(0.0)):
        count += len(arrived)
        yield arrived


def roles_of(
    bridge: Bridge, mapping: Path | None, source: str, modelled: bool, units: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Role]:
    """Return the roles of the topics of a bridge.

    `source` is the parameter `excitation_source`, `modelled` states whether the mapping contains a load model, and
    `units` replaces units in the mapping. Raise `BridgeError` or `RecordingError` if the mapping is invalid, or assigns
    no load although `source` requires a load.
    """
    if source == "tool_forces":
        raise BridgeError("excitation_source: got 'tool_forces', expected 'excitation' or 'scene' without ROS")
    topics: Any = bridge.topics()
    if topics is None and mapping is None:
        raise BridgeError("got no mapping, expected a mapping that assigns the topics (--map)")
    roles = {name: role for name, role in read_map(mapping, topics).items() if name in _TAKEN}
    if topics is None and any(role.message_type == OPCUA for role in roles.values()):
        raise BridgeError("mapping: got nodes, expected topics: only opc.tcp://HOST:PORT has nodes")
    if ("drive" in roles) != modelled or {"drive", "excitation"} <= roles.keys():
        raise BridgeError("mapping: expected drive and load_model together, and no excitation beside them")
    if source == "excitation" and not {"drive", "excitation"} & roles.keys():
        # each type is truncated, because the first line of a file that is not a table may be long
        complaints = "; ".join(f"{topic} ({str(kind)[:120]})" for topic, kind in (topics or {}).items())
        setup = "" if topics is None else "; plow-twin setup FILE writes a mapping"
        raise BridgeError(
            f"excitation: got no load by names or mapping in {complaints}, expected the columns fx, fy, m{setup}"
        )
    for name, role in roles.items() if bridge.ends else ():
        if role.stamp == "log":
            raise BridgeError(f"{name}.stamp: got 'log', expected a column: a row of a file has no time of receipt")
    return with_units(roles, units)


_TAKEN: Final = ("excitation", "drive", "travel", "head_pose", "gaps")
