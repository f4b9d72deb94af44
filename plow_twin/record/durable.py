"""What a disk does not take: its errors name the file, what is there is whole, and it is waited for after a write."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give errors of a disk, which is full at a write long after a file was opened, the name of the file or folder."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def whole_file(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Give a stream whose content becomes the file `path` in one step, once all of it is written.

    Until then, after an error and after a kill, the file is the one before, or none. With `sync` that holds for a loss
    of power too. What is no regular file, a pipe or a device, is written to as it is.

    Raises
    ------
    OSError
        The disk does not take it; the error has the name of the file.
    """
    try:
        if path.exists() and not path.is_file():
            with path.open("wb") as stream:
                yield stream
            return
        place = path.resolve()  # a link goes on to point there
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
        if error.errno is None:  # of a library, with a text of its own
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_whole(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a file in one step: `whole_file`."""
    with whole_file(path, sync=sync) as stream:
        stream.write(content)


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
