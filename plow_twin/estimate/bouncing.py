"""Clearances with a hard contact, from features of the whole motion instead of the pose at each moment.

With a hard contact the head bounces many times before it rests, so its pose at a moment cannot be predicted. The
reach of the corners and the scatter of the pose at each phase of the load can be predicted. Motions with randomly drawn
stiffness, damping and load gains are simulated and observed with the sensor's noise and gaps. A regression among the
simulated motions near the measured one gives the difference between clearance and reach (approximate Bayesian
computation with local-linear adjustment); its residuals give the interval.

References: Beaumont, Zhang and Balding, Genetics 162 (2002) 2025; Fearnhead and Prangle, J. R. Stat. Soc. B 74 (2012)
419; Wood, Nature 466 (2010) 1102; Blum and Francois, Stat. Comput. 20 (2010) 63.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import priors, tuning
from plow_twin.estimate.forward import Forward
from plow_twin.estimate.laws import Draws, log_odds
from plow_twin.estimate.likely import Seen, likeliest
from plow_twin.estimate.measurements import FEWEST_FOR_SCATTER, Poses, filled
from plow_twin.estimate.priors import UNSTATED, deviation_of, is_stated
from plow_twin.estimate.regression import ridge
from plow_twin.estimate.start import noise_level, range_of_motion, reaches, smooth_width
from plow_twin.estimate.unknowns import (
    DAMPING,
    GAIN,
    GX,
    GY,
    LEAST_CLEARANCE,
    OTHER_LAW,
    SOFTNESS,
    Unknowns,
    with_other_law,
)
from plow_twin.model import geometry

Array = NDArray[np.float64]

#: Derived: biases of theta that are tried, in rad; they reach eight prior deviations to both sides. The best bias is
#: refined by a parabola over three quarters of the spacing of the tried biases to both sides.
_TURNS: Final = np.linspace(-0.16, 0.16, 81)
_FINEST_TURN: Final = 3e-3
_NEAR_TURNS: Final = np.linspace(-_FINEST_TURN, _FINEST_TURN, 5)
#: Bound: largest number of rows in the search for a bias, and in the refinement of the bias.
_MOST_ROWS, _MOST_NEAR_ROWS = 2000, 1200
#: Derived: smallest number of rows in a part of a load period; the mean of nine values has a third of their scatter.
_FEWEST_OF_PHASE = 9
#: Derived: delays in s that are tried. For the measured path they reach two prior deviations to both sides, and for the
#: paths of simulated motions a tenth of that. `_NO_LAG` is the index of zero among the delays of simulated motions.
_LAGS_S: Final = np.linspace(-0.1, 0.1, 81)
_OF_DRAWN_S: Final = np.linspace(-0.01, 0.01, 9)
_NO_LAG = len(_OF_DRAWN_S) // 2
#: Derived: distances in rows, as powers of two, over which changes are computed: `_CHANGES` for the changes of pose and
#: reach in the whole motion, `_CHANGES_BY_PHASE` for the changes of the pose at each phase of the load.
_CHANGES: Final = (1, 2, 4, 8, 16, 32)
_CHANGES_BY_PHASE: Final = (1, 4)
#: Definition: the paths by which a scene names the sides of the frame.
_SIDES: Final = ("frame.width_m", "frame.height_m")
#: Guard: squared scatter, in m2 or rad2, that keeps logarithms and quotients finite.
_NO_SCATTER = 1e-14
#: Bound: largest factor on the work allowed for simulated motions if the window is longer than ten load periods.
_LONGER = 2.0
#: Guard: smallest and largest penetration in m that is drawn for a hard and for a firm contact.
_HARD_BOUNDS, _FIRM_BOUNDS = (8e-7, 6e-4), (2e-6, 2e-2)
#: Bound: number of rounds in which the noise of a draw is corrected.
_NOISE_ROUNDS = 3
#: Derived: smallest number of draws for a regression with twenty features, and smallest number of poses for a 99 %
#: quantile.
_FEWEST, _FEWEST_WHOLE = 30, 100


@dataclass(frozen=True, eq=False)
class Bounced:
    """Result of a comparison.

    clearance, clearance_deviation : (2,) in m
    bias, bias_deviation : (3,) of x, y in m and theta in rad
    ln_penetration : mean and standard deviation of the logarithm of the penetration in m under the reference force
    ln_damping : mean and standard deviation of the unknown for the damping, as in `Unknowns`
    noise : (3,) standard deviation of the measurements
    distance : distance of the measured motion from nearby drawn motions, relative to the distances among drawn motions
    path : distance of the measured path (mean and scatter of the pose over the load's period) from its prediction by
        the drawn motions, as a normal deviate among the same distances of the drawn motions; 0 with too few poses
    law : likeness of the motion to motions under another contact law, as a normal deviate among motions under the
        believed law; 0 if no other law is known, or too few of its motions can be run, or the contact is not hard
    odds : log odds of the other law; minus infinity in the same cases, and if the motions are drawn about a given
        vector
    unseen : (2,) deviation of the clearances in m due to errors of the frame's sides, the sensor's scales and turned
        walls, which the motion does not show
    rounded : (2,) excess of the clearances in m if the frame's corners are rounded by `priors.ROUNDING`; zero if the
        scene states the corners or the sides' deviations
    """

    clearance: Array
    clearance_deviation: Array
    bias: Array
    bias_deviation: Array
    ln_penetration: tuple[float, float]
    ln_damping: tuple[float, float]
    noise: Array
    distance: float
    path: float
    law: float
    odds: float
    unseen: Array = field(default_factory=lambda: np.zeros(2))
    rounded: Array = field(default_factory=lambda: np.zeros(2))


def bounces(unknowns: Unknowns, poses: Poses) -> bool:
    """Return whether the motion shows a contact so hard that whole motions must be compared."""
    return _reach_noise(unknowns, _whole(poses)) < tuning.POSSIBLE and _is_narrow(unknowns, poses)


def _is_narrow(unknowns: Unknowns, poses: Poses) -> bool:
    """Return whether the head always stops at the same place up to noise, so that the walls do not yield."""
    q = _whole(poses)
    reach = _reach(unknowns, q)
    return bool(np.median(reach[2] - reach[0]) < max(tuning.NARROW * _reach_noise(unknowns, q), tuning.FITTED))


def _whole(poses: Poses) -> Array:
    """Return the complete poses or, if they are few, all poses with gaps bridged by straight lines."""
    whole = np.isfinite(poses.q).all(axis=1)
    return poses.q[whole] if whole.sum() > _FEWEST_WHOLE else filled(poses)


def _reach_noise(unknowns: Unknowns, q: Array) -> float:
    """Return the standard deviation of a corner's reach in m."""
    level = noise_level(q)
    return math.hypot(level[0], level[2] * geometry.half_diagonal(unknowns.scene))


def bias_of_hard(unknowns: Unknowns, poses: Poses) -> Array:
    """Return the sensor's bias of x and y in m and theta in rad if the contact is hard; zeros if it is soft.

    A hard wall stops both corners at the same place; with a biased theta the poses show two places. The bias of theta
    is therefore chosen so that the farthest reaches lie closest together. The biases of x and y are removed first,
    because they change the reaches of a turned head.
    """
    q = _whole(poses)
    bias = np.zeros(3)
    bias[:2] = _off_centre(_reach(unknowns, q)[2])
    few = _few(q, _MOST_ROWS) - bias
    bias[2] = _TURNS[int(np.argmin(_widths(unknowns, few, _TURNS)))]
    bias += _near_bias(unknowns, q - bias)
    return bias if _is_narrow(unknowns, poses.moved(-bias)) else np.zeros(3)


def _near_bias(unknowns: Unknowns, q: Array) -> Array:
    """Return a small bias, shape (3,); the same estimate on drawn motions shows its error."""
    q = _few(q, _MOST_NEAR_ROWS)
    bias = np.zeros(3)
    for _ in range(2):
        bias[:2] += _off_centre(_reach(unknowns, q - bias)[2])
        widths = _widths(unknowns, q - bias, _NEAR_TURNS)
        curve, slope, _ = np.polyfit(_NEAR_TURNS, widths, 2)
        least = -0.5 * slope / curve if curve > 0.0 else _NEAR_TURNS[int(np.argmin(widths))]
        bias[2] += float(np.clip(least, -_FINEST_TURN, _FINEST_TURN))
    return bias


def _few(q: Array, most: int) -> Array:
    """Return every n-th row, with n so large that at most `most` rows are left."""
    return q[:: len(q) // most + 1]


def _off_centre(reach: Array) -> Array:
    """Return half the difference of opposite reaches, left minus right and bottom minus top, shape (2,), in m."""
    right, left, top, bottom = reach
    return 0.5 * np.array([left - right, bottom - top])


def _widths(unknowns: Unknowns, q: Array, turns: Array) -> Array:
    """Return the spread of the farthest reaches for each bias of theta in `turns`, summed over the walls, in m."""
    count = len(q)
    (low, middle), (far, farthest) = (
        (int(start * count), max(int(end * count), int(start * count) + 1)) for start, end in tuning.TURN_WINDOWS
    )
    widths = []
    for turn in turns:
        reach = reaches(unknowns.scene, q - [0.0, 0.0, turn])
        reach.partition(sorted({low, min(middle, count - 1), far, min(farthest, count - 1)}), axis=0)
        widths.append(float((reach[far:farthest].mean(axis=0) - reach[low:middle].mean(axis=0)).sum()))
    return np.array(widths)


def compare(
    forward: Forward, unknowns: Unknowns, poses: Poses, period: float, near: Array | None = None, seed: int = 0
) -> Bounced | None:  # fmt: skip
    """Compare the measured motion with drawn motions; None if too few can be run or the contact is not hard.

    The drawn motions have hard contacts. With `near`, a vector of unknowns, they are drawn about its softness and
    damping.
    """
    eye = MotionFeatures(unknowns, poses, period)
    measured = eye.features(eye.q)
    spread = _Spread.hard(unknowns) if near is None else _Spread.near(unknowns, near)
    drawn = _Drawn(forward, unknowns, eye, spread, np.random.default_rng(seed))
    longer = float(np.clip((poses.t[-1] - poses.t[0]) / (10.0 * period), 1.0, _LONGER))
    most_work = forward.work + int(longer * tuning.MOST_WORK[1])
    centre = range_of_motion(unknowns.scene, poses)[0] - tuning.OVERRATED
    if near is not None:
        centre = centre - math.exp(spread.mean[0])
    found: _Regressed | None = None
    delay = 0.0
    rounds = list(zip(tuning.DRAWS[:3], tuning.DRAWN_CLEARANCE[:3], strict=True))
    for count, about in rounds:
        drawn.add(count, centre, about, delay, most_work)
        if len(drawn.features) < _FEWEST:
            return None
        features = np.array(drawn.features)
        if found is None:
            delay = path_delay(eye, features[:, 5:], drawn.q, measured[5:])
            # the first round was drawn without a delay, so its paths are shifted by the delay that has now been found
            paths = [eye.paths(q, _OF_DRAWN_S - delay) for q in drawn.q]
            drawn.by_phase = [eye.changes_by_phase(q, -delay) for q in drawn.q]
        else:
            paths += [eye.paths(q, _OF_DRAWN_S) for q in drawn.q]
        drawn.q.clear()
        like, seen, targets = features[:, 5:], measured[5:], np.array(drawn.targets)
        if near is not None and found is not None:
            likely = _likeliest(features, targets, np.array(paths), measured, eye.paths(eye.q, _OF_DRAWN_S))
            like, seen = np.concatenate([like, likely[:-1]], axis=1), np.concatenate([seen, likely[-1]])
        found = regress_near(like, targets, seen)
        moved = measured[:2] + found.value[:2] - centre
        centre = centre + moved
        # the change of a clearance in the last round is added to its deviation, because a clearance that still changes
        # has not converged
        deviation = np.hypot(found.deviation[:2], moved)
        if near is None and len(features) <= tuning.DRAWS[0] and found.distance > tuning.NOT_HARD:
            return None
        if near is not None:
            drawn.spread = drawn.spread.narrowed(found)
            followed = found.value[5] > math.log(tuning.FITTED) and deviation.max() < tuning.ENOUGH_FOR_FIT
            if len(rounds) == 3 and count == tuning.DRAWS[2] and not followed:
                rounds.append((tuning.DRAWS[3], tuning.DRAWN_CLEARANCE[3]))
    assert found is not None
    # a large change in the last round shows that a clearance has not converged, so its deviation is increased
    deviation = np.where(np.abs(moved) > tuning.ASTRAY, np.hypot(deviation, tuning.UNEXPLAINED_HARD), deviation)
    law, odds = 0.0, -math.inf
    if found.value[5] < math.log(tuning.FITTED):
        law, odds = _of_other_law(drawn, centre, delay, int(longer * tuning.MOST_WORK[2]), near is None)
    return Bounced(
        centre,
        deviation,
        measured[2:5] + found.value[2:5],
        found.deviation[2:5],
        (float(found.value[5]), tuning.WIDENED_SOFTNESS * float(found.deviation[5])),
        (float(found.value[6]), float(found.deviation[6])),
        eye.noise,
        found.distance,
        path_deviate(eye.paths(eye.q, _LAGS_S), features[:, 5:], paths, measured[5:]),
        law,
        # without odds if `near` is given, because the limit of the odds was tuned without `near`
        odds if near is None else -math.inf,
        *hidden_by_geometry(unknowns, poses, period, measured[:2]),
    )


def hidden_by_geometry(unknowns: Unknowns, poses: Poses, period: float, reach: Array) -> tuple[Array, Array]:
    """Return `unseen` and `rounded` of `Bounced`; `reach`, shape (2,), holds the sums of opposite reaches in m.

    A resting head touches the frame at three corners, always at the same angle. At this angle, errors of the sides, the
    scales and the corners change the reach as another clearance would. At a turned wall it touches with the same pad,
    half the turn away from the wall's middle; the turns of two opposite walls add up.
    """
    scene = unknowns.scene
    width, height = (deviation_of(scene, path) for path in _SIDES)

    def moved(width: float = 0.0, height: float = 0.0, scale: Array | float = 0.0) -> Array:
        frame = replace(scene.frame, width_m=scene.frame.width_m + width, height_m=scene.frame.height_m + height)
        other = replace(unknowns, scene=replace(scene, frame=frame))
        seen = MotionFeatures(other, poses, period)
        off: Array = np.abs(seen.features(seen.q * (1.0 + scale))[:2] - reach)
        return off

    turned = np.array(
        [[UNSTATED[f"turn_{wall}"] for wall in walls] for walls in (("left", "right"), ("top", "bottom"))]
    )
    scaled = [moved(scale=scale) for scale in np.diag(priors.SCALES)]
    unseen = np.sqrt(
        np.square([moved(width), moved(0.0, height), *scaled]).sum(axis=0) + (0.25 * turned**2).sum(axis=1)
    )
    # the prior of round corners is not needed if the scene states the corners' radius, or the deviation of a side,
    # which covers the corners too
    known = scene.frame.corner_radius_m is not None or any(is_stated(scene, path) for path in _SIDES)
    across = 0.0 if known else -2.0 * priors.ROUNDING
    return unseen, moved(across, across) if across else np.zeros(2)


@dataclass(frozen=True, eq=False)
class _Spread:
    """Distribution of drawn contacts: means and deviations of the logarithms of penetration and damping, shape (2,)."""

    mean: Array
    deviation: Array
    bounds: tuple[float, float]

    @staticmethod
    def hard(unknowns: Unknowns) -> _Spread:
        middle, deviation, damping, _ = tuning.HARD_DRAWN
        mean = np.array([math.log(middle), float(unknowns.nominal()[DAMPING])])
        return _Spread(mean, np.array([deviation, damping if unknowns.damped else 0.0]), _HARD_BOUNDS)

    @staticmethod
    def near(unknowns: Unknowns, vector: Array) -> _Spread:
        """Return the distribution about the softness and damping of a vector of unknowns."""
        mean = np.array([math.log(unknowns.penetration_of(float(vector[SOFTNESS]))), vector[DAMPING]])
        return _Spread(mean, tuning.FIRM_SPREAD[0] * np.array([1.0, float(unknowns.damped)]), _FIRM_BOUNDS)

    def narrowed(self, found: _Regressed) -> _Spread:
        """Return a narrower distribution, about the result of a regression."""
        _, over, least = tuning.FIRM_SPREAD
        deviation = np.minimum(np.maximum(over * found.deviation[5:7], least), self.deviation)
        return _Spread(found.value[5:7], deviation, _FIRM_BOUNDS)


class _Drawn:
    """Motions drawn with one contact law: features, targets, changes, and the motions themselves until cleared."""

    def __init__(
        self, forward: Forward, unknowns: Unknowns, eye: MotionFeatures, spread: _Spread, rng: np.random.Generator
    ) -> None:  # fmt: skip
        self.forward, self.unknowns, self.eye, self.spread, self.rng = forward, unknowns, eye, spread, rng
        self.features: list[Array] = []
        self.targets: list[Array] = []
        self.changes: list[Array] = []
        self.by_phase: list[Array] = []
        self.q: list[Array] = []

    def add(self, count: int, centre: Array, about: float, delay: float, most_work: int) -> None:
        """Draw `count` more motions that are seen `delay` s late, or fewer if the work reaches `most_work`.

        The clearances have the mean `centre` and the deviation `about`, both in m.
        """
        for _ in range(count):
            if self.forward.work > most_work:
                return
            numbers = self._numbers()
            clearance = np.maximum(centre + about * self.rng.standard_normal(2), LEAST_CLEARANCE)
            q = self.eye.look(self.forward, self.unknowns, clearance, numbers, delay, self.rng)
            if q is not None:
                seen = self.eye.features(q)
                self.features.append(seen)
                self.targets.append(np.concatenate([clearance - seen[:2], -seen[2:5], numbers]))
                self.changes.append(self.eye.changes(q))
                self.by_phase.append(self.eye.changes_by_phase(q))
                self.q.append(q)

    def _numbers(self) -> Array:
        """Draw the logarithms of penetration and damping, and three load gains, shape (5,)."""
        mean = np.concatenate([self.spread.mean, np.ones(3)])
        drawn = self.rng.standard_normal(5)
        numbers: Array = mean + np.concatenate([self.spread.deviation, np.full(3, tuning.HARD_DRAWN[3])]) * drawn
        numbers[0] = np.clip(numbers[0], *np.log(self.spread.bounds))
        if self.unknowns.scene.contact.law in OTHER_LAW.values():
            # damping under the other law is drawn as a share of critical damping, for any stiffness
            critical = self.unknowns.critical_damping(self.unknowns.force / math.exp(numbers[0]))
            numbers[1] = math.log(tuning.LAW_DAMPING[1] * critical) + tuning.LAW_DAMPING[2] * drawn[1]
        return numbers

    def of_other_law(self) -> _Drawn | None:
        """Return an empty set of draws with the other possible law; None if there is no such law."""
        other = with_other_law(self.unknowns)
        return None if other is None else _Drawn(self.forward.of(other.scene), other, self.eye, self.spread, self.rng)

    def like(self) -> Array:
        """Return the features of the motions, shape (n, m)."""
        return np.concatenate([np.array(self.features)[:, 5:], np.array(self.changes)], axis=1)

    def draws(self) -> Draws:
        """Return the features of the motions, including features by phase of the load, and the drawn unknowns."""
        of_draw = np.array(self.targets)[:, [5, 6, 7, 8, 9, 0, 1]]
        return Draws(np.concatenate([self.like(), np.array(self.by_phase)], axis=1), of_draw)


def _likeliest(features: Array, targets: Array, paths: Array, measured: Array, seen: Array) -> Array:
    """Return likeliest clearances minus reaches in m, shape (n + 1, 2), of n drawn motions and the measured motion.

    Of `seen`, (lags, k), and `paths`, (n, lags, k), only the mean poses are used.
    """
    before, after = _NO_LAG - 1, _NO_LAG + 1
    paths, seen = (path[..., : path.shape[-1] // 2] for path in (paths, seen))
    there = np.isfinite(paths).all(axis=(0, 1)) & np.isfinite(seen).all(axis=0)

    def motions(features: Array, paths: Array) -> Seen:
        like = np.concatenate([features[:, :2], features[:, 5:]], axis=1)
        late = (paths[:, after] - paths[:, before]) / (_OF_DRAWN_S[after] - _OF_DRAWN_S[before])
        return Seen(
            np.concatenate([like, paths[:, _NO_LAG, there]], axis=1),
            np.concatenate([np.zeros_like(like), late[:, there]], axis=1),
        )

    reach = features[:, :2]
    drawn = np.concatenate([targets[:, :2] + reach, targets[:, 5:]], axis=1)
    likely = likeliest(drawn, tuning.HARD_DRAWN[3], motions(features, paths), motions(measured[None], seen[None]))
    off: Array = likely - np.concatenate([reach, measured[None, :2]])
    return off


def path_delay(eye: MotionFeatures, features: Array, drawn: list[Array], measured: Array) -> float:
    """Return the delay in s that brings the measured path nearest to motions drawn without a delay."""
    paths = np.array([eye.paths(q, np.zeros(1))[0] for q in drawn])
    seen = eye.paths(eye.q, _LAGS_S)
    there = np.isfinite(paths).all(axis=0) & np.isfinite(seen).all(axis=0)
    if there.sum() < tuning.PATH_PHASES:
        return 0.0
    value, left = _Near.to(features, measured).left_over(paths[:, there])
    off = ((seen[:, there] - value) ** 2 / ((left**2).mean(axis=0) + _NO_SCATTER)).sum(axis=1)
    # a delay cannot be negative, because no pose is known before it is measured
    return max(float(_LAGS_S[int(np.argmin(off))]), 0.0)


def _of_other_law(
    drawn: _Drawn, centre: Array, delay: float, most_work: int, by_odds: bool
) -> tuple[float, float]:  # fmt: skip
    """Return the likeness of the measured motion to motions under another law, and the log odds of that law.

    With `by_odds`, half of the draws are enough if their odds are clear, because then the likeness does not matter.

    Goodness of fit does not separate laws with similar motions. A classifier of draws of both laws (Pudlo et al.,
    Bioinformatics 32 (2016) 859) and the likelihood under each law do separate them. Each of the two methods finds
    cases that the other misses.
    """
    other, nothing = drawn.of_other_law(), (0.0, -math.inf)
    if other is None:
        return nothing
    eye, half = drawn.eye, tuning.DRAWS[4] // 2
    measured = np.concatenate([eye.features(eye.q)[5:], eye.changes(eye.q)])
    by_phase = np.concatenate([measured, eye.changes_by_phase(eye.q)])
    found = nothing
    for count in (half, tuning.DRAWS[4] - half):
        other.add(count, centre, tuning.DRAWN_CLEARANCE[2], delay, most_work)
        if len(other.features) >= _FEWEST:
            odds = log_odds(drawn.draws(), other.draws(), by_phase)
            found = class_deviate(drawn.like(), other.like(), measured), odds
            if by_odds and not tuning.CLEAR_ODDS[0] < odds < tuning.CLEAR_ODDS[1]:
                break
    drawn.forward.work += other.forward.work
    return found


def class_deviate(believed: Array, other: Array, measured: Array) -> float:
    """Return the likeness of features (m,) to `other` (k, m) rather than `believed` (n, m), as a normal deviate.

    The class label is regressed on the features, with the same total weight for both classes. The deviate compares the
    prediction with the cross-validated predictions of the believed class.
    """
    features = np.concatenate([believed, other])
    sizes = [len(believed), len(other)]
    label = np.repeat([0.0, 1.0], sizes)
    weight = np.repeat(0.5 * len(label) / np.array(sizes), sizes)
    z = (features - measured) / (features.std(axis=0) + 1e-12)
    basis = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    inverse, leverage = ridge(basis, tuning.RIDGE[2], weight)
    beta = inverse @ (basis.T @ (weight * label))
    held_out = label - (label - basis @ beta) / (1.0 - np.minimum(leverage, 0.95))
    right = held_out[: len(believed)]
    return float((beta[0] - right.mean()) / right.std(ddof=1))


def path_deviate(seen: Array, features: Array, drawn: list[Array], measured: Array) -> float:
    """Return the distance of the measured path from the drawn motions as a normal deviate; 0 with too few measurements.

    Nearby drawn motions are compared with the remaining drawn motions in the same way. Their distances are those of a
    correct model, for any contact, noise and length of the window.
    """
    # shape (n, lags, parts); stamps may be late or early, so a path is compared at several lags
    paths = np.array(drawn)
    there = np.isfinite(paths).all(axis=(0, 1)) & np.isfinite(seen).all(axis=0)
    if there.sum() < tuning.PATH_PHASES:
        return 0.0
    paths, off = paths[:, :, there], _distance_of_paths(features, paths[:, :, there], measured, seen[:, there])
    distance = (((features - measured) / (features.std(axis=0) + 1e-12)) ** 2).mean(axis=1)
    others = []
    for index in np.argsort(distance, kind="stable")[:FEWEST_FOR_SCATTER]:
        rest = np.arange(len(features)) != index
        others.append(_distance_of_paths(features[rest], paths[rest], features[index], paths[index]))
    ln_others = np.log(others)
    return float((math.log(off) - ln_others.mean()) / ln_others.std(ddof=1))


def _distance_of_paths(features: Array, paths: Array, measured: Array, seen: Array) -> float:
    """Return the mean square distance of a seen path (lags, k) from the prediction by the drawn paths (n, lags, k).

    It is the Mahalanobis distance with the covariance of the drawn paths' residuals, shrunk toward equal variances
    (Ledoit and Wolf, J. Multivar. Anal. 88 (2004) 365).
    """
    near = _Near.to(features, measured)
    value, left = near.left_over(paths[:, _NO_LAG])
    variance = (near.weight[:, None] * left**2).sum(axis=0) / near.weight.sum()
    deviation = np.sqrt(variance * (1.0 + near.inverse[0, 0]))
    left *= np.sqrt(near.weight / near.weight.sum())[:, None] / deviation
    share, size = tuning.SHRINKAGE[1], left.shape[1]
    off = (seen - value) / deviation
    # (a L^T L + b I)^-1 = (I - L^T (b/a I + L L^T)^-1 L) / b inverts the smaller matrix: there are fewer draws than
    # numbers in a path
    equal = share * float(np.square(left).sum()) / size
    among = left @ left.T + equal / (1.0 - share) * np.eye(len(left))
    along = left @ off.T
    square = (np.square(off).sum(axis=1) - (along * np.linalg.solve(among, along)).sum(axis=0)) / equal
    return float(square.min() / seen.shape[1])


@dataclass(frozen=True, eq=False)
class _Regressed:
    value: Array
    deviation: Array
    distance: float


@dataclass(frozen=True, eq=False)
class _Near:
    """The terms of a regression on features among the nearest of n draws.

    distance, weight : (n,) distance of a draw from the measured features, and its weight
    scale : (m,) scatter of the features
    basis, inverse : (n, m + 1), (m + 1, m + 1) basis, and inverse of the normal matrix
    leverage : (n,) leverage of each draw
    """

    distance: Array
    weight: Array
    scale: Array
    basis: Array
    inverse: Array
    leverage: Array

    @staticmethod
    def to(features: Array, measured: Array) -> _Near:
        scale = features.std(axis=0) + 1e-12
        z = (features - measured) / scale
        distance = (z * z).mean(axis=1)
        weight = np.maximum(1.0 - distance / np.sort(distance)[int(tuning.NEAR * len(distance))], 0.0)
        basis = np.concatenate([np.ones((len(z), 1)), z], axis=1)
        inverse, leverage = ridge(basis, tuning.RIDGE[0], weight)
        return _Near(distance, weight, scale, basis, inverse, leverage)

    def regress(self, targets: Array) -> tuple[Array, Array]:
        """Return the targets (n, k) predicted at the measured features, shape (k,), and their residuals."""
        beta = self.inverse @ (self.basis.T @ (self.weight[:, None] * targets))
        return beta[0], targets - self.basis @ beta

    def left_over(self, targets: Array) -> tuple[Array, Array]:
        """Return the result of `regress` with cross-validated residuals: each draw is predicted from the others."""
        value, error = self.regress(targets)
        left: Array = error / (1.0 - np.minimum(self.leverage, 0.9))[:, None]
        return value, left


def regress_near(features: Array, targets: Array, measured: Array) -> _Regressed:
    """Regress targets (n, k) on features (n, m), weighting draws near the measured features most.

    The deviations are those of a prediction at `measured`, which may lie at the edge of the draws.
    """
    near = _Near.to(features, measured)
    value, error = near.regress(targets)
    variance = _scatter_at(near.basis, near.weight, error, near.leverage)
    deviation = np.sqrt(variance * (1.0 + near.inverse[0, 0]))
    between = ((features[:, None] - features[None]) ** 2 / near.scale**2).mean(axis=2)
    nearest = np.sort(between, axis=1)[:, 1:6].mean(axis=1)
    return _Regressed(value, deviation, float(np.sort(near.distance)[:5].mean() / np.quantile(nearest, 0.95)))


def _scatter_at(basis: Array, weight: Array, error: Array, leverage: Array) -> Array:
    """Return the residual variance of a regression at the measured features, shape (k,).

    The variance depends on softness and noise, so the logarithm of the squared residuals is also regressed on the
    features (Blum and Francois).
    """
    freed = 1.0 - np.minimum(leverage, 0.9)
    square = error**2 / freed[:, None]
    held = np.diag([0.0] + [tuning.RIDGE[1]] * (basis.shape[1] - 1))
    beta = np.linalg.solve(
        basis.T @ (weight[:, None] * basis) + held, basis.T @ (weight[:, None] * np.log(square + _NO_SCATTER))
    )
    predicted = np.exp(basis @ beta)
    size = (weight[:, None] * square / predicted).sum(axis=0) / weight.sum()
    variance: Array = size * np.exp(beta[0])
    return variance


@dataclass(frozen=True, eq=False)
class _Phases:
    """Rows (k,) that have a component, the part of the load period of each row, and the number of rows of each part.

    A number of rows is at least 1, so that quotients are finite; `known` marks the parts with enough rows.
    """

    rows: NDArray[np.int64]
    inside: NDArray[np.int64]
    size: NDArray[np.int64]
    known: NDArray[np.bool_]


class MotionFeatures:
    """Features of motions as the sensor sees them, at the poses' times and with their gaps and noise."""

    def __init__(self, unknowns: Unknowns, poses: Poses, period: float) -> None:
        self._unknowns, self._t = unknowns, poses.t
        self._there = np.isfinite(poses.q)
        self.q = filled(poses)
        self.noise = noise_level(self.q)
        self._period, self._parts = period, tuning.PATH_PHASES // 2
        #: mask of the poses that are at least one period after the first pose; earlier poses still depend on the start
        self._settled = poses.t - poses.t[0] >= period
        self._whole = self._there.all(axis=1)
        if self._whole.sum() <= _FEWEST_WHOLE:
            self._whole = np.ones(len(poses.t), np.bool_)
        self._smooth = max(min(smooth_width(poses, tuning.AVERAGED), int(self._whole.sum()) // 8), 1)
        self._reach_phase = ((poses.t[self._whole] - poses.t[0]) / period % 1.0 * tuning.PATH_PHASES).astype(int)
        phase = np.minimum(((poses.t - poses.t[0]) / period % 1.0 * self._parts).astype(int), self._parts - 1)
        #: for each component and each part of a period, the rows that have the component; parts with few rows are left
        #: out
        self._parts_of = [
            [rows for k in range(self._parts) if len(rows := np.flatnonzero((phase == k) & there)) > 8]
            for there in self._there.T
        ]
        self._phases: dict[float, list[_Phases]] = {}

    def look(
        self, forward: Forward, unknowns: Unknowns, clearance: Array, numbers: Array, delay: float,
        rng: np.random.Generator,
    ) -> Array | None:  # fmt: skip
        """Return a simulated motion as the sensor sees it, `delay` s late; None if the model cannot be run."""
        vector = unknowns.nominal()
        vector[[GX, GY]], vector[DAMPING] = clearance, numbers[1]
        vector[GAIN] = np.clip(numbers[2:5], 0.7, 1.3)
        scene = unknowns.scene_of(vector)
        # a fit has a hardest contact, but a drawn contact may be harder, because the decay of the bounces depends on
        # the stiffness
        contact = replace(scene.contact, stiffness=unknowns.force / math.exp(numbers[0]) ** scene.contact.exponent)
        start = np.concatenate([self.q[0], np.zeros(3)])
        start += np.array([1e-3, 1e-3, 4e-3, 0.05, 0.05, 0.2]) * rng.standard_normal(6)
        white = rng.standard_normal(self.q.shape)
        edges, t = np.array([0, len(self._t)]), self._t - delay
        run = forward.run(replace(scene, contact=contact), vector[GAIN], t[:1] - 0.1, start[None], edges, t)
        return None if run is None else self._seen(run.q, white)

    def paths(self, q: Array, lags_s: Array) -> Array:
        """Return the path for each lag, shape (lags, 240)."""
        return np.array([self._path(q, lag_s) for lag_s in lags_s])

    def _path(self, q: Array, lag_s: float) -> Array:
        """Return the centred mean pose and the logarithm of its scatter at each phase of the load, shape (240,).

        Phases with too few poses are NaN. The scatter shows how fast bounces die out.
        """
        out = np.full((2, tuning.PATH_PHASES, 3), np.nan)
        for i, phases in enumerate(self._phases_at(lag_s)):
            if not phases.known.any():
                continue
            inside, known, size = phases.inside, phases.known, phases.size
            value = q[phases.rows, i] - q[phases.rows, i].mean()
            mean = np.bincount(inside, value, len(size)) / size
            square = np.bincount(inside, (value - mean[inside]) ** 2, len(size)) / size
            out[0, known, i] = mean[known] - mean[known].mean()
            out[1, known, i] = 0.5 * np.log(square[known] + _NO_SCATTER)
        return out.ravel()

    def _phases_at(self, lag_s: float) -> list[_Phases]:
        """Return the phases of each component for a lag, cached because all drawn motions are seen with few lags."""
        if lag_s not in self._phases:
            if len(self._phases) > 2 * len(_OF_DRAWN_S):
                self._phases.clear()
            parts, found = tuning.PATH_PHASES, []
            phase = ((self._t - self._t[0] - lag_s) / self._period % 1.0 * parts).astype(int) % parts
            for there in self._there.T:
                rows = np.flatnonzero(there & self._settled)
                count = np.bincount(phase[rows], minlength=parts)
                found.append(_Phases(rows, phase[rows], np.maximum(count, 1), count >= _FEWEST_OF_PHASE))
            self._phases[lag_s] = found
        return self._phases[lag_s]

    def _seen(self, q: Array, white: Array) -> Array:
        """Return a motion with the noise that makes its quick changes as large as the measured ones.

        Bounces also change the pose quickly. If all quick changes were taken for noise, noise and reach would be
        overestimated.
        """
        noise = self.noise
        for _ in range(_NOISE_ROUNDS):
            noise = noise * self.noise / np.maximum(noise_level(self._bridged(q + noise * white)), 1e-12)
        return self._bridged(q + noise * white)

    def _bridged(self, q: Array) -> Array:
        """Return a motion without the components that are missing in the measurement, bridged like the measurement."""
        return q if self._there.all() else filled(Poses(self._t, np.where(self._there, q, np.nan)))

    def features(self, q: Array) -> Array:
        """Return reach, bias and the other features of the motion, in this order."""
        whole = q[self._whole]
        bias = _near_bias(self._unknowns, whole)
        whole = whole - bias
        reach = _reach(self._unknowns, whole)
        right, left, top, bottom = reach[1]
        bias[:2] += _off_centre(reach[1])
        sums = np.array([right + left, top + bottom])
        averaged = np.concatenate([self._averaged(whole), self._by_phase(whole)])
        averaged = averaged[:, [0, 2]] + averaged[:, [1, 3]] - sums
        scatter = []
        for i in range(3):
            parts = np.array([q[rows, i].std() for rows in self._parts_of[i]])
            calm = np.sort(parts)[: max(len(parts) // 3, 1)]
            scatter += [math.log(calm.mean() + 1e-9), math.log(parts.mean() + 1e-9)] if len(parts) else [0.0, 0.0]
        like = [reach[2] - reach[0], reach[2] - reach[1], scatter, averaged.ravel()]
        return np.concatenate([sums, bias, *like])

    def changes(self, q: Array) -> Array:
        """Return logarithms of the changes of pose and reach over several distances, which show how bounces decay."""
        rows = np.concatenate([q, reaches(self._unknowns.scene, q)], axis=1)
        parts = []
        for apart in _CHANGES:
            if len(rows) > 2 * apart + 1:
                change = _second_difference(rows, apart)
                parts += [change.std(axis=0), np.abs(change).mean(axis=0)]
        return np.log(np.concatenate(parts) + 1e-12)

    def changes_by_phase(self, q: Array, lag_s: float = 0.0) -> Array:
        """Return the logarithms of the pose's changes at each phase of the load, for a motion that is `lag_s` late."""
        phase = ((self._t - self._t[0] - lag_s) / self._period % 1.0 * self._parts).astype(int) % self._parts
        count = np.maximum(np.bincount(phase, minlength=self._parts), 1)
        parts = []
        for apart in _CHANGES_BY_PHASE:
            squares = _second_difference(q, apart) ** 2
            parts += [np.bincount(phase[apart:-apart], column, self._parts) / count for column in squares.T]
        return 0.5 * np.log(np.concatenate(parts) + _NO_SCATTER)

    def _averaged(self, q: Array) -> Array:
        """Return `_reach` of poses that are averaged over a few rows to reduce their noise."""
        even = np.full(self._smooth, 1.0 / self._smooth)
        if self._smooth > 1:
            q = np.stack([np.convolve(column, even, "valid") for column in q.T], axis=1)
        return _reach(self._unknowns, q)

    def _by_phase(self, q: Array) -> Array:
        """Return mean reaches in the load phases with the farthest reaches, in which the head rests, shape (3, 4)."""
        reach, phase = reaches(self._unknowns.scene, q), self._reach_phase
        count = np.bincount(phase, minlength=tuning.PATH_PHASES + 1)
        known = count > 0
        means = np.stack([np.bincount(phase, one, len(count))[known] / count[known] for one in reach.T], axis=1)
        means.sort(axis=0)
        parts = [means[-max(int(share * len(means)), 1) :].mean(axis=0) for share in tuning.FARTHEST_PARTS]
        return np.stack(parts)


def _second_difference(rows: Array, apart: int) -> Array:
    """Return second differences over distances of `apart` rows, shape (n - 2 apart, k)."""
    change: Array = rows[2 * apart :] - 2.0 * rows[apart:-apart] + rows[: -2 * apart]
    return change


def _reach(unknowns: Unknowns, q: Array) -> Array:
    """Return the reaches toward the right, left, top and bottom, averaged between quantiles, shape (3, 4), in m."""
    ordered = np.sort(reaches(unknowns.scene, q), axis=0)
    count = len(ordered)
    windows = [
        ordered[int(low * count) : max(int(high * count), int(low * count) + 1)] for low, high in tuning.REACH_WINDOWS
    ]
    return np.stack([window.mean(axis=0) for window in windows])
