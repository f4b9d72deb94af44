"""Correction of a fit for differences between machine and model, which changes the values and widens the intervals.

Three kinds of differences are considered:

- Further unknowns, each with a prior: inertia, size and compliance of the frame, friction, exponent, differences
  between the walls, errors of the sensor, and constant errors of the load. They are estimated in one linearised step
  from the fit. Bayesian variable selection samples which of them differ from the scene. Unknowns that cannot be
  negative have one-sided priors.
- The load is assumed to have a constant error in each swing (a part of the motion that begins in flight). The size of
  the errors is estimated from all swings (empirical Bayes).
- The remaining residuals are treated as noise. The variance of the measurements is increased if the residuals are
  large, or if they stay correlated for long (tempered likelihood).

References: George and McCulloch, J. Am. Stat. Assoc. 88 (1993) 881 (selection by Gibbs sampling); Hoeting et al., Stat.
Sci. 14 (1999) 382 (averaging over models); Dempster, Laird and Rubin, J. R. Stat. Soc. B 39 (1977) 1 (the sizes of
random effects); Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425 (discrepancy).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr, ndtr

from plow_twin.estimate import tuning
from plow_twin.estimate.compliance import by_compliance
from plow_twin.estimate.fit import (
    DIFFERENCES,
    FEWEST_OF_SWING,
    LAG,
    WALLS,
    Fit,
    Point,
    Problem,
    huber_weight,
    scatter_ratio,
)
from plow_twin.estimate.harmonics import COMPONENTS, Harmonics
from plow_twin.estimate.measurements import FEWEST_FOR_SCATTER
from plow_twin.estimate.pads import deviations
from plow_twin.estimate.priors import ROUNDING, UNSTATED, deviation_of
from plow_twin.estimate.result import NORMAL_P95
from plow_twin.estimate.unknowns import GX, GY, SIZE, SOFTNESS
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import LEAST_EXPONENT, Friction, Scene, largest_exponent

Array = NDArray[np.float64]

#: Paths of the exponent, of the friction coefficient and of the speed below which friction is viscous.
EXPONENT, FRICTION, CREEP = "contact.exponent", "friction.coefficient", "friction.regularisation_speed_m_s"
#: Step of the difference quotient for each quantity of a scene: a fifth to a half of the prior deviation.
STATED: Final = {
    "head.mass_kg": 0.02,
    "head.inertia_kg_m2": 0.02,
    "frame.width_m": 5e-4,
    "frame.height_m": 5e-4,
    EXPONENT: 0.02,
    FRICTION: 0.01,
    CREEP: 0.1,
}
#: Lower bound on the relative change of the speed below which friction is viscous.
_LEAST_CREEP = -0.9
#: Steps of the difference quotients with respect to the relative stiffness and damping of a wall, and to a constant
#: load in units of half the load's range.
_WALL_STEP, _PUSH_STEP = 0.02, 5e-3
#: Smallest error of the load in units of half the load's range, a guard against division by zero.
_LEAST_PUSH = 1e-5
#: Upper bounds on the iterations of expectation-maximisation before each of three inflations of the noise.
_ROUNDS = (8, 5, 3)
#: Upper bound on the number of sweeps of the sampler, and number of initial sweeps that are discarded.
_SWEEPS, _BURNT = 50, 10
#: Number of bisections for a quantile, derived from an error of a millionth of the interval.
_BISECTIONS = 20
#: Upper bound on the lag in rows at which the correlation of residuals is computed.
_LONGEST_LAG = 60


@dataclass(frozen=True, eq=False)
class Graded:
    """Result of a fit for a machine that may differ from the model.

    Attributes
    ----------
    shared, covariance : ndarray, shape (SIZE,), (SIZE, SIZE)
        The unknowns of the whole window and their covariance. If the fit passes all checks, the machine is assumed to
        differ from the scene only in them.
    clearance : ndarray, shape (2,)
        Clearances in m, for a machine that may differ from the scene in any quantity.
    clearance_deviation : ndarray, shape (2, 2)
        Standard deviations in m of the two halves of normal distributions with the 5 % quantiles (first row) and the
        95 % quantiles (second row) of the clearances.
    differs : dict of str to (float, float, float)
        Probability, mean and standard deviation of the difference from the scene, for each further quantity.
    load : ndarray, shape (3,)
        Standard deviation of the load's error in a swing, in units of half the load's range.
    inflation : ndarray, shape (3,)
        Variance of the measured x, y and theta, divided by the variance of the noise in the fit.
    surprise : float
        Mean square of the linearised steps of the differences in units of their prior deviations, at least 1.
    harmonics : Harmonics, optional
        The harmonics that were added to the load.
    """

    shared: Array
    covariance: Array
    clearance: Array
    clearance_deviation: Array
    differs: dict[str, tuple[float, float, float]]
    load: Array
    inflation: Array
    surprise: float
    harmonics: Harmonics | None = None


def graded(problem: Problem, fitted: Fit, doubtful: bool = False) -> Graded:
    """Return the result of a fit for a machine that may differ from the model.

    Parameters
    ----------
    problem, fitted : Problem, Fit
        The fit, which need not have reached an optimum.
    doubtful : bool
        Whether the fit fails a check or has not reached an optimum, so that a difference is likely.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations cannot be solved.
    """
    problem = problem.with_fine_steps()
    fitted = replace(fitted, linear=problem.linearise(fitted.point))
    columns, pushes = _columns(problem, fitted)
    linear = _Linearised(problem, fitted, columns, pushes)
    for rounds in _ROUNDS:
        linear.learn(rounds)
        linear.temper()
    linear.eliminate()
    mean, covariance, often, halves = linear.averaged(np.random.default_rng(0), tuning.DIFFERS[int(doubtful)])
    surprise, named = linear.surprise(mean, often), linear.named(mean, often)
    share, exponent, _ = named.get(EXPONENT, (0.0, 0.0, 0.0))
    bent = tuning.BENT_BY_EXPONENT * share * (exponent - problem.unknowns.changes.get(EXPONENT, 0.0)) ** 2
    unexplained = tuning.UNEXPLAINED * math.sqrt(float(linear.inflation.mean()) - 1.0)
    ratio = max(1.0, linear.scatter()) * surprise

    def widened(step: Array, covariance: Array) -> Array:
        """Return the covariance of the shared unknowns, increased by the errors of the linearised step."""
        out: Array = ratio * covariance[:SIZE, :SIZE] + np.diag((tuning.BENT * step[:SIZE]) ** 2)
        out[[GX, GY], [GX, GY]] += bent**2 + unexplained**2
        return out

    clearance = (fitted.shared + mean[:SIZE])[[GX, GY]]
    added = np.diag(widened(mean, np.zeros_like(covariance)))[[GX, GY]]
    deviation = np.sqrt(ratio * halves**2 + added)
    if not doubtful:
        mean, covariance = linear.exact()
    harmonics, variance = problem.harmonics, ratio * np.diag(covariance)
    return Graded(
        fitted.shared + mean[:SIZE], widened(mean, covariance), clearance, deviation, named, linear.load,
        linear.inflation, surprise, harmonics and harmonics.moved(mean[linear.waves], variance[linear.waves]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Column:
    """A further quantity.

    deviation : prior standard deviation
    derivative : (n, 3) derivative of the predicted measurements
    value : value in the fit; None if the fit uses the value of the scene
    least : smallest possible value
    """

    deviation: float
    derivative: Array
    value: float | None = None
    least: float = -math.inf


def _columns(problem: Problem, fitted: Fit) -> tuple[dict[str, _Column], Array]:
    """Return the further quantities, and the derivatives, (n, 3, 3), of the measurements with respect to a load.

    A quantity is left out if its prior deviation is zero, if the contact law fixes it, or if its change cannot be
    simulated.
    """
    point = fitted.point

    def by(step: float, **changed: Any) -> Array | None:
        other = problem.evaluate(point.shared, point.states, **changed)
        return None if other is None else np.nan_to_num((other.predicted - point.predicted) / step)

    scene, depth = problem.unknowns.scene, problem.unknowns.penetration_of(float(fitted.shared[SOFTNESS]))
    out: dict[str, _Column] = {}
    for path, coarse in STATED.items():
        deviation, step = deviation_of(scene, path) if can_move(scene, path) else 0.0, problem.steps * coarse
        change = partial(moved_scene, path=path, step=step, depth=depth)
        column = by(step, change=change) if deviation > 0.0 else None
        if column is not None:
            least = least_change(problem.unknowns.nominal_scene or scene, path)
            out[path] = _Column(deviation, column, problem.unknowns.changes.get(path), least)
    sides = [out[path].derivative for path in ("frame.width_m", "frame.height_m") if path in out]
    if len(sides) == 2 and scene.frame.corner_radius_m is None:
        # at small angles, a radius has the effect of sides that are shorter by twice the radius
        out["corner_radius"] = _Column(ROUNDING, -2.0 * (sides[0] + sides[1]), least=0.0)
    column = by_compliance(problem, point)
    if column is not None:
        out["compliance"] = _Column(UNSTATED["compliance"], column, least=0.0)
    for (wall, pads), part in product(WALLS.items(), _of_walls(scene)):
        of_pads, step = np.ones(PAIR_COUNT), problem.steps * _WALL_STEP
        of_pads[list(pads)] += step
        column = by(step, **{part: of_pads})
        if column is not None:
            out[f"{part}_{wall}"] = _Column(UNSTATED[f"{part}_{wall}"], column)
    held, columns, prior = problem.differences.any(), problem.by_differences(point), deviations()
    for index, name in enumerate(DIFFERENCES):
        least = 0.0 if index == LAG else -math.inf
        if held:
            out[name] = _Column(prior[index], columns[:, :, index], float(problem.differences[index]), least)
        else:
            out[name] = _Column(UNSTATED[name], columns[:, :, index], least=least)
    out |= {name: _Column(UNSTATED[name], np.nan_to_num(column)) for name, column in _of_sensor(problem, point)}
    if problem.harmonics is not None:
        columns, values = problem.by_harmonics(point, problem.harmonics), problem.harmonics.amplitude.ravel()
        for index, name in enumerate(problem.harmonics.names):
            out[name] = _Column(tuning.LACKING, columns[:, :, index], float(values[index]))
    size = np.ptp(problem.forward.load.wrench, axis=0) / 2.0
    step = problem.steps * _PUSH_STEP
    pushes = [by(step, push=step * push) for push in np.diag(np.maximum(size, 1e-3 * size.max()))]
    if problem.harmonics is None:
        constants = zip(COMPONENTS, pushes, strict=True)
        out |= {f"load_{name}": _Column(UNSTATED[f"load_{name}"], push) for name, push in constants if push is not None}
    return out, np.stack([np.zeros_like(point.rate) if push is None else push for push in pushes], axis=2)


def _of_walls(scene: Scene) -> tuple[str, ...]:
    """Return the names of the numbers of the contact that may differ between the walls."""
    constant = scene.contact.law == "hunt_crossley" and scene.contact.damping
    return ("stiffness", "damping") if constant else ("stiffness",)


def _of_sensor(problem: Problem, point: Point) -> Iterator[tuple[str, Array]]:
    t = problem.window.poses.t
    for index, axis in enumerate(("x", "y", "theta")):
        column = np.zeros_like(point.predicted)
        column[:, index] = point.predicted[:, index]
        yield f"scale_{axis}", column
    yield "clock", -point.rate * (t - t.mean())[:, None]


def variants(scene: Scene) -> tuple[Scene, ...]:
    """Return the scenes with a different exponent and with friction, which need kernels of their own."""
    paths = (path for path in (EXPONENT, FRICTION) if can_move(scene, path))
    return tuple(moved_scene(scene, path, STATED[path], 1.0) for path in paths)


def can_move(scene: Scene, path: str) -> bool:
    """Return whether the number at `path` can differ from the scene."""
    if path == CREEP:
        rubbing = scene.friction
        return rubbing is not None and rubbing.coefficient > 0.0 and rubbing.stick_stiffness_n_m is None
    return path != EXPONENT or scene.contact.exponent + STATED[path] <= largest_exponent(scene.contact)


def least_change(scene: Scene, path: str) -> float:
    """Return the smallest possible change of the number at `path`."""
    if path == FRICTION:
        return -scene.friction.coefficient if scene.friction else 0.0
    if path == CREEP:
        return _LEAST_CREEP
    return LEAST_EXPONENT - scene.contact.exponent if path == EXPONENT else -math.inf


def moved_scene(scene: Scene, path: str, step: float, depth: float) -> Scene:
    """Return the scene with the number at `path` changed by `step`, which is relative for mass, inertia and speed.

    A change of the exponent does not change the force at the penetration `depth` in m.
    """
    part, name = path.split(".")
    if part == "friction":
        rubbing = scene.friction or Friction(0.0)
        if path == CREEP:
            speed = rubbing.regularisation_speed_m_s * (1.0 + step)
            return replace(scene, friction=replace(rubbing, regularisation_speed_m_s=speed))
        static = rubbing.static_coefficient
        other = replace(
            rubbing,
            coefficient=rubbing.coefficient + step,
            static_coefficient=None if static is None else static + step,
        )
        return replace(scene, friction=other)
    if part == "head":
        return replace(scene, head=replace(scene.head, **{name: getattr(scene.head, name) * (1.0 + step)}))
    if part == "frame":
        return replace(scene, frame=replace(scene.frame, **{name: getattr(scene.frame, name) + step}))
    contact = scene.contact
    stiffness = contact.stiffness * depth**-step
    return replace(scene, contact=replace(contact, exponent=contact.exponent + step, stiffness=stiffness))


class _Linearised:
    """The least-squares problem, linearised at a fit.

    The border of the normal equations consists of the unknowns of the whole window and of the further unknowns. Each
    swing has its own starting state and error of the load.

    inflation : (3,) factor on the variance of each component
    load : (3,) standard deviation of the load's error in a swing
    """

    def __init__(self, problem: Problem, fitted: Fit, columns: dict[str, _Column], pushes: Array) -> None:
        every, waves = columns.values(), 0 if problem.harmonics is None else problem.harmonics.amplitude.size
        # the harmonics are the last quantities, in the slice `waves` of the border
        self.names = list(columns)[: len(columns) - waves]
        self.waves = slice(SIZE + len(self.names), SIZE + len(columns))
        self._fit, self._swing = fitted, fitted.point.swing
        further = np.stack([quantity.derivative for quantity in every], axis=2)
        self._precision = np.concatenate([problem.deviation, [quantity.deviation for quantity in every]]) ** -2.0
        # values of the further quantities, and whether the fit includes them, shape (k,) each
        self._value = np.array([quantity.value or 0.0 for quantity in every])
        self._in_fit = np.array([quantity.value is not None for quantity in every])
        self._least = np.array([quantity.least for quantity in every])
        self._pull = np.concatenate([problem.mean - fitted.shared, -self._value]) * self._precision
        rows = [np.flatnonzero(self._swing == index) for index in range(problem.window.swings)]
        self._rows = [some for some in rows if len(some) >= FEWEST_OF_SWING]
        if not self._rows:
            raise np.linalg.LinAlgError("no swing has enough poses")
        linear, residual = fitted.linear.rows, fitted.point.residual
        self._border = [
            np.concatenate([linear[some][:, :, :SIZE], further[some]], axis=2).reshape(-1, len(self._precision))
            for some in self._rows
        ]
        self._of_start = [
            np.concatenate([linear[some][:, :, SIZE:], pushes[some]], axis=2).reshape(3 * len(some), -1)
            for some in self._rows
        ]
        self._residual = [np.nan_to_num(residual[some]).ravel() for some in self._rows]
        self._finite = [np.isfinite(residual[some]).ravel() for some in self._rows]
        self._remaining = self._residual
        self._start_spread = problem.start_spread
        self.inflation, self.load = np.ones(3), np.full(3, tuning.PUSH)

    def eliminate(self) -> None:
        held = np.diag(np.concatenate([self._start_spread**-2.0, self.load**-2.0]))
        self._blocks, self._swings = [], []
        for rows, border, own, residual, there, remaining in zip(
            self._rows, self._border, self._of_start, self._residual, self._finite, self._remaining, strict=True
        ):
            variance = (self._fit.variance[rows] * self.inflation).ravel()
            z = np.abs(remaining) / np.sqrt(variance)
            weight = (there * huber_weight(z) / variance)[:, None]
            cross, score = (weight * border).T @ own, (weight * own).T @ residual
            factor = cho_factor((weight * own).T @ own + held)
            gain = cho_solve(factor, cross.T)
            self._swings.append((factor, gain, cho_solve(factor, score)))
            normal = (weight * border).T @ border - cross @ gain
            self._blocks.append((normal, (weight * border).T @ residual - gain.T @ score))
        self._normal = np.sum([normal for normal, _ in self._blocks], axis=0) + np.diag(self._precision)
        self._score = np.sum([score for _, score in self._blocks], axis=0) + self._pull

    def learn(self, rounds: int) -> None:
        """Estimate the size of the load's error in a swing by expectation-maximisation, with all quantities free."""
        for _ in range(rounds):
            self.eliminate()
            covariance = np.linalg.inv(self._normal)
            step = covariance @ self._score
            square = np.zeros(3)
            self._remaining = []
            for (factor, gain, alone), border, own, residual in zip(
                self._swings, self._border, self._of_start, self._residual, strict=True
            ):
                state = alone - gain @ step
                self._remaining.append(residual - border @ step - own @ state)
                inverse = cho_solve(factor, np.eye(own.shape[1]))
                spread = np.diag(inverse)[6:] + np.einsum("ij,jk,ik->i", gain[6:], covariance, gain[6:])
                square += state[6:] ** 2 + spread
            self.load = np.maximum(np.sqrt(square / len(self._swings)), _LEAST_PUSH)

    def temper(self) -> None:
        """Inflate the variance according to the size of the residuals and the length of their correlation."""
        remaining = np.full(self._fit.point.residual.shape, np.nan)
        for rows, some, there in zip(self._rows, self._remaining, self._finite, strict=True):
            remaining[rows] = np.where(there, some, np.nan).reshape(-1, 3)
        for index in range(3):
            column = remaining[:, index]
            finite = np.isfinite(column)
            if finite.sum() < FEWEST_FOR_SCATTER:
                continue
            usual = float(np.median(self._fit.variance[finite, index]))
            square = float((column[finite] ** 2).mean())
            self.inflation[index] = max(1.0, square / usual) * _lasting(column, self._swing, square)

    def exact(self) -> tuple[Array, Array]:
        _, mean, covariance = self._conditional(self._in_fit)
        return mean, covariance

    def _conditional(self, differs: NDArray[np.bool_]) -> tuple[float, Array, Array]:
        """Return the log evidence, and mean and covariance of the unknowns, if only the marked quantities differ from
        the scene.
        """
        size, use = len(self._precision), np.append(np.arange(SIZE), SIZE + np.flatnonzero(differs))
        mean, covariance = np.zeros(size), np.zeros((size, size))
        lower = np.linalg.cholesky(self._normal[np.ix_(use, use)])
        inverse = cho_solve((lower, True), np.eye(len(use)))
        mean[use], covariance[np.ix_(use, use)] = inverse @ self._score[use], inverse
        evidence = 0.5 * float(self._score[use] @ mean[use]) - float(np.log(np.diag(lower)).sum())
        evidence += 0.5 * float(np.log(self._precision[use]).sum())
        for index in np.flatnonzero(differs & np.isfinite(self._least)).tolist():
            inside = _truncate(mean, covariance, SIZE + index, self._least[index] - self._value[index])
            evidence += inside - float(log_ndtr(-self._least[index] * math.sqrt(self._precision[SIZE + index])))
        return evidence, mean, covariance

    def averaged(self, rng: np.random.Generator, prior: float) -> tuple[Array, Array, Array, Array]:
        """Return mean and covariance of the samples, the share of samples in which each quantity differs, and the
        deviations of the clearances as in `Graded.clearance_deviation`.

        `prior` is the prior probability of a difference. A quantity that the fit includes differs in all samples.
        """
        size, odds = len(self._precision), math.log(prior / (1.0 - prior))
        cache: dict[bytes, tuple[float, Array, Array]] = {}

        def given(which: NDArray[np.bool_]) -> tuple[float, Array, Array]:
            key = which.tobytes()  # cached, because the sampler visits most sets several times
            if key not in cache:
                evidence, mean, covariance = self._conditional(which)
                cache[key] = evidence + odds * int(which.sum()), mean, covariance
            return cache[key]

        differs, counted = self._in_fit.copy(), _SWEEPS - _BURNT
        now = given(differs)[0]
        mean, second, often = np.zeros(size), np.zeros((size, size)), np.zeros(len(differs))
        parts = []
        for sweep in range(_SWEEPS):
            for index in rng.permutation(np.flatnonzero(~self._in_fit)):
                other = differs.copy()
                other[index] = not other[index]
                instead = given(other)[0]
                if np.log(rng.random()) < instead - now:
                    differs, now = other, instead
            if sweep >= _BURNT:
                _, step, covariance = given(differs)
                second += covariance + np.outer(step, step)
                mean += step
                often += differs
                parts.append((step[[GX, GY]], np.sqrt(np.diag(covariance)[[GX, GY]])))
        mean /= counted
        halves = _halves(mean[[GX, GY]], *np.stack(parts, axis=1))
        return mean, second / counted - np.outer(mean, mean), often / counted, halves

    def scatter(self) -> float:
        scores = np.stack([score[:SIZE] for _, score in self._blocks])
        precision, normals = self._precision[:SIZE], [normal[:SIZE, :SIZE] for normal, _ in self._blocks]
        inverse = np.linalg.inv(np.sum(normals, axis=0) + np.diag(precision))
        return scatter_ratio(scores, precision, inverse, np.diag(inverse), len(scores))

    def surprise(self, mean: Array, often: Array) -> float:
        """Return `Graded.surprise`. The linearisation is inaccurate if the result exceeds 1."""
        own = len(self.names)
        z, often = (mean[SIZE:] * np.sqrt(self._precision[SIZE:]))[:own], often[:own]
        return max(1.0, float((z**2 / np.maximum(often, 0.1)).sum() / max(often.sum(), 1.0)))

    def named(self, mean: Array, often: Array) -> dict[str, tuple[float, float, float]]:
        deviation = np.sqrt(1.0 / np.diag(self._normal)[SIZE:])
        return {
            name: (float(share), float(value / max(share, 1e-9)), float(spread))
            for name, share, value, spread in zip(self.names, often, self._value + mean[SIZE:], deviation, strict=False)
        }


