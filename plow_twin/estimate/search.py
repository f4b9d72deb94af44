"""Search for the best fit in several stages.

A swing is a part of the motion that begins in flight. From stage to stage, a longer part of each swing (the *horizon*)
is fitted, and the number of candidates decreases.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import LAG, Fit, Problem, Window, fit, unmoved_span
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.measurements import RESOLVING, Poses, filled
from plow_twin.estimate.priors import UNSTATED
from plow_twin.estimate.start import cut, first_vectors, range_of_motion
from plow_twin.estimate.unknowns import BIAS, DELAY, GAIN, GX, GY, SOFTNESS, Unknowns

Array = NDArray[np.float64]


#: Smallest numbers of rows in a horizon and in a swing, derived from the six unknowns of a starting state.
_FEWEST_ROWS = (8, 12)
#: Differences from the model with only a low pass of the sensor, with the time constant of the prior.
LOW_PASS: Final = np.array([0.0] * LAG + [UNSTATED["filter"]])
#: Stages of the search: horizon as a share of the period, and upper bounds on the number of iterations of each fit and
#: on the number of candidates for the next stage.
_STAGES: Final = ((0.1, 4, 5), (0.2, 3, 2))
#: Upper bound on the number of swings.
_MOST_SWINGS = 350


def candidate(forward: Forward, unknowns: Unknowns, poses: Poses, period: float) -> tuple[Problem, Fit] | None:
    """Return the best fit to the beginnings of the first swings; None if no starting point could be simulated."""
    interval = poses.interval()
    first = poses.between(float(poses.t[0]), float(poses.t[0]) + tuning.FIRST_PERIODS * period)
    window = cut(unknowns.scene, first, period, max(0.2 * period, _FEWEST_ROWS[1] * interval))
    horizons = [max(share * period, _FEWEST_ROWS[0] * interval) for share, *_ in _STAGES]
    vectors = first_vectors(Problem(forward, unknowns, window, horizon=horizons[0]), 6)
    points = [(vector, states_at(window, vector), tuning.FIRST_NOISE) for vector in vectors]
    fits: list[Fit] = []
    for (_, iterations, most), horizon in zip(_STAGES, horizons, strict=True):
        problem, fits = Problem(forward, unknowns, window, horizon=horizon), []
        for shared, states, noise in points:
            fitted = fit(problem, shared, better_states(problem, shared, states), noise, iterations)
            if fitted is None:
                continue
            fits = sorted([*fits, fitted], key=lambda fit: fit.loss)
            if _have_met(fits, fitted):
                del fits[1:]
                break
        fits = fits[:most]
        points = [(one.shared, one.point.states, one.noise) for one in fits]
    return (problem, fits[0]) if fits else None


def _have_met(fits: list[Fit], newest: Fit) -> bool:
    """Return whether the two best fits, of which one is `newest`, agree in clearances and loss.

    `fits` are sorted by loss. Starting points with different stiffness that lead to equal fits have found the optimum.
    """
    if len(fits) < 2 or newest not in fits[:2]:
        return False
    best, other = fits[:2]
    near = np.abs(other.shared - best.shared)[[GX, GY]] < tuning.MET
    return bool(near.all()) and other.loss - best.loss < tuning.OUTLYING**2


def behind_low_pass(problem: Problem, fitted: Fit) -> Fit | None:
    """Return a fit of the same swings with the time constant of the sensor's low pass fixed at its prior deviation.

    Steps from a fit without a low pass do not lead to a time constant longer than an impact. The result is None if the
    new fit is not clearly better, or if the poses are too rare to show a low pass.
    """
    if problem.window.poses.interval() > RESOLVING:
        return None
    other = problem.having(forward=problem.forward.renewed(), differences=LOW_PASS)
    refitted = fit(other, fitted.shared, fitted.point.states, fitted.noise, _STAGES[-1][1])
    return refitted if refitted is not None and refitted.loss < fitted.loss - tuning.OUTLYING**2 else None


def refine(
    forward: Forward, unknowns: Unknowns, poses: Poses, period: float, shared: Array, noise: Array, drift: Array | None,
    differences: Array | None = None, close: bool = False,
) -> tuple[Problem, Fit] | None:  # fmt: skip
    """Return a fit to all poses from a good starting point; None if the motion cannot be simulated.

    The beginnings of the swings are fitted before whole swings.

    Parameters
    ----------
    forward, unknowns : Forward, Unknowns
        Forward model and prior.
    poses : Poses
        The measured poses.
    period : float
        Period of the load in s.
    shared : ndarray, shape (SIZE,)
        Starting point.
    noise : ndarray, shape (3,)
        First guess of the standard deviation of the measurements.
    drift : ndarray, shape (3,), or None
        Spectral density of the acceleration in m2/s3 and rad2/s3 that the unknown part of a broad-band load causes;
        None for a load that is not broad-band.
    differences : ndarray, shape (7,), optional
        Fixed differences from the model.
    close : bool
        Whether the starting point is so close to the optimum that even the fit of a hard contact converges with long
        swings.
    """
    hard = not close and bool(np.exp(shared[SOFTNESS]) < tuning.HARD)
    rows = poses.interval() * np.array(_FEWEST_ROWS)
    shortest = tuning.SHORTEST[0 if hard else 1 if drift is None else 2]
    horizon = tuning.HARD_HORIZON if hard else np.inf
    if drift is not None and not hard:
        # the unknown part of the load may move the head by no more than the noise
        shortest = min(max(shortest, unmoved_span(noise, drift) / period), tuning.SHORTEST[1])
    shortest = max(shortest * period, rows[1], float(poses.t[-1] - poses.t[0]) / _MOST_SWINGS)
    horizon = max(horizon * period, rows[0])
    window = cut(unknowns.scene, poses, period, shortest)
    near = Problem(
        forward, unknowns, window, horizon=min(near_horizon(poses, period), horizon), differences=differences
    )
    starts = [shared]
    if unknowns.is_hard(shared):  # a contact that is not hard needs no second starting point
        starts.append(range_of_hard(unknowns, poses, shared))
    fits = []
    for start in starts:
        states = better_states(near, start, states_at(window, start))
        fits.append(fit(near, start, states, noise, 10, *(() if hard else (tuning.ENOUGH,))))
    best = min((fit_result for fit_result in fits if fit_result is not None), key=lambda fit: fit.loss, default=None)
    if best is None:
        return None
    whole = near.having(horizon=horizon, drift=None if hard else drift)
    states = better_states(whole, best.shared, best.point.states)
    best = fit(whole, best.shared, states, best.noise, 20 if not hard and drift is None else 12)
    return None if best is None else (whole, best)


def near_horizon(poses: Poses, period: float) -> float:
    """Return the horizon in s for a fit to the beginnings of swings."""
    return max(0.2 * period, _FEWEST_ROWS[0] * poses.interval())


def range_of_hard(unknowns: Unknowns, poses: Poses, shared: Array) -> Array:
    """Return a starting point with a hard contact and with the range of motion as clearances."""
    start = unknowns.nominal()
    clearance, bias = range_of_motion(unknowns.scene, poses)
    start[[GX, GY]], start[BIAS][:2] = clearance, bias
    start[SOFTNESS] = unknowns.softness_of(unknowns.force / 1e-4**unknowns.scene.contact.exponent)
    start[DELAY] = shared[DELAY]
    return unknowns.within(start)


def states_at(window: Window, shared: Array) -> Array:
    """Return the first guesses of the starting states without the bias of the sensor, shape (s, 6)."""
    states = window.states.copy()
    states[:, :3] -= shared[BIAS]
    return states


def better_states(problem: Problem, shared: Array, states: Array) -> Array:
    """Return starting states, replaced by the end of the previous swing where it fits the poses better."""
    window, scene = problem.window, problem.unknowns.scene_of(shared)
    gain, poses = shared[GAIN], window.poses
    scale = np.maximum(np.nanstd(np.where(poses.measured, poses.q, filled(poses)), axis=0), 1e-6)
    out = states.copy()
    times = window.poses.t - shared[DELAY]
    for index in range(window.swings - 1):
        span = window.starts[[index, index + 1]]
        run = problem.forward.run(scene, gain, span[:1], out[index : index + 1], np.array([0, 1]), span[1:])
        if run is None:
            continue
        reached = np.concatenate([run.q[0], run.v[0]])
        rows = (times >= span[1]) & (times < span[1] + min(problem.horizon, 0.5 * (window.starts[index + 2] - span[1])))
        if rows.sum() < 2:
            out[index + 1] = reached
            continue
        both = np.stack([reached, out[index + 1]])
        count = int(rows.sum())
        runs = problem.forward.run(
            scene, gain, np.repeat(span[1:], 2), both, np.array([0, count, 2 * count]), np.tile(times[rows], 2)
        )
        if runs is None:
            continue
        error = (np.tile(window.poses.q[rows] - shared[BIAS], (2, 1)) - runs.q) / scale
        losses = [float(np.nanmean(np.minimum(part**2, 1.0))) for part in (error[:count], error[count:])]
        if losses[0] < losses[1]:
            out[index + 1] = reached
    return out
