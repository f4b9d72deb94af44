"""The twins (members) of a follower, drawn from a prior or an estimate and moved by an ensemble Kalman filter.

The filter uses perturbed observations (Burgers et al., Mon. Weather Rev. 126 (1998) 1719). A late pose corrects the
present state through the covariance between past and present states. With a hard contact, a correction of a tenth of a
millimetre can cause a false impact, so a correction is skipped if it would press a member against a wall with more than
half of the head's weight.

Parameters that an estimate hardly determines are learned from the poses (module `learned`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.discrepancy import CREEP, FRICTION
from plow_twin.estimate.forces import FEWEST, amplitudes_of, draw_biases, draw_scenes, loads_of, quantiles
from plow_twin.estimate.learned import Learner, biases_of, numbers_of, with_numbers
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.unknowns import QUANTITIES
from plow_twin.model.geometry import factors_of, penetration_rows, penetrations_at_centre, wall_distances
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import DOF_NAMES, Friction, Gravity, Scene, Wear, fastest_travel, variants
from plow_twin.run.batch import TwinBatch
from plow_twin.run.twin import Twin
from plow_twin.solve.compiled_scene import compile_scene, compile_scenes, options
from plow_twin.solve.state import ADVANCE, FOLLOWED, WITH_INTERVALS
from plow_twin.stream.driven import MOST_STEPS
from plow_twin.stream.outputs import clearances

Array = NDArray[np.float64]
Rows = NDArray[np.void]

#: Upper bound on the age in s of a pose that is used, including the delay of the sensor.
LATEST_S: Final = 0.25
#: Lower bound on the interval in s between stored states of the motion.
_PATH_S: Final = 2e-3
#: Upper bound on the number of consecutive outliers that are ignored. After more outliers, the head has really moved.
_MOST_OUTLYING: Final = 5
#: Lower bound on the number of members that adopt parameters in one call. A call costs as much as three members.
_AT_ONCE: Final = 8
_ALL: Final = slice(None)
#: Accuracy of the share by which a pose is scaled, by definition: of a clearance of 100 mm, it is a nanometre.
_SHARE: Final = 1e-8
#: Smallest probability of a difference that members have, by definition of the median probability model.
_PROBABLE: Final = 0.5
#: Lower bound on the friction coefficient of a member, because all members must have the same terms.
_LEAST_FRICTION: Final = 1e-3
_THETA: Final = DOF_NAMES.index("theta")


class Ensemble:
    """Twins drawn from a prior or an estimate; the first twin has the median of each parameter.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    estimate : Estimate
        The prior with the clearances of unworn pads, or an estimate with the present clearances.
    members : int
        Number of twins.
    rng : numpy.random.Generator
        Generator of the random numbers.
    start : float or None
        Time in s of the scene's initial state. With None, the members are not drawn yet: `draw_piece` draws a part of
        them, and `start_at` must be called before the ensemble is used.
    tol : float
        Tolerance of the solver.
    worn : ndarray, shape (8,)
        Wear depth of the pads in m that belongs to the clearances of the estimate.
    learns : bool
        Whether parameters that an estimate hardly determines are estimated from the poses.
    """

    def __init__(
        self, scene: Scene, estimate: Estimate, members: int, rng: np.random.Generator, start: float | None, tol: float,
        worn: Array, learns: bool = True,
    ) -> None:  # fmt: skip
        self.count = members
        self._pieces = self._draw(scene, estimate, members, rng, tol, worn, learns)
        if start is not None:
            self.start_at(start, worn)

    def draw_piece(self) -> bool:
        """Draw the next of five parts, and return whether there was a part left."""
        return next(self._pieces, False)

    def _draw(
        self, scene: Scene, estimate: Estimate, members: int, rng: np.random.Generator, tol: float, worn: Array,
        learns: bool,
    ) -> Iterator[bool]:  # fmt: skip
        """Draw the members, and yield True after each part."""
        differ = rubs(scene, estimate)
        if differ:
            scene = replace(scene, friction=scene.friction or Friction(0.0))
        scenes, gain = draw_scenes(scene, estimate, members, rng) if members > 1 else ([scene], np.ones((1, 3)))
        yield True
        scenes[0], gain[0] = middle_of(scene, estimate)
        if differ:
            scenes = _with_friction(scenes, estimate, rng)
        #: whether poses move the first member; under the prior, they move the second member, a copy of the first member
        self._steers_first = estimate.horizontal_state is not State.PRIOR
        if not self._steers_first and members > 1:
            scenes[1], gain[1] = scenes[0], gain[0]
        #: part of the estimated clearances due to wear in m, shape (2, 1)
        self.moved_before = np.zeros((2, 1))
        if scene.wear is not None:
            states = (estimate.horizontal_state, estimate.vertical_state)
            self.moved_before = np.where([[state.known] for state in states], widening(scene, worn)[:, None], 0.0)
            scenes = _worn(scenes, scene.wear, self.moved_before)
        #: the first member, which is advanced alone so that its forces are available first
        self.first = Twin(scenes[0], tol=tol, excitation="sampled", max_steps=MOST_STEPS)
        yield True
        self.others: TwinBatch | None = None
        if members > 1:
            compiled = compile_scenes(scenes[1:], tol, sampled=True, kind=options(scenes[1]))
            yield True
            stiff = [member.parts.implicit is not None for member in compiled[1]]
            if any(stiff) and compile_scene(scenes[0], tol, sampled=True).parts.implicit is None:
                # a live twin has no time to compile the kernel of overdamped contacts, which are improbable here
                contact = scenes[0].contact
                companions = [
                    replace(scene, contact=contact) if is_stiff else scene
                    for scene, is_stiff in zip(scenes[1:], stiff, strict=True)
                ]
                scenes = [scenes[0], *companions]
                compiled = compile_scenes(companions, tol, sampled=True, kind=options(companions[0]))
                yield True
            self.others = TwinBatch(scenes[1:], tol=tol, max_steps=MOST_STEPS, compiled=compiled)
            yield True
        self._scene, self._gain, self._rng, self._speed = scene, gain, rng, 0.0
        self._numbers = numbers_of(scenes, gain, draw_biases(estimate, members, rng))
        learns = learns and self._steers_first and members > 1
        self._learner = Learner.of(self._numbers.copy(), 0.0) if learns else None
        # harmonics that the measured load lacks, and their amplitudes of each member in N, N, N m, shape (m, k, 3)
        self._harmonics = estimate.load_harmonics
        self._amplitude = amplitudes_of(estimate, members, rng)
        self._walls = np.repeat(penetration_rows(scene)[None], members, axis=0)
        self._walls[:, 4] = penetrations_at_centre(scene, wall_distances(scenes))
        self._clearance = _clearance_of(scenes)
        self._fastest = np.array([fastest_travel(member.wear, member.contact) for member in scenes])
        self._stiffness, self._exponent = (
            np.array([member.contact.stiffness for member in scenes]),
            scene.contact.exponent,
        )
        self._pressed = tuning.PRESSED * scene.head.mass_kg * Gravity().acceleration_m_s2
        # whether each degree of freedom is free
        self._free = np.array(scene.free)

    def start_at(self, t: float, worn: Array) -> None:
        """Draw all further parts, and set all members to the initial state of the scene at the time `t` [s].

        `worn` are the present wear depths of the pads in m, shape (8,).
        """
        while self.draw_piece():
            pass
        members = self.count
        #: wear depths of the pads at the start in m, shape (8,)
        self.worn_before = worn
        self.first.reset(t, wear_depth=worn)
        if self.others is not None:
            self.others.reset(t, wear_depth=worn)
        # index of the next member that adopts learned parameters, and number of members that are due
        self._turn, self._waiting = 0, 0.0
        if self._learner is not None:
            self._learner.time = t
        # load error of each member in N, N, N m, and its time in s
        self._load_off, self._drifted = np.zeros((members, 3)), t
        self.good = np.ones(members, dtype=bool)
        #: force, and peak and impulse of the span, of each pair of each member
        self._sums = np.zeros((members, 3, PAIR_COUNT))
        self._peak, self._impulse = self._sums[:, 1], self._sums[:, 2]
        #: sum of the squared normalised innovations of each member
        self.square = np.zeros(members)
        #: number of consecutive outliers
        self.outlying = 0
        # `_path`: recent times in s and poses (m, 3) in order of time
        # `_v`, `worn`, `_depth`: present rates (m, 3), wear depths (m, 8) and penetrations (m, 8)
        initial = self._scene.initial
        self._path: deque[tuple[float, Array]] = deque([(t, np.tile(np.array(initial.q), (members, 1)))])
        self._v, self.worn = np.tile(np.array(initial.v), (members, 1)), np.tile(self.worn_before, (members, 1))
        self._depth = self._penetration(self._path[-1][1])
        #: newest rows of all members, from which `settle` copies the state
        self._newest: Rows | None = None

    @property
    def moved(self) -> bool:
        """Whether a pose has moved the members."""
        return bool(self.square.any())

    @property
    def pose(self) -> Array:
        """The present pose of each member, x, y [m] and theta [rad], shape (m, 3)."""
        return self._path[-1][1]

    def set_travel_speed(self, speed_m_s: float) -> None:
        """Set the travel speed along the face, up to the limit of each member's wear and contact."""
        self._speed = speed_m_s
        speeds = np.minimum(speed_m_s, self._fastest)
        self.first.set_travel_speed(float(speeds[0]))
        if self.others is not None:
            self.others.set_travel_speed(speeds[1:])

    def _loads(self, t: Array, wrench: Array, which: slice) -> Array:
        loads = loads_of(t, wrench, self._gain[which], self._harmonics, self._amplitude[which])
        applied: Array = loads + self._load_off[which, None, :]
        return applied

    def advance_first(self, t: Array, wrench: Array, rows: Rows) -> int:
        """Advance the first member, write its rows, shape (n,), and return the number of failed advances."""
        failed, _ = self.first.advance_rows(t, self._loads(t, wrench, slice(1))[0], rows)
        rows["followed"] = FOLLOWED
        return failed

    def advance_others(
        self, t: Array, wrench: Array, rows: Rows, needed: NDArray[np.bool_], ends: NDArray[np.bool_]
    ) -> None:
        """Advance all further members to the time of the first member, and add intervals to the first member's rows.

        `needed` marks the rows that receive intervals, and `ends` the last rows of spans.
        """
        parts = [_bytes(rows[None])]
        if self.others is not None:
            parts.append(_bytes(self.others.advance_samples(t, self._loads(t, wrench, slice(1, None))).rows))
        whole = np.concatenate(parts).view(ADVANCE)[..., 0]
        good = whole["status"] == 0
        if len(self.good) == 1:
            self.good[:] = True
        for place, (now, is_wanted, is_end) in enumerate(zip(t.tolist(), needed.tolist(), ends.tolist(), strict=True)):
            self.good &= good[:, place]
            np.maximum(self._peak, whole["peak"][:, place], out=self._peak)
            self._impulse += whole["impulse"][:, place]
            if is_wanted:
                self._sums[:, 0] = whole["force"][:, place]
                self._add_intervals(rows[place : place + 1])
            if is_end:
                self.begin_span()
            self._store_motion(now, whole["q"][:, place].copy())
        self._newest = whole[:, -1]

    def settle(self) -> None:
        """Copy rates, wear and penetration from the newest rows. Call this before their use."""
        rows, self._newest = self._newest, None
        if rows is not None:
            self._v, self.worn, self._depth = rows["v"].copy(), rows["wear_depth"].copy(), rows["penetration"].copy()

    def _store_motion(self, now: float, q: Array) -> None:
        path = self._path
        if len(path) > 1 and path[-1][0] - path[-2][0] < _PATH_S:
            path.pop()
        path.append((now, q))
        while path[1][0] <= now - LATEST_S:
            path.popleft()

    def _add_intervals(self, row: Rows) -> None:
        _, low, high = self._points(self._sums)
        for index, name in enumerate(("force", "peak", "impulse")):
            row[f"{name}_low"], row[f"{name}_high"] = low[index], high[index]
        if np.isfinite(low.sum() + high.sum()):
            row["followed"] = WITH_INTERVALS

    def held(self, t: float, row: Rows) -> None:
        """Write the row that the constant load of the newest sample gives at `t`; the state does not change."""
        state = self.twins()
        row[:] = self.first.advance(t).rows
        self._sums[0, 0] = row["force"][0]
        if self.others is not None:
            self._sums[1:, 0] = self.others.advance(t).force[:, 0]
        self.set_twins(state)
        self._add_intervals(row)

    def begin_span(self) -> None:
        """Begin a new span of peaks and impulses."""
        self._peak[:], self._impulse[:] = 0.0, 0.0

    def span(self) -> tuple[Array, Array]:
        """Return peaks and impulses of the span, shape (3, 8) each: first member, 5 % and 95 % quantiles."""
        return np.stack(self._points(self._peak)), np.stack(self._points(self._impulse))

    def _points(self, values: Array) -> tuple[Array, Array, Array]:
        """Return the values of the first member, and the 5 % and 95 % quantiles, widened to include these values."""
        low, _, high = quantiles(values if self.good.all() else values[self._used()])
        return values[0].copy(), np.minimum(low, values[0]), np.maximum(high, values[0])

    def _used(self) -> NDArray[np.bool_]:
        return self.good if self.good.any() else np.ones(len(self.good), dtype=bool)

    def clearance(self) -> Array:
        """Return the clearances of unworn pads in m, shape (2, 3): value, 5 % and 95 % quantile.

        Members are weighted by the likelihood of the measured poses, which is tempered so that enough members count.
        """
        use = self._used()
        excess = np.clip(self.square - self.square[use].min(), 0.0, 1e9)
        low, high = 0.0, 1.0
        for _ in range(40):
            share = 0.5 * (low + high)
            weight = np.where(use, np.exp(-0.5 * share * excess), 0.0)
            enough = weight.sum() ** 2 > FEWEST * (weight**2).sum()
            low, high = (share, high) if enough else (low, share)
        weight = np.where(use, np.exp(-0.5 * low * excess), 0.0)
        out = np.zeros((2, 3))
        for axis, values in enumerate(self._clearance.T):
            order = np.argsort(values)
            share = np.cumsum(weight[order]) / weight.sum()
            out[axis] = values[order[np.searchsorted(share, [0.5, 0.05, 0.95]).clip(0, len(order) - 1)]]
        return out

    def start_from(self, previous: Ensemble, wrench: Array, *, joins: bool = False) -> None:
        """Start from the state of the members `previous`, under the load `wrench`.

        If `joins` is set, further members join the first member, whose state does not change.

        The poses are scaled to the clearances. Measured poses move the second member under a prior, and the first
        member under an estimate. If an estimate replaces a prior, the new first member therefore starts at the pose of
        the old second member, and vice versa.
        """
        previous.settle()
        from_ = np.where(previous.good, np.arange(len(previous.good)), int(np.argmax(previous.good)))
        from_ = np.resize(from_, len(self.good))
        if self._steers_first and not previous._steers_first and len(previous.good) > 1 and previous.good[1]:
            from_[0] = 1
        if previous._steers_first and not self._steers_first and previous.good[0]:
            from_[1:2] = 0
        share = self._shares(previous._room()[from_])
        self._load_off = previous._load_off[from_]
        loads = self._loads(np.array([self.first.time]), wrench[None], _ALL)[:, 0]
        self.first.advance(self.first.time, loads[0])
        if self.others is not None:
            self.others.set_wrench(loads[1:])
        self._path = _scaled(previous._path, from_, share)
        self._sums[1:], self._sums[0] = previous._sums[from_[1:]], previous._sums[0]
        self._move_toward(self._path[-1][1], previous._v[from_], previous._force(previous._depth)[from_])
        if joins:
            self.first = previous.first
        if self._learner is not None and previous._learner is not None:
            self._learner.take_over(previous._learner)
            self._take_numbers(np.arange(len(self.good)))
        elif self.others is None and previous._learner is not None:
            # a single twin continues with the parameters of the first member
            self._set_numbers(np.zeros(1, np.int64), previous._numbers[:1])

    def move_near(self, q: Array, v: Array) -> None:
        """Move each member to the pose `q`, scaled to its clearances."""
        places = q * self._shares(np.broadcast_to(self._room()[0], (len(self.good), 3)))
        force = self._force(self._penetration(places))[:1]
        self._move_toward(places, np.tile(v, (len(places), 1)), np.tile(force, (len(places), 1)))

    def _room(self) -> Array:
        """Return horizontal, vertical and smaller clearance in m, shape (m, 3), but 1 for a locked direction."""
        room = np.column_stack([self._clearance, self._clearance.min(axis=1)])
        return np.where(self._free, room, 1.0)

    def _shares(self, room: Array) -> Array:
        """Return the scales of `_room` divided by those of other members, shape (m, 3)."""
        return np.divide(self._room(), room, out=np.ones_like(room), where=room > 0.0)

    def _move_toward(self, q: Array, v: Array, force: Array, which: NDArray[np.int64] | None = None) -> None:
        """Move members toward the poses `q` until a pair would bear much more than `force` [N], shape (m, 8)."""
        which = np.arange(len(q)) if which is None else which
        q, v, force = q[which], v[which], force[which]
        share, bound = np.ones(len(q)), np.flatnonzero(~self._allowed(q, force, which))
        if len(bound):
            share[bound] = self._largest_share(q[bound], force[bound], which[bound])
        self._put(which, self._nearer(q, share), v)

    def _largest_share(self, q: Array, force: Array, which: NDArray[np.int64]) -> Array:
        """Return the largest share, (m,), by which poses may be scaled so that no pair bears much more than `force`.

        The share lies between `low` and `high`. Each pass tries their middle, and both sides of the share at which a
        pair would reach the force if its penetration were linear in the share.
        """
        limit = ((force + self._pressed) / self._stiffness[which, None]) ** (1.0 / self._exponent)
        low, high = np.zeros(len(q)), np.ones(len(q))
        while (high - low).max() > _SHARE:
            ends = self._penetrations(q, np.stack([low, high]), which)
            growth, reached = ends[1] - ends[0], ends[1] >= limit
            part = np.divide(limit - ends[0], growth, out=np.ones_like(growth), where=reached & (growth > 0.0))
            width = high - low
            cut = low + width * part.min(axis=1).clip(0.0, 1.0)
            curved = np.maximum(tuning.CURVED * width**2, 0.5 * _SHARE)
            tried = np.stack([cut - curved, cut + curved, 0.5 * (low + high)]).clip(low, high)
            allowed = (self._penetrations(q, tried, which) < limit).all(axis=2)
            low = np.where(allowed, tried, low).max(axis=0)
            high = np.where(allowed, high, tried).min(axis=0)
        return low

    def _penetrations(self, q: Array, share: Array, which: NDArray[np.int64]) -> Array:
        """Return the penetrations in m, shape (k, m, 8), at the poses `q`, (m, 3), scaled by shares, (k, m)."""
        places = self._nearer(np.tile(q, (len(share), 1)), share.ravel())
        return self._penetration(places, np.tile(which, len(share))).reshape(*share.shape, PAIR_COUNT)

    def _nearer(self, q: Array, share: Array) -> Array:
        """Return poses that are scaled toward the middle by `share`, shape (m,), in the free directions."""
        return np.where(self._free, share[:, None] * q, q)

    def correct(self, t: float, q: Array, noise: Array, load_error: Array) -> bool:
        """Correct the members with a pose that was measured at time `t`, and return whether the pose was used.

        The errors of the members' loads, with the standard deviation `load_error` in N, N, N m, shape (3,), are
        corrected too. A late pose is not used; an outlier is used only after several consecutive outliers.
        """
        self.settle()
        finite = np.flatnonzero(np.isfinite(q) & self._free)
        times = [time for time, _ in self._path]
        if t <= times[0] or not len(finite):
            return False
        upper = min(bisect_left(times, t), len(times) - 1)
        path = np.stack([self._path[index][1] for index in range(upper - 1, len(times))])
        share = min((t - times[upper - 1]) / (times[upper] - times[upper - 1]), 1.0)
        # pose that the sensor of each member would have measured
        predicted = ((1.0 - share) * path[0] + share * path[1] + biases_of(self._numbers))[:, finite]
        since = self.first.time - self._drifted
        self._drift(load_error)
        state = np.concatenate([self._v, *path, self._load_off], axis=1)
        use = self._steering()
        own_state, own_poses = state[use], predicted[use]
        middle = own_poses.mean(axis=0)
        centred_poses, freedom = own_poses - middle, max(len(own_poses) - 1, 1)
        scatter = centred_poses.T @ centred_poses / freedom + np.diag(noise[finite] ** 2)
        center = _difference(q, middle, finite)
        if (np.abs(center) <= tuning.OUTLYING * np.sqrt(np.diag(scatter))).all():
            self.outlying = 0
        else:
            self.outlying += 1
            if self.outlying <= _MOST_OUTLYING:
                return False
        white = self._rng.standard_normal((len(predicted), len(finite)))
        white[0] = 0.0
        if self._learner is not None:
            self._learner.add(self._numbers[use], centred_poses, center, noise[finite])
        differences = _difference(q, predicted, finite)
        # limit the influence of a single wrong pose
        most = tuning.OUTLYING * noise[finite]
        self.square += ((differences.clip(-most, most) / noise[finite]) ** 2).sum(axis=1)
        weight = np.linalg.solve(scatter, centred_poses.T @ (own_state - own_state.mean(axis=0)) / freedom)
        weight[:, ~np.tile(self._free, len(path) + 2)] = 0.0
        moved = state + (differences + noise[finite] * white) @ weight
        v, places = moved[:, :3], moved[:, 3:-3].reshape(len(moved), -1, 3).transpose(1, 0, 2)
        allowed = np.flatnonzero(self._allowed(places[-1], self._force(self._depth)))
        allowed = allowed[allowed >= 1 - self._steers_first]
        path[:, allowed] = places[:, allowed]
        for place, index in enumerate(range(upper - 1, len(times))):
            self._path[index] = times[index], path[place]
        self._load_off[allowed] = moved[allowed, -3:]
        self._put(allowed, places[-1, allowed], v[allowed])
        self._recover()
        self._learn(since)
        return True

    def _steering(self) -> slice | NDArray[np.bool_]:
        """Return the indices of the members whose scatter corrects all; under a prior, without the first member."""
        use = self._used()
        if not self._steers_first and use[1:].any():
            return slice(1, None) if use[1:].all() else use & (np.arange(len(use)) > 0)
        return _ALL if use.all() else use

    def _drift(self, load_error: Array) -> None:
        """Advance the load errors as Ornstein-Uhlenbeck processes, without noise for the first member."""
        time, drifted = self.first.time, self._drifted
        self._drifted = time
        if load_error.any() or self._load_off.any():
            kept = math.exp(-(time - drifted) / tuning.LOAD_ERROR_LASTS)
            white = self._rng.standard_normal(self._load_off.shape)
            white[0] = 0.0
            self._load_off = kept * self._load_off + math.sqrt(1.0 - kept**2) * load_error * white

    def _learn(self, since: float) -> None:
        """Update the learned parameters every `tuning.LEARNED_EACH` s, and let members adopt the parameters.

        The first member adopts them at once, all further members one after another. `since` is the time in s since the
        previous pose.
        """
        learner, count = self._learner, len(self.good) - 1
        if learner is None:
            return
        due = self.first.time - learner.time >= tuning.LEARNED_EACH
        if due:
            learner.learn(self.first.time)
        self._waiting = min(self._waiting + since / tuning.LEARNED_EACH * count, float(count))
        ready = int(self._waiting) if self._waiting >= _AT_ONCE else 0
        turn = 1 + (self._turn + np.arange(ready)) % count
        self._turn, self._waiting = (self._turn + ready) % count, self._waiting - ready
        which = np.append(0, np.sort(turn)) if due else np.sort(turn)
        if len(which):
            self._take_numbers(which)

    def _take_numbers(self, which: NDArray[np.int64]) -> None:
        assert self._learner is not None
        self._set_numbers(which, self._learner.numbers(which))

    def _set_numbers(self, which: NDArray[np.int64], numbers: Array) -> None:
        """Set the parameters of the members `which` (ascending), and scale their poses to the new clearances.

        A member keeps its parameters if the new values need a different kernel, as an overdamped contact does.
        """
        scenes = [self.first.scene, *(() if self.others is None else self.others.scenes)]
        if not len(which):
            return
        changed, gain = with_numbers([scenes[place] for place in which.tolist()], numbers)
        accepted, lanes = np.ones(len(which), dtype=bool), which > 0
        if self.others is not None:
            accepted[lanes] = self.others.change(which[lanes] - 1, changed[-int(lanes.sum()) :] if lanes.any() else [])
        which, room, force, old_gain = which[accepted], self._room(), self._force(self._depth), self._gain[0].copy()
        if not accepted.any():
            return
        changed = list(compress(changed, accepted))
        self._numbers[which], self._gain[which] = numbers[accepted], gain[accepted]
        self._clearance[which] = _clearance_of(changed)
        self._walls[which, 4] = penetrations_at_centre(changed[0], wall_distances(changed))
        self._fastest[which] = [fastest_travel(scene.wear, scene.contact) for scene in changed]
        self._stiffness[which] = [scene.contact.stiffness for scene in changed]
        if which[0] == 0:
            load = (self.first.wrench - self._load_off[0]) / old_gain * self._gain[0] + self._load_off[0]
            time = self.first.time
            self.first = self.first.like(changed[0])
            self.first.reset(time, wear_depth=self.worn[0], pose=(self.pose[0], self._v[0]))
            self.first.advance(time, load)
        if self._scene.wear is not None:
            self.set_travel_speed(self._speed)
        share = self._shares(room)[which]
        for _, q in self._path:
            q[which] *= share
        self._move_toward(self.pose, self._v, force, which)

    def _recover(self) -> None:
        lost, good_members = np.flatnonzero(~self.good), np.flatnonzero(self.good)
        self.good[:] = True
        if not len(lost) or not len(good_members):
            return
        from_ = np.arange(len(self.good))
        from_[lost] = np.resize(good_members, len(lost))
        share = self._shares(self._room()[from_])
        self._path = _scaled(self._path, from_, share)
        self._move_toward(self._path[-1][1], self._v[from_], self._force(self._depth)[from_], lost)

    def _force(self, depth: Array, which: NDArray[np.int64] | slice = _ALL) -> Array:
        """Return the elastic force of each pair of some members in N, shape (m, 8), from the penetrations in m."""
        force: Array = self._stiffness[which, None] * np.maximum(depth, 0.0) ** self._exponent
        return force

    def _allowed(self, q: Array, force: Array, which: NDArray[np.int64] | slice = _ALL) -> NDArray[np.bool_]:
        """Return whether no pair of a member at the poses `q`, (m, 3), bears much more than `force` [N], (m, 8)."""
        present_force = self._force(self._penetration(q, which), which)
        return np.asarray((present_force < force + self._pressed).all(axis=1))

    def _put(self, which: NDArray[np.int64], q: Array, v: Array) -> None:
        for place in np.flatnonzero(which == 0):
            self.first.move(q[place], v[place])
        lanes = which > 0
        if self.others is not None and lanes.any():
            self.others.move(which[lanes] - 1, q[lanes], v[lanes])
        self._path[-1][1][which], self._v[which] = q, v
        self._depth[which] = self._penetration(q, which)

    def _penetration(self, q: Array, which: NDArray[np.int64] | slice = _ALL) -> Array:
        """Return the penetration of each pair in m, shape (m, 8), for some members at poses `q`, shape (m, 3)."""
        depth: Array = np.einsum("mi,mij->mj", factors_of(self._scene, q), self._walls[which]) - self.worn[which]
        return depth

    def twins(self) -> list[bytes]:
        """Return the exact states of the first twin and of all further twins."""
        return [self.first.snapshot(), b"" if self.others is None else self.others.snapshot()]

    def set_twins(self, states: Sequence[bytes]) -> None:
        """Restore states that `twins` has returned."""
        self.first.restore(states[0])
        if self.others is not None:
            self.others.restore(states[1])

    def learned(self) -> tuple[Array, Array]:
        """Return the parameters of all members, and the state of the learner (empty without a learner)."""
        if self._learner is None:
            return self._numbers, np.zeros(0)
        return self._numbers, np.concatenate([[self._turn, self._waiting], self._learner.state()])

    def state(self) -> tuple[list[bytes], Any]:
        """Return the whole state: arrays as bytes, and the random generator as JSON values."""
        self.settle()
        times, path = np.array([time for time, _ in self._path]), [q.tobytes() for _, q in self._path]
        wide = (self._peak, self._impulse, self._v, self.worn, self._depth, self._load_off)
        learned = self.learned()
        arrays = (self.good, self.square, *wide, np.array([self._drifted]), *learned, times)
        blobs = [*self.twins(), *(array.tobytes() for array in arrays), b"".join(path)]
        return blobs, self._rng.bit_generator.state

    def set_state(self, blobs: list[bytes], random: Any) -> None:
        """Restore a state that `state` has returned."""
        self.good = np.frombuffer(blobs[2], np.bool_).copy()
        count = len(self.good)
        self.square, *wide, drifted, numbers, learned, times, path = (np.frombuffer(blob).copy() for blob in blobs[3:])
        if self._learner is not None:
            self._turn, self._waiting = int(learned[0]), float(learned[1])
            self._learner.set_state(learned[2:])
        numbers = numbers.reshape(count, -1)
        which = np.flatnonzero((numbers != self._numbers).any(axis=1))
        self._set_numbers(which, numbers[which])
        own = [array.reshape(count, -1) for array in wide]
        self._peak[:], self._impulse[:], self._v, self.worn, self._depth, self._load_off = own
        self._drifted = float(drifted[0])
        self._newest = None
        self.set_twins(blobs[:2])
        self._path = deque(zip(times.tolist(), path.reshape(-1, count, 3), strict=True))
        self._rng.bit_generator.state = random


