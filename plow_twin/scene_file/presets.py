"""Paths of the files of `config/`, in the source tree or in share/plow_twin of an installation."""

from __future__ import annotations

from pathlib import Path
from typing import Final

PRESETS: Final = ("paper", "bench_kv", "bench_hc", "measured_square", "measured_ellipse")


def config_folder() -> Path:
    """Return the folder with the configuration files of the package.

    Raise `FileNotFoundError` if the package was installed without its data files.
    """
    package = Path(__file__).resolve().parent.parent
    if (package.parent / "package.xml").is_file():
        return package.parent / "config"
    # an installation has the folders lib/pythonX.Y/site-packages/plow_twin and share
    unresolved = Path(__file__).absolute().parent.parent
    for prefix in (*package.parents, *unresolved.parents):
        folder = prefix / "share" / "plow_twin" / "config"
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"share/plow_twin/config: not found above {package}; was the package installed by pip or colcon?"
    )


def scene_path(name: str | Path) -> Path:
    """Return the file of a preset (`PRESETS`). Return a path that is no preset unchanged."""
    return config_folder() / f"{name}.yaml" if str(name) in PRESETS else Path(name)
