"""Comparison of runs. Windows are grouped by run, day or shift, and each group is compared with the first group."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, time, timedelta, tzinfo
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.recording import read_recording
from plow_twin.study.comparison.change import ROUNDING, Change, Drawn, changes, points, with_neighbours
from plow_twin.study.comparison.windows import FULL, QUANTITIES, Windows, windows_of

#: Smallest stamp [ns] that is treated as a date. Smaller stamps, before the year 2001, count from an
#: arbitrary start.
_DATES_NS: Final = 10**18
SHIFTS: Final = (time(6), time(14), time(22))

#: Function that returns the group of a window, given the name of its run and its stamp [ns].
Label = Callable[[str, int], str]


@dataclass
class Comparison:
    """Groups of windows in order of first appearance, and the changes from the first group to each later group."""

    groups: dict[str, Windows]
    #: Names of the runs with windows in each group.
    runs: dict[str, list[str]]
    #: Changes by group, pair and quantity, without the first group; None if a group has too few windows.
    changes: dict[str, dict[str, dict[str, Change | None]]] = field(default_factory=dict)
    #: Changes of the clearance by group and axis, without the first group.
    clearance_changes: dict[str, dict[str, Change | None]] = field(default_factory=dict)
    scenes: list[str] = field(default_factory=list)
    #: Reasons to doubt the comparison.
    notes: list[str] = field(default_factory=list)

    def appeared(self, group: str) -> dict[str, list[str]]:
        """Return for each pair the quantities that are 0 in the first group and positive in this group.

        Their relative change is not defined, so `changes` contains None.
        """
        first, later = next(iter(self.groups.values())), self.groups[group]
        new = {
            name: (first.pairs[name].mean(axis=0) == 0.0) & (later.pairs[name].mean(axis=0) > 0.0)
            for name in QUANTITIES
        }
        return {pair: [name for name in QUANTITIES if new[name][place]] for place, pair in enumerate(PAIR_NAMES)}

    def equal(self, group: str) -> bool:
        """Return whether the means of load, quantities and clearances of this group equal those of the first group."""
        first, later = (
            np.concatenate((windows.load.mean(axis=0), _cells(windows).mean(axis=0)))
            for windows in (next(iter(self.groups.values())), self.groups[group])
        )
        return bool(np.allclose(first, later, rtol=ROUNDING, atol=0.0))

    def facts(self) -> dict[str, Any]:
        """Return all results as plain values for JSON."""
        return {
            "groups": {
                name: {
                    "runs": self.runs[name],
                    "windows": len(windows.start_ns),
                    "load": {
                        "force_rms_n": points(windows.load[:, 0]),
                        "moment_rms_n_m": points(windows.load[:, 1]),
                    },
                    "clearance": {
                        "horizontal_m": points(windows.clearance[:, 0]),
                        "vertical_m": points(windows.clearance[:, 1]),
                    },
                    "pairs": {
                        pair: {quantity: points(values[:, place]) for quantity, values in windows.pairs.items()}
                        for place, pair in enumerate(PAIR_NAMES)
                    },
                }
                for name, windows in self.groups.items()
            },
            "units": dict(QUANTITIES),
            "scenes": self.scenes,
            "notes": self.notes,
            "changes": {
                name: {pair: _facts(by_quantity) for pair, by_quantity in by_pair.items()}
                for name, by_pair in self.changes.items()
            },
            "clearance_changes": {name: _facts(by_axis) for name, by_axis in self.clearance_changes.items()},
            "appeared": {name: self.appeared(name) for name in self.changes},
            "equal": [name for name in self.changes if self.equal(name)],
        }


def _facts(changes: Mapping[str, Change | None]) -> dict[str, Any]:
    return {
        name: None if change_found is None else {**vars(change_found), "verdict": change_found.verdict}
        for name, change_found in changes.items()
    }


def by_run(name: str, stamp_ns: int) -> str:
    """Return the name of the run as the group of a window."""
    return name


def by_time(kind: str, shifts: Sequence[time] = SHIFTS, zone: tzinfo = UTC) -> Label:
    """Return a function that groups windows by day or by shift (`kind`) in a time zone.

    `shifts` are the times at which shifts begin. The function raises a `RecordingError` if a stamp is not a date.
    """
    begins = sorted(shifts)

    def label(name: str, stamp_ns: int) -> str:
        if stamp_ns < _DATES_NS:
            raise RecordingError(f"{name}: got stamps that count from a start, expected dates: compare --by run")
        at = datetime.fromtimestamp(stamp_ns // 10**9, zone)
        if kind == "day":
            return at.strftime("%Y-%m-%d")
        before = [begin for begin in begins if begin <= at.time()]
        if not before:  # before the first shift of a day, the last shift of the previous day continues
            return f"{(at - timedelta(days=1)).strftime('%Y-%m-%d')} {begins[-1].strftime('%H:%M')}"
        return f"{at.strftime('%Y-%m-%d')} {before[-1].strftime('%H:%M')}"

    return label


def compare(
    runs: Iterable[tuple[str, Windows]],
    label: Label = by_run,
    seed: int = 0,
    scenes: Mapping[str, tuple[str, str]] = MappingProxyType({}),
) -> Comparison:
    """Compare the first group of windows with each later group.

    `runs` are the names and windows of the runs in order of time. `scenes` contains the name and the contents of the
    scene of each run. `seed` is the seed of the bootstrap draws. Raise `RecordingError` if there are fewer than two
    groups.
    """
    parts: dict[str, list[Windows]] = {}
    names: dict[str, list[str]] = {}
    notes: list[str] = []
    runs = list(runs)
    for name, windows in runs:
        if windows.silent:
            notes.append(f"{name}: {windows.silent} windows with a stretch without samples were left out")
        labels = np.array([label(name, stamp) for stamp in windows.start_ns.tolist()])
        for group in dict.fromkeys(labels.tolist()):
            chosen = windows.chosen(labels == group)
            for other, other_value in zip(names.get(group, ()), parts.get(group, ()), strict=True):
                twice = _overlapping(chosen, other_value)
                if twice.any():
                    notes.append(
                        f"{name}: {twice.sum()} of {len(twice)} windows in {group} left out: {other} covers their time"
                    )
                    chosen = chosen.chosen(~twice)
            parts.setdefault(group, []).append(chosen)
            names.setdefault(group, []).append(name)
    if len(parts) < 2:
        got = f"1 group of windows ({next(iter(parts))})" if parts else "0 groups of windows"
        raise RecordingError(f"got {got}, expected two or more")
    comparison = Comparison({group: Windows.joined(chosen) for group, chosen in parts.items()}, names)
    comparison.scenes = sorted({name for name, _ in scenes.values() if name})
    comparison.notes = notes + _rates_apart(runs) + _scenes_apart(scenes)
    (reference, first), *others = comparison.groups.items()
    loads = {
        group: with_neighbours(windows.load[:, 0], windows.start_ns) for group, windows in comparison.groups.items()
    }
    random = np.random.default_rng(seed)
    before = Drawn(_cells(first), loads[reference], random)
    for group, windows in others:
        cells = iter(changes(before, Drawn(_cells(windows), loads[group], random)))
        comparison.changes[group] = {pair: {quantity: next(cells) for quantity in QUANTITIES} for pair in PAIR_NAMES}
        comparison.clearance_changes[group] = {axis: next(cells) for axis in ("horizontal", "vertical")}
    return comparison


def _cells(windows: Windows) -> np.ndarray[Any, Any]:
    """Return the quantities of all pairs and the clearances as columns, shape (n, cells)."""
    by_pair = np.stack([windows.pairs[name] for name in QUANTITIES], axis=2)
    return np.hstack((by_pair.reshape(len(by_pair), -1), windows.clearance))


def _overlapping(windows: Windows, others: Windows) -> np.ndarray[Any, Any]:
    if not len(others.start_ns):
        return np.zeros(len(windows.start_ns), bool)
    order = np.argsort(others.start_ns)
    (begins, ends), (starts, stops) = (
        # start and end of the part of a window that certainly contains messages
        ((part.start_ns + (1.0 - FULL) * part.length_ns), (part.start_ns + FULL * part.length_ns))
        for part in (windows, others)
    )
    starts, stops = starts[order], stops[order]
    before = np.searchsorted(starts, ends) - 1  # index of the last window that begins before each end
    return np.asarray((before >= 0) & (stops[before] > begins))


def _rates_apart(runs: Sequence[tuple[str, Windows]]) -> list[str]:
    rates = {name: float(windows.rate_hz.mean()) for name, windows in runs if len(windows.rate_hz)}
    if not rates or min(rates.values()) >= FULL * max(rates.values()):
        return []
    text = ", ".join(f"{name} {rate:.4g} Hz" for name, rate in rates.items())
    return [f"the sample rates differ, and peaks, impacts and contact depend on them: {text}"]


def _scenes_apart(scenes: Mapping[str, tuple[str, str]]) -> list[str]:
    if len({contents for _, contents in scenes.values()}) < 2:
        return []
    text = ", ".join(f"{run} {name or 'without a name'}" for run, (name, _) in scenes.items())
    return [f"the runs have different scenes, so a change of the machine may be a change of its description: {text}"]


@dataclass(frozen=True)
class WindowsTask:
    """Computation of the windows of one run, as a `RunTask`."""

    path: Path
    window_s: float | None = None

    def stored(self) -> dict[str, Any] | None:
        """Return None, because windows are not stored."""
        return None

    def run(self) -> dict[str, Any]:
        """Return the windows (`windows`), losses (`lost`), and name and contents of the scene (`scene`) of the run."""
        recording = read_recording(self.path)
        windows = windows_of(recording, self.window_s)
        scene = Path(str(recording.header.parameters.get("scene", ""))).name
        contents = recording.header.scene_yaml
        return {"run": str(self.path), "windows": windows, "lost": recording.losses(), "scene": (scene, contents)}
