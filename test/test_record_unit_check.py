"""A wrong unit is detected from magnitude and rate, and named. Stated units and unusual machines are accepted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plow_twin.cli.app import run as cli
from plow_twin.model.geometry import largest_angle
from plow_twin.record.unit_check import unit_doubts
from plow_twin.scene_file import load_scene
from plow_twin.scene_file.presets import scene_path

SCENE = load_scene(scene_path("paper"))
TIMES = np.arange(4000) * 1e-3
LOAD = np.sin(2.0 * TIMES)[:, None] * [32e3, -11e3, -45e3]
POSE = np.cos(2.0 * TIMES)[:, None] * [0.012, 0.014, 0.15]


def _write(path: Path, scale: dict[str, float]) -> Path:
    names = ("t", "fx", "fy", "m", "x", "y", "theta")
    rows = np.column_stack((TIMES, LOAD, POSE)) * [scale.get(name, 1.0) for name in names]
    np.savetxt(path, rows, "%.9g", ",", header=",".join(names), comments="")
    return path


@pytest.mark.parametrize(
    ("scale", "options"),
    [
        ({"fx": 1e-3, "fy": 1e-3, "m": 1e-3}, ["fx=kN", "fy=kN", "m=kNm"]),
        ({"fx": 1e-6, "fy": 1e-6}, ["fx=MN", "fy=MN"]),
        ({"m": 1e-3}, ["m=kNm"]),
        ({"t": 1e3}, ["t=ms"]),
        ({"t": 1e6}, ["t=us"]),
        ({"x": 1e3, "y": 1e3}, ["x=mm", "y=mm"]),
        ({"theta": 180.0 / np.pi}, ["theta=deg"]),
    ],
)
@pytest.mark.parametrize("verb", ["live", "analyse"])
def test_a_wrong_unit_is_refused_with_the_option_that_states_it(
    verb: str, scale: dict[str, float], options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _write(tmp_path / "load.csv", scale)
    (tmp_path / "map.yaml").write_text("excitation: {topic: load}\nhead_pose: {topic: load}\n")
    command = [verb, str(path), "--map", str(tmp_path / "map.yaml"), "--scene", "paper", "--quiet"]
    record = ["--record", str(tmp_path / "run")] if verb == "live" else []
    assert cli([*command, *record]) == 2
    errors = capsys.readouterr().err
    stated = [part for option in options for part in ("--unit", option)]
    for option in options:
        assert f"--unit {option}" in errors
    assert not (tmp_path / "run").exists()  # no empty run remains of a refused start
    assert cli([*command, *stated]) == 0


def test_an_estimate_refuses_millimetres_for_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.yaml").write_text(scene_path("paper").read_text())
    np.savetxt(tmp_path / "load.csv", np.column_stack((TIMES, LOAD)), "%.9g", ",", header="t,fx,fy,m", comments="")
    pose = np.column_stack((TIMES, POSE * [1e3, 1e3, 1.0]))
    np.savetxt(tmp_path / "pose.csv", pose, "%.9g", ",", header="t,x,y,theta", comments="")
    assert cli(["estimate", str(tmp_path)]) == 2
    assert (
        "x: got 12, expected less than half the frame or the clearance, 0.165 m; they look like mm"
        in capsys.readouterr().err
    )


def test_a_swing_that_the_clearance_does_not_allow_is_in_degrees() -> None:
    angle = largest_angle(SCENE)  # at this angle, the frame of 0.33 m by 0.27 m touches both walls
    reach = 0.33 * np.sin(angle) + 0.27 * np.cos(angle), 0.33 * np.cos(angle) + 0.27 * np.sin(angle)
    assert min(0.30 - reach[0], 0.355 - reach[1]) == pytest.approx(0.0, abs=1e-4)
    for swing, likely in ((0.25, []), (0.6, ["deg"]), (6.0, ["deg"])):
        for offset in (0.0, 0.1):
            # an offset of the sensor's zero must not change the verdict
            theta = {("head_pose", "theta"): offset + swing * np.sin(2.0 * TIMES)}
            assert [doubt.likely for doubt in unit_doubts(theta, TIMES, SCENE)] == likely


def test_an_unknown_name_and_a_unit_of_another_quantity_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _write(tmp_path / "load.csv", {})
    for option, expected in (
        ("fz=kN", "unit of fz: got an unknown name, expected one of fx, fy, m, t, theta, x, y"),
        ("Fx=kN", "unit of Fx: got an unknown name"),
        ("fx=kn", "unit of fx: got 'kn', expected one of N, kN, MN"),
        ("fx=mm", "unit of fx: got 'mm', expected one of N, kN, MN"),
        ("t=min", "unit of t: got 'min', expected one of"),
        ("fx", "got 'fx', expected NAME=UNIT"),
    ):
        assert cli(["live", str(path), "--unit", option, "--quiet"]) == 2
        assert expected in capsys.readouterr().err


@given(
    share=st.floats(0.02, 5.0),
    rate=st.sampled_from([2.0, 10.0, 100.0, 1000.0]),
    pose=st.floats(1e-4, 0.12),
    offset_s=st.sampled_from([0.0, 1.7e9]),
)
def test_measurements_in_si_pass(share: float, rate: float, pose: float, offset_s: float) -> None:
    times = np.arange(2000) / rate
    phase = np.sin(2.0 * times)
    values = {("excitation", name): share * phase * size for name, size in (("fx", 32e3), ("fy", 1.0), ("m", 45e3))}
    values |= {("head_pose", name): pose * phase for name in ("x", "y", "theta")}
    assert unit_doubts(values, offset_s + times, SCENE) == []


def test_a_load_of_one_sample_a_second_is_accepted() -> None:
    times = np.arange(600.0)
    load = {("excitation", "fx"): 32e3 * np.sin(2.0 * times)}
    assert unit_doubts(load, times, SCENE) == []
    slow = {("excitation", "fx"): 32e3 * np.sin(0.01 * times)}
    assert unit_doubts(slow, 1.7e9 + times, SCENE) == []
    assert [doubt.likely for doubt in unit_doubts(slow, times, SCENE)] == ["ms"]
