"""Drawing of a recording into rerun, batch by batch: curves, cross-sections and events."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from plow_twin.model.geometry import angle_of
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.record.alarms import ALARMS
from plow_twin.record.entries import Batch, Entries, Holes
from plow_twin.record.messages import DiagnosticStatus
from plow_twin.record.outputs import publication_templates
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.rows import Rows, poses_of, rows_by_topic
from plow_twin.stream.journal import Hold, Loss, Pose, Reset, Travel, Unload
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES, clearances
from plow_twin.view import layout
from plow_twin.view.columns import Array, Batches, Curves, Indexes, TimeAxis, buffers
from plow_twin.view.contact_sets import ContactSets, masks_of, set_color
from plow_twin.view.events import Events
from plow_twin.view.face import FaceChart
from plow_twin.view.figures import scene_and_date, signed
from plow_twin.view.residuals import Residuals
from plow_twin.view.section import ARROW_MM_PER_N, LABEL_MM, LOAD_COLOR, PAIR_COLORS, Section
from plow_twin.view.what_if import WhatIf

#: Largest drawn age of a sample [ns]. A larger age shows that the stamps come from another clock than the recorder's.
_LARGEST_AGE_NS: Final = 3_600_000_000_000
_GREY: Final = (150, 155, 165)
_WHITE: Final = (235, 235, 235)
_TOUCHING: Final = (240, 140, 40)
_PADS: Final = np.array([name.startswith("pad_") for name in CLEARANCE_NAMES])
_BEST_PADS: Final = np.array([name in PAD_NAMES for name in CLEARANCE_NAMES])
#: Columns of the wear depths of the pads, and of their 5 % and 95 % points.
_PAD_POINTS: Final = [[CLEARANCE_NAMES.index(f"{name}{point}") for name in PAD_NAMES] for point in ("", "/p05", "/p95")]
_BOUNDS: Final = [
    CLEARANCE_NAMES.index(f"{way}/{point}") for way in ("horizontal", "vertical") for point in ("p05", "p95")
]
#: Number of rows with which a band is drawn between two clearance messages, unless curves are thinned.
_BAND_ROWS: Final = 10
#: Shortest time [ns] between two drawings of the forces along the face.
_FACE_NS: Final = 1_000_000_000


Sink = Callable[[rr.RecordingStream, rrb.Blueprint], object]


class Drawing:
    """Drawing of a recording into a rerun stream, one batch of records at a time.

    `sink` receives the stream and its blueprint before anything is drawn. In each span of `span_ns`, only the least and
    the largest value of a curve are drawn; with 0, all rows are drawn. The remaining arguments are those of `to_rrd`.
    """

    def __init__(
        self,
        reader: RunReader,
        sink: Sink,
        *,
        section_hz: float,
        exaggerate: float | None,
        span_ns: int,
        others: Mapping[str, Scene] | None = None,
    ) -> None:
        self.header = header = reader.header
        scene = header.scene(reader.path)
        self.stream = stream = rr.RecordingStream("plow_twin")
        self.section = Section.of(scene)
        self._exaggerate, self.section_hz = exaggerate or self.section.exaggeration(), section_hz
        follows, title = header.follow == "full", scene_and_date(reader)
        sink(stream, layout.blueprint(self.section, self._exaggerate, bool(others), follows, title=title))
        self._axis = axis = TimeAxis()
        self.force = Curves(stream, axis, layout.FORCE, span_ns)
        self.force_at_stamp = Curves(stream, axis, layout.FORCE_AT_STAMP, span_ns)
        self.force_bounds = Curves(stream, axis, layout.FORCE_BOUNDS, span_ns)
        self.pose, self.measured = (Curves(stream, axis, name, span_ns) for name in (layout.POSE, layout.MEASURED))
        self.penetration = Curves(stream, axis, layout.PENETRATION, span_ns)
        self.load = Curves(stream, axis, layout.LOAD, span_ns)
        self.age = Curves(stream, axis, layout.AGE, span_ns)
        self.interval = Curves(stream, axis, layout.INTERVAL, span_ns)
        self.total = Curves(stream, axis, layout.TOTAL, span_ns)
        self.growth = Curves(stream, axis, layout.GROWTH, span_ns)
        self.wear = Curves(stream, axis, layout.WEAR, span_ns)
        self.band = Curves(stream, axis, layout.BAND, span_ns)
        self.residual = Curves(stream, axis, layout.RESIDUAL, span_ns)
        self.what_if = WhatIf(stream, axis, header, others or {}, span_ns)
        self.contact_sets = ContactSets(stream, axis, self.section.labels, span_ns)
        self.face = FaceChart(stream, axis)
        self._residuals = Residuals()
        self._drawn_face_ns = -_FACE_NS
        self._band_end: tuple[Indexes, Indexes, Array] | None = None
        self._band_colored = False
        self._holes = Holes()
        self.head = Batches(stream, axis, "section/head", rr.LineStrips2D, ("strips", "colors"))
        self.corners = Batches(stream, axis, "section/corners", rr.Points2D, ("positions", "radii"))
        self.arrows = Batches(stream, axis, "section/force", rr.Arrows2D, ("origins", "vectors", "colors", "labels"))
        self.names = Batches(stream, axis, "section/head/name", rr.Points2D, ("positions",))
        self.load_arrow = Batches(stream, axis, "section/load", rr.Arrows2D, ("origins", "vectors", "labels"))
        self.walls = Batches(stream, axis, "exaggerated/head", rr.LineStrips2D, ("strips", "colors"))
        self.pads = Batches(stream, axis, "exaggerated/pads", rr.Boxes2D, ("centers", "half_sizes"))
        self.pad_names = Batches(stream, axis, "exaggerated/pads/wear", rr.Points2D, ("positions", "labels"))
        self.events = Events(stream, axis)
        self.section_rows = 0
        #: Number and stamp [ns] of the newest advance.
        self.step, self.stamp_ns = -1, 0
        self._shown: int | None = None
        self._sample_ns: int | None = None
        self._early: list[tuple[int, DiagnosticStatus]] = []
        self._wrench = np.full(3, np.nan)  # unknown until the first load
        self._worn = False
        self._largest_load = self._named_load = np.zeros(3)
        self._scene = scene
        self._templates = publication_templates(header.frame_id, header.child_frame_id)
        self._topics = {header.topic(name): name for name in self._templates}
        self._draw_still(scene, reader.path)

    @property
    def first_ns(self) -> int:
        """The first stamp [ns], or 0 if no stamp has been read."""
        return self._axis.first_ns or 0

    def _draw_still(self, scene: Scene, source: Path) -> None:
        layout.style_curves(self.stream)
        frame = rr.LineStrips2D([self.section.frame_strip()], colors=[_GREY], radii=[1.5])
        places = np.concatenate((0.85 * self.section.corners(), [[0.0, -0.37 * self.section.frame[1]]]))
        names = (*self.section.labels, self.section.frame_name)
        if self.section.is_block:
            places, names = np.array([[0.0, -0.5 * self.section.cavity[1]]]), (self.section.frame_name,)
        places[:, 1] -= LABEL_MM
        label: dict[str, Any] = {"radii": [0.1], "show_labels": True}
        still: dict[str, Any] = {
            "section/frame": frame,
            "exaggerated/frame": frame,
            "exaggerated/head": rr.LineStrips2D.from_fields(radii=[1.5]),
            "exaggerated/pads": rr.Boxes2D.from_fields(colors=list(PAIR_COLORS), radii=[1.0]),
            "exaggerated/pads/wear": rr.Points2D.from_fields(colors=list(PAIR_COLORS), **label),
            "section/frame/names": rr.Points2D(places, labels=names, colors=[_GREY], **label),
            "section/head": rr.LineStrips2D.from_fields(radii=[0.9]),
            "section/corners": rr.Points2D.from_fields(colors=[_WHITE]),
            "section/force": rr.Arrows2D.from_fields(radii=[2.2], show_labels=True),
            "section/head/name": rr.Points2D.from_fields(labels=["head (moves)"], colors=[_WHITE], **label),
            "section/load": rr.Arrows2D.from_fields(radii=[2.2], colors=[LOAD_COLOR], show_labels=True),
            "about": rr.TextDocument(layout.about(scene, self.header, source), media_type=rr.MediaType.MARKDOWN),
        }
        for entity, archetype in still.items():
            self.stream.log(entity, archetype, static=True)

    def add(self, batch: Batch) -> None:
        """Draw a batch. Lines are interrupted at missing journal entries and at resets."""
        missing = self._holes.find(batch.entries)
        resets = {index for index, entry in batch.entries.others.items() if isinstance(entry, Reset)}
        places = sorted(resets | set(missing))
        for place, part in zip((None, *places), batch.parted(places), strict=True):
            if place is not None:
                self._end_lines()
            if place in missing:
                self._hole(missing[place], part)
            self._whole(part)

    def _end_lines(self) -> None:
        for buffer in buffers(self):
            if isinstance(buffer, Curves):
                buffer.end()
        self.contact_sets.end()
        self.what_if.end_lines()
        self._band_end = None
        self._residuals = Residuals()

    def _hole(self, count: int, after: Batch) -> None:
        self._sample_ns, self._wrench = None, np.full(3, np.nan)
        self.events.forget()
        if not isinstance(after.entries.others.get(0), Loss):  # a `Loss` in the journal is drawn as a separate event
            text = f"{count} journal entries are missing after this"
            self.events.add(self.stamp_ns, max(self.step, 0), text, "ERROR")

    def _whole(self, batch: Batch) -> None:
        entries = batch.entries
        advance = entries.sample.copy()
        advance[[index for index, entry in entries.others.items() if isinstance(entry, Hold | Unload)]] = True
        stamps = entries.stamp_ns.copy()
        for index, entry in entries.others.items():
            stamps[index] = getattr(entry, "stamp_ns", 0)
        steps = self.step + np.cumsum(advance)
        if self._axis.first_ns is None and advance.any():
            self._axis.first_ns = int(stamps[np.flatnonzero(advance)[0]])
        before = (self.step, self._wrench)
        self._entries(entries, stamps, steps, advance)
        by_topic = rows_by_topic(batch.outputs, self._topics, self._templates)
        bounds = np.maximum.accumulate(entries.sequence) if len(entries) else entries.sequence

        def places(rows: Rows) -> Indexes:
            return np.asarray(np.searchsorted(bounds, rows.sequence, side="right"), np.int64)

        steps_before = np.concatenate(([before[0]], steps))
        for name, rows in by_topic.items():
            self._rows(name, rows, np.maximum(steps_before[places(rows)], 0))
        if "contact_peaks" in by_topic:
            self._along_face(entries, by_topic["contact_peaks"], places(by_topic["contact_peaks"]))
        self.what_if.add(entries, stamps, steps)
        contact, head = by_topic.get("contact_forces"), by_topic.get("head_state")
        if contact is not None and head is not None:
            at, loads = places(head), np.concatenate((before[1][None], self._loads(entries, advance, before[1])))
            self._section(contact, head, steps_before[at], loads[np.searchsorted(np.flatnonzero(advance), at)])
        if head is not None:
            poses = [(index, entry) for index, entry in sorted(entries.others.items()) if isinstance(entry, Pose)]
            self.residual.add(*self._residuals.compare(poses, steps, head))
            self._poses(poses, steps, head, np.maximum(steps_before[places(head)], 0))
        self._statuses(batch)

    def _entries(self, entries: Entries, stamps: Indexes, steps: Indexes, advance: NDArray[np.bool_]) -> None:
        if self.header.excitation_source != "scene" and advance.any():
            loads = self._loads(entries, advance, self._wrench)
            finite = np.isfinite(loads[:, 0])
            self.load.add(stamps[advance][finite], steps[advance][finite], loads[finite] / 1e3)
            self._wrench = loads[-1]
        samples = np.flatnonzero(entries.sample)
        if samples.size:
            at, wrench = stamps[samples], entries.wrench[samples]
            self._largest_load = np.maximum(self._largest_load, np.abs(wrench).max(axis=0) / 1e3)
            age = entries.log_time_ns[samples] - at
            near = np.abs(age) <= _LARGEST_AGE_NS
            self.age.add(at[near], steps[samples][near], age[near, None] / 1e6)
            interval = np.diff(at, prepend=at[0] if self._sample_ns is None else self._sample_ns)
            after_first = slice(1 if self._sample_ns is None else 0, None)
            self.interval.add(at[after_first], steps[samples][after_first], interval[after_first, None] / 1e6)
            self._sample_ns = int(at[-1])
        for index in sorted(entries.others):
            self._back(samples[: np.searchsorted(samples, index)], stamps, steps)
            entry, stamp_ns = entries.others[index], int(stamps[index])
            # an entry without a stamp is drawn at the stamp that the model has reached
            if not hasattr(entry, "stamp_ns"):
                reached = np.flatnonzero(advance[:index])
                stamp_ns = int(stamps[reached[-1]]) if reached.size else self.stamp_ns
            self.events.entry(stamp_ns, max(int(steps[index]), 0), entry, self.header.excitation_source)
            samples = samples[np.searchsorted(samples, index) :]
        self._back(samples, stamps, steps)
        reached = np.flatnonzero(advance)
        if reached.size:
            self.step, self.stamp_ns = int(steps[-1]), int(stamps[reached[-1]])

    @staticmethod
    def _loads(entries: Entries, advance: NDArray[np.bool_], before: Array) -> Array:
        """Return the load at the end of each advance, shape (n, 3): sampled, held or zero, or NaN if it is unknown."""
        places = np.flatnonzero(advance)
        loads = np.where(entries.sample[places, None], entries.wrench[places], 0.0)
        for row in np.flatnonzero(~entries.sample[places]).tolist():
            if isinstance(entries.others[int(places[row])], Hold):
                loads[row] = loads[row - 1] if row else before
        return loads

    def _back(self, samples: Indexes, stamps: Indexes, steps: Indexes) -> None:
        if samples.size:
            self.events.sample(int(stamps[samples[0]]), int(steps[samples[0]]))

    def _rows(self, name: str, rows: Rows, steps: Indexes) -> None:
        stamps, numbers = rows.stamp_ns, rows.numbers
        match name:
            case "contact_forces":
                self.penetration.add(stamps, steps, numbers[:, :PAIR_COUNT] * 1e3)
                self.force_at_stamp.add(stamps, steps, numbers[:, 2 * PAIR_COUNT :] / 1e3)
                self.contact_sets.add(stamps, steps, numbers[:, 2 * PAIR_COUNT :])
            case "force_intervals":
                self.force_bounds.add(stamps, steps, numbers[:, PAIR_COUNT:] / 1e3)
            case "contact_peaks":
                peak = numbers[:, 2 * PAIR_COUNT :]
                self.force.add(stamps, steps, peak / 1e3)
                self.what_if.run(stamps, steps, peak)
                self.events.peaks(stamps, steps, numbers[:, :PAIR_COUNT], peak)
            case "clearance":
                total_m = numbers[:, ~_PADS]
                self.total.add(stamps, steps, 1e3 * total_m)
                self.growth.add(stamps, steps, 1e6 * self._growth_m(numbers))
                self.wear.add(stamps, steps, 1e3 * numbers[:, _PADS])
                self._bands(stamps, steps, numbers)
                self._pads(stamps, steps, numbers)

    def _poses(self, measured: Sequence[tuple[int, Pose]], steps: Indexes, head: Rows, at: Indexes) -> None:
        if not (measured or self.measured.rows):
            return
        self.pose.add(head.stamp_ns, at, 1e3 * poses_of(head.numbers))
        rising = sorted((entry.stamp_ns, max(int(steps[place]), 0), entry.pose) for place, entry in measured)
        if rising:
            stamps, places, poses = zip(*rising, strict=True)
            self.measured.add(np.array(stamps), np.array(places), 1e3 * np.array(poses))

    def _growth_m(self, numbers: Array) -> Array:
        """Return the growth of the clearances by wear [m], with its interval, in the order of `layout.GROWTH`."""
        new = clearances(self._scene, np.zeros(PAIR_COUNT))[:2]
        best, low, high = (clearances(self._scene, numbers[:, pads])[:, :2] - new for pads in _PAD_POINTS)
        return np.concatenate((best, np.stack((low, high), axis=2).reshape(len(numbers), 4)), axis=1)

    def _bands(self, stamps: Indexes, steps: Indexes, numbers: Array) -> None:
        """Draw the area between two bounds as a curve that alternates between the bounds from row to row."""
        total = np.concatenate((1e3 * numbers[:, _BOUNDS], 1e6 * self._growth_m(numbers)[:, 2:]), axis=1)
        if self._band_end is not None and len(stamps) and self._band_end[0][0] < stamps[0]:
            ends = zip(self._band_end, (stamps, steps, total), strict=True)
            stamps, steps, total = (np.concatenate(pair) for pair in ends)
        self._band_end = stamps[-1:], steps[-1:], total[-1:]
        if len(stamps) > 1 and not self.band.span_ns:
            rows = np.arange(0.0, len(stamps) - 1, 1.0 / _BAND_ROWS)
            indices = np.arange(len(stamps))
            total = np.stack([np.interp(rows, indices, column) for column in total.T], axis=1)
            stamps = stamps[0] + np.interp(rows, indices, stamps - stamps[0]).astype(np.int64)
            steps = steps[rows.astype(np.int64)]
        if not self._band_colored and len(stamps) > 1:
            self._color_bands(stamps, steps)
            self._band_colored = True
        bound = np.arange(len(stamps)) % 2
        sides = total.reshape(len(stamps), len(layout.BAND), 2)
        self.band.add(stamps, steps, np.where(bound[:, None], sides[:, :, 1], sides[:, :, 0]))

    def _color_bands(self, stamps: Indexes, steps: Indexes) -> None:
        """Set the colours of the bands: an opaque first stroke, whose colour the legend shows, and faint strokes."""
        behind = int(np.searchsorted(stamps, stamps[0] + 2 * self.band.span_ns))
        changes = [0, min(max(1, behind), len(stamps) - 1)]
        for entity in layout.BAND:
            colors = rr.SeriesLines.columns(colors=layout.band_colors(entity))
            rr.send_columns(entity, self._axis.columns(stamps[changes], steps[changes]), colors, recording=self.stream)

    def _pads(self, stamps: Indexes, steps: Indexes, numbers: Array) -> None:
        depth_mm = 1e3 * numbers[:, _BEST_PADS]
        for row in np.flatnonzero(np.diff(stamps // round(1e9 / min(self.section_hz, 1.0)), prepend=-1)).tolist():
            if depth_mm[row].any():
                middles, halves, places = self.section.pads(depth_mm[row])
                self.pads.add(int(stamps[row]), int(steps[row]), centers=middles, half_sizes=halves)
                labels = [f"{depth:.3g} mm" if depth >= 1.0 else f"{1e3 * depth:.3g} µm" for depth in depth_mm[row]]
                self.pad_names.add(int(stamps[row]), int(steps[row]), positions=places, labels=labels)
            elif self._worn:  # the pads were replaced
                self.pads.add(int(stamps[row]), int(steps[row]), centers=[], half_sizes=[])
                self.pad_names.add(int(stamps[row]), int(steps[row]), positions=[], labels=[])
            self._worn = bool(depth_mm[row].any())

    def _along_face(self, entries: Entries, rows: Rows, places: Indexes) -> None:
        largest, begin = rows.numbers[:, 2 * PAIR_COUNT :].max(axis=1), 0
        for index, entry in sorted(entries.others.items()):
            if isinstance(entry, Travel | Reset):
                end = int(np.searchsorted(places, index, side="right"))
                self.face.forces(rows.stamp_ns[begin:end], largest[begin:end])
                begin = end
                if isinstance(entry, Travel):
                    self.face.travel(entry)
                else:
                    self.face.restart()
        self.face.forces(rows.stamp_ns[begin:], largest[begin:])
        if self.face.known and self.stamp_ns - self._drawn_face_ns >= _FACE_NS:
            self.face.draw(self.stamp_ns, max(self.step, 0))
            self._drawn_face_ns = self.stamp_ns

    def _section(self, contact: Rows, head: Rows, steps: Indexes, loads: Array) -> None:
        """Draw the first stamp of each span for which forces and pose were published together."""
        at = np.minimum(np.searchsorted(contact.sequence, head.sequence), len(contact) - 1)
        spans = head.stamp_ns // round(1e9 / self.section_hz)
        for row in np.flatnonzero(contact.stamp_ns[at] == head.stamp_ns).tolist():
            if spans[row] != self._shown:
                self._shown = int(spans[row])
                self._moment(
                    int(head.stamp_ns[row]), int(steps[row]), head.numbers[row], contact.numbers[at[row]], loads[row]
                )

    def _moment(self, stamp_ns: int, step: int, head: Array, contact: Array, load: Array) -> None:
        self.section_rows += 1
        force = contact[2 * PAIR_COUNT :]
        pose = (float(head[0]), float(head[1]), float(angle_of(head[2], head[3])))
        color = set_color(int(masks_of(force[None])[0]))
        strips = self.section.head_strips(pose)
        self.head.add(stamp_ns, step, strips=list(strips), colors=[color] * len(strips))
        self._load(stamp_ns, step, pose, load)
        self.corners.add(stamp_ns, step, positions=self.section.corners(pose), radii=self.section.corner_radii(force))
        origins, vectors, pairs = self.section.arrows(pose, force)
        colors = [PAIR_COLORS[pair] for pair in pairs]
        labels = [f"{force[pair] / 1e3:.0f} kN" for pair in pairs]
        self.arrows.add(stamp_ns, step, origins=origins, vectors=vectors, colors=colors, labels=labels)
        walls, touching = self.section.exaggerated(contact[:PAIR_COUNT], self._exaggerate)
        shades = [_TOUCHING if touches else _WHITE for touches in touching]
        self.walls.add(stamp_ns, step, strips=list(walls), colors=shades)

    def _load(self, stamp_ns: int, step: int, pose: tuple[float, float, float], load: Array) -> None:
        """Draw the name of the head, and the sampled load at its centre. Loads of the scene are not in the journal."""
        centre, name = self.section.head_points(pose)
        self.names.add(stamp_ns, step, positions=[name])
        fx, fy, moment = load.tolist()
        if self.header.excitation_source != "scene" and math.isfinite(fx):
            vector = (ARROW_MM_PER_N * fx, -ARROW_MM_PER_N * fy)
            label = f"load {math.hypot(fx, fy) / 1e3:.0f} kN, {signed(moment / 1e3, '+.0f')} kN m"
            self.load_arrow.add(stamp_ns, step, origins=[centre], vectors=[vector], labels=[label])

    def _statuses(self, batch: Batch) -> None:
        """Write changes of status and alarms. Changes before the first sample are written at the first sample."""
        topics = (self.header.topic("status"), self.header.topic(ALARMS))
        for record in (record for part in batch.outputs for record in part.on(topics)):
            message = record.message()
            if isinstance(message, DiagnosticStatus):
                self._early.append((record.publish_time_ns, message))
        if self._axis.first_ns is not None:
            self._write_statuses()

    def _write_statuses(self) -> None:
        first_ns = self._axis.first_ns
        for published_ns, message in self._early:
            stamp_ns = published_ns if first_ns is None else max(first_ns, published_ns)
            self.events.status(stamp_ns, max(self.step, 0), message)
        self._early = []

    def flush(self) -> None:
        """Send the buffered rows."""
        if (self._largest_load > 1.05 * self._named_load).any():
            layout.style_load(self.stream, self._largest_load)
            self._named_load = self._largest_load
        for buffer in buffers(self):
            buffer.flush()
        for part in (self.events, self.contact_sets, self.face, self.what_if):
            part.flush()

    def finish(self, reader: RunReader) -> None:
        """Write the status of the recording and its losses, and send the buffered rows."""
        self._write_statuses()
        self.face.draw(self.stamp_ns, max(self.step, 0))
        self.contact_sets.finish()
        notes = [f"{count} {name.replace('_', ' ')}" for name, count in reader.lost_parts.items()]
        if reader.status not in (FileStatus.COMPLETE, FileStatus.UNREAD):
            notes.append(reader.status.value)
        for text in notes:
            self.events.add(self.stamp_ns, max(self.step, 0), f"recording: {text}", "ERROR")
        self.flush()
