"""A recording as one picture, without a viewer: cross-section at the largest force, forces, load, clearance."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.alarms import alarms_of
from plow_twin.record.durable import whole_file
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.times import EPOCH_S
from plow_twin.stream.alarms import Thresholds
from plow_twin.view.envelope import Envelope
from plow_twin.view.run_curves import Instant, RunCurves
from plow_twin.view.section import PAIR_COLORS, Section

#: Room about the end of an arrow for its label [mm].
_LABEL_ROOM_MM: Final = 50.0
_LOAD_NAMES: Final = ("Fx [kN]", "Fy [kN]", "M [kN m]")


def to_png(path: Path, out: Path) -> tuple[FileStatus, dict[str, int], int]:
    """Draw a recording into a PNG; return how the recording ended, counts of its losses, and failed advances.

    No line crosses missing entries or a reset. A long run is drawn as the envelope of its curves: the least and the
    largest value in bins of one width.

    Raises
    ------
    RecordingError
        The file is no recording, or `out` cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    reader = RunReader(path)
    scene = reader.header.scene(reader.path)
    section = Section.of(scene)
    curves = RunCurves.of(reader)
    if not curves:
        raise RecordingError(f"{reader.path}: got no row to draw ({reader.status.value}), expected some")
    figure = Figure(figsize=(15, 8.5), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    _draw_instant(figure.add_subplot(grid[:2, 0]), figure.add_subplot(grid[2, 0]), section, curves.instant)
    force = figure.add_subplot(grid[0, 1:])
    load, clearance = (figure.add_subplot(grid[row, 1:], sharex=force) for row in (1, 2))
    colors = [tuple(part / 255 for part in color) for color in PAIR_COLORS]
    _curves(force, curves.force, PAIR_NAMES, "largest force [kN]", colors)
    _thresholds(force, alarms_of(reader.header.parameters).alarms["force"].thresholds)
    _curves(load, curves.load, _LOAD_NAMES, "load [kN, kN m]", None)
    _clearance(clearance, curves)
    for axis in (force, load, clearance):
        for begin, end in curves.held_s:
            axis.axvspan(begin, end, color="0.85", lw=0, zorder=0)
        for begin, end in curves.failed_s:
            axis.axvspan(begin, end, color="tab:red", alpha=0.25, zorder=0)
    meanings = ("; grey: without samples" if curves.held_s else "") + ("; red: failed" if curves.failed_s else "")
    clearance.set_xlabel("time since the first stamp [s]" + meanings)
    lost = {**reader.lost, **reader.lost_parts}
    figure.suptitle(_title(reader, curves, lost))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(out) as stream:
            FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {error.strerror}") from error
    return reader.status, lost, curves.failed


def _title(reader: RunReader, curves: RunCurves, lost: dict[str, int]) -> str:
    """Return file, scene, date and end of the recording."""
    parts = [reader.path.name]
    scene = reader.header.parameters.get("scene")
    if isinstance(scene, str) and scene:
        parts.append(f"scene {Path(scene).name}")
    if curves.first_ns is not None and curves.first_ns >= EPOCH_S * 1e9:
        parts.append(datetime.fromtimestamp(curves.first_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC"))
    losses = [f"lost {name.replace('_', ' ')}: {count}" for name, count in lost.items()]
    if curves.failed:
        losses.append(f"{curves.failed} advances failed: no forces")
    if reader.status is not FileStatus.COMPLETE or not losses:
        losses.insert(0, reader.status.value)
    return ", ".join(parts + losses)


def _draw_instant(upper: Any, lower: Any, section: Section, instant: Instant | None) -> None:
    if instant is None:
        for place, name in ((upper, "pose"), (lower, "penetrations")):
            _say_nothing(place, f"no {name} in the recording")
            place.set(xticks=[])
        return
    _draw_section(upper, section, instant)
    _draw_gaps(lower, instant.penetration)


def _say_nothing(axis: Any, text: str) -> None:
    """Write a text in place of a drawing."""
    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes)
    axis.set(yticks=[])


def _draw_section(axis: Any, section: Section, instant: Instant) -> None:
    pose, force, largest = instant.pose, instant.force, float(instant.force.max())
    axis.plot(*section.frame_strip().T, color="0.5", label=section.frame_name)
    for number, strip in enumerate(section.head_strips(pose)):
        axis.plot(*strip.T, color="k", lw=1.0, label="" if number else "head")
    if largest > 0.0:
        origins, vectors, pairs = section.arrows(pose, force)
        for origin, vector, pair in zip(origins, vectors, pairs, strict=True):
            color = tuple(part / 255 for part in PAIR_COLORS[pair])
            axis.annotate("", origin + vector, origin, arrowprops={"arrowstyle": "->", "color": color, "lw": 2})
            text = f"{force[pair] / 1e3:.0f} kN"
            sideways = abs(vector[0]) > abs(vector[1])
            side = "center" if not sideways else "left" if vector[0] > 0.0 else "right"
            axis.annotate(text, origin + 1.1 * vector, color=color, ha=side, va="center", fontsize=8)
        # the limits of the axes follow the ends of the arrows, not the annotations
        axis.update_datalim(
            np.concatenate([origins + 1.1 * vectors + side for side in (-_LABEL_ROOM_MM, _LABEL_ROOM_MM)])
        )
        axis.autoscale_view()
    axis.set(aspect="equal", title=f"Cross-section [mm] at the largest force\nof a stamp, {largest / 1e3:.1f} kN")
    axis.margins(0.1)
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.06), ncols=2, fontsize=7)
    _y_upwards(axis)


