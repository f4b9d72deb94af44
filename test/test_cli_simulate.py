"""The command line: files, JSON and exit codes. It is run in this process unless the process matters."""

from __future__ import annotations

import csv
import json
import os
import re
import resource
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mcap_bytes
import numpy as np
import pytest
from commands import plow_twin, plow_twin_here

from plow_twin import PAIR_NAMES, Gravity, simulate
from plow_twin.cli import scene_facts
from plow_twin.record.durable import whole_file
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.scene_file.presets import scene_path

RUN = ["simulate", "paper", "--t-end", "2", "--output-dt", "0.01"]


def test_csv_and_json_contain_the_documented_columns_and_keys(tmp_path: Path) -> None:
    completed = plow_twin(*RUN, "--tol", "1e-10", "--out", "run.csv", "--json", cwd=tmp_path)
    assert completed.returncode == 0, completed.stderr
    result = simulate(load_scene(scene_path("paper")), 2.0, 0.01, tol=1e-10)

    with (tmp_path / "run.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header == ["t", "x", "y", "theta", "vx", "vy", "omega", *(f"force_{name}" for name in PAIR_NAMES)]
    expected = np.column_stack([result.t, result.q, result.v, result.force])
    np.testing.assert_array_equal(np.array(rows, dtype=float), expected)  # 17 digits represent each number exactly

    answer = json.loads(completed.stdout)
    assert answer.keys() == {"scene", "t_end", "pairs", "contact_sets", "solver", "wall_s", "compile_s"}
    assert (answer["scene"], answer["t_end"]) == ("paper", 2.0)
    assert tuple(answer["pairs"]) == PAIR_NAMES
    assert answer["pairs"] == result.statistics
    for row in answer["pairs"].values():
        assert row.keys() == {"max", "mean_in_contact", "mean_over_time", "impulse", "time_in_contact", "makes"}
    assert answer["contact_sets"] == result.contact_sets
    assert answer["contact_sets"].keys() == {"ccw", "cw"}
    assert sum(answer["contact_sets"]["cw"].values()) == pytest.approx(1.0)
    assert answer["solver"].keys() >= {"method", "steps", "evaluations", "events"}
    assert answer["wall_s"] > 0.0
    assert answer["compile_s"] >= 0.0


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_on_a_full_disk_a_file_keeps_its_old_content_or_is_complete(suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"run{suffix}"
    arguments = ("simulate", "bench_kv", "--t-end", "1", "--quiet", "--out", str(out))
    assert plow_twin_here(*arguments).returncode == 0
    before = out.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        done = plow_twin_here(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (done.returncode, done.stderr) == (1, f"plow-twin: {out}: File too large\n")
    assert out.read_bytes() == before and [*tmp_path.iterdir()] == [out]


def test_messages_of_a_library_about_a_file_are_preserved(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no such codec"), whole_file(tmp_path / "table"):
        raise OSError("no such codec")
    assert not [*tmp_path.iterdir()]


def test_a_device_is_written_directly(tmp_path: Path) -> None:
    pipe, other = tmp_path / "pipe.csv", tmp_path / "other.csv"
    os.mkfifo(pipe)
    (tmp_path / "link.csv").symlink_to(other)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_text)
        for name in ("pipe.csv", "link.csv"):
            done = plow_twin_here("simulate", "bench_kv", "--t-end", "1", "-q", "--out", str(tmp_path / name))
            assert done.returncode == 0
    assert read.result() == other.read_text() and pipe.is_fifo() and (tmp_path / "link.csv").is_symlink()


def test_npz_contains_exactly_the_documented_arrays(tmp_path: Path) -> None:
    done = plow_twin_here(*RUN, "--out", str(tmp_path / "run.npz"), "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    result = simulate(load_scene(scene_path("paper")), 2.0, 0.01)
    with np.load(tmp_path / "run.npz") as run:
        assert set(run) == {
            *("t", "q", "v", "force", "penetration"),
            *("event_time", "event_pair", "event_from", "event_to", "event_rate"),
        }
        for name in ("t", "q", "v", "force", "penetration"):
            np.testing.assert_array_equal(run[name], getattr(result, name))
        assert run["q"].shape == (201, 3)
        assert run["force"].shape == (201, 8)
        np.testing.assert_array_equal(run["event_time"], result.events["time"])
        np.testing.assert_array_equal(run["event_to"], result.events["mode_to"])
        assert set(run["event_to"]) <= {0, 1, 2}
        assert len(run["event_time"]) > 10


def test_fixed_step_methods_run_the_same_scene(tmp_path: Path) -> None:
    answers = {}
    for method, extra in (("events", []), ("rk4", ["--dt", "1e-4"]), ("euler", ["--dt", "1e-5"])):
        done = plow_twin_here("simulate", "paper", "--t-end", "1", "--method", method, *extra, "--json")
        assert done.returncode == 0, done.stderr
        answers[method] = json.loads(done.stdout)
        assert answers[method]["solver"]["method"] == method
    assert answers["rk4"]["solver"]["steps"] == 10_000
    exact = answers["events"]["pairs"]
    largest = max(exact, key=lambda name: exact[name]["impulse"])
    for method in ("rk4", "euler"):
        assert answers[method]["pairs"][largest]["impulse"] == pytest.approx(exact[largest]["impulse"], rel=1e-3)
        assert answers[method]["pairs"][largest]["max"] == pytest.approx(exact[largest]["max"], rel=1e-2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "paper"], "--t-end"),
        (["simulate", "paper", "--t-end", "nan"], "got 'nan', expected a finite number > 0"),
        (["simulate", "paper", "--t-end", "1", "--out", "run.txt"], "expected a name that ends in .csv or .npz"),
        (["simulate", "paper", "--t-end", "1", "--out", "no/run.csv"], "expected an existing folder"),
        (["simulate", "paper", "--t-end", "1", "--method", "rk4"], "--dt"),
        (["simulate", "paper", "--t-end", "1", "--dt", "1e-3"], "--dt"),
        (
            ["simulate", "paper", "--t-end", "1", "--method", "rk4", "--dt", "1e-3", "--output-dt", "0.0015"],
            "output_dt",
        ),
        (
            ["simulate", "paper", "--t-end", "1e6", "--output-dt", "1e-7"],
            "1e+13 rows, expected at most 10000000 rows: 0.1",
        ),
        (
            ["simulate", "paper", "--t-end", "1e300", "--output-dt", "1e-300"],
            "inf rows, expected at most 10000000 rows",
        ),
        (["simulate", "missing.yaml", "--t-end", "1"], "missing.yaml"),
        (
            ["simulate", "bad.yaml", "--t-end", "1"],
            "head.mass: got 2430.0, expected a known key; did you mean mass_kg",
        ),
        (["replay", "missing.mcap"], "missing.mcap"),
        (["demo", "--speed", "warp"], "warp"),
        (["record", "run", "--all", "--exclude", "["], "expected a regular expression"),
        (["nonsense"], "nonsense"),
    ],
)
def test_wrong_usage_and_wrong_scenes_exit_with_2(arguments: list[str], message: str, tmp_path: Path) -> None:
    plain = dump_scene(replace(load_scene(scene_path("paper")), marks={}))
    (tmp_path / "bad.yaml").write_text(plain.replace("mass_kg", "mass"))
    done = plow_twin_here(*arguments, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_a_closed_standard_output_causes_no_traceback() -> None:
    command = [sys.executable, "-m", "plow_twin", "info", "paper"]
    completed = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *command], capture_output=True, text=True, timeout=100)
    assert (completed.returncode, completed.stderr) == (0, "")


