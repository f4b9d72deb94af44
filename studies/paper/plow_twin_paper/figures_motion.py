"""Figures of section 3 of the paper: motion (Fig. 6), forces (Fig. 7) and close-ups (Figs 8 and 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows import braces
from plow_twin_paper.rows_motion import force_table
from plow_twin_paper.rows_sets import shown_time
from plow_twin_paper.runs import PaperRuns
from plow_twin_paper.style import CORNER_STYLE, DARK, LIGHT, SENSE_COLOR, sheet
from plow_twin_paper.values import CORNERS, FORCES, MOMENTS, PERIOD_S, SENSE_NAMES, Sense

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POSE: Final = (("x [mm]", 1e3, "#0072B2"), ("y [mm]", 1e3, "#D55E00"), ("theta [mrad]", 1e3, "#009E73"))


def fig06(runs: PaperRuns) -> Figure:
    """Draw x, y and theta over the whole run, and over its last two load periods."""
    t, q = runs.case.t, runs.case.q
    with sheet(10.5, 6.0) as figure:
        panels = figure.subplots(3, 2, sharex="col", width_ratios=(1.5, 1))
        close = t >= runs.t_end - 2.0 * PERIOD_S
        for row, (label, factor, color) in enumerate(_POSE):
            panels[row, 0].plot(t, factor * q[:, row], color=color, linewidth=0.8)
            panels[row, 1].plot(t[close], factor * q[close, row], color=color)
            panels[row, 0].set_ylabel(label)
        panels[0, 0].set_title("whole run")
        panels[0, 1].set_title("last two periods of the load")
        for panel in panels[2]:
            panel.set_xlabel("time [s]")
            panel.margins(x=0.0)
        return figure


def fig07(runs: PaperRuns) -> Figure:
    """Draw the force at each point for each direction of swing, with the published largest value and mean."""
    letters, t = paper_sets.letters_of_pairs(runs.scene), runs.case.t
    table = force_table(runs.scene, runs.case)
    highest = 1.12e-3 * max([*(row["max"] for row in table.values()), *(force.value_n for force in FORCES)])
    with sheet(11.0, 7.4) as figure:
        panels = figure.subplots(4, 2, sharex=True, sharey=True)
        for column, (sense, name) in enumerate(SENSE_NAMES.items()):
            panels[0, column].set_title(f"{name} contacts")
            panels[3, column].set_xlabel("time [s]")
            for row, corner in enumerate(CORNERS):
                chosen = paper_sets.of_sense(sense)
                (pair,) = (index for index, letter in enumerate(letters) if letter == corner and chosen[index])
                panel = panels[row, column]
                panel.plot(t, 1e-3 * runs.case.force[:, pair], color=SENSE_COLOR[sense], linewidth=0.6)
                _published(panel, sense, corner)
                own = table[sense, corner]
                text = (
                    f"{corner}: largest {own['max'] / 1e3:.1f}, mean in contact {own['mean_in_contact'] / 1e3:.1f} kN"
                )
                panel.text(0.01, 0.97, text, transform=panel.transAxes, va="top", fontsize=8.5, color=DARK, bbox=_BOX)
                panel.set_ylim(0.0, 1.25 * highest)
                panel.margins(x=0.0)
                panels[row, 0].set_ylabel(f"force at {corner} [kN]")
        handles, names = panels[0, 0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, names, loc="outside lower center", ncols=2)
        return figure


_BOX: Final = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}


def _published(panel: Any, sense: Sense, corner: str) -> None:
    styles = {"max": ("--", "largest, published"), "mean_in_contact": (":", "mean, published")}
    for force in FORCES:
        if (force.sense, force.corner) == (sense, corner):
            line, name = styles[force.statistic]
            panel.axhline(force.value_n / 1e3, color="black", linestyle=line, linewidth=1.2, label=name)


def close_up(runs: PaperRuns, sense: Sense) -> Figure:
    """Draw the forces of one direction of swing in a period around the quoted times, and the contacts of each point."""
    times = {moment: shown_time(moment.time_s, runs.t_end) for moment in MOMENTS if moment.sense == sense}
    # a shorter run may end before some quoted times, so all quoted times move back by the same number of periods
    back = max(moment.time_s - time for moment, time in times.items())
    times = {moment: moment.time_s - back for moment in times}
    centre = 0.5 * (min(times.values()) + max(times.values()))
    left = min(centre - 0.5 * PERIOD_S, runs.t_end - PERIOD_S)
    t, letters, chosen = runs.case.t, paper_sets.letters_of_pairs(runs.scene), paper_sets.of_sense(sense)
    rows = (t >= left) & (t <= left + PERIOD_S)
    timeline = paper_sets.holds(runs.scene, runs.case, sense)
    with sheet(10.5, 5.6) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
        for pair in np.flatnonzero(chosen):
            color, _ = CORNER_STYLE[letters[pair]]
            top.plot(t[rows], 1e-3 * runs.case.force[rows, pair], color=color, label=letters[pair])
        _bars(bottom, timeline, left)
        highest = 1e-3 * float(runs.case.force[rows][:, chosen].max())
        top.set_ylim(0.0, 1.45 * max(highest, 1.0))
        for level, (moment, time) in enumerate(sorted(times.items(), key=lambda item: item[1])):
            for panel in (top, bottom):
                panel.axvline(time, color="black", linestyle="--", linewidth=0.9)
            here = braces(paper_sets.at(timeline, time))
            text = f" {moment.time_s:g} s: paper {braces(moment.corners)}, here {here}"
            place = (1.40 - 0.11 * level) * max(highest, 1.0)
            top.text(time, place, text + " ", fontsize=8.5, ha="left" if level else "right", va="center", bbox=_BOX)
        top.set_ylabel("force [kN]")
        top.set_title(f"{SENSE_NAMES[sense]} contacts, one period of the load{_moved(back)}")
        handles, names = top.get_legend_handles_labels()
        order = sorted(range(len(names)), key=lambda index: names[index])
        figure.legend([handles[i] for i in order], [f"point {names[i]}" for i in order], loc="outside right upper")
        bottom.set_xlabel("time [s]")
        bottom.set_ylabel("carries force")
        bottom.set_xlim(left, left + PERIOD_S)
        return figure


def _moved(back: float) -> str:
    return f"; quoted times moved {back / PERIOD_S:.0f} periods back" if back > 0.0 else ""


def _bars(panel: Any, timeline: list[paper_sets.Hold], left: float) -> None:
    for row, corner in enumerate(CORNERS):
        spans = [
            (hold.start_s, hold.duration_s)
            for hold in timeline
            if corner in hold.corners and hold.end_s > left and hold.start_s < left + PERIOD_S
        ]
        panel.broken_barh(spans, (row - 0.35, 0.7), color=CORNER_STYLE[corner][0])
    panel.set_yticks(range(len(CORNERS)), CORNERS)
    panel.set_ylim(len(CORNERS) - 0.4, -0.6)
    panel.grid(axis="y", visible=False)
    panel.spines["left"].set_color(LIGHT)
