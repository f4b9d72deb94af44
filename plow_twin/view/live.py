"""Live view of a run. A separate process reads the growing file of the run, so the node does not depend on the view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from plow_twin.model.scene import Scene
from plow_twin.record.follow import Tail
from plow_twin.record.reader import RunReader
from plow_twin.view.drawing import Drawing, Sink
from plow_twin.view.rrd import ViewSummary

#: Rate of spans [Hz]. One hour of all curves takes some 200 MB in the viewer.
CURVE_HZ: Final = 25.0
SECTION_HZ: Final = 20.0
#: Rate of the cross-section [Hz] in the part of the run before the view started.
_SECTION_HZ_BEFORE: Final = 1.0


def follow(
    path: Path,
    sink: Sink,
    stop: Callable[[], bool] = lambda: False,
    *,
    exaggerate: float | None = None,
    others: Mapping[str, Scene] | None = None,
) -> ViewSummary:
    """Show a recording until its recorder ends or `stop` returns True. See `to_rrd` for the remaining arguments."""
    reader = RunReader(path, Tail(stop))
    drawing = Drawing(
        reader, sink, section_hz=_SECTION_HZ_BEFORE, exaggerate=exaggerate, span_ns=round(1e9 / CURVE_HZ), others=others
    )
    for batch in reader.batches():
        if len(batch.entries) or batch.outputs:
            drawing.add(batch)
        else:  # all recorded data have been drawn, so the view is live
            drawing.section_hz = SECTION_HZ
            drawing.flush()
            drawing.stream.flush()
    drawing.finish(reader)
    drawing.stream.flush()
    drawing.stream.disconnect()
    return ViewSummary.of(reader.path, drawing, reader)