def test_failures_exit_with_1(tmp_path: Path) -> None:
    (tmp_path / "no.mcap").write_bytes(b"not a recording")
    (tmp_path / "full.csv").symlink_to("/dev/full")
    for arguments, message in (
        (["info", "no.mcap"], "no.mcap"),
        (["replay", "no.mcap"], "no.mcap"),
        (["simulate", "paper", "--t-end", "0.1", "--out", "full.csv"], "full.csv: No space left on device"),
    ):
        done = plow_twin_here(*arguments, cwd=tmp_path)
        assert done.returncode == 1, done.stderr
        assert message in done.stderr
        assert "Traceback" not in done.stderr


def test_too_little_memory_gives_one_line_and_exit_code_1() -> None:
    code = """
import resource, sys
from plow_twin import simulate
from plow_twin.scene_file.presets import scene_path
from plow_twin.scene_file import load_scene
from plow_twin.cli import main
simulate(load_scene(scene_path("paper")), 0.1)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
main(["simulate", "paper", "--t-end", "1", "--output-dt", "1.1e-7", "--quiet"])
"""
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=110, check=False)
    assert completed.returncode == 1, completed.stderr
    assert completed.stderr.startswith("plow-twin: not enough memory")
    assert "Traceback" not in completed.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_signal_at_the_end_of_the_interpreter_has_no_effect(number: int) -> None:
    code = f"""
import atexit, os
from plow_twin.cli import main
atexit.register(os.kill, os.getpid(), {int(number)})
main(["simulate", "no such scene"])
"""
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=110, check=False)
    assert (completed.returncode, "Traceback" in completed.stderr) == (2, False), completed.stderr


