"""All numbers of the estimator that were chosen and not derived, with the data on which each choice is based.

Other modules read a number as `tuning.NAME`, so that `benchmark/tuning_sensitivity.py` can vary it (results in
`benchmark/results/tuning.md`). The comment before a number contains its effect, its unit in brackets (commas separate
the units of several elements) and, after `Basis:`, the data on which the choice is based. A number without a basis was
chosen by judgement. Seeds are those of `benchmark/estimate.py`. Penetrations are given for the reference force of 100
kN.
"""

from __future__ import annotations

import inspect
import re
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Value = float | int | tuple[Any, ...] | NDArray[np.float64]

# Conditions for an estimated quantity
#: largest deviation of an estimated clearance; a rough clearance may have twice this deviation; the limit for a group
#: of pads, and the smallest reported change within a window, are half of it [m]
OBSERVED = 1e-3
#: increase of a clearance with which motions are drawn to test whether the reach of the motion follows [m]
FARTHER = 3e-3
#: smallest change of the reach, relative to that of the clearance, for a clearance that is observed [1]
#: Basis: nine clearances that were 2.6 to 13 mm off: at most 0.40; 11 of 12 of `hard`, `firm`, `middle` and
#: `hard_sensor`, seeds 60200 to 60204: at least 0.84
FOLLOWS = 0.5
#: largest deviation of a clearance with a hard contact that is not rough; it is small because walls that are seldom
#: touched give wrong clearances [m]
#: Basis: seeds 40400 to 40409
BOUNCED_MOST = 2e-4
#: largest deviation of an observable clearance around a block or under an uncertain load, in prior deviations [prior]
OBSERVED_SHARE = 0.5
#: inflation of the variance at which the result of an unfinished fit is withdrawn [1]
#: Basis: `cutting_10hz`, seeds 80000, 80001, 81000: fits with errors of 9 to 15 mm had inflations of 15 to 25; a limit
#: of 7.5 would withdraw results under loads with errors of 5 %
MOST_INFLATED = 15.0
#: longest mean interval of poses, and longest gaps that may make up half of the window; with fewer poses in a flight,
#: the guess of its starting state is wrong [s]
#: Basis: poses at 100 Hz with values missing at random, seeds 2 to 17: with a tenth of the poses (gaps of 0.17 s), one
#: of 16 estimates had an error of 2 mm, 5 of its deviations; with 0.15 or 0.2 of the poses (0.11 s, 0.08 s), all 12
#: intervals contained the truth
SPARSEST = 0.125
#: shortest time in contact with the walls of both sides [s]
#: Basis: if the load always presses the head to one wall, a fit with 0.05 s of contact at the other wall has an error
#: of 20 mm
TOUCHED = 0.1
#: smallest share of the measured x or y that the model must predict [1]
PREDICTED = 0.08
#: largest penetration of both walls together, relative to the penetration under the reference force [1]
#: Basis: there are two walls, and the paper's forces reach twice the reference force
GIVEN = 4.0
#: largest scatter of the poses of a resting head, relative to their noise [1]
RESTS = 1.3
#: scatter of the load below which the head is expected to rest [weights]
IDLE_LOAD = 0.05

