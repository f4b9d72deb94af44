"""Clearances from gap sensors, independent of the contact law, and poses if no poses are measured.

A gap is linear in the clearances and in the head's body coordinates (`model/geometry.py`). A message with gaps of five
pairs, or of four if theta is measured, determines clearances and pose by least squares. The constant errors of the
sensors limit the accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import PlowTwinError
from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import FEWEST_POSES, Poses, usable_rows
from plow_twin.estimate.result import Interval
from plow_twin.model.geometry import penetration_rows
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y, PAIR_NAMES
from plow_twin.model.scene import Clearance, Scene

Array = NDArray[np.float64]

#: Largest distance [m] that is accepted as a gap, a guard against faulty readings.
_LARGEST = 1e3
#: Upper bound on the number of iterations for the nonlinear equations.
_ROUNDS = 4
#: Lower bound on a singular value of the equations, below which the sensors do not determine an unknown.
_SINGULAR = 1e-6
#: Definition of the groups of two facing pads, whose gaps determine a clearance.
GROUPS: Final = {
    "horizontal_top": (1, 3),
    "horizontal_bottom": (7, 5),
    "vertical_left": (0, 6),
    "vertical_right": (2, 4),
}


class GapsError(PlowTwinError):
    """The gaps have the wrong shape."""


@dataclass(frozen=True, eq=False)
class Gaps:
    """Measured gaps.

    t : (n,) strictly increasing stamps in s
    gap : (n, 8) gap of each pair in m, NaN without a measurement
    deviation : stated standard deviation of the constant error of a sensor in m, 0 if not stated
    """

    t: Array
    gap: Array
    deviation: float = 0.0

    @staticmethod
    def of(t: ArrayLike, gap: ArrayLike, deviation: float = 0.0) -> tuple[Gaps, int]:
        """Return the usable rows in order of time, and the number of rows that are left out.

        A row is left out if its stamp is not finite or repeated, or if it contains no gap or a gap above 1e3 m.

        Raises
        ------
        GapsError
            If an array has the wrong shape.
        """
        times, rows, left_out = usable_rows(t, gap, _LARGEST, ("gaps", "gap"), GapsError)
        return Gaps(times, rows, deviation), left_out

    def between(self, start: float, end: float) -> Gaps:
        """Return the rows with stamps in [start, end)."""
        inside = (self.t >= start) & (self.t < end)
        return replace(self, t=self.t[inside], gap=self.gap[inside])


@dataclass(frozen=True, eq=False)
class GapsFit:
    """Clearances and poses computed from measured gaps.

    poses : poses computed from the gaps; empty if theta was taken from measured poses
    clearance : (2,) horizontal and vertical clearance in m
    deviation : (2,) standard deviations of the clearances in m
    groups : clearance of each group of facing pads with sensors
    used : number of messages that were used
    contradiction : largest mean residual of a sensor in units of its constant error; 0 if no sensor is redundant
    """

    poses: Poses
    clearance: Array
    deviation: Array
    groups: dict[str, Interval]
    used: int
    contradiction: float


def fit_gaps(scene: Scene, gaps: Gaps, poses: Poses) -> GapsFit | str:
    """Return the fit of clearances and poses to gaps, or a message why there is no fit.

    If the gaps do not determine theta, it is taken from `poses`. The most frequent set of sensors that determines the
    unknowns is used. It must occur in at least 20 messages.
    """
    error = gaps.deviation or tuning.CONSTANT_ERROR
    rows = penetration_rows(replace(scene, clearance=Clearance(0.0, 0.0)))
    theta = _theta_at(gaps.t, poses)
    fits: list[GapsFit] = []
    unused = "gaps: got no message within the load's span"
    finite = np.isfinite(gaps.gap)
    sets, counts = np.unique(finite, axis=0, return_counts=True)
    for pairs in sets[np.argsort(counts, kind="stable")]:
        own = (finite == pairs).all(axis=1)
        gap_fit = _fit_one_set(
            rows, gaps.t[own], gaps.gap[own][:, pairs], np.flatnonzero(pairs), theta[own], error, scene
        )
        if isinstance(gap_fit, str):
            unused = gap_fit
        else:
            fits.append(gap_fit)
    return max(fits, key=lambda fit: fit.used, default=unused)


def _theta_at(t: Array, poses: Poses) -> Array:
    finite = np.isfinite(poses.q[:, 2]) if len(poses.t) else np.zeros(0, bool)
    if not finite.any():
        return np.full(len(t), np.nan)
    at = poses.t[finite]
    theta: Array = np.interp(t, at, poses.q[finite, 2], left=np.nan, right=np.nan)
    return theta


def _fit_one_set(
    rows: Array, t: Array, gap: Array, pairs: NDArray[np.int64], theta: Array, error: float, scene: Scene
) -> GapsFit | str:
    """Return the fit to n messages with the same k sensors, or a message why there is no fit.

    `gap`, shape (n, k), contains the gaps of the pairs with the indices `pairs`, shape (k,).
    """
    names = ", ".join(PAIR_NAMES[pair] for pair in pairs)
    # gap of a pair: half the clearance minus the reach of its corner
    half = 0.5 * np.abs(np.stack([NORMAL_X, NORMAL_Y], axis=1))[pairs]
    fixed = np.concatenate([-rows[2:4, pairs].T, half], axis=1)
    with_turn = np.concatenate([fixed, -rows[1, pairs][:, None]], axis=1)
    turns = bool(np.linalg.matrix_rank(with_turn, _SINGULAR) == 5)
    if not turns:
        if np.linalg.matrix_rank(fixed, _SINGULAR) < 4:
            return f"gaps: got sensors at {names}, expected five pairs that determine theta, or one pair at each wall"
        good = np.isfinite(theta)
        t, gap, theta = t[good], gap[good], theta[good]
    if len(t) < FEWEST_POSES:
        beside = "" if turns else " while theta was measured"
        return f"gaps: got {len(t)} messages of {names}{beside}, expected at least {FEWEST_POSES}"
    unknown = np.zeros((len(t), 5))
    unknown[:, 4] = 0.0 if turns else theta
    equations = with_turn if turns else fixed
    inverse = np.linalg.pinv(equations)
    residual = np.zeros_like(gap)
    for _ in range(_ROUNDS):
        # the derivatives at theta = 0 suffice for a small theta
        c, s = np.cos(unknown[:, 4]), np.sin(unknown[:, 4])
        reach = c[:, None] * rows[0, pairs] + s[:, None] * rows[1, pairs] + rows[4, pairs]
        residual = gap - (unknown[:, :4] @ fixed.T - reach)
        unknown[:, : equations.shape[1]] += residual @ inverse.T
    x, y = _displacement(unknown, scene)
    clearance = np.median(unknown[:, 2:4], axis=0)
    # averaging does not reduce the constant errors of the sensors
    spread = error * np.sqrt((inverse[2:4] ** 2).sum(axis=1))
    noise = unknown[:, 2:4].std(axis=0) / np.sqrt(len(t))
    q = np.stack([x, y, unknown[:, 4]], axis=1)
    poses = Poses(t, q) if turns else Poses(t[:0], q[:0])
    groups = {
        name: Interval.normal(
            float(np.median(_between(rows, t, gap, pairs, pair, unknown[:, 4]))), np.sqrt(2.0) * error
        )
        for name, pair in GROUPS.items()
        if np.isin(pair, pairs).all()
    }
    bias = np.abs(residual.mean(axis=0)).max() / error if len(pairs) > equations.shape[1] else 0.0
    return GapsFit(poses, clearance, np.hypot(spread, noise), groups, len(t), float(bias))


def _displacement(unknown: Array, scene: Scene) -> tuple[Array, Array]:
    """Return x and y in m, shape (n,) each, from body coordinates and theta."""
    c, s = np.cos(unknown[:, 4]), np.sin(unknown[:, 4])
    across, up = (unknown[:, :2] - scene.head.com_offset_m).T
    return c * across - s * up, s * across + c * up


def _between(rows: Array, t: Array, gap: Array, pairs: NDArray[np.int64], pair: tuple[int, int], theta: Array) -> Array:
    """Return the clearance in m between the two facing pads of `pair` from each message, shape (n,)."""
    first, second = (gap[:, int(np.flatnonzero(pairs == index)[0])] for index in pair)
    both = rows[:, list(pair)].sum(axis=1)
    clearance: Array = first + second + np.cos(theta) * both[0] + np.sin(theta) * both[1] + both[4]
    return clearance
