"""Comparison of runs: windows contain the recorded numbers, and chance, load and machine are distinguished."""

from __future__ import annotations

import io
import json
import re
import shutil
from contextlib import ExitStack
from dataclasses import replace
from datetime import time
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow.parquet
import pytest
from figure_checks import check_figure, kept_figures
from record_support import BASE_NS, STEP_NS, Run, paper_sample, record_run

from plow_twin import load_scene
from plow_twin.cli import compare as compare_verb
from plow_twin.cli.app import run as cli
from plow_twin.cli.console import PlainConsole
from plow_twin.errors import RecordingError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.messages import JointState
from plow_twin.record.recording import read_recording
from plow_twin.stream.journal import Parameter, Sample
from plow_twin.study.comparison.change import Change, Drawn, changes, with_neighbours
from plow_twin.study.comparison.compare import Comparison, by_time, compare
from plow_twin.study.comparison.report import _figure
from plow_twin.study.comparison.windows import _PADS, QUANTITIES, windows_of

pytestmark = pytest.mark.usefixtures("without_workers")
SECONDS = 8


def _run(folder: Path, scale: float) -> Run:
    samples = (paper_sample(index) for index in range(SECONDS * 1000))
    return record_run(folder, (Sample(s.stamp_ns, tuple(scale * part for part in s.wrench)) for s in samples))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run]:
    folder = tmp_path_factory.mktemp("compare")
    return _run(folder / "monday", 1.0), _run(folder / "tuesday", 1.3)