# Checks
#: limit that noise does not reach: for kinks of a flight, impacts away from a wall, gaps, poses, and similarity to
#: another law; its square is the limit of chi^2 of the rotations of walls, and of the remaining gain of a fit
#: [deviations]
#: Basis: one in 1.7 million normally distributed values exceeds the limit; chi^2 of the rotations was at most 9 for
#: correct models (seeds 42000 to 42004); of 780 poses of three followed machines, none exceeded it with soft contacts,
#: and eight with a hard contact
OUTLYING = 5.0
#: limit of three ratios: residuals to their differences between successive rows; scatter of the residuals between
#: phases of the load to their scatter within a phase; noise in one part of the window to the noise in the rest [1]
#: Basis: the ratios are 1 without a fault
MOST_RATIO = 2.0
#: largest difference from 1 of the load's gain, or of a cell's gain, that is not suspect [1]
MOST_GAIN = 0.25
#: largest chi^2 of the sensor's three scale factors [chi^2]
#: Basis: correct models have at most 12
MOST_SCALE = 16.0
#: smallest ratio of chi^2 of rotated walls, lever arm and low pass to chi^2 of the scale factors; each of the two
#: groups can partly explain the effect of the other [1]
#: Basis: ratios: 5 and more for rotated walls (0.3 to 1 times the wear late in a life); 2.2 and 7.3 for a low pass of
#: 20 Hz (`filter_20`, seeds 99001, 98002); 0.4 to 1.6 for scale factors of 1.05; 0.2 to 0.7 for errors of frame, mass
#: and scale of theta
MORE_ASKEW = 2.0
#: smallest reduction of chi^2 by a change within the window [chi^2]
CHANGE_CHI2 = 200.0
#: smallest share of the excess residuals that a change within the window explains [1]
CHANGE_SHARE = 0.25
#: share of the swings at each end of the window at which no change is tested [1]
#: Basis: load in steps (`load_steps`, seed 98201): a change after 3 of 176 swings reduces chi^2 by 254, a change after
#: 9 by at most 61
CHANGE_ENDS = 0.05
#: smallest number of equal successive rows of a stuck sensor, and smallest motion during these rows [rows, deviations]
STUCK = (12, 6.0)
#: number of parts of a load period in which residuals are compared [parts]
PHASES = 24
#: damping under the other law in a fit; for drawn hard contacts, the median of the damping and the deviation of its
#: logarithm [critical, critical, 1]
LAW_DAMPING = (0.05, 0.2, 0.6)
#: largest distance of a motion with a hard contact from drawn motions, relative to the distances between drawn motions
#: [1]
MOST_DISTANCE = 4.0
#: largest distance of the path of a motion with a hard contact from drawn paths [deviations]
MOST_PATH = 4.5
#: log odds of another law: above the first value, the model is suspect; below the second value, a motion that resembles
#: the other law is accepted [1]
#: Basis: correct models (seeds from 42200) have log odds of at most -7; a correct model that resembles the other law by
#: 2.43 deviations (seed 46205) has -44
MOST_ODDS = (-3.0, -20.0)
#: log odds of another law after half of the draws at which the comparison ends: against the law, for the law [1]
#: Basis: `hard` and `hard_kelvin_voigt`, 13 seeds from 50000: the remaining draws change the log odds by up to 120, and
#: reduce them to no less than 0.4 of their value; no verdict changes
CLEAR_ODDS = (-75.0, 30.0)

# Screening of measurements
#: stated deviation above which a component is treated as not measured, relative to the prior deviation of the bias or
#: to the median deviation [1]
MUCH_WORSE = 10.0
#: smallest distance of a spike from its neighbours; largest share of rows that are spikes [deviations, 1]
SPIKE = (20.0, 0.1)
#: smallest share of repeated rows of a slow sensor; longest repetition relative to the mean repetition [1, 1]
REPEATING = (0.25, 3.0)
#: longest gap between samples of the load in s; for a load with few knots, longest gap in median intervals of its
#: samples [s, 1]
LONGEST_GAP = (0.5, 20.0)

