"""The recorder under stress: killed, overrun, on a full disk, and not closed. All losses are counted."""

from __future__ import annotations

import errno
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import started
from record_support import BASE_NS, STEP_NS, paper_sample, records_of
from waiting import until

from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record import ring
from plow_twin.record.bag import BagWriter, Topic
from plow_twin.record.entries import EntryRecord, OutputRecord
from plow_twin.record.header import JOURNAL, LOSS_RECORD, RunHeader
from plow_twin.record.journal_codec import Dropped
from plow_twin.record.mcap_file import UnbufferedFile
from plow_twin.record.messages import JointState
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.recorder import Recorder
from plow_twin.record.replay import replay
from plow_twin.record.ring import RingWriter
from plow_twin.record.writer import RunWriter, in_free_folder
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Loss, Sample, Snapshot
from plow_twin.stream.session import Session

HEADER = RunHeader("version: 1")
TOPIC = "/contact_forces"

#: Program that writes a journal at 1 kHz and prints the time of each sample that the recorder accepts. Its arguments
#: are the folder, the largest size of a file, the number of samples, and the recorder's options as JSON.
WRITER = """
    import json, os, sys, time
    import numpy as np
    from pathlib import Path
    from plow_twin.model.pairs import PAIR_NAMES
    from plow_twin.record.header import RunHeader
    from plow_twin.record.messages import JointState
    from plow_twin.record.recorder import Recorder
    from plow_twin.stream.journal import Sample
    folder, limit, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    if limit:
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    errors = []
    recorder = Recorder(folder, RunHeader("version: 1"), on_error=errors.append, **json.loads(sys.argv[4]))
    rng = np.random.default_rng(0)
    refused = 0
    for index in range(count):
        stamp = 1_800_000_000_000_000_000 + index * 1_000_000
        refused += not recorder.journal(Sample(stamp, tuple(rng.standard_normal(3))))
        message = JointState(stamp, "slide_frame", PAIR_NAMES, *rng.standard_normal((3, 8)))
        refused += not recorder.output("/contact_forces", stamp, message)
        os.write(1, f"{index} {time.time_ns()}\\n".encode())  # in one go: another thread may print too
        time.sleep(0.001)
"""


def writer_command(
    folder: Path, *, limit: int = 0, count: int = 10**9, begin: str = "", end: str = "", **options: Any
) -> list[str]:
    """Return the command of a writer, with additional code before and after the program."""
    code = "".join(map(textwrap.dedent, (begin, WRITER, end)))
    return [sys.executable, "-c", code, str(folder), str(limit), str(count), json.dumps(options)]


def start_writer(folder: Path, *, limit: int = 0, count: int = 10**9, end: str = "") -> subprocess.Popen[str]:
    command = writer_command(folder, limit=limit, count=count, end=end)
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def joint_state(index: int) -> JointState:
    values = np.full(8, float(index))
    return JointState(BASE_NS + index * STEP_NS, "slide_frame", PAIR_NAMES, values, values, values)


#: Program that reads lines `folder flush_period`. For each line it forks a writer, and prints its process id and its
#: end.
FORKS = """
    import json, os, sys
    import plow_twin.record.writer, mcap.writer, rosbags.typesys, lz4.frame, zstandard
    from plow_twin.record.header import RunHeader
    from plow_twin.record.writer import warm_up_writer
    warm_up_writer(RunHeader("version: 1"))
    for line in sys.stdin:
        folder, period = line.split()
        child = os.fork()
        if child == 0:
            sys.argv[1:] = [folder, "0", str(10**9), json.dumps({"flush_period_s": float(period)})]
            break
        print("child", child, flush=True)
        os.waitpid(child, 0)
        print("end", flush=True)
    else:
        sys.exit()
"""