def _halves(mean: Array, means: Array, deviations: Array) -> Array:
    """Return the deviations of the two halves of normal distributions with the means `mean`, shape (2,), and the 5 %
    and 95 % quantiles of mixtures of s normal distributions, shape (s, 2) each.

    If a quantity that moves the clearance differs in few samples, the distribution is far from normal.
    """
    out = np.zeros((2, 2))
    for row, (share, sign) in enumerate(((0.05, -1.0), (0.95, 1.0))):
        low, high = (means - 5.0 * deviations).min(axis=0), (means + 5.0 * deviations).max(axis=0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            below = ndtr((middle - means) / deviations).mean(axis=0) < share
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        out[row] = np.maximum(sign * (low - mean), 0.0) / NORMAL_P95
    return out


def _truncate(mean: Array, covariance: Array, index: int, least: float) -> float:
    """Change the mean and covariance of normal unknowns, in place, to those given that unknown `index` is at least
    `least`.

    Return the logarithm of the probability of this condition.
    Reference: Minka, Expectation propagation (2001), section 3.2 (moment matching).
    """
    spread = math.sqrt(covariance[index, index])
    z = (mean[index] - least) / spread
    log_inside = float(log_ndtr(z))
    ratio = math.exp(-0.5 * z * z - 0.5 * math.log(2.0 * math.pi) - log_inside)
    column = covariance[:, index] / spread
    mean += ratio * column
    covariance -= ratio * (ratio + z) * np.outer(column, column)
    return log_inside


def _lasting(residual: Array, swing: NDArray[np.int64], square: float) -> float:
    """Return the correlation length of residuals in rows, the sum of their correlations over all lags."""
    rows = 1.0
    for lag in range(1, _LONGEST_LAG):
        one, other = residual[:-lag], residual[lag:]
        both = np.isfinite(one) & np.isfinite(other) & (swing[:-lag] == swing[lag:])
        if both.sum() < FEWEST_FOR_SCATTER:
            break
        alike = float((one[both] * other[both]).mean()) / square
        if alike < tuning.UNCORRELATED:
            break
        rows += 2.0 * alike
    return rows
