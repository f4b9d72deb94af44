"""The twin that follows its machine: full twins drawn from what is known, steered by the measured poses.

The members differ in clearances, contact and load gains. They are drawn from the prior at first and from each estimate
that stands from then on; new members begin where those before them stand. Each pose moves all members by an ensemble
Kalman filter with perturbed observations (Burgers et al., Mon. Weather Rev. 126 (1998) 1719), late poses through their
covariance with the present. A member whose walls the correction would press on with more than half of the head's weight
goes on as it is: behind a hard contact a tenth of a millimetre would be an impact that never was.

The first member has the middle of all that is known and no drawn noise. It is the median twin: a real motion. Before
the first estimate it is the nominal twin, which no pose moves: steered to where a machine with other clearances is, it
would press its own walls, and its forces would be further off than those of a twin that does not follow. The second
member is then its double that the poses move, and shows where a first estimate begins.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import time as _time
from bisect import bisect_left, insort
from collections import Counter, deque
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.estimate import tuning
from plow_twin.estimate.estimate import prior_of
from plow_twin.estimate.forces import FEWEST, TOLERANCE, draw_scenes, quantiles
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.similar import Units
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.unknowns import DAMPING, GAIN, Unknowns
from plow_twin.model.geometry import penetration_rows, states_of
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import DOF_NAMES, Clearance, Gravity, Scene, fastest_travel
from plow_twin.run.advance import Advance
from plow_twin.run.batch import TwinBatch
from plow_twin.run.twin import Advanced, Twin
from plow_twin.solve.state import FOLLOWED, ROW, WITH_INTERVALS
from plow_twin.stream.driven import MOST_MEASURED
from plow_twin.stream.outputs import clearances

Array = NDArray[np.float64]
Rows = NDArray[np.void]

#: Definition: members by default.
MEMBERS: Final = 128
#: Bound: seconds of motion that are kept for poses that are late, their delay included.
LATEST_S: Final = 0.25
#: Bound: least distance in s of what is kept of the motion.
_PATH_S: Final = 2e-3
#: Bound: least distance in s of poses that are used; nearer ones tell little more and cost as much.
APART_S: Final = 4e-3
#: Bound: poses from whose quick changes the noise is told: fewest, and most.
_NOISE_ROWS: Final = (20, 400)
#: Bound: outlying poses in a row after which they are used: the head has jumped, a single glitch does not last so long.
_MOST_OUTLYING: Final = 5
#: Bound: samples that are advanced through at once: the rows of all members stay in the processor's cache.
_CALL: Final = 20
#: Definition: what is known of the clearances is told again so often [1/s], as often as it is published.
_KNOWN_HZ: Final = 10.0
#: Bound: poses that wait for the model to reach their stamps; as many as a session keeps to use again.
_MOST_DUE: Final = MOST_MEASURED
_THETA: Final = DOF_NAMES.index("theta")
#: Derived: places of c, s, X, Y in the solver's state.
_PLACES: Final = (5, 6, 0, 1)
#: Definition: one row, which is wanted or not; no digest; clearances that do not move.
_YES: Final = np.ones(1, bool)
_NO: Final = np.zeros(1, bool)
_NO_DIGESTS: Final = np.zeros(0, np.int64)
_UNMOVED: Final = np.zeros(6)
#: Definition: nothing is stated of either.
_NO_LOAD: Final = Load(np.array([0.0, 1.0]), np.zeros((2, 3)))
_NO_POSES: Final = Poses(np.zeros(0), np.zeros((0, 3)))
_LENGTH: Final = struct.Struct("<q")


@dataclass(frozen=True, eq=False)
class Span:
    """Knowledge over a span of time.

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


class _Behind(NamedTuple):
    """Samples that only the first member has been through: times, loads, its rows.

    Which rows are to have intervals, and end a span of peaks and impulses; whether one begins with the first.
    """

    t: Array
    wrench: Array
    rows: Rows
    wanted: NDArray[np.bool_]
    ends: NDArray[np.bool_]
    begins: bool


