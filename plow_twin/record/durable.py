"""Replace files atomically, add file names to disk errors, and wait until data are on the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` that is raised inside this context without a file name."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def whole_file(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a stream, and replace the file `path` atomically by the content of the stream when the context ends.

    If an error occurs or the process is killed, an existing file stays unchanged. With `sync`, the new file survives a
    loss of power. If `path` is a pipe or a device, it cannot be replaced, so the stream writes to it directly. Raise
    `OSError` if the file cannot be written. The error contains the path.
    """
    try:
        if path.exists() and not path.is_file():
            with path.open("wb") as stream:
                yield stream
            return
        place = path.resolve()  # if `path` is a symbolic link, the target of the link is replaced
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
        if error.errno is None:  # the error was raised by a library, which has described it
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_whole(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write `content` to a file atomically. The arguments `path` and `sync` are described in `whole_file`."""
    with whole_file(path, sync=sync) as stream:
        stream.write(content)


def sync_path(*paths: Path) -> None:
    """Wait until the content of files, or of folders, is on the disk.

    A new file survives a loss of power only if the file and its folder are synchronized.
    """
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
