"""Time windows of a run, each about one load period long, with the load and quantities of each pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import RecordingError
from plow_twin.estimate.measurements import Load
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.recording import Batched, Recording
from plow_twin.record.run_time import RunTime
from plow_twin.stream.outputs import CLEARANCE_NAMES, PAD_NAMES

Array = NDArray[np.float64]
Indexes = NDArray[np.int64]

#: The quantities that each window has for each pair, with their units.
QUANTITIES: Final[Mapping[str, str]] = {
    "peak": "N",
    "impacts": "1/min",
    "in_contact": "share of samples",
    "impulse": "N",
    "dissipation": "W",
    "wear": "m/h",
}
#: Duration [s], from the start of the load, that is searched for a period.
_PERIOD_SPAN_S: Final = 60.0
#: Length of a window if the load has no period [s].
_NO_PERIOD_S: Final = 10.0
#: Smallest number of messages in a window, as a share of the number in a full window. A window with fewer messages,
#: because the run ends or has a gap, is left out. No note is made if the lowest sample rate of the runs is at least
#: this share of the highest.
FULL: Final = 0.9
_PADS: Final = np.array([CLEARANCE_NAMES.index(name) for name in PAD_NAMES])
_TOTALS: Final = np.array([CLEARANCE_NAMES.index(name) for name in ("horizontal", "vertical")])


@dataclass
class Windows:
    """The n windows of a run.

    Attributes
    ----------
    start_ns : ndarray, shape (n,)
        First stamp of each window [ns].
    pairs : dict of str to ndarray, shape (n, 8)
        `QUANTITIES`: largest force, impacts per minute, share of samples in contact, impulse and dissipated energy per
        second, wear per hour.
    load : ndarray, shape (n, 2)
        Root mean square of the force [N] and of the moment [N m] of the load.
    clearance : ndarray, shape (n, 2)
        Horizontal and vertical clearance [m].
    length_ns : ndarray, shape (n,)
        Length of each window [ns].
    rate_hz : ndarray, shape (n,)
        Sample rate of the load [Hz].
    silent : int
        Number of windows left out because of a stretch without samples.
    """

    start_ns: Indexes
    pairs: dict[str, Array]
    load: Array
    clearance: Array
    length_ns: Indexes
    rate_hz: Array
    silent: int = 0

    def chosen(self, which: NDArray[np.bool_]) -> Windows:
        """Return the windows selected by a mask, shape (n,), without a copy if it selects all."""
        if which.all():
            return self
        return Windows(
            self.start_ns[which],
            {name: values[which] for name, values in self.pairs.items()},
            self.load[which],
            self.clearance[which],
            self.length_ns[which],
            self.rate_hz[which],
        )

    @classmethod
    def joined(cls, parts: Sequence[Windows]) -> Windows:
        """Return the joined windows of several runs; a single run is not copied."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.start_ns for part in parts]),
            {name: np.concatenate([part.pairs[name] for part in parts]) for name in QUANTITIES},
            np.concatenate([part.load for part in parts]),
            np.concatenate([part.clearance for part in parts]),
            np.concatenate([part.length_ns for part in parts]),
            np.concatenate([part.rate_hz for part in parts]),
        )


@dataclass
class _Sums:
    """Sums over the messages of each window, by window number."""

    width: int
    rows: dict[int, Array] = field(default_factory=dict)

    def add(self, window: Indexes, values: Array, reduce: Any = np.add) -> None:
        """Add values, shape (n, width), to the windows numbered `window`, shape (n,), which never decreases."""
        if not len(window):
            return
        first = np.flatnonzero(np.r_[True, np.diff(window) != 0])
        for number, value in zip(window[first].tolist(), reduce.reduceat(values, first, axis=0), strict=True):
            self.rows[number] = reduce(self.rows[number], value) if number in self.rows else value

    def of(self, numbers: list[int]) -> Array:
        """Return the sums of the windows `numbers`, zero for a window without values."""
        return np.array([self.rows.get(number, np.zeros(self.width)) for number in numbers]).reshape(-1, self.width)


