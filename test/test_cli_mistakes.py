"""Mistakes of a new user with all verbs except `live`: each gives one clear message and an exit code."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from plow_twin.cli.app import run as cli
from plow_twin.record.chunks import MAGIC
from plow_twin.scene_file.presets import scene_path

TIMES = np.arange(0.0, 20.0, 0.01)
ROWS = np.column_stack((
    TIMES,
    np.sin(2.0 * TIMES)[:, None] * [30e3, -10e3, -40e3],
    np.sin(2.0 * TIMES)[:, None] * [0.012, 0.014, 0.01],
))  # fmt: skip
LOAD, POSE = ("t", "fx", "fy", "m"), ("t", "x", "y", "theta")
ALL = (*LOAD, *POSE[1:])
CALIBRATE = ["study", "calibrate", "paper", "--unknown", "clearance.horizontal_m=0.02:0.03", "--out", "fit"]
CALIBRATE += ["--recording"]
LIMITS = ["--limit-horizontal", "35", "--limit-vertical", "40"]
MAP = ["--map", "own.yaml", "--scene", "paper"]


def _write(
    path: str, names: tuple[str, ...] = ALL, *, separator: str = ",", header: bool = True, **scale: float
) -> None:
    rows = ROWS[:, [ALL.index(name) for name in names]] * [scale.get(name, 1.0) for name in names]
    Path(path).parent.mkdir(exist_ok=True)
    head = separator.join(names) if header else ""
    np.savetxt(path, rows, "%.9g", separator, header=head, comments="")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("desk")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _write("own.csv")
        _write("kilonewtons.csv", fx=1e-3, fy=1e-3, m=1e-3)
        _write("headless.csv", header=False)
        _write("bars.csv", separator="|")
        _write("decimal.csv")
        text = Path("decimal.csv").read_text()
        Path("decimal.csv").write_text(re.sub(r"-?[0-9.]+(e-?[0-9]+)?", "1,5", text))
        _write("millimetres.csv", POSE, x=1e3, y=1e3)
        _write("milliseconds.csv", POSE, t=1e3)
        _write("planar.csv", POSE[:3])
        _write("degrees.csv", POSE, theta=180.0 / np.pi * 10.0)
        scales = {"kN": {"fx": 1e-3, "fy": 1e-3}, "mm": {"x": 1e3, "y": 1e3}, "ms": {"t": 1e3}, "bars": {}}
        for name, scale in scales.items():
            separator = "|" if name == "bars" else ","
            _write(f"{name}/load.csv", LOAD, separator=separator, **scale)
            _write(f"{name}/pose.csv", POSE, separator=separator, **scale)
            Path(name, "scene.yaml").write_text(scene_path("paper").read_text())
        _write("planar/pose.csv", POSE[:3])
        _write("planar/load.csv", LOAD)
        Path("planar/scene.yaml").write_text(scene_path("paper").read_text())
        for name in ("empty.csv", "taken/notes.txt"):
            Path(name).parent.mkdir(exist_ok=True)
            Path(name).write_text("")
        Path("rowless").mkdir()
        for name, names in (("load", LOAD), ("pose", POSE)):
            Path("rowless", f"{name}.csv").write_text(",".join(names))
        Path("own.yaml").write_text("excitation: {topic: own}\nhead_pose: {topic: own}\n")
        Path("kN.yaml").write_text("excitation: {topic: kilonewtons}\nhead_pose: {topic: kilonewtons}\n")
        Path("misspelt.yaml").write_text("excitations: {topic: own}\n")
        Path("begun.mcap").write_bytes(MAGIC[:3])
        Path("run.mcap").write_bytes(MAGIC + bytes(range(256)))
        Path("knots.yaml").write_text("excitation: {topic: own, unit: {fx: knots}}\n")
    return folder


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["estimate", "mm"], 2, "x: got 12, expected less than half the frame or the clearance, 0.165 m; they look"),
        (
            ["estimate", "kN"],
            2,
            "got 30, expected about 3.2e+04 N as in the scene; they look like kN: convert the file",
        ),
        (
            ["estimate", "kilonewtons.csv", *MAP[2:], "--map", "kN.yaml"],
            2,
            "they look like kN: convert the file, or state the unit in a",
        ),
        (["estimate", "ms"], 2, "t: got stamps 10 s apart, expected many samples in each period of such a smooth load"),
        (["estimate", "rowless"], 1, "rowless: got no load and no measured pose, expected at least one row"),
        (["estimate", "planar"], 1, "t, x, y, theta (the cells of a coordinate that was not measured are empty)"),
        (["estimate", "bars"], 1, "t|fx|fy|m (expected commas, semicolons or tabs between them), expected t, fx, fy"),
        (["estimate", "headless.csv", *MAP], 1, "(no header row?)"),
        (["estimate", "empty.csv", "--scene", "paper"], 1, "empty.csv: got no load, expected at least one row"),
        (
            ["estimate", "own.csv", "--scene", "papper", *MAP[:2]],
            2,
            "a scene file, or one of the presets paper, bench_kv",
        ),
        (["estimate", "nowhere"], 2, "'nowhere' does not exist"),
        (
            ["estimate", "own.csv", "--scene", "paper", "--map", "misspelt.yaml"],
            2,
            "known key; did you mean excitation?",
        ),
        (["estimate", "own.csv", *MAP, "--follow-dt", "inf"], 2, "got 'inf', expected a finite number > 0"),
        (["estimate", "own.csv", *MAP, "--follow-dt", "nan"], 2, "got 'nan', expected a finite number > 0"),
        (["analyse", "kilonewtons.csv", "--scene", "paper"], 2, "look like kN: state the unit: --unit fx=kN"),
        (["analyse", "headless.csv", "--scene", "paper"], 1, "(no header row?)"),
        (["analyse", "bars.csv", "--scene", "paper"], 1, "(expected commas, semicolons or tabs between them)"),
        (["analyse", "empty.csv", "--scene", "paper"], 1, "columns (none: is it empty?)"),
        (["analyse", "own.csv"], 1, "a scene is needed, expected --scene or scene.yaml"),
        (["analyse", "own.csv", "--scene", "paper", "--map", "knots.yaml"], 2, "got 'knots', expected one of N, kN"),
        (["compare", "own.csv", "empty.csv"], 1, "own.csv: not an MCAP file"),
        (["compare", "own.csv", "nowhere"], 2, "nowhere: does not exist"),
        (["live", "own.csv", "--set", "alarm_force=[2e5, 1e5]"], 2, "alarm_force: got [200000.0, 100000.0], expected"),
        (["view", "own.csv"], 1, "plow-twin live makes a recording of a table, and commands with --map read a table"),
        (["view", "headless.csv", *MAP], 1, "(no header row?)"),
        (["view", "own.csv", "--scene", "paper", "--map", "misspelt.yaml"], 2, "did you mean excitation?"),
        (["info", "own.csv"], 1, "own.csv: got a table, expected --map"),
        (
            [*CALIBRATE, "millimetres.csv"],
            2,
            "y: got 14, expected less than half the frame or the clearance",
        ),
        ([*CALIBRATE, "milliseconds.csv"], 2, "t: got stamps 10 s apart"),
        ([*CALIBRATE, "degrees.csv"], 2, "theta: got 5.73, expected less than 0.785 rad; they look like deg"),
        ([*CALIBRATE, "planar.csv"], 2, "(plow-twin estimate uses poses with unmeasured coordinates, as empty cells)"),
        (
            ["study", "sweep", "paper", "--x", "qq=1:2:3", "--statistic", "max.ccw.a", "--t-end", "1", "--out", "new"],
            2,
            "got 'qq'; nearest: initial.q[2], initial.q[1], initial.q[0] (plow-twin info",
        ),
        ([*CALIBRATE, "headless.csv"], 2, "(no header row?)"),
        ([*CALIBRATE, "bars.csv"], 2, "(expected commas, semicolons or tabs between them)"),
        ([*CALIBRATE, "empty.csv"], 2, "columns (none: is it empty?)"),
        (["setup", "headless.csv"], 1, "got no header row or no rows"),
        (["setup", "bars.csv"], 2, "(expected commas, semicolons or tabs between them); state --column t=COLUMN"),
        (["setup", "decimal.csv"], 1, "got 14 cells in a row, expected the 7 of its header (if commas are decimal"),
        (["setup", "empty.csv"], 1, "got no header row or no rows"),
        (["setup", "nowhere.csv"], 2, "'nowhere.csv' does not exist"),
        (["export", "own.csv", "--to", "csv", "--out", "out"], 1, "plow-twin live makes a recording of a table"),
        (["export", "taken", "--to", "csv", "--out", "out"], 1, "taken"),
        (["export", "own.csv", "--to", "xls", "--out", "out"], 2, "is not one of 'csv', 'parquet', 'npz'"),
        (["dashboard", "own.csv"], 1, "own.csv: not an MCAP file"),
        (["forecast", "begun.mcap", *LIMITS], 1, "begun.mcap: truncated before its first message"),
        (
            ["live", "run.mcap", "--scene", "paper"],
            1,
            "run.mcap: got an MCAP recording, expected a table; plow-twin an",
        ),
        (["setup", "run.mcap"], 1, "run.mcap: got an MCAP recording, expected a table; plow-twin analyse"),
        (["simulate", "run.mcap", "--t-end", "1"], 2, "a readable scene file (it is an MCAP recording)"),
    ],
)
def test_a_mistake_in_a_command_is_reported_in_a_message(
    arguments: list[str],
    code: int,
    message: str,
    desk: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(desk)
    before = sorted(desk.rglob("*"))
    assert cli(arguments) == code
    shown = capsys.readouterr().err
    assert message in " ".join(shown.split()), shown
    # the message names the mistake in one line without the contents of the file, and no output file remains
    assert len([line for line in shown.splitlines() if not line.startswith("Usage")]) <= 3 and len(shown) < 500
    assert sorted(desk.rglob("*")) == before


def test_an_unexpected_end_of_data_is_not_called_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    def cut(_: object) -> None:
        raise EOFError("Ran out of input")

    monkeypatch.setattr("plow_twin.scene_file.load_scene", cut)
    with pytest.raises(EOFError, match="Ran out of input"):
        cli(["info", "paper"])


def test_rows_that_an_estimate_cannot_use_are_counted_in_its_losses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _write("twice/load.csv", LOAD)
    Path("twice/pose.csv").write_text("t,x,y,theta\n1,0,0,0\n1,0,0,0\nwhat,0,0,0\n")
    Path("twice/scene.yaml").write_text(scene_path("paper").read_text())
    assert cli(["estimate", "twice", "--json"]) == 3
    shown = capsys.readouterr()
    assert json.loads(shown.out)["losses"] == {"unreadable_rows": 1, "unusable_rows": 1}
    assert "twice: lost unreadable_rows: 1, unusable_rows: 1" in shown.err


def test_a_small_load_is_estimated_if_the_mapping_states_its_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _write("small/load.csv", LOAD, fx=1e-3, fy=1e-3)
    Path("small/pose.csv").write_text("t,x,y,theta\n1,0,0,0\n2,0,0,0\n")
    Path("small/scene.yaml").write_text(scene_path("paper").read_text())
    for unit, code in (("", 2), (", unit: {fx: N, fy: N}", 3)):
        Path("map.yaml").write_text(f"excitation: {{topic: load{unit}}}\nhead_pose: {{topic: pose}}\n")
        assert cli(["estimate", "small", "--map", "map.yaml"]) == code
    assert "small: got 2 poses within the load's span" in capsys.readouterr().err


@pytest.mark.parametrize("poses", ["none", "after the load"])
def test_an_estimate_from_too_few_poses_checks_nothing_and_has_exit_code_3(
    poses: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _write("few/load.csv", LOAD)
    late = ROWS[:, [0, 4, 5, 6]] + [1000.0, 0.0, 0.0, 0.0]
    np.savetxt("few/pose.csv", late[: 0 if poses == "none" else None], "%.9g", ",", header=",".join(POSE), comments="")
    Path("few/scene.yaml").write_text(scene_path("paper").read_text())
    assert cli(["estimate", "few"]) == 3
    shown = capsys.readouterr()
    assert "model and sensor not checked" in shown.out
    assert "few: got 0 poses within the load's span, 0 s to 19.99 s, expected at least 20" in shown.err