def _scaled(path: Iterable[tuple[float, Array]], from_: NDArray[np.int64], share: Array) -> deque[tuple[float, Array]]:
    """Return a path with the poses of the members `from_`, shape (m,), scaled by `share`, shape (m, 3)."""
    times, poses = zip(*path, strict=True)
    return deque(zip(times, np.stack(poses)[:, from_] * share, strict=True))


def _bytes(rows: Rows) -> NDArray[np.uint8]:
    """Return the fields of `ADVANCE` in rows (m, n) as bytes, which NumPy copies faster than records."""
    views: NDArray[np.uint8] = np.ascontiguousarray(rows)[..., None].view(np.uint8)[..., : ADVANCE.itemsize]
    return views


def _difference(q: Array, others: Array, components: NDArray[np.int64]) -> Array:
    """Return the pose `q` minus the poses `others`, shape (..., k), for k components; angles in [-pi, pi]."""
    difference: Array = q[components] - others
    turn = components == _THETA
    difference[..., turn] = np.remainder(difference[..., turn] + np.pi, 2.0 * np.pi) - np.pi
    return difference


def _clearance_of(scenes: Sequence[Scene]) -> Array:
    return np.array([[scene.clearance.horizontal_m, scene.clearance.vertical_m] for scene in scenes]).reshape(-1, 2)


