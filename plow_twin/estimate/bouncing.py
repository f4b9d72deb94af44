"""Estimate of the clearances of a hard contact from features of the whole motion.

With a hard contact, the head bounces many times before it rests, so its pose at a given moment cannot be predicted. The
reach of a corner, which is the distance that it moves toward a wall, and the scatter of the pose at each phase of the
load can be predicted. The method is approximate Bayesian computation with local-linear adjustment:

1. Stiffness, damping and load gains are drawn at random, and the motion is simulated for each draw.
2. Each simulated motion is observed with the noise and the gaps of the sensor.
3. For the simulated motions near the measured motion, the difference between clearance and reach is regressed on the
features. The regression gives the clearance, and its residuals give the interval.

References: Beaumont, Zhang and Balding, Genetics 162 (2002) 2025; Fearnhead and Prangle, J. R. Stat. Soc. B 74 (2012)
419; Wood, Nature 466 (2010) 1102; Blum and Francois, Stat. Comput. 20 (2010) 63.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import priors, tuning
from plow_twin.estimate.forward import Forward, Start
from plow_twin.estimate.laws import Draws, log_odds
from plow_twin.estimate.likely import PathFeatures, likeliest
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
from plow_twin.solve.lanes.record import WIDTH

Array = NDArray[np.float64]

#: Trial values for the bias of theta in rad, over eight prior deviations to both sides. A parabola through the points
#: `_NEAR_TURNS` refines the best value.
_TURNS: Final = np.linspace(-0.16, 0.16, 81)
_FINEST_TURN: Final = 3e-3
_NEAR_TURNS: Final = np.linspace(-_FINEST_TURN, _FINEST_TURN, 5)
#: Upper bounds on the number of rows for the search for a bias and for its refinement.
_MOST_ROWS, _MOST_NEAR_ROWS = 2000, 1200
#: Smallest number of rows in a part of a load period, derived from the scatter of a mean of nine values, which is a
#: third of the scatter of one value.
_FEWEST_OF_PHASE = 9
#: Trial values for the delay of the sensor in s: `_LAGS_S` for the measured motion, over two prior deviations to both
#: sides, and `_OF_DRAWN_S` for simulated motions. `_NO_LAG` is the index of the delay zero in `_OF_DRAWN_S`.
_LAGS_S: Final = np.linspace(-0.1, 0.1, 81)
_OF_DRAWN_S: Final = np.linspace(-0.01, 0.01, 9)
_NO_LAG = len(_OF_DRAWN_S) // 2
#: Steps in rows of the second differences of pose and reach in the whole motion, and of the pose at each phase of the
#: load.
_CHANGES: Final = (1, 2, 4, 8, 16, 32)
_CHANGES_BY_PHASE: Final = (1, 4)
#: Paths of the frame's sides in a scene.
_SIDES: Final = ("frame.width_m", "frame.height_m")
#: Smallest squared scatter in m2 or rad2, a guard against logarithms of zero and divisions by zero.
_NO_SCATTER = 1e-14
#: Upper bound on the factor by which the work for simulated motions may grow in windows longer than ten load periods.
_LONGER = 2.0
#: Lower and upper bound on the drawn penetration in m, for a hard contact and for a firm contact.
_HARD_BOUNDS, _FIRM_BOUNDS = (8e-7, 6e-4), (2e-6, 2e-2)
#: Upper bound on the number of iterations in which the noise of a simulated motion is adjusted.
_NOISE_ROUNDS = 3
#: Time in s from the start of a simulated motion to the first pose, by definition.
_BEFORE: Final = 0.1
#: Smallest number of draws, derived from the twenty features of a regression, and smallest number of complete poses,
#: derived from their 99 % quantile.
_FEWEST, _FEWEST_WHOLE = 30, 100


@dataclass(frozen=True, eq=False)
class Bounced:
    """Result of the comparison of a measured motion with drawn motions.

    Attributes
    ----------
    clearance, clearance_deviation : ndarray, shape (2,)
        Clearances and their standard deviations in m.
    bias, bias_deviation : ndarray, shape (3,)
        Bias of x and y in m and of theta in rad, and the standard deviations of the three biases.
    ln_penetration : tuple of float
        Mean and standard deviation of the logarithm of the penetration in m under the reference force.
    ln_damping : tuple of float
        Mean and standard deviation of the logarithm of the damping or, for a restitution, of its logit.
    noise : ndarray, shape (3,)
        Standard deviation of the measurements.
    distance : float
        Distance of the measured motion from nearby drawn motions, divided by the typical distance between drawn
        motions.
    path : float
        Distance of the measured path (mean and scatter of the pose over the load's period) from the path that the drawn
        motions predict, as a normal deviate of the distances of drawn motions. It is 0 with too few poses.
    law : float
        Similarity of the measured motion to motions under the alternative contact law (`unknowns.OTHER_LAW`), as a
        normal deviate with respect to motions under the assumed law. It is 0 without a comparison of the laws.
    odds : float
        Logarithm of the odds of the alternative law against the assumed law. It is minus infinity without a comparison
        of the laws, and if the motions are drawn about a given vector.
    unseen : ndarray, shape (2,)
        Standard deviation of the clearances in m due to quantities that the motion does not show: errors of the frame's
        sides and of the sensor's scale factors, and rotations of walls.
    rounded : ndarray, shape (2,)
        Distance in m by which the clearances are overestimated if the frame's corners have the radius
        `priors.ROUNDING`. It is zero if the scene states the radius or the deviations of the sides.
    follows : ndarray, shape (2,)
        Change of the reach if the walls are farther apart, relative to the change of the clearance. It is near 0 for
        walls that the head does not touch.
    """

    clearance: Array
    clearance_deviation: Array
    bias: Array
    bias_deviation: Array
    ln_penetration: tuple[float, float]
    ln_damping: tuple[float, float]
    noise: Array
    distance: float = 0.0
    path: float = 0.0
    law: float = 0.0
    odds: float = -math.inf
    unseen: Array = field(default_factory=lambda: np.zeros(2))
    rounded: Array = field(default_factory=lambda: np.zeros(2))
    follows: Array = field(default_factory=lambda: np.ones(2))


def bounces(unknowns: Unknowns, poses: Poses) -> bool:
    """Return whether the contact is so hard that only features of the motion can be predicted."""
    return _reach_noise(unknowns, _whole(poses)) < tuning.POSSIBLE and _is_narrow(unknowns, poses)


def _is_narrow(unknowns: Unknowns, poses: Poses) -> bool:
    """Return whether the head always stops at the same position up to noise, as at rigid walls."""
    q = _whole(poses)
    reach = _reach(unknowns, q)
    return bool(np.median(reach[2] - reach[0]) < max(tuning.NARROW * _reach_noise(unknowns, q), tuning.FITTED))


def _whole(poses: Poses) -> Array:
    """Return the complete poses or, if there are few, all poses with missing components interpolated."""
    whole = np.isfinite(poses.q).all(axis=1)
    return poses.q[whole] if whole.sum() > _FEWEST_WHOLE else filled(poses)


def _reach_noise(unknowns: Unknowns, q: Array) -> float:
    """Return the standard deviation in m of the reach of a corner due to noise."""
    level = noise_level(q)
    return math.hypot(level[0], level[2] * geometry.half_diagonal(unknowns.scene))


def bias_of_hard(unknowns: Unknowns, poses: Poses) -> Array:
    """Return the sensor's bias of x, y and theta in m, m, rad for a hard contact; zeros for a soft contact.

    A hard wall stops both of its corners at the same position. With a bias of theta, they seem to stop at two
    positions. The bias is therefore chosen so that the scatter of the farthest reaches is smallest.
    """
    q = _whole(poses)
    bias = np.zeros(3)
    bias[:2] = _off_centre(_reach(unknowns, q)[2])
    few = _few(q, _MOST_ROWS) - bias
    bias[2] = _TURNS[int(np.argmin(_widths(unknowns, few, _TURNS)))]
    bias += _near_bias(unknowns, q - bias)
    return bias if _is_narrow(unknowns, poses.moved(-bias)) else np.zeros(3)


def _near_bias(unknowns: Unknowns, q: Array) -> Array:
    """Return a small bias, shape (3,), in m, m, rad.

    Its error cancels, because it is also computed for drawn motions, which have no bias.
    """
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
    """Return every n-th row, with the smallest n for which at most `most` rows remain."""
    return q[:: len(q) // most + 1]


def _off_centre(reach: Array) -> Array:
    """Return half the difference of left and right reach, and of bottom and top reach, in m, shape (2,)."""
    right, left, top, bottom = reach
    return 0.5 * np.array([left - right, bottom - top])


def _widths(unknowns: Unknowns, q: Array, turns: Array) -> Array:
    """Return the sum over the walls of the scatter of the farthest reaches in m, for each bias of theta in `turns`."""
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
    """Compare the measured motion with drawn motions. The result is None after few draws or without a hard contact.

    By default, the drawn motions have hard contacts. If a vector of unknowns `near` is given, stiffness and damping are
    drawn about its values.
    """
    motion_features = MotionFeatures(unknowns, poses, period)
    measured = motion_features.features(motion_features.q)
    spread = _Spread.hard(unknowns) if near is None else _Spread.near(unknowns, near)
    drawn = _Drawn(forward, unknowns, motion_features, spread, np.random.default_rng(seed))
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
            delay = path_delay(motion_features, features[:, 5:], drawn.q, measured[5:])
            # the first motions were drawn without a delay
            paths = [motion_features.paths(q, _OF_DRAWN_S - delay) for q in drawn.q]
            drawn.by_phase = [motion_features.changes_by_phase(q, -delay) for q in drawn.q]
        else:
            paths += [motion_features.paths(q, _OF_DRAWN_S) for q in drawn.q]
        drawn.q.clear()
        like, seen, targets = features[:, 5:], measured[5:], np.array(drawn.targets)
        if near is not None and found is not None:
            likely = _likeliest(
                features, targets, np.array(paths), measured, motion_features.paths(motion_features.q, _OF_DRAWN_S)
            )
            like, seen = np.concatenate([like, likely[:-1]], axis=1), np.concatenate([seen, likely[-1]])
        found = regress_near(like, targets, seen)
        moved = measured[:2] + found.value[:2] - centre
        centre = centre + moved
        # the last change of a clearance shows how far it has converged
        deviation = np.hypot(found.deviation[:2], moved)
        if near is None and len(features) <= tuning.DRAWS[0] and found.distance > tuning.NOT_HARD:
            return None
        if near is not None:
            drawn.spread = drawn.spread.narrowed(found)
            followed = found.value[5] > math.log(tuning.FITTED) and deviation.max() < tuning.ENOUGH_FOR_FIT
            if len(rounds) == 3 and count == tuning.DRAWS[2] and not followed:
                rounds.append((tuning.DRAWS[3], tuning.DRAWN_CLEARANCE[3]))
    assert found is not None
    # a large last change indicates a false result
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
        motion_features.noise,
        found.distance,
        path_deviate(motion_features.paths(motion_features.q, _LAGS_S), features[:, 5:], paths, measured[5:]),
        law,
        # near an earlier estimate the odds are not tested, because their limit was tuned for searches without one
        odds if near is None else -math.inf,
        *hidden_by_geometry(unknowns, poses, period, measured[:2]),
        _follows(drawn, centre, delay, measured[:2], seed),
    )


def _follows(drawn: _Drawn, centre: Array, delay: float, reach: Array, seed: int) -> Array:
    """Return `Bounced.follows`, from motions between walls that are farther apart than the measured motion shows."""
    shares = np.ones(2)
    for axis, farther in enumerate(np.diag([tuning.FARTHER, tuning.FARTHER])):
        others = _Drawn(drawn.forward, drawn.unknowns, drawn.motion_features, drawn.spread, np.random.default_rng(seed))
        others.add(WIDTH, centre + farther, 0.0, delay, 0)
        if others.features:
            moved = np.array(others.features)[:, axis].mean() - reach[axis]
            shares[axis] = float(moved) / tuning.FARTHER
    return shares


def by_range(unknowns: Unknowns, poses: Poses) -> Bounced:
    """Return the result for a hard contact from the range of motion alone, without a measured load.

    The penetration at each wall is assumed to be uniformly distributed between 0 and `tuning.FITTED`.
    """
    span = float(poses.t[-1] - poses.t[0])
    motion_features = MotionFeatures(unknowns, poses, span)
    yielding = tuning.FITTED / math.sqrt(6.0)
    middle, softness, damping, _ = tuning.HARD_DRAWN
    unseen, rounded = hidden_by_geometry(unknowns, poses, span, motion_features.features(motion_features.q)[:2])
    return Bounced(
        range_of_motion(unknowns.scene, poses)[0] - tuning.OVERRATED,
        np.full(2, yielding),
        np.zeros(3),
        np.array([yielding, yielding, yielding / geometry.half_diagonal(unknowns.scene)]),
        (math.log(middle), softness),
        (float(unknowns.nominal()[DAMPING]), damping),
        motion_features.noise,
        unseen=unseen,
        rounded=rounded,
    )


def hidden_by_geometry(unknowns: Unknowns, poses: Poses, period: float, reach: Array) -> tuple[Array, Array]:
    """Return the attributes `unseen` and `rounded` of `Bounced`.

    `reach`, shape (2,), contains the sum of left and right reach, and the sum of bottom and top reach, in m. The head
    always rests on three corners at the same angle, so an error of a side, a scale factor or a corner changes the reach
    like a different clearance. At a rotated wall, it always touches the same pad, which is displaced by half the
    rotation.
    """
    scene = unknowns.scene
    width, height = (deviation_of(scene, path) for path in _SIDES)

    def moved(width: float = 0.0, height: float = 0.0, scale: Array | float = 0.0) -> Array:
        frame = replace(scene.frame, width_m=scene.frame.width_m + width, height_m=scene.frame.height_m + height)
        other = replace(unknowns, scene=replace(scene, frame=frame))
        motion_features = MotionFeatures(other, poses, period)
        change: Array = np.abs(motion_features.features(motion_features.q * (1.0 + scale))[:2] - reach)
        return change

    turned = np.array(
        [[UNSTATED[f"turn_{wall}"] for wall in walls] for walls in (("left", "right"), ("top", "bottom"))]
    )
    changes = [moved(width), moved(0.0, height), *(moved(scale=scale) for scale in np.diag(priors.SCALES))]
    unseen = np.sqrt(np.square(changes).sum(axis=0) + (0.25 * turned**2).sum(axis=1))
    # a stated radius or deviation of a side includes the effect of rounded corners
    stated = scene.frame.corner_radius_m is not None or any(is_stated(scene, path) for path in _SIDES)
    # the sides stay positive
    across = 0.0 if stated else -min(2.0 * priors.ROUNDING, 0.5 * min(scene.frame.width_m, scene.frame.height_m))
    return unseen, moved(across, across) if across else np.zeros(2)


@dataclass(frozen=True, eq=False)
class _Spread:
    """Distribution of the draws: logarithms of penetration and damping, with `bounds` on the penetration in m."""

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
        mean = np.array([math.log(unknowns.penetration_of(float(vector[SOFTNESS]))), vector[DAMPING]])
        return _Spread(mean, tuning.FIRM_SPREAD[0] * np.array([1.0, float(unknowns.damped)]), _FIRM_BOUNDS)

    def narrowed(self, regressed: _Regressed) -> _Spread:
        _, over, least = tuning.FIRM_SPREAD
        deviation = np.minimum(np.maximum(over * regressed.deviation[5:7], least), self.deviation)
        return _Spread(regressed.value[5:7], deviation, _FIRM_BOUNDS)


class _Drawn:
    """Motions drawn under one contact law, with their features and the targets of the regression."""

    def __init__(
        self, forward: Forward, unknowns: Unknowns, motion_features: MotionFeatures, spread: _Spread,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self.forward, self.unknowns, self.motion_features = forward, unknowns, motion_features
        self.spread, self.rng = spread, rng
        self.features: list[Array] = []
        self.targets: list[Array] = []
        self.changes: list[Array] = []
        self.by_phase: list[Array] = []
        self.q: list[Array] = []
        #: number of motions drawn so far, and number of their solver steps
        self.drawn = self.work = 0

    def add(self, count: int, centre: Array, about: float, delay: float, most_work: int) -> None:
        """Add up to `count` motions, observed with a delay of `delay` s, until the work reaches `most_work`.

        The clearances have the mean `centre` and the standard deviation `about`, both in m.
        """
        work_before = self.forward.work
        if self.drawn:  # as many motions as the work allows, if each takes as many steps as those before
            count = min(count, max(int((most_work - work_before) * self.drawn / max(self.work, 1)), 0))
        motions = [self._draw(centre, about) for _ in range(count)]
        runs = self.motion_features.run(self.forward, [start for *_, start in motions], delay)
        self.drawn += count
        self.work += self.forward.work - work_before
        for q, (clearance, numbers, _) in zip(runs, motions, strict=True):
            if q is not None:
                q = self.motion_features.with_noise(q, self.rng)
                features = self.motion_features.features(q)
                self.features.append(features)
                self.targets.append(np.concatenate([clearance - features[:2], -features[2:5], numbers]))
                self.changes.append(self.motion_features.changes(q))
                self.by_phase.append(self.motion_features.changes_by_phase(q))
                self.q.append(q)

    def _draw(self, centre: Array, about: float) -> tuple[Array, Array, Start]:
        numbers = self._numbers()
        clearance = np.maximum(centre + about * self.rng.standard_normal(2), LEAST_CLEARANCE)
        return clearance, numbers, self.motion_features.start(self.unknowns, clearance, numbers, self.rng)

    def _numbers(self) -> Array:
        mean = np.concatenate([self.spread.mean, np.ones(3)])
        drawn = self.rng.standard_normal(5)
        numbers: Array = mean + np.concatenate([self.spread.deviation, np.full(3, tuning.HARD_DRAWN[3])]) * drawn
        numbers[0] = np.clip(numbers[0], *np.log(self.spread.bounds))
        if self.unknowns.scene.contact.law in OTHER_LAW.values():
            # the damping is a fraction of the critical damping of the drawn stiffness
            critical = self.unknowns.critical_damping(self.unknowns.force / math.exp(numbers[0]))
            numbers[1] = math.log(tuning.LAW_DAMPING[1] * critical) + tuning.LAW_DAMPING[2] * drawn[1]
        return numbers

    def of_other_law(self) -> _Drawn | None:
        other = with_other_law(self.unknowns)
        if other is None:
            return None
        return _Drawn(self.forward.of(other.scene), other, self.motion_features, self.spread, self.rng)

    def like(self) -> Array:
        return np.concatenate([np.array(self.features)[:, 5:], np.array(self.changes)], axis=1)

    def draws(self) -> Draws:
        of_draw = np.array(self.targets)[:, [5, 6, 7, 8, 9, 0, 1]]
        return Draws(np.concatenate([self.like(), np.array(self.by_phase)], axis=1), of_draw)


def _likeliest(features: Array, targets: Array, paths: Array, measured: Array, measured_path: Array) -> Array:
    """Return the most likely clearances minus the reaches in m, shape (n + 1, 2).

    The rows are for the n drawn motions with the paths `paths`, shape (n, lags, k), and for the measured motion with
    the path `measured_path`, shape (lags, k).
    """
    earlier, later = _NO_LAG - 1, _NO_LAG + 1
    paths, measured_path = (path[..., : path.shape[-1] // 2] for path in (paths, measured_path))
    finite = np.isfinite(paths).all(axis=(0, 1)) & np.isfinite(measured_path).all(axis=0)

    def motions(features: Array, paths: Array) -> PathFeatures:
        like = np.concatenate([features[:, :2], features[:, 5:]], axis=1)
        late = (paths[:, later] - paths[:, earlier]) / (_OF_DRAWN_S[later] - _OF_DRAWN_S[earlier])
        return PathFeatures(
            np.concatenate([like, paths[:, _NO_LAG, finite]], axis=1),
            np.concatenate([np.zeros_like(like), late[:, finite]], axis=1),
        )

    reach = features[:, :2]
    drawn = np.concatenate([targets[:, :2] + reach, targets[:, 5:]], axis=1)
    likely = likeliest(
        drawn, tuning.HARD_DRAWN[3], motions(features, paths), motions(measured[None], measured_path[None])
    )
    difference: Array = likely - np.concatenate([reach, measured[None, :2]])
    return difference


def path_delay(motion_features: MotionFeatures, features: Array, drawn: list[Array], measured: Array) -> float:
    """Return the delay in s with which the measured path is nearest to the motions `drawn` without a delay."""
    paths = np.array([motion_features.paths(q, np.zeros(1))[0] for q in drawn])
    measured_path = motion_features.paths(motion_features.q, _LAGS_S)
    finite = np.isfinite(paths).all(axis=0) & np.isfinite(measured_path).all(axis=0)
    if finite.sum() < tuning.PATH_PHASES:
        return 0.0
    value, residual = _Near.to(features, measured).left_over(paths[:, finite])
    square_distance = ((measured_path[:, finite] - value) ** 2 / ((residual**2).mean(axis=0) + _NO_SCATTER)).sum(axis=1)
    # the delay of a sensor cannot be negative
    return max(float(_LAGS_S[int(np.argmin(square_distance))]), 0.0)


def _of_other_law(
    drawn: _Drawn, centre: Array, delay: float, most_work: int, by_odds: bool
) -> tuple[float, float]:  # fmt: skip
    """Return the similarity of the measured motion to motions under the alternative law, and the log odds of this law.

    The similarity comes from a classifier that is trained with draws of both laws (Pudlo et al., Bioinformatics 32
    (2016) 859), the odds from the ratio of the likelihoods. Neither criterion finds all cases. With `by_odds`, clear
    odds after half of the draws end the comparison.
    """
    other, nothing = drawn.of_other_law(), (0.0, -math.inf)
    if other is None:
        return nothing
    motion_features, half = drawn.motion_features, tuning.DRAWS[4] // 2
    q = motion_features.q
    measured = np.concatenate([motion_features.features(q)[5:], motion_features.changes(q)])
    by_phase = np.concatenate([measured, motion_features.changes_by_phase(q)])
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


def class_deviate(own: Array, other: Array, measured: Array) -> float:
    """Return a normal deviate that is large if the features `measured` resemble `other` more than `own`.

    `own` and `other` contain the features of motions under two laws, one motion per row; `measured` has the shape
    (m,). A class label is regressed on the features. The deviate is the distance of the prediction for `measured` from
    the cross-validated predictions for the class `own`.
    """
    features = np.concatenate([own, other])
    sizes = [len(own), len(other)]
    label = np.repeat([0.0, 1.0], sizes)
    weight = np.repeat(0.5 * len(label) / np.array(sizes), sizes)
    z = (features - measured) / (features.std(axis=0) + 1e-12)
    basis = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    inverse, leverage = ridge(basis, tuning.RIDGE[2], weight)
    beta = inverse @ (basis.T @ (weight * label))
    held_out = label - (label - basis @ beta) / (1.0 - np.minimum(leverage, 0.95))
    right = held_out[: len(own)]
    return float((beta[0] - right.mean()) / right.std(ddof=1))


def path_deviate(measured_path: Array, features: Array, drawn: list[Array], measured: Array) -> float:
    """Return the distance of the measured path from the drawn motions as a normal deviate; 0 with too few measurements.

    Nearby drawn motions have distances of the same size if the model is correct.
    """
    # shape (n, lags, parts), with several lags because the delay is not known exactly
    paths = np.array(drawn)
    finite = np.isfinite(paths).all(axis=(0, 1)) & np.isfinite(measured_path).all(axis=0)
    if finite.sum() < tuning.PATH_PHASES:
        return 0.0
    paths = paths[:, :, finite]
    apart = _distance_of_paths(features, paths, measured, measured_path[:, finite])
    distance = (((features - measured) / (features.std(axis=0) + 1e-12)) ** 2).mean(axis=1)
    drawn_apart = []
    for index in np.argsort(distance, kind="stable")[:FEWEST_FOR_SCATTER]:
        others = np.arange(len(features)) != index
        drawn_apart.append(_distance_of_paths(features[others], paths[others], features[index], paths[index]))
    ln_drawn = np.log(drawn_apart)
    return float((math.log(apart) - ln_drawn.mean()) / ln_drawn.std(ddof=1))


def _distance_of_paths(features: Array, paths: Array, measured: Array, measured_path: Array) -> float:
    """Return the mean square distance of the path `measured_path`, (lags, k), from the drawn `paths`, (n, lags, k).

    It is the Mahalanobis distance at the best lag. The covariance of the residuals is shrunk toward equal variances
    (Ledoit and Wolf, J. Multivar. Anal. 88 (2004) 365).
    """
    near = _Near.to(features, measured)
    value, residual = near.left_over(paths[:, _NO_LAG])
    variance = (near.weight[:, None] * residual**2).sum(axis=0) / near.weight.sum()
    deviation = np.sqrt(variance * (1.0 + near.inverse[0, 0]))
    residual *= np.sqrt(near.weight / near.weight.sum())[:, None] / deviation
    share, size = tuning.SHRINKAGE[1], residual.shape[1]
    difference = (measured_path - value) / deviation
    # a path has more numbers than there are draws, so the smaller matrix L L^T is inverted:
    # (a L^T L + b I)^-1 = (I - L^T (b/a I + L L^T)^-1 L) / b
    equal = share * float(np.square(residual).sum()) / size
    among = residual @ residual.T + equal / (1.0 - share) * np.eye(len(residual))
    along = residual @ difference.T
    square = (np.square(difference).sum(axis=1) - (along * np.linalg.solve(among, along)).sum(axis=0)) / equal
    return float(square.min() / measured_path.shape[1])


@dataclass(frozen=True, eq=False)
class _Regressed:
    value: Array
    deviation: Array
    distance: float


@dataclass(frozen=True, eq=False)
class _Near:
    """Matrices of a regression on m features of n draws, in which draws near the measured features have large weights.

    distance : (n,) squared distance of each draw from the measured features
    weight : (n,) weight of each draw
    scale : (m,) scatter of the features
    basis : (n, m + 1) design matrix
    inverse : (m + 1, m + 1) inverse of the normal matrix
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
        """Return the prediction of `targets` (n, k) at the measured features, shape (k,), and the residuals (n, k)."""
        beta = self.inverse @ (self.basis.T @ (self.weight[:, None] * targets))
        return beta[0], targets - self.basis @ beta

    def left_over(self, targets: Array) -> tuple[Array, Array]:
        """Return the prediction of `regress` with leave-one-out residuals."""
        value, error = self.regress(targets)
        residual: Array = error / (1.0 - np.minimum(self.leverage, 0.9))[:, None]
        return value, residual


def regress_near(features: Array, targets: Array, measured: Array) -> _Regressed:
    """Return the values and deviations of k targets that a regression predicts for the features `measured`, shape (m,).

    The arrays `targets`, shape (n, k), and `features`, shape (n, m), belong to n draws. Draws near `measured` have
    large weights.
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

    The logarithm of the squared residuals is regressed on the features (Blum and Francois).
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
    """Division of a load period into parts, for one component of the pose.

    rows : (k,) rows in which the component was measured
    inside : (k,) part of the load period of each row
    size : number of rows in each part, at least 1
    known : whether each part has enough rows
    """

    rows: NDArray[np.int64]
    inside: NDArray[np.int64]
    size: NDArray[np.int64]
    known: NDArray[np.bool_]

    @staticmethod
    def of(rows: NDArray[np.int64], phase: NDArray[np.int64], parts: int) -> _Phases:
        """Return the division of `rows` by the part of the period of every pose, `phase`."""
        count = np.bincount(phase[rows], minlength=parts)
        return _Phases(rows, phase[rows], np.maximum(count, 1), count >= _FEWEST_OF_PHASE)

    def moments(self, values: Array) -> tuple[Array, Array]:
        """Return the mean of `values` in each part minus the mean over all parts, and the variance in each part."""
        value = values[self.rows] - values[self.rows].mean()
        mean = np.bincount(self.inside, value, len(self.size)) / self.size
        square = np.bincount(self.inside, (value - mean[self.inside]) ** 2, len(self.size)) / self.size
        return mean, square


class MotionFeatures:
    """Features of motions that are observed with the times, the gaps and the noise of the sensor."""

    def __init__(self, unknowns: Unknowns, poses: Poses, period: float) -> None:
        self._unknowns, self._t = unknowns, poses.t
        self._there = np.isfinite(poses.q)
        self.q = filled(poses)
        self.noise = noise_level(self.q)
        self._period, self._parts = period, tuning.PATH_PHASES // 2
        #: poses after the first period, which no longer depend on the initial state
        self._settled = poses.t - poses.t[0] >= period
        self._whole = self._there.all(axis=1)
        if self._whole.sum() <= _FEWEST_WHOLE:
            self._whole = np.ones(len(poses.t), np.bool_)
        self._smooth = max(min(smooth_width(poses, tuning.AVERAGED), int(self._whole.sum()) // 8), 1)
        self._reach_phase = ((poses.t[self._whole] - poses.t[0]) / period % 1.0 * tuning.PATH_PHASES).astype(int)
        phase = np.minimum(((poses.t - poses.t[0]) / period % 1.0 * self._parts).astype(int), self._parts - 1)
        self._scattered = [_Phases.of(np.flatnonzero(there), phase, self._parts) for there in self._there.T]
        self._phases: dict[float, list[_Phases]] = {}

    def simulated(
        self, forward: Forward, unknowns: Unknowns, clearance: Array, numbers: Array, rng: np.random.Generator
    ) -> Array | None:
        """Return a simulated motion as the sensor would measure it; None after a failure.

        `clearance` and `numbers` are those of `start`.
        """
        motion_start = self.start(unknowns, clearance, numbers, rng)
        edges, t = np.array([0, len(self._t)]), self._t
        run = forward.run(motion_start.scene, motion_start.gain, t[:1] - _BEFORE, motion_start.state[None], edges, t)
        return None if run is None else self.with_noise(run.q, rng)

    def run(self, forward: Forward, starts: Sequence[Start], delay: float) -> list[Array | None]:
        """Return simulated poses at the times of the measurements minus `delay` s; None after a failure."""
        t = self._t - delay
        return forward.run_many(starts, float(t[0]) - _BEFORE, t)

    def start(self, unknowns: Unknowns, clearance: Array, numbers: Array, rng: np.random.Generator) -> Start:
        """Return scene, load gains and random initial state of a motion.

        `clearance`, shape (2,), is in m. `numbers` contains the logarithms of penetration and damping, and three load
        gains.
        """
        vector = unknowns.nominal()
        vector[[GX, GY]], vector[DAMPING] = clearance, numbers[1]
        vector[GAIN] = np.clip(numbers[2:5], 0.7, 1.3)
        scene = unknowns.scene_of(vector)
        # `scene_of` limits the stiffness, but the decay of bounces depends on larger values
        contact = replace(scene.contact, stiffness=unknowns.force / math.exp(numbers[0]) ** scene.contact.exponent)
        state = np.concatenate([self.q[0], np.zeros(3)])
        state += np.array([1e-3, 1e-3, 4e-3, 0.05, 0.05, 0.2]) * rng.standard_normal(6)
        return Start(replace(scene, contact=contact), vector[GAIN], state)

    def paths(self, q: Array, lags_s: Array) -> Array:
        """Return the path of a motion for each lag, shape (lags, 240)."""
        return np.array([self._path(q, lag_s) for lag_s in lags_s])

    def _path(self, q: Array, lag_s: float) -> Array:
        """Return mean and logarithmic scatter of the pose at each phase of the load, shape (240,).

        The average over all phases is subtracted from the mean. Phases with too few poses are NaN.
        """
        out = np.full((2, tuning.PATH_PHASES, 3), np.nan)
        for i, phases in enumerate(self._phases_at(lag_s)):
            if not phases.known.any():
                continue
            mean, square = phases.moments(q[:, i])
            occupied = phases.known
            out[0, occupied, i] = mean[occupied] - mean[occupied].mean()
            out[1, occupied, i] = 0.5 * np.log(square[occupied] + _NO_SCATTER)
        return out.ravel()

    def _phases_at(self, lag_s: float) -> list[_Phases]:
        if lag_s not in self._phases:
            if len(self._phases) > 2 * len(_OF_DRAWN_S):
                self._phases.clear()
            parts = tuning.PATH_PHASES
            phase = ((self._t - self._t[0] - lag_s) / self._period % 1.0 * parts).astype(int) % parts
            self._phases[lag_s] = [
                _Phases.of(np.flatnonzero(there & self._settled), phase, parts) for there in self._there.T
            ]
        return self._phases[lag_s]

    def with_noise(self, q: Array, rng: np.random.Generator) -> Array:
        """Add noise to a motion so that its estimated noise level equals that of the measurement.

        Bounces raise the estimated noise level, so the added noise is smaller than the measured level.
        """
        noise, white = self.noise, rng.standard_normal(self.q.shape)
        for _ in range(_NOISE_ROUNDS):
            noise = noise * self.noise / np.maximum(noise_level(self._bridged(q + noise * white)), 1e-12)
        return self._bridged(q + noise * white)

    def _bridged(self, q: Array) -> Array:
        return q if self._there.all() else filled(Poses(self._t, np.where(self._there, q, np.nan)))

    def features(self, q: Array) -> Array:
        """Return the features of a motion. The first five are two sums of opposite reaches and three biases."""
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
        for i, phases in enumerate(self._scattered):
            if not phases.known.any():
                scatter += [0.0, 0.0]
                continue
            parts = np.sqrt(phases.moments(q[:, i])[1][phases.known])
            calm = np.sort(parts)[: max(len(parts) // 3, 1)]
            scatter += [math.log(calm.mean() + 1e-9), math.log(parts.mean() + 1e-9)]
        like = [reach[2] - reach[0], reach[2] - reach[1], scatter, averaged.ravel()]
        return np.concatenate([sums, bias, *like])

    def changes(self, q: Array) -> Array:
        """Return logarithms of second differences of pose and reach, which depend on the decay of the bounces."""
        rows = np.concatenate([q, reaches(self._unknowns.scene, q)], axis=1)
        parts = []
        for apart in _CHANGES:
            if len(rows) > 2 * apart + 1:
                change = _second_difference(rows, apart)
                parts += [change.std(axis=0), np.abs(change).mean(axis=0)]
        return np.log(np.concatenate(parts) + 1e-12)

    def changes_by_phase(self, q: Array, lag_s: float = 0.0) -> Array:
        """Return logarithms of second differences of the pose, delayed by `lag_s`, at each phase of the load."""
        phase = ((self._t - self._t[0] - lag_s) / self._period % 1.0 * self._parts).astype(int) % self._parts
        count = np.maximum(np.bincount(phase, minlength=self._parts), 1)
        parts = []
        for apart in _CHANGES_BY_PHASE:
            squares = _second_difference(q, apart) ** 2
            parts += [np.bincount(phase[apart:-apart], column, self._parts) / count for column in squares.T]
        return 0.5 * np.log(np.concatenate(parts) + _NO_SCATTER)

    def _averaged(self, q: Array) -> Array:
        even = np.full(self._smooth, 1.0 / self._smooth)
        if self._smooth > 1:
            q = np.stack([np.convolve(column, even, "valid") for column in q.T], axis=1)
        return _reach(self._unknowns, q)

    def _by_phase(self, q: Array) -> Array:
        """Return mean reaches in m, shape (3, 4), over the load phases with the farthest reaches, at rest."""
        reach, phase = reaches(self._unknowns.scene, q), self._reach_phase
        count = np.bincount(phase, minlength=tuning.PATH_PHASES + 1)
        occupied = count > 0
        means = np.stack(
            [np.bincount(phase, column, len(count))[occupied] / count[occupied] for column in reach.T], axis=1
        )
        means.sort(axis=0)
        parts = [means[-max(int(share * len(means)), 1) :].mean(axis=0) for share in tuning.FARTHEST_PARTS]
        return np.stack(parts)


def _second_difference(rows: Array, apart: int) -> Array:
    """Return second differences of rows with the spacing `apart`, shape (n - 2 apart, k)."""
    change: Array = rows[2 * apart :] - 2.0 * rows[apart:-apart] + rows[: -2 * apart]
    return change


def _reach(unknowns: Unknowns, q: Array) -> Array:
    """Return the reaches to right, left, top and bottom in m between the quantiles of `REACH_WINDOWS`, shape (3, 4)."""
    ordered = np.sort(reaches(unknowns.scene, q), axis=0)
    count = len(ordered)
    windows = [
        ordered[int(low * count) : max(int(high * count), int(low * count) + 1)] for low, high in tuning.REACH_WINDOWS
    ]
    return np.stack([window.mean(axis=0) for window in windows])