def kill_writers(folders: Iterable[Path], rng: random.Random, flush_s: float, longest_s: float) -> None:
    """Kill writers at random times, and check that only items since the last flush are lost."""
    command = [sys.executable, "-c", textwrap.dedent(FORKS) + textwrap.dedent(WRITER)]
    with started(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        for folder in folders:
            process.stdin.write(f"{folder} {flush_s}\n")
            process.stdin.flush()
            child = int(process.stdout.readline().split()[1])
            lines = [process.stdout.readline()]  # this line shows that the writer has begun to write
            killer = threading.Timer(rng.uniform(0.0, longest_s), os.kill, [child, signal.SIGKILL])
            killer.start()
            for line in process.stdout:  # the lines are read continuously, so that the pipe does not become full
                if line.endswith("end\n"):
                    break
                lines.append(line)
            killer.join()
            check_killed(folder, lines, flush_s)
        process.stdin.close()


def check_killed(folder: Path, lines: list[str], flush_s: float) -> None:
    whole = [line for line in lines if len(line.split()) == 2 and line.endswith("\n")]
    last_index, last_ns = map(int, whole[-1].split())
    reader = RunReader(folder)
    records = list(records_of(reader))
    assert reader.status is FileStatus.TRUNCATED
    assert not (folder / "metadata.yaml").exists()
    stamps = [r.entry.stamp_ns for r in records if isinstance(r, EntryRecord) and isinstance(r.entry, Sample)]
    assert stamps == [BASE_NS + index * STEP_NS for index in range(len(stamps))]
    messages = [r.message() for r in records if isinstance(r, OutputRecord)]
    assert [m.stamp_ns for m in messages] == [BASE_NS + index * STEP_NS for index in range(len(messages))]
    assert len(messages) <= len(stamps) <= last_index + 2
    # The file contains the entries up to one flush period before the kill, and the messages up to two periods before,
    # because the chunk of the journal is written first. The tolerance is for delays of a busy machine.
    first_ns = int(lines[0].split()[1])
    for kind, periods in ((EntryRecord, 1), (OutputRecord, 2)):
        newest_ns = max((r.log_time_ns for r in records if isinstance(r, kind)), default=first_ns)
        lost = f"{last_index + 1} written, {len(stamps)} samples and {len(messages)} messages read"
        assert last_ns - newest_ns <= max(1.5, periods * flush_s + 0.5) * 1e9, lost


def test_killed_writers_lose_at_most_the_last_second(tmp_path: Path) -> None:
    kill_writers((tmp_path / f"run{n}" for n in range(20)), random.Random(0), flush_s=0.2, longest_s=0.5)


@pytest.mark.stress
@pytest.mark.timeout(3600)
def test_two_hundred_killed_writers_lose_only_items_since_the_last_flush(tmp_path: Path) -> None:
    kill_writers((tmp_path / f"run{n}" for n in range(200)), random.Random(1), flush_s=0.5, longest_s=4.0)


def test_a_full_queue_is_counted_and_noted_in_the_file(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", HEADER, queue_size=40)
    accepted: Counter[str] = Counter()
    kept_samples, kept_messages = [], []
    for index in range(4000):
        sample = Sample(BASE_NS + index * STEP_NS, (float(index), 0.0, 0.0))
        if recorder.journal(sample):
            kept_samples.append(sample)
        if recorder.output(TOPIC, sample.stamp_ns, joint_state(index)):
            kept_messages.append(sample.stamp_ns)
        if recorder.snapshot_wanted:
            accepted["snapshot"] += recorder.journal(Snapshot(sample.stamp_ns, b"state"))
        if index % 500 == 0:
            time.sleep(0.05)
    loss = recorder.close()
    assert loss.closed and loss.error is None
    assert loss.lost[JOURNAL] > 0 and loss.lost[TOPIC] > 0 and accepted["snapshot"] > 0
    assert len(kept_messages) + loss.lost[TOPIC] == 4000
    # refused snapshots may be among the lost entries, so the sum may be larger
    assert len(kept_samples) + loss.lost[JOURNAL] >= 4000

    reader = RunReader(tmp_path / "run")
    records = list(records_of(reader))
    entries = [record.entry for record in records if isinstance(record, EntryRecord)]
    assert [entry for entry in entries if isinstance(entry, Sample)] == kept_samples
    assert [r.publish_time_ns for r in records if isinstance(r, OutputRecord)] == kept_messages
    assert sum(entry.count for entry in entries if isinstance(entry, Loss)) == loss.lost[JOURNAL]
    assert sum(entry.count for entry in entries if isinstance(entry, Dropped)) == loss.lost[TOPIC]
    # notes of lost messages may be between the note of a lost entry and the snapshot, so they are removed
    recorded = [entry for entry in entries if not isinstance(entry, Dropped)]
    for entry, following in itertools.pairwise(recorded):
        assert not isinstance(entry, Loss) or isinstance(following, Snapshot)
    assert reader.lost == dict(loss.lost)
    # the notes remain in the file if the process is killed
    data = reader.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: data.index(LOSS_RECORD.encode())])
    cut = RunReader(tmp_path / "cut.mcap")
    assert [*cut.batches(outputs=False)] and (cut.status, cut.lost) == (FileStatus.TRUNCATED, reader.lost)
    bag = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert bag["custom_data"] == {f"plow_twin_lost {topic}": str(count) for topic, count in loss.lost.items()}


