"""The follower, an ensemble of twins that measured poses and estimates keep close to one machine.

The twins (members) differ in clearances, contact parameters and load gains. These parameters are drawn from the prior
at the start, and anew from each valid estimate. Newly drawn members start at the poses of the previous members. The
module `members` contains the Kalman filter by which measured poses move the members.

The first member, the median twin, has the median of each parameter and no random noise, so its motion obeys the
equations of motion. Before the first estimate, the median twin is the nominal twin. If the machine had larger
clearances, poses would press the nominal twin against its walls and falsify its forces, so they move only its copy, the
second member.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import time as _time
from bisect import insort
from collections import Counter, deque
from collections.abc import Container
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plow_twin.errors import ArgumentError
from plow_twin.estimate import tuning
from plow_twin.estimate.forces import FEWEST, TOLERANCE
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.members import LATEST_S, Ensemble, compile_friction, may_rub, widening
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.similar import Units
from plow_twin.estimate.start import noise_level
from plow_twin.estimate.summary import prior_of
from plow_twin.estimate.unknowns import DAMPING, GAIN, Unknowns
from plow_twin.kernel.compiler import kept_on_disk
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.model.scene import Scene
from plow_twin.run.advance import Advance
from plow_twin.run.twin import Advanced
from plow_twin.solve.state import ROW
from plow_twin.stream.driven import MOST_MEASURED, PREPARATION_S, Learned, PoseCounts

Array = NDArray[np.float64]
Rows = NDArray[np.void]

#: Default number of members, by definition.
MEMBERS: Final = 128
#: Lower bound on the time in s between two poses that are used, because more poses add little information.
APART_S: Final = 4e-3
#: Lower and upper bound on the number of poses from which the noise is computed.
_NOISE_ROWS: Final = (20, 400)
#: Upper bound on the number of samples in one call, so that the rows of all members fit into the processor's cache.
_CALL: Final = 20
#: Rate in 1/s at which the clearances are computed, by definition the rate at which they are published.
_KNOWN_HZ: Final = 10.0
#: Upper bound on the number of poses that wait until the model reaches their stamps.
_MOST_DUE: Final = MOST_MEASURED
#: Constant arrays by definition: masks of a single row with and without intervals, no digests, unchanged clearances.
_YES: Final = np.ones(1, bool)
_NO: Final = np.zeros(1, bool)
_NO_DIGESTS: Final = np.zeros(0, np.int64)
_UNMOVED: Final = np.zeros(6)
#: A zero load and an empty set of poses, by definition.
_NO_LOAD: Final = Load.unmeasured(1.0)
_NO_POSES: Final = Poses(np.zeros(0), np.zeros((0, 3)))
_LENGTH: Final = struct.Struct("<q")
#: Key of the harmonics of the load in the JSON of an estimate.
_HARMONICS: Final = "load_harmonics"
#: Key of the wear depths of the pads [m] at the arrival of an estimate, in its JSON.
_WORN: Final = "worn_m"
#: Key of harmonics that wait for the origin of the model time, and key of the stamp [ns] from which their phases count.
_WAITING, _BEGIN_NS = "waiting_harmonics", "begin_ns"


@dataclass(frozen=True, eq=False)
class Span:
    """Peaks and impulses of the contact forces over a span of time, with intervals.

    Attributes
    ----------
    start, end : float
        Beginning and end of the span in s.
    peak, impulse : ndarray, shape (3, 8)
        Largest force in N and impulse in N s of each pair. The rows contain the values of the median twin, the 5 %
        quantiles and the 95 % quantiles.
    """

    start: float
    end: float
    peak: Array
    impulse: Array


class _Behind(NamedTuple):
    """Samples that only the first member has processed, with its rows.

    `wanted` marks the rows for which intervals are computed, and `ends` the last rows of spans of peaks and impulses.
    `begins` states whether a span begins with the first row.
    """

    t: Array
    wrench: Array
    rows: Rows
    wanted: NDArray[np.bool_]
    ends: NDArray[np.bool_]
    begins: bool


class _Draft(NamedTuple):
    """Members that are drawn, perhaps not all yet, from `text`, the JSON of an estimate (empty for the prior)."""

    text: str
    #: the draw's number, which determines the random numbers
    drawn: int
    estimate: Estimate
    ensemble: Ensemble

    def fits(self, text: str, drawn: int, members: int) -> bool:
        """Return whether these are the members that would be drawn."""
        return (self.text, self.drawn, self.ensemble.count) == (text, drawn, members)


class Follower:
    """A twin under sampled loads that follows one machine by means of measured poses and estimates.

    A `Follower` is used like a `Twin`. Its motion is the motion of its first member, the median twin.

    Parameters
    ----------
    scene : Scene
        The nominal scene.
    members : int
        Number of twins, either 1 or at least 20. Poses do not move a single twin, and its forces have no intervals.
    tol : float
        Tolerance of the solver, as for `Twin`.
    seed : int
        Seed of the random numbers.
    alone : bool
        Whether the first member is alone until the further members have been drawn, `PREPARATION_S` later.

    Raises
    ------
    ArgumentError
        If there are too few members.
    """

    excitation: Literal["scene", "sampled"] = "sampled"
    max_evaluations: int | None = None
    #: number of advances that `max_evaluations` has cut short, always 0 for a follower
    bounded = 0

    def __init__(
        self, scene: Scene, members: int = MEMBERS, *, tol: float = TOLERANCE, seed: int = 0, alone: bool = False
    ) -> None:
        if members != 1 and members < FEWEST:
            raise ArgumentError(f"members: got {members}, expected 1 or at least {FEWEST}")
        self.scene, self.tol = scene, tol
        self._members, self._seed = members, seed
        self._prior = prior(scene)
        self._speed = scene.wear.travel_speed_m_s if scene.wear is not None else 0.0
        #: number of poses and estimates added so far
        self.added = 0
        #: whether intervals of the forces are computed for each row, not only for published rows
        self.every_row = False
        #: whether a single published row is returned before `catch_up` advances all members except the first
        self.defers = False
        self._behind: _Behind | None = None
        #: minimum and maximum of each component of the load so far, shape (2, 3)
        self._range = np.zeros((2, 3))
        self._ends, self._begins = _NO_DIGESTS, False
        self._span_start = 0.0
        self._wrench = np.zeros(3)
        self.poses = PoseCounts()
        #: number of times that members were drawn, and model time in s of the latest draw from an estimate
        self.drawn, self._since = 0, 0.0
        #: members that are drawn in pieces for a later use, and model time in s of the latest piece
        self._draft: _Draft | None = None
        self._prepared = 0.0
        self._draw("", 0.0, self._unworn(), alone=alone)
        #: compiled terms of the nominal scene, as in `Twin`; the draw decides whether members have further terms
        self.signature: tuple[bool, ...] = self._ensemble.first.signature
        self._drop_measurements()

    def _drop_measurements(self) -> None:
        #: poses and estimates in order of time: time in s, sequence number, and the pose or the estimate (JSON). An
        #: empty text stands for the members that the first member lacks.
        self._due: list[tuple[float, int, list[float] | str]] = []
        if self._alone:
            self._due.append((self.time + PREPARATION_S, 0, ""))
        #: times of recently used poses
        self._used: deque[float] = deque()
        self._noise_rows: deque[Array] = deque(maxlen=_NOISE_ROWS[1])

    def _unworn(self) -> Array:
        wear = self.scene.wear
        return np.zeros(PAIR_COUNT) if wear is None else np.array(wear.initial_depth_m, dtype=np.float64)

    def _draw(self, text: str, time: float, worn: Array, *, alone: bool = False) -> None:
        """Draw members at the time `time` [s] from an estimate (JSON; empty for the prior), or only the first one."""
        self._prepared = time
        draft, self._draft = self._draft, None
        members = 1 if alone else self._members
        if draft is None or not draft.fits(text, self.drawn, members):
            draft = self._begin_draft(text, self.drawn, members, worn)
        draft.ensemble.start_at(time, worn)
        self._text, self._ensemble, self._present_estimate = text, draft.ensemble, draft.estimate
        #: the estimate that the members follow; None for the prior
        self.estimate = Estimate.from_dict(json.loads(text)) if text else None
        self._load_share = _load_share(text)
        self._ensemble.set_travel_speed(self._speed)
        self._note_clearance()

    def _begin_draft(self, text: str, drawn: int, members: int, worn: Array) -> _Draft:
        estimate = _whole(Estimate.from_dict(json.loads(text)), self._prior) if text else self._prior
        rng = np.random.default_rng([self._seed, drawn])
        # errors of an uncertain load would distort learned parameters
        learns = not _load_share(text).any()
        if _WORN in text:
            worn = np.array(json.loads(text)[_WORN])
        ensemble = Ensemble(self.scene, estimate, members, rng, None, self.tol, worn, learns)
        return _Draft(text, drawn, estimate, ensemble)

    def _prepare(self) -> None:
        """Draw a piece of the members that the next waiting estimate will need.

        This changes only when the work is done.
        """
        self._prepared = self.time
        latest = self.time + PREPARATION_S
        waiting = (item for when, _, item in self._due if when <= latest and isinstance(item, str))
        ready = next(filter(self._is_ready, waiting), None)
        text = None if ready is None else self._text_after(ready)
        if text is None:
            self._draft = None
            return
        if self._draft is None or not self._draft.fits(text, self.drawn + 1, self._members):
            self._draft = self._begin_draft(text, self.drawn + 1, self._members, self._unworn())
        self._draft.ensemble.draw_piece()

    @property
    def _alone(self) -> bool:
        """Whether the first member waits for the further members."""
        return self._ensemble.others is None and self._members > 1

    # -- as a `Twin` -------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Model time in s."""
        return self._ensemble.first.time

    @property
    def wrench(self) -> Array:
        """The last sample of the load: Fx, Fy [N] and M [N m], shape (3,); zero before the first sample."""
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
        """Number of members."""
        return self._members

    @property
    def lost(self) -> int:
        """Number of members that have left the range of the model."""
        self.catch_up()
        return int((~self._ensemble.good).sum())

    def failure(self, status: int) -> str:
        """Return the reason of the latest failed advance as text."""
        return self._ensemble.first.failure(status)

    def like(self, scene: Scene) -> Follower:
        """Return a follower of a scene with the settings and the counters of this follower."""
        follower = Follower(scene, self._members, tol=self.tol, seed=self._seed, alone=True)
        follower.every_row, follower.defers = self.every_row, self.defers
        follower.poses = self.poses
        return follower

    def warm_up(self) -> float:
        """Compile the kernels, or load them from the cache on disk; return the elapsed time in s."""
        begin, state = _time.perf_counter(), self.snapshot()
        self.advance(self.time + 1e-6)
        self._ensemble.start_from(self._ensemble, self._wrench)
        if self._ensemble.others is not None:
            self._ensemble.others.warm_up()
        self.restore(state)
        if may_rub(self.scene) and not kept_on_disk():  # the estimating process could not pass on its kernels later
            compile_friction(self.scene, self.tol)
        return _time.perf_counter() - begin

    def advance(self, t: float, wrench: ArrayLike | None = None) -> Advance:
        """Advance to model time `t`, as `Twin.advance` does."""
        sample = self._wrench if wrench is None else np.asarray(wrench, dtype=np.float64)
        rows = np.zeros(1, ROW)
        self.advance_rows(np.array([t], dtype=np.float64), sample[None], rows)
        return Advance(rows[0])

    def end_spans(self, ends: NDArray[np.int64], begins: bool) -> None:
        """Set which rows of the next `advance_rows` are published.

        Parameters
        ----------
        ends : ndarray of int64, shape (m,)
            Ascending indices of the published rows; each of these rows ends a span of peaks and impulses.
        begins : bool
            Whether a span begins with the first row.
        """
        self.catch_up()
        self._ends, self._begins = ends, begins

    def advance_rows(
        self, t: Array, wrench: Array, rows: Rows | None, digest_after: NDArray[np.int64] = _NO_DIGESTS
    ) -> Advanced:
        """Advance to given times, as `Twin.advance_rows` does. Each row depends on all measurements before its time.

        If `defers` is set, a row that is published alone is returned before `catch_up` advances the further members.
        """
        self.catch_up()
        if wrench.shape != (len(t), 3) or not np.isfinite(wrench).all():
            raise ArgumentError(f"wrench: got {wrench!r}, expected finite numbers of shape ({len(t)}, 3)")
        alone = self._begins and len(t) == len(self._ends) == 1 and not len(digest_after)
        if self.defers and alone and rows is not None:
            failed = self._advance_first(t, wrench, rows, _NO if self._ensemble.others is None else _YES, _YES)
            if failed:
                self.catch_up()
            return Advanced(failed, [])
        ends = np.zeros(len(t), bool)
        ends[self._ends] = True
        self._ends = _NO_DIGESTS
        needed = ends.copy()
        needed[-1] = True
        if self.every_row or not self.steered:
            needed[:] = self.every_row
        stops = Counter(digest_after.tolist())
        failed, digests, begin = 0, list[str](), 0
        while begin < len(t):
            end = self._stop(t, begin, stops)
            rows_of_span = slice(begin, end)
            out = rows[rows_of_span] if rows is not None else np.zeros(end - begin, ROW)
            failed += self._advance_first(
                t[rows_of_span], wrench[rows_of_span], out, needed[rows_of_span], ends[rows_of_span]
            )
            self.catch_up()
            if end in stops:
                digests += [self.digest()] * stops[end]
            begin = end
        return Advanced(failed, digests)

    def _advance_first(
        self, t: Array, wrench: Array, rows: Rows, needed: NDArray[np.bool_], ends: NDArray[np.bool_]
    ) -> int:
        """Advance only the median twin, and return the number of failed advances."""
        failed = self._ensemble.advance_first(t, wrench, rows)
        clearance = self._clearance.ravel()
        rows["known_clearance"] = clearance if self.scene.wear is None else clearance + self._moved(rows["wear_depth"])
        self._wrench = wrench[-1].copy()
        self._behind = _Behind(t, wrench, rows, needed, ends, self._begins)
        self._begins = False
        return failed

    def catch_up(self) -> None:
        """Advance all members to the time of the first member, add intervals to its rows, and use due measurements."""
        behind, self._behind = self._behind, None
        if behind is None:
            return
        if behind.begins:
            self._ensemble.begin_span()
        t, wrench, rows, wanted, ends, _ = behind
        self._ensemble.advance_others(t, wrench, rows, wanted & (not self._alone), ends)
        least, most = wrench.min(axis=0), wrench.max(axis=0)
        self._range = np.stack([np.minimum(self._range[0], least), np.maximum(self._range[1], most)])
        if math.floor(self.time * _KNOWN_HZ) != self._cell:
            self._note_clearance()
        while self._due and self._due[0][0] <= self.time:
            self._use(*self._due.pop(0))
        if self._due and self.time > self._prepared:
            self._prepare()

    def _stop(self, t: Array, begin: int, digest_after: Container[int]) -> int:
        end = min(begin + _CALL, len(t))
        due = self._due[0][0] if self._due else math.inf
        for place in range(begin, end):
            if place + 1 in digest_after or t[place] >= due or math.floor(t[place] * _KNOWN_HZ) != self._cell:
                return place + 1
        return end

    def _moved(self, worn: Array) -> Array:
        """Return the growth due to wear of the clearances and of their interval ends in m, shape (..., 6).

        `worn` contains the wear depths of the pads in m, shape (..., 8).
        """
        if self.scene.wear is None:
            return _UNMOVED
        return np.repeat(widening(self.scene, worn), 3, axis=-1)

    def _note_clearance(self) -> None:
        self._cell = math.floor(self.time * _KNOWN_HZ)
        estimate = self._present_estimate
        if self.estimate is None and self._ensemble.moved:
            self._clearance = self._ensemble.clearance()
            return
        self._clearance = np.array(
            [[value.mean, value.p05, value.p95] for value in (estimate.horizontal, estimate.vertical)]
        )
        if self.estimate is not None:
            self._clearance -= self._ensemble.moved_before

    def reset(
        self,
        t: float,
        *,
        wear_depth: ArrayLike | None = None,
        pose: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        """Reset the motion at model time `t`, as `Twin.reset` does, and drop earlier measurements."""
        self.catch_up()
        self.drawn += 1
        worn = self._unworn() if wear_depth is None else np.array(wear_depth, dtype=np.float64)
        if self._alone and np.array_equal(worn, self._ensemble.worn_before):
            self._ensemble.start_at(t, worn)
            self._draft, self._prepared = None, t
            self._note_clearance()
        else:
            self._draw("", t, worn, alone=True)
        self._drop_measurements()
        self._wrench = np.zeros(3)
        self._span_start = t
        if pose is not None:
            q, v = (np.asarray(part, dtype=np.float64) for part in pose)
            self._ensemble.move_near(q, v)

    def set_travel_speed(self, speed_m_s: float) -> None:
        """Set the travel speed along the face, as `Twin.set_travel_speed` does."""
        self.catch_up()
        self._speed = abs(float(speed_m_s))
        self._ensemble.set_travel_speed(self._speed)

    def digest(self) -> str:
        """Return a digest of the exact state, as 16 hexadecimal digits."""
        self.catch_up()
        arrays = (part.tobytes() for part in self._ensemble.learned())
        state = [*self._ensemble.twins(), self._wrench.tobytes(), self._ensemble.square.tobytes(), *arrays]
        return hashlib.blake2b(b"".join(state), digest_size=8).hexdigest()

    def snapshot(self) -> bytes:
        """Return the exact state as bytes for a follower with the same scene, number of members and seed."""
        self.catch_up()
        blobs, random = self._ensemble.state()
        noise = np.array(self._noise_rows).reshape(-1, 3)
        blobs += [noise.tobytes(), self._clearance.tobytes(), self._wrench.tobytes()]
        facts = {
            "members": self._members, "added": self.added, "drawn": self.drawn, "estimate": self._text,
            "due": self._due, "used": list(self._used), "speed": self._speed, "cell": self._cell,
            "span": self._span_start, "since": self._since, "worn": self._ensemble.worn_before.tolist(),
            "random": random, "outlying": self._ensemble.outlying, "range": self._range.tolist(),
            "poses": self.poses, "alone": self._alone, "sizes": [len(blob) for blob in blobs],
        }  # fmt: skip
        head = json.dumps(facts).encode()
        return b"".join([_LENGTH.pack(len(head)), head, *blobs])

    def snapshot_size(self, data: bytes) -> int:
        """Return the length in bytes of the snapshot at the beginning of `data`."""
        facts, begin = _facts(data)
        return begin + int(sum(facts["sizes"]))

    def restore(self, data: bytes) -> None:
        """Restore a state that `snapshot` has returned."""
        self._behind = None
        facts, begin = _facts(data)
        blobs = []
        for size in facts["sizes"]:
            blobs.append(data[begin : begin + size])
            begin += size
        worn, self._speed = np.array(facts["worn"]), float(facts["speed"])
        drawn = facts["drawn"], facts["members"], facts["estimate"], facts["worn"], facts["alone"]
        if drawn != (self.drawn, self._members, self._text, self._ensemble.worn_before.tolist(), self._alone):
            self.drawn, self._members = int(facts["drawn"]), int(facts["members"])
            self._draw(facts["estimate"], 0.0, worn, alone=bool(facts["alone"]))
        self.added, self._cell, self._span_start = int(facts["added"]), int(facts["cell"]), float(facts["span"])
        self._since, self.poses = float(facts["since"]), PoseCounts(*facts["poses"])
        self._due = [(float(when), int(number), measured) for when, number, measured in facts["due"]]
        self._used = deque(facts["used"])
        *own, noise, clearance, wrench = blobs
        self._ensemble.set_state(own, facts["random"])
        self._ensemble.outlying, self._range = int(facts["outlying"]), np.array(facts["range"])
        self._noise_rows = deque(np.frombuffer(noise).reshape(-1, 3).copy(), maxlen=_NOISE_ROWS[1])
        self._clearance, self._wrench = np.frombuffer(clearance).reshape(2, 3).copy(), np.frombuffer(wrench).copy()

    def second(self, data: bytes) -> Follower:
        """Return a follower with equal settings, which `restore` must set to the snapshot `data` before any other use.

        Its members are drawn by `draw_piece`, or by `restore` if that has not been called often enough.
        """
        facts, _ = _facts(data)
        second = copy(self)
        # no members have this number, so `restore` never uses the members that both followers still share
        second._behind, second.drawn = None, -1
        members = 1 if facts["alone"] else int(facts["members"])
        second._draft = self._begin_draft(facts["estimate"], int(facts["drawn"]), members, np.array(facts["worn"]))
        return second

    def draw_piece(self) -> bool:
        """Draw the next of five parts of the members that `restore` will need; return whether there was a part left."""
        return self._draft is not None and self._draft.ensemble.draw_piece()

    # -- measurements ------------------------------------------------------------------------------------------------

    def add_pose(self, t: float, q: ArrayLike, known: float = -math.inf) -> None:
        """Add a pose `q`, shape (3,), that was measured at time `t` in s; a component that was not measured is NaN.

        The pose is used when the model reaches both `t` and the time `known` in s, or at once if it is late by at most
        `LATEST_S`.
        """
        self._add(max(t, known), [t, *np.asarray(q, dtype=np.float64).tolist()])

    def add_estimate(self, text: str, t: float, start: float = 0.0) -> None:
        """Add an estimate, the JSON of `Estimate.as_dict`, with a window from `start` [s], for use from time `t` [s].

        After the prior, the members follow an estimate that contains a clearance. Only an estimate that contains the
        same clearances replaces it. A rough clearance does not replace an estimated clearance from nearly the same
        motion. After a withdrawn estimate, the members follow the prior.

        The clearances of the estimate belong to the wear at `t` - `PREPARATION_S`, from when members can be drawn.
        """
        known = t if self.scene.wear is None else t - PREPARATION_S
        self._add(known, _harmonics_from(text, start))

    def _add(self, t: float, measured: list[float] | str) -> None:
        self.added += 1
        if t <= self.time:
            self.catch_up()
            self._use(t, self.added, measured)
        elif isinstance(measured, str) or len(self._due) < _MOST_DUE:
            insort(self._due, (t, self.added, measured), key=lambda due: due[:2])
        else:
            self.poses = self.poses._replace(dropped=self.poses.dropped + 1)

    def _use(self, t: float, number: int, measured: list[float] | str) -> None:
        if not isinstance(measured, str):
            self._use_pose(measured[0], np.array(measured[1:]))
        elif self._is_ready(measured):
            self._adopt(measured)
        elif t + PREPARATION_S <= self.time:
            self._adopt(self._with_wear(measured))
        else:
            insort(self._due, (t + PREPARATION_S, number, self._with_wear(measured)), key=lambda due: due[:2])

    def _adopt(self, measured: str) -> None:
        text = self._text_after(measured)
        if text is not None:
            self._begin_anew(text)

    def _is_ready(self, text: str) -> bool:
        """Return whether members can be drawn from an estimate (JSON): in a scene with wear, it contains the wear."""
        return self.scene.wear is None or not text or _WORN in text

    def _with_wear(self, text: str) -> str:
        """Return an estimate (JSON) with the present wear, unless it has the wear of an earlier time."""
        if self._is_ready(text):
            return text
        return json.dumps(json.loads(text) | {_WORN: self.wear_depth.tolist()})

    def _text_after(self, measured: str) -> str | None:
        """Return the estimate (JSON; empty for the prior) from which `measured` lets members be drawn, or None."""
        if not measured:
            return self._text if self._alone else None
        result = Estimate.from_dict(json.loads(measured))
        if State.WITHDRAWN in (result.horizontal_state, result.vertical_state):
            return "" if self.estimate is not None else None
        return measured if self._is_replaced_by(result) else None

    def _is_replaced_by(self, estimate: Estimate) -> bool:
        new = (estimate.horizontal_state, estimate.vertical_state)
        previous = self.estimate
        if previous is None:
            return any(state.known for state in new)
        pairs = tuple(zip((previous.horizontal_state, previous.vertical_state), new, strict=True))
        if self.time - self._since < tuning.NEW_MOTION * (estimate.t_end - estimate.t_start) and any(
            own is State.ESTIMATED and other is State.ROUGH for own, other in pairs
        ):
            return False
        return all(other.known for own, other in pairs if own.known)

    def learned(self, origin_ns: int | None) -> Learned:
        """Return the estimate, the steering and the counts, which `learn` sets after a change of the motion.

        The harmonics of the load in the estimate wait for `begin_at`, because their phases depend on the model time,
        which began at the stamp `origin_ns` [ns]. Waiting estimates are used at once, for the change would drop them.
        """
        self.catch_up()
        waiting = [item for item in self._due if isinstance(item[2], str)]
        self._due = [item for item in self._due if item not in waiting]
        for _, _, measured in waiting:
            assert isinstance(measured, str)
            self._adopt(self._with_wear(measured))
        return Learned(_waiting(self._text, origin_ns), self.steered, self.poses)

    def learn(self, learned: Learned) -> None:
        """Continue from the present motion with the estimate, the steering and the counts of an earlier state."""
        if self.steered and not learned.steered:  # too many twins for this computer
            self.follow_parameters()
        if learned.estimate != self._text:
            self.catch_up()
            self._begin_anew(learned.estimate)
        self.poses = learned.poses

    def begin_at(self, origin_ns: int) -> None:
        """Set the stamp [ns] of model time 0, and use harmonics of the load that wait for it."""
        if _WAITING in self._text:
            facts = json.loads(self._text)
            harmonics = facts.pop(_WAITING)
            facts[_HARMONICS] = harmonics | {"begin_s": (harmonics.pop(_BEGIN_NS) - origin_ns) * 1e-9}
            self.catch_up()
            self._begin_anew(json.dumps(facts))

    def _begin_anew(self, text: str) -> None:
        previous, joins = self._ensemble, self._alone and text == self._text
        self.drawn += 1
        self._since = self.time
        self._draw(text, self.time, self.wear_depth)
        self._ensemble.start_from(previous, self._wrench, joins=joins)

    def follow_parameters(self) -> None:
        """Continue from the state of the median twin with a single twin that poses do not move."""
        self.catch_up()
        self._members = 1
        self._begin_anew(self._text)

    def _use_pose(self, t: float, q: Array) -> None:
        if self._ensemble.others is None or any(abs(t - used) < APART_S for used in self._used):
            return
        newest = not self._used or t > max(self._used)
        self._used.append(t)
        while self._used and self._used[0] < self.time - 2.0 * LATEST_S:
            self._used.popleft()
        noise, delay = self._sensor()
        if noise is not None:
            outliers = self._ensemble.outlying
            used = self._ensemble.correct(t - delay, q, noise, self._load_error())
            self.poses = self.poses._replace(used=self.poses.used + used)
            if not used and self._ensemble.outlying > outliers:
                self.poses = self.poses._replace(outlying=self.poses.outlying + 1)
                return
        if newest and np.isfinite(q).all():
            self._noise_rows.append(q)

    def _load_error(self) -> Array:
        """Return the standard deviation of the load's error in N, N, N m, shape (3,)."""
        deviation: Array = tuning.LOAD_ERROR_SHARE * self._load_share * 0.5 * (self._range[1] - self._range[0])
        return deviation

    def _sensor(self) -> tuple[Array | None, float]:
        """Return the noise of the sensor in m, m, rad (None after too few poses), and its delay in s."""
        estimate = self.estimate
        noise: Array | None = None
        if estimate is not None and estimate.noise is not None:
            noise = np.array(estimate.noise)
        elif len(self._noise_rows) >= _NOISE_ROWS[0]:
            noise = noise_level(np.array(self._noise_rows))
        if noise is None or not noise.all():
            return None, 0.0
        return noise, 0.0 if estimate is None or estimate.delay is None else max(estimate.delay.mean, 0.0)

    # -- clearances and forces ---------------------------------------------------------------------------------------

    def clearance(self) -> Array:
        """Return the two clearances, each with its 5 % and 95 % quantiles, in m, shape (2, 3)."""
        self.catch_up()
        self._note_clearance()
        found: Array = self._clearance + self._moved(self.wear_depth).reshape(2, 3)
        return found

    def span(self) -> Span:
        """Return peaks and impulses since the previous call.

        A published row ends the span, so the result is valid only if no row has been published since then.
        """
        self.catch_up()
        start, self._span_start = self._span_start, self.time
        interval = Span(start, self.time, *self._ensemble.span())
        self._ensemble.begin_span()
        return interval

    def held(self, t: float) -> Rows:
        """Return the row, shape (1,), at `t` under the load of the newest sample, without a change of the state."""
        self.catch_up()
        rows = np.zeros(1, ROW)
        self._ensemble.held(t, rows)
        rows["known_clearance"] = self._clearance.ravel() + self._moved(rows["wear_depth"])
        return rows


def follower(scene: Scene, follow: str, members: int, tol: float) -> Follower:
    """Return a follower with `members` twins if `follow` is `full`, and with a single twin if it is `parameters`."""
    return Follower(scene, members) if follow == "full" else Follower(scene, 1, tol=tol)


def _harmonics_from(text: str, start: float) -> str:
    """Return an estimate (JSON) with the harmonics' phases counted from `start` [s]."""
    if _HARMONICS not in text:
        return text
    facts = json.loads(text)
    facts[_HARMONICS]["begin_s"] = start
    return json.dumps(facts)


def _waiting(text: str, origin_ns: int | None) -> str:
    """Return an estimate (JSON) whose harmonics wait for `begin_at`; without an origin, they are dropped."""
    if _HARMONICS not in text:
        return text
    facts = json.loads(text)
    harmonics = facts.pop(_HARMONICS)
    if origin_ns is not None:
        facts[_WAITING] = harmonics | {_BEGIN_NS: origin_ns + round(harmonics.pop("begin_s") * 1e9)}
    return json.dumps(facts)


def _load_share(text: str) -> Array:
    """Return a rough estimate's (JSON) error of the load in units of half the load's range, shape (3,), or zero."""
    facts = json.loads(text) if text else {}
    rough = State.ROUGH.value in [facts.get(axis, {}).get("state") for axis in ("horizontal", "vertical")]
    figures = facts.get("figures", {}) if rough else {}
    return np.array([figures.get(f"load_error_{name}", 0.0) for name in ("fx", "fy", "m")])


def _facts(data: bytes) -> tuple[dict[str, Any], int]:
    (length,) = _LENGTH.unpack_from(data)
    begin = _LENGTH.size + length
    return json.loads(data[_LENGTH.size : begin]), begin


def prior(scene: Scene) -> Estimate:
    """Return the prior of a scene as an estimate."""
    units = Units.of(scene, _NO_LOAD)
    unknowns = Unknowns.stated(units.scene(scene), _NO_LOAD, _NO_POSES)
    normal = [Interval.normal(*pair) for pair in zip(unknowns.nominal(), unknowns.deviations(), strict=True)]
    damping = None
    if unknowns.damped:
        value = normal[DAMPING]
        damping = Interval(*(unknowns.damping_of(number) for number in (value.mean, value.p05, value.p95)))
    fx, fy, m = normal[GAIN]
    prior_estimate = replace(prior_of(unknowns, (0.0, 0.0)), damping=damping, gain_fx=fx, gain_fy=fy, gain_m=m)
    return prior_estimate if units == Units() else units.in_si(prior_estimate, scene)


def _whole(estimate: Estimate, previous: Estimate) -> Estimate:
    return replace(
        estimate,
        damping=estimate.damping or previous.damping,
        gain_fx=estimate.gain_fx or previous.gain_fx,
        gain_fy=estimate.gain_fy or previous.gain_fy,
        gain_m=estimate.gain_m or previous.gain_m,
    )
