"""Compare the forces of the twin and of the nominal scene with the true forces of the synthetic machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.record.reader import RunReader
from plow_twin.record.recording import read_recording
from plow_twin.run.twin import Twin
from plow_twin.stream.journal import Estimated

Array = NDArray[np.float64]

#: Length of the compared part at the end of a run [s]. It is about one period of the load in the paper.
COMPARED_S: Final = 3.2


@dataclass(frozen=True, eq=False)
class Comparison:
    """Forces in the last `COMPARED_S` of a run."""

    #: largest force of each pair [N], for the keys `nominal`, `followed` and `true`, shape (8,)
    peaks: dict[str, Array]
    #: RMS of the difference from the true forces, divided by the RMS of the true forces; the keys are `nominal` and
    #: `followed`
    error: dict[str, float]
    #: times in the run at which estimates were made [s]
    estimates_s: list[float]
    #: time in the run at which the compared part begins [s]
    since_s: float


def compare_forces(run: Path, wider_m: float) -> Comparison | None:
    """Compare the forces of a run with those of a machine whose clearances are larger by `wider_m` [m].

    The result is None if the run has no forces.
    """
    recording = read_recording(run)
    stamps, wrench = recording["excitation"].numpy()
    published_ns, forces = recording["contact_forces"].numpy()
    if not len(stamps) or not len(published_ns):
        return None
    scene = recording.scene
    clearance = replace(
        scene.clearance,
        horizontal_m=scene.clearance.horizontal_m + wider_m,
        vertical_m=scene.clearance.vertical_m + wider_m,
    )
    times = (stamps - stamps[0]) * 1e-9
    motions = {
        name: Twin(model, tol=1e-6, excitation="sampled").advance_samples(times, wrench)
        for name, model in (("nominal", scene), ("true", replace(scene, clearance=clearance)))
    }
    late = times >= times[-1] - COMPARED_S
    compared = np.flatnonzero(late & np.isin(stamps, published_ns))
    last = dict(zip(published_ns.tolist(), forces[:, -PAIR_COUNT:], strict=True))
    followed = np.array([last[stamp] for stamp in stamps[compared].tolist()])
    true = motions["true"].force[compared]
    peaks = {name: motion.peak[late].max(axis=0) for name, motion in motions.items()}
    size = float(np.sqrt((true**2).mean()))
    error = {
        name: float(np.sqrt(((force - true) ** 2).mean())) / size
        for name, force in (("nominal", motions["nominal"].force[compared]), ("followed", followed))
    }
    came = [1e-9 * (stamp_ns - int(stamps[0])) for stamp_ns in _estimate_stamps(RunReader(run))]
    return Comparison({**peaks, "followed": followed.max(axis=0)}, error, came, float(times[-1]) - COMPARED_S)


def _estimate_stamps(reader: RunReader) -> list[int]:
    """Return the stamp [ns] of the last sample before each estimate."""
    stamps: list[int] = []
    for batch in reader.batches(outputs=False):
        indices = np.flatnonzero(batch.entries.sample)
        places = [index for index, entry in batch.entries.rest.items() if isinstance(entry, Estimated)]
        before = np.searchsorted(indices, places) - 1
        stamps += batch.entries.stamp_ns[indices[before[before >= 0]]].tolist()
    return stamps
