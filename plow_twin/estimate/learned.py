"""Estimation of the members' parameters from the poses that move the members of a follower.

With a hard contact, an estimate hardly determines stiffness and load gains, which are therefore estimated from the
poses while the twin follows the machine. The method is similar to a two-stage Kalman filter (Friedland, IEEE Trans.
Autom. Control 14 (1969) 359):

1. The predicted poses of the members are regressed on their parameters. The slope is the sensitivity of a pose to the
parameters.
2. The residuals of the regression give the covariance of a prediction with known parameters.
3. The innovations (measured minus predicted poses) correct the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.unknowns import contact_numbers
from plow_twin.model.scene import Scene, variants

Array = NDArray[np.float64]

#: Lower bound on the number of members, as a multiple of the number of learned parameters plus one.
_MEMBERS: Final = 4
#: Upper bound on a restitution.
_MOST_RESTITUTION = 0.999


def numbers_of(scenes: Sequence[Scene], gain: Array, bias: Array) -> Array:
    """Return the parameters of m members in units of `tuning.LEARNED_TO`, shape (m, 10).

    The parameters are the logarithms of K^-1/2 and of the damping or restitution, two clearances, three load gains, and
    three biases of the sensor.
    """
    damping = [
        scene.contact.damping if scene.contact.restitution is None else scene.contact.restitution for scene in scenes
    ]
    raw = np.column_stack([
        [-0.5 * np.log(scene.contact.stiffness) for scene in scenes],
        [np.log(number) if number else 0.0 for number in damping],
        [scene.clearance.horizontal_m for scene in scenes],
        [scene.clearance.vertical_m for scene in scenes],
        gain,
        bias,
    ])  # fmt: skip
    numbers: Array = raw / np.array(tuning.LEARNED_TO)
    return numbers


def biases_of(numbers: Array) -> Array:
    """Return the biases of the sensor in m, m, rad, shape (..., 3), from the parameters of members, shape (..., 10)."""
    scaled: Array = (numbers * np.array(tuning.LEARNED_TO))[..., -3:]
    return scaled


def with_numbers(scenes: Sequence[Scene], numbers: Array) -> tuple[list[Scene], Array]:
    """Return the scenes and the load gains, shape (m, 3), of members with the parameters `numbers`, shape (m, 10)."""
    columns = np.ascontiguousarray((numbers * np.array(tuning.LEARNED_TO)).T)[:-3]
    softness, damping, horizontal, vertical, *gain = columns
    contact, number = scenes[0].contact, None
    if contact.restitution is not None:
        number = np.minimum(np.exp(damping), _MOST_RESTITUTION)
    elif contact.damping:
        number = np.exp(damping)
    changed = {
        "contact": contact_numbers(contact, np.exp(-2.0 * softness), number),
        "clearance": {"horizontal_m": horizontal, "vertical_m": vertical},
    }
    return variants(scenes, changed), np.stack(gain, axis=1)


class Learner:
    """Normal distribution of the machine's parameters given the poses, in units of `tuning.LEARNED_TO`.

    Only *learned* parameters are estimated from the poses.

    Parameters
    ----------
    drawn : ndarray, shape (m, 10)
        Parameters of the members as drawn from an estimate; the first row belongs to the median twin.
    open_columns : ndarray of int, shape (k,)
        Indices of the learned parameters.
    time : float
        Time of the estimate in s.
    """

    def __init__(self, drawn: Array, open_columns: NDArray[np.int64], time: float) -> None:
        self._all, self.open, self.time = drawn, open_columns, time
        own = drawn[:, open_columns]
        self._least, self._most = own.min(axis=0), own.max(axis=0)
        self.mean, self.covariance = own[0].copy(), np.cov(own.T).reshape(len(open_columns), -1)
        self._widest = np.sqrt(np.diag(self.covariance))
        # standardised differences of the members from the mean, zero for the median twin
        white = own - own.mean(axis=0)
        white[0] = 0.0
        self._white = white @ np.linalg.inv(np.linalg.cholesky(self.covariance)).T
        self._begin()

    @classmethod
    def of(cls, drawn: Array, time: float) -> Learner | None:
        """Return a learner of the parameters that have a standard deviation above one unit, or None."""
        varied = np.flatnonzero(drawn[1:].std(axis=0) > 1.0)
        enough = len(drawn) >= _MEMBERS * (len(varied) + 1)
        return cls(drawn, varied, time) if len(varied) and enough else None

    def _begin(self) -> None:
        self._precision, self._score = np.zeros((len(self.open), len(self.open))), np.zeros(len(self.open))

    def take_over(self, previous: Learner) -> None:
        """Combine the distribution with that of the previous learner, unless they contradict each other."""
        both, in_self, in_before = np.intersect1d(self.open, previous.open, return_indices=True)
        if not len(both):
            return
        covariance = previous.covariance[np.ix_(in_before, in_before)]
        difference = previous.mean[in_before] - self.mean[in_self]
        total = covariance + self.covariance[np.ix_(in_self, in_self)]
        if difference @ np.linalg.solve(total, difference) > tuning.OUTLYING**2:
            return
        gain = self.covariance[:, in_self] @ np.linalg.inv(total)
        self.mean = np.clip(self.mean + gain @ difference, self._least, self._most)
        self.covariance = self.covariance - gain @ self.covariance[in_self]

    def add(self, numbers: Array, measured_change: Array, difference: Array, noise: Array) -> None:
        """Add the information from a pose.

        Parameters
        ----------
        numbers : ndarray, shape (m, 10)
            Parameters of the members.
        measured_change : ndarray, shape (m, c)
            Predictions of the members, minus their mean.
        difference : ndarray, shape (c,)
            The pose minus the mean prediction.
        noise : ndarray, shape (c,)
            Standard deviation of the pose.
        """
        own = numbers[:, self.open]
        middle = own.mean(axis=0)
        apart = own - middle
        spread = np.linalg.inv(apart.T @ apart + 1e-6 * np.eye(len(self.open)))
        slope = spread @ (apart.T @ measured_change)
        scatter = measured_change - apart @ slope
        alone = scatter.T @ scatter / (len(own) - len(self.open) - 1)
        inverse = np.linalg.inv(alone + np.diag(noise**2))
        # subtract the information in the slope that is due to the random scatter of the members
        self._precision += slope @ inverse @ slope.T - spread * np.trace(inverse @ alone)
        self._score += slope @ inverse @ (difference - (self.mean - middle) @ slope)

    def learn(self, time: float) -> None:
        """Update the distribution with the information from poses since the last update."""
        root = np.linalg.cholesky(self.covariance)
        value, axes = np.linalg.eigh(tuning.LEARNING * root.T @ self._precision @ root)
        turned = root @ axes
        prior_deviation = np.sqrt(np.diag(self.covariance))
        self.covariance = (turned / (1.0 + value.clip(0.0))) @ turned.T
        step = tuning.LEARNING * (self.covariance @ self._score)
        # the linearisation is accurate within one standard deviation
        step /= max(1.0, float(np.abs(step / prior_deviation).max()))
        self.mean = np.clip(self.mean + step, self._least, self._most)
        # the deviations grow with time, because the machine changes
        deviation = np.sqrt(np.diag(self.covariance))
        wider = np.maximum(deviation, 1.0) * np.exp(0.5 * (time - self.time) / tuning.LEARNED_FOR)
        share = np.minimum(wider, self._widest) / deviation
        self.covariance = self.covariance * np.outer(share, share)
        self.time = time
        self._begin()

    def numbers(self, which: NDArray[np.int64]) -> Array:
        """Return the learned parameters of the members with the indices `which`, shape (k, 10)."""
        found = self._all[which].copy()
        own = self.mean + self._white[which] @ np.linalg.cholesky(self.covariance).T
        found[:, self.open] = np.clip(own, self._least, self._most)
        return found

    def state(self) -> Array:
        """Return the whole state as one array."""
        parts = (self.mean, self.covariance.ravel(), self._precision.ravel(), self._score, [self.time])
        return np.concatenate(parts)

    def set_state(self, state: Array) -> None:
        """Restore a state that `state` has returned."""
        count = len(self.open)
        ends = np.cumsum([count, count * count, count * count, count])
        mean, covariance, precision, score, (time,) = np.split(state, ends)
        self.mean, self._score, self.time = mean.copy(), score.copy(), float(time)
        self.covariance, self._precision = (matrix.reshape(count, count).copy() for matrix in (covariance, precision))
