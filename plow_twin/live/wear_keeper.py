"""The pads' wear kept on disk while the node runs: saved at intervals beside the executor, and at the stop."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.scene import Scene
from plow_twin.record.wear_state import WearState, claim_folder, load_wear, save_wear, scene_identity


class WearKeeper:
    """The wear of one head in one scene, in a folder.

    Parameters
    ----------
    folder
        Where it is kept.
    head
        Serial of the head.
    scene
        Its scene.

    Raises
    ------
    WearStateError
        No file can be written to the folder, or another twin keeps its wear there.
    """

    def __init__(self, folder: Path, head: str, scene: Scene) -> None:
        self.folder, self._head, self._scene = folder, head, scene
        self._claim: int | None = claim_folder(folder)
        self._identity = scene_identity(scene)
        self._saved: tuple[float, ...] | None = None
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="wear")
        self._writing: Future[None] | None = None
        #: why it could not be saved the last time; empty: it could
        self.error = ""

    def load(self) -> tuple[float, ...] | None:
        """Return the saved depths [m], or None when none have been saved; raises as `load_wear`."""
        self._saved = load_wear(self.folder, self._head, self._scene)
        return self._saved

    def save(self, depth: NDArray[np.float64]) -> None:
        """Save depths [m] unless they are saved already; does not wait for the disk."""
        if self._writing is not None and not self._writing.done():
            return
        values = tuple(depth.tolist())
        if values != self._saved or self.error:
            self._writing = self._writer.submit(self._save, values)

    def close(self, depth: NDArray[np.float64]) -> None:
        """Save depths [m] and wait until they are on the disk."""
        if self._writing is not None:
            self._writing.result()
        self.save(depth)
        self._writer.shutdown(wait=True)
        self.release()

    def release(self) -> None:
        """Leave the folder to others; nothing is saved."""
        claim, self._claim = self._claim, None
        if claim is not None:
            os.close(claim)

    def _save(self, values: tuple[float, ...]) -> None:
        try:
            save_wear(self.folder, WearState(self._head, self._identity, values))
        except OSError as error:
            self.error = f"{self.folder}: wear not saved: {error}"
        else:
            self._saved, self.error = values, ""