def windows_of(recording: Recording, window_s: float | None = None) -> Windows:
    """Return the windows of a run of plow_twin whose outputs were recorded.

    Parameters
    ----------
    recording
        The run.
    window_s
        Length of a window [s]; by default the period of the load, or 10 s if it has no period.

    Raises
    ------
    RecordingError
        The recording is not a run of plow_twin or has no outputs, or each window has a stretch without samples.
    """
    window_ns = round(1e9 * (window_s or _load_period(recording)))
    peak, moved, contact, load = _Sums(PAIR_COUNT), _Sums(2 * PAIR_COUNT), _Sums(2 * PAIR_COUNT + 1), _Sums(3)
    slow, slow_count = _Sums(2), _Sums(1)
    messages, silences, silent_ns = _Sums(1), RunTime(recording.header.parameters).silences, list[tuple[int, int]]()
    touches: Array | None = None
    newest: tuple[Indexes, Array] | None = None
    pads: dict[int, tuple[Array, Array]] = {}
    for found in recording.batches("excitation", "contact_forces", "contact_peaks", "clearance"):
        for part, name in ((part, name) for name, part in found.items() if len(part.stamp_ns)):
            window = part.stamp_ns // window_ns
            if (np.diff(window) < 0).any():
                part, window = _risen(part, window)
            if name == "excitation":
                silent_ns += [(begin, end) for _, begin, end in silences.add(part.stamp_ns)]
                force2, moment2 = (part.values[:, :2] ** 2).sum(axis=1), part.values[:, 2] ** 2
                load.add(window, np.column_stack((force2, moment2, np.ones(len(window)))))
            elif name == "contact_peaks":
                total, impulse, largest = np.split(part.values, 3, axis=1)
                before = total[:1] if touches is None else touches[None]
                made = np.clip(np.diff(np.concatenate((before, total)), axis=0), 0.0, None)
                touches = total[-1]
                moved.add(window, np.hstack((made, impulse)))
                peak.add(window, largest, np.maximum)
                messages.add(window, np.ones((len(window), 1)))
            elif name == "contact_forces":
                stamps, power, in_contact = _powers(part, newest)
                newest = part.stamp_ns[-1:], part.values[-1:]
                step_s = np.diff(stamps) * 1e-9
                near = (step_s < 0.1 * window_ns * 1e-9)[:, None]
                work = np.where(near, 0.5 * (power[1:] + power[:-1]) * step_s[:, None], 0.0)
                count = len(work)
                ends = window[len(window) - count :]
                contact.add(ends, np.hstack((work, in_contact[len(in_contact) - count :], np.ones((count, 1)))))
            else:
                slow.add(window, part.values[:, _TOTALS])
                slow_count.add(window, np.ones((len(window), 1)))
                for number in np.unique(window).tolist():
                    rows = part.values[window == number][:, _PADS]
                    pads[number] = (pads[number][0] if number in pads else rows[0], rows[-1])
    for name, found_of in (("contact_peaks", messages), ("clearance", slow)):
        if not found_of.rows:
            raise RecordingError(
                f"{recording.path}: got no {name}, expected a run with outputs: plow-twin replay --write"
            )
    full = FULL * float(np.median([row[0] for row in messages.rows.values()]))
    # messages at the end of a silence describe the whole silence, so all windows that the silence touches are left out
    known, silent = np.array(sorted(messages.rows)), set[int]()
    for begin, end in silent_ns:
        first, last = np.searchsorted(known, begin // window_ns), np.searchsorted(known, end // window_ns, side="right")
        silent.update(known[first:last].tolist())
    numbers = sorted(number for number, row in messages.rows.items() if row[0] >= full and number not in silent)
    if not numbers:
        raise RecordingError(
            f"{recording.path}: each window has a stretch without samples, expected some complete windows; "
            "samples further apart than excitation_timeout are such a stretch"
        )
    seconds = window_ns * 1e-9
    sums, touched = moved.of(numbers), contact.of(numbers)
    squares = load.of(numbers)
    grown = np.array([pads[number][1] - pads[number][0] if number in pads else np.zeros(8) for number in numbers])
    return Windows(
        np.array(numbers, np.int64) * window_ns,
        {
            "peak": peak.of(numbers),
            "impacts": sums[:, :PAIR_COUNT] * 60.0 / seconds,
            "in_contact": touched[:, PAIR_COUNT : 2 * PAIR_COUNT] / np.maximum(touched[:, -1:], 1.0),
            "impulse": sums[:, PAIR_COUNT:] / seconds,
            "dissipation": touched[:, :PAIR_COUNT] / seconds,
            "wear": grown.reshape(-1, PAIR_COUNT) * 3600.0 / seconds,
        },
        np.sqrt(squares[:, :2] / np.maximum(squares[:, 2:], 1.0)),
        _between(slow, slow_count, numbers),
        np.full(len(numbers), window_ns, np.int64),
        squares[:, 2] / seconds,
        len(silent),
    )


def _between(sums: _Sums, count: _Sums, numbers: list[int]) -> Array:
    """Return the means of windows; a window without a message gets interpolated means."""
    known = sorted(sums.rows)
    means = sums.of(known) / count.of(known)
    return np.column_stack([np.interp(numbers, known, column) for column in means.T])


def _risen(part: Batched, window: Indexes) -> tuple[Batched, Indexes]:
    """Return the rows sorted by stamp; with late samples or clock steps, older stamps can come later."""
    order = np.argsort(part.stamp_ns, kind="stable")
    return Batched(part.stamp_ns[order], part.values[order]), window[order]


def _powers(part: Batched, newest: tuple[Indexes, Array] | None) -> tuple[Indexes, Array, Array]:
    """Return stamps, power into each contact [W] and whether it has force; the row `newest` comes first."""
    stamps, values = part.stamp_ns, part.values
    if newest is not None and newest[0][0] < stamps[0]:
        stamps, values = np.concatenate((newest[0], stamps)), np.concatenate((newest[1], values))
    _, rate, force = np.split(values, 3, axis=1)
    return stamps, force * rate, (force > 0.0).astype(float)


def _load_period(recording: Recording) -> float:
    """Return the period of the load in the first minute [s]."""
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
