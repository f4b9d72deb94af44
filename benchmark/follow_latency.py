"""CPU time of live samples at 1 kHz, with `follow` off and on: ordinary samples, and samples with an event.

    python benchmark/follow_latency.py

The runtime of the node is driven without ROS by the load and by poses at 100 Hz. An estimate arrives after half a
second. The rows go to `benchmark/results/follow_latency.csv`.
"""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from estimate import RESULTS
from estimate_truths import GROUPS, Truth, draw
from numpy.typing import NDArray

from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.live import parameters
from plow_twin.live.runtime import Runtime
from plow_twin.live.solver_start import Preparation
from plow_twin.scene_file import dump_scene
from plow_twin.stream.driver import Arrival
from plow_twin.stream.journal import Estimated
from plow_twin.stream.topics import TOPICS

_T0 = 1_795_000_000_000_000_000
#: Sampling interval, end of the run, end of the warm-up, and time of the first estimate [s]. Samples in the warm-up are
#: not measured.
_STEP, _END, _FIRST, _ESTIMATED = 1e-3, 6.0, 2.0, 0.5
#: Time between two events [s], and time after an event over which the largest sample is searched [s].
_BETWEEN, _AFTER = 0.337, 0.2
_MS = 1e-6


class _Front:
    name, follows_samples, sends_motion = "/plow_twin", False, True
    topics = {topic.name: f"/{topic.name}" for topic in TOPICS}  # noqa: RUF012

    def now_ns(self) -> int:
        return _T0

    def __getattr__(self, name: str) -> Any:
        return lambda *_: ""


def _known(truth: Truth, state: State = State.ESTIMATED) -> Estimated:
    """Return an estimate with the accuracy of an estimate from ten load periods."""
    contact = truth.scene.contact
    assert contact.damping is not None
    horizontal, vertical = (Interval.normal(value, 3e-5) for value in truth.clearance)
    gain_fx, gain_fy, gain_m = (Interval.normal(gain, 0.003) for gain in truth.gain)
    result = Estimate(
        0.0, 1.0, horizontal, vertical, state, state,
        Interval.normal(contact.stiffness, 2e-3 * contact.stiffness), Interval.normal(contact.damping, 5e-3),
        gain_fx, gain_fy, gain_m, noise=(5e-4, 5e-4, 2e-3),
    )  # fmt: skip
    return Estimated(0, 1, 2, 3, (), (0.0,) * 6, json.dumps(result.as_dict()))


#: Function that causes the event with a number at a time [s], and returns samples that arrive late with it.
Event = Callable[[Runtime, Truth, int, float], list[Arrival]]


def _nothing(_: Runtime, __: Truth, ___: int, ____: float) -> list[Arrival]:
    return []


def _estimate(runtime: Runtime, truth: Truth, _: int, __: float) -> list[Arrival]:
    runtime.driver.session.apply(_known(truth))
    return []


def _withdrawal(runtime: Runtime, truth: Truth, number: int, _: float) -> list[Arrival]:
    """Withdraw the estimate, or give it again."""
    runtime.driver.session.apply(_known(truth, State.ESTIMATED if number % 2 else State.WITHDRAWN))
    return []


def _change(runtime: Runtime, truth: Truth, number: int, now: float) -> list[Arrival]:
    wider = truth.nominal.clearance.horizontal_m + 1e-4 * (number + 1)
    runtime.driver.set_model(_T0 + round(1e9 * now), {"clearance.horizontal_m": wider})
    return []


def _late_pose(runtime: Runtime, truth: Truth, _: int, now: float) -> list[Arrival]:
    """Add a pose that is 0.2 s late, in the middle between two other poses."""
    t = np.floor((now - 0.2) * 100.0) / 100.0 + 0.005
    x, y, theta = (float(np.interp(t, truth.poses.t, column)) for column in truth.poses.q.T)
    runtime.add_pose(_T0 + round(1e9 * t), (x, y, theta))
    return []


def _late_load(age: float) -> Event:
    def late(_: Runtime, truth: Truth, __: int, now: float) -> list[Arrival]:
        t = now - age - 0.5 * _STEP
        return [(_T0 + round(1e9 * t), _load_at(truth, t))]

    return late


def _load_at(truth: Truth, t: float) -> tuple[float, float, float]:
    fx, fy, m = (float(np.interp(t, truth.load.t, column)) for column in truth.load.wrench.T)
    return fx, fy, m


