"""Contradictions and omissions of the paper, each with the evidence of this run."""

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
    """A contradiction with its place in the paper and the number that decides about it."""

    source: str
    statement: str
    evidence: str


def contradictions(runs: PaperRuns) -> list[Contradiction]:
    """Return the contradictions, with numbers from the published values and from the runs."""
    return [_phase(), _zero_load(runs), _doubled(runs), _labels(runs), *_WORDS, _check_length(), *_GAPS]


def _phase() -> Contradiction:
    load = {moment.time_s: math.sin(OMEGA_RAD_S * moment.time_s) for moment in MOMENTS}
    odd = [m for m in MOMENTS if m.sense == "ccw" and load[m.time_s] > 0.0]
    listed = ", ".join(f"{m.time_s:g} s {m.sense} {load[m.time_s]:+.2f}" for m in MOMENTS)
    times = ", ".join(f"{moment.time_s:g} s" for moment in odd)
    return Contradiction(
        "section 3, Figs 8 and 9",
        "All loads are in phase as sin(2t), yet the quoted times do not split by the sign of the load: the "
        f"counter-clockwise contact at {times} falls into the half period of clockwise contacts.",
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
        f"A {SENSE_NAMES[moment.sense]} contact {braces(moment.corners)} is quoted at {moment.time_s:g} s, where the "
        "load has just passed through zero: the head has had no time to cross the gap.",
        f"sin(2t) = {math.sin(OMEGA_RAD_S * moment.time_s):+.3f}; this run at that phase: "
        + ", ".join(f"{name} {corners}" for name, corners in here.items()),
    )


def _doubled(runs: PaperRuns) -> Contradiction:
    pair = int(runs.case.penetration.max(axis=0).argmax())
    depth = float(runs.case.penetration[:, pair].max())
    # for a point `depth` outside a strip, the distances to its two sides exceed its width by `excess`
    width = runs.scene.frame.height_m + runs.scene.clearance.vertical_m
    excess = abs(-depth) + abs(width + depth) - width
    return Contradiction(
        "section 1, eqs (2) to (4)",
        "The test of contact, s > l_BC with s the sum of the distances to two opposite sides, is right, but s - l_BC "
        "is twice the penetration: whoever puts it into the spring law has 2^n times the stiffness. A "
        "fitted stiffness cannot tell the two apart.",
        f"deepest penetration of this run {1e3 * depth:.2f} mm, s - l_BC there {1e3 * excess:.2f} mm",
    )


def _labels(runs: PaperRuns) -> Contradiction:
    frame = runs.scene.frame
    sides = {name: _side(runs, *name) for name in ("ab", "ad")}
    return Contradiction(
        'section 1 (l_ab = 0.27 m) and section 3 ("the upper points a and b")',
        "If a and b are the upper points, side ab is horizontal and the frame is 0.27 m wide and 0.33 m high; the "
        'words can also be read as "on the frame, points a and b". Fig. 1, which would decide, is not in the text.',
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
        "The three-point contact {a,b,c} at 57.85 s is in the paragraph on clockwise contacts but is called "
        "counter-clockwise there; this study takes it as clockwise.",
        "a, b, c counter-clockwise would be the fourth counter-clockwise set beside {b}, {a,d}, {a,b,d}",
    ),
    Contradiction(
        "section 5, captions of Figs 14 and 15",
        "The Chinese captions say vertical clearance for Fig. 14 and horizontal for Fig. 15, the English "
        "captions the reverse; this study follows the Chinese captions.",
        "the order of Figs 10 and 11 speaks for the Chinese captions",
    ),
)


def _check_length() -> Contradiction:
    first = min(moment.time_s for moment in MOMENTS)
    return Contradiction(
        "section 5, Fig. 13",
        f"The check with RecurDyn runs for {FACE_T_END_S:g} s, the quoted contacts lie after {first:g} s: they cannot "
        "be compared in time. It shows one face counter-clockwise, two and three clockwise, and no force in numbers.",
        "the claim that it confirms the model rests on three contact states and two trends",
    )


_GAPS: Final = (
    Contradiction(
        "sections 2 and 3",
        "Stiffness, damping and exponent of the contact law are printed nowhere, nor the signs of loads and arms, the "
        "initial state, the step, or the time over which a force is averaged; equations (5) and (6) are lost in "
        "the text.",
        "in the preset paper every number in place of a missing number is marked reconstructed or assumed",
    ),
    Contradiction(
        "section 3",
        "l_y and l_yN are two symbols with one value, 0.615 m.",
        "if each symbol is meant for one sense of the swing, nothing changes",
    ),
    Contradiction(
        "sections 3 and 4",
        "The case of Figs 6 to 9 (25 mm horizontal, 30 mm vertical) lies on neither curve of Figs 10 and 11 (20 mm "
        "kept fixed): the published forces cannot be checked against the published curves.",
        "no number can be read from Figs 10, 11, 14, 15; the text gives only their shape",
    ),
)
