"""Sums over the contacts of a run, such as impacts, forces, contact times and dissipated energy."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.walking import Walked
from plow_twin.run.energy_balance import elastic_energy

Array = NDArray[np.float64]

CYCLE_BINS: Final = 16
FACE_BIN_M: Final = 1.0
#: Memory [B] of a `Series`, enough for 131,072 numbers.
_IN_MEMORY: Final = 2**20


@dataclass
class Pass:
    """A motion along the face in one direction, from one reversal of the travel to the next.

    Times are in s since the first stamp, positions along the face in m, energies in J.
    """

    start_s: float
    end_s: float
    start_m: float
    end_m: float
    impacts: int
    largest_force_n: float
    contact_loss_j: float


class Series:
    """A series of any length. Beyond `_IN_MEMORY` bytes, it is stored on the disk."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 (goes with this object)
        weakref.finalize(self, self._file.close)
        self.low, self.high, self.last = math.inf, -math.inf, math.nan

    def __iter__(self) -> Iterator[float]:
        """Yield the numbers. No number may be added during the iteration."""
        self._file.seek(0)
        while block := self._file.read(_IN_MEMORY):
            yield from np.frombuffer(block).tolist()

    def add(self, values: Array) -> None:
        """Append at least one number, shape (n,)."""
        self._file.seek(0, 2)
        self._file.write(values.astype(np.float64).tobytes())
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
        self.last = float(values[-1])