def _worn(scenes: Sequence[Scene], wear: Wear, moved: Array) -> list[Scene]:
    """Return scenes with wear and with clearances reduced by `moved` in m, shape (2, 1)."""
    horizontal, vertical = np.maximum(_clearance_of(scenes).T - moved, 0.0)
    return variants(scenes, {"clearance": {"horizontal_m": horizontal, "vertical_m": vertical}}, wear=wear)


def widening(scene: Scene, worn: Array) -> Array:
    """Return the growth of the clearances in m, shape (..., 2), due to wear depths `worn` in m, shape (..., 8)."""
    own = np.array([scene.clearance.horizontal_m, scene.clearance.vertical_m])
    offset: Array = clearances(scene, worn)[..., :2] - own
    return offset


def may_rub(scene: Scene) -> bool:
    """Return whether members of a scene can differ in friction.

    Members with wear or with friction that sticks cannot, because they do not share vectors (`solve.lanes`) and would
    take too long.
    """
    return scene.wear is None and (scene.friction is None or scene.friction.stick_stiffness_n_m is None)


def rubs(scene: Scene, estimate: Estimate) -> bool:
    """Return whether members differ in friction, because the machine's friction probably differs from the scene's."""
    return may_rub(scene) and estimate.differs.get(FRICTION, (0.0,))[0] >= _PROBABLE


