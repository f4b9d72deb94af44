"""The wear of the pads on disk: written atomically, for one head and one scene."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plow_twin.live.wear_keeper import KeptWear, WearKeeper
from plow_twin.model.scene import Scene
from plow_twin.record.wear_state import (
    FILE_NAME,
    WearStateError,
    parse_wear,
    read_wear,
    save_wear,
    scene_identity,
    wear_content,
)
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path

SCENE = load_scene(scene_path("paper"))
DEPTH = tuple(0.05 / 3.0 * index for index in range(8))
NEW, WORN = np.zeros(8), np.full(8, 1e-3)


def _save(folder: Path, depth: tuple[float, ...] = DEPTH) -> Path:
    save_wear(folder, wear_content("head 7", scene_identity(SCENE), depth))
    return folder / FILE_NAME


def _loaded(folder: Path, head: str, scene: Scene) -> tuple[float, ...] | None:
    content = read_wear(folder)
    return None if content is None else parse_wear(content, folder / FILE_NAME, head, scene)


def _saved(keeper: WearKeeper, depth: np.ndarray) -> str:
    """Save depths, and wait until they are on disk. Return the error."""
    keeper.save(depth)
    assert keeper._writing is not None
    keeper._writing.result()
    return keeper.error


def test_saved_wear_is_loaded_exactly_and_no_other_file_remains(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    assert _loaded(folder, "head 7", SCENE) is None
    _save(folder)
    _save(folder)
    assert _loaded(folder, "head 7", SCENE) == DEPTH
    assert os.listdir(folder) == [FILE_NAME]
    # the wear is also valid for a scene with other loads
    assert _loaded(folder, "head 7", replace(SCENE, loads=())) == DEPTH


def test_another_head_or_scene_and_damage_are_refused(tmp_path: Path) -> None:
    path = _save(tmp_path)
    other = replace(SCENE, clearance=replace(SCENE.clearance, vertical_m=0.031))
    for head, scene, named in (("head 8", SCENE, "another head"), ("head 7", other, "another scene")):
        with pytest.raises(WearStateError, match=named):
            _loaded(tmp_path, head, scene)
    record = json.loads(path.read_text())
    broken = [
        path.read_text()[:40],
        "[]",
        "[" * 100_000,
        json.dumps(record | {"version": 2}),
        json.dumps(record | {"depth_m": {**record["depth_m"], "top_left_top": -1e-3}}),
        json.dumps(record | {"depth_m": {**record["depth_m"], "top_left_top": "nan"}}),
        json.dumps(record | {"depth_m": {**record["depth_m"], "top_left_top": 0.5}}),
    ]
    for text in broken:
        path.write_text(text)
        with pytest.raises(WearStateError, match=FILE_NAME):
            _loaded(tmp_path, "head 7", SCENE)


def test_two_twins_cannot_save_their_wear_in_one_folder(tmp_path: Path) -> None:
    first = WearKeeper(tmp_path / "wear", "head 7", SCENE)
    with pytest.raises(WearStateError, match="another twin uses it for its wear"):
        WearKeeper(tmp_path / "wear", "head 7", SCENE)
    first.close(np.array(DEPTH))
    second = WearKeeper(tmp_path / "wear", "head 7", SCENE)
    assert second.load() == DEPTH
    second.release()  # a failed configuration releases the folder too
    WearKeeper(tmp_path / "wear", "head 7", SCENE).release()
    assert os.listdir(tmp_path / "wear") == [FILE_NAME]


def test_on_a_full_disk_the_old_file_remains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _save(tmp_path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        _save(tmp_path, (0.1,) * 8)
    monkeypatch.undo()
    assert _loaded(tmp_path, "head 7", SCENE) == DEPTH
    assert os.listdir(tmp_path) == [FILE_NAME]


def test_a_foreign_file_that_appears_during_the_run_is_not_replaced(tmp_path: Path) -> None:
    # a volume that is mounted late replaces the folder by another folder with earlier wear
    folder, volume = tmp_path / "wear", tmp_path / "volume"
    volume.mkdir()
    path = _save(volume)
    keeper = WearKeeper(folder, "head 7", SCENE)
    assert keeper.load() is None and _saved(keeper, NEW) == ""
    folder.rename(tmp_path / "beneath")
    volume.rename(folder)
    for _ in range(2):
        assert "is not the file that this twin has read or written" in _saved(keeper, WORN)
    assert _loaded(folder, "head 7", SCENE) == DEPTH
    with pytest.raises(WearStateError, match="another twin uses it for its wear"):
        WearKeeper(folder, "head 7", SCENE)
    # the former folder returns; then another program writes to it, and then it is removed
    folder.rename(volume)
    (tmp_path / "beneath").rename(folder)
    assert _saved(keeper, WORN) == "" and _loaded(folder, "head 7", SCENE) == tuple(WORN)
    _save(folder)
    assert _saved(keeper, 2.0 * WORN) and _loaded(folder, "head 7", SCENE) == DEPTH
    (folder / FILE_NAME).unlink()
    assert _saved(keeper, 2.0 * WORN) == "" and _loaded(folder, "head 7", SCENE) == tuple(2.0 * WORN)
    keeper.close(2.0 * WORN)
    assert _loaded(path.parent, "head 7", SCENE) == DEPTH


def test_a_recreated_folder_is_locked_again(tmp_path: Path) -> None:
    folder = tmp_path / "wear"
    first = WearKeeper(folder, "head 7", SCENE)
    assert _saved(first, NEW) == ""
    folder.rename(tmp_path / "old")
    assert _saved(first, WORN) == "" and _loaded(folder, "head 7", SCENE) == tuple(WORN)
    with pytest.raises(WearStateError, match="another twin uses it for its wear"):
        WearKeeper(folder, "head 7", SCENE)
    folder.rename(tmp_path / "older")
    second = WearKeeper(folder, "head 7", SCENE)
    second.close(WORN)
    second = WearKeeper(folder, "head 7", SCENE)
    assert "another twin uses it for its wear" in _saved(first, NEW)
    second.close(WORN)
    first.release()
    assert _loaded(folder, "head 7", SCENE) == tuple(WORN)


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("waited", [False, True])
def test_unsaved_wear_is_used_later_unless_the_file_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waited: bool, replaced: bool
) -> None:
    keeper = WearKeeper(tmp_path, "head 7", SCENE)
    assert keeper.load() is None and _saved(keeper, NEW) == ""
    with monkeypatch.context() as full:
        calls: list[int] = []

        def fail(descriptor: int) -> None:
            calls.append(descriptor)
            # the first call syncs the file, and the second call syncs the folder with the new file
            if len(calls) == 1 + waited:
                raise OSError(28, "No space left on device")

        full.setattr(os, "fsync", fail)
        assert "No space" in _saved(keeper, WORN)
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", lambda descriptor: os.fstat(-1))
        keeper.close(2.0 * WORN)
    kept = keeper.kept(2.0 * WORN)
    if replaced:
        _save(tmp_path)
    again = WearKeeper(tmp_path, "head 7", SCENE)
    assert again.load(kept) == (DEPTH if replaced else tuple(2.0 * WORN))
    assert again.load(KeptWear(tuple(3.0 * WORN))) == _loaded(tmp_path, "head 7", SCENE)
    again.close(2.0 * WORN)
    assert again.kept(WORN) == KeptWear(tuple(WORN))
    assert _loaded(tmp_path, "head 7", SCENE) == tuple(2.0 * WORN)