# Fit
#: residual above which a measurement has a smaller weight [deviations]
HUBER = 3.0
#: weight of the variance of unpredictable motion: in a fit, whose Jacobian is noisy too; in the comparison of fits;
#: with measured forces [1]
JITTER_WEIGHT = (100.0, 5.0, 10.0)
#: prior deviation of a starting state about its guess [m, m, rad, m/s, m/s, rad/s]
START_SPREAD = np.array([4e-3, 4e-3, 0.02, 0.2, 0.2, 1.0])
#: factor on `START_SPREAD` for components that were never measured [1]
ASSUMED = 10.0
#: deviation of the displaced starting states that test the predictability [m, m, rad, m/s, m/s, rad/s]
PROBED_STATE = np.array([2e-4, 2e-4, 8e-4, 6e-3, 6e-3, 3e-2])
#: largest factor that allows for the fit of unknowns to few swings [1]
MOST_FREED = 3.0
#: largest work of a fit, of drawn motions over ten load periods, and of motions drawn under another law [steps]
#: Basis: a few seconds on one core
MOST_WORK = (3_000_000, 3_500_000, 1_500_000)
#: if a component was never measured: number of drawn motions, number of improved motions, and number of motions from
#: which `FIRST_PERIODS` are fitted [1]
UNMEASURED_DRAWS = (400, 10, 3)
#: smallest and largest penetration of the contacts among these draws [m]
UNMEASURED_DEPTHS = (5e-4, 4e-2)
#: deviations of the residuals in successive improvements, as shares of the scatter of the poses [1]
UNMEASURED_SCALES = (0.1, 0.03, 0.0)
#: largest number of steps of each improvement [1]
UNMEASURED_STEPS = 8
#: error of the load that links the swings: its size as a share of the load's scatter, and its correlation time [1, s]
UNMEASURED_LOAD = (0.05, 0.1)
#: largest number of fits that start from the motion of an unfinished fit [1]
UNMEASURED_ROUNDS = 3
#: part of the window in which candidates are compared [periods]
FIRST_PERIODS = 3.0
#: noise of x, y and theta in the first iteration [m, m, rad]
FIRST_NOISE = np.array([1e-3, 1e-3, 4e-3])
#: largest difference between the clearances of two candidates with equal losses that count as the same optimum and end
#: the search [m]
#: Basis: `plain`, seeds 54000 to 54011: the final clearances move by less than 1e-6 m; without the condition of equal
#: losses, one of 12 moves by 0.24 mm
MET = 2e-4
#: shortest swing with a hard contact, with a soft contact, and under a broad-band load [periods]
SHORTEST = (0.04, 0.35, 0.03)
#: horizon of a swing with a hard contact [periods]
HARD_HORIZON = 0.11
#: reduction of the cost below which the fit to the beginnings of swings ends [1]
ENOUGH = 30.0
#: penetration below which the motion after some bounces cannot be predicted [m]
HARD = 3e-3
#: penetration below which a further fit starts from the range of motion, and whole motions are always compared [m]
CERTAINLY_HARD = 3e-4
#: penetration that a pose cannot distinguish from zero [m]
RESOLVED = 1e-4
#: impact speed below which the damping D / v0 stays constant; otherwise, slow touches would make the contact stiff
#: [m/s]
SLOWEST_IMPACT = 0.03
#: penetrations from which fits are started [m]
PENETRATIONS = (1e-4, 7e-4, 1.5e-3, 2.5e-3, 4e-3, 6e-3, 8.5e-3, 1.2e-2, 1.7e-2, 2.4e-2, 4e-2)
#: spans of the parabolas that give a starting state [s]
PARABOLAS = (0.12, 0.09, 0.06)
#: largest misfit of an acceptable parabola [deviations]
PARABOLA_FITS = 1.4
#: factor on the deviations of a fit that has not converged [1]
UNFINISHED = 1.3
#: scatter of a clearance over the optima of the cost with a hard contact, with a firm contact, and with one measured
#: component [m]
#: Basis: group `hard` of the benchmark; seeds 43201 to 43215 (K from 3e7 to 1.4e8); three machines with only x measured
OPTIMA = (4e-4, 4.5e-5, 8e-4)
#: penetration below which a contact is firm [m]
#: Basis: as for `OPTIMA`
FIRM = 3.5e-3
#: largest number of knots of the load in a period, and factor on this number for a broad-band load [knots, 1]
KNOTS = (120, 3)
#: factor on the effect of the unknown part of a broad-band load between its samples, because contacts convert errors of
#: the pose to errors of the rate, and vice versa [1]
LEFT_OPEN = 4.0

