"""Joint fit of poses and contact forces by Gauss-Newton steps, starting from the fit of the poses.

The unknowns are the shared unknowns, the delay of the forces, and the logarithm of the gain of each load cell. The
starting state of each swing (a part of the motion that begins in flight) is eliminated. A force that is hard to predict
has less weight, and Huber's function limits the influence of each force. The intervals are widened according to the
scatter of the scores of the swings (White 1982).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.contact_forces import Cells, ContactForces, ForcesOfFit, cells_of
from plow_twin.estimate.fit import Fit, Linear, Point, Problem, huber_loss, pieces, scatter_ratio
from plow_twin.estimate.measurements import FEWEST_FOR_SCATTER, FEWEST_IN_CONTACT
from plow_twin.estimate.result import Cell, ForcesUsed, Interval
from plow_twin.estimate.unknowns import DAMPING, MOVING, QUANTITIES, SIZE
from plow_twin.model.pairs import PAIR_NAMES

Array = NDArray[np.float64]

#: Upper bound on the number of rows, about 200 per second in a window of ten load periods.
_MOST_ROWS = 6000
#: Gauss-Newton iteration: upper bound on the number of steps, number of steps with random probes of the predictability,
#: number of these probes, and smallest reduction of the cost for a further step.
_ROUNDS, _DRAWN_ROUNDS, _PROBES, _ENOUGH = 8, 3, 3, 0.5
#: Steps of the two-sided difference quotients with respect to the delay in s and to a starting state. With the larger
#: one-sided steps of the fit of the poses, clearances were wrong by 4 standard deviations.
_DELAY_STEP = 2e-5
_STATE_STEPS = np.array([1e-5, 1e-5, 5e-5, 2e-4, 2e-4, 1.4e-3])


@dataclass(frozen=True, eq=False)
class JointFit:
    """Result of the joint fit of poses and contact forces.

    used : properties of the load cells, or the reason why the forces were not used
    shared : (SIZE,) shared unknowns; None if the forces were not used
    covariance : (SIZE, SIZE) covariance of the shared unknowns; None if the forces were not used
    model : reasons why the model is suspect
    sensor : reasons why the sensor is suspect
    """

    used: ForcesUsed
    shared: Array | None = None
    covariance: Array | None = None
    model: tuple[str, ...] = ()
    sensor: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Place:
    """Values of the unknowns, with the delay of the forces in s and the logarithms of the k gains."""

    shared: Array
    states: Array
    delay: float
    gain: Array


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Values of the unknowns, with the predicted motion and the predicted forces of the cells, shape (m,)."""

    place: _Place
    point: Point
    force: Array


@dataclass(frozen=True, eq=False)
class _Block:
    """Normal equations of a swing for the *border*, all unknowns except the starting states.

    normal : (b, b) matrix for the unknowns of the border
    score : (b,) right-hand side for the unknowns of the border
    state : (6,) step of the starting state if the border's unknowns do not change
    answer : (6, b) derivative of the starting state's step with respect to the steps of the border's unknowns
    root : (6, 6) Cholesky factor of the covariance of the starting state
    """

    normal: Array
    score: Array
    state: Array
    answer: Array
    root: Array

    @staticmethod
    def of(normal: Array, score: Array, border: int) -> _Block:
        held, cross = normal[border:, border:], normal[border:, :border]
        inverse = np.linalg.inv(held)
        answer = -inverse @ cross
        return _Block(
            normal[:border, :border] + cross.T @ answer,
            score[:border] + answer.T @ score[border:],
            inverse @ score[border:],
            answer,
            np.linalg.cholesky(inverse),
        )


def not_used(reason: str) -> JointFit:
    """Return the result without the forces, for the reason `reason`."""
    return JointFit(ForcesUsed(unused=reason))


