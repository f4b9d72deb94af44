"""The benchmark runs, names what it cannot run, and its errors are within what was asked; no time is judged."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scenes import ROOT

BENCHMARK = ROOT / "benchmark"


def run(code: str, *arguments: str) -> str:
    """Run Python with the benchmark's folder on its path."""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(BENCHMARK)!r}); {code}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    table = tmp_path_factory.mktemp("benchmark") / "quick.csv"
    command = [sys.executable, str(BENCHMARK / "run.py"), "--quick", "--out", str(table)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_part_has_its_rows(rows: list[dict[str, str]]) -> None:
    counted = Counter(row["section"] for row in rows)
    assert counted["work_precision"] == 2 * 2 * (4 + 1)
    assert counted["stiffness"] == 8 and counted["contact_events"] == 8 and counted["machine_time"] == 2
    assert counted["random_scenes"] == 2 * 20
    assert counted["ensemble"] >= 5


@pytest.mark.parametrize(("scene", "factor"), [("kv", 1.0), ("hc", 10.0)])
def test_errors_on_the_bench_scenes_are_within_the_tolerance(
    rows: list[dict[str, str]], scene: str, factor: float
) -> None:
    own = [
        row for row in rows
        if row["section"] == "work_precision" and row["scene"] == scene and row["setting"].startswith("tol=")
    ]  # fmt: skip
    assert len(own) == 8
    for row in own:
        assert row["status"] == "ok"
        assert float(row["error"]) <= factor * float(row["setting"].removeprefix("tol="))


def test_random_scenes_stay_near_their_references(rows: list[dict[str, str]]) -> None:
    """Error in tolerances: at most ten, or a few times what the scene makes of one tolerance at the start."""
    calm = [
        row for row in rows
        if row["section"] == "random_scenes" and row["status"] == "ok" and float(row["amplification"]) < 1e4
    ]  # fmt: skip
    assert len(calm) >= 20
    for row in calm:
        assert float(row["value"]) <= max(10.0, 5.0 * float(row["amplification"])), row["scene"]


def test_work_grows_with_contact_events_not_with_time(rows: list[dict[str, str]]) -> None:
    steps = {row["scene"]: int(row["steps"]) for row in rows if row["section"] == "contact_events"}
    assert steps["free flight"] <= 2
    per_event = [
        int(row["steps"]) / int(row["events"])
        for row in rows
        if row["section"] == "contact_events" and int(row["events"]) > 0
    ]
    assert max(per_event) < 20


def test_a_peer_that_is_missing_is_named() -> None:
    code = (
        "sys.modules['sksundae'] = None; sys.modules['sksundae.cvode'] = None; "
        "import work_precision as w; from cases import measure; "
        "rows = measure([c for c in w.python_cases('kv') if 'sundae' in c.row.solver][:1], 1, lambda text: None); "
        "print(rows[0].solver, '|', rows[0].status, '|', rows[0].wall_ms)"
    )
    solver, status, wall = run(code).strip().split(" | ")
    assert solver == "CVODE Adams (scikit-sundae)" and wall == "None"
    assert status.startswith("not run: ") and "sksundae" in status


def test_the_independent_reference_agrees_with_the_shipped_one(tmp_path: Path) -> None:
    """`reference.c` on both bench scenes against trajectories made by another program."""
    code = (
        "import numpy as np, random_scenes as r, bench_scenes as b\n"
        "from native import NotInstalled\n"
        "for name in b.NAMES:\n"
        "    try: run = r.reference_run(b.bench_scene(name), 3.0, 0.01, r.LONG_DOUBLE[0])\n"
        "    except NotInstalled as problem: print('missing', problem); break\n"
        "    with np.load(b.ROOT / 'test' / 'data' / f'bench_{name}.npz') as z: expected = z['q'][:301]\n"
        "    print(name, run.finished, r.distance(b.bench_scene(name), run.q, expected))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code, encoding="utf-8")
    output = run(f"exec(open({str(script)!r}).read())")
    if output.startswith("missing"):
        pytest.skip(output)
    table = [line.split() for line in output.strip().splitlines()]
    assert [line[0] for line in table] == ["kv", "hc"]
    for _, finished, error in table:
        assert finished == "True" and float(error) < 1e-12


def test_saved_references_belong_to_the_saved_scenes() -> None:
    """Rows start at the initial pose, and a scene that is calm has a reference."""
    with np.load(BENCHMARK / "data" / "random_scenes.npz") as saved:
        q, lines = saved["q"], saved["lines"]
        assert q.shape == (200, 51, 3) and len(lines) == 200
        calm = saved["amplification"] < 1e3
        assert calm.sum() > 100 and (saved["disagreement"][calm] < 1e-10).all()
    initial = np.array([[float(word) for word in str(line).split()[17:20]] for line in lines])
    assert np.abs(q[:, 0] - initial).max() < 1e-15
