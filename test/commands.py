"""The command line as a user runs it, in its own process, and, faster, in this process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from plow_twin.cli.app import run


def plow_twin(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command as a program."""
    command = [sys.executable, "-m", "plow_twin", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=110, stdin=subprocess.DEVNULL)


@contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a program beside the test, and kill it at the end if it still runs; `Popen` alone would wait for ever."""
    with subprocess.Popen(command, text=True, **options) as process:
        try:
            yield process
            process.wait(60)
        finally:
            process.kill()


def plow_twin_here(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, with the same output and exit code, because starting a process takes a second."""
    given, out, err = [*map(str, arguments)], StringIO(), StringIO()
    with chdir(cwd or Path.cwd()), redirect_stdout(out), redirect_stderr(err):
        code = run(given)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())