def test_a_missing_extra_is_named_with_its_pip_command(tmp_path: Path) -> None:
    (tmp_path / "mcap.py").write_text("raise ModuleNotFoundError(\"No module named 'mcap'\", name='mcap')")
    (tmp_path / "run.mcap").write_bytes(mcap_bytes.beginning())
    # `python -m` puts the working directory, which contains this mcap.py, first on the path
    completed = plow_twin("replay", "run.mcap", cwd=tmp_path)
    assert completed.returncode == 1
    assert "pip install 'plow_twin[record]'" in completed.stderr
    assert "Traceback" not in completed.stderr


def test_info_lists_marks_and_versions() -> None:
    done = plow_twin_here("info", "paper", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    rows = {row["key"]: row for row in facts["numbers"]}
    assert rows["contact.stiffness"] | {"source": ""} == {
        "key": "contact.stiffness",
        "value": 9.6975e6,
        "unit": "N/m^exponent",
        "mark": "reconstructed",
        "source": "",
    }
    derived = {fact["quantity"]: fact["value"] for fact in facts["derived"]}
    assert derived["constant moment of gravity"] == pytest.approx(-2430 * 9.81 * 0.255)
    assert derived["fx1: amplitude of the moment"] == pytest.approx(-66240)
    rigid = load_scene("bench_kv")
    rigid = replace(rigid, head=replace(rigid.head, rotation="consistent", com_offset_m=(0.1, 0.0)), gravity=Gravity())
    moments = [fact["value"] for fact in scene_facts.derived(rigid) if "moment of gravity" in fact["quantity"]]
    assert moments == pytest.approx([-rigid.head.mass_kg * 9.81 * 0.1])
    environment = plow_twin_here("info", "--json")
    assert environment.returncode == 0, environment.stderr
    versions = json.loads(environment.stdout)
    assert versions["numpy"] == np.__version__
    assert {"mcap", "rerun-sdk", "matplotlib", "pyarrow", "Jinja2", "distributed", "rclpy"} <= versions.keys()


def test_the_energy_balance_closes() -> None:
    # this scene uses the same kernels as the pinned motions
    call = ["simulate", "bench_kv", *RUN[2:], "--energy-balance"]
    done = plow_twin_here(*call, "--json")
    assert done.returncode == 0, done.stderr
    balance = json.loads(done.stdout)["energy_balance"]
    start, end = balance["kinetic_j"]
    stored = balance["stored_j"][1] - balance["stored_j"][0]
    supplied = balance["load_work_j"] + balance["gravity_work_j"]
    used = balance["dissipated_j"] + balance["friction_work_j"] + stored
    assert end - start == pytest.approx(supplied - used, abs=1e-6 * balance["turnover_j"])
    assert balance["dissipated_j"] > 1.0 and balance["friction_work_j"] == 0.0
    assert 0.0 <= balance["relative_imbalance"] < 1e-6 and len(balance["momentum_imbalance"]) == 3
    shown = plow_twin_here(*call).stdout
    assert "balance of energy" in shown and "largest imbalance" in shown


def test_comments_of_the_paper_scene_state_the_evidence_for_words() -> None:
    text = scene_path("paper").read_text(encoding="utf-8")
    words = re.findall(r"^ *(rotation|labels|law|locked|pairs|wear): (?:[^#\n]*)(.*)$", text, re.MULTILINE)
    assert {key for key, _ in words} == {"rotation", "labels", "law", "locked", "pairs", "wear"}
    for key, comment in words:
        assert re.match("# (given|reconstructed|assumed): .", comment), f"{key}: {comment!r}"
