"""The balance of energy and momentum closes for a correct motion, and only for a correct motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import preset

from plow_twin import Contact, Head, Wear, simulate
from plow_twin.run.energy_balance import energy_balance_of
from plow_twin.run.motion import Motion, run_events
from plow_twin.run.simulate import _start
from plow_twin.solve.compiled_scene import compile_scene
from plow_twin.solve.energy_balance import new_balance
from plow_twin.solve.state import new_work

PAPER, BENCH = preset("paper"), preset("bench_kv")
SCENES = {
    "paper": PAPER,
    "bench_kv": BENCH,
    "bench_hc": preset("bench_hc"),
    "offset": replace(
        PAPER, head=Head(2430.0, 1265.0, "consistent", (0.1, -0.05)), gravity=replace(PAPER.gravity, arm_m=0.0)
    ),
    "ramp": replace(PAPER, contact=Contact("ramped_damping", 1e8, 1.5, damping=6e4, ramp_m=2e-3)),
    "wear": replace(PAPER, wear=Wear(1e-9, 3.0, 0.015)),
    "locked": replace(PAPER, locked=("y",)),
}
SCENES["offset, ramp, wear"] = replace(SCENES["offset"], contact=SCENES["ramp"].contact, wear=SCENES["wear"].wear)
# scenes of the full run only, because each compiles its own kernels; test_solve_falling covers the law of `paper` in
# the quick run
FULL_COUNT = ("paper", "bench_hc", "offset", "ramp", "wear", "locked")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.stress] if name in FULL_COUNT else []) for name in SCENES]
)
def test_the_energy_balances(name: str) -> None:
    balance = simulate(SCENES[name], 5.0, energy_balance=True).energy_balance
    assert balance is not None
    assert balance.relative_imbalance < 1e-11
    scale = np.abs(balance.impulse).max(axis=0) + 1.0
    assert (balance.momentum_imbalance < 1e-10 * scale).all()
    gained = balance.kinetic_j[1] - balance.kinetic_j[0]
    stored = balance.stored_j[1] - balance.stored_j[0]
    work = balance.load_work_j + balance.gravity_work_j - balance.dissipated_j - balance.friction_work_j
    assert work == pytest.approx(gained + stored, abs=1e-9 * balance.turnover_j)
    assert balance.dissipated_j > 0.0 and balance.friction_work_j == 0.0


def test_the_balance_changes_no_bit_of_the_motion_and_costs_nothing_when_off() -> None:
    plain, balanced = simulate(BENCH, 2.0), simulate(BENCH, 2.0, energy_balance=True)
    assert np.array_equal(plain.q, balanced.q) and plain.solver == balanced.solver and plain.energy_balance is None
    assert _start(compile_scene(BENCH, 1e-9), 1, energy_balance=False).sums is None


def test_a_wrong_motion_violates_the_balance() -> None:
    """The balance computes its own forces, so that a solver with another stiffness is detected."""
    compiled = compile_scene(BENCH, 1e-9)
    motion = Motion.start(compiled, np.zeros((1, 3)), np.zeros((1, 3)), outputs=True)
    motion.sums = new_balance()
    run_events(compiled, motion, np.zeros(1), 1.0, new_work(), 10**6)
    compiled.params.inverse_inertia *= 1.0 + 1e-6
    run_events(compiled, motion, np.zeros(1), 2.0, new_work(), 10**6)
    assert energy_balance_of(compiled, motion.state, motion.sums).relative_imbalance > 1e-10


@pytest.mark.stress  # this test compiles additional kernels
def test_fixed_steps_balance_energy_to_their_order() -> None:
    coarse, fine = (
        simulate(PAPER, 2.0, method="rk4", dt=dt, output_dt=0.1, energy_balance=True).energy_balance
        for dt in (4e-4, 1e-4)
    )
    assert coarse is not None and fine is not None
    assert fine.relative_imbalance < 0.15 * coarse.relative_imbalance < 1e-6
