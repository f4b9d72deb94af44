"""Share of a core that the estimate of a live node needs, for a window of 32 s every 10 s, with 256 twins.

    python benchmark/estimate_live.py

Three loads are sampled at 1 kHz: a harmonic load, a harmonic load with 1 % of white noise, and a load that is random in
each sample. As in the node, the first window is estimated without a starting value. Each later window starts from the
previous estimate.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # one thread, as in `Worker`

import platform
import time
from dataclasses import replace

import click
import numpy as np
from estimate_truths import GROUPS, Truth, draw

from plow_twin.estimate.answer import Requests, answer
from plow_twin.estimate.estimate import Guess, warm_up
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.window import Windows

WINDOW_S, INTERVAL_S = 32.0, 10.0
#: Length of the data [s], enough for the first windows and two later windows.
_END_S = 55.0


def shares(truth: Truth, load: Load, members: int) -> list[float]:
    """Return the share of a core that the estimate of each window needs."""
    windows, found = Windows(WINDOW_S, INTERVAL_S, 2.0), []
    guess: Guess = ()
    poses = iter(zip(truth.poses.t, truth.poses.q, strict=True))
    pose = next(poses, None)
    for t, wrench in zip(load.t, load.wrench, strict=True):
        while pose is not None and pose[0] <= t:
            windows.add_pose(round(pose[0] * 1e9), tuple(pose[1].tolist()))
            pose = next(poses, None)
        window = windows.add_load(round(t * 1e9), tuple(wrench.tolist()))
        if window is None or window.end_ns - window.start_ns < 0.9e9 * WINDOW_S:
            continue
        begin = time.process_time()
        reply = answer(truth.nominal, window, guess, Requests(members, INTERVAL_S))
        found.append((time.process_time() - begin) / INTERVAL_S)
        guess = reply.following
    return found


@click.command()
@click.option("--members", default=256, show_default=True)
@click.option("--seed", default=25_000, show_default=True)
def main(members: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    click.echo(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores")
    for name in ("plain", "stochastic"):
        truth = draw(replace(GROUPS[name], load_step=1e-3, periods=_END_S / np.pi), seed)
        warm_up(truth.nominal)
        noisy = 0.01 * truth.load.wrench.std(axis=0) * rng.standard_normal(truth.load.wrench.shape)
        loads = {name: truth.load}
        if name == "plain":
            loads["plain, 1 % of noise"] = Load(truth.load.t, truth.load.wrench + noisy)
        for title, load in loads.items():
            answer_shares = ", ".join(f"{share:.2f}" for share in shares(truth, load, members))
            click.echo(f"{title}: {answer_shares} of a core")


if __name__ == "__main__":
    main()
