"""In units of its own size, a machine of another size gives bit-identical estimates."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from estimate_support import known
from scenes import preset

from plow_twin import Friction, Harmonic, Initial, simulate
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forces import draw_scenes
from plow_twin.estimate.reason import FORCE, LENGTH, Reason
from plow_twin.estimate.similar import Units


def test_a_machine_of_another_size_is_estimated_like_the_paper_s_machine() -> None:
    truth, result = known()[0]
    desk = Units(8.0, 1024.0, 4.0)  # a machine that is an eighth as large, a thousandth as heavy and four times as fast
    scene = desk.scene(truth.nominal)
    estimated = estimate(scene, desk.load(truth.load), desk.poses(truth.poses))
    assert estimated.t_end == result.t_end / 4.0 and estimated.bias_x is not None and estimated.delay is not None
    # the factors are powers of two, so the conversion changes no bit of a mantissa
    back = desk.in_si(estimated, truth.nominal)
    assert back == replace(result, lost=back.lost) and estimated.horizontal.mean == result.horizontal.mean / 8.0
    assert back.motion is not None and result.motion is not None
    np.testing.assert_array_equal(back.motion.model, result.motion.model)
    twins, gain = draw_scenes(scene, estimated, 20, np.random.default_rng(0))
    alike, same = draw_scenes(truth.nominal, result, 20, np.random.default_rng(0))
    assert gain == pytest.approx(same)
    assert [8.0 * twin.clearance.vertical_m for twin in twins] == pytest.approx(
        [twin.clearance.vertical_m for twin in alike]
    )


def test_the_reasons_for_a_machine_of_another_size_are_in_si_units() -> None:
    desk, truth = Units(8.0, 1024.0, 4.0), known()[0][0]
    load, poses = desk.load(truth.load), desk.poses(truth.poses)
    begin, scene = float(poses.t[0]), desk.scene(truth.nominal)
    (few,) = estimate(scene, load, poses.between(begin, begin + 0.01)).reasons
    assert f"the load's span, {load.t[0]:g} s to {load.t[-1]:g} s" in few
    step = round(0.1 / float(np.median(np.diff(poses.t))))
    (rare,) = estimate(scene, load, replace(poses, t=poses.t[::step], q=poses.q[::step])).reasons
    assert rare == "poses: got 10.0 a second, expected at least 32.0"


def test_a_reason_is_converted_to_si_and_copied_with_its_quantities() -> None:
    shifted = Reason("by {:.2g} m, {:.2g} N", (0.5, LENGTH), (3.0, FORCE)).after("{cell}: ")
    assert shifted == "{cell}: by 0.5 m, 3 N"
    assert pickle.loads(pickle.dumps(shifted)).in_si(8.0, 1024.0, 4.0) == "{cell}: by 4 m, 1.5e+03 N"


@pytest.mark.parametrize("friction", [Friction(0.2, 0.02), Friction(0.3, stick_stiffness_n_m=5e7)])
def test_a_scene_in_other_units_has_the_same_motion(friction: Friction) -> None:
    thrown = Initial((1e-3, 0.0, 1e-3), (0.4, 0.3, 0.5))
    units, scene = Units(8.0, 1024.0, 4.0), replace(preset("bench_kv"), friction=friction, initial=thrown)
    # load and energy balance have no effect on the motion, but with them the kernels of other tests are used
    nothing, balance = (Harmonic("nothing to speak of", (1e-9, 0.0), 2.0),), friction.stick_stiffness_n_m is not None
    run, other = (
        simulate(replace(one, loads=nothing), span, span / 40.0, 1e-9, energy_balance=balance)
        for one, span in ((scene, 0.4), (units.scene(scene), 0.1))
    )
    assert np.ptp(run.q, axis=0).min() > 1e-3
    assert other.q * [8.0, 8.0, 1.0] == pytest.approx(run.q, rel=1e-6, abs=1e-9)
    assert other.force * units.force == pytest.approx(run.force, rel=1e-6, abs=1e-3)
