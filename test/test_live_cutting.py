"""The stochastic cutting load: its distribution, its correlation along the face, and its passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plow_twin.errors import ArgumentError
from plow_twin.live.cutting_load import CuttingLoad, Face

FACE = Face(length_m=200.0, speed_m_s=2.0, turn_s=4.0)
LOAD = CuttingLoad(FACE, 40e3, lateral_n=5e3, at_m=(0.1, 0.7), variation=0.5, correlation_m=0.05, seed=3)


def test_the_plough_travels_turns_and_returns_without_a_jump() -> None:
    t = np.arange(0.0, 500.0, 1e-3)
    position, speed, number = FACE.travel(t)
    assert position.min() >= 0.0 and position.max() <= 200.0
    assert position.max() > 199.99 and position[number == 1].min() < 0.01
    np.testing.assert_allclose(np.diff(position), 0.5 * (speed[1:] + speed[:-1]) * 1e-3, rtol=0.0, atol=1e-8)
    assert (speed[(number % 2 == 1)] <= 0.0).all() and np.abs(speed).max() == 2.0
    # the speed changes by 2 m/s within 2 s, half the duration of a turn
    assert np.abs(np.diff(speed)).max() <= 1.0001e-3


def test_the_load_has_the_requested_mean_variation_correlation_and_skewness() -> None:
    t = np.arange(4.0, 96.0, 1e-3)
    force = np.concatenate([LOAD.at(t + index * 102.0) for index in range(6)])
    fx, fy, moment = force.T
    assert fx.mean() == pytest.approx(40e3, rel=0.02)
    assert fx.std() / fx.mean() == pytest.approx(0.5, rel=0.04)
    assert fx.min() > 0.0
    skewness = ((fx - fx.mean()) ** 3).mean() / fx.std() ** 3
    # the skewness of a Gamma distribution is twice its coefficient of variation
    assert skewness == pytest.approx(2.0 * 0.5, rel=0.15)
    assert abs(fy.mean()) < 400.0 and fy.std() == pytest.approx(5e3, rel=0.04)
    np.testing.assert_allclose(moment, 0.1 * fy - 0.7 * fx)
    one = fy[: len(t)]
    lag = round(0.05 / 2.0 / 1e-3)
    assert np.corrcoef(one[lag:], one[:-lag])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.06)


def test_the_load_depends_on_position_seed_and_pass() -> None:
    times = np.arange(10.0, 20.0, 0.01)
    coarse, fine = LOAD.at(times), LOAD.at(np.arange(10.0, 20.0, 0.001))
    np.testing.assert_allclose(fine[::10][: len(coarse)], coarse, rtol=0.0, atol=0.01)
    assert (LOAD.at(times) == coarse).all()
    assert not np.allclose(replace(LOAD, seed=4).at(times), coarse)
    force, back = LOAD.at(np.array([52.0])), LOAD.at(np.array([52.0 + 102.0]))
    assert not np.allclose(force, back)
    assert (LOAD.at(np.array([0.0])) == 0.0).all()  # at this time, the head is at the end of the face


@pytest.mark.parametrize(
    "wrong",
    [
        {"variation": 0.0},
        {"correlation_m": -1.0},
        {"force_n": float("nan")},
        {"face": Face(1.0, 2.0, 4.0)},
        {"seed": -1},
    ],
)
def test_a_load_out_of_range_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ArgumentError, match="got"):
        replace(LOAD, **wrong)  # type: ignore[arg-type]
