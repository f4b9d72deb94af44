"""Measured orders of convergence: with event detection, and with fixed steps that do not locate touches."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
import pytest
from scenes import pose_error, preset, reference, wall_and_point, with_presets_terms

from plow_twin import Contact, Scene, simulate
from plow_twin.solve import compiled_scene

REFERENCES = {"bench_kv": "bench_kv", "bench_hc": "bench_hc", "paper": "paper_r1"}

CONTACTS = {
    "kelvin_voigt": Contact("kelvin_voigt", 1e6, damping=0.4 * math.sqrt(2e6)),
    "n = 1": Contact("exact_restitution", 1e6, 1.0, restitution=0.5),
    "n = 1.5": Contact("exact_restitution", 3e7, 1.5, restitution=0.5),
    "n = 1.5, Hertz": Contact("hertz", 3e7, 1.5),
    "n = 2": Contact("exact_restitution", 1e9, 2.0, restitution=0.5),
}


def local_orders(errors: list[float]) -> np.ndarray:
    return -np.diff(np.log2(errors))


def fixed_step_errors(
    contact: Contact, method: Literal["rk4", "euler"], halvings: int, phases: int = 32
) -> list[float]:
    """Return the mean pose error after one impact, for steps of 80 us that are halved repeatedly.

    The phases of touch and separation in a step are distributed uniformly, because the stiffness varies slightly. The
    mean is therefore smooth in dt, although a single run is not.
    """
    t_end, errors = 0.016, []
    for count in 200 * 2 ** np.arange(halvings + 1):
        dt, found = t_end / int(count), []
        for phase in range(phases):
            stiffness = contact.stiffness * (1.0 + 0.2 * ((phase * 0.6180339887) % 1.0))
            stiffened = dataclasses.replace(contact, stiffness=stiffness)
            scene = with_presets_terms(
                wall_and_point(stiffened, speed=1.0, gap=0.004 + 2.0 * dt * (phase + 0.5) / phases)
            )
            exact = simulate(scene, t_end, output_dt=t_end, tol=1e-13)
            fixed_run = simulate(scene, t_end, output_dt=t_end, method=method, dt=dt)
            found.append(abs(fixed_run.q[-1, 1] - exact.q[-1, 1]))
        errors.append(float(np.mean(found)))
    return errors


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("n = 1.5", 2.5),
        # these laws need additional compiled kernels
        pytest.param("n = 1", 2.0, marks=pytest.mark.stress),
        pytest.param("kelvin_voigt", 1.0, marks=pytest.mark.stress),
        pytest.param("n = 1.5, Hertz", 2.5, marks=pytest.mark.stress),
        pytest.param("n = 2", 3.0, marks=pytest.mark.stress),
    ],
)
def test_rk4_without_event_location_has_order_n_plus_one(name: str, order: float) -> None:
    """The force begins as d^n, or with a jump (Shampine and Thompson, Comput. Math. Appl. 39 (2000) 43)."""
    errors = fixed_step_errors(CONTACTS[name], "rk4", 4)
    assert np.polyfit(np.log2([1, 2, 4, 8, 16]), np.log2(errors), 1)[0] == pytest.approx(-order, abs=0.15)
    assert local_orders(errors) == pytest.approx(order, abs=0.35)


@pytest.mark.parametrize(
    "name", ["n = 1.5", *(pytest.param(name, marks=pytest.mark.stress) for name in ("kelvin_voigt", "n = 1"))]
)
def test_semi_implicit_euler_has_order_one(name: str) -> None:
    errors = fixed_step_errors(CONTACTS[name], "euler", 3)
    assert local_orders(errors) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("order", [6, 8])
@pytest.mark.parametrize(("name", "first"), [("bench_kv", 4), ("paper", 4), ("bench_hc", 2)])
def test_event_location_keeps_the_order_of_the_series(
    name: str, first: int, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is compared with the number of steps in 4 s of impacts, for series of order 6 and 8.

    The tolerance varies over six decades. All errors are above rounding errors (1e-13 of the clearance).
    """
    scene, exact = preset(name), reference(REFERENCES[name])["q"][:401]
    monkeypatch.setattr(compiled_scene, "order_for", lambda tol: order)
    steps, errors = zip(*[run(scene, 10.0**-k, exact) for k in range(first, first + 6)], strict=True)
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, rel=0.1)


@pytest.mark.parametrize("name", REFERENCES)
def test_the_error_falls_with_the_tolerance(name: str) -> None:
    """From 1e-3 to 1e-8, above rounding errors, the error is a constant times tol^s with s near 1."""
    scene, exact = preset(name), reference(REFERENCES[name])["q"][:501]
    exponents = np.arange(3, 9)
    errors = [run(scene, 10.0**-k, exact)[1] for k in exponents.tolist()]
    slope, offset = np.polyfit(-exponents, np.log10(errors), 1)
    assert slope == pytest.approx(1.0, abs=0.12)
    # no error differs from the fitted line by more than 0.6 decades
    assert np.log10(errors) == pytest.approx(offset - slope * exponents, abs=0.6)


def run(scene: Scene, tol: float, exact: np.ndarray) -> tuple[int, float]:
    result = simulate(scene, 0.01 * (len(exact) - 1), output_dt=0.01, tol=tol)
    return result.solver["steps"], pose_error(scene, result.q, exact)
