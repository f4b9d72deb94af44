"""Contact forces measured in addition to the poses: they narrow the intervals, and can contradict the estimate."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import ROOT, preset

from plow_twin import Contact, simulate
from plow_twin.cli.estimate import _given
from plow_twin.estimate import estimate as estimating
from plow_twin.estimate import summary
from plow_twin.estimate.contact_forces import ContactForces, ContactForcesError, forces_at
from plow_twin.estimate.fit import Fit, Problem, Window
from plow_twin.estimate.measurements import Poses
from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.estimate.similar import Units
from plow_twin.estimate.unknowns import BIAS, DELAY, SIZE
from plow_twin.model.pairs import PAIR_NAMES
from plow_twin.record.measured import read_measured, read_recording

sys.path.insert(0, str(ROOT / "benchmark"))
from estimate_truths import GROUPS, Truth, draw


@pytest.fixture(scope="module")
def truth() -> Truth:
    return draw(replace(GROUPS["forces_slow"], periods=5.0), 2)


@pytest.fixture(scope="module")
def fitted(truth: Truth) -> tuple[Estimate, Problem, Fit]:
    fits: list[tuple[Problem, Fit]] = []
    plain, summarise = pytest.MonkeyPatch(), estimating.summarise
    with plain.context() as patch:

        def seen(problem: Problem, fit: Fit, *others: object) -> Estimate:
            fits.append((problem, fit))
            return summarise(problem, fit, *others)  # type: ignore[arg-type]

        patch.setattr(estimating, "summarise", seen)
        result = estimating.estimate(truth.nominal, truth.load, truth.poses)
    return result, *fits[-1]


def _exact(result: Estimate) -> dict[str, Interval]:
    """Return the values of a machine with exactly the frame of the scene."""
    assert result.apparent is not None
    return result.values() | dict(zip(("horizontal", "vertical"), result.apparent, strict=True))


def test_forces_halve_the_intervals_and_they_contain_the_truth(
    truth: Truth, fitted: tuple[Estimate, Problem, Fit]
) -> None:
    plain, result = fitted[0], estimating.estimate(truth.nominal, truth.load, truth.poses, forces=truth.forces)
    assert (result.model, result.sensor, result.horizontal_state) == ("ok", "ok", State.ESTIMATED)
    contact = truth.scene.contact
    for name, true, share in (
        ("stiffness", contact.stiffness, 0.5), ("damping", contact.damping, 0.5),
        ("horizontal", truth.clearance[0], 0.8), ("vertical", truth.clearance[1], 0.8),
    ):  # fmt: skip
        value, before = (_exact(one)[name] for one in (result, plain))
        assert abs(value.mean - true) < 2.6 * value.deviation < 2.6 * share * before.deviation, name
    used = result.as_dict()["forces_measured"]
    assert used["rows"] > 1000 and used["unused"] == "" and "forces_measured" not in plain.as_dict()
    assert used["pairs"]["top_left_top"]["noise_n"] == pytest.approx(1e3, rel=0.1)
    assert all(0.8 < cell["gain"]["mean"] < 1.2 for cell in used["pairs"].values())


@pytest.mark.parametrize("fault", ["dead", "stuck", "swapped", "unit"])
def test_a_cell_that_contradicts_the_motion_is_named(
    truth: Truth, fitted: tuple[Estimate, Problem, Fit], fault: str
) -> None:
    assert truth.forces is not None
    force = truth.forces.force.copy()
    if fault == "dead":
        force[:, 2] = 0.0
    elif fault == "stuck":
        force[len(force) // 2 :, 2] = force[len(force) // 2, 2]
    elif fault == "swapped":
        force[:, [2, 5]] = force[:, [5, 2]]
    else:
        force[:, 2] *= 1e-3
    result, problem, fit = fitted
    estimated = summary._with_forces(result, problem, fit, replace(truth.forces, force=force), 1.0)
    assert (estimated.sensor, estimated.model, estimated.horizontal_state) == ("suspect", "ok", State.WITHDRAWN)
    named = {PAIR_NAMES[2], PAIR_NAMES[5]} if fault == "swapped" else {PAIR_NAMES[2]}
    assert {name for name in PAIR_NAMES if any(f" {name}:" in reason for reason in estimated.reasons)} == named
    assert estimated.stiffness == result.stiffness and estimated.as_dict()["forces_measured"]["rows"] == 0


def test_forces_of_another_law_make_the_model_suspect(truth: Truth, fitted: tuple[Estimate, Problem, Fit]) -> None:
    assert truth.forces is not None
    result, problem, fit = fitted
    t, measured = truth.forces.t, truth.forces.force
    # the motion obeys the assumed contact law, so the poses alone show no contradiction
    own = fit.shared.copy()
    own[[*range(SIZE)[BIAS], DELAY]] = 0.0
    window = Window(Poses(t, np.zeros((len(t), 3))), problem.window.starts, problem.window.states)
    point = Problem(problem.forward, problem.unknowns, window).evaluate(own, fit.point.states)
    assert point is not None
    contact = Contact(law="kelvin_voigt", stiffness=truth.scene.contact.stiffness, damping=1e5)
    force = forces_at(replace(truth.scene, contact=contact), -point.residual, point.rate)[1]
    force += 1e3 * np.random.default_rng(0).standard_normal(measured.shape)
    estimated = summary._with_forces(result, problem, fit, ContactForces.of(t, force)[0], 1.0)
    assert (estimated.model, estimated.sensor, estimated.vertical_state) == ("suspect", "ok", State.WITHDRAWN)
    assert estimated.stiffness == result.stiffness and "remain unexplained" in estimated.reasons[-1]


def test_the_law_s_forces_agree_with_the_solver() -> None:
    scene = preset("paper")
    scene = replace(scene, contact=Contact(law="hunt_crossley", stiffness=1e7, damping=0.7))
    run = simulate(scene, 1.5, 1e-2, 1e-6)
    penetration, force = forces_at(scene, run.q, run.v)
    assert run.force.max() > 1e4
    np.testing.assert_allclose(penetration, run.penetration, atol=1e-9)
    np.testing.assert_allclose(force, run.force, rtol=1e-6, atol=1.0)
    units = Units(2.0, 4.0, 0.5)
    small = forces_at(units.scene(scene), run.q / [2.0, 2.0, 1.0], run.v * [0.25, 0.25, 0.5])[1]
    np.testing.assert_allclose(small * units.force, force, rtol=1e-9)


def test_without_measured_forces_their_code_does_not_run(
    truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = replace(truth, load=truth.load.between(0.0, 4.0), poses=truth.poses.between(0.0, 4.0), forces=None)
    short.write(tmp_path)
    # `--out` writes a file of this name with computed forces, which must not be read as a measurement
    (tmp_path / "forces.csv").write_text("t,force_top_left_top/p05\n0,1\n")
    for name in ("contact_forces", "force_fit"):
        # an import of this module now raises an error
        monkeypatch.setitem(sys.modules, f"plow_twin.estimate.{name}", None)
    result, _ = _given(tmp_path, None, None, True).run()
    assert result.forces_measured is None
    (tmp_path / "contact_forces.csv").write_text("t,top_left_top\n0,1\n")
    with pytest.raises(ImportError):
        _given(tmp_path, None, None, True)


def test_forces_are_read_from_a_folder_and_by_a_mapping(truth: Truth, tmp_path: Path) -> None:
    truth.write(tmp_path)
    (tmp_path / "contact_forces.csv").write_text(
        "t;top_left_top;top_right_right\n0,5;1,5;\n0,6;;\n0,7;x;2\n0,8;;-3,5\n"
    )
    measured = read_measured(tmp_path)
    assert measured.forces[:, 0].tolist() == [0.5, 0.6, 0.8] and measured.unreadable == 1
    forces, lost = ContactForces.of(measured.forces[:, 0], measured.forces[:, 1:])
    assert (forces.t.tolist(), lost) == ([0.5, 0.8], 1) and forces.force[1, PAIR_NAMES.index("top_right_right")] == -3.5
    (tmp_path / "map.yaml").write_text(
        "excitation: {topic: load, type: csv}\nhead_pose: {topic: pose, type: csv}\n"
        "forces: {topic: cells, type: csv, unit: kN}\n"
    )
    (tmp_path / "cells.csv").write_text("t,top_left_top\n0.5,2\n0.6,3\n")
    mapped = read_recording(tmp_path, mapping=tmp_path / "map.yaml")
    assert mapped.forces[:, :2] == pytest.approx(np.array([[0.5, 2000.0], [0.6, 3000.0]]))
    with pytest.raises(ContactForcesError, match=r"got t .2,. and force .2, 3."):
        ContactForces.of([0.0, 1.0], np.zeros((2, 3)))
