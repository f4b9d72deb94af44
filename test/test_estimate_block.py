"""Clearances around a block from its impacts: measured drops, and a simulated block between four walls."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import plow_twin as run_command

from plow_twin import Clearance, Contact, Frame, Friction, Head, Initial, Scene, dump_scene, load_scene, simulate
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import Estimate, State
from plow_twin.model.scene import Harmonic
from plow_twin.study.measured.drops import Drops

DATA = Path(__file__).resolve().parent.parent / "benchmark" / "data" / "measured" / "square_drops.npz"
SQUARE = load_scene("measured_square")
#: Standard deviation [m] of the clearance's prior. The height of the table is half the clearance, so its deviation is 5
#: mm.
DEVIATION = 0.01
#: Friction that moves nothing. With it and the balance, blocks share the kernels of `test_solve_corners`.
SMOOTH = Friction(1e-12, 0.05)


@pytest.fixture(scope="module")
def drops() -> Drops:
    return Drops.load(DATA)


def unknown_table(off: float) -> Scene:
    """Return the square's scene with the table `off` [m] lower."""
    marks = dict(SQUARE.marks)
    marks["clearance.vertical_m"] = replace(marks["clearance.vertical_m"], deviation=DEVIATION)
    clearance = Clearance(SQUARE.clearance.horizontal_m, SQUARE.clearance.vertical_m + 2.0 * off)
    return replace(SQUARE, clearance=clearance, marks=marks)


def of_drop(drops: Drops, index: int, off: float = 0.0, scene: Scene | None = None) -> Estimate:
    pose = drops.pose[index] - [0.0, 1.0, 0.0]
    t = np.arange(len(pose)) / 250.0
    return estimate(scene or unknown_table(off), Load(t[[0, -1]], np.zeros((2, 3))), Poses(t, pose))


def test_height_of_the_table_follows_from_measured_drops(drops) -> None:
    rng = np.random.default_rng(4)
    result = [of_drop(drops, index, 0.005 * rng.standard_normal()) for index in range(0, 250, 4)]
    estimated = [drop for drop in result if drop.vertical_state.known]
    assert len(estimated) > 0.9 * len(result)
    true = SQUARE.clearance.vertical_m
    # an error of the clearance causes half the error in the height of the table
    off = 0.5 * np.array([one.vertical.mean - true for one in estimated])
    assert np.median(np.abs(off)) < 5e-4
    inside = np.mean([one.vertical.p05 < true < one.vertical.p95 for one in estimated])
    assert 0.8 < inside < 0.99
    # heights that the data do not determine to half a millimetre are marked as rough
    rough = np.array([one.vertical_state is State.ROUGH for one in estimated])
    assert (rough | (np.abs(off) < 5e-4)).mean() > 0.85
    for estimate_of_drop, flagged in zip(estimated, rough, strict=True):
        assert (estimate_of_drop.vertical.deviation > 1e-3) == flagged
        assert any(reason.startswith("vertical: rough") for reason in estimate_of_drop.reasons) == flagged


def test_walls_without_impacts_are_not_observable(drops) -> None:
    scene = unknown_table(0.0)
    stiffness, width = scene.marks["contact.stiffness"], scene.marks["clearance.horizontal_m"]
    stated = {
        "contact.stiffness": replace(stiffness, deviation=1e6),
        "clearance.horizontal_m": replace(width, deviation=2e-3),
    }
    result = of_drop(drops, 0, scene=replace(scene, marks={**scene.marks, **stated}))
    # with impacts on a single wall, a bias has the same effect as another clearance
    assert result.bias_x is None and result.bias_y is None and result.bias_theta is not None
    assert result.horizontal_state is State.NOT_OBSERVABLE
    assert result.horizontal.mean == SQUARE.clearance.horizontal_m
    # the scene states this deviation
    assert result.horizontal.deviation == pytest.approx(2e-3)
    assert result.stiffness is not None and result.stiffness.deviation == pytest.approx(1e6, rel=0.05)
    assert any("0 impacts on the right wall" in reason for reason in result.reasons)


def test_impact_far_from_the_walls_is_left_out_and_reported(drops) -> None:
    # in this drop, the block hits an obstacle 0.7 m from the origin
    result = of_drop(drops, 10)
    assert result.horizontal_state is State.NOT_OBSERVABLE
    assert any(reason.startswith("left wall: 1 impacts left out, got one at 0.69") for reason in result.reasons)