@dataclass
class LoadTotals:
    """Sums over all rows of a run."""

    scene: Scene
    duration_s: float = 0.0
    impacts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(PAIR_COUNT, np.int64))
    impulse: Array = field(default_factory=lambda: np.zeros(PAIR_COUNT))
    largest: Array = field(default_factory=lambda: np.zeros(PAIR_COUNT))
    contact_s: Array = field(default_factory=lambda: np.zeros(PAIR_COUNT))
    contact_loss_j: float = 0.0
    sets: Counter[int] = field(default_factory=Counter)
    passes: list[Pass] = field(default_factory=list)
    #: Largest force [N], by index of the pass and of the piece of the face.
    face: dict[tuple[int, int], float] = field(default_factory=dict)
    #: Wear depth [m] that the pads have gained, by direction of travel (0 forward, 1 backward).
    pad_wear: Array = field(default_factory=lambda: np.zeros((2, PAIR_COUNT)))
    #: Wear depth [m] of the slide at each pair, by direction of travel and piece of the face.
    slide_wear: dict[tuple[int, int], Array] = field(default_factory=dict)
    _first_ns: int | None = None
    #: Stamp [ns], load, pose, velocities and penetrations of the last row.
    _last: tuple[int, Array, Array, Array, Array] | None = None
    #: Wear depth [m] of the pads after the last row.
    _worn: Array | None = None
    _place_m: float = 0.0
    _direction: float = 0.0
    _reversals: list[Series] = field(default_factory=lambda: [Series() for _ in range(PAIR_COUNT)])

    def restart(self) -> None:
        """Continue after a reset. The interval across the reset is not counted."""
        self._last = self._worn = None

    def add(self, walked: Walked) -> None:
        """Add a batch of computed rows."""
        self.scene = walked.scene
        rows, stamps = walked.rows, walked.stamp_ns
        self._first_ns = int(stamps[0]) if self._first_ns is None else self._first_ns
        steps = np.zeros(len(stamps))
        steps[1:] = np.diff(stamps) * 1e-9
        if self._last is not None:
            steps[0] = max(0.0, (int(stamps[0]) - self._last[0]) * 1e-9)
        self.duration_s += float(steps.sum())
        self.impacts += walked.makes.sum(axis=0)
        self.impulse += rows.impulse.sum(axis=0)
        np.maximum(self.largest, rows.peak.max(axis=0), out=self.largest)
        self.contact_s += rows.time_in_contact[steps > 0.0].sum(axis=0)
        masks = ((rows.force > 0.0) << np.arange(PAIR_COUNT)).sum(axis=1)
        for mask, count in zip(*np.unique(masks, return_counts=True), strict=True):
            self.sets[int(mask)] += int(count)
        for pair, kept in enumerate(self._reversals):
            turning = reversals(rows.peak[:, pair])
            if turning.any() or kept.last != 0.0:  # one zero is enough for a long time without contact
                kept.add(turning)
        loss = self._contact_loss(walked, steps)
        self.contact_loss_j += float(loss.sum())
        self._face(walked, steps, loss)
        last = (walked.wrench, rows.q, rows.v, rows.penetration)
        self._last = (int(stamps[-1]), *(column[-1].copy() for column in last))

    def _contact_loss(self, walked: Walked, steps: Array) -> Array:
        """Return the energy [J] that the contacts dissipate between rows: the work of the load minus the gain."""
        now = walked.wrench, walked.rows.q, walked.rows.v, walked.rows.penetration
        first = (column[0] for column in now) if self._last is None else self._last[1:]
        before = [
            np.concatenate((first_value[None], column[:-1])) for first_value, column in zip(first, now, strict=True)
        ]
        work: Array = (0.5 * (now[0] + before[0]) * (now[1] - before[1])).sum(axis=1)
        gain = self._energy(*now[1:]) - self._energy(*before[1:])
        return np.where(steps > 0.0, work - gain, 0.0)

    def _energy(self, q: Array, v: Array, penetration: Array) -> Array:
        head, gravity = self.scene.head, self.scene.gravity
        theta, omega = q[:, 2], v[:, 2]
        # vector from the centre of the cavity to the centre of mass, in world axes
        along = np.cos(theta) * head.com_offset_m[0] - np.sin(theta) * head.com_offset_m[1]
        up = np.sin(theta) * head.com_offset_m[0] + np.cos(theta) * head.com_offset_m[1]
        speed_2 = (v[:, 0] - omega * up) ** 2 + (v[:, 1] + omega * along) ** 2
        height = q[:, 1] + up + gravity.arm_m * theta
        kinetic = 0.5 * (head.mass_kg * speed_2 + head.inertia_kg_m2 * omega**2)
        potential = head.mass_kg * gravity.acceleration_m_s2 * height
        return np.asarray(kinetic + potential + elastic_energy(self.scene, penetration))

    def _face(self, walked: Walked, steps: Array, loss: Array) -> None:
        speed = walked.speed_m_s
        direction = math.copysign(1.0, speed) if speed else 0.0
        now_s = (int(walked.stamp_ns[0]) - (self._first_ns or 0)) * 1e-9
        if not self.passes or (direction and self._direction and direction != self._direction):
            self.passes.append(Pass(now_s, now_s, self._place_m, self._place_m, 0, 0.0, 0.0))
        self._direction = direction or self._direction
        place = self._place_m + speed * np.cumsum(steps)
        self._place_m = float(place[-1])
        largest = walked.rows.peak.max(axis=1)
        here = self.passes[-1]
        here.end_s = (int(walked.stamp_ns[-1]) - (self._first_ns or 0)) * 1e-9
        here.end_m = self._place_m
        here.impacts += int(walked.makes.sum())
        here.largest_force_n = max(here.largest_force_n, float(largest.max()))
        here.contact_loss_j += float(loss.sum())
        if speed:
            pieces = np.floor(place / FACE_BIN_M).astype(np.int64)
            for piece in np.unique(pieces).tolist():
                key = (len(self.passes) - 1, piece)
                self.face[key] = max(self.face.get(key, 0.0), float(largest[pieces == piece].max()))
            self._wear(walked.rows.wear_depth, speed, pieces)
        self._worn = walked.rows.wear_depth[-1].copy()

    def _wear(self, depth: Array, speed: float, pieces: NDArray[np.int64]) -> None:
        """Add the wear of the pads, and the wear of the pieces of the slide that the pads pass.

        A pad wears over the whole distance travelled. A point of the slide wears only while a pad passes it.
        """
        wear = self.scene.wear
        if wear is None or wear.coefficient_m2_n == 0.0:
            return
        gained = np.diff(depth, axis=0, prepend=depth[:1] if self._worn is None else self._worn[None])
        backward = int(speed < 0.0)
        self.pad_wear[backward] += gained.sum(axis=0)
        if wear.pad_length_m is None:
            return
        share = wear.pad_length_m / FACE_BIN_M
        for piece in np.unique(pieces).tolist():
            key = (backward, piece)
            self.slide_wear[key] = self.slide_wear.get(key, 0.0) + share * gained[pieces == piece].sum(axis=0)

    def wear_facts(self) -> dict[str, Any] | None:
        """Return the wear depths [m] for JSON, or None without wear."""
        if not self.pad_wear.any():
            return None
        pads = {
            name: dict(zip(PAIR_NAMES, depth.tolist(), strict=True))
            for name, depth in zip(("forward", "backward"), self.pad_wear, strict=True)
        }
        out: dict[str, Any] = {"pads_m": pads}
        if self.slide_wear:
            pieces = {piece for _, piece in self.slide_wear}
            total = np.sum(list(self.slide_wear.values()), axis=0) / len(pieces)
            out["slide_mean_m"] = dict(zip(PAIR_NAMES, total.tolist(), strict=True))
            out["slide_pieces"] = len(pieces)
        return out

    def cycles(self) -> dict[str, list[dict[str, float]]]:
        """Return the rainflow counts (ASTM E1049) of each pair's force: upper end [N] and count of each bin."""
        import rainflow

        by_pair = {}
        for pair, kept in enumerate(self._reversals):
            if kept.high > kept.low:
                bins = rainflow.count_cycles(kept, binsize=(kept.high - kept.low) / CYCLE_BINS)
                by_pair[PAIR_NAMES[pair]] = [{"range_n": float(size), "count": float(count)} for size, count in bins]
        return by_pair

    def facts(self) -> dict[str, Any]:
        """Return all sums for JSON."""
        total = max(1, self.sets.total())
        # the motion is relative to a frame on springs, whose energy is not known
        unknown = {} if self.scene.support is None else {"contact_loss_j": None}
        return {
            "duration_s": self.duration_s,
            "impacts": dict(zip(PAIR_NAMES, self.impacts.tolist(), strict=True)),
            "largest_force_n": dict(zip(PAIR_NAMES, self.largest.tolist(), strict=True)),
            "impulse_n_s": dict(zip(PAIR_NAMES, self.impulse.tolist(), strict=True)),
            "duty": dict(zip(PAIR_NAMES, (self.contact_s / max(self.duration_s, 1e-300)).tolist(), strict=True)),
            "contact_loss_j": self.contact_loss_j,
            "passes": [vars(item) | unknown for item in self.passes],
            "wear": self.wear_facts(),
            "cycles": self.cycles(),
            "contact_sets": {
                "+".join(PAIR_NAMES[pair] for pair in range(PAIR_COUNT) if mask >> pair & 1) or "none": count / total
                for mask, count in self.sets.most_common()
            },
            **unknown,
        }


def reversals(values: Array) -> Array:
    """Return the turning points of a series, including its ends."""
    if len(values) < 3:
        return values
    changes = np.flatnonzero(np.diff(values) != 0.0)
    if not changes.size:
        return values[:1]
    kept = np.concatenate((values[changes], values[-1:]))
    rising = np.diff(kept) > 0.0
    turns = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    return np.concatenate((kept[:1], kept[turns], kept[-1:]))
