"""Least-squares fit of the unknowns, and of the state at the start of each swing, to the measured motion.

The window is divided into *swings*, which are parts of the motion that begin in flight between the walls. Each swing is
simulated from its own starting state (multiple shooting), so errors due to the load or to bounces do not accumulate.
Levenberg-Marquardt steps minimise the sum of Huber's function of the residuals and the terms of the prior.

If the load is unknown between its samples, the swings are short, and each swing is *linked* to the next swing by a
random jump with the covariance that the unknown load causes (weak constraints). Simulations from displaced starting
states give the variance of the prediction, which is added to the variance of the measurement.

References: Bock, Recent advances in parameter identification techniques for ODE (1983); Nocedal and Wright, Numerical
Optimization, ch. 10; Huber, Robust Statistics, ch. 7; Tremolet, Q. J. R. Meteorol. Soc. 132 (2006) 2483.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.arrow import OWN, Arrow, Factor
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.harmonics import Harmonics
from plow_twin.estimate.measurements import RESOLVING, Load, Poses
from plow_twin.estimate.sensor import Memory, moved_by_lever
from plow_twin.estimate.unknowns import BIAS, DAMPING, DELAY, GAIN, MOVING, OF_SCENE, PROBES, QUANTITIES, SIZE, Unknowns
from plow_twin.kernel.low_pass import lagged
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

#: Precision of an unknown without a prior, a guard against a singular matrix.
NO_PRIOR = 1e-6
#: Steps of the difference quotients with respect to a starting state, in m, m, rad, m/s, m/s, rad/s.
_DISPLACED = np.array([2e-4, 2e-4, 1e-3, 5e-3, 5e-3, 3e-2])
#: Lower bound on the spectral density of an unknown acceleration in m2/s3 and rad2/s3. It changes a rate by 0.1 mm/s or
#: 0.1 mrad/s in one second, which no sensor resolves.
_LEAST_DRIFT = 1e-8
#: Definition of the walls by the indices of two pads. The first pad is top or left.
WALLS: Final = {"left": (1, 7), "right": (3, 5), "top": (0, 2), "bottom": (6, 4)}
#: Definition of the *differences*, the unknowns by which the machine or the sensor differs from the model:
#:
#: - `turn_<wall>`: rotation of a wall, expressed as the distance in m by which the first pad in `WALLS` lies farther
#:   out than the second pad
#: - `lever_<axis>`: lever arm of the sensor in m
#: - `filter`: squared time constant of the sensor's low pass in s2
TURNS, LEVER, LAG = slice(0, 4), slice(4, 6), 6
DIFFERENCES: Final = ("turn_left", "turn_right", "turn_top", "turn_bottom", "lever_x", "lever_y", "filter")
#: Steps of the difference quotients with respect to the differences.
DIFFERENCE_STEPS: Final = np.array([2e-4, 2e-4, 2e-4, 2e-4, 1e-3, 1e-3, 4e-6])
#: Step of the difference quotients with respect to the amplitude of a harmonic, in units of half the load's range.
_HARMONIC_STEP = 5e-3
#: Factor on the steps of all difference quotients for accurate derivatives. A search needs large steps, which average
#: over the kinks of the motion. Large steps give wrong derivatives for a change without effect on the motion, for
#: example a common factor on mass, inertia, stiffness and load.
_FINE = 1.0 / 300.0
#: Smallest number of poses of a swing, derived from its six unknowns, which two poses would just determine.
FEWEST_OF_SWING = 4


def huber_loss(z: Array) -> Array:
    """Return Huber's function of absolute normalised residuals: quadratic up to `tuning.HUBER`, linear beyond."""
    return np.where(z <= tuning.HUBER, z * z, tuning.HUBER * (2.0 * z - tuning.HUBER))


def huber_weight(z: Array) -> Array:
    """Return the weights of iteratively reweighted least squares for Huber's function."""
    return np.minimum(1.0, tuning.HUBER / np.maximum(z, 1e-12))


@dataclass(frozen=True, eq=False)
class Window:
    """Poses divided into swings.

    starts : (s + 1,) model times in s at which the swings begin, followed by the end of the last swing
    states : (s, 6) first guesses of x, y, theta and their rates at the beginning of each swing
    """

    poses: Poses
    starts: Array
    states: Array

    @property
    def swings(self) -> int:
        """Number of swings."""
        return len(self.states)