def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path: Path) -> None:
    end = """
    counters = recorder.counters
    loss = recorder.close()
    print(json.dumps({"errors": errors, "refused": refused, "lost": dict(loss.lost), "closed": loss.closed,
                      "error": loss.error, "counted": dict(counters.lost)}))
    """
    process = start_writer(tmp_path / "run", limit=200_000, count=3000, end=end)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    report = json.loads(output.splitlines()[-1])
    assert len(output.splitlines()) == 3001  # the full disk did not stop the caller, which continued to its last sample
    assert report["errors"] == [report["error"]] and "File too large" in report["error"]
    assert not report["closed"] and report["refused"] > 0 and report["counted"] == report["lost"]
    reader = RunReader(tmp_path / "run")
    entries = [record for record in records_of(reader) if isinstance(record, EntryRecord)]
    assert reader.status is FileStatus.TRUNCATED and len(entries) > 100
    assert len(entries) + report["lost"][JOURNAL] == 3000


def test_little_free_space_ends_a_recording_that_can_be_read(tmp_path: Path) -> None:
    errors: list[str] = []
    recorder = Recorder(tmp_path / "run", HEADER, min_free_bytes=2**62, on_error=errors.append)
    recorder.journal(Sample(BASE_NS, (1.0, 2.0, 3.0)))
    until(lambda: errors, "the end of the recording")
    assert not recorder.journal(Sample(BASE_NS + 1, (1.0, 2.0, 3.0)))
    loss = recorder.close()
    assert errors == [loss.error] and f"expected at least {2**62} B" in errors[0]
    assert loss.closed and loss.lost[JOURNAL] >= 1
    reader = RunReader(tmp_path / "run")
    list(records_of(reader))
    assert reader.status is FileStatus.STOPPED_EARLY
    assert reader.stop_reason is not None and reader.stop_reason in errors[0]
    bag = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert bag["custom_data"]["plow_twin_stopped_early"] == reader.stop_reason


