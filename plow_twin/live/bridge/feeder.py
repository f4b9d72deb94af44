"""Pass the messages of a bridge to the inputs of a live twin.

Lost messages are counted by the numbers of the sender. A message without a number gets the next number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from plow_twin.live.bridge.source import Messages
from plow_twin.live.bridge.table import Table
from plow_twin.live.inputs import OPTIONAL
from plow_twin.live.load_model import LoadModel
from plow_twin.live.runtime import Runtime
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.map_file import ROLES
from plow_twin.record.mapping import Role, roles_by_topic
from plow_twin.record.messages import Message
from plow_twin.record.sources import Arrived
from plow_twin.stream.driver import Arrival, Block
from plow_twin.stream.intake import Intake, Verdict
from plow_twin.stream.journal import Spread

#: Largest jump of the message number within a sequence. If the message after a larger jump has the next number, the
#: sender has restarted.
_RESTART = 1000
#: Largest number of samples that count as lost between two messages. At 10 kHz, the number corresponds to a day.
_MOST_LOST = 10**9
#: Number of messages after which the number 0 or 1 means a restart of the sender. In the first messages, the number 0
#: or 1 may belong to a late message.
_FIRST = 10
#: Relative change of the standard deviation of the load above which the new deviation is written to the journal.
_NOTABLE = 0.02


class Feeder:
    """Feeder that passes messages to the runtime of a live twin.

    Roles that a live twin does not use are ignored. The function `send` receives each message of the twin. With
    `model`, the load is computed from the signals of the drive.
    """

    def __init__(
        self,
        roles: Mapping[str, Role],
        runtime: Runtime,
        send: Callable[[str, memoryview | Message], None],
        model: LoadModel | None = None,
    ) -> None:
        self._model, self._send = model, send
        self._deviation = (0.0, 0.0, 0.0)
        self._runtime = runtime
        self._by_topic = roles_by_topic(roles)
        #: newest stamp [ns]; a single stamp far ahead is not used
        self.newest_ns = 0
        self._far_ahead_ns: int | None = None
        #: reason why the first invalid load was refused
        self.unfit = ""
        self._number = 0
        #: count of messages without a number since the last message with a number
        self._assumed = 0
        #: number of messages that the sender has not counted
        self._unnumbered = 0
        #: number of the last message if it does not continue the earlier numbers, otherwise None
        self._odd: int | None = None
        self._counts = False
        self._sender = 0
        self._source = next((role.topic for name, role in roles.items() if name in ("excitation", "drive")), "")
        inputs = runtime.inputs
        self._at_once = runtime.reads_at_once
        self._optional: dict[str, Intake] = {topic: getattr(inputs, topic) for topic in OPTIONAL}
        inputs.senders.start([self._name])
        inputs.senders.alive([self._name])

    def begin(self, messages: Iterable[Arrived]) -> None:
        """Set the start time for a source whose samples advance the time.

        The start time is the first stamp after which the stamps do not jump back.
        """
        read = (role.read(arrived) for arrived in messages for _, role in self._by_topic.get(arrived.topic, ()))
        stamps = (signal[0] for signal in read if signal is not None)
        back_ns = round(self._runtime.settings.jump_back * 1e9)
        first_ns = next(stamps, 0)
        goes_on = (first for first, second in pairwise(chain([first_ns], stamps)) if second >= first - back_ns)
        self.newest_ns = next(goes_on, first_ns)

    def feed(self, messages: Messages) -> None:
        """Process messages in the order of arrival."""
        if isinstance(messages, Table) and self._feed_table(messages):
            return
        samples: list[Arrival] = []
        for arrived in messages:
            roles = self._by_topic.get(arrived.topic, ())
            for name, role in roles:
                if len(roles) > 1 and role.empty(arrived):
                    continue  # the row contains only values of other roles
                if name in ("excitation", "drive"):
                    samples += self._sample(role, arrived)
                elif name in self._optional:
                    self._measured(name, role, arrived)
        if not samples:
            return
        for stamp_ns, _ in samples:
            self._follow_time(stamp_ns)
        if self._at_once and len(samples) > 1:
            stamps, wrench = zip(*samples, strict=True)
            self._step(Block(np.array(stamps), np.array(wrench)))
        else:
            self._step(samples)

    def _step(self, arrived: list[Arrival] | Block) -> None:
        for topic, message in self._runtime.step(arrived):
            self._send(topic, message)

    def _feed_table(self, table: Table) -> bool:
        """Process the lines of a file as arrays; return False, without an effect, if they must be processed singly."""
        roles, inputs = self._by_topic.get(table.topic, []), self._runtime.inputs
        role = next((role for name, role in roles if name == "excitation"), None)
        if role is None or role.sequence or not (self._at_once and inputs.active):
            return False
        if inputs.senders.followed != self._name:
            return False
        rows = table.read(role)
        if rows is None or not role.plausible(dict(zip(role.fields, rows[1].T, strict=True))):
            return False
        for arrived in table if len(roles) > 1 else ():
            for name, other in roles:
                if name in self._optional and not other.empty(arrived):
                    self._measured(name, other, arrived)
        stamps, values = rows
        inputs.senders.count_arrival(self._name, self._number + 1, len(stamps))
        self._number += len(stamps)
        self._follow_times(stamps)
        order = [list(role.fields).index(name) for name in ROLES["excitation"]]
        self._step(Block(stamps, np.ascontiguousarray(values[:, order])))
        return True

    def _follow_times(self, stamps: NDArray[np.int64]) -> None:
        newest = np.maximum.accumulate(np.append(self.newest_ns, stamps))
        jump_ns = round(self._runtime.settings.jump_forward * 1e9)
        if self.newest_ns and self._far_ahead_ns is None and (stamps <= newest[:-1] + jump_ns).all():
            self.newest_ns = newest.item(-1)
            return
        for stamp_ns in stamps.tolist():
            self._follow_time(stamp_ns)

    def _follow_time(self, stamp_ns: int) -> None:
        """Advance the time of the source. A stamp far ahead is used only if the next stamp confirms it."""
        jump_ns = round(self._runtime.settings.jump_forward * 1e9)
        far_ns, self._far_ahead_ns = self._far_ahead_ns, None
        if far_ns is not None and stamp_ns >= far_ns - jump_ns:
            self.newest_ns = far_ns
        if not self.newest_ns or stamp_ns <= self.newest_ns + jump_ns:
            self.newest_ns = max(self.newest_ns, stamp_ns)
        else:
            self._far_ahead_ns = stamp_ns

    @property
    def _name(self) -> bytes:
        return f"{self._source}#{self._sender}".encode() if self._sender else self._source.encode()

    def _sample(self, role: Role, arrived: Arrived) -> list[Arrival]:
        intake = self._runtime.driver.intake
        found = role.read(arrived)
        if found is None and not self.unfit:
            self.unfit = role.why_unfit(arrived, with_value=True)
        stamp_ns, values = (0, {}) if found is None else found
        numbers = tuple(values.values())
        if arrived.retained:
            intake.refuse(Verdict.INACTIVE, stamp_ns, numbers)
            return []
        sender, number, again = self._numbered(role, arrived)
        if again:
            intake.refuse(Verdict.DUPLICATE, stamp_ns, numbers)
            return []
        if not self._runtime.inputs.wanted(sender, number, stamp_ns, numbers, found is not None):
            return []
        if not role.plausible(values):
            intake.refuse(Verdict.IMPLAUSIBLE, stamp_ns, numbers)
            return []
        if self._model is None:
            return [(stamp_ns, (values["fx"], values["fy"], values["m"]))]
        load = self._model.wrench(values)
        if load is None:
            intake.refuse(Verdict.MALFORMED, stamp_ns, numbers)
            return []
        wrench, deviation = load
        absurd = intake.limits is not None and intake.limits.exceeded(wrench)
        if absurd or not all(map(math.isfinite, (*wrench, *deviation))):
            return [(stamp_ns, wrench)]  # the intake will refuse this sample, so its deviation is not used
        if any(abs(new - old) > _NOTABLE * max(new, old) for new, old in zip(deviation, self._deviation, strict=True)):
            self._deviation = deviation
            self._runtime.driver.session.apply(Spread(stamp_ns, deviation))
        return [(stamp_ns, wrench)]

    def _numbered(self, role: Role, arrived: Arrived) -> tuple[bytes, int, bool]:
        number = role.number(arrived) if role.sequence else None
        if number is None:
            # the number of the next numbered message will show whether the sender has counted this message
            self._assumed += 1
            self._number += 1
            return self._name, self._number + self._unnumbered, False
        assumed, self._assumed = self._assumed, 0
        if self._counts and 0 <= self._number - number < assumed:
            self._unnumbered += self._number - number + 1
            self._number, self._odd = number, None
            return self._name, number + self._unnumbered, False
        if not self._counts:
            self._counts = True
            if self._number:  # the earlier messages had no numbers
                self._begin_anew()
            self._number = number - 1
        elif number == self._odd:
            return self._name, number, True
        elif self._goes_on(number):
            self._odd = None
        else:  # the next message will show whether the numbers have jumped or this number is wrong
            self._odd, number = number, self._number + 1
        again, self._number = number == self._number, number
        return self._name, number + self._unnumbered, again

    def _goes_on(self, number: int) -> bool:
        """Return whether a number continues the earlier numbers, or new numbers that begin with `_odd`."""
        odd, before = self._odd, self._number
        if odd is not None and abs(number - odd) < abs(number - before):
            if not before < odd <= before + _MOST_LOST:
                self._begin_anew()
                self._runtime.inputs.senders.count_arrival(self._name, odd)
                if odd <= _RESTART:
                    self._runtime.inputs.lost_at_first(self._name, max(odd - 1, 0))
            return True
        return abs(number - before) <= _RESTART and not number <= 1 < before - _FIRST

    def _begin_anew(self) -> None:
        self._sender += 1
        self._assumed = self._unnumbered = 0
        self._runtime.inputs.senders.start([self._name])
        self._runtime.inputs.senders.alive([self._name])

    def _measured(self, name: str, role: Role, arrived: Arrived) -> None:
        signal, intake, inputs = role.read(arrived), self._optional[name], self._runtime.inputs
        inputs.arriving = (name, arrived.topic.encode())
        if signal is None:
            intake.refuse(Verdict.MALFORMED)
            return
        stamp_ns, values = signal
        if arrived.retained and name != "travel":
            # a retained message is old: its speed is still valid, but its pose or gap is not
            intake.refuse(Verdict.INACTIVE, stamp_ns, tuple(values.values()))
        elif not role.plausible(values):
            intake.refuse(Verdict.IMPLAUSIBLE, stamp_ns, tuple(values.values()))
        elif name == "travel":
            self._runtime.add_travel(stamp_ns, values["speed"])
        elif name == "gaps":
            gaps = {PAIR_NAMES.index(pair): gap for pair, gap in values.items() if not math.isnan(gap)}
            self._runtime.add_gaps(stamp_ns, gaps)
        else:
            x, y, theta = (values.get(component, math.nan) for component in ROLES["head_pose"])
            self._runtime.add_pose(stamp_ns, (x, y, theta))
