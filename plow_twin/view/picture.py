"""A recording as one picture, without a viewer: cross-section at the largest force, forces, load, clearance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.durable import whole_file
from plow_twin.record.entries import EntryRecord
from plow_twin.record.messages import JointState, Odometry
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.stream.journal import Reset, Sample
from plow_twin.view.section import PAIR_COLORS, Section

_MOST_ROWS: Final = 8000
#: Numbers of entries are those modulo twice that.
_HALF: Final = 2**31


class _Largest:
    """Rows in time of which only the largest values of neighbours are kept when there are many."""

    def __init__(self, width: int) -> None:
        self.times: list[float] = []
        self.rows: list[NDArray[np.float64]] = []
        self._width = width
        self._ends: list[int] = []  # places of rows to which no line is drawn from the one before

    def add(self, time_s: float, row: NDArray[np.float64]) -> None:
        self.times.append(time_s)
        self.rows.append(row)
        if len(self.rows) >= 2 * _MOST_ROWS:
            self.rows = [np.where(np.abs(a) >= np.abs(b), a, b) for a, b in zip(*[iter(self.rows)] * 2, strict=True)]
            self.times = self.times[::2]
            self._ends = [(place + 1) // 2 for place in self._ends]

    def end(self) -> None:
        """End the lines: the next row does not go on from the last one."""
        self._ends.append(len(self.rows))

    def series(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times and rows, shapes (n,) and (n, width), with a row of NaN where a line ends."""
        times, rows = np.array(self.times), np.array(self.rows).reshape(-1, self._width)
        ends = [place for place in self._ends if place < len(times)]
        return np.insert(times, ends, np.nan), np.insert(rows, ends, np.nan, axis=0)