def _y_upwards(axis: Any) -> None:
    """Label y upwards: the section has y downwards as the viewer has."""
    axis.invert_yaxis()
    axis.yaxis.set_major_formatter(lambda y, _: f"{0.0 - y:g}")


def _draw_gaps(axis: Any, penetration: NDArray[np.float64]) -> None:
    """Draw the gap of each pair as a bar, and its penetration to the other side."""
    places = np.arange(len(PAIR_NAMES))
    colors = ["tab:orange" if value > 0.0 else "0.6" for value in penetration]
    bars = axis.barh(places, 1e3 * penetration, color=colors)
    axis.bar_label(bars, [f"{1e3 * value:.1f}" for value in penetration], fontsize=7, padding=2)
    axis.axvline(0.0, color="k", lw=0.8)
    axis.margins(x=0.15)
    axis.set_yticks(places, PAIR_NAMES, fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("gap (negative) or penetration at that stamp [mm]")


def _curves(axis: Any, rows: Envelope, names: Sequence[str], label: str, colors: Sequence[Any] | None) -> None:
    axis.set_ylabel(label)
    if not rows:
        _say_nothing(axis, "not in the recording")
        return
    for index, name in enumerate(names):
        color = colors[index] if colors else f"C{index}"
        times, least, largest = rows.bands(index)
        axis.plot(times, largest, lw=0.7, label=name, color=color)
        if rows.is_binned:
            axis.plot(times, least, lw=0.7, color=color)
            axis.fill_between(times, least, largest, color=color, alpha=0.2, lw=0)
    _legend_beside(axis)


def _thresholds(axis: Any, thresholds: Thresholds) -> None:
    """Draw the thresholds [N] of the alarm on forces, if it has any."""
    for value, color, name in ((thresholds.warn, "tab:orange", "warning"), (thresholds.error, "tab:red", "error")):
        if value > 0.0:
            axis.axhline(value / 1e3, color=color, ls="--", lw=1.0)
            axis.annotate(name, (1.0, value / 1e3), xycoords=axis.get_yaxis_transform(), color=color, fontsize=7,
                          ha="right", va="bottom")  # fmt: skip


def _clearance(axis: Any, curves: RunCurves) -> None:
    """Draw both clearances with their intervals, and the changes by other causes than wear."""
    axis.set_ylabel("clearance with its\n5..95 % interval [mm]")
    if not curves.clearance:
        _say_nothing(axis, "not in the recording")
        return
    for index, name in enumerate(("horizontal", "vertical")):
        times, _, value = curves.clearance.bands(3 * index)
        low, high = curves.clearance.bands(3 * index + 1)[1], curves.clearance.bands(3 * index + 2)[2]
        line = axis.plot(times, value, label=f"{name},\n{value[-1]:.3f} mm at the end")[0]
        axis.fill_between(times, low, high, alpha=0.25, color=line.get_color(), lw=0)
    for time_s, reason in curves.changes:
        axis.axvline(time_s, color="0.4", ls=":", lw=1.0)
        axis.annotate(reason, (time_s, 1.0), xycoords=axis.get_xaxis_transform(), fontsize=7, rotation=90,
                      ha="right", va="top", color="0.3")  # fmt: skip
    _legend_beside(axis)


def _legend_beside(axis: Any) -> None:
    """Put the legend beside the axes."""
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
