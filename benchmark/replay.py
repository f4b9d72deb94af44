"""Speed of replay and of reading the same file, and size of a recording: `python benchmark/replay.py [SECONDS]`.

The paper's head is recorded at 1 kHz with all outputs. The program prints the size of the recording, and speeds as
multiples of real time:

- replay of all messages, and replay of digests alone
- upper bounds of the replay: the motion alone, and decompression alone
- drawing of a long run, and reading of the file with `mcap` and `rosbags`

Times are processor times of one thread, the shortest of several runs. The last column of a replay excludes its start
(scene, twin, and loading of compiled code), which has its own row.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from plow_twin.record.chunks import ChunkReader
from plow_twin.record.header import RunHeader
from plow_twin.record.recorder import Recorder
from plow_twin.record.replay import replay
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Sample
from plow_twin.stream.session import Session
from plow_twin.view import to_rrd

_AMPLITUDE = np.array([32_000.0, -11_000.0, -45_495.0])
_START_NS = 1_800_000_000_000_000_000
_REPEATS = 5
_BATCH = 8192
#: Length [s] of a recording whose replay takes hardly longer than its start.
_SHORT_S = 0.1


def record(folder: Path, seconds: float, outputs: bool) -> int:
    """Record a run. Return its size [B]."""
    scene = load_scene("paper")
    kind = "all" if outputs else "none"
    header = RunHeader(dump_scene(scene), record_outputs=kind)
    recorder = Recorder(folder, header, queue_size=10**7)
    session = Session(Twin(scene, excitation="sampled"), on_entry=recorder.journal)
    session.start()
    for index in range(round(1000 * seconds)):
        fx, fy, moment = (np.sin(2e-3 * index) * _AMPLITUDE).tolist()
        session.apply(Sample(_START_NS + index * 1_000_000, (fx, fy, moment)))
        published = session.outputs.pop()
        if outputs:
            recorder.publication(published)
    session.close()
    report = recorder.close(timeout_s=600.0)
    if not report.complete:
        raise SystemExit(f"recording incomplete: {report}")
    return recorder.path.stat().st_size


def least(work: Callable[[], object]) -> float:
    """Return the shortest processor time of several runs [s]."""
    times = []
    for _ in range(_REPEATS):
        begin = time.thread_time()
        work()
        times.append(time.thread_time() - begin)
    return min(times)


def _wrenches(index: NDArray[np.int64]) -> NDArray[np.float64]:
    wrenches: NDArray[np.float64] = np.sin(2e-3 * index)[:, None] * _AMPLITUDE
    return wrenches


def move(seconds: float, rows: bool) -> None:
    """Advance a twin by the samples of the recording, with or without computing the rows of its publications."""
    twin = Twin(load_scene("paper"), excitation="sampled")
    index, memory = np.arange(round(1000 * seconds)), np.zeros(_BATCH, ROW)
    for begin in range(0, len(index), _BATCH):
        here = index[begin : begin + _BATCH]
        stamps = 1e-3 * here.astype(np.float64)
        twin.advance_rows(stamps, _wrenches(here), memory[: len(here)] if rows else None)


def decompress_all(path: Path) -> None:
    for _ in ChunkReader(path):
        pass


def read_mcap(path: Path) -> None:
    with path.open("rb") as stream:
        for _ in make_reader(stream).iter_messages(log_time_order=False):
            pass


def read_rosbags(folder: Path) -> None:
    with Reader(folder) as reader:
        for _ in reader.messages():
            pass


@click.command()
@click.argument("seconds", type=click.FloatRange(min=_SHORT_S), default=60.0)
def main(seconds: float) -> None:
    """Record SECONDS (60) of the paper's head, replay the recording, and print all speeds."""
    with tempfile.TemporaryDirectory() as name:
        full, bare, short = (Path(name) / folder for folder in ("full", "bare", "short"))
        for folder, outputs in ((full, True), (bare, False)):
            size = record(folder, seconds, outputs)
            print(f"{folder.name:8} {size / seconds / 1e3:8.1f} kB/s {size / seconds * 3.6e-3:8.0f} MB/h")
        record(short, _SHORT_S, True)
        replay(short)  # this call compiles the code
        replay(short, digests_only=True)
        start = least(lambda: replay(short))
        print(f"{'start of a replay':26} {start:8.3f} s")
        works: dict[str, Callable[[], object]] = {
            "replay, every message": lambda: replay(full),
            "replay, digests alone": lambda: replay(full, digests_only=True),
            "replay of the journal": lambda: replay(bare, digests_only=True),
            "the motion, all read out": lambda: move(seconds, rows=True),
            "the motion alone": lambda: move(seconds, rows=False),
            "decompressing, finding": lambda: decompress_all(full / "full_0.mcap"),
            "view, thinned": lambda: to_rrd(full, Path(name) / "full.rrd", most_rows=round(200_000 * seconds / 3600)),
            "read with mcap": lambda: read_mcap(full / "full_0.mcap"),
            "read with rosbags": lambda: read_rosbags(full),
        }
        to_rrd(full, Path(name) / "full.rrd")  # this call compiles the code
        for title, work in works.items():
            spent = least(work)
            apart = f", {seconds / (spent - start):.0f} x without its start" if title.startswith("replay") else ""
            print(f"{title:26} {spent:8.3f} s {seconds / spent:8.0f} x real time{apart}")


if __name__ == "__main__":
    main()