# Machines that differ from the model
#: first guess of the load's error in a swing [half range]
PUSH = 0.02
#: correlation of residuals at which the sum over lags ends [1]
UNCORRELATED = 0.05
#: prior probability that a quantity differs from the scene if a fit passes all checks, and if it fails a check [1, 1]
#: Basis: 52 clearances of 13 kinds of machines, seeds 84001 to 84003: with 0.05, 0.2 and 0.5, intervals of correct
#: models are 1.3, 1.9 and 2.8 times as wide as without differences, and 0.92, 0.95 and 0.97 of the intervals of other
#: machines contain the truth; with one-sided priors and 0.05, 0.1 and 0.2, intervals of correct models are 1.0, 1.1 and
#: 1.2 times as wide, and 0.57, 0.79 and 0.86 of the intervals contain the clearances of frames with errors of 2 mm
#: (seeds 30100 to 30107)
DIFFERS = (0.1, 0.5)
#: probability of a difference of friction or exponent above which a fit with this difference follows [1]
#: Basis: `friction_02`, `friction_05`, `friction_10`, `exponent_110`, seeds 98300, 98301
CERTAIN = 0.9
#: error of a linearised step, relative to the step [1]
BENT = 0.3
#: deviation of a clearance per squared change of the exponent [m]
#: Basis: `exponent` and `shape`, seeds 1 and 2: without this deviation and `UNEXPLAINED`, errors of clearances reach 9
#: deviations
BENT_BY_EXPONENT = 0.1
#: deviation of a clearance per square root of the inflation minus 1 [m]
#: Basis: as for `BENT_BY_EXPONENT`
UNEXPLAINED = 1e-4
#: prior deviation of the rotation of a wall in a fit [m]
TURN = 4e-3
#: multiples of a load's frequency at which harmonics may be missing from the measured load [1]
#: Basis: `shape` 72000, 74000, 74001, `harmonic_1`, `harmonic_5`, `constant_1` 99001: all 12 intervals contain the
#: truth, with an RMS error of 0.06 mm; with 2 and 3 only, two intervals do not; with 1 in addition, the RMS error is
#: 0.08 mm
MULTIPLES = (2, 3, 4, 5)
#: prior deviation of the amplitude of a missing harmonic [half range]
#: Basis: harmonics from 1 to 15 % are fitted
LACKING = 0.1
#: change of chi^2 of rotated walls, lever arm and low pass between two fits below which no further fit follows [chi^2]
#: Basis: `lever` 80000 and `filter_5` 96001: clearances move by at most 0.13 deviations; with 4, by 0.6 deviations
SETTLED = 1.0

