"""Search for the recordings at the paths that a user gives, without repetitions."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from plow_twin.errors import RecordingError
from plow_twin.record.bag import beside_folders
from plow_twin.record.reader import mcap_path, packed, read_header
from plow_twin.scene_file.parquet_lines import SUFFIX

_KINDS: Final = ("*.mcap", "*.db3", "*.csv")


def _holds(folder: Path, kinds: Sequence[str] = _KINDS) -> bool:
    return folder.is_dir() and any(any(folder.glob(pattern)) for pattern in kinds)


def _is_recording(folder: Path, results: Sequence[Path]) -> bool:
    """Return whether a folder is one recording, and not a folder of several recordings."""
    if not _holds(folder):
        return False
    if (folder / "metadata.yaml").is_file() or any(folder.glob(f"{glob.escape(folder.name)}_*")):
        return True
    if (folder / "analysis.json").is_file():
        results = [*results, (folder / "run").resolve()]
    runs = [item for item in folder.iterdir() if _holds(item, _KINDS[:2]) and item.resolve() not in results]
    return not set(runs) - set(beside_folders(folder))


def left_out(path: Path, results: Sequence[Path] = ()) -> list[Path]:
    """Return the items in a folder that `expand` omits: empty folders, tables beside runs, and runs inside a run."""
    if not path.is_dir():
        return []
    folders = [item for item in sorted(path.iterdir()) if item.is_dir()]
    if _is_recording(path, results):
        return [item for item in folders if _holds(item) and item not in beside_folders(path)]
    empty = [item for item in folders if not any(item.iterdir())]
    return empty + sorted(path.glob("*.csv")) + [file for item in folders if _holds(item) for file in left_out(item)]


def expand(paths: Sequence[Path], results: Sequence[Path] = ()) -> list[Path]:
    """Return the recordings at the given paths, and those directly inside the given folders.

    The folders `results` contain results of an earlier analysis and are not recordings. Raise `RecordingError` if a
    folder has no recording.
    """
    recordings: list[Path] = []
    for path in paths:
        if not path.is_dir() or _is_recording(path, results):
            recordings.append(path)
            continue
        inside = [
            item
            for item in sorted(path.iterdir())
            # a recording with missing parts is included; its analysis names the missing parts
            if item.suffix in (".mcap", ".db3") or _holds(item) or (item / "metadata.yaml").is_file()
        ]
        # a table beside recordings is probably a result of an analysis
        if not inside and any(path.glob(f"*{SUFFIX}")):
            inside = [path]
        if not inside:
            raise RecordingError(f"{path}: got a folder without recordings, expected at least one{packed(path)}")
        recordings += inside
    return recordings


def counted_once(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the recordings without repetitions of a path or a run, and a message for each repetition."""
    kept: dict[object, Path] = {}
    left_out: list[str] = []
    for path in paths:
        keys = path.resolve(), _identity(path)
        first = next((kept[key] for key in keys if key in kept), None)
        if first is None:
            kept |= dict.fromkeys(keys, path)
        elif first == path:
            left_out.append(f"{path}: given twice, used once")
        else:
            left_out.append(f"{path}: left out: the same run as {first}")
    return list(dict.fromkeys(kept.values())), left_out


def _identity(path: Path) -> object:
    """Return a key that is equal for two copies of a run."""
    try:
        header = read_header(mcap_path(path))
    except (RecordingError, OSError):  # the analysis reports the error
        header = None
    return path if header is None or not header.run_id else (header.run_id, header.part)
