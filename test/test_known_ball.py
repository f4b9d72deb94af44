"""A ball that bounces to rest on a rigid table, and a ball on a vibrating table up to its first period doubling.

The known solutions are for a rigid table with restitution e. The contact here is linear and stiff, with the exact
restitution, and the error decreases with its stiffness. All relevant bounces are above the floor of the impact speed.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import wall_and_point, with_presets_terms
from scipy.optimize import brentq

from plow_twin import Clearance, Contact, Frame, Gravity, Harmonic, Head, Initial, Result, Scene, simulate

GRAVITY = 9.81
#: Angular frequency of the table [rad/s], for 10 Hz.
OMEGA = 2.0 * math.pi * 10.0
PERIOD = 2.0 * math.pi / OMEGA


def rest_time_error(e: float, stiffness: float, h: float = 0.01) -> float:
    contact = Contact("exact_restitution", stiffness, restitution=e, impact_speed_floor_m_s=1e-4)
    pairs = ("top_left_top", "top_right_top")
    scene = wall_and_point(contact, speed=0.0, mass=1.0, gravity=GRAVITY, gap=2 * h, pairs=pairs)
    result = simulate(with_presets_terms(scene), 1.5, output_dt=1.5, tol=1e-8)
    # at rest, each of the two corners carries half the weight
    assert result.force[-1, [0, 2]] == pytest.approx([GRAVITY / 2, GRAVITY / 2], rel=1e-5)
    assert abs(result.v[-1]).max() < 1e-6
    return float(result.events["time"][-1]) / (math.sqrt(2.0 * h / GRAVITY) * (1.0 + e) / (1.0 - e)) - 1.0


@pytest.mark.parametrize("e", [0.3, 0.5, 0.8])
def test_bouncing_ball_comes_to_rest(e: float) -> None:
    """Infinitely many bounces end at sqrt(2 h / g) (1 + e) / (1 - e). At K = 1e11 N/m, the error is 5e-4."""
    errors = [abs(rest_time_error(e, stiffness)) for stiffness in (1e7, 1e9, 1e11)]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 5e-4
    # a nonlinear contact lasts longer at small speeds, so the error is proportional to K^-0.4 only
    pairs = ("top_left_top", "top_right_top")
    limit = math.sqrt(0.02 / GRAVITY) * (1.0 + e) / (1.0 - e)
    for stiffness, bound in ((1e9, 0.05), (1e11, 0.015)):
        contact = Contact("exact_restitution", stiffness, 1.5, restitution=e)
        scene = wall_and_point(contact, speed=0.0, mass=1.0, gravity=GRAVITY, gap=0.02, pairs=pairs)
        assert abs(simulate(with_presets_terms(scene), 3.0, tol=1e-8).events["time"][-1] / limit - 1.0) < bound


def on_the_table(
    gamma: float, r: float, stiffness: float, periods: int, shift: float = 0.0
) -> tuple[Result, np.ndarray]:
    """Start `shift` rad from the period-one orbit. Return the run, and the times of touches in periods of the table.

    In the frame of the table, its motion A sin(wt) is a load m A w^2 sin(wt) on the ball. On the orbit, the ball leaves
    the table at a phase with cos(phase) = pi (1 - r) / (1 + r) / gamma.
    """
    phase = math.acos(min(1.0, math.pi * (1.0 - r) / (1.0 + r) / gamma))
    amplitude = gamma * GRAVITY / OMEGA**2
    speed = 0.5 * GRAVITY * PERIOD - amplitude * OMEGA * math.cos(phase)
    scene = Scene(
        Head(1.0, 1.0), Frame(0.2, 0.2), Clearance(0.5, 0.5),
        Contact("exact_restitution", stiffness, restitution=r), Gravity(GRAVITY),
        (Harmonic("table", (0.0, gamma * GRAVITY), OMEGA, phase + shift),),
        Initial((0.0, -0.25, 0.0), (0.0, speed, 0.0)), ("x", "theta"), ("top_left_top",),
    )  # fmt: skip
    result = simulate(scene, periods * PERIOD, output_dt=periods * PERIOD, tol=1e-12)
    events = result.events
    return result, events["time"][events["mode_from"] == 0] / PERIOD


@pytest.mark.parametrize(("gamma", "period"), [(1.06, 1), (1.3, 1), (1.5, 1), (1.56, 2), (1.65, 2)])
def test_a_ball_on_a_vibrating_table_has_its_period(gamma: float, period: int) -> None:
    """With r = 0.5, an orbit with one bounce per period exists from gamma = 1.0472 on. Its period doubles at 1.5268.

    Reference: Holmes, J. Sound Vib. 84 (1982) 173.
    """
    _, touches = on_the_table(gamma, 0.5, 1e9, 400)
    flights = np.diff(touches)[-40:]
    assert flights[::2] + flights[1::2] == pytest.approx(2.0, abs=1e-9)
    spread = float(abs(flights - 1.0).max())
    assert spread < 1e-9 if period == 1 else spread > 0.05


@pytest.mark.parametrize("gamma", [1.01, 1.03])
def test_below_the_threshold_the_ball_sticks_each_period(gamma: float) -> None:
    result, touches = on_the_table(gamma, 0.5, 1e8, 60)
    # without a period-one orbit, the ball bounces several times in each period and then stays on the table
    assert np.count_nonzero(touches > 40.0) > 2 * 19
    assert np.diff(touches)[touches[1:] > 40.0].max() < 0.999
    # with one bounce per period, the ball would be in contact for only 0.3 % of the time
    assert result.statistics["top_left_top"]["time_in_contact"] > 0.5 * 60 * PERIOD


def one_bounce_a_period(gamma: float, r: float, stiffness: float) -> bool:
    _, touches = on_the_table(gamma, r, stiffness, 200)
    return len(touches) <= 201 and float(abs(np.diff(touches)[-20:] - 1.0).max()) < 1e-3


def existence_threshold(r: float, stiffness: float) -> float:
    """Return the smallest gamma with one bounce per period, to 1e-4. The search begins at the rigid table's value."""
    rigid = math.pi * (1.0 - r) / (1.0 + r)
    low, high = 0.97 * rigid, 1.02 * rigid
    assert one_bounce_a_period(high, r, stiffness) and not one_bounce_a_period(low, r, stiffness)
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if one_bounce_a_period(middle, r, stiffness) else (middle, high)
    return high


