"""What a disk does not take: it is waited for after a write, and its errors name the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give errors of a disk, which is full at a write long after a file was opened, the name of the file or folder."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


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
