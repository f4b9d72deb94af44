"""Keep the last seconds of a run in memory, as parts of a recording, and write them to a folder on request."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from plow_twin.errors import RecordingError, TakenError
from plow_twin.record.durable import sync_path
from plow_twin.record.header import RunHeader
from plow_twin.record.mcap_file import ByteFile, MemoryFile
from plow_twin.record.metadata_yaml import PartFacts, bag_metadata, write_metadata
from plow_twin.record.writer import RunWriter, make_folder, shortage

#: Number of parts in a full ring. Only whole parts are dropped.
PARTS: Final = 8


class RingWriter(RunWriter):
    """Recording in memory that drops its oldest parts.

    The ring contains at least the last `ring_s` seconds, and at most an eighth more. The argument `folder` gives the
    recording its name, and the folder is not created. With `sync_dumps`, the method `dump` waits until the data are on
    the disk.
    """

    def __init__(
        self,
        folder: Path,
        header: RunHeader,
        chunk_size: int,
        min_free_bytes: int,
        ring_s: float,
        *,
        sync_dumps: bool = False,
    ) -> None:
        self._ring_s, self._sync_dumps = ring_s, sync_dumps
        self._finished: list[tuple[float, PartFacts, bytes]] = []  # start [s], description and content of each part
        self._begun = time.monotonic()
        super().__init__(folder, header, chunk_size, min_free_bytes)
        self.path = folder

    def _make(self, path: Path) -> ByteFile:
        return MemoryFile()

    def _prepare(self, folder: Path) -> None:
        """Do nothing, because a ring needs no folder."""

    @property
    def bytes_written(self) -> int:
        """Size of the parts in memory [B]."""
        return sum(len(content) for _, _, content in self._finished) + self.part_bytes

    def shortage(self) -> str | None:
        """Return None, because a ring uses no disk space."""
        return None

    def split(self, loss: Mapping[str, int], keep_bytes: int = 0) -> None:
        """Start a new part, and drop the parts that the ring no longer needs."""
        old = self._part
        super().split(loss, 0)
        assert isinstance(old.file.out, MemoryFile)
        self._finished.append((self._begun, self._done.pop(), old.file.out.getvalue()))
        self._bytes_before, self._begun = 0, time.monotonic()
        while len(self._finished) > 1 and self._finished[1][0] <= self._begun - self._ring_s:
            self._finished.pop(0)

    def dump(self, folder: Path, loss: Mapping[str, int]) -> None:
        """Write all completed parts to a new folder, and remove them from memory.

        Raise `TakenError` if the folder contains another recording, and `OSError` or `RecordingError` if the folder
        cannot be written. The parts then stay in memory.
        """
        make_folder(folder)
        with ExitStack() as undone:  # after an error, the files written so far are removed
            undone.callback(_remove, folder)
            self._dump(folder, loss, undone)
            undone.pop_all()
        if self._sync_dumps:
            sync_path(folder.parent)
        self._finished = []

    def _dump(self, folder: Path, loss: Mapping[str, int], undone: ExitStack) -> None:
        """Write the parts to a folder, and register the removal of each file with `undone`."""
        if (short := shortage(folder, self._min_free_bytes)) is not None:
            raise RecordingError(short)
        facts = []
        for _, part, content in self._finished:
            name = f"{folder.name}_{part.name.rpartition('_')[2]}"
            try:
                with (folder / name).open("xb") as stream:
                    undone.callback((folder / name).unlink)
                    stream.write(content)
            except FileExistsError as error:
                raise TakenError(f"{folder / name}: exists already, expected a new file for the recording") from error
            if self._sync_dumps:
                sync_path(folder / name)
            facts.append(PartFacts(name, part.start_ns, part.end_ns, part.topics))
        for name in ("metadata.yaml", "metadata.yaml.partial"):
            undone.callback((folder / name).unlink, missing_ok=True)
        write_metadata(folder, bag_metadata(facts, loss), sync=self._sync_dumps)

    def close(self, loss: Mapping[str, int], stop_reason: str | None = None) -> None:
        """Remove all parts from memory."""
        self._finished = []


def _remove(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
