"""Wear over a life: known solutions, comparison with a direct simulation, and quantiles of the forecast."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import plow_twin
from record_support import BASE_NS, STEP_NS, paper_sample, record_run
from scenes import preset

from plow_twin import Clearance, Table, Twin, Wear, simulate
from plow_twin.cli.app import run as cli
from plow_twin.estimate import tuning
from plow_twin.estimate.coefficient import History, coefficient
from plow_twin.estimate.forecast import Plan, Scenario, forecast, with_clearances, with_estimate
from plow_twin.estimate.life import LifeError, mean_forces, period_of, wear_path
from plow_twin.model.loads import compile_loads
from plow_twin.model.pairs import NORMAL_X, NORMAL_Y
from plow_twin.record.estimated import left_by
from plow_twin.record.reader import RunReader
from plow_twin.scene_file import dump_scene
from plow_twin.stream.journal import Estimated, SetModel, SetWear
from plow_twin.stream.session import Session

#: Wear so fast that a life takes a minute, about 1 mm in 20 s.
FAST = Wear(1e-8, 1.0, 0.2)


def test_the_jump_agrees_with_the_direct_run() -> None:
    scene = replace(preset("paper"), wear=FAST)
    span = 24.0 * period_of(scene)
    direct = simulate(scene, span, span, 1e-6).wear_depth
    path = wear_path(scene, (1.0, 1.0), FAST.coefficient_m2_n * FAST.travel_speed_m_s * span / FAST.pad_area_m2)
    assert path.depth[-1] == pytest.approx(direct, rel=0.03, abs=1e-5)
    assert direct.max() > 1e-3


def test_sliding_in_the_plane_and_running_in_do_not_disturb_the_jump() -> None:
    """With a hundredth of the usual travel, most wear is by sliding in the plane. New pads wear three times as fast."""
    slow = replace(FAST, travel_speed_m_s=0.02, coefficient_m2_n=3e-9, sliding="total")
    scene = replace(preset("paper"), wear=replace(slow, running_in_ratio=3.0, running_in_depth_m=2e-4))
    assert scene.wear is not None
    span = 24.0 * period_of(scene)
    direct = simulate(scene, span, span, 1e-6).wear_depth
    exposure = slow.coefficient_m2_n * slow.travel_speed_m_s * span / slow.pad_area_m2
    path = wear_path(scene, (1.0, 1.0), exposure)
    assert path.depth[-1] == pytest.approx(direct, rel=0.03, abs=1e-5)
    travel_only = wear_path(replace(preset("paper"), wear=replace(slow, sliding="travel")), (1.0, 1.0), exposure)
    assert direct.max() > 1.5 * travel_only.depth[-1].max() > 1e-4
    # with a quarter of the coefficient, running-in is incomplete, but the path is still valid
    quarter = simulate(replace(scene, wear=replace(scene.wear, coefficient_m2_n=7.5e-10)), span, span, 1e-6).wear_depth
    early = [np.interp(0.25 * exposure, path.exposure, pad) for pad in path.depth.T]
    assert early == pytest.approx(quarter, rel=0.05, abs=1e-5)
    # larger clearances mean that the pads have worn, so that their running-in is complete
    worn = with_clearances(scene, scene.clearance.horizontal_m + 2e-3, scene.clearance.vertical_m)
    assert worn.wear is not None and worn.clearance == scene.clearance
    assert worn.wear.initial_depth_m == pytest.approx(1e-3 * np.abs(NORMAL_X))


def test_constant_force_wears_as_archard_says() -> None:
    """For a constant force F, the depth is h = F E, where E is the exposure."""
    scene = replace(preset("paper"), wear=FAST)
    force, deviation = mean_forces(scene, np.zeros(8))
    path = wear_path(scene, (1.0, 1.0), 1e-10)
    assert path.depth[-1] == pytest.approx(force * 1e-10, rel=1e-3)
    assert (deviation < 0.05 * force.max()).all()


def test_quantiles_scale_with_the_coefficient_and_end_at_the_horizon(tmp_path: Path) -> None:
    slow = Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14))
    scene = replace(preset("paper"), wear=slow)
    plan = Plan(0.028, 0.034, 20_000.0, stop_h=1000.0, load_deviation=0.0)
    life = forecast(scene, plan)
    p10, p50, p90 = (life.quantile(share) for share in (0.1, 0.5, 0.9))
    assert p10 is not None and p50 is not None and p90 is not None and p10 < p50 < p90
    # k_s has a log-normal prior, which determines the ratio of the 10 % and 90 % points of 1/k_s
    assert np.log(p90 / p10) == pytest.approx(np.log(4.0) * 1.2816 / 1.6449, rel=0.1)
    doubled = replace(scene, wear=replace(slow, prior_m2_n=(1e-14, 4e-14)))
    assert forecast(doubled, plan).quantile(0.5) == pytest.approx(0.5 * p50, rel=0.02)
    assert life.probability_before(p50) == pytest.approx(0.5, abs=0.02)
    short = forecast(scene, replace(plan, horizon_h=0.01 * p10, stop_h=None)).as_dict()
    assert short["p50"]["hours"] is None and short["not_reached_in_horizon"] == 1.0
    file = tmp_path / "scene.yaml"
    file.write_text(dump_scene(scene))
    limits = ["--limit-horizontal", "28", "--limit-vertical", "34", "--horizon", "20000", "--stop", "1000", "--json"]
    limits += ["--scenario", "hard:coefficient=2"]
    picture = tmp_path / "plots" / "forecast.png"
    completed = plow_twin("forecast", file, *limits, "--plot", picture)
    assert completed.returncode == 0, completed.stderr
    facts = json.loads(completed.stdout)
    assert facts["p50"]["passes"] == pytest.approx(facts["p50"]["km"] * 1000.0 / 250.0)
    assert 0.0 <= facts["probability_before_stop"] <= 1.0
    other = facts["scenarios"]["hard"]
    assert other["p50"]["hours"] < 0.55 * facts["p50"]["hours"]
    assert other["probability_before_stop"] >= facts["probability_before_stop"]
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    # just before the median time to the limit, one clearance has nearly reached its limit
    now = life.clearances(np.zeros(1))[1, 0]
    assert now == pytest.approx([0.025, 0.030], abs=1e-9)
    late = life.clearances(np.array([0.99 * p50]))[1, 0]
    assert max(late - [0.028, 0.034]) == pytest.approx(0.0, abs=3e-4)
    # after the limit is reached, the clearances are those at the end of the path
    assert (life.clearances(np.array([1e3 * p90])) < [0.0285, 0.0347]).all()


def test_scenarios_are_separate_forecasts_from_the_same_draws() -> None:
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14)))
    dry, heavy = Scenario.parse("dry: coefficient=0.5"), Scenario.parse("heavy:load=1.3,coefficient=1")
    plan = Plan(0.0255, 0.0305, 1e5, draws=200, scenarios=(dry, heavy))
    result = forecast(scene, plan)
    alone = forecast(scene, replace(plan, scenarios=()))
    assert np.array_equal(result.hours, alone.hours)
    assert result.scenarios["dry"].hours == pytest.approx(2.0 * result.hours, rel=1e-2)
    # a heavier load causes larger forces and a shorter life; the ratio depends on the contact
    middle, sooner = result.quantile(0.5), result.scenarios["heavy"].quantile(0.5)
    assert middle is not None and sooner is not None and 0.6 * middle < sooner < 0.95 * middle
    for text in ("no numbers:load", "a:speed=2", "b:load=0", ":load=2", "c:load=nan"):
        with pytest.raises(LifeError, match="scenario: got"):
            Scenario.parse(text)
    with pytest.raises(LifeError, match="expected distinct names"):
        forecast(scene, replace(plan, scenarios=(dry, dry)))


def test_a_table_of_enough_periods_is_a_load_for_a_forecast() -> None:
    """A sampled harmonic load, as in a recording, gives the same mean forces as the harmonic load."""
    scene = preset("paper")
    t = np.arange(0.0, 20.0, 0.01)
    sampled = replace(scene, loads=(Table("recorded", t, compile_loads(scene.loads).at(t)),))
    assert period_of(sampled) == pytest.approx(period_of(scene), rel=0.1)
    depth = np.zeros(8)
    assert mean_forces(sampled, depth)[0].sum() == pytest.approx(mean_forces(scene, depth)[0].sum(), rel=0.1)
    with pytest.raises(LifeError, match=r"got [0-9.]+ periods, expected at least 6"):
        period_of(replace(scene, loads=(Table("short", t[:900], compile_loads(scene.loads).at(t[:900])),)))


def test_an_estimated_clearance_includes_the_present_wear() -> None:
    """The estimated clearance already includes 2 mm of wear of the pads, which the forecast must not add again."""
    worn = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, initial_depth_m=(2e-3,) * 8))
    facts = {
        name: {"mean_m": mean, "p05_m": mean - 1e-4, "p95_m": mean + 1e-4, "state": "estimated"}
        for name, mean in (("horizontal", 0.029), ("vertical", 0.034))
    }
    now, deviation = with_estimate(worn, facts)
    result = forecast(now, Plan(0.033, 0.038, 1e6, draws=50), deviation)
    assert np.quantile(result.now, 0.5, axis=0) == pytest.approx([0.029, 0.034], abs=5e-5)
    assert result.clearances(np.zeros(1))[1, 0] == pytest.approx([0.029, 0.034], abs=5e-5)


def test_a_forecast_of_a_run_uses_its_last_pads_and_no_estimate_of_earlier_pads(tmp_path: Path) -> None:
    facts = {
        name: {"mean_m": 0.029, "p05_m": 0.0289, "p95_m": 0.0291, "state": "estimated"}
        for name in ("horizontal", "vertical")
    }
    of_old_pads = Estimated(BASE_NS, BASE_NS + 1, 2, 20, (), (0.0,) * 6, json.dumps(facts))
    depth = tuple(1e-4 * count for count in range(8))
    changes = SetModel(BASE_NS, json.dumps({"clearance.vertical_m": 0.031}))
    entries = [paper_sample(0), of_old_pads, changes, paper_sample(1), SetWear(BASE_NS + STEP_NS, depth, "measured")]
    record_run(tmp_path / "set", [*entries, paper_sample(2)], wear=Wear(1e-14, 0.015, 2.0))
    scene, newest = left_by(RunReader(tmp_path / "set"))
    assert newest is None and scene.clearance.vertical_m == 0.031
    assert scene.wear is not None and scene.wear.initial_depth_m == pytest.approx(depth, abs=1e-12)
    # the first snapshot of a run contains the wear at the start of the run, which may come from wear_state_path and not
    # from the scene
    session = Session(Twin(scene, excitation="sampled"), wear_depth=depth)
    record_run(tmp_path / "kept", [session.snapshot(), paper_sample(0), of_old_pads], wear=Wear(1e-14, 0.015, 2.0))
    scene, newest = left_by(RunReader(tmp_path / "kept"))
    assert newest == of_old_pads
    assert scene.wear is not None and scene.wear.initial_depth_m == pytest.approx(depth, abs=1e-12)
    # the wear of the run itself, as last published
    run = record_run(tmp_path / "worn", map(paper_sample, range(300)), wear=Wear(1e-9, 0.015, 2.0))
    depths = [message.position[2:10] for topic, message in run.outputs if topic.endswith("clearance")]
    worn, _ = left_by(RunReader(run.folder))
    assert worn.wear is not None and max(depths[-1]) > 0.0 and worn.wear.initial_depth_m == tuple(depths[-1])


def test_a_scene_without_wear_or_period_is_refused() -> None:
    scene = preset("paper")
    with pytest.raises(LifeError, match="wear: missing"):
        forecast(scene, Plan(0.03, 0.03, 100.0))
    with pytest.raises(LifeError, match=r"wear\.travel_speed_m_s: got 0, expected a speed above 0"):
        forecast(replace(scene, wear=Wear(1e-14, 0.015, 0.0)), Plan(0.03, 0.03, 100.0))
    for unlikely in (0.0, 5e-13):
        with pytest.raises(LifeError, match=r"expected a value within wear\.prior_m2_n, 1e-15 to 1e-13"):
            forecast(replace(scene, wear=Wear(unlikely, 0.015, 2.0)), Plan(0.03, 0.03, 100.0))
    with pytest.raises(LifeError, match="loads: got no harmonic"):
        mean_forces(replace(scene, loads=()), np.zeros(8))


def test_a_history_of_clearances_determines_the_coefficient(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The true history is a direct simulation without jumps. Its coefficient is not in the middle of the prior."""
    true_k = 1.8e-9
    scene = replace(preset("paper"), wear=replace(FAST, coefficient_m2_n=1e-9, prior_m2_n=(2.5e-10, 4e-9)))
    worn = replace(scene, wear=replace(FAST, coefficient_m2_n=true_k))
    spans = np.arange(0.0, 25.0, 4.0) * period_of(scene)
    depth = np.array([np.zeros(8), *(simulate(worn, span, span, 1e-6).wear_depth for span in spans[1:])])
    growth = 0.5 * np.stack([depth @ np.abs(NORMAL_X), depth @ np.abs(NORMAL_Y)], axis=1)
    noise = 5e-5
    rng = np.random.default_rng(4)
    clearance = np.array([0.025, 0.030]) + growth + noise * rng.standard_normal(growth.shape)
    history = History(spans * FAST.travel_speed_m_s, clearance, np.full(growth.shape, noise))
    estimated = coefficient(scene, history)
    interval = estimated.interval()
    assert interval.p05 < true_k < interval.p95 and interval.p95 / interval.p05 < 1.3**2
    # without noise, the clearances would determine the coefficient exactly, but the interval includes the error of the
    # path
    sure = replace(estimated, weight=np.eye(len(estimated.value))[len(estimated.value) // 2]).interval()
    assert sure.p95 / sure.p05 > math.exp(3.2 * tuning.PATH_DEVIATION)
    assert np.abs(estimated.clearance - [0.025, 0.030] - growth[-1]).max() < 4.0 * noise
    # the forecast begins with the present depths of the pads, which have worn unequally
    assert estimated.depth == pytest.approx(depth[-1], rel=0.1, abs=5e-5)
    ahead = with_clearances(scene, *map(float, estimated.clearance), estimated.depth)
    assert ahead.wear is not None and ahead.wear.initial_depth_m == pytest.approx(estimated.depth)
    total = np.array([ahead.clearance.horizontal_m, ahead.clearance.vertical_m]) + 0.5 * np.array(
        [estimated.depth @ np.abs(NORMAL_X), estimated.depth @ np.abs(NORMAL_Y)]
    )
    assert total == pytest.approx(estimated.clearance)
    # a narrower posterior gives a narrower forecast
    plan = Plan(0.030, 0.035, 1.0, load_deviation=0.0)
    prior, posterior = (forecast(scene, plan, known=knowledge) for knowledge in (None, estimated))
    ratios = [life.quantile(0.9) / life.quantile(0.1) for life in (prior, posterior)]  # type: ignore[operator]
    assert ratios[1] < 1.5 < ratios[0]

    rows = np.column_stack([1e-3 * history.travel, 1e3 * clearance, np.full((len(spans), 2), 1e3 * noise)])
    lines = [",".join(map(repr, map(float, row[[0, 1, 3, 2, 4]]))) for row in rows]
    csv, file = tmp_path / "history.csv", tmp_path / "scene.yaml"
    csv.write_text("\n".join(["km,horizontal_mm,horizontal_sd_mm,vertical_mm,vertical_sd_mm", *lines]))
    file.write_text(dump_scene(scene))
    limits = ["--limit-horizontal", "30", "--limit-vertical", "35", "--horizon", "1", "--json", "--history", str(csv)]
    capsys.readouterr()
    assert cli(["forecast", str(file), *limits]) == 0
    assert json.loads(capsys.readouterr().out)["coefficient_m2_n"]["mean"] == pytest.approx(interval.mean)


def test_a_forecast_wears_the_pads_by_the_contact_that_was_estimated() -> None:
    """The forces on the pads depend on the contact, so the forecast must use the estimated contact."""
    wear = Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14))
    nominal = replace(preset("paper"), wear=wear)
    hard = replace(nominal, contact=replace(nominal.contact, stiffness=2.4 * nominal.contact.stiffness))
    facts = {
        name: {"mean_m": mean, "p05_m": mean - 1e-4, "p95_m": mean + 1e-4, "state": "estimated"}
        for name, mean in (("horizontal", 0.025), ("vertical", 0.030))
    } | {name: {"mean": getattr(hard.contact, name)} for name in ("stiffness", "damping")}
    plan, exact = Plan(0.026, 0.040, 1e6, draws=50), (6e-5, 6e-5)
    hours = forecast(hard, plan, exact).quantile(0.5)
    now, deviation = with_estimate(nominal, facts)
    assert now.contact == hard.contact
    assert forecast(now, plan, deviation).quantile(0.5) == pytest.approx(hours, rel=0.01)
    assert forecast(nominal, plan, exact).quantile(0.5) != pytest.approx(hours, rel=0.05)
    nothing = {
        name: axis_facts | {"state": "not_observable"} for name, axis_facts in facts.items() if "mean_m" in axis_facts
    }
    assert with_estimate(nominal, facts | nothing)[0].contact == nominal.contact


