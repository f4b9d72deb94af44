"""The twin that follows its machine: full twins drawn from what is known, steered by the measured poses.

The members differ in clearances, contact and load gains. They are drawn from the prior at first and from each estimate
that stands from then on; a new ensemble goes once more through the last seconds of load and poses, so it stands where
the machine is. Each pose moves all members by an ensemble Kalman filter with perturbed observations (Burgers et al.,
Mon. Weather Rev. 126 (1998) 1719), late poses through their covariance with the present. A member whose walls the
correction would press on with more than half of the head's weight goes on as it is: behind a hard contact a tenth of a
millimetre would be an impact that never was.

The first member has the middle of all that is known and no drawn noise. It is the median twin: a real motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import ArgumentError
from plow_twin.estimate.estimate import prior_of
from plow_twin.estimate.forces import FEWEST, TOLERANCE, draw_scenes, quantiles
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.similar import Units
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.unknowns import DAMPING, GAIN, Unknowns
from plow_twin.model.geometry import penetration_rows
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.run.batch import TwinBatch

Array = NDArray[np.float64]

#: Members by default.
MEMBERS: Final = 128
#: Seconds of load and poses that a new ensemble goes through: two load periods of the paper.
LOOK_BACK_S: Final = 6.3
#: Seconds of motion that are kept for poses that are late, by their delay among it.
LATEST_S: Final = 0.25
#: Least distance in s of poses that are used: nearer ones tell little more and cost as much.
APART_S: Final = 4e-3
#: Poses from whose quick changes the noise is told: fewest, and most.
_NOISE_ROWS: Final = (20, 400)
#: Share of the head's weight on earth that a correction may press a pair with, beyond its force.
_PRESSED: Final = 0.5
_STANDARD_GRAVITY: Final = 9.81
#: Share of the clearances, as a standard deviation, by which the members of a new ensemble are apart at first, and rows
#: over whose distance the rates of the measured poses are told.
_APART, _RATE_ROWS = 0.12, 5
#: Members that carry the clearance of the prior at least, as a share: of more the poses would be trusted too far.
_FEWEST_CARRY: Final = 0.1
#: Nothing is stated of either.
_NO_LOAD: Final = Load(np.array([0.0, 1.0]), np.zeros((2, 3)))
_NO_POSES: Final = Poses(np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Followed:
    """What is known at some times, from what was measured before each.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Times in s.
    force, low, high : ndarray, shape (n, 8)
        Forces of the median twin and the ends of their 90 % intervals in N.
    clearance : ndarray, shape (n, 2, 3)
        Horizontal and vertical clearance: value, 5 % and 95 % points in m.
    """

    t: Array
    force: Array
    low: Array
    high: Array
    clearance: Array


@dataclass(frozen=True, eq=False)
class Span:
    """What is known of a span of time.

    Attributes
    ----------
    start, end : float
        In s.
    peak, impulse : ndarray, shape (3, 8)
        Largest force in N and impulse in N s of each pair: of the median twin, 5 % and 95 % points.
    """

    start: float
    end: float
    peak: Array
    impulse: Array


class Follower:
    """Follows one machine: takes in load, poses and estimates in order of time, tells forces and clearances.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    members : int
        Twins, at least 20.
    start : float
        Time in s at which the scene's initial state holds.
    seed : int
        Of all that is drawn.

    Raises
    ------
    ArgumentError
        For too few members.
    """

    def __init__(self, scene: Scene, members: int = MEMBERS, *, start: float = 0.0, seed: int = 0) -> None:
        if members < FEWEST:
            raise ArgumentError(f"members: got {members}, expected at least {FEWEST}")
        self._scene, self._members, self._seed = scene, members, seed
        self._prior = prior(scene)
        self._start = start
        self._load = Rows()
        self._poses = Rows()
        #: the estimate that is followed; None: the prior
        self.estimate: Estimate | None = None
        self._known = self._prior
        self._ensemble = Ensemble(scene, self._known, members, self._rng(0), start)
        self._taken_over = 0
        self._span_start = start

    def _rng(self, count: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, count])

    @property
    def time(self) -> float:
        """Model time in s."""
        return self._ensemble.time

    def clearance(self) -> Array:
        """Return horizontal and vertical clearance, each with its 5 % and 95 % points, shape (2, 3), in m."""
        if self.estimate is None and self._ensemble.steered:
            return self._ensemble.clearance()
        known = self._known
        return np.array([[value.mean, value.p05, value.p95] for value in (known.horizontal, known.vertical)])

    def advance(self, t: Array, wrench: Array) -> Followed:
        """Advance through samples of the load believed, `t` (n,) in s and `wrench` (n, 3) in N, N, N m."""
        self._load.add(t, wrench, float(t[-1]) - LOOK_BACK_S)
        force, low, high = self._ensemble.advance(t, wrench)
        return Followed(t, force, low, high, np.repeat(self.clearance()[None], len(t), axis=0))

    def held(self, t: float) -> Followed:
        """Return what is known at a time after the newest sample, which is held; nothing changes."""
        force, low, high = self._ensemble.held(t)
        return Followed(np.array([t]), force, low, high, self.clearance()[None])

    def span(self) -> Span:
        """Return peaks and impulses since the call before; what a new ensemble has not gone through is left out."""
        start, self._span_start = self._span_start, self.time
        return Span(start, self.time, *self._ensemble.span())

    def take_pose(self, t: float, q: Array) -> None:
        """Take in a pose that was measured at `t` in s, not later than the present, NaN where it was not."""
        if len(self._poses.t) and t - self._poses.t[-1] < APART_S:
            return
        self._poses.add(np.array([t]), q[None], self.time - LOOK_BACK_S)
        noise, bias, delay = self._sensor()
        if noise is not None:
            self._ensemble.take_pose(t - delay, q - bias, noise)

    def take_estimate(self, found: Estimate) -> bool:
        """Take over an estimate if it says more than what is followed; return whether the ensemble is another one.

        One that is withdrawn lets the prior hold again.
        """
        told = [found.horizontal_state.known, found.vertical_state.known]
        if State.WITHDRAWN in (found.horizontal_state, found.vertical_state):
            if self.estimate is None:
                return False
            self.estimate, self._known = None, self._prior
        elif all(told) or (self.estimate is None and any(told)):
            self.estimate = found
            self._known = _whole(found, self._prior)
        else:
            return False
        self._begin_anew()
        return True

    def restart(self, scene: Scene) -> None:
        """Go on with another machine: what was estimated of the one before holds no longer."""
        self._scene, self._prior = scene, prior(scene)
        self.estimate, self._known = None, self._prior
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Let an ensemble drawn from what is known now go through the newest load and poses."""
        self._taken_over += 1
        load, poses = self._load, self._poses
        begin = float(load.t[0]) if len(load.t) else self._start
        rng = self._rng(self._taken_over)
        ensemble = Ensemble(self._scene, self._known, self._members, rng, begin)
        noise, bias, delay = self._sensor()
        if noise is not None and begin > self._start:
            ensemble.scatter(poses.rates(_RATE_ROWS))
        for rows, used in in_turn(load.t, poses.t):
            if load.t[rows][-1] <= self._span_start:
                ensemble.span()
            ensemble.advance(load.t[rows], load.values[rows], told=False)
            for index in range(used.start, used.stop):
                if noise is not None:
                    ensemble.take_pose(float(poses.t[index]) - delay, poses.values[index] - bias, noise)
        self._ensemble = ensemble

    def _sensor(self) -> tuple[Array | None, Array, float]:
        """Return noise, None where too little was measured to tell, bias and delay of the sensor."""
        found = self.estimate
        noise: Array | None = None
        if found is not None and found.noise is not None:
            noise = np.array(found.noise)
        else:
            whole = self._poses.values[np.isfinite(self._poses.values).all(axis=1)][-_NOISE_ROWS[1] :]
            if len(whole) >= _NOISE_ROWS[0]:
                noise = noise_level(whole)
        if noise is None or not noise.all():
            return None, np.zeros(3), 0.0
        if found is None:
            return noise, np.zeros(3), 0.0
        bias = [0.0 if value is None else value.mean for value in (found.bias_x, found.bias_y, found.bias_theta)]
        return noise, np.array(bias), 0.0 if found.delay is None else max(found.delay.mean, 0.0)


