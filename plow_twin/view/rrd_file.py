"""Writer of rerun files that raises an error if the disk is full."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from threading import Thread
from typing import Final, Self

import rerun as rr
import rerun.blueprint as rrb

from plow_twin.errors import RecordingError

#: Largest number of bytes copied at once. A pipe contains fewer bytes, so each copy empties the pipe.
_CHUNK: Final = 1 << 20


class RrdFile:
    """Writer of a stream to a file through a pipe, as a context manager. An incomplete file is removed.

    The file sink of rerun 0.41 waits forever if the disk is full. With this writer, `check` and the end of the context
    raise `RecordingError` instead.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise self._refused(error) from error
        self._error: OSError | None = None
        self._stream: rr.RecordingStream | None = None
        self._outlet, self._inlet = os.pipe()
        self._writer = Thread(target=self._write, name="rrd file", daemon=True)
        self._writer.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._stream is not None:
            self._stream.disconnect()
        os.close(self._inlet)
        self._writer.join()
        if (kind is not None or self.failed) and self.path.is_file():  # a device such as /dev/null is not removed
            self.path.unlink()
        if kind is None:
            self.check()

    def attach(self, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        """Attach a stream with its blueprint."""
        self._stream = stream
        stream.save(f"/dev/fd/{self._inlet}", default_blueprint=blueprint)

    @property
    def failed(self) -> bool:
        """True if a write has failed."""
        return self._error is not None

    def check(self) -> None:
        """Raise `RecordingError` if a write has failed."""
        if self._error is not None:
            raise self._refused(self._error) from self._error

    def _refused(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self.path}: cannot be written: {error.strerror}")

    def _write(self) -> None:
        with open(self._outlet, "rb", buffering=0) as outlet:
            try:
                with self._file:
                    shutil.copyfileobj(outlet, self._file, _CHUNK)
            except OSError as error:
                self._error = error
                while outlet.read(_CHUNK):  # the stream would block if nothing read the pipe
                    pass
