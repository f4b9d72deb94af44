"""Every example runs as its README describes, in limited time, with the promised output."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet
import pytest
from scenes import ROOT

SAID = {
    "first_scene": r"top_left_top +largest +[1-9][\d.]* kN, +\d+ makes",
    "live_twin": r"restored and advanced by 1000 samples in one call: [0-9a-f]{16}, bit-identical",
    "own_contact_law": r"0\.50 +0\.\d+ +0\.5000",
    "sweep": r"20\.0 mm( +\d+\.\d){5}",
    "calibration": r"stiffness 3\.1e\+07 N/m",
    "reading_a_recording": r"result +the same\b",
    "measured_drop": r"mean distance of the simulated centre: \d+\.\d mm; measured inside the bands: \d+%",
    "a_year": r"the forecast narrowed from \d+ to \d+ days",
}
FOLDERS = sorted(path for path in (ROOT / "examples").iterdir() if path.is_dir())


def test_every_example_is_listed_and_has_a_short_readme() -> None:
    assert {folder.name for folder in FOLDERS} == SAID.keys()
    listed = (ROOT / "examples" / "README.md").read_text()
    for folder in FOLDERS:
        assert f"({folder.name}/README.md)" in listed
        readme = (folder / "README.md").read_text()
        assert len(readme.splitlines()) <= 12 and f"python examples/{folder.name}/run.py" in readme
        for target in re.findall(r"\]\(([^)#]+)\)", readme):
            assert (folder / target).exists(), target


def test_the_extras_named_for_the_examples_install_the_imports_of_the_examples() -> None:
    extra_of = {"matplotlib": "study", "rosbags": "record", "rerun": "view"}
    named = re.search(r"pip install '\.\[([\w,]+)\]'", (ROOT / "examples" / "README.md").read_text())
    for script in (ROOT / "examples").glob("*/run.py"):
        modules = set(re.findall(r"^(?:import|from) (\w+)", script.read_text(), re.MULTILINE))
        modules -= {*sys.stdlib_module_names, "numpy", "plow_twin"}
        assert {extra_of[module] for module in modules} <= set(named[1].split(",")), script


#: Examples that compile additional kernels or take minutes.
LONG = ("a_year", "calibration", "measured_drop")


@pytest.mark.timeout(250)
@pytest.mark.parametrize(
    "folder",
    [pytest.param(one, marks=pytest.mark.stress) if one.name in LONG else one for one in FOLDERS],
    ids=lambda folder: folder.name,
)
def test_the_example_runs(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(folder / "run.py"), str(tmp_path)]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert completed.returncode == 0, completed.stderr
    assert re.search(SAID[folder.name], completed.stdout), completed.stdout
    if folder.name == "first_scene":
        assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")
    if folder.name == "sweep":
        table = [float(number) for row in re.findall(r" mm(.+)", completed.stdout) for number in row.split()]
        assert table == pytest.approx(table_of_the_command(folder, tmp_path), abs=0.051)


def table_of_the_command(folder: Path, out: Path) -> list[float]:
    """Return the largest forces [kN] that the command in the README of the sweep computes."""
    readme = (folder / "README.md").read_text()
    command = re.search(r"`plow-twin (study sweep [^`]+) --out runs/sweep`", readme)[1].split()
    subprocess.run([sys.executable, "-m", "plow_twin", *command, "--out", str(out)], check=True, capture_output=True)
    return [float(force) / 1e3 for force in pyarrow.parquet.read_table(out / "sweep.parquet")["max"].to_pylist()]