# Hard contacts
#: penetration above which a fit of each pose is more accurate than a comparison of whole motions; scatter of the
#: farthest reaches below which a wall may be hard [m]
FITTED = 8e-4
#: scatter of the farthest reaches, relative to noise, below which a wall may be hard [deviations]
NARROW = 1.58
#: noise of a reach above which a small scatter of the reach does not show a hard wall [m]
POSSIBLE = 1e-3
#: windows over which reaches are averaged, from middle to farthest reaches [quantiles]
REACH_WINDOWS = ((0.6, 0.8), (0.75, 0.95), (0.9, 0.99))
#: two windows of the reach, whose distance is smallest with the correct bias of theta [quantiles]
TURN_WINDOWS = ((0.4, 0.7), (0.9, 0.99))
#: time over which the pose is averaged for a second set of reaches [s]
AVERAGED = 0.05
#: number of parts of a load period for paths and mean reaches; scatters have half as many parts [parts]
PATH_PHASES = 40
#: shares of a period with the farthest reaches, over which the reach is averaged [1]
FARTHEST_PARTS = (0.1, 0.2, 0.33)
#: excess of the range of motion over the clearances [m]
OVERRATED = np.array([0.8e-3, 1.0e-3])
#: number of draws in three rounds, in a fourth round for firm contacts, and under another law [motions]
DRAWS = (30, 30, 40, 100, 60)
#: deviation of the drawn clearances in the four rounds [m]
DRAWN_CLEARANCE = (1.2e-3, 3e-4, 3e-4, 2.5e-4)
#: distribution of drawn hard contacts: median penetration, and deviations of the logarithm of penetration, of the
#: logarithm of damping, and of the gains [m, 1, 1, 1]
HARD_DRAWN = (1.2e-5, 1.6, 0.7, 0.06)
#: deviations from which the logarithms for a firm contact are drawn: deviation in the first round; in later rounds,
#: factor of the deviation of the previous result, and smallest deviation [1]
#: Basis: seeds 43200 to 43215
FIRM_SPREAD = (0.5, 1.5, 0.1)
#: distance in the first round above which a contact is firm, not hard [1]
#: Basis: seeds 46100 to 46209: at most 0.8 for ten hard contacts, and 1.3 to 3 for eight firm contacts
NOT_HARD = 1.2
#: deviation of a clearance below which a fit follows without a further round [m]
ENOUGH_FOR_FIT = 1.2e-4
#: change of a clearance in the last round above which `UNEXPLAINED_HARD` is added [m]
ASTRAY = 1.5e-4
#: additional deviation of a clearance with a hard contact if its rounds have not converged; for a motion unlike the
#: model's, it is multiplied by the distance of the motion, relative to its limit [m]
#: Basis: `hard_kelvin_voigt`, `hard_shape`: median error of 0.1 mm
UNEXPLAINED_HARD = 3e-4
#: factor on the deviation of the logarithm of penetration, whose distribution has long tails [1]
#: Basis: seeds 40400 to 40409
WIDENED_SOFTNESS = 1.6
#: share of the draws that a regression uses [1]
NEAR = 0.7
#: ridge penalty of the regressions for the reach, for the residual variance, for the label of the law, and for the
#: features [1]
RIDGE = (0.3, 20.0, 1.0, 0.01)
#: shrinkage of a covariance from few draws: toward a diagonal matrix for features, and toward equal variances for a
#: path [1]
SHRINKAGE = (0.4, 0.2)
#: smallest share of a draw's residual that is assumed to remain in a fit that includes the draw [1]
LEAST_FREE = 0.2
#: largest distance of the most likely parameters of a law from the middle of the draws [deviations]
FARTHEST = 3.5
#: deviation of the remaining delay of a path [s]
LATE = 4e-3

# Following
#: largest force that a correction may add to a pair [weights]
#: Basis: seeds 71100 to 71102 of `benchmark/follow.py`: without this limit, the intervals for hard contacts contain 0.5
#: to 0.7 of the forces
PRESSED = 0.5
#: error of the load in following twins, relative to the load's error in a swing according to a rough estimate [1]
#: Basis: groups `shape`, `law`, `friction` of `benchmark/follow.py`, seeds 71000 to 71002: with 1 and 3, the intervals
#: contain 0.5 to 0.7 of the forces; with 20, up to 1.0
LOAD_ERROR_SHARE = 10.0
#: correlation time of this error [s]
#: Basis: as for `LOAD_ERROR_SHARE`; with 0.05, the shares change by at most 0.04
LOAD_ERROR_LASTS = 0.2
#: deviation down to which parameters of following twins are learned from the poses: logarithms of K^-1/2 and damping,
#: clearances, load gains, biases of the sensor [1, 1, m, m, 1, 1, 1, m, m, rad]
#: Basis: errors of the learned parameters for simulated hard contacts (`benchmark/follow.py`, seeds 71101, 71102); for
#: the biases, the error of the mean of 28 s of poses at 100 Hz, with the weight `LEARNING`
LEARNED_TO = (0.06, 0.12, 5e-5, 5e-5, 0.01, 0.01, 0.01, 2e-5, 2e-5, 1e-4)
#: weight of a pose in the learning of these parameters [1]
#: Basis: errors of peaks and impulses of ten hard contacts (`benchmark/follow.py`, seeds 71101, 71102, 74000 to 74007),
#: in deviations (RMS): 0.25 gives 0.4 to 0.9 with a coverage of 1.00, 0.5 gives 0.4 to 1.0 with 0.99, 1 gives up to 1.5
LEARNING = 0.5
#: time in which the variance of a learned parameter grows by the factor e [s]
#: Basis: as for `LEARNED_TO`
LEARNED_FOR = 20.0
#: time between two updates of the learned parameters [s]
#: Basis: as for `LEARNED_TO`
LEARNED_EACH = 1.0
#: assumed distance of a scaled pose's share from its linear interpolation over a unit of the share; it affects the
#: number of passes, not their result [1]
#: Basis: four passes in the case that was tried, six by bisection alone
CURVED = 0.1
#: smallest share of new motion in an early window, and in the window of an estimate that replaces an estimate with
#: fewer rough clearances [window]
#: Basis: a window that is longer by half has a share of a third, neighbouring windows of a node have 0.31, and windows
#: of 10.0 and 10.8 s have 0.07
NEW_MOTION = 0.2

