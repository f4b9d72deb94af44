"""Writing of files in one step, disk errors that name the file, and waiting for the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` raised inside this context, such as the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def whole_file(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a stream whose content becomes the file `path` in one step at the end.

    Until then, and after an error or a kill, an existing file stays unchanged. With `sync` the new file also survives a
    loss of power. A pipe or a device is written to directly.

    Raises
    ------
    OSError
        The file cannot be written; the error names it.
    """
    try:
        if path.exists() and not path.is_file():
            with path.open("wb") as stream:
                yield stream
            return
        place = path.resolve()  # a symbolic link stays, and its target is replaced
        beside = place.with_name(f".{place.name}.{os.getpid()}")
        try:
            with beside.open("wb") as stream:
                yield stream
                if sync:
                    stream.flush()
                    os.fsync(stream.fileno())
            beside.replace(place)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
        if sync:
            sync_path(place.parent)
    except OSError as error:
        if error.errno is None:  # the library that raised the error has described it
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_whole(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a file in one step by `whole_file`."""
    with whole_file(path, sync=sync) as stream:
        stream.write(content)


def sync_path(*paths: Path) -> None:
    """Wait until files, or the entries of folders, are on the disk. A new file needs both."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