def test_an_unfinished_path_is_an_error_and_not_an_unreached_limit() -> None:
    """From a clearance of a micrometre, 400 steps make no progress. The result must not be `not reached`."""
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14)))
    tight = replace(scene, clearance=Clearance(1e-6, 0.030))
    result = forecast(tight, Plan(0.002, 0.034, 1e3, draws=50))
    assert 0.0 < (result.quantile(0.5) or 0.0) < 1e3
    assert forecast(scene, Plan(0.02, 0.02, 1e3, stop_h=0.0, draws=50)).as_dict()["probability_before_stop"] == 1.0
    with pytest.raises(LifeError, match="mm at the end of the path, expected clearances with which the model runs"):
        mean_forces(scene, np.full(8, 0.5))


def test_drawn_clearances_are_never_below_zero() -> None:
    """A clearance drawn from its prior can be -70 mm, from which the path leaves the range of the model."""
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14)))
    result = forecast(scene, Plan(0.026, 0.031, 1e3, draws=50), (0.03, 0.03))
    assert result.now.min() > 0.0
    with pytest.raises(LifeError, match="deviations: got"):
        forecast(scene, Plan(0.026, 0.031, 1e3), (float("nan"), 0.0))
    for numbers in ((np.nan, 0.03, 1.0), (0.03, np.inf, 1.0), (0.03, 0.03, -1.0)):
        with pytest.raises(LifeError, match="expected a finite number >= 0"):
            Plan(*numbers)
    for facts in ({}, {"horizontal": 3}, {"horizontal": {"state": "fine"}}):
        with pytest.raises(LifeError, match="expected the output of `plow-twin estimate --json`"):
            with_estimate(scene, facts)