# Signs, order and units of the poses
#: time over which motions are averaged before they are compared with the motions that the load causes [s]
RESEMBLES = 0.3
#: size of a negative correlation above which a sign is wrong [1]
#: Basis: all kinds and groups of machines, seeds 700010 to 700012 and 700020: correlations of right signs are above
#: -0.13; above -0.25 within single load periods of `chatter`, and above 0.2 in those of seven other kinds (710100)
OPPOSED = 0.4
#: correlation of x and y with each other's simulated motions above which they may be swapped, and excess of the sum of
#: both correlations over that with their own motions [1, 1]
#: Basis: as for `OPPOSED`, and `swapped`, `plain`, `middle`, `hard` 710000 to 710003: the excess is at least 0.4 for
#: swapped axes with soft contacts, and at most 0.0 for right axes with correlations above 0.2
SWAPPED = (0.5, 0.2)
#: ratio of measured to simulated scatter above which, or below whose inverse, a unit is wrong [1]
#: Basis: as for `OPPOSED`: ratios from 0.3 to 1.7, and up to 18 for a load of averages over 1 s without a correlation
WRONG_UNIT = 6.0

#: distance of a clearance from its prior mean beyond which a second fit begins at the prior mean [deviations]
#: Basis: stress test of `test_estimate_motion.py` with theta locked: 3.4 from a wrong fit; 10 mm of wear: 1.3
FAR = 3.0
# Loads that do not explain the motion
#: length of the test functions by which the equations are multiplied [s]
#: Basis: kinds `load_10`, `averages_1hz`
MODULATED = 0.12
#: averaging time of the load that would cause a motion, if the load was not measured [s]
#: Basis: `plain`, seeds 30200 to 30202: errors of clearances are at most 3.7 mm; with 0.2 s, they reach 8 mm
LOAD_AVERAGED = 0.4
#: if the load was not measured: median of the penetrations of both walls, relative to the penetration under the
#: reference force; deviation of its logarithm; share of the penetrations that is added to the deviation of a clearance
#: [1, 1, 1]
#: Basis: as for `LOAD_AVERAGED`
YIELDED = (1.5, 0.4, 0.1)
#: number of draws in each of three rounds, with and without measured theta [motions]
UNCERTAIN_DRAWS = (60, 120)
#: deviations of the clearances, of the logarithm of penetration, and of the logarithm of damping in the first round [m,
#: 1, 1]
UNCERTAIN_SPREAD = (3e-3, 0.35, 0.7)
#: deviation of the gains of a load that does not explain the motion [1]
UNCERTAIN_GAIN = 0.15
#: deviation of the increase of the exponent, in half of the draws [1]
#: Basis: simulated machines with the exponent 1.5
UNCERTAIN_EXPONENT = 0.3
#: longest interval between samples of a load at which its amplitude is not reduced [s]
#: Basis: `averages_1hz`
COARSEST = 0.25
#: deviation of the gains of a load with longer intervals [1]
#: Basis: averages over a third of a period reduce the amplitude by 0.16
COARSE_GAIN = 0.2
#: largest distance between a comparison under an uncertain load and a failed fit that agree [deviations]
AGREES = 2.0
#: smallest and largest error of a load relative to its amplitude [1]
LOAD_ERRORS = (0.01, 0.3)
#: shortest and longest correlation time of this error [s]
LOAD_CORRELATION = (0.15, 1.5)
#: share of the regression's correction that is added to the deviation, and constant term of the deviation [1, m]
#: Basis: seeds 80000 to 80003
CORRECTED = (0.3, 4e-4)