def to_png(path: Path, out: Path, *, exaggerate: float | None = None) -> tuple[FileStatus, dict[str, int]]:
    """Draw a recording into a PNG; return how the recording ended, and what of it is lost.

    No line goes over entries that are not there, nor over a reset.

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
    force, load, clearance, shown = _collected(reader)
    if not (force.rows or load.rows or clearance.rows):
        raise RecordingError(f"{reader.path}: got no row to draw ({reader.status.value}), expected some")
    figure = Figure(figsize=(15, 8.5), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    factor = exaggerate or section.exaggeration()
    upper, lower = figure.add_subplot(grid[:2, 0]), figure.add_subplot(grid[2, 0])
    if shown is None:
        for place, what in ((upper, "pose"), (lower, "penetrations")):
            _say_nothing(place, f"no {what} in the recording")
            place.set(xticks=[])
    else:
        _draw_section(upper, section, shown)
        _draw_wide(lower, section, shown.penetration, factor)
    axis = figure.add_subplot(grid[0, 1:])
    _curves(
        axis, force, PAIR_NAMES, "largest force [kN]", [tuple(part / 255 for part in color) for color in PAIR_COLORS]
    )
    _curves(
        figure.add_subplot(grid[1, 1:], sharex=axis), load, ("Fx [kN]", "Fy [kN]", "M [kN m]"), "load [kN, kN m]", None
    )
    below = figure.add_subplot(grid[2, 1:], sharex=axis)
    _bands(below, clearance, (scene.clearance.horizontal_m, scene.clearance.vertical_m))
    below.set_xlabel("time since the first stamp [s]")
    lost = {**reader.lost, **reader.lost_parts}
    told = [f"{name.replace('_', ' ')}: {count}" for name, count in lost.items()]
    if reader.status is not FileStatus.COMPLETE or not told:
        told.insert(0, reader.status.value)
    figure.suptitle(f"{reader.path.name}: {', '.join(told)}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(out) as stream:
            FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    except OSError as error:
        raise RecordingError(f"{out}: cannot be written: {error.strerror}") from error
    return reader.status, lost


def _collected(reader: RunReader) -> tuple[_Largest, _Largest, _Largest, _Instant | None]:
    """Return forces [kN], load [kN, kN m] and clearances [mm] over time, and the instant of the largest force."""
    force, load, clearance = drawn = _Largest(8), _Largest(3), _Largest(6)
    names = {reader.header.topic(name): name for name in ("contact_forces", "contact_peaks", "head_state", "clearance")}
    first_ns: int | None = None
    shown: _Instant | None = None
    held, gaps = np.zeros(8), np.zeros(8)
    reached: int | None = None  # number of the newest entry
    for record in reader:
        if isinstance(record, EntryRecord):
            ahead = 1 if reached is None else (record.sequence - reached + _HALF) % (2 * _HALF) - _HALF
            if ahead > 1 or isinstance(record.entry, Reset):
                for rows in drawn:
                    rows.end()
            reached = record.sequence if ahead > 0 else reached
            if isinstance(record.entry, Sample):
                first_ns = record.entry.stamp_ns if first_ns is None else first_ns
                load.add((record.entry.stamp_ns - first_ns) * 1e-9, np.array(record.entry.wrench) / 1e3)
            continue
        name = names.get(record.topic)
        message = record.message() if name is not None else None
        if isinstance(message, Odometry):
            turn = message.orientation
            now = (message.position[0], message.position[1], 2.0 * math.atan2(turn[2], turn[3]))
            if shown is None or held.max() > shown.force.max():
                shown = _Instant(now, held, gaps)
        elif isinstance(message, JointState):
            first_ns = message.stamp_ns if first_ns is None else first_ns
            time_s = (message.stamp_ns - first_ns) * 1e-9
            if name == "contact_forces":
                held, gaps = message.effort, message.position
            elif name == "contact_peaks":
                force.add(time_s, message.effort / 1e3)
            else:
                clearance.add(time_s, _clearance_row(message))
    return force, load, clearance, shown


def _clearance_row(message: JointState) -> NDArray[np.float64]:
    wanted = [f"{way}{point}" for way in ("horizontal", "vertical") for point in ("", "/p05", "/p95")]
    return np.array([1e3 * message.position[message.name.index(name)] for name in wanted])


class _Instant(NamedTuple):
    """Pose x, y [m], theta [rad] of the head at a stamp, forces [N] and penetrations [m] of the pairs."""

    pose: tuple[float, float, float]
    force: NDArray[np.float64]
    penetration: NDArray[np.float64]


def _say_nothing(axis: Any, text: str) -> None:
    """Say in the place of a drawing that there is nothing to draw."""
    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes)
    axis.set(yticks=[])


def _draw_section(axis: Any, section: Section, instant: _Instant) -> None:
    pose, force, largest = instant.pose, instant.force, float(instant.force.max())
    axis.plot(*section.frame_strip().T, color="0.5", label=section.frame_name)
    for number, strip in enumerate(section.head_strips(pose)):
        axis.plot(*strip.T, color="k", lw=1.0, label="" if number else "head")
    if largest > 0.0:
        origins, vectors, pairs = section.arrows(pose[2], force)
        for origin, vector, pair in zip(origins, vectors, pairs, strict=True):
            color = tuple(part / 255 for part in PAIR_COLORS[pair])
            axis.annotate("", origin + vector, origin, arrowprops={"arrowstyle": "->", "color": color, "lw": 2})
            text = f"{force[pair] / 1e3:.0f} kN"
            axis.annotate(text, origin + 1.25 * vector, color=color, ha="center", va="center", fontsize=8)
    axis.set(aspect="equal", title=f"Cross-section [mm], largest force at a stamp: {largest / 1e3:.1f} kN")
    axis.margins(0.1)
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.06), ncols=2, fontsize=7)
    _y_upwards(axis)


def _y_upwards(axis: Any) -> None:
    """Let y count upwards: the section has it downwards, as viewers have."""
    axis.invert_yaxis()
    axis.yaxis.set_major_formatter(lambda y, _: f"{0.0 - y:g}")


def _draw_wide(axis: Any, section: Section, penetration: NDArray[np.float64], factor: float) -> None:
    axis.plot(*section.frame_strip().T, color="0.5")
    walls, touching = section.exaggerated(penetration, factor)
    for wall, touches in zip(walls, touching, strict=True):
        axis.plot(*wall.T, color="tab:orange" if touches else "k")
    axis.set(
        aspect="equal", title=f"clearance {factor:g} times as wide, walls that touch in orange", xticks=[], yticks=[]
    )
    axis.invert_yaxis()


def _curves(axis: Any, rows: _Largest, names: Sequence[str], label: str, colors: Sequence[Any] | None) -> None:
    times, values = rows.series()
    for index, name in enumerate(names):
        if len(values):
            axis.plot(times, values[:, index], lw=0.7, label=name, color=colors[index] if colors else None)
    axis.set_ylabel(label)
    if len(values):
        _legend_beside(axis)
    else:
        _say_nothing(axis, "not in the recording")


def _bands(axis: Any, rows: _Largest, new_m: Sequence[float]) -> None:
    """Draw the growth of both clearances with its interval: beside millimetres of clearance it would not be seen."""
    times, values = rows.series()
    for index, name in enumerate(("horizontal", "vertical")):
        if len(values):
            value, low, high = 1e3 * (values[:, 3 * index : 3 * index + 3].T - 1e3 * new_m[index])
            line = axis.plot(times, value, label=f"{name},\n{values[-1, 3 * index]:.3f} mm at the end")[0]
            axis.fill_between(times, low, high, alpha=0.25, color=line.get_color())
    axis.set_ylabel("growth of the clearance,\n5..95 % [um]")
    if len(values):
        _legend_beside(axis)
    else:
        _say_nothing(axis, "not in the recording")


def _legend_beside(axis: Any) -> None:
    """Name the curves beside the axis, where no curve is."""
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
