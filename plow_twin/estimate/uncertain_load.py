"""Clearances if the measured load does not explain the motion, or if load or theta was not measured.

Motions with random clearances, contact parameters and load errors are simulated with the sensor's noise and gaps. A
regression over the simulated motions near the measured motion corrects the result of the module `equation_error`, or
the range of motion if theta was not measured. The method is that of the module `bouncing`.

If the load was not measured, each draw has the load that would cause the measured motion between the drawn walls,
averaged over a time longer than an impact. With this load, only the true walls give the measured impacts. The sensor's
biases of x and y are assumed to be zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.bouncing import MotionFeatures, regress_near
from plow_twin.estimate.equation_error import DEPTHS, EquationError
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import Load, Poses, interpolated
from plow_twin.estimate.start import noise_level, range_of_motion
from plow_twin.estimate.unknowns import DAMPING, LEAST_CLEARANCE, Unknowns
from plow_twin.model import geometry
from plow_twin.model.scene import largest_exponent

Array = NDArray[np.float64]

#: Interval between two knots of the load's error, derived as a share of the shortest correlation time of the error.
_KNOTS = 1.0 / 3.0
#: Interval [s] between the knots of the load between samples, derived as half the period of a soft contact (20 Hz).
_KNOT = 0.025
#: Upper bound on the number of sets of draws, each about the result of the previous set.
_ROUNDS = 3
#: Lower bound on the number of draws for a regression.
_FEWEST = 40


@dataclass(frozen=True, eq=False)
class Compared:
    """Result of the comparison of a measured motion with motions under uncertain loads.

    clearance : (2,) horizontal and vertical clearance in m
    deviation : (2,) standard deviations of the clearances in m
    touched : (2,) whether the head touched both horizontal walls, and whether it touched both vertical walls
    ln_depth : mean and deviation of the logarithm of the penetration in m under the reference force
    ln_damping : mean and deviation of the logarithm of the damping
    distance : distance of the measured motion from nearby drawn motions, divided by the distances between drawn motions
    load_error : error of the load relative to its amplitude
    """

    clearance: Array
    deviation: Array
    touched: NDArray[np.bool_]
    ln_depth: tuple[float, float]
    ln_damping: tuple[float, float]
    distance: float
    load_error: float


@dataclass
class _Spread:
    """Distribution of the draws. The clearances in m have the mean `centre`, shape (2,), and the deviation `about`.

    The logarithms of penetration [m], damping and relative load error each have a mean and a standard deviation. The
    clearances are reduced by random penetrations of both walls, with the median `yielded` relative to the penetration
    under the reference force.
    """

    centre: Array
    about: float
    ln_depth: tuple[float, float]
    ln_damping: tuple[float, float]
    ln_error: tuple[float, float]
    yielded: float = 0.0


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Parts of the comparison that depend on the measured quantities.

    features : function that computes features of poses (n, 3); the first two are distances in m near the clearances
    spread : distribution of the first draws
    touched : as in `Compared`
    draws : number of draws in a round
    unexplained : share of the regression's correction that is added to the deviation, and constant in m that is added
    load : function that returns the load for drawn clearances (2,) in m and drawn numbers (5,)
    """

    features: Callable[[Array], Array]
    spread: _Spread
    touched: NDArray[np.bool_]
    draws: int
    unexplained: tuple[float, ...]
    load: Callable[[Array, Array], Load]


