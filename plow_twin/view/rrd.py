"""A recording turned into a rerun file with its arrangement: `to_rrd`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr

from plow_twin.errors import RecordingError
from plow_twin.model.scene import Clearance, Scene
from plow_twin.record.header import RunHeader
from plow_twin.record.messages import DiagnosticStatus, JointState, Odometry
from plow_twin.record.reader import EntryRecord, FileStatus, OutputRecord, RunReader
from plow_twin.stream.journal import Hold, Sample
from plow_twin.view import layout
from plow_twin.view.columns import Batches, Curves, buffers
from plow_twin.view.events import Events
from plow_twin.view.section import ARROW_MM_PER_N, LOAD_COLOR, PAIR_COLORS, Section

#: A curve with more rows is thinned.
MOST_ROWS: Final = 200_000
#: The cross-section moves at this rate [Hz]; curves keep every row.
SECTION_HZ: Final = 100.0
#: Stamps further than that from the recorder's clock [ns] are on another clock: no age is drawn.
_LARGEST_AGE_NS: Final = 3_600_000_000_000
#: Size of a recording for each row of its curves [B].
_BYTES_PER_ROW: Final = 400
_GREY: Final = (150, 155, 165)
_WHITE: Final = (235, 235, 235)
_TOUCHING: Final = (240, 140, 40)


@dataclass(frozen=True)
class ViewSummary:
    """What a .rrd holds: first stamp, rows of the curves, moments of the cross-section, events.

    `status` is how the recording ended, `lost` what its recorder counted as lost, by topic.
    """

    path: Path
    first_ns: int
    curve_rows: int
    section_rows: int
    events: int
    status: FileStatus
    lost: Mapping[str, int]


def to_rrd(
    path: Path,
    out: Path,
    *,
    section_hz: float = SECTION_HZ,
    exaggerate: float | None = None,
    most_rows: int = MOST_ROWS,
    until_s: float | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> ViewSummary:
    """Write the .rrd of a recording, complete or cut off, with at most one block of it in memory.

    Parameters
    ----------
    path
        The `.mcap` file or its folder.
    out
        The .rrd file to write.
    section_hz
        Rate of the cross-section [Hz].
    exaggerate
        How many times as wide the clearance is drawn in the second cross-section; None: so that it is well seen.
    most_rows
        Rows of a curve, and a tenth of them of the cross-section, beyond which a long run is thinned: a curve keeps the
        least and the largest value of each span, so that no peak is lost.
    until_s
        Stop that long after the first stamp [s].
    on_progress
        Receives the share done, 0..1.

    Raises
    ------
    RecordingError
        The file is no recording, or `out` cannot be written.
    """
    reader = RunReader(Path(path))
    scene = reader.header.scene(reader.path)
    section = Section.of(scene)
    stream = rr.RecordingStream("plow_twin")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        wide = exaggerate or section.exaggeration()
        stream.save(out, default_blueprint=layout.blueprint(section, wide))
    except Exception as error:  # the SDK raises RuntimeError and OSError alike
        raise RecordingError(f"{out}: cannot be written: {error}") from error
    duration_s = reader.duration_s()
    span_ns = _span_ns(reader, duration_s, most_rows)
    section_hz = min(section_hz, max(1.0, 0.1 * most_rows / max(duration_s, 1e-9)))
    run = _Run(stream, reader.header, section, scene.clearance, section_hz, wide, span_ns)
    run.start(scene, reader.path)
    for index, record in enumerate(reader):
        if isinstance(record, EntryRecord):
            run.entry(record)
        else:
            run.output(record)
        if until_s is not None and run.elapsed_s >= until_s:
            break
        if on_progress is not None and index % 1000 == 0:
            on_progress(reader.position)
    run.finish(reader.status)
    if on_progress is not None:
        on_progress(1.0)
    stream.flush()
    stream.disconnect()
    return ViewSummary(
        out, run.first_ns, run.force.sent, run.section_rows, run.events.count, reader.status, reader.lost
    )


def _span_ns(reader: RunReader, duration_s: float, most_rows: int) -> int:
    """Return the span in which a curve keeps two rows [ns]; 0 for a run of few rows."""
    size = sum(part.stat().st_size for part in reader.parts)
    rows = size / _BYTES_PER_ROW
    return 0 if rows <= most_rows else max(1, round(2e9 * duration_s / most_rows))


class _Run:
    """Turn records into curves, moments of the cross-section and events."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        header: RunHeader,
        section: Section,
        clearance: Clearance,
        section_hz: float,
        exaggerate: float,
        span_ns: int,
    ) -> None:
        self._exaggerate = exaggerate
        self.walls = Batches(stream, "exaggerated/head", rr.LineStrips2D, ("strips", "colors"))
        self.stream = stream
        self.header = header
        self.section = section
        self.force = Curves(stream, layout.FORCE, span_ns)
        self.force_at_stamp = Curves(stream, layout.FORCE_AT_STAMP, span_ns)
        self.penetration = Curves(stream, layout.PENETRATION, span_ns)
        self.load = Curves(stream, layout.LOAD, span_ns)
        self.age = Curves(stream, layout.AGE, span_ns)
        self.interval = Curves(stream, layout.INTERVAL, span_ns)
        self.head = Batches(stream, "section/head", rr.LineStrips2D, ("strips",))
        self.corners = Batches(stream, "section/corners", rr.Points2D, ("positions", "radii"))
        self.arrows = Batches(stream, "section/force", rr.Arrows2D, ("origins", "vectors", "colors", "labels"))
        self.names = Batches(stream, "section/head/name", rr.Points2D, ("positions",))
        self.load_arrow = Batches(stream, "section/load", rr.Arrows2D, ("origins", "vectors", "labels"))
        self.events = Events(stream)
        self._stream_span_ns = span_ns
        self.slow: tuple[Curves, Curves, Curves] | None = None
        self.section_rows = 0
        self.step = -1
        self._spacing_ns = round(1e9 / section_hz)
        self._shown: int | None = None
        self._stamp_ns = 0
        self._first_ns: int | None = None
        self._sample_ns: int | None = None
        self._contact: JointState | None = None
        self._early: list[tuple[int, DiagnosticStatus]] = []
        self._wrench = (0.0, 0.0, 0.0)
        self._new_m = {"horizontal": clearance.horizontal_m, "vertical": clearance.vertical_m}
        self._handlers: dict[str, Callable[[OutputRecord, Any], None]] = {
            header.topic("contact_forces"): self._contact_forces,
            header.topic("contact_peaks"): self._contact_peaks,
            header.topic("head_state"): self._head_state,
            header.topic("clearance"): self._clearance,
            header.topic("status"): self._status,
        }

    @property
    def elapsed_s(self) -> float:
        """Time since the first stamp [s]."""
        return 0.0 if self._first_ns is None else (self._stamp_ns - self._first_ns) * 1e-9

    @property
    def first_ns(self) -> int:
        """The first stamp; 0 without any."""
        return self._first_ns or 0

    def start(self, scene: Scene, source: Path) -> None:
        """Write what does not change in time."""
        layout.style_curves(self.stream)
        outline = self.section.frame_strip()
        self.stream.log("section/frame", rr.LineStrips2D([outline], colors=[_GREY], radii=[1.5]), static=True)
        self.stream.log("exaggerated/frame", rr.LineStrips2D([outline], colors=[_GREY], radii=[1.5]), static=True)
        self.stream.log("exaggerated/head", rr.LineStrips2D.from_fields(radii=[1.5]), static=True)
        places = np.concatenate((0.85 * self.section.corners(), [[0.0, -0.43 * self.section.frame[1]]]))
        names = (*self.section.labels, "frame (fixed)")
        labels = rr.Points2D(places, labels=names, radii=[0.1], colors=[_GREY], show_labels=True)
        self.stream.log("section/frame/names", labels, static=True)
        self.stream.log("section/head", rr.LineStrips2D.from_fields(colors=[_WHITE], radii=[0.9]), static=True)
        self.stream.log("section/corners", rr.Points2D.from_fields(colors=[_WHITE]), static=True)
        self.stream.log("section/force", rr.Arrows2D.from_fields(radii=[2.2], show_labels=True), static=True)
        name = rr.Points2D.from_fields(labels=["head (moves)"], radii=[0.1], colors=[_WHITE], show_labels=True)
        self.stream.log("section/head/name", name, static=True)
        load = rr.Arrows2D.from_fields(radii=[2.2], colors=[LOAD_COLOR], show_labels=True)
        self.stream.log("section/load", load, static=True)
        document = rr.TextDocument(layout.about(scene, self.header, source), media_type=rr.MediaType.MARKDOWN)
        self.stream.log("about", document, static=True)

    def entry(self, record: EntryRecord) -> None:
        """Take an entry of the journal."""
        entry = record.entry
        stamp_ns = getattr(entry, "stamp_ns", self._stamp_ns)
        if isinstance(entry, Sample | Hold):
            self.step += 1
            self._stamp_ns = stamp_ns
            self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        if isinstance(entry, Sample):
            fx, fy, moment = self._wrench = entry.wrench
            self.load.add(stamp_ns, self.step, (fx / 1e3, fy / 1e3, moment / 1e3))
            self._quality(stamp_ns, record.log_time_ns)
        if self._early and self._first_ns is not None:
            self._write_early(self._first_ns)
        self.events.entry(stamp_ns, max(self.step, 0), entry, self.header.excitation_source)

    def _quality(self, stamp_ns: int, log_time_ns: int) -> None:
        if self._sample_ns is not None:
            self.interval.add(stamp_ns, self.step, [(stamp_ns - self._sample_ns) / 1e6])
        self._sample_ns = stamp_ns
        age_ns = log_time_ns - stamp_ns
        if abs(age_ns) <= _LARGEST_AGE_NS:
            self.age.add(stamp_ns, self.step, [age_ns / 1e6])

    def output(self, record: OutputRecord) -> None:
        """Take a message of the node; other topics are passed over."""
        handler = self._handlers.get(record.topic)
        if handler is not None:
            handler(record, record.message())

    def _contact_forces(self, record: OutputRecord, message: JointState) -> None:
        self._contact = message
        self.force_at_stamp.add(message.stamp_ns, self.step, message.effort / 1e3)
        self.penetration.add(message.stamp_ns, self.step, message.position * 1e3)

    def _contact_peaks(self, record: OutputRecord, message: JointState) -> None:
        self.force.add(message.stamp_ns, self.step, message.effort / 1e3)
        self.events.peaks(message.stamp_ns, self.step, message)

    def _head_state(self, record: OutputRecord, message: Odometry) -> None:
        stamp_ns, contact = message.stamp_ns, self._contact
        place = stamp_ns // self._spacing_ns
        if contact is None or contact.stamp_ns != stamp_ns or place == self._shown:
            return
        self._shown = place
        self.section_rows += 1
        theta = 2.0 * math.atan2(message.orientation[2], message.orientation[3])
        pose = (message.position[0], message.position[1], theta)
        self.head.add(stamp_ns, self.step, strips=list(self.section.head_strips(pose)))
        self._load(stamp_ns, pose)
        radii = self.section.corner_radii(contact.effort)
        self.corners.add(stamp_ns, self.step, positions=self.section.corners(), radii=radii)
        origins, vectors, pairs = self.section.arrows(theta, contact.effort)
        colors = [PAIR_COLORS[pair] for pair in pairs]
        labels = [f"{contact.effort[pair] / 1e3:.0f} kN" for pair in pairs]
        self.arrows.add(stamp_ns, self.step, origins=origins, vectors=vectors, colors=colors, labels=labels)
        walls, touching = self.section.exaggerated(contact.position, self._exaggerate)
        shades = [_TOUCHING if touches else _WHITE for touches in touching]
        self.walls.add(stamp_ns, self.step, strips=list(walls), colors=shades)

    def _load(self, stamp_ns: int, pose: tuple[float, float, float]) -> None:
        """Draw the head's name and the sampled load at its centre; the scene's own loads are not journalled."""
        centre, name = self.section.head_points(pose)
        self.names.add(stamp_ns, self.step, positions=[name])
        fx, fy, moment = self._wrench
        if self.header.excitation_source != "scene":
            vector = (ARROW_MM_PER_N * fx, -ARROW_MM_PER_N * fy)
            label = f"load {math.hypot(fx, fy) / 1e3:.0f} kN, {moment / 1e3:+.0f} kN m"
            self.load_arrow.add(stamp_ns, self.step, origins=[centre], vectors=[vector], labels=[label])

    def _clearance(self, record: OutputRecord, message: JointState) -> None:
        pads = np.array([name.startswith("pad_") for name in message.name])
        if self.slow is None:
            names = list(zip(message.name, pads, strict=True))
            total = [f"clearance/{name}" for name, pad in names if not pad]
            growth = [f"growth/{name}" for name, pad in names if not pad]
            wear = [f"wear/{name}" for name, pad in names if pad]
            layout.style_clearances(self.stream, (*total, *growth, *wear))
            self.slow = (Curves(self.stream, total), Curves(self.stream, growth), Curves(self.stream, wear))
        total_m, depth_m = message.position[~pads], message.position[pads]
        new_m = [self._new_m[name.partition("/")[0]] for name, pad in zip(message.name, pads, strict=True) if not pad]
        rows = (1e3 * total_m, 1e6 * (total_m - new_m), 1e3 * depth_m)
        for curves, row in zip(self.slow, rows, strict=True):
            curves.add(message.stamp_ns, max(self.step, 0), row)

    def _status(self, record: OutputRecord, message: DiagnosticStatus) -> None:
        if self._first_ns is None:
            self._early.append((record.publish_time_ns, message))
        else:
            self.events.status(self._stamp_ns, self.step, message)

    def _write_early(self, stamp_ns: int | None) -> None:
        """Write the states from before the first sample at its stamp: playing then starts where there is motion."""
        for published_ns, message in self._early:
            self.events.status(published_ns if stamp_ns is None else stamp_ns, max(self.step, 0), message)
        self._early = []

    def finish(self, status: FileStatus) -> None:
        """Send what is still collected."""
        self._write_early(None)
        if status not in (FileStatus.COMPLETE, FileStatus.UNREAD):
            self.events.add(self._stamp_ns, max(self.step, 0), f"recording {status.value}", "ERROR")
        for buffer in buffers(self):
            buffer.flush()
        for curves in self.slow or ():
            curves.flush()
        self.events.flush()
