"""Errors of the twin that follows its machine: forces, peaks, impulses and clearances of synthetic truths.

    python benchmark/follow.py --group soft --group hard --truths 12 --seed 72000
    python benchmark/follow.py --table                       # table of the truths in the file

The errors are compared with those of the nominal twin. At each time, the result depends only on measurements up to this
time. All thresholds were set on seeds below 72000. Each result is written as soon as it is computed, and truths that
are in the file are skipped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # one thread, as in `Worker`

import click
import numpy as np
from estimate import completed
from estimate_truths import PERIOD, Group, Truth, draw
from numpy.typing import NDArray

from plow_twin import Scene, Table, simulate
from plow_twin.errors import SolverError
from plow_twin.estimate.estimate import warm_up
from plow_twin.estimate.follow import MEMBERS, Follower
from plow_twin.estimate.followed import Stretch, follow
from plow_twin.stream.outputs import clearances

Array = NDArray[np.float64]
RESULTS = Path(__file__).resolve().parent / "results" / "follow.jsonl"
GROUPS = {
    "soft": Group("K 3e6 .. 3e8", stiffness=(3e6, 3e8)),
    "hard": Group("K 1e9 .. 1e11", stiffness=(1e9, 1e11)),
    # machines of the following groups differ from the model
    "friction": Group("friction 0.1", friction=0.1),
    "law": Group("law: Kelvin-Voigt", law="kelvin_voigt"),
    "shape": Group("load: third harmonic of 10 %", third_harmonic=0.1),
}
# index of the first load period in which forces are compared, and least share of the largest impulse of a compared pair
FIRST_PERIOD, LEAST_SHARE = 4, 0.01
#: Interval [s] of the rows from which the true peaks and impulses are computed: a fifth of the duration of the shortest
#: contact.
_FINE = 1e-4


def run_one(name: str, seed: int, members: int, groups: Mapping[str, Group]) -> dict[str, Any]:
    try:
        truth = draw(groups[name], seed)
    except SolverError as error:  # the head has passed through a wall, which is impossible in a real machine
        return {"group": name, "seed": seed, "not_drawn": str(error)}
    load = Table("measured", truth.load.t, truth.load.wrench)
    true, nominal = (Motion(scene, truth) for scene in (truth.scene, replace(truth.nominal, loads=(load,))))
    warm_up(truth.nominal)
    Follower(truth.nominal, members).warm_up()
    begin = time.process_time()
    stretch = follow(truth.nominal, truth.load, truth.poses, members, span=PERIOD)
    cpu_s = time.process_time() - begin
    return {
        "group": name, "seed": seed, "stiffness": truth.scene.contact.stiffness,
        "estimates": len(stretch.taken_over), "cores": cpu_s / float(truth.load.t[-1]),
        **_forces(stretch, true, nominal), **_spans(stretch, true, nominal), **_clearance(stretch, true),
    }  # fmt: skip


class Motion:
    """Forces at the samples of the load, and peaks and impulses of each load period."""

    def __init__(self, scene: Scene, truth: Truth) -> None:
        end = float(truth.load.t[-1])
        run = simulate(scene, end, _FINE, 1e-6)
        every = round(float(truth.load.t[1]) / _FINE)
        self.force = run.force[::every]
        #: clearances [m] at the samples of the load, shape (n, 2)
        self.clearance = clearances(scene, _worn(scene, run.force)[::every])[..., :2]
        edges = np.searchsorted(run.t, PERIOD * np.arange(int(end / PERIOD) + 1))
        pieces = [run.force[first:last] for first, last in pairwise(edges.tolist())]
        self.peak = np.stack([piece.max(axis=0) for piece in pieces])
        self.impulse = np.stack([piece.sum(axis=0) * _FINE for piece in pieces])


def _worn(scene: Scene, force: Array) -> Array:
    """Return the wear depths [m] of the pads that the forces at intervals of `_FINE` cause, shape (n, 8)."""
    wear = scene.wear
    if wear is None:
        return np.zeros_like(force)
    speed = wear.coefficient_m2_n * wear.travel_speed_m_s / wear.pad_area_m2
    return np.asarray(wear.initial_depth_m) + speed * _FINE * np.cumsum(force, axis=0)


def _forces(stretch: Stretch, true: Motion, nominal: Motion) -> dict[str, float]:
    count = min(len(stretch.rows.t), len(true.force))
    rows, force = stretch.rows, true.force[:count]
    late = rows.t[:count] >= FIRST_PERIOD * PERIOD
    size = np.sqrt((force[late] ** 2).sum())
    inside = (rows.low[:count] <= force) & (force <= rows.high[:count])
    touching = force > 0.0
    width = (rows.high[:count] - rows.low[:count])[touching & late[:, None]]
    return {
        "rms": float(np.sqrt(((rows.force[:count] - force)[late] ** 2).sum()) / size),
        "rms_nominal": float(np.sqrt(((nominal.force[:count] - force)[late] ** 2).sum()) / size),
        "coverage": float(inside[touching].mean()),
        "coverage_late": float(inside[touching & late[:, None]].mean()),
        "width": float(np.median(width) / np.sqrt((force[touching] ** 2).mean())),
    }


def _spans(stretch: Stretch, true: Motion, nominal: Motion) -> dict[str, float]:
    out: dict[str, float] = {}
    for quantity in ("peak", "impulse"):
        truth, other = getattr(true, quantity), getattr(nominal, quantity)
        followed = np.stack([getattr(span, quantity) for span in stretch.spans])
        count = min(len(followed), len(truth))
        counts = true.impulse[:count] > LEAST_SHARE * true.impulse.max()
        counts[:FIRST_PERIOD] = False
        mean, low, high = followed[:count].transpose(1, 0, 2)
        error = np.abs(mean - truth[:count])[counts] / truth[:count][counts]
        inside = (low <= truth[:count]) & (truth[:count] <= high)
        out[quantity] = float(np.median(error))
        out[f"{quantity}_nominal"] = float(
            np.median(np.abs(other[:count] - truth[:count])[counts] / truth[:count][counts])
        )
        out[f"{quantity}_coverage"] = float(inside[counts].mean())
    return out


def _clearance(stretch: Stretch, true: Motion) -> dict[str, float]:
    rows, out = stretch.rows, {}
    count = min(len(rows.t), len(true.clearance))
    first = next((takeover.t for takeover in stretch.taken_over if takeover.taken), float(rows.t[-1]))
    for axis, name in enumerate(("horizontal", "vertical")):
        value, low, high = rows.clearance[:count, axis].T
        own = true.clearance[:count, axis]
        before = rows.t[:count] < first
        out[f"{name}_coverage"] = float(((low <= own) & (own <= high)).mean())
        out[f"{name}_before"] = float((low <= own)[before].mean()) if before.any() else float("nan")
        out[f"{name}_width_before_mm"] = 1e3 * float((high - low)[before][-1]) if before.any() else float("nan")
        out[f"{name}_width_mm"] = 1e3 * float((high - low)[-1])
        out[f"{name}_error_mm"] = 1e3 * float((value - own)[-1])
    return out


def as_markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of the page, with medians over the truths and means of the coverage."""
    lines = [
        "| group | truths | RMS error of the forces: nominal, followed | largest force a pair and period | "
        "impulse | "
        "coverage of forces in contact, peaks, impulses | clearance: coverage over all rows | cores |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, group in GROUPS.items():
        own = [row for row in rows if row["group"] == name and "not_drawn" not in row]
        if not own:
            continue

        def middle(key: str, own: list[dict[str, Any]] = own) -> str:
            return f"{100 * float(np.median([row[key] for row in own])):.1f} %"

        def mean(key: str, own: list[dict[str, Any]] = own) -> float:
            return float(np.nanmean([row[key] for row in own]))

        most = f"{100 * max(row['rms'] for row in own):.0f} %"
        clearance = 0.5 * (mean("horizontal_coverage") + mean("vertical_coverage"))
        lines.append(
            f"| {group.title} | {len(own)} | {middle('rms_nominal')}, {middle('rms')} (most {most}) | "
            f"{middle('peak_nominal')}, {middle('peak')} | {middle('impulse_nominal')}, {middle('impulse')} | "
            f"{mean('coverage_late'):.2f}, {mean('peak_coverage'):.2f}, {mean('impulse_coverage'):.2f} | "
            f"{clearance:.2f} | {mean('cores'):.2f} |"
        )
    return "\n".join(lines)


def command(
    own: dict[str, Group], results: Path, count: int, first: int, markdown: Callable[[Sequence[dict[str, Any]]], str]
) -> click.Command:
    """Return the command that judges truths of the groups `own`, by default `count` from the seed `first` on."""

    @click.command()
    @click.option("--group", "groups", multiple=True, type=click.Choice(list(own)))
    @click.option("--truths", default=count, show_default=True)
    @click.option("--seed", default=first, show_default=True, help="First seed.")
    @click.option("--members", default=MEMBERS, show_default=True)
    @click.option("--out", type=click.Path(path_type=Path), default=results, show_default=True)
    @click.option("--table", "alone", is_flag=True, help="Only print the table of the stored results.")
    def judge(groups: tuple[str, ...], truths: int, seed: int, members: int, out: Path, alone: bool) -> None:
        if not alone:
            warm_up(draw(Group("start", periods=1.0), 0).nominal)
        cases = ((name, seed + i) for i in range(0 if alone else truths) for name in groups or tuple(own))
        click.echo(markdown(completed(out, ("group", "seed"), cases, partial(run_one, members=members, groups=own))))

    return judge


main = command(GROUPS, RESULTS, 12, 72000, as_markdown)


if __name__ == "__main__":
    main()
