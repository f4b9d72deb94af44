"""A recording is read with third-party libraries, and its results are computed again and compared bit for bit.

The argument is the folder of a run of the node (`record_path`, or `plow-twin demo`). Without an argument, the example
records three seconds.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore


def record(folder: Path) -> None:
    """Record 3 s of samples at 1 kHz, with journal and publications, as the node does."""
    from plow_twin import Twin, dump_scene, load_scene
    from plow_twin.record.header import RunHeader
    from plow_twin.record.recorder import Recorder
    from plow_twin.stream.journal import Sample
    from plow_twin.stream.session import Session

    scene = load_scene("bench_kv")
    recorder = Recorder(folder, RunHeader(dump_scene(scene)))
    session = Session(Twin(scene, excitation="sampled"), on_entry=recorder.journal)
    session.start()
    for index in range(3000):
        load = np.sin(2e-3 * index) * np.array([40e3, 11e3, 30e3])
        session.apply(Sample(1_800_000_000_000_000_000 + index * 1_000_000, tuple(load)))
        recorder.publication(session.outputs.pop())
    session.close()
    assert recorder.close().complete


if len(sys.argv) > 2:
    run = Path(sys.argv[2])
else:
    run = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples/reading_a_recording") / "run"
    shutil.rmtree(run, ignore_errors=True)
    record(run)

# any library that reads rosbag2's MCAP files can be used
largest: dict[str, float] = {}
impulse: dict[str, float] = {}
with AnyReader([run], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
    for connection, _, data in reader.messages():
        if connection.topic.endswith("contact_peaks"):
            message = reader.deserialize(data, connection.msgtype)
            for name, force, added in zip(message.name, message.effort, message.velocity, strict=True):
                largest[name] = max(largest.get(name, 0.0), float(force))
                impulse[name] = impulse.get(name, 0.0) + float(added)
for name, force in largest.items():
    print(f"{name:20}  largest {force / 1e3:6.1f} kN, impulse {impulse[name] / 1e3:7.3f} kN s")

# the replay computes all messages again; since they are bit-identical, its exit code is 0
subprocess.run([sys.executable, "-m", "plow_twin", "replay", str(run)], check=True)
