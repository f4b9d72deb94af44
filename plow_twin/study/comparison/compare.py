"""Runs in groups, by run, day or shift, and each group beside the first: `compare`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, time, timedelta, tzinfo
from pathlib import Path
from typing import Any, Final

import numpy as np

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.recording import read_recording
from plow_twin.study.comparison.change import Change, change, points, with_neighbours
from plow_twin.study.comparison.windows import QUANTITIES, Windows, windows_of

#: Stamps before this [ns] are no dates: 1e18 ns is in the year 2001.
_DATES_NS: Final = 10**18
#: Default begins of the shifts.
SHIFTS: Final = (time(6), time(14), time(22))

#: Returns the label of the group that a window belongs to, by the run's name and the window's stamp.
Label = Callable[[str, int], str]


@dataclass
class Comparison:
    """Groups of windows in order of their labels' first appearance, and the changes from the first to each other.

    Attributes
    ----------
    groups : dict of str to Windows
        All windows of a group.
    runs : dict of str to list of str
        Runs that have windows in a group.
    changes : dict
        By group (but the first), pair and quantity: `Change`, or None where there are too few windows.
    clearance_changes : dict
        By group (but the first), horizontal and vertical: the same.
    scenes : list of str
        Names of the scenes of all runs.
    """

    groups: dict[str, Windows]
    runs: dict[str, list[str]]
    changes: dict[str, dict[str, dict[str, Change | None]]] = field(default_factory=dict)
    clearance_changes: dict[str, dict[str, Change | None]] = field(default_factory=dict)
    scenes: list[str] = field(default_factory=list)

    def facts(self) -> dict[str, Any]:
        """Return plain values for JSON."""
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
            "changes": {
                name: {pair: _facts(by_quantity) for pair, by_quantity in by_pair.items()}
                for name, by_pair in self.changes.items()
            },
            "clearance_changes": {name: _facts(by_axis) for name, by_axis in self.clearance_changes.items()},
        }


def _facts(changes: Mapping[str, Change | None]) -> dict[str, Any]:
    """Return changes as plain values."""
    return {
        name: None if found is None else {**vars(found), "verdict": found.verdict} for name, found in changes.items()
    }


def by_run(name: str, stamp_ns: int) -> str:
    """Group by run."""
    return name


def by_time(kind: str, shifts: Sequence[time] = SHIFTS, zone: tzinfo = UTC) -> Label:
    """Return the labels of days, or of shifts that begin at the times `shifts`, in a time zone.

    Parameters
    ----------
    kind
        `day` or `shift`.
    shifts
        Begins of the shifts.
    zone
        The zone of days and shifts.

    Raises
    ------
    RecordingError
        By the labels: the stamps are no dates.
    """
    begins = sorted(shifts)

    def label(name: str, stamp_ns: int) -> str:
        if stamp_ns < _DATES_NS:
            raise RecordingError(f"{name}: got stamps that count from a start, expected dates: compare --by run")
        at = datetime.fromtimestamp(stamp_ns // 10**9, zone)
        if kind == "day":
            return at.strftime("%Y-%m-%d")
        before = [begin for begin in begins if begin <= at.time()]
        if not before:  # the last shift of the day before
            return f"{(at - timedelta(days=1)).strftime('%Y-%m-%d')} {begins[-1].strftime('%H:%M')}"
        return f"{at.strftime('%Y-%m-%d')} {before[-1].strftime('%H:%M')}"

    return label


def compare(
    runs: Iterable[tuple[str, Windows]], label: Label = by_run, seed: int = 0, scenes: Iterable[str] = ()
) -> Comparison:
    """Return the groups of some runs, and the changes from the first group to each other.

    Parameters
    ----------
    runs
        Name and windows of each run, in order of time.
    label
        Names the group of a window.
    seed
        Of the draws of the bootstrap.
    scenes
        Names of the runs' scenes.

    Raises
    ------
    RecordingError
        There are fewer than two groups.
    """
    parts: dict[str, list[tuple[Windows, np.ndarray[Any, Any]]]] = {}
    names: dict[str, list[str]] = {}
    for name, windows in runs:
        labels = np.array([label(name, stamp) for stamp in windows.start_ns.tolist()])
        for group in dict.fromkeys(labels.tolist()):
            parts.setdefault(group, []).append((windows, labels == group))
            names.setdefault(group, []).append(name)
    if len(parts) < 2:
        raise RecordingError(f"got {len(parts)} group of windows ({', '.join(parts)}), expected two or more")
    found = Comparison({group: _joined(chosen) for group, chosen in parts.items()}, names)
    found.scenes = sorted(set(scenes))
    (reference, first), *others = found.groups.items()
    loads = {group: with_neighbours(windows.load[:, 0], windows.start_ns) for group, windows in found.groups.items()}
    random = np.random.default_rng(seed)
    for group, windows in others:
        found.changes[group] = {
            pair: {
                quantity: change(
                    (first.pairs[quantity][:, place], loads[reference]),
                    (windows.pairs[quantity][:, place], loads[group]),
                    random,
                )
                for quantity in QUANTITIES
            }
            for place, pair in enumerate(PAIR_NAMES)
        }
        found.clearance_changes[group] = {
            axis: change(
                (first.clearance[:, place], loads[reference]),
                (windows.clearance[:, place], loads[group]),
                random,
            )
            for place, axis in enumerate(("horizontal", "vertical"))
        }
    return found


def _joined(parts: Sequence[tuple[Windows, np.ndarray[Any, Any]]]) -> Windows:
    return Windows(
        np.concatenate([windows.start_ns[chosen] for windows, chosen in parts]),
        {name: np.concatenate([windows.pairs[name][chosen] for windows, chosen in parts]) for name in QUANTITIES},
        np.concatenate([windows.load[chosen] for windows, chosen in parts]),
        np.concatenate([windows.clearance[chosen] for windows, chosen in parts]),
    )


@dataclass(frozen=True)
class WindowsTask:
    """The windows of one run, for a process of its own."""

    path: Path
    window_s: float | None = None

    def stored(self) -> dict[str, Any] | None:
        """Return nothing: windows are not kept."""
        return None

    def run(self) -> dict[str, Any]:
        """Return the windows under the key `windows`, the run's losses under `lost`, its scene's name under `scene`.

        Raises
        ------
        RecordingError
            The run cannot be used.
        """
        recording = read_recording(self.path)
        windows = windows_of(recording, self.window_s)
        scene = Path(str(recording.header.parameters.get("scene", ""))).name
        return {"run": str(self.path), "windows": windows, "lost": recording.losses(), "scene": scene}
