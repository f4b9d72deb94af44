"""The screen of a recording.

While the run is being recorded, the screen shows the newest data. After the end of the run, it shows the last hour.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.dashboard.access import PageAccess
from plow_twin.dashboard.facts import facts_of
from plow_twin.dashboard.feed import RATE_HZ, Feed
from plow_twin.dashboard.screen import Screen
from plow_twin.live.part import part_of
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.entries import Batch
from plow_twin.record.follow import Tail
from plow_twin.record.header import RunHeader
from plow_twin.record.outputs import publication_templates
from plow_twin.record.reader import RunReader
from plow_twin.record.rows import Rows, poses_of, rows_by_topic
from plow_twin.record.unused import InputCounts
from plow_twin.stream.intake import NS_PER_S
from plow_twin.stream.journal import Hold, Mark
from plow_twin.stream.topics import Cadence, names_of

#: Topics with messages that are decoded one by one.
_SLOW: Final = names_of(Cadence.ESTIMATE, Cadence.CHANGE)
#: Interval between attempts to send an update [s].
_WAIT_S: Final = 2e-3


class RunFeed:
    """Feed of the screen from a recording, one second of stamps at a time, until `stopped` returns True."""

    def __init__(self, feed: Feed, header: RunHeader, stopped: Callable[[], bool]) -> None:
        self._feed, self._stopped = feed, stopped
        self._templates = publication_templates(header.frame_id, header.child_frame_id)
        self._topics = {header.topic(name): name for name in self._templates}
        self._slow = {header.topic(name): name for name in _SLOW}
        self._inputs = InputCounts(header.excitation_source)

    def add(self, batch: Batch) -> None:
        """Add a batch of the recording."""
        rows = rows_by_topic(batch.outputs, self._topics, self._templates)
        stamps_ns, wrench = batch.entries.samples()
        held_ns = []
        for _, entry in sorted(batch.entries.others.items()):
            if isinstance(entry, Hold):
                held_ns.append(entry.stamp_ns)
            elif isinstance(entry, Mark):
                self._feed.event("mark", entry.text, stamp_ns=entry.stamp_ns)
        self._inputs.add(batch.entries)
        self._feed.part("input", (0, "", {"source": self._inputs.source, **self._counted()}))
        loads, held = Rows(stamps_ns, stamps_ns, wrench), np.array(held_ns, np.int64)
        arrays = [loads.stamp_ns, held, *(rows_of_topic.stamp_ns for rows_of_topic in rows.values())]
        for second in np.unique(np.concatenate(arrays) // NS_PER_S).tolist():
            self._second(
                {name: _within(topic_rows, second) for name, topic_rows in rows.items()}, _within(loads, second)
            )
            self._feed.motion.held = bool((held // NS_PER_S == second).any())
            self._feed.motion.was_held |= self._feed.motion.held
            while not (self._feed.send() or self._stopped()):
                time.sleep(_WAIT_S)
        self._say(batch)  # last, because an estimate replaces earlier clearances

    def _counted(self) -> dict[str, str]:
        others = self._inputs.facts()
        own = others.pop(self._inputs.source, {})
        counted = {"samples_used": own.pop("used", 0), "samples_lost": own.pop("lost", 0)}
        counted |= {f"dropped_{reason}": count for reason, count in own.items()}
        for name, other_rows in others.items():
            counted |= {f"{name}_used": other_rows.pop("used", 0), f"{name}_dropped": sum(other_rows.values())}
        return {name: str(count) for name, count in counted.items()}

    def _second(self, rows: dict[str, Rows], loads: Rows) -> None:
        motion = self._feed.motion
        for rows_of_topic in (loads, *rows.values()):
            if len(rows_of_topic):
                motion.stamp_ns = int(rows_of_topic.stamp_ns[-1])
        newest = {name: topic_rows.numbers[-1] for name, topic_rows in rows.items() if len(topic_rows)}
        if len(loads):
            motion.add_load(loads.numbers)
        if "contact_peaks" in newest:
            motion.add_peaks(rows["contact_peaks"].numbers[:, 2 * PAIR_COUNT :])
        if "peak_intervals" in newest:
            _, _, _, _, low, high = np.split(rows["peak_intervals"].numbers, 6, axis=1)
            motion.add_points(low, high)
        if "contact_forces" in newest:
            motion.penetration, _, motion.force = newest["contact_forces"].reshape(3, PAIR_COUNT)
        if "head_state" in newest:
            motion.pose = poses_of(newest["head_state"])
        if "clearance" in newest:
            motion.set_clearance(newest["clearance"])

    def _say(self, batch: Batch) -> None:
        for outputs in batch.outputs:
            for record in outputs.on(self._slow):
                self._feed.part(self._slow[record.topic], part_of(record.message()))


def _within(rows: Rows, second: int) -> Rows:
    chosen: NDArray[np.bool_] = rows.stamp_ns // NS_PER_S == second
    return Rows(rows.sequence[chosen], rows.stamp_ns[chosen], rows.numbers[chosen])


def show_run(path: Path, access: PageAccess, stopped: Callable[[], bool], on_open: Callable[[Screen], object]) -> None:
    """Show a recording, which may be in progress, until `stopped` returns True. `on_open` receives the screen."""
    reader = RunReader(path, Tail(stopped))
    header = reader.header
    with Screen(access, facts_of(header.scene(reader.path), header.parameters, str(path))) as screen:
        on_open(screen)
        run = RunFeed(screen.feed, header, stopped)
        for batch in reader.batches():
            if len(batch.entries) or batch.outputs:
                run.add(batch)
            else:  # all recorded data have been sent, and new data are awaited
                screen.feed.turn()
            if stopped() or screen.has_ended:
                return
        screen.feed.event("end", f"recording: {reader.status.value}")
        while not (stopped() or screen.has_ended):
            screen.feed.turn()
            time.sleep(1.0 / RATE_HZ)
