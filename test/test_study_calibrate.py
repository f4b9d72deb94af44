"""Calibration: known parameters from random starts, identical results from equal seeds, and targets of each kind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from figure_checks import check_figure, kept_figures
from record_support import STEP_NS, paper_entries, paper_sample, record_run
from scenes import ROOT, preset

from plow_twin import simulate, simulate_many
from plow_twin.cli.app import run
from plow_twin.model.scene import Mark
from plow_twin.scene_file import dump_scene, load_scene
from plow_twin.stream.journal import PartOfPose, Pose
from plow_twin.study.calibration.calibrate import Calibration, Search, calibrate
from plow_twin.study.calibration.objective import RecordingObjective, TargetObjective
from plow_twin.study.calibration.pose_recording import PoseRecording, load_poses
from plow_twin.study.calibration.targets import Target, TargetSet, load_targets
from plow_twin.study.calibration.uniqueness import Cluster, identifiability, near_optimal, near_optimal_ends
from plow_twin.study.calibration.unknowns import Space, parse_unknown
from plow_twin.study.parameters import StudyError, with_parameters
from plow_twin.study.statistics import statistic

#: Parameters of a scene that differ from the preset: stiffness, damping, a phase, a clearance and a sign.
TRUTH = {
    "contact.stiffness": 2.3e7,
    "contact.damping": 0.43,
    "loads.fy.phase_rad": 0.6,
    "clearance.horizontal_m": 0.0215,
    "loads.fx2.sign": -1.0,
}
RANGES = (
    "contact.stiffness=3e6:3e8:log",
    "contact.damping=0.05:2:log",
    "loads.fy.phase_rad=-1.5:1.5",
    "clearance.horizontal_m=0.015:0.035",
    "loads.fx2.sign",
)
#: Largest relative error of each parameter after each start.
RECOVERED = 1e-6


def recording(seconds: float = 3.0) -> PoseRecording:
    motion = simulate(with_parameters(preset("paper"), TRUTH), seconds, 0.01)
    return PoseRecording(motion.t, motion.q)


def space() -> Space:
    return Space(tuple(parse_unknown(text, preset("paper")) for text in RANGES))


#: Effort of a search that finds the true parameters from each start.
SEARCH = Search(screen=150, population=24, generations=24)


def from_recording(
    starts: int, workers: int | None = None, search: Search = SEARCH
) -> tuple[Calibration, RecordingObjective]:
    objective = RecordingObjective(preset("paper"), recording(), workers=workers)
    return calibrate(space(), objective, seed=7, starts=starts, search=search), objective


def errors(calibration: Calibration) -> list[float]:
    return [max(abs(start.values[path] / true - 1.0) for path, true in TRUTH.items()) for start in calibration.starts]


def test_known_parameters_are_recovered_from_every_random_start() -> None:
    calibration, objective = from_recording(3)
    assert len(calibration.starts) == 3 and max(errors(calibration)) < RECOVERED
    assert (
        len({start.before_polish for start in calibration.starts}) == 3
    )  # the three starts have taken different paths
    uniqueness = identifiability(space(), objective, calibration.best.point)
    assert len(uniqueness.singular_values) == 4 and uniqueness.singular_values[-1] > 1e-2
    assert sum(value**2 for value in uniqueness.weakest.values()) == pytest.approx(1.0)
    clusters = near_optimal(space(), calibration, excess=1e-6)
    assert len(clusters) == 1 and clusters[0].members >= 3 and clusters[0].values["loads.fx2.sign"] == -1.0
    two = [Cluster(2, 1.0, {}, {"x": (1.0, 2.0)}), Cluster(1, 1.05, {}, {"x": (5.0, 6.0)})]
    assert near_optimal_ends(two, "x") == (1.0, 6.0) and near_optimal_ends(two, "law") is None


@pytest.mark.stress
def test_known_parameters_are_recovered_from_20_random_starts() -> None:
    calibration, _ = from_recording(20)
    assert len(calibration.starts) == 20 and max(errors(calibration)) < RECOVERED


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads() -> None:
    one, two = (from_recording(1, workers, Search(30, 10, 6))[0] for workers in (1, 3))
    assert one.best.values == two.best.values and one.best.objective == two.best.objective
    assert one.population.tobytes() == two.population.tobytes()


def test_an_undetermined_parameter_is_reported() -> None:
    scene = with_parameters(preset("paper"), {"contact.impact_speed_floor_m_s": 2e-3})
    # a constant damping does not depend on the floor of the speed, so the recording does not determine the floor
    unknowns = Space(
        tuple(parse_unknown(text, scene) for text in (RANGES[0], "contact.impact_speed_floor_m_s=1e-4:1e-2"))
    )
    objective = RecordingObjective(scene, recording(1.0))
    uniqueness = identifiability(unknowns, objective, np.array([0.4, 0.5]))
    assert uniqueness.singular_values[1] == 0.0 < uniqueness.singular_values[0]
    assert uniqueness.weakest == {"contact.stiffness": 0.0, "contact.impact_speed_floor_m_s": 1.0}


def figures(seconds: float) -> TargetSet:
    """Return figures of the true motion as a paper may publish them: forces, means, shares and impulses."""
    true = with_parameters(preset("paper"), TRUTH)
    members = simulate_many([true], seconds, seconds)
    paths = [
        f"{kind}.{sense}.{corner}"
        for kind in ("max", "mean_in_contact", "impulse")
        for sense in ("ccw", "cw")
        for corner in "abcd"
    ]
    paths += ["contact_points.ccw.2", "contact_points.cw.2"]
    numbers = {path: float(statistic(true, path)(members)[0]) for path in paths}
    return TargetSet(
        tuple(Target(path, "value", (path,), number, settings=({},)) for path, number in numbers.items() if number),
        seconds,
        1e-9,
    )


def test_known_parameters_are_recovered_from_published_figures() -> None:
    objective = TargetObjective(preset("paper"), figures(3.0))
    calibration = calibrate(
        space(), objective, seed=3, starts=1, search=Search(screen=200, population=24, generations=30)
    )
    assert min(errors(calibration)) < 1e-5
    assert calibration.best.objective < 1e-6 and all(
        abs(r) < 1e-3 for r in objective.unweighted(calibration.best.values)
    )


def test_the_command_fits_a_recording_and_marks_the_fitted_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rec = recording(2.0)
    np.savetxt(tmp_path / "run.csv", np.column_stack([rec.t, rec.q]), delimiter=",", header="t,x,y,theta", comments="")
    np.savez(tmp_path / "run.npz", t=rec.t, q=rec.q)
    assert load_poses(tmp_path / "run.csv").q == pytest.approx(load_poses(tmp_path / "run.npz").q, abs=1e-15)
    arguments = [
        "study",
        "calibrate",
        "paper",
        "--recording",
        str(tmp_path / "run.csv"),
        "--starts",
        "1",
        "--seed",
        "2",
    ]
    for path in ("contact.damping", "loads.fy.phase_rad", "clearance.horizontal_m"):
        arguments += ["--set", f"{path}={TRUTH[path]}"]
    arguments += ["--unknown", RANGES[0], "--unknown", RANGES[4], "--screen", "40", "--population", "10"]
    figures = kept_figures(monkeypatch)
    assert run([*arguments, "--out", str(tmp_path / "fit"), "--plot", str(tmp_path / "fit.png")]) == 0
    check_figure(figures[0])
    pose, residual = figures[0].axes[:2]
    np.testing.assert_allclose(pose.lines[0].get_ydata(), 1e3 * rec.q[:, 0])
    # the recording is exact, so the residual vanishes
    assert np.abs(residual.lines[0].get_ydata()).max() < 1e-6
    assert figures[0].axes[-1].get_yticklabels()[0].get_text() == "contact stiffness [MN/mⁿ]"
    assert "singular values" in capsys.readouterr().out
    fit = load_scene(tmp_path / "fit" / "fit.yaml")
    assert fit.contact.stiffness == pytest.approx(TRUTH["contact.stiffness"], rel=1e-6)
    assert fit.loads[1].force_n[0] < 0.0 and fit.marks["contact.stiffness"].mark is Mark.RECONSTRUCTED
    assert "run.csv" in fit.marks["contact.stiffness"].source and fit.marks["head.mass_kg"].mark is Mark.GIVEN
    assert "36 kN is given" in fit.marks["loads[1].force_n[0]"].source
    facts = json.loads((tmp_path / "fit" / "calibration.json").read_text())
    assert facts["seed"] == 2 and facts["objective"] < 1e-10 and facts["runs"] > 40
    for wrong, message in (
        (["--unknown", "contact.stiffness=1:2:lag"], "LOW:HIGH"),
        (["--unknown", "contact.stifness=1:2"], "nearest: contact.stiffness"),
        (["--target", "paper"], "expected either --target or --recording"),
        (["--t-end", "1"], "--t-end: got it with --recording"),
        (["--unknown", "contact.law=flores,hu_gou"], "contact.law: got 'hu_gou', expected one of"),
        (["--set", "contact.law=hertz"], "contact.damping: got 0.43"),
        (["--set", "contact.law=hertz", "--unknown", "contact.damping=0.1:1"], "contact.damping"),
    ):
        assert run([*arguments, *wrong, "--out", str(tmp_path / "none")]) == 2
        assert message in capsys.readouterr().err


def test_a_recording_of_the_node_provides_its_load(tmp_path: Path) -> None:
    record_run(tmp_path / "run", map(paper_sample, range(1500)), frame_every=5)
    poses = load_poses(tmp_path / "run" / "run_0.mcap")
    assert poses.load is not None and len(poses.load.t) > 1000 and poses.t[-1] > 1.0
    scene = replace(preset("paper"), loads=(poses.load,))
    objective = RecordingObjective(scene, poses)
    unknowns = Space((parse_unknown("contact.stiffness=3e6:3e7:log", scene),))
    calibration = calibrate(
        unknowns, objective, seed=1, starts=1, search=Search(screen=20, population=6, generations=4)
    )
    assert calibration.best.values["contact.stiffness"] == pytest.approx(preset("paper").contact.stiffness, rel=1e-4)


def test_targets_are_judged_by_their_rules(tmp_path: Path) -> None:
    def residual(target: Target, *rows: list[float]) -> float:
        return float(target.residual(np.array([rows]))[0])

    value = Target("v", "value", ("max",), 100.0, tolerance=0.05)
    assert residual(value, [104.0]) == pytest.approx(0.8) and value.met(0.8) and not value.met(-1.01)
    above = Target("a", "above", ("max.a", "max.b"), others=("max.c",), tolerance=0.1)
    assert residual(above, [5.0, 8.0, 10.0]) == pytest.approx(5.0) and residual(above, [11.0, 12.0, 10.0]) == 0.0
    rare = Target("r", "at_most", ("max",), 0.1, scale=0.2)
    assert residual(rare, [0.5]) == pytest.approx(2.0) and residual(rare, [0.05]) == 0.0
    rises = Target("t", "trend", ("max",), shape="rises", tolerance=0.1)
    assert residual(rises, [1.0], [2.0], [1.5], [3.5]) == pytest.approx(0.5 / 0.2)
    bump = replace(rises, shape="rises_then_falls")
    assert residual(bump, [1.0], [2.0], [1.5], [1.0]) == 0.0 < residual(bump, [1.0], [2.0], [1.5], [1.7])
    assert residual(bump, [1.0], [2.0], [3.0], [4.0]) > 0.0 and residual(bump, [4.0], [3.0], [2.0], [1.0]) > 0.0

    paper = load_targets(ROOT / "config" / "paper_targets.yaml", preset("paper"))
    assert all(target.mark == "given" and "Fig." in target.source for target in paper.targets)
    assert len(paper.settings) == 10 and paper.settings[0] == {}
    r1 = dict(zip((t.name for t in paper.targets), TargetObjective(preset("paper"), paper).unweighted({}), strict=True))
    assert r1["ccw max at a"] == pytest.approx((147.6 / 153.0 - 1.0) / 0.05, abs=0.01)
    assert r1["cw: b largest"] == 0.0 < r1["ccw: a largest"]
    fit = load_scene(ROOT / "config" / "paper_best_fit.yaml")
    best = TargetObjective(fit, paper)
    assert float((best.residuals([{}]) ** 2).sum()) == pytest.approx(7.90, abs=0.01)
    missed = [target.name for target, r in zip(paper.targets, best.unweighted({}), strict=True) if not target.met(r)]
    assert len(missed) == 9 and not any(
        name.startswith(("ccw m", "cw m", "ccw: a largest", "cw: b l")) for name in missed
    )
    assert fit.marks["contact.stiffness"].mark is Mark.RECONSTRUCTED and fit.marks["head.mass_kg"].mark is Mark.GIVEN
    (tmp_path / "bad.yaml").write_text(
        "version: 1\nt_end: -3\ntargets:\n- {statistic: max.z, value: 1}\n- {value: 2}\n- 3\n"
    )
    expected = r"(?s)4 problem.*t_end: got -3.*targets\[1\]\.statistic: got nothing.*targets\[2\]: got 3.*max\.z"
    with pytest.raises(StudyError, match=expected):
        load_targets(tmp_path / "bad.yaml", preset("paper"))


def test_a_fitted_scene_is_written_and_read_unchanged(tmp_path: Path) -> None:
    values = {
        "frame.labels": "top_left_cw",
        "contact.restitution": 0.5,
        "loads.fx1.arm_sign": -1.0,
        "clearance.scale": 2.0,
    }
    scene = with_parameters(preset("paper"), {**values, "contact.law": "exact_restitution"})
    (tmp_path / "fit.yaml").write_text(dump_scene(scene))
    assert load_scene(tmp_path / "fit.yaml") == scene


def test_measured_poses_of_a_run_are_fitted_instead_of_the_computed_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = [paper_sample(index) for index in range(600)]
    # the sensor was switched on before the load, and one of its poses has no angle
    poses = [Pose(sample.stamp_ns - 10 * STEP_NS, (1e-3, 2e-3, 3e-3)) for sample in samples[::20]]
    poses[5] = PartOfPose(poses[5].stamp_ns, (0, 1), (9e-3, 9e-3))
    record_run(tmp_path / "run", [entry for pair in zip(samples[::20], poses, strict=True) for entry in pair])
    measured = load_poses(tmp_path / "run")
    assert not measured.computed and len(measured.t) == len(poses) - 2 and measured.t[0] == pytest.approx(0.01)
    np.testing.assert_allclose(measured.q, np.tile((1e-3, 2e-3, 3e-3), (len(measured.t), 1)))

    # without measured poses, or with missing entries, the command says so
    file = record_run(tmp_path / "alone", samples).file
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-1000])
    arguments = ["study", "calibrate", "paper", "--unknown", "contact.stiffness=9e6:1e7", "--starts", "1", "--screen"]
    arguments += ["2", "--population", "5", "--generations", "0", "--out", str(tmp_path / "fit"), "-q", "--recording"]
    assert run([*arguments, str(cut)]) == 3
    err = capsys.readouterr().err
    assert "truncated" in err and "the fit is to the motion that the twin computed" in err


def test_a_recording_that_is_not_one_motion_from_the_start_is_refused(tmp_path: Path) -> None:
    record_run(tmp_path / "run", paper_entries(200))
    with pytest.raises(StudyError, match=r"got 1 changes of motion or model \(Reset\)"):
        load_poses(tmp_path / "run")
    # a simulation from 0 to a date would not end
    table = tmp_path / "dates.csv"
    table.write_text("t,x,y,theta\n1700000000,0,0,0\n1700000001,0,0,0\n")
    with pytest.raises(StudyError, match="expected the time since the scene's start"):
        load_poses(table)
    table.write_text("t,x,y,theta\n0,0,0,0\n1,0,0\n")
    with pytest.raises(StudyError, match="data row 2: got '1', '0', '0', expected numbers in all"):
        load_poses(table)
