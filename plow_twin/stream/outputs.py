"""Publications of the motion; each row summarises the motion since the previous row.

The motion since the previous publication is called the *window*. Clearances and wear rates change slowly, so at most
one publication in 0.1 s contains them. They form the *slow part* of a publication. Publications depend on the journal
alone, so a replay gives bit-identical publications.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import for_arguments
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y, PAIR_COUNT, PAIR_NAMES
from plow_twin.model.running_in import with_running_in, without_running_in
from plow_twin.model.scene import Scene
from plow_twin.solve.state import ROW, WITH_INTERVALS
from plow_twin.solve.totals import publish, publish_window, summary

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Rows = NDArray[np.void]

#: Period of the slow parts [ns]; only the first publication in each period has a slow part.
SLOW_PERIOD_NS: Final = 100_000_000

PAD_NAMES: Final = tuple(f"pad_{name}" for name in PAIR_NAMES)
_CLEARANCES: Final = ("horizontal", "vertical", *PAD_NAMES)
#: Names of the numbers in the field `clearance`: all best values, then the 5 % and 95 % quantiles of each value.
CLEARANCE_NAMES: Final = (*_CLEARANCES, *(f"{name}/{point}" for name in _CLEARANCES for point in ("p05", "p95")))

#: Indices of the two pads on each side, in the order left, right, top, bottom.
_ON_SIDES: Final = np.array(
    [np.flatnonzero(side) for side in (NORMAL_X < 0.0, NORMAL_X > 0.0, NORMAL_Y > 0.0, NORMAL_Y < 0.0)]
)
_STATE_SIZE: Final = 4 * PAIR_COUNT
#: Length of the result of `Outputs.state` [B].
STATE_BYTES: Final = 8 * (_STATE_SIZE + 1)
#: Record of a slow part. `clearance` is in the order of `CLEARANCE_NAMES` [m]; `wear_rate` is the growth of each wear
#: depth [m/s].
SLOW: Final = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("row", "i8"),  # index in the publication of the row with this slow part
        ("clearance", "f8", (len(CLEARANCE_NAMES),)),
        ("wear_rate", "f8", (PAIR_COUNT,)),
    ]
)
#: Indices of the published rows if a single row is added and published.
ONLY_ROW: Final = np.zeros(1, np.int64)
#: Indices of the published rows if no row is published.
NONE: Final = np.zeros(0, np.int64)
_NO_ROWS: Final = np.zeros(0, ROW)
_NO_SLOW: Final = np.zeros(0, SLOW)
FOLLOWED_FIELDS: Final = (
    "followed", "known_clearance", "force_low", "force_high", "peak_low", "peak_high", "impulse_low", "impulse_high",
)  # fmt: skip
_MOTION: Final = ("t", "stamp_ns", "held", "q", "v", "penetration", "rate", "force", "wear_depth", *FOLLOWED_FIELDS)
#: Fields that are checked for numbers that are not finite.
_SUMMED: Final = ("q", "v", "penetration", "rate", "force", "impulse", "peak")
#: Indices in `clearance` of the numbers in `known_clearance`, and of the numbers that an estimate shifts.
_KNOWN: Final = np.array([0, len(_CLEARANCES), len(_CLEARANCES) + 1, 1, len(_CLEARANCES) + 2, len(_CLEARANCES) + 3])
#: Number of rows allocated together. The allocation takes about as long as the allocation of a single row.
_STOCK: Final = 256


class Published(NamedTuple):
    """A publication: `rows` of type `ROW`, shape (n,), and the slow parts of some rows, of type `SLOW`, shape (m,)."""

    rows: Rows
    slow: Rows

    @property
    def finite(self) -> bool:
        """Whether every number is finite."""
        if len(self.rows) == 1:
            rows_finite = summary(self.rows, 0)[-1]
        else:
            rows_finite = all(bool(np.isfinite(self.rows[name]).all()) for name in _SUMMED)
        return rows_finite and (
            not len(self.slow) or all(bool(np.isfinite(self.slow[name]).all()) for name in ("clearance", "wear_rate"))
        )

    @property
    def with_intervals(self) -> bool:
        """Whether the first row contains intervals of its forces."""
        return len(self.rows) > 0 and int(self.rows["followed"][0]) == WITH_INTERVALS

    def at(self, index: int) -> Published:
        """Return the row with the given index, and its slow part if it has one."""
        slow = self.slow[self.slow["row"] == index]
        return Published(self.rows[index : index + 1], _numbered_from(slow, index))

    def of(self, index: Integers) -> Published:
        """Return the rows with the given indices, which must rise, and the slow parts of these rows."""
        slow = self.slow[np.isin(self.slow["row"], index)]
        slow["row"] = np.searchsorted(index, slow["row"])
        return Published(self.rows[index], slow)

    @classmethod
    def joined(cls, parts: Sequence[Published]) -> Published:
        """Return the concatenation of several publications."""
        if len(parts) == 1:
            return parts[0]
        begins = np.cumsum([0, *(len(part.rows) for part in parts)]).tolist()
        slow = [_numbered_from(part.slow, -begin) for part, begin in zip(parts, begins, strict=False)]
        rows = [part.rows for part in parts]
        return cls(np.concatenate(rows) if rows else _NO_ROWS, np.concatenate(slow) if slow else _NO_SLOW)


NOTHING: Final = Published(_NO_ROWS, _NO_SLOW)


def _numbered_from(slow: Rows, first: int) -> Rows:
    """Return a copy of slow parts with row indices that count from the row `first`."""
    if len(slow):
        slow = slow.copy()
        slow["row"] -= first
    return slow


class Stock:
    """Allocator of rows. Each row is used only once, so that a stored publication never changes."""

    def __init__(self) -> None:
        self._rows, self._used = _NO_ROWS, 0

    def new(self, count: int) -> Rows:
        """Return `count` rows that have not been used before."""
        if self._used + count > len(self._rows):
            self._rows, self._used = np.zeros(max(count, _STOCK), ROW), 0
        begin, self._used = self._used, self._used + count
        return self._rows[begin : self._used]


def clearances(scene: Scene, wear_depth: Array) -> Array:
    """Return the horizontal and vertical clearance, followed by the eight wear depths, shape (..., 10) [m].

    `wear_depth` has the shape (..., 8). The wall of a side is assumed to move out by the mean wear depth of its two
    pads.
    """
    moved = 0.5 * (wear_depth[..., _ON_SIDES[:, 0]] + wear_depth[..., _ON_SIDES[:, 1]])
    clearance = np.empty((*wear_depth.shape[:-1], len(_CLEARANCES)))
    clearance[..., 0] = scene.clearance.horizontal_m + moved[..., 0] + moved[..., 1]
    clearance[..., 1] = scene.clearance.vertical_m + moved[..., 2] + moved[..., 3]
    clearance[..., 2:] = wear_depth
    return clearance


def prior_points(scene: Scene, wear_depth: Array) -> tuple[Array, Array]:
    """Return the 5 % and 95 % quantiles of the wear depths [m] under the prior of the coefficient, shape (8,) each.

    Running-in is neglected. The growth of a depth is assumed to be proportional to the wear coefficient k_s, which is
    accurate while the growth is small compared with the clearance. Without wear, both quantiles equal the wear depth.
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


