"""Picture of a recording: cross-section at the largest force, contact forces, load and clearances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.alarms import alarms_of
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.stream.alarms import Thresholds
from plow_twin.view.envelope import Envelope
from plow_twin.view.figures import legend_beside, scene_and_date, signed, write_png
from plow_twin.view.run_curves import Instant, RunCurves
from plow_twin.view.section import PAIR_RGB, Section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Margin around the end of an arrow for its label [mm].
_LABEL_ROOM_MM: Final = 50.0
_LABEL_WIDTH: Final = 0.015
_LOAD_NAMES: Final = ("Fx [kN]", "Fy [kN]", "M [kN m]")
#: Labels of the states of a clearance, as on the operator's screen.
_STATES: Final = {
    "prior": "assumed",
    "estimated": "estimated",
    "rough": "rough estimate",
    "not_observable": "not observable",
    "withdrawn": "withdrawn",
}


def to_png(path: Path, out: Path) -> tuple[FileStatus, dict[str, int], int]:
    """Draw a recording as PNG. Return its status, its losses, and the number of failed advances.

    Lines are interrupted at missing journal entries and at resets. For a long run, the envelope of the curves is drawn.
    """
    reader = RunReader(path)
    curves = RunCurves.of(reader)
    lost = {**reader.lost, **reader.lost_parts}
    write_png(run_figure(reader, curves), out)
    return reader.status, lost, curves.failed


def run_figure(reader: RunReader, curves: RunCurves) -> Figure:
    """Return the figure of a recording, or raise `RecordingError` if there is no row to draw."""
    from matplotlib.figure import Figure

    if not curves:
        raise RecordingError(f"{reader.path}: got no row to draw ({reader.status.value}), expected at least one")
    section = Section.of(reader.header.scene(reader.path))
    figure = Figure(figsize=(15, 8.5), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    _draw_instant(figure.add_subplot(grid[:2, 0]), figure.add_subplot(grid[2, 0]), section, curves)
    force = figure.add_subplot(grid[0, 1:])
    load, clearance = (figure.add_subplot(grid[row, 1:], sharex=force) for row in (1, 2))
    alarms = alarms_of(reader.header.parameters).alarms
    _curves(force, curves.force, PAIR_NAMES, "largest force [kN]", PAIR_RGB, only_largest=True)
    _thresholds(force, alarms["force"].thresholds, 1e-3)
    force.set_ylim(bottom=0.0)
    _curves(load, curves.load, _LOAD_NAMES, "load: forces [kN],\nmoment [kN m]", None, gaps=curves.held_s)
    _clearance(clearance, curves)
    _thresholds(clearance, alarms["clearance"].thresholds, 1e3)
    if curves.instant_s is not None:
        force.axvline(curves.instant_s, color="0.3", ls=":", lw=1.0, label="cross-section")
    for axis in (force, load, clearance):
        for begin, end in curves.held_s:
            axis.axvspan(begin, end, color="0.85", lw=0, zorder=0)
        for begin, end in curves.failed_s:
            axis.axvspan(begin, end, color="tab:red", alpha=0.25, zorder=0)
        if axis.get_legend_handles_labels()[0]:
            legend_beside(axis)
    clearance.set_xlabel("\n".join(("time since the first stamp [s]", "; ".join(_meanings(curves)))).rstrip())
    figure.suptitle(_title(reader, curves))
    return figure


def _meanings(curves: RunCurves) -> list[str]:
    span = max(curves.force.bin_s, curves.load.bin_s)
    return [
        *(["grey: without samples"] if curves.held_s else []),
        *(["red: failed"] if curves.failed_s else []),
        *([f"forces: the largest, load: least to largest in spans of up to {span:.2g} s"] if span else []),
    ]


def _title(reader: RunReader, curves: RunCurves) -> str:
    parts = ["/".join(reader.path.absolute().parent.parts[-2:])]
    parts.append(scene_and_date(reader, curves.first_ns))
    losses = [f"lost {name.replace('_', ' ')}: {count}" for name, count in reader.lost_parts.items()]
    if reader.lost:
        where = next(iter(reader.lost)) if len(reader.lost) == 1 else f"{len(reader.lost)} topics"
        losses.insert(0, f"{sum(reader.lost.values())} messages lost on {where}")
    if curves.failed:
        losses.append(f"{curves.failed} advances failed: no forces")
    if reader.status is not FileStatus.COMPLETE or not losses:
        parts.append(reader.status.value)
    return "\n".join(filter(None, (", ".join(parts), ", ".join(losses))))


def _draw_instant(upper: Any, lower: Any, section: Section, curves: RunCurves) -> None:
    instant = curves.instant
    if instant is None or curves.instant_s is None:
        for place, name in ((upper, "pose"), (lower, "penetrations")):
            _note_absence(place, f"no {name} in the recording")
            place.set(xticks=[])
        return
    _draw_section(upper, section, instant, curves)
    _draw_gaps(lower, instant.penetration)


def _note_absence(axis: Any, text: str) -> None:
    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes)
    axis.set(yticks=[])


def _draw_section(axis: Any, section: Section, instant: Instant, curves: RunCurves) -> None:
    pose, force, largest = instant.pose, instant.force, float(instant.force.max())
    axis.plot(*section.frame_strip().T, color="0.5", label=section.frame_name)
    for number, strip in enumerate(section.head_strips(pose)):
        axis.plot(*strip.T, color="k", lw=1.0, label="" if number else "head")
    if largest > 0.0:
        origins, vectors, pairs = section.arrows(pose, force)
        for origin, vector, pair in zip(origins, vectors, pairs, strict=True):
            color = PAIR_RGB[pair]
            axis.annotate("", origin + vector, origin, arrowprops={"arrowstyle": "->", "color": color, "lw": 2})
            text = f"{force[pair] / 1e3:.0f} kN"
            sideways = abs(vector[0]) > abs(vector[1])
            side = "center" if not sideways else "left" if vector[0] > 0.0 else "right"
            axis.annotate(text, origin + 1.1 * vector, color=color, ha=side, va="center", fontsize=8)
        # matplotlib ignores annotations in the limits of axes, so points on both sides of each label are added
        axis.update_datalim(
            np.concatenate([origins + 1.1 * vectors + side for side in (-_LABEL_ROOM_MM, _LABEL_ROOM_MM)])
        )
        axis.autoscale_view()
    turned, of_stamp = signed(math.degrees(pose[2]), ".1f"), f"at this stamp: {largest / 1e3:.1f} kN"
    of_run = f"of the run: {curves.peak:.1f} kN; " if curves.peak else ""
    axis.set(aspect="equal")
    axis.set_title(
        f"Cross-section [mm] at {curves.instant_s:.2f} s, head turned by {turned}°\nlargest force {of_run}{of_stamp}",
        fontsize=9,
    )
    axis.margins(0.1)
    axis.set_xlabel("to scale: where a wall overlaps a corner, the overlap is the penetration", fontsize=8)
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.1), ncols=2, fontsize=7)
    axis.invert_yaxis()
    axis.yaxis.set_major_formatter(lambda y, _: signed(0.0 - y, "g"))


def _draw_gaps(axis: Any, penetration: NDArray[np.float64]) -> None:
    """Draw a bar for each pair: the gap to the left, or the penetration to the right."""
    places = np.arange(len(PAIR_NAMES))
    colors = ["tab:orange" if value > 0.0 else "0.6" for value in penetration]
    bars = axis.barh(places, 1e3 * penetration, color=colors)
    axis.bar_label(bars, [signed(1e3 * value, ".1f") for value in penetration], fontsize=7, padding=2)
    axis.axvline(0.0, color="k", lw=0.8)
    axis.margins(x=0.15)
    axis.set_yticks(places, PAIR_NAMES, fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("at that stamp [mm]: gap (negative), penetration (positive)", fontsize=9)


def _curves(
    axis: Any,
    rows: Envelope,
    names: Sequence[str],
    label: str,
    colors: Sequence[Any] | None,
    *,
    only_largest: bool = False,
    gaps: Sequence[tuple[float, float]] = (),
) -> None:
    """Draw curves. If the rows are in bins, draw the band from the least to the largest value of each bin.

    `only_largest` omits the bands. Lines are interrupted at the `gaps` (start and end [s]).
    """
    axis.set_ylabel(label)
    if not rows:
        _note_absence(axis, "not in the recording")
        return
    for index, name in enumerate(names):
        color = colors[index] if colors else f"C{index}"
        times, least, largest = rows.bands(index)
        behind = [_widest(times, *gap) for gap in gaps if gap[1] - gap[0] > 2.0 * rows.bin_s]
        times, least, largest = (np.insert(values, behind, np.nan) for values in (times, least, largest))
        axis.plot(times, largest, lw=0.7, label=name, color=color)
        if rows.bin_s and not only_largest:
            axis.plot(times, least, lw=0.7, color=color)
            axis.fill_between(times, least, largest, color=color, alpha=0.2, lw=0)


def _widest(times: NDArray[np.float64], begin: float, end: float) -> int:
    """Return the index after the longest step that overlaps a gap from `begin` to `end` [s], or `len(times)`."""
    steps = np.where((times[1:] > begin) & (times[:-1] < end), np.diff(times), 0.0)
    return int(steps.argmax()) + 1 if steps.any() else len(times)


def _thresholds(axis: Any, thresholds: Thresholds, factor: float) -> None:
    for value, color, name in ((thresholds.warn, "tab:orange", "warning"), (thresholds.error, "tab:red", "error")):
        if value > 0.0:
            axis.axhline(factor * value, color=color, ls="--", lw=1.0, label=f"{name} threshold")


def _clearance(axis: Any, curves: RunCurves) -> None:
    axis.set_ylabel("clearance with its\n90 % interval [mm]")
    if not curves.clearance:
        _note_absence(axis, "not in the recording")
        return
    for index, name in enumerate(("horizontal", "vertical")):
        times, _, value = curves.clearance.bands(3 * index)
        low, high = curves.clearance.bands(3 * index + 1)[1], curves.clearance.bands(3 * index + 2)[2]
        end = _with_interval(value[-1], low[-1], high[-1])
        label = f"{name}, at the end\n{end},\n{_STATES[curves.states[name]]}"
        line = axis.plot(times, value, label=label)[0]
        axis.fill_between(times, low, high, alpha=0.25, color=line.get_color(), lw=0)
    left, right = axis.get_xlim()
    labels: list[tuple[float, str]] = []
    for time_s, reason in curves.changes:
        axis.axvline(time_s, color="0.4", ls=":", lw=1.0)
        if labels and time_s - labels[-1][0] < _LABEL_WIDTH * (right - left):
            labels[-1] = (labels[-1][0], f"{labels[-1][1]}, {reason}")
        else:
            labels.append((time_s, reason))
    for time_s, reason in labels:
        axis.annotate(reason, (time_s, 0.97), xycoords=axis.get_xaxis_transform(), fontsize=7, rotation=90,
                      xytext=(-2.0, 0.0), textcoords="offset points", ha="right", va="top", color="0.2")  # fmt: skip


def _with_interval(value: float, low: float, high: float) -> str:
    if high - low < 1e-3:
        return f"{value:.3f} mm"
    return f"{value:.2f} mm ({low:.2f} to {high:.2f})"
