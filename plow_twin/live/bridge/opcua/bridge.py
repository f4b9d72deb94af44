"""Receive samples from an OPC UA server by a subscription, and read missed samples from the history of the server.

The server sends single values, which the class `Samples` combines into samples.
"""

from __future__ import annotations

import asyncio
import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Final

from asyncua import ua
from asyncua.ua.uaerrors import UaError

from plow_twin.access import is_loopback
from plow_twin.live.bridge.access import Access, host_and_port
from plow_twin.live.bridge.opcua.link import PUBLISHING_MS, Link, Revised
from plow_twin.live.bridge.opcua.readings import Counts, overflowed, reading
from plow_twin.live.bridge.opcua.samples import Samples
from plow_twin.live.bridge.source import BATCH, Bridge, BridgeError
from plow_twin.live.part import Part
from plow_twin.record.map_file import OPCUA, SERVER_STAMP, SOURCE_STAMP
from plow_twin.record.mapping import Role
from plow_twin.record.merging import StampOf
from plow_twin.record.sources import Arrived, TopicType

#: Largest number of samples in the queue. If the queue is full, new samples are counted as lost, and samples from the
#: history wait.
_QUEUE: Final = 100_000
_PORTS: Final = {"opc.tcp": 4840}
#: Longest wait for all values with the same stamp [s]: five publishing intervals. The values arrive in one or two
#: messages.
_WAIT_S: Final = 5e-3 * PUBLISHING_MS
#: Time span of the history that is read at a time [ns].
_PIECE_NS: Final = 10_000_000_000
#: Largest assumed delay of the values of a node behind the values of another node [ns].
_OVERLAP_NS: Final = 1_000_000_000
#: Largest plausible lead of a stamp ahead of the system time [ns]. Values with a larger lead are not used to find gaps.
_AHEAD_NS: Final = 86_400_000_000_000
#: Largest assumed delay until a sent value is available in the history [s].
_HISTORY_LAG_S: Final = 5.0
#: Longest wait for the first values of a subscription [s]. A server sends these values immediately.
_FIRST_VALUES_S: Final = 10.0
_FIRST_WAIT_S: Final = 1.0
_LONGEST_WAIT_S: Final = 30.0


