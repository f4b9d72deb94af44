"""Files of users: separator, time, columns and units are guessed, or the message names the option that sets them."""

from __future__ import annotations

import fcntl
import json
import math
import os
import pty
import select
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from plow_twin.cli.app import run as cli
from plow_twin.errors import RecordingError, UnitError
from plow_twin.record.column_guess import guess_columns
from plow_twin.scene_file import load_scene

PAPER = load_scene("paper")
CTRL_C = b"\x03"


def _file(path: Path, header: str, *, step: float, size: float = 1e3, comma: bool = False) -> Path:
    """Write a file with a time, the paper's load in units of `size` N, and a pose in mm."""
    lines = [header]
    for index in range(600):
        phase = math.sin(2e-3 * index)
        numbers = (index * step, 32e3 / size * phase, -11e3 / size * phase, -45e3 / size * phase, 5.0 * phase)
        line = ";".join(f"{number:.5f}" for number in numbers)
        lines.append(line.replace(".", ",") if comma else line)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_spreadsheet_s_file_becomes_a_mapping_with_which_the_twin_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = _file(tmp_path / "own.csv", "Zeit;Kraft_x [kN];Kraft y;Drehmoment;Weg_x_mm", step=1.0, comma=True)
    out = tmp_path / "out"
    assert cli(["setup", str(file), "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert "semicolon, decimal commas, a row each 0.001 s" in output and "plow-twin live" in output
    assert "SI" not in output
    roles = yaml.safe_load((out / "map.yaml").read_text())
    assert roles["excitation"]["unit"] == {"fx": "kN", "fy": "kN", "m": "kN m"} and roles["head_pose"]["unit"] == {
        "x": "mm"
    }
    assert (out / "setup.png").stat().st_size > 10_000
    assert cli(["info", str(file), "--map", str(out / "map.yaml"), "--json"]) == 0
    read = json.loads(capsys.readouterr().out)["roles"]
    assert (read["excitation"]["messages"], read["excitation"]["unfit"]) == (600, 0)
    assert read["excitation"]["span_s"] == pytest.approx(0.599) and read["excitation"]["rate_hz"] == pytest.approx(1000)
    assert read["head_pose"]["values"]["x"] == pytest.approx([0.0, 5e-3 * math.sin(2e-3 * 599)], abs=1e-5)
    run = ["live", str(file), "--map", str(out / "map.yaml"), "--scene", str(out / "scene.yaml"), "--json"]
    assert cli(run) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["input"]["samples_used"], facts["state"]["model_time_s"]) == ("600", "0.599")
    # existing files are not overwritten
    assert cli(["setup", str(file), "--out", str(out)]) == 2 and "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("header", "step", "size", "units"),
    [
        ("t;fx;fy;m;x", 1e-3, 1.0, {"x": "mm", "t": "s"}),
        ("t;fx;fy;m;x", 1.0, 1e3, {"fx": "kN", "fy": "kN", "m": "kN m", "x": "mm", "t": "ms"}),
        (
            "timestamp;F_x(kN);F_y(kN);Mz (kN m);pos_x [mm]",
            1e-3,
            1e3,
            {"fx": "kN", "fy": "kN", "m": "kN m", "x": "mm", "t": "s"},
        ),
    ],
)
def test_units_follow_from_names_or_magnitudes(
    tmp_path: Path, header: str, step: float, size: float, units: dict[str, str]
) -> None:
    guess = guess_columns(_file(tmp_path / "own.csv", header, step=step, size=size), PAPER, {}, {})
    assert guess.units | {"t": guess.time_unit} == units and not guess.open
    in_si = {"fx": "N", "fy": "N", "m": "N m"}
    assert guess.mapping()["excitation"]["unit"] == {name: units.get(name, unit) for name, unit in in_si.items()}
    largest = {name: float(abs(found).max()) for (_, name), found in guess.values.items()}
    phase = math.sin(2e-3 * 599)
    assert largest == pytest.approx(
        {"fx": 32e3 * phase, "fy": 11e3 * phase, "m": 45e3 * phase, "x": 5e-3 * phase}, rel=1e-3
    )
    assert guess.stamps_s[-1] == pytest.approx(0.599)


def test_for_undecided_columns_the_option_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = _file(tmp_path / "own.csv", "t;a;b;c;d", step=1e-3, size=1.0)
    assert cli(["setup", str(file), "--out", str(tmp_path / "out")]) == 2
    errors = " ".join(capsys.readouterr().err.split())
    assert "fx, fy, m cannot be determined from the columns t, a, b, c, d" in errors and "--column fx=COLUMN" in errors
    assert not (tmp_path / "out").exists()
    stated = {"fx": "a", "fy": "b", "m": "c"}
    guess = guess_columns(file, PAPER, stated, {"m": "kN m"})
    assert {name: column for (_, name), column in guess.columns.items()} == stated and guess.units == {"m": "kN m"}
    for columns, units, wrong in (({"fx": "z"}, {}, "got 'z'"), ({"fz": "a"}, {}, "fz"), ({}, {"fx": "lbf"}, "lbf")):
        with pytest.raises(RecordingError, match=wrong):
            guess_columns(file, PAPER, stated | columns, units)


