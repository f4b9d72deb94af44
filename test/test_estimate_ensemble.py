"""Forces with intervals from an ensemble of twins that is drawn from an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimate_support import known

from plow_twin import Table, Twin
from plow_twin.estimate.answer import followed
from plow_twin.estimate.forces import ForceEnsemble, ForcesError, draw_scenes, forces_of
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.result import Interval, State
from plow_twin.estimate.unknowns import CORRELATED


def test_intervals_of_the_forces_contain_peaks_and_impulses() -> None:
    truth, result = known()[0]
    assert result.correlation is not None and np.linalg.eigvalsh(np.array(result.correlation)).min() > 0.0
    period = truth.load.period()
    forces = forces_of(truth.nominal, result, truth.load, 60, period)
    cutting = truth.scene.loads[0]
    assert isinstance(cutting, Table)
    run = Twin(replace(truth.scene, loads=()), excitation="sampled").advance_samples(cutting.t, cutting.wrench)
    late = (cutting.t > forces.t[0]) & (cutting.t <= forces.t[-1])
    true = {"peak": run.peak[late].max(axis=0), "impulse": run.impulse[late].sum(axis=0)}
    held = [
        low <= value <= high
        for name, values in true.items()
        for value, low, high in zip(values, getattr(forces, name)[0], getattr(forces, name)[2], strict=True)
    ]
    assert sum(held) >= 11, "of 16, whose errors go together"
    assert forces.peak[2].max() < 1.4 * forces.peak[0].max()
    withdrawn = replace(result, horizontal_state=State.WITHDRAWN)
    with pytest.raises(ForcesError, match="withdrawn"):
        ForceEnsemble(truth.nominal, withdrawn)
    with pytest.raises(ForcesError, match="members: got 3"):
        ForceEnsemble(truth.nominal, result, 3)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_thinned_load_gives_the_same_forces(noise: float) -> None:
    truth, result = known()[0]
    t = np.arange(0.0, 6.0, 1e-3)
    wrench = np.stack([np.interp(t, truth.load.t, column) for column in truth.load.wrench.T], axis=1)
    wrench += noise * wrench.std(axis=0) * np.random.default_rng(1).standard_normal(wrench.shape)
    load = Load(t, wrench)
    few = followed(load, truth.load.period())
    assert len(few.t) < 0.3 * len(t)
    # one load has fewer samples than the other, but with both loads the forces begin 3.1 s after the first sample
    each = [forces_of(truth.nominal, result, one, 60, 3.1, over_time=False) for one in (load, few)]
    assert each[0].start == each[1].start == pytest.approx(3.1)
    for one, other in ((each[0].peak, each[1].peak), (each[0].impulse, each[1].impulse)):
        # a few of the sixty members move differently, which changes the 5 % and 95 % points
        for value, its, most in zip(one, other, (0.15, 0.03, 0.15), strict=True):
            assert its == pytest.approx(value, rel=most, abs=1e-3 * float(one.max()))


def test_members_are_drawn_with_the_estimate_s_correlation() -> None:
    truth, result = known()[0]
    matrix = np.eye(len(CORRELATED))
    matrix[0, 2] = matrix[2, 0] = -0.8
    drawn = replace(result, correlation=tuple(map(tuple, matrix.tolist())))
    scenes, gains = draw_scenes(truth.nominal, drawn, 2000, np.random.default_rng(1))
    clearance = np.array([scene.clearance.horizontal_m for scene in scenes])
    stiffness = np.log([scene.contact.stiffness for scene in scenes])
    # clearance and stiffness are correlated: members with a smaller clearance have softer contacts
    assert np.corrcoef(clearance, stiffness)[0, 1] == pytest.approx(0.8, abs=0.04)
    assert drawn.apparent is not None  # all members have the frame of the scene
    ends = drawn.apparent[0].p05, drawn.apparent[0].p95
    assert np.quantile(clearance, [0.05, 0.95]) == pytest.approx(ends, abs=0.05 * (ends[1] - ends[0]))
    assert gains.shape == (2000, 3)


def test_members_outside_the_range_of_the_model_are_omitted_and_counted() -> None:
    truth, result = known()[0]
    soft = replace(result, stiffness=Interval(2e7, 1e6, 4e7), correlation=None)
    forces = forces_of(truth.nominal, soft, truth.load.between(0.0, 6.0), 60, 3.2)
    assert forces.left_out > 0 and forces.members + forces.left_out == 60
    assert np.isfinite(forces.force).all()