def test_a_history_that_the_prior_does_not_allow_is_refused() -> None:
    """The posterior would be at the end of the grid. Its interval would have no width and would exclude the truth."""
    scene = replace(preset("paper"), wear=replace(FAST, coefficient_m2_n=1e-9, prior_m2_n=(2.5e-10, 4e-9)))
    travel = np.arange(5) * 10.0
    still = np.tile([0.025, 0.030], (5, 1))
    with pytest.raises(LifeError, match="expected a wider wear"):
        coefficient(scene, History(travel, still, np.full((5, 2), 1e-6)))
    with pytest.raises(LifeError, match=r"row 0: got \[0.0, -0.025, .*above 0"):
        History(travel, -still, np.full((5, 2), 1e-6))


def test_a_history_that_shrinks_is_refused() -> None:
    """A clearance that decreases by 20 deviations must not give a coefficient near 0 with a narrow interval."""
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0))
    travel, shrunk = np.array([0.0, 1e4]), np.array([[0.025, 0.030], [0.0245, 0.0295]])
    with pytest.raises(LifeError, match=r"no wear of this scene explains.*row 2 is -0\.2\d+ mm off"):
        coefficient(scene, History(travel, shrunk, np.full((2, 2), 5e-5)))
    assert coefficient(scene, History(travel, shrunk, np.full((2, 2), 1e-3))).interval().mean < 1e-13