@dataclass(eq=False)
class Point:
    """Values of all unknowns, and the motion that is simulated with these values.

    shared : (SIZE,) unknowns that apply to the whole window
    states : (s, 6) starting states of the swings
    swing : (n,) index of the swing of each pose, -1 outside all swings
    predicted : (n, 3) predicted measurements without the bias, NaN outside all swings
    residual : (n, 3) measured minus predicted values, NaN without a measurement
    rate : (n, 3) rates of the predicted measurements
    contact : (s, 8) time in s during which each pair is in contact
    defect : (s - 1, 6) starting state of a swing minus final state of the previous swing; (0, 6) without links
    """

    shared: Array
    states: Array
    swing: NDArray[np.int64]
    predicted: Array
    residual: Array
    rate: Array
    contact: Array
    defect: Array
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Linear:
    """Jacobians with respect to the shared unknowns and to the starting state of one swing.

    rows : (n, 3, SIZE + 6) Jacobian of the predicted measurements; the last six columns are for the row's swing
    ends : (s - 1, 6, SIZE + 6) Jacobian of the ends of linked swings
    """

    rows: Array
    ends: Array


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the normal equations, for the shared unknowns and for one or two consecutive swings.

    swing : index of the first swing
    rows : (m, SIZE + 6) or (m, SIZE + 12) Jacobian
    weighted : Jacobian multiplied by the weights, in the shape of `rows`
    residual : (m,) residuals
    """

    swing: int
    rows: Array
    weighted: Array
    residual: Array

    @property
    def own(self) -> slice:
        """Slice of the unknowns of these swings in the vector of all unknowns."""
        first = SIZE + OWN * self.swing
        return slice(first, first + self.rows.shape[1] - SIZE)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    point : unknowns and motion at the end of the fit
    covariance : (SIZE, SIZE) covariance of the shared unknowns
    factor : the factorised normal equations of all unknowns
    noise : (3,) standard deviation of the measurements
    variance : (n, 3) variance of each measurement, the inverse of its weight
    jitter : (n, 3) variance of the unpredictable part of the motion
    linear : Jacobians at `point`
    left : (SIZE + 6 s,) next step of the linearised problem, zero at an optimum
    gain_left : predicted reduction of the cost by the step `left`
    """

    point: Point
    covariance: Array
    factor: Factor
    noise: Array
    variance: Array
    jitter: Array
    linear: Linear
    left: Array
    gain_left: float
    iterations: int
    converged: bool

    @property
    def finished(self) -> bool:
        """Whether the fit has reached an optimum, which is necessary for tests of the residuals."""
        return self.gain_left < tuning.OUTLYING**2

    @property
    def loss(self) -> float:
        """Twice the negative log likelihood, for the comparison of fits to the same measurements."""
        variance = self.noise**2 + tuning.JITTER_WEIGHT[1] * self.jitter
        finite = np.isfinite(self.point.residual)
        z = np.abs(self.point.residual[finite]) / np.sqrt(variance[finite])
        return float(huber_loss(z).sum() + np.log(variance[finite]).sum())

    @property
    def shared(self) -> Array:
        """The shared unknowns, shape (SIZE,)."""
        return self.point.shared

    @property
    def deviation(self) -> Array:
        """Standard deviations of the shared unknowns, shape (SIZE,)."""
        deviation: Array = np.sqrt(np.diag(self.covariance))
        return deviation


@dataclass(frozen=True, eq=False)
class _Rows:
    """Assignment of poses to swings, for stamps that are `shift` s late.

    swing : (n,) index of the swing of each pose, -1 outside all swings
    inside : (k,) indices of the poses that lie in swings
    times : (k,) model times of these poses in s
    inner : (s + 1,) index in `inside` of the first row of each swing
    asked : times in s at which a simulation returns the state, including the ends of linked swings
    ends : indices in `asked` of the ends of linked swings
    edges : (s + 1,) index in `asked` of the first time of each swing
    """

    shift: float
    swing: NDArray[np.int64]
    inside: NDArray[np.int64]
    times: Array
    inner: NDArray[np.int64]
    asked: Array
    ends: NDArray[np.int64]
    edges: NDArray[np.int64]


