"""Read and write the wear file of a head, from which the next process restores the wear of the pads."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from plow_twin.errors import PlowTwinError
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.model.scene import Scene
from plow_twin.record.durable import write_whole

FILE_NAME: Final = "wear.json"
VERSION: Final = 1


class WearStateError(PlowTwinError, ValueError):
    """A wear file cannot be used."""


def scene_identity(scene: Scene) -> str:
    """Return a hash of the numbers that identify a set of pads: frame, clearance, head and initial wear depths.

    Loads, contact parameters and the wear coefficient are not included, because they may change while the pads stay.
    """
    numbers = (
        *(scene.frame.width_m, scene.frame.height_m),
        *(scene.clearance.horizontal_m, scene.clearance.vertical_m),
        *(scene.head.mass_kg, scene.head.inertia_kg_m2),
        *(() if scene.wear is None else (scene.wear.pad_area_m2, *scene.wear.initial_depth_m)),
    )
    return hashlib.sha256(" ".join(float(number).hex() for number in numbers).encode()).hexdigest()[:16]


def check_depth(depth_m: Sequence[float], scene: Scene) -> None:
    """Raise a `ValueError` if a depth is negative or larger than the frame of the scene allows."""
    most = 0.5 * min(scene.frame.width_m, scene.frame.height_m)
    if not all(0.0 <= depth <= most for depth in depth_m):
        raise ValueError(f"got {list(depth_m)}, expected depths from 0 to half the frame's smaller side, {most:g} m")


def read_wear(folder: Path) -> bytes | None:
    """Return the content of the wear file in a folder, or None if the folder has no wear file."""
    path = folder / FILE_NAME
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise WearStateError(f"{path}: cannot be read: {error}") from error


def parse_wear(content: bytes, path: Path, head: str, scene: Scene) -> tuple[float, ...]:
    """Return the wear depths [m] from the content of a wear file.

    Raise `WearStateError` if the content is invalid, or belongs to another head or scene.
    """
    try:
        record: dict[str, Any] = json.loads(content)
        if record["version"] != VERSION:
            raise WearStateError(f"{path}: version: got {record['version']!r}, expected {VERSION}")
        found = {name: str(record[name]) for name in ("head", "scene")}
        depth = tuple(float(record["depth_m"][name]) for name in PAIR_NAMES)
    except WearStateError:
        raise
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise WearStateError(f"{path}: damaged, expected the wear of {len(PAIR_NAMES)} pads ({error!r})") from error
    for name, expected in (("head", head), ("scene", scene_identity(scene))):
        if found[name] != expected:
            raise WearStateError(
                f"{path}: {name}: got {found[name]!r}, expected {expected!r}: the wear of another {name} is not used; "
                "give another folder or move the file away"
            )
    try:
        check_depth(depth, scene)
    except ValueError as error:
        raise WearStateError(f"{path}: depth_m: {error}") from error
    return depth


def claim_folder(folder: Path) -> int:
    """Create a folder for the wear file of one twin, and lock it until the returned descriptor is closed.

    Raise `WearStateError` if the folder cannot be written to, or another twin has locked it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise _unwritable(folder, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise WearStateError(f"{folder}: another twin uses it for its wear, expected a separate folder") from None
    except OSError:  # the file system has no locks
        pass
    beside = folder / f".{FILE_NAME}.{os.getpid()}"
    try:
        beside.touch()
        beside.unlink()
    except OSError as error:
        os.close(descriptor)
        raise _unwritable(folder, error) from error
    return descriptor


def _unwritable(folder: Path, error: OSError) -> WearStateError:
    reason = error.strerror or str(error)
    return WearStateError(f"wear_state_path: got {str(folder)!r}, expected a folder that can be written to: {reason}")


def wear_content(head: str, scene: str, depth_m: Sequence[float]) -> bytes:
    """Return the content of a wear file with the wear depths [m] of a head; `scene` is a `scene_identity`."""
    record = {
        "version": VERSION,
        "head": head,
        "scene": scene,
        "saved": datetime.now(UTC).isoformat(timespec="seconds"),
        "depth_m": dict(zip(PAIR_NAMES, depth_m, strict=True)),
    }
    return (json.dumps(record, indent=1) + "\n").encode()


def save_wear(folder: Path, content: bytes) -> None:
    """Replace the wear file atomically. After a crash, either the complete old file or the complete new file exists.

    Raise `OSError` if the file cannot be written, or the disk has not confirmed the new content.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / FILE_NAME, content, sync=True)