class OpcUa(Bridge):
    """Subscription to the nodes of a mapping, which is renewed after a broken connection.

    Each role of the mapping is a topic, and its fields are nodes. `rate_hz` is the expected rate of the samples [Hz];
    with 0, the fastest sampling of the server is requested. With `waits`, `start` does not wait for the connection,
    otherwise it waits for up to `connect_s` [s]. The function `on_arrival` is called, in another thread, when samples
    have arrived. Raise `BridgeError` if the address, a node identifier or the set of certificates is invalid, or if the
    connection is not encrypted.
    """

    def __init__(
        self,
        access: Access,
        roles: Mapping[str, Role],
        rate_hz: float = 0.0,
        connect_s: float = 20.0,
        *,
        waits: bool = False,
        on_arrival: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        self._access, self._connect_s, self._waits = access, connect_s, waits
        _, self.host, self.port = host_and_port(access, _PORTS, has_path=True)
        _check_encryption(access, self.host)
        self._sampling_ms = 1e3 / rate_hz if rate_hz else 0.0
        self._roles = {role.topic: role for role in roles.values() if role.message_type == OPCUA}
        if not self._roles:
            raise BridgeError("mapping: got no role with nodes, expected fields like fx: {node: 'ns=2;s=Load.Fx'}")
        self._nodes = sorted({node for role in self._roles.values() for node in role.fields.values()})
        self._ids = [_node_id(node) for node in self._nodes]
        self._samples = {
            topic: Samples(sorted(set(role.fields.values())), _WAIT_S) for topic, role in self._roles.items()
        }
        #: topics that use each node, by number of the node
        self._topics_of = [
            [topic for topic, role in self._roles.items() if node in role.fields.values()] for node in self._nodes
        ]
        #: namespaces of the server at the first connection
        self._uris: list[str] = []
        self._counts = Counts()
        self._revised: Revised | None = None
        self._queue: deque[Arrived] = deque()
        self._arrived = threading.Event()
        self._on_arrival = on_arrival or self._arrived.set
        self._answer = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="opcua", daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._link: Link | None = None
        #: lists of values that wait for the end of a read of the history, and whether values before each list were
        #: lost; None if values are used immediately
        self._held_back: list[tuple[list[tuple[int, Any]], bool]] | None = None
        #: monotonic time at which the connection broke [s], or None while it exists
        self._broken_s: float | None = None
        #: reason why the history cannot be read, or an empty text if it can be read
        self._no_history = ""
        logging.getLogger("asyncua").addHandler(logging.NullHandler())

    def topics(self) -> dict[str, TopicType]:
        """Return the roles as topics, which all have the type `OPCUA`."""
        return dict.fromkeys(self._roles, OPCUA)

    def start(self, topics: list[str], stamp_ns: StampOf[Arrived] | None = None) -> None:
        """Connect to the server and subscribe to all nodes."""
        self._thread.start()
        if self._waits:
            return
        if not self._answer.wait(self._connect_s):
            self.trouble = f"no answer within {self._connect_s:g} s"
        if not self.connected:
            trouble = self.trouble
            self.close()
            raise BridgeError(
                trouble if trouble.startswith(("node:", self._access.url)) else f"{self._access.url}: {trouble}"
            )

    def poll(self, timeout_s: float) -> list[Arrived]:
        """Return the samples that have arrived."""
        if not self._queue:
            self._arrived.wait(timeout_s)
        self._arrived.clear()
        return [self._queue.popleft() for _ in range(min(len(self._queue), BATCH))]

    def close(self) -> None:
        """Disconnect."""
        self._stop.set()
        if self._loop is not None and self._task is not None:
            with suppress(RuntimeError):  # the event loop has already ended
                self._loop.call_soon_threadsafe(self._task.cancel)
        if self._thread.is_alive():
            self._thread.join()

    def part(self) -> Part:
        """Return the part `source` of the diagnostics."""
        revised, complaint = self._revised, ""
        values = {"server": self._access.url, "connected": str(self.connected).lower()}
        if revised is not None:
            values |= {key: f"{value:g}" for key, value in asdict(revised).items()}
            complaint = revised.complaint(self._sampling_ms)
        counts = asdict(self._counts)
        if self._broken_s is not None:
            counts["unfilled_s"] += time.monotonic() - self._broken_s
        values |= {key: f"{value:g}" for key, value in counts.items()}
        values["no_history"] = self._no_history
        message = self.trouble or complaint
        return int(bool(message)), message, values

    def _run(self) -> None:
        with suppress(asyncio.CancelledError):
            asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop, self._task = asyncio.get_running_loop(), asyncio.current_task()
        wait_s = _FIRST_WAIT_S
        while not self._stop.is_set():
            link = Link(self._access, self.host, self._ids, self._uris, self._sampling_ms, self._take, self._counts)
            try:
                await self._follow(link)
            except Exception as error:  # for a malformed answer, asyncua raises various errors
                self.trouble = self._words(error)
            finally:
                wait_s = _FIRST_WAIT_S if self.connected else wait_s
                if self.connected and not self._stop.is_set():
                    self._broken_s = time.monotonic()
                    self._counts.breaks += 1
                self.connected, self._held_back = False, None
                await link.close()
            if not (self._waits or self._answer.is_set()):  # if the first attempt fails, the twin does not start
                self._answer.set()
                return
            await asyncio.sleep(wait_s * random.uniform(0.5, 1.0))
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    async def _follow(self, link: Link) -> None:
        self._held_back, self._no_history, self._link = [], "", link
        self._revised = await link.open()
        self._uris = self._uris or link.uris
        self.connected, self.trouble = True, ""
        self._answer.set()
        if self._broken_s is not None:
            values, self._broken_s = await self._first_values(), None
            self._counts.breaks_filled += await self._fill(values)
        await self._release()
        while not self._stop.is_set() and not link.trouble:
            await asyncio.sleep(_WAIT_S)
            self._pass_on(time.monotonic())
        if link.trouble:
            self.trouble = f"the connection broke: {link.trouble}; reconnecting"

    async def _first_values(self) -> list[tuple[int, Any]]:
        """Return the first values of the new subscription, up to which the history is read."""
        give_up = time.monotonic() + _FIRST_VALUES_S
        while not self._held_back and time.monotonic() < give_up:
            await asyncio.sleep(0.01)
        return self._held_back[0][0] if self._held_back else []

    async def _release(self) -> None:
        while self._held_back:
            waiting, self._held_back = self._held_back, []
            for values, lost in waiting:
                await self._take_now([item for item in values if not self._is_known(*item)], lost)
        self._held_back = None

    async def _take(self, values: list[tuple[int, Any]], lost: bool) -> None:
        """Use values from the server, after the history if values before them were lost."""
        if self._held_back is not None:
            self._held_back.append((values, lost))
            return
        self._held_back = []
        try:
            await self._take_now(values, lost)
        finally:
            await self._release()

    async def _take_now(self, values: list[tuple[int, Any]], lost: bool) -> None:
        overflows = sum(overflowed(value) for _, value in values)
        self._counts.overflows += overflows
        if (lost or overflows) and any(min(samples.newest_ns.values()) for samples in self._samples.values()):
            await self._fill(values)
            values = [item for item in values if not self._is_known(*item)]
        now_s = time.monotonic()
        for number, value in values:
            self._add(number, value, now_s)
        self._pass_on(now_s)

    def _stamp_ns(self, number: int, value: Any) -> int:
        found = reading(value, self._by_server(number), Counts())
        return 0 if found is None else found[0]

    def _is_known(self, number: int, value: Any) -> bool:
        """Return whether a value has already been read from the history.

        A value with a much older stamp counts as new, because the clock of the server must have been set back.
        """
        stamp_ns = self._stamp_ns(number, value)
        return stamp_ns > 0 and 0 <= self._newest_ns(number) - stamp_ns < _PIECE_NS

    def _by_server(self, number: int) -> bool:
        return self._roles[self._topics_of[number][0]].stamp == SERVER_STAMP

    def _newest_ns(self, number: int) -> int:
        return self._samples[self._topics_of[number][0]].newest_ns[self._nodes[number]]

    def _add(self, number: int, value: Any, now_s: float) -> None:
        found = reading(value, self._by_server(number), self._counts)
        if found is not None:
            for topic in self._topics_of[number]:
                samples, node = self._samples[topic], self._nodes[number]
                if found[0] > time.time_ns() + _AHEAD_NS:
                    samples.add_stray(node, *found, now_s)
                elif samples.newest_ns[node] or topic == "travel":
                    # the first speed is used immediately, because it is valid until the next speed
                    samples.add(node, *found, now_s)
                else:
                    samples.begin(node, *found)

    async def _fill(self, up_to: list[tuple[int, Any]]) -> bool:
        """Read the values before the values `up_to` from the history; return whether no value is missing."""
        ends_ns: dict[int, int] = {}
        for number, value in up_to:
            stamp_ns = self._stamp_ns(number, value)
            if 0 < stamp_ns < time.time_ns() + _AHEAD_NS:
                ends_ns.setdefault(number, stamp_ns)
        if not self._no_history:
            try:
                await self._read_history(ends_ns)
            except UaError as error:
                self._no_history = self._words(error)
        missing_ns = max((end_ns - self._newest_ns(number) for number, end_ns in ends_ns.items()), default=0)
        if missing_ns <= 0:
            return True
        self._counts.unfilled_s += missing_ns * 1e-9
        self.lost += 1
        return False

    async def _read_history(self, ends_ns: Mapping[int, int]) -> None:
        """Read the history until each node has reached its stamp in `ends_ns`."""
        end_ns = max(ends_ns.values(), default=time.time_ns())
        reached_ns, count = 0, 0
        give_up = time.monotonic() + _HISTORY_LAG_S
        while any(self._newest_ns(number) < end for number, end in ends_ns.items()):
            newest_ns = max(self._newest_ns(number) for number in range(len(self._nodes)))
            reached_ns = max(reached_ns, newest_ns - _OVERLAP_NS)
            piece_ns = min(reached_ns + _PIECE_NS, end_ns)
            new = await self._take_piece(reached_ns, piece_ns)
            count += new
            if piece_ns < end_ns:
                reached_ns = piece_ns
            elif new:
                give_up = time.monotonic() + _HISTORY_LAG_S
            elif time.monotonic() > give_up:
                break
            else:
                await asyncio.sleep(0.2)
        if not count and any(self._newest_ns(number) < end for number, end in ends_ns.items()):
            self._no_history = "the history of the server is empty"

    async def _take_piece(self, begin_ns: int, end_ns: int) -> int:
        """Use the new values of the history between two stamps [ns], and return their number."""
        assert self._link is not None
        values = await self._link.history(begin_ns, end_ns)
        new = [item for item in values if self._stamp_ns(*item) > self._newest_ns(item[0])]
        within_interval = [item for item in new if self._stamp_ns(*item) <= end_ns + _OVERLAP_NS]
        self._counts.history_strays += len(new) - len(within_interval)
        self._counts.values_filled += len(within_interval)
        now_s = time.monotonic()
        for number, value in within_interval:
            self._add(number, value, now_s)
        self._pass_on(float("-inf"))
        while len(self._queue) > _QUEUE // 2:
            await asyncio.sleep(0.01)
        return len(within_interval)

    def _pass_on(self, now_s: float) -> None:
        log_ns = time.time_ns()
        for topic, samples in self._samples.items():
            for stamp_ns, values in samples.take(now_s):
                if len(self._queue) >= _QUEUE:
                    self.lost += 1
                    continue
                content = {SOURCE_STAMP: stamp_ns, SERVER_STAMP: stamp_ns, **values}
                self._queue.append(Arrived(topic, log_ns, content))
            self.lost += samples.take_incomplete()
        if self._queue:
            self._on_arrival()

    def _words(self, error: BaseException) -> str:
        if isinstance(error, BridgeError):
            return str(error)
        if isinstance(error, TimeoutError):
            return f"no server at {self.host}:{self.port}: no answer"
        kind = "refused" if isinstance(error, UaError) else f"no server at {self.host}:{self.port}"
        return f"{kind}: {error or type(error).__name__}"


def _node_id(text: str) -> ua.NodeId:
    try:
        return ua.NodeId.from_string(text)
    except (UaError, ValueError) as error:
        raise BridgeError(f"node: got {text!r}, expected an identifier like 'ns=2;s=Load.Fx' or 'ns=2;i=7'") from error


def _check_encryption(access: Access, host: str) -> None:
    files = (access.certificate, access.key, access.ca)
    if any(files) and not all(files):
        raise BridgeError("certificates: expected --tls-cert, --tls-key and --tls-ca (of the server) together")
    if bool(access.user_certificate) != bool(access.user_key):
        raise BridgeError("user: expected --user-cert and --user-key together")
    if access.user_certificate and (access.user or not all(files)):
        raise BridgeError("user: --user-cert replaces --user, and needs --tls-cert, --tls-key and --tls-ca")
    if not any(files) and not access.plain and not is_loopback(host):
        raise BridgeError(
            f"{access.url}: got another machine without certificates, expected --tls-cert or this machine"
        )
