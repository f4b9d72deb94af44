"""The recorded file: read by other programs, truncated and damaged at any place, with exact entries."""

from __future__ import annotations

import ast
import math
import random
import re
import runpy
import struct
import subprocess
import sys
from collections import Counter
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import setuptools
import yaml
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from record_support import BASE_NS, Run, chunk_spans, paper_entries, record_run, records_of, rewrite
from rosbags.highlevel import AnyReader

from plow_twin.errors import RecordingError
from plow_twin.record.cdr import decode, encode, typestore
from plow_twin.record.compression import decompress
from plow_twin.record.entries import EntryRecord, OutputRecord
from plow_twin.record.header import RunHeader
from plow_twin.record.journal_codec import Dropped, from_message, read_digests, to_message
from plow_twin.record.messages import Integers, JointState, Odometry, Text, WrenchStamped
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.replay import replay
from plow_twin.stream.journal import (
    Digest,
    Entry,
    Hold,
    Loss,
    Parameter,
    Reset,
    Sample,
    Snapshot,
    Travel,
    Unused,
)

JOURNAL = {Sample: "samples", Digest: "digests"}
# a journal stores integers in 64 bits
whole = st.integers(-(2**63), 2**63 - 1)
counts = st.integers(1, 2**63 - 1)
stamps = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9)
numbers = st.floats(allow_nan=False, allow_infinity=False)
entries = st.one_of(
    st.builds(Sample, stamps, st.tuples(numbers, numbers, numbers)),
    st.builds(Hold, stamps),
    st.builds(Travel, stamps, numbers),
    st.builds(Reset, stamps, st.text()),
    st.builds(Parameter, st.text(), st.one_of(st.booleans(), whole, numbers, st.text())),
    st.builds(Snapshot, stamps, st.binary()),
    st.builds(Digest, stamps, st.text("0123456789abcdef", min_size=16, max_size=16)),
    st.builds(Loss, counts),
    st.builds(
        Unused,
        st.text(),
        st.text(),
        st.text(),
        whole,
        st.lists(stamps).map(tuple),
        st.lists(st.lists(st.floats(allow_subnormal=True).map(lambda number: number or 0.0)).map(tuple)).map(tuple),
    ),
    st.builds(Dropped, st.text(), counts),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_run(tmp_path_factory.mktemp("runs") / "paper", paper_entries(1500))


@given(entries)
def test_every_entry_comes_back_exactly(entry: Entry | Dropped) -> None:
    message = to_message(entry, "slide_frame")
    again = from_message(decode(encode(message), message.TYPE))
    # repr distinguishes -0.0 from 0.0, and 1 from 1.0 and True; == does not
    assert repr(again) == repr(entry)


@given(st.lists(numbers, min_size=3, max_size=3), stamps)
def test_equal_messages_have_equal_bytes(values: list[float], stamp_ns: int) -> None:
    def build() -> list[bytes]:
        three = (values[0], values[1], values[2])
        state = JointState(stamp_ns, "é", ("a", "bb", "ccc"), velocity=np.array(values))
        pose = Odometry(stamp_ns, "", "head", three, (0.0, 0.0, 0.6, 0.8), three, three)
        return [encode(state), encode(pose), encode(WrenchStamped(stamp_ns, "f", three, three))]

    assert build() == build()


def test_journal_keeps_order_of_use_in_one_counter(run: Run) -> None:
    reader = RunReader(run.folder)
    records = list(records_of(reader))
    journal = [record for record in records if isinstance(record, EntryRecord)]
    assert [record.sequence for record in journal] == list(range(len(journal)))
    assert [record.entry for record in journal] == run.entries
    outputs = [record for record in records if isinstance(record, OutputRecord)]
    assert [(record.topic, record.data) for record in outputs] == [(t, encode(m)) for t, m in run.outputs]
    assert reader.status is FileStatus.COMPLETE
    assert reader.counts.total() == len(records)
    assert run.loss.complete


def test_rosbags_reads_the_folder(run: Run) -> None:
    sent = [message for topic, message in run.outputs if topic == "/contact_forces"]
    with AnyReader([run.folder]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == Counter(
            [topic for topic, _ in run.outputs]
            + [f"/plow_twin/journal/{JOURNAL.get(type(e), 'entries')}" for e in run.entries]
        )
        chosen = [c for c in reader.connections if c.topic == "/contact_forces"]
        received = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen)]
    assert len(received) == len(sent)
    for theirs, ours in zip(received, sent, strict=True):
        assert isinstance(ours, JointState)
        assert theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec == ours.stamp_ns
        assert tuple(theirs.name) == ours.name
        np.testing.assert_array_equal(theirs.effort, ours.effort)
        np.testing.assert_array_equal(theirs.position, ours.position)