def depth_of(turns: Array) -> Array | None:
    """Return the outward displacement of each pad in m, shape (8,), by rotations of the walls; None without any."""
    if not turns.any():
        return None
    depth = np.zeros(PAIR_COUNT)
    for (first, second), turn in zip(WALLS.values(), turns, strict=True):
        depth[first], depth[second] = 0.5 * turn, -0.5 * turn
    return depth


class Problem:
    """A least-squares problem: a window of measurements, a prior and a forward model.

    Parameters
    ----------
    forward : Forward
        The forward model.
    unknowns : Unknowns
        The scene and the definition of the unknowns.
    window : Window
        The measurements.
    prior : tuple of ndarray, shape (SIZE,), optional
        Means and standard deviations of the shared unknowns. By default, the prior of `unknowns` is used.
    horizon : float
        Duration in s of the longest part of a swing that is simulated.
    differences : ndarray, shape (7,), optional
        Values in the order of `DIFFERENCES`; zero by default.
    drift : ndarray, shape (3,), optional
        Spectral density of an unknown acceleration in m2/s3 and rad2/s3, which links the swings.
    harmonics : Harmonics, optional
        Harmonics that were added to the measured load.
    """

    def __init__(
        self, forward: Forward, unknowns: Unknowns, window: Window, prior: tuple[Array, Array] | None = None,
        horizon: float = np.inf, differences: Array | None = None, drift: Array | None = None,
        harmonics: Harmonics | None = None,
    ) -> None:  # fmt: skip
        self.forward, self.unknowns, self.window, self.horizon = forward, unknowns, window, horizon
        self.mean, self.deviation = prior or (unknowns.nominal(), unknowns.deviations())
        self.differences = np.zeros(len(DIFFERENCES)) if differences is None else differences
        self.drift, self.harmonics = drift, harmonics
        #: factor on the steps of the difference quotients
        self.steps = 1.0
        #: prior deviation of a starting state, shape (6,), larger for components without measurements
        self.start_spread = tuning.START_SPREAD * np.tile(np.where(window.poses.measured, 1.0, tuning.ASSUMED), 2)
        self.link = np.zeros((0, 6, 6)) if drift is None else link_weights(np.diff(window.starts)[:-1], drift)
        self._memory: Memory | None = None
        self._columns: tuple[Point | None, Array] = None, np.zeros(0)
        self._waves: tuple[Point | None, Array] = None, np.zeros(0)
        self._scene: tuple[bytes, Scene] = b"", unknowns.scene
        self._at: _Rows | None = None

    def with_fine_steps(self) -> Problem:
        """Return a copy of the problem with small steps, and thus accurate derivatives."""
        fine = copy(self)
        fine.steps, fine._columns, fine._waves = _FINE, (None, np.zeros(0)), (None, np.zeros(0))
        return fine

    def having(self, **changes: Any) -> Problem:
        """Return a problem with other parts, which have the names of the parameters; the prior is that of the scene."""
        parts: dict[str, Any] = {name: getattr(self, name) for name in ("forward", "unknowns", "window", "horizon")}
        return Problem(**(parts | {"differences": self.differences} | changes))

    def at_times(self, t: Array) -> Problem:
        """Return the problem without measurements at the times `t`, (n,), with a sensor of no lever arm or low pass."""
        turns = self.differences[TURNS]
        window = Window(Poses(t, np.zeros((len(t), 3))), self.window.starts, self.window.states)
        return self.having(window=window, differences=np.append(turns, np.zeros(len(DIFFERENCES) - len(turns))))

    def evaluate(
        self, shared: Array, states: Array, differences: Array | None = None,
        change: Callable[[Scene], Scene] | None = None, load: Load | None = None, **acting: Array,
    ) -> Point | None:  # fmt: skip
        """Return the motion with the given unknowns; None if the motion leaves the range of the model.

        Parameters
        ----------
        shared, states : ndarray, shape (SIZE,), (s, 6)
            The unknowns.
        differences : ndarray, shape (7,), optional
            Values that replace the differences of the problem.
        change : callable, optional
            Function that returns a changed scene, which may need other compiled terms.
        load : Load, optional
            Load that replaces the load of the forward model.
        **acting : ndarray
            The arguments `push`, `stiffness` and `damping` of `Forward.run`.
        """
        motions = self._evaluate(shared, states[None], differences, change, load, **acting)
        return None if motions is None else motions[0]

    def _evaluate(
        self, shared: Array, several: Array, differences: Array | None = None,
        change: Callable[[Scene], Scene] | None = None, load: Load | None = None, **acting: Array,
    ) -> list[Point] | None:  # fmt: skip
        """Return the motions for k sets of starting states `several`, shape (k, s, 6), as `evaluate` does."""
        window, differences = self.window, self.differences if differences is None else differences
        rows = self._rows_at(float(shared[DELAY]) - float(np.sqrt(differences[LAG])))
        scene, forward = self._scene_of(shared), self.forward
        if change is not None:
            scene, forward = change(scene), forward.of(change(self.unknowns.scene))
        if load is not None:
            forward = forward.under(load)
        count, size = len(several), len(rows.asked)
        edges = (size * np.arange(count)[:, None] + rows.edges[:-1]).ravel()
        motions = forward.run(
            scene, shared[GAIN], np.tile(window.starts[:-1], count), several.reshape(-1, 6),
            np.append(edges, size * count), np.tile(rows.asked, count), depth_of(differences[TURNS]), **acting,
        )  # fmt: skip
        if motions is None:
            return None
        q, v = motions.q.reshape(count, size, 3), motions.v.reshape(count, size, 3)
        contact = motions.contact.reshape(count, window.swings, -1)
        return [self._point(shared, several[k], rows, q[k], v[k], contact[k], differences) for k in range(count)]

    def _rows_at(self, shift: float) -> _Rows:
        if self._at is None or self._at.shift != shift:
            window = self.window
            times = window.poses.t - shift
            swing = np.searchsorted(window.starts, times, side="right") - 1
            swing[swing >= window.swings] = -1
            swing[times - window.starts[np.maximum(swing, 0)] > self.horizon] = -1
            inside = np.flatnonzero(swing >= 0)
            # the rows of a swing are consecutive
            inner = np.searchsorted(swing[inside], np.arange(window.swings + 1)).astype(np.int64)
            requested, ends, edges = times[inside], np.zeros(0, np.int64), inner
            if len(self.link):  # each swing except the last is simulated up to the start of the next swing
                ends = edges[1:-1] + np.arange(len(self.link))
                requested = np.insert(requested, edges[1:-1], window.starts[1:-1])
                edges = edges + np.minimum(np.arange(window.swings + 1), len(self.link))
            self._at = _Rows(shift, swing, inside, times[inside], inner, requested, ends, edges)
        return self._at

    def _point(
        self, shared: Array, states: Array, rows: _Rows, q: Array, v: Array, contact: Array, differences: Array
    ) -> Point:
        """Return a point from poses and rates at the times `rows.asked`, as the sensor measures them."""
        window, lag = self.window, float(np.sqrt(differences[LAG]))
        at_ends = np.hstack((q[rows.ends], v[rows.ends]))
        if len(rows.ends):
            q, v = np.delete(q, rows.ends, axis=0), np.delete(v, rows.ends, axis=0)
        begin = states[:, :3], states[:, 3:]
        if differences[LEVER].any():
            q, v = moved_by_lever(q, v, differences[LEVER])
            begin = moved_by_lever(*begin, differences[LEVER])
        if lag:
            self._memory = self._memory or Memory(window.poses)
            memory = self._memory.at(window.starts[:-1] + rows.shift) - shared[BIAS]
            begin = np.ascontiguousarray(begin[0]), np.ascontiguousarray(begin[1])
            q, v = lagged(lag, rows.inner, window.starts[:-1], *begin, memory, rows.times, q, v)
        count = len(rows.swing)
        predicted, rate = np.full((count, 3), np.nan), np.zeros((count, 3))
        predicted[rows.inside], rate[rows.inside] = q, v
        residual = window.poses.q - predicted - shared[BIAS]
        defect = states[1 : len(rows.ends) + 1] - at_ends
        return Point(shared, states, rows.swing, predicted, residual, rate, contact, defect)

    def cost(self, point: Point, variance: Array) -> float:
        """Return twice the negative logarithm of the posterior, with Huber's function of the residuals.

        A measurement outside all swings contributes 1, the expected contribution of a measurement.
        """
        z = np.abs(point.residual) / np.sqrt(variance)
        loss = huber_loss(z)
        unpredicted = np.isnan(loss) & np.isfinite(self.window.poses.q)
        shift = (point.shared - self.mean) / self.deviation
        moved = (point.states - self.window.states) / self.start_spread
        linked = np.einsum("si,sij,sj->", point.defect, self.link, point.defect)
        return float(np.nansum(loss) + unpredicted.sum() + shift @ shift + (moved * moved).sum() + linked)

    def linearise(self, point: Point) -> Linear:
        """Return the Jacobians of the predicted measurements and of the ends of the swings."""
        rows, ends = np.zeros((len(point.residual), 3, SIZE + OWN)), np.zeros((len(point.defect), 6, SIZE + OWN))
        # only the latest scene is cached, so the derivatives that need the unchanged scene come first
        for displaced in (self.steps * _DISPLACED, -self.steps * _DISPLACED):
            together = self._evaluate(point.shared, point.states + np.diag(displaced)[:, None])
            if together is None:
                continue
            for j, other in enumerate(together):
                ends[:, :, SIZE + j] = point.defect - other.defect
                ends[:, j, SIZE + j] += displaced[j]  # `other` displaces the start of the next swing too
                ends[:, :, SIZE + j] /= displaced[j]
                rows[:, :, SIZE + j] = np.nan_to_num((point.residual - other.residual) / displaced[j])
            break
        for j in reversed(MOVING):
            if j != DAMPING or self.unknowns.damped:
                rows[:, :, j], ends[:, :, j] = self._quotient(point, j)
        rows[:, :, BIAS] = np.eye(3)
        rows[:, :, DELAY] = -point.rate
        return Linear(rows, ends)

    def _scene_of(self, shared: Array) -> Scene:
        key = shared[OF_SCENE].tobytes()
        if self._scene[0] != key:
            self._scene = key, self.unknowns.scene_of(shared)
        return self._scene[1]

    def by_differences(self, point: Point) -> Array:
        """Return the derivatives of the prediction with respect to the differences, shape (n, 3, 7).

        A derivative is zero if the motion cannot be simulated.
        """
        if self._columns[0] is not point:
            out = np.zeros((*point.residual.shape, len(DIFFERENCES)))
            resolved = self.window.poses.interval() <= RESOLVING
            for index, step in enumerate(self.steps * DIFFERENCE_STEPS[: None if resolved else LAG]):
                moved = self.differences.copy()
                moved[index] += step
                other = self.evaluate(point.shared, point.states, moved)
                if other is not None:
                    out[:, :, index] = np.nan_to_num((other.predicted - point.predicted) / step)
            self._columns = point, out
        return self._columns[1]

    def by_harmonics(self, point: Point, harmonics: Harmonics) -> Array:
        """Return the derivatives of the prediction with respect to the amplitudes of k harmonics, shape (n, 3, 3 k).

        A derivative is zero if the motion cannot be simulated.
        """
        if self._waves[0] is not point:
            load, size = harmonics.moved(-harmonics.amplitude).added(self.forward.load), harmonics.amplitude.size
            out = np.zeros((*point.residual.shape, size))
            unmoved, step = self.evaluate(point.shared, point.states, load=load), self.steps * _HARMONIC_STEP
            for index, unit in enumerate(np.eye(size).reshape(size, *harmonics.amplitude.shape)):
                wave = replace(harmonics, amplitude=step * unit).at(load.t)
                moved = replace(load, wrench=load.wrench + wave)
                other = self.evaluate(point.shared, point.states, load=moved)
                if unmoved is not None and other is not None:
                    out[:, :, index] = np.nan_to_num((other.predicted - unmoved.predicted) / step)
            self._waves = point, out
        return self._waves[1]

    def _quotient(self, point: Point, index: int) -> tuple[Array, Array]:
        step = QUANTITIES[index].step
        assert step is not None, "it moves the head"
        step *= self.steps
        for signed in (step, -step):
            moved = point.shared.copy()
            moved[index] += signed
            moved = self.unknowns.within(moved)
            change = moved[index] - point.shared[index]
            other = self.evaluate(moved, point.states) if abs(change) > 0.5 * step else None
            if other is not None:
                # a residual is measured minus predicted
                return np.nan_to_num((point.residual - other.residual) / change), (point.defect - other.defect) / change
        return np.zeros_like(point.residual), np.zeros_like(point.defect)


