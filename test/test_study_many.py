"""Many recordings at once, with workers that die; one that is analysed while it is recorded."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from record_support import paper_sample, record_run

from plow_twin.stream.journal import Entry
from plow_twin.study.analysis.many import analyse_many
from plow_twin.study.analysis.task import Task, analyse_task

RUNS = 4
PAPER = Path("paper")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Loads as CSV: each analysis makes a run of its own."""
    folder = tmp_path_factory.mktemp("runs")
    for number in range(RUNS):
        (folder / f"r{number}").mkdir()
        rows = (f"{1e-3 * i},{','.join(map(str, paper_sample(i).wrench))}" for i in range(2000 + number))
        (folder / f"r{number}" / "load.csv").write_text("t,fx,fy,m\n" + "\n".join(rows))
    return folder


def tasks(runs: Path, out: Path) -> list[Task]:
    return [Task(path, PAPER, None, (), out / path.name) for path in sorted(runs.iterdir())]


def test_a_killed_worker_loses_nothing_and_a_second_call_takes_what_is_there(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "plow_twin", "analyse", str(runs), "--scene", "paper", "--out", str(out)]
    with subprocess.Popen([*command, "--workers", "2", "--json"], stdout=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not list(out.glob("*/asked.json")) and time.monotonic() < deadline:
            time.sleep(0.01)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        workers = [pid for pid in children if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]
        os.kill(int(workers[0]), signal.SIGKILL)
        report = json.loads(process.communicate(timeout=200)[0])
    assert process.returncode == 0
    assert [facts["input"]["samples_used"] for facts in report["runs"]] == [2000 + n for n in range(RUNS)]
    assert len(list(out.glob("*/analysis.json"))) == RUNS
    # a second call takes what is whole, and makes anew what was cut off in the middle
    (out / "r2" / "asked.json").unlink()
    stored = [task.stored() for task in tasks(runs, out)]
    assert [facts is None for facts in stored] == [False, False, True, False]
    assert stored[0] == report["runs"][0]
    again = analyse_task(tasks(runs, out)[2])
    assert again["input"] == report["runs"][2]["input"] and tasks(runs, out)[2].stored() is not None
    other = Task(runs / "r0", Path("paper_best_fit"), None, (), out / "r0")
    assert other.stored() is None


@pytest.mark.stress
def test_a_cluster_gives_the_same_results(runs: Path, tmp_path: Path) -> None:
    from distributed import LocalCluster

    some = tasks(runs, tmp_path / "out")[:2]
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        found = analyse_many(some, workers=1, dask=cluster.scheduler_address)
    assert [facts["input"]["samples_used"] for facts in found] == [2000, 2001]
    assert all(task.stored() is not None for task in some)


def test_a_run_is_analysed_while_it_is_recorded(tmp_path: Path) -> None:
    reported = threading.Event()

    def entries() -> Iterator[Entry]:
        """Samples; the second half once the first has been reported."""
        for index in range(4000):
            if index == 2000:
                assert reported.wait(100)
            yield paper_sample(index)

    kept: dict[str, Any] = {"flush_period_s": 0.05}
    writer = threading.Thread(target=record_run, args=(tmp_path / "run", entries()), kwargs=kept)
    writer.start()
    command = [sys.executable, "-m", "plow_twin", "analyse", str(tmp_path / "run"), "--watch", "0.1", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        reported.set()
        last = json.loads(process.stdout.read().splitlines()[-1])
    writer.join()
    assert process.returncode == 0 and last["lost"] == {}
    assert 0 < first["input"]["samples_used"] <= 2000 and last["input"]["samples_used"] == 4000
