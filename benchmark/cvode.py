"""CVODE, called from C by the program `cvode_bench.c`, which measures its own run time."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample
from native import NotInstalled, compile_c

_LIBRARIES = [
    *(
        f"-lsundials_{part}"
        for part in ("cvode", "nvecserial", "sunmatrixdense", "sunlinsoldense", "sunnonlinsolfixedpoint")
    ),
    "-lm",
]


def program() -> str:
    try:
        return compile_c("cvode_bench.c", _LIBRARIES)
    except NotInstalled as problem:
        raise NotInstalled(f"SUNDIALS' CVODE library (Debian libsundials-dev): {problem}") from None


def version() -> str:
    return subprocess.run([program(), "--version"], capture_output=True, text=True, check=True).stdout.strip()


def prepare(p: Array, law: str, method: str, roots: bool, rtol: float, output_dt: float) -> Callable[[], Sample]:
    """Prepare one setting. Each call of the result starts a process that measures its own time."""
    executable = program()
    numbers = " ".join(repr(float(number)) for number in p)

    def run() -> Sample:
        with TemporaryDirectory() as folder:
            poses = Path(folder) / "poses"
            setting = [law, method, str(int(roots)), repr(rtol), repr(T_END), repr(output_dt), "1", str(poses)]
            completed = subprocess.run([executable, *setting], input=numbers, capture_output=True, text=True)
            if completed.returncode != 0:
                raise RuntimeError(completed.stderr.strip() or f"exit code {completed.returncode}")
            lines = completed.stdout.split("\n")
            steps, evaluations, events = (int(word) for word in lines[1].split())
            return Sample(float(lines[0]), np.fromfile(poses).reshape(-1, 3), steps, evaluations, events)

    return run
