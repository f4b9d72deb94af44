"""Analysis of many recordings with workers that are killed, and of a recording that is still being written."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commands import started
from pyarrow import parquet
from record_support import paper_sample, record_run
from waiting import until

from plow_twin.cli.app import run as cli
from plow_twin.errors import RecordingError
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path
from plow_twin.stream.journal import Entry
from plow_twin.study.analysis import many
from plow_twin.study.analysis.many import run_many
from plow_twin.study.analysis.recordings import expand, left_out
from plow_twin.study.analysis.report import write_table_of_runs
from plow_twin.study.analysis.task import Task, names_apart, run_task
from plow_twin.study.parameters import StudyError

RUNS = 4
PAPER = Path("paper")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return folders with loads as CSV. Each analysis writes its own run."""
    folder = tmp_path_factory.mktemp("runs")
    for number in range(RUNS):
        (folder / f"r{number}").mkdir()
        rows = (f"{1e-3 * i},{','.join(map(str, paper_sample(i).wrench))}" for i in range(2000 + number))
        (folder / f"r{number}" / "load.csv").write_text("t,fx,fy,m\n" + "\n".join(rows))
    return folder


def tasks(runs: Path, out: Path) -> list[Task]:
    return [Task(path, PAPER, None, (), out / path.name) for path in sorted(runs.iterdir())]


def workers_of(process: subprocess.Popen[str]) -> list[str]:
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [pid for pid in children if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]


def is_running(pid: str) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def test_a_killed_worker_loses_nothing_and_a_second_call_uses_finished_chunks(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "plow_twin", "analyse", str(runs), "--scene", "paper", "--out", str(out)]
    with started([*command, "--workers", "2", "--json"], stdout=subprocess.PIPE) as process:
        until(lambda: list(out.glob("*/asked.json")), "the first analysis")
        os.kill(int(workers_of(process)[0]), signal.SIGKILL)
        report = json.loads(process.communicate(timeout=200)[0])
    assert process.returncode == 0
    assert [facts["input"]["samples_used"] for facts in report["runs"]] == [2000 + n for n in range(RUNS)]
    assert len(list(out.glob("*/analysis.json"))) == RUNS
    # a second call keeps complete results and repeats interrupted tasks
    (out / "r2" / "asked.json").unlink()
    stored = [task.stored() for task in tasks(runs, out)]
    assert [facts is None for facts in stored] == [False, False, True, False]
    assert stored[0] == report["runs"][0]
    again = run_task(tasks(runs, out)[2])
    assert again["input"] == report["runs"][2]["input"] and tasks(runs, out)[2].stored() is not None
    other = Task(runs / "r0", Path("paper_best_fit"), None, (), out / "r0")
    assert other.stored() is None


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.stress)])
def test_an_interrupt_ends_the_call_and_its_workers_at_once(number: signal.Signals, tmp_path: Path) -> None:
    for run in range(2):  # each run needs several minutes of work
        (tmp_path / "runs" / f"r{run}").mkdir(parents=True)
        rows = (f"{60 * i},{','.join(map(str, paper_sample(60_000 * i).wrench))}" for i in range(2000))
        (tmp_path / "runs" / f"r{run}" / "load.csv").write_text("t,fx,fy,m\n" + "\n".join(rows))
    command = [sys.executable, "-m", "plow_twin", "analyse", str(tmp_path / "runs"), "--scene", "paper"]
    command += ["--out", str(tmp_path / "out"), "--workers", "2"]
    with started(command, stderr=subprocess.PIPE, start_new_session=True) as process:
        until(lambda: process.poll() is not None or len(list(tmp_path.glob("out/*/run/run_0.mcap"))) == 2, "two runs")
        workers = workers_of(process)
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # a terminal sends Ctrl-C to the whole process group
        else:
            process.send_signal(number)
        output = process.communicate(timeout=20)[1]
    if number == signal.SIGINT:
        assert process.returncode == 1 and "interrupted" in output and "Traceback" not in output
    assert len(workers) == 2
    until(lambda: not any(map(is_running, workers)), "the end of the workers")


def test_the_other_tasks_continue_after_the_early_death_of_a_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[list[int]] = []

    def one_dies(tasks: Any, waiting: list[int], workers: int, done: Any) -> list[int]:
        rounds.append(list(waiting))
        if len(rounds) == 1 or waiting == [1]:
            return list(waiting)
        for task in waiting:
            done(task, {"run": str(task)})
        return []

    monkeypatch.setattr(many, "_round", one_dies)
    results = run_many([Task(Path(str(n)), None, None, (), None) for n in range(5)], workers=2)
    assert rounds == [[0, 1, 2, 3, 4], [0], [1], [2, 3, 4]]
    assert ["error" in facts for facts in results] == [False, True, False, False, False]


