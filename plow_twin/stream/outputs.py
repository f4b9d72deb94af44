"""What is published of the motion, as plain numbers: one after the other, nothing lost between two of them.

A publication is a function of the journal alone, so that a replay forms the same publications bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import NORMAL_X, NORMAL_Y, PAIR_COUNT, PAIR_NAMES
from plow_twin.model.running_in import with_running_in, without_running_in
from plow_twin.model.scene import Scene
from plow_twin.solve.state import ROW
from plow_twin.solve.totals import add_up, sum_makes, sum_windows

if TYPE_CHECKING:
    from plow_twin.run.advance import Advance, AdvanceSeries

Array = NDArray[np.float64]

#: `clearance` and `wear_rate` change slowly: they are part of the first publication in each such span of stamps.
SLOW_PERIOD_NS: Final = 100_000_000

PAD_NAMES: Final = tuple(f"pad_{name}" for name in PAIR_NAMES)
_CLEARANCES: Final = ("horizontal", "vertical", *PAD_NAMES)
#: The names of `clearance`: the best values, then the 5 % and 95 % points of each.
CLEARANCE_NAMES: Final = (*_CLEARANCES, *(f"{name}/{point}" for name in _CLEARANCES for point in ("p05", "p95")))

#: The two pads on each side: left, right, top, bottom.
_ON_SIDES: Final = np.array(
    [np.flatnonzero(side) for side in (NORMAL_X < 0.0, NORMAL_X > 0.0, NORMAL_Y > 0.0, NORMAL_Y < 0.0)]
)
_STATE_SIZE: Final = 4 * PAIR_COUNT


@dataclass(frozen=True)
class Slow:
    """What changes slowly: `clearance` (30,) [m] under `CLEARANCE_NAMES`, `wear_rate` (8,) [m/s]."""

    clearance: Array
    wear_rate: Array


@dataclass(frozen=True)
class Publication:
    """One publication: the state at `stamp_ns`, and all that happened since the publication before.

    `penetration` [m], `rate` [m/s] and `force` [N] are those at the stamp, shape (8,); `makes` counts all makes so
    far, `impulse` [N s] and `peak` [N] are those since the publication before; `q` [m, m, rad] and `v` have shape (3,).
    `held`: the state at `stamp_ns` was computed without a sample; what happened before it may have had some. Where
    only a part of what happened had samples, `measured_peak` [N] is that of this part. `corrected`: late samples were
    worked in, and `impulse` and `peak` are those since the time to which the model went back. `marked`: one of the two
    is so, or was so in the publication before.
    """

    stamp_ns: int
    penetration: Array
    rate: Array
    force: Array
    makes: NDArray[np.int64]
    impulse: Array
    peak: Array
    q: Array
    v: Array
    slow: Slow | None
    held: bool = False
    corrected: bool = False
    marked: bool = False
    measured_peak: Array | None = None

    @classmethod
    def of_row(cls, row: NDArray[np.void], **others: Any) -> Self:
        """Return the publication whose numbers stand in a `ROW`, shape (1, 1), that nobody writes to any more.

        `others` are stamp, slow part and marks. The numbers are taken out when they are asked for.
        """
        made = cls.__new__(cls)  # a frozen class sets its fields one by one
        made.__dict__.update(others, row=row)
        return made

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name not in _ARRAYS:
            raise AttributeError(name)
        found: NDArray[Any] = self.__dict__["row"][name][0, 0]
        self.__dict__[name] = found
        return found

    @property
    def rows(self) -> NDArray[np.void]:
        """The numbers as a `ROW`, shape (1, 1)."""
        row: NDArray[np.void] | None = self.__dict__.get("row")
        if row is None:
            row = np.zeros((1, 1), ROW)
            for name in _ARRAYS:
                row[name] = getattr(self, name)
        return row

    @property
    def finite(self) -> bool:
        """Whether every number is finite."""
        parts = [self.q, self.v, self.penetration, self.rate, self.force, self.impulse, self.peak]
        if self.slow is not None:
            parts += [self.slow.clearance, self.slow.wear_rate]
        return math.isfinite(np.add.reduce(np.concatenate(parts)))


@dataclass(frozen=True)
class Publications:
    """Many publications: the numbers of `Publication` with an axis (n,) in front; `slow_index` (m,) have slow parts.

    What is said of a publication beside its numbers (held, corrected) is not here.
    """

    stamp_ns: NDArray[np.int64]
    penetration: Array
    rate: Array
    force: Array
    makes: NDArray[np.int64]
    impulse: Array
    peak: Array
    q: Array
    v: Array
    slow_index: NDArray[np.int64]
    clearance: Array
    wear_rate: Array
    #: of the first one: `Publication.measured_peak`
    measured_peak: Array | None = None

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def __getitem__(self, index: int) -> Publication:
        place = int(np.searchsorted(self.slow_index, index))
        slow = place < len(self.slow_index) and self.slow_index[place] == index
        return Publication(
            stamp_ns=int(self.stamp_ns[index]),
            **{name: getattr(self, name)[index] for name in _ARRAYS},
            slow=Slow(self.clearance[place], self.wear_rate[place]) if slow else None,
            measured_peak=None if index else self.measured_peak,
        )

    @classmethod
    def of(cls, publications: Sequence[Publication]) -> Publications:
        """Put publications together."""
        slow = [
            (index, publication.slow) for index, publication in enumerate(publications) if publication.slow is not None
        ]
        arrays = {name: np.stack([getattr(publication, name) for publication in publications]) for name in _ARRAYS}
        return cls(
            stamp_ns=np.array([publication.stamp_ns for publication in publications], np.int64),
            **arrays,
            slow_index=np.array([index for index, _ in slow], np.int64),
            clearance=np.array([part.clearance for _, part in slow]).reshape(-1, len(CLEARANCE_NAMES)),
            wear_rate=np.array([part.wear_rate for _, part in slow]).reshape(-1, PAIR_COUNT),
        )


_ARRAYS: Final = ("penetration", "rate", "force", "makes", "impulse", "peak", "q", "v")


def clearances(scene: Scene, wear_depth: Array) -> Array:
    """Return total horizontal and vertical clearance and the eight pad depths, shape (..., 10) [m], from (..., 8).

    A side's walls move out by the mean wear depth of the two pads on it.
    """
    moved = 0.5 * (wear_depth[..., _ON_SIDES[:, 0]] + wear_depth[..., _ON_SIDES[:, 1]])
    found = np.empty((*wear_depth.shape[:-1], len(_CLEARANCES)))
    found[..., 0] = scene.clearance.horizontal_m + moved[..., 0] + moved[..., 1]
    found[..., 1] = scene.clearance.vertical_m + moved[..., 2] + moved[..., 3]
    found[..., 2:] = wear_depth
    return found


def prior_points(scene: Scene, wear_depth: Array) -> tuple[Array, Array]:
    """Return the 5 % and 95 % points of the pad depths under the prior of the wear coefficient, shape (8,) each [m].

    Growth is proportional to k_s as long as it is small against the clearance, or what it would be without running-in
    is. Without wear, or with k_s = 0, both points equal the wear depth.
    """
    if scene.wear is None or scene.wear.coefficient_m2_n == 0.0:
        return wear_depth, wear_depth
    initial = np.asarray(scene.wear.initial_depth_m)
    low, high = (point / scene.wear.coefficient_m2_n for point in scene.wear.prior_m2_n)
    if scene.wear.running_in_ratio > 1.0:
        begin, steady = without_running_in(scene.wear, initial), without_running_in(scene.wear, wear_depth)
        points = [with_running_in(scene.wear, begin + (steady - begin) * share) for share in (low, high)]
        return points[0], points[1]
    return initial + (wear_depth - initial) * low, initial + (wear_depth - initial) * high


def warm_up() -> None:
    """Compile what a publication of a single advance needs, or load it from the cache on disk."""
    add_up(np.zeros((1, 1), ROW), np.zeros(PAIR_COUNT, np.int64), np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT))


class Outputs:
    """Collect advances into publications. Makes, impulses and peaks survive any number of advances between two."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._advance: Advance | None = None
        self._stamp_ns = 0
        self._makes = np.zeros(PAIR_COUNT, np.int64)
        self._impulse = np.zeros(PAIR_COUNT)
        self._peak = np.zeros(PAIR_COUNT)
        #: of the advances with a sample, once there was one of either kind; None: they are all of one
        self._measured_peak: Array | None = None
        #: stamp and pad depths of the last slow part; None before the first
        self._slow_ns: int | None = None
        self._slow_wear_depth = np.zeros(PAIR_COUNT)
        self._held = False
        #: from when on what was told before has been computed again [ns]
        self._corrected_ns: int | None = None
        #: of before that: stamp and advance that the next publication was to show, and whether it was held
        self._before: tuple[int, Advance, bool] | None = None
        self._marked = False
        #: what an estimate adds to the clearances and their points, as in `CLEARANCE_NAMES`; None: nothing is estimated
        self._shift: Array | None = None

    def set_shift(self, shift: Sequence[float]) -> None:
        """Add to the horizontal and the vertical clearance of the model, and to their points, from now on.

        `shift` has 6 numbers [m]: horizontal, its 5 % and 95 % points, vertical, its points. No part of `state`: an
        estimate stays when late samples are worked in.
        """
        values = np.zeros(len(CLEARANCE_NAMES))
        for axis in range(2):
            points = len(_CLEARANCES) + 2 * axis
            values[[axis, points, points + 1]] = shift[3 * axis : 3 * axis + 3]
        self._shift = values if values.any() else None

    def set_scene(self, scene: Scene) -> None:
        """Speak of a scene with other numbers from here on."""
        self._scene = scene

    def clear_shift(self) -> None:
        """Let the clearances be those of the model again."""
        self._shift = None

    def add(self, stamp_ns: int, advance: Advance, held: bool = False) -> None:
        """Take in one good advance that ended at `stamp_ns`; `held`: computed without a sample."""
        self._measured_peak = self._measured(advance.peak, held)
        self._advance = advance
        self._stamp_ns, self._held = stamp_ns, held
        self._makes += advance.makes
        self._impulse += advance.impulse
        np.maximum(self._peak, advance.peak, out=self._peak)

    def _measured(self, peak: Array, held: bool) -> Array | None:
        """Return what `_measured_peak` is with further advances, which have the peak `peak`."""
        before = self._measured_peak
        if before is None and (self._advance is None or self._held is held):
            return None
        if before is None:
            return self._peak.copy() if held else peak
        return before if held else np.maximum(before, peak)

    def add_series(self, stamps_ns: Sequence[int], series: AdvanceSeries) -> None:
        """Take in many advances that ended at samples, at `stamps_ns`; those that failed count for nothing."""
        good = np.flatnonzero(series.status == 0)
        if good.size == 0:
            return
        last = int(good[-1])
        peak = series.peak[good].max(axis=0)
        self._measured_peak = self._measured(peak, False)
        self._advance, self._stamp_ns, self._held = series[last], stamps_ns[last], False
        self._makes += series.makes[good].sum(axis=0)
        # row by row, as `add` does: the sum has the same bits
        self._impulse = np.add.reduce(np.concatenate((self._impulse[None], series.impulse[good])), axis=0)
        np.maximum(self._peak, peak, out=self._peak)

    def correct(self, stamp_ns: int, oldest_ns: int) -> int:
        """Note that all from `stamp_ns` on is computed again; return from when on it is since the last publication.

        That is later than `oldest_ns`: what was computed again before it stays as it is.
        """
        if self._corrected_ns is None or self._corrected_ns <= oldest_ns:
            self._corrected_ns = stamp_ns
            self._before = None if self._advance is None else (self._stamp_ns, self._advance, self._held)
        self._corrected_ns = min(stamp_ns, self._corrected_ns)
        if self._before is not None and self._before[0] >= self._corrected_ns:
            self._before = None
        return self._corrected_ns

    def begin_correction(self) -> None:
        """Let impulses and peaks begin here, at the time that `correct` returned.

        What has been published up to here is not published again, even if each advance from here on should fail.
        """
        self._impulse[:] = 0.0
        self._peak[:] = 0.0
        self._advance = self._measured_peak = None
        if self._before is not None:
            self._stamp_ns, self._advance, self._held = self._before

    @property
    def slow_before(self) -> tuple[int | None, Array]:
        """Stamp and pad depths of the last slow part that was published."""
        return self._slow_ns, self._slow_wear_depth

    @slow_before.setter
    def slow_before(self, before: tuple[int | None, Array]) -> None:
        self._slow_ns, self._slow_wear_depth = before

    @property
    def pending(self) -> tuple[int, Advance] | None:
        """Stamp and advance that the next publication shows, None when there is none since the last."""
        return None if self._advance is None else (self._stamp_ns, self._advance)

    def set_pending(self, pending: tuple[int, Advance] | None) -> None:
        """Go back to what `pending` was: `state` does not hold it."""
        self._stamp_ns, self._advance = (self._stamp_ns, None) if pending is None else pending

    @property
    def is_empty(self) -> bool:
        """Whether there was no advance since the last publication."""
        return self._advance is None

    def publish_row(self, stamp_ns: int, row: NDArray[np.void]) -> Publication | None:
        """Take in an advance that ended at a sample, as `add` and `take` do together; None when it failed.

        `row` is a `ROW`, shape (1, 1), that becomes the publication's.
        """
        if add_up(row, self._makes, self._impulse, self._peak):
            return None
        self._stamp_ns, self._held = stamp_ns, False
        slow = self._slow_part(row["wear_depth"][0, 0]) if self._is_slow_due() else None
        if self._marked or self._corrected_ns is not None:
            return Publication.of_row(row, stamp_ns=stamp_ns, slow=slow, **self._take_marks())
        return Publication.of_row(row, stamp_ns=stamp_ns, slow=slow)

    def restart(self) -> None:
        """Forget what has not been published; the makes go on counting."""
        self._advance = None
        self._slow_ns = None
        self._corrected_ns = self._before = self._measured_peak = None
        self._impulse[:] = 0.0
        self._peak[:] = 0.0

    def take(self) -> Publication | None:
        """Return the publication of everything since the last one, or None when there was no advance since."""
        advance, self._advance = self._advance, None
        if advance is None:
            return None
        publication = Publication.__new__(Publication)
        # all at once: a frozen class sets its fields one by one
        publication.__dict__.update(
            stamp_ns=self._stamp_ns,
            penetration=advance.penetration,
            rate=advance.rate,
            force=advance.force,
            makes=self._makes.copy(),
            impulse=self._impulse.copy(),
            peak=self._peak.copy(),
            q=advance.q,
            v=advance.v,
            slow=self._slow_part(advance.wear_depth) if self._is_slow_due() else None,
            measured_peak=self._measured_peak,
            **self._take_marks(),
        )
        self._measured_peak = None
        self._impulse[:] = 0.0
        self._peak[:] = 0.0
        return publication

    def _take_marks(self) -> dict[str, bool]:
        """Return what is said of a publication beside its numbers; the next one is not corrected any more."""
        corrected = self._corrected_ns is not None
        mark, before = self._held or corrected, self._marked
        self._corrected_ns, self._before, self._marked = None, None, mark
        return {"held": self._held, "corrected": corrected, "marked": mark or before}

    def take_rows(self, stamps: NDArray[np.int64], rows: AdvanceSeries, taken: NDArray[np.int64]) -> Publications:
        """Take in good advances that ended at `stamps`, with a publication after each of the rows `taken` (rising).

        The same bits as `add` for each row and `take` after those rows.
        """
        # after each row: views instead of copies
        chosen: NDArray[np.int64] | slice = slice(None) if len(taken) == len(stamps) else taken
        makes, impulse, peak = self._windows(rows, taken)
        slow_index, clearance, wear_rate = self._slow_rows(stamps[chosen], rows.wear_depth[chosen])
        measured_peak = self._measured_peak
        if measured_peak is not None:
            end = int(taken[0]) + 1 if len(taken) else len(stamps)
            measured_peak = np.maximum(measured_peak, rows.peak[:end].max(axis=0))
        self._measured_peak = None if len(taken) else measured_peak
        publications = Publications(
            stamp_ns=stamps[chosen],
            penetration=rows.penetration[chosen],
            rate=rows.rate[chosen],
            force=rows.force[chosen],
            makes=makes,
            impulse=impulse,
            peak=peak,
            q=rows.q[chosen],
            v=rows.v[chosen],
            slow_index=slow_index,
            clearance=clearance,
            wear_rate=wear_rate,
            measured_peak=measured_peak if len(taken) else None,
        )
        self._stamp_ns, self._held = int(stamps[-1]), False
        begin = int(taken[-1]) + 1 if len(taken) else 0
        self._advance = rows[len(stamps) - 1] if begin < len(stamps) else None
        if len(taken):
            self._corrected_ns = self._before = None
        return publications

    def _windows(self, rows: AdvanceSeries, taken: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array, Array]:
        """Return makes so far, impulse and peak of the window that ends with each of the rows `taken`."""
        if len(taken) == len(rows) and not (self._impulse.any() or self._peak.any()):
            # each row is a window
            makes, self._makes = np.empty((len(rows), PAIR_COUNT), np.int64), self._makes.copy()
            sum_makes(rows.makes, self._makes, makes)
            return makes, rows.impulse, rows.peak
        eight = (len(taken), PAIR_COUNT)
        makes, impulse, peak = np.empty(eight, np.int64), np.empty(eight), np.empty(eight)
        self._makes, self._impulse, self._peak = self._makes.copy(), self._impulse.copy(), self._peak.copy()
        sum_windows(
            (rows.makes, rows.impulse, rows.peak), taken, self._makes, self._impulse, self._peak, makes, impulse, peak
        )
        return makes, impulse, peak

    def _slow_rows(self, stamps: NDArray[np.int64], wear_depth: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return which of some publications have a slow part, and the parts."""
        before_ns, wear_before = self._slow_ns, self._slow_wear_depth
        spans = stamps // SLOW_PERIOD_NS
        changed = np.ones(len(stamps), bool)
        changed[1:] = spans[1:] != spans[:-1]
        if before_ns is not None and len(stamps):
            changed[0] = spans[0] != before_ns // SLOW_PERIOD_NS
        index = np.flatnonzero(changed)
        if not index.size:
            return index, np.zeros((0, len(CLEARANCE_NAMES))), np.zeros((0, PAIR_COUNT))
        stamps, wear_depth = stamps[index], wear_depth[index]
        elapsed_s, grown = np.ones(len(stamps)), np.zeros(wear_depth.shape)
        elapsed_s[1:], grown[1:] = np.diff(stamps) * 1e-9, np.diff(wear_depth, axis=0)
        if before_ns is not None and stamps[0] > before_ns:
            elapsed_s[0], grown[0] = (stamps[0] - before_ns) * 1e-9, wear_depth[0] - wear_before
        self._slow_ns, self._slow_wear_depth = int(stamps[-1]), wear_depth[-1].copy()
        return index, self._clearance(wear_depth), grown / elapsed_s[:, None]

    def _is_slow_due(self) -> bool:
        before_ns = self._slow_ns
        return before_ns is None or self._stamp_ns // SLOW_PERIOD_NS != before_ns // SLOW_PERIOD_NS

    def _slow_part(self, wear_depth: Array) -> Slow:
        before_ns = self._slow_ns
        grown, elapsed_s = np.zeros(PAIR_COUNT), 1.0
        if before_ns is not None and self._stamp_ns > before_ns:
            grown, elapsed_s = wear_depth - self._slow_wear_depth, (self._stamp_ns - before_ns) * 1e-9
        self._slow_ns, self._slow_wear_depth = self._stamp_ns, wear_depth.copy()
        return Slow(self._clearance(wear_depth), grown / elapsed_s)

    def _clearance(self, wear_depth: Array) -> Array:
        """Return what `CLEARANCE_NAMES` name, shape (..., 30) [m], from (..., 8)."""
        best, points = clearances(self._scene, wear_depth), prior_points(self._scene, wear_depth)
        low, high = (best if depth is wear_depth else clearances(self._scene, depth) for depth in points)
        count = len(_CLEARANCES)
        found = np.empty((*wear_depth.shape[:-1], 3 * count))
        found[..., :count], found[..., count::2], found[..., count + 1 :: 2] = best, low, high
        if self._shift is not None:
            found += self._shift
        return found

    def modelled(self, wear_depth: Array) -> Array:
        """Return the horizontal clearance of the model and its two points, then the vertical ones, shape (6,) [m]."""
        middle = clearances(self._scene, wear_depth)
        low, high = (clearances(self._scene, points) for points in prior_points(self._scene, wear_depth))
        return np.stack((middle, low, high), axis=1)[:2].ravel()

    def state(self) -> bytes:
        """Return what the numbers of the next publication depend on beside the next advance, exactly."""
        slow_ns = -1 if self._slow_ns is None else self._slow_ns
        numbers = (self._makes, self._impulse, self._peak, self._slow_wear_depth, np.array([slow_ns]))
        return b"".join(part.tobytes() for part in numbers)

    def set_state(self, data: bytes) -> None:
        """Go on from a state that `state` returned."""
        parts = np.frombuffer(data, np.float64, _STATE_SIZE).reshape(4, PAIR_COUNT)
        self._makes = parts[0].view(np.int64).copy()
        self._impulse, self._peak, self._slow_wear_depth = (part.copy() for part in parts[1:])
        slow_ns = int(np.frombuffer(data, np.int64, 1, offset=8 * _STATE_SIZE)[0])
        self._slow_ns = None if slow_ns < 0 else slow_ns
        self._advance = None

    @staticmethod
    def state_size() -> int:
        """Length of `state()` in bytes."""
        return 8 * (_STATE_SIZE + 1)
