"""A run shown while it is recorded: the file is followed by a process of its own, whatever the viewer does.

Nothing leads from here back to the node: a viewer that is slow, stopped or gone stops this process alone. What is shown
is thinned to a fixed rate, the least and the largest value of each span being kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from plow_twin.model.scene import Scene
from plow_twin.record.follow import Tail
from plow_twin.record.reader import RunReader
from plow_twin.view import layout
from plow_twin.view.drawing import Drawing
from plow_twin.view.rrd import ViewSummary
from plow_twin.view.section import Section

#: Spans a second in which a curve keeps two values [Hz]: an hour of all curves is some 200 MB in the viewer.
CURVE_HZ: Final = 25.0
#: Moments of the cross-section [Hz], and those of what was recorded before.
SECTION_HZ: Final = 20.0
_SECTION_HZ_BEFORE: Final = 1.0

#: Takes the stream and its arrangement to where they go.
Sink = Callable[[rr.RecordingStream, rrb.Blueprint], object]


def follow(
    path: Path,
    sink: Sink,
    stop: Callable[[], bool] = lambda: False,
    *,
    exaggerate: float | None = None,
    others: Mapping[str, Scene] | None = None,
) -> ViewSummary:
    """Show a recording until its recorder closes it or ends, or `stop` is true; `exaggerate`, `others` as in `to_rrd`.

    Raises
    ------
    RecordingError
        The file is no recording.
    """
    reader = RunReader(path, Tail(stop))
    scene = reader.header.scene(reader.path)
    wide = exaggerate or Section.of(scene).exaggeration()
    stream = rr.RecordingStream("plow_twin")
    sink(stream, layout.blueprint(Section.of(scene), wide, bool(others)))
    drawing = Drawing(
        stream,
        reader.header,
        scene,
        reader.path,
        section_hz=_SECTION_HZ_BEFORE,
        exaggerate=wide,
        span_ns=round(1e9 / CURVE_HZ),
        others=others,
    )
    for batch in reader.batches():
        if len(batch.entries) or batch.outputs:
            drawing.add(batch)
        else:  # all there is
            drawing.section_hz = SECTION_HZ
            drawing.flush()
            stream.flush()
    drawing.finish(reader)
    stream.flush()
    stream.disconnect()
    return ViewSummary.of(reader.path, drawing, reader)
