"""The demo as a user starts it: publisher and node as processes, and a summary of the recording."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from record_support import BASE_NS, paper_sample, record_run, records_of
from rich.console import Console
from ros_processes import ROOT
from waiting import until

from plow_twin.demo.comparison import compare_forces
from plow_twin.demo.demo import Watch, _run, program
from plow_twin.demo.excitation_publisher import plan
from plow_twin.demo.run_summary import summarise
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.start import range_of_motion
from plow_twin.model.loads import compile_loads
from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.run.twin import Twin
from plow_twin.scene_file import load_scene
from plow_twin.stream.journal import Entry, Estimated


def _demo(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "plow_twin", "demo", "--out", str(folder), *arguments]
    return subprocess.run(command, cwd=ROOT, env=dict(os.environ), capture_output=True, text=True, timeout=110)


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv")
def test_the_processes_of_the_demo_always_end_with_it(tmp_path: Path) -> None:
    text = (
        "import os, pathlib, plow_twin.demo.demo\n"
        f"child = plow_twin.demo.demo.Child(['http.server', '0'], pathlib.Path({str(tmp_path / 'log')!r}))\n"
        "print(child._process.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    completed = subprocess.run([sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True, timeout=110)
    child = Path("/proc", completed.stdout.strip(), "cmdline")
    # the child has ended if its command line is empty (a zombie) or absent
    until(lambda: not child.exists() or not child.read_bytes(), "the end of the child")


# CI has a separate step for the speed `fast`
@pytest.mark.parametrize("speed", ["real", pytest.param("fast", marks=pytest.mark.stress)])
def test_the_demo_runs_to_its_end_without_loss(tmp_path: Path, speed: str) -> None:
    done = _demo(tmp_path, "--speed", speed, "--seconds", "3")
    assert done.returncode == 0, done.stderr
    for line in (
        "samples sent 3000, used 3000, frames out 3000, lost 0",
        "contact sets ccw: ",
        "horizontal clearance 25.000",
        " µm, deepest pad",
        "real-time factor ",
        "  look at it: ",
    ):
        assert line in done.stdout, done.stdout
    if speed == "fast":
        # the printed command works in this folder, although the environment is not on PATH
        (again,) = (line.partition(":  ")[2] for line in done.stdout.splitlines() if "again, bit for bit" in line)
        bare = dict(os.environ) | {"PATH": "/usr/bin:/bin"}
        assert subprocess.run(again, shell=True, cwd=ROOT, env=bare, capture_output=True, timeout=100).returncode == 0
    (folder,) = tmp_path.iterdir()
    reader = RunReader(folder / "run")
    assert sum(1 for _ in records_of(reader)) > 12000
    assert reader.status is FileStatus.COMPLETE and not reader.lost
    assert reader.header.clock == ("ros" if speed == "fast" else "system")
    assert (folder / "run.rrd").stat().st_size > 10_000
    assert json.loads((folder / "publisher.log").read_text().splitlines()[-1])["stalls"] == 0
    assert "Traceback" not in (folder / "node.log").read_text()

    # the summary is compared with a twin in this process
    scene = load_scene(folder / "scene.yaml")
    times = np.arange(3000) * 1e-3
    series = Twin(scene, excitation="sampled").advance_samples(times, compile_loads(scene.loads).at(times))
    summary = summarise(folder / "run")
    np.testing.assert_allclose(summary.largest, series.peak.max(axis=0), rtol=1e-6)
    assert (summary.makes == series.makes.sum(axis=0)).all()
    in_contact = (series.impulse > 0.0).sum(axis=0) * 1e-3
    mean = np.divide(series.impulse.sum(axis=0), in_contact, out=np.zeros(8), where=in_contact > 0.0)
    np.testing.assert_allclose(summary.mean_in_contact, mean, rtol=1e-3)
    np.testing.assert_allclose(summary.wear_depth, series.wear_depth[-1], rtol=0.05)
    horizontal, low, high = summary.clearance["horizontal"]
    assert 0.025 < low < horizontal < high
    for shares in summary.contact_sets.values():
        assert sum(shares.values()) == pytest.approx(1.0)


def test_the_demo_starts_with_the_compiled_estimator_and_ends_when_each_sample_is_accounted_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processes are simulated: each read of the diagnostics returns the next report."""
    watch, events = Watch(), list[str]()
    reports = iter([
        {"state": {"lifecycle": "active"}, "estimate": {"ready": "0"}}, {"estimate": {"ready": "0"}},
        {"estimate": {"ready": "1"}}, {"estimate": {"ready": "1", "estimates": "1"}, "input": {"samples_used": "9000"}},
        {"input": {"samples_used": "12000"}},
        {"input": {"samples_used": "14990", "dropped_late": "3", "dropped_stray": "1", "samples_lost": "6"}},
    ])  # fmt: skip

    def look() -> None:
        watch.parts |= next(reports, {})
        watch.reports += 1
        events.append(f"ready {watch.text('estimate', 'ready')}")

    @contextmanager
    def process(arguments: list[str], log: Path) -> Iterator[Mock]:
        events.append(arguments[0].rpartition(".")[2])
        stop = Mock(side_effect=lambda: events.append(f"stop after {watch.accounted} samples"))
        yield Mock(running=False, output=lambda: '{"sent": 15000}', stop=stop)

    @contextmanager
    def watching() -> Iterator[tuple[Watch, Callable[[], None]]]:
        yield watch, look

    monkeypatch.setattr("plow_twin.demo.demo.Child", process)
    monkeypatch.setattr("plow_twin.demo.demo._watching", watching)
    assert _run("real", 15.0, tmp_path, Console(quiet=True), True, None) == (watch, 15000)
    assert events[:5] == ["main", "ready 0", "ready 0", "ready 1", "excitation_publisher"]
    assert events[-1] == "stop after 15000 samples"


