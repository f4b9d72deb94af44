"""Published values of the paper, each with its place in the text. In scenes, their mark is `given`.

The curves are known only from the text of the paper. The criteria of agreement at the end of this module are not from
the paper.

References
----------
Mao, Zhang et al. (2015), Dynamic characteristics of plough head under contact-impact with clearances, J. Vibration and
Shock 34(19).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

Sense = Literal["ccw", "cw"]
SENSE_NAMES: Final[dict[Sense, str]] = {"ccw": "counter-clockwise", "cw": "clockwise"}
CORNERS: Final = ("a", "b", "c", "d")
FACES: Final = ("top", "right", "bottom", "left")

#: Clearances of Figs 6 to 9 (section 3): horizontal and vertical [m].
CASE_M: Final = (0.025, 0.030)
#: Clearance that is fixed in each of Figs 10 and 11 (section 4) [m].
FIXED_M: Final = 0.020
#: Values of the clearance that varies in Figs 10 and 11 [m].
GRID_M: Final = (0.020, 0.0225, 0.025, 0.0275, 0.030)
#: Values of the clearance that varies in Figs 14 and 15 (section 5) [m].
FACE_GRID_M: Final = (0.020, 0.025, 0.030)
#: Length of the simulations of Figs 14 and 15 [s].
FACE_T_END_S: Final = 20.0
OMEGA_RAD_S: Final = 2.0
PERIOD_S: Final = 2.0 * math.pi / OMEGA_RAD_S


@dataclass(frozen=True)
class Force:
    """A published force: the largest of its kind at the four points, and the point where it occurs."""

    sense: Sense
    statistic: Literal["max", "mean_in_contact"]
    corner: str
    value_n: float


FORCES: Final = (
    Force("ccw", "mean_in_contact", "a", 74e3),
    Force("cw", "mean_in_contact", "b", 82e3),
    Force("ccw", "max", "a", 153e3),
    Force("cw", "max", "b", 177e3),
)
FORCES_SOURCE: Final = "section 3, Fig. 7"


@dataclass(frozen=True)
class Moment:
    """A contact set that the paper quotes at a time [s]."""

    time_s: float
    sense: Sense
    corners: str
    figure: str


MOMENTS: Final = (
    Moment(53.8, "ccw", "b", "Fig. 8"),
    Moment(53.03, "ccw", "ad", "Fig. 8"),
    Moment(52.95, "ccw", "abd", "Fig. 8"),
    Moment(56.55, "cw", "a", "Fig. 9"),
    Moment(56.8, "cw", "bc", "Fig. 9"),
    Moment(57.85, "cw", "abc", "Fig. 9"),
)


@dataclass(frozen=True)
class FaceMark:
    """A mark in Fig. 13 (section 5): the number of inner faces that touch at the same time in a direction of swing."""

    number: int
    sense: Sense
    faces: int


FACE_MARKS: Final = (FaceMark(1, "ccw", 1), FaceMark(2, "cw", 2), FaceMark(3, "cw", 3))

#: Largest relative difference between a computed and a published force that agree.
FORCE_TOLERANCE: Final = 0.05
#: Shortest uninterrupted duration of a contact set [s] for which the set counts as observed.
SHORTEST_HOLD_S: Final = 5e-3
#: Smallest step against a trend that counts, as a share of the curve's largest value. Smaller steps are not visible in
#: a printed curve.
TREND_SLACK: Final = 0.005
#: Largest share of the contact time of a set that is rare.
RARE_SHARE: Final = 0.10
