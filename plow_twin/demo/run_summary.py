"""Summary of a recorded run from its messages: forces per corner and sense, contact sets, clearance and wear."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import CORNER_NAMES, PAIR_COUNT, STOPS_COUNTER_CLOCKWISE, corner_of
from plow_twin.model.scene import Scene
from plow_twin.record.entries import EntryRecord, OutputRecord
from plow_twin.record.messages import JointState
from plow_twin.record.reader import RunReader
from plow_twin.stream.journal import Estimated

#: Mask of the pairs that belong to each sense of swing.
SENSES: Final = {"ccw": STOPS_COUNTER_CLOCKWISE, "cw": ~STOPS_COUNTER_CLOCKWISE}
_TOPICS: Final = ("contact_forces", "contact_peaks", "clearance")


@dataclass(frozen=True)
class RunSummary:
    """Figures of one run.

    Attributes
    ----------
    largest, mean_in_contact : ndarray, shape (8,)
        Largest force, and impulse over the time in contact [N]; each touch makes that time uncertain by a sample
        interval.
    makes : ndarray, shape (8,)
        Number of makes.
    contact_sets : dict
        By sense: share of the contact time in which exactly these corners carry force.
    clearance : dict
        Newest value, 5 % and 95 % point [m] of `horizontal` and `vertical`.
    wear_depth : ndarray, shape (8,)
        Newest depth of each pad [m].
    frames : int
        Messages on contact_forces.
    estimate : dict or None
        The newest estimate that the node has made, as `plow-twin estimate --json` prints it.
    """

    scene: Scene
    largest: NDArray[np.float64]
    mean_in_contact: NDArray[np.float64]
    makes: NDArray[np.float64]
    contact_sets: dict[str, dict[str, float]]
    clearance: dict[str, tuple[float, float, float]]
    wear_depth: NDArray[np.float64]
    frames: int
    estimate: dict[str, Any] | None = None


def corner_letters(scene: Scene) -> dict[str, str]:
    """Return the letter of each corner, or its name where the scene has no letter."""
    letters = {corner: letter for letter, corner in scene.frame.labels.items()}
    return {corner: letters.get(corner, corner) for corner in CORNER_NAMES}


def summarise(path: Path) -> RunSummary:
    """Read a recording and return its figures.

    Raises
    ------
    RecordingError
        The file is not a recording of plow_twin.
    """
    reader = RunReader(path)
    scene = reader.header.scene(reader.path)
    found, estimate = _read(reader)
    forces, peaks = found["contact_forces"], found["contact_peaks"]
    largest, impulse, in_contact = np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT), np.zeros(PAIR_COUNT)
    before_ns = peaks[0].stamp_ns if peaks else 0
    for message in peaks:
        largest = np.maximum(largest, message.effort)
        impulse += message.velocity
        in_contact += (message.velocity > 0.0) * (message.stamp_ns - before_ns) * 1e-9
        before_ns = message.stamp_ns
    mean = np.divide(impulse, in_contact, out=np.zeros(PAIR_COUNT), where=in_contact > 0.0)
    makes = peaks[-1].position if peaks else np.zeros(PAIR_COUNT)
    clearance = dict(zip(*_named(found["clearance"]), strict=True))
    return RunSummary(
        scene,
        largest,
        mean,
        makes,
        {sense: _shares(forces, mask, corner_letters(scene)) for sense, mask in SENSES.items()},
        {
            name: (clearance[name], clearance[f"{name}/p05"], clearance[f"{name}/p95"])
            for name in ("horizontal", "vertical")
            if name in clearance
        },
        np.array([value for name, value in clearance.items() if name.startswith("pad_") and "/" not in name]),
        len(forces),
        estimate,
    )


def _read(reader: RunReader) -> tuple[dict[str, list[JointState]], dict[str, Any] | None]:
    topics = {reader.header.topic(name): name for name in _TOPICS}
    found: dict[str, list[JointState]] = {name: [] for name in _TOPICS}
    estimate = None
    for record in reader:
        if isinstance(record, EntryRecord) and isinstance(record.entry, Estimated):
            estimate = json.loads(record.entry.result)
        if isinstance(record, OutputRecord) and record.topic in topics:
            message = record.message()
            if isinstance(message, JointState):
                found[topics[record.topic]].append(message)
    return found, estimate


def _named(messages: list[JointState]) -> tuple[tuple[str, ...], list[float]]:
    return (messages[-1].name, messages[-1].position.tolist()) if messages else ((), [])


def _shares(forces: list[JointState], mask: NDArray[np.bool_], letters: dict[str, str]) -> dict[str, float]:
    counts: Counter[str] = Counter()
    for message in forces:
        pairs = np.flatnonzero((message.effort > 0.0) & mask)
        if pairs.size:
            counts["".join(sorted(letters[corner_of(int(pair))] for pair in pairs))] += 1
    return {corners: count / counts.total() for corners, count in counts.most_common()}
