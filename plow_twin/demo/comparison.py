"""The forces of the demo's synthetic machine, beside the twin's published forces and those of the nominal scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.record.entries import OutputRecord
from plow_twin.record.messages import JointState
from plow_twin.record.reader import RunReader
from plow_twin.run.advance import AdvanceSeries
from plow_twin.run.twin import Twin
from plow_twin.stream.journal import Estimated

Array = NDArray[np.float64]

#: Length of the compared end of a run [s]: a load period of the paper.
COMPARED_S: Final = 3.2


@dataclass(frozen=True, eq=False)
class Comparison:
    """Forces over the newest `COMPARED_S` of a run.

    Attributes
    ----------
    peaks : dict of str to ndarray, shape (8,)
        Largest force of each pair in N, by `nominal`, `followed` and `true`.
    error : dict of str to float
        RMS of the difference from the true forces over their RMS, by `nominal` and `followed`.
    estimates_s : list of float
        Times of the run in s at which an estimate was made.
    since_s : float
        Time of the run in s from which on the forces are compared.
    """

    peaks: dict[str, Array]
    error: dict[str, float]
    estimates_s: list[float]
    since_s: float


def compare_forces(run: Path, wider_m: float) -> Comparison | None:
    """Compare the forces of a run with those of a machine with larger clearances; None without forces.

    Parameters
    ----------
    run : Path
        The recording.
    wider_m : float
        Excess of the machine's clearances over the scene's in m.
    """
    reader = RunReader(run)
    stamps, wrench, published, estimates = _read(reader)
    if not len(stamps) or not published:
        return None
    scene = reader.header.scene(reader.path)
    clearance = replace(
        scene.clearance,
        horizontal_m=scene.clearance.horizontal_m + wider_m,
        vertical_m=scene.clearance.vertical_m + wider_m,
    )
    times = (stamps - stamps[0]) * 1e-9
    motions = {
        name: _motion(one, times, wrench)
        for name, one in (("nominal", scene), ("true", replace(scene, clearance=clearance)))
    }
    late = times >= times[-1] - COMPARED_S
    here = np.flatnonzero(late & np.isin(stamps, np.fromiter(published, np.int64)))
    followed = np.array([published[stamp] for stamp in stamps[here].tolist()])
    true = motions["true"].force[here]
    peaks = {name: motion.peak[late].max(axis=0) for name, motion in motions.items()}
    size = float(np.sqrt((true**2).mean()))
    error = {
        name: float(np.sqrt(((force - true) ** 2).mean())) / size
        for name, force in (("nominal", motions["nominal"].force[here]), ("followed", followed))
    }
    came = [1e-9 * (stamp_ns - int(stamps[0])) for stamp_ns in estimates]
    return Comparison({**peaks, "followed": followed.max(axis=0)}, error, came, float(times[-1]) - COMPARED_S)


def _motion(scene: Scene, times: Array, wrench: Array) -> AdvanceSeries:
    return Twin(scene, tol=1e-6, excitation="sampled").advance_samples(times, wrench)


def _read(reader: RunReader) -> tuple[NDArray[np.int64], Array, dict[int, Array], list[int]]:
    """Return stamps [ns] and wrenches of the samples, published forces by stamp, and times of the estimates [ns]."""
    topic = reader.header.topic("contact_forces")
    stamps, wrench, published, estimates = [], [], {}, []
    for batch in reader.batches():
        there = np.flatnonzero(batch.entries.sample)
        stamps.append(batch.entries.stamp_ns[there])
        wrench.append(batch.entries.wrench[there])
        places = [index for index, entry in batch.entries.rest.items() if isinstance(entry, Estimated)]
        before = np.searchsorted(there, places) - 1
        estimates += stamps[-1][before[before >= 0]].tolist()
        for part in batch.outputs:
            for place in range(len(part.messages)):
                record = part.record(place)
                if isinstance(record, OutputRecord) and record.topic == topic:
                    message = record.message()
                    if isinstance(message, JointState):
                        published[message.stamp_ns] = message.effort
    return np.concatenate(stamps), np.concatenate(wrench), published, estimates