def test_unusable_input_of_a_forecast_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """There is no forecast for a stop beyond the horizon, an empty estimate or a missing contact."""
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14)))
    file, estimate_file, history = (tmp_path / name for name in ("scene.yaml", "estimate.json", "history.csv"))
    file.write_text(dump_scene(scene))
    # a spreadsheet may write the history with a byte order mark, semicolons and decimal commas
    sheet = "\ufeffkm;horizontal_mm;horizontal_sd_mm;vertical_mm;vertical_sd_mm\n0,0;25;1;30;1\n9;25;1;30;1\n"
    history.write_text(sheet)
    limits = ["--limit-horizontal", "28", "--limit-vertical", "34"]
    assert cli(["forecast", str(file), "-q", *limits, "--history", str(history)]) == 0

    def said(*more: str, scene_file: Path | str = file) -> str:
        assert cli(["forecast", str(scene_file), *limits, *more]) == 2
        return capsys.readouterr().err

    assert "--stop: got 20 h, expected at most the horizon, --horizon 5" in said("--horizon", "5", "--stop", "20")
    assert "scenario: got 'hard:mass=1.3'" in said("--scenario", "hard:mass=1.3")
    assert "wear: missing, expected a section `wear`" in said(scene_file="paper")
    assert "got 0.028 mm, expected more than the present clearance, 25.000 mm; is it in m?" in " ".join(
        said("--limit-horizontal", "0.028").split()
    )
    assert cli(["forecast", str(file), "-q", *limits, "--limit-horizontal", "24"]) == 0
    assert "--limit-horizontal: the present clearance, 25.000 mm, has already passed 24 mm" in capsys.readouterr().err
    whole = {"mean_m": 0.026, "p05_m": 0.0259, "p95_m": 0.0261, "state": "estimated"}
    for text, expected in (
        ("null", "got NoneType, expected JSON of an estimate"),
        ("[" * 200_000, "expected JSON of an estimate"),
        (json.dumps({"horizontal": [1]}), "estimate: horizontal: got [1], expected the output of `plow-twin estimate"),
        (json.dumps({"horizontal": whole, "vertical": whole | {"state": "withdrawn"}}), "a withdrawn vertical"),
        (json.dumps({"horizontal": whole, "vertical": whole | {"p05_m": float("nan")}}), "expected finite values"),
    ):
        estimate_file.write_text(text)
        assert expected in " ".join(said("--estimate", str(estimate_file)).split())
    estimate_file.write_text(json.dumps({"horizontal": whole, "vertical": whole, "stiffness": {"mean": -1e7}}))
    assert "estimate: stiffness: got {'mean': -10000000.0}" in said(
        "--estimate", str(estimate_file), "--history", str(history)
    )


