"""The output of commands fits a terminal of 80 columns: no cell is cut off, and no Python names are shown."""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import plow_twin_here
from record_support import paper_sample, record_run
from rich.console import Console

from plow_twin.cli import analyse as analyse_verb
from plow_twin.cli import app, console
from plow_twin.cli import estimate as estimate_verb
from plow_twin.cli import info as info_verb
from plow_twin.cli import simulate as simulate_verb
from plow_twin.cli.app import run
from plow_twin.cli.console import PlainConsole, progress
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Pose
from plow_twin_paper import command as paper_verb
from plow_twin_paper.rows import Row, Verdict

WIDTH = 80


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    text = io.StringIO()
    for module in (console, analyse_verb, estimate_verb, info_verb, simulate_verb, paper_verb):
        monkeypatch.setattr(module, "output_console", lambda: PlainConsole(file=text, width=WIDTH))

    def lines(*arguments: object, code: int = 0) -> list[str]:
        if arguments:
            assert run([*map(str, arguments)]) == code
        return text.getvalue().splitlines()

    return lines


def test_each_number_of_a_scene_is_printed_on_one_line(printed: Callable[..., list[str]]) -> None:
    lines = printed("info", "paper")
    assert max(map(len, lines)) <= WIDTH and not any("…" in line for line in lines)
    assert any(re.fullmatch(r"│ +impact_speed_floor_m_s │ +0\.001 │ +m/s │ +assumed +\d+ │", line) for line in lines)
    assert any(
        re.fullmatch(r"│ +stiffness +│ +9\.6975e\+06 │ N/m\^exponent │ +reconstructed +\d+ │", line) for line in lines
    )
    # no row continues on a second line: each line is a heading or contains a value
    numbers, _ = "\n".join(lines).split("derived quantities")
    rows = [line for line in numbers.splitlines() if line.startswith("│")]
    assert all(re.match(r"│ (\w+(\[\d\])? +│ +│|  \w+(\[\d\])? +│ +\S)", line) for line in rows)
    assert any("paper, parameters of the model" in line for line in lines)


def test_each_statistic_of_a_run_is_printed_on_one_line(printed: Callable[..., list[str]]) -> None:
    lines = printed("simulate", "paper", "--t-end", "1")
    assert max(map(len, lines[:-1])) <= WIDTH and not any("…" in line for line in lines)
    assert sum(bool(re.match(r"│ (top|bottom)_\w+ +│", line)) for line in lines) == 8


def test_a_recording_and_its_replay_are_described_in_words(printed: Callable[..., list[str]], tmp_path: Path) -> None:
    made = record_run(tmp_path / "run", map(paper_sample, range(50)))
    shown = printed("info", made.folder)
    columns = {match.end() for line in shown if (match := re.match(r" *\S+ +(?=\S)", line))}
    assert len(columns) == 1  # longer names, such as those of the journal, do not move their values
    lines = shown + printed("replay", made.folder) + printed("doctor", made.folder)
    text = "\n".join(lines)
    assert not re.search(r"[{}\[\]']", text.replace(str(tmp_path), "")) and "None" not in text
    for line in ("messages", "build", "messages_compared", "  contact_forces         50", "lost                     -"):
        assert line in lines
    long = [line for line in lines if len(line) > WIDTH]
    assert all(str(tmp_path) in line for line in long)  # a path that users may copy is not broken


def test_estimates_and_comparisons_are_printed_in_full_with_units(
    printed: Callable[..., list[str]], tmp_path: Path
) -> None:
    entries = [
        entry
        for index in range(200)
        for entry in (paper_sample(index), Pose(paper_sample(index).stamp_ns, (0.0, 0.0, 0.0)))
    ]
    lines = printed("analyse", record_run(tmp_path / "run", entries).folder)
    for head in ("lag [s]", "x [m]", "theta [rad]"):
        assert any(head in line for line in lines)

    scene = load_scene(scene_path("paper"))
    small = Interval(-5.300854e-06, -4.592612e-05, 3.532441e-05)
    result = Estimate(
        *(0.0, 13.99, Interval(0.025, 0.0249, 0.0251), Interval(0.03, 0.0299, 0.0301)),
        *(State.NOT_OBSERVABLE, State.WITHDRAWN, Interval(9.695005e10, 9.6750615e10, 9.714991e10)),
        *(Interval(0.72597344, 0.71644036, 0.73563338), small, small, small, small, small, small, small),
        groups={"horizontal_bottom": (small, State.NOT_OBSERVABLE)},
    )
    estimate_verb.show_estimate(result, scene)
    lines = printed()
    assert max(map(len, lines)) <= WIDTH and not any("…" in line for line in lines)
    for head in ("stiffness [MN/m]", "damping [s/m]", "horizontal, bottom [mm]"):
        assert any(head in line for line in lines)


def test_no_summary_of_a_verb_is_truncated() -> None:
    for arguments in (["--help"], ["study", "--help"]):
        assert "..." not in plow_twin_here(*arguments).stdout.replace("[ARGS]...", "")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ctrl_c_is_not_lost_in_a_destructor() -> None:
    class Ends:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), progress("replaying", quiet=True) as on_progress:
        on_progress(0.1)
        left = Ends()
        del left  # Python ignores the exception that `__del__` raises
        on_progress(0.2)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_paper_s_statements_fit(printed: Callable[..., list[str]]) -> None:
    def row(what: str, published: str, computed: str, **numbers: object) -> Row:
        return Row("Fig. 7", "section 4", what, published, computed, Verdict.DISAGREES, "5 %", "", **numbers)

    number = row("clockwise, mean force at b", "82", "90.24", unit="kN", published_value=82.0, value=90.24)
    words = row("sets that occur, " * 6, "{b}, {a,d}, {a,b,d}", "{b}, {a,d}; " * 12)
    console = paper_verb.output_console()
    for entry, difference in ((number, "+10.1 %"), (words, "")):
        paper_verb._print_row(console, entry, difference)
    lines = printed()
    assert re.fullmatch(r"no +clockwise, mean force at b +82 +90\.24 kN +\+10\.1 %", lines[0])
    assert max(map(len, lines)) <= WIDTH and any(line.strip().startswith("paper: {b}, {a,d}") for line in lines)
    assert " ".join(" ".join(lines).split()).count("{b}, {a,d};") == 12


def test_progress_has_a_rate_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    console = Console(file=text, width=WIDTH, force_terminal=True)
    monkeypatch.setattr("plow_twin.cli.console.error_console", lambda: console)
    with progress("compiling, replaying", quiet=False) as on_progress:
        for share in (0.1, 0.2, 0.3):
            on_progress(share)
    last = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text.getvalue()).replace("\r", "\n").strip().splitlines()[-1]
    assert re.search(r" 30% [0-9.e+]+ %/s +[0-9:]+ [-0-9:]+$", last.rstrip()), last


def test_the_help_of_the_node_starts_no_node() -> None:
    code = "import sys; sys.modules['rclpy'] = None; from plow_twin.ros.main import main; main(['--help'])"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert completed.returncode == 0 and "--ros-args" in completed.stdout


def test_a_text_that_the_locale_cannot_encode_is_printed_with_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii", write_through=True))
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    monkeypatch.setattr(app, "run", lambda arguments: print("bottom_right_\u2026"))
    with pytest.raises(SystemExit):
        app.main([])
    assert written.getvalue() == b"bottom_right_\\u2026\n"
