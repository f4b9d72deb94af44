"""Alarms have two levels, hysteresis and a minimum duration, and remain latched until they are acknowledged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from plow_twin.solve.state import ROW
from plow_twin.stream.alarms import Alarms, Level, Thresholds
from plow_twin.stream.outputs import SLOW, Published

MS = 1_000_000


def _publication(
    stamp_ms: int, force: float, *, held: bool = False, clearance: Sequence[float] = (), wear_rate: Sequence[float] = ()
) -> Published:
    rows, slow = np.zeros(1, ROW), np.zeros(int(len(clearance) > 0), SLOW)
    rows["stamp_ns"], rows["held"], rows["samples"] = stamp_ms * MS, held, not held
    rows["peak"][0, 1] = rows["measured_peak"][0, 1] = force
    if len(slow):
        slow["stamp_ns"], slow["clearance"] = stamp_ms * MS, clearance
        if len(wear_rate):
            slow["wear_rate"] = wear_rate
    return Published(rows, slow)


def _changes(alarms: Alarms, published: Published) -> bool:
    return list(alarms.feed(published)) == [0]


def _levels(alarms: Alarms) -> tuple[Level, Level]:
    return alarms.levels["force"]


def test_an_alarm_has_a_duration_a_hysteresis_and_a_latch() -> None:
    alarms = Alarms({"force": Thresholds(100.0, 200.0)}, duration_s=0.003)
    assert not any(_changes(alarms, _publication(stamp, 150.0)) for stamp in range(3))
    assert _changes(alarms, _publication(3, 150.0))
    assert _levels(alarms) == (Level.WARN, Level.WARN)
    _changes(alarms, _publication(4, 96.0))
    assert _levels(alarms) == (Level.WARN, Level.WARN)
    _changes(alarms, _publication(5, 94.0))
    assert _levels(alarms) == (Level.NONE, Level.WARN)
    # too short a time at a level raises no alarm, and publications without samples do not count
    _changes(alarms, _publication(6, 300.0))
    _changes(alarms, _publication(7, 0.0))
    for stamp in range(8, 20):
        _changes(alarms, _publication(stamp, 300.0, held=True))
    assert _levels(alarms) == (Level.NONE, Level.WARN)
    assert alarms.acknowledge() == [] and alarms.worst is Level.NONE
    for stamp in range(20, 30):
        _changes(alarms, _publication(stamp, 300.0))
    assert _levels(alarms) == (Level.ERROR, Level.ERROR)
    assert alarms.acknowledge() == ["force"] and alarms.worst is Level.ERROR
    _changes(alarms, _publication(30, 150.0))
    assert alarms.acknowledge() == ["force"] and _levels(alarms) == (Level.WARN, Level.WARN)
    raised = alarms.alarms["force"].raised
    # value and threshold still belong to the higher level, although the level has decreased
    assert raised is not None and (raised.value, raised.threshold) == (300.0, 100.0)


def test_a_threshold_of_zero_disables_an_alarm() -> None:
    alarms = Alarms({"force": Thresholds(0.0, 200.0)})
    assert not _changes(alarms, _publication(0, 199.0))
    assert alarms.worst is Level.NONE
    assert _changes(alarms, _publication(1, 201.0))


def test_a_residual_belongs_to_the_stamp_of_an_early_or_late_pose() -> None:
    alarms = Alarms({"residual": Thresholds(0.004, 0.0)})

    def moved(stamp_ms: int) -> Published:
        publication = _publication(stamp_ms, 0.0)
        publication.rows["q"][0, 0] = 1e-3 * stamp_ms
        return publication

    for stamp_ms in range(0, 100, 10):
        _changes(alarms, moved(stamp_ms))
    # a pose between two publications is compared with the pose of the model at its time
    assert not alarms.feed_pose(35 * MS, (0.036, 0.0, 0.0))
    assert abs(alarms.alarms["residual"].value - 0.001) < 1e-12
    # a pose ahead of the model waits until the model has reached its time
    assert not alarms.feed_pose(105 * MS, (0.110, 0.0, 0.0))
    assert not _changes(alarms, moved(100))
    assert _changes(alarms, moved(110))
    assert alarms.levels["residual"] == (Level.WARN, Level.WARN)
    assert abs(alarms.alarms["residual"].value - 0.005) < 1e-12


def test_the_growth_rate_of_the_clearance_covers_ten_seconds() -> None:
    alarms = Alarms({"clearance_rate": Thresholds(1e-3, 0.0)})
    for tenth in range(200):
        clearance = np.zeros(30)
        clearance[0] = 0.03 + 2e-4 * tenth
        assert _changes(alarms, _publication(100 * tenth, 0.0, clearance=clearance)) == (tenth == 100)
    assert abs(alarms.alarms["clearance_rate"].value - 2e-3) < 1e-9


@pytest.mark.parametrize("names", [("force",), ("wear_rate",), ("clearance", "clearance_rate"), ()])
def test_many_publications_together_raise_the_same_alarms_as_single_publications(names: tuple[str, ...]) -> None:
    rng = np.random.default_rng(len(names))
    run = []
    for index in range(4000):
        slow = {"clearance": rng.random(30), "wear_rate": rng.random(8)} if index % 100 == 0 else {}
        run.append(_publication(10 * index, float(rng.random() ** 20), **slow))
    quantities = ("force", "clearance", "clearance_rate", "wear_rate")
    thresholds = {name: Thresholds(0.05, 0.97) if name in names else Thresholds() for name in quantities}
    one, many = Alarms(thresholds, 0.02), Alarms(thresholds, 0.02)
    expected = [(index, one.levels) for index, publication in enumerate(run) if _changes(one, publication)]
    changes_of_level = []
    for first in range(0, len(run), 250):
        changes = many.feed(Published.joined(run[first : first + 250]))
        changes_of_level += [(first + index, many.levels) for index in changes]
        assert first + 250 < len(run) or many.alarms == one.alarms
    assert changes_of_level == expected and bool(names) == bool(expected)