def test_a_mistake_in_a_file_of_a_history_is_reported_in_the_units_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(1e-15, 1e-13)))
    file, history = tmp_path / "scene.yaml", tmp_path / "history.csv"
    file.write_text(dump_scene(scene))

    def said(rows: str, code: int) -> str:
        history.write_text("km,horizontal_mm,horizontal_sd_mm,vertical_mm,vertical_sd_mm\n" + rows)
        limits = ["--limit-horizontal", "28", "--limit-vertical", "34", "--history", str(history)]
        assert cli(["forecast", str(file), *limits]) == code
        return " ".join(capsys.readouterr().err.split())

    assert "horizontal_mm: got 0.0252, expected about the scene's clearance, 25.000 mm; is it in m?" in said(
        "0,0.0252,1e-4,0.0302,1e-4\n100,0.0255,1e-4,0.0305,1e-4\n", 2
    )
    shown = said("200,25,0.1,30,0.1\n100,25.5,0.1,30.5,0.1\n", 1)
    row = "data row 2: got km 100, horizontal_mm 25.5, horizontal_sd_mm 0.1, vertical_mm 30.5, vertical_sd_mm 0.1"
    assert f"{row} after km 200, expected" in shown
    # a growth that is too large shows the prior of the scene
    shown = said("0,25,0.001,30,0.001\n0.001,27,0.001,32,0.001\n", 1)
    assert "prior, 1e-15 to 1e-13 m^2/N, hardly allows, expected a wider wear.prior_m2_n" in shown


