"""Summarize a recorded run by its forces, contact sets, clearances and wear."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT, STOPS_COUNTER_CLOCKWISE, corner_of
from plow_twin.model.scene import Scene
from plow_twin.record.estimated import left_by
from plow_twin.record.reader import RunReader
from plow_twin.record.recording import read_recording

#: Masks of the pairs that stop a counter-clockwise swing, and of the pairs that stop a clockwise swing.
SENSES: Final = {"ccw": STOPS_COUNTER_CLOCKWISE, "cw": ~STOPS_COUNTER_CLOCKWISE}


@dataclass(frozen=True)
class RunSummary:
    """Summary of one run."""

    scene: Scene
    #: largest force of each pair [N], shape (8,)
    largest: NDArray[np.float64]
    #: impulse of each pair divided by its time in contact [N], shape (8,); the time in contact is a sum of sample
    #: intervals, so each touch adds an uncertainty of one interval
    mean_in_contact: NDArray[np.float64]
    #: number of touches, shape (8,)
    makes: NDArray[np.float64]
    #: share of the contact time in which exactly the corners of a set carry force; the keys are the direction of the
    #: swing and the set
    contact_sets: dict[str, dict[str, float]]
    #: newest value, 5 % point and 95 % point of the clearances `horizontal` and `vertical` [m]
    clearance: dict[str, tuple[float, float, float]]
    #: newest wear depth of each pad [m], shape (8,)
    wear_depth: NDArray[np.float64]
    #: number of messages on the topic `contact_forces`
    frames: int
    #: the newest estimate of the node, in the format of `plow-twin estimate --json`
    estimate: dict[str, Any] | None = None


def summarise(path: Path) -> RunSummary:
    """Return the summary of a recording. Raise `RecordingError` if the file is not a recording."""
    recording = read_recording(path)
    newest = left_by(RunReader(path))[1]
    stamps, peaks = recording["contact_peaks"].numpy()
    makes, impulse, largest = np.moveaxis(peaks.reshape(-1, 3, PAIR_COUNT), 1, 0)
    in_contact = 1e-9 * ((impulse > 0.0) * np.diff(stamps, prepend=stamps[:1])[:, None]).sum(axis=0)
    mean = np.divide(impulse.sum(axis=0), in_contact, out=np.zeros(PAIR_COUNT), where=in_contact > 0.0)
    forces = recording["contact_forces"].numpy()[1][:, -PAIR_COUNT:]
    table = recording["clearance"]
    rows = table.numpy()[1]
    clearance = dict(zip(table.columns, rows[-1].tolist(), strict=True)) if len(rows) else {}
    return RunSummary(
        recording.scene,
        largest.max(axis=0, initial=0.0),
        mean,
        makes[-1] if len(makes) else np.zeros(PAIR_COUNT),
        {sense: _shares(forces, mask, recording.scene.frame.corner_labels) for sense, mask in SENSES.items()},
        {
            name: (clearance[name], clearance[f"{name}/p05"], clearance[f"{name}/p95"])
            for name in ("horizontal", "vertical")
            if name in clearance
        },
        np.array([value for name, value in clearance.items() if name.startswith("pad_") and "/" not in name]),
        len(forces),
        None if newest is None else json.loads(newest.result),
    )


def _shares(forces: NDArray[np.float64], mask: NDArray[np.bool_], letters: dict[str, str]) -> dict[str, float]:
    counts: Counter[str] = Counter()
    for force in forces:
        pairs = np.flatnonzero((force > 0.0) & mask)
        if pairs.size:
            counts["".join(sorted(letters[corner_of(int(pair))] for pair in pairs))] += 1
    return {corners: count / counts.total() for corners, count in counts.most_common()}
