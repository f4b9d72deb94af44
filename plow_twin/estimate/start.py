"""Starting points of a fit, and division of the motion into swings, which begin in flight."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.fit import Problem, Window
from plow_twin.estimate.measurements import Poses, filled
from plow_twin.estimate.unknowns import BIAS, DAMPING, GX, GY, SOFTNESS
from plow_twin.model import geometry
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y
from plow_twin.model.scene import Scene

Array = NDArray[np.float64]

#: Definition of the walls right, left, top and bottom by masks of their pairs, shape (8,) each.
WALLS: Final = (NORMAL_X > 0.0, NORMAL_X < 0.0, NORMAL_Y > 0.0, NORMAL_Y < 0.0)
#: Indices of the two pairs at each wall, in the order of `WALLS`.
_PADS: Final = [np.flatnonzero(wall).tolist() for wall in WALLS]
#: Upper bound on the number of trial times for the start of a swing.
_CANDIDATES = 12


def smoothed(q: Array, width: int) -> Array:
    """Return running medians of poses over `width` rows."""
    if width < 2 or len(q) < width:
        return q
    padded = np.pad(q, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    medians: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, width, axis=0), axis=-1)
    return medians


def reaches(scene: Scene, q: Array) -> Array:
    """Return the reaches in m toward the right, left, top and bottom wall, shape (n, 4).

    A reach is the distance of the corner nearest to the wall from the centre of the cavity, minus half the size of the
    frame. In contact, it equals half the clearance plus the penetration.
    """
    rows = geometry.penetration_rows(scene)[:4]
    c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
    body = np.stack([c, s, c * q[:, 0] + s * q[:, 1], -s * q[:, 0] + c * q[:, 1]], axis=1)
    toward = body @ rows
    half = np.array([scene.frame.width_m, scene.frame.width_m, scene.frame.height_m, scene.frame.height_m]) / 2.0
    return np.stack([np.maximum(toward[:, one], toward[:, other]) for one, other in _PADS], axis=1) - half


def smooth_width(poses: Poses, span: float = 0.06) -> int:
    """Return the number of rows in `span` s."""
    return max(1, int(span / float(np.median(np.diff(poses.t)))))


def range_of_motion(scene: Scene, poses: Poses) -> tuple[Array, Array]:
    """Return the clearances and the biases of x and y in m, shape (2,) each, from the range of motion."""
    reach = reaches(scene, smoothed(filled(poses), smooth_width(poses)))
    right, left, top, bottom = np.quantile(reach, 0.99, axis=0)
    # relative to a head that moves to the right, the frame moves to the left
    return np.array([right + left, top + bottom]), 0.5 * np.array([left - right, bottom - top])


def cut(scene: Scene, poses: Poses, period: float, shortest: float) -> Window:
    """Return poses divided into swings of at least `shortest` s.

    A swing begins when the head is away from the walls and moves on a parabola.
    """
    interval = poses.interval()
    raw, t = filled(poses), poses.t
    width = smooth_width(poses, 0.04)
    reach = reaches(scene, smoothed(raw, width))
    # distance of the head from the nearest wall
    room = -(reach - np.quantile(reach, 0.99, axis=0)).max(axis=1)
    noise = np.maximum(noise_level(raw), 1e-7)
    clear = tuning.OUTLYING * np.hypot(*(noise[[0, 2]] * [1.0, geometry.half_diagonal(scene)])) / np.sqrt(width)
    apart = max(shortest, 6 * interval)
    starts, states = [float(t[0])], [_parabola(t, raw, float(t[0]), noise)[0]]
    while t[-1] > starts[-1] + 2.0 * apart:
        near = np.flatnonzero((t > starts[-1] + apart) & (t < starts[-1] + 2.0 * apart) & (room > clear))
        if not len(near):
            # without a suitable start, the swing ends after a whole load period
            far = np.flatnonzero((t > starts[-1] + 2.0 * apart) & (room > clear))
            end = min(float(t[far[0]]) if len(far) else np.inf, starts[-1] + period)
            near = np.flatnonzero((t >= end) & (t < end + apart))
            if not len(near) or t[-1] < end + apart:
                break
        near = near[np.argsort(-room[near], kind="stable")][:_CANDIDATES]
        fits = [_parabola(t, raw, float(t[index]), noise) for index in near]
        best = int(np.argmin([misfit for _, misfit in fits]))
        starts.append(float(t[near[best]]))
        states.append(fits[best][0])
    return Window(poses, np.array([*starts, float(t[-1]) + 1e-6]), np.stack(states))


def _parabola(t: Array, q: Array, start: float, noise: Array) -> tuple[Array, float]:
    """Return pose and rate at the time `start`, shape (6,), by parabolas through nearby poses, and their misfit.

    The parabolas have the longest span whose misfit noise explains. A longer span contains an impact.
    """
    near, misfit = np.zeros(0, np.int64), np.inf
    state = np.zeros(6)
    for span in tuning.PARABOLAS:
        low, high = np.searchsorted(t, [start - 0.5 * span, start + 0.5 * span])
        if high - low < 6:
            middle = int(np.searchsorted(t, start))
            low, high = max(0, min(middle - 3, len(t) - 6)), max(0, min(middle - 3, len(t) - 6)) + 6
        near = np.arange(low, min(high, len(t)))
        basis = np.vander(t[near] - start, 3, increasing=True)
        coefficients, *_ = np.linalg.lstsq(basis, q[near], rcond=None)
        error = (q[near] - basis @ coefficients) / noise
        now = float(np.sqrt((error**2).sum(axis=0) / max(len(near) - 3, 1)).max())
        if now < misfit:
            misfit, state = now, np.concatenate([coefficients[0], coefficients[1]])
        if now < tuning.PARABOLA_FITS:
            return np.concatenate([coefficients[0], coefficients[1]]), now
    return state, misfit


def noise_level(q: Array) -> Array:
    """Return the standard deviation of the noise of poses, shape (3,), from their third differences."""
    if len(q) < 8:
        return np.zeros(3)
    level: Array = 1.4826 * np.median(np.abs(np.diff(q, n=3, axis=0)), axis=0) / np.sqrt(20.0)
    return level


def first_vectors(problem: Problem, most: int) -> list[Array]:
    """Return the best `most` starting points of the shared unknowns, shape (SIZE,) each, in order of the misfit.

    For several stiffnesses and dampings, the clearances are adjusted until the simulated range of motion is right.
    """
    unknowns, window = problem.unknowns, problem.window
    measured, bias = range_of_motion(unknowns.scene, window.poses)
    matches: list[tuple[float, Array]] = []
    for penetration in (None, *tuning.PENETRATIONS):
        for damping in (0.0, -1.0, 1.0) if unknowns.damped else (0.0,):
            vector = unknowns.nominal()
            vector[BIAS][:2] = bias
            vector[DAMPING] += damping
            if penetration is not None:
                vector[SOFTNESS] = unknowns.softness_of(unknowns.force / penetration**unknowns.scene.contact.exponent)
            vector[[GX, GY]] = measured - np.array([1.2, 1.6]) * np.exp(vector[SOFTNESS])
            matches += _matched(problem, vector, measured)
    matches.sort(key=lambda pair: pair[0])
    return [vector for _, vector in matches[:most]]


def _matched(problem: Problem, vector: Array, measured: Array) -> list[tuple[float, Array]]:
    """Return the loss, and `vector` with clearances adjusted to the range of motion `measured` in m.

    The result is a list of one item, or empty if the motion cannot be simulated.
    """
    poses, unknowns = problem.window.poses, problem.unknowns
    matches = []
    for _ in range(4):
        vector = unknowns.within(vector)
        states = problem.window.states.copy()
        states[:, :3] -= vector[BIAS]
        point = problem.evaluate(vector, states)
        if point is None:
            break
        scale = np.nanstd(poses.q, axis=0)
        error = point.residual / np.where(scale > 0.0, scale, 1.0)
        matches.append((float(np.nanmean(np.minimum(error * error, 1.0))), vector))
        predicted = Poses(poses.t, poses.q - point.residual - vector[BIAS])
        clearance, _ = range_of_motion(unknowns.scene, predicted)
        vector = vector.copy()
        vector[[GX, GY]] += 0.8 * (measured - clearance)
    return sorted(matches, key=lambda pair: pair[0])[:1]
