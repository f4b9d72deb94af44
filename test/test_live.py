"""The live twin without ROS. With files, standard input and MQTT, session, counters and recording are the same."""

from __future__ import annotations

import fcntl
import gc
import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, cast
from urllib.error import URLError
from urllib.request import urlopen

import forge
import numpy as np
import pytest
from network import free_port
from record_support import PAPER_AMPLITUDE, records_of, rewrite
from waiting import until

from plow_twin.cli.app import run as run_cli
from plow_twin.cli.live_report import MOST_WAITING, Outlet
from plow_twin.errors import RecordingError
from plow_twin.live import parameters
from plow_twin.live.bridge.files import Files, StandardInput
from plow_twin.live.bridge.source import BridgeError
from plow_twin.live.control import Control, ControlError, call
from plow_twin.live.front import BridgeFront
from plow_twin.live.inputs import Inputs
from plow_twin.live.load_model import read_load_model
from plow_twin.live.metrics import Metrics
from plow_twin.live.part import Part
from plow_twin.live.service_names import mark_problem
from plow_twin.live.services import Services
from plow_twin.live.solver_start import Preparation
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.doctor import examine
from plow_twin.record.entries import EntryRecord, OutputRecord
from plow_twin.record.mapping import read_map
from plow_twin.record.measured import read_recording
from plow_twin.record.reader import RunReader
from plow_twin.record.replay import replay
from plow_twin.record.sources import Arrived, Columns
from plow_twin.record.times import time_ns
from plow_twin.record.unused import unused_messages
from plow_twin.record.writer import RunWriter
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.solve.state import Status
from plow_twin.stream.intake import Verdict
from plow_twin.stream.journal import Gaps, Mark, Parameter, PartOfPose, Pose, Unused
from plow_twin.stream.limits import pose_limits, value_limits
from plow_twin.study.analysis.analyse import analyse
from plow_twin.view.run_curves import RunCurves

ROOT = Path(__file__).resolve().parent.parent
START_S = 200.0


def _row(index: int, times: float = 1.0) -> tuple[float, ...]:
    phase = times * float(np.sin(2e-3 * index))
    return (index * 1e-3, *(phase * amplitude for amplitude in PAPER_AMPLITUDE))


def _csv(path: Path, count: int, more: str = "", times: float = 1.0, start: float = 0.0) -> Path:
    values = (_row(index, times) for index in range(count))
    rows = "".join(",".join(map(repr, (start + t, *load))) + "\n" for t, *load in values)
    path.write_text(f"t,fx,fy,m\n{rows}{more}", encoding="utf-8")
    return path


#: Invalid sequence numbers.
STRAY = ("5000000", "1e30", "0", "-7", "nan")


def _run(path: Path, mapping: Path | None = None, reports: list[Part] | None = None, **values: Any) -> dict[str, Part]:
    """Run a twin on a file and return its diagnostics. Diagnostics during the run are added to `reports`."""
    settings = parameters.settings(values)
    messages: list[str] = []

    def say(name: str, part: Part) -> None:
        if name == "state" and reports is not None:
            reports.append(part)

    prepared = Preparation(settings).result(lambda: False)
    front = BridgeFront(Files([path], follow=False), mapping, settings, prepared, say, messages.append)
    assert front.run(lambda: False) == []
    return front.parts()