def test_windows_contain_the_recorded_numbers(runs: tuple[Run, Run]) -> None:
    windows = windows_of(read_recording(runs[0].folder), 1.0)
    assert len(windows.start_ns) == SECONDS and (windows.start_ns % 10**9 == 0).all()
    peaks = [m for topic, m in runs[0].outputs if topic == "/contact_peaks" and isinstance(m, JointState)]
    forces = [m for topic, m in runs[0].outputs if topic == "/contact_forces" and isinstance(m, JointState)]
    number = np.array([message.stamp_ns // 10**9 for message in peaks]) - BASE_NS // 10**9
    effort, impulse, total = (
        np.array([getattr(m, part) for m in peaks]) for part in ("effort", "velocity", "position")
    )
    force, rate = (np.array([getattr(m, part) for m in forces]) for part in ("effort", "velocity"))
    for window in range(SECONDS):
        inside = number == window
        np.testing.assert_array_equal(windows.pairs["peak"][window], effort[inside].max(axis=0))
        np.testing.assert_allclose(windows.pairs["impulse"][window], impulse[inside].sum(axis=0), rtol=1e-12)
        if window:
            assert windows.pairs["in_contact"][window] == pytest.approx((force[inside] > 0.0).mean(axis=0))
    np.testing.assert_array_equal(windows.pairs["impacts"].sum(axis=0) / 60.0, total[-1] - total[0])
    work = (0.5 * (force[1:] * rate[1:] + force[:-1] * rate[:-1])).sum(axis=0) * STEP_NS * 1e-9
    np.testing.assert_allclose(windows.pairs["dissipation"].sum(axis=0), work, rtol=1e-9)
    load = np.array([paper_sample(index).wrench for index in range(1000)])
    np.testing.assert_allclose(windows.load[0], np.sqrt([(load[:, :2] ** 2).sum() / 1e3, (load[:, 2] ** 2).mean()]))


def test_a_clearance_without_a_message_is_interpolated_between_windows(runs: tuple[Run, Run]) -> None:
    windows = windows_of(read_recording(runs[0].folder), 0.05)
    scene = load_scene("paper").clearance
    np.testing.assert_allclose(windows.clearance, [[scene.horizontal_m, scene.vertical_m]] * len(windows.start_ns))


def test_new_pads_do_not_count_as_negative_wear(runs: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch) -> None:
    """After `set_wear` the mean wear of a run was negative, and no pad of the run had a change of wear."""
    recording = read_recording(runs[0].folder)
    batches = type(recording).batches

    def grown(self: Any, *names: str) -> Any:
        for batch in batches(self, *names):
            if "clearance" in batch:
                part = batch["clearance"]
                run_s = (part.stamp_ns - BASE_NS) * 1e-9
                values = part.values.copy()
                values[:, _PADS] = np.where(run_s < 1.55, 1e-3 + run_s * 1e-6, run_s * 1e-6)[:, None]
                batch = {**batch, "clearance": replace(part, values=values)}
            yield batch

    monkeypatch.setattr(type(recording), "batches", grown)
    wear = windows_of(recording, 1.0).pairs["wear"]
    # the first window lacks the time before its first message, the second the time of the change
    assert wear[2:] == pytest.approx(3.6e-3, rel=1e-6) and (wear > 2e-3).all() and (wear < 3.7e-3).all()


def test_windows_with_a_stretch_without_samples_are_left_out_and_named(runs: tuple[Run, Run], tmp_path: Path) -> None:
    # in the first case, a window has 97 % of its messages, which is sufficient
    for first, end, timeout in ((4100, 4130, 0.02), (4100, 5200, 0.5)):
        samples = (paper_sample(index) for index in range(SECONDS * 1000) if not first <= index < end)
        run = record_run(tmp_path / str(end), samples, parameters={"excitation_timeout": timeout})
        windows = windows_of(read_recording(run.folder), 1.0)
        begins = (windows.start_ns - BASE_NS) // 10**9
        left_out = {first // 1000, end // 1000}
        assert set(range(SECONDS)) - set(begins.tolist()) == left_out and windows.silent == len(left_out)
        comparison = compare([("monday", windows_of(read_recording(runs[0].folder), 1.0)), ("tuesday", windows)])
        assert f"tuesday: {windows.silent} windows with a stretch without samples were left out" in comparison.notes
    with pytest.raises(RecordingError, match="got a silence in each window"):
        samples = (paper_sample(1000 * second + index) for second in range(SECONDS) for index in range(10))
        windows_of(read_recording(record_run(tmp_path / "bursts", samples).folder), 1.0)
    samples = (paper_sample(600 * index) for index in range(12))
    assert not windows_of(read_recording(record_run(tmp_path / "slow", samples).folder), 1.0).silent


def test_the_window_is_the_period_of_the_load(runs: tuple[Run, Run]) -> None:
    starts = windows_of(read_recording(runs[0].folder)).start_ns
    # the angular frequency of the load is 2 rad/s, so its period is pi s; the data cover two and a half periods
    assert np.diff(starts)[0] * 1e-9 == pytest.approx(np.pi, rel=0.3)


def change(
    before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray], random: Any, draws: int = 300
) -> Change | None:
    return changes(*(Drawn(values[:, None], load, random, draws) for values, load in (before, after)))[0]


def test_at_most_one_table_in_twenty_shows_a_random_change() -> None:
    random = np.random.default_rng(1)
    tables, found_again = [], 0
    for _ in range(60):
        groups = [(random.gamma(4.0, 25e3, (60, 50)), random.normal(1.0, 0.05, 60)) for _ in range(2)]
        drawn = [Drawn(*group, random, draws=200) for group in groups]
        tables.append([cell.verdict for cell in changes(*drawn) if cell is not None])
        groups[1][0][:, 7] *= 1.8  # a single true change among them is still detected
        cell = changes(drawn[0], Drawn(*groups[1], random, draws=200))[7]
        found_again += cell is not None and cell.verdict == "machine"
    assert sum(any(verdict != "chance" for verdict in table) for table in tables) <= 7
    assert found_again >= 57


@pytest.mark.parametrize(("factor", "load_factor", "verdict"), [(1.15, 1.0, "machine"), (1.0, 1.15, "load")])
def test_a_change_of_the_machine_is_distinguished_from_a_change_of_the_load(
    factor: float, load_factor: float, verdict: str
) -> None:
    random = np.random.default_rng(2)
    load = [random.normal(mean, 0.08, 300) for mean in (1.0, load_factor)]
    force = [
        scale * 1e5 * loads * random.normal(1.0, 0.05, 300) for scale, loads in zip((1.0, factor), load, strict=True)
    ]
    difference = change((force[0], load[0]), (force[1], load[1]), random, draws=300)
    assert difference is not None and difference.verdict == verdict and difference.low < 0.15 < difference.high
    steady = change((force[0], np.ones(300)), (force[1], np.full(300, 1.2)), random, draws=300)
    assert steady is not None and steady.verdict == "load or machine"
    assert change((force[0][:5], load[0][:5]), (force[1], load[1]), random) is None


def test_a_lasting_change_of_the_load_is_attributed_to_the_load() -> None:
    random = np.random.default_rng(4)
    verdicts = []
    for _ in range(40):
        groups = []
        for scale in (1.0, 1.15):
            true = scale * random.normal(
                1.0, 0.15, 62
            )  # a window covers half of each of two periods, and contains the peak of only one of them
            start_ns = 10**9 * np.arange(61)
            loads = with_neighbours(0.5 * (true[1:] + true[:-1]), start_ns)
            groups.append((1e5 * true[1:] * random.normal(1.0, 0.02, 61), loads))
        difference = change(*groups, random, draws=100)
        assert difference is not None
        verdicts.append(difference.verdict)
    assert verdicts.count("load") >= 34
    np.testing.assert_array_equal(
        with_neighbours(np.array([1.0, 2.0, 3.0]), np.array([0, 10, 90])), [[1, 1, 2], [2, 1, 2], [3, 3, 3]]
    )
    # a slope is invalid at loads far from those to which it was fitted
    load = random.normal(1.0, 0.02, 40)
    apart = change((1e5 * load**2, load), (1.4e5 * load**2, 1.4 * load), random, draws=100)
    assert apart is not None and apart.verdict == "load or machine"
    equal = np.full(93, 0.025)  # the means of these equal numbers differ by rounding errors
    constant = change((equal[:62], np.ones(62)), (equal, np.ones(93)), random, draws=100)
    assert constant is not None and constant.verdict == "chance"


def test_days_and_shifts_follow_their_time_zone() -> None:
    late = 1_800_000_000 - 1_800_000_000 % 86_400 + 23 * 3600  # 23:00 UTC
    stamp = late * 10**9
    assert by_time("day")("run", stamp) == "2027-01-15"
    assert by_time("day", zone=ZoneInfo("Europe/Berlin"))("run", stamp) == "2027-01-16"
    assert by_time("shift")("run", stamp) == "2027-01-15 22:00"
    # 04:00 belongs to the night shift of the previous day
    assert by_time("shift")("run", stamp + 5 * 3600 * 10**9) == "2027-01-15 22:00"
    assert by_time("shift", [time(0), time(12)])("run", stamp + 5 * 3600 * 10**9) == "2027-01-16 00:00"


def test_two_runs_are_compared_on_the_terminal_as_json_and_as_a_page(
    runs: tuple[Run, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(run.folder) for run in runs]
    assert cli(["compare", *folders, "--window", "0.5", "--json", "--workers", "1", "--out", str(tmp_path)]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert list(facts["groups"]) == ["monday", "tuesday"] and facts["groups"]["monday"]["windows"] == 2 * SECONDS
    assert facts["notes"] == []
    ratio = (
        facts["groups"]["tuesday"]["load"]["force_rms_n"]["mean"]
        / facts["groups"]["monday"]["load"]["force_rms_n"]["mean"]
    )
    assert ratio == pytest.approx(1.3)
    changes = facts["changes"]["tuesday"]
    assert set(changes) == set(PAIR_NAMES) and changes["top_right_top"]["peak"]["verdict"] != "machine"
    # the pads do not wear here, so the clearance is unchanged
    assert facts["clearance_changes"]["tuesday"]["horizontal"]["verdict"] == "chance"
    page = (tmp_path / "compare.html").read_text(encoding="utf-8")
    assert "tuesday compared with monday" in page and "data:image/png;base64," in page and "http" not in page
    table = pyarrow.parquet.read_table(tmp_path / "windows.parquet")
    assert len(table) == 4 * SECONDS and set(table["group"].to_pylist()) == {"monday", "tuesday"}
    assert cli(["compare", *folders, "--window", "0.5", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "tuesday compared with monday" in printed and "clearance [%]: horizontal +0.0" in printed


@pytest.mark.parametrize("dask", [False, pytest.param(True, marks=pytest.mark.stress)])
def test_a_folder_of_runs_is_compared_and_its_picture_has_the_dates(
    dask: bool,
    runs: tuple[Run, Run],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    figures = kept_figures(monkeypatch)
    arguments = ["compare", str(runs[0].folder.parent), "--window", "0.5", "--out", str(tmp_path), "--json"]
    with ExitStack() as opened:
        if dask:
            from distributed import LocalCluster

            options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
            cluster = opened.enter_context(LocalCluster(**options))
            arguments += ["--dask", cluster.scheduler_address]
        assert cli([*arguments, "--workers", "1"]) == 0
    assert list(json.loads(capsys.readouterr().out)["groups"]) == ["monday", "tuesday"]
    windows = windows_of(read_recording(runs[0].folder), 0.5)
    month = _figure(Comparison({f"2026-12-{day:02}": windows for day in range(1, 31)}, {}))
    for figure in (figures[0], month):
        check_figure(figure)
    assert [line.get_label() for line in month.axes[0].lines[::2]] == list(PAIR_NAMES)
    assert (
        figures[0]
        .get_suptitle()
        .startswith("Largest contact forces; 2027-01-15 08:00:00 UTC to 2027-01-15 08:00:07 UTC")
    )


def test_one_group_and_a_run_without_outputs_are_refused(
    runs: tuple[Run, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli(["compare", str(runs[0].folder), "--workers", "1"]) == 1
    assert "got 1 group of windows (monday), expected two or more" in capsys.readouterr().err
    assert cli(["compare", *[str(runs[0].folder)] * 2, "--workers", "1"]) == 1
    assert "monday: given twice, used once" in capsys.readouterr().err
    bare = record_run(tmp_path / "bare", [Parameter("hold", "hold"), *map(paper_sample, range(99))], frame_every=10**9)
    assert cli(["compare", str(runs[0].folder), str(bare.folder), "--workers", "1"]) == 1
    assert "bare: got no contact_peaks" in capsys.readouterr().err
    assert cli(["compare", str(bare.folder), "--workers", "1"]) == 1
    assert "got 0 groups of windows, expected two or more" in capsys.readouterr().err


def test_stray_files_beside_runs_are_named_and_the_runs_compared(
    runs: tuple[Run, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in runs:
        shutil.copytree(run.folder, tmp_path / run.folder.name)
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n")
    (tmp_path / "cut.mcap").write_bytes(next(runs[0].folder.glob("*.mcap")).read_bytes()[:20])
    assert cli(["compare", str(tmp_path), "--window", "0.5", "--workers", "1", "--json"]) == 3
    printed = capsys.readouterr()
    assert list(json.loads(printed.out)["groups"]) == ["monday", "tuesday"]
    for message in (f"{tmp_path / 'load.csv'}: left out", f"left out: {tmp_path / 'cut.mcap'}"):
        assert message in printed.err


def test_the_same_run_under_two_paths_counts_once(
    runs: tuple[Run, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(runs[0].folder, copy)
    folders = [str(runs[0].folder), str(copy), str(runs[1].folder)]
    assert cli(["compare", *folders, "--window", "0.5", "--workers", "1", "--json"]) == 0
    printed = capsys.readouterr()
    assert list(json.loads(printed.out)["groups"]) == ["monday", "tuesday"]
    assert f"{copy}: left out: the same run as {runs[0].folder}" in printed.err
    assert cli(["analyse", *folders[:2], "--workers", "1", "--json"]) == 0
    printed = capsys.readouterr()
    assert len(json.loads(printed.out)["runs"]) == 1 and "copy: left out: the same run as" in printed.err


def test_overlapping_runs_other_rates_and_other_scenes_are_named(runs: tuple[Run, Run]) -> None:
    monday, tuesday = (windows_of(read_recording(run.folder), 0.5) for run in runs)
    later = replace(monday, start_ns=monday.start_ns + 86_400 * 10**9, rate_hz=monday.rate_hz / 2)
    named = {name: (name, name) for name in ("a", "b", "c")}
    comparison = compare([("a", monday), ("b", tuesday), ("c", later)], by_time("day"), scenes=named)
    assert [len(group.start_ns) for group in comparison.groups.values()] == [2 * SECONDS, 2 * SECONDS]
    twice, rates, scenes = comparison.notes
    assert twice == "b: 16 of 16 windows in 2027-01-15 left out: a covers their time"
    assert rates.endswith("them: a 1000 Hz, b 1000 Hz, c 500 Hz") and scenes.endswith("its description: a a, b b, c c")


def test_names_of_pads_are_complete_in_eighty_columns(runs: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch) -> None:
    windows, text = windows_of(read_recording(runs[0].folder), 1.0), io.StringIO()
    monkeypatch.setattr(compare_verb, "output_console", lambda: PlainConsole(file=text, width=80))
    shares = dict(zip(QUANTITIES, (-0.999, 0.9994, 1.0, 12.34, -1.0, -1e-17), strict=True))
    cells = {name: Change(share, -1.0, 1.0, 0.0, share, -1.0, 1.0, 0.0) for name, share in shares.items()}
    comparison = Comparison({"a": windows, "b": windows}, {}, {"b": dict.fromkeys(PAIR_NAMES, cells)}, {"b": {}})
    compare_verb._show(comparison)
    row = r"│ bottom_right_bottom │ +-99.9M │ +\+99.9M │ +\+100M │ +\+1234M │ +-100M │ +\+0.0M │"
    assert re.search(row, text.getvalue()) and "…" not in text.getvalue()


def test_a_new_contact_and_equal_runs_are_named(
    runs: tuple[Run, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # a load that presses to one side first leaves pads without contact
    pressed = record_run(tmp_path / "pressed", (Sample(paper_sample(i).stamp_ns, (6e4, 0.0, 0.0)) for i in range(4000)))
    copy = record_run(tmp_path / "again", (Sample(paper_sample(i).stamp_ns, (6e4, 0.0, 0.0)) for i in range(4000)))
    folders = [str(run.folder) for run in (pressed, copy, runs[1])]
    arguments = ["compare", *folders, "--window", "0.25", "--workers", "1"]
    assert cli([*arguments, "--json", "--out", str(tmp_path / "out")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["equal"] == ["again"] and not any(facts["appeared"]["again"].values())
    new = facts["appeared"]["tuesday"]
    without = [pair for pair in PAIR_NAMES if facts["groups"]["pressed"]["pairs"][pair]["in_contact"]["mean"] == 0.0]
    touched = [pair for pair in without if facts["groups"]["tuesday"]["pairs"][pair]["in_contact"]["mean"] > 0.0]
    assert touched and all("peak" in new[pair] for pair in touched)
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    assert "<td>new</td>" in page and "All means are the same" in page
    assert cli(arguments) == 0
    printed = capsys.readouterr().out
    assert "again equals pressed: all means are the same" in printed and "tuesday equals" not in printed
    assert re.search(rf"│ {touched[0]} +│ +new │", printed)
