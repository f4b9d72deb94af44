"""`plow-twin estimate`: interface, mapped bags, and the part of a recording that it uses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_support import BIAS, LAG_S, motion, write_bag
from commands import plow_twin
from estimate_support import GROUPS, draw
from record_support import STEP_NS, paper_sample, record_run
from rosbags.rosbag2 import StoragePlugin

from plow_twin import Wear
from plow_twin.record.measured import read_recording
from plow_twin.stream.journal import Entry, Pose, SetWear


def test_the_command_keeps_the_contract(tmp_path: Path) -> None:
    truth = draw(replace(GROUPS["sensor"], periods=6.0), 1)
    truth.write(tmp_path)
    # a row with a text instead of a number is counted and not used
    with (tmp_path / "pose.csv").open("a") as file:
        file.write("99,what,0,0\n")
    words = ["estimate", tmp_path, "--json", "--out", tmp_path / "out", "--plot", tmp_path / "fit.png"]
    completed = plow_twin(*words, "--forces", "20")
    assert completed.returncode == 3, completed.stderr
    facts = json.loads(completed.stdout)
    assert facts == json.loads((tmp_path / "out" / "estimate.json").read_text())
    for name, true in zip(("horizontal", "vertical"), truth.clearance, strict=True):
        value = facts[name]
        assert value["state"] == "estimated" and value["p05_m"] < value["mean_m"] < value["p95_m"]
        assert abs(value["mean_m"] - true) < 2e-4
    assert facts["stiffness"]["mean"] == pytest.approx(truth.scene.contact.stiffness, rel=0.02)
    assert facts["delay"]["mean"] == pytest.approx(truth.delay, abs=2e-3)
    assert (facts["model"], facts["sensor"], facts["lost"]) == ("ok", "ok", 1)
    assert facts["t_end"] > 18.0 and facts["wall_s"] > 0.0
    header = (tmp_path / "out" / "forces.csv").read_text().splitlines()[0].split(",")
    assert header[:2] == ["t", "force_top_left_top/p05"] and len(header) == 25
    assert (tmp_path / "fit.png").read_bytes()[:4] == b"\x89PNG"
    assert facts["forces"]["members"] == 20 and facts["forces"]["pairs"]["top_left_top"]["peak_n"]["p50"] > 0.0


def test_without_a_load_intervals_of_rough_clearances_contain_the_truth(tmp_path: Path) -> None:
    truth = draw(replace(GROUPS["hard"], periods=5.0), 30100)
    truth.write(tmp_path)
    (tmp_path / "load.csv").unlink()
    completed = plow_twin("estimate", tmp_path, "--json")
    facts = json.loads(completed.stdout)
    assert facts["model"] == "suspect" and facts["reasons"][0].startswith("load: not measured (no load.csv")
    for name, true in zip(("horizontal", "vertical"), truth.clearance, strict=True):
        value = facts[name]
        assert value["state"] == "rough" and value["p05_m"] < true < value["p95_m"] < value["p05_m"] + 5e-3


def test_a_bag_is_read_by_its_mapping(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", motion(), StoragePlugin.SQLITE3)
    completed = plow_twin("estimate", bag, "--map", tmp_path / "map.yaml", "--json", "--scene", "paper")
    assert completed.returncode == 0, completed.stderr
    facts = json.loads(completed.stdout)
    assert facts["delay"]["mean"] == pytest.approx(LAG_S, abs=2e-3)
    assert [facts[f"bias_{name}"]["mean"] for name in ("x", "y", "theta")] == pytest.approx(np.negative(BIAS), abs=3e-4)
    assert facts["horizontal"]["mean_m"] == pytest.approx(0.025, abs=3e-4)
    assert facts["vertical"]["mean_m"] == pytest.approx(0.030, abs=3e-4)


def test_samples_before_a_change_of_the_pads_are_not_used(tmp_path: Path) -> None:
    entries: list[Entry] = [paper_sample(index) for index in range(200)]
    entries.insert(20, Pose(entries[10].stamp_ns, (1e-3, 0.0, 0.0), (1e-3, 1e-3, 1e-3)))
    last = entries[-1].stamp_ns
    entries += [SetWear(last, (0.0,) * 8, "new pads"), Pose(last + STEP_NS, (2e-3, 0.0, 0.0))]
    entries += [paper_sample(index) for index in range(200, 260)]
    record_run(tmp_path / "run", entries, wear=Wear(0.0, 1.0, 0.0))
    measured = read_recording(tmp_path / "run")
    assert len(measured.load) == 60 and measured.poses[:, 1].tolist() == [2e-3]
    assert measured.pose_deviation == (0.0, 0.0, 0.0)
