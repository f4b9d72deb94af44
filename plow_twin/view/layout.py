"""Blueprint of the rerun viewer for a recording, and the style of each curve."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
from plow_twin.view.contact_sets import ENTITY
from plow_twin.view.face import HEIGHT, WIDTH
from plow_twin.view.section import ARROW_MM_PER_N, LOAD_COLOR, PAD_MM_PER_MM, PAIR_COLORS, Section

FORCE: Final = tuple(f"force/{name}" for name in PAIR_NAMES)
FORCE_AT_STAMP: Final = tuple(f"force_at_stamp/{name}" for name in PAIR_NAMES)
#: 5 % and 95 % points of the forces at the stamps, for a twin that follows its machine.
FORCE_BOUNDS: Final = tuple(f"force_interval/{name}/{point}" for point in ("p05", "p95") for name in PAIR_NAMES)
POSE: Final = ("pose/x", "pose/y", "pose/theta")
MEASURED: Final = ("pose/measured/x", "pose/measured/y", "pose/measured/theta")
PENETRATION: Final = tuple(f"penetration/{name}" for name in PAIR_NAMES)
LOAD: Final = ("load/fx", "load/fy", "load/moment")
AGE: Final = ("quality/sample_age_ms",)
INTERVAL: Final = ("quality/sample_interval_ms",)
TOTAL: Final = tuple(f"clearance/{name}" for name in CLEARANCE_NAMES if not name.startswith("pad_"))
GROWTH: Final = tuple(f"growth/{name}" for name in CLEARANCE_NAMES if not name.startswith("pad_"))
#: Areas between the bounds of a clearance. Their names sort before those of the curves, which are drawn on top of them.
BAND: Final = tuple(f"{group}/band/{way}" for group in ("clearance", "growth") for way in ("horizontal", "vertical"))
RESIDUAL: Final = ("residual/x", "residual/y", "residual/theta")
WEAR: Final = tuple(f"wear/{name}" for name in CLEARANCE_NAMES if name.startswith("pad_"))

#: Contents of a view without the bounds, which the bands show. A legend has room for only eight names.
_WITHOUT_BOUNDS: Final = (
    "$origin/**",
    *(f"- $origin/{name}" for name in CLEARANCE_NAMES if name.endswith(("/p05", "/p95"))),
)
_FOLLOWED: Final = ("$origin/**", "/force_at_stamp/**")
_LOAD_NAMES: Final = (("Fx", "Fy", "M"), ("kN", "kN", "kN m"))
_LOAD_COLORS: Final = (LOAD_COLOR, (86, 180, 233), (200, 200, 200))
_QUALITY: Final = ((240, 160, 60), (86, 180, 233))
_RESIDUAL_NAMES: Final = ("x [mm]", "y [mm]", "theta [mrad]")
_WHAT_IF_COLORS: Final = (
    (235, 235, 235),
    (86, 180, 233),
    (240, 160, 60),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
)
#: Opacity of a stroke of a band (255: opaque). Several faint strokes overlap at each pixel.
_BAND_ALPHA: Final = 10
_BAND_WIDTH: Final = 6.0
_CLEARANCE_COLORS: Final = {"horizontal": (86, 180, 233), "vertical": (240, 160, 60)}


def blueprint(
    section: Section, exaggerate: float, what_if: bool = False, followed: bool = False, *, title: str = ""
) -> rrb.Blueprint:
    """Return the arrangement of the views.

    With `what_if`, the view that compares scenes is the active tab. With `followed`, a view shows the forces with their
    90 % intervals. `title` is appended to the name of the view of the forces.
    """
    half_x, half_y = (float(half) for half in section.half_view)
    bounds = (-half_x, half_x), (-half_y, half_y)
    picture = _space("section", "Cross-section [mm]", *bounds)
    wide = _space("exaggerated", f"Clearance {exaggerate:g} times as wide", *bounds)
    face = _space("face", "Force along the face", (-30.0, WIDTH + 15.0), (-HEIGHT - 12.0, 15.0))
    times = [TimelineColumn(visible=name == RUN_TIME, timeline=name) for name in (RUN_TIME, ROS_TIME, STEP)]
    columns = rrb.TextLogColumns(timeline_columns=times, text_log_columns=["LogLevel", "Body"])
    below = rrb.Tabs(
        rrb.TextLogView(origin="events", name="Events", columns=columns),
        face,
        rrb.TextDocumentView(origin="about", name="About this run"),
        rrb.TimeSeriesView(origin="quality", name="Data quality [ms]"),
        active_tab=0,
    )
    curves = rrb.Vertical(
        # with a smaller share, the view would cut off its title
        _plot("force", f"Largest contact force [kN]{title and '; '}{title}"),
        rrb.StateTimelineView(origin=ENTITY, name="Corners that carry force"),
        _plot("load", "Load on the head"),
        rrb.Tabs(
            *([_plot("what_if", "What if: largest force [kN]")] if what_if else []),
            _plot("growth", "Growth by wear [µm]", rrb.Corner2D.LeftTop, _WITHOUT_BOUNDS),
            _plot("clearance", "Clearance [mm]", contents=_WITHOUT_BOUNDS),
            _plot("pose", "Pose, measured and of the twin"),
            _plot("residual", "Residual"),
            *([_plot("force_interval", "Force and its 90 % interval [kN]", contents=_FOLLOWED)] if followed else []),
            _plot("penetration", "Penetration [mm]"),
            _plot("wear", "Wear [mm]", rrb.Corner2D.LeftTop, _WITHOUT_BOUNDS),
            active_tab=0,
        ),
        # with these shares, the contact sets fit into a window of 600 pixels height
        row_shares=[4.7, 2.2, 2.7, 3.4],
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(rrb.Horizontal(picture, wide), below, row_shares=[5, 3]), curves, column_shares=[6, 5]
        ),
        rrb.TimePanel(state="collapsed", timeline=RUN_TIME),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _space(origin: str, name: str, x: tuple[float, float], y: tuple[float, float]) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds, background=(24, 26, 30))


def _plot(
    origin: str,
    name: str,
    legend: rrb.Corner2D = rrb.Corner2D.RightTop,
    contents: Sequence[str] = ("$origin/**",),
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, contents=list(contents), name=name, plot_legend=legend)


def style_curves(stream: rr.RecordingStream) -> None:
    """Set the colours and names of the curves, and a reduction that preserves peaks where many points share a pixel."""
    for entities in (FORCE, FORCE_AT_STAMP, PENETRATION):
        for entity, name, color in zip(entities, PAIR_NAMES, PAIR_COLORS, strict=True):
            _style(stream, entity, name, color)
    style_load(stream, (0.0, 0.0, 0.0))
    for entity, name, color in zip((*AGE, *INTERVAL), ("age of a sample", "time between two"), _QUALITY, strict=True):
        _style(stream, entity, name, color)
    for entity in FORCE_BOUNDS:
        _, pair, point = entity.split("/")
        _style(stream, entity, f"{pair} {point}", _darker(PAIR_COLORS[PAIR_NAMES.index(pair)]), 1.0)
    for pose, measured, residual, name, color in zip(
        POSE, MEASURED, RESIDUAL, _RESIDUAL_NAMES, _LOAD_COLORS, strict=True
    ):
        _style(stream, pose, name, color)
        _style(stream, measured, f"{name}, measured", _darker(color), 1.0)
        _style(stream, residual, name, color)
    for entity in BAND:
        _style(stream, entity, "90 % interval", None, _BAND_WIDTH)
    # bounds are drawn thinner and darker than values
    for entity in (*TOTAL, *GROWTH, *WEAR):
        base, _, bound = entity.partition("/")[2].partition("/")
        base = base.removeprefix("pad_")
        color = _CLEARANCE_COLORS.get(base) or PAIR_COLORS[PAIR_NAMES.index(base)]
        shade, width = (_darker(color), 1.0) if bound else (color, 2.5)
        _style(stream, entity, f"{base} {bound}".strip(), shade, width)


def _darker(color: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(round(0.6 * part) for part in color)


def band_colors(entity: str) -> list[tuple[int, ...]]:
    """Return two colours of a band: the colour of the first, opaque stroke, and the colour of the faint strokes."""
    color = _CLEARANCE_COLORS[entity.rpartition("/")[2]]
    return [(*(part // 2 for part in color), 255), (*color, _BAND_ALPHA)]


def style_load(stream: rr.RecordingStream, largest: Iterable[float]) -> None:
    """Put the largest loads into the names of the load curves."""
    for entity, name, unit, color, value in zip(LOAD, *_LOAD_NAMES, _LOAD_COLORS, largest, strict=True):
        named = f"{name}, to {value:.3g} {unit}" if value else f"{name} [{unit}]"
        _style(stream, entity, named, color)


def what_if_curves(stream: rr.RecordingStream, names: Sequence[str]) -> tuple[str, ...]:
    """Set the names and colours of the curves of the run and of other scenes. Return their entities."""
    entities = tuple(f"what_if/{number}" for number in range(len(names) + 1))
    for number, (entity, name) in enumerate(zip(entities, ("the run", *names), strict=True)):
        color = _WHAT_IF_COLORS[number % len(_WHAT_IF_COLORS)]
        _style(stream, entity, name, color, 2.0 if number == 0 else 1.2)
    return entities


def _style(
    stream: rr.RecordingStream, entity: str, name: str, color: tuple[int, ...] | None, width: float = 1.5
) -> None:
    lines = rr.SeriesLines(
        colors=None if color is None else [color],
        names=[name],
        widths=[width],
        aggregation_policy=AggregationPolicy.MinMax,
        interpolation_mode=InterpolationMode.Linear,
    )
    stream.log(entity, lines, static=True)


def about(scene: Scene, header: RunHeader, source: Path) -> str:
    """Return a description of the run and of the views as Markdown."""
    contact = scene.contact
    frame = "fixed frame" if scene.support is None else "frame, on springs, to which this picture is fixed,"
    return f"""# {source.name}

