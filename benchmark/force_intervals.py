"""Coverage of the true peaks and impulses by the intervals of forces, and cost of 256 twins with samples at 1 kHz.

python benchmark/force_intervals.py --truths 6 --seed 7000
"""

from __future__ import annotations

import time
from dataclasses import replace

import click
import numpy as np
from estimate_truths import GROUPS, PERIOD, draw

from plow_twin import Table, Twin
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forces import ForceEnsemble


@click.command()
@click.option("--group", type=click.Choice(list(GROUPS)), default="plain", show_default=True)
@click.option("--truths", default=6, show_default=True)
@click.option("--seed", default=7000, show_default=True, help="First seed.")
@click.option("--members", default=256, show_default=True)
def main(group: str, truths: int, seed: int, members: int) -> None:
    for number in range(seed, seed + truths):
        truth = draw(GROUPS[group], number)
        result = estimate(truth.nominal, truth.load, truth.poses)
        true_load = truth.scene.loads[0]
        assert isinstance(true_load, Table)
        t = true_load.t
        nominal_load = np.stack([np.interp(t, truth.load.t, column) for column in truth.load.wrench.T], axis=1)
        ensemble = ForceEnsemble(truth.nominal, result, members)
        settled = int(np.searchsorted(t, PERIOD))
        ensemble.advance(t[:settled], nominal_load[:settled])
        begin = time.process_time()
        forces = ensemble.advance(t[settled:], nominal_load[settled:])
        share = (time.process_time() - begin) / (t[-1] - t[settled])
        run = Twin(replace(truth.scene, loads=()), excitation="sampled").advance_samples(t, true_load.wrench)
        held = []
        for true, interval in (
            (run.peak[settled:].max(axis=0), forces.peak),
            (run.impulse[settled:].sum(axis=0), forces.impulse),
        ):
            held.append(int(((interval[0] <= true) & (true <= interval[2])).sum()))
        force = run.force[settled:]
        acting = (forces.force[2] > 0.0) | (force > 0.0)
        inside = ((forces.force[0] <= force) & (force <= forces.force[2]))[acting].mean()
        click.echo(
            f"seed {number}: peaks {held[0]} and impulses {held[1]} of 8 held, forces held for {100 * inside:.0f} % of "
            f"the time that they may act, {share:.2f} of a core"
        )


if __name__ == "__main__":
    main()