def unmoved_span(noise: Array, drift: Array) -> float:
    """Return the longest span in s in which white acceleration noise moves the head by no more than the noise."""
    return float(np.cbrt(3.0 * noise**2 / np.maximum(drift, _LEAST_DRIFT)).min())


def link_weights(spans: Array, drift: Array) -> Array:
    """Return the inverse covariance, (s, 6, 6), of pose and rate due to white acceleration noise over s spans."""
    drift = np.maximum(drift, _LEAST_DRIFT)
    weights = np.zeros((len(spans), 6, 6))
    place = np.arange(3)
    weights[:, place, place] = 12.0 / np.outer(spans**3, drift)
    weights[:, place, 3 + place] = weights[:, 3 + place, place] = -6.0 / np.outer(spans**2, drift)
    weights[:, 3 + place, 3 + place] = 4.0 / np.outer(spans, drift)
    return weights


def fit(
    problem: Problem, shared: Array, states: Array, noise: Array, iterations: int, enough: float = 0.3, seed: int = 0
) -> Fit | None:
    """Return the fit from given unknowns; None if their motion cannot be simulated.

    Parameters
    ----------
    problem : Problem
        The least-squares problem.
    shared, states : ndarray, shape (SIZE,), (s, 6)
        Starting values of the unknowns.
    noise : ndarray, shape (3,)
        First guess of the standard deviation of the measurements.
    iterations : int
        Largest number of iterations.
    enough : float
        Reduction of the cost below which the fit ends as converged.
    seed : int
        Seed of the random displacements that `unpredicted` uses.
    """
    point = problem.evaluate(problem.unknowns.within(shared), states)
    if point is None:
        return None
    damping, converged, done = 1e-3, False, 0
    linear = problem.linearise(point)
    jitter = unpredicted(problem, point, linear.rows, seed)
    while done < iterations and problem.forward.work < tuning.MOST_WORK[0]:
        done += 1
        noise = np.maximum(noise_of(point.residual, noise, jitter), problem.unknowns.noise)
        variance = noise**2 + tuning.JITTER_WEIGHT[0] * jitter
        point.cost = problem.cost(point, variance)
        normal, gradient = normal_equations(problem, point, linear, variance)
        trial, damping = _descend(problem, point, variance, normal, gradient, damping)
        if trial is None:
            converged = True
            break
        gained = point.cost - trial.cost
        point = trial
        linear = problem.linearise(point)
        if gained < enough:
            converged = True
            break
        jitter = unpredicted(problem, point, linear.rows, seed)
    noise = np.maximum(noise_of(point.residual, noise, jitter), problem.unknowns.noise)
    variance = noise**2 + tuning.JITTER_WEIGHT[0] * jitter
    point.cost = problem.cost(point, variance)
    normal, gradient = normal_equations(problem, point, linear, variance)
    factor = normal.factorised()
    newton_step = factor.solve(gradient)
    gain_left = float(gradient @ newton_step)
    return Fit(
        point, factor.covariance(), factor, noise, variance, jitter, linear, newton_step, gain_left, done, converged
    )


