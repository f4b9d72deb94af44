"""Numerical stress: every scene gives a finite result or a named error, with limited work."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scenes import FIRM, preset, wall_and_point, with_presets_terms

from plow_twin import Clearance, Contact, Head, Initial, PlowTwinError, Scene, Status, Twin, simulate

PAPER = preset("paper")


def with_contact(law: str, stiffness: float, exponent: float = 1.0, **damping: Any) -> Scene:
    return dataclasses.replace(PAPER, contact=Contact(law, stiffness, exponent, **damping))


SOLVED = {
    **{f"K {k:g}": with_contact("kelvin_voigt", k, damping=6e4) for k in (1e7, 1e9, 1e11, 1e13)},
    **{f"K {k:g}, n 1.5": with_contact("exact_restitution", k, 1.5, restitution=0.7) for k in (1e9, 1e11, 1e13)},
    **{f"e {e:g}": with_contact("exact_restitution", 1e8, restitution=e) for e in (0.0, 0.01, 0.99)},
    **{f"overdamped C {c:g}": with_contact("kelvin_voigt", 2e7, damping=c) for c in (1e6, 1e8)},
    **{
        f"clearance {gap:g}": dataclasses.replace(
            with_contact("kelvin_voigt", 2e8, damping=1e6), clearance=Clearance(gap, gap)
        )
        for gap in (0.0, 1e-9, -1e-3)
    },
    "start deep in the wall": dataclasses.replace(PAPER, initial=Initial((0.05, 0.0, 0.0))),
    "heavy": dataclasses.replace(with_contact("kelvin_voigt", 1e9, damping=1e6), head=Head(1e5, 5e4)),
}
REFUSED = {
    "K 1e3": with_contact("kelvin_voigt", 1e3, damping=6e4),
    "start at 60 degrees": dataclasses.replace(PAPER, initial=Initial((0.0, 0.0, 1.05))),
    "cavity left": dataclasses.replace(PAPER, initial=Initial((0.0, 0.0, 0.0), (1e3, 0.0, 0.0))),
}


@pytest.mark.parametrize("scene", SOLVED.values(), ids=SOLVED.keys())
def test_extreme_scenes_are_solved(scene: Scene) -> None:
    # with implicit steps, the balance selects the kernels of a pinned motion
    result = simulate(scene, 2.0, tol=1e-8, energy_balance=scene is SOLVED["overdamped C 1e+08"])
    for array in (result.q, result.v, result.force, result.penetration):
        assert np.isfinite(array).all()
    assert (result.force >= 0.0).all()
    # in 2 s under weight and load, no scene needs more steps than the scene with the stiffest contact
    assert result.solver["steps"] < 100_000


@pytest.mark.parametrize("scene", REFUSED.values(), ids=REFUSED.keys())
def test_a_motion_outside_the_model_is_named(scene: Scene) -> None:
    with pytest.raises(PlowTwinError, match="left the model's range"):
        simulate(scene, 2.0)


def test_heads_from_0_1_kg_to_100_t_have_finite_rows() -> None:
    for mass in (1e-1, 1e1, 1e3, 1e5):
        scene = dataclasses.replace(
            PAPER, head=Head(mass, 0.5 * mass), contact=Contact("kelvin_voigt", 2e7, damping=1e3 * mass**0.5)
        )
        assert np.isfinite(simulate(scene, 0.2, tol=1e-8).q).all()


@pytest.mark.parametrize("kind", ["noise at 10 kHz", "steps", "spikes of 1e9 N"])
def test_violent_samples_give_finite_rows_or_a_status(kind: str) -> None:
    random = np.random.default_rng(20150819)
    twin = Twin(with_contact("kelvin_voigt", 1e8, damping=2e5), excitation="sampled")
    t = np.arange(1, 5001) * 1e-4
    wrench = random.normal(0.0, 1.0, (len(t), 3)) * [5e4, 2e4, 3e4]
    if kind == "steps":
        wrench = np.repeat(wrench[::100], 100, axis=0)
    if kind == "spikes of 1e9 N":
        wrench[::997] = 1e9
    series = twin.advance_samples(t, wrench)
    for array in (series.q, series.v, series.force, series.peak, series.impulse):
        assert np.isfinite(array).all()
    good = series.status == Status.OK
    if kind == "spikes of 1e9 N":
        # the first spike throws the head out of the range of the model; all later rows have this status and the last
        # valid pose
        first_bad = int(np.argmin(good))
        assert 0 < first_bad < 100 and (series.status[first_bad:] == Status.OUT_OF_RANGE).all()
        assert (series.q[first_bad:] == series.q[first_bad - 1]).all()
    else:
        assert good.all()
    assert series.steps.max() < 10_000


@pytest.mark.parametrize("hours", [10.0])
def test_hours_at_rest_do_not_drift_and_cost_little(hours: float) -> None:
    scene = wall_and_point(
        Contact("kelvin_voigt", 2e7, damping=6e4), speed=0.0, mass=2430.0, gravity=9.81,
        pairs=("top_left_top", "top_right_top"),
    )  # fmt: skip
    scene = dataclasses.replace(scene, head=Head(2430.0, FIRM), locked=())
    settled = simulate(scene, 10.0, output_dt=10.0)
    late = simulate(scene, hours * 3600.0, output_dt=3600.0)
    assert np.abs(late.q[1:] - settled.q[-1]).max() < 1e-12
    assert late.force[-1, [0, 2]] == pytest.approx([2430.0 * 9.81 / 2] * 2, rel=1e-9)
    # at rest, the number of steps depends only on time: at most a few steps per second
    assert late.solver["steps"] < 20 * hours * 3600.0


def test_two_corners_at_the_same_instant_touch_together() -> None:
    contact = Contact("exact_restitution", 1e9, 1.5, restitution=0.6)
    scene = with_presets_terms(wall_and_point(contact, speed=1.0, pairs=("top_left_top", "top_right_top")))
    result = simulate(scene, 0.02, tol=1e-10)
    first = result.events[:2]
    assert set(first["pair"]) == {0, 2} and first["time"][0] == pytest.approx(first["time"][1], abs=1e-15)
    assert result.v[-1, 1] == pytest.approx(0.6, abs=1e-8)


@pytest.mark.parametrize("request_s", [0.0, 1e-12, 1e4])
def test_any_order_of_advances_in_time_is_possible(request_s: float) -> None:
    twin = Twin(wall_and_point(Contact("kelvin_voigt", 1e9, damping=1e-3), speed=1.0, gravity=9.81))
    row = twin.advance(request_s)
    assert row.status is Status.OK and row.t == request_s and np.isfinite(row.q).all()
