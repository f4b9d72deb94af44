"""Compilation of the benchmark's C programs, repeated only if their source has changed."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
BUILD = HERE.parent / "build" / "benchmark"
FLAGS = ("-O3", "-march=native", "-std=gnu11", "-Wall")


class NotInstalled(Exception):
    """A program or library that a peer needs is not installed."""


def compile_c(source: str, libraries: Sequence[str], flags: Sequence[str] = FLAGS) -> str:
    """Compile the file `source` of this folder. Return the path of the program, or raise `NotInstalled`."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise NotInstalled("no gcc on PATH")
    text = (HERE / source).read_bytes() + repr((libraries, flags)).encode()
    BUILD.mkdir(parents=True, exist_ok=True)
    program = BUILD / f"{Path(source).stem}-{hashlib.blake2b(text, digest_size=6).hexdigest()}"
    if not program.exists():
        command = [compiler, *flags, "-o", str(program), str(HERE / source), *libraries]
        completed = subprocess.run(command, capture_output=True, text=True)
        if completed.returncode != 0:
            missing = next(
                (line for line in completed.stderr.splitlines() if "error" in line or "cannot find" in line), ""
            )
            raise NotInstalled(f"gcc cannot build {source}: {missing.rpartition('error: ')[2][:120]}")
    return str(program)
