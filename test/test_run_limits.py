"""Bounded work: limits of a run, Ctrl-C and progress, each with what has been computed."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import preset

from plow_twin import (
    ArgumentError,
    Clearance,
    Contact,
    Frame,
    Friction,
    Head,
    LimitError,
    PlowTwinError,
    RunInterrupted,
    Scene,
    Wear,
    simulate,
)
from plow_twin.cli.app import run


def test_a_run_stops_at_its_limits_and_says_where_it_stood() -> None:
    scene = preset("paper")
    whole = simulate(scene, 10.0, output_dt=0.01)
    with pytest.raises(
        LimitError, match=r"max_steps = 100 reached at t = \S+ s of 10 s after 100 steps .* in contact: "
    ) as stop:
        simulate(scene, 10.0, output_dt=0.01, max_steps=100)
    part = stop.value.result
    assert part.solver["steps"] == 100 and 0 < len(part.t) < len(whole.t)
    assert stop.value.time_s == pytest.approx(part.t[-1], abs=0.01)
    # what has been computed is what it would have been
    for name in ("t", "q", "v", "force"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[: len(part.t)]), name
    with pytest.raises(LimitError, match=r"max_wall_s = 1e-09 reached at t = "):
        simulate(scene, 1e4, max_wall_s=1e-9)
    with pytest.raises(LimitError, match=r"max_steps = 30 reached at t = 0\.003 s"):
        simulate(scene, 0.1, method="rk4", dt=1e-4, max_steps=30)
    for bad in ({"max_steps": 0}, {"max_wall_s": 0.0}, {"max_wall_s": np.nan}, {"tol": 1.0}):
        with pytest.raises(ArgumentError, match=next(iter(bad))) as refused:
            simulate(scene, 1.0, **bad)
        assert isinstance(refused.value, PlowTwinError) and isinstance(refused.value, ValueError)


def test_looking_at_a_run_does_not_change_it() -> None:
    scene, shares = preset("paper"), []
    whole = simulate(scene, 200.0, output_dt=0.1)
    looked = simulate(scene, 200.0, output_dt=0.1, on_progress=shares.append)
    assert np.array_equal(whole.q, looked.q) and np.array_equal(whole.events, looked.events)
    assert whole.solver == looked.solver and whole.statistics == looked.statistics
    assert len(shares) >= 2 and shares == sorted(shares) and shares[-1] < 1.0


@pytest.mark.parametrize("fixed", [{}, {"method": "rk4", "dt": 1e-4}], ids=["events", "rk4"])
def test_ctrl_c_ends_a_run_with_what_has_been_computed(fixed: dict[str, object]) -> None:
    def press(share: float) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(RunInterrupted, match=r"interrupted at t = \S+ s of 10000 s") as stop:
        simulate(preset("paper"), 1e4, output_dt=0.1, on_progress=press, **fixed)
    # the first slice of work is the last one
    assert 2048 <= stop.value.result.solver["steps"] < 3000
    assert isinstance(stop.value, KeyboardInterrupt) and len(stop.value.result.t) > 1


def test_the_command_line_writes_what_has_been_computed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "part.npz"
    code = run(["simulate", "paper", "--t-end", "10", "--max-steps", "100", "--out", str(out), "--json"])
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert code == 1 and "max_steps = 100 reached at t = " in told.err
    assert found["solver"]["steps"] == 100 and 0.0 < found["t_end"] < 10.0
    with np.load(out) as file:
        assert 0 < len(file["t"]) < 1001 and np.isfinite(file["q"]).all()


BENCH = preset("bench_kv")


@pytest.mark.stress
@pytest.mark.parametrize(
    ("scene", "tol"),
    [
        (replace(BENCH, friction=Friction(5.0, 1e-9)), 1e-8),
        (replace(BENCH, wear=Wear(1.0, 0.015, 2.0)), 1e-8),
        (replace(BENCH, frame=Frame(1e6, 1e6)), 1e-8),
        (replace(BENCH, head=Head(1e-6, 1e-6)), 1e-11),
        (Scene(Head(2430.0, 1265.0), Frame(0.33, 0.27), Clearance(0.0, 0.0), Contact("hertz", 1e13, 1.5)), 1e-12),
    ],
    ids=["friction 5", "wear 1", "frame of 1000 km", "head of 1 mg", "no clearance"],
)
def test_no_scene_works_without_bound(scene: Scene, tol: float) -> None:
    try:
        simulate(scene, 10.0, tol=tol, max_steps=200_000)
    except PlowTwinError as error:
        assert "at t = " in str(error)