EVENTS: dict[str, Event] = {
    "none": _nothing,
    "new estimate": _estimate,
    "withdrawal of the estimate": _withdrawal,
    "change of the model": _change,
    "pose 0.2 s late": _late_pose,
    "load 5 ms late": _late_load(0.005),
    "load 0.1 s late": _late_load(0.1),
    "load 1 s late": _late_load(1.0),
}


@dataclass(frozen=True, eq=False)
class Times:
    """CPU times of a run in ms.

    Attributes
    ----------
    first, whole : ndarray, shape (n,)
        Time of each sample until its first message and until its last message, with all poses and events that arrived
        since the previous sample.
    events : ndarray of int, shape (m,)
        Indices of the samples with an event.
    """

    first: NDArray[np.float64]
    whole: NDArray[np.float64]
    events: NDArray[np.int64]

    def row(self) -> list[float]:
        """Return medians of first and whole times, and of the largest whole time in `_AFTER` s after an event."""
        count = round(_AFTER / _STEP)
        largest = [self.whole[index + 1 : index + count].max() for index in self.events.tolist()]
        return [*(float(np.median(part[self.events])) for part in (self.first, self.whole)), float(np.median(largest))]


def measured(truth: Truth, follow: str, event: Event) -> Times:
    """Return the CPU times of a run with events of one kind."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder, "believed.yaml")
        scene.write_text(dump_scene(truth.nominal), encoding="utf-8")
        # with these long windows and intervals, the runtime makes no estimate of its own
        settings = parameters.settings(
            {"scene": str(scene), "estimate": True, "estimate_window": 600.0, "estimate_interval": 600.0}
            | {"follow": follow}
        )
        front: Any = _Front()
        runtime = Runtime(front, settings, Preparation(settings).result(lambda: False))
        runtime.start()
        runtime.activate()
        times = _play(runtime, truth, event)
        runtime.close()
    return times


def _play(runtime: Runtime, truth: Truth, event: Event) -> Times:
    t, clock = np.arange(0.0, _END, _STEP), time.thread_time_ns
    wrench = np.stack([np.interp(t, truth.load.t, column) for column in truth.load.wrench.T], axis=1)
    events = np.round(np.arange(_FIRST, _END - _AFTER, _BETWEEN) / _STEP).astype(int).tolist()
    first, whole, pose, estimated = np.zeros(len(t)), np.zeros(len(t)), 0, False
    for index, (now, (fx, fy, m)) in enumerate(zip(t.tolist(), wrench.tolist(), strict=True)):
        begin, out = clock(), 0
        while truth.poses.t[pose] <= now:
            x, y, theta = truth.poses.q[pose].tolist()
            runtime.add_pose(_T0 + round(1e9 * float(truth.poses.t[pose])), (x, y, theta))
            pose += 1
        if not estimated and now >= _ESTIMATED:
            runtime.driver.session.apply(_known(truth))
            estimated = True
        late = event(runtime, truth, events.index(index), now) if index in events else []
        for _ in runtime.step([*late, (_T0 + round(1e9 * now), (fx, fy, m))]):
            out = out or clock() - begin
        first[index], whole[index] = _MS * out, _MS * (clock() - begin)
    return Times(first, whole, np.array(events))


@click.command()
def main() -> None:
    rows = []
    for title, stiffness in (("soft", (3e6, 3e8)), ("hard", (1e9, 1e11))):
        truth = draw(replace(GROUPS["plain"], stiffness=stiffness, periods=2.2), 71003)
        for follow in ("off", "full"):
            for name, event in EVENTS.items():
                times = measured(truth, follow, event)
                ordinary = times.whole[round(_FIRST / _STEP) :]
                row = times.row() if name != "none" else [
                    float(np.median(times.first[round(_FIRST / _STEP) :])), float(np.median(ordinary)),
                    float(np.quantile(ordinary, 0.99)),
                ]  # fmt: skip
                rows.append([title, follow, name, *(f"{value:.3f}" for value in row)])
                click.echo("  ".join(rows[-1]))
    with (RESULTS / "follow_latency.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["contact", "follow", "event", "first_ms", "all_ms", "later_ms"])
        writer.writerows(rows)


if __name__ == "__main__":
    main()