class Rows:
    """The newest rows of a stream: `t` (n,) in s, `values` (n, 3)."""

    def __init__(self) -> None:
        self.t, self.values = np.zeros(0), np.zeros((0, 3))

    def add(self, t: Array, values: Array, oldest: float) -> None:
        """Add rows, and drop those before `oldest`."""
        first = int(np.searchsorted(self.t, oldest, side="left"))
        self.t = np.append(self.t[first:], t)
        self.values = np.concatenate([self.values[first:], values])

    def rates(self, apart: int) -> Array:
        """Return the root mean square of the rates over so many rows, shape (3,), 0 where too few were measured."""
        if len(self.t) <= apart:
            return np.zeros(3)
        rate = (self.values[apart:] - self.values[:-apart]) / (self.t[apart:] - self.t[:-apart])[:, None]
        rate = np.where(np.isfinite(rate), rate, 0.0)
        found: Array = np.sqrt((rate**2).mean(axis=0))
        return found


def in_turn(load: Array, poses: Array) -> list[tuple[slice, slice]]:
    """Return samples of a load and the poses that follow upon them, in turn, by their stamps in s.

    A pose follows upon the first sample that is not earlier: a twin goes no further than its load is known.
    """
    places = np.searchsorted(load, poses, side="left")
    ends = np.append(np.unique(places[places < len(load)]) + 1, len(load))
    out, first = [], 0
    for end in ends.tolist():
        if end > first:
            used = slice(*np.searchsorted(places, [first, end], side="left").tolist())
            out.append((slice(first, end), used))
            first = end
    return out