def compile_friction(scene: Scene, tol: float) -> None:
    """Compile the kernels of members that differ in friction, or load them from the cache on disk."""
    scenes = [replace(scene, friction=Friction(_LEAST_FRICTION), loads=(), wear=None)] * 2
    TwinBatch(scenes, tol=tol).advance(1e-6)
    Twin(scenes[0], tol=tol, excitation="sampled").warm_up()


def _with_friction(scenes: Sequence[Scene], estimate: Estimate, rng: np.random.Generator) -> list[Scene]:
    """Return scenes with friction coefficients drawn about those of the scenes."""
    _, by, deviation = estimate.differs[FRICTION]
    share, faster, _ = estimate.differs.get(CREEP, (0.0, 0.0, 0.0))
    assert scenes[0].friction is not None
    speed = scenes[0].friction.regularisation_speed_m_s * (1.0 + share * faster)
    drawn = scenes[0].friction.coefficient + by + deviation * np.append(0.0, rng.standard_normal(len(scenes) - 1))
    rubbing = {
        "coefficient": np.maximum(drawn, _LEAST_FRICTION),
        "regularisation_speed_m_s": np.full(len(drawn), speed),
    }
    return variants(scenes, {"friction": rubbing})


def middle_of(scene: Scene, estimate: Estimate) -> tuple[Scene, Array]:
    """Return the scene and the load gains, shape (3,), that have the median values of an estimate."""
    if estimate.horizontal_state is State.PRIOR:
        return replace(scene, loads=(), wear=None), np.ones(3)

    def point(value: Interval | None) -> Interval | None:
        return None if value is None else Interval(value.mean, value.mean, value.mean)

    points: dict[str, Any] = {quantity.name: point(getattr(estimate, quantity.name)) for quantity in QUANTITIES}
    middle = replace(estimate, apparent=None, **points)
    scenes, gain = draw_scenes(scene, middle, 1, np.random.default_rng(0))
    return scenes[0], gain[0]
