"""Limits on the files that parameters may name, because anybody on the ROS graph may set parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

from plow_twin.errors import Problem
from plow_twin.scene_file.presets import PRESETS

#: Parameters that name files or folders.
FILES: Final = ("scene", "record_path", "wear_state_path")


class Named(Protocol):
    """The parameters that name files, and the folder that bounds them."""

    @property
    def file_root(self) -> str:
        """Folder within which the files must be; empty: anywhere."""

    @property
    def scene(self) -> str:
        """Scene file or preset."""

    @property
    def record_path(self) -> str:
        """Folder of the recording."""

    @property
    def wear_state_path(self) -> str:
        """Folder of the wear."""


def outside(settings: Named) -> list[Problem]:
    """Return a problem for each parameter that names a file outside `file_root`; symbolic links are followed."""
    if not settings.file_root:
        return []
    root = Path(settings.file_root).resolve()
    named = {name: getattr(settings, name) for name in FILES}
    return [
        Problem(name, given, f"a path within file_root, {root}")
        for name, given in named.items()
        if _is_path(name, given) and not Path(given).resolve().is_relative_to(root)
    ]


def refused_changes(before: Named, after: Named) -> list[str]:
    """Return why parameters that name files cannot be changed so after the start; presets are allowed."""
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