def fit_jointly(problem: Problem, fitted: Fit, forces: ContactForces, widened: float) -> JointFit:
    """Return the joint fit of poses and forces. `widened` is a factor on the variance of the poses' noise."""
    if problem.unknowns.scene.contact.restitution is not None:
        return not_used("the law's damping follows from the speed of each touch")
    if len(problem.link):
        return not_used("the load is broad-band, so its swings are linked")
    if len(forces.t) < FEWEST_FOR_SCATTER:
        return not_used(f"got {len(forces.t)} messages in the window, expected at least {FEWEST_FOR_SCATTER}")
    forces = forces.thinned(_MOST_ROWS)
    forces_of_fit = ForcesOfFit(problem, forces.t)
    cells, against = cells_of(forces_of_fit, fitted, forces)
    if against:
        return replace(not_used("a cell contradicts the motion"), sensor=tuple(against))
    if cells is None:
        return not_used("the head touches no wall with a load cell")
    return _Joint(problem, fitted, forces_of_fit, cells, widened).solve()


class _Joint:
    """The fit of the poses, extended by measured forces. The force of one cell in one row is called an *entry*."""

    def __init__(self, problem: Problem, fitted: Fit, forces_of_fit: ForcesOfFit, cells: Cells, widened: float) -> None:
        self._problem, self._fit, self._forces_of_fit, self._cells = problem, fitted, forces_of_fit, cells
        self._variance = fitted.variance * widened
        self._border = SIZE + 1 + len(cells.pairs)
        gain, delay = (deviation**-2 for deviation in tuning.CELL_PRIOR)
        self._precision = np.concatenate([1.0 / problem.deviation**2, [delay], np.full(len(cells.pairs), gain)])

    def solve(self) -> JointFit:
        found, cells = self._fit, self._cells
        measured_force = self._forces_of_fit.at(found.shared, found.point.states, cells.delay)
        assert measured_force is not None  # `cells_of` has already simulated this motion
        near = np.isfinite(cells.force) & (measured_force.penetration > -2.0 * tuning.HEAD_ROOM)
        near[:, np.setdiff1d(np.arange(near.shape[1]), cells.pairs)] = False
        self._row, self._pair = np.nonzero(near)
        self._cell, self._swing = np.searchsorted(cells.pairs, self._pair), measured_force.swing[self._row]
        self._measured, self._jitter = cells.force[near], np.zeros(len(self._row))
        self._weigh(measured_force.force[near])
        at = self._evaluated(_Place(found.shared, found.point.states, cells.delay, np.zeros(len(cells.pairs))))
        if at is None:
            return not_used("the model cannot be run")
        linear, jacobian = self._linearised(at)
        for index in range(_ROUNDS):
            # the first probes are drawn from the uncertainty of the poses, later probes from the joint uncertainty
            if index < _DRAWN_ROUNDS:
                self._weigh(at.force)
                known = self._blocks(at, linear, jacobian if index else 0.0 * jacobian)
                self._jitter = self._unpredicted(at, jacobian, known)
            self._weigh(at.force)
            following = self._descended(at, self._blocks(at, linear, jacobian))
            if following is None:
                break
            gained, at = self._cost(at) - self._cost(following), following
            linear, jacobian = self._linearised(at)
            if gained < _ENOUGH and index >= _DRAWN_ROUNDS:
                break
        self._weigh(at.force)
        blocks = self._blocks(at, linear, jacobian)
        step, covariance = self._step(at, blocks)
        covariance = covariance * max(1.0, self._scatter(blocks, covariance)) + np.outer(step, step)
        return self._summary(at, covariance)

    def _weigh(self, force: Array) -> None:
        noise = self._cells.noise[self._pair]
        self._spread = (
            noise**2 + (tuning.LAW_ERROR * np.nan_to_num(force)) ** 2 + tuning.JITTER_WEIGHT[2] * self._jitter
        )

    def _force(self, place: _Place) -> Array | None:
        measured_force = self._forces_of_fit.at(place.shared, place.states, place.delay)
        if measured_force is None:
            return None
        force: Array = np.exp(place.gain[self._cell]) * measured_force.force[self._row, self._pair]
        return force

    def _evaluated(self, place: _Place) -> _Evaluation | None:
        point, force = self._problem.evaluate(place.shared, place.states), self._force(place)
        return None if point is None or force is None else _Evaluation(place, point, force)

    def _prior_offset(self, place: _Place) -> Array:
        """Return the prior means of the border's unknowns minus their present values."""
        late = self._cells.delay - place.delay
        return np.concatenate([self._problem.mean - place.shared, [late], -place.gain])

    def _cost(self, at: _Evaluation) -> float:
        z = np.abs(self._measured - at.force) / np.sqrt(self._spread)
        loss = huber_loss(z)
        offset = self._prior_offset(at.place)[SIZE:]
        prior = float(self._precision[SIZE:] @ offset**2)
        return self._problem.cost(at.point, self._variance) + float(np.nansum(loss) + np.isnan(loss).sum()) + prior

    def _linearised(self, at: _Evaluation) -> tuple[Linear, Array]:
        """Return the Jacobian of the poses, and that of the forces (m, b + 6) for the border and the starting state."""
        place, border = at.place, self._border
        out = np.zeros((len(self._row), border + 6))
        for j in MOVING:
            step = QUANTITIES[j].fine_step
            if step is not None and (j != DAMPING or self._problem.unknowns.damped):
                by = step * (np.arange(SIZE) == j)
                out[:, j] = self._quotient(place, step, shared=by)
        out[:, SIZE] = self._quotient(place, _DELAY_STEP, delay=_DELAY_STEP)
        out[np.arange(len(out)), SIZE + 1 + self._cell] = np.nan_to_num(at.force)
        for j, step in enumerate(_STATE_STEPS):
            by = step * (np.arange(6) == j)
            out[:, border + j] = self._quotient(place, step, states=by)
        return self._problem.linearise(at.point), out

    def _quotient(self, place: _Place, step: float, **by: Any) -> Array:
        """Return the central difference quotient of the forces for changes `by`; 0 if a motion cannot be simulated."""
        below, above = (
            replace(place, **{name: getattr(place, name) + sign * value for name, value in by.items()})
            for sign in (-1.0, 1.0)
        )
        one, other = self._force(below), self._force(above)
        if one is None or other is None:
            return np.zeros(len(self._row))
        out: Array = np.nan_to_num((other - one) / (2.0 * step))
        return out

    def _blocks(self, at: _Evaluation, linear: Linear, jacobian: Array) -> list[_Block]:
        border, out = self._border, []
        places = np.r_[0:SIZE, border : border + 6]
        residual = np.nan_to_num(self._measured - at.force)
        scale = np.sqrt(self._spread)
        weight = np.minimum(1.0, tuning.HUBER * scale / np.maximum(np.abs(residual), 1e-12)) / self._spread
        for piece, *_ in pieces(self._problem, at.point, linear, self._variance):
            inside = self._swing == piece.swing
            rows = jacobian[inside]
            weighted = weight[inside][:, None] * rows
            normal, score = weighted.T @ rows, weighted.T @ residual[inside]
            normal[np.ix_(places, places)] += piece.weighted.T @ piece.rows
            score[places] += piece.weighted.T @ piece.residual
            spread, moved = self._problem.start_spread, self._problem.window.states - at.place.states
            normal[border:, border:] += np.diag(spread**-2)
            score[border:] += moved[piece.swing] / spread**2
            out.append(_Block.of(normal, score, border))
        return out

    def _step(self, at: _Evaluation, blocks: list[_Block]) -> tuple[Array, Array]:
        """Return the step of the border, shape (b,), and its covariance."""
        normal = np.sum([block.normal for block in blocks], axis=0) + np.diag(self._precision)
        covariance: Array = np.linalg.inv(normal)
        pull = self._precision * self._prior_offset(at.place)
        score = np.sum([block.score for block in blocks], axis=0) + pull
        return covariance @ score, covariance

    def _descended(self, at: _Evaluation, blocks: list[_Block]) -> _Evaluation | None:
        cost, place = self._cost(at), at.place
        step, _ = self._step(at, blocks)
        states = np.stack([block.state + block.answer @ step for block in blocks])
        for share in (1.0, 0.5, 0.2):
            part = share * step
            other = self._evaluated(
                _Place(
                    self._problem.unknowns.within(place.shared + part[:SIZE]),
                    place.states + share * states,
                    place.delay + part[SIZE],
                    place.gain + part[SIZE + 1 :],
                )
            )
            if other is not None and self._cost(other) < cost:
                return other
        return None

    def _unpredicted(self, at: _Evaluation, jacobian: Array, blocks: list[_Block]) -> Array:
        """Return the variance of the forces, shape (m,), that the linearisation does not predict, by random probes."""
        rng, place, total = np.random.default_rng(0), at.place, np.zeros(len(at.force))
        root = np.linalg.cholesky(self._step(at, blocks)[1][:SIZE, :SIZE])
        for _ in range(_PROBES):
            border = np.zeros(self._border)
            border[:SIZE] = root @ rng.standard_normal(SIZE)
            states = np.stack([block.answer @ border + block.root @ rng.standard_normal(6) for block in blocks])
            force = self._force(replace(place, shared=place.shared + border[:SIZE], states=place.states + states))
            if force is not None:
                foretold = jacobian[:, : self._border] @ border
                foretold += np.einsum("mj,mj->m", jacobian[:, self._border :], states[self._swing])
                total += np.nan_to_num(force - at.force - foretold) ** 2
        return total / _PROBES

    def _scatter(self, blocks: list[_Block], covariance: Array) -> float:
        scores = np.stack([block.score for block in blocks])
        unknowns = self._border - (SIZE - len(MOVING))
        return scatter_ratio(scores, self._precision, covariance, np.diag(covariance), len(blocks), unknowns)

    def _summary(self, at: _Evaluation, covariance: Array) -> JointFit:
        cells, place = self._cells, at.place
        deviation, left_over = np.sqrt(np.diag(covariance)), self._left_over(at)
        cell_of_pair = {}
        for k, pair in enumerate(cells.pairs.tolist()):
            gain = Interval.normal(np.exp(place.gain[k]), np.exp(place.gain[k]) * deviation[SIZE + 1 + k])
            rows, share = int((self._cell == k).sum()), float(np.median(left_over[k])) if left_over[k] else 0.0
            offset, noise = float(cells.offset[pair]), float(cells.noise[pair])
            cell_of_pair[PAIR_NAMES[pair]] = Cell(rows, gain, offset, noise, share)
        used = ForcesUsed(cell_of_pair, Interval.normal(place.delay, deviation[SIZE]))
        all_shares = [share for shares in left_over for share in shares]
        together = float(np.median(all_shares)) if all_shares else 0.0
        most, most_together = tuning.MOST_LEFT_OVER
        if together > most_together:
            used = replace(used, unused="the law gives other forces")
            reason = f"contact forces: {together:.1%} of them remain unexplained, expected at most {most_together:.0%}"
            return JointFit(used, model=(reason,))
        bad = tuple(
            f"contact forces: {name}: {cell.left_over:.0%} remain unexplained, expected at most {most:.0%}"
            for name, cell in cell_of_pair.items()
            if cell.left_over > most
        )
        if bad:
            return JointFit(replace(used, unused="a cell contradicts the motion"), sensor=bad)
        unfitted = self._unfitted(at)
        if unfitted:
            return JointFit(replace(used, unused=f"{unfitted} of {self._problem.window.swings} swings are not fitted"))
        return JointFit(used, place.shared, covariance[:SIZE, :SIZE])

    def _unfitted(self, at: _Evaluation) -> int:
        """Return the number of swings whose forces do not fit because of a false optimum of the starting state."""
        z = (self._measured - at.force) ** 2 / self._spread
        z, swing = z[np.isfinite(z)], self._swing[np.isfinite(z)]
        count, total = np.bincount(swing), np.bincount(swing, z)
        return int((total > tuning.MOST_MISFIT * np.maximum(count, 1)).sum())

    def _left_over(self, at: _Evaluation) -> list[list[float]]:
        out: list[list[float]] = []
        residual, finite = self._measured - at.force, np.isfinite(at.force)
        for k, pair in enumerate(self._cells.pairs.tolist()):
            out.append([])
            variance = float(self._cells.noise[pair]) ** 2
            for swing in range(self._problem.window.swings):
                inside = finite & (self._cell == k) & (self._swing == swing)
                square = float((at.force[inside] ** 2).mean()) if inside.sum() >= FEWEST_IN_CONTACT else 0.0
                if square > tuning.OUTLYING**2 * variance:
                    beyond = max(float((residual[inside] ** 2).mean()) - variance, 0.0)
                    out[-1].append(float(np.sqrt(beyond / square)))
        return out
