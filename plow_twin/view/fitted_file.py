"""Output of the picture of a fit as a PNG file or a rerun file."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from plow_twin.view.figures import write_png
from plow_twin.view.fitted import FittedPicture, markdown

_MEASURED: Final = (150, 155, 165)
_FITTED: Final = (86, 180, 233)
_RESIDUAL: Final = (240, 160, 60)
_COMPONENTS: Final = (("x", "mm"), ("y", "mm"), ("theta", "mrad"))


def write_fit_picture(picture: FittedPicture, path: Path) -> None:
    """Write a PNG file, or a rerun file if the suffix is .rrd. Raise `RecordingError` if the file cannot be written."""
    if path.suffix == ".rrd":
        _write_rrd(picture, path)
    else:
        write_png(picture.figure(), path)


def _write_rrd(picture: FittedPicture, path: Path) -> None:
    import rerun as rr
    import rerun.blueprint as rrb

    from plow_twin.view.columns import RUN_TIME
    from plow_twin.view.rrd_file import RrdFile

    stream = rr.RecordingStream("plow_twin")
    plots = [
        rrb.TimeSeriesView(origin=f"{kind}/{name}", name=f"{title} {name} [{unit}]")
        for name, unit in _COMPONENTS
        for kind, title in (("pose", "Measured and fitted"), ("residual", "Measured minus fitted"))
    ]
    layout = rrb.Horizontal(
        rrb.Vertical(*plots, row_shares=[2, 1] * len(_COMPONENTS)),
        rrb.TextDocumentView(origin="values", name="Values"),
        column_shares=[3, 2],
    )
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    with RrdFile(path) as file:
        file.attach(stream, rrb.Blueprint(layout, rrb.TimePanel(state="collapsed", timeline=RUN_TIME), *panels))
        motion = picture.motion
        for number, (name, _) in enumerate(_COMPONENTS):
            points = rr.SeriesPoints(colors=[_MEASURED], names=["measured"], marker_sizes=[1.5])
            stream.log(f"pose/{name}/measured", points, static=True)
            stream.log(f"pose/{name}/fitted", rr.SeriesLines(colors=[_FITTED], names=["fitted"]), static=True)
            stream.log(f"residual/{name}", rr.SeriesPoints(colors=[_RESIDUAL], marker_sizes=[1.5]), static=True)
            curves = {
                f"pose/{name}/measured": motion.measured,
                f"pose/{name}/fitted": motion.model,
                f"residual/{name}": motion.residual,
            }
            for entity, rows in curves.items():
                there = np.isfinite(rows[:, number])
                times = rr.TimeColumn(RUN_TIME, duration=motion.t[there])
                values = rr.Scalars.columns(scalars=1e3 * rows[there, number])
                rr.send_columns(entity, [times], values, recording=stream)
        document = rr.TextDocument(markdown(picture), media_type=rr.MediaType.MARKDOWN)
        stream.log("values", document, static=True)
