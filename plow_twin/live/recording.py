"""Record the run of a live twin. The module is imported only if a run is recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from plow_twin.live.parameters import Settings
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.record.header import RunHeader
from plow_twin.record.messages import Message
from plow_twin.record.outputs import MARKED, publication_messages
from plow_twin.record.recorder import Recorder
from plow_twin.record.writer import in_free_folder
from plow_twin.scene_file import dump_scene
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Series, Session

_QUEUE_SIZE: Final = 20_000


class Recording:
    """Recording of a configured twin.

    `topics` contains the resolved name of each output topic, by base name. `clock` returns the time on `/clock` [ns];
    with None, the system time is used. `on_error` receives the reason when recording stops early, in the thread of the
    recorder.
    """

    def __init__(
        self,
        settings: Settings,
        scene: Scene,
        node_name: str,
        topics: Mapping[str, str],
        clock: Callable[[], int] | None,
        on_error: Callable[[str], None],
    ) -> None:
        self._topics, self._frame_id = topics, settings.frame_id
        header = RunHeader(
            scene_yaml=dump_scene(scene),
            tol=settings.tolerance,
            excitation_source=settings.excitation_source,
            node=node_name,
            topics=dict(topics),
            frame_id=settings.frame_id,
            child_frame_id=settings.child_frame_id,
            clock="system" if clock is None else "ros",
            parameters=asdict(settings),
            record_outputs=settings.record_outputs,
        )
        self._decimation = Decimation(settings.record_outputs, settings.record_rate)
        make = partial(
            Recorder,
            header=header,
            queue_size=_QUEUE_SIZE,
            part_bytes=round(settings.record_part_mb * 1e6),
            part_s=settings.record_part_s,
            keep_bytes=round(settings.record_keep_mb * 1e6),
            ring_s=settings.record_ring,
            sync=settings.record_sync,
            now_ns=clock or time.time_ns,
            on_error=on_error,
        )
        #: result of `Recorder.series` for the last series, shape (n,)
        self._series = np.zeros(0, np.int64)
        self.recorder = in_free_folder(Path(settings.record_path), make)

    def publication(self, published: Published, sent: Mapping[str, bytes]) -> None:
        """Record a publication. `sent` contains the bytes of the sent messages by base name, or is empty."""
        selected = self._decimation.select(published)
        if selected is not None:
            self.recorder.publication(selected, sent if selected is published else {})
        if published.rows["marked"][0] and not (sent and selected is published):
            stamp_ns = int(published.rows["stamp_ns"][0])
            for topic, message in publication_messages(published, self._frame_id, "", MARKED).items():
                self.message(topic, stamp_ns, message)

    def series(self, series: Series) -> None:
        """Write a series of samples to the journal."""
        self._series = self.recorder.series(series)

    def publications(self, published: Published) -> None:
        """Record the publications of the last series, one for each sample."""
        if self._decimation.keeps_all:
            self.recorder.publications(published, self._series)
            return
        for number, sequence in enumerate(self._series.tolist()):
            selected = self._decimation.select(published.at(number))
            if selected is not None:
                self.recorder.publications(selected, np.array([sequence]))

    def message(self, topic: str, stamp_ns: int, message: Message) -> None:
        """Record a message that does not belong to a publication. `topic` is the base name of its topic."""
        self.recorder.output(self._topics[topic], stamp_ns, message)

    @property
    def behind(self) -> bool:
        """Whether the queue of the recorder is more than half full."""
        return self.recorder.counters.queued > _QUEUE_SIZE // 2

    def renew(self, session: Session) -> bool:
        """Write a snapshot to the journal if the recorder needs a snapshot; return whether a snapshot was written."""
        snapshot_due = self.recorder.snapshot_wanted
        if snapshot_due:
            self.recorder.journal(session.renew())
        return snapshot_due


class Decimation:
    """Selection of the publications to record.

    The argument `outputs` is `all`, `decimated` or `none`. With `decimated`, the first publication in each period of
    the rate `rate_hz` [Hz] is recorded, and every publication with a slow part is recorded. The impulses and
    peaks of an omitted publication are added to the next recorded publication.
    """

    def __init__(self, outputs: str, rate_hz: float) -> None:
        self._outputs = outputs
        self._span_ns = max(1, round(1e9 / rate_hz))
        self._last_span: int | None = None
        self._impulse = np.zeros(PAIR_COUNT)
        self._peak = np.zeros(PAIR_COUNT)

    @property
    def keeps_all(self) -> bool:
        """Whether every publication is recorded."""
        return self._outputs == "all"

    def select(self, published: Published) -> Published | None:
        """Return the publication to record, or None if `published`, which has one row, is omitted."""
        if self._outputs == "all":
            return published
        if self._outputs == "none":
            return None
        rows, slow = published
        self._impulse += rows["impulse"][0]
        np.maximum(self._peak, rows["peak"][0], out=self._peak)
        span = int(rows["stamp_ns"][0]) // self._span_ns
        if span == self._last_span and not len(slow):
            return None
        self._last_span, rows = span, rows.copy()
        rows["impulse"], rows["peak"] = self._impulse, self._peak
        self._impulse[:] = 0.0
        self._peak[:] = 0.0
        return Published(rows, slow)
