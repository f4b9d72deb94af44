"""Output to InfluxDB by its official client, with one measurement for each group of values."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Any, Final

from influxdb_client import InfluxDBClient, Point, WritePrecision
from influxdb_client.client.write_api import SYNCHRONOUS

from plow_twin.dashboard.link import Link
from plow_twin.telemetry.output import State
from plow_twin.telemetry.values import Group, Newest

#: Largest number of points in the queue: ten minutes of all numeric groups at 1 Hz. The oldest points are dropped.
_WAITING: Final = 2000
_AT_ONCE: Final = 500
_ANSWER_MS: Final = 5000
#: Waiting time after the first failed attempt to write [s]. The time doubles with each failure up to `_LONGEST_WAIT_S`.
_FIRST_WAIT_S: Final = 1.0
_LONGEST_WAIT_S: Final = 30.0


class Influx:
    """Writer of lines `plow_twin_<group>,head=... name=value,... stamp` to a bucket of InfluxDB.

    `ca` is the file with the certificate of the authority that certifies the database. If `ca` is None, the authorities
    of the system are trusted.
    """

    def __init__(self, url: str, org: str, bucket: str, token: str, ca: str | None) -> None:
        self.state = State(trouble="no connection yet")
        self._client = InfluxDBClient(url, token, org=org, timeout=_ANSWER_MS, ssl_ca_cert=ca, enable_gzip=False)
        self._write, self._bucket = self._client.write_api(SYNCHRONOUS), bucket
        self._waiting: deque[str] = deque()
        #: lines of the present request, and the task that writes them
        self._being_sent: list[str] = []
        self._writing: asyncio.Task[None] | None = None
        self._wait_s, self._again_s = 0.0, 0.0

    async def open(self, link: Link, newest: Newest) -> None:
        """Do nothing, because each request opens its own connection."""

    async def send(self, changed: dict[str, Group], newest: Newest) -> None:
        """Queue the groups that have changed."""
        for name, group in changed.items():
            line = line_of(name, group, str(newest.facts.get("head", "")))
            if line:
                self._waiting.append(line)
        self._limit()

    async def turn(self) -> None:
        """Write the queued lines in the background, because a database may take long to answer."""
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write_all())

    async def close(self, patience_s: float) -> None:
        """Try to write the queued lines one last time. Lines that are not written in time are counted as lost."""
        if patience_s:
            await self.turn()
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=patience_s)
        self.state.lost += len(self._waiting) + len(self._being_sent)
        self._client.close()

    async def _write_all(self) -> None:
        """Write the queued lines, but not during the wait after a failed attempt."""
        while self._waiting and time.monotonic() >= self._again_s:
            self._being_sent = [self._waiting.popleft() for _ in range(min(len(self._waiting), _AT_ONCE))]
            try:
                await asyncio.to_thread(self._write.write, self._bucket, record="\n".join(self._being_sent))
            except Exception as error:  # the type depends on the answer of the database
                self._fail(error)
            else:
                self.state.sent += len(self._being_sent)
                self.state.connected, self.state.trouble, self._wait_s = True, "", 0.0
                self._being_sent = []

    def _fail(self, error: Any) -> None:
        """Record a failure; drop the lines if the database has rejected their content."""
        self.state.connected = False
        status = getattr(error, "status", None)
        reason = f"{status} {error.reason}" if status else str(error) or type(error).__name__
        self.state.trouble = f"not written: {reason}"[:300]
        lines, self._being_sent = self._being_sent, []
        if status in (400, 413, 422):
            self.state.lost += len(lines)
        else:
            self._waiting.extendleft(reversed(lines))
            self._limit()
        self._wait_s = min(max(2.0 * self._wait_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)
        self._again_s = time.monotonic() + self._wait_s

    def _limit(self) -> None:
        while len(self._waiting) + len(self._being_sent) > _WAITING:
            self._waiting.popleft()
            self.state.lost += 1


def line_of(name: str, group: Group, head: str) -> str:
    """Return a group as a line of the InfluxDB protocol, or an empty text if no value is known."""
    point = Point(f"plow_twin_{name}")
    if head:
        point = point.tag("head", head)
    for key, value in group.values.items():
        if value is not None:
            point = point.field(key, value)
    stamp_ns = round(group.time_s * 1e9) if group.time_s else time.time_ns()
    return str(point.time(stamp_ns, WritePrecision.NS).to_line_protocol())