def compare_under_uncertain_load(
    measured_load: Load | None, unknowns: Unknowns, poses: Poses, period: float
) -> tuple[Compared | None, int]:
    """Return the comparison of the measured motion with motions under random load errors, and its work.

    Parameters
    ----------
    measured_load : Load or None
        The measured load without samples that hardly move the head; None if it was not measured.
    unknowns : Unknowns
        The prior.
    poses : Poses
        The measured poses; theta may be missing.
    period : float
        Period of the load in s.

    Returns
    -------
    compared : Compared or None
        None if too few motions could be simulated, or if the result is smaller than all drawn clearances.
    work : int
        Number of solver steps.
    """
    rng = np.random.default_rng(0)
    motion_features = MotionFeatures(unknowns, poses, period)
    if measured_load is None:
        by = _without_load(motion_features, unknowns, poses, period)
    elif poses.measured[2]:
        by = _with_angle(motion_features, measured_load, unknowns, poses)
    else:
        by = _without_angle(motion_features, measured_load, unknowns, poses)
    spread, measured = by.spread, by.features(motion_features.q)
    rows: list[Array] = []
    targets: list[Array] = []
    work = 0
    found = None
    for _ in range(_ROUNDS):
        for _ in range(by.draws):
            clearance, numbers, ln_error = _draw(spread, rng)
            other = _with_exponent(unknowns, rng)
            forward = Forward(other.scene, _with_error(by.load(clearance, numbers), math.exp(ln_error), rng))
            q = motion_features.simulated(forward, other, clearance, numbers, rng)
            work += forward.work
            if q is not None:
                rows.append(by.features(q))
                targets.append(np.concatenate([clearance - rows[-1][:2], numbers[:2], [ln_error]]))
        if len(rows) < _FEWEST:
            return None, work
        found = regress_near(np.array(rows)[:, 2:], np.array(targets), measured[2:])
        value, deviation, previous_centre = found.value, found.deviation, spread.centre
        spread = _Spread(
            measured[:2] + value[:2],
            max(tuning.UNCERTAIN_SPREAD[0] / 2.0, tuning.FIRM_SPREAD[1] * float(deviation[:2].max())),
            (value[2], max(tuning.FIRM_SPREAD[2], tuning.FIRM_SPREAD[1] * deviation[2])),
            (value[3], tuning.UNCERTAIN_SPREAD[2]),
            (value[4], max(tuning.FIRM_SPREAD[2], tuning.FIRM_SPREAD[1] * deviation[4])),
        )
    assert found is not None
    if (spread.centre < LEAST_CLEARANCE).any():  # an extrapolation of the regression beyond all draws
        return None, work
    share, least = by.unexplained
    unexplained = np.hypot(share * value[:2], least)
    # the last change of a clearance shows how far it has converged
    moved = spread.centre - previous_centre
    return Compared(
        spread.centre,
        np.sqrt(deviation[:2] ** 2 + unexplained**2 + moved**2),
        by.touched,
        (float(value[2]), float(deviation[2])),
        (float(value[3]), float(deviation[3])),
        found.distance,
        math.exp(float(value[4])),
    ), work


def _without_load(motion_features: MotionFeatures, unknowns: Unknowns, poses: Poses, period: float) -> _Comparison:
    """Return the comparison for a load that was not measured; motions are compared by reaches and changes."""
    equations = EquationError(unknowns, Load.unmeasured(period), poses.t)

    def load(clearance: Array, numbers: Array) -> Load:
        return equations.required_load(
            motion_features.q, np.repeat(0.5 * clearance, 2), numbers[0], math.exp(numbers[1])
        )

    def features(q: Array) -> Array:
        values = motion_features.features(q)
        return np.concatenate([values[:2], values[5:], motion_features.changes(q)])

    travel = features(motion_features.q)[:2]
    spread = _Spread(
        travel,
        0.0,
        _middle(DEPTHS),
        (_damping(unknowns), tuning.UNCERTAIN_SPREAD[2]),
        _middle(tuning.LOAD_ERRORS),
        tuning.YIELDED[0],
    )
    unexplained = tuning.YIELDED[2], 0.0
    return _Comparison(features, spread, _moved(motion_features, poses), tuning.UNCERTAIN_DRAWS[1], unexplained, load)


def _with_angle(motion_features: MotionFeatures, measured_load: Load, unknowns: Unknowns, poses: Poses) -> _Comparison:
    """Return the comparison by the weak form of the equations of motion, which needs load and theta."""
    about, softness, damping = tuning.UNCERTAIN_SPREAD
    equations = EquationError(unknowns, measured_load, poses.t)
    first = equations.search(motion_features.q, range_of_motion(unknowns.scene, poses)[0])
    level = noise_level(motion_features.q)
    noise = math.hypot(max(level[0], level[1]), level[2] * geometry.half_diagonal(unknowns.scene))
    times = equations.touched(motion_features.q, first, tuning.OUTLYING * noise)
    start, ln_depth = np.repeat(0.5 * first.clearance, 2), first.ln_depth

    def features(q: Array) -> Array:
        return equations.fit(q, start, ln_depth).features

    spread = _Spread(
        first.clearance, about, (ln_depth, softness), (_damping(unknowns), damping), _middle(tuning.LOAD_ERRORS)
    )
    touched = np.asarray((times.reshape(2, 2) > tuning.TOUCHED).all(axis=1))
    draws = tuning.UNCERTAIN_DRAWS[0]
    return _Comparison(features, spread, touched, draws, tuning.CORRECTED, lambda clearance, numbers: measured_load)


