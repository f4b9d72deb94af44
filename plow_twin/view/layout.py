"""How the viewer arranges a recording: the blueprint, and how each curve looks."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn
from rerun.components import AggregationPolicy, InterpolationMode

from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.header import RunHeader
from plow_twin.stream.outputs import CLEARANCE_NAMES
from plow_twin.view.columns import ROS_TIME, RUN_TIME, STEP
from plow_twin.view.section import ARROW_MM_PER_N, LOAD_COLOR, PAIR_COLORS, Section

FORCE: Final = tuple(f"force/{name}" for name in PAIR_NAMES)
FORCE_AT_STAMP: Final = tuple(f"force_at_stamp/{name}" for name in PAIR_NAMES)
PENETRATION: Final = tuple(f"penetration/{name}" for name in PAIR_NAMES)
LOAD: Final = ("load/fx", "load/fy", "load/moment")
AGE: Final = ("quality/sample_age_ms",)
INTERVAL: Final = ("quality/sample_interval_ms",)
TOTAL: Final = tuple(f"clearance/{name}" for name in CLEARANCE_NAMES if not name.startswith("pad_"))
GROWTH: Final = tuple(f"growth/{name}" for name in CLEARANCE_NAMES if not name.startswith("pad_"))
WEAR: Final = tuple(f"wear/{name}" for name in CLEARANCE_NAMES if name.startswith("pad_"))

_LOAD_NAMES: Final = ("Fx [kN]", "Fy [kN]", "M [kN m]")
_LOAD_COLORS: Final = (LOAD_COLOR, (86, 180, 233), (200, 200, 200))
_CLEARANCE_COLORS: Final = {"horizontal": (86, 180, 233), "vertical": (240, 160, 60)}


def blueprint(section: Section, exaggerate: float) -> rrb.Blueprint:
    """Return the arrangement: the cross-sections beside the curves, the events and data quality below."""
    half_x, half_y = (float(half) for half in section.half_view)
    picture = rrb.Spatial2DView(
        origin="section",
        name="Cross-section [mm]",
        visual_bounds=rrb.VisualBounds2D(x_range=(-half_x, half_x), y_range=(-half_y, half_y)),
        background=(24, 26, 30),
    )
    wide = rrb.Spatial2DView(
        origin="exaggerated",
        name=f"Clearance {exaggerate:g} times as wide",
        visual_bounds=rrb.VisualBounds2D(x_range=(-half_x, half_x), y_range=(-half_y, half_y)),
        background=(24, 26, 30),
    )
    times = [TimelineColumn(visible=name == RUN_TIME, timeline=name) for name in (RUN_TIME, ROS_TIME, STEP)]
    columns = rrb.TextLogColumns(timeline_columns=times, text_log_columns=["LogLevel", "Body"])
    below = rrb.Tabs(
        rrb.TextLogView(origin="events", name="Events", columns=columns),
        rrb.TextDocumentView(origin="about", name="About this run"),
        rrb.TimeSeriesView(origin="quality", name="Data quality [ms]"),
        active_tab=0,
    )
    curves = rrb.Vertical(
        _plot("force", "Contact force, largest between two messages [kN]"),
        _plot("load", "Load on the head"),
        rrb.Tabs(
            _plot("growth", "Clearance: growth by wear, 5..95 % [um]", rrb.Corner2D.LeftTop),
            _plot("clearance", "Clearance with 5..95 % interval [mm]"),
            _plot("penetration", "Penetration, negative is a gap [mm]"),
            _plot("wear", "Wear depth of the pads with 5..95 % interval [mm]"),
            active_tab=0,
        ),
        row_shares=[5, 2, 4],
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(rrb.Horizontal(picture, wide), below, row_shares=[5, 3]), curves, column_shares=[6, 5]
        ),
        rrb.TimePanel(state="collapsed", timeline=RUN_TIME),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plot(origin: str, name: str, legend: rrb.Corner2D = rrb.Corner2D.RightTop) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend)


def style_curves(stream: rr.RecordingStream) -> None:
    """Give the curves their colours, names and the reduction that keeps peaks when many points share a pixel."""
    for entities in (FORCE, FORCE_AT_STAMP, PENETRATION):
        for entity, name, color in zip(entities, PAIR_NAMES, PAIR_COLORS, strict=True):
            _style(stream, entity, name, color, AggregationPolicy.MinMax)
    for entity, name, color in zip(LOAD, _LOAD_NAMES, _LOAD_COLORS, strict=True):
        _style(stream, entity, name, color, AggregationPolicy.MinMax)
    for entity in (*AGE, *INTERVAL):
        _style(stream, entity, entity.rpartition("/")[2], (200, 200, 200), AggregationPolicy.MinMax)
    for entity in (*TOTAL, *GROWTH, *WEAR):  # the bounds of an interval thinner than the value that they belong to
        base, _, bound = entity.partition("/")[2].partition("/")
        pair = base.removeprefix("pad_")
        color = _CLEARANCE_COLORS.get(base) or PAIR_COLORS[PAIR_NAMES.index(pair)]
        shade = tuple(round(0.6 * part) for part in color) if bound else color
        _style(stream, entity, f"{base} {bound}".strip(), shade, AggregationPolicy.MinMax, 1.0 if bound else 2.5)


def _style(
    stream: rr.RecordingStream,
    entity: str,
    name: str,
    color: tuple[int, ...],
    policy: AggregationPolicy,
    width: float = 1.5,
) -> None:
    lines = rr.SeriesLines(
        colors=[color],
        names=[name],
        widths=[width],
        aggregation_policy=policy,
        interpolation_mode=InterpolationMode.Linear,
    )
    stream.log(entity, lines, static=True)


def about(scene: Scene, header: RunHeader, source: Path) -> str:
    """Return, in Markdown, what was run and how to read the picture."""
    contact = scene.contact
    return f"""# {source.name}

The head ({scene.head.mass_kg:g} kg) moves about the fixed frame of the guide
({1e3 * scene.frame.width_m:g} x {1e3 * scene.frame.height_m:g} mm) inside the clearance of its cavity
({1e3 * scene.clearance.horizontal_m:g} mm horizontal, {1e3 * scene.clearance.vertical_m:g} mm vertical in total).
Where a corner of the frame meets a wall of the cavity, an arrow shows the force on the head (100 kN are
{1e5 * ARROW_MM_PER_N:g} mm long), in the colour of its curve. Everything is to scale but the outer outline of the head.

- grey: frame, with its corners; white: the cavity and, schematically, the body of the head; violet: the load on it
- force curves: the largest force between two messages, no peak is left out (`force_at_stamp`: the force at the stamp)
- the cross-section is thinned in time; curves keep every row
- growth of the clearance: over the clearance without wear, in micrometres; the thin lines bound its 5..95 % interval
- timelines: `{ROS_TIME}` is the stamp, `{RUN_TIME}` the time since the first one, `{STEP}` counts the advances
- beside it the same with the clearance drawn several times as wide, worn pads included; walls that touch are orange

| | |
|---|---|
| contact law | {contact.law}, stiffness {contact.stiffness:g}, exponent {contact.exponent:g} |
| excitation source | {header.excitation_source} |
| tolerance | {header.tol:g} |
| node | {header.node} |
| plow_twin | {header.package_version} |
"""
