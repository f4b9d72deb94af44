"""Parquet instead of CSV files: equal numbers, times in any zone, and files that are too large when unpacked."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet
from record_support import PAPER_AMPLITUDE

from plow_twin.cli.app import run as cli
from plow_twin.record import measured
from plow_twin.record.column_guess import guess_columns
from plow_twin.record.mapping import messages_of, read_map, readings
from plow_twin.record.measured import read_measured, read_recording
from plow_twin.record.reader import RunReader
from plow_twin.record.sources import open_source
from plow_twin.record.times import time_ns
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.csv_rows import csv_rows, open_csv
from plow_twin.scene_file.parquet_lines import ParquetLines
from plow_twin.study.calibration.pose_recording import load_poses

UTC_NS = pa.timestamp("ns", "UTC")
BEGIN_NS = 1_767_322_999_123_456_789  # 2026-01-02T03:03:19 UTC
MAP = """excitation:
  {topic: plant, fields: {fx: "Kraft x [kN]", fy: Kraft y, m: M}, unit: {fx: kN, fy: kN}, stamp: Zeit}
head_pose: {topic: plant, fields: {x: x}, stamp: Zeit}
"""


def _table(count: int, kind: pa.DataType = UTC_NS) -> pa.Table:
    """Return the paper's load at 1 kHz, with forces in kN, and a pose in which every tenth value is missing."""
    phase = np.sin(2e-3 * np.arange(count))
    fx, fy, m = (phase * amplitude for amplitude in PAPER_AMPLITUDE)
    stamps = pa.array(BEGIN_NS + 1_000_000 * np.arange(count), pa.timestamp("ns"))
    x: list[Any] = [None if index % 10 == 0 else 1e-3 * float(phase[index]) for index in range(count)]
    return pa.table(
        {
            "Zeit": stamps.cast(kind, safe=False),
            "Kraft x [kN]": 1e-3 * fx,
            "Kraft y": 1e-3 * fy,
            "M": m,
            "x": pa.array(x, pa.float64()),
            "remark": ['"a, b"'] * count,
            "waveform": [[1.0, 2.0]] * count,
        }
    )


def _samples(run: Path) -> list[tuple[int, list[float]]]:
    parts = [batch.entries.samples() for batch in RunReader(run).batches(outputs=False)]
    return [row for stamps, wrench in parts for row in zip(stamps.tolist(), wrench.tolist(), strict=True)]


def _read(path: Path, mapping: Path) -> list[tuple[str, int, dict[str, float]]]:
    source = open_source(path)
    roles = read_map(mapping, source.topics())
    return [(name, *found) for name, _, found in readings(messages_of(source, roles), roles) if found is not None]


ZONES = ("UTC", "Europe/Berlin", "America/Denver", "+05:30", None)


def test_a_file_of_a_historian_gives_the_same_run_as_its_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.yaml").write_text(MAP)
    (tmp_path / "lines").mkdir()
    table = _table(3000, pa.timestamp("ns", "Europe/Berlin"))
    parquet.write_table(table, tmp_path / "plant.parquet", row_group_size=700)
    plain = table.drop_columns(["waveform"]).set_column(0, "Zeit", table["Zeit"].cast(pa.timestamp("ns", "UTC")))
    csv.write_csv(plain, tmp_path / "lines" / "plant.csv")
    runs = []
    for file in ("plant.parquet", "lines/plant.csv"):
        run = tmp_path / f"run_{len(runs)}"
        words = ["live", str(tmp_path / file), "--map", str(tmp_path / "map.yaml"), "--scene", "paper"]
        assert cli([*words, "--record", str(run), "--json"]) == 0
        runs.append(json.loads(capsys.readouterr().out)["input"])
        assert cli(["replay", str(run), "-q"]) == 0
    capsys.readouterr()
    assert runs[0] == runs[1] and runs[0]["samples_used"] == "3000"
    ours, theirs = (_samples(tmp_path / f"run_{number}") for number in (0, 1))
    assert ours == theirs and ours[0][0] == BEGIN_NS  # the stamps are equal to the nanosecond


def test_instants_are_the_same_in_each_zone_and_naive_times_are_utc(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP)
    readings = []
    for unit, precision_ns in (("ns", 1), ("us", 1000)):
        for zone in ZONES:
            table = _table(50)
            stamps = table["Zeit"].cast(pa.int64()).to_numpy() // precision_ns
            table = table.set_column(0, "Zeit", pa.array(stamps).cast(pa.timestamp(unit, zone)))
            parquet.write_table(table, tmp_path / "plant.parquet", version="2.6")
            read = _read(tmp_path / "plant.parquet", tmp_path / "map.yaml")
            assert [stamp for name, stamp, _ in read if name == "excitation"] == (stamps * precision_ns).tolist()
            readings.append([(name, values["fx"]) for name, _, values in read if name == "excitation"])
    assert all(rows == readings[0] for rows in readings)
    # dates as texts give equal times
    assert time_ns("2026-01-02T03:03:19.123456789Z") == time_ns("2026-01-02 04:03:19.123456789+01:00") == BEGIN_NS
    assert time_ns("2026-01-02 03:03:19.1234567") == BEGIN_NS - 89
    assert time_ns("2026-01-02T03:03:19.123Z") == BEGIN_NS - 456_789


