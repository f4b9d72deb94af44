"""Wear over months, extrapolated from the mean force on each pad in a simulation of a few load periods.

The wear rate of a pad is k_s <F> v / A (Archard) with the wear coefficient k_s, the mean force <F>, the travel speed v
and the area A. With the travel s, the exposure is E = k_s s / A in 1/N. The wear depths h satisfy dh/dE = <F>(h), so
one path h(E) holds for every time, travel speed and coefficient. The path is computed with Heun's method. The
difference between Heun's and Euler's method and the change of the clearance limit the step size.

References: Archard, J. Appl. Phys. 24 (1953) 981; Lemaitre and Doghri, Comput. Methods Appl. Mech. Eng. 115 (1994) 197
(jump in cycles); ISO 13381-1 (prognosis).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import PlowTwinError, SolverError
from plow_twin.estimate import tuning
from plow_twin.estimate.measurements import Load
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y
from plow_twin.model.running_in import with_running_in, without_running_in
from plow_twin.model.scene import Harmonic, Scene, Table, Wear
from plow_twin.run.simulate import simulate

Array = NDArray[np.float64]

#: Wear depth in m of the trial simulation that measures the sliding distance, far below the bound at which wear would
#: change the motion.
_TRACE_M = 1e-12
#: Upper bound on the number of interpolated rows between two rows of a path with running-in.
_FINER = 16
#: Upper bound on the number of steps of a path.
_MOST_STEPS = 400
#: Lower bound on the clearance in m to which the size of a step is proportional.
_LEAST_CLEARANCE = 1e-3


class LifeError(PlowTwinError):
    """The wear of a machine cannot be computed from the given input."""


@dataclass(frozen=True, eq=False)
class Path:
    """Wear depths as functions of the exposure.

    exposure : (n,) rising exposures in 1/N, from 0
    depth : (n, 8) wear depth of each pad in m
    force : (n, 8) mean normal force of each pad in N
    deviation : (n, 8) standard error of the mean force in N
    error : estimate of the largest error of a depth in m at the end of the path
    """

    exposure: Array
    depth: Array
    force: Array
    deviation: Array
    error: float

    def clearance_growth(self) -> Array:
        """Return the growth of the horizontal and the vertical clearance in m, shape (n, 2).

        A wall is assumed to move by the mean wear depth of its two pads.
        """
        horizontal = 0.5 * self.depth @ np.abs(NORMAL_X)
        vertical = 0.5 * self.depth @ np.abs(NORMAL_Y)
        return np.stack([horizontal, vertical], axis=1)


def period_of(scene: Scene) -> float:
    """Return the period in s of the slowest harmonic load or, without harmonic loads, of the longest table.

    Raises
    ------
    LifeError
        If the scene has neither a harmonic load nor a table, or if the table is too short for mean forces.
    """
    omegas = [load.omega_rad_s for load in scene.loads if isinstance(load, Harmonic)]
    if omegas:
        return 2.0 * math.pi / min(omegas)
    tables = [load for load in scene.loads if isinstance(load, Table)]
    if not tables:
        raise LifeError("loads: got no harmonic load and no table, expected a load with a period")
    longest = max(tables, key=lambda load: float(load.t[-1]))
    period = Load(longest.t, longest.wrench).period()
    periods = float(longest.t[-1]) / period
    if periods < sum(tuning.MEAN_PERIODS):
        raise LifeError(f"loads: got {periods:.1f} periods, expected at least {sum(tuning.MEAN_PERIODS)}")
    return period


def mean_forces(scene: Scene, depth: Array, tol: float = 1e-6) -> tuple[Array, Array]:
    """Return the mean force of each worn pad in N, shape (8,), and its standard error over the periods.

    With wear by in-plane sliding, each force is multiplied by the sliding distance per travel.

    Raises
    ------
    LifeError
        If the scene has no period, or the head leaves the range of the model.
    """
    period = period_of(scene)
    wear = scene.wear or Wear(0.0, 1.0, 0.0)
    trace = _trace(scene, period) if wear.sliding == "total" else 0.0
    worn = replace(scene, wear=replace(
        wear, coefficient_m2_n=trace, initial_depth_m=tuple(map(float, depth)), running_in_ratio=1.0
    ))  # fmt: skip
    impulses = []
    for count in range(tuning.MEAN_PERIODS[0], sum(tuning.MEAN_PERIODS) + 1):
        try:
            result = simulate(worn, count * period, count * period, tol)
        except SolverError as error:
            widest = [1e3 * value for value in _clearances(scene, depth)]
            raise LifeError(
                f"clearances: got {widest[0]:.1f} mm and {widest[1]:.1f} mm at the end of the path, expected "
                f"clearances with which the model runs: {error}"
            ) from error
        if trace:
            # impulse that would cause the same wear by travel alone
            impulses.append((result.wear_depth - depth) * (wear.pad_area_m2 / (trace * wear.travel_speed_m_s)))
        else:
            impulses.append(np.array([values["impulse"] for values in result.statistics.values()]))
    forces = np.diff(np.array(impulses), axis=0) / period
    return forces.mean(axis=0), forces.std(axis=0, ddof=1) / math.sqrt(len(forces))


def wear_in_travel(scene: Scene) -> Wear:
    """Return the wear section of a scene; raise `LifeError` without the section or with a travel speed of 0."""
    if scene.wear is None:
        raise LifeError("wear: missing, expected a section `wear` with travel_speed_m_s above 0")
    if scene.wear.travel_speed_m_s <= 0.0:
        raise LifeError(f"wear.travel_speed_m_s: got {scene.wear.travel_speed_m_s:g}, expected a speed above 0")
    return scene.wear


def _trace(scene: Scene, period: float) -> float:
    """Return the wear coefficient [m^2/N] with which a pad under the head's weight wears by about `_TRACE_M`."""
    wear = wear_in_travel(scene)
    impulse = scene.head.mass_kg * 10.0 * sum(tuning.MEAN_PERIODS) * period
    return _TRACE_M * wear.pad_area_m2 / (wear.travel_speed_m_s * impulse)