def record_around_a_pause(folder: Path, stop: Callable[[], object], go_on: Callable[[], object]) -> Recorder:
    """Record a twin. The disk fails in the middle and recovers. Each stage ends at a count of the recorder."""
    scene = load_scene(scene_path("paper"))
    recorder = Recorder(folder, RunHeader(dump_scene(scene)), flush_period_s=0.02, min_free_bytes=1)
    session = Session(Twin(scene, excitation="sampled"), on_entry=recorder.journal)
    session.start()
    samples = map(paper_sample, itertools.count())

    def go(reached: Callable[[], bool]) -> None:
        def step() -> bool:
            session.apply(next(samples))
            publication = session.outputs.pop()
            assert len(publication.rows)
            recorder.publication(publication)
            if recorder.snapshot_wanted:
                recorder.journal(session.snapshot())
            return reached()

        until(step, recorder.counters, pause_s=0.0005)

    def lost() -> int:
        return min(recorder.counters.lost.get(name, 0) for name in (JOURNAL, "/contact_peaks"))

    go(lambda: recorder.counters.written > 500)
    stop()
    go(lambda: recorder.counters.error is not None and lost() > 50)
    go_on()
    go(lambda: recorder.counters.error is None and not recorder.snapshot_wanted)
    written = recorder.counters.written
    go(lambda: recorder.counters.written > written + 2000)
    session.close()
    return recorder


@pytest.mark.parametrize("kind", ["little space", "no space"])
def test_a_recording_continues_when_the_disk_has_space_again(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = threading.Event()
    write, usage = UnbufferedFile.write, shutil.disk_usage

    def write_half(file: UnbufferedFile, data: bytes) -> None:
        write(file, data[: len(data) // 2] if full.is_set() else data)
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")

    if kind == "no space":
        monkeypatch.setattr(UnbufferedFile, "write", write_half)
    else:
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(path)._replace(free=0 if full.is_set() else 9))
    loss = record_around_a_pause(tmp_path / "run", full.set, full.clear).close()
    assert loss.closed and loss.error is None and loss.lost[JOURNAL] > 50
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.status, report.divergences) == (3, FileStatus.COMPLETE, 0)
    assert report.lost[JOURNAL] == loss.lost[JOURNAL] and report.compared["contact_peaks"] > 500


def test_losses_on_a_full_disk_are_counted_exactly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, calls, full = UnbufferedFile.write, itertools.count(), True

    def fail_sometimes(file: UnbufferedFile, data: bytes) -> None:
        if full and next(calls) % 31 > 28:
            write(file, data[:10])
            raise OSError(errno.ENOSPC, "No space left on device")
        write(file, data)

    monkeypatch.setattr(UnbufferedFile, "write", fail_sometimes)
    recorder = Recorder(
        tmp_path / "run", HEADER, flush_period_s=0.2, chunk_size=8192, part_bytes=10_000, min_free_bytes=1
    )
    sent, message = itertools.count(1), JointState(BASE_NS, "slide_frame", PAIR_NAMES, *np.zeros((3, 8)))

    def step() -> bool:
        for _ in range(50):
            recorder.journal(Sample(BASE_NS, (1.0, 2.0, 3.0)))
            recorder.output(TOPIC, BASE_NS, message)
        if recorder.snapshot_wanted:
            recorder.journal(Snapshot(BASE_NS, b"0"))
        return 50 * next(sent) >= 20_000

    until(step, pause_s=0.002)
    full = False
    until(lambda: recorder.counters.error is None, "space on the disk")
    while recorder.snapshot_wanted:
        recorder.journal(Snapshot(BASE_NS, b"0"))
    loss = recorder.close()
    assert loss.closed and min(loss.lost[JOURNAL], loss.lost[TOPIC]) > 100
    reader = RunReader(tmp_path / "run")
    records = list(records_of(reader))
    numbers = [record.sequence for record in records if isinstance(record, EntryRecord)]
    assert len(reader.parts) > 1 and len(numbers) + loss.lost[JOURNAL] == max(numbers) + 1
    assert sum(isinstance(record, OutputRecord) for record in records) + loss.lost[TOPIC] == 50 * (next(sent) - 1)
    noted = Counter[str]()
    for record in records:
        if isinstance(record, EntryRecord) and isinstance(record.entry, Loss | Dropped):
            noted[record.entry.topic if isinstance(record.entry, Dropped) else JOURNAL] += record.entry.count
    assert noted == loss.lost


def test_an_incomplete_ring_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(folder: Path, *arguments: object, **options: object) -> None:
        (folder / "metadata.yaml.partial").touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ring, "write_metadata", half)
    recorder = Recorder(tmp_path / "new" / "ring", HEADER, ring_s=5.0)
    marked = recorder.mark()
    loss = recorder.close()
    assert loss.error == f"{marked}: the last 5 s not written: [Errno 28] No space left on device" and not loss.complete
    assert os.listdir(tmp_path / "new") == []


