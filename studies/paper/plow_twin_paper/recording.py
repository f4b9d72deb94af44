"""A run of a scene as a recording and as a rerun file, with the loads of the scene as samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import SolverError
from plow_twin.model.loads import compile_loads
from plow_twin.model.scene import Scene
from plow_twin.run.advance import Advance
from plow_twin.run.simulate import output_times
from plow_twin.run.twin import Twin
from plow_twin.stream.journal import Entry, Sample
from plow_twin.stream.outputs import NOTHING
from plow_twin.stream.session import Session

if TYPE_CHECKING:
    from plow_twin.record.writer import RunWriter

Array = NDArray[np.float64]
#: Interval of the samples [s].
SAMPLE_S: Final = 1e-3
#: Number of samples per message. The peaks of a message cover all its samples.
MESSAGE_EVERY: Final = 4
_CHUNK_B: Final = 256 * 1024
_MIN_FREE_B: Final = 64 * 1024 * 1024


@dataclass(frozen=True)
class Recording:
    """The files of a recorded run, and the pose of the head, shape (n, 3), at the times t of samples, shape (n,)."""

    mcap: Path
    rrd: Path
    t: Array
    q: Array


def record(
    scene: Scene, t_end: float, folder: Path, on_progress: Callable[[float], object] = lambda share: None
) -> Recording:
    """Run a scene. Write `folder`/..._0.mcap and `folder`.rrd.

    Raises
    ------
    SolverError
        The motion could not be continued.
    RecordingError
        The folder is not empty or cannot be written.
    """
    from plow_twin.record.header import RunHeader
    from plow_twin.record.writer import RunWriter
    from plow_twin.scene_file import dump_scene
    from plow_twin.view import to_rrd

    writer = RunWriter(folder, RunHeader(dump_scene(scene)), _CHUNK_B, _MIN_FREE_B)
    times = output_times(t_end, SAMPLE_S)
    try:
        q = _drive(scene, times, writer, lambda share: on_progress(0.6 * share))
    except BaseException:
        writer.abandon()
        raise
    writer.close({})
    rrd = folder.with_suffix(".rrd")
    to_rrd(writer.path, rrd, on_progress=lambda share: on_progress(0.6 + 0.4 * share))
    return Recording(writer.path, rrd, times, q)


def _drive(scene: Scene, times: Array, writer: RunWriter, on_progress: Callable[[float], object]) -> Array:
    """Pass the loads to a twin and write its inputs and outputs. Return its poses, shape (n, 3)."""
    from plow_twin.record.outputs import publication_messages

    header, sequence = writer.header, -1
    stamps = np.rint(1e9 * times).astype(np.int64).tolist()
    poses = np.zeros((len(times), 3))
    stamp_ns = 0

    def journal(entry: Entry) -> None:
        nonlocal sequence
        sequence += 1
        writer.write_entry(sequence, stamp_ns, entry)

    session = Session(Twin(scene, excitation="sampled"), on_entry=journal)
    session.start()
    for index, (stamp_ns, wrench) in enumerate(zip(stamps, compile_loads(scene.loads).at(times).tolist(), strict=True)):
        rows = session.apply(Sample(stamp_ns, (wrench[0], wrench[1], wrench[2])))
        assert rows is not None
        advance = Advance(rows[0])
        if advance.status:
            raise SolverError(f"recorded run at t = {times[index]:.9g} s: {advance.status.text}")
        poses[index] = advance.q
        published = session.outputs.pop() if index % MESSAGE_EVERY == 0 else NOTHING
        for name, message in publication_messages(published, header.frame_id, header.child_frame_id).items():
            writer.write_output(header.topic(name), sequence, stamp_ns, stamp_ns, message)
        if index % 1000 == 0:
            on_progress(index / len(times))
    session.close()
    return poses