def test_mcap_reader_finds_ros2_conventions(run: Run) -> None:
    with run.file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == len(run.entries) + len(run.outputs)
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
            (offered,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
            assert offered["reliability"] == "reliable"
            if "/journal/" not in channel.topic:
                assert (offered["depth"], offered["durability"]) == (1000, "volatile")
        previous = 0
        for _, _, message in reader.iter_messages():
            assert message.log_time >= previous
            assert message.publish_time in (0, message.log_time) or message.publish_time >= BASE_NS
            previous = message.log_time


def test_metadata_yaml_agrees_with_rosbag2(run: Run) -> None:
    bag = yaml.safe_load((run.folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (bag["version"], bag["storage_identifier"], bag["ros_distro"]) == (9, "mcap", "jazzy")
    assert bag["relative_file_paths"] == [run.file.name] == [file["path"] for file in bag["files"]]
    assert bag["message_count"] == len(run.entries) + len(run.outputs)
    assert bag["duration"]["nanoseconds"] > 0


def test_rerun_checks_the_file(run: Run) -> None:
    command = [str(Path(sys.executable).with_name("rerun")), "mcap", "check", str(run.file)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_a_truncated_file_is_read_up_to_its_end(run: Run, tmp_path: Path) -> None:
    data = run.file.read_bytes()
    whole = list(records_of(run.file))
    rng = random.Random(1)
    first_chunk = chunk_spans(run.file)[0][0]
    cuts = {*rng.sample(range(first_chunk, len(data)), 60), *range(len(data) - 40, len(data) - 8)}
    cut_file = tmp_path / "cut.mcap"
    for cut in sorted(cuts):
        cut_file.write_bytes(data[:cut])
        reader = RunReader(cut_file)
        records = list(records_of(reader))
        # journal and outputs are in separate chunks, so a truncated file contains the first records of each
        for kind in (EntryRecord, OutputRecord):
            chosen = [record for record in records if isinstance(record, kind)]
            assert chosen == [record for record in whole if isinstance(record, kind)][: len(chosen)]
        assert reader.status is FileStatus.TRUNCATED, cut
        assert reader.lost == {} and reader.damaged_chunks == 0


def test_a_damaged_byte_loses_one_chunk_and_is_reported(run: Run, tmp_path: Path) -> None:
    data = bytearray(run.file.read_bytes())
    whole = list(records_of(run.file))
    spans = chunk_spans(run.file)
    rng = random.Random(2)
    for start, length in (spans[0], spans[len(spans) // 2], spans[-1]):
        place = start + rng.randrange(length)
        data[place] ^= 0x40
        file = tmp_path / "damaged.mcap"
        file.write_bytes(data)
        data[place] ^= 0x40
        reader = RunReader(file)
        records = list(records_of(reader))
        assert (reader.damaged_chunks, reader.status) == (1, FileStatus.DAMAGED)
        rest = iter(whole)
        assert 0 < len(records) < len(whole)
        assert all(record in rest for record in records)  # the records are in order, and there are no others


def write_large(source: Path, target: Path, images: int, image_size: int, attachments: int) -> None:
    """Copy a recording, and add messages of a camera and large attachments, whose bytes are holes in a sparse file."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    data = source.read_bytes()
    head = 8
    for _ in range(2):  # skip the header of the file and the header of the run
        head += 9 + struct.unpack_from("<Q", data, head + 1)[0]
    schema = struct.pack("<H", 60_000) + text("sensor_msgs/msg/Image") + text("ros2msg") + text("uint8[] data")
    channel = struct.pack("<HH", 60_000, 60_000) + text("/camera") + text("cdr") + struct.pack("<I", 0)
    with target.open("wb") as out:
        out.write(data[:head])
        for opcode, record in ((3, schema), (4, channel)):
            out.write(struct.pack("<BQ", opcode, len(record)) + record)
        for _ in range(attachments):
            out.write(struct.pack("<BQ", 9, 300_000_000))
            out.seek(300_000_000, 1)
        for _ in range(images):
            size = 31 + image_size
            out.write(struct.pack("<BQQQQIIQ", 6, 40 + size, 0, 0, size, 0, 0, size))
            out.write(struct.pack("<BQHIQQ", 5, 22 + image_size, 60_000, 0, 0, 0))
            out.seek(image_size, 1)
        out.write(data[head:])


def check_large(run: Run, folder: Path, images: int, image_size: int, attachments: int) -> int:
    """Replay such a recording in a separate process. Return the peak memory of the process [B]."""
    file = folder / "large.mcap"
    write_large(run.file, file, images, image_size, attachments)
    code = (
        "import resource, sys; from pathlib import Path; from plow_twin.record.replay import replay\n"
        "report = replay(Path(sys.argv[1]))\n"
        "most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(report.exit_code, report.messages_compared, 1024 * most)"
    )
    completed = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed.stderr
    code_, compared, most = map(int, completed.stdout.split())
    assert (code_, compared) == (0, replay(run.folder).messages_compared)
    return most


def test_attachments_and_other_topics_of_any_size_are_skipped(run: Run, tmp_path: Path) -> None:
    check_large(run, tmp_path, images=2, image_size=1_000_000, attachments=1)


@pytest.mark.stress
def test_ten_gigabytes_are_read_in_bounded_memory(run: Run, tmp_path: Path) -> None:
    small = check_large(run, tmp_path, images=0, image_size=0, attachments=0)
    large = check_large(run, tmp_path, images=70, image_size=60_000_000, attachments=20)
    assert (tmp_path / "large.mcap").stat().st_size > 10_000_000_000
    assert large - small < 5 * 60_000_000


def test_a_file_that_another_program_rewrote_is_a_run(run: Run, tmp_path: Path) -> None:
    """The header of the run is behind the chunks. It is found even if the file has no index at its end."""
    file = rewrite(run.file, tmp_path / "anew.mcap", metadata_last=True)
    report = replay(file)
    assert (report.exit_code, report.messages_compared) == (0, replay(run.file).messages_compared)
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    last = summary.metadata_indexes[-1]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: last.offset + last.length])
    assert replay(cut).status is FileStatus.TRUNCATED


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "empty: its recorder was killed"),
        (b"something else entirely", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "truncated before its first message"),
        (None, "no such recording"),
    ],
)
def test_a_file_without_a_recording_is_named(content: bytes | None, expected: str, tmp_path: Path) -> None:
    file = tmp_path / "notes.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(RecordingError, match=expected) as error:
        RunReader(file)
    assert str(file) in str(error.value)


def test_the_documentation_lists_every_key_of_header_and_journal() -> None:
    text = (Path(__file__).resolve().parent.parent / "docs" / "recording.md").read_text()
    keys = {"layout_version", *(spec.name for spec in fields(RunHeader))}
    for kind in (Hold, Travel, Reset, Parameter, Snapshot, Digest, Loss, Dropped):
        keys |= {kind.__name__.lower(), *(spec.name for spec in fields(kind))}
    assert {key for key in keys if f"`{key}`" not in text} == set()


def test_the_extra_brings_every_library_that_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).resolve().parent.parent
    imported: set[str] = set()
    for path in (root / "plow_twin" / "record").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.partition(".")[0])
    monkeypatch.chdir(root)
    declared: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", declared.update)
    runpy.run_path("setup.py")
    requirements = [*declared["install_requires"], *declared["extras_require"]["record"]]
    names = {re.split("[^A-Za-z0-9_-]", requirement.replace("PyYAML", "yaml"))[0] for requirement in requirements}
    names.add("llvmlite")  # numba requires llvmlite at a fixed version, so it need not be declared
    # these libraries are used only if they are installed, so they need not be declared
    names |= {"pandas", "pyarrow"}
    assert imported - names - sys.stdlib_module_names - {"plow_twin"} == set()


def test_a_sample_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    message = WrenchStamped(BASE_NS, "slide_frame", (math.nan, 0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(RecordingError, match=r"got \(nan, 0.0, 0.0\), expected finite"):
        from_message(message)


@given(st.lists(st.tuples(stamps, st.integers(0, 2**64 - 1)), max_size=5))
def test_many_digests_read_together_equal_digests_read_one_by_one(given_digests: list[tuple[int, int]]) -> None:
    messages = [to_message(Digest(stamp_ns, f"{digest:016x}"), "") for stamp_ns, digest in given_digests]
    data = [encode(message) for message in messages]
    lengths = np.array([len(part) for part in data], np.int64)
    buffer = np.frombuffer(b"".join(data), np.uint8)
    found, stamp_ns, digests = read_digests(buffer, np.cumsum(lengths) - lengths, lengths)
    assert found.all()
    assert list(zip(stamp_ns.tolist(), digests.tolist(), strict=True)) == given_digests
    assert all(type(message).TYPE == "std_msgs/msg/UInt64MultiArray" for message in messages)


def test_a_digest_with_a_flipped_bit_is_another_digest_or_an_error() -> None:
    whole = encode(to_message(Digest(BASE_NS, "0123456789abcdef"), ""))
    for place in range(len(whole)):
        data = bytearray(whole)
        data[place] ^= 1
        digests, _, _ = read_digests(np.frombuffer(data, np.uint8), np.zeros(1, np.int64), np.array([len(data)]))
        assert digests[0] == (place >= len(whole) - 16)
    nothing = read_digests(np.frombuffer(whole, np.uint8), np.array([1, -1, 2**40]), np.full(3, len(whole)))
    assert not nothing[0].any()
    with pytest.raises(RecordingError, match="got 3 integers, expected the two of a digest"):
        from_message(Integers((1, 2, 3)))


@given(st.text())
def test_a_string_has_the_bytes_that_rosbags_gives_it(text: str) -> None:
    types = typestore()
    assert encode(Text(text)) == bytes(types.serialize_cdr(types.types[Text.TYPE](text), Text.TYPE))


def test_frames_of_lz4_of_every_kind_are_read() -> None:
    noise = np.random.default_rng(5).bytes(70_000)
    contents = (b"", b"x", bytes(range(256)) * 1000, noise, 3 * (noise[:9000] + bytes(90_000)))
    for content, linked, checksum, size in product(contents, (False, True), (False, True), (False, True)):
        frame = lz4.frame.compress(content, block_linked=linked, content_checksum=checksum, store_size=size)
        assert bytes(decompress("lz4", memoryview(frame), len(content))) == content
