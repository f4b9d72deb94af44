"""Contact forces measured by load cells at the guides, which narrow the intervals of contact parameters and clearances.

The fit of the poses gives the motion, and the contact law gives the force of each pair. If a load cell contradicts the
force of its pair, the measured forces are not used. If there is no contradiction, the module `force_fit` fits poses and
forces together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import PlowTwinError
from plow_twin.estimate import tuning
from plow_twin.estimate.fit import TURNS, Fit, Problem, depth_of
from plow_twin.estimate.measurements import FEWEST_IN_CONTACT, FEWEST_POSES, usable_rows
from plow_twin.estimate.reason import FORCE, Reason
from plow_twin.estimate.unknowns import BIAS, DELAY
from plow_twin.model.contact import free_force
from plow_twin.model.geometry import body_states, penetration_rows
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.solve.compiled_scene import compile_scene

Array = NDArray[np.float64]

#: Largest force [N] that is accepted, a guard against faulty readings.
_LARGEST = 1e12
#: Largest trial value for the delay of the load cells in s (three prior deviations), and step between trial values.
_LARGEST_DELAY, _DELAY_STEP = 0.15, 2e-3
#: The contact law as a Python function.
_LAW = getattr(free_force, "py_func", free_force)


class ContactForcesError(PlowTwinError):
    """The contact forces have the wrong shape."""


@dataclass(frozen=True, eq=False)
class ContactForces:
    """Measured contact forces.

    t : (n,) rising stamps in s
    force : (n, 8) force of each pair in N, NaN without a measurement
    """

    t: Array
    force: Array

    @staticmethod
    def of(t: ArrayLike, force: ArrayLike) -> tuple[ContactForces, int]:
        """Return the usable rows in order of time, and the number of rows that are left out.

        A row is left out if its stamp is not finite or repeated, or if it contains no force or a force above 1e12 N.

        Raises
        ------
        ContactForcesError
            If an array has the wrong shape.
        """
        times, rows, left_out = usable_rows(t, force, _LARGEST, ("contact forces", "force"), ContactForcesError)
        return ContactForces(times, rows), left_out

    def between(self, start: float, end: float) -> ContactForces:
        """Return the rows with stamps in [start, end)."""
        inside = (self.t >= start) & (self.t < end)
        return ContactForces(self.t[inside], self.force[inside])

    def thinned(self, most: int) -> ContactForces:
        """Return every n-th row, with the smallest n for which at most `most` rows remain."""
        apart = max(1, -(-len(self.t) // most))
        return ContactForces(self.t[::apart], self.force[::apart])


@dataclass(frozen=True, eq=False)
class FittedForces:
    """Penetration and contact force of the fitted motion at the times of the measured forces.

    swing : (n,) index of the swing of each row, -1 outside all swings
    penetration : (n, 8) penetration of each pair in m, NaN outside all swings
    force : (n, 8) force of each pair in N, NaN outside all swings
    """

    swing: NDArray[np.int64]
    penetration: Array
    force: Array


@dataclass(frozen=True, eq=False)
class Cells:
    """Load cells that measure forces in agreement with the motion.

    pairs : (k,) indices of the pairs of these cells
    force : (n, 8) measured forces minus `offset` in N
    offset : (8,) median reading during flight in N
    noise : (8,) standard deviation in N
    delay : delay in s of the stamps relative to the motion
    """

    pairs: NDArray[np.int64]
    force: Array
    offset: Array
    noise: Array
    delay: float


class ForcesOfFit:
    """Contact forces from the motion of a fit, at the times of the measured forces."""

    def __init__(self, problem: Problem, t: Array) -> None:
        self._problem, self._depth = problem.at_times(t), depth_of(problem.differences[TURNS])

    def at(self, shared: Array, states: Array, delay: float) -> FittedForces | None:
        """Return penetrations and forces for given unknowns and a delay [s]; None if the motion cannot be simulated."""
        own = shared.copy()
        own[BIAS], own[DELAY] = 0.0, delay
        point = self._problem.evaluate(own, states)
        if point is None:
            return None
        penetration, force = forces_at(
            self._problem.unknowns.scene_of(shared), -point.residual, point.rate, self._depth
        )
        force[point.swing < 0] = np.nan
        return FittedForces(point.swing, penetration, force)


def forces_at(scene: Scene, q: Array, v: Array, depth: Array | None = None) -> tuple[Array, Array]:
    """Return the penetrations in m and the forces in N, shape (n, 8) each, for poses and rates of shape (n, 3).

    `depth`, shape (8,), contains the outward displacement of each pad in m. The scene must state a damping, not a
    restitution.
    """
    x, y, vx, vy, omega, c, s, _ = body_states(np.hstack((q, v)), scene.head.com_offset_m).T
    rows = penetration_rows(scene)
    penetration = np.stack([c, s, x, y], axis=1) @ rows[:4] + rows[4] - (0.0 if depth is None else depth)
    rate = np.stack([-omega * s, omega * c, vx + omega * y, vy - omega * x], axis=1) @ rows[:4]
    params = compile_scene(scene, tuning.TOLERANCE, sampled=True).params
    viscous = float(params["viscous"])
    factor = 0.0 if viscous else float(scene.contact.damping or 0.0)
    numbers = float(params["stiffness"]), float(params["exponent"]), factor, viscous, float(params["ramp"])
    force, inside = np.zeros(penetration.shape), penetration > 0.0
    linear = numbers[1] == 1.0 and not numbers[-1]  # a law that is not linear, or has a ramp, accepts no arrays
    law = _LAW if linear else np.vectorize(_LAW, otypes=[np.float64])
    force[inside] = np.maximum(law(penetration[inside], rate[inside], *numbers), 0.0)
    return penetration, force


def cells_of(forces_of_fit: ForcesOfFit, solution: Fit, forces: ContactForces) -> tuple[Cells | None, list[str]]:
    """Return the usable cells, or None without any, and a reason for each cell that contradicts the motion."""
    fitted = forces_of_fit.at(solution.shared, solution.point.states, 0.0)
    if fitted is None:
        return None, []
    delay = _delay(forces, fitted)
    fitted = forces_of_fit.at(solution.shared, solution.point.states, delay)
    if fitted is None:
        return None, []
    offset, noise = np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT)
    for i in range(PAIR_COUNT):
        column = forces.force[:, i]
        flight = column[(fitted.penetration[:, i] < -tuning.HEAD_ROOM) & np.isfinite(column)]
        if len(flight) >= FEWEST_POSES:
            offset[i] = np.median(flight)
            noise[i] = 1.4826 * np.median(np.abs(flight - offset[i]))
    measured = forces.force - offset
    found_out, pairs = list[str](), list[int]()
    largest = float(np.nanmax(fitted.force))
    # the resolution of a cell limits its noise
    noise = np.maximum(noise, 1e-4 * largest)
    for i, name in enumerate(PAIR_NAMES):
        finite = np.isfinite(measured[:, i]) & (fitted.swing >= 0)
        if not finite.any():
            continue
        reason = _contradiction(measured[finite], fitted.force[finite], i, largest, float(noise[i]))
        if reason:
            found_out.append(reason.after(f"contact forces: {name}: "))
        elif (fitted.force[finite, i] > 0.0).sum() >= FEWEST_IN_CONTACT:
            pairs.append(i)
    if not (found_out or pairs):
        return None, []
    return Cells(np.array(pairs, np.int64), measured, offset, noise, delay), found_out


def _contradiction(measured: Array, fitted: Array, pair: int, largest: float, noise: float) -> Reason | None:
    """Return why a cell contradicts the motion, or None.

    `measured` and `fitted` contain the measured forces and the forces of the fitted motion in N, shape (n, 8) each.
    """
    own = fitted[:, pair]
    if (own > 0.0).sum() < FEWEST_IN_CONTACT:
        most = float(np.abs(measured[:, pair]).max())
        silent = most <= tuning.CELL_SHARE * largest + 6 * noise
        return None if silent else Reason("{:.3g} N where the motion gives no contact", (most, FORCE))
    value = measured[:, pair]
    ends = np.flatnonzero(np.append(np.diff(value) != 0.0, True))
    for first, end in zip(np.append(0, ends[:-1] + 1), ends + 1, strict=True):
        if end - first >= tuning.STUCK[0] and np.ptp(own[first:end]) > max(tuning.CELL_SHARE * own.max(), 6.0 * noise):
            return Reason(
                f"the same value {end - first} times in a row, while the motion's force changes by {{:.3g}} N",
                (float(np.ptp(own[first:end])), FORCE),
            )
    if own.max() < 6.0 * noise:
        return None
    like = np.array([correlation(value, fitted[:, other]) for other in range(PAIR_COUNT)])
    if like[pair] < tuning.LEAST_CORRELATION:
        best = int(np.argmax(like))
        other = f", {like[best]:.2f} with {PAIR_NAMES[best]}" if like[best] > tuning.LEAST_CORRELATION else ""
        return Reason(
            f"correlation of {like[pair]:.2f} with the motion's force{other}, expected at least "
            f"{tuning.LEAST_CORRELATION:g}"
        )
    gain = float(value @ own / (own @ own))
    if abs(gain - 1.0) > tuning.MOST_GAIN:
        return Reason(
            f"{gain:.3g} times the motion's force, expected {1.0 - tuning.MOST_GAIN:g} to {1.0 + tuning.MOST_GAIN:g}"
        )
    return None


def _delay(forces: ContactForces, fitted: FittedForces) -> float:
    t, measured, computed = forces.t, np.nan_to_num(forces.force), np.nan_to_num(fitted.force)
    pairs = np.flatnonzero(computed.any(axis=0) & measured.any(axis=0))
    lags = np.arange(-_LARGEST_DELAY, _LARGEST_DELAY + 0.5 * _DELAY_STEP, _DELAY_STEP)
    alike = [sum(correlation(measured[:, i], np.interp(t - lag, t, computed[:, i])) for i in pairs) for lag in lags]
    return float(lags[int(np.argmax(alike))])


def correlation(first: Array, second: Array) -> float:
    """Return the correlation coefficient of two series; 0 if a series is constant."""
    first, second = first - first.mean(), second - second.mean()
    size = float(np.sqrt((first @ first) * (second @ second)))
    return float(first @ second) / size if size > 0.0 else 0.0