def test_a_forecast_from_a_clearance_without_a_measurement_prints_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, estimate_file = tmp_path / "scene.yaml", tmp_path / "estimate.json"
    file.write_text(dump_scene(replace(preset("paper"), wear=Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14)))))
    command = ["forecast", str(file), "-q", "--limit-horizontal", "28", "--limit-vertical", "34"]
    shown = {}
    for states in (("prior", "not_observable"), ("estimated", "rough")):
        clearances = zip(("horizontal", "vertical"), (0.025, 0.030), states, strict=True)
        facts = {
            name: {"mean_m": mean, "p05_m": mean - 1e-3, "p95_m": mean + 1e-3, "state": state}
            for name, mean, state in clearances
        }
        estimate_file.write_text(json.dumps(facts))
        assert cli([*command, "--estimate", str(estimate_file)]) == 0
        shown[states[0]] = capsys.readouterr().err
    assert "estimate.json: horizontal: got the state prior, expected estimated or rough" in shown["prior"]
    assert "vertical: got the state not_observable" in shown["prior"] and shown["estimated"] == ""


def test_a_history_that_cannot_be_used_is_refused() -> None:
    with pytest.raises(LifeError, match="at least 2 rows"):
        History(np.zeros(1), np.zeros((1, 2)), np.ones((1, 2)))
    with pytest.raises(LifeError, match=r"row 1: got \[0.0, .*travel that does not decrease"):
        History(np.array([1.0, 0.0]), np.ones((2, 2)), np.ones((2, 2)))
