"""Environments and clean sources for tests that install the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement

from plow_twin.kernel.polynomial import to_bernstein
from plow_twin.model.contact import power_term
from plow_twin.solve.loop import integrate
from plow_twin.solve.method.series import expand

ROOT = Path(__file__).resolve().parent.parent
SOURCES = (
    "plow_twin",
    "config",
    "launch",
    "resource",
    "scripts",
    "setup.py",
    "setup.cfg",
    "package.xml",
    "pyproject.toml",
    "LICENSE",
    "README.md",
    "MANIFEST.in",
)


def copy_sources(target: Path) -> Path:
    """Copy the inputs of a build, without results of an earlier build or run."""
    target.mkdir(parents=True)
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, target / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        else:
            shutil.copy2(ROOT / name, target / name)
    return target


def clean_environment(**extra: str) -> dict[str, str]:
    """Return the environment without the variables that refer to another installation."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH")
    # the ROS wheels restart Python with these variables; a child in another environment must not inherit them
    hidden += ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "NUMBA_CACHE_DIR")
    return {key: value for key, value in os.environ.items() if key not in hidden} | extra


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None, code: int = 0) -> str:
    """Run a command and check its exit code. Return its output, or its error output if `code` is not 0."""
    completed = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=env if env is not None else clean_environment(),
        capture_output=True,
        text=True,
        timeout=300,
        stdin=subprocess.DEVNULL,
    )
    assert completed.returncode == code, (
        f"{command} ended with {completed.returncode}\n{completed.stdout}\n{completed.stderr}"
    )
    return completed.stderr if code else completed.stdout


def make_environment(folder: Path) -> Path:
    """Create an empty virtual environment. Return its Python."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    return folder / "bin" / "python"


def lend(python: Path, *names: str) -> None:
    """Link distributions of this environment, and all that they require, into another one; copies would take long."""
    (site,) = python.parent.parent.glob("lib/python*/site-packages")
    waiting, linked = [*names], set[str]()
    while waiting:
        if (name := waiting.pop()) in linked:
            continue
        linked.add(name)
        package = distribution(name)
        needed = (Requirement(text) for text in package.requires or ())
        waiting += [
            requirement.name
            for requirement in needed
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        ]
        for part in {file.parts[0] for file in package.files or ()} - {"..", "__pycache__"}:
            if not (site / part).exists():
                (site / part).symlink_to(package.locate_file(part))


def install(python: Path, *requirements: str) -> None:
    """Install into an environment without looking for anything outside of it."""
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-compile", "--no-index")
    run(*pip, *requirements, cwd=python.parent)


def lend_kernels(python: Path) -> None:
    """Copy the kernels that this source tree has compiled into the package that is installed in an environment.

    If sources or versions differ, the copies are ignored and the kernels are compiled again.
    """
    (package,) = python.parent.parent.glob("lib/python*/site-packages/plow_twin")
    for kernel in (to_bernstein, power_term, integrate, expand):
        folder = package / Path(kernel.py_func.__code__.co_filename).parent.relative_to(ROOT / "plow_twin")
        kept = shutil.ignore_patterns("*.py[co]")
        shutil.copytree(kernel.stats.cache_path, folder / "__pycache__", ignore=kept, dirs_exist_ok=True)


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the package from clean sources with the setuptools of this environment."""
    source = copy_sources(folder / "source")
    wheels = folder / "wheels"
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    run(*pip, "--wheel-dir", wheels, ".", cwd=source)
    (wheel,) = wheels.glob("*.whl")
    return wheel
