"""Fit of poses in which one or two components were never measured.

If a component is missing, the range of motion gives no starting point for the clearances. In a soft contact, the load
alone determines the motion after some periods. The fit has these steps:

1. Vectors of unknowns are drawn from the prior, and their motions are compared with the measured components.
2. Levenberg-Marquardt steps improve the vectors with the nearest motions.
3. The poses are divided into swings, which begin in flight, with missing components from the motions of step 2.
4. A fit with swings that are linked to each other uses only the measured values.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import Fit, Problem, huber_loss, huber_weight
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import Poses, filled
from plow_twin.estimate.search import refine
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.unknowns import BIAS, DELAY, GAIN, QUANTITIES, SIZE, SOFTNESS, Unknowns
from plow_twin.model import geometry

Array = NDArray[np.float64]

#: Steps of the difference quotients with respect to all unknowns. The steps for biases and delay are 1e-3 in SI units.
_STEPS: Final = np.array([quantity.step or 1e-3 for quantity in QUANTITIES])
#: Upper bound on the number of times that a step is shortened.
_SHORTER: Final = 5


class _Simulation:
    """Simulation of the first `rows` poses from one start, and its distance from the measured components."""

    def __init__(self, forward: Forward, unknowns: Unknowns, poses: Poses, period: float) -> None:
        self.forward, self.unknowns, self.poses = forward, unknowns, poses
        self.measured = poses.measured
        self.size = np.where(self.measured, filled(poses).std(axis=0), 1.0)
        self.noise = np.where(self.measured, np.maximum(noise_level(filled(poses)), 1e-7), 1.0)
        #: poses after the first period, which hardly depend on the unknown start
        self._settled = poses.t - poses.t[0] >= period
        self._start = np.concatenate([filled(poses)[0], np.zeros(3)])[None]
        #: indices of the unknowns that the measured components can determine
        self.free = np.flatnonzero(np.concatenate([np.ones(BIAS.start), self.measured, np.ones(SIZE - BIAS.stop)]))
        self.mean, self.deviation = unknowns.nominal(), unknowns.deviations()

    def motion(self, vector: Array, rows: int) -> Array | None:
        """Return the poses for a vector of unknowns, without bias, shape (n, 3); None if they cannot be simulated."""
        vector = self.unknowns.within(vector)
        t = self.poses.t[:rows] - vector[DELAY]
        scene = self.unknowns.scene_of(vector)
        run = self.forward.run(scene, vector[GAIN], t[:1], self._start, np.array([0, rows]), t)
        return None if run is None else run.q

    def residual(self, vector: Array, rows: int) -> Array | None:
        """Return measured minus predicted values of k components, shape (n, k); None without a motion."""
        q = self.motion(vector, rows)
        if q is None:
            return None
        error = self.poses.q[:rows] - q - vector[BIAS]
        return np.asarray(np.nan_to_num(error[self._settled[:rows]][:, self.measured]))

    def centred(self, vector: Array, rows: int) -> tuple[float, Array] | None:
        """Return misfit and vector after the mean residual has been added to the bias of the vector."""
        error = self.residual(vector, rows)
        if error is None:
            return None
        vector = vector.copy()
        vector[BIAS][self.measured] += error.mean(axis=0)
        residual = (error - error.mean(axis=0)) / self.size[self.measured]
        return float(np.minimum(residual**2, 1.0).mean()), vector

    def descend(self, vector: Array, rows: int, scale: Array) -> tuple[Array, float]:
        """Return an improved vector and its cost; `scale`, shape (3,), is the unit of the residuals."""
        residual, damping = self._normalised(vector, rows, scale), 1e-2
        if residual is None:
            return vector, np.inf
        for _ in range(tuning.UNMEASURED_STEPS):
            better, damping = self._better(vector, residual, rows, scale, damping)
            if better is None:
                break
            gained = self._cost(residual) - self._cost(better[1])
            vector, residual = better
            if gained < tuning.ENOUGH:
                break
        return vector, self._cost(residual)

    def _better(
        self, vector: Array, residual: Array, rows: int, scale: Array, damping: float
    ) -> tuple[tuple[Array, Array] | None, float]:
        free, spread = self.free, self.deviation[self.free]
        normal, gradient = self._equations(vector, residual, rows, scale)
        for _ in range(_SHORTER):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial = vector.copy()
            trial[free] -= np.clip(step, -spread, spread)
            trial = self.unknowns.within(trial)
            improved = self._normalised(trial, rows, scale)
            if improved is not None and self._cost(improved) < self._cost(residual):
                return (trial, improved), max(0.2 * damping, 1e-6)
            damping = max(8.0 * damping, 1e-3)
        return None, damping

    def _normalised(self, vector: Array, rows: int, scale: Array) -> Array | None:
        """Return the residuals in units of `scale`, and those of the prior; None without a motion."""
        error = self.residual(vector, rows)
        prior = ((vector - self.mean) / self.deviation)[self.free]
        return None if error is None else np.concatenate([(error / scale[self.measured]).ravel(), prior])

    def _cost(self, normalised: Array) -> float:
        error, prior = np.split(normalised, [-len(self.free)])
        return float(huber_loss(np.abs(error)).sum() + np.square(prior).sum())

    def _equations(self, vector: Array, residual: Array, rows: int, scale: Array) -> tuple[Array, Array]:
        columns = np.zeros((len(residual), len(self.free)))
        for place, index in enumerate(self.free):
            moved = vector.copy()
            moved[index] += _STEPS[index]
            moved_residual = self._normalised(moved, rows, scale)
            if moved_residual is not None:
                columns[:, place] = (moved_residual - residual) / _STEPS[index]
            else:  # the moved motion cannot be simulated, so only the prior acts on this unknown
                columns[place - len(self.free), place] = 1.0 / self.deviation[index]
        weight = np.append(huber_weight(np.abs(residual[: -len(self.free)])), np.ones(len(self.free)))
        return columns.T @ (weight[:, None] * columns), columns.T @ (weight * residual)


def fit_some_components(
    forward: Forward, unknowns: Unknowns, poses: Poses, period: float, drift: Array
) -> tuple[Problem, Fit] | None:
    """Return a fit of poses in which one or two components were never measured; None if no motion is near the poses.

    Parameters
    ----------
    forward, unknowns : Forward, Unknowns
        Forward model under the measured load, and prior.
    poses : Poses
        The measured poses, with NaN for the components that were never measured.
    period : float
        Period of the load in s.
    drift : ndarray, shape (3,)
        Spectral density of an unknown acceleration, in m2/s3 and rad2/s3, which links the swings.
    """
    rng = np.random.default_rng(0)
    whole = _Simulation(forward, unknowns, poses, period)
    end = float(poses.t[0]) + tuning.FIRST_PERIODS * period
    noise = np.where(whole.measured, whole.noise, _like_measured(whole))

    def refined(shared: Array, end: float, previous: Fit | None = None) -> tuple[Problem, Fit] | None:
        q = whole.motion(shared, len(poses.t))
        if q is None:
            return None
        if previous is not None:
            predicted = previous.point.predicted
            q[: len(predicted)] = np.where(np.isfinite(predicted), predicted, q[: len(predicted)])
        # the division into swings compares poses with their noise
        q = q + shared[BIAS] + np.where(whole.measured, 0.0, noise) * rng.standard_normal(q.shape)
        some = replace(poses, assumed=q).between(float(poses.t[0]), end)
        return refine(forward.renewed(), unknowns, some, period, shared, noise, drift, close=True)

    def finished(candidate: tuple[Problem, Fit], end: float) -> tuple[Problem, Fit]:
        # each repetition has better values of the missing components
        for _ in range(tuning.UNMEASURED_ROUNDS):
            # the losses of two rounds do not compare, because their missing components have different random noise
            improved = None if candidate[1].finished else refined(candidate[1].shared, end, candidate[1])
            if improved is None:
                break
            candidate = improved
        return candidate

    candidates = [refined(vector, end) for vector in _starts(whole, int(np.searchsorted(poses.t, end)), rng)]
    best = min((one for one in candidates if one is not None), key=lambda one: one[1].loss, default=None)
    if best is None:
        return None
    refined_fit = refined(finished(best, end)[1].shared, np.inf)
    return None if refined_fit is None else finished(refined_fit, np.inf)


def _starts(whole: _Simulation, rows: int, rng: np.random.Generator) -> list[Array]:
    drawn, (draws, improved, kept) = [], tuning.UNMEASURED_DRAWS
    for _ in range(draws):
        vector = whole.mean + whole.deviation * rng.standard_normal(SIZE)
        vector[BIAS], vector[DELAY] = 0.0, 0.0
        vector[SOFTNESS] = np.log(np.exp(rng.uniform(*np.log(tuning.UNMEASURED_DEPTHS))) + tuning.RESOLVED)
        found = whole.centred(whole.unknowns.within(vector), rows)
        if found is not None:
            drawn.append(found)
    drawn.sort(key=lambda one: one[0])
    better = []
    for _, vector in drawn[:improved]:
        cost = np.inf
        for share in tuning.UNMEASURED_SCALES:
            vector, cost = whole.descend(vector, rows, np.maximum(share * whole.size, whole.noise))
        better.append((cost, vector))
    return [vector for _, vector in sorted(better, key=lambda one: one[0])[:kept]]


def _like_measured(whole: _Simulation) -> Array:
    """Return the noise of all components in m, m, rad. Missing components have the mean noise of the others."""
    arm = geometry.half_diagonal(whole.unknowns.scene)
    level = float((whole.noise * [1.0, 1.0, arm])[whole.measured].mean())
    return level * np.array([1.0, 1.0, 1.0 / arm])