class Outputs:
    """Combine advances into publications without losing a peak, an impulse or a touch."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._publish = _publish()
        #: the window; it includes the newest advance if `_waits` is 1
        self._window = np.zeros(1, ROW)
        self._waits = 0
        self._stock = Stock()
        #: stamp [ns] and wear depths [m] of the last slow part; the stamp is None before the first
        self.slow_before: tuple[int | None, Array] = None, np.zeros(PAIR_COUNT)
        #: stamp from which the motion was computed again [ns], valid while the field `corrected` of the window is 1
        self._corrected_ns = 0
        #: if the motion was computed again: the window before that, unless all its advances were published
        self._before: Rows | None = None
        #: shifts by an estimate, in the order of `CLEARANCE_NAMES` [m]; None if all are zero
        self._shift: Array | None = None

    def set_shift(self, shift: Sequence[float]) -> None:
        """Add the shifts of an estimate to the published clearances and their quantiles.

        `shift` contains six numbers [m]: for the horizontal clearance and its 5 % and 95 % quantiles, then for the
        vertical clearance. The shift is not part of `state`, so the insertion of late samples does not change it.
        """
        values = np.zeros(len(CLEARANCE_NAMES))
        values[_KNOWN] = shift
        self._shift = values if values.any() else None

    def add(self, rows: Rows, stamps: Integers, taken: Integers, *, held: bool = False) -> Published:
        """Add advances to the window, and return the publications after some of them.

        `rows`, shape (n,), are the advances, and `stamps`, shape (n,), their stamps [ns]. A publication follows each
        advance with an index in `taken`, shape (m,), whose indices must rise, and overwrites the row of the advance. If
        all its advances have failed, the stamp of a publication is 0. `held` states whether the advances were computed
        without samples.
        """
        self._waits = self._publish(rows, np.ascontiguousarray(stamps), int(held), taken, self._window, self._waits)
        if not len(taken):
            return NOTHING
        chosen = rows if len(taken) == len(rows) else rows[taken]
        return Published(chosen, self._slow(chosen))

    def pop(self) -> Published:
        """Publish all advances since the previous publication; `NOTHING` without such advances."""
        if not self._waits:
            return NOTHING
        rows, self._waits = self._stock.new(1), 0
        publish_window(self._window, rows)
        return Published(rows, self._slow(rows))

    def correct(self, stamp_ns: int, oldest_ns: int) -> int:
        """Register that the motion from `stamp_ns` on will be computed again, and mark the window as corrected.

        Return the earliest `stamp_ns` of all calls since the previous publication. A call is ignored if its stamp does
        not exceed `oldest_ns`, the age limit of late samples.
        """
        window = self._window[0]
        if not window["corrected"] or self._corrected_ns <= oldest_ns:
            window["corrected"], self._corrected_ns = 1, stamp_ns
            self._before = self._window.copy() if self._waits else None
        self._corrected_ns = min(stamp_ns, self._corrected_ns)
        if self._before is not None and self._before["stamp_ns"][0] >= self._corrected_ns:
            self._before = None
        return self._corrected_ns

    def begin_correction(self) -> None:
        """Restart impulses and peaks at the stamp that `correct` returned.

        If all later advances fail, the newest unpublished advance before the stamp is published.
        """
        self._clear()
        if self._before is not None:
            for name in _MOTION:
                self._window[name] = self._before[name]
            self._waits = 1

    @property
    def waits(self) -> bool:
        """Whether an advance is waiting to be published."""
        return bool(self._waits)

    @property
    def is_clear(self) -> bool:
        """Whether neither an advance nor a mark is waiting to be published."""
        window = self._window
        return not (self._waits or window["corrected"][0] or window["marked"][0])

    @property
    def makes(self) -> Integers:
        """Number of touches of each pair so far, shape (8,)."""
        makes: Integers = self._window["makes"][0].copy()
        return makes

    def copy(self) -> Outputs:
        """Return outputs with the same state."""
        other = copy(self)
        other._window, other._stock = self._window.copy(), Stock()
        return other

    def replace_motion(self, other: Outputs) -> None:
        """Replace the unpublished advances by those of a copy, in which late samples have been inserted."""
        self._window, self._waits = other._window, other._waits
        self._corrected_ns, self._before = other._corrected_ns, other._before

    def restart(self) -> None:
        """Drop all unpublished data; the numbers of touches do not change."""
        self._clear()
        self._window["corrected"] = 0
        self.slow_before, self._before = (None, self.slow_before[1]), None

    def _clear(self) -> None:
        for name in ("impulse", "peak", "measured_peak", "samples"):
            self._window[name] = 0
        self._waits = 0

    def _slow(self, rows: Rows) -> Rows:
        stamps, (before_ns, before_depth) = rows["stamp_ns"], self.slow_before
        if before_ns is not None:
            before = before_ns // SLOW_PERIOD_NS
            if before == stamps.item(0) // SLOW_PERIOD_NS == stamps.item(-1) // SLOW_PERIOD_NS:
                return _NO_SLOW  # fast path for most publications
        good = np.flatnonzero(stamps)
        spans = stamps[good] // SLOW_PERIOD_NS
        changed = np.ones(len(good), bool)
        changed[1:] = spans[1:] != spans[:-1]
        if before_ns is not None and len(good):
            changed[0] = spans[0] != before_ns // SLOW_PERIOD_NS
        index = good[changed]
        if not index.size:
            return _NO_SLOW
        stamps, wear_depth = stamps[index], rows["wear_depth"][index]
        elapsed_s, growth = np.ones(len(stamps)), np.zeros(wear_depth.shape)
        elapsed_s[1:], growth[1:] = np.diff(stamps) * 1e-9, np.diff(wear_depth, axis=0)
        if before_ns is not None and stamps[0] > before_ns:
            elapsed_s[0], growth[0] = (stamps[0] - before_ns) * 1e-9, wear_depth[0] - before_depth
        self.slow_before = int(stamps[-1]), wear_depth[-1].copy()
        slow = np.zeros(len(index), SLOW)
        slow["stamp_ns"], slow["row"] = stamps, index
        slow["clearance"], slow["wear_rate"] = self._clearance(wear_depth), growth / elapsed_s[:, None]
        if self._shift is not None:
            slow["clearance"] += self._shift
        followed = np.flatnonzero(rows["followed"][index])
        if followed.size:
            slow["clearance"][followed[:, None], _KNOWN] = rows["known_clearance"][index[followed]]
        return slow

    def _clearance(self, wear_depth: Array) -> Array:
        best, points = clearances(self.scene, wear_depth), prior_points(self.scene, wear_depth)
        low, high = (best if depth is wear_depth else clearances(self.scene, depth) for depth in points)
        count = len(_CLEARANCES)
        clearance = np.empty((*wear_depth.shape[:-1], 3 * count))
        clearance[..., :count], clearance[..., count::2], clearance[..., count + 1 :: 2] = best, low, high
        return clearance

    def modelled(self, wear_depth: Array) -> Array:
        """Return the clearances of the model without a shift, shape (6,) [m], in the order of `set_shift`."""
        known: Array = self._clearance(wear_depth)[_KNOWN]
        return known

    def state(self) -> bytes:
        """Return the exact state as bytes; state and later advances determine all later publications."""
        (slow_ns, depth), window = self.slow_before, self._window
        stamp = np.array([-1 if slow_ns is None else slow_ns])
        numbers = (window["makes"], window["impulse"], window["peak"], depth, stamp)
        return b"".join(part.tobytes() for part in numbers)

    def set_state(self, data: bytes) -> None:
        """Continue from a state that the method `state` has returned."""
        parts = np.frombuffer(data, np.float64, _STATE_SIZE).reshape(4, PAIR_COUNT)
        self._clear()
        self._window["makes"] = parts[0].view(np.int64)
        self._window["impulse"], self._window["peak"] = parts[1:3]
        # the state does not contain `measured_peak`, the peak over advances with samples, so the peak over all advances
        # is used
        self._window["measured_peak"] = parts[2]
        slow_ns = int(np.frombuffer(data, np.int64, 1, offset=8 * _STATE_SIZE)[0])
        self.slow_before = None if slow_ns < 0 else slow_ns, parts[3].copy()


def warm_up() -> None:
    """Compile the functions that make publications, or load them from the cache on disk."""
    _publish()
    rows = np.zeros(1, ROW)
    publish_window(rows.copy(), rows)
    summary(rows, 0)


@cache
def _publish() -> Callable[..., int]:
    """Return `publish` compiled for its argument types, because the check of the types takes longer than the call."""
    rows = np.zeros(1, ROW)
    return for_arguments(publish, (rows, ONLY_ROW, 0, ONLY_ROW, rows, 0))
