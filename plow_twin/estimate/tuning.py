"""All numbers of the estimator that were chosen and not derived, with the data on which each choice is based.

Other modules read a number as `tuning.NAME`, so that `benchmark/tuning_sensitivity.py` can vary it (results in
`benchmark/results/tuning.md`). Seeds are those of `benchmark/estimate.py`. Penetrations are given for the reference
force of 100 kN.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Value = float | int | tuple[Any, ...] | Array

#: Basis of a number that was chosen without a recorded experiment.
JUDGED = "judgement"


@dataclass(frozen=True)
class Tuned:
    """Description of a chosen number.

    Attributes
    ----------
    unit : str
        Unit of the number; commas separate the units of several elements.
    meaning : str
        Effect of the number.
    basis : str
        The data on which the choice is based.
    """

    unit: str
    meaning: str
    basis: str = JUDGED


# Conditions for an estimated quantity
OBSERVED: Annotated[
    float,
    Tuned(
        "m",
        "largest deviation of an estimated clearance; a rough clearance may have twice this deviation; the limit "
        "for a group of pads, and the smallest reported change within a window, are half of it",
    ),
] = 1e-3
FARTHER: Annotated[
    float,
    Tuned("m", "increase of a clearance from a comparison of motions at which the reach is tested"),
] = 3e-3
FOLLOWS: Annotated[
    float,
    Tuned(
        "1",
        "smallest change of the reach, relative to that of the clearance, for a clearance that is observed",
        "nine clearances that were 2.6 to 13 mm off: at most 0.40; 11 of 12 of `hard`, `firm`, `middle` and "
        "`hard_sensor`, seeds 60200 to 60204: at least 0.84",
    ),
] = 0.5
BOUNCED_MOST: Annotated[
    float,
    Tuned(
        "m",
        "largest deviation of a clearance with a hard contact that is not rough; it is small because walls that "
        "are seldom touched give wrong clearances",
        "seeds 40400 to 40409",
    ),
] = 2e-4
OBSERVED_SHARE: Annotated[
    float,
    Tuned(
        "prior",
        "largest deviation of an observable clearance around a block or under an uncertain load, in prior deviations",
    ),
] = 0.5
MOST_INFLATED: Annotated[
    float,
    Tuned(
        "1",
        "inflation of the variance at which the result of an unfinished fit is withdrawn",
        "`cutting_10hz`, seeds 80000, 80001, 81000: fits with errors of 9 to 15 mm had inflations of 15 to 25; a "
        "limit of 7.5 would withdraw results under loads with errors of 5 %",
    ),
] = 15.0
SPARSEST: Annotated[
    float,
    Tuned(
        "s",
        "longest mean interval of poses, and longest gaps that may make up half of the window; with fewer poses "
        "in a flight, the guess of its starting state is wrong",
        "poses at 100 Hz with values missing at random, seeds 2 to 17: with a tenth of the poses (gaps of 0.17 "
        "s), one of 16 estimates had an error of 2 mm, 5 of its deviations; with 0.15 or 0.2 of the poses (0.11 "
        "s, 0.08 s), all 12 intervals contained the truth",
    ),
] = 0.125
TOUCHED: Annotated[
    float,
    Tuned(
        "s",
        "shortest time in contact with the walls of both sides",
        "if the load always presses the head to one wall, a fit with 0.05 s of contact at the other wall has an "
        "error of 20 mm",
    ),
] = 0.1
PREDICTED: Annotated[float, Tuned("1", "smallest share of the measured x or y that the model must predict")] = 0.08
GIVEN: Annotated[
    float,
    Tuned(
        "1",
        "largest penetration of both walls together, relative to the penetration under the reference force",
        "there are two walls, and the paper's forces reach twice the reference force",
    ),
] = 4.0
RESTS: Annotated[float, Tuned("1", "largest scatter of the poses of a resting head, relative to their noise")] = 1.3
IDLE_LOAD: Annotated[float, Tuned("weights", "scatter of the load below which the head is expected to rest")] = 0.05

# Checks
OUTLYING: Annotated[
    float,
    Tuned(
        "deviations",
        "limit that noise does not reach: for kinks of a flight, impacts away from a wall, gaps, poses, and "
        "similarity to another law; its square is the limit of chi^2 of the rotations of walls, and of the "
        "remaining gain of a fit",
        "one in 1.7 million normally distributed values exceeds the limit; chi^2 of the rotations was at most 9 "
        "for correct models (seeds 42000 to 42004); of 780 poses of three followed machines, none exceeded it "
        "with soft contacts, and eight with a hard contact",
    ),
] = 5.0
MOST_RATIO: Annotated[
    float,
    Tuned(
        "1",
        "largest ratio of the residuals to their differences between successive rows, of their scatter between "
        "phases of the load to their scatter within a phase, and of the noise in one part of the window to the "
        "noise in the rest",
        "the ratios are 1 without a fault",
    ),
] = 2.0
MOST_GAIN: Annotated[
    float, Tuned("1", "largest difference from 1 of the load's gain, or of a cell's gain, that is not suspect")
] = 0.25
MOST_SCALE: Annotated[
    float, Tuned("chi^2", "largest chi^2 of the sensor's three scale factors", "correct models have at most 12")
] = 16.0
MORE_ASKEW: Annotated[
    float,
    Tuned(
        "1",
        "smallest ratio of chi^2 of rotated walls, lever arm and low pass to chi^2 of the scale factors; each of "
        "the two groups can partly explain the effect of the other",
        "ratios: 5 and more for rotated walls (0.3 to 1 times the wear late in a life); 2.2 and 7.3 for a low "
        "pass of 20 Hz (`filter_20`, seeds 99001, 98002); 0.4 to 1.6 for scale factors of 1.05; 0.2 to 0.7 for "
        "errors of frame, mass and scale of theta",
    ),
] = 2.0
CHANGE_CHI2: Annotated[float, Tuned("chi^2", "smallest reduction of chi^2 by a change within the window")] = 200.0
CHANGE_SHARE: Annotated[float, Tuned("1", "smallest share of the excess residuals that such a change explains")] = 0.25
CHANGE_ENDS: Annotated[
    float,
    Tuned(
        "1",
        "share of the swings at each end of the window at which no change is tested",
        "load in steps (`load_steps`, seed 98201): a change after 3 of 176 swings reduces chi^2 by 254, a change "
        "after 9 by at most 61",
    ),
] = 0.05
STUCK: Annotated[
    tuple[float, ...],
    Tuned(
        "rows, deviations",
        "smallest number of equal successive rows of a stuck sensor, and smallest motion during these rows",
    ),
] = (12, 6.0)
PHASES: Annotated[int, Tuned("parts", "number of parts of a load period in which residuals are compared")] = 24
LAW_DAMPING: Annotated[
    tuple[float, ...],
    Tuned(
        "critical, critical, 1",
        "damping under the other law in a fit; for drawn hard contacts, the median of the damping and the "
        "deviation of its logarithm",
    ),
] = (0.05, 0.2, 0.6)
MOST_DISTANCE: Annotated[
    float,
    Tuned(
        "1",
        "largest distance of a motion with a hard contact from drawn motions, relative to the distances between "
        "drawn motions",
    ),
] = 4.0
MOST_PATH: Annotated[
    float, Tuned("deviations", "largest distance of the path of a motion with a hard contact from drawn paths")
] = 4.5
MOST_ODDS: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "log odds of another law: above the first value, the model is suspect; below the second value, a motion "
        "that resembles the other law is accepted",
        "correct models (seeds from 42200) have log odds of at most -7; a correct model that resembles the other "
        "law by 2.43 deviations (seed 46205) has -44",
    ),
] = (-3.0, -20.0)
CLEAR_ODDS: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "log odds of another law after half of the draws at which the comparison ends: against the law, for the law",
        "`hard` and `hard_kelvin_voigt`, 13 seeds from 50000: the remaining draws change the log odds by up to "
        "120, and reduce them to no less than 0.4 of their value; no verdict changes",
    ),
] = (-75.0, 30.0)

# Screening of measurements
MUCH_WORSE: Annotated[
    float,
    Tuned(
        "1",
        "stated deviation above which a component is treated as not measured, relative to the prior deviation of "
        "the bias or to the median deviation",
    ),
] = 10.0
SPIKE: Annotated[
    tuple[float, ...],
    Tuned("deviations, 1", "smallest distance of a spike from its neighbours; largest share of rows that are spikes"),
] = (20.0, 0.1)
REPEATING: Annotated[
    tuple[float, ...],
    Tuned(
        "1, 1", "smallest share of repeated rows of a slow sensor; longest repetition relative to the mean repetition"
    ),
] = (0.25, 3.0)
LONGEST_GAP: Annotated[
    tuple[float, ...],
    Tuned(
        "s, 1",
        "longest gap between samples of the load in s; for a load with few knots, longest gap in median intervals"
        " of its samples",
    ),
] = (0.5, 20.0)

# Fit
HUBER: Annotated[float, Tuned("deviations", "residual above which a measurement has a smaller weight")] = 3.0
JITTER_WEIGHT: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "weight of the variance of unpredictable motion: in a fit, whose Jacobian is noisy too; in the comparison"
        " of fits; with measured forces",
    ),
] = (100.0, 5.0, 10.0)
START_SPREAD: Annotated[
    Array, Tuned("m, m, rad, m/s, m/s, rad/s", "prior deviation of a starting state about its guess")
] = np.array([4e-3, 4e-3, 0.02, 0.2, 0.2, 1.0])
ASSUMED: Annotated[float, Tuned("1", "factor on `START_SPREAD` for components that were never measured")] = 10.0
PROBED_STATE: Annotated[
    Array,
    Tuned("m, m, rad, m/s, m/s, rad/s", "deviation of the displaced starting states that test the predictability"),
] = np.array([2e-4, 2e-4, 8e-4, 6e-3, 6e-3, 3e-2])
MOST_FREED: Annotated[float, Tuned("1", "largest factor that allows for the fit of unknowns to few swings")] = 3.0
MOST_WORK: Annotated[
    tuple[int, ...],
    Tuned(
        "steps",
        "largest work of a fit, of drawn motions over ten load periods, and of motions drawn under another law",
        "a few seconds on one core",
    ),
] = (3_000_000, 3_500_000, 1_500_000)
UNMEASURED_DRAWS: Annotated[
    tuple[int, ...],
    Tuned(
        "1",
        "if a component was never measured: number of drawn motions, number of improved motions, and number of "
        "motions from which `FIRST_PERIODS` are fitted",
    ),
] = (400, 10, 3)
UNMEASURED_DEPTHS: Annotated[
    tuple[float, float], Tuned("m", "smallest and largest penetration of the contacts among these draws")
] = (5e-4, 4e-2)
UNMEASURED_SCALES: Annotated[
    tuple[float, ...],
    Tuned("1", "deviations of the residuals in successive improvements, as shares of the scatter of the poses"),
] = (0.1, 0.03, 0.0)
UNMEASURED_STEPS: Annotated[int, Tuned("1", "largest number of steps of each improvement")] = 8
UNMEASURED_LOAD: Annotated[
    tuple[float, float],
    Tuned(
        "1, s",
        "error of the load that links the swings: its size as a share of the load's scatter, and its correlation time",
    ),
] = (0.05, 0.1)
UNMEASURED_ROUNDS: Annotated[
    int, Tuned("1", "largest number of fits that start from the motion of an unfinished fit")
] = 3
FIRST_PERIODS: Annotated[float, Tuned("periods", "part of the window in which candidates are compared")] = 3.0
FIRST_NOISE: Annotated[Array, Tuned("m, m, rad", "noise of x, y and theta in the first iteration")] = np.array(
    [1e-3, 1e-3, 4e-3]
)
MET: Annotated[
    float,
    Tuned(
        "m",
        "largest difference between the clearances of two candidates with equal losses that count as the same "
        "optimum and end the search",
        "`plain`, seeds 54000 to 54011: the final clearances move by less than 1e-6 m; without the condition of "
        "equal losses, one of 12 moves by 0.24 mm",
    ),
] = 2e-4
SHORTEST: Annotated[
    tuple[float, ...],
    Tuned("periods", "shortest swing with a hard contact, with a soft contact, and under a broad-band load"),
] = (0.04, 0.35, 0.03)
HARD_HORIZON: Annotated[float, Tuned("periods", "horizon of a swing with a hard contact")] = 0.11
ENOUGH: Annotated[float, Tuned("1", "reduction of the cost below which the fit to the beginnings of swings ends")] = (
    30.0
)
HARD: Annotated[float, Tuned("m", "penetration below which the motion after some bounces cannot be predicted")] = 3e-3
CERTAINLY_HARD: Annotated[
    float,
    Tuned(
        "m",
        "penetration below which a further fit starts from the range of motion, and whole motions are always compared",
    ),
] = 3e-4
RESOLVED: Annotated[float, Tuned("m", "penetration that a pose cannot distinguish from zero")] = 1e-4
SLOWEST_IMPACT: Annotated[
    float,
    Tuned(
        "m/s",
        "impact speed below which the damping D / v0 stays constant; otherwise, slow touches would make the "
        "contact stiff",
    ),
] = 0.03
PENETRATIONS: Annotated[tuple[float, ...], Tuned("m", "penetrations from which fits are started")] = (
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
PARABOLA_FITS: Annotated[float, Tuned("deviations", "largest misfit of an acceptable parabola")] = 1.4
UNFINISHED: Annotated[float, Tuned("1", "factor on the deviations of a fit that has not converged")] = 1.3
OPTIMA: Annotated[
    tuple[float, ...],
    Tuned(
        "m",
        "scatter of a clearance over the optima of the cost with a hard contact, with a firm contact, and with "
        "one measured component",
        "group `hard` of the benchmark; seeds 43201 to 43215 (K from 3e7 to 1.4e8); three machines with only x "
        "measured",
    ),
] = (4e-4, 4.5e-5, 8e-4)
FIRM: Annotated[float, Tuned("m", "penetration below which a contact is firm", "as for `OPTIMA`")] = 3.5e-3
KNOTS: Annotated[
    tuple[int, ...],
    Tuned(
        "knots, 1", "largest number of knots of the load in a period, and factor on this number for a broad-band load"
    ),
] = (120, 3)
LEFT_OPEN: Annotated[
    float,
    Tuned(
        "1",
        "factor on the effect of the unknown part of a broad-band load between its samples, because contacts "
        "convert errors of the pose to errors of the rate, and vice versa",
    ),
] = 4.0

# Machines that differ from the model
PUSH: Annotated[float, Tuned("half range", "first guess of the load's error in a swing")] = 0.02
UNCORRELATED: Annotated[float, Tuned("1", "correlation of residuals at which the sum over lags ends")] = 0.05
DIFFERS: Annotated[
    tuple[float, ...],
    Tuned(
        "1, 1",
        "prior probability that a quantity differs from the scene if a fit passes all checks, and if it fails a check",
        "52 clearances of 13 kinds of machines, seeds 84001 to 84003: with 0.05, 0.2 and 0.5, intervals of "
        "correct models are 1.3, 1.9 and 2.8 times as wide as without differences, and 0.92, 0.95 and 0.97 of the"
        " intervals of other machines contain the truth; with one-sided priors and 0.05, 0.1 and 0.2, intervals "
        "of correct models are 1.0, 1.1 and 1.2 times as wide, and 0.57, 0.79 and 0.86 of the intervals contain "
        "the clearances of frames with errors of 2 mm (seeds 30100 to 30107)",
    ),
] = (0.1, 0.5)
CERTAIN: Annotated[
    float,
    Tuned(
        "1",
        "probability of a difference of friction or exponent above which a fit with this difference follows",
        "`friction_02`, `friction_05`, `friction_10`, `exponent_110`, seeds 98300, 98301",
    ),
] = 0.9
BENT: Annotated[float, Tuned("1", "error of a linearised step, relative to the step")] = 0.3
BENT_BY_EXPONENT: Annotated[
    float,
    Tuned(
        "m",
        "deviation of a clearance per squared change of the exponent",
        "`exponent` and `shape`, seeds 1 and 2: without this deviation and `UNEXPLAINED`, errors of clearances "
        "reach 9 deviations",
    ),
] = 0.1
UNEXPLAINED: Annotated[
    float,
    Tuned(
        "m",
        "deviation of a clearance per square root of the inflation minus 1",
        "as for `BENT_BY_EXPONENT`",
    ),
] = 1e-4
TURN: Annotated[float, Tuned("m", "prior deviation of the rotation of a wall in a fit")] = 4e-3
MULTIPLES: Annotated[
    tuple[int, ...],
    Tuned(
        "1",
        "multiples of a load's frequency at which harmonics may be missing from the measured load",
        "`shape` 72000, 74000, 74001, `harmonic_1`, `harmonic_5`, `constant_1` 99001: all 12 intervals contain "
        "the truth, with an RMS error of 0.06 mm; with 2 and 3 only, two intervals do not; with 1 in addition, "
        "the RMS error is 0.08 mm",
    ),
] = (2, 3, 4, 5)
LACKING: Annotated[
    float,
    Tuned(
        "half range",
        "prior deviation of the amplitude of a missing harmonic",
        "harmonics from 1 to 15 % are fitted",
    ),
] = 0.1
SETTLED: Annotated[
    float,
    Tuned(
        "chi^2",
        "change of chi^2 of rotated walls, lever arm and low pass between two fits below which no further fit follows",
        "`lever` 80000 and `filter_5` 96001: clearances move by at most 0.13 deviations; with 4, by 0.6 deviations",
    ),
] = 1.0

# Hard contacts
FITTED: Annotated[
    float,
    Tuned(
        "m",
        "penetration above which a fit of each pose is more accurate than a comparison of whole motions; scatter "
        "of the farthest reaches below which a wall may be hard",
    ),
] = 8e-4
NARROW: Annotated[
    float, Tuned("deviations", "scatter of the farthest reaches, relative to noise, below which a wall may be hard")
] = 1.58
POSSIBLE: Annotated[
    float, Tuned("m", "noise of a reach above which a small scatter of the reach does not show a hard wall")
] = 1e-3
REACH_WINDOWS: Annotated[
    tuple[tuple[float, float], ...],
    Tuned("quantiles", "windows over which reaches are averaged, from middle to farthest reaches"),
] = ((0.6, 0.8), (0.75, 0.95), (0.9, 0.99))
TURN_WINDOWS: Annotated[
    tuple[tuple[float, float], ...],
    Tuned("quantiles", "two windows of the reach, whose distance is smallest with the correct bias of theta"),
] = ((0.4, 0.7), (0.9, 0.99))
AVERAGED: Annotated[float, Tuned("s", "time over which the pose is averaged for a second set of reaches")] = 0.05
PATH_PHASES: Annotated[
    int, Tuned("parts", "number of parts of a load period for paths and mean reaches; scatters have half as many parts")
] = 40
FARTHEST_PARTS: Annotated[
    tuple[float, ...], Tuned("1", "shares of a period with the farthest reaches, over which the reach is averaged")
] = (0.1, 0.2, 0.33)
OVERRATED: Annotated[Array, Tuned("m", "excess of the range of motion over the clearances")] = np.array(
    [0.8e-3, 1.0e-3]
)
DRAWS: Annotated[
    tuple[int, ...],
    Tuned("motions", "number of draws in three rounds, in a fourth round for firm contacts, and under another law"),
] = (30, 30, 40, 100, 60)
DRAWN_CLEARANCE: Annotated[tuple[float, ...], Tuned("m", "deviation of the drawn clearances in the four rounds")] = (
    1.2e-3,
    3e-4,
    3e-4,
    2.5e-4,
)
HARD_DRAWN: Annotated[
    tuple[float, ...],
    Tuned(
        "m, 1, 1, 1",
        "distribution of drawn hard contacts: median penetration, and deviations of the logarithm of penetration,"
        " of the logarithm of damping, and of the gains",
    ),
] = (1.2e-5, 1.6, 0.7, 0.06)
FIRM_SPREAD: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "deviation of the logarithms drawn for a firm contact: in the first round, relative to the deviation of "
        "the previous result, and smallest value",
        "seeds 43200 to 43215",
    ),
] = (0.5, 1.5, 0.1)
NOT_HARD: Annotated[
    float,
    Tuned(
        "1",
        "distance in the first round above which a contact is firm, not hard",
        "seeds 46100 to 46209: at most 0.8 for ten hard contacts, and 1.3 to 3 for eight firm contacts",
    ),
] = 1.2
ENOUGH_FOR_FIT: Annotated[
    float, Tuned("m", "deviation of a clearance below which a fit follows without a further round")
] = 1.2e-4
ASTRAY: Annotated[
    float, Tuned("m", "change of a clearance in the last round above which `UNEXPLAINED_HARD` is added")
] = 1.5e-4
UNEXPLAINED_HARD: Annotated[
    float,
    Tuned(
        "m",
        "additional deviation of a clearance with a hard contact if its rounds have not converged; for a motion "
        "unlike the model's, it is multiplied by the distance of the motion, relative to its limit",
        "`hard_kelvin_voigt`, `hard_shape`: median error of 0.1 mm",
    ),
] = 3e-4
WIDENED_SOFTNESS: Annotated[
    float,
    Tuned(
        "1",
        "factor on the deviation of the logarithm of penetration, whose distribution has long tails",
        "seeds 40400 to 40409",
    ),
] = 1.6
NEAR: Annotated[float, Tuned("1", "share of the draws that a regression uses")] = 0.7
RIDGE: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "ridge penalty of the regressions for the reach, for the residual variance, for the label of the law, and"
        " for the features",
    ),
] = (0.3, 20.0, 1.0, 0.01)
SHRINKAGE: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "shrinkage of a covariance from few draws: toward a diagonal matrix for features, and toward equal "
        "variances for a path",
    ),
] = (0.4, 0.2)
LEAST_FREE: Annotated[
    float, Tuned("1", "smallest share of a draw's residual that is assumed to remain in a fit that includes the draw")
] = 0.2
FARTHEST: Annotated[
    float, Tuned("deviations", "largest distance of the most likely parameters of a law from the middle of the draws")
] = 3.5
LATE: Annotated[float, Tuned("s", "deviation of the remaining delay of a path")] = 4e-3

# Following
PRESSED: Annotated[
    float,
    Tuned(
        "weights",
        "largest force that a correction may add to a pair",
        "seeds 71100 to 71102 of `benchmark/follow.py`: without this limit, the intervals for hard contacts "
        "contain 0.5 to 0.7 of the forces",
    ),
] = 0.5
LOAD_ERROR_SHARE: Annotated[
    float,
    Tuned(
        "1",
        "error of the load in following twins, relative to the load's error in a swing according to a rough estimate",
        "groups `shape`, `law`, `friction` of `benchmark/follow.py`, seeds 71000 to 71002: with 1 and 3, the "
        "intervals contain 0.5 to 0.7 of the forces; with 20, up to 1.0",
    ),
] = 10.0
LOAD_ERROR_LASTS: Annotated[
    float,
    Tuned(
        "s", "correlation time of this error", "as for `LOAD_ERROR_SHARE`; with 0.05, the shares change by at most 0.04"
    ),
] = 0.2
LEARNED_TO: Annotated[
    tuple[float, ...],
    Tuned(
        "1, 1, m, m, 1, 1, 1, m, m, rad",
        "deviation down to which parameters of following twins are learned from the poses: logarithms of K^-1/2 "
        "and damping, clearances, load gains, biases of the sensor",
        "errors of the learned parameters for simulated hard contacts (`benchmark/follow.py`, seeds 71101, "
        "71102); for the biases, the error of the mean of 28 s of poses at 100 Hz, with the weight `LEARNING`",
    ),
] = (0.06, 0.12, 5e-5, 5e-5, 0.01, 0.01, 0.01, 2e-5, 2e-5, 1e-4)
LEARNING: Annotated[
    float,
    Tuned(
        "1",
        "weight of a pose in the learning of these parameters",
        "as for `LEARNED_TO`: with 1, the errors of the learned parameters are two to three deviations",
    ),
] = 0.25
LEARNED_FOR: Annotated[
    float, Tuned("s", "time in which the variance of a learned parameter grows by the factor e", "as for `LEARNED_TO`")
] = 20.0
LEARNED_EACH: Annotated[
    float, Tuned("s", "time between two updates of the learned parameters", "as for `LEARNED_TO`")
] = 1.0
NEW_MOTION: Annotated[
    float,
    Tuned(
        "window",
        "smallest share of new motion in an early window, and in the window of an estimate that replaces an "
        "estimate with fewer rough clearances",
        "a window that is longer by half has a share of a third, neighbouring windows of a node have 0.31, and "
        "windows of 10.0 and 10.8 s have 0.07",
    ),
] = 0.2

# Loads that do not explain the motion
MODULATED: Annotated[
    float,
    Tuned("s", "length of the test functions by which the equations are multiplied", "kinds `load_10`, `averages_1hz`"),
] = 0.12
LOAD_AVERAGED: Annotated[
    float,
    Tuned(
        "s",
        "averaging time of the load that would cause a motion, if the load was not measured",
        "`plain`, seeds 30200 to 30202: errors of clearances are at most 3.7 mm; with 0.2 s, they reach 8 mm",
    ),
] = 0.4
YIELDED: Annotated[
    tuple[float, float, float],
    Tuned(
        "1, 1, 1",
        "if the load was not measured: penetrations of both walls, relative to the penetration under the "
        "reference force, as the median and the deviation of the logarithm; share of the penetrations that is "
        "added to the deviation of a clearance",
        "as for `LOAD_AVERAGED`",
    ),
] = (1.5, 0.4, 0.1)
UNCERTAIN_DRAWS: Annotated[
    tuple[int, ...], Tuned("motions", "number of draws in each of three rounds, with and without measured theta")
] = (60, 120)
UNCERTAIN_SPREAD: Annotated[
    tuple[float, ...],
    Tuned(
        "m, 1, 1",
        "deviations of the clearances, of the logarithm of penetration, and of the logarithm of damping in the "
        "first round",
    ),
] = (3e-3, 0.35, 0.7)
UNCERTAIN_GAIN: Annotated[float, Tuned("1", "deviation of the gains of a load that does not explain the motion")] = 0.15
UNCERTAIN_EXPONENT: Annotated[
    float,
    Tuned(
        "1",
        "deviation of the increase of the exponent, in half of the draws",
        "simulated machines with the exponent 1.5",
    ),
] = 0.3
COARSEST: Annotated[
    float,
    Tuned("s", "longest interval between samples of a load at which its amplitude is not reduced", "`averages_1hz`"),
] = 0.25
COARSE_GAIN: Annotated[
    float,
    Tuned(
        "1",
        "deviation of the gains of a load with longer intervals",
        "averages over a third of a period reduce the amplitude by 0.16",
    ),
] = 0.2
AGREES: Annotated[
    float,
    Tuned("deviations", "largest distance between a comparison under an uncertain load and a failed fit that agree"),
] = 2.0
LOAD_ERRORS: Annotated[
    tuple[float, ...], Tuned("1", "smallest and largest error of a load relative to its amplitude")
] = (
    0.01,
    0.3,
)
LOAD_CORRELATION: Annotated[tuple[float, ...], Tuned("s", "shortest and longest correlation time of this error")] = (
    0.15,
    1.5,
)
CORRECTED: Annotated[
    tuple[float, ...],
    Tuned(
        "1, m",
        "share of the regression's correction that is added to the deviation, and constant term of the deviation",
        "seeds 80000 to 80003",
    ),
] = (0.3, 4e-4)

# Forces
HEAD_ROOM: Annotated[
    float, Tuned("m", "distance from the wall beyond which a pad is in flight; within twice this distance it may touch")
] = 1e-3
LEAST_CORRELATION: Annotated[
    float, Tuned("1", "smallest correlation between the force of a cell and the force that the motion gives")
] = 0.7
CELL_SHARE: Annotated[
    float,
    Tuned(
        "largest force",
        "smallest change of the force that the motion gives while the reading of a stuck cell is constant; "
        "largest force of a cell in flight",
    ),
] = 0.2
CELL_PRIOR: Annotated[tuple[float, ...], Tuned("1, s", "prior deviation of a cell's gain and delay")] = (0.05, 0.02)
LAW_ERROR: Annotated[float, Tuned("1", "relative error of a force due to errors of the contact law and the load")] = (
    0.01
)
MOST_LEFT_OVER: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "largest unexplained share of the force of one cell, and of all cells",
        "seeds 62000 to 62004: at most 0.04 and 0.013; with a Kelvin-Voigt contact, at least 0.037",
    ),
] = (0.1, 0.02)
MOST_MISFIT: Annotated[
    float, Tuned("1", "mean square residual above which a swing counts as not fitted", "0.5 to 0.85 for fitted swings")
] = 1.5
TOLERANCE: Annotated[
    float,
    Tuned(
        "clearance",
        "tolerance of simulated poses; thinned loads have twice this tolerance, relative to their range",
        "a few micrometres, far below the resolution of sensors; thinning reduces the time for the members to a fifth",
    ),
] = 1e-4
LOAD_KNOT: Annotated[
    float,
    Tuned(
        "s",
        "interval of the knots of a broad-band load",
        "two loads: the forces change by a ninth of their interval; with 9 ms, by the whole interval",
    ),
] = 4e-3

# Blocks
DRAG: Annotated[float, Tuned("g", "deviation of an unknown acceleration in flight")] = 0.1
BEYOND: Annotated[
    float,
    Tuned("rows", "largest extrapolation of two flights beyond the gap between them to the point where they meet"),
] = 0.25
GAINED: Annotated[
    float,
    Tuned(
        "1",
        "largest ratio of the kinetic energies after and before an impact; a larger ratio means two impacts or a "
        "long contact",
    ),
] = 1.25
IMPACT_SHARE: Annotated[
    float,
    Tuned(
        "1",
        "largest share of impacts that gain energy, and smallest share of contacts that are impacts between two "
        "flights",
        "measured drops: 0.01 and 0.5; at 50 Hz 0.5; behind a soft contact 0.05",
    ),
] = 0.25

# Gaps, wear, windows
CONSTANT_ERROR: Annotated[float, Tuned("m", "constant error of a gap sensor due to dirt on a worn pad")] = 1e-4
PATH_DEVIATION: Annotated[
    float,
    Tuned(
        "1",
        "relative deviation of the wear rate in addition to the deviation from a history, due to means over few "
        "periods and to unequal pads",
        "simulated lives with seeds below 1000 (`benchmark/lives.py`)",
    ),
] = 0.03
LEAST_PROBABLE: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "probability below which a history contradicts wear, and largest probability at an end of the prior's range",
    ),
] = (1e-6, 0.02)
MEAN_PERIODS: Annotated[
    tuple[int, ...],
    Tuned(
        "periods",
        "number of load periods that are omitted at the start, and number of periods over which the mean force is"
        " computed",
    ),
] = (2, 4)
JUMP: Annotated[
    tuple[float, ...], Tuned("clearance", "largest change of a pad's depth in a jump, and largest error of this change")
] = (
    0.02,
    1e-3,
)
WINDOW_SHARES: Annotated[
    tuple[float, ...],
    Tuned(
        "window, window, 1",
        "length of the shortest window that is estimated, and of the shortest early window, as shares of the full"
        " length; growth factor from one early window to the next",
    ),
] = (0.5, 0.1, 1.5)
ALIKE: Annotated[
    tuple[float, ...],
    Tuned(
        "1",
        "largest ratio of a machine to the paper's machine in length, in mass and in time for an estimate in SI units",
    ),
] = (2.5, 6.0, 4.0)


@dataclass(frozen=True)
class Entry:
    """Name, value and description of a chosen number."""

    name: str
    value: Value
    tuned: Tuned


def entries() -> list[Entry]:
    """Return all chosen numbers in the order of this file."""
    hints = get_type_hints(sys.modules[__name__], include_extras=True)
    tuned = {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}
    return [Entry(name, globals()[name], meaning) for name, meaning in tuned.items()]
