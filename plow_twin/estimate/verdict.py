"""Tests whether the residuals of a fit are noise; if not, the model or the sensor is suspect.

The page docs/estimate.md lists faults that the tests do not find.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.arrow import OWN
from plow_twin.estimate.fit import NO_PRIOR, Fit, Problem, joint_step, pieces
from plow_twin.estimate.measurements import FEWEST_FOR_SCATTER, FEWEST_POSES, Poses
from plow_twin.estimate.reason import LENGTH, NUMBER, Reason
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.unknowns import BIAS, DAMPING, GAIN, GX, GY, SIZE, SOFTNESS, with_other_law
from plow_twin.model import geometry
from plow_twin.solve.compiled_scene import inertias

Array = NDArray[np.float64]

COMPONENTS = ("x", "y", "theta")

#: Approximate upper bound on the number of times in a window at which a change of a bias or a clearance is tested.
MOMENTS = 60


@dataclass
class Verdict:
    """Faults of the model and of the sensor that the tests have found.

    model : messages about faults of the model
    sensor : messages about faults of the sensor
    figures : statistics of the tests
    by_scale : whether wrong scale factors are the only fault of the sensor
    broken : whether the sensor has failed or the measurements contradict each other, so no estimate is possible
    added : description of the terms that the fit has added to the scene or to the measured load
    changed : (2,) change in m, within the window, of the two clearances or of the biases of x and y
    """

    model: list[str] = field(default_factory=list)
    sensor: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    by_scale: bool = False
    broken: bool = False
    added: str = ""
    changed: Array = field(default_factory=lambda: np.zeros(2))


def judge(problem: Problem, fit: Fit, period: float) -> Verdict:
    """Return the faults that the residuals of a fit show; `period` is the period of the load in s."""
    verdict = Verdict()
    _stuck(problem, fit, verdict)
    _noise_change(fit, verdict)
    _change_within(problem, fit, verdict)
    _colour(fit, verdict)
    _repeated(problem, fit, period, verdict)
    _other_law(problem, fit, verdict)
    for name, gain, deviation in zip(("fx", "fy", "m"), fit.shared[GAIN], fit.deviation[GAIN], strict=True):
        excess = (abs(gain - 1.0) - tuning.MOST_GAIN) / max(deviation, 1e-9)
        verdict.figures[f"gain_{name}"] = float(gain)
        if excess > 2.0:
            verdict.model.append(f"load {name}: {gain:.2f} times the given load")
    if not fit.converged:
        verdict.figures["not_converged"] = 1.0
    if verdict.sensor:
        # a faulty sensor does not test the model
        verdict.model.clear()
    _scale(problem, fit, verdict)
    return verdict


def judge_sensor(poses: Poses) -> list[str]:
    """Return messages about faults of the sensor that the poses alone show, such as a constant value."""
    reasons = []
    for i, name in enumerate(COMPONENTS):
        column = poses.q[np.isfinite(poses.q[:, i]), i]
        if len(column) < 5 * FEWEST_POSES:
            continue
        ends = np.flatnonzero(np.append(np.diff(column) != 0.0, True))
        longest = int(np.diff(np.append(-1, ends)).max())
        if longest > FEWEST_FOR_SCATTER:
            reasons.append(f"{name}: the same value {longest} times in a row")
        parts = np.array([noise_level(part[:, None])[0] for part in np.array_split(column, 5)])
        ratio = float(parts.max() / max(float(np.median(parts)), 1e-12))
        if ratio > tuning.MOST_RATIO:
            reasons.append(f"{name}: the noise of one part of the window is {ratio:.1f} times that of the rest")
    return reasons


def predicted(fit: Fit) -> NDArray[np.bool_]:
    """Return which measurements the model predicts almost to within the noise, shape (n, 3)."""
    close: NDArray[np.bool_] = np.isfinite(fit.point.residual) & (fit.variance < 1.5 * fit.noise**2)
    return close


def _colour(fit: Fit, verdict: Verdict) -> None:
    is_predicted = predicted(fit)
    for i, name in enumerate(COMPONENTS):
        quick = quick_noise(fit.point.residual[:, i], fit.point.swing)
        rows = fit.point.residual[is_predicted[:, i], i]
        if quick <= 0.0 or len(rows) < 50:
            continue
        ratio = float(np.mean(np.minimum(np.abs(rows), 5.0 * quick) ** 2) / quick**2)
        # the last term allows for the random scatter of `ratio`
        limit = 1.0 + (tuning.MOST_RATIO - 1.0) + 4.0 * 2.5 / np.sqrt(len(rows))
        verdict.figures[f"colour_{name}"] = ratio
        if ratio > limit and not verdict.sensor:
            verdict.model.append(
                f"variance of the residual of {name}: {ratio:.2f} times that of its noise, expected at most {limit:.2f}"
            )


def _repeated(problem: Problem, fit: Fit, period: float, verdict: Verdict) -> None:
    """Test whether the residuals repeat in each period of the load (analysis of variance).

    A wrong contact law or a wrong shape of the load causes residuals that repeat.
    """
    t, is_predicted = problem.window.poses.t, predicted(fit)
    turns = np.floor((t - t[0]) / period).astype(int)
    phase = np.minimum(((t - t[0]) / period % 1.0 * tuning.PHASES).astype(int), tuning.PHASES - 1)
    between, within, cells, freedom = 0.0, 0.0, 0, 0
    for i in range(3):
        scale = fit.noise[i]
        for k in range(tuning.PHASES):
            inside = is_predicted[:, i] & (phase == k)
            parts = [fit.point.residual[inside & (turns == turn), i] for turn in np.unique(turns[inside])]
            means = np.array([part.mean() for part in parts]) / scale
            if len(means) < 3:
                continue
            between += len(means) * float(means.mean()) ** 2
            within += float(((means - means.mean()) ** 2).sum())
            cells += 1
            freedom += len(means) - 1
    if freedom < 30 or within <= 0.0:
        return
    ratio = (between / cells) / (within / freedom)
    verdict.figures["repeated"] = ratio
    if ratio > tuning.MOST_RATIO and not verdict.sensor:
        verdict.model.append(f"residuals repeat with the load: {ratio:.1f}, expected at most {tuning.MOST_RATIO:g}")


def _other_law(problem: Problem, fit: Fit, verdict: Verdict) -> None:
    """Test whether the alternative contact law explains the residuals (linearised score test).

    The motion under the alternative law is mixed into the predicted motion. Its share is the only unknown that is not
    eliminated.
    """
    unknowns = with_other_law(problem.unknowns)
    if unknowns is None or not fit.finished:
        return
    shared = fit.shared.copy()
    stiffness = unknowns.stiffness_of(float(shared[SOFTNESS]))
    shared[DAMPING] = math.log(tuning.LAW_DAMPING[0] * unknowns.critical_damping(stiffness))
    forward, prior = problem.forward.of(unknowns.scene), (problem.mean, problem.deviation)
    other = problem.having(forward=forward, unknowns=unknowns, prior=prior, drift=problem.drift)
    point = other.evaluate(shared, fit.point.states)
    problem.forward.work += forward.work
    if point is None:
        return
    change = np.nan_to_num(fit.point.residual - point.residual)[:, :, None]
    step, covariance, _ = joint_step(problem, fit, change, np.full(1, NO_PRIOR), np.zeros(1))
    moved = float(step[-1] / math.sqrt(covariance[-1, -1]))
    verdict.figures["law"] = moved
    if abs(moved) > tuning.OUTLYING and not verdict.sensor:
        verdict.model.append(
            f"residuals like those of another contact law: {moved:.1f}, expected at most {tuning.OUTLYING:g}"
        )


def _scale(problem: Problem, fit: Fit, verdict: Verdict) -> None:
    """Test the sensor's scale factors, which show in the acceleration in flight and in contacts of a rotated head."""
    if not fit.finished:
        return
    motion = np.nan_to_num(problem.window.poses.q - fit.point.residual - fit.shared[BIAS])
    columns = motion[:, :, None] * np.eye(3)
    step, covariance, _ = joint_step(problem, fit, columns, np.full(3, NO_PRIOR), np.zeros(3))
    scale = step[SIZE:]
    chi2 = float(scale @ np.linalg.solve(covariance[SIZE:, SIZE:], scale))
    verdict.figures["scale"] = chi2
    if chi2 > tuning.MOST_SCALE and not (verdict.sensor or verdict.model):
        verdict.by_scale = True
        x, y, theta = (1.0 + scale).tolist()
        verdict.sensor.append(
            f"scale factors of x, y, theta: got {x:.3f}, {y:.3f}, {theta:.3f} with chi^2 {chi2:.0f}, "
            f"expected at most {tuning.MOST_SCALE:g}"
        )


