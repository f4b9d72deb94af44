"""The load from signals of the drive: values computed by hand, intervals from random draws, and journal entries."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from record_support import records_of

from plow_twin.errors import PlowTwinError
from plow_twin.live import parameters
from plow_twin.live.bridge.files import Files
from plow_twin.live.front import BridgeFront
from plow_twin.live.load_model import LoadModel, read_load_model
from plow_twin.live.solver_start import Preparation
from plow_twin.record.entries import EntryRecord
from plow_twin.record.replay import replay
from plow_twin.stream.journal import Sample, Spread

MODEL = LoadModel(
    push_ratio=(0.5, 0.1),
    at_m=(0.1, 0.7),
    lateral_ratio=(0.1, 0.02),
    efficiency=(0.8, 0.05),
    idle_force_n=(20e3, 3e3),
    specific_force_n_m=(1e6, 4e5),
)


def test_power_speed_and_depth_give_the_load_and_its_deviation() -> None:
    by_drive, spread = MODEL.cutting_force({"power": 200e3, "speed": -2.0})  # type: ignore[misc]
    assert by_drive == pytest.approx(0.8 * 100e3 - 20e3)
    assert spread == pytest.approx(math.hypot(0.05 * 100e3, 3e3))
    by_coal, wide = MODEL.cutting_force({"depth": 0.08})  # type: ignore[misc]
    assert (by_coal, wide) == (pytest.approx(80e3), pytest.approx(32e3))
    both, narrow = MODEL.cutting_force({"power": 200e3, "speed": 2.0, "depth": 0.08, "position": math.nan})  # type: ignore[misc]
    assert 60e3 < both < 62e3 and narrow < spread
    assert MODEL.cutting_force({"power": 5e3, "speed": 0.01}) == (0.0, 0.0)
    assert MODEL.cutting_force({"power": 5e3}) is None and MODEL.wrench({}) is None
    assert MODEL.cutting_force({"chain_force": 1e3})[0] == 0.0  # type: ignore[index]  # nothing is cut


def test_absurd_telemetry_is_counted_and_has_no_small_deviation(tmp_path: Path) -> None:
    for drive in ({"power": 1e200, "speed": 2.0}, {"chain_force": 1e308}, {"depth": -1e308}):
        wrench = MODEL.wrench(drive)
        assert wrench is not None and not max(map(abs, (*wrench[0], *wrench[1]))) < 1e100
    # a biased sensor may give a negative depth, which is no better evidence than the same positive depth
    (below, wide), (_, same) = (MODEL.cutting_force({"depth": depth}) for depth in (-0.08, 0.08))  # type: ignore[misc]
    assert (below, wide) == (0.0, same)
    (tmp_path / "map.yaml").write_text(MAP)
    absurd_rows = {5: "1e200,2,,0", 7: "200,1e-300,8,0"}
    rows = [f"{0.1 * k:.1f},{absurd_rows.get(k, '200,2,8,0')}" for k in range(10)]
    (tmp_path / "drive.csv").write_text("\n".join(["t,p,v,d,s", *rows]) + "\n")
    settings = parameters.settings({"record_path": str(tmp_path / "run")})
    files = Files([tmp_path / "drive.csv"], follow=False)
    prepared = Preparation(settings).result(lambda: False)
    front = BridgeFront(files, tmp_path / "map.yaml", settings, prepared, lambda *_: None, print)
    assert front.run(lambda: False) == []
    values = front.parts()["input"][2]
    assert (values["samples_used"], values["dropped_implausible"]) == ("9", "1")
    entries = [record.entry for record in records_of(tmp_path / "run") if isinstance(record, EntryRecord)]
    assert max(max(entry.deviation) for entry in entries if isinstance(entry, Spread)) < 1e6


def test_the_interval_covers_randomly_drawn_coefficients() -> None:
    drive = {"power": 200e3, "speed": 2.0}
    wrench = MODEL.wrench(drive)
    assert wrench is not None
    rng = np.random.default_rng(5)
    n = 200_000
    assert MODEL.efficiency is not None
    z = rng.normal(*MODEL.efficiency, n) * 100e3 - rng.normal(*MODEL.idle_force_n, n)
    fx, fy = rng.normal(*MODEL.push_ratio, n) * z, rng.normal(*MODEL.lateral_ratio, n) * z
    drawn = np.stack([fx, fy, 0.1 * fy - 0.7 * fx])
    np.testing.assert_allclose(wrench[0], drawn.mean(axis=1), rtol=0.01)
    np.testing.assert_allclose(wrench[1], drawn.std(axis=1), rtol=0.02)


MAP = """
drive: {topic: drive, fields: {power: p, speed: v, depth: d, position: s}, unit: {power: kW, depth: cm}}
travel: {topic: drive, fields: {speed: v}}
load_model:
  push_ratio: [0.5, 0.1]
  at_m: [0.1, 0.7]
  efficiency: [0.8, 0.05]
  idle_force_n: [20000, 3000]
  specific_force_n_m: [1.0e6, 4.0e5]
  resistance: {position_m: [0, 100, 200], factor: [1.0, 1.5, 0.8]}
