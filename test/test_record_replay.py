"""Replay: the same run gives bit-identical results, and any change of a recording is located."""

from __future__ import annotations

import json
import struct
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from record_support import (
    BASE_NS,
    PAPER_AMPLITUDE,
    STEP_NS,
    Run,
    chunk_spans,
    paper_entries,
    paper_sample,
    record_run,
    records_of,
    rewrite,
)

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import decode, encode
from plow_twin.record.entries import OutputRecord
from plow_twin.record.header import HEADER_RECORD
from plow_twin.record.messages import JointState, WrenchStamped
from plow_twin.record.outputs import FOLLOWED_TOPICS, PUBLICATION_TOPICS
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.solve.state import ROW
from plow_twin.stream.journal import Digest, Sample
from plow_twin.stream.session import Session

COUNT = 2500
SAMPLES = "/plow_twin/journal/samples"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a run of 2.5 s under the paper's load: samples only, each followed by outputs."""
    return record_run(tmp_path_factory.mktemp("runs") / "paper", map(paper_sample, range(COUNT)))


def flip_sample(index: int, bit: int) -> Any:
    """Return a function that flips one bit of Fx in the sample with a given index."""

    def change(topic: str, message: Any) -> bytes | None:
        if topic != SAMPLES or message.publish_time != BASE_NS + index * STEP_NS:
            return None
        wrench = decode(message.data, WrenchStamped.TYPE)
        assert isinstance(wrench, WrenchStamped)
        place = message.data.index(struct.pack("<d", wrench.force[0]))
        data = bytearray(message.data)
        data[place + bit // 8] ^= 1 << bit % 8
        return bytes(data)

    return change


@pytest.mark.parametrize("frame_every", [1, 7])
def test_the_same_build_gives_the_same_bits(frame_every: int, tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", paper_entries(COUNT), frame_every=frame_every)
    shares: list[float] = []
    report = replay(run.folder, shares.append)
    assert (report.exit_code, report.first_divergence, report.divergences) == (0, None, 0)
    assert report.status is FileStatus.COMPLETE and not report.loss and not report.build_differences
    sent = Counter(topic.lstrip("/") for topic, _ in run.outputs)
    assert (
        report.compared == sent
        and set(sent) == set(PUBLICATION_TOPICS) - set(FOLLOWED_TOPICS)
        and not report.not_compared
    )
    assert report.digests_compared == sum(isinstance(entry, Digest) for entry in run.entries) >= COUNT // 100
    assert report.entries == len(run.entries)
    assert (report.samples, report.steps) == (COUNT, COUNT + 1)
    assert shares == sorted(shares) and shares[-1] == 1.0
    # the comparison is meaningful, because contacts occur
    assert max(m.effort.max() for _, m in run.outputs if isinstance(m, JointState) and m.effort.size) > 1e4


@pytest.mark.parametrize("index", [1, 700, COUNT - 2])
def test_a_flipped_sample_diverges_at_its_step(index: int, run: Run, tmp_path: Path) -> None:
    changed = rewrite(run.file, tmp_path / "changed.mcap", flip_sample(index, 51))
    report = replay(changed)
    assert report.exit_code == 1 and report.first_divergence is not None
    assert report.first_divergence.step == index
    assert report.first_divergence.stamp_ns == BASE_NS + index * STEP_NS
    assert report.first_divergence.topic in PUBLICATION_TOPICS
    assert report.first_divergence.recorded != report.first_divergence.computed


def test_the_last_bit_of_a_sample_is_found_by_the_next_digest(run: Run, tmp_path: Path) -> None:
    report = replay(rewrite(run.file, tmp_path / "changed.mcap", flip_sample(1234, 0)))
    assert report.exit_code == 1 and report.first_divergence is not None
    assert 1234 <= report.first_divergence.step < 1300


def test_a_changed_output_is_found_and_does_not_affect_the_others(run: Run, tmp_path: Path) -> None:
    index = 1111

    def change(topic: str, message: Any) -> bytes | None:
        if topic != "/contact_forces" or message.publish_time != BASE_NS + index * STEP_NS:
            return None
        state = decode(message.data, JointState.TYPE)
        assert isinstance(state, JointState)
        effort = state.effort.copy()
        effort[3] += 1.0
        return encode(JointState(state.stamp_ns, state.frame_id, state.name, state.position, state.velocity, effort))

    report = replay(rewrite(run.file, tmp_path / "changed.mcap", change))
    assert report.exit_code == 1 and report.divergences == 1 and report.first_divergence is not None
    divergence = report.first_divergence
    assert (divergence.step, divergence.topic, divergence.field) == (index, "contact_forces", "effort[3]")
    assert float(divergence.recorded) == float(divergence.computed) + 1.0


def test_a_flipped_bit_anywhere_in_an_output_is_found(run: Run, tmp_path: Path) -> None:
    places = {
        ("/contact_forces", 300): 0,
        ("/contact_peaks", 600): -1,
        ("/head_state", 900): 200,
        ("/clearance", 1000): 60,
        ("/wear_rate", 1000): 311,
    }

    def change(topic: str, message: Any) -> bytes | None:
        place = places.get((topic, (message.publish_time - BASE_NS) // STEP_NS))
        if place is None:
            return None
        data = bytearray(message.data)
        data[place] ^= 4
        return bytes(data)

    report = replay(rewrite(run.file, tmp_path / "changed.mcap", change))
    assert (report.exit_code, report.divergences, report.compared["clearance"]) == (1, len(places), 25)
    assert report.first_divergence is not None
    assert (report.first_divergence.step, report.first_divergence.topic) == (300, "contact_forces")


def test_outputs_in_another_order_are_compared(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "turned.mcap"
    with run.file.open("rb") as stream, file.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out, chunk_size=64 * 1024)
        writer.start(profile="ros2", library="test")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, dict(record.metadata))
        messages = list(reader.iter_messages(log_time_order=False))
        journal = [found for found in messages if "/journal/" in found[1].topic]
        outputs = [found for found in messages if "/journal/" not in found[1].topic]
        numbers: dict[str, int] = {}
        for schema, channel, message in [*journal, *reversed(outputs)]:
            if channel.topic not in numbers:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(numbers[channel.topic], *times)
        writer.finish()
    report = replay(file)
    assert (report.exit_code, report.messages_compared) == (0, replay(run.folder).messages_compared)


def test_a_missing_sample_diverges(run: Run, tmp_path: Path) -> None:
    """A sample has the stamp of the previous sample, so the model cannot reach the recorded messages."""

    def change(topic: str, message: Any) -> bytes | None:
        if topic != SAMPLES or message.publish_time != BASE_NS + 900 * STEP_NS:
            return None
        wrench = decode(message.data, WrenchStamped.TYPE)
        assert isinstance(wrench, WrenchStamped)
        return encode(WrenchStamped(wrench.stamp_ns - STEP_NS, wrench.frame_id, wrench.force, wrench.torque))

    report = replay(rewrite(run.file, tmp_path / "changed.mcap", change))
    assert report.first_divergence is not None and report.first_divergence.step == 900


def test_a_truncated_file_is_replayed_up_to_its_end(run: Run, tmp_path: Path) -> None:
    data = run.file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    report = replay(cut)
    assert (report.exit_code, report.status, report.divergences) == (3, FileStatus.TRUNCATED, 0)
    assert 0 < report.samples < COUNT and report.messages_compared > 0


def test_after_a_damaged_chunk_nothing_is_compared(run: Run, tmp_path: Path) -> None:
    spans = chunk_spans(run.file)
    lost_entries = lost_messages = False
    for start, length in spans:  # the chunks of the journal and of the outputs
        data = bytearray(run.file.read_bytes())
        middle = start + length // 2
        # several bytes are changed, because a single flipped bit in compressed data may have no effect
        data[middle : middle + 8] = bytes(byte ^ 0xFF for byte in data[middle : middle + 8])
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data)
        report = replay(damaged)
        assert (report.exit_code, report.status, report.divergences) == (3, FileStatus.DAMAGED, 0)
        lost_entries |= report.lost.get("journal, unaccounted", 0) > 0
        lost_messages |= sum(report.not_compared.values()) > 0 and report.messages_compared > 0
    assert lost_entries and lost_messages


def test_replay_continues_from_the_snapshot_after_a_loss(tmp_path: Path) -> None:
    def rush_then_walk() -> Iterator[Sample]:
        for index in range(COUNT):
            if index > COUNT // 2 and index % 10 == 0:
                time.sleep(0.03)  # in the pause, the queue is emptied, so the recording is complete from here on
            yield paper_sample(index)

    run = record_run(tmp_path / "run", rush_then_walk(), queue_size=150, pause_every=0)
    assert run.loss.closed and run.loss.lost["journal"] > 0
    report = replay(run.folder)
    assert (report.exit_code, report.divergences) == (3, 0)
    assert report.lost == dict(run.loss.lost)
    last = max(m.stamp_ns for _, m in run.outputs if isinstance(m, JointState))
    reader = RunReader(run.folder)
    kept = [record.entry for record in records_of(reader) if hasattr(record, "entry")]
    assert report.samples == sum(isinstance(entry, Sample) for entry in kept) < COUNT
    assert report.span_s > 0 and last == BASE_NS + (COUNT - 1) * STEP_NS
    assert report.messages_compared > 0 and report.digests_compared > 0


def test_another_build_is_named(run: Run, tmp_path: Path) -> None:
    def metadata(record: dict[str, str]) -> dict[str, str]:
        if "build" in record:
            record["build"] = json.dumps({**json.loads(record["build"]), "numba": "0.1.0"})
        return record

    report = replay(rewrite(run.file, tmp_path / "other.mcap", metadata=metadata))
    assert list(report.build_differences) == ["numba"] and report.build_differences["numba"][0] == "0.1.0"
    assert report.exit_code == 0


def test_a_damaged_scene_in_a_file_is_named_with_its_key(run: Run, tmp_path: Path) -> None:
    def metadata(record: dict[str, str]) -> dict[str, str]:
        return {key: text.replace("mass_kg", "mbss_kg") for key, text in record.items()}

    damaged = rewrite(run.file, tmp_path / "damaged.mcap", metadata=metadata)
    with pytest.raises(RecordingError, match=r"scene in .*damaged\.mcap(.|\n)*mass_kg"):
        replay(damaged)


def test_a_header_without_a_key_is_refused(run: Run, tmp_path: Path) -> None:
    def metadata(record: dict[str, str]) -> dict[str, str]:
        record.pop("tol", None)
        return record

    with pytest.raises(RecordingError, match=f"metadata '{HEADER_RECORD}': tol is missing"):
        replay(rewrite(run.file, tmp_path / "other.mcap", metadata=metadata))


def test_a_full_recording_is_computed_from_the_journal_alone(tmp_path: Path) -> None:
    bare = record_run(tmp_path / "bare", paper_entries(COUNT), frame_every=10**9)
    full = record_run(tmp_path / "full", paper_entries(COUNT))
    report = replay(bare.folder, write=tmp_path / "made")
    assert (report.exit_code, report.divergences) == (0, 0)
    made = [(r.topic, r.data) for r in records_of(tmp_path / "made") if isinstance(r, OutputRecord)]
    assert made == [(r.topic, r.data) for r in records_of(full.folder) if isinstance(r, OutputRecord)]
    again = replay(tmp_path / "made")
    assert (again.exit_code, again.compared["contact_forces"]) == (0, COUNT + 1)


def test_only_digests_are_compared_without_reading_the_outputs(run: Run, tmp_path: Path) -> None:
    data = bytearray(run.file.read_bytes())
    for start, length in chunk_spans(run.file, journal=False):
        data[start + length // 2] ^= 0xFF  # only chunks of outputs are damaged, and outputs are not read here
    file = tmp_path / "damaged.mcap"
    file.write_bytes(data)
    report = replay(file, digests_only=True)
    assert (report.exit_code, report.digests_compared, report.messages_compared) == (0, COUNT // 100 + 1, 0)
    changed = replay(rewrite(run.file, tmp_path / "changed.mcap", flip_sample(1234, 0)), digests_only=True)
    assert changed.exit_code == 1 and changed.first_divergence is not None
    assert 1234 <= changed.first_divergence.step < 1300


def test_digests_do_not_break_a_run_of_samples(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    advance = Session.advance

    def counted(session: Session, stamps: Any, *rest: Any, **options: Any) -> Any:
        calls.append(len(stamps))
        return advance(session, stamps, *rest, **options)

    monkeypatch.setattr(Session, "advance", counted)
    assert replay(run.folder).exit_code == 0
    # a digest follows every hundred samples, but the calls process thousands of samples after the first call
    assert sum(calls) == COUNT + 2 and len(calls) <= 4


def test_without_rows_the_motion_is_the_same_and_nothing_is_counted() -> None:
    scene = load_scene(scene_path("paper"))
    times, marks = 1e-3 * np.arange(COUNT), np.array([1, 700, COUNT])
    wrench = np.sin(2.0 * times)[:, None] * np.array(PAPER_AMPLITUDE)
    digests, in_contact = [], []
    for rows in (np.zeros(COUNT, ROW), None):
        twin = Twin(scene, excitation="sampled")
        digests.append(twin.advance_rows(times, wrench, rows, marks).digests)
        in_contact.append(float(twin._all_totals["set_time"].sum()))
    assert digests[0] == digests[1]
    assert in_contact[0] > 1.0 and in_contact[1] == 0.0
