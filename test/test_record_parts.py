"""Recordings of several parts, recordings of the journal alone, and repairs."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shutil
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from record_support import chunk_spans, paper_sample, record_run, records_of, rewrite
from rosbags.highlevel import AnyReader

from plow_twin import Wear
from plow_twin.cli.app import run as cli
from plow_twin.cli.info import read_recording
from plow_twin.errors import RecordingError
from plow_twin.live.recording import Decimation
from plow_twin.record import measured
from plow_twin.record.bag import BagWriter, Topic
from plow_twin.record.doctor import examine, repair
from plow_twin.record.header import RunHeader
from plow_twin.record.mcap_file import UnbufferedFile
from plow_twin.record.measured import read_recording as read_measured
from plow_twin.record.metadata_yaml import listed_parts
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.recorder import Recorder
from plow_twin.record.replay import replay
from plow_twin.record.sources import open_source
from plow_twin.record.writer import RunWriter
from plow_twin.run.twin import Twin
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Pose, Sample, Snapshot
from plow_twin.stream.outputs import Published
from plow_twin.stream.session import Session
from plow_twin.study.analysis.analyse import analyse

COUNT = 3000
#: Options that divide a run of `COUNT` samples into several parts.
SMALL: dict[str, Any] = {"part_bytes": 200_000, "flush_period_s": 0.01, "chunk_size": 50_000}


def test_parts_can_be_read_alone_and_nothing_is_lost_between_them(tmp_path: Path) -> None:
    run = record_run(
        tmp_path / "run", map(paper_sample, range(COUNT)), part_bytes=200_000, flush_period_s=0.01, chunk_size=50_000
    )
    parts = RunReader(run.folder).parts
    assert len(parts) >= 3 and not run.loss.lost
    report = replay(run.folder)
    assert (report.exit_code, report.samples, report.compared["contact_forces"]) == (0, COUNT, COUNT)
    assert report.snapshots_compared == len(parts) - 1
    for part in parts[1:]:
        first = next(iter(records_of(part)))
        assert isinstance(first.entry, Snapshot)  # type: ignore[union-attr]
        alone = replay(part)
        assert (alone.exit_code, alone.lost) == (0, {}) and alone.samples > 0
    bag = yaml.safe_load((run.folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert bag["relative_file_paths"] == [part.name for part in parts]
    with AnyReader([run.folder]) as reader:
        assert reader.message_count == bag["message_count"] == len(run.entries) + len(run.outputs)


def test_the_oldest_parts_are_removed_on_request(tmp_path: Path) -> None:
    run = record_run(
        tmp_path / "run",
        map(paper_sample, range(COUNT)),
        part_bytes=100_000,
        keep_bytes=150_000,
        flush_period_s=0.01,
        chunk_size=50_000,
    )
    parts = RunReader(run.folder).parts
    assert parts[0].name != "run_0.mcap" and sum(part.stat().st_size for part in parts) < 500_000
    report = replay(run.folder)
    assert (report.exit_code, report.divergences, report.lost) == (0, 0, {}) and report.samples < COUNT


def test_the_journal_alone_takes_less_than_75_bytes_a_sample(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), frame_every=10**9, pause_every=0)
    assert run.file.stat().st_size / COUNT < 75
    assert replay(run.folder).exit_code == 0


@pytest.mark.parametrize(("share", "begun"), [(0.4, None), (0.9, 0), (0.9, 100)])
def test_a_truncated_recording_is_repaired(share: float, begun: int | None, tmp_path: Path) -> None:
    """A recorder that is killed during a change of files leaves a second part, which has `begun` bytes."""
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), chunk_size=50_000)
    data = run.file.read_bytes()
    run.file.write_bytes(data[: int(len(data) * share)])
    (run.folder / "metadata.yaml").unlink()
    begun_parts = [] if begun is None else [run.folder / "run_1.mcap"]
    for part in begun_parts:
        part.write_bytes(data[:begun])
    before = examine(run.folder)
    assert before.problems and before.status == FileStatus.TRUNCATED.value
    records = list(records_of(run.folder))
    assert RunReader(run.folder).damaged_chunks == 0 and repair(run.folder) == [run.file, *begun_parts]
    after = examine(run.folder)
    assert after.problems == [] and after.status == FileStatus.COMPLETE.value
    # the repaired file contains every record that could be read before, but not always in the same order
    assert {repr(record) for record in records_of(run.folder)} == {repr(record) for record in records}
    assert replay(run.folder).exit_code == 0
    with AnyReader([run.folder]) as reader:
        assert reader.message_count == len(records)


def test_a_recording_in_progress_is_not_repaired(tmp_path: Path) -> None:
    scene = dump_scene(load_scene(scene_path("paper")))
    with closing(Recorder(tmp_path / "run", RunHeader(scene))) as recorder:
        recorder.journal(paper_sample(0))
        with pytest.raises(RecordingError, match="still being written"):
            repair(tmp_path / "run")
    assert repair(tmp_path / "run") == [] and RunReader(tmp_path / "run").parts


def test_a_damaged_chunk_is_left_out_by_a_repair_and_the_gap_is_named(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), chunk_size=50_000)
    whole, spans = run.file.read_bytes(), chunk_spans(run.file)
    assert len(spans) > 6
    for start, length in spans[2:6]:  # these are chunks of the journal and of the outputs
        data = bytearray(whole)
        data[start + length // 2] ^= 0xFF
        run.file.write_bytes(data)
        before = replay(run.folder)
        assert repair(run.folder) == [run.file] and (run.folder / "run_0.mcap.damaged").exists()
        report, after = examine(run.folder), replay(run.folder)
        assert report.parts[0].healthy and report.entries[Sample.__name__] <= COUNT
        assert "run_0.mcap: 1 chunk(s) left out by a repair" in report.problems and repair(run.folder) == []
        assert (after.exit_code, after.divergences) == (3, 0) == (before.exit_code, before.divergences)
        assert after.messages_compared == before.messages_compared


def test_faults_that_stop_other_programs_are_named_and_repaired(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(100)))
    listing = run.folder / "metadata.yaml"
    good = listing.read_text()
    for text, problem in (
        ("{{", "metadata.yaml: cannot be read"),
        ("", "metadata.yaml: cannot be read"),
        (good.replace("run_0.mcap", "run_7.mcap"), "run_7.mcap is missing"),
    ):
        listing.write_text(text)
        assert any(problem in one for one in examine(run.folder).problems)
        assert repair(run.folder) == [] and examine(run.folder).problems == []
        with AnyReader([run.folder]) as reader:
            assert reader.message_count
    with run.file.open("ab") as stream:
        stream.write(b"x" * 100)
    assert examine(run.folder).problems == ["run_0.mcap: 100 B after the end of the MCAP content"]
    assert repair(run.folder) == [run.file] and examine(run.folder).problems == []
    with AnyReader([run.folder]) as reader:
        assert reader.message_count


def test_a_damaged_qos_of_a_topic_does_not_stop_a_repair(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(100)))
    data = run.file.read_bytes()
    assert data.count(b"keep_last") > 1  # in the declarations of the topics, which are outside the chunks
    run.file.write_bytes(data.replace(b"keep_last", b"keep\x17last")[:-100])
    assert repair(run.folder) == [run.file] and examine(run.folder).problems == []
    with AnyReader([run.folder]) as reader:
        assert reader.message_count


def test_a_repair_keeps_every_old_file_and_lists_every_part(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), **SMALL)
    parts = RunReader(run.folder).parts
    old = [parts[1].read_bytes()[:-1000]]
    for _ in range(2):  # the file is truncated, repaired and truncated again
        parts[1].write_bytes(old[-1])
        assert repair(parts[1]) == [parts[1]]  # a single part of a run can be repaired
        assert listed_parts(run.folder) == [part.name for part in parts]
        old.append(parts[1].read_bytes()[:-2000])
    kept = [parts[1].with_name(f"{parts[1].name}.damaged{ending}") for ending in ("", "_2")]
    assert [file.read_bytes() for file in kept] == old[:2]


def test_topics_recorded_beside_a_run_are_examined_and_repaired(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(100)))
    writer = BagWriter(run.folder / "beside")
    number = writer.topic(Topic("/level", "own/msg/Level", "float64 value", "RIHS01_" + 64 * "0", "[]"))
    for index in range(100):
        writer.add(number, index, index, index, bytes(12))
        writer.flush()
    writer.lost["/level"] = 7  # losses that the recorder has counted, for example on a full disk
    writer.close()
    lost = "beside: 7 lost on /level, as counted by the recorder"
    assert examine(run.folder).problems == [lost]
    writer.path.write_bytes(writer.path.read_bytes()[:2000])  # the recorder was killed
    assert examine(run.folder).problems == ["beside/beside_0.mcap: truncated: its end is missing", lost]
    assert repair(run.folder) == [writer.path] and examine(run.folder).problems == [lost]
    with writer.path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count > 5
    # the type belongs to another package, so its hash is unknown and zeros are written
    assert summary.channels[1].metadata["topic_type_hash"] == "RIHS01_" + 64 * "0"
    assert "own/msg/Level" in (writer.folder / "metadata.yaml").read_text()


def test_a_repeated_part_is_named_and_read_once(tmp_path: Path) -> None:
    run = record_run(
        tmp_path / "run", map(paper_sample, range(COUNT)), part_bytes=200_000, flush_period_s=0.01, chunk_size=50_000
    )
    second = run.folder / "run_1.mcap"
    before = replay(run.folder)
    last = RunReader(run.folder).parts[-1].name
    for name in (f"run_{int(last[4:-5]) + 1}.mcap", "run_1 (copy).mcap", "again.mcap"):
        copy = run.folder / name
        shutil.copy(second, copy)
        after = replay(run.folder)
        assert after.repeated_parts == {name: "run_1.mcap"}
        assert (after.exit_code, after.samples, after.compared) == (0, before.samples, before.compared)
        assert f"{name}: repeats run_1.mcap (part 1): it is not read" in examine(run.folder).problems
        assert repair(run.folder) == [copy] and examine(run.folder).problems == []
        copy.with_name(f"{name}.repeated").unlink()


def test_a_part_of_another_run_is_named_and_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs of one scene and node differ only in their random id."""
    run, other = (record_run(tmp_path / name, map(paper_sample, range(COUNT)), **SMALL) for name in ("run", "other"))
    parts = RunReader(run.folder).parts
    assert {RunReader(part).header.run_id for part in parts} == {RunReader(run.folder).header.run_id}
    for part in (parts[1], parts[-1]):
        shutil.copy(other.file, part)
        after, report, (facts, lossy) = replay(run.folder), examine(run.folder), read_recording(run.folder)
        assert (after.exit_code, after.divergences, after.repeated) == (3, 0, 0) and lossy
        assert after.foreign_parts[part.name] == facts["foreign_parts"][part.name] == ["run_id"]
        assert f"{part.name}: belongs to another run (its run_id differ) and is not read" in report.problems
        count = len(after.foreign_parts)
        counted = {"missing_parts": count, "foreign_parts": count}
        assert facts["lost"] == counted and facts["damaged_chunks"] == 0
        assert counted.items() <= after.lost.items() and counted.items() <= analyse(run.folder).lost.items()
    capsys.readouterr()
    assert cli(["replay", str(run.folder), "-q"]) == 3
    assert f"{part.name} belongs to another run" in capsys.readouterr().err
    assert repair(run.folder) == [parts[1], parts[-1]] and not RunReader(run.folder).foreign
    assert part.with_name(f"{part.name}.foreign").is_file()