@pytest.mark.parametrize("follow", ["off", "full"])
def test_an_advance_of_a_live_twin_fails_after_the_limit_of_steps(follow: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # without the limit, a very stiff contact keeps the node from answering for over a minute
    for module in ("plow_twin.live.solver_start", "plow_twin.estimate.members"):
        monkeypatch.setattr(f"{module}.MOST_STEPS", 20)
    settings = parameters.settings({"estimate": follow != "off", "follow": "full", "follow_members": 20})
    twin = Preparation(settings).result(lambda: False).twin
    assert twin.advance(10.0, (1e3, 1e3, 0.0)).status is Status.BUDGET


def test_a_file_is_fed_recorded_and_replayed_and_every_row_is_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = "no numbers at all\n1.1,1e9,0,0\n1.2,nan,0,0\n1.3,1,2\n0.5,1,2,3\n1.4,true,0,0\n1.5,1_0,0,0\n"
    bad += "x" * 70000 + "\n"
    path = _csv(tmp_path / "load.csv", 1000, bad)
    values = _run(path, record_path=str(tmp_path / "run"), alarm_force=[1e3, 1e9])["input"][2]
    dropped = {key: count for key, count in values.items() if key.startswith("dropped_") and count != "0"}
    assert (values["samples_in"], values["samples_used"]) == ("1008", "1000")
    assert dropped == {
        "dropped_malformed": "5",
        "dropped_implausible": "1",
        "dropped_non_finite": "1",
        "dropped_duplicate": "1",
    }
    report = replay(tmp_path / "run")
    assert (report.samples, report.exit_code, report.first_divergence) == (1000, 0, None)
    assert report.compared["contact_forces"] == 1000
    # the recording contains the unused messages, and their numbers agree with the counters of the twin
    drops = {key.removeprefix("dropped_"): int(count) for key, count in dropped.items()}
    assert report.inputs == examine(tmp_path / "run").inputs == {"excitation": {"used": 1000, **drops}}
    unused = {unused_entry["reason"]: unused_entry for unused_entry in unused_messages(tmp_path / "run")}
    assert unused["implausible"]["values"] == (1e9, 0.0, 0.0)
    assert repr(unused["non_finite"]["values"]) == "(nan, 0.0, 0.0)"
    assert unused["duplicate"] == {
        "input": "excitation", "sender": "load", "reason": "duplicate", "count": 1, "stamp_ns": 1_500_000_000,
        "values": (1.0, 2.0, 3.0),
    }  # fmt: skip
    assert run_cli(["info", str(tmp_path / "run"), "--unused"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 9 and "excitation,load,non_finite,1,2200000000,nan 0.0 0.0" in printed


def test_a_single_stamp_far_ahead_neither_sets_the_clock_nor_ends_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    date = "2026-01-01T00:00:{:06.3f}".format
    rows = [f"{date(index * 1e-3)},1,2,3\n" for index in range(300)]
    rows[150:150] = ["2037-01-01,1,2,3\n"]  # this stamp is eleven years after the previous stamp
    rows[200:200] = ["9999-12-31,1,2,3\n", "9999-12-31,1,2,3\n"]
    path = tmp_path / "load.csv"
    path.write_text("time,fx,fy,m\n" + "".join(rows))
    values = _run(path, record_path=str(tmp_path / "run"))["input"][2]
    assert (values["samples_used"], values["dropped_stray"], values["dropped_malformed"]) == ("300", "1", "2")
    assert float(values["newest_sample_age_s"]) == 0.0
    assert run_cli(["info", str(tmp_path / "run"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["duration_s"] < 1.0
    assert replay(tmp_path / "run").samples == 300


@pytest.mark.parametrize(("column", "bad"), [("x", "999"), ("speed", "fast")])
def test_dropped_messages_of_any_input_change_the_exit_code(column: str, bad: str, tmp_path: Path) -> None:
    path = tmp_path / "all.csv"
    rows = "".join(f"{index * 0.01},1,2,3,{bad if index % 2 else 0}\n" for index in range(20))
    path.write_text(f"t,fx,fy,m,{column}\n{rows}")
    role = "head_pose" if column == "x" else "travel"
    mapping = tmp_path / "map.yaml"
    mapping.write_text(f"excitation: {{topic: all}}\n{role}: {{topic: all, fields: {{{column}: {column}}}}}\n")
    assert run_cli(["live", str(path), "--map", str(mapping), "--quiet"]) == 3


def test_a_pose_may_lack_any_component(tmp_path: Path) -> None:
    path = _csv(tmp_path / "load.csv", 20)
    mapping = tmp_path / "map.yaml"
    mapping.write_text("excitation: {topic: load}\nhead_pose: {topic: load, fields: {theta: m}, scale: 1e-9}\n")
    assert _run(path, mapping)["input"][2]["head_pose_used"] == "20"


def test_measured_poses_and_gaps_are_journalled_in_order_of_arrival(tmp_path: Path) -> None:
    rows = [",".join(map(repr, _row(index))) + ",,,," for index in range(100)]
    rows.insert(50, "0.0302,,,,0.001,0.002,0.003,0.004")
    rows.insert(60, "0.0405,,,,,,,0.005")
    rows.insert(61, "0.0205,,,,0.001,,0.003,")  # y was not measured
    path = tmp_path / "all.csv"
    path.write_text("t,fx,fy,m,x,y,theta,top_left_top\n" + "\n".join(rows) + "\n")
    (tmp_path / "map.yaml").write_text("excitation: {topic: all}\nhead_pose: {topic: all}\ngaps: {topic: all}\n")
    stated = {"head_pose_deviation": [1e-4, 2e-4, 3e-4], "excitation_deviation": [1e3, 0.0, 2e3]}
    values = _run(path, tmp_path / "map.yaml", record_path=str(tmp_path / "run"), **stated)["input"][2]
    measured = read_recording(tmp_path / "run")
    assert (measured.pose_deviation, measured.load_deviation) == ((1e-4, 2e-4, 3e-4), (1e3, 0.0, 2e3))
    assert (values["samples_used"], values["head_pose_used"], values["gaps_used"]) == ("100", "2", "2")
    assert values["head_pose_dropped"] == "0"
    entries = [record.entry for record in records_of(tmp_path / "run") if isinstance(record, EntryRecord)]
    assert [entry for entry in entries if isinstance(entry, Pose | PartOfPose | Gaps)] == [
        Pose(1_030_200_000, (0.001, 0.002, 0.003)),
        Gaps(1_030_200_000, (0,), (0.004,)),
        Gaps(1_040_500_000, (0,), (0.005,)),
        PartOfPose(1_020_500_000, (0, 2), (0.001, 0.003)),
    ]
    assert np.array_equal(measured.poses[-1, 1:], (0.001, np.nan, 0.003), equal_nan=True)
    report = replay(tmp_path / "run")
    assert (report.samples, report.exit_code) == (100, 0)


def test_bounded_work_is_reported_with_its_error_and_repeated_by_the_journal(tmp_path: Path) -> None:
    settings = {"scene": "bench_kv", "max_evaluations": 16, "record_path": str(tmp_path / "run")}
    reports: list[Part] = []
    parts = _run(_csv(tmp_path / "load.csv", 1500), reports=reports, **settings)
    # a report covers the time since the previous report, so the largest error may be in any report
    largest = max(float(values["error_estimate_m"]) for _, _, values in (*reports, parts["state"]))
    assert int(parts["state"][2]["coarse_advances"]) > 0 and 0.0 < largest < 1e-3
    report = replay(tmp_path / "run")
    assert (report.samples, report.exit_code, report.first_divergence) == (1500, 0, None)
    assert report.compared["contact_forces"] == 1500


def test_the_alarms_of_a_run_are_computed_again_and_compared(tmp_path: Path) -> None:
    rows = [",".join(map(repr, _row(index))) + ",,," for index in range(1200)]
    for index in range(50, 1200, 50):
        rows[index] += f"\n{index * 1e-3 + 2e-4!r},,,,{0.02 if index in (300, 350) else 0.0},0.0,0.0"
    path = tmp_path / "all.csv"
    path.write_text("t,fx,fy,m,x,y,theta\n" + "\n".join(rows) + "\n")
    mapping = tmp_path / "map.yaml"
    mapping.write_text("excitation: {topic: all}\nhead_pose: {topic: all}\n")
    parameters_of_run = {"alarm_force": [1e3, 1e9], "alarm_residual": [0.015, 0.0], "alarm_duration": 0.002}
    settings = parameters.settings(parameters_of_run | {"record_path": str(tmp_path / "run")})
    said: list[tuple[str, Part]] = []
    front = BridgeFront(
        Files([path], follow=False), mapping, settings, Preparation(settings).result(lambda: False),
        lambda name, part: said.append((name, part)), pytest.fail,
    )  # fmt: skip
    acknowledged: list[tuple[bool, str]] = []

    def acknowledge() -> bool:
        if front.runtime.alarms.worst and not acknowledged:
            acknowledged.append(Services(front.runtime, front.changed).acknowledge_alarms())
        return False

    assert front.run(acknowledge) == [] and acknowledged
    # changes of a level are recorded, and all alarms are reported once per second
    alarms = [part[2] for name, part in said if name == "alarms"]
    assert any(values["residual_latched"] == "warn" for values in alarms)
    recorded = [
        dict(record.message().values)
        for record in records_of(tmp_path / "run")
        if isinstance(record, OutputRecord) and record.topic == "/alarms"
    ]
    assert len(recorded) > 3 and all(values in alarms for values in recorded)
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.compared["alarms"], report.first_divergence) == (0, len(recorded), None)

    def other_thresholds(record: dict[str, str]) -> dict[str, str]:
        return {key: text.replace("0.015", "0.025") for key, text in record.items()}

    file = next((tmp_path / "run").glob("*.mcap"))
    report = replay(rewrite(file, tmp_path / "other.mcap", metadata=other_thresholds))
    assert report.exit_code == 1 and report.first_divergence is not None
    # the alarm of the residual was raised and then released; the replay raises no alarm, so there are two divergences
    divergence = report.first_divergence
    assert (report.divergences, divergence.topic, divergence.recorded, divergence.computed) == (
        2,
        "alarms",
        "a message",
        "none",
    )

    def other_level(topic: str, message: Any) -> bytes | None:
        return bytes(message.data).replace(b"warn", b"none") if topic == "/alarms" else None

    report = replay(rewrite(file, tmp_path / "told.mcap", other_level))
    assert report.first_divergence is not None
    divergence = report.first_divergence
    assert (divergence.topic, divergence.recorded, divergence.computed) == (
        "alarms",
        "none",
        "warn",
    ) and "_l" in divergence.field
    # after a kill and a repair, the outputs end before the journal
    last = max(record.sequence for record in records_of(file) if getattr(record, "topic", "") == "/alarms")

    def cut(topic: str, message: Any) -> bytes | None:
        return b"" if "/journal/" not in topic and message.sequence > last - (topic == "/alarms") else None

    report = replay(rewrite(file, tmp_path / "cut.mcap", cut))
    assert (report.exit_code, report.compared["alarms"]) == (0, len(recorded) - 1)
    # alarms cannot be compared without recorded outputs
    few = parameters_of_run | {"record_path": str(tmp_path / "few"), "record_outputs": "none"}
    _run(path, mapping, **few)
    report = replay(tmp_path / "few")
    assert (report.exit_code, report.compared["alarms"]) == (0, 0) and report.not_compared["alarms"] > 0


def test_an_unused_message_of_any_input_is_a_warning(tmp_path: Path) -> None:
    rows = [",".join(map(repr, (*_row(index), 50.0 if index == 7 else 1.0))) for index in range(20)]
    path = tmp_path / "load.csv"
    path.write_text("t,fx,fy,m,speed\n" + "\n".join(rows) + "\n")
    level, message, values = _run(path)["input"]
    assert (level, message, values["travel_used"], values["travel_dropped"]) == (1, "travel_dropped", "19", "1")


def test_message_numbers_of_the_sender_show_loss_repetition_and_restart(tmp_path: Path) -> None:
    numbers = [*range(7, 100), 99, *range(110, 200), *range(1, 50), *range(52, 60)]
    lines = [
        json.dumps({"time": 1000 + index, "load": {"f": [index, 2, 3]}, "n": n}) for index, n in enumerate(numbers)
    ]
    # messages of other senders have no sequence number; they and the two damaged messages use no number
    lines[150], lines[151] = '{"n": 152, "load"', '{"n"'
    for place, other in ((60, '{"hello": 1}'), (40, "garbage"), (20, '{"n": "x", "status": 3}')):
        lines.insert(place, other)
    path = tmp_path / "plough.csv"
    # an unreadable message before the first sequence number is not counted as number 1
    path.write_text("\n".join(["{}", "nothing", *lines, '{"n": 60, "load"']) + "\n", encoding="utf-8")
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "excitation: {topic: plough, fields: {fx: 'load.f[0]', fy: 'load.f[1]', m: 'load.f[2]'}, sequence: n,\n"
        "  stamp: time, stamp_unit: ms, unit: {fx: kN}, limits: {fx: [-1, 1e6]}}\n"
    )
    values = _run(path, mapping, limit_force=1e9, limit_force_rate=1e12)["input"][2]
    # 10 numbers are missing between 99 and 110, and 2 between 49 and 52
    assert (values["samples_lost"], values["dropped_duplicate"], values["dropped_malformed"]) == ("12", "1", "8")
    assert int(values["samples_used"]) == len(numbers) - 3


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        *((["1", "2", *map(str, range(3, 150)), stray, *map(str, range(151, 301))], 0) for stray in STRAY),
        ([*map(str, range(150)), *map(str, range(150))], 0),  # from 0, with a new start
        # jumps after which the numbers continue: back to a new count, ahead, and ahead by too much for a loss
        ([*map(str, range(2000, 2150)), *map(str, range(2, 150))], 1),
        ([*map(str, range(1, 150)), *map(str, range(5000, 5150))], 4850),
        ([*map(str, range(1, 150)), *map(str, range(10**15, 10**15 + 150))], 0),
    ],
)
def test_a_single_stray_number_moves_nothing(tmp_path: Path, numbers: list[str], lost: int) -> None:
    path, mapping = tmp_path / "load.csv", tmp_path / "map.yaml"
    rows = [f"{1e9 + 1e-3 * index!r},1,2,3,{number}" for index, number in enumerate(numbers)]
    path.write_text("\n".join(["t,fx,fy,m,n", *rows]) + "\n")
    mapping.write_text("excitation: {topic: load, fields: {fx: fx, fy: fy, m: m}, sequence: n}\n")
    values = _run(path, mapping)["input"][2]
    assert (values["samples_lost"], values["samples_used"]) == (str(lost), str(len(numbers)))


def test_a_mapping_has_units_offsets_and_clocks_and_its_faults_are_named(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"

    def read(text: str, **content: Any) -> tuple[int, dict[str, float]] | None:
        path.write_text(text)
        return read_map(path, None)["head_pose"].read(Arrived("p", 5, content))

    pose = "head_pose: {topic: p, fields: {x: a, y: b.c, theta: turn}, clock_offset: -0.5, "
    pose += "unit: {x: mm, y: cm, theta: deg}, "
    rows = read(
        pose + "offset: {x: 1}, scale: {x: 2}, stamp: at}", a=3, b={"c": 4}, turn=180, at="2026-01-02T03:04:05.25Z"
    )
    assert rows is not None
    assert rows[1] == pytest.approx({"x": 7e-3, "y": 4e-2, "theta": np.pi})
    assert rows[0] == 1_767_323_044_750_000_000
    rows = read(pose + "scale: 0, offset: {x: 1}}", a=3, b={"c": 4}, turn=180)
    assert rows is not None and rows[1] == pytest.approx({"x": 1e-3, "y": 0.0, "theta": 0.0})
    assert read(pose + "stamp: at}", a="", b={"c": 4}, turn="x", at=1) is None
    for wrong in (True, [1], {}, None, 10**400):
        assert read(pose + "stamp: at}", a=wrong, b={"c": 4}, turn=1, at=1) is None
    assert time_ns(1_767_323_045_123_456_789, "ns") == 1_767_323_045_123_456_789
    # times with an arbitrary start are shifted by 1 s, because 0 means that a stamp is missing
    assert time_ns(0.5) == 1_500_000_000
    assert time_ns("yesterday") is None and time_ns(float("inf")) is None and time_ns(1e300) is None
    # many databases write the first date for `empty`; the other two dates cannot be stamps
    assert time_ns("9999-12-31") is None and time_ns("2300-01-01T00:00:00") is None and time_ns("0001-01-01") is None
    assert time_ns(10**400) is None and time_ns("20260102") == (20_260_102 + 1) * 10**9
    for text, message in (
        ("unit: {x: N}", "unit.x: got 'N', expected one of m, cm, mm, um"),
        ("limits: {x: [2, 1]}", "limits.x: got [2, 1], expected the smallest number"),
        ("clock_offset: soon", "clock_offset: got 'soon'"),
        ("stamp_unit: h", "stamp_unit: got 'h'"),
        ("gain: 2", "gain: got 2, expected a known key"),
        ("scal: 2", "scal: got 2, expected a known key; did you mean scale?"),
        ("stamp_unit: [s]", "stamp_unit: got ['s'], expected one of s, ms"),
        ("stamp: [t]", "stamp: got ['t'], expected header, log, the name of a column, a path, or {node: identifier}"),
        ("sequence: 0.5", "sequence: got 0.5, expected the name"),
        ("fields: {x: [1]}", "fields.x: got [1], expected the name of a column"),
        ("fields: 5", "fields: got 5"),
        ("scale: {x: true}", "scale.x: got True, expected a finite number"),
        ("scale: false", "scale: got False, expected a mapping"),
        ("limits: {x: [0, true]}", "limits.x[1]: got True, expected a finite number"),
        ("unit: mm", "unit.theta: got 'mm', expected one of rad"),
        ("limits: 0", "limits.x: got 0, expected a finite number > 0"),
    ):
        path.write_text(f"head_pose: {{topic: p, {text}}}")
        with pytest.raises(RecordingError, match="head_pose") as caught:
            read_map(path, None)
        assert message in str(caught.value)
    # if the requested field with the time is missing, the time of receipt does not replace it
    assert read("head_pose: {topic: p, stamp: at}", x=1, y=2, theta=3) is None
    for key, name in (("stamp", "at"), ("sequence", "n")):
        path.write_text(f"head_pose: {{topic: p, {key}: {name}}}")
        with pytest.raises(
            RecordingError, match=f"head_pose.{key}: got '{name}', expected one of the columns t, x, y, theta"
        ):
            read_map(path, {"p": Columns(("t", "x", "y", "theta"))})
    for data in (b"head_pose: {topic: p", b"\xff\xfe\x00", b"[" * 5000, b"7"):
        path.write_bytes(data)
        for reader in (lambda path: read_map(path, None), read_load_model):
            with pytest.raises(RecordingError, match=r"map\.yaml: "):
                reader(path)


def test_files_wait_for_a_slow_recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Input without a clock arrives in batches. Each batch fills a quarter of this queue."""
    monkeypatch.setattr("plow_twin.live.recording._QUEUE_SIZE", 2400)
    monkeypatch.setattr("plow_twin.record.recorder._POLL_S", 0.3)
    path = _csv(tmp_path / "load.csv", 2000)
    assert run_cli(["live", str(path), "--record", str(tmp_path / "run"), "--quiet"]) == 0
    report = replay(tmp_path / "run")
    assert (report.exit_code, report.compared["contact_forces"]) == (0, 2000)


def test_a_full_disk_under_the_log_does_not_end_the_twin(tmp_path: Path) -> None:
    _csv(tmp_path / "load.csv", 50)
    arguments = ["live", str(tmp_path / "load.csv"), "--record"]
    full = Path("/dev/full").open("w")  # noqa: SIM115  # closing this file raises an error
    with redirect_stderr(full):
        assert run_cli([*arguments, str(tmp_path / "log")]) == 0
    with redirect_stdout(full):
        assert run_cli([*arguments, str(tmp_path / "lines"), "--lines"]) == 3
    with suppress(OSError):
        full.close()
    for name in ("log", "lines"):
        report = replay(tmp_path / name)
        assert (report.samples, report.exit_code) == (50, 0)


def test_a_hanging_reader_of_the_lines_stops_nothing_and_lost_lines_are_counted() -> None:
    lines: list[str] = []
    hangs, lost_at = threading.Event(), list[int]()

    def write(line: str) -> bool:
        hangs.wait(60.0)
        lines.append(line)
        return True

    outlet = Outlet(write, lambda: lost_at.append(outlet.lost))
    for number in range(MOST_WAITING + 100):
        outlet.put(str(number))
    assert lost_at == [1] and 99 <= outlet.lost <= 100
    hangs.set()
    # after the line that was being written, the newest lines are written in order
    assert outlet.close() and len(lines) + outlet.lost == MOST_WAITING + 100
    assert lines[-MOST_WAITING:] == list(map(str, range(100, MOST_WAITING + 100)))


def test_a_live_twin_with_an_unread_standard_output_continues_and_can_be_stopped(tmp_path: Path) -> None:
    path, port = _csv(tmp_path / "load.csv", 100), free_port()
    more = ["--metrics", str(port), "--record", str(tmp_path / "run")]
    with _live(str(path), "--follow", "--scene", "paper", *more) as live:
        pipe = live.process.stdout
        assert pipe is not None
        # the pipe is soon full, because it holds less than the lines of one second
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, 4096)
        live.until_count("samples_used", 100)
        for count in range(1000, 4000, 1000):  # from here on, nothing reads the pipe
            with path.open("a") as file:
                file.writelines(",".join(map(repr, _row(index))) + "\n" for index in range(count - 900, count + 100))
            until(lambda: _metric(port, "plow_twin_input_samples_used") >= count + 100, count, 0.1)  # noqa: B023
        live.process.send_signal(signal.SIGTERM)
        assert live.process.wait(60.0) == 3
        errors = live.process.stderr
        assert errors is not None and re.search(rb"\d+ lines were not, or only partly, written", errors.read())
    assert replay(tmp_path / "run").samples == 3100


def _metric(port: int, name: str) -> float:
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as page:
        lines = [line.split() for line in page.read().decode().splitlines() if line.startswith(f"{name} ")]
    return float(lines[0][1]) if lines else 0.0


class Live:
    def __init__(self, *arguments: str, **options: Any) -> None:
        words = ["live", *arguments, "--lines"]
        self.process = forge.start("plow_twin", words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
        self.heard: dict[str, dict[str, Any]] = {}
        self.alarms: list[dict[str, Any]] = []

    def until(self, reached: Callable[[dict[str, dict[str, Any]]], bool], event: str) -> dict[str, str]:
        """Read the output until a condition is true. Return the values of its part `input`."""
        give_up = time.monotonic() + START_S
        assert self.process.stdout is not None
        while not ("input" in self.heard and reached(self.heard)):
            assert time.monotonic() < give_up, f"{event}: {self.heard}"
            line = self.process.stdout.readline()
            assert line, f"{event}: ended: {self.process.communicate()[1].decode()}; {self.heard}"
            part = json.loads(line)
            self.heard[part["topic"]] = part
            self.alarms += [part] if part["topic"] == "alarms" else []
        return {key: str(counts) for key, counts in self.heard["input"]["values"].items()}

    def until_count(self, key: str, count: int) -> dict[str, str]:
        return self.until(lambda heard: int(heard["input"]["values"][key]) >= count, f"{count} {key}")

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        self.process.communicate(timeout=60.0)
        return self.process.returncode


@contextmanager
def _live(*arguments: str, **options: Any) -> Iterator[Live]:
    live = Live(*arguments, **options)
    try:
        yield live
    finally:
        live.process.kill()
        live.process.communicate()


def test_a_file_is_followed_while_it_grows_and_when_it_is_replaced(tmp_path: Path) -> None:
    path, run = tmp_path / "load.csv", tmp_path / "run"
    _csv(path, 100)
    arguments = (str(path), "--follow", "--record", str(run), "--set", "excitation_timeout=3600")
    with _live(*arguments) as live:
        live.until_count("samples_used", 100)
        text = "".join(",".join(map(repr, _row(index))) + "\n" for index in range(100, 200))
        with path.open("a") as stream:
            stream.write(text[:1234])  # this text ends within a number
            stream.flush()
            live.until_count("samples_used", 105)
            stream.write(text[1234:])
        live.until_count("samples_used", 200)
        path.rename(tmp_path / "load.csv.1")
        path.write_text("t,fx,fy,m\n" + "".join(",".join(map(repr, _row(index))) + "\n" for index in range(200, 300)))
        values = live.until_count("samples_used", 300)
        assert values["samples_in"] == "300"
        assert live.stop(signal.SIGHUP) == 0  # the signal of a terminal that is closed
    report = replay(run)
    assert (report.samples, report.exit_code) == (300, 0)


def test_a_screen_cannot_request_a_service_that_is_switched_off(tmp_path: Path) -> None:
    settings = parameters.settings({"services_off": "mark"})
    front = BridgeFront(
        Files([_csv(tmp_path / "load.csv", 10)], follow=False), None, settings,
        Preparation(settings).result(lambda: False), lambda name, part: None, pytest.fail,
    )  # fmt: skip
    services = Services(front.runtime, front.changed)
    assert services.answer("mark", "new pads") == (False, "mark: switched off by the parameter services_off")
    assert front.run(lambda: False) == [] and services.answer("acknowledge", "")[0]


def test_an_alarm_is_reported_once_with_value_pad_threshold_and_time_and_acknowledged_without_ros(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # the path of a socket must be short, but the folders of tests have long paths
    path, control = _csv(tmp_path / "load.csv", 5000), Path(tempfile.mkdtemp(dir="/tmp")) / "twin.socket"
    control.touch()
    # this file exists and is not the socket of a twin
    assert run_cli(["live", str(path), "--control", str(control)]) == 1
    assert "cannot be a socket" in capsys.readouterr().err
    control.unlink()
    thresholds = ("--set", "alarm_force=[20e3,1e9]", "--set", "alarm_duration=0.002")
    arguments = (str(path), "--follow", "--control", str(control), "--set", "excitation_timeout=3600", *thresholds)
    with _live(*arguments, "--record", str(tmp_path / "run")) as live:
        live.until_count("samples_used", 5000)
        # within five seconds the force exceeds the threshold repeatedly, but the alarm is reported once
        (alarm,) = live.alarms
        values = alarm["values"]
        assert values["force_raised"] > values["force_threshold"] == 20e3 and values["force_place"] in PAIR_NAMES
        assert alarm["stamp_ns"] >= values["force_stamp_ns"] > 1_000_000_000
        assert f"kN at {values['force_place']}, warning threshold 20 kN, at 0." in alarm["message"]
        again = sum(record.topic == "/alarms" for record in records_of(tmp_path / "run") if hasattr(record, "topic"))
        assert again > 4
        mark, acknowledge = ["call", str(control), "mark", "new pads"], ["call", str(control), "acknowledge_alarms"]
        assert [run_cli(mark), run_cli(acknowledge)] == [0, 0]
        answer = capsys.readouterr().out
        assert "still active: force" in answer and f"kN at {values['force_place']}, warning threshold 20 kN" in answer
        assert re.search(r", now [\d.]+ kN$", answer.strip())
        for text, got in (
            (" ", "got 0 characters"),
            ("x" * 201, "got 201 characters"),
            ("a\x1b[2Jb", "got 'a\\x1b[2Jb'"),
        ):
            assert run_cli(["call", str(control), "mark", text]) == 2 and got in capsys.readouterr().err
            # other programs can use the socket without `plow-twin call`
            assert call(control, "mark", text) == (False, mark_problem(text))
        for place, kind in ((path, "a file"), (tmp_path, "a folder"), (tmp_path / "none", "nothing there")):
            assert run_cli(["call", str(place), "mark", "x"]) == 1
            assert f"got {kind}, expected the socket that plow-twin live --control" in capsys.readouterr().err
        assert run_cli(["call", str(control), "restore"]) == 1 and "no snapshot" in capsys.readouterr().err
        assert live.stop() == 0
    assert not control.exists() and run_cli(acknowledge) == 1
    entries = [record.entry for record in records_of(tmp_path / "run") if isinstance(record, EntryRecord)]
    marks = [entry.text for entry in entries if isinstance(entry, Mark)]
    assert marks == ["alarm: force", "new pads"]
    assert [entry.name for entry in entries if isinstance(entry, Parameter)] == ["alarms_acknowledged"]


def test_a_request_whose_client_has_given_up_is_not_performed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy twin performed a reset seconds after the client had reported that no twin answers."""
    called: list[str] = []

    class Recorder:
        def call(self, name: str, text: str | None) -> tuple[bool, str]:
            called.append(name)
            return True, ""

    monkeypatch.setattr("plow_twin.live.control._PATIENCE_S", 0.05)
    path = Path(tempfile.mkdtemp(dir="/tmp")) / "twin.socket"
    with Control(path) as control:
        control.services = cast(Services, Recorder())
        with pytest.raises(ControlError, match="no twin answers"):
            call(path, "reset")
        control.turn()
    path.parent.rmdir()
    assert not called


def test_files_with_dates_are_waited_for_and_followed_from_one_to_the_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def text(begin: int, end: int) -> str:
        return "".join(",".join(map(repr, _row(index))) + "\n" for index in range(begin, end))

    days = [tmp_path / f"load_{day}.csv" for day in (8, 9, 10)]
    mapping = tmp_path / "map.yaml"
    mapping.write_text("excitation: {topic: load_*, unit: {fx: N}}\n")
    arguments = (str(tmp_path / "load_*.csv"), "--follow", "--map", str(mapping), "--set", "excitation_timeout=3600")
    with _live(*arguments) as live:
        days[1].write_text("t,fx")  # the header is incomplete
        time.sleep(0.5)
        days[1].write_text("t,fx,fy,m\n" + text(0, 100))
        live.until_count("samples_used", 100)
        with days[1].open("a") as before:
            days[2].write_text("t,fx,fy,m\n" + text(150, 200))
            live.until_count("samples_used", 150)
            before.write(text(100, 150))  # these rows are late, so the motion is corrected
        values = live.until_count("samples_used", 200)
        assert (values["samples_in"], values["rolled_back"]) == ("200", "50")
        assert live.stop() == 0
    # without --follow, files are read in the order of the numbers in their names; the mapping also works for a single
    # file
    days[0].write_text("t,fx,fy,m\n" + text(-30, 0))
    for source, count in ((arguments[0], 230), (str(days[0]), 30)):
        assert run_cli(["live", source, "--map", str(mapping), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["input"]["samples_used"] == str(count)


def test_the_share_of_files_that_has_been_read_rises_to_one(tmp_path: Path) -> None:
    for day in (1, 2):
        _csv(tmp_path / f"load_{day}.csv", 9000)
    for source in (tmp_path / "load_1.csv", tmp_path / "load_*.csv"):
        files = Files([source], follow=False)
        files.start([source.stem])
        shares = [files.share]
        while files.poll(0.0):
            shares.append(files.share)
        files.close()
        assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0 and len({*shares}) > 2


def test_losses_of_a_truncated_or_replaced_file_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "load.csv"
    path.write_text("t,fx,fy,m\n1,10,0,0\n2,20,0,0\n3,3")
    files = Files([path], follow=True)
    files.start(["load"])

    def read() -> list[float | None]:
        contents = [arrived.content for arrived in files.poll(0.0)]
        return [None if content is None else float(content.get("fx", math.nan)) for content in contents]

    assert read() == [10.0, 20.0]
    path.write_text("4,40,0,0\n")  # the file is truncated within a line, and its writer continues without a header
    assert read() == [None, 40.0]
    path.rename(tmp_path / "load.csv.1")
    with (tmp_path / "load.csv.1").open("a") as stream:
        stream.write("5,50,0,0\n")  # the writer does not notice that the file was truncated
    assert read() == [50.0]
    path.write_text("m;fx;t;fy\n0;60;6;0\n")
    assert read() == [60.0]
    path.write_text("0,7\n0,70,7,0\n")  # the file was truncated within a line; the second half of this line is ignored
    assert read() == [None, 70.0]
    path.write_text("t,fx,fy,m\n" + "8,80,0,0\n" * 3)  # the file is written again and becomes longer than before
    assert read() == [80.0] * 3
    path.unlink()
    assert read() == []
    path.write_text("a,b\n1,2\n")
    assert repr(read()) == "[nan]"  # the new header contains no load, so the row contains none
    files.close()


def test_lines_on_standard_input_are_used_and_a_silence_is_held(tmp_path: Path) -> None:
    arguments = ("-", "--record", str(tmp_path / "run"), "--set", "excitation_timeout=0.05")
    with _live(*arguments, stdin=subprocess.PIPE) as live:
        assert live.process.stdin is not None
        for index in range(100):
            t, fx, fy, m = _row(index)
            live.process.stdin.write(json.dumps({"t": t, "fx": fx, "fy": fy, "m": m}).encode() + b"\n")
        live.process.stdin.write(b'{"t": NaN}\n[1, 2]\n')
        live.process.stdin.flush()
        values = live.until(lambda heard: int(heard["input"]["values"]["holds"]) > 0, "a hold")
        live.process.stdin.close()
        assert (values["samples_used"], values["dropped_malformed"]) == ("100", "2")
        assert values["newest_sample_age_s"] == ""  # the stamps count from the start of the source
        live.process.stdin = None
        live.process.communicate(timeout=60.0)
        assert live.process.returncode == 3  # two lines were not used, and the exit code shows a loss
    report = replay(tmp_path / "run")
    assert (report.samples, report.exit_code) == (100, 0)


def test_a_closed_standard_input_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # Python sets `sys.stdin` to None if it is closed
    with pytest.raises(BridgeError, match="closed standard input"):
        StandardInput()


class Endless:
    """Endless samples at 1 kHz with poses and speeds in between. `look` is called before each batch."""

    def __init__(self, look: Callable[[int], bool]) -> None:
        self.ends = self.finished = False
        self.connected = True
        self.lost, self.trouble = 0, ""
        self._look, self._index, self._begin = look, 0, time.time()

    def topics(self) -> dict[str, Columns]:
        return {"load": Columns(("t", "fx", "fy", "m", "x", "y", "theta", "speed"))}

    def start(self, topics: list[str], stamp_ns: object = None) -> None:
        pass

    def poll(self, timeout_s: float) -> list[Arrived]:
        self.finished = self._look(self._index)
        rows = []
        for _ in range(20):
            t, *load = _row(self._index)
            row: dict[str, Any] = dict(zip(("t", "fx", "fy", "m"), (self._begin + t, *load), strict=True))
            row |= dict(
                zip(("x", "y", "theta"), (1e-3, 1e-3, 0.0) if self._index % 10 == 0 else ("",) * 3, strict=True)
            )
            row["speed"] = 1.0 if self._index % 100 == 0 else ""
            rows.append(Arrived("load", time.time_ns(), row))
            self._index += 1
        # every 50th batch is in reverse order, so some rows are late
        return rows[::-1] if self._index % 1000 == 0 else rows

    def close(self) -> None:
        pass


@pytest.mark.stress
def test_the_memory_of_a_long_run_is_bounded_except_for_the_index_of_the_recording(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text("excitation: {topic: load}\nhead_pose: {topic: load}\ntravel: {topic: load}\n")
    parameters_of_run = {
        "record_path": str(tmp_path / "run"),
        "alarm_force": [1e3, 1e9],
        "alarm_residual": [0.015, 0.0],
    }
    settings = parameters.settings(parameters_of_run | {"jump_forward": 3600.0, "excitation_timeout": 3600.0})
    memory: list[tuple[int, int, int]] = []

    def look(index: int) -> bool:
        if index and index % 8000 == 0:
            recording = front.runtime.recording
            assert recording is not None
            until(lambda: not recording.recorder.counters.queued, "an empty queue")
            gc.collect()
            writer = recording.recorder._writer
            assert isinstance(writer, RunWriter)
            index_bytes = len(writer._part.file._chunk_index)
            memory.append((len(gc.get_objects()), tracemalloc.get_traced_memory()[0] - index_bytes, index_bytes))
        return len(memory) == 3

    prepared = Preparation(settings).result(lambda: False)
    front = BridgeFront(Endless(look), tmp_path / "map.yaml", settings, prepared, lambda *_: None, pytest.fail)
    tracemalloc.start()
    try:
        assert front.run(lambda: False) == []
    finally:
        tracemalloc.stop()
    (_, _, _), (objects, size, before), (more, larger, after) = memory
    # between the measurements, 8,000 samples and 25,000 messages pass; the number of objects varies by some hundreds
    assert more - objects < 800 and larger - size < 100_000, memory
    # before a part ends, its index grows by about 140 B for each chunk, which is 2 MB per hour
    assert 0 < after - before < 20_000
    figures = front.parts()["input"][2]
    assert int(figures["samples_used"]) == int(figures["samples_in"]) and int(figures["rolled_back"]) > 0


def test_a_refusal_by_the_system_is_a_warning_and_the_other_settings_apply() -> None:
    code = """
import os, resource
from dataclasses import replace
from plow_twin.live.parameters import settings
from plow_twin.live.realtime import apply_realtime, raise_priority
asked, wrong = settings({"priority": 50, "lock_memory": True}), settings({"cpu_affinity": "0,x"})
for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
    resource.setrlimit(limit, (0, 0))
if os.getuid() == 0:
    os.setresuid(65534, 65534, 65534)
one = min(os.sched_getaffinity(0))
print(*raise_priority(asked), *apply_realtime(replace(asked, cpu_affinity=str(one))), sep="\\n")
print(*apply_realtime(wrong), sep="\\n")
print(os.sched_getaffinity(0) == {one})
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    completed = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    lines = completed.stdout.splitlines()
    assert [line.partition(" ")[0].rstrip(":") for line in lines] == ["priority", "lock_memory", "cpu_affinity", "True"]


def test_a_stop_during_the_imports_is_a_normal_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("the signal was ignored")

    monkeypatch.setattr("plow_twin.cli.live._live", stopped)
    assert run_cli(["live", "-"]) == 0


def test_the_priority_is_for_the_computing_thread_alone() -> None:
    code = """
import os, sys
from threading import Thread
from plow_twin.live.parameters import settings
from plow_twin.live.realtime import raise_priority
refused = raise_priority(settings({"priority": 1}))
found = []
thread = Thread(target=lambda: found.append(os.sched_getscheduler(0)))
thread.start()
thread.join()
if not (child := os.fork()):
    os._exit(os.sched_getscheduler(0) != os.SCHED_OTHER)
normal = [os.SCHED_OTHER] == found and os.waitpid(child, 0)[1] == 0
print(bool(refused) or os.sched_getscheduler(0) == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, normal)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    completed = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert completed.stdout.split() == ["True", "True"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["nowhere.csv"], 1, "no such file"),
        (["load.csv", "--set", "excitation_timeot=1"], 2, "did you mean excitation_timeout"),
        (["load.csv", "--set", "excitation_timeout=-1"], 2, "a number from 0.01"),
        (["load.csv", "--set", "excitation_source=tool_forces"], 1, "expected 'excitation' or 'scene'"),
        (["other.csv"], 1, "expected the columns fx, fy, m"),
        (["twice.csv"], 1, "column 'fx' occurs more than once"),
        (["load.csv", "--map", "twice.yaml"], 2, "the key twice, in lines 1 and 2"),
        (["junk.csv"], 1, "\\x1b"),
        (["wide.csv"], 2, "10001 columns, expected at most 10000"),
        (["mqtt://localhost:1"], 1, "expected a mapping that assigns the topics"),
    ],
)
def test_a_message_about_a_wrong_call_states_the_expected_call(
    arguments: list[str],
    code: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    _csv(tmp_path / "load.csv", 3)
    (tmp_path / "other.csv").write_text("t,a,b\n1,2,3\n")
    (tmp_path / "wide.csv").write_text("t" + ",c" * 10_000 + "\n")
    (tmp_path / "twice.csv").write_text("t,fx,fx,fy,m\n1,2,3,4,5\n")
    (tmp_path / "twice.yaml").write_text("excitation: {topic: load}\nexcitation: {topic: other}\n")
    (tmp_path / "junk.csv").write_bytes(b"\x1b[31m" + bytes(range(256)) * 100)
    assert run_cli(["live", *arguments, "--quiet"]) == code
    assert message in " ".join(capfd.readouterr().err.split())


def test_prometheus_reads_the_numbers_of_the_diagnostics(tmp_path: Path) -> None:
    path, port = _csv(tmp_path / "load.csv", 100, start=time.time()), free_port()
    url, first = f"http://127.0.0.1:{port}/metrics", b""
    with _live(str(path), "--follow", "--metrics", str(port), "--set", "excitation_timeout=3600") as live:
        give_up = time.monotonic() + 120.0
        while not first:
            with suppress(URLError), urlopen(url, timeout=30.0) as page:
                first = page.read()
                assert b"plow_twin_state_level" in first  # already in the first answer
            assert time.monotonic() < give_up
            time.sleep(0.02)
        live.until_count("samples_used", 100)
        with urlopen(url, timeout=30.0) as page:
            metrics = dict(line.split() for line in page.read().decode().splitlines() if not line.startswith("#"))
        assert (metrics["plow_twin_input_samples_used"], metrics["plow_twin_state_level"]) == ("100.0", "0.0")
        assert "plow_twin_state_scene" not in metrics  # texts are not exported
        board = (ROOT / "config" / "grafana.json").read_text()
        shown = set(re.findall(r"plow_twin_\w+", " ".join(_expressions(json.loads(board)))))
        assert len(shown) > 15 and shown <= metrics.keys(), shown - metrics.keys()
        assert run_cli(["live", str(path), "--metrics", str(port), "--quiet"]) == 1  # the port is in use
        assert live.stop() == 0


def test_silent_readers_of_metrics_are_limited() -> None:
    port = free_port()
    with Metrics(port, {"state": (0, "", {"model_time_s": "1.5"})}), ExitStack() as opened:
        idle = [opened.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(40)]
        closed: list[socket.socket] = []
        while len(closed) < 24:
            closed, _, _ = select.select(idle, [], [], 30.0)
            assert closed
        assert len(closed) == 24 and not any(one.recv(1) for one in closed)
        opened.close()
        give_up = time.monotonic() + 30.0
        while True:
            try:
                with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=30.0) as page:
                    assert b"plow_twin_state_model_time_s 1.5" in page.read()
                break
            except OSError:  # the server has not noticed yet that the idle connections are closed
                assert time.monotonic() < give_up


def _expressions(board: dict[str, Any]) -> list[str]:
    return [target["expr"] for panel in board["panels"] for target in panel["targets"]]


def test_impossible_poses_gaps_and_speeds_are_not_used() -> None:
    used: list[Any] = []
    inputs = Inputs(cast(Any, None), "excitation", 10, 2.0, journaled=False)
    inputs.active = inputs.started = True
    inputs.set_limits(value_limits(2.0, 1.0), pose_limits(load_scene("paper"), 0.05, 0.7), value_limits(0.1, 1.0))
    second = 10**9
    # the speed 2.5 is too large, and the change to -1.7 is too fast
    for at, speed in ((1, 0.5), (2, 1.4), (3, 2.5), (4, -1.7), (5, 0.0)):
        used += [speed] if inputs.uses_travel(at * second, speed) else []
    assert used == [0.5, 1.4, 0.0] and inputs.travel.counts[Verdict.IMPLAUSIBLE] == 2
    used.clear()
    nan = math.nan
    poses = [(0.01, 0.0, 0.0), (0.04, nan, 0.0), (0.02, 0.06, 0.0), (-0.04, 0.0, 0.0), (nan, 0.001, 0.0)]
    for at, pose in enumerate(poses):  # y of the third pose is too large, and x of the fourth pose changes too fast
        used += [pose] if inputs.uses_pose(second + at * 50_000_000, pose) else []
    assert [pose[0] for pose in used[:2]] == [0.01, 0.04] and used[2][1] == 0.001 and len(used) == 3
    assert inputs.head_pose.counts[Verdict.IMPLAUSIBLE] == 2
    used.clear()
    # the second message lacks pair 3, so the change of pair 3 is computed from the first and the third message
    for at, gaps in enumerate([{1: 0.01, 3: 0.01}, {1: 0.02}, {3: 0.09, 1: 0.02}, {1: 0.11}, {3: 0.05, 1: 0.03}]):
        used += [gaps] if inputs.uses_gaps(second + at * 20_000_000, gaps) else []
    assert used == [{1: 0.01, 3: 0.01}, {1: 0.02}, {3: 0.05, 1: 0.03}]
    assert inputs.gaps.counts[Verdict.IMPLAUSIBLE] == 2


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("t,fx,fy,m\n", 3, "topic load: got no sample, expected at least one"),
        ("t,fx,fy,m\n" + "1.0,inf,2.0,3.0\n" * 40, 3, "40 loads have a number that is not finite (nan or inf)"),
        ("0.0,1.0,2.0,3.0\n0.1,1.0,2.0,3.0\n", 1, "columns 0.0, 1.0, 2.0, 3.0 (no header row?)"),
    ],
)
def test_an_input_without_a_sample_or_without_a_header_is_named(
    text: str, code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "load.csv").write_text(text)
    assert run_cli(["live", str(tmp_path / "load.csv"), "--quiet"]) == code
    shown = capsys.readouterr().err
    assert message in shown and "no --scene: the preset paper is used" in shown


def test_every_view_of_a_run_reports_failed_advances(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, run = _csv(tmp_path / "load.csv", 720, times=3.0), tmp_path / "run"
    assert run_cli(["live", str(path), "--scene", "paper", "--record", str(run)]) == 3
    errors = capsys.readouterr().err
    assert "10 advances failed, without forces from 0.681 s to 0.690 s: the head turned to -45.3 degrees" in errors
    assert "the model is valid up to 45; then the head was set to the initial position, with its wear" in errors
    for arguments in (["info"], ["doctor"]):
        code = run_cli([*arguments, str(run), "--json"])
        assert (code, json.loads(capsys.readouterr().out)["failed_advances"]) == (3 * (arguments == ["info"]), 10)
    for arguments in ([], ["--png", str(tmp_path / "run.png")]):
        assert run_cli(["view", str(run), *arguments]) == 3
        assert "10 advances failed" in capsys.readouterr().err
    curves = RunCurves.of(RunReader(run))
    assert np.allclose(curves.failed_s, [(0.681, 0.690)]) and curves.failed == 10
    assert replay(run).exit_code == 0


def test_every_view_reports_a_silence_in_a_file_and_no_loss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, run, page = _csv(tmp_path / "load.csv", 2000), tmp_path / "run", tmp_path / "run.html"
    rows = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(rows[:301] + rows[1001:1201] + rows[1701:]), encoding="utf-8")
    assert run_cli(["live", str(path), "--scene", "paper", "--record", str(run), "--json"]) == 0
    shown = capsys.readouterr()
    named = "1.202 s without samples, in 2 stretches, the longest from 0.299 s to 1.000 s after the first"
    assert named in shown.err
    counted = json.loads(shown.out)["input"]
    assert (counted["silences"], counted["silent_s"], counted["holds"]) == ("2", "1.202", "0")
    assert run_cli(["info", str(run), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["without_samples"] == {
        "count": 2,
        "total_s": pytest.approx(1.202),
        "longest_from_s": pytest.approx(0.299),
    }
    curves = RunCurves.of(RunReader(run))
    assert np.allclose(curves.held_s, [(0.299, 1.0), (1.199, 1.7)])
    for envelope in (curves.force, curves.load, curves.clearance):
        assert np.isnan(envelope.bands(0)[0]).sum() == 2
    assert run_cli(["view", str(run), "--html", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert named in text and "No loss was counted" not in text
    assert run_cli(["analyse", str(run)]) == 0
    assert f"{named}; in these intervals the load is interpolated linearly" in capsys.readouterr().out.replace("\n", "")


def test_a_hole_in_a_file_that_is_longer_than_jump_forward_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "load.csv"
    rows = [",".join(map(repr, _row(index))) for index in (*range(100), *range(20_100, 20_200))]
    path.write_text("t,fx,fy,m\n" + "\n".join(rows) + "\n", encoding="utf-8")
    assert run_cli(["live", str(path), "--json"]) == 0
    shown = capsys.readouterr()
    assert "the stamps jumped forward (1) by more than jump_forward (10 s), and the motion was reset" in shown.err
    assert json.loads(shown.out)["input"]["jumps_forward"] == "1"


def test_a_sample_that_is_late_by_less_than_rollback_span_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "load.csv"
    rows = [",".join(map(repr, _row(index))) for index in (*range(300), *range(301, 2200), 300, *range(2200, 2300))]
    path.write_text("t,fx,fy,m\n" + "\n".join(rows) + "\n", encoding="utf-8")
    assert run_cli(["live", str(path), "--json"]) == 0
    counted = json.loads(capsys.readouterr().out)["input"]
    assert (counted["samples_used"], counted["rolled_back"]) == ("2300", "1")


@pytest.mark.parametrize(
    ("step_s", "code", "unused"),
    [(2.005, 0, "with earlier samples (43) or dropped (0 duplicate, 0"), (2.0, 3, "(3) or dropped (40 duplicate, 0")],
)
def test_a_step_back_of_the_clock_within_jump_back_is_named(
    step_s: float, code: int, unused: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [0.01 * index - (step_s if index >= 240 else 0.0) for index in range(280)]
    rows = [f"{t:.3f},{','.join(map(repr, _row(10 * index)[1:]))}" for index, t in enumerate(times)]
    rows[100], rows[103] = rows[103], rows[100]  # two samples that arrive in another order are no step
    (path := tmp_path / "load.csv").write_text("t,fx,fy,m\n" + "\n".join(rows) + "\n")
    assert run_cli(["live", str(path), "--scene", "paper", "--quiet"]) == code
    shown = capsys.readouterr().err
    assert f"the stamps stepped back (1) by up to {step_s - 0.01:.4g} s" in shown and unused in shown
    assert "too few digits" not in shown


@pytest.mark.parametrize("name", ["timestamp", "Time", "time_s", "Stamp", "Zeit [ms]", "t_us"])
def test_live_and_analyse_recognise_the_same_column_of_times(name: str, tmp_path: Path) -> None:
    scale = {"Zeit [ms]": 1e3, "t_us": 1e6}.get(name, 1.0)
    rows = [f"{fx},{fy},{m},{scale * t:.0f}" for t, fx, fy, m in map(_row, range(0, 300_000, 1000))]
    (path := tmp_path / "load.csv").write_text(f"fx,fy,m,{name}\n" + "\n".join(rows) + "\n")
    counted = _run(path, record_path=str(tmp_path / "run"))["input"][2]
    assert (counted["samples_in"], counted["samples_used"]) == ("300", "300")
    for recording, scene in ((tmp_path / "run", None), (path, scene_path("paper"))):
        assert analyse(recording, scene=scene).predictions[0].loads.duration_s == pytest.approx(299.0)


@pytest.mark.parametrize("command", [["live"], ["analyse"], ["live", "--follow", "--seconds", "5"]])
@pytest.mark.parametrize("header", ["clock,fx,fy,m", "time_s,fx,fy,m,time_ms"])
def test_a_file_without_one_column_of_times_is_refused(
    command: list[str], header: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path := tmp_path / "load.csv").write_text(header + "\n" + "0,1,2,3,4\n"[: 2 * header.count(",") + 1] + "\n")
    assert run_cli([*command, str(path), "--scene", "paper"]) == 1
    expected = "expected one column with a name such as t, time, timestamp or stamp, also with a unit such as time_ms"
    assert f"load: time: got the columns {header.replace(',', ', ')}, {expected}" in capsys.readouterr().err
    (mapping := tmp_path / "map.yaml").write_text("excitation: {topic: load, stamp: log}")
    if command == ["live"]:
        assert run_cli(["live", str(path), "--scene", "paper", "--map", str(mapping)]) == 1
        assert "excitation.stamp: got 'log', expected a column" in capsys.readouterr().err


@pytest.mark.parametrize(("setting", "reported"), [("follow=full", True), ("follow=parameters", False)])
def test_a_file_is_read_at_the_speed_of_the_following_twins_and_a_message_says_so(
    setting: str, reported: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _csv(tmp_path / "load.csv", 50)
    options = ["--set", "estimate=true", "--set", setting, "--set", "follow_members=20"]
    # exit code 3: there are not enough data for an estimate
    assert run_cli(["live", str(path), "--scene", "paper", *options]) == 3
    assert ("20 twins follow the machine" in capsys.readouterr().err) == reported
    if not reported:
        assert run_cli(["live", str(path), "--scene", "paper", *options, "--follow", "--seconds", "0.5"]) == 0
        assert "no estimate was made, because the run ended too early" in capsys.readouterr().err


def _mistaken(name: str) -> str:
    """Return a file with a mistake that a plant engineer may make."""
    rows = [_row(index)[1:] for index in range(3000)]
    lines = {
        "decimal commas": lambda t, f: f"{t:.3f},{f[0]:.1f},{f[1]:.1f},{f[2]:.1f}".replace(".", ","),
        "local dates": lambda t, f: f"25.10.2026 02:59:{t:06.3f},{f[0]},{f[1]},{f[2]}",
        "coarse times": lambda t, f: f"{t:.1f},{f[0]},{f[1]},{f[2]}",
        "milliseconds since 1970": lambda t, f: f"{1.764e12 + 1e3 * t:.1f},{f[0]},{f[1]},{f[2]}",
        "newest first": lambda t, f: f"{100.0 - t},{f[0]},{f[1]},{f[2]}",
        "swapped": lambda t, f: f"{f[0]},{t},{f[1]},{f[2]}",
        "days": lambda t, f: f"{45000.0 + t / 86400.0:.9f},{f[0]},{f[1]},{f[2]}",
        "km/h": lambda t, f: f"{t},{f[0]},{f[1]},{f[2]},7.2",
        "bars": lambda t, f: f"{t}|{f[0]}|{f[1]}|{f[2]}",
        "summer time": lambda t, f: f"2026-10-25T02:{59 * (t < 1.0):02d}:{t - (t >= 1.0):09.6f},{f[0]},{f[1]},{f[2]}",
    }
    text = "\n".join(lines[name](1e-3 * index, load) for index, load in enumerate(rows))
    header = {"km/h": "t,fx,fy,m,speed", "bars": "t|fx|fy|m"}.get(name, "t,fx,fy,m")
    return f"{header}\n{text}\n"


@pytest.mark.parametrize(
    ("name", "code", "message"),
    [
        ("decimal commas", 3, "3000 malformed; the first: load has a line without the 4 cells of its header"),
        ("local dates", 3, "load has no time at 't': got '25.10.2026 02:59:00.000', expected a number or a date"),
        ("milliseconds since 1970", 3, "got '1764000000000.0', expected seconds; they look like ms: state the unit"),
        ("coarse times", 3, "samples have the stamp or number of another sample: do the times have too few digits?"),
        ("newest first", 2, "they look like rows from the newest to the oldest: sort the rows by time"),
        ("swapped", 2, "t: got stamps of which"),
        ("days", 2, "they look like days of a spreadsheet: write seconds, or dates"),
        ("km/h", 2, "speed: got 7.2, expected at most 5 m/s, as ploughs reach; they look like km/h"),
        ("bars", 1, "fx|fy|m (expected commas, semicolons or tabs between them)), expected the columns fx, fy, m"),
        ("summer time", 0, "the stamps jumped back (1), and the motion was reset: are they in local time"),
    ],
)
def test_a_natural_mistake_in_a_file_is_named(
    name: str, code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "load.csv").write_text(_mistaken(name))
    assert run_cli(["live", str(tmp_path / "load.csv"), "--scene", "paper", "--quiet"]) == code
    assert message in capsys.readouterr().err


def test_utf16_a_used_folder_and_a_threshold_in_kilonewtons_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _csv(tmp_path / "load.csv", 100)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    words = ["live", str(path), "--scene", "paper", "--quiet", "--set", "alarm_force=[160, 220]"]
    assert run_cli([*words, "--record", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().err
    assert f"run is not empty: the recording is written to {tmp_path / 'run_2'}" in shown
    assert "alarm_force: got 160 N, expected about 3.2e+04 N as in the scene; is it in kN?" in shown
    path.write_text(path.read_text(), encoding="utf-16")
    assert run_cli(words) == 1
    assert "load.csv: got UTF-16 text, expected UTF-8" in capsys.readouterr().err


def _troubled_rows(seed: int, count: int) -> Iterator[str]:
    """Yield rows of a file: mostly a continuous load, sometimes unusual rows."""
    rng = np.random.default_rng(seed)
    kinds = ["gap", "late", "twice", "stray", "text", "empty", "wild", "pose", "header", "integer", "triple"]
    stamp = 500.0
    for row_number in range(count):
        kind = "back" if row_number == count // 2 else str(rng.choice([*["usual"] * 600, *kinds]))
        stamp += 5.0 if kind == "gap" else 1e-3
        load = np.sin(2.0 * stamp) * np.array(PAPER_AMPLITUDE) * (3.0 if kind == "triple" else 1.0)
        at = {"late": stamp - rng.integers(2, 300) * 1e-3, "stray": stamp + 100.0, "back": stamp - 50.0}.get(
            kind, stamp
        )
        stamp = at if kind == "back" else stamp
        row = ",".join([f"{at:.6f}", *(f"{value:.3f}" for value in load)]) + ",,,"
        match kind:
            case "twice":
                row += "\n" + row
            case "text":
                row = "no numbers at all"
            case "empty":
                row = f"{at:.6f},,,,,,"
            case "wild":
                row = f"{at:.6f},1e9,0,0,,,"
            case "pose":
                row = f"{at:.6f},,,,0.001,,0.002"
            case "header":
                row = "t,fx,fy,m,x,y,theta"
            case "integer":
                row = f"{int(at)},0,0,0,,,"
        yield row + "\n"


def _recorded(run: Path) -> tuple[list[Any], list[Any]]:
    """Return journal and outputs of a recording, with the number of entries before each output.

    Messages and entries that depend on the wall clock are omitted: the status, and the times of unused messages.
    """
    entries: list[EntryRecord] = []
    outputs = []
    for batch in RunReader(run).batches():
        records = [batch.entries.record(index) for index in range(len(batch.entries))]
        entries += [record for record in records if not isinstance(record.entry, Unused)]
        outputs += [part.record(index) for part in batch.outputs for index in range(len(part))]
    numbers = [record.sequence for record in entries]
    times = [
        (bisect_right(numbers, record.sequence), record.topic, record.data)
        for record in outputs
        if record.topic != "/status"
    ]
    return [record.entry for record in entries], times


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("parameters_of_run", [{}, {"record_outputs": "decimated"}])
def test_a_file_gives_the_same_journal_outputs_and_counts_in_batches_as_row_by_row(
    seed: int, parameters_of_run: dict[str, Any], tmp_path: Path
) -> None:
    columns = "t,fx,fy,m" if seed % 2 else "t,fx,fy,m,x,y,theta"
    rows = [line.removesuffix(",,,\n") + "\n" if seed % 2 else line for line in _troubled_rows(seed, 4000)]
    path = tmp_path / "load.csv"
    path.write_text(f"{columns}\n{''.join(rows)}")
    runs = []
    for name in ("together", "single"):
        values = parameters_of_run | {"record_path": str(tmp_path / name), "alarm_force": [1e3, 1e5]}
        settings = parameters.settings(values)
        prepared = Preparation(settings).result(lambda: False)
        front = BridgeFront(Files([path], follow=False), None, settings, prepared, lambda *_: None, pytest.fail)
        if name == "single":
            # an observer receives each sample, so with an observer the samples are processed one by one
            front.attach(_Onlooker())
        front.run(lambda: False)
        figures = front.parts()
        counts = {key: figures["input"][2][key] for key in figures["input"][2] if not key.endswith(("_s", "_ms"))}
        digest = front.runtime.driver.session.twin.digest()
        published = front.runtime.publishing
        runs.append((*_recorded(tmp_path / name), counts, digest, published.published, published.latency.count))
        assert replay(tmp_path / name).exit_code == 0
    together, single = runs
    assert len(together[0]) == len(single[0]) > 3500
    for one, other in zip(together, single, strict=True):
        assert one == other


class _Onlooker:
    """An observer without methods of its own."""

    def publication(self, published: Any) -> None: ...
    def part(self, name: str, part: Part) -> None: ...


def test_a_stop_before_the_end_of_a_file_is_a_loss(tmp_path: Path) -> None:
    path = _csv(tmp_path / "load.csv", 3000)
    prepared = Preparation(parameters.settings({})).result(lambda: False)
    front = BridgeFront(Files([path], follow=False), None, parameters.settings({}), prepared, lambda *_: None, str)
    stops = iter([False, False, True])
    assert front.run(lambda: next(stops, True)) == ["stopped before the end of load"]
    assert 0 < int(front.parts()["input"][2]["samples_used"]) < 3000
