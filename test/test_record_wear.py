"""The wear of the pads on disk: whole or not at all, of one head and one scene."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plow_twin.live.wear_keeper import WearKeeper
from plow_twin.record.wear_state import FILE_NAME, WearState, WearStateError, load_wear, save_wear, scene_identity
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path

SCENE = load_scene(scene_path("paper"))
DEPTH = tuple(0.05 / 3.0 * index for index in range(8))


def _save(folder: Path) -> Path:
    save_wear(folder, WearState("head 7", scene_identity(SCENE), DEPTH))
    return folder / FILE_NAME


def test_what_was_saved_is_loaded_to_the_bit_and_nothing_else_stays_behind(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    assert load_wear(folder, "head 7", SCENE) is None
    _save(folder)
    _save(folder)
    assert load_wear(folder, "head 7", SCENE) == DEPTH
    assert os.listdir(folder) == [FILE_NAME]
    # loads and contact numbers are not the pads
    assert load_wear(folder, "head 7", replace(SCENE, loads=())) == DEPTH


def test_another_head_or_scene_and_damage_are_refused(tmp_path: Path) -> None:
    path = _save(tmp_path)
    other = replace(SCENE, clearance=replace(SCENE.clearance, vertical_m=0.031))
    for head, scene, named in (("head 8", SCENE, "another head"), ("head 7", other, "another scene")):
        with pytest.raises(WearStateError, match=named):
            load_wear(tmp_path, head, scene)
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
            load_wear(tmp_path, "head 7", SCENE)


def test_two_twins_do_not_keep_their_wear_in_one_folder(tmp_path: Path) -> None:
    first = WearKeeper(tmp_path / "wear", "head 7", SCENE)
    with pytest.raises(WearStateError, match="another twin keeps its wear there"):
        WearKeeper(tmp_path / "wear", "head 7", SCENE)
    first.close(np.array(DEPTH))
    second = WearKeeper(tmp_path / "wear", "head 7", SCENE)
    assert second.load() == DEPTH
    second.release()  # what could not be configured leaves the folder too
    WearKeeper(tmp_path / "wear", "head 7", SCENE).release()
    assert os.listdir(tmp_path / "wear") == [FILE_NAME]


def test_a_disk_that_takes_nothing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _save(tmp_path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_wear(tmp_path, WearState("head 7", scene_identity(SCENE), (1.0,) * 8))
    monkeypatch.undo()
    assert load_wear(tmp_path, "head 7", SCENE) == DEPTH
    assert os.listdir(tmp_path) == [FILE_NAME]