def test_block_between_four_walls_with_a_rotated_sensor_is_estimated() -> None:
    side, true = 0.2, np.array([0.030, 0.022])
    guide = Scene(
        Head(5.0, 5.0 * side**2 / 6.0, carries="corners"),
        Frame(side, side),
        Clearance(*true.tolist()),
        Contact("kelvin_voigt", stiffness=1e8, damping=3e3),
        loads=(
            Harmonic("slow", (60.0, 55.0), omega_rad_s=7.0),
            Harmonic("quick", (60.0, 55.0), omega_rad_s=11.0, phase_rad=1.0),
            Harmonic("m", (0.0, 0.0), omega_rad_s=5.0, moment_n_m=1.0),
        ),
        initial=Initial(v=(0.3, -0.2, 0.1)),
        friction=SMOOTH,
    )  # fmt: skip
    motion = simulate(guide, t_end=20.0, output_dt=0.004, tol=1e-6, energy_balance=True)
    rng = np.random.default_rng(2)
    measured = motion.q + np.array([1.5e-3, -1e-3, 8e-3]) + rng.normal(0.0, [3e-5, 3e-5, 2e-4], motion.q.shape)
    t = np.arange(0.0, 20.0, 0.01)
    along = np.sin(7.0 * t) + np.sin(11.0 * t + 1.0)
    wrench = np.stack([60.0 * along, 55.0 * along, np.sin(5.0 * t)], axis=1)
    nominal = replace(guide, clearance=Clearance(*(true + np.array([4e-3, -3e-3])).tolist()), loads=())
    result = estimate(nominal, Load(t, wrench), Poses(motion.t, measured))
    for value, clearance, state in zip(
        (result.horizontal, result.vertical), true, (result.horizontal_state, result.vertical_state), strict=True
    ):
        assert state.known, result.reasons
        assert abs(value.mean - clearance) < 1e-3
        assert value.p05 < clearance < value.p95
    assert result.bias_x is not None and result.bias_x.p05 < 1.5e-3 < result.bias_x.p95
    assert result.bias_theta is not None and result.bias_theta.p05 < 8e-3 < result.bias_theta.p95


@pytest.mark.parametrize(
    ("change", "word"), [((slice(0, 5), slice(None)), "complete poses"), ((slice(None), 2), "complete poses")]
)
def test_unusable_poses_are_named(drops, change, word) -> None:
    pose = drops.pose[0] - [0.0, 1.0, 0.0]
    t = np.arange(len(pose)) / 250.0
    if change[1] == 2:
        pose[:, 2] = np.nan
    else:
        pose, t = pose[change[0]], t[change[0]]
    result = estimate(unknown_table(0.0), Load(np.array([0.0, 0.8]), np.zeros((2, 3))), Poses(t, pose))
    assert result.vertical_state is State.NOT_OBSERVABLE
    assert word in result.reasons[0]


# the following twins need other kernels, which must be compiled
@pytest.mark.parametrize("follows", [False, pytest.param(True, marks=pytest.mark.stress)])
def test_command_estimates_a_drop(follows: bool, drops, tmp_path) -> None:
    pose = drops.pose[8] - [0.0, 1.0, 0.0]
    t = np.arange(len(pose)) / 250.0
    (tmp_path / "scene.yaml").write_text(dump_scene(unknown_table(0.003)), encoding="utf-8")
    np.savetxt(tmp_path / "pose.csv", np.column_stack([t, pose]), delimiter=",", header="t,x,y,theta", comments="")
    load = np.column_stack([t, np.zeros((len(t), 3))])
    np.savetxt(tmp_path / "load.csv", load, delimiter=",", header="t,fx,fy,m", comments="")
    out = tmp_path / "out"
    more = ("--forces", "20", *(("--follow", "--follow-members", "20") if follows else ()), "--out", str(out))
    done = run_command("estimate", str(tmp_path), "--json", *more)
    assert done.returncode == 0, done.stderr
    for name, count in (("forces.csv", 24), *((("followed.csv", 30),) if follows else ())):
        names = (out / name).read_text(encoding="utf-8").splitlines()[0].split(",")
        rows = np.loadtxt(out / name, delimiter=",", skiprows=1)
        assert rows.shape[1] == 1 + count and np.isfinite(rows).all()
        met = {column for column, values in zip(names, rows.T, strict=True) if "left" in column and values.any()}
        assert met and all("bottom_left_bottom" in column for column in met)
    result = json.loads(done.stdout)
    assert result["vertical"]["state"] in ("estimated", "rough")
    assert abs(0.5 * (result["vertical"]["mean_m"] - SQUARE.clearance.vertical_m)) < 2e-3
    assert result["figures"]["restitution"] == pytest.approx(0.5, abs=0.3)


