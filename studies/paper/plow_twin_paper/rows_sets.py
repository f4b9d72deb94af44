"""Rows of Figs 8 and 9, which show which points carry force at the same time, how often, and when."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from plow_twin.model.scene import Scene
from plow_twin.run.simulate import Result
from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows import CHECK, FITTED, Row, Verdict, braces
from plow_twin_paper.sets import Hold
from plow_twin_paper.values import (
    MOMENTS,
    OMEGA_RAD_S,
    PERIOD_S,
    RARE_SHARE,
    SENSE_NAMES,
    SHORTEST_HOLD_S,
    Moment,
    Sense,
)

_SETS: Final = "Contact sets (Figs 8 and 9)"
_TIMES: Final = "Contact sets at the quoted times (Figs 8 and 9)"
_FIGURES: Final[dict[Sense, str]] = {"ccw": "section 3, Fig. 8", "cw": "section 3, Fig. 9"}


def rows(scene: Scene, result: Result) -> list[Row]:
    """Return the rows of Figs 8 and 9 for one run."""
    timelines = {sense: paper_sets.holds(scene, result, sense) for sense in SENSE_NAMES}
    found = [row for moment in MOMENTS for row in _occurs(moment, timelines[moment.sense])]
    for sense, timeline in timelines.items():
        found += _sizes(sense, timeline)
    return [*found, *(_quoted(moment, timelines[moment.sense]) for moment in MOMENTS)]


def _occurs(moment: Moment, timeline: Sequence[Hold]) -> Iterator[Row]:
    figures = paper_sets.figures(timeline).get(moment.corners)
    text = "never"
    if figures:
        longest, total = 1e3 * figures.longest_s, 1e3 * figures.total_s
        text = f"longest hold {longest:.2f} ms, {total:.1f} ms in all ({figures.share:.2%})"
    yield Row(
        _SETS, _FIGURES[moment.sense], f"{SENSE_NAMES[moment.sense]}: {braces(moment.corners)} occurs", "occurs", text,
        Verdict.of(figures is not None and figures.count > 0),
        f"held for {1e3 * SHORTEST_HOLD_S:g} ms or more without a break", FITTED,
    )  # fmt: skip


def _sizes(sense: Sense, timeline: Sequence[Hold]) -> Iterator[Row]:
    shares = paper_sets.share_by_size(timeline)
    text = ", ".join(f"{size}: {share:.1%}" for size, share in enumerate(shares, start=1))
    name = SENSE_NAMES[sense]
    remark = "" if sense == "ccw" else " (said of counter-clockwise alone, taken for both)"
    yield Row(
        _SETS, _FIGURES["ccw"], f"{name}: two-point contact is the most frequent{remark}", "two points most often",
        f"share of the contact time by number of points {text}", Verdict.of(max(shares) == shares[1] > 0.0),
        "largest share of the contact time", FITTED,
    )  # fmt: skip
    yield Row(
        _SETS, f"{_FIGURES[sense]}; section 6 (1)", f"{name}: one, two and three points; four are not mentioned",
        "no four-point contact", f"four points for {shares[3]:.1%} of the contact time",
        Verdict.of(shares[3] <= RARE_SHARE), f"at most {RARE_SHARE:.0%} of the contact time", FITTED, "%", None,
        100.0 * shares[3],
    )  # fmt: skip


def shown_time(time_s: float, t_end: float) -> float:
    """Return the quoted time. If the run is shorter, return the last time of the run at the same phase of the load."""
    return time_s - PERIOD_S * max(0, math.ceil((time_s - t_end) / PERIOD_S))


def _quoted(moment: Moment, timeline: Sequence[Hold]) -> Row:
    time = shown_time(moment.time_s, timeline[-1].end_s)
    phase = time % PERIOD_S
    cycles = phase + PERIOD_S * np.arange(round((time - phase) / PERIOD_S) + 1)
    same = sum(paper_sets.at(timeline, float(cycle)) == moment.corners for cycle in cycles)
    near = paper_sets.nearest(timeline, time, moment.corners)
    load = math.sin(OMEGA_RAD_S * moment.time_s)
    at_time = "" if time == moment.time_s else f" at {time:.2f} s, the same phase"
    title = f"{SENSE_NAMES[moment.sense]} contact at {moment.time_s:g} s (load at sin = {load:+.2f})"
    return Row(
        _TIMES, f"section 3, {moment.figure}", title, braces(moment.corners),
        f"{braces(paper_sets.at(timeline, time))}{at_time}; the quoted set at this phase in {same} of {len(cycles)} "
        f"periods; {_near(near, moment)}", Verdict.of(paper_sets.at(timeline, time) == moment.corners),
        "the same set at that time, or at that phase in a shorter run", CHECK,
    )  # fmt: skip


def _near(near: tuple[float, Hold] | None, moment: Moment) -> str:
    if near is None:
        return f"{braces(moment.corners)} never occurs"
    distance, hold = near
    side = "earlier" if distance < 0.0 else "later"
    return f"nearest {braces(moment.corners)} {abs(distance):.2f} s {side}, for {1e3 * hold.duration_s:.2g} ms"
