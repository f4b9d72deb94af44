"""Time windows of a run, with the load and the quantities of each pair. A window is about one load period long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.estimate.measurements import Load
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.entries import concatenated
from plow_twin.record.recording import Batched, Recording
from plow_twin.record.run_time import RunTime
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES
from plow_twin.stream.silences import Silences

Array = NDArray[np.float64]
Indexes = NDArray[np.int64]

#: Quantities of each pair in a window, with their units.
QUANTITIES: Final[Mapping[str, str]] = {
    "peak": "N",
    "impacts": "1/min",
    "in_contact": "share of samples",
    "impulse": "N",
    "dissipation": "W",
    "wear": "m/h",
}
#: Length [s] of the part at the start of a run in which the period of the load is searched.
_PERIOD_SPAN_S: Final = 60.0
_NO_PERIOD_S: Final = 10.0
#: Smallest ratio of the messages in a window to those of a full window, and of two sample rates that count as equal.
FULL: Final = 0.9
_PADS: Final = np.array([CLEARANCE_NAMES.index(name) for name in PAD_NAMES])
#: Names of the arrays of `Windows` with one row for each window.
_ROWS: Final = ("start_ns", "load", "clearance", "length_ns", "rate_hz")
_TOTALS: Final = np.array([CLEARANCE_NAMES.index(name) for name in ("horizontal", "vertical")])


@dataclass
class Windows:
    """The n windows of a run."""

    start_ns: Indexes
    #: Values of each of the `QUANTITIES`, shape (n, 8).
    pairs: dict[str, Array]
    #: Root mean squares of the force [N] and of the moment [N m] of the load, shape (n, 2).
    load: Array
    clearance: Array  # horizontal and vertical [m], shape (n, 2)
    length_ns: Indexes
    #: Sample rate of the load [Hz], shape (n,).
    rate_hz: Array
    #: Number of windows that were left out because samples are missing.
    silent: int = 0

    def chosen(self, which: NDArray[np.bool_]) -> Windows:
        """Return the windows selected by a mask, shape (n,), without a copy if all windows are selected."""
        if which.all():
            return self
        pairs = {name: values[which] for name, values in self.pairs.items()}
        return replace(self, pairs=pairs, silent=0, **{name: getattr(self, name)[which] for name in _ROWS})

    @classmethod
    def joined(cls, parts: Sequence[Windows]) -> Windows:
        """Concatenate the windows of several runs. The windows of a single run are not copied."""
        if len(parts) == 1:
            return parts[0]
        pairs = {name: np.concatenate([part.pairs[name] for part in parts]) for name in QUANTITIES}
        return cls(pairs=pairs, **dict(zip(_ROWS, concatenated(parts, *_ROWS), strict=True)))


@dataclass
class _Sums:
    """Sums over the messages of each window. The key of `rows` is the number of the window."""

    width: int
    rows: dict[int, Array] = field(default_factory=dict)

    def add(self, window: Indexes, values: Array, reduce: Any = np.add) -> None:
        """Add values, shape (n, width), to the windows numbered `window`, shape (n,), in non-decreasing order."""
        if not len(window):
            return
        first = np.flatnonzero(np.r_[True, np.diff(window) != 0])
        for number, value in zip(window[first].tolist(), reduce.reduceat(values, first, axis=0), strict=True):
            self.rows[number] = reduce(self.rows[number], value) if number in self.rows else value

    def of(self, numbers: list[int]) -> Array:
        """Return the sums of the windows `numbers`, shape (len(numbers), width), or 0 for a window without values."""
        return np.array([self.rows.get(number, np.zeros(self.width)) for number in numbers]).reshape(-1, self.width)


def windows_of(recording: Recording, window_s: float | None = None) -> Windows:
    """Return the windows of a run of plow_twin.

    The outputs of the run must have been recorded. A window is `window_s` long. The default length is the period of the
    load, or 10 s if the load has no period. Raise `RecordingError` if the recording is not a run of plow_twin, has no
    outputs, or has missing samples in every window.
    """
    sums = _RunSums(round(1e9 * (window_s or _load_period(recording))), RunTime(recording.header.parameters).silences)
    for found in recording.batches("excitation", "contact_forces", "contact_peaks", "clearance"):
        for name, part in found.items():
            if len(part.stamp_ns):
                sums.add(name, part)
    for name, part_of in (("contact_peaks", sums.messages), ("clearance", sums.clearance)):
        if not part_of.rows:
            raise RecordingError(
                f"{recording.path}: got no {name}, expected a run with outputs: plow-twin replay --write"
            )
    silent = sums.silent()
    full = FULL * float(np.median([row[0] for row in sums.messages.rows.values()]))
    numbers = sorted(number for number, row in sums.messages.rows.items() if row[0] >= full and number not in silent)
    if not numbers:
        raise RecordingError(
            f"{recording.path}: got a silence in each window, expected at least one complete window; "
            "a silence is an interval between samples that is longer than excitation_timeout"
        )
    return sums.windows(numbers, len(silent))


class _RunSums:
    """Sums for each window of a run."""

    def __init__(self, window_ns: int, silences: Silences) -> None:
        self._window_ns, self._silences = window_ns, silences
        self._silent_ns: list[tuple[int, int]] = []
        self.messages, self.clearance, self._clearance_count = _Sums(1), _Sums(2), _Sums(1)
        self._load, self._peak, self._moved = _Sums(3), _Sums(PAIR_COUNT), _Sums(2 * PAIR_COUNT)
        self._contact = _Sums(2 * PAIR_COUNT + 1)
        #: Growth of the wear depths. New pads reduce the depth, not the growth.
        self._grown = _Sums(PAIR_COUNT)
        #: Wear depths of the pads in the newest message.
        self._depth: Array | None = None
        #: Cumulative number of impacts of each pair in the newest message.
        self._impacts: Array | None = None
        #: Stamp and values of the newest message of contact forces.
        self._newest: tuple[Indexes, Array] | None = None

    def add(self, name: str, part: Batched) -> None:
        window = part.stamp_ns // self._window_ns
        if (np.diff(window) < 0).any():
            part, window = _risen(part, window)
        if name == "excitation":
            self._silent_ns += [(begin, end) for _, begin, end in self._silences.add(part.stamp_ns)]
            force2, moment2 = (part.values[:, :2] ** 2).sum(axis=1), part.values[:, 2] ** 2
            self._load.add(window, np.column_stack((force2, moment2, np.ones(len(window)))))
        elif name == "contact_peaks":
            self._add_peaks(part, window)
        elif name == "contact_forces":
            self._add_forces(part, window)
        else:
            self.clearance.add(window, part.values[:, _TOTALS])
            self._clearance_count.add(window, np.ones((len(window), 1)))
            depth = part.values[:, _PADS]
            before = depth[:1] if self._depth is None else self._depth
            self._grown.add(window, np.maximum(np.diff(depth, axis=0, prepend=before), 0.0))
            self._depth = depth[-1:]

    def _add_peaks(self, part: Batched, window: Indexes) -> None:
        total, impulse, largest = np.split(part.values, 3, axis=1)
        before = total[:1] if self._impacts is None else self._impacts[None]
        made = np.clip(np.diff(np.concatenate((before, total)), axis=0), 0.0, None)
        self._impacts = total[-1]
        self._moved.add(window, np.hstack((made, impulse)))
        self._peak.add(window, largest, np.maximum)
        self.messages.add(window, np.ones((len(window), 1)))

    def _add_forces(self, part: Batched, window: Indexes) -> None:
        stamps, power, in_contact = _powers(part, self._newest)
        self._newest = part.stamp_ns[-1:], part.values[-1:]
        step_s = np.diff(stamps) * 1e-9
        near = (step_s < 0.1 * self._window_ns * 1e-9)[:, None]
        work = np.where(near, 0.5 * (power[1:] + power[:-1]) * step_s[:, None], 0.0)
        count = len(work)
        ends = window[len(window) - count :]
        self._contact.add(ends, np.hstack((work, in_contact[len(in_contact) - count :], np.ones((count, 1)))))

    def silent(self) -> set[int]:
        """Return the windows that overlap a time without samples, with the window of the first message after it."""
        windows, silent = np.array(sorted(self.messages.rows)), set[int]()
        for begin, end in self._silent_ns:
            first = np.searchsorted(windows, begin // self._window_ns)
            last = np.searchsorted(windows, end // self._window_ns, side="right")
            silent.update(windows[first:last].tolist())
        return silent

    def windows(self, numbers: list[int], silent: int) -> Windows:
        """Return the windows `numbers`; `silent` is the number of windows that were left out."""
        seconds = self._window_ns * 1e-9
        sums, touched, squares = self._moved.of(numbers), self._contact.of(numbers), self._load.of(numbers)
        return Windows(
            np.array(numbers, np.int64) * self._window_ns,
            {
                "peak": self._peak.of(numbers),
                "impacts": sums[:, :PAIR_COUNT] * 60.0 / seconds,
                "in_contact": touched[:, PAIR_COUNT : 2 * PAIR_COUNT] / np.maximum(touched[:, -1:], 1.0),
                "impulse": sums[:, PAIR_COUNT:] / seconds,
                "dissipation": touched[:, :PAIR_COUNT] / seconds,
                "wear": self._grown.of(numbers) * 3600.0 / seconds,
            },
            np.sqrt(squares[:, :2] / np.maximum(squares[:, 2:], 1.0)),
            _between(self.clearance, self._clearance_count, numbers),
            np.full(len(numbers), self._window_ns, np.int64),
            squares[:, 2] / seconds,
            silent,
        )


def _between(sums: _Sums, count: _Sums, numbers: list[int]) -> Array:
    """Return the means of windows, interpolated for a window without a message."""
    windows = sorted(sums.rows)
    means = sums.of(windows) / count.of(windows)
    return np.column_stack([np.interp(numbers, windows, column) for column in means.T])


def _risen(part: Batched, window: Indexes) -> tuple[Batched, Indexes]:
    """Sort rows by stamp. After late samples or clock steps, older stamps can follow newer stamps."""
    order = np.argsort(part.stamp_ns, kind="stable")
    return Batched(part.stamp_ns[order], part.values[order]), window[order]


def _powers(part: Batched, newest: tuple[Indexes, Array] | None) -> tuple[Indexes, Array, Array]:
    """Return stamps, the power into each contact [W], and whether it carries force, beginning with the row `newest`."""
    stamps, values = part.stamp_ns, part.values
    if newest is not None and newest[0][0] < stamps[0]:
        stamps, values = np.concatenate((newest[0], stamps)), np.concatenate((newest[1], values))
    _, rate, force = np.split(values, 3, axis=1)
    return stamps, force * rate, (force > 0.0).astype(float)


def _load_period(recording: Recording) -> float:
    stamps, wrench, span = list[Indexes](), list[Array](), 0.0
    for part in recording["excitation"].batches():
        stamps.append(part.stamp_ns)
        wrench.append(part.values)
        span = (int(stamps[-1][-1]) - int(stamps[0][0])) * 1e-9
        if span > _PERIOD_SPAN_S:
            break
    if not stamps or span <= 0.0:
        return _NO_PERIOD_S
    times = (np.concatenate(stamps) - stamps[0][0]) * 1e-9
    first = times <= _PERIOD_SPAN_S
    load, _ = Load.of(times[first], np.concatenate(wrench)[first])
    return load.oscillation() or _NO_PERIOD_S