def test_missing_values_are_empty_and_numbers_exact_and_lists_are_omitted(tmp_path: Path) -> None:
    path = tmp_path / "any.parquet"
    table = pa.table(
        {
            "a": pa.array([0.1, None, float("inf")]),
            "b": pa.array([0.1, 1e-30, 2.0], pa.float32()),
            "c": pa.array([2**62 + 1, None, 3]),
            "d": pa.array(["x", "y", "x"]).dictionary_encode(),
            "e": pa.array([1500, 2500, None], pa.duration("ms")),
            "f": [[1], [2], [3]],
            "g": [b"\xff", b"", b""],
            "h": pa.array([datetime(2026, 1, 1, tzinfo=UTC)] * 3, pa.timestamp("s", "Asia/Tokyo")),
        }
    )
    parquet.write_table(table, path)
    with open_csv(path) as stream:
        head, *rows = (cells for _, cells in csv_rows(stream))
    assert head == ["a", "b", "c", "d", "e", "h"]
    assert rows[0] == ["0.1", repr(float(np.float32(0.1))), str(2**62 + 1), "x", "1.5", "2026-01-01 00:00:00.000Z"]
    assert rows[1][0] == rows[1][2] == "" and float(rows[1][1]) == float(np.float32(1e-30))
    assert rows[2][:1] + rows[2][4:5] == ["inf", ""]