def _without_angle(
    motion_features: MotionFeatures, measured_load: Load, unknowns: Unknowns, poses: Poses
) -> _Comparison:
    """Return the comparison by reaches, for a theta that was not measured."""
    nominal, deviations = unknowns.nominal(), unknowns.deviations()

    def features(q: Array) -> Array:
        values = motion_features.features(q)
        return np.concatenate([values[:2], values[5:]])

    depth = _middle(DEPTHS)
    damping = (_damping(unknowns), tuning.UNCERTAIN_SPREAD[2])
    spread = _Spread(nominal[:2], float(deviations[:2].max()) / 2.0, depth, damping, _middle(tuning.LOAD_ERRORS))
    moved, draws = _moved(motion_features, poses), tuning.UNCERTAIN_DRAWS[1]
    return _Comparison(features, spread, moved, draws, (0.0, 0.0), lambda clearance, numbers: measured_load)


def _moved(motion_features: MotionFeatures, poses: Poses) -> NDArray[np.bool_]:
    """Return whether x and y moved by more than their noise, shape (2,)."""
    moved: NDArray[np.bool_] = np.nanstd(poses.q[:, :2], axis=0) > tuning.RESTS * noise_level(motion_features.q)[:2]
    return moved


def _middle(bounds: tuple[float, ...]) -> tuple[float, float]:
    low, high = np.log(bounds)
    return 0.5 * (low + high), (high - low) / math.sqrt(12.0)


def _damping(unknowns: Unknowns) -> float:
    return float(unknowns.nominal()[DAMPING])


def _draw(spread: _Spread, rng: np.random.Generator) -> tuple[Array, Array, float]:
    """Return drawn clearances (2,) in m, drawn numbers (5,), and the drawn logarithm of the relative load error.

    The numbers are the logarithms of penetration and damping, and three load gains.
    """
    white = rng.standard_normal(8)
    ln_depth = np.clip(spread.ln_depth[0] + spread.ln_depth[1] * white[2], *np.log(DEPTHS))
    clearance = spread.centre + spread.about * white[:2]
    clearance -= spread.yielded * np.exp(ln_depth + tuning.YIELDED[1] * white[:2])
    clearance = np.maximum(clearance, LEAST_CLEARANCE)
    ln_damping = spread.ln_damping[0] + spread.ln_damping[1] * white[3]
    gains = 1.0 + tuning.UNCERTAIN_GAIN * white[4:7]
    ln_error = np.clip(spread.ln_error[0] + spread.ln_error[1] * white[7], *np.log(tuning.LOAD_ERRORS))
    return clearance, np.array([ln_depth, ln_damping, *gains]), float(ln_error)


def _with_exponent(unknowns: Unknowns, rng: np.random.Generator) -> Unknowns:
    """Increase the exponent of the scene at random in half of the cases, as far as the contact law admits.

    With a smaller exponent, a wall would be stiffest at its surface.
    """
    step = tuning.UNCERTAIN_EXPONENT * max(0.0, rng.standard_normal())
    contact = unknowns.scene.contact
    exponent = min(contact.exponent + step, largest_exponent(contact))
    return replace(unknowns, scene=replace(unknowns.scene, contact=replace(contact, exponent=exponent)))


def _with_error(load: Load, share: float, rng: np.random.Generator) -> Load:
    """Return a load plus a random error and a random part between the samples.

    The error is an Ornstein-Uhlenbeck process with the standard deviation `share` times the load's amplitude. The part
    between the samples is white noise with a spectral density of at most `load.unknown`.
    """
    least, most = tuning.LOAD_CORRELATION
    time = math.exp(rng.uniform(math.log(least), math.log(most)))
    grid = np.arange(load.t[0], load.t[-1], _KNOTS * least)
    keep = math.exp(-_KNOTS * least / time)
    error = rng.standard_normal((len(grid), 3))
    error[1:] *= math.sqrt(1.0 - keep * keep)
    for index in range(1, len(grid)):
        error[index] += keep * error[index - 1]
    amplitude = 0.5 * share * np.ptp(load.wrench, axis=0)
    within = np.arange(load.t[0], load.t[-1], _KNOT)
    missed = rng.standard_normal((len(within), 3)) * np.sqrt(rng.random() * np.array(load.unknown) / _KNOT)
    t = np.unique(np.concatenate([load.t, grid, within]))
    parts = ((load.t, load.wrench), (grid, amplitude * error), (within, missed))
    wrench = sum(interpolated(t, knots, part) for knots, part in parts)
    return Load(t, np.asarray(wrench))
