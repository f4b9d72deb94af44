"""The command line in a separate process, as a user runs it, and in this process, which is faster."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import forge

from plow_twin.cli.app import run


def plow_twin(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command as a program."""
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with forge.start("plow_twin", [*map(str, arguments)], cwd=cwd, text=True, **pipes) as process:
        out, err = process.communicate(timeout=250)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


@contextmanager
def started(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a program, and kill it at the end of the context. A `Popen` context would wait without limit."""
    own = [*command[:3]] == [sys.executable, "-m", "plow_twin"]
    start = partial(forge.start, "plow_twin", [*command[3:]]) if own else partial(subprocess.Popen, command)
    with start(text=True, **options) as process:
        try:
            yield process
            process.wait(60)
        finally:
            process.kill()


def plow_twin_here(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, which saves the second that the start of a process takes."""
    words, out, err = [*map(str, arguments)], StringIO(), StringIO()
    with chdir(cwd or Path.cwd()), redirect_stdout(out), redirect_stderr(err):
        code = run(words)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())