def quick_noise(residual: Array, swing: NDArray[np.int64]) -> float:
    """Return the standard deviation of a residual from differences of successive rows within swings."""
    finite = np.isfinite(residual)
    value, part = residual[finite], swing[finite]
    if len(value) < 10:
        return 0.0
    change = np.diff(value)[np.diff(part) == 0]
    return float(1.4826 * np.median(np.abs(change)) / np.sqrt(2.0)) if len(change) else 0.0


def _stuck(problem: Problem, fit: Fit, verdict: Verdict) -> None:
    measured = problem.window.poses.q
    for i, name in enumerate(COMPONENTS):
        column, residual = measured[:, i], fit.point.residual[:, i]
        finite = np.isfinite(column)
        value, predicted = column[finite], (column - residual)[finite]
        if len(value) < tuning.STUCK[0]:
            continue
        ends = np.flatnonzero(np.append(np.diff(value) != 0.0, True))
        lengths = np.diff(np.append(-1, ends))
        for end, length in zip(ends[lengths >= tuning.STUCK[0]], lengths[lengths >= tuning.STUCK[0]], strict=True):
            span = predicted[end - length + 1 : end + 1]
            moved = float(np.nanmax(span) - np.nanmin(span)) if np.isfinite(span).any() else 0.0
            least = tuning.STUCK[1] * max(noise_level(value[:, None])[0], 1e-5)
            if moved > least or length > FEWEST_FOR_SCATTER:
                verdict.sensor.append(f"{name}: the same value {length} times in a row")
                verdict.broken = True
                break