class Follower:
    """A twin under sampled loads that follows one machine: it takes in poses and estimates too.

    It is driven like a `Twin`. Its motion is that of its first member, which has the middle of what is known.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    members : int
        Twins, at least 20; with 1 the parameters alone follow: no pose moves it, and its forces have no intervals.
    tol : float
        As for `Twin`.
    start : float
        Time in s at which the scene's initial state holds.
    seed : int
        Of all that is drawn.

    Raises
    ------
    ArgumentError
        For too few members.
    """

    excitation: Literal["scene", "sampled"] = "sampled"
    max_evaluations: int | None = None
    #: advances cut short: none
    bounded = 0

    def __init__(
        self, scene: Scene, members: int = MEMBERS, *, tol: float = TOLERANCE, start: float = 0.0, seed: int = 0
    ) -> None:
        if members != 1 and members < FEWEST:
            raise ArgumentError(f"members: got {members}, expected 1 or at least {FEWEST}")
        self.scene, self.tol = scene, tol
        self._members, self._seed = members, seed
        self._prior = prior(scene)
        self._speed = scene.wear.travel_speed_m_s if scene.wear is not None else 0.0
        #: poses and estimates so far, whether they were used or not
        self.added = 0
        #: whether the intervals of the forces are wanted at each row, beside those published
        self.every_row = False
        #: whether a row that is published by itself does not wait for the other members, which `catch_up` advances
        self.defers = False
        self._behind: _Behind | None = None
        #: smallest and largest load so far, shape (2, 3)
        self._range = np.zeros((2, 3))
        self._ends, self._begins = _NO_DIGESTS, False
        self._span_start = start
        self._wrench = np.zeros(3)
        #: poses that have moved the members, poses that are outliers, and poses that were dropped because too many wait
        self.poses_used = self.poses_outlying = self.poses_dropped = 0
        #: times that members were drawn anew
        self.drawn = 0
        self._draw("", start, self._unworn())
        self._forget()

    def _forget(self) -> None:
        """Forget all poses."""
        #: what waits for its time, in order: time in s, number, pose or text of an estimate
        self._due: list[tuple[float, int, list[float] | str]] = []
        #: times of the poses used lately
        self._used: deque[float] = deque()
        self._noise_rows: deque[Array] = deque(maxlen=_NOISE_ROWS[1])

    def _unworn(self) -> Array:
        wear = self.scene.wear
        return np.zeros(PAIR_COUNT) if wear is None else np.array(wear.initial_depth_m, dtype=np.float64)

    def _draw(self, text: str, time: float, worn: Array) -> None:
        """Draw members from an estimate, JSON; from the prior without one. They are in the scene's initial state."""
        self._text = text
        #: the estimate that is followed; None: the prior
        self.estimate = Estimate.from_dict(json.loads(text)) if text else None
        self._load_share = _load_share(text)
        self._known = self._prior if self.estimate is None else _whole(self.estimate, self._prior)
        rng = np.random.default_rng([self._seed, self.drawn])
        self._ensemble = Ensemble(self.scene, self._known, self._members, rng, time, self.tol, worn)
        self._ensemble.set_travel_speed(self._speed)
        self._tell_clearance()

    # -- as a `Twin` -------------------------------------------------------------------------------------------------

    @property
    def signature(self) -> tuple[bool, ...]:
        """Which terms the equations have, as of `Twin`."""
        others = self._ensemble.others
        return self._ensemble.first.signature + (() if others is None else others.signature)

    @property
    def time(self) -> float:
        """Model time in s."""
        return self._ensemble.first.time

    @property
    def wrench(self) -> Array:
        """The last sample: Fx, Fy [N] and M [N m], shape (3,); zero before the first."""
        return self._wrench.copy()

    @property
    def wear_depth(self) -> Array:
        """Wear depth of each pad of the median twin [m], shape (8,)."""
        return self._ensemble.first.wear_depth

    @property
    def steered(self) -> bool:
        """Whether poses move the members."""
        return self._members > 1

    @property
    def members(self) -> int:
        """Twins that are advanced."""
        return self._members

    @property
    def lost(self) -> int:
        """Members that have left the model's range."""
        self.catch_up()
        return int((~self._ensemble.good).sum())

    def poses_of_all(self) -> Array:
        """Return the present pose of each member, x, y [m] and theta [rad], shape (m, 3)."""
        self.catch_up()
        found: Array = self._ensemble.pose.copy()
        return found

    def failure(self, status: int) -> str:
        """Say why the newest advance that failed did so."""
        return self._ensemble.first.failure(status)

    def like(self, scene: Scene) -> Follower:
        """Return a follower of another machine, which counts on."""
        found = Follower(scene, self._members, tol=self.tol, seed=self._seed)
        found.every_row, found.defers = self.every_row, self.defers
        found.poses_used, found.poses_outlying = self.poses_used, self.poses_outlying
        found.poses_dropped = self.poses_dropped
        return found

    def warm_up(self) -> float:
        """Compile what is needed, or load it from the cache on disk; return the seconds it took."""
        begin, before = _time.perf_counter(), self.snapshot()
        self.advance(self.time + 1e-6)
        self._ensemble.stand_like(self._ensemble, self._wrench)
        self.restore(before)
        return _time.perf_counter() - begin

    def advance(self, t: float, wrench: ArrayLike | None = None) -> Advance:
        """Advance to model time `t`, as `Twin.advance`."""
        sample = self._wrench if wrench is None else np.asarray(wrench, dtype=np.float64)
        rows = np.zeros(1, ROW)
        self.advance_rows(np.array([t], dtype=np.float64), sample[None], rows)
        return Advance(rows[0])

    def end_spans(self, ends: NDArray[np.int64], begins: bool) -> None:
        """Say what the next `advance_rows` is for.

        Parameters
        ----------
        ends : ndarray of int64, shape (m,)
            Rising numbers of the rows that are published: a span of peaks and impulses ends there.
        begins : bool
            Whether a span begins with the first row.
        """
        self.catch_up()
        self._ends, self._begins = ends, begins

    def advance_rows(
        self, t: Array, wrench: Array, rows: Rows | None, digest_after: NDArray[np.int64] = _NO_DIGESTS
    ) -> Advanced:
        """Advance to some times, as `Twin.advance_rows`; a row knows what was measured before it.

        With `defers`, the other members are left to `catch_up` after a row that is published by itself.
        """
        self.catch_up()
        if wrench.shape != (len(t), 3) or not np.isfinite(wrench).all():
            raise ArgumentError(f"wrench: got {wrench!r}, expected finite numbers of shape ({len(t)}, 3)")
        alone = self._begins and len(t) == len(self._ends) == 1 and not len(digest_after)
        if self.defers and alone and rows is not None:
            failed = self._advance_first(t, wrench, rows, _YES if self.steered else _NO, _YES)
            if failed:
                self.catch_up()
            return Advanced(failed, [])
        ends = np.zeros(len(t), bool)
        ends[self._ends] = True
        self._ends = _NO_DIGESTS
        wanted = ends.copy()
        wanted[-1] = True
        if self.every_row or not self.steered:
            wanted[:] = self.every_row
        stops = Counter(digest_after.tolist())
        failed, digests, begin = 0, list[str](), 0
        while begin < len(t):
            end = self._stop(t, begin, stops)
            here = slice(begin, end)
            told = rows[here] if rows is not None else np.zeros(end - begin, ROW)
            failed += self._advance_first(t[here], wrench[here], told, wanted[here], ends[here])
            self.catch_up()
            if end in stops:
                digests += [self.digest()] * stops[end]
            begin = end
        return Advanced(failed, digests)

    def _advance_first(
        self, t: Array, wrench: Array, rows: Rows, wanted: NDArray[np.bool_], ends: NDArray[np.bool_]
    ) -> int:
        """Advance the median twin, and leave the others to `catch_up`; return how many advances failed."""
        failed = self._ensemble.advance_first(t, wrench, rows)
        known = self._clearance.ravel()
        rows["known_clearance"] = known if self.scene.wear is None else known + self._moved(rows["wear_depth"])
        self._wrench = wrench[-1].copy()
        self._behind = _Behind(t, wrench, rows, wanted, ends, self._begins)
        self._begins = False
        return failed

    def catch_up(self) -> None:
        """Bring all members to where the first is: its rows get their intervals, and what was measured acts."""
        behind, self._behind = self._behind, None
        if behind is None:
            return
        if behind.begins:
            self._ensemble.begin_span()
        self._ensemble.advance_others(*behind[:-1])
        ends = behind.wrench.min(axis=0), behind.wrench.max(axis=0)
        self._range = np.stack([np.minimum(self._range[0], ends[0]), np.maximum(self._range[1], ends[1])])
        if math.floor(self.time * _KNOWN_HZ) != self._cell:
            self._tell_clearance()
        while self._due and self._due[0][0] <= self.time:
            when, _, what = self._due.pop(0)
            self._use(when, what)

    def _stop(self, t: Array, begin: int, digest_after: Container[int]) -> int:
        """Return up to where to go at once: nothing happens on the way."""
        end = min(begin + _CALL, len(t))
        due = self._due[0][0] if self._due else math.inf
        for place in range(begin, end):
            if place + 1 in digest_after or t[place] >= due or math.floor(t[place] * _KNOWN_HZ) != self._cell:
                return place + 1
        return end

    def _moved(self, worn: Array) -> Array:
        """Return by how much pads that are worn by `worn` (..., 8) widen the clearances and their points, (..., 6)."""
        if self.scene.wear is None:
            return _UNMOVED
        return np.repeat(_moved(self.scene, worn), 3, axis=-1)

    def _tell_clearance(self) -> None:
        """Note the clearances that unworn pads would have by present knowledge."""
        self._cell = math.floor(self.time * _KNOWN_HZ)
        known = self._known
        if self.estimate is None and self._ensemble.moved:
            self._clearance = self._ensemble.clearance()
            return
        self._clearance = np.array([[value.mean, value.p05, value.p95] for value in (known.horizontal, known.vertical)])
        if self.estimate is not None:
            self._clearance -= self._ensemble.moved_before

    def reset(
        self,
        t: float,
        *,
        wear_depth: ArrayLike | None = None,
        pose: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        """Begin anew at model time `t`, as `Twin.reset`: what was measured of the motion before holds no longer."""
        self.catch_up()
        self.drawn += 1
        worn = self._unworn() if wear_depth is None else np.array(wear_depth, dtype=np.float64)
        self._draw("", t, worn)
        self._forget()
        self._wrench = np.zeros(3)
        self._span_start = t
        if pose is not None:
            q, v = (np.asarray(part, dtype=np.float64) for part in pose)
            self._ensemble.stand_about(q, v)

    def set_travel_speed(self, speed_m_s: float) -> None:
        """Set the speed along the face from here on, as `Twin.set_travel_speed`."""
        self.catch_up()
        self._speed = abs(float(speed_m_s))
        self._ensemble.set_travel_speed(self._speed)

    def digest(self) -> str:
        """Return 16 hexadecimal digits that stand for the exact state."""
        self.catch_up()
        state = [*self._ensemble.twins(), self._wrench.tobytes(), self._ensemble.square.tobytes()]
        return hashlib.blake2b(b"".join(state), digest_size=8).hexdigest()

    def snapshot(self) -> bytes:
        """Return the exact state as bytes, to be restored by a follower of the same scene, members and seed."""
        self.catch_up()
        blobs, random = self._ensemble.state()
        noise = np.array(self._noise_rows).reshape(-1, 3)
        blobs += [noise.tobytes(), self._clearance.tobytes(), self._wrench.tobytes()]
        facts = {
            "members": self._members, "added": self.added, "drawn": self.drawn, "estimate": self._text,
            "due": self._due, "used": list(self._used), "speed": self._speed, "cell": self._cell,
            "span": self._span_start, "worn": self._ensemble.worn_before.tolist(), "random": random,
            "outlying": self._ensemble.outlying, "range": self._range.tolist(), "sizes": [len(blob) for blob in blobs],
        }  # fmt: skip
        head = json.dumps(facts).encode()
        return b"".join([_LENGTH.pack(len(head)), head, *blobs])

    def snapshot_size(self, data: bytes) -> int:
        """Return the length of the snapshot at the beginning of some bytes."""
        facts, begin = _facts(data)
        return begin + int(sum(facts["sizes"]))

    def restore(self, data: bytes) -> None:
        """Take over a state saved by `snapshot`."""
        self._behind = None
        facts, begin = _facts(data)
        blobs = []
        for size in facts["sizes"]:
            blobs.append(data[begin : begin + size])
            begin += size
        worn, self._speed = np.array(facts["worn"]), float(facts["speed"])
        drawn = facts["drawn"], facts["members"], facts["estimate"], facts["worn"]
        if drawn != (self.drawn, self._members, self._text, self._ensemble.worn_before.tolist()):
            self.drawn, self._members = int(facts["drawn"]), int(facts["members"])
            self._draw(facts["estimate"], 0.0, worn)
        self.added, self._cell, self._span_start = int(facts["added"]), int(facts["cell"]), float(facts["span"])
        self._due = [(float(when), int(number), what) for when, number, what in facts["due"]]
        self._used = deque(facts["used"])
        *own, noise, clearance, wrench = blobs
        self._ensemble.set_state(own, facts["random"])
        self._ensemble.outlying, self._range = int(facts["outlying"]), np.array(facts["range"])
        self._noise_rows = deque(np.frombuffer(noise).reshape(-1, 3).copy(), maxlen=_NOISE_ROWS[1])
        self._clearance, self._wrench = np.frombuffer(clearance).reshape(2, 3).copy(), np.frombuffer(wrench).copy()

    # -- what is measured --------------------------------------------------------------------------------------------

    def add_pose(self, t: float, q: ArrayLike, known: float = -math.inf) -> None:
        """Take in a pose measured at `t` in s, shape (3,), NaN where it was not; it acts once the model has come there.

        It acts at `known` in s where that is later. One of the last `LATEST_S` acts at once.
        """
        self._add(max(t, known), [t, *np.asarray(q, dtype=np.float64).tolist()])

    def add_estimate(self, text: str, t: float) -> None:
        """Take in an estimate, JSON as of `Estimate.as_dict`, that is known from `t` in s on.

        It is followed if it says more than what is followed; one that is withdrawn lets the prior hold again.
        """
        self._add(t, text)

    def _add(self, t: float, what: list[float] | str) -> None:
        self.added += 1
        if t <= self.time:
            self.catch_up()
            self._use(t, what)
        elif isinstance(what, str) or len(self._due) < _MOST_DUE:
            insort(self._due, (t, self.added, what), key=lambda due: due[:2])
        else:
            self.poses_dropped += 1

    def _use(self, t: float, what: list[float] | str) -> None:
        if not isinstance(what, str):
            self._use_pose(what[0], np.array(what[1:]))
            return
        found = Estimate.from_dict(json.loads(what))
        states = (found.horizontal_state, found.vertical_state)
        if State.WITHDRAWN in states:
            if self.estimate is not None:
                self._begin_anew("")
        elif all(state.known for state in states) or (self.estimate is None and any(state.known for state in states)):
            self._begin_anew(what)

    @property
    def known(self) -> str:
        """The estimate that is followed, JSON; empty: the prior."""
        return self._text

    def follow_estimate(self, known: str) -> None:
        """Go on from here with what another one's `known` was."""
        if known != self._text:
            self.catch_up()
            self._begin_anew(known)

    def _begin_anew(self, text: str) -> None:
        """Draw from what is known now; the members begin where those before them stand."""
        before = self._ensemble
        self.drawn += 1
        self._draw(text, self.time, self.wear_depth)
        self._ensemble.stand_like(before, self._wrench)

    def follow_parameters(self) -> None:
        """Go on with one twin that no pose moves, from where the median twin stands."""
        self.catch_up()
        self._members = 1
        self._begin_anew(self._text)

    def _use_pose(self, t: float, q: Array) -> None:
        if not self.steered or any(abs(t - used) < APART_S for used in self._used):
            return
        newest = not self._used or t > max(self._used)
        self._used.append(t)
        while self._used and self._used[0] < self.time - 2.0 * LATEST_S:
            self._used.popleft()
        noise, bias, delay = self._sensor()
        if noise is not None:
            before = self._ensemble.outlying
            used = self._ensemble.correct(t - delay, q - bias, noise, self._load_error())
            self.poses_used += used
            if not used and self._ensemble.outlying > before:
                self.poses_outlying += 1
                return
        if newest and np.isfinite(q).all():
            self._noise_rows.append(q)

    def _load_error(self) -> Array:
        """Return the error of the load, N and N m, that the estimate has found where the model describes roughly."""
        found: Array = tuning.LOAD_ERROR_SHARE * self._load_share * 0.5 * (self._range[1] - self._range[0])
        return found

    def _sensor(self) -> tuple[Array | None, Array, float]:
        """Return noise, None where too little was measured to tell, bias and delay of the sensor."""
        found = self.estimate
        noise: Array | None = None
        if found is not None and found.noise is not None:
            noise = np.array(found.noise)
        elif len(self._noise_rows) >= _NOISE_ROWS[0]:
            noise = noise_level(np.array(self._noise_rows))
        if noise is None or not noise.all():
            return None, np.zeros(3), 0.0
        if found is None:
            return noise, np.zeros(3), 0.0
        bias = [0.0 if value is None else value.mean for value in (found.bias_x, found.bias_y, found.bias_theta)]
        return noise, np.array(bias), 0.0 if found.delay is None else max(found.delay.mean, 0.0)

    # -- what is known -----------------------------------------------------------------------------------------------

    def clearance(self) -> Array:
        """Return horizontal and vertical clearance, each with its 5 % and 95 % points, shape (2, 3), in m."""
        self.catch_up()
        self._tell_clearance()
        found: Array = self._clearance + self._moved(self.wear_depth).reshape(2, 3)
        return found

    def span(self) -> Span:
        """Return peaks and impulses since the call before, where no publication has ended a span."""
        self.catch_up()
        start, self._span_start = self._span_start, self.time
        found = Span(start, self.time, *self._ensemble.span())
        self._ensemble.begin_span()
        return found

    def held(self, t: float) -> Rows:
        """Return the row, shape (1,), of a time after the newest sample, which is held; nothing changes."""
        self.catch_up()
        rows = np.zeros(1, ROW)
        self._ensemble.held(t, rows)
        rows["known_clearance"] = self._clearance.ravel() + self._moved(rows["wear_depth"])
        return rows


def follower(scene: Scene, follow: str, members: int, tol: float) -> Follower:
    """Return the twin of a scene that follows `full`, with so many members, or `parameters` alone."""
    return Follower(scene, members) if follow == "full" else Follower(scene, 1, tol=tol)


def _load_share(text: str) -> Array:
    """Return the load's error in shares of half its range, (3,), of an estimate, JSON; zero unless it is rough."""
    found = json.loads(text) if text else {}
    rough = State.ROUGH.value in [found.get(axis, {}).get("state") for axis in ("horizontal", "vertical")]
    figures = found.get("figures", {}) if rough else {}
    return np.array([figures.get(f"load_error_{name}", 0.0) for name in ("fx", "fy", "m")])


def _facts(data: bytes) -> tuple[dict[str, Any], int]:
    """Return the facts at the beginning of a snapshot, and where what follows them begins."""
    (length,) = _LENGTH.unpack_from(data)
    begin = _LENGTH.size + length
    return json.loads(data[_LENGTH.size : begin]), begin


def _moved(scene: Scene, worn: Array) -> Array:
    """Return by how much pads that are worn by `worn` (..., 8) widen the clearances in m, shape (..., 2)."""
    own = np.array([scene.clearance.horizontal_m, scene.clearance.vertical_m])
    found: Array = clearances(scene, worn)[..., :2] - own
    return found


class Ensemble:
    """Twins drawn from what is known; the first has its middle.

    Parameters
    ----------
    scene, known
        The nominal scene, and what is known: clearances of unworn pads in the prior, those at present in an estimate.
    members, rng, start, tol
        How many; for all that is drawn; time of the scene's initial state; tolerance.
    worn : ndarray, shape (8,)
        Wear depth of the pads in m.
    """

    def __init__(
        self, scene: Scene, known: Estimate, members: int, rng: np.random.Generator, start: float, tol: float,
        worn: Array,
    ) -> None:  # fmt: skip
        scenes, gain = draw_scenes(scene, known, members, rng) if members > 1 else ([scene], np.ones((1, 3)))
        scenes[0], gain[0] = middle_of(scene, known)
        #: whether poses move the first member, whose numbers are those of an estimate; else its double, the second
        self._steers_first = known.horizontal_state is not State.PRIOR
        if not self._steers_first and members > 1:
            scenes[1], gain[1] = scenes[0], gain[0]
        #: wear of the pads at the beginning, and by how much it had widened the clearances that are known, (2, 1)
        self.worn_before, self.moved_before = worn, np.zeros((2, 1))
        if scene.wear is not None:
            states = (known.horizontal_state, known.vertical_state)
            self.moved_before = np.where([[state.known] for state in states], _moved(scene, worn)[:, None], 0.0)
            scenes = [_worn(one, scene, worn, self.moved_before[:, 0]) for one in scenes]
        #: the first member, by itself: its forces need not wait for the others
        self.first = Twin(scenes[0], tol=tol, excitation="sampled", start=start)
        self.others = TwinBatch(scenes[1:], tol=tol, start=start) if members > 1 else None
        self._scene, self._gain, self._rng = scene, gain, rng
        #: error of each member's load, N and N m, and time in s up to which it has drifted
        self._load_off, self._drifted = np.zeros((members, 3)), start
        self._walls = np.stack([penetration_rows(one) for one in scenes])
        self._clearance = np.array([[one.clearance.horizontal_m, one.clearance.vertical_m] for one in scenes])
        self._fastest = np.array([fastest_travel(one.wear, one.contact) for one in scenes])
        self._stiffness, self._exponent = np.array([one.contact.stiffness for one in scenes]), scene.contact.exponent
        self._pressed = tuning.PRESSED * scene.head.mass_kg * Gravity().acceleration_m_s2
        self.good = np.ones(members, dtype=bool)
        #: force, and peak and impulse since the span's begin
        self._told = np.zeros((members, 3, PAIR_COUNT))
        self._peak, self._impulse = self._told[:, 1], self._told[:, 2]
        #: squares of each member's normalised innovations
        self.square = np.zeros(members)
        #: degrees of freedom that are not locked, and outlying poses in a row
        self._free = np.array([name not in scene.locked for name in DOF_NAMES])
        self.outlying = 0
        #: times and poses (m, 3) of the newest seconds, oldest first; present rates (m, 3), wear and penetration (m, 8)
        self._path: deque[tuple[float, Array]] = deque([(start, np.tile(np.array(scene.initial.q), (members, 1)))])
        self._v, self.worn = np.tile(np.array(scene.initial.v), (members, 1)), np.tile(worn, (members, 1))
        self._depth = self._penetration(self._path[-1][1])
        #: the newest rows of all members, while nobody has asked for what they hold
        self._newest: Rows | None = None

    @property
    def moved(self) -> bool:
        """Whether any pose has moved the members."""
        return bool(self.square.any())

    @property
    def pose(self) -> Array:
        """The present pose of each member, (m, 3)."""
        return self._path[-1][1]

    def set_travel_speed(self, speed_m_s: float) -> None:
        """Set the speed along the face, of each member as far as its damping allows."""
        speeds = np.minimum(speed_m_s, self._fastest)
        self.first.set_travel_speed(float(speeds[0]))
        if self.others is not None:
            self.others.set_travel_speed(speeds[1:])

    def advance_first(self, t: Array, wrench: Array, rows: Rows) -> int:
        """Advance the first member and write its rows, shape (n,); return how many advances failed."""
        failed, _ = self.first.advance_rows(t, wrench * self._gain[0] + self._load_off[0], rows)
        rows["followed"] = FOLLOWED
        return failed

    def advance_others(
        self, t: Array, wrench: Array, rows: Rows, wanted: NDArray[np.bool_], ends: NDArray[np.bool_]
    ) -> None:
        """Advance the other members to where the first is, whose rows are given; write intervals into those `wanted`.

        A span of peaks and impulses ends with each of `ends`.
        """
        parts = [_bytes(rows[None])]
        if self.others is not None:
            loads = wrench * self._gain[1:, None, :] + self._load_off[1:, None, :]
            parts.append(_bytes(self.others.advance_samples(t, loads).rows))
        whole = np.concatenate(parts).view(ROW)
        good = whole["status"] == 0
        if len(self.good) == 1:
            self.good[:] = True
        for place, (now, is_wanted, is_end) in enumerate(zip(t.tolist(), wanted.tolist(), ends.tolist(), strict=True)):
            self.good &= good[:, place]
            np.maximum(self._peak, whole["peak"][:, place], out=self._peak)
            self._impulse += whole["impulse"][:, place]
            if is_wanted:
                self._told[:, 0] = whole["force"][:, place]
                self._tell(rows[place : place + 1])
            if is_end:
                self.begin_span()
            self._remember(now, whole["q"][:, place].copy())
        self._newest = whole[:, -1]

    def settle(self) -> None:
        """Take rates, wear and penetration out of the newest rows: few samples are asked for them."""
        rows, self._newest = self._newest, None
        if rows is not None:
            self._v, self.worn, self._depth = rows["v"].copy(), rows["wear_depth"].copy(), rows["penetration"].copy()

    def _remember(self, now: float, q: Array) -> None:
        path = self._path
        if len(path) > 1 and path[-1][0] - path[-2][0] < _PATH_S:
            path.pop()
        path.append((now, q))
        while path[1][0] <= now - LATEST_S:
            path.popleft()

    def _tell(self, row: Rows) -> None:
        """Write the intervals of forces, peaks and impulses."""
        _, low, high = self._points(self._told)
        for index, name in enumerate(("force", "peak", "impulse")):
            row[f"{name}_low"], row[f"{name}_high"] = low[index], high[index]
        if np.isfinite(low.sum() + high.sum()):
            row["followed"] = WITH_INTERVALS

    def held(self, t: float, row: Rows) -> None:
        """Write the row of a later time with the newest sample held; nothing changes."""
        before = self.twins()
        row[:] = self.first.advance(t).rows
        self._told[0, 0] = row["force"][0]
        if self.others is not None:
            self._told[1:, 0] = self.others.advance(t).force[:, 0]
        self.set_twins(before)
        self._tell(row)

    def begin_span(self) -> None:
        """Let peaks and impulses begin here."""
        self._peak[:], self._impulse[:] = 0.0, 0.0

    def span(self) -> tuple[Array, Array]:
        """Return peaks and impulses since the span's begin: of the first member and the points, (3, 8) each."""
        return np.stack(self._points(self._peak)), np.stack(self._points(self._impulse))

    def _points(self, values: Array) -> tuple[Array, Array, Array]:
        """Return the first member's values, and the 5 % and 95 % points over the members that are in range."""
        low, _, high = quantiles(values if self.good.all() else values[self._used()])
        return values[0].copy(), np.minimum(low, values[0]), np.maximum(high, values[0])

    def _used(self) -> NDArray[np.bool_]:
        """Return which members determine intervals: those in the model's range, or all without such members."""
        return self.good if self.good.any() else np.ones(len(self.good), dtype=bool)

    def clearance(self) -> Array:
        """Return the clearances with their 5 % and 95 % points, (2, 3), of the members that foretell the poses best.

        The likelihoods are tempered until enough members carry the interval. Of unworn pads.
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

    def stand_like(self, before: Ensemble, wrench: Array) -> None:
        """Begin where others stand under a load, each by its own clearances, with what they have gone through.

        The first with the numbers of an estimate begins where the second stood, which the poses have moved; the second
        of a prior begins where the first stood.
        """
        before.settle()
        from_ = np.where(before.good, np.arange(len(before.good)), int(np.argmax(before.good)))[: len(self.good)]
        if self._steers_first and not before._steers_first and len(before.good) > 1 and before.good[1]:
            from_[0] = 1
        if before._steers_first and not self._steers_first and before.good[0]:
            from_[1:2] = 0
        share = self._shares(before._room()[from_])
        self._load_off = before._load_off[from_]
        loads = wrench * self._gain + self._load_off
        self.first.advance(self.first.time, loads[0])
        if self.others is not None:
            self.others.set_wrench(loads[1:])
        self._path = deque((t, q[from_] * share) for t, q in before._path)
        self._told[1:], self._told[0] = before._told[from_[1:]], before._told[0]
        self._stand(self._path[-1][1], before._v[from_], before._force(before._depth)[from_])

    def stand_about(self, q: Array, v: Array) -> None:
        """Begin at a pose of the first member, the others by their own clearances."""
        places = q * self._shares(np.broadcast_to(self._room()[0], (len(self.good), 3)))
        force = self._force(self._penetration(places))[:1]
        self._stand(places, np.tile(v, (len(places), 1)), force)

    def _room(self) -> Array:
        """Return what the head can move by, horizontally, vertically, and at its corners, shape (m, 3); 1 if locked."""
        room = np.column_stack([self._clearance, self._clearance.min(axis=1)])
        return np.where(self._free, room, 1.0)

    def _shares(self, room: Array) -> Array:
        """Return by how much more than a room the head can move by, shape (m, 3)."""
        return np.divide(self._room(), room, out=np.ones_like(room), where=room > 0.0)

    def _stand(self, q: Array, v: Array, force: Array, which: NDArray[np.int64] | None = None) -> None:
        """Stand at poses; where a pair would be pressed by more than a force, (m, 8), nearer to the middle."""
        low, high = np.zeros(len(q)), np.ones(len(q))
        free = self._allowed(q, force)
        low[free] = 1.0
        for _ in range(40) if not free.all() else ():
            share = 0.5 * (low + high)
            allowed = self._allowed(self._nearer(q, share), force)
            low, high = np.where(allowed, share, low), np.where(allowed, high, share)
        which = np.arange(len(q)) if which is None else which
        self._put(which, self._nearer(q, low)[which], v[which])

    def _nearer(self, q: Array, share: Array) -> Array:
        """Return poses nearer to the middle, as far as the head is free to move."""
        return np.where(self._free, share[:, None] * q, q)

    def correct(self, t: float, q: Array, noise: Array, load_error: Array) -> bool:
        """Move the members toward a pose measured at `t`, by their covariance with it; False if it is not used.

        Their loads err by `load_error`, N and N m, shape (3,), and the pose corrects these errors too.
        Not used are poses that are too late, and outliers as long as few of them come in a row.
        """
        self.settle()
        there = np.flatnonzero(np.isfinite(q) & self._free)
        times = [time for time, _ in self._path]
        if t <= times[0] or not len(there):
            return False
        after = min(bisect_left(times, t), len(times) - 1)
        path = np.stack([self._path[index][1] for index in range(after - 1, len(times))])
        share = min((t - times[after - 1]) / (times[after] - times[after - 1]), 1.0)
        then = ((1.0 - share) * path[0] + share * path[1])[:, there]
        self._drift(load_error)
        state = np.concatenate([self._v, *path, self._load_off], axis=1)
        use = self._used()
        if not self._steers_first and use[1:].any():
            use = use & (np.arange(len(use)) > 0)
        about, seen = state - state[use].mean(axis=0), then - then[use].mean(axis=0)
        freedom = max(int(use.sum()) - 1, 1)
        scatter = seen[use].T @ seen[use] / freedom + np.diag(noise[there] ** 2)
        center = _off(q, then[use].mean(axis=0), there)
        if (np.abs(center) <= tuning.OUTLYING * np.sqrt(np.diag(scatter))).all():
            self.outlying = 0
        else:
            self.outlying += 1
            if self.outlying <= _MOST_OUTLYING:
                return False
        white = self._rng.standard_normal((len(then), len(there)))
        white[0] = 0.0
        off = _off(q, then, there)
        # no member is worse than an outlier: a bad pose that is used does not outweigh all others
        most = tuning.OUTLYING * noise[there]
        self.square += ((off.clip(-most, most) / noise[there]) ** 2).sum(axis=1)
        weight = np.linalg.solve(scatter, seen[use].T @ about[use] / freedom)
        weight[:, ~np.tile(self._free, len(path) + 2)] = 0.0
        moved = state + (off + noise[there] * white) @ weight
        v, places = moved[:, :3], moved[:, 3:-3].reshape(len(moved), -1, 3).transpose(1, 0, 2)
        allowed = np.flatnonzero(self._allowed(places[-1], self._force(self._depth)))
        allowed = allowed[allowed >= 1 - self._steers_first]
        for place, index in enumerate(range(after - 1, len(times))):
            self._path[index][1][allowed] = places[place, allowed]
        self._load_off[allowed] = moved[allowed, -3:]
        self._put(allowed, places[-1, allowed], v[allowed])
        self._recover()
        return True

    def _drift(self, load_error: Array) -> None:
        """Let the errors of the loads drift, as Ornstein-Uhlenbeck processes; that of the first has no noise."""
        now, before = self.first.time, self._drifted
        self._drifted = now
        if load_error.any() or self._load_off.any():
            kept = math.exp(-(now - before) / tuning.LOAD_ERROR_LASTS)
            white = self._rng.standard_normal(self._load_off.shape)
            white[0] = 0.0
            self._load_off = kept * self._load_off + math.sqrt(1.0 - kept**2) * load_error * white

    def _recover(self) -> None:
        """Put members that have left the model's range where others are; if all have, they go on as they are."""
        lost, left = np.flatnonzero(~self.good), np.flatnonzero(self.good)
        self.good[:] = True
        if not len(lost) or not len(left):
            return
        from_ = np.arange(len(self.good))
        from_[lost] = np.resize(left, len(lost))
        share = self._shares(self._room()[from_])
        self._path = deque((t, q[from_] * share) for t, q in self._path)
        self._stand(self._path[-1][1], self._v[from_], self._force(self._depth)[from_], lost)

    def _force(self, depth: Array) -> Array:
        """Return the elastic force of each pair, (m, 8)."""
        found: Array = self._stiffness[:, None] * np.maximum(depth, 0.0) ** self._exponent
        return found

    def _allowed(self, q: Array, force: Array) -> NDArray[np.bool_]:
        """Return which members may be put to poses (m, 3): no pair is pressed by much more than a force, (m, 8)."""
        return np.asarray((self._force(self._penetration(q)) < force + self._pressed).all(axis=1))

    def _put(self, which: NDArray[np.int64], q: Array, v: Array) -> None:
        for place in np.flatnonzero(which == 0):
            self.first.move(q[place], v[place])
        rest = which > 0
        if self.others is not None and rest.any():
            self.others.move(which[rest] - 1, q[rest], v[rest])
        self._path[-1][1][which], self._v[which] = q, v
        self._depth = self._penetration(self._path[-1][1])

    def _penetration(self, q: Array) -> Array:
        """Return the penetration of each pair in m, (m, 8), with each member's clearances at poses of shape (m, 3)."""
        state = states_of(self._scene, np.concatenate([q, np.zeros_like(q)], axis=1))
        body = np.concatenate([state[:, _PLACES], np.ones((len(q), 1))], axis=1)
        found: Array = np.einsum("mi,mij->mj", body, self._walls) - self.worn
        return found

    def twins(self) -> list[bytes]:
        """Return the exact states of the twins: of the first, and of the others."""
        return [self.first.snapshot(), b"" if self.others is None else self.others.snapshot()]

    def set_twins(self, states: Sequence[bytes]) -> None:
        """Go on from what `twins` returned."""
        self.first.restore(states[0])
        if self.others is not None:
            self.others.restore(states[1])

    def state(self) -> tuple[list[bytes], Any]:
        """Return all that changes, as bytes and as JSON."""
        self.settle()
        times, path = np.array([time for time, _ in self._path]), np.stack([q for _, q in self._path])
        wide = (self._peak, self._impulse, self._v, self.worn, self._depth, self._load_off)
        arrays = (self.good, self.square, *wide, np.array([self._drifted]), times, path)
        return [*self.twins(), *(one.tobytes() for one in arrays)], self._rng.bit_generator.state

    def set_state(self, blobs: list[bytes], random: Any) -> None:
        """Go on from what `state` returned."""
        self.set_twins(blobs[:2])
        self.good = np.frombuffer(blobs[2], np.bool_).copy()
        count = len(self.good)
        self.square, *wide, drifted, times, path = (np.frombuffer(blob).copy() for blob in blobs[3:])
        own = [one.reshape(count, -1) for one in wide]
        self._peak[:], self._impulse[:], self._v, self.worn, self._depth, self._load_off = own
        self._drifted = float(drifted[0])
        self._newest = None
        self._path = deque(zip(times.tolist(), path.reshape(-1, count, 3), strict=True))
        self._rng.bit_generator.state = random


def _bytes(rows: Rows) -> NDArray[np.uint8]:
    """Return rows (m, n) as bytes: numpy copies a record field by field."""
    found: NDArray[np.uint8] = np.ascontiguousarray(rows).view(np.uint8)
    return found


def _off(q: Array, then: Array, there: NDArray[np.int64]) -> Array:
    """Return by how much a pose differs from others (..., k) in the coordinates `there`; angles up to full turns."""
    off: Array = q[there] - then
    turn = there == _THETA
    off[..., turn] = np.remainder(off[..., turn] + np.pi, 2.0 * np.pi) - np.pi
    return off


def _worn(one: Scene, scene: Scene, worn: Array, moved: Array) -> Scene:
    """Return a member's scene with worn pads; its clearances are what is known, by `moved` (2,) due to the wear."""
    assert scene.wear is not None
    depths = tuple(worn.tolist())
    horizontal, vertical = one.clearance.horizontal_m - moved[0], one.clearance.vertical_m - moved[1]
    clearance = Clearance(max(float(horizontal), 0.0), max(float(vertical), 0.0))
    return replace(one, clearance=clearance, wear=replace(scene.wear, initial_depth_m=depths))


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
        apparent=None,
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
