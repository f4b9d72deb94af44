"""Wear over a life: known answers, the direct run, and a forecast whose quantiles are what they say."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import preset

from plow_twin import Wear, simulate
from plow_twin.estimate.forecast import Plan, forecast
from plow_twin.estimate.life import LifeError, mean_forces, period_of, wear_path
from plow_twin.scene_file import dump_scene

#: Wear so fast that a life fits into a simulation of a minute: 1 mm in some 20 s.
FAST = Wear(1e-8, 1.0, 0.2)


def test_the_jump_agrees_with_the_direct_run() -> None:
    scene = replace(preset("paper"), wear=FAST)
    span = 24.0 * period_of(scene)
    direct = simulate(scene, span, span, 1e-6).wear_depth
    path = wear_path(scene, (1.0, 1.0), FAST.coefficient_m2_n * FAST.travel_speed_m_s * span / FAST.pad_area_m2)
    assert path.depth[-1] == pytest.approx(direct, rel=0.03, abs=1e-5)
    assert direct.max() > 1e-3


def test_constant_force_wears_as_archard_says() -> None:
    """Where wear does not change the force, h = F E."""
    scene = replace(preset("paper"), wear=FAST)
    force, deviation = mean_forces(scene, np.zeros(8))
    path = wear_path(scene, (1.0, 1.0), 1e-10)
    assert path.depth[-1] == pytest.approx(force * 1e-10, rel=1e-3)
    assert (deviation < 0.05 * force.max()).all()


def test_quantiles_scale_with_the_coefficient_and_the_horizon_cuts(tmp_path: Path) -> None:
    slow = Wear(1e-14, 0.015, 2.0, prior_m2_n=(5e-15, 2e-14))
    scene = replace(preset("paper"), wear=slow)
    plan = Plan(0.028, 0.034, 20_000.0, stop_h=1000.0, load_deviation=0.0)
    life = forecast(scene, plan)
    p10, p50, p90 = (life.quantile(share) for share in (0.1, 0.5, 0.9))
    assert p10 is not None and p50 is not None and p90 is not None and p10 < p50 < p90
    # log-normal: the 10 % and 90 % points of 1/k_s are a factor apart that the prior fixes
    assert np.log(p90 / p10) == pytest.approx(np.log(4.0) * 1.2816 / 1.6449, rel=0.1)
    doubled = replace(scene, wear=replace(slow, prior_m2_n=(1e-14, 4e-14)))
    assert forecast(doubled, plan).quantile(0.5) == pytest.approx(0.5 * p50, rel=0.02)
    assert life.probability_before(p50) == pytest.approx(0.5, abs=0.02)
    short = forecast(scene, replace(plan, horizon_h=0.01 * p10)).as_dict()
    assert short["p50"]["hours"] is None and short["not_reached_in_horizon"] == 1.0
    file = tmp_path / "scene.yaml"
    file.write_text(dump_scene(scene))
    limits = ["--limit-horizontal", "28", "--limit-vertical", "34", "--horizon", "20000", "--stop", "1000", "--json"]
    command = [sys.executable, "-m", "plow_twin", "forecast", str(file), *limits]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["p50"]["passes"] == pytest.approx(facts["p50"]["km"] * 1000.0 / 250.0)
    assert 0.0 <= facts["probability_before_stop"] <= 1.0


def test_a_scene_without_wear_or_period_is_refused() -> None:
    scene = preset("paper")
    with pytest.raises(LifeError, match="wear: got none"):
        forecast(scene, Plan(0.03, 0.03, 100.0))
    with pytest.raises(LifeError, match="loads: got no harmonic"):
        mean_forces(replace(scene, loads=()), np.zeros(8))
