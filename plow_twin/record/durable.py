"""What a loss of power leaves: a file or folder of which the disk has been waited for."""

from __future__ import annotations

import os
from pathlib import Path


def sync_path(*paths: Path) -> None:
    """Wait until the disk has what a file holds, or what a folder lists: a new file is lost without its folder.

    Raises
    ------
    OSError
        The disk does not take it.
    """
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