def test_forces_are_compared_with_the_machine_s_and_times_of_estimates_are_printed(tmp_path: Path) -> None:
    entries: list[Entry] = [paper_sample(index) for index in range(2000)]
    entries.insert(1500, Estimated(BASE_NS, BASE_NS, 1, 1, (), (0.0,) * 6, ""))
    beside = compare_forces(record_run(tmp_path / "run", entries).folder, 1.5e-3)
    assert beside is not None
    assert beside.estimates_s == pytest.approx([1.499])
    # the twin of this run does not follow its machine, so its forces are those of the nominal model
    assert beside.error["followed"] == pytest.approx(beside.error["nominal"], rel=1e-3)
    assert beside.error["nominal"] > 0.02


def test_the_synthetic_sensor_belongs_to_a_wider_guide() -> None:
    commands = plan("paper", 1000.0, 7.0, sensor_mm=3.0)
    assert commands.pose is not None and commands.pose.shape == (700, 3) and commands.pose_every == 10
    poses, _ = Poses.of(np.arange(700) * 0.01, commands.pose)
    reached = range_of_motion(load_scene("paper"), poses)[0]
    series = Twin(load_scene("paper"), excitation="sampled").advance_samples(np.arange(7000) * 1e-3, commands.wrench)
    own = range_of_motion(load_scene("paper"), Poses.of(np.arange(700) * 0.01, series.q[::10])[0])[0]
    assert reached - own == pytest.approx([3e-3, 3e-3], abs=2e-3)


def test_a_program_is_named_by_a_path_from_this_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "my project" / ".venv" / "bin"
    folder.mkdir(parents=True)
    (folder / "plow-twin").touch()
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.chdir(tmp_path / "my project")
    assert program("plow-twin", "plow_twin") == ".venv/bin/plow-twin"
    assert program("rerun", "rerun") == ".venv/bin/python -m rerun"
    monkeypatch.chdir(folder)
    assert program("plow-twin", "plow_twin") == "./plow-twin"
    monkeypatch.chdir("/")
    assert program("plow-twin", "plow_twin") in (f"'{folder}/plow-twin'", f"'{str(folder)[1:]}/plow-twin'")


def test_a_demo_fails_with_the_reason_if_its_node_cannot_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = _demo(tmp_path / "file" / "below", "--seconds", "1", "--quiet")
    assert done.returncode != 0
    assert "file" in done.stderr and "Traceback" not in done.stderr
