"""Fits with harmonics that are missing from the measured load.

A linearised step of all unknowns, including the amplitudes of the harmonics, alternates with a short fit of all other
unknowns. The beginnings of the swings (parts of the motion that begin in flight) are fitted first, because the fit of a
short motion has few false optima.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import Fit, Problem, fit, joint_step
from plow_twin.estimate.harmonics import COMPONENTS, Harmonics
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.search import better_states, near_horizon
from plow_twin.estimate.unknowns import SIZE
from plow_twin.estimate.verdict import Verdict, judge

Array = NDArray[np.float64]

#: Upper bounds on the number of fits with harmonics, of iterations in each fit, and of successive fits without
#: improvement.
_ROUNDS, _ITERATIONS, _IN_VAIN = 12, 6, 4
#: Upper bound on the fitted part of each swing in the second stage, divided by that in the first stage. The third stage
#: fits whole swings.
_LONGER = 2.0


def with_harmonics(
    problem: Problem, fitted: Fit, measured_load: Load, period: float
) -> tuple[tuple[Problem, Fit], Verdict] | None:
    """Return a fit that includes harmonics of the measured load `measured_load`, and its verdict.

    The result is None if the load is not periodic, if swings are linked, if the motion cannot be simulated, or if a
    check fails after any stage.
    """
    harmonics, poses = Harmonics.of(measured_load), problem.window.poses
    if harmonics is None or len(problem.link):
        return None
    near = near_horizon(poses, period)
    for horizon in (near, _LONGER * near, np.inf):
        stage = Problem(problem.forward, problem.unknowns, problem.window, horizon=horizon)
        states = better_states(stage, fitted.shared, fitted.point.states)
        begun = fit(stage, fitted.shared, states, fitted.noise, _ITERATIONS)
        ended = None if begun is None else _alternated(stage, begun, measured_load, harmonics)
        if ended is None:
            return None
        problem, fitted, harmonics = ended
        verdict = judge(problem, fitted, period)
        if verdict.model or verdict.sensor:
            return None
    verdict.added = _named(harmonics)
    return ((problem, fitted), verdict) if fitted.finished else None


def _alternated(
    problem: Problem, fitted: Fit, measured_load: Load, harmonics: Harmonics
) -> tuple[Problem, Fit, Harmonics] | None:
    """Return a fit with harmonics, by linearised steps and fits from `harmonics`; None if a simulation fails."""
    best, in_vain = fitted.loss, 0
    for index in range(_ROUNDS):
        value = harmonics.amplitude.ravel()
        precision = np.full(len(value), tuning.LACKING**-2.0)
        columns = problem.by_harmonics(fitted.point, harmonics)
        step, covariance, states = joint_step(problem, fitted, columns, precision, -value * precision)
        (shared, change), covariance = np.split(step, [SIZE]), covariance[SIZE:, SIZE:]
        size = float(change @ np.linalg.solve(covariance, change))
        # a change within the noise is left to the linearised step of `discrepancy.graded`
        if in_vain == _IN_VAIN or (index and size < tuning.SETTLED * len(COMPONENTS)):
            break
        harmonics = harmonics.moved(np.clip(change, -tuning.LACKING, tuning.LACKING), np.diag(covariance))
        problem = problem.having(forward=problem.forward.under(harmonics.added(measured_load)), harmonics=harmonics)
        most = problem.deviation, problem.start_spread
        shared, states = (np.clip(one, -bound, bound) for one, bound in zip((shared, states), most, strict=True))
        shared = problem.unknowns.within(fitted.shared + shared)
        states = better_states(problem, shared, fitted.point.states + states)
        refitted = fit(problem, shared, states, fitted.noise, _ITERATIONS)
        if refitted is None:
            return None
        fitted = refitted
        in_vain = 0 if fitted.loss < best else in_vain + 1
        best = min(best, fitted.loss)
    return problem, fitted, harmonics


def _named(harmonics: Harmonics) -> str:
    clear = harmonics.amplitude**2 / harmonics.variance
    clear[1::2] += clear[2::2]
    clear[2::2] = 0.0
    term, component = divmod(int(clear.argmax()), len(COMPONENTS))
    size = float(np.linalg.norm(harmonics.amplitude[term : term + 2 if term else 1, component]))
    place = f"at {harmonics.multiples[term // 2]} times its frequency" if term else "at rest"
    return f"load: {COMPONENTS[component]} lacks {size:.1%} of its amplitude {place}"
