"""The numbers of the estimator that were chosen rather than derived, each with the data that it was set on.

They are read as `tuning.NAME` where they are used, so that `benchmark/tuning_sensitivity.py` can vary them;
`benchmark/results/tuning.md` shows them with the sensitivity that it measured. Seeds: `benchmark/estimate.py`.
Penetrations are those under the reference force of 100 kN.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Value = float | int | tuple[Any, ...] | Array

#: Basis of a number without a recorded experiment.
JUDGED = "judgement"


@dataclass(frozen=True)
class Tuned:
    """The meaning of a chosen number.

    Attributes
    ----------
    unit : str
        Its unit; commas separate the units of several elements.
    meaning : str
        Where it acts.
    basis : str
        The data that it was set on.
    """

    unit: str
    meaning: str
    basis: str = JUDGED


# Conditions for an estimated quantity
OBSERVED: Annotated[
    float,
    Tuned(
        "m",
        "largest deviation of an estimated clearance; twice it for a rough one, half of it for a group "
        "of pads and as least change within the window",
    ),
] = 1e-3
BOUNCED_MOST: Annotated[
    float,
    Tuned(
        "m",
        "largest deviation behind a hard contact that is not rough: a wall touched too seldom gives wrong answers",
        "seeds 40400 to 40409",
    ),
] = 2e-4
OBSERVED_SHARE: Annotated[float, Tuned("prior", "the same around a block")] = 0.5
MOST_INFLATED: Annotated[
    float,
    Tuned(
        "1",
        "growth of the variance from which on an unfinished fit is withdrawn",
        "`cutting_10hz`, seeds 80000, 80001, 81000: fits 9 to 15 mm off had 15 to 25; at 7.5, loads with "
        "errors of 5 % would be withdrawn",
    ),
] = 15.0
SPARSEST: Annotated[
    float, Tuned("s", "longest distance of poses; with fewer in a flight, its start is guessed wrong")
] = 0.125
TOUCHED: Annotated[float, Tuned("s", "least time in contact of the walls of both sides")] = 0.02
PREDICTED: Annotated[float, Tuned("1", "least share of the measured x, or y, that the model predicts")] = 0.08
GIVEN: Annotated[
    float,
    Tuned(
        "1",
        "largest penetration of both walls over that under the reference force",
        "twice two walls; the paper's forces reach twice the reference",
    ),
] = 4.0
RESTS: Annotated[float, Tuned("1", "scatter of the poses over their noise up to which the head rests")] = 1.3
IDLE_LOAD: Annotated[float, Tuned("weights", "scatter of the load below which a head is expected to rest")] = 0.05

# Checks
OUTLYING: Annotated[
    float,
    Tuned(
        "deviations",
        "limit that noise does not reach: kinks of a flight, impacts away from a wall, gaps, poses, steps to "
        "another law; its square for chi^2 of the turns of walls and for the gain left to a fit",
        "one in 1.7 million normal values; chi^2 of the turns was 9 at most for right models (seeds 42000 to "
        "42004); of 780 poses of three followed truths none was further off behind soft contacts, eight behind a "
        "hard one",
    ),
] = 5.0
MOST_RATIO: Annotated[
    float,
    Tuned(
        "1",
        "residuals over their quick changes; their scatter over the load's phase over that within a "
        "phase; noise of a part of the window over that of the rest",
        "1 without a fault",
    ),
] = 2.0
MOST_GAIN: Annotated[float, Tuned("1", "change of the load's or a cell's gain from which on it is suspect")] = 0.25
MOST_SCALE: Annotated[float, Tuned("chi^2", "the sensor's three scales", "right models have 12 at most")] = 16.0
MORE_ASKEW: Annotated[
    float,
    Tuned(
        "1",
        "chi^2 of turned walls, lever arm and low pass over that of the scales, each explaining the other in part",
        "walls worn askew: 5 and more (0.3 to 1 times the wear late in a life); low pass of 20 Hz: 2.2 and 7.3 "
        "(`filter_20`, seeds 99001, 98002); scales of 1.05: 0.4 to 1.6; frame, mass, scale of theta: 0.2 to 0.7",
    ),
] = 2.0
CHANGE_CHI2: Annotated[float, Tuned("chi^2", "gain of a change within the window")] = 200.0
CHANGE_SHARE: Annotated[float, Tuned("1", "least share of the excess residuals that such a change explains")] = 0.25
STUCK: Annotated[
    tuple[float, ...], Tuned("rows, deviations", "rows with one value of a stuck sensor, and the motion meanwhile")
] = (12, 6.0)
PHASES: Annotated[int, Tuned("parts", "parts of a load period in which residuals are compared")] = 24
LAW_DAMPING: Annotated[
    tuple[float, ...],
    Tuned(
        "critical, critical, 1",
        "damping of the other law: in a fit; of drawn hard contacts, median and deviation of the logarithm",
    ),
] = (0.05, 0.2, 0.6)
MOST_DISTANCE: Annotated[float, Tuned("1", "distance of a hard motion from the drawn ones, over theirs")] = 4.0
MOST_PATH: Annotated[float, Tuned("deviations", "distance of its path over the load's period")] = 4.5
MOST_ODDS: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "ln odds of another law: suspect above the first; a motion that looks like the other law is "
        "accepted below the second",
        "right models (seeds from 42200 on) have -7 at most; seed 46205, a right model, has -44 and "
        "looks like the other by 2.43 deviations",
    ),
] = (-3.0, -20.0)

# Screening of measurements
MUCH_WORSE: Annotated[
    float,
    Tuned(
        "1",
        "stated deviation over the prior of the bias, or over the median, from which on a component "
        "counts as not measured",
    ),
] = 10.0
SPIKE: Annotated[
    tuple[float, ...], Tuned("deviations, 1", "distance of a spike from its neighbours; most rows that are spikes")
] = (20.0, 0.1)
REPEATING: Annotated[
    tuple[float, ...], Tuned("1, 1", "least share of repeated rows of a slow sensor; longest repetition over the mean")
] = (0.25, 3.0)
LONGEST_GAP: Annotated[
    tuple[float, ...],
    Tuned("s, 1", "longest silence of the load; in median distances of samples, for a load of few knots"),
] = (0.5, 20.0)

# Fit
HUBER: Annotated[float, Tuned("deviations", "residual from which on a measurement counts less")] = 3.0
JITTER_WEIGHT: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "weight of the variance that cannot be predicted: in a fit, where the Jacobian is noise too; in "
        "comparing fits; with forces",
    ),
] = (100.0, 5.0, 10.0)
START_SPREAD: Annotated[
    Array, Tuned("m, m, rad, m/s, m/s, rad/s", "prior deviation of a starting state about its guess")
] = np.array([4e-3, 4e-3, 0.02, 0.2, 0.2, 1.0])
PROBED_STATE: Annotated[
    Array, Tuned("m, m, rad, m/s, m/s, rad/s", "deviation of the displaced starts that probe predictability")
] = np.array([2e-4, 2e-4, 8e-4, 6e-3, 6e-3, 3e-2])
MOST_FREED: Annotated[float, Tuned("1", "most widening for unknowns fitted to few swings")] = 3.0
MOST_WORK: Annotated[
    tuple[int, ...],
    Tuned(
        "steps",
        "work of a fit, of motions drawn in ten load periods, of those of another law",
        "a few seconds of a core",
    ),
] = (3_000_000, 3_500_000, 1_500_000)
FIRST_PERIODS: Annotated[float, Tuned("periods", "part of the window in which candidates are compared")] = 3.0
FIRST_NOISE: Annotated[Array, Tuned("m, m, rad", "noise of x, y and theta in the first iteration")] = np.array(
    [1e-3, 1e-3, 4e-3]
)
SHORTEST: Annotated[
    tuple[float, ...], Tuned("periods", "shortest swing: hard contact, soft contact, broad-band load")
] = (0.04, 0.35, 0.03)
HARD_HORIZON: Annotated[float, Tuned("periods", "horizon of a swing of a hard contact")] = 0.11
ENOUGH: Annotated[float, Tuned("1", "gain in the cost that ends the fit to the beginnings of swings")] = 30.0
HARD: Annotated[float, Tuned("m", "penetration below which the motion after some bounces cannot be predicted")] = 3e-3
CERTAINLY_HARD: Annotated[
    float,
    Tuned(
        "m", "penetration below which a fit also starts from the range of motion, and a comparison has the last word"
    ),
] = 3e-4
RESOLVED: Annotated[float, Tuned("m", "penetration that a pose cannot distinguish from zero")] = 1e-4
SLOWEST_IMPACT: Annotated[
    float,
    Tuned(
        "m/s", "impact speed below which damping does not follow D / v0: touches at rest would make the contact stiff"
    ),
] = 0.03
PENETRATIONS: Annotated[tuple[float, ...], Tuned("m", "penetrations that are tried as starts")] = (
    1e-4,
    7e-4,
    1.5e-3,
    2.5e-3,
    4e-3,
    6e-3,
    8.5e-3,
    1.2e-2,
    1.7e-2,
    2.4e-2,
    4e-2,
)
PARABOLAS: Annotated[tuple[float, ...], Tuned("s", "spans of the parabolas that give a starting state")] = (
    0.12,
    0.09,
    0.06,
)
PARABOLA_FITS: Annotated[float, Tuned("deviations", "misfit of a parabola that is good enough")] = 1.4
UNFINISHED: Annotated[float, Tuned("1", "widening of a fit that has not converged")] = 1.3
OPTIMA: Annotated[
    tuple[float, ...],
    Tuned(
        "m",
        "scatter of a clearance over the optima of the cost: hard contact, firm contact",
        "the benchmark's group `hard`; seeds 43201 to 43215 (K 3e7 to 1.4e8)",
    ),
] = (4e-4, 4.5e-5)
FIRM: Annotated[float, Tuned("m", "penetration below which a contact is firm", "the same seeds")] = 3.5e-3
KNOTS: Annotated[
    tuple[int, ...], Tuned("knots, 1", "knots of the load in a period; most of a broad-band load, in these")
] = (120, 3)
LEFT_OPEN: Annotated[
    float,
    Tuned(
        "1", "weight of a broad-band load's effect between its samples, which contacts turn from pose to rate and back"
    ),
] = 4.0

# Machines that differ from the model
PUSH: Annotated[float, Tuned("half range", "first guess of the load's error in a swing")] = 0.02
UNCORRELATED: Annotated[float, Tuned("1", "correlation of residuals that ends the sum over lags")] = 0.05
DIFFERS: Annotated[
    float,
    Tuned("1", "probability that a quantity differs from the scene", "`none`, `frame`, `theta_scale`, seed 96000"),
] = 0.2
BENT: Annotated[float, Tuned("1", "share of the linearised step by which it may be wrong")] = 0.3
BENT_BY_EXPONENT: Annotated[
    float,
    Tuned(
        "m",
        "deviation of a clearance by the square of the exponent's change",
        "`exponent` and `shape`, seeds 1 and 2: without it and the next, up to 9 deviations off",
    ),
] = 0.1
UNEXPLAINED: Annotated[
    float, Tuned("m", "deviation of a clearance by the root of the growth of the variance", "as above")
] = 1e-4
TURN: Annotated[float, Tuned("m", "prior deviation of the turn of a wall in a fit")] = 4e-3

# Hard contacts
FITTED: Annotated[
    float,
    Tuned(
        "m",
        "penetration from which on a fit moment by moment knows more; scatter of the largest reaches of a hard wall",
    ),
] = 8e-4
NARROW: Annotated[float, Tuned("deviations", "scatter of the largest reaches of a hard wall, in noise")] = 1.58
POSSIBLE: Annotated[float, Tuned("m", "noise of a reach above which a narrow reach is no sign of a hard wall")] = 1e-3
REACH_WINDOWS: Annotated[
    tuple[tuple[float, float], ...],
    Tuned("quantiles", "windows in which reaches are averaged, from the middle to the farthest"),
] = ((0.6, 0.8), (0.75, 0.95), (0.9, 0.99))
TURN_WINDOWS: Annotated[
    tuple[tuple[float, float], ...], Tuned("quantiles", "windows whose distance is least at the right bias of theta")
] = ((0.4, 0.7), (0.9, 0.99))
AVERAGED: Annotated[float, Tuned("s", "span over which the pose is averaged for a second look at the reach")] = 0.05
PATH_PHASES: Annotated[
    int, Tuned("parts", "parts of a load period for paths and mean reaches; half of them for scatters")
] = 40
FARTHEST_PARTS: Annotated[
    tuple[float, ...], Tuned("1", "shares of a period, the farthest, whose mean reach is taken")
] = (0.1, 0.2, 0.33)
OVERRATED: Annotated[Array, Tuned("m", "excess of the range of motion over the clearances")] = np.array(
    [0.8e-3, 1.0e-3]
)
DRAWS: Annotated[
    tuple[int, ...], Tuned("motions", "draws of three rounds, of one more for firm contacts, of another law")
] = (30, 30, 40, 100, 60)
DRAWN_CLEARANCE: Annotated[tuple[float, ...], Tuned("m", "deviation of the clearances in these rounds")] = (
    1.2e-3,
    3e-4,
    3e-4,
    2.5e-4,
)
HARD_DRAWN: Annotated[
    tuple[float, ...],
    Tuned(
        "m, 1, 1, 1",
        "draws of a hard contact: median penetration, deviations of its logarithm, of the damping's, of the gains",
    ),
] = (1.2e-5, 1.6, 0.7, 0.06)
FIRM_SPREAD: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "deviation of the logarithms drawn for a firm contact: at first, over that of the round before, at least",
        "seeds 43200 to 43215",
    ),
] = (0.5, 1.5, 0.1)
NOT_HARD: Annotated[
    float,
    Tuned(
        "1",
        "distance of the first round from which on a contact is firm",
        "seeds 46100 to 46209: 0.8 at most in ten hard ones, 1.3 to 3 in eight firm ones",
    ),
] = 1.2
ENOUGH_FOR_FIT: Annotated[float, Tuned("m", "deviation below which no further round comes before a fit")] = 1.2e-4
ASTRAY: Annotated[float, Tuned("m", "correction of the last round from which on the next deviation counts")] = 1.5e-4
UNEXPLAINED_HARD: Annotated[
    float,
    Tuned(
        "m",
        "deviation of a clearance where a hard motion has gone astray or, times its distance over the limit, differs",
        "`hard_kelvin_voigt`, `hard_shape`: 0.1 off in the median",
    ),
] = 3e-4
WIDENED_SOFTNESS: Annotated[
    float, Tuned("1", "widening of the logarithm of stiffness, which has long tails", "seeds 40400 to 40409")
] = 1.6
NEAR: Annotated[float, Tuned("1", "share of the draws that is regressed")] = 0.7
RIDGE: Annotated[
    tuple[float, ...],
    Tuned("1", "ridge penalty of the regressions: reach, residual variance, label of the law, features"),
] = (0.3, 20.0, 1.0, 0.01)
SHRINKAGE: Annotated[
    tuple[float, ...],
    Tuned("1", "of a covariance of few draws: features toward their variances, a path toward equal ones"),
] = (0.4, 0.2)
LEAST_FREE: Annotated[float, Tuned("1", "least share of a draw's residual that a fit with the draw leaves")] = 0.2
FARTHEST: Annotated[
    float, Tuned("deviations", "farthest a likeliest parameter of a law may lie from the middle of the draws")
] = 3.5
LATE: Annotated[float, Tuned("s", "deviation of the delay left in a path")] = 4e-3

# Following
PRESSED: Annotated[
    float,
    Tuned(
        "weights",
        "force beyond a pair's own with which a correction may press it",
        "seeds 71100 to 71102 of `benchmark/follow.py`: without a limit intervals of hard contacts hold 0.5 to 0.7",
    ),
] = 0.5
LOAD_ERROR_SHARE: Annotated[
    float,
    Tuned(
        "1",
        "error of the load in twins that follow, over its error in a swing by a rough estimate",
        "groups `shape`, `law`, `friction` of `benchmark/follow.py`, seeds 71000 to 71002: at 1 and 3 intervals "
        "hold 0.5 to 0.7, at 20 up to 1.0",
    ),
] = 10.0
LOAD_ERROR_LASTS: Annotated[
    float,
    Tuned("s", "time for which that error is correlated", "the same seeds; 0.05 gives the same within 0.04"),
] = 0.2
LEARNED_TO: Annotated[
    tuple[float, ...],
    Tuned(
        "1, 1, m, m, 1, 1, 1",
        "deviation to which numbers of twins that follow are learned from the poses: logarithms of K^-1/2 and damping, "
        "clearances, load gains",
        "simulated hard contacts (benchmark/follow.py, seeds 71101, 71102): errors of the learned numbers",
    ),
] = (0.06, 0.12, 5e-5, 5e-5, 0.01, 0.01, 0.01)
LEARNING: Annotated[
    float,
    Tuned(
        "1",
        "weight of a pose when these numbers are learned",
        "the same seeds: at 1 the learned numbers are two to three of their deviations off",
    ),
] = 0.25
LEARNED_FOR: Annotated[float, Tuned("s", "time after which what was learned counts less by e", "the same")] = 20.0
LEARNED_EACH: Annotated[float, Tuned("s", "time between two changes of the twins' numbers", "the same")] = 1.0

# Loads that do not explain the motion
MODULATED: Annotated[
    float, Tuned("s", "span of a function that the equations are multiplied by", "kinds `load_10`, `averages_1hz`")
] = 0.12
UNCERTAIN_DRAWS: Annotated[
    tuple[int, ...], Tuned("motions", "draws of each of three rounds: with an angle, without one")
] = (60, 120)
UNCERTAIN_SPREAD: Annotated[
    tuple[float, ...],
    Tuned("m, 1, 1", "first deviations of the clearances, and of the logarithms of penetration and damping"),
] = (3e-3, 0.35, 0.7)
UNCERTAIN_GAIN: Annotated[float, Tuned("1", "deviation of the gains of a load that does not explain the motion")] = 0.15
UNCERTAIN_EXPONENT: Annotated[
    float, Tuned("1", "deviation of the exponent beyond the scene's, in half of the draws", "truths with exponent 1.5")
] = 0.3
COARSEST: Annotated[
    float,
    Tuned("s", "distance of the samples of a load up to which its error is no loss of amplitude", "`averages_1hz`"),
] = 0.25
COARSE_GAIN: Annotated[
    float,
    Tuned(
        "1",
        "deviation of the gains of a load that is sampled more rarely",
        "averages over a third of a period lose 0.16 of the amplitude",
    ),
] = 0.2
AGREES: Annotated[
    float,
    Tuned("deviations", "distance up to which such a comparison and a fit that has not converged agree"),
] = 2.0
LOAD_ERRORS: Annotated[tuple[float, ...], Tuned("1", "least and largest error of a load over its amplitude")] = (
    0.01,
    0.3,
)
LOAD_CORRELATION: Annotated[tuple[float, ...], Tuned("s", "shortest and longest correlation of that error")] = (
    0.15,
    1.5,
)
CORRECTED: Annotated[
    tuple[float, ...],
    Tuned(
        "1, m", "share of the regression's correction that counts as a deviation, and least one", "seeds 80000 to 80003"
    ),
] = (0.3, 4e-4)

# Forces
HEAD_ROOM: Annotated[
    float, Tuned("m", "head room from which on a pad is in flight; up to twice it a pad may touch")
] = 1e-3
LEAST_CORRELATION: Annotated[
    float, Tuned("1", "correlation with the motion's force below which a cell does not measure it")
] = 0.7
CELL_SHARE: Annotated[
    float, Tuned("largest force", "change of the motion's force at a stuck cell; most force of a cell in flight")
] = 0.2
CELL_PRIOR: Annotated[tuple[float, ...], Tuned("1, s", "prior deviation of a cell's gain and delay")] = (0.05, 0.02)
LAW_ERROR: Annotated[float, Tuned("1", "error of law and load in a force")] = 0.01
MOST_LEFT_OVER: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "residual of one cell, and of all, beyond noise",
        "seeds 62000 to 62004: 0.04 and 0.013 at most; Kelvin-Voigt 0.037 and more",
    ),
] = (0.1, 0.02)
MOST_MISFIT: Annotated[
    float, Tuned("1", "mean square residual beyond which a swing is left out", "0.5 to 0.85 for fitted swings")
] = 1.5
TOLERANCE: Annotated[
    float,
    Tuned(
        "clearance",
        "tolerance of simulated poses; twice it, in the load's range, for thinned loads",
        "a few micrometres, far below sensors' resolution; thinning takes the members' time to a fifth",
    ),
] = 1e-4
LOAD_KNOT: Annotated[
    float,
    Tuned(
        "s",
        "distance of the knots of a broad-band load",
        "two loads: forces moved by a ninth of their interval (9 ms: all of it)",
    ),
] = 4e-3

# Blocks
DRAG: Annotated[float, Tuned("g", "deviation of an unknown acceleration in flight")] = 0.1
BEYOND: Annotated[float, Tuned("rows", "how far outside their gap two flights may meet")] = 0.25
GAINED: Annotated[
    float, Tuned("1", "kinetic energy after an impact over that before; more means two impacts or a long contact")
] = 1.25
IMPACT_SHARE: Annotated[
    float,
    Tuned(
        "1",
        "most impacts that gain energy, and fewest contacts between two flights",
        "measured drops: 0.01 and 0.5; at 50 Hz 0.5; behind a soft contact 0.05",
    ),
] = 0.25

# Gaps, wear, windows
CONSTANT_ERROR: Annotated[float, Tuned("m", "constant error of a gap's sensor: dirt on a worn pad")] = 1e-4
PATH_DEVIATION: Annotated[
    float,
    Tuned(
        "1",
        "deviation of the wear rate beside a history: means over few periods, unequal pads",
        "lives with seeds below 1000 (`benchmark/lives.py`)",
    ),
] = 0.03
LEAST_PROBABLE: Annotated[
    tuple[float, ...],
    Tuned("1", "probability below which a history contradicts wear; most probability at an end of the prior's range"),
] = (1e-6, 0.02)
MEAN_PERIODS: Annotated[
    tuple[int, ...], Tuned("periods", "load periods that are left out, and that the mean force is taken over")
] = (2, 4)
JUMP: Annotated[tuple[float, ...], Tuned("clearance", "largest change of a pad's depth in a jump, and its error")] = (
    0.02,
    1e-3,
)
WINDOW_SHARES: Annotated[
    tuple[float, ...],
    Tuned("window, window, 1", "least part of a window that is estimated, of an early one, growth to the next"),
] = (0.5, 0.1, 1.5)
ALIKE: Annotated[
    tuple[float, ...], Tuned("1", "ratio in length, mass and time up to which a machine is estimated in SI units")
] = (2.5, 6.0, 4.0)


@dataclass(frozen=True)
class Entry:
    """A chosen number: its name, value and meaning."""

    name: str
    value: Value
    tuned: Tuned


def entries() -> list[Entry]:
    """Return all chosen numbers in the order of this file."""
    hints = get_type_hints(sys.modules[__name__], include_extras=True)
    tuned = {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}
    return [Entry(name, globals()[name], meaning) for name, meaning in tuned.items()]
