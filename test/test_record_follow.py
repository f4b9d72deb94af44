"""A recording that is read during its recording: its parts, its end, and a writer that is killed."""

from __future__ import annotations

import signal
import sys
import textwrap
import threading
from pathlib import Path

import pytest
from commands import started
from record_support import BASE_NS, STEP_NS, paper_sample, record_run

from plow_twin.errors import RecordingError
from plow_twin.record.follow import Tail, claim
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.running import find_run

COUNT = 3000


def test_a_tail_reads_every_sample_of_every_part_and_ends_with_the_run(tmp_path: Path) -> None:
    before = record_run(tmp_path / "before", map(paper_sample, range(10)))
    # this first reading compiles the reader
    assert sum(len(batch.entries) for batch in RunReader(before.folder, Tail()).batches())
    options = {"part_bytes": 100_000, "flush_period_s": 0.05}
    writer = threading.Thread(
        target=record_run, args=(tmp_path / "run", map(paper_sample, range(COUNT))), kwargs=options
    )
    writer.start()
    reader = RunReader(find_run(tmp_path / "run", 60.0), Tail())
    stamps: list[int] = []
    sent = pauses = 0
    for batch in reader.batches():
        stamps += batch.entries.stamp_ns[batch.entries.sample].tolist()
        sent += sum(map(len, batch.outputs))
        pauses += not len(batch.entries) and not batch.outputs
    writer.join()
    assert stamps == [BASE_NS + index * STEP_NS for index in range(COUNT)]
    assert len(reader.parts) > 3 and pauses > 1 and reader.status is FileStatus.COMPLETE
    assert sent == sum(sum(map(len, batch.outputs)) for batch in RunReader(tmp_path / "run").batches()) > 3 * COUNT


def test_a_tail_waits_for_an_end_that_is_partly_written(tmp_path: Path) -> None:
    file = record_run(tmp_path / "run", map(paper_sample, range(10))).file
    whole = file.read_bytes()
    file.write_bytes(whole[:-3])
    with file.open("ab", buffering=0) as writer:
        claim(writer.fileno())
        reader = RunReader(file, Tail(lambda: not writer.write(whole[-3:])))
        assert sum(len(batch.entries) for batch in reader.batches()) > 10
    assert file.read_bytes() == whole and reader.status is FileStatus.COMPLETE


WRITER = """
    import sys, time
    from pathlib import Path
    sys.path.insert(0, sys.argv[2])
    from record_support import RunHeader, Recorder, dump_scene, load_scene, paper_sample, scene_path
    recorder = Recorder(Path(sys.argv[1]), RunHeader(dump_scene(load_scene(scene_path("paper")))), flush_period_s=0.05)
    for index in range(10**9):
        recorder.journal(paper_sample(index))
        time.sleep(0.002)
"""


def test_reading_a_recording_in_progress_ends_when_the_writer_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(WRITER), str(tmp_path / "run"), str(Path(__file__).parent)]
    with started(command) as process:
        reader = RunReader(find_run(tmp_path / "run", 60.0), Tail())
        samples = 0
        for batch in reader.batches():
            samples += int(batch.entries.sample.sum())
            if samples > 50 and process.returncode is None:
                process.send_signal(signal.SIGKILL)
                process.wait()
    assert samples > 50 and reader.status is FileStatus.TRUNCATED


def test_the_run_in_progress_is_found_beside_an_earlier_run(tmp_path: Path) -> None:
    record_run(tmp_path / "run", map(paper_sample, range(10)))
    writer = threading.Thread(target=record_run, args=(tmp_path / "run_2", map(paper_sample, range(COUNT))))
    writer.start()
    run_folder = find_run(tmp_path / "run", 60.0)
    reader = RunReader(run_folder, Tail(stop=lambda: True))
    assert run_folder == tmp_path / "run_2" and [*reader.batches()] and reader.status is FileStatus.UNREAD
    writer.join()
    assert find_run(tmp_path / "run", 0.0) == tmp_path / "run"
    with pytest.raises(RecordingError, match="expected a recording in progress"):
        find_run(tmp_path / "none", 0.0)