def doubling_threshold(r: float, stiffness: float) -> float:
    """Return the gamma at which a small disturbance of the period-one orbit alternates without decay."""

    def growth(gamma: float) -> float:
        _, touches = on_the_table(gamma, r, stiffness, 14, shift=1e-4)
        late = np.diff(touches)[-2:] - 1.0
        return float(late[1] / late[0]) + 1.0

    return float(brentq(growth, 1.48, 1.56, xtol=1e-8))


def test_both_thresholds_of_the_vibrating_table_converge_to_the_known_values() -> None:
    """With r = 0.5, a = pi (1-r)/(1+r) is 1.0472, and (a^2 + 4 ((1+r^2)/(1+r)^2)^2)^0.5 is 1.5268.

    The error is proportional to K^-1/2, like the duration of a contact. At K = 1e9 N/m, it is 1e-3 and 4e-4. The values
    extrapolated to a rigid table have an error of 1e-4.
    """
    r = 0.5
    exists = math.pi * (1.0 - r) / (1.0 + r)
    doubles = math.hypot(exists, 2.0 * (1.0 + r * r) / (1.0 + r) ** 2)
    assert exists == pytest.approx(1.0472, abs=5e-5) and doubles == pytest.approx(1.5268, abs=5e-5)
    for threshold, rigid, bound in ((existence_threshold, exists, 1.1e-3), (doubling_threshold, doubles, 4e-4)):
        values = np.array([threshold(r, stiffness) for stiffness in (1e7, 1e8, 1e9)])
        errors = abs(values / rigid - 1.0)
        assert errors[2] < bound
        assert errors[:-1] / errors[1:] == pytest.approx(math.sqrt(10.0), rel=0.1)
        limit = (math.sqrt(10.0) * values[2] - values[1]) / (math.sqrt(10.0) - 1.0)
        assert limit == pytest.approx(rigid, rel=1.5e-4)
