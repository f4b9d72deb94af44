"""The command line in a separate process, as a user runs it, and in this process, which is faster."""

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
    command = [sys.executable, "-m", "plow_twin", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=110, stdin=subprocess.DEVNULL)


@contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a program, and kill it at the end of the context. A `Popen` context would wait without limit."""
    with subprocess.Popen(command, text=True, **options) as process:
        try:
            yield process
            process.wait(60)
        finally:
            process.kill()


def plow_twin_here(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, which saves the second that the start of a process takes."""
    given, out, err = [*map(str, arguments)], StringIO(), StringIO()
    with chdir(cwd or Path.cwd()), redirect_stdout(out), redirect_stderr(err):
        code = run(given)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())
