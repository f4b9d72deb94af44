"""Environments and clean sources for tests that install the package."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

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
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=env if env is not None else clean_environment(),
        capture_output=True,
        text=True,
        timeout=300,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == code, f"{command} ended with {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stderr if code else done.stdout


def make_environment(folder: Path, *requirements: str) -> Path:
    """Create a virtual environment with the given requirements at the locked versions. Return its Python."""
    run(sys.executable, "-m", "venv", folder, cwd=folder.parent)
    python = folder / "bin" / "python"
    install(python, *requirements)
    return python


def install(python: Path, *requirements: str) -> None:
    """Install requirements at the locked versions into an environment."""
    pip = ("-m", "pip", "install", "--quiet", "--no-compile", "-c", ROOT / "requirements" / "constraints.txt")
    run(python, *pip, *requirements, cwd=python.parent)


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
