"""Properties of the checks: each stress run draws new examples, and the lowest versions are exact."""

from __future__ import annotations

import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, settings
from scenes import ROOT

VERSION = re.compile(r"^([\w.-]+)>=([\d.]+)(,<[\d.]+)?$")


def dry_run(target: str, *variables: str) -> str:
    command = ["make", "--dry-run", "--always-make", target, *variables]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_a_stress_run_draws_new_examples_and_prints_its_seed() -> None:
    stress = settings.get_profile("stress")
    assert not stress.derandomize and stress.database is None and Phase.shrink in stress.phases
    line = dry_run("stress")
    assert "--hypothesis-profile=stress --hypothesis-seed=$seed" in line and 'echo "SEED=$seed"' in line
    assert "--hypothesis" not in dry_run("test") and settings.get_profile("plow_twin").derandomize


@pytest.fixture
def metadata(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    stated: dict[str, Any] = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("setuptools.setup", lambda **keywords: stated.update(keywords))
    runpy.run_path(str(ROOT / "setup.py"))
    return stated


def test_every_file_of_the_package_is_installed(metadata: dict[str, Any]) -> None:
    package = ROOT / "plow_twin"
    tracked = subprocess.run(["git", "ls-files", "plow_twin"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    others = {ROOT / name for name in tracked if not name.endswith(".py")}
    installed = {path for pattern in metadata["package_data"]["plow_twin"] for path in package.glob(pattern)}
    assert others <= installed and installed
    folders = {path.parent for path in package.rglob("*.py")}
    assert {".".join(folder.relative_to(ROOT).parts) for folder in folders} == {*metadata["packages"]}


def test_the_lowest_versions_agree_with_setup(metadata: dict[str, Any]) -> None:
    stated: dict[str, str] = {}
    extras = metadata["extras_require"]
    of_tests = [line for line in extras["test"] if re.match("pytest(-xdist)?>", line)]
    run = (line for name in ("record", "mqtt", "sparkplug", "metrics") for line in extras[name])
    for line in (*metadata["install_requires"], *run, *of_tests):
        match = VERSION.fullmatch(line)
        assert match is not None, line
        stated[match[1]] = match[2]
    stated["lz4"] = "4.3"  # the first version with a wheel for Python 3.11; version 4.0.2 in Ubuntu needs a compiler
    lines = (ROOT / "requirements" / "lowest.txt").read_text().splitlines()
    lowest = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert lowest.keys() == stated.keys()
    for name, version in stated.items():
        # `6` means the first release of version 6, and `1.26` the last patch of 1.26
        assert lowest[name].removesuffix(".*").split(".")[: len(version.split("."))] == version.split("."), name
    assert "1.26" in lowest["numpy"]


#: Code that holds the interpreter lock, so that no signal handler and no other thread can run.
HANGING = """
import ctypes

def test_before():
    pass

def test_that_hangs():
    ctypes.PyDLL(None).sleep(100)
"""


def test_a_hanging_test_is_named_and_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "test_hanging.py").write_text(HANGING)
    options = f"-n 1 -p no:cacheprovider -c {ROOT}/pyproject.toml --rootdir={tmp_path} {tmp_path}"
    options += " -o faulthandler_timeout=1"
    venv = Path(sys.prefix)
    command = ["make", f"--old-file={venv}/.installed", "test", f"VENV={venv}", f"PYTEST_ARGS={options}"]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert completed.returncode != 0 and "1 failed, 1 passed" in completed.stdout
    assert re.search("crashed while running '.*test_that_hangs'", completed.stdout)
    assert "in test_that_hangs" in completed.stderr  # the output names the place where the test hangs


#: Source of a kernel.
DOUBLE = "from plow_twin.kernel.compiler import kernel\n@kernel(entry=True)\ndef double(x):\n    return 2.0 * x\n"
#: Source of a test of this kernel that waits until another process has reached the same place.
MEETING = """
import time
from pathlib import Path
from doubling import double

def test_it():
    here = Path(__file__)
    here.with_suffix(".here").touch()
    while len(list(here.parent.glob("*.here"))) < 2:
        time.sleep(0.01)
    assert double(2.0) == 4.0
"""


def test_the_processes_of_a_suite_compile_a_kernel_once(tmp_path: Path) -> None:
    (folder := tmp_path / "test").mkdir()
    for name in ("conftest.py", "compiles.py", "ros_domain.py", "shared_work.py", "first.txt"):
        shutil.copy(ROOT / "test" / name, folder)
    (folder / "doubling.py").write_text(DOUBLE)
    for name in ("test_one.py", "test_other.py"):
        (folder / name).write_text(MEETING)
    environment = {name: text for name, text in os.environ.items() if not name.startswith("PYTEST_")}
    command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "loadfile", "--compiles", "test"]
    completed = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert completed.returncode == 0, completed.stdout
    assert re.search(r" 1 times  doubling\.double", completed.stdout), completed.stdout


def test_the_test_files_that_run_first_exist() -> None:
    names = [line for line in (ROOT / "test" / "first.txt").read_text().splitlines() if not line.startswith("#")]
    assert names and all((ROOT / "test" / name).is_file() for name in names)


def test_ci_is_bounded_and_runs_every_check() -> None:
    program = (ROOT / ".ci" / "run").read_text()
    steps = re.findall(r'^step "([^"]+)" (\d+) (?:env \S+ )?make (.+)', program, re.MULTILINE)
    assert sum(int(limit) for _, limit, _ in steps) <= 4200
    targets = {word for _, _, script in steps for word in script.split()}
    # coverage is a figure and not a check, so it has no required minimum
    assert targets >= {"test", "lint", "docs", "demo", "lowest"}
    assert "test_stream_session.py" in dry_run("coverage") and "--cov" not in dry_run("test")
    lowest = dry_run("lowest")
    assert all(
        name in lowest
        for name in ("test_solve_reference.py", "test_record_file.py", "test_ros_lifecycle.py", "test_mqtt.py")
    )


def test_a_screenshot_does_not_change_the_settings_of_the_user_s_viewer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    screenshot = importlib.import_module("screenshot")
    environments: list[dict[str, str]] = []
    monkeypatch.setattr(screenshot.subprocess, "run", lambda command, **options: environments.append(options["env"]))
    monkeypatch.setattr(screenshot.subprocess, "Popen", lambda command, **options: environments.append(options["env"]))
    screenshot.start_viewer(9, tmp_path)
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        assert [environment[name] for environment in environments] == [str(tmp_path)] * 2
