"""Contradictions and omissions of the paper, each with evidence from this run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from plow_twin_paper import sets as paper_sets
from plow_twin_paper.rows import braces
from plow_twin_paper.rows_sets import shown_time
from plow_twin_paper.runs import PaperRuns
from plow_twin_paper.values import FACE_T_END_S, MOMENTS, OMEGA_RAD_S, SENSE_NAMES


@dataclass(frozen=True)
class Contradiction:
    """A contradiction, its place in the paper, and the number that resolves it."""

    source: str
    statement: str
    evidence: str


def contradictions(runs: PaperRuns) -> list[Contradiction]:
    """Return all contradictions, with numbers from the published values and from the runs."""
    return [_phase(), _zero_load(runs), _doubled(runs), _labels(runs), *_WORDS, _check_length(), *_GAPS]


def _phase() -> Contradiction:
    load = {moment.time_s: math.sin(OMEGA_RAD_S * moment.time_s) for moment in MOMENTS}
    odd = [m for m in MOMENTS if m.sense == "ccw" and load[m.time_s] > 0.0]
    listed = ", ".join(f"{m.time_s:g} s {m.sense} {load[m.time_s]:+.2f}" for m in MOMENTS)
    times = ", ".join(f"{moment.time_s:g} s" for moment in odd)
    return Contradiction(
        "section 3, Figs 8 and 9",
        "All loads are proportional to sin(2t), so the sign of the load should determine the direction of the swing. "
        f"The counter-clockwise contact at {times}, however, is in the half period of clockwise contacts.",
        f"sin(2t): {listed}",
    )


def _zero_load(runs: PaperRuns) -> Contradiction:
    moment = min(MOMENTS, key=lambda moment: abs(math.sin(OMEGA_RAD_S * moment.time_s)))
    time = shown_time(moment.time_s, runs.t_end)
    here = {
        name: braces(paper_sets.at(paper_sets.holds(runs.scene, runs.case, sense), time))
        for sense, name in SENSE_NAMES.items()
    }
    return Contradiction(
        f"section 3, {moment.figure}",
        f"A {SENSE_NAMES[moment.sense]} contact {braces(moment.corners)} is quoted at {moment.time_s:g} s. At this "
        "time, the load has just passed through zero, so the head has had no time to cross the gap.",
        f"sin(2t) = {math.sin(OMEGA_RAD_S * moment.time_s):+.3f}; this run at that phase: "
        + ", ".join(f"{name} {corners}" for name, corners in here.items()),
    )


def _doubled(runs: PaperRuns) -> Contradiction:
    pair = int(runs.case.penetration.max(axis=0).argmax())
    depth = float(runs.case.penetration[:, pair].max())
    # for a point that lies outside a strip by `depth`, the sum of its distances to both sides exceeds the width by
    # `excess`
    width = runs.scene.frame.height_m + runs.scene.clearance.vertical_m
    excess = abs(-depth) + abs(width + depth) - width
    return Contradiction(
        "section 1, eqs (2) to (4)",
        "Let s be the sum of the distances of a corner to two opposite sides. The condition of contact, s > l_BC, is "
        "correct, but s - l_BC is twice the penetration. If s - l_BC is inserted in the spring law, the force is 2^n "
        "times as large. A fitted stiffness does not show which of the two was used.",
        f"largest penetration of this run {1e3 * depth:.2f} mm; s - l_BC at this time {1e3 * excess:.2f} mm",
    )


def _labels(runs: PaperRuns) -> Contradiction:
    frame = runs.scene.frame
    sides = {name: _side(runs, *name) for name in ("ab", "ad")}
    return Contradiction(
        'section 1 (l_ab = 0.27 m) and section 3 ("the upper points a and b")',
        "If a and b are the upper points, side ab is horizontal, and the frame is 0.27 m wide and 0.33 m high. The "
        'words can also mean "points a and b on the frame". Fig. 1, which would show the labels, is not in the text.',
        f"this scene: a {frame.labels['a']}, b {frame.labels['b']}; ab {sides['ab']:g} m, ad {sides['ad']:g} m long, "
        f"frame {frame.width_m:g} m wide, {frame.height_m:g} m high",
    )


def _side(runs: PaperRuns, first: str, second: str) -> float:
    frame = runs.scene.frame
    places = [
        np.array([frame.width_m * ("right" in corner), frame.height_m * ("top" in corner)])
        for corner in (frame.labels[first], frame.labels[second])
    ]
    return float(np.linalg.norm(places[0] - places[1]))


_WORDS: Final = (
    Contradiction(
        "section 3, Fig. 9",
        "The three-point contact {a,b,c} at 57.85 s is in the paragraph on clockwise contacts, but the "
        "paragraph calls it counter-clockwise. This study assumes that it is clockwise.",
        "a counter-clockwise {a,b,c} would be a fourth counter-clockwise set in addition to {b}, {a,d}, {a,b,d}",
    ),
    Contradiction(
        "section 5, captions of Figs 14 and 15",
        "By the Chinese captions, the vertical clearance varies in Fig. 14 and the horizontal clearance in Fig. 15. "
        "The English captions state the reverse. This study follows the Chinese captions.",
        "Figs 10 and 11 have the order of the Chinese captions",
    ),
)


def _check_length() -> Contradiction:
    first = min(moment.time_s for moment in MOMENTS)
    return Contradiction(
        "section 5, Fig. 13",
        f"The check with RecurDyn ends at {FACE_T_END_S:g} s, and the quoted contacts occur after {first:g} s, so "
        "their times cannot be compared. The check shows contacts of one face (counter-clockwise) and of two and "
        "three faces (clockwise), but no numbers of forces.",
        "three contact states and two trends are the only evidence that the check confirms the model",
    )


_GAPS: Final = (
    Contradiction(
        "sections 2 and 3",
        "The paper does not state the stiffness, damping and exponent of the contact law, or the signs of loads "
        "and arms. The initial state, the step, and the time over which a force is averaged are missing too. The text "
        "lacks equations (5) and (6).",
        "in the preset paper, each number that replaces a missing number is marked as reconstructed or assumed",
    ),
    Contradiction(
        "section 3",
        "l_y and l_yN are two symbols with one value, 0.615 m.",
        "the results do not change if each symbol is for one direction of swing",
    ),
    Contradiction(
        "sections 3 and 4",
        "The clearances of Figs 6 to 9 (25 mm horizontal, 30 mm vertical) are not on the curves of Figs 10 and 11, for "
        "which one clearance is 20 mm. The published forces therefore cannot be compared with the published curves.",
        "the text describes only the shape of Figs 10, 11, 14 and 15, and no number can be read from them",
    ),
)
