"""The recording of a live twin; imported only when a run is recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from plow_twin.live.parameters import Settings
from plow_twin.model.scene import Scene
from plow_twin.record.decimation import Decimation
from plow_twin.record.header import RunHeader
from plow_twin.record.messages import Message
from plow_twin.record.outputs import marks
from plow_twin.record.recorder import Recorder
from plow_twin.record.writer import in_free_folder
from plow_twin.scene_file import dump_scene
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Series, Session

_QUEUE_SIZE: Final = 20_000


class Recording:
    """The recording of a configured node.

    `topics` are the resolved names of the outputs by their base names. `clock` returns the time [ns] on `/clock`;
    without it the system's time is used. `on_error` is called from the recorder's thread with the reason when recording
    stops early.
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
        #: for each sample of the newest series, the number of the last journal entry before its publication
        self._series = np.zeros(0, np.int64)
        self.recorder = in_free_folder(Path(settings.record_path), make)

    def publication(self, published: Published, sent: Mapping[str, bytes]) -> None:
        """Record a sent publication; `sent` has the bytes of its messages, if there are any."""
        wanted = self._decimation.select(published)
        if wanted is not None:
            self.recorder.publication(wanted, sent if wanted is published else {})
        if published.rows["marked"][0] and not (sent and wanted is published):
            stamp_ns = int(published.rows["stamp_ns"][0])
            for topic, message in marks(published, self._frame_id).items():
                self.message(topic, stamp_ns, message)

    def series(self, series: Series) -> None:
        """Journal samples that were applied together."""
        self._series = self.recorder.series(series)

    def publications(self, published: Published) -> None:
        """Record the publications after each sample of the newest series."""
        if self._decimation.keeps_all:
            self.recorder.publications(published, self._series)
            return
        for number, sequence in enumerate(self._series.tolist()):
            wanted = self._decimation.select(published.at(number))
            if wanted is not None:
                self.recorder.publications(wanted, np.array([sequence]))

    def message(self, topic: str, stamp_ns: int, message: Message) -> None:
        """Record another message, by base name of its topic."""
        self.recorder.output(self._topics[topic], stamp_ns, message)

    @property
    def behind(self) -> bool:
        """Whether the recorder's queue is so full that messages may soon be lost."""
        return self.recorder.counters.queued > _QUEUE_SIZE // 2

    def renew(self, session: Session) -> bool:
        """Journal a snapshot if entries were lost and there is room again; return whether this was done."""
        wanted = self.recorder.snapshot_wanted
        if wanted:
            self.recorder.journal(session.renew())
        return wanted
