"""Output of a recording as a rerun file with its blueprint."""

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
#: Rate of the cross-section [Hz]. Curves are not thinned to this rate.
SECTION_HZ: Final = 100.0
#: Assumed size of a recording [B] per row of its curves.
_BYTES_PER_ROW: Final = 400


@dataclass(frozen=True)
class ViewSummary:
    """Content of a rerun file: first stamp, numbers of rows, cross-sections and events.

    `status` describes how the recording ended. `lost` contains the recorder's counts by topic, the missing and foreign
    parts, and the samples that came too late for other scenes. `rows` is the number of rows of the force curves, and
    `curve_rows` the number of rows sent. `failed` is the number of failed advances, for which no forces exist.
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
    exaggerate: float | None = None,
    most_rows: int = MOST_ROWS,
    others: Mapping[str, Scene] | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> ViewSummary:
    """Write a complete or truncated recording as a rerun file.

    Parameters
    ----------
    path
        The `.mcap` file or its folder.
    out
        The .rrd file to write.
    exaggerate
        Factor by which the second cross-section widens the clearance. With None, the factor follows from the clearance.
    most_rows
        Largest number of rows of a curve. The number of cross-sections is limited to a twentieth of this number. For a
        longer run, only two values of each curve are written for each span: the least and the largest. No peak is lost.
    others
        Scenes by name. The forces of these scenes under the load of the run are drawn beside the forces of the run.
    on_progress
        Callback that receives the share of the work done, 0..1.

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
            section_hz=min(SECTION_HZ, max(1.0, 0.05 * most_rows / max(duration_s, 1e-9))),
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
    """Return the length [ns] of a span, or 0 if all rows are written. Two rows are written for each span."""
    rows = reader.size() / _BYTES_PER_ROW
    return 0 if rows <= most_rows else max(1, round(2e9 * duration_s / most_rows))