def test_loads_far_too_large_for_the_scene_are_refused_before_a_file_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = _file(tmp_path / "own.csv", "t;fx [kN];fy [kN];m [kN m];x", step=1e-3, size=1.0)
    command = ["setup", str(file), "--scene", "paper", "--out", str(tmp_path / "out")]
    assert cli(command) == 2
    errors = capsys.readouterr().err
    assert "fx: got 2.97e+07 N" in errors and not (tmp_path / "out").exists()
    options = [option for option in ("fx=N", "fy=N", "m=Nm") if f"--unit {option}" in errors]
    assert len(options) == 3
    assert cli([*command, *(part for option in options for part in ("--unit", option))]) == 0
    written = yaml.safe_load((tmp_path / "out" / "map.yaml").read_text())["excitation"]["unit"]
    assert written == {"fx": "N", "fy": "N", "m": "Nm"}


def _in_terminal(folder: Path, *expected: bytes) -> tuple[int, str]:
    """Run `setup own.csv` in a terminal, and type one answer at each prompt. Return exit code and screen."""
    command = [sys.executable, "-m", "plow_twin", "setup", "own.csv", "--out", "out"]
    near, far = pty.openpty()

    def own_terminal() -> None:
        fcntl.ioctl(far, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        command, cwd=folder, stdin=far, stdout=far, stderr=far, start_new_session=True, preexec_fn=own_terminal
    )
    os.close(far)
    screen, answers, answered_to = b"", list(expected), 0
    with suppress(OSError):  # reading fails after the program has closed its side of the terminal
        while True:
            # readline may miss a signal just before it waits, so the key is pressed again
            while expected[-1] == CTRL_C and not answers and not select.select([near], [], [], 5.0)[0]:
                os.write(near, CTRL_C)
            data = os.read(near, 4096)
            if not data:
                break
            screen += data
            if answers and screen[answered_to:].rstrip().endswith(b":"):
                answered_to = len(screen)
                os.write(near, answers.pop(0))
    os.close(near)
    return process.wait(60.0), screen.decode()


def test_prompts_in_a_terminal_take_corrections_and_write_the_choice(tmp_path: Path) -> None:
    _file(tmp_path / "own.csv", "t;a;b;c;d", step=1e-3, size=1.0)
    code, screen = _in_terminal(tmp_path, b"z\n", b"a\n", b"\n", b"b\n", b"c\n")
    assert code == 0, screen
    assert "'z' is not one of" in screen and screen.count("Column of") == 5
    written = (tmp_path / "out" / "map.yaml").read_text()
    assert all(f"{name}: {column}" in written for name, column in (("fx", "a"), ("fy", "b"), ("m", "c")))
    assert "next: plow-twin live own.csv --map out/map.yaml --scene out/scene.yaml" in screen
    # existing files are not overwritten
    code, screen = _in_terminal(tmp_path, b"a\n", b"b\n", b"c\n")
    assert code == 2 and "exists already" in screen and (tmp_path / "out" / "map.yaml").read_text() == written


@pytest.mark.parametrize("last", [CTRL_C, b"\x04"], ids=["Ctrl-C", "Ctrl-D"])
def test_an_interrupted_prompt_leaves_no_file(last: bytes, tmp_path: Path) -> None:
    _file(tmp_path / "own.csv", "t;a;b;c;d", step=1e-3, size=1.0)
    code, screen = _in_terminal(tmp_path, b"a\n", last)
    assert code == 1 and "interrupted" in screen and "Traceback" not in screen
    assert [item.name for item in tmp_path.iterdir()] == ["own.csv"]


def test_dates_that_cannot_be_read_and_stamps_that_fall_are_named(tmp_path: Path) -> None:
    rows = "".join(f"25.10.2026 02:59:{index % 60:02d},{index},1,2\n" for index in range(100))
    (tmp_path / "own.csv").write_text(f"time,fx,fy,m\n{rows}")
    with pytest.raises(RecordingError, match=r"t: got '25\.10\.2026 02:59:00' in the column time, expected a number"):
        guess_columns(tmp_path / "own.csv", PAPER, {}, {})
    rows = "".join(f"{100 - index},{index},1,2\n" for index in range(100))
    (tmp_path / "own.csv").write_text(f"t,fx,fy,m\n{rows}")
    with pytest.raises(UnitError, match="rows from the newest to the oldest: sort the rows by time"):
        guess_columns(tmp_path / "own.csv", PAPER, {}, {})


@pytest.mark.parametrize(
    ("zone", "message"), [("", "by its name; dates without a zone are UTC"), ("+01:00", "by its name")]
)
def test_dates_without_a_zone_and_cells_without_a_number_are_mentioned(tmp_path: Path, zone: str, message: str) -> None:
    rows = [f"2026-01-02T03:04:{index:02}.5{zone},{'nan' if index % 3 else 1e3},-1e3,2e3" for index in range(30)]
    file = tmp_path / "own.csv"
    file.write_text("\n".join(["t,fx,fy,m", *rows]) + "\n")
    because = guess_columns(file, PAPER, {}, {}).because
    assert because == {
        "t": message,
        "fx": "by its name; 20 of 30 cells have no number",
        "fy": "by its name",
        "m": "by its name",
    }