def test_a_recording_of_another_layout_is_refused_by_its_number(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(10)))
    rewrite(run.file, tmp_path / "old.mcap", metadata=lambda record: {**record, "layout_version": "3"})
    with pytest.raises(RecordingError, match=r"old\.mcap: layout_version: got '3', expected '4'"):
        RunReader(tmp_path / "old.mcap")


def test_repeated_entries_are_counted_and_used_once(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), chunk_size=50_000)
    whole, spans = run.file.read_bytes(), chunk_spans(run.file)
    before = replay(run.folder)
    head = 9 + 3 * 8 + 2 * 4 + len("zstd") + 8  # number of bytes in the record of a chunk before its data
    # the repeated bytes begin with a journal chunk and end before an outputs chunk
    begin, end = spans[2][0] - head, spans[8][0] - head
    run.file.write_bytes(whole[:end] + whole[begin:end] + whole[end:])
    after, report = replay(run.folder), examine(run.folder)
    assert after.divergences == 0 and after.samples == before.samples and after.repeated == report.repeated_entries > 0
    assert after.inputs == before.inputs and before.inputs
    assert report.missing_entries == 0 and any("more than once" in problem for problem in report.problems)


def test_on_a_full_disk_a_repair_leaves_no_incomplete_file(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)))
    run.file.write_bytes(run.file.read_bytes()[:-1000])
    files = sorted(run.folder.iterdir())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # a write beyond this size fails, as on a full disk
    try:
        with pytest.raises(OSError, match="too large") as error:
            repair(run.folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.filename == f"{run.file}.partial" and sorted(run.folder.iterdir()) == files


def test_a_change_of_files_on_a_full_disk_is_undone_and_done_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = RunWriter(tmp_path / "run", RunHeader(dump_scene(load_scene(scene_path("paper")))), 50_000, 0)
    writer.write_entry(0, 0, paper_sample(0))
    writer.flush()
    write, writes = UnbufferedFile.write, 0

    def write_or_fail(file: UnbufferedFile, data: bytes) -> None:
        nonlocal left
        left -= 1
        write(file, data if left >= 0 else data[: len(data) // 2])
        if left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(UnbufferedFile, "write", write_or_fail)
    while len(os.listdir(tmp_path / "run")) == 1:  # the disk becomes full at each write of the change in turn
        left, writes = writes, writes + 1
        with suppress(OSError):
            writer.split({})
    left = 100
    writer.close({})
    assert writes == 9 and examine(tmp_path / "run").problems == []
    assert listed_parts(tmp_path / "run") == ["run_0.mcap", "run_1.mcap"]


def test_a_full_disk_ends_the_writing_of_a_replay_with_a_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), frame_every=10**9, pause_every=0)
    before, full = run.file.read_bytes(), tmp_path / "full"
    # this run puts the kernels into the cache before the size of files is limited
    assert cli(["replay", str(run.folder), "--write", str(tmp_path / "whole"), "-q"]) == 0
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        assert cli(["replay", str(run.folder), "--write", str(full), "-q"]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    errors = capsys.readouterr().err
    assert str(full / "full_0.mcap") in errors and "too large" in errors and "Traceback" not in errors
    # the written part is a truncated recording, and the source is unchanged
    assert run.file.read_bytes() == before and (full / "full_0.mcap").stat().st_size <= 200_000
    report = replay(full)
    assert (report.exit_code, report.status, report.divergences) == (3, FileStatus.TRUNCATED, 0)


def test_an_invalid_part_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    run = record_run(
        tmp_path / "run", map(paper_sample, range(COUNT)), part_bytes=200_000, flush_period_s=0.01, chunk_size=50_000
    )
    parts = RunReader(run.folder).parts
    for part in (parts[0], parts[1], parts[-1]):
        good, samples = part.read_bytes(), examine(part).entries[Sample.__name__]
        part.write_bytes(b"\0" * len(good))
        report, after = examine(run.folder), replay(run.folder)
        assert f"{part.name}: not an MCAP file: it cannot be read" in report.problems
        assert report.entries[Sample.__name__] == after.samples == COUNT - samples
        assert (after.exit_code, after.divergences) == (3, 0) and after.status is FileStatus.DAMAGED
        part.write_bytes(good)
    parts[1].write_bytes(b"no recording")
    assert repair(run.folder) == [parts[1]] and (run.folder / f"{parts[1].name}.damaged").exists()
    assert replay(run.folder).divergences == 0


def test_a_decimated_recording_keeps_every_peak(tmp_path: Path) -> None:
    scene = load_scene(scene_path("paper"))
    recorder = Recorder(tmp_path / "run", RunHeader(dump_scene(scene), record_outputs="decimated"))
    session = Session(Twin(scene, excitation="sampled"), on_entry=recorder.journal)
    session.start()
    decimation, sent, kept = Decimation("decimated", 20.0), [], []
    for index in range(COUNT):
        session.apply(paper_sample(index))
        publication = session.outputs.pop()
        assert len(publication.rows)
        sent.append(publication)
        selected = decimation.select(publication)
        if selected is not None:
            kept.append(selected)
            recorder.publication(selected)
    session.close()
    assert recorder.close().complete and len(kept) == COUNT // 50
    peaks = Published.joined(sent).rows["peak"].max(axis=0)
    np.testing.assert_array_equal(Published.joined(kept).rows["peak"].max(axis=0), peaks)
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.compared["contact_forces"]) == (0, len(kept))
    assert report.not_compared["contact_peaks"] == len(kept)
    assert Decimation("none", 20.0).select(sent[0]) is None and Decimation("all", 20.0).select(sent[0]) is sent[0]


@pytest.mark.parametrize("which", [0, 1, -1])
def test_a_missing_part_is_counted_and_the_load_has_a_gap_there(which: int, tmp_path: Path) -> None:
    run = record_run(
        tmp_path / "run", map(paper_sample, range(COUNT)), part_bytes=200_000, flush_period_s=0.01, chunk_size=50_000
    )
    whole = analyse(run.folder)
    assert not whole.lossy and not read_recording(run.folder)[1]
    RunReader(run.folder).parts[which].unlink()
    for listing in (True, False):  # without a listing, the numbers of the parts show only a missing part in the middle
        report, analysis, (facts, lossy) = replay(run.folder), analyse(run.folder), read_recording(run.folder)
        problems = examine(run.folder).problems
        if listing or which == 1:
            assert (
                report.lost["missing_parts"] == analysis.losses["missing_parts"] == facts["lost"]["missing_parts"] == 1
            )
            assert report.exit_code == 3 and analysis.lossy and lossy
            assert (
                sum("is missing: meta" in problem or "as the part numbers show" in problem for problem in problems) == 1
            )
        (run.folder / "metadata.yaml").unlink(missing_ok=True)
    assert analysis.input["samples_used"] == report.samples < COUNT
    times = np.diff(analysis.predictions[0].series()[0])
    assert times.max() == 1_000_000  # no row is missing among the remaining rows
    assert analysis.predictions[0].loads.duration_s < whole.predictions[0].loads.duration_s


def test_parts_removed_during_reading_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `record_keep_mb`, the oldest parts are removed, possibly before a slow reader has read them."""
    # the batches are so small that the reader reads the parts one by one
    monkeypatch.setattr("plow_twin.record.reader._LEAST", 1)
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)), **SMALL)
    (run.folder / "metadata.yaml").unlink()  # without metadata.yaml, the run seems to be in progress
    parts = RunReader(run.folder).parts
    assert len(parts) >= 4
    reader = RunReader(run.folder)
    parts[0].unlink()
    records = iter(records_of(reader))
    first = next(records)
    parts[1].unlink()  # the reader has already opened this part, so it reads the part to its end
    parts[2].unlink()
    assert isinstance(first.entry, Snapshot)  # type: ignore[union-attr]
    assert len(list(records)) < sum(reader.counts.values()) < COUNT * 4
    assert reader.status is FileStatus.COMPLETE and reader.lost_parts == {"missing_parts": 1}
    assert reader.parts == [parts[1], *parts[3:]]


def test_estimate_and_forecast_report_missing_parts_and_rows_beyond_the_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = (Pose(paper_sample(index).stamp_ns, (0.0, 0.0, 0.0)) for index in range(COUNT))
    entries = (entry for pair in zip(map(paper_sample, range(COUNT)), poses, strict=True) for entry in pair)
    run = record_run(tmp_path / "run", entries, frame_every=10**9, wear=Wear(1e-14, 0.015, 2.0), **SMALL)
    forecast = ["forecast", str(run.folder), "--limit-horizontal", "40", "--limit-vertical", "45", "--json"]
    whole = read_measured(run.folder)
    assert whole.lost == {} and cli(forecast) == 0
    with monkeypatch.context() as patched:
        patched.setattr(measured, "MOST_ROWS", 100)
        newest = read_measured(run.folder)
    assert newest.lost == {"older_rows": 2 * (COUNT - 100)} and len(newest.poses) == 100
    np.testing.assert_array_equal(newest.load[:, 1:], whole.load[-100:, 1:])
    RunReader(run.folder).parts[1].unlink()
    recording = read_measured(run.folder)
    assert recording.lost["missing_parts"] == 1 and recording.unreadable == sum(recording.lost.values())
    capsys.readouterr()
    assert cli(forecast) == 3
    printed = capsys.readouterr()
    assert json.loads(printed.out)["lost"] == {"missing_parts": 1} and "there may be a newer estimate" in printed.err
    (empty := tmp_path / "empty").mkdir()
    assert cli(["forecast", str(empty), *forecast[2:]]) == 1 and "got no .mcap file" in capsys.readouterr().err


def test_an_estimate_does_not_interpolate_the_load_over_a_damaged_chunk(tmp_path: Path) -> None:
    """The gap is detected although it is shorter than half a second, the shortest silence."""
    poses = [Pose(paper_sample(index).stamp_ns, (0.0, 0.0, 0.0)) for index in range(0, COUNT, 10)]
    entries = [entry for index in range(COUNT) for entry in (paper_sample(index), *poses[index : index + 1])]
    run = record_run(tmp_path / "run", entries, frame_every=10**9, flush_period_s=0.01)
    assert len(read_measured(run.folder).load) == COUNT
    spans = chunk_spans(run.file, journal=True)
    start, length = spans[len(spans) // 3]
    data = bytearray(run.file.read_bytes())
    data[start + length // 2] ^= 0xFF
    run.file.write_bytes(data)
    measured = read_measured(run.folder)
    apart = np.diff(measured.load[:, 0])
    assert apart.max() == pytest.approx(1e-3, abs=1e-6) and measured.lost["damaged_chunks"] == 1
    kept, aside = len(measured.load), measured.lost["samples_of_other_stretches"]
    assert kept > COUNT // 2 and 0 < aside < COUNT - kept and 0.02 < 1e-3 * (COUNT - kept - aside) < 0.5
    assert measured.load[0, 0] > 0.0  # times are counted from the first sample of the whole recording


def test_a_missing_part_of_a_foreign_recording_is_counted(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(10)))
    listing = run.folder / "metadata.yaml"
    text = listing.read_text()
    assert open_source(run.folder).losses.counts == {}
    listing.write_text(re.sub(r"( *)- run_0.mcap\n", r"\1- run_0.mcap\n\1- run_1.mcap\n", text))
    assert open_source(run.folder).losses.counts == {"missing_parts": 1}


def test_a_recording_without_comparable_content_is_not_called_equal(tmp_path: Path) -> None:
    Recorder(tmp_path / "run", RunHeader(dump_scene(load_scene(scene_path("paper"))))).close()
    report = replay(tmp_path / "run")
    assert (report.entries, report.nothing, report.exit_code) == (0, True, 3)