def pieces(problem: Problem, point: Point, linear: Linear, variance: Array) -> Iterator[list[Piece]]:
    """Yield for each swing the parts of the normal equations from its measurements and its link to the next swing."""
    z = np.abs(point.residual) / np.sqrt(variance)
    weight = np.nan_to_num(huber_weight(z) / variance) * np.isfinite(point.residual)
    weighted, residual = linear.rows * weight[:, :, None], np.nan_to_num(point.residual)
    # the rows of a swing are consecutive
    used = np.flatnonzero(point.swing >= 0)
    edges = np.searchsorted(point.swing[used], np.arange(problem.window.swings + 1))
    for index, (low, high) in enumerate(pairwise(edges.tolist())):
        inside = slice(used[low], used[high - 1] + 1) if low < high else slice(0)
        rows, own = linear.rows[inside].reshape(-1, SIZE + OWN), weighted[inside].reshape(-1, SIZE + OWN)
        found = [Piece(index, rows, own, residual[inside].ravel())]
        if index < len(problem.link):
            rows = np.hstack((-linear.ends[index], np.eye(OWN)))
            found.append(Piece(index, rows, problem.link[index] @ rows, -point.defect[index]))
        yield found


def normal_equations(problem: Problem, point: Point, linear: Linear, variance: Array) -> tuple[Arrow, Array]:
    """Return the matrix and the right-hand side of the normal equations, including the prior."""
    swings = problem.window.swings
    normal, gradient = Arrow.empty(SIZE, swings), np.zeros(SIZE + OWN * swings)
    for piece in chain.from_iterable(pieces(problem, point, linear, variance)):
        normal.add(piece.swing, piece.weighted.T @ piece.rows)
        right = piece.weighted.T @ piece.residual
        gradient[:SIZE] += right[:SIZE]
        gradient[piece.own] += right[SIZE:]
    gradient[:SIZE] += (problem.mean - point.shared) / problem.deviation**2
    gradient[SIZE:] += ((problem.window.states - point.states) / problem.start_spread**2).ravel()
    return normal.plus(
        np.concatenate([1.0 / problem.deviation**2, np.tile(1.0 / problem.start_spread**2, swings)])
    ), gradient


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Normal equations of a swing for b unknowns, from which its starting state has been eliminated.

    swing : index of the swing
    normal : (b, b) matrix, the information of the swing
    score : (b,) right-hand side
    state : (6,) step of the starting state if the b unknowns do not change
    gain : (b, 6) derivative of minus this step with respect to the steps of the b unknowns
    """

    swing: int
    normal: Array
    score: Array
    state: Array
    gain: Array


def eliminated(problem: Problem, result: Fit, columns: Array | None = None) -> Iterator[Eliminated]:
    """Yield the normal equations of each swing that has enough poses, without links between swings.

    Their unknowns are the shared unknowns and, with `columns` as in `joint_step`, further unknowns.
    """
    z = np.abs(np.nan_to_num(result.point.residual)) / np.sqrt(result.variance)
    weight = np.isfinite(result.point.residual) * huber_weight(z) / result.variance
    residual, rows = np.nan_to_num(result.point.residual), result.linear.rows
    border = rows[:, :, :SIZE] if columns is None else np.concatenate([rows[:, :, :SIZE], columns], axis=2)
    for swing in range(problem.window.swings):
        inside = result.point.swing == swing
        if inside.sum() < FEWEST_OF_SWING:
            continue
        shared, own = border[inside].reshape(-1, border.shape[2]), rows[inside][:, :, SIZE:].reshape(-1, OWN)
        weights = weight[inside].reshape(-1, 1)
        weighted_residual = (weights * residual[inside].reshape(-1, 1)).ravel()
        cross, held = (weights * shared).T @ own, (weights * own).T @ own
        held += np.diag(1e-6 + 1e-9 * np.diag(held))
        gain, score = np.linalg.solve(held, cross.T).T, own.T @ weighted_residual
        normal = (weights * shared).T @ shared - gain @ cross.T
        yield Eliminated(swing, normal, shared.T @ weighted_residual - gain @ score, np.linalg.solve(held, score), gain)


def scatter_ratio(
    scores: Array, precision: Array, inverse: Array, expected: Array, swings: int, unknowns: int = len(MOVING)
) -> float:
    """Return the variance of the shared unknowns from the scatter of k swings, divided by the variance `expected`.

    The ratio is averaged over all unknowns that move the head, because the ratio of a single unknown would be too
    random. A factor of at most `MOST_FREED` restores the scatter that is lost by fitting `unknowns` to `swings` swings.
    `scores`, shape (k, b), are right-hand sides of the normal equations, `precision`, shape (b,), the inverse variances
    of the prior, and `inverse` is that of the normal matrix.

    Reference: White, Econometrica 50 (1982) 1 (maximum likelihood of misspecified models).
    """
    scores = scores - scores.mean(axis=0)
    meat = scores.T @ scores * len(scores) / max(len(scores) - 1, 1) + np.diag(precision)
    restored = swings / max(swings - unknowns, swings / tuning.MOST_FREED)
    return restored * float((np.diag(inverse @ meat @ inverse) / expected)[list(MOVING)].mean())


def joint_step(
    problem: Problem, result: Fit, columns: Array, precision: Array, pull: Array
) -> tuple[Array, Array, Array]:
    """Return the linearised step of the unknowns, its covariance, and the step of the starting states.

    Parameters
    ----------
    problem, result : Problem, Fit
        The fit at which the problem is linearised.
    columns : ndarray, shape (n, 3, k)
        Derivatives of the prediction with respect to the k further unknowns.
    precision, pull : ndarray, shape (k,)
        Terms that the prior of the further unknowns adds to the matrix and to the right-hand side of the normal
        equations.

    Returns
    -------
    tuple of ndarray, shapes (SIZE + k,), (SIZE + k, SIZE + k), (s, 6)
        The step of a starting state is 0 in a swing with few poses.
    """
    normal = np.diag(np.concatenate([1.0 / problem.deviation**2, precision]))
    gradient = np.concatenate([(problem.mean - result.shared) / problem.deviation**2, pull])
    states, gains = np.zeros((problem.window.swings, OWN)), np.zeros((problem.window.swings, len(gradient), OWN))
    for swing in eliminated(problem, result, columns):
        normal += swing.normal
        gradient += swing.score
        states[swing.swing], gains[swing.swing] = swing.state, swing.gain
    covariance: Array = np.linalg.inv(normal)
    step = covariance @ gradient
    return step, covariance, states - step @ gains


def _descend(
    problem: Problem, point: Point, variance: Array, normal: Arrow, gradient: Array, damping: float
) -> tuple[Point | None, float]:
    """Return the point after a Levenberg-Marquardt step, and the damping for the next step.

    The point is None if no step reduces the cost.
    """
    scale = normal.diagonal()
    deviations = np.concatenate([problem.deviation, np.tile(problem.start_spread, problem.window.swings)])
    for _ in range(6):
        step = normal.plus(damping * scale).factorised().solve(gradient)
        step *= min(1.0, 1.0 / max(np.abs(step / deviations)[:SIZE].max(), 1e-12))
        step = np.clip(step, -deviations, deviations)
        shared = problem.unknowns.within(point.shared + step[:SIZE])
        trial = problem.evaluate(shared, point.states + step[SIZE:].reshape(-1, 6))
        if trial is not None:
            trial.cost = problem.cost(trial, variance)
            if trial.cost < point.cost:
                return trial, max(damping * 0.2, 1e-6)
        damping = max(damping * 8.0, 1e-3)
    return None, damping


def unpredicted(problem: Problem, point: Point, jacobian: Array, seed: int, probes: int = 3) -> Array:
    """Return the variance of the motion that the linearisation does not predict, shape (n, 3).

    Motions with small random displacements of the unknowns are compared with the prediction of the Jacobian. After
    several bounces at a hard contact, the difference is as large as the motion.
    """
    rng = np.random.default_rng(seed)
    total, count = np.zeros_like(point.residual), np.zeros_like(point.residual)
    inside = point.swing >= 0
    for _ in range(probes):
        states = tuning.PROBED_STATE * rng.standard_normal(point.states.shape)
        shared = problem.unknowns.within(point.shared + PROBES * rng.standard_normal(SIZE))
        other = problem.evaluate(shared, point.states + states)
        if other is None:
            continue
        change = np.zeros((len(inside), SIZE + OWN))
        change[:, :SIZE] = shared - point.shared
        change[inside, SIZE:] = states[point.swing[inside]]
        error = point.residual - other.residual - np.einsum("nij,nj->ni", jacobian, change)
        finite = np.isfinite(error)
        total[finite] += error[finite] ** 2
        count += finite
    return _spread(total / np.maximum(count, 1.0))


def _spread(variance: Array, reach: int = 2) -> Array:
    padded = np.pad(variance, ((reach, reach), (0, 0)), mode="edge")
    total = np.zeros_like(variance)
    for shift in range(2 * reach + 1):
        total += padded[shift : shift + len(variance)]
    return total / (2 * reach + 1)


def noise_of(residual: Array, previous: Array, jitter: Array) -> Array:
    """Return the standard deviation of each component, shape (3,), from the median of the absolute residuals."""
    out = previous.copy()
    for i, column in enumerate(residual.T):
        finite = np.isfinite(column)
        calm = finite & (jitter[:, i] < 0.1 * previous[i] ** 2)
        finite = calm if calm.sum() > 0.2 * finite.sum() else finite
        if finite.sum() > 10:
            out[i] = 1.4826 * np.median(np.abs(column[finite]))
    return np.maximum(out, 1e-9)