def test_a_mark_set_after_the_report_of_a_lost_mark_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    twin = Twin(load_scene(scene_path("paper")), excitation="sampled")
    folder, write, failures = tmp_path / "ring", ring.write_metadata, [OSError(28, "No space left on device")]

    def write_or_fail(*arguments: Any, **options: Any) -> None:
        if failures:
            raise failures.pop()
        write(*arguments, **options)

    monkeypatch.setattr(ring, "write_metadata", write_or_fail)
    recorder = Recorder(
        folder, RunHeader(dump_scene(twin.scene)), flush_period_s=0.01, ring_s=5.0,
        on_error=lambda text: recorder.mark(),
    )  # fmt: skip
    session = Session(twin, on_entry=recorder.journal)
    session.start()
    recorder.mark()

    def marked() -> int:
        if recorder.snapshot_wanted:
            recorder.journal(session.renew())
        return recorder.counters.marks

    until(marked, "a mark")
    recorder.close()
    assert (recorder.counters.marks, recorder.counters.marks_lost, folder.exists()) == (1, 1, True)


def test_a_ring_stores_the_last_seconds_and_writes_them_at_a_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dump = RingWriter.dump

    def dump_after_another(ring: RingWriter, folder: Path, loss: Mapping[str, int]) -> None:
        if folder.name == "ring_2":  # another process creates this folder just before the ring does
            Recorder(folder, HEADER).close()
        dump(ring, folder, loss)

    monkeypatch.setattr(RingWriter, "dump", dump_after_another)
    scene = load_scene(scene_path("paper"))
    folder = tmp_path / "runs" / "ring"
    twin = Twin(scene, excitation="sampled")
    twin.warm_up()
    recorder = Recorder(folder, RunHeader(dump_scene(scene)), flush_period_s=0.01, ring_s=0.4)
    session = Session(twin, on_entry=recorder.journal)
    session.start()
    marked: list[Path | None] = []
    index = 0
    for marks in (0, 1, 2):
        end = time.monotonic() + 1.0
        while time.monotonic() < end or recorder.counters.marks < marks:
            session.apply(paper_sample(index))
            publication = session.outputs.pop()
            assert len(publication.rows)
            recorder.publication(publication)
            if recorder.snapshot_wanted:
                recorder.journal(session.renew())
            index += 1
            time.sleep(0.001)
        assert folder.exists() == (marks > 0)
        if marks < 2:
            marked.append(recorder.mark())
            assert recorder.mark() == marked[-1]
    loss = recorder.close()
    assert loss.complete and marked == [folder, folder.with_name("ring_2")]
    written = (folder, folder.with_name("ring_3"))
    for path in written:
        report = replay(path)
        assert (report.exit_code, report.divergences) == (0, 0) and report.messages_compared
        # on a busy machine, few samples arrive in the 0.4 s of the ring
        assert 0.02 < report.span_s < 0.7 * index * 1e-3
    # the two recordings have no sample in common
    stamps = [
        {int(stamp) for batch in RunReader(path).batches() for stamp in batch.entries.stamp_ns[batch.entries.sample]}
        for path in written
    ]
    assert stamps[0].isdisjoint(stamps[1])


