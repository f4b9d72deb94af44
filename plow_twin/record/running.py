"""Find a recording that is being written."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

from plow_twin.errors import RecordingError
from plow_twin.record.follow import POLL_S, is_claimed
from plow_twin.record.reader import read_header, run_parts


def find_run(path: Path, wait_s: float, stop: Callable[[], bool] = lambda: False) -> Path:
    """Return the result of `running_run` or, if it is None, the path of the existing recording `path`.

    Raise `RecordingError` if no recording exists.
    """
    run = running_run(path, wait_s, stop)
    if run is None and not path.exists():
        raise RecordingError(f"{path}: got no recording within {wait_s:g} s, expected a recording in progress")
    return run or path


def running_run(path: Path, wait_s: float, stop: Callable[[], bool] = lambda: False) -> Path | None:
    """Return the recording that is being written to the folder `path`, or to `<path>_2`, `<path>_3`, ....

    If no recording is being written, the function waits until one is written. The function returns None after `wait_s`
    [s], or when `stop` returns True.
    """
    deadline = time.monotonic() + wait_s
    while True:
        for candidate in _candidates(path):
            try:
                parts = run_parts(candidate)
                with parts[-1].open("rb") as stream:
                    claimed = is_claimed(stream.fileno())
                if claimed and read_header(parts[0]) is not None:
                    return candidate
            except (RecordingError, OSError):  # the header is not yet written, or the recording was just removed
                continue
        if stop() or time.monotonic() >= deadline:
            return None
        time.sleep(POLL_S)


def _candidates(path: Path) -> list[Path]:
    """Return `path` and the existing folders `<path>_2`, `<path>_3`, ..., in descending order."""
    numbered: list[tuple[int, Path]] = [(1, path)]
    if path.parent.is_dir():
        for other in path.parent.glob(f"{path.name}_*"):
            digits = re.fullmatch(r"_(\d+)", other.name.removeprefix(path.name))
            numbered += [(int(digits[1]), other)] if digits and other.is_dir() else []
    return [candidate for _, candidate in sorted(numbered, reverse=True)]