def wear_path(scene: Scene, limit: tuple[float, float], most_exposure: float) -> Path:
    """Return the path until a clearance reaches its limit in m, or the exposure reaches `most_exposure` in 1/N.

    Raises
    ------
    LifeError
        If the scene has no wear or no period, or the path has too many steps.
    """
    if scene.wear is None:
        raise LifeError("wear: got no wear, expected a section `wear`")
    # without running-in, the wear coefficient does not depend on the depth
    steady = without_running_in(scene.wear, np.array(scene.wear.initial_depth_m, dtype=np.float64))
    depth = with_running_in(scene.wear, steady)
    smallest = max(min(_clearances(scene, depth)), _LEAST_CLEARANCE)
    force, deviation = mean_forces(scene, depth)
    rows = [(0.0, steady, force, deviation)]
    error, exposure = 0.0, 0.0
    step = tuning.JUMP[0] * smallest / max(float(force.max()), 1.0)
    while exposure < most_exposure and len(rows) < _MOST_STEPS and not _beyond(scene, depth, limit):
        step = min(step, most_exposure - exposure)
        euler = steady + step * force
        ahead, ahead_deviation = mean_forces(scene, with_running_in(scene.wear, euler))
        change = 0.5 * step * (ahead - force)
        # the noise of the mean forces is not an error of the step
        noise = 0.5 * step * np.hypot(deviation, ahead_deviation)
        excess = float(np.maximum(np.abs(change) - 2.0 * noise, 0.0).max()) / smallest
        if excess > tuning.JUMP[1] and step * float(force.max()) > 1e-3 * smallest:
            step *= 0.5
            continue
        exposure, steady, force, deviation = exposure + step, euler + change, ahead, ahead_deviation
        depth = with_running_in(scene.wear, steady)
        error += excess * excess * smallest + float(noise.max()) ** 2 / smallest
        rows.append((exposure, steady, force, deviation))
        smallest = max(min(_clearances(scene, depth)), _LEAST_CLEARANCE)
        grow = 1.5 if excess < 0.3 * tuning.JUMP[1] else 1.0
        step = min(grow * step, tuning.JUMP[0] * smallest / max(float(force.max()), 1.0))
    if exposure < most_exposure and not _beyond(scene, depth, limit):
        raise LifeError(f"path: got {len(rows)} steps and no end, expected at most {_MOST_STEPS}")
    columns = [np.array([row[i] for row in rows]) for i in range(4)]
    if scene.wear.running_in_ratio > 1.0:
        columns = _finer(columns)
    return Path(columns[0], with_running_in(scene.wear, columns[1]), columns[2], columns[3], error)


def _finer(columns: list[Array]) -> list[Array]:
    """Return the columns of a path without running-in, with linearly interpolated rows inserted."""
    at = np.arange(len(columns[0]), dtype=np.float64)
    more = np.linspace(0.0, at[-1], _FINER * (len(at) - 1) + 1)
    lower = np.minimum(more.astype(int), max(len(at) - 2, 0))
    share = more - lower
    upper = np.minimum(lower + 1, len(at) - 1)
    return [(column[lower].T * (1.0 - share) + column[upper].T * share).T for column in columns]


def _beyond(scene: Scene, depth: Array, limit: tuple[float, float]) -> bool:
    horizontal, vertical = _clearances(scene, depth)
    return horizontal >= limit[0] or vertical >= limit[1]


def _clearances(scene: Scene, depth: Array) -> tuple[float, float]:
    return (
        scene.clearance.horizontal_m + 0.5 * float(depth @ np.abs(NORMAL_X)),
        scene.clearance.vertical_m + 0.5 * float(depth @ np.abs(NORMAL_Y)),
    )