# Forces
#: distance from the wall beyond which a pad is in flight; within twice this distance it may touch [m]
HEAD_ROOM = 1e-3
#: smallest correlation between the force of a cell and the force that the motion gives [1]
LEAST_CORRELATION = 0.7
#: smallest change of the force that the motion gives while the reading of a stuck cell is constant; largest force of a
#: cell in flight [largest force]
CELL_SHARE = 0.2
#: prior deviation of a cell's gain and delay [1, s]
CELL_PRIOR = (0.05, 0.02)
#: relative error of a force due to errors of the contact law and the load [1]
LAW_ERROR = 0.01
#: largest unexplained share of the force of one cell, and of all cells [1]
#: Basis: seeds 62000 to 62004: at most 0.04 and 0.013; with a Kelvin-Voigt contact, at least 0.037
MOST_LEFT_OVER = (0.1, 0.02)
#: mean square residual above which a swing counts as not fitted [1]
#: Basis: 0.5 to 0.85 for fitted swings
MOST_MISFIT = 1.5
#: tolerance of simulated poses; thinned loads have twice this tolerance, relative to their range [clearance]
#: Basis: a few micrometres, far below the resolution of sensors; thinning reduces the time for the members to a fifth
TOLERANCE = 1e-4
#: interval of the knots of a broad-band load [s]
#: Basis: two loads: the forces change by a ninth of their interval; with 9 ms, by the whole interval
LOAD_KNOT = 4e-3

# Blocks
#: deviation of an unknown acceleration in flight [g]
DRAG = 0.1
#: largest extrapolation of two flights beyond the gap between them to the point where they meet [rows]
BEYOND = 0.25
#: largest ratio of the kinetic energies after and before an impact; a larger ratio means two impacts or a long contact
#: [1]
GAINED = 1.25
#: largest share of impacts that gain energy, and smallest share of contacts that are impacts between two flights [1]
#: Basis: measured drops: 0.01 and 0.5; at 50 Hz 0.5; behind a soft contact 0.05
IMPACT_SHARE = 0.25

# Gaps, wear, windows
#: constant error of a gap sensor due to dirt on a worn pad [m]
CONSTANT_ERROR = 1e-4
#: relative deviation of the wear rate in addition to the deviation from a history, due to means over few periods and to
#: unequal pads [1]
#: Basis: simulated lives with seeds below 1000 (`benchmark/lives.py`)
PATH_DEVIATION = 0.03
#: probability below which a history contradicts wear, and largest probability at an end of the prior's range [1]
LEAST_PROBABLE = (1e-6, 0.02)
#: number of load periods that are omitted at the start, and number of periods over which the mean force is computed
#: [periods]
MEAN_PERIODS = (2, 4)
#: largest change of a pad's depth in a jump, and largest error of this change [clearance]
JUMP = (0.02, 1e-3)
#: length of the shortest window that is estimated, and of the shortest early window, as shares of the full length;
#: growth factor from one early window to the next [window, window, 1]
WINDOW_SHARES = (0.5, 0.1, 1.5)
#: largest ratio of a machine to the paper's machine in length, in mass and in time for an estimate in SI units [1]
ALIKE = (2.5, 6.0, 4.0)


@dataclass(frozen=True)
class Entry:
    """A chosen number with its effect (`meaning`), its unit and the data on which the choice is based."""

    name: str
    value: Value
    meaning: str
    unit: str
    basis: str


def entries() -> list[Entry]:
    """Return all chosen numbers with their comments, in the order of this file."""
    found = re.findall(r"((?:^#: .*\n)+)(\w+) = ", inspect.getsource(sys.modules[__name__]), re.MULTILINE)
    out = []
    for comment, name in found:
        effect, _, basis = comment.replace("\n", " ").replace("#: ", "").strip().partition(" Basis: ")
        meaning, _, unit = effect.removesuffix("]").rpartition(" [")
        out.append(Entry(name, globals()[name], meaning, unit, basis or "judgement"))
    return out