The head ({scene.head.mass_kg:g} kg) moves about the {frame} of the guide
({1e3 * scene.frame.width_m:g} x {1e3 * scene.frame.height_m:g} mm) inside the clearance of its cavity
({1e3 * scene.clearance.horizontal_m:g} mm horizontal, {1e3 * scene.clearance.vertical_m:g} mm vertical in total).
Where a corner of the frame meets a wall of the cavity, an arrow shows the force on the head in the colour of its curve.
An arrow of {1e5 * ARROW_MM_PER_N:g} mm means 100 kN. Everything except the outer outline of the head is drawn to scale.

- Colours: the frame and its corners are grey, the cavity and the schematic body of the head are white, and the load on
  the head is violet.
- Force curves show the largest force between two messages. `force_at_stamp` shows the force at the stamp of a message.
- The cross-section is drawn at a limited rate; curves contain all rows or their extremes.
- The growth of the clearance is measured from the clearance without wear [µm]. The band is its 90 % interval.
- The outline of the head and the corners that carry force are blue if they stop a counter-clockwise swing, orange if
  they stop a clockwise swing, and violet for both.
- The force along the face is the largest force in each piece of the face. The newest pass is bright.
- A residual is a measured pose minus the pose of the model.
- If the twin follows its machine (`follow: full`), the forces at the stamps are shown with their 90 % interval.
- The timeline `{ROS_TIME}` shows the stamp. `{RUN_TIME}` counts from the first stamp, `{STEP}` counts advances.
- The second cross-section widens the clearance, which also exaggerates the slope of the walls. Walls that touch are
  orange. Bars inside the frame show the wear of its pads, {1e-3 * PAD_MM_PER_MM:g} mm for each µm.

| | |
|---|---|
| contact law | {contact.law}, stiffness {contact.stiffness:g}, exponent {contact.exponent:g} |
| excitation source | {header.excitation_source} |
| tolerance | {header.tol:g} |
| node | {header.node} |
| plow_twin | {header.package_version} |
"""
