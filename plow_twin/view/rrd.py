"""A recording as a rerun file with its blueprint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from plow_twin.model.scene import Scene
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.view.drawing import Drawing
from plow_twin.view.rrd_file import RrdFile

MOST_ROWS: Final = 200_000
#: Rate of the cross-section [Hz]; curves keep every row.
SECTION_HZ: Final = 100.0
#: Assumed size of a recording per row of its curves [B].
_BYTES_PER_ROW: Final = 400


@dataclass(frozen=True)
class ViewSummary:
    """Content of a .rrd: first stamp, rows of the curves, cross-sections, events.

    `status` is how the recording ended. `lost` has the recorder's counts by topic, the missing and foreign parts, and
    the samples that came too late for other scenes. Of the `rows` of the force curves, `curve_rows` were sent. `failed`
    is the number of failed advances, which have no forces.
    """

    path: Path
    first_ns: int
    rows: int
    curve_rows: int
    section_rows: int
    events: int
    status: FileStatus
    lost: Mapping[str, int]
    failed: int = 0

    @classmethod
    def of(cls, path: Path, drawing: Drawing, reader: RunReader) -> ViewSummary:
        """Return the summary of a drawing."""
        force = drawing.force
        return cls(
            path,
            drawing.first_ns,
            force.rows,
            force.sent,
            drawing.section_rows,
            drawing.events.count,
            reader.status,
            {**reader.lost, **reader.lost_parts, **drawing.what_if.lost},
            drawing.events.failed,
        )


def to_rrd(
    path: Path,
    out: Path,
    *,
    section_hz: float = SECTION_HZ,
    exaggerate: float | None = None,
    most_rows: int = MOST_ROWS,
    others: Mapping[str, Scene] | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> ViewSummary:
    """Write the .rrd of a complete or cut-off recording, with only a few of its chunks in memory at a time.

    Parameters
    ----------
    path
        The `.mcap` file or its folder.
    out
        The .rrd file to write.
    section_hz
        Rate of the cross-section [Hz].
    exaggerate
        Factor by which the second cross-section widens the clearance; None: chosen by the size of the clearance.
    most_rows
        Largest number of rows of a curve; the limit for the cross-section is a twentieth of this number. A longer run
        is thinned: a curve keeps the least and the largest value of each span, so that no peak is lost.
    others
        Other scenes, by name, whose forces under the load of the run are drawn too.
    on_progress
        Receives the share that is done, 0..1.

    Raises
    ------
    RecordingError
        The file is not a recording, or `out` cannot be written.
    """
    reader = RunReader(Path(path))
    duration_s = reader.duration_s()
    with RrdFile(out) as file:
        drawing = Drawing(
            reader,
            file.attach,
            section_hz=min(section_hz, max(1.0, 0.05 * most_rows / max(duration_s, 1e-9))),
            exaggerate=exaggerate,
            span_ns=_span_ns(reader, duration_s, most_rows),
            others=others,
        )
        for batch in reader.batches():
            drawing.add(batch)
            file.check()
            if on_progress is not None:
                on_progress(reader.position)
        drawing.finish(reader)
        if on_progress is not None:
            on_progress(1.0)
    return ViewSummary.of(out, drawing, reader)


def _span_ns(reader: RunReader, duration_s: float, most_rows: int) -> int:
    """Return the span of which a curve keeps two rows [ns]; 0 for a short run, which keeps all."""
    rows = reader.size() / _BYTES_PER_ROW
    return 0 if rows <= most_rows else max(1, round(2e9 * duration_s / most_rows))
