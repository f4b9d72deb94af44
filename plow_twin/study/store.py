"""The folder of a sweep.

    sweep.json          the arguments of the sweep, and the number of members in a chunk
    chunks/00007.npz    the status and statistics of the members of one chunk, and the build that computed the chunk

A chunk is written atomically, so a killed run loses only its unfinished chunk.
"""

from __future__ import annotations

import json
import re
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from plow_twin.record.durable import write_whole
from plow_twin.study.parameters import StudyError
from plow_twin.study.sweep.table import Sweep, Table

Array = NDArray[np.float64]

FORMAT: Final = 1
#: Name of a chunk, or of the temporary file of a chunk that a killed process left behind.
_CHUNK_NAME: Final = re.compile(r"\d{5,}\.npz|\.\d{5,}\.npz\.\d+")


class Store:
    """The stored chunks of one sweep, in a folder that is created if necessary.

    A chunk has `chunk` members, or as many as the chunks that are already stored. `fresh` deletes a stored sweep. Raise
    `StudyError` if the folder contains a sweep with other arguments, an unreadable sweep, or chunks without
    `sweep.json`.
    """

    def __init__(self, folder: Path, sweep: Sweep, chunk: int, fresh: bool = False) -> None:
        self.folder, self.sweep, self.chunk = folder, sweep, chunk
        self._chunks = folder / "chunks"
        if fresh:
            for path in [*self._chunks.glob("*.npz*"), *self._chunks.glob(".*.npz.*")]:
                if _CHUNK_NAME.fullmatch(path.name):
                    path.unlink()
            (folder / "sweep.json").unlink(missing_ok=True)
        if (folder / "sweep.json").exists():
            self._take_up()
        elif self._chunks.exists() and not fresh:
            raise StudyError(
                f"{folder}: got chunks without sweep.json, expected a sweep's folder (--fresh discards it)"
            )
        self._chunks.mkdir(parents=True, exist_ok=True)
        facts = {"format": FORMAT, "chunk": self.chunk, "arguments": sweep.arguments()}
        write_whole(folder / "sweep.json", json.dumps(facts, indent=1).encode(), sync=True)

    def _take_up(self) -> None:
        path = self.folder / "sweep.json"
        try:
            facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            stored, self.chunk = facts["arguments"], int(facts["chunk"])
        except (ValueError, KeyError, TypeError):
            raise StudyError(f"{path}: cannot be read, expected a sweep (--fresh discards it)") from None
        requested = self.sweep.arguments()
        differing = [key for key in requested if stored.get(key) != requested[key]]
        if differing or facts.get("format") != FORMAT:
            difference = (
                "; ".join(_difference(key, stored.get(key), requested[key]) for key in differing) or "its format"
            )
            raise StudyError(
                f"{self.folder}: contains another sweep, which differs in {difference}. Use another --out or --fresh"
            )

    @property
    def chunks(self) -> list[range]:
        """The indices of the members of each chunk."""
        size = self.sweep.size
        return [range(begin, min(begin + self.chunk, size)) for begin in range(0, size, self.chunk)]

    def missing(self) -> list[int]:
        """Return the indices of the chunks that are missing or damaged."""
        return [index for index in range(len(self.chunks)) if self.read(index) is None]

    def read(self, index: int) -> tuple[Array, str] | None:
        """Return the table and the build of a chunk, or None if the chunk is missing or damaged."""
        try:
            with self._path(index).open("rb") as file, np.load(file, allow_pickle=False) as archive:
                table, build = np.asarray(archive["table"], float), str(archive["build"])
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None
        shape = (len(self.chunks[index]), 1 + len(self.sweep.statistics))
        return (table, build) if table.shape == shape else None

    def write(self, index: int, table: Array, build: str) -> None:
        """Store a chunk, with its table, shape (members, 1 + statistics), and the fingerprint of its build."""
        buffer = BytesIO()
        np.savez(buffer, table=table, build=np.array(build))
        write_whole(self._path(index), buffer.getvalue(), sync=True)

    def table(self) -> Table:
        """Return the whole table, or raise a `StudyError` if a chunk is missing."""
        chunks = [self.read(index) for index in range(len(self.chunks))]
        parts = [part for part in chunks if part is not None]
        if len(parts) < len(chunks):
            raise StudyError(f"{self.folder}: got {len(parts)} chunks, expected {len(chunks)}")
        whole = np.concatenate([table for table, _ in parts])
        builds = tuple(sorted({build for _, build in parts}))
        return Table(self.sweep, whole[:, 0].astype(np.int64), whole[:, 1:], builds)

    def _path(self, index: int) -> Path:
        return self._chunks / f"{index:05d}.npz"


def _difference(key: str, stored: Any, requested: Any) -> str:
    if key == "scene_yaml":
        return "the scene"
    return f"{key} (stored {json.dumps(stored)}, asked {json.dumps(requested)})"
