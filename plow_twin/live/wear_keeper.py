"""Save the wear of the pads in a thread, at intervals and when the node stops."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.record.wear_state import (
    FILE_NAME,
    WearStateError,
    claim_folder,
    parse_wear,
    read_wear,
    save_wear,
    scene_identity,
    wear_content,
)


@dataclass(frozen=True)
class KeptWear:
    """Wear depths [m] at the end of an earlier runtime of this process.

    If the depths could not be saved, `older_files` contains the contents of the wear file that the depths should have
    replaced.
    """

    depth_m: tuple[float, ...]
    older_files: tuple[bytes, ...] = ()


class WearKeeper:
    """Storage for the wear of one head in one scene, in a folder.

    Only a file that this object has read or written is replaced, because any other file may come from the user. Raise
    `WearStateError` if the folder cannot be written to, or if another twin uses it.
    """

    def __init__(self, folder: Path, head: str, scene: Scene) -> None:
        self.folder, self._head, self._scene = folder, head, scene
        self._claim: int | None = claim_folder(folder)
        self._identity = scene_identity(scene)
        self._saved: tuple[float, ...] | None = None
        self._own_contents: tuple[bytes, ...] = ()  # contents that the file may have after the last read or write
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="wear")
        self._writing: Future[None] | None = None
        #: reason why the last attempt to save the wear failed; empty after a success
        self.error = ""

    def load(self, kept: KeptWear | None = None) -> tuple[float, ...] | None:
        """Return the wear depths [m] with which the twin starts, or None without saved wear.

        If the depths `kept` could not be saved, and the file has not changed since then, they replace those in the
        file.
        """
        stored = read_wear(self.folder)
        if stored is not None:
            self._own_contents = (stored,)
            self._saved = parse_wear(stored, self.folder / FILE_NAME, self._head, self._scene)
        return kept.depth_m if kept is not None and stored in (None, *kept.older_files) else self._saved

    def kept(self, depth: NDArray[np.float64]) -> KeptWear:
        """Return the wear depths [m] for the next runtime of the process. Call `close` first."""
        return KeptWear(tuple(depth.tolist()), self._own_contents if self.error else ())

    def save(self, depth: NDArray[np.float64]) -> None:
        """Begin to save wear depths [m] in the thread, unless the same depths are already saved."""
        if self._writing is not None and not self._writing.done():
            return
        values = tuple(depth.tolist())
        if values != self._saved or self.error:
            self._writing = self._writer.submit(self._save, values)

    def close(self, depth: NDArray[np.float64]) -> None:
        """Save wear depths [m], and wait until the file is on the disk."""
        if self._writing is not None:
            self._writing.result()
        self.save(depth)
        self._writer.shutdown(wait=True)
        self.release()

    def release(self) -> None:
        """Unlock the folder without saving the wear."""
        claim, self._claim = self._claim, None
        if claim is not None:
            os.close(claim)

    def _save(self, values: tuple[float, ...]) -> None:
        try:
            if not self._is_claimed():
                # the locked folder was moved or removed, or another file system was mounted over it
                self.release()
                self._claim = claim_folder(self.folder)
            stored = read_wear(self.folder)
            if stored not in (None, *self._own_contents):
                raise WearStateError(
                    f"{self.folder / FILE_NAME} is not the file that this twin has read or written and is left as it "
                    "is: clean up and configure to continue with its wear, or move it away to save the wear of "
                    "this twin"
                )
            content = wear_content(self._head, self._identity, values)
            self._own_contents = (content,) if stored is None else (stored, content)
            save_wear(self.folder, content)
            self._own_contents = (content,)
        except (OSError, WearStateError) as error:
            self.error = f"{self.folder}: wear not saved: {error}"
        else:
            self._saved, self.error = values, ""

    def _is_claimed(self) -> bool:
        try:
            return self._claim is not None and os.path.samestat(os.fstat(self._claim), self.folder.stat())
        except FileNotFoundError:
            return False
