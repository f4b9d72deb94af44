"""Poses and loads on input: rows that are rejected and counted, stated deviations, and thinning."""

from __future__ import annotations

import numpy as np
import pytest
from estimate_support import known
from scipy.signal import lfilter

from plow_twin.estimate.measurements import EstimateError, Load, Poses, without_uncertain


def test_arrays_of_the_wrong_shape_are_named() -> None:
    with pytest.raises(EstimateError, match=r"poses: got t \(2,\) and q \(3, 3\)"):
        Poses.of([0.0, 1.0], np.zeros((3, 3)))
    with pytest.raises(EstimateError, match="at least 2"):
        Load.of([0.0], np.zeros((1, 3)))


def test_implausible_poses_and_loads_are_left_out_and_counted() -> None:
    """A single pose of 1e300 m would make the estimate fail with an overflow."""
    poses, lost = Poses.of([0.0, 1.0, 2.0], [[0.0, 0.0, 0.0], [1e300, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert (poses.t.tolist(), lost) == ([0.0, 2.0], 1)
    load, lost = Load.of([0.0, 1.0, 2.0], [[0.0, 0.0, 0.0], [1e5, 0.0, 1e300], [0.0, 0.0, 0.0]])
    assert (load.t.tolist(), lost) == ([0.0, 2.0], 1)


def test_the_covariance_of_a_pose_is_used() -> None:
    """A covariance of 1e6, which means `not measured`, must not make the other poses useless."""
    q, own = np.ones((40, 3)), np.full((40, 3), 1e-3)
    own[7], own[8, 0], own[9] = 1e3, 0.02, np.nan
    kept, deviation = without_uncertain((0.0, 0.0, 4e-3), q, own)
    assert deviation == pytest.approx((1e-3, 1e-3, 4e-3))
    assert np.argwhere(np.isnan(kept)).tolist() == [[7, 0], [7, 1], [7, 2], [8, 0]]
    for wrong in ((np.nan, 0.0, 0.0), (0.0, -1.0, 0.0), (np.inf, 0.0, 0.0)):
        with pytest.raises(EstimateError, match="poses: got the deviations"):
            Poses.of(np.arange(40.0), q, wrong)
        with pytest.raises(EstimateError, match="load: got the deviations"):
            Load.of(np.arange(40.0), q, wrong)


def test_spikes_and_repetitions_of_a_sensor_are_left_out() -> None:
    poses = known()[0][0].poses
    level = np.array([5e-4, 5e-4, 2e-3])
    assert poses.without_spikes(level)[1] == 0 and poses.fresh() is poses
    q = poses.q.copy()
    q[30::60, 1] += 5.0
    clean, count = Poses(poses.t, q).without_spikes(level)
    assert (
        count == len(q[30::60]) and np.isnan(clean.q[30::60, 1]).all() and np.isfinite(clean.q).sum() == q.size - count
    )
    q[::4] += 5.0
    assert Poses(poses.t, q).without_spikes(level)[1] == 0, "a bad sensor is not made a good one"
    # a sensor with a rate of 20 Hz, read at 100 Hz, repeats each value in five rows
    slow = Poses(poses.t, poses.q[np.arange(len(poses.t)) // 5 * 5])
    assert np.array_equal(slow.fresh().q, poses.q[::5]) and np.array_equal(slow.fresh().t, poses.t[::5])
    slow.q[700:] = slow.q[700]
    assert slow.fresh() is slow, "one that has stopped is not hidden"


def test_a_load_is_thinned_within_its_share() -> None:
    t = np.linspace(0.0, 10.0, 10_001)
    load, _ = Load.of(t, np.stack([np.sin(2.0 * t), 0.0 * t, np.cos(2.0 * t)], axis=1) * 1e5)
    thin = load.thinned(1e-3)
    assert len(thin.t) < 500
    for column, whole in zip(thin.wrench.T, load.wrench.T, strict=True):
        assert np.abs(np.interp(t, thin.t, column) - whole).max() <= 1.001e-3 * 2e5
    assert load.period() == pytest.approx(np.pi, rel=0.1)


def test_an_averaged_load_keeps_its_mean_and_bridges_gaps() -> None:
    rng = np.random.default_rng(2)
    t = np.delete(np.arange(0.0, 10.0, 2e-3), slice(2000, 2400))
    load, _ = Load.of(t, rng.standard_normal((len(t), 3)) + 5.0)
    few = load.averaged(1000)
    fine = np.linspace(0.0, t[-1], 200_001)
    for column, whole in zip(few.wrench.T, load.wrench.T, strict=True):
        left_over = np.interp(fine, few.t, column) - np.interp(fine, t, whole)
        # the integral of the difference does not drift
        assert np.abs(np.cumsum(left_over) * (fine[1] - fine[0])).max() < 0.02
        assert np.abs(np.interp(4.4, few.t, column) - np.interp(4.4, t, whole)) < 0.1


def test_the_unknown_impulse_of_a_rough_load_between_its_samples_is_estimated() -> None:
    rng = np.random.default_rng(3)
    fine = np.arange(200_001) * 1e-4
    rough = np.cumsum(rng.standard_normal((len(fine), 3)), axis=0) * [1.0, 2.0, 3.0]
    load, _ = Load.of(fine[::50], rough[::50])
    lines = np.stack([np.interp(fine, load.t, column) for column in load.wrench.T], axis=1)
    impulse = np.add.reduceat((rough - lines)[:-1] * 1e-4, np.arange(0, 200_000, 50), axis=0)
    assert load.believable().unknown == pytest.approx((impulse**2).sum(axis=0) / fine[-1], rel=0.1)
    smooth, _ = Load.of(fine[::50], np.sin(2.0 * fine[::50, None]) * [1.0, 2.0, 3.0])
    assert (np.array(smooth.believable().unknown) < 1e-9 * np.array(load.believable().unknown)).all()


def test_rare_samples_of_a_rough_load_determine_only_its_oscillation() -> None:
    rng = np.random.default_rng(4)
    fine, keep = np.arange(0.0, 200.0, 1e-3), np.exp(-1e-3 / 8e-3)
    drive = np.sqrt(1.0 - keep**2) * rng.standard_normal((len(fine), 3)) * [1.0, 2.0, 3.0]
    rough = lfilter([1.0], [1.0, -keep], drive, axis=0)
    slow = np.sin(2.0 * fine[:, None]) * [3.0, 6.0, 9.0]
    load, _ = Load.of(fine[::100], (slow + rough)[::100])
    lines = np.stack([np.interp(fine, load.t, column) for column in load.wrench.T], axis=1)
    impulse = np.add.reduceat((slow + rough - lines) * 1e-3, np.arange(0, len(fine), 1000), axis=0)
    _, its, of_samples = load._roughness()
    share = (of_samples - its) / (impulse**2).mean(axis=0)
    assert ((share > 0.4) & (share < 1.3)).all(), "samples hardly tell how short the correlation is"
    believable = load.believable()
    residual = np.stack([np.interp(believable.t, fine, column) for column in slow.T], axis=1) - believable.wrench
    # the samples have errors with standard deviations of 1, 2 and 3; the remaining errors are smaller
    assert (residual.std(axis=0) < [0.4, 0.8, 1.2]).all()
    assert (np.array(believable.unknown) < (impulse**2).mean(axis=0)).all()