def test_losses_of_callers_do_not_disturb_the_closing_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = RunWriter.close

    def close_among_callers(writer: RunWriter, loss: Mapping[str, int], *reason: str | None) -> None:
        before = dict(loss)
        # this call would wait without limit if `close` held the lock
        assert not recorder.output("/late", BASE_NS, joint_state(0))
        assert dict(loss) == before
        close(writer, loss, *reason)

    monkeypatch.setattr(RunWriter, "close", close_among_callers)
    recorder = Recorder(tmp_path / "run", HEADER, min_free_bytes=2**62)
    loss = recorder.close()
    assert loss.closed and loss.lost == {"/late": 1}
    reader = RunReader(tmp_path / "run")
    list(records_of(reader))
    assert reader.lost == {} and reader.status is FileStatus.STOPPED_EARLY


@pytest.mark.parametrize("whole", [False, True], ids=["file", "folder"])
def test_a_removed_file_is_noticed(whole: bool, tmp_path: Path) -> None:
    errors: list[str] = []
    with closing(Recorder(tmp_path / "run", HEADER, flush_period_s=0.05, on_error=errors.append)) as recorder:
        shutil.rmtree(recorder.path.parent) if whole else recorder.path.unlink()
        until(lambda: errors, "the end of the recording")
        assert not recorder.journal(Sample(BASE_NS, (0.0, 0.0, 0.0)))
    assert len(errors) == 1 and "removed or replaced" in errors[0]


def test_an_open_recorder_is_closed_at_exit(tmp_path: Path) -> None:
    process = start_writer(tmp_path / "run", count=200)
    process.communicate(timeout=60)
    assert process.returncode == 0
    reader = RunReader(tmp_path / "run")
    assert sum(isinstance(record, EntryRecord) for record in records_of(reader)) == 200
    assert reader.status is FileStatus.COMPLETE
    assert (tmp_path / "run" / "metadata.yaml").exists()


