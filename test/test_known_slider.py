"""The slider with clearance in its guide of Flores, Leine and Glocker, Multibody Syst. Dyn. 23 (2010) 165.

The slider has four corners in a guide, like our head. The gap functions of the paper are compared with our
penetrations. The mechanism with rigid impacts is integrated here with event detection, and compared with our solver.
See docs/known_answers.md for a comparison with the data of Siconos.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest
from scenes import ROOT, preset

from plow_twin import Clearance, Frame, Initial, simulate

sys.path.insert(0, str(ROOT / "benchmark"))
import siconos


def penetrations(y: float, theta: float) -> np.ndarray:
    """Return our penetrations. The head represents the guide, and its pose is the inverse of the slider's pose."""
    scene = replace(
        preset("paper"), frame=Frame(2.0 * siconos.HALF_LENGTH, 2.0 * siconos.HALF_HEIGHT),
        clearance=Clearance(1.0, 2.0 * siconos.GAP), initial=Initial((-np.sin(theta) * y, -np.cos(theta) * y, -theta)),
    )  # fmt: skip
    return simulate(scene, 0.0).penetration[0]


def test_gap_functions_are_our_penetrations() -> None:
    """g1 and g2 are gaps of the upper corners (left, right) at the upper wall, g3 and g4 those of the lower corners."""
    random = np.random.default_rng(2010)
    for y, theta in zip(random.uniform(-2e-3, 2e-3, 200), random.uniform(-0.05, 0.05, 200), strict=True):
        depth = penetrations(y, theta)
        assert -siconos.gaps(y, theta) == pytest.approx(depth[[0, 2, 6, 4]], abs=1e-15)


def test_touches_agree_with_the_rigid_mechanism() -> None:
    """The first five touches, and the speeds after them, are late by the duration of a contact, about K^-1/2."""
    t, states, impacts = siconos.rigid_motion(0.009, 5)
    assert len(impacts) >= 5 and impacts[0] == pytest.approx(2.69e-3, abs=2e-5)
    late = []
    for stiffness in (1e10, 1e11, 1e12):
        ours = siconos.our_slider(t, states[:, :2], states[:, 2:], stiffness, 1e-5)
        events = ours.events[ours.events["mode_from"] == 0]
        touches = events["time"][events["pair"] == events["pair"][0]]
        late.append(touches[:5] - impacts[:5])
    # the load is linear between samples 10 us apart, which delays a touch by 2e-8 s
    assert late[2] == pytest.approx(0.0, abs=7e-6) and late[2][0] == pytest.approx(0.0, abs=3e-8)
    for softer, stiffer in itertools.pairwise(late):
        assert softer[1:] / stiffer[1:] == pytest.approx(np.sqrt(10.0), rel=0.02)


def test_both_corners_of_a_side_touch_together_and_share_the_force() -> None:
    t, states, _ = siconos.rigid_motion(0.004, 1)
    ours = siconos.our_slider(t, states[:, :2], states[:, 2:], 1e10, 1e-5)
    assert set(ours.events["pair"][:2].tolist()) in ({0, 2}, {4, 6})
    assert ours.events["time"][0] == pytest.approx(ours.events["time"][1], abs=1e-12)
    impulse = sorted(row["impulse"] for row in ours.statistics.values())
    assert impulse[-1] == pytest.approx(impulse[-2], rel=1e-9) and impulse[-3] == 0.0