def test_the_estimates_folder_calibration_and_setup_take_parquet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = 1e-3 * np.arange(200)
    load = pa.table({"t": seconds, "fx": seconds, "fy": 2.0 * seconds, "m": 3.0 * seconds})
    pose = pa.table({"t": seconds, "x": 1e-3 * seconds, "y": pa.array([None] * 200, pa.float64()), "theta": seconds})
    for folder, ending, write in (("p", "parquet", parquet.write_table), ("c", "csv", csv.write_csv)):
        (tmp_path / folder).mkdir()
        write(load, tmp_path / folder / f"load.{ending}")
        write(pose, tmp_path / folder / f"pose.{ending}")
    recordings = [read_measured(tmp_path / folder, Path("paper")) for folder in ("p", "c")]
    np.testing.assert_array_equal(recordings[0].load, recordings[1].load)
    np.testing.assert_array_equal(recordings[0].poses, recordings[1].poses)
    assert len(recordings[0].load) == 200 and np.isnan(recordings[0].poses[:, 2]).all() and not recordings[0].unreadable
    (tmp_path / "c" / "load.csv").rename(tmp_path / "c" / "excitation.csv")
    # if there are too many rows, the newest are used, and the others are counted
    with monkeypatch.context() as patched:
        patched.setattr(measured, "MOST_ROWS", 50)
        newest = read_measured(tmp_path / "p", Path("paper")), read_recording(tmp_path / "c", Path("paper"))
    for one in newest:
        assert one.lost == {"older_rows": 300} and len(one.poses) == 50
        np.testing.assert_array_equal(one.load[:, 1:], recordings[0].load[150:, 1:])
    parquet.write_table(pose.set_column(2, "y", pa.array(seconds)), tmp_path / "motion.parquet")
    assert load_poses(tmp_path / "motion.parquet").q.shape == (200, 3)

    table = _table(600, pa.timestamp("us", "Europe/Berlin"))
    parquet.write_table(table.drop_columns(["x"]), tmp_path / "plant.parquet")
    guess = guess_columns(tmp_path / "plant.parquet", load_scene("paper"), {}, {})
    assert (guess.time, guess.open) == ("Zeit", {})
    assert guess.columns["excitation", "fx"] == "Kraft x [kN]" and guess.units["fx"] == "kN"
    words = [
        "setup",
        str(tmp_path / "plant.parquet"),
        "--column",
        "m=M",
        "--unit",
        "m=N m",
        "--out",
        str(tmp_path / "out"),
    ]
    assert cli(words) == 0 and "Parquet, a row each 0.001 s" in capsys.readouterr().out
    words = ["live", str(tmp_path / "plant.parquet"), "--map", str(tmp_path / "out" / "map.yaml"), "--scene", "paper"]
    assert cli([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["input"]["samples_used"] == "600"


def test_an_analysis_reads_a_folder_of_parquet_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = _table(2000)
    (tmp_path / "plant").mkdir()
    parquet.write_table(table.select(["Zeit", "Kraft x [kN]", "Kraft y", "M"]), tmp_path / "plant" / "load.parquet")
    parquet.write_table(table.select(["Zeit", "x"]), tmp_path / "plant" / "pose.parquet")
    mapping = MAP.replace("plant", "load.parquet", 1).replace("plant", "pose")
    (tmp_path / "map.yaml").write_text(mapping)
    words = ["--map", str(tmp_path / "map.yaml"), "--scene", "paper", "--json"]
    assert cli(["analyse", str(tmp_path / "plant"), *words]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["signals"] and whole["input"]["samples_used"] == 2000 and not whole["lossy"]
    # every tenth pose has no value, which is a loss, so the exit code is 3
    assert cli(["live", str(tmp_path / "plant"), *words]) == 3
    assert json.loads(capsys.readouterr().out)["input"]["samples_used"] == "2000"


def _rows(path: Path, count: int) -> None:
    parquet.write_table(pa.table({"t": pa.nulls(count), "fx": pa.nulls(count)}), path)


def _large_column(path: Path) -> None:
    values = pa.array(np.full(70_000_000, 7.0))
    parquet.write_table(
        pa.table({"fx": values}), path, use_dictionary=False, compression="zstd", row_group_size=10**9
    )  # fmt: skip


def test_invalid_or_excessive_parquet_gives_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {name: tmp_path / f"{name}.parquet" for name in ("rows", "columns", "column", "text", "empty", "cut")}
    _rows(files["rows"], 50_000_000)
    assert files["rows"].stat().st_size < 500_000
    parquet.write_table(pa.table({f"c{number}": [1.0] for number in range(10_001)}), files["columns"])
    _large_column(files["column"])
    files["text"].write_text("t,fx,fy,m\n0,1,2,3\n")
    files["empty"].write_bytes(b"")
    parquet.write_table(_table(1000), files["cut"])
    whole = files["cut"].read_bytes()
    files["cut"].write_bytes(whole[: len(whole) // 2])
    expected = {"rows": 2, "columns": 2, "column": 2, "text": 1, "empty": 1, "cut": 1}
    for name, code in expected.items():
        for words in (["live"], ["setup"], ["analyse", "--scene", "paper"], ["info", "--unit", "fx=kN"]):
            assert cli([*words, str(files[name])]) == code, (name, words)
            errors = capsys.readouterr().err
            lines = [line for line in errors.splitlines() if "no --scene" not in line]
            assert len(lines) == 1 and files[name].name in lines[0], (name, words, errors)
    parquet.write_table(_table(10), tmp_path / "good.parquet")
    assert cli(["live", str(tmp_path / "good.parquet"), "--follow"]) == 1
    assert "does not grow" in capsys.readouterr().err


def test_a_damaged_page_ends_the_rows_there_and_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, mapping = tmp_path / "plant.parquet", tmp_path / "map.yaml"
    mapping.write_text(MAP)
    table = _table(20_000).drop_columns(["waveform"])
    parquet.write_table(table, path, row_group_size=5000, write_page_checksum=True, compression="zstd")
    data = bytearray(path.read_bytes())
    place = parquet.ParquetFile(path).metadata.row_group(2).column(1).data_page_offset
    data[place + 40 : place + 4000] = bytes(3960)
    path.write_bytes(data)
    read = _read(path, mapping)
    assert sum(name == "excitation" for name, _, _ in read) == 8192  # complete blocks before the damage are read
    source = open_source(path)
    assert len(list(source.messages(lambda _: True))) == 8192 and source.losses.counts["truncated_files"] == 1
    assert cli(["live", str(path), "--map", str(mapping), "--scene", "paper"]) == 1
    assert "the rows from 8193 on cannot be read" in capsys.readouterr().err


def test_the_share_that_has_been_read_rises_to_one(tmp_path: Path) -> None:
    path = tmp_path / "plant.parquet"
    parquet.write_table(_table(20_000), path)
    with ParquetLines(path) as lines:
        places = [lines.tell()]
        while lines.read(1 << 18):
            places.append(lines.tell())
    assert places[0] == 0 and places == sorted(places) and len(set(places)) > 3
    assert places[-1] == path.stat().st_size


def test_a_number_beside_a_sign_that_only_python_strips_is_read(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_bytes(b"t,fx,fy,m\n0,1,2,-2\x1c\n1,1,2,\x1c\n")
    source = open_source(tmp_path / "load.csv")
    roles = read_map(None, source.topics())
    read = [found for _, _, found in readings(messages_of(source, roles), roles) if found is not None]
    assert read[0][1]["m"] == -2.0 and np.isnan(read[1][1]["m"])
