"""Rows of Figs 10 and 11 (force as a function of clearance) and of Figs 13 to 15 (check with RecurDyn)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows import ASSUMED, CHECK, FITTED, Row, Verdict
from plow_twin_paper.runs import FaceRun, PaperRuns, Sweep, face_of_pair
from plow_twin_paper.values import (
    CORNERS,
    FACE_GRID_M,
    FACE_MARKS,
    FACES,
    GRID_M,
    SENSE_NAMES,
    SHORTEST_HOLD_S,
    TREND_SLACK,
    FaceMark,
)

Array = NDArray[np.float64]
_VERTICAL: Final = "Vertical clearance (Fig. 10)"
_HORIZONTAL: Final = "Horizontal clearance (Fig. 11)"
_FACES: Final = "Inner faces, the paper's RecurDyn check (Figs 13 to 15)"
_RISES: Final = f"no step down, but an overall rise, of at least {TREND_SLACK:.1%} of the largest value"
_RISES_THEN_FALLS: Final = (
    f"largest value inside the range; no step down before it, no step up after it, of at least {TREND_SLACK:.1%} of it"
)


def rises(values: Array) -> bool:
    """Return whether a curve rises. Decreases below the share `TREND_SLACK` of its largest value are ignored."""
    slack = TREND_SLACK * float(values.max())
    return bool((np.diff(values) > -slack).all() and values[-1] - values[0] > slack)


def rises_then_falls(values: Array) -> bool:
    """Return whether a curve first rises and then falls, with the tolerance of `rises`."""
    slack, top = TREND_SLACK * float(values.max()), int(values.argmax())
    if not 0 < top < len(values) - 1:
        return False
    steps = np.diff(values)
    monotonic = (steps[:top] > -slack).all() and (steps[top:] < slack).all()
    return bool(monotonic and values[top] - max(values[0], values[-1]) > slack)


def rows(runs: PaperRuns) -> list[Row]:
    """Return the rows of Figs 10, 11 and 13 to 15."""
    return [
        *_corners(runs.vertical, _VERTICAL, "section 4, Fig. 10; section 6 (2)", falls=True),
        *_corners(runs.horizontal, _HORIZONTAL, "section 4, Fig. 11; section 6 (2)", falls=False),
        *(_mark(runs, mark) for mark in FACE_MARKS),
        *_faces(runs.faces_vertical, "section 5, Fig. 14", "vertical", falls=True),
        *_faces(runs.faces_horizontal, "section 5, Fig. 15", "horizontal", falls=False),
    ]


def _corners(sweep: Sweep, group: str, source: str, falls: bool) -> Iterator[Row]:
    at = ", ".join(f"{1e3 * value:g}" for value in GRID_M)
    for column, corner in enumerate(CORNERS):
        title = f"point {corner}: largest force against {group.partition(' (')[0].lower()}"
        yield _trend(group, source, title, sweep.on_grid()[:, column], at, falls, FITTED if corner in "ab" else CHECK)
    forces, along = sweep.on_grid(), group.partition(" (")[0].lower()
    first = [CORNERS[int(row.argmax())] if np.isfinite(row).all() else "?" for row in forces]
    yield Row(
        group, "section 4, Figs 10 and 11", f"{along}: the largest of all is at a or b", "a or b",
        f"{', '.join(first)} at {at} mm",
        Verdict.NOT_COMPUTED if "?" in first else Verdict.of(set(first) <= {"a", "b"}),
        "at each of the five clearances", FITTED,
    )  # fmt: skip


def _trend(group: str, source: str, title: str, values: Array, at: str, falls: bool, inputs: str) -> Row:
    computed = np.isfinite(values).all()
    agrees = bool(computed) and (rises_then_falls(values) if falls else rises(values))
    return Row(
        group, source, title, "rises, then falls" if falls else "rises",
        f"{', '.join(f'{value / 1e3:.1f}' for value in values)} kN at {at} mm",
        Verdict.of(agrees) if computed else Verdict.NOT_COMPUTED, _RISES_THEN_FALLS if falls else _RISES, inputs,
    )  # fmt: skip


def longest_faces(runs: PaperRuns, mark: FaceMark, since_s: float = 0.0) -> tuple[float, float] | None:
    """Return start and length [s] of the longest time in which as many faces are in contact as `mark` states, or None.

    The search begins at `since_s` and ends after the 20 s of section 5. For one direction of swing, each corner has one
    pair, and different corners touch different faces. The number of faces in contact is thus the number of points.
    """
    chosen = paper_sets.of_sense(mark.sense)
    faces = [face for pair, face in enumerate(face_of_pair()) if chosen[pair]]
    assert len(set(faces)) == len(faces) == PAIR_COUNT // 2
    end = float(runs.faces.t[-1])
    timeline = paper_sets.holds(runs.scene, runs.case, mark.sense)
    durations = [
        (hold.start_s, min(hold.end_s, end) - hold.start_s)
        for hold in timeline
        if len(hold.corners) == mark.faces and since_s <= hold.start_s < end
    ]
    return max(durations, key=lambda hold: hold[1], default=None)


def _mark(runs: PaperRuns, mark: FaceMark) -> Row:
    faces = longest_faces(runs, mark)
    text = "never" if faces is None else f"longest {1e3 * faces[1]:.1f} ms, at {faces[0]:.2f} s"
    many = "one inner face" if mark.faces == 1 else f"{('two', 'three')[mark.faces - 2]} inner faces"
    return Row(
        _FACES, f"section 5, Fig. 13, mark {mark.number}", f"{SENSE_NAMES[mark.sense]}: {many} in contact", "occurs",
        text, Verdict.of(faces is not None and faces[1] >= SHORTEST_HOLD_S),
        f"held for {1e3 * SHORTEST_HOLD_S:g} ms or more in the first 20 s", CHECK,
    )  # fmt: skip


def _faces(runs: tuple[FaceRun, ...], source: str, name: str, falls: bool) -> Iterator[Row]:
    at = ", ".join(f"{1e3 * value:g}" for value in FACE_GRID_M)
    for column, face in enumerate(FACES):
        values = np.array([run.face_n[:, column].max() for run in runs])
        yield _trend(_FACES, source, f"{name} clearance, {face} face: largest force", values, at, falls, ASSUMED)