class Ensemble:
    """Twins drawn from what is known; the first has its middle."""

    def __init__(self, scene: Scene, known: Estimate, members: int, rng: np.random.Generator, start: float) -> None:
        scenes, gain = draw_scenes(scene, known, members, rng)
        scenes[0], gain[0] = middle_of(scene, known)
        self._twins = TwinBatch(scenes, tol=TOLERANCE, start=start)
        self._gain, self._rng = gain, rng
        self._walls = np.stack([penetration_rows(one) for one in scenes])
        self._clearance = np.array([[one.clearance.horizontal_m, one.clearance.vertical_m] for one in scenes])
        weight = _PRESSED * scene.head.mass_kg * _STANDARD_GRAVITY
        stiffness, exponent = np.array([one.contact.stiffness for one in scenes])[:, None], scene.contact.exponent
        self._pressed = stiffness, exponent, weight
        self._good = np.ones(members, dtype=bool)
        self._peak, self._impulse = np.zeros((members, PAIR_COUNT)), np.zeros((members, PAIR_COUNT))
        #: squares of each member's normalised innovations
        self._square = np.zeros(members)
        #: times and poses (h, m, 3) of the newest seconds, oldest first, and the present rates (m, 3)
        self._t, self._q = np.array([start]), np.zeros((1, members, 3)) + np.array(scene.initial.q)
        self._v = np.zeros((members, 3)) + np.array(scene.initial.v)
        self._depth = self._penetration(self._q[-1])

    @property
    def time(self) -> float:
        """Model time in s."""
        return self._twins.time

    @property
    def steered(self) -> bool:
        """Whether any pose has moved the members."""
        return bool(self._square.any())

    def advance(self, t: Array, wrench: Array, told: bool = True) -> tuple[Array, Array, Array]:
        """Advance all members; return forces of the first and the ends of their intervals, (n, 8) each, if `told`."""
        batch = self._twins.advance_samples(t, wrench * self._gain[:, None, :])
        self._good &= (batch.status == 0).all(axis=1)
        np.maximum(self._peak, batch.peak.max(axis=1), out=self._peak)
        self._impulse += batch.impulse.sum(axis=1)
        kept = self._t > t[-1] - LATEST_S
        self._t = np.append(self._t[kept], t)
        self._q = np.concatenate([self._q[kept], batch.q.transpose(1, 0, 2)])
        self._v, self._depth = batch.v[:, -1].copy(), batch.penetration[:, -1].copy()
        return self._points(batch.force) if told else (self._v,) * 3

    def held(self, t: float) -> tuple[Array, Array, Array]:
        """Return the same at a later time with the newest sample held; nothing changes."""
        before = self._twins.snapshot()
        batch = self._twins.advance(t)
        self._twins.restore(before)
        return self._points(batch.force)

    def span(self) -> tuple[Array, Array]:
        """Return peaks and impulses since the call before: of the first member and the points, (3, 8) each."""
        told = np.stack(self._points(self._peak)), np.stack(self._points(self._impulse))
        self._peak[:], self._impulse[:] = 0.0, 0.0
        return told

    def _points(self, force: Array) -> tuple[Array, Array, Array]:
        low, _, high = quantiles(force[self._good] if self._good.sum() >= FEWEST else force)
        return force[0].copy(), np.minimum(low, force[0]), np.maximum(high, force[0])

    def clearance(self) -> Array:
        """Return the clearances with their 5 % and 95 % points, (2, 3), of the members that foretell the poses best.

        The likelihoods are tempered until enough members carry the interval.
        """
        excess = self._square - self._square[self._good].min(initial=np.inf)
        low, high = 0.0, 1.0
        fewest = _FEWEST_CARRY * len(excess)
        for _ in range(40):
            share = 0.5 * (low + high)
            weight = np.where(self._good, np.exp(-0.5 * share * np.minimum(excess, 1e9)), 0.0)
            enough = weight.sum() ** 2 > fewest * (weight**2).sum()
            low, high = (share, high) if enough else (low, share)
        weight = np.where(self._good, np.exp(-0.5 * low * np.minimum(excess, 1e9)), 0.0)
        out = np.zeros((2, 3))
        for axis, values in enumerate(self._clearance.T):
            order = np.argsort(values)
            share = np.cumsum(weight[order]) / weight.sum()
            out[axis] = values[order[np.searchsorted(share, [0.5, 0.05, 0.95]).clip(0, len(order) - 1)]]
        return out

    def scatter(self, rate: Array) -> None:
        """Set the members apart about the middle of the cavity, with rates that scatter by `rate`, shape (3,)."""
        white = self._rng.standard_normal((len(self._twins), 6))
        turn = self._clearance.min(axis=1) / np.abs(self._walls[:, :2]).max(axis=(1, 2))
        room = _APART * np.column_stack([self._clearance, turn])
        q, v = room * np.clip(white[:, :3], -2.0, 2.0), rate * white[:, 3:]
        clear = (self._penetration(q) < 0.0).all(axis=1)
        q[~clear] = 0.0
        q[0], v[0] = 0.0, 0.0
        self._put(np.arange(len(q)), q, v)

    def take_pose(self, t: float, q: Array, noise: Array) -> None:
        """Move the members toward a pose measured at `t`, by their covariance with it; too late ones tell nothing."""
        there = np.flatnonzero(np.isfinite(q))
        if t <= self._t[0] or not len(there):
            return
        after = min(int(np.searchsorted(self._t, t)), len(self._t) - 1)
        share = min((t - self._t[after - 1]) / (self._t[after] - self._t[after - 1]), 1.0)
        then = ((1.0 - share) * self._q[after - 1] + share * self._q[after])[:, there]
        white = self._rng.standard_normal((len(then), len(there)))
        white[0] = 0.0
        off = q[there] - then
        self._square += ((off / noise[there]) ** 2).sum(axis=1)
        state = np.concatenate([self._v, *self._q[max(after - 1, 0) :]], axis=1)
        use = self._good if self._good.sum() >= FEWEST else np.ones(len(state), dtype=bool)
        about, seen = state - state[use].mean(axis=0), then - then[use].mean(axis=0)
        scatter = seen[use].T @ seen[use] / (use.sum() - 1) + np.diag(noise[there] ** 2)
        weight = np.linalg.solve(scatter, seen[use].T @ about[use] / (use.sum() - 1))
        moved = state + (off + noise[there] * white) @ weight
        v, places = moved[:, :3], moved[:, 3:].reshape(len(moved), -1, 3).transpose(1, 0, 2)
        allowed = np.flatnonzero(self._allowed(places[-1]))
        self._q[len(self._q) - len(places) :, allowed] = places[:, allowed]
        self._put(allowed, places[-1, allowed], v[allowed])

    def _allowed(self, q: Array) -> NDArray[np.bool_]:
        """Tell which members may be put to poses (m, 3): no pair is pressed much more than it is."""
        stiffness, exponent, weight = self._pressed
        now, then = (np.maximum(depth, 0.0) ** exponent for depth in (self._depth, self._penetration(q)))
        return np.asarray((stiffness * (then - now) < weight).all(axis=1))

    def _put(self, which: NDArray[np.int64], q: Array, v: Array) -> None:
        self._twins.move(which, q, v)
        self._q[-1, which], self._v[which] = q, v
        self._depth = self._penetration(self._q[-1])

    def _penetration(self, q: Array) -> Array:
        """Return the penetration of each pair in m, (m, 8), with each member's clearances at poses of shape (m, 3)."""
        x, y, theta = q.T
        c, s = np.cos(theta), np.sin(theta)
        body = np.stack([c, s, c * x + s * y, -s * x + c * y, np.ones(len(q))], axis=1)
        found: Array = np.einsum("mi,mij->mj", body, self._walls)
        return found


