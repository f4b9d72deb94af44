"""CPU time of a live sample at 1 kHz until its forces are sent, and in total, with `follow` off and on.

    python benchmark/follow_latency.py

The runtime of the node is driven without ROS by the load, poses at 100 Hz, and an estimate after half a second.
"""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from estimate_truths import GROUPS, Truth, draw

from plow_twin.estimate.result import Estimate, Interval, State
from plow_twin.live import parameters
from plow_twin.live.runtime import Runtime
from plow_twin.live.solver_start import Preparation
from plow_twin.scene_file import dump_scene
from plow_twin.stream.journal import Estimated
from plow_twin.stream.topics import TOPICS

_T0 = 1_795_000_000_000_000_000
#: Sampling interval, end of the run, end of the warm-up, and time of the estimate [s]. Samples in the warm-up are not
#: measured.
_STEP, _END, _FIRST, _ESTIMATED = 1e-3, 6.0, 1.0, 0.5


class _Front:
    name, follows_samples, sends_motion = "/plow_twin", False, True
    topics = {topic.name: f"/{topic.name}" for topic in TOPICS}  # noqa: RUF012

    def now_ns(self) -> int:
        return _T0

    def __getattr__(self, name: str) -> Any:
        return lambda *_: ""


def _known(truth: Truth) -> Estimated:
    """Return an estimate with the accuracy of an estimate from ten load periods."""
    contact = truth.scene.contact
    assert contact.damping is not None
    horizontal, vertical = (Interval.normal(value, 3e-5) for value in truth.clearance)
    gain_fx, gain_fy, gain_m = (Interval.normal(gain, 0.003) for gain in truth.gain)
    result = Estimate(
        0.0, 1.0, horizontal, vertical, State.ESTIMATED, State.ESTIMATED,
        Interval.normal(contact.stiffness, 2e-3 * contact.stiffness), Interval.normal(contact.damping, 5e-3),
        gain_fx, gain_fy, gain_m, noise=(5e-4, 5e-4, 2e-3),
    )  # fmt: skip
    return Estimated(0, 1, 2, 3, (), (0.0,) * 6, json.dumps(result.as_dict()))


def measured(truth: Truth, follow: str) -> tuple[list[int], list[int]]:
    """Return two lists of CPU times of samples [ns]: until the first message, and until the last message."""
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
        first, whole = _play(runtime, truth)
        runtime.close()
    return first, whole


def _play(runtime: Runtime, truth: Truth) -> tuple[list[int], list[int]]:
    t, clock = np.arange(0.0, _END, _STEP), time.thread_time_ns
    wrench = np.stack([np.interp(t, truth.load.t, column) for column in truth.load.wrench.T], axis=1)
    first, whole, pose, estimated = list[int](), list[int](), 0, False
    for now, (fx, fy, m) in zip(t.tolist(), wrench.tolist(), strict=True):
        while truth.poses.t[pose] <= now:
            x, y, theta = truth.poses.q[pose].tolist()
            runtime.add_pose(_T0 + round(1e9 * float(truth.poses.t[pose])), (x, y, theta))
            pose += 1
        if not estimated and now >= _ESTIMATED:
            runtime.driver.session.apply(_known(truth))
            estimated = True
        begin, out = clock(), 0
        for _ in runtime.step([(_T0 + round(1e9 * now), (fx, fy, m))]):
            out = out or clock() - begin
        first.append(out)
        whole.append(clock() - begin)
    count = round(_FIRST / _STEP)
    return first[count:], whole[count:]


@click.command()
def main() -> None:
    click.echo("| contact | `follow` | forces out: median, 90 %, 99 % | all: median, mean |\n|---|---|---|---|")
    for title, stiffness in (("soft", (3e6, 3e8)), ("hard", (1e9, 1e11))):
        truth = draw(replace(GROUPS["plain"], stiffness=stiffness, periods=2.2), 71003)
        for follow in ("off", "parameters", "full"):
            first, whole = (1e-6 * np.array(times) for times in measured(truth, follow))
            out = ", ".join(f"{value:.3f}" for value in np.quantile(first, [0.5, 0.9, 0.99]))
            click.echo(f"| {title} | `{follow}` | {out} | {np.median(whole):.3f}, {whole.mean():.3f} |")


if __name__ == "__main__":
    main()