def test_closing_waits_while_items_are_written_and_then_reports_missing_items(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, stuck = RunWriter.write_samples, threading.Event()

    def slowly(writer: RunWriter, *given: Any) -> None:
        if len(given[0]) == 1:  # only the last sample arrives alone, and writing it blocks
            stuck.wait(60.0)
        time.sleep(0.3)
        write(writer, *given)

    monkeypatch.setattr("plow_twin.record.recorder._BURST", 10)
    monkeypatch.setattr(RunWriter, "write_samples", slowly)
    for count in (50, 51):
        recorder = Recorder(tmp_path / f"run {count}", HEADER)
        for index in range(count):
            assert recorder.journal(paper_sample(index))
        # writing one burst takes 0.3 s, which is fast enough; five bursts take 1.5 s, which is too long
        report = recorder.close(timeout_s=0.6)
        assert report.complete == (count == 50)
    sentence = report.sentence(tmp_path / "run 51")
    stuck.set()
    assert "is incomplete: no data were written for 0.6 s, " in sentence and "are unwritten; its last file" in sentence
    assert sentence.endswith(f"plow-twin doctor --repair '{tmp_path / 'run 51'}' completes its files")


def test_an_earlier_recording_is_never_written_over(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    Recorder(folder, HEADER).close()
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(RecordingError, match="exists already"):
        Recorder(folder, HEADER)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_recorders_that_request_the_same_folder_get_separate_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quicker: list[Recorder] = []

    def make(folder: Path) -> Recorder:
        if not quicker:
            quicker.append(Recorder(folder, HEADER))
        elif len(quicker) == 1:  # this folder existed before and was empty, so the recorder may use it
            monkeypatch.setattr("plow_twin.record.writer._is_free", lambda folder: True)
            quicker.append(Recorder(folder, HEADER))
        else:
            monkeypatch.undo()
        return Recorder(folder, HEADER)

    own = in_free_folder(tmp_path / "run", make)
    recorders = [*quicker, own]
    for index, recorder in enumerate(recorders):
        assert recorder.journal(paper_sample(index)) and recorder.close().complete
    assert [recorder.path.parent.name for recorder in recorders] == ["run", "run_2", "run_3"]
    for index, recorder in enumerate(recorders):
        (record,) = records_of(recorder.path)
        assert isinstance(record, EntryRecord) and record.entry == paper_sample(index)


def test_a_message_of_another_type_stops_the_recording_and_its_topic_is_named(tmp_path: Path) -> None:
    from plow_twin.record.messages import Text

    recorder = Recorder(tmp_path / "run", HEADER)
    recorder.output(TOPIC, BASE_NS, joint_state(0))
    recorder.output(TOPIC, BASE_NS, Text("no joint state"))
    loss = recorder.close()
    assert loss.error is not None and TOPIC in loss.error and not loss.closed


#: Code that logs the path and the size at each sync to the disk.
SYNCS = """
    import os, time
    def note(wait):
        def noted(descriptor):
            path, size = os.readlink(f"/proc/self/fd/{descriptor}"), os.fstat(descriptor).st_size
            wait(descriptor)
            os.write(1, f"synced {size} {path}\\n".encode())  # in one go: the other thread prints too
        return noted
    os.fsync, os.fdatasync = note(os.fsync), note(os.fdatasync)
"""


def test_with_sync_flushed_data_survive_a_loss_of_power(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = writer_command(folder, begin=SYNCS, sync=True, flush_period_s=0.2)
    file = folder / "run_0.mcap"
    synced: list[tuple[str, int]] = []
    index, before, flushes = -1, -1, 0
    with started(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        for line in process.stdout:
            kind, *rest = line.split()
            if kind != "synced":
                index = int(kind)
            else:
                synced.append((rest[1], int(rest[0])))
                flushes += index >= 0
                # these entries are on the disk when the next flush begins, at the latest
                before = index if flushes == 3 else before
            if flushes == 5:
                process.kill()
    # a loss of power may leave only the synced data, so the file is truncated to the synced size
    assert {str(folder), str(tmp_path)} <= {path for path, _ in synced}
    os.truncate(file, max(size for path, size in synced if path == str(file)))
    reader = RunReader(folder)
    stamps = [
        r.entry.stamp_ns for r in records_of(reader) if isinstance(r, EntryRecord) and isinstance(r.entry, Sample)
    ]
    assert before > 0 and len(stamps) > before
    assert stamps == [BASE_NS + index * STEP_NS for index in range(len(stamps))]


def test_only_with_sync_the_recorder_waits_for_the_disk(tmp_path: Path) -> None:
    waited = []
    for sync in (False, True):
        command = writer_command(tmp_path / str(sync), count=20, begin=SYNCS, end="recorder.close()", sync=sync)
        completed = subprocess.run(command, capture_output=True, text=True)
        lines = [line.split() for line in completed.stdout.splitlines() if line.startswith("synced")]
        waited.append({path: int(size) for _, size, path in lines})
    assert not waited[0]
    folder = tmp_path / "True"
    assert waited[1][str(folder / "True_0.mcap")] == (folder / "True_0.mcap").stat().st_size
    assert {str(folder / "metadata.yaml.partial"), str(folder)} <= set(waited[1])


def test_a_full_disk_beside_a_run_is_reported_and_so_is_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    writer = BagWriter(tmp_path / "beside", messages.append)
    number = writer.topic(Topic("/level", "own/msg/Level", "float64 value", "RIHS01_" + 64 * "0", "[]"))
    for index, free in enumerate([True, False, False, True, True]):
        monkeypatch.setattr("plow_twin.record.bag.shortage", lambda folder, least, free=free: None if free else "full")
        writer.add(number, index, index, index, bytes(12))
        writer.flush()
    assert [text.removeprefix(f"{writer.path}: ") for text in messages] == [
        "full: messages are lost until the disk has free space",
        "recording continues, 2 messages were lost",
    ]
    writer.close()
    assert (writer.written["/level"], writer.lost["/level"]) == (3, 2)