def prior(scene: Scene) -> Estimate:
    """Return what is known of a scene before anything is measured, its damping and the load's gains among it."""
    units = Units.of(scene, _NO_LOAD)
    unknowns = Unknowns.stated(units.scene(scene), _NO_LOAD, _NO_POSES)
    normal = [Interval.normal(*pair) for pair in zip(unknowns.nominal(), unknowns.deviations(), strict=True)]
    damping = None
    if unknowns.damped:
        value = normal[DAMPING]
        damping = Interval(*(unknowns.damping_of(number) for number in (value.mean, value.p05, value.p95)))
    fx, fy, m = normal[GAIN]
    known = replace(prior_of(unknowns, (0.0, 0.0), 0), damping=damping, gain_fx=fx, gain_fy=fy, gain_m=m)
    return known if units == Units() else units.in_si(known, scene)


def _whole(found: Estimate, known: Estimate) -> Estimate:
    """Return an estimate with damping and gains of the prior where it tells none."""
    return replace(
        found,
        damping=found.damping or known.damping,
        gain_fx=found.gain_fx or known.gain_fx,
        gain_fy=found.gain_fy or known.gain_fy,
        gain_m=found.gain_m or known.gain_m,
    )


def middle_of(scene: Scene, known: Estimate) -> tuple[Scene, Array]:
    """Return the scene and the gains of the load, shape (3,), that an estimate has in its middle."""
    if known.horizontal_state is State.PRIOR:
        return replace(scene, loads=(), wear=None), np.ones(3)

    def point(value: Interval) -> Interval:
        return Interval(value.mean, value.mean, value.mean)

    middle = replace(
        known,
        horizontal=point(known.horizontal),
        vertical=point(known.vertical),
        stiffness=point(known.stiffness),
        damping=known.damping and point(known.damping),
        gain_fx=known.gain_fx and point(known.gain_fx),
        gain_fy=known.gain_fy and point(known.gain_fy),
        gain_m=known.gain_m and point(known.gain_m),
    )
    scenes, gain = draw_scenes(scene, middle, 1, np.random.default_rng(0))
    return scenes[0], gain[0]