"""


def test_telemetry_of_the_drive_runs_the_twin_and_its_interval_is_in_the_journal(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP)
    rows = [f"{0.1 * k:.1f},{200 + 20 * math.sin(k)},2.0,8,{0.2 * k}" for k in range(100)]
    (tmp_path / "drive.csv").write_text("\n".join(["t,p,v,d,s", *rows, "10.0,,,,", "10.1,x,2,8,20"]) + "\n")
    settings = parameters.settings({"record_path": str(tmp_path / "run")})
    prepared = Preparation(settings).result(lambda: False)
    files = Files([tmp_path / "drive.csv"], follow=False)
    front = BridgeFront(files, tmp_path / "map.yaml", settings, prepared, lambda *_: None, print)
    assert front.run(lambda: False) == []
    values = front.parts()["input"][2]
    assert (values["samples_used"], values["dropped_malformed"], values["travel_used"]) == ("100", "1", "101")
    entries = [record.entry for record in records_of(tmp_path / "run") if isinstance(record, EntryRecord)]
    first = next(entry for entry in entries if isinstance(entry, Sample))
    model = read_load_model(tmp_path / "map.yaml")
    assert model is not None
    expected = model.wrench({"power": 200e3, "speed": 2.0, "depth": 0.08, "position": 0.0})
    assert expected is not None and first.wrench == pytest.approx(expected[0])
    spreads = [entry for entry in entries if isinstance(entry, Spread)]
    assert spreads[0].deviation == pytest.approx(expected[1]) and 1 < len(spreads) < 100
    assert replay(tmp_path / "run").exit_code == 0


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            "push_ratio: [0.5, 0.1], at_m: [0, 0], efficiency: 0.8",
            "load_model.efficiency: got 0.8, expected a mean and a standard deviation >= 0",
        ),
        (
            "push_ratio: [0.5, -0.1], at_m: [0, 0], efficiency: [1, 0]",
            "push_ratio[1]: got -0.1, expected a standard deviation >= 0",
        ),
        ("push_ratio: [0.5, 0.1], efficiency: [1, 0]", "at_m: got nothing, expected two finite numbers: x and y [m]"),
        ("push_ratio: [0.5, 0.1], at_m: [0, 0]", "efficiency or specific_force_n_m or idle_force_n (for chain_force)"),
        ("push_ratio: [1, 0], at_m: [0, 0], idle_force_n: [0, 0], resistance: {}", "resistance.factor: got nothing"),
        (
            "push_ratio: [1, 0], at_m: [0, 0], idle_force_n: [0, 0], resistance: {position_m: [1, 0], factor: [1, 1]}",
            "expected rising position_m",
        ),
    ],
)
def test_coefficients_that_cannot_be_used_are_named(entry: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(f"load_model: {{{entry}}}")
    with pytest.raises(PlowTwinError) as caught:
        read_load_model(tmp_path / "map.yaml")
    assert message in str(caught.value)
