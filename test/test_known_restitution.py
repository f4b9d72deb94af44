"""Restitution of the contact laws: the identity of the exact law, published tables, and the page of results.

A free point hits a wall. These are cases 1 and 2 of docs/known_answers.md.
"""

from __future__ import annotations

import csv
import math
import sys

import pytest
from scenes import ROOT
from scipy.integrate import solve_ivp

from plow_twin import Contact
from plow_twin.model.contact_laws import LAWS, exact_damping_number

sys.path.insert(0, str(ROOT / "benchmark"))
import restitution

# published restitutions `DELIVERED` of each law for the nominal restitutions `ASKED`
ASKED = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
DELIVERED = {
    "lankarani_nikravesh": (0.6653, 0.6723, 0.6842, 0.7016, 0.7252, 0.7561, 0.7960, 0.8471, 0.9132, 0.9535),
    "flores": (0.0694, 0.1555, 0.2562, 0.3629, 0.4704, 0.5773, 0.6832, 0.7885, 0.8939, 0.9468),
    "hunt_crossley": (0.5158, 0.5469, 0.5813, 0.6197, 0.6630, 0.7120, 0.7680, 0.8329, 0.9090, 0.9524),
}


# other integer exponents need kernels that must be compiled
@pytest.mark.parametrize("n", [1.0, 1.5, 2.2, pytest.param(3.0, marks=pytest.mark.stress)])
@pytest.mark.parametrize("e", [0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_exact_restitution_is_returned_for_any_stiffness_exponent_and_mass(n: float, e: float) -> None:
    """The identity D (1 + e) = ln((1 + D) / (1 - D e)) is valid for all exponents, stiffnesses, masses and speeds."""
    for stiffness, mass, speed in ((1e7, 2.0, 1.0), (1e9, 300.0, 0.2)):
        stiff = stiffness * 1e3 ** (n - 1.0)
        contact = Contact("exact_restitution", stiff, n, restitution=e, impact_speed_floor_m_s=restitution.FLOOR)
        assert restitution.free_impact(contact, mass, speed) == pytest.approx(e, abs=1e-8)


@pytest.mark.parametrize(
    ("e", "d"), [(0.1, 9.998159), (0.3, 3.087082), (0.5, 1.432751), (0.7, 0.634828), (0.9, 0.166482)]
)
@pytest.mark.parametrize("n", [1.0, 2.2])
def test_a_damping_factor_in_the_scene_gives_the_restitution_of_its_damping_number(
    e: float, d: float, n: float
) -> None:
    """D = lambda v0 is given as a damping, so that the law does not use the identity."""
    speed = 0.4
    contact = Contact("hunt_crossley", 1e9, n, damping=d / speed)
    # the table contains D with six decimals, and de/dD is at most 0.35, so rounding changes e by less than 3e-7
    assert restitution.free_impact(contact, speed=speed) == pytest.approx(e, abs=3e-7)


def test_impacts_below_the_speed_floor_have_a_higher_restitution() -> None:
    """The damping factor is that of an impact at the floor, so D falls with the speed."""
    contact = Contact("exact_restitution", 1e9, 1.5, restitution=0.4, impact_speed_floor_m_s=0.5)
    delivered = restitution.free_impact(contact, speed=0.2)
    assert delivered > 0.4
    assert exact_damping_number(delivered) == pytest.approx(0.4 * exact_damping_number(0.4), rel=1e-7)


@pytest.mark.parametrize("law", DELIVERED)
def test_the_other_laws_have_their_published_restitution(law: str) -> None:
    for nominal, published in zip(ASKED, DELIVERED[law], strict=True):
        assert restitution.measure(law, [nominal])[0].delivered == pytest.approx(published, abs=6e-5)


@pytest.mark.parametrize("law", restitution.restitution_laws())
def test_every_law_has_the_restitution_of_the_energy_identity(law: str) -> None:
    for nominal in (0.15, 0.55, 0.85):
        delivered = restitution.measure(law, [nominal])[0].delivered
        assert exact_damping_number(delivered) == pytest.approx(LAWS[law].damping_number(nominal), rel=1e-7)


@pytest.mark.parametrize(
    ("z", "e"), [(0.01, 0.9693), (0.05, 0.8588), (0.1, 0.7441), (0.2, 0.5717), (0.3, 0.4510), (0.5, 0.2984)]
)
def test_kelvin_voigt_without_pull_has_the_known_restitution(z: float, e: float) -> None:
    assert restitution.measure("kelvin_voigt", [z])[0].delivered == pytest.approx(e, abs=6e-5)


def test_kelvin_voigt_agrees_with_the_closed_form() -> None:
    """The restitution is exp(-z / r (pi - atan(2 z r / (1 - 2 z^2)))) with r = sqrt(1 - z^2), for z < 1 / sqrt(2).

    The formula follows from F = 0 on the damped sine (Schwager and Poeschel, Granular Matter 9 (2007) 465).
    """
    for z in (0.02, 0.15, 0.4, 0.6):
        root = math.sqrt(1.0 - z * z)
        expected = math.exp(-z / root * (math.pi - math.atan2(2.0 * z * root, 1.0 - 2.0 * z * z)))
        assert restitution.measure("kelvin_voigt", [z])[0].delivered == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(("z", "ramp"), [(0.1, 0.1), (0.3, 1.0), (2.0, 0.3)])
def test_ramped_damping_agrees_with_another_integrator(z: float, ramp: float) -> None:
    """SciPy integrates u'' = -max(0, u + 2 z s u') with the ramp s.

    This is the law for depths in units of v sqrt(m/K) and times in units of sqrt(m/K).
    """

    def rates(_t: float, state: list[float]) -> tuple[float, float]:
        u, rate = state
        share = min(max(u / ramp, 0.0), 1.0)
        # a contact that was CLIPPED on the way out pushes again when the ramp has reduced the damping
        return rate, -max(0.0, u + 2.0 * z * share * share * (3.0 - 2.0 * share) * rate)

    def parted(_t: float, state: list[float]) -> float:
        return state[0]

    parted.terminal, parted.direction = True, -1.0  # type: ignore[attr-defined]
    free = solve_ivp(rates, (0.0, 500.0), (1e-14, 1.0), events=parted, rtol=1e-12, atol=1e-14, max_step=0.02)
    expected = -float(free.y[1, -1])
    for stiffness, mass, speed in ((1e6, 2.0, 1.0), (3e8, 50.0, 0.3)):
        contact = restitution.damped(z, ramp, stiffness, mass, speed)
        assert restitution.free_impact(contact, mass, speed) == pytest.approx(expected, abs=1e-7)


def test_the_page_shows_the_results_of_the_solver() -> None:
    page = restitution.PAGE.read_text(encoding="utf-8")
    with restitution.TABLE.open(newline="", encoding="utf-8") as file:
        rows = [
            restitution.Row(row["law"], float(row["asked"]), float(row["delivered"]), float(row["ramp"]))
            for row in csv.DictReader(file)
        ]
    assert {row.law for row in rows} == set(LAWS)
    tables = (restitution.page_table, restitution.laws_table, restitution.ratio_table, restitution.ramp_table)
    for table in tables:
        assert f"\n{table(rows)}\n" in page
    # a law without damping would need other compiled kernels
    for law in ("zhiying_qishao", "kelvin_voigt"):
        stored = {row.asked: row.delivered for row in rows if row.law == law}
        for again in restitution.measure(law, list(stored)[5:-1:10]):
            assert stored[again.asked] == pytest.approx(again.delivered, abs=2e-9)
    assert {row.delivered for row in rows if row.law == "hertz"} == {1.0}
    for row in [row for row in rows if row.law == "ramped_damping" and row.asked > 0.0][::9]:
        (again,) = restitution.measure(row.law, [row.asked], row.ramp)
        assert row.delivered == pytest.approx(again.delivered, abs=2e-9)


def test_a_law_is_valid_where_its_restitution_is_within_five_percent_of_the_nominal() -> None:
    rows = [
        restitution.Row("x", e, e * f)
        for e, f in [(0.0, 1), (0.1, 1.2), (0.2, 1.04), (0.3, 0.96), (0.4, 0.9), (0.5, 1)]
    ]
    assert restitution.valid_ranges(rows) == "0.20 .. 0.30, 0.50"
