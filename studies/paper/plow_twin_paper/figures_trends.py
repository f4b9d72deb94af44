"""Figures of trends: clearance (Figs 10 and 11), inner faces (Figs 13 to 15), and the models of the head's rotation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin_paper.rotation import Rotation
from plow_twin_paper.rows_motion import force_table
from plow_twin_paper.rows_trends import longest_faces
from plow_twin_paper.runs import FaceRun, PaperRuns, Sweep
from plow_twin_paper.style import CORNER_STYLE, DARK, FACE_STYLE, sheet
from plow_twin_paper.values import CORNERS, FACE_MARKS, FACES, FIXED_M, GRID_M, PERIOD_S, SENSE_NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Name, colour and line style of the three models of the head's rotation.
_FORMS: Final = (
    ("constant moment (paper)", "#333333", "-"),
    ("exact, I about the centre of mass", "#D55E00", "--"),
    ("exact, I about the cavity's centre", "#0072B2", ":"),
)
_FIRST_S: Final = 4.0


def trend(sweep: Sweep, along: str, fixed: str) -> Figure:
    """Draw the largest force of each point as a function of a clearance (Figs 10 and 11)."""
    with sheet(8.0, 4.6) as figure:
        panel = figure.subplots()
        for column, corner in enumerate(CORNERS):
            color, marker = CORNER_STYLE[corner]
            panel.plot(1e3 * sweep.clearance_m, 1e-3 * sweep.largest_n[:, column], color=color, linewidth=1.0)
            grid = 1e-3 * sweep.on_grid()[:, column]
            panel.plot(
                1e3 * np.array(GRID_M), grid, color=color, marker=marker, linestyle="none", label=f"point {corner}"
            )
        panel.set_xlabel(f"{along} clearance [mm], {fixed} {1e3 * FIXED_M:g} mm")
        panel.set_ylabel("largest force, both senses [kN]")
        panel.set_title("line: every 0.25 mm; marks: where the trend is judged")
        figure.legend(loc="outside right upper")
        return figure


def fig13(runs: PaperRuns) -> Figure:
    """Draw the force on each inner face over two periods, with the contact states that the paper marks."""
    run, end = runs.faces, float(runs.faces.t[-1])
    since = max(end - 2.0 * PERIOD_S, 0.0)
    rows = run.t >= since
    with sheet(10.5, 6.6) as figure:
        panels = figure.subplots(4, 1, sharex=True, sharey=True)
        for column, face in enumerate(FACES):
            panels[column].plot(run.t[rows], 1e-3 * run.face_n[rows, column], color=FACE_STYLE[face][0])
            panels[column].set_ylabel(f"{face} [kN]")
        for level, mark in enumerate(FACE_MARKS):
            faces = longest_faces(runs, mark, since)
            if faces is not None:
                _mark(panels, faces, f"{mark.number}: {mark.sense}, {mark.faces} face{'s'[: mark.faces - 1]}", level)
        panels[3].set_xlabel("time [s]")
        panels[3].set_xlim(since, end)
        panels[3].set_ylim(bottom=0.0)
        figure.suptitle(
            "yellow: the longest of each contact state that the paper marks, in these two periods", fontsize=10
        )
        return figure


def _mark(panels: Any, found: tuple[float, float], text: str, level: int) -> None:
    """Shade the span `found` (start and length [s]) in all panels, and write its name above the first panel."""
    for panel in panels:
        panel.axvspan(found[0], found[0] + found[1], color="#F0E442", alpha=0.85, linewidth=0.0)
    panels[0].annotate(
        text, (found[0] + 0.5 * found[1], 1.0), xycoords=("data", "axes fraction"), xytext=(0, 6 + 13 * level),
        textcoords="offset points", ha="center", fontsize=8.5, arrowprops={"arrowstyle": "-", "linewidth": 0.6},
    )  # fmt: skip


def faces(runs: tuple[FaceRun, ...], along: str) -> Figure:
    """Draw the forces on the inner faces at three clearances (Figs 14 and 15)."""
    with sheet(11.0, 4.8) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
        for column, face in enumerate(FACES):
            color, marker = FACE_STYLE[face]
            largest = [1e-3 * float(run.face_n[:, column].max()) for run in runs]
            left.plot(
                [1e3 * run.clearance_m for run in runs], largest, color=color, marker=marker, label=f"{face} face"
            )
        left.set_xticks([1e3 * run.clearance_m for run in runs])
        left.set_xlabel(f"{along} clearance [mm]")
        left.set_ylabel("largest force on the face [kN]")
        left.set_ylim(bottom=0.0)
        left.legend(loc="lower left", ncols=2)
        first = max(float(runs[0].t[-1]) - PERIOD_S, 0.0)
        for run, color, line in zip(runs, ("#56B4E9", "#E69F00", "#000000"), ("-", "--", ":"), strict=True):
            rows = run.t >= first
            name = f"{1e3 * run.clearance_m:g} mm"
            right.plot(
                run.t[rows], 1e-3 * run.face_n[rows, FACES.index("top")], color=color, linestyle=line, label=name
            )
        right.set_xlabel("time [s]")
        right.set_ylabel("force on the top face [kN]")
        right.set_title("last period of the load")
        right.margins(x=0.0)
        right.set_ylim(0.0, 1.2 * right.get_ylim()[1])
        right.legend(loc="upper center", ncols=3, title=f"{along} clearance")
        return figure


def rotation_figure(rotation: Rotation) -> Figure:
    """Draw the first seconds and the largest forces for the three models of the head's rotation."""
    with sheet(11.0, 6.6) as figure:
        grid = figure.add_gridspec(3, 2, width_ratios=(1.5, 1))
        labels = ("x [mm]", "y [mm]", "theta [mrad]")
        panels = [figure.add_subplot(grid[row, 0]) for row in range(3)]
        for (name, color, line), result in zip(_FORMS, rotation.results, strict=True):
            rows = result.t <= _FIRST_S
            for column, panel in enumerate(panels):
                panel.plot(result.t[rows], 1e3 * result.q[rows, column], color=color, linestyle=line, label=name)
        for label, panel in zip(labels, panels, strict=True):
            panel.set_ylabel(label)
            panel.margins(x=0.0)
        panels[2].set_xlabel("time [s]")
        panels[0].set_title("first seconds")
        for row, name in enumerate(SENSE_NAMES.values()):
            _bars(figure.add_subplot(grid[row, 1]), rotation, row, name)
        handles, names = panels[0].get_legend_handles_labels()
        blank = figure.add_subplot(grid[2, 1])
        blank.axis("off")
        blank.legend(handles, names, loc="center left", fontsize=9.5)
        return figure


def _bars(panel: Any, rotation: Rotation, row: int, name: str) -> None:
    sense = tuple(SENSE_NAMES)[row]
    for index, (_, color, _) in enumerate(_FORMS):
        table = force_table(rotation.scenes[index], rotation.results[index])
        heights = [1e-3 * table[sense, corner]["max"] for corner in CORNERS]
        bars = panel.bar(np.arange(4) + 0.27 * (index - 1), heights, 0.25, color=color)
        panel.bar_label(bars, [f"{height:.0f}" for height in heights], fontsize=7.5, color=DARK)
    panel.set_xticks(range(4), CORNERS)
    panel.set_title(f"{name}: largest force [kN]")
    panel.grid(axis="x", visible=False)
    panel.margins(y=0.15)
