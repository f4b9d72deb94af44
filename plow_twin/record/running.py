"""Search for the recording that is being written now."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

from plow_twin.errors import RecordingError
from plow_twin.record.follow import POLL_S, is_claimed
from plow_twin.record.reader import read_header, run_parts


def find_run(path: Path, wait_s: float, stop: Callable[[], bool] = lambda: False) -> Path:
    """Return `running_run`, or else the existing recording at `path`.

    Raises
    ------
    RecordingError
        There is no recording.
    """
    found = running_run(path, wait_s, stop)
    if found is None and not path.exists():
        raise RecordingError(f"{path}: got no recording within {wait_s:g} s, expected one that is being written")
    return found or path


def running_run(path: Path, wait_s: float, stop: Callable[[], bool] = lambda: False) -> Path | None:
    """Return the recording that is being written at `path` or beside it (`<path>_2`, ...).

    Returns None if no recording is being written within `wait_s` [s], or once `stop` returns True.
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
            except (RecordingError, OSError):  # the recording has not begun yet, or was just removed
                continue
        if stop() or time.monotonic() >= deadline:
            return None
        time.sleep(POLL_S)


def _candidates(path: Path) -> list[Path]:
    """Return `path` and the folders `<path>_2`, ... that a recorder makes when `path` exists, the newest first."""
    numbered: list[tuple[int, Path]] = [(1, path)]
    if path.parent.is_dir():
        for other in path.parent.glob(f"{path.name}_*"):
            digits = re.fullmatch(r"_(\d+)", other.name.removeprefix(path.name))
            numbered += [(int(digits[1]), other)] if digits and other.is_dir() else []
    return [candidate for _, candidate in sorted(numbered, reverse=True)]
