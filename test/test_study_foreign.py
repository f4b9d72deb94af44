"""Files from other programs: truncated, incomplete, exported by a spreadsheet, or in encodings unknown to ROS 2."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from bag_support import MAP, PAPER, STORE, measured, motion, wrench_message, write_bag
from figure_checks import kept_figures
from mcap.writer import Writer
from record_support import BASE_NS, STEP_NS, paper_sample, record_run
from rerun.chunk import RrdReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from plow_twin.cli.app import run as run_cli
from plow_twin.errors import RecordingError
from plow_twin.record.doctor import examine, repair
from plow_twin.record.measured import read_measured, read_recording
from plow_twin.record.reader import FileStatus
from plow_twin.record.replay import replay
from plow_twin.record.sources import open_source
from plow_twin.study.analysis.analyse import Analysis, analyse
from plow_twin.study.analysis.recordings import expand
from plow_twin.study.analysis.report import write_report

COUNT = 300
TYPE = "geometry_msgs/msg/WrenchStamped"


def sqlite_bag(folder: Path) -> Path:
    """Return a bag with the load. Its last third is in the write-ahead log of a killed recorder."""
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/load", TYPE, typestore=STORE)
        for index in range(2 * COUNT // 3):
            time_ns = BASE_NS + index * STEP_NS
            writer.write(connection, time_ns, wrench_message(time_ns, paper_sample(index).wrench))
    file = next(folder.glob("*.db3"))
    live, killed = sqlite3.connect(file), folder / "killed"
    live.execute("PRAGMA journal_mode=WAL")
    for index in range(2 * COUNT // 3, COUNT):
        time_ns = BASE_NS + index * STEP_NS
        data = wrench_message(time_ns, paper_sample(index).wrench)
        live.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (time_ns, data))
    live.commit()
    killed.mkdir()
    for item in folder.glob("*.db3*"):  # the copy is made while the database is open, so it has no clean end
        if not item.name.endswith("-shm"):
            shutil.copy(item, killed)
    live.close()
    return killed


def test_a_bag_without_its_metadata_and_with_an_open_log_is_read_to_its_end(tmp_path: Path) -> None:
    killed = sqlite_bag(tmp_path / "bag")
    assert not (killed / "metadata.yaml").exists() and list(killed.glob("*-wal"))
    times = [arrived.log_time_ns for arrived in open_source(killed).messages(lambda topic: True)]
    assert times == [BASE_NS + index * STEP_NS for index in range(COUNT)]


def test_a_bag_compressed_by_message_is_read_and_a_bag_compressed_as_a_whole_is_named(tmp_path: Path) -> None:
    for mode in (CompressionMode.MESSAGE, CompressionMode.FILE):
        bag = BagWriter(tmp_path / mode.name, version=9, storage_plugin=StoragePlugin.SQLITE3)
        bag.set_compression(mode, CompressionFormat.ZSTD)
        with bag as writer:
            connection = writer.add_connection("/load", TYPE, typestore=STORE)
            for time_ns in (BASE_NS, BASE_NS + STEP_NS):
                writer.write(connection, time_ns, wrench_message(time_ns, paper_sample(1).wrench))
            writer.write(connection, BASE_NS, b"")
    file = next((tmp_path / "MESSAGE").glob("*.db3"))
    live = sqlite3.connect(file)
    live.execute("UPDATE messages SET data = ? WHERE id = 3", (b"\x28\xb5\x2f\xfd damaged",))
    live.commit()
    live.close()
    source = open_source(tmp_path / "MESSAGE")
    forces = [arrived.content.wrench.force.x for arrived in source.messages(lambda topic: True)]
    assert forces == [paper_sample(1).wrench[0]] * 2 and source.losses.counts == {"undecodable": 1}
    for read in (open_source, lambda path: expand([path]), replay):
        with pytest.raises(RecordingError, match=r"FILE\.db3\.zstd is compressed as a whole"):
            read(tmp_path / "FILE")


def mcap(path: Path, encoding: str, schema: tuple[str, str, bytes], messages: list[tuple[int, bytes]]) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema_id = writer.register_schema(*schema) if schema[0] else 0
        channel = writer.register_channel("/load", encoding, schema_id)
        for time_ns, data in messages:
            writer.add_message(channel, max(time_ns, 0) % 2**64, data, max(time_ns, 0) % 2**64)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("encoding", "schema"),
    [
        ("json", (TYPE, "jsonschema", b"{}")),
        ("ros1", ("geometry_msgs/WrenchStamped", "ros1msg", b"Header header\nWrench wrench\n")),
        ("protobuf", ("Wrench", "protobuf", b"\x00\xff\x01")),
        ("cdr", ("", "", b"")),
        ("cdr", ("other_msgs/msg/Thing", "ros2msg", b"")),
        ("cdr", ("other_msgs/msg/Thing", "ros2msg", b"\xff\xfe no text")),
    ],
)
def test_a_recording_without_ros_2_messages_is_refused(
    encoding: str, schema: tuple[str, str, bytes], tmp_path: Path
) -> None:
    file = mcap(tmp_path / "odd.mcap", encoding, schema, [(BASE_NS, json.dumps({"fx": 1.0}).encode())])
    with pytest.raises(RecordingError, match="excitation") as error:
        analyse(file, scene=PAPER)
    assert "/load" in str(error.value)
    source = open_source(file)
    assert not list(source.messages(lambda topic: True))
    assert list(source.losses.unknown_types) == ["/load"]
    assert encoding == "cdr" or encoding in source.losses.unknown_types["/load"]


def test_stamps_of_any_size_are_counted_and_harmless(tmp_path: Path) -> None:
    good = [(BASE_NS + i * STEP_NS, paper_sample(i).wrench) for i in range(COUNT)]
    odd = [0, -(2**31) * 10**9, (2**31 - 1) * 10**9, -1]
    messages = [(time_ns, wrench_message(time_ns, wrench)) for time_ns, wrench in good]
    for place, stamp_ns in enumerate(odd):
        messages.insert(50 * (place + 1), (BASE_NS, wrench_message(stamp_ns, (1e9, 0.0, 0.0))))
    (tmp_path / "map.yaml").write_text(MAP.split("\nhead_pose")[0].replace("1000", "1"))
    schema = STORE.generate_msgdef(TYPE, ros_version=2)[0].encode()
    file = mcap(tmp_path / "odd.mcap", "cdr", (TYPE, "ros2msg", schema), messages)
    analysis = analyse(file, scene=PAPER, mapping=tmp_path / "map.yaml")
    dropped = sum(count for name, count in analysis.input.items() if name.startswith("dropped_"))
    assert analysis.input["samples_in"] == COUNT + len(odd) == analysis.input["samples_used"] + dropped
    assert analysis.input["dropped_stray"] == 1 and "jump_forward" not in analysis.input
    assert analysis.lossy and analysis.predictions[0].loads.largest.max() < 1e6


def sheet(
    path: Path, delimiter: str, comma: bool, mark: bool, header: tuple[str, ...] = ("t", "fx", "fy", "m")
) -> Path:
    lines = [delimiter.join(header)]
    for index in range(COUNT):
        cells = [f"{value:.6f}" for value in (index * 1e-3, *paper_sample(index).wrench)]
        lines.append(delimiter.join(cell.replace(".", ",") if comma else cell for cell in cells[: len(header)]))
    path.write_text("\r\n".join(lines), encoding="utf-8-sig" if mark else "utf-8")
    return path


def test_the_csv_of_a_spreadsheet_gives_the_numbers_of_a_plain_csv(tmp_path: Path) -> None:
    def peaks(analysis: Analysis) -> list[float]:
        assert analysis.input == {"samples_in": COUNT, "samples_used": COUNT}
        return list(analysis.predictions[0].loads.largest)

    plain = peaks(analyse(sheet(tmp_path / "load.csv", ",", comma=False, mark=False), scene=PAPER))
    assert max(plain) > 0.0
    for delimiter in ";\t":
        assert peaks(analyse(sheet(tmp_path / "load.csv", delimiter, comma=True, mark=True), scene=PAPER)) == plain


def test_missing_and_repeated_columns_are_named(tmp_path: Path) -> None:
    twice = sheet(tmp_path / "load.csv", ",", comma=False, mark=True, header=("t", "fx", "fx", "m"))
    with pytest.raises(RecordingError, match="'fx' occurs more than once"):
        analyse(twice, scene=PAPER)
    short = sheet(tmp_path / "load.csv", ",", comma=False, mark=True, header=("t", "fx", "fy"))
    with pytest.raises(RecordingError, match="excitation: got load"):
        analyse(short, scene=PAPER)
    (tmp_path / "map.yaml").write_text("excitation: {topic: load, fields: {fx: fx, fy: fy, m: moment}}")
    with pytest.raises(RecordingError, match="'moment', expected one of the columns t, fx, fy"):
        analyse(short, scene=PAPER, mapping=tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text("excitation: {topic: load, fields: {fx: fx, fy: fy, m: fy}, stamp: when}")
    with pytest.raises(RecordingError, match="stamp: got 'when', expected one of the columns t, fx, fy"):
        analyse(short, scene=PAPER, mapping=tmp_path / "map.yaml")


def test_a_mapping_without_a_field_or_stamp_is_named(tmp_path: Path) -> None:
    """A misspelt `header` must not be read as `header`, and a misspelt field must be named and not only counted."""
    schema = STORE.generate_msgdef(TYPE, ros_version=2)[0].encode()
    times = [BASE_NS + i * STEP_NS for i in range(COUNT)]
    messages = [(time_ns, wrench_message(time_ns, paper_sample(i).wrench)) for i, time_ns in enumerate(times)]
    file, chosen = mcap(tmp_path / "load.mcap", "cdr", (TYPE, "ros2msg", schema), messages), tmp_path / "map.yaml"
    topic = next(iter(open_source(file).topics()))
    chosen.write_text(f"excitation: {{topic: {topic}, stamp: headr}}")
    with pytest.raises(RecordingError, match=f"excitation.stamp: got 'headr', expected header or log for {TYPE}"):
        analyse(file, scene=PAPER, mapping=chosen)
    wrong = "{fx: wrench.force.x, fy: wrench.forc.y, m: wrench.torque.z}"
    chosen.write_text(f"excitation: {{topic: {topic}, fields: {wrong}}}")
    message = f"{topic} has no number at 'wrench.forc.y' for fy"
    with pytest.raises(RecordingError, match=f"malformed {COUNT}; excitation: {message}"):
        analyse(file, scene=PAPER, mapping=chosen)
    chosen.write_text(f"excitation: {{topic: {topic}}}\nhead_pose: {{topic: {topic}, fields: {{x: pose.x}}}}")
    analysis = analyse(file, scene=PAPER, mapping=chosen)
    assert analysis.losses == {f"unfit, head_pose: {topic} has no number at 'pose.x' for x": COUNT}
    with pytest.raises(
        RecordingError, match=f"got no measured pose, expected at least one row; head_pose: {topic} has no number"
    ):
        read_recording(file, Path(PAPER), chosen)


def test_the_estimate_reads_csv_as_the_analysis_does(tmp_path: Path) -> None:
    """A byte order mark must not become part of the name `t`. Semicolons separate columns, and dates are times."""
    scene, names = Path(PAPER), ("t", "x", "y", "theta")
    sheet(tmp_path / "load.csv", ",", comma=False, mark=False)
    sheet(tmp_path / "pose.csv", ",", comma=False, mark=False, header=names)
    plain = read_measured(tmp_path, scene)
    assert len(plain.load) == len(plain.poses) == COUNT
    for delimiter, comma, mark in ((",", False, True), (";", True, True), ("\t", True, False)):
        sheet(tmp_path / "load.csv", delimiter, comma, mark)
        sheet(tmp_path / "pose.csv", delimiter, comma, mark, header=("time", *names[1:]))
        measured = read_measured(tmp_path, scene)
        assert measured.unreadable == 0
        np.testing.assert_array_equal(measured.load, plain.load)
        np.testing.assert_array_equal(measured.poses, plain.poses)
    for name in ("load", "pose"):
        header, *rows = (tmp_path / f"{name}.csv").read_text().replace(",", ".").splitlines()
        dated = [
            f"2026-01-02T03:04:{5 + float(row.split(chr(9))[0]):09.6f}Z\t{row.partition(chr(9))[2]}" for row in rows
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *dated]))
    measured = read_measured(tmp_path, scene)
    np.testing.assert_allclose(measured.load, plain.load, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(measured.poses, plain.poses, rtol=0.0, atol=1e-6)
    (tmp_path / "gaps.csv").write_text("t,left,right\n0,1,2\n")
    with pytest.raises(RecordingError, match="got the columns t, left, right, expected t and some of top_left_top"):
        read_measured(tmp_path, scene)


def test_a_full_disk_is_named_with_the_file_being_written(tmp_path: Path) -> None:
    analysis = analyse(sheet(tmp_path / "load.csv", ",", comma=False, mark=False), scene=PAPER)
    out = tmp_path / "out"
    out.mkdir()
    (out / "analysis.json").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device") as error:
        write_report(analysis, out)
    assert error.value.filename == str(out / "analysis.json")


def test_columns_with_any_name_dates_and_mixed_rows_are_read(tmp_path: Path) -> None:
    lines = ['head;when;"Fx, N";2;"M;Nm";x']
    for index in range(COUNT):
        start = f"A;2026-01-02T03:04:05.{index:03}Z;"
        wrench = ";".join(f"{value:.6f}" for value in paper_sample(index).wrench)
        lines += [f"{start}{wrench};", f"{start};;;0,25"]
    (tmp_path / "all.csv").write_text("\n".join(lines))
    (tmp_path / "map.yaml").write_text(
        "excitation: {topic: all, fields: {fx: 'Fx, N', fy: 2, m: 'M;Nm'}, stamp: when}\n"
        "head_pose: {topic: all, fields: {x: x}, unit: {x: mm}, stamp: when}\n"
    )
    analysis = analyse(tmp_path / "all.csv", scene=PAPER, mapping=tmp_path / "map.yaml")
    plain = analyse(sheet(tmp_path / "load.csv", ",", comma=False, mark=False), scene=PAPER)
    assert analysis.input == plain.input == {"samples_in": COUNT, "samples_used": COUNT} and not analysis.lossy
    np.testing.assert_array_equal(analysis.predictions[0].loads.largest, plain.predictions[0].loads.largest)
    stamps, rows = analysis.measured.signals["x"].series()
    assert (stamps[0], len(stamps), set(rows[:, 0])) == (1_767_323_045_000_000_000, COUNT, {0.25e-3})


def test_an_empty_last_part_of_a_killed_recorder_loses_no_earlier_data(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(COUNT)))
    (run.folder / "run_1.mcap").touch()
    report = replay(run.folder)
    assert (report.status, report.exit_code, report.samples) == (FileStatus.TRUNCATED, 3, COUNT)
    unnamed = "run_1.mcap: metadata.yaml does not name it"
    assert examine(run.folder).problems == ["run_1.mcap: truncated: its end is missing", unnamed]
    repair(run.folder)
    assert replay(run.folder).exit_code == 0 and (run.folder / "run_1.mcap.damaged").exists()


def bag_of_parts(folder: Path, kind: StoragePlugin) -> list[Path]:
    """Write a bag in three parts as rosbag2 does, each with 10 ms of load and without a gap. Return the parts."""
    ending, listed = kind.name.lower().replace("sqlite3", "db3"), []
    folder.mkdir()
    for part in range(3):
        one = folder.parent / f"{folder.name}_{part}"
        with BagWriter(one, version=9, storage_plugin=kind) as writer:
            connection = writer.add_connection("/load", TYPE, typestore=STORE)
            for index in range(100 * part, 100 * (part + 1)):
                time_ns = BASE_NS + index * STEP_NS
                writer.write(connection, time_ns, wrench_message(time_ns, paper_sample(index).wrench))
        listed.append(shutil.move(one / f"{one.name}.{ending}", folder / f"{folder.name}_{part}.{ending}"))
    text = (one / "metadata.yaml").read_text()
    names = "".join(f"\n  - {part.name}" for part in listed)
    text = re.sub(r"relative_file_paths:\n *- [^\n]*", f"relative_file_paths:{names}", text)
    (folder / "metadata.yaml").write_text(text)
    return listed


@pytest.mark.parametrize("kind", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_the_other_parts_of_a_damaged_bag_are_used(kind: StoragePlugin, tmp_path: Path) -> None:
    """No load is interpolated over a gap of any length, and a damaged file does not make the whole bag unreadable."""
    parts = bag_of_parts(tmp_path / "bag", kind)
    plain = analyse(tmp_path / "bag", scene=PAPER)
    assert (plain.input["samples_used"], plain.lost, len(plain.predictions[0].spans)) == (COUNT, {}, 1)
    parts[1].write_bytes(b"no recording at all")
    for reason in ("damaged_files", "missing_parts"):
        analysis = analyse(tmp_path / "bag", scene=PAPER, out=tmp_path / reason)
        assert (analysis.input["samples_used"], analysis.lost) == (2 * COUNT // 3, {reason: 1})
        assert list(analysis.predictions[0].spans.values()) == [
            tuple(BASE_NS + index * STEP_NS for index in ends) for ends in ((0, 99), (200, 299))
        ]
        parts[1].unlink(missing_ok=True)
    for part in (parts[0], parts[2]):
        part.write_bytes(b"no recording at all")
    with pytest.raises(RecordingError, match=str(tmp_path / "bag")):
        analyse(tmp_path / "bag", scene=PAPER)


@pytest.mark.parametrize("kind", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_type_that_only_the_bag_defines_is_read(kind: StoragePlugin, tmp_path: Path) -> None:
    store, name = get_typestore(Stores.ROS2_JAZZY), "plant_msgs/msg/Load"
    store.register(get_types_from_msg("builtin_interfaces/Time at\nfloat32 fx\nfloat64[2] f", name))
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=kind) as writer:
        connection = writer.add_connection("/load", name, typestore=store)
        for index in range(10):
            time_ns = BASE_NS + index * STEP_NS
            time = store.types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
            message = store.types[name](time, 5e3 * index, np.array([1e4, 2e4]))
            writer.write(connection, time_ns, store.serialize_cdr(message, name))
    (tmp_path / "map.yaml").write_text(
        "excitation: {topic: /load, fields: {fx: fx, fy: 'f[0]', m: 'f[1]'}, stamp: log}\n"
    )
    analysis = analyse(tmp_path / "bag", scene=PAPER, mapping=tmp_path / "map.yaml")
    assert analysis.input == {"samples_in": 10, "samples_used": 10} and not analysis.lossy


def test_a_bag_of_another_program_is_drawn_by_its_mapping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(tmp_path / "bag", tuple(part[:400] for part in motion()), StoragePlugin.SQLITE3)
    figures = kept_figures(monkeypatch)
    arguments = ["view", str(tmp_path / "bag"), "--map", str(tmp_path / "map.yaml"), "--scene", "paper", "--quiet"]
    assert run_cli([*arguments, "--png", str(tmp_path / "bag.png")]) == 0
    force, load = figures[0].axes[2:4]
    assert figures[0].get_suptitle().startswith("bag/run, scene paper, ")
    largest = max(float(np.nanmax(line.get_ydata())) for line in force.lines[:8])
    assert largest == pytest.approx(analyse_force(tmp_path) / 1e3, rel=1e-6)
    np.testing.assert_allclose(load.lines[0].get_ydata(), motion()[1][:400, 0] / 1e3)
    assert run_cli([*arguments, "--out", str(tmp_path / "bag.rrd")]) == 0
    drawn = [
        chunk.to_record_batch()["Scalars:scalars"].to_pylist()
        for chunk in RrdReader(str(tmp_path / "bag.rrd")).stream()
        if chunk.entity_path == "/pose/measured/x" and not chunk.is_static
    ]
    poses = [q[0] for _, q in measured(tuple(part[:400] for part in motion()))]
    np.testing.assert_allclose([value for part in drawn for row in part for value in row], 1e3 * np.array(poses))


def analyse_force(folder: Path) -> float:
    """Return the largest force [N] that an analysis of the bag finds."""
    analysis = analyse(folder / "bag", scene=PAPER, mapping=folder / "map.yaml")
    return max(analysis.facts()["loads"]["largest_force_n"].values())