def _noise_change(fit: Fit, verdict: Verdict) -> None:
    if not fit.finished:  # the residuals contain motion, which can vary within the window
        return
    for i, name in enumerate(COMPONENTS):
        residual, swing = fit.point.residual[:, i], fit.point.swing
        parts = [quick_noise(residual[index], swing[index]) for index in np.array_split(np.arange(len(residual)), 5)]
        noises = np.array([part for part in parts if part > 0.0])
        if len(noises) < 3:
            continue
        ratio = float(noises.max() / np.median(noises))
        verdict.figures[f"noise_ratio_{name}"] = ratio
        if ratio > tuning.MOST_RATIO:
            verdict.sensor.append(f"{name}: the noise of one part of the window is {ratio:.1f} times that of the rest")
            verdict.broken = True


def _change_within(problem: Problem, fit: Fit, verdict: Verdict) -> None:
    if problem.window.swings < 6:
        return
    best: list[tuple[float, Array]] = []
    for name, columns in (("bias", np.arange(SIZE)[BIAS]), ("clearance", np.array([GX, GY]))):
        held = np.diag(1.0 / problem.deviation[columns] ** 2)
        changes = [
            (np.asarray(np.linalg.solve(information + held, score), np.float64), score)
            for information, score in _changes(problem, fit, columns)
        ]
        gains = [(float(change @ score), change) for change, score in changes]
        best.append(max(gains, key=lambda pair: pair[0], default=(-np.inf, np.zeros(len(columns)))))
        verdict.figures[f"change_{name}"] = best[-1][0]
    (bias, shift), (clearance, growth) = best
    share = max(bias, clearance) / max(_excess(fit), 1e-9)
    verdict.figures["change_share"] = share
    if max(bias, clearance) < tuning.CHANGE_CHI2:
        return
    moved = np.hypot(shift[:2], geometry.half_diagonal(problem.unknowns.scene) * shift[2])
    changed = np.zeros(2)
    if bias >= clearance and moved.max() > 0.5 * tuning.OBSERVED:
        by = zip(shift.tolist(), (LENGTH, LENGTH, NUMBER), strict=True)
        verdict.sensor.append(Reason("shifted within the window by {:.2g} m, {:.2g} m, {:.2g} rad", *by))
        changed = moved
    elif clearance > bias and np.abs(growth).max() > 0.5 * tuning.OBSERVED:
        by = zip(growth.tolist(), (LENGTH, LENGTH), strict=True)
        verdict.model.append(Reason("machine changed within the window: clearances by {:.2g} m, {:.2g} m", *by))
        changed = np.abs(growth)
    # unlike a wrong load or law, a real change explains a large share of the residuals
    if changed.any() and share > tuning.CHANGE_SHARE and _load_suffices(problem, fit):
        # a smaller change only widens the interval
        verdict.broken |= bool(changed.max() > 2.0 * tuning.OBSERVED)
        verdict.changed = changed


def _load_suffices(problem: Problem, fit: Fit) -> bool:
    """Return whether the unknown part of the load has no effect on the residuals of short or linked swings."""
    drift = np.array(problem.forward.load.unknown) / np.asarray(inertias(problem.unknowns.scene)) ** 2
    span = float(np.median(np.diff(problem.window.starts)))
    return len(problem.link) > 0 or bool((drift * span**3 / 3.0 < fit.noise**2).all())


def _excess(fit: Fit) -> float:
    """Return the sum of squared residuals minus squared `quick_noise`, in units of the variances of the fit."""
    total = 0.0
    for i in range(3):
        quick = quick_noise(fit.point.residual[:, i], fit.point.swing)
        square = fit.point.residual[:, i] ** 2 - quick**2
        total += float(np.nansum(square / fit.variance[:, i]))
    return total


def _changes(problem: Problem, fit: Fit, columns: NDArray[np.intp]) -> Iterator[tuple[Array, Array]]:
    """Yield the information matrix and the score for a change of the unknowns `columns` at each of several swings.

    A change near an end of the window cannot be distinguished from a few swings that are fitted badly.
    """
    count = len(columns)
    size = SIZE + OWN * problem.window.swings
    cross, own, score = np.zeros((size, count)), np.zeros((count, count)), np.zeros(count)
    swings = list(pieces(problem, fit.point, fit.linear, fit.variance))
    apart = math.ceil(len(swings) / MOMENTS)
    end = max(2, round(tuning.CHANGE_ENDS * len(swings)))
    for index in range(len(swings) - 1, end - 1, -1):
        for piece in swings[index]:
            changed = piece.weighted[:, columns]
            crossed = piece.rows.T @ changed
            cross[:SIZE] += crossed[:SIZE]
            cross[piece.own] += crossed[SIZE:]
            own += changed.T @ piece.rows[:, columns]
            score += changed.T @ piece.residual
        if index <= len(swings) - end and index % apart == 0:
            yield own - cross.T @ fit.factor.solve(cross), score.copy()
