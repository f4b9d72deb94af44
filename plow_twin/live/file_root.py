"""Limits on the files that parameters may name: anybody on the ROS graph may set parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from plow_twin.errors import Problem
from plow_twin.scene_file.presets import PRESETS

if TYPE_CHECKING:
    from plow_twin.live.parameters import Settings

#: Parameters that name files or folders.
FILES: Final = ("scene", "record_path", "wear_state_path")


def outside(settings: Settings) -> list[Problem]:
    """Return a problem for each parameter that names a file outside `file_root`, after symbolic links."""
    if not settings.file_root:
        return []
    root = Path(settings.file_root).resolve()
    named = {name: getattr(settings, name) for name in FILES}
    return [
        Problem(name, given, f"a path within file_root, {root}")
        for name, given in named.items()
        if _is_path(name, given) and not Path(given).resolve().is_relative_to(root)
    ]


def refused_changes(before: Settings, after: Settings) -> list[str]:
    """Return why parameters that name files cannot be changed after the start; presets can."""
    if after.file_root:
        return [str(problem) for problem in outside(after)]
    changed = [name for name in FILES if getattr(before, name) != getattr(after, name)]
    return [
        f"{name}: names a file, and is read-only without the parameter file_root"
        for name in changed
        if not (name == "scene" and getattr(after, name) in PRESETS)
    ]


def _is_path(name: str, given: str) -> bool:
    return bool(given) and not (name == "scene" and given in PRESETS)
