"""Sweeps give bit-identical results to single runs, even after kills."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import forge
import numpy as np
import pyarrow.parquet as pq
import pytest
from figure_checks import check_figure, kept_figures
from scenes import preset
from waiting import until

from plow_twin import Friction, simulate
from plow_twin.cli.app import run
from plow_twin.errors import SceneError
from plow_twin.scene_file import dump_scene
from plow_twin.study.cluster import connect
from plow_twin.study.parameters import StudyError, parameter_of, parameter_paths, with_parameters
from plow_twin.study.store import Store
from plow_twin.study.sweep.run import run_here, run_on_cluster
from plow_twin.study.sweep.table import Sweep, parse_axis
from plow_twin.study.words import parameter_words, statistic_words

GRID = ["--x", "clearance.horizontal_m=0.020:0.030:5", "--y", "contact.stiffness=6e6:6e7:3:log"]
STATISTICS = (
    "max.top_left_top",
    "max.ccw.a",
    "contact_sets.ccw.ad",
    "contact_points.cw.4",
    "impulse",
    "makes",
    "events",
)


def sweep_of(*axes: str, t_end: float = 6.0) -> Sweep:
    scene = preset("paper")
    return Sweep(dump_scene(scene), tuple(parse_axis(text, scene) for text in axes), STATISTICS, t_end, 1e-7)


def test_every_member_has_the_numbers_of_its_single_run(tmp_path: Path) -> None:
    sweep = sweep_of(GRID[1], GRID[3])
    table = run_here(Store(tmp_path, sweep, chunk=4))
    assert sweep.shape == (5, 3) and not table.failed
    for member in (0, 7, 14):
        values = sweep.values(member)
        scene = with_parameters(preset("paper"), values)
        assert (scene.clearance.horizontal_m, scene.contact.stiffness) == tuple(values.values())
        single = simulate(scene, sweep.t_end_s, tol=sweep.tol)
        four = single.contact_sets["cw"].get("abcd", 0.0)
        expected = (
            single.statistics["top_left_top"]["max"],
            single.statistics["bottom_right_bottom"]["max"],
            single.contact_sets["ccw"].get("ad", 0.0),
            four,
            sum(row["impulse"] for row in single.statistics.values()),
            sum(row["makes"] for row in single.statistics.values()),
            len(single.events),
        )
        assert table.numbers[member] == pytest.approx(expected, rel=1e-7, abs=0.0)
    assert np.unique(table.numbers[:, 0]).size == 15


def test_axes_of_parameters_and_statistics_have_readable_labels_with_units() -> None:
    for path in parameter_paths(preset("paper")):
        words, factor = parameter_words(path)
        assert not words.endswith(("_m", "_n", "_kg", "_rad")) and factor > 0.0, path
    assert parameter_words("clearance.horizontal_m") == ("horizontal clearance [mm]", 1e3)
    assert parameter_words("wear.coefficient_m2_n") == ("wear coefficient [m²/N]", 1.0)
    assert parameter_words("support.horizontal_damping_n_s_m") == ("support horizontal damping [N s/m]", 1.0)
    assert parameter_words("loads.fy.phase_rad") == ("load fy phase [rad]", 1.0)
    assert statistic_words("max.ccw.a") == ("largest force, counter-clockwise, corner a [kN]", 1e-3)
    assert statistic_words("contact_points.cw.2") == ("share of contact time, clockwise, force at 2 corners", 1.0)


def test_parameters_are_set_and_refused_by_path() -> None:
    scene = preset("paper")
    assert {"contact.stiffness", "loads.fx1.phase_rad", "head.com_offset_m[0]", "initial.q[2]"} <= set(
        parameter_paths(scene)
    )
    changed = with_parameters(
        scene, {"loads.fx3.sign": 1.0, "loads.fx1.arm_sign": -1.0, "clearance.scale": 2.0, "clearance.vertical_m": 0.02}
    )
    assert changed.loads[2].force_n == (96000.0, 0.0) and changed.loads[0].at_m == (0.0, -0.72)
    assert (changed.clearance.horizontal_m, changed.clearance.vertical_m) == (0.05, 0.04)
    assert "clearance.vertical_m" not in changed.marks and "head.mass_kg" in changed.marks
    assert with_parameters(scene, {"contact.restitution": 0.5}).contact.damping is None
    assert scene.friction is None and with_parameters(scene, {"contact.stiffness": 1e7}).friction is None
    assert with_parameters(scene, {"friction.coefficient": 0.2}).friction == Friction(0.2)
    for path in parameter_paths(scene):
        value = parameter_of(scene, path)
        if value is not None:
            assert dump_scene(with_parameters(scene, {path: value})).count("value") > 0
            assert parameter_of(with_parameters(scene, {path: value}), path) == value
    with pytest.raises(StudyError, match=r"contact\.stifness.*nearest: contact\.stiffness"):
        with_parameters(scene, {"contact.stifness": 1.0})
    with pytest.raises(SceneError, match=r"contact\.stiffness: got -1\.0"):
        with_parameters(scene, {"contact.stiffness": -1.0})


def test_a_killed_sweep_continues(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["study", "sweep", "paper", *GRID, "--statistic", "max.ccw.a", "--statistic", "events"]
    arguments += ["--t-end", "40", "--chunk", "2", "--out"]
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    process = forge.start("plow_twin", [*arguments, str(killed)], stderr=subprocess.DEVNULL)
    try:
        until(lambda: process.poll() is not None or len(list(killed.glob("chunks/*.npz"))) >= 2, pause_s=0.005)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    stored = len(list(killed.glob("chunks/*.npz")))
    assert process.returncode == -signal.SIGKILL and 2 <= stored < 8
    # a killed write or a defective disk leaves such files
    (killed / "chunks" / ".00007.npz.1").write_bytes(b"half")
    first = killed / "chunks" / "00000.npz"
    first.write_bytes(first.read_bytes()[:100])

    assert run([*arguments, str(killed)]) == 0
    before = 2 * (stored - 1)
    assert f"15 members, {before} already stored, {15 - before} to compute" in capsys.readouterr().err
    assert run([*arguments, str(whole), "--quiet"]) == 0
    assert (killed / "sweep.parquet").read_bytes() == (whole / "sweep.parquet").read_bytes()
    assert run([*arguments, str(killed)]) == 0
    assert "15 already stored, 0 to compute" in capsys.readouterr().err


def test_failed_members_are_listed_and_invalid_arguments_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plow_twin.study.cluster.CONNECT_TIMEOUT_S", 0.5)
    arguments = ["study", "sweep", "paper", "--statistic", "max", "--t-end", "2", "--out", str(tmp_path)]
    arguments += ["--x", "contact.stiffness=1e3,-1,1e7,1e8"]
    figures = kept_figures(monkeypatch)
    assert run(arguments) == 3
    check_figure(figures[0])
    assert figures[0].get_suptitle().startswith("Sweep of paper: 2 s each, drawn 20")
    assert figures[0].axes[0].get_xlabel() == "contact stiffness [MN/mⁿ]"
    assert figures[0].axes[0].get_ylabel() == "largest force [kN]"
    printed = capsys.readouterr()
    assert "left the model's range" in printed.err and "contact.stiffness: got -1.0" in printed.err
    stored = (tmp_path / "sweep.parquet").read_bytes()
    table = pq.read_table(tmp_path / "sweep.parquet")
    assert table["status"].to_pylist() == [1, -1, 0, 0]
    assert table["contact.stiffness"].to_pylist() == [1e3, -1.0, 1e7, 1e8]
    assert np.isnan(table["max"].to_numpy()).tolist() == [True, True, False, False]
    facts = json.loads(table.schema.metadata[b"plow_twin"])
    assert facts["arguments"]["tol"] == 1e-9 and "mass_kg" in facts["arguments"]["scene_yaml"]
    assert facts["units"] == {"max": "N"} and facts["builds"][0]["numba"]
    assert (tmp_path / "sweep.png").read_bytes()[:4] == b"\x89PNG"

    assert run([*arguments, "--tol", "1e-8"]) == 2
    assert "differs in tol (stored 1e-09, asked 1e-08)" in capsys.readouterr().err
    assert run([*arguments, "--set", "head.mass_kg=2000"]) == 2
    assert "differs in the scene" in capsys.readouterr().err
    assert (tmp_path / "sweep.parquet").read_bytes() == stored
    (tmp_path / "chunks" / "notes.txt").write_text("somebody's")
    assert run([*arguments, "--set", "head.mass_kg=2000", "--fresh", "-q"]) == 3
    assert (tmp_path / "chunks" / "notes.txt").read_text() == "somebody's"
    for wrong, message in (
        (["--x", "contact.stiffness=1:2"], "PATH=LOW:HIGH:COUNT".replace("PATH", "contact.stiffness")),
        (["--statistic", "max.ccw.z"], "nearest: max.ccw"),
        (["--x", "contact.law=flores,hu_gou"], "contact.law: got 'hu_gou', expected one of exact_restitution"),
        (["--y", "contact.stiffness=1:2:3"], "two different parameters"),
        (["--x", "contact.stiffness=1:2:100000000"], "expected at most 1000000"),
        (["--x", "contact.stiffness=1:2:2000", "--y", "head.mass_kg=1:2:2000"], "got 4000000 members"),
        (["--dask", "tcp://127.0.0.1:1"], "expected the address of a scheduler"),
    ):
        extra = ["--fresh", "--x", "contact.stiffness=1e7:2e7:2"] if "--dask" in wrong else []
        assert run([*arguments, *extra, *wrong]) == (1 if "--dask" in wrong else 2)
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(("module", "extra"), [("pyarrow", "study"), ("distributed", "dask")])
def test_a_missing_library_is_named_before_the_work(
    module: str, extra: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    arguments = ["study", "sweep", "paper", *GRID, "--statistic", "max", "--t-end", "2", "--dask", "tcp://127.0.0.1:1"]
    assert run([*arguments, "--out", str(tmp_path / "out")]) == 1
    assert f"{module}, which is not installed: pip install 'plow_twin[{extra}]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["http://127.0.0.1:8786", "tcp://127.0.0.1", ""])
def test_no_client_is_made_for_an_invalid_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # such a client would wait 40 s at the end of the process, and then print a traceback
    monkeypatch.setattr("distributed.Client", None)
    with pytest.raises(StudyError, match=f"got '{address}', expected the address of a scheduler"):
        connect(address)


def test_killing_a_dask_worker_loses_no_result(tmp_path: Path) -> None:
    from distributed import LocalCluster

    sweep = sweep_of(GRID[1], GRID[3], t_end=40.0)
    store = Store(tmp_path / "cluster", sweep, chunk=1)
    kill: list[int] = []
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        victim = cluster.workers[0].pid

        def on_progress(done: int) -> None:
            if not kill:
                os.kill(victim, signal.SIGKILL)
                kill.append(done)

        table = run_on_cluster(store, cluster.scheduler_address, on_progress)
        assert victim not in {worker.pid for worker in cluster.workers.values()}
    assert kill == [1]
    local = run_here(Store(tmp_path / "local", sweep, chunk=4))
    assert np.array_equal(table.status, local.status) and not table.failed
    assert table.numbers.tobytes() == local.numbers.tobytes()
    assert len(set(table.builds) | set(local.builds)) == 1