@pytest.mark.stress
def test_a_cluster_gives_the_same_results(runs: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    some = tasks(runs, tmp_path / "out")[:2]
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        results = run_many(some, workers=1, dask=cluster.scheduler_address)
    assert [facts["input"]["samples_used"] for facts in results] == [2000, 2001]
    assert all(task.stored() is not None for task in some)


def test_the_wait_for_a_cluster_without_workers_is_limited(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr("plow_twin.study.cluster.WORKER_TIMEOUT_S", 0.1)
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address=None) as cluster,
        pytest.raises(StudyError, match="got no worker"),
    ):
        run_many(tasks(runs, tmp_path / "out"), workers=1, dask=cluster.scheduler_address)


def test_a_run_is_analysed_while_it_is_recorded(tmp_path: Path) -> None:
    reported = threading.Event()

    def entries() -> Iterator[Entry]:
        """Yield samples; the second half follows after the first half has been reported."""
        for index in range(4000):
            if index == 2000:
                assert reported.wait(100)
            yield paper_sample(index)

    kept: dict[str, Any] = {"flush_period_s": 0.05}
    writer = threading.Thread(target=record_run, args=(tmp_path / "run", entries()), kwargs=kept)
    writer.start()
    (out := tmp_path / "out").mkdir()  # this folder contains the result of an earlier analysis of another recording
    for name in ("asked.json", "predicted_1.parquet"):
        (out / name).write_text("{}")
    command = [sys.executable, "-m", "plow_twin", "analyse", str(tmp_path / "run"), "--watch", "0.1", "--json"]
    command += ["--out", str(out)]
    with started(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        reported.set()
        last = json.loads(process.stdout.read().splitlines()[-1])
    writer.join()
    assert process.returncode == 0 and last["lost"] == {}
    assert {path.name for path in out.iterdir()} == {
        "analysis.json",
        "report.html",
        "predicted.parquet",
        "clearance.parquet",
    }
    assert 0 < first["input"]["samples_used"] <= 2000 and last["input"]["samples_used"] == 4000


def test_a_failed_recording_among_many_has_a_row_with_the_error(tmp_path: Path) -> None:
    run = record_run(tmp_path / "run", map(paper_sample, range(10)))
    (tmp_path / "taken").write_text("no folder")
    result = run_task(Task(run.folder, None, None, (), tmp_path / "taken"))
    assert result["run"] == str(run.folder) and "FileExistsError" in result["error"]


@pytest.mark.usefixtures("without_workers")
def test_every_omitted_recording_of_a_folder_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("good", "gone"):
        record_run(tmp_path / name, map(paper_sample, range(10)))
    for part in (tmp_path / "gone").glob("*.mcap"):
        part.unlink()
    (tmp_path / "empty").mkdir()
    assert expand([tmp_path]) == [tmp_path / "gone", tmp_path / "good"] and left_out(tmp_path) == [tmp_path / "empty"]
    rows = [run_task(Task(path, None, None, (), None)) for path in expand([tmp_path])]
    assert ["error" in row for row in rows] == [True, False]
    write_table_of_runs(rows, out := tmp_path.with_name("out"), [tmp_path / "empty"])
    table = parquet.read_table(out / "runs.parquet")
    assert table.column("lost").to_pylist() == [None, 0, None]
    assert table.column("error").to_pylist()[1:] == [None, "left out: no recording"]
    # all parts of one recording are missing, so the exit code is 1
    assert cli(["analyse", str(tmp_path), "--json", "--quiet"]) == 1
    assert json.loads(capsys.readouterr().out)["left_out"] == [str(tmp_path / "empty")]
    shutil.copytree(tmp_path / "good", inner := tmp_path / "good" / "inner")
    assert left_out(tmp_path) == [tmp_path / "empty", inner]
    shutil.copy(tmp_path / "good" / "good_0.mcap", tmp_path / "stray.mcap")
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n")
    shutil.rmtree(tmp_path / "gone")
    strays = [tmp_path / "empty", tmp_path / "load.csv", inner]
    assert expand([tmp_path]) == [tmp_path / "good", tmp_path / "stray.mcap"] and left_out(tmp_path) == strays
    assert cli(["analyse", str(tmp_path), "--json", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["left_out"] == list(map(str, strays))
    assert "stray.mcap: left out: the same run as" in printed.err
    assert cli(["analyse", str(tmp_path / "good"), "--json", "--quiet", "--out", str(out)]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"] == [str(inner)]
    assert str(inner) in (out / "report.html").read_text()


def test_tables_with_their_analysis_beside_them_stay_one_recording(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("t,fx,fy,m\n")
    record_run(tmp_path / "run", map(paper_sample, range(10)))
    assert expand([tmp_path]) == [tmp_path / "run"]
    assert expand([tmp_path], [(tmp_path / "run").resolve()]) == [tmp_path]
    (tmp_path / "analysis.json").write_text("{}")
    assert expand([tmp_path]) == [tmp_path] and left_out(tmp_path) == [tmp_path / "run"]


def test_a_run_that_was_killed_before_its_header_is_repeated(runs: Path, tmp_path: Path) -> None:
    task = Task(runs / "r0", PAPER, None, (), tmp_path)
    task.run()
    part = tmp_path / "run" / "run_0.mcap"
    part.write_bytes(part.read_bytes()[:44])
    task.clear()
    assert not part.exists()


def test_recordings_with_equal_names_have_separate_results(tmp_path: Path) -> None:
    files = [tmp_path / "a" / "load.csv", tmp_path / "a" / "load.mcap", tmp_path / "a" / "pose.csv"]
    folders = [tmp_path / "jan" / "1" / "run", tmp_path / "feb" / "1" / "run", tmp_path / "run.1", tmp_path / "run.2"]
    for folder in folders:
        folder.mkdir(parents=True)
    (tmp_path / "a").mkdir()
    for file in files:
        file.touch()
    names = names_apart([*files, *folders])
    assert names == ["load.csv", "load.mcap", "pose", "jan_1_run", "feb_1_run", "run.1", "run.2"]


def test_an_interrupted_analysis_continues_and_removes_no_recorded_run(runs: Path, tmp_path: Path) -> None:
    task = Task(runs / "r0", PAPER, None, (), tmp_path / "out")
    first = task.run()
    assert task.stored() == first
    half = tmp_path / "out" / "run" / "run_0.mcap"
    half.write_bytes(half.read_bytes()[:-4000])
    other = Task(runs / "r1", PAPER, None, (), tmp_path / "out")
    other.clear()  # a task begins with this call, even if it is interrupted later
    assert task.stored() is None and not half.exists()
    assert task.run()["loads"] == first["loads"]
    recorded = record_run(tmp_path / "mine" / "run", map(paper_sample, range(10))).file
    with pytest.raises(RecordingError, match="exists already"):
        Task(runs / "r0", PAPER, None, (), tmp_path / "mine").run()
    assert recorded.exists()


def test_no_input_is_removed_and_results_of_two_recordings_are_not_mixed(runs: Path, tmp_path: Path) -> None:
    out, narrow = tmp_path / "out", tmp_path / "narrow.yaml"
    scene = load_scene(scene_path("paper"))
    narrow.write_text(dump_scene(replace(scene, clearance=replace(scene.clearance, horizontal_m=0.02))))
    Task(runs / "r0", PAPER, None, (narrow,), out).run()
    assert (out / "predicted_1.parquet").exists()
    # one file is an input of this task, and the other belongs to another task
    for path in (out / "run", out / "run" / "run_0.mcap"):
        with pytest.raises(RecordingError, match="would replace it"):
            Task(path, None, None, (), out).run()
        with pytest.raises(RecordingError, match="would replace it"):
            Task(runs / "r1", PAPER, None, (), out).check([path])
    assert (out / "run" / "run_0.mcap").exists() and (out / "report.html").exists()
    (broken := tmp_path / "broken").mkdir()
    (broken / "load.csv").write_text("t,fx,fy,m\n0.0,nan,0,0\n")
    with pytest.raises(RecordingError):
        Task(broken, PAPER, None, (), out).run()
    assert not [path.name for path in out.iterdir() if path.is_file()]
    # another scene, or the same scene in another role, makes another task
    Task(runs / "r0", PAPER, None, (narrow,), out).run()
    assert Task(runs / "r0", PAPER, None, (narrow,), out).stored() is not None
    assert Task(runs / "r0", PAPER, narrow, (), out).stored() is None
    assert Task(runs / "r0", narrow, None, (PAPER,), out).stored() is None
    narrow.write_text(dump_scene(scene))
    assert Task(runs / "r0", PAPER, None, (narrow,), out).stored() is None


def test_files_beside_the_data_are_inputs_of_the_analysis(runs: Path, tmp_path: Path) -> None:
    (data := tmp_path / "data").mkdir()
    load = data / "load.csv"
    load.write_text((runs / "r0" / "load.csv").read_text())
    paper = load_scene(scene_path("paper"))
    scene, other = dump_scene(paper), dump_scene(replace(paper, clearance=replace(paper.clearance, vertical_m=0.02)))
    (data / "scene.yaml").write_text(scene)
    task = Task(load, None, None, (), data / "out")
    task.run()
    assert task.stored() is not None
    (data / "scene.yaml").write_text(other)
    assert task.stored() is None
    (data / "scene.yaml").write_text(scene)
    assert task.stored() is not None
    (data / "more.mcap").write_bytes(b"")
    assert task.stored() is None