@pytest.fixture(scope="module")
def elastic() -> dict[float, tuple[np.ndarray, np.ndarray]]:
    """Return times and poses of a block in a guide with clearances of 30 mm and 22 mm, for each stiffness."""
    motions = {}
    for stiffness in (1e4, 1e8):
        motion = simulate(guide(stiffness), t_end=12.0, output_dt=0.004, tol=1e-6, energy_balance=True)
        noise = np.random.default_rng(1).normal(0.0, [3e-5, 3e-5, 2e-4], motion.q.shape)
        motions[stiffness] = motion.t, motion.q + noise
    return motions


def guide(stiffness: float) -> Scene:
    return Scene(
        Head(5.0, 5.0 * 0.2**2 / 6.0, carries="corners"),
        Frame(0.2, 0.2),
        Clearance(0.030, 0.022),
        # nearly elastic; a contact without damping would need other compiled kernels
        Contact("kelvin_voigt", stiffness=stiffness, damping=1e-3 * stiffness**0.5),
        loads=(Harmonic("slow", (60.0, 55.0), omega_rad_s=7.0), Harmonic("quick", (60.0, 55.0), omega_rad_s=11.0)),
        initial=Initial(v=(0.3, -0.2, 0.1)),
        friction=SMOOTH,
    )


def of_guide(t: np.ndarray, q: np.ndarray, stiffness: float) -> Estimate:
    at = np.arange(0.0, 12.01, 0.01)
    along = np.sin(7.0 * at) + np.sin(11.0 * at)
    wrench = np.stack([60.0 * along, 55.0 * along, 0.0 * at], axis=1)
    nominal = replace(guide(stiffness), clearance=Clearance(0.034, 0.019), loads=())
    return estimate(nominal, Load(at, wrench), Poses(t, q))


def test_an_unknown_stiffness_widens_the_interval(elastic) -> None:
    result = of_guide(*elastic[1e8], stiffness=1e5)
    for value, true in ((result.horizontal, 0.030), (result.vertical, 0.022)):
        assert value.p05 < true < value.p95


@pytest.mark.parametrize(("stiffness", "every"), [(1e4, 1), (1e8, 5)])
def test_contacts_longer_than_two_poses_determine_nothing(elastic, stiffness, every) -> None:
    """A soft contact lasts for many rows. At 50 Hz, two impacts look like one impact."""
    t, q = elastic[stiffness]
    result = of_guide(t[::every], q[::every], stiffness)
    assert result.horizontal_state is State.NOT_OBSERVABLE
    assert "impacts" in result.reasons[0]


@pytest.mark.parametrize("too_stiff", [300.0, 30.0])
def test_a_contact_much_softer_than_assumed_leaves_the_clearance_in_its_interval(too_stiff) -> None:
    """The impacts scatter more than rigid impacts, and the interval is correspondingly wide."""
    motion = simulate(guide(1e7), t_end=12.0, output_dt=0.004, tol=1e-6, energy_balance=True)
    noise = np.random.default_rng(1).normal(0.0, [3e-5, 3e-5, 2e-4], motion.q.shape)
    result = of_guide(motion.t, motion.q + noise, 1e7 * too_stiff)
    for value, true in ((result.horizontal, 0.030), (result.vertical, 0.022)):
        assert abs(value.mean - true) < 1.5e-3
        assert value.p05 < true < value.p95


@pytest.mark.stress  # this test compiles additional kernels
def test_rounded_block_between_four_walls_is_estimated() -> None:
    rounded = replace(guide(1e8), frame=Frame(0.2, 0.2, corner_radius_m=0.03))
    motion = simulate(rounded, t_end=12.0, output_dt=0.004, tol=1e-6, energy_balance=True)
    noise = np.random.default_rng(1).normal(0.0, [3e-5, 3e-5, 2e-4], motion.q.shape)
    at = np.arange(0.0, 12.01, 0.01)
    along = np.sin(7.0 * at) + np.sin(11.0 * at)
    wrench = np.stack([60.0 * along, 55.0 * along, 0.0 * at], axis=1)
    nominal = replace(rounded, clearance=Clearance(0.034, 0.019), loads=())
    result = estimate(nominal, Load(at, wrench), Poses(motion.t, motion.q + noise))
    for value, true in ((result.horizontal, 0.030), (result.vertical, 0.022)):
        assert abs(value.mean - true) < 5e-4
        assert value.p05 < true < value.p95
