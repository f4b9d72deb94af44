"""Estimate of the wear coefficient after a simulated month: `python benchmark/month.py --truths 20`.

A head works for a month under a broad-band load. On some days, a sensor with noise, bias and delay measures its pose
over ten load periods. The load that the estimate gets has an error of 5 %. `estimate` estimates the clearances from
these data, and their growth gives the coefficient. The true wear is computed with a quarter of the step and means over
four times as many periods.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from estimate import RESULTS, completed
from estimate_truths import PERIOD, cutting
from numpy.typing import NDArray

from plow_twin import Clearance, Contact, Scene, Table, Wear, load_scene, simulate
from plow_twin.estimate import life, tuning
from plow_twin.estimate.answer import under_load
from plow_twin.estimate.coefficient import History, coefficient
from plow_twin.estimate.estimate import estimate
from plow_twin.estimate.forecast import with_estimate
from plow_twin.estimate.measurements import Load, Poses
from plow_twin.estimate.result import State
from plow_twin.model.loads import compile_loads
from plow_twin.stream.outputs import clearances

Array = NDArray[np.float64]
DAYS = np.linspace(0.0, 30.0, 7)
SPEED_M_S, PAD_AREA_M2 = 2.0, 0.06
#: 5 % and 95 % points of the prior [m^2/N]. The true coefficient is drawn from this prior.
PRIOR = (3e-16, 3e-15)
#: Largest factor between the estimated and the true coefficient that is acceptable.
FACTOR = 1.3
#: Sampling intervals [s] of the true load, of the given load and of the pose.
_FINE, _LOAD_STEP, _POSE_STEP = 1e-3, 2e-3, 1e-2
_SPAN = 10.0 * PERIOD
#: Standard deviations of the broad-band part of the load [N, N, N m], and of the noise of the sensor [m, m, rad].
_BROAD, _NOISE = np.array([8e3, 4e3, 1.1e4]), np.array([5e-4, 5e-4, 2e-3])


@dataclass(frozen=True, eq=False)
class Machine:
    """The assumed and the true values of a machine."""

    believed: Scene
    scene: Scene
    coefficient_m2_n: float
    gain: Array
    bias: Array
    delay_s: float


def machine(rng: np.random.Generator) -> Machine:
    low, high = np.log(PRIOR)
    true_coefficient = float(np.exp(rng.normal(0.5 * (low + high), (high - low) / 3.2897)))
    nominal = replace(load_scene("paper"), wear=Wear(1e-15, PAD_AREA_M2, SPEED_M_S, prior_m2_n=PRIOR))
    contact = Contact("hunt_crossley", float(np.exp(rng.uniform(*np.log([5e6, 3e7])))), damping=0.72)
    scene = replace(nominal, clearance=Clearance(*rng.uniform(0.018, 0.034, 2)), contact=contact)
    bias = 1e-3 * rng.standard_normal(3) * np.array([1.0, 1.0, 3.0])
    return Machine(nominal, scene, true_coefficient, 1.0 + 0.05 * rng.standard_normal(3), bias, 0.05 * rng.uniform())


def load_of(true_machine: Machine, rng: np.random.Generator, span: float) -> tuple[Array, Array]:
    """Return the times and samples of the load that the estimate gets."""
    t = np.arange(0.0, span + _FINE, _FINE)
    return t, compile_loads(true_machine.believed.loads).at(t) + cutting(rng, t) * _BROAD


def visit(true_machine: Machine, worn: Scene, rng: np.random.Generator) -> tuple[Load, Poses]:
    """Return the measurements of a worn machine: the load for the estimate, and the poses of the sensor."""
    t, wrench = load_of(true_machine, rng, _SPAN)
    motion = simulate(replace(worn, loads=(Table("cutting", t, wrench * true_machine.gain),)), _SPAN, _FINE, 1e-6)
    at = np.arange(0.0, _SPAN, _POSE_STEP)
    q = np.stack(
        [np.interp(np.maximum(at - true_machine.delay_s, 0.0), motion.t, column) for column in motion.q.T], axis=1
    )
    knots = np.arange(0.0, _SPAN + _LOAD_STEP, _LOAD_STEP)
    load, _ = Load.of(knots, np.stack([np.interp(knots, t, column) for column in wrench.T], axis=1))
    poses, _ = Poses.of(at, q + true_machine.bias + _NOISE * rng.standard_normal(q.shape))
    return load, poses


def one_month(seed: int, day_m: float) -> dict[str, Any]:
    """Estimate the clearances on each of the `DAYS`, and the wear coefficient, for a travel `day_m` [m] per day."""
    rng = np.random.default_rng([20261123, seed])
    true_machine = machine(rng)
    path = true_path(true_machine, rng, day_m)
    rows, under = [], true_machine.believed
    for day in DAYS:
        exposure = true_machine.coefficient_m2_n * day * day_m / PAD_AREA_M2
        depth = np.array([np.interp(exposure, path.exposure, pad) for pad in path.depth.T])
        worn = replace(
            true_machine.scene, wear=Wear(0.0, PAD_AREA_M2, SPEED_M_S, initial_depth_m=tuple(depth.tolist()))
        )
        load, poses = visit(true_machine, worn, rng)
        result = estimate(true_machine.believed, load, poses)
        if State.ESTIMATED is result.horizontal_state is result.vertical_state:
            estimates = [[value.mean, value.deviation] for value in result.in_scene_frame()]
            rows.append((float(day), estimates, clearances(worn, depth)[:2]))
            under = under_load(with_estimate(true_machine.believed, result.as_dict())[0], result, load)
    days, values, true = (np.array([row[i] for row in rows]) for i in range(3))
    history = History((days - days[0]) * day_m, values[:, :, 0], values[:, :, 1])
    estimated = coefficient(under, history)
    quantiles = [estimated.quantile(share) / true_machine.coefficient_m2_n for share in (0.05, 0.5, 0.9, 0.95)]
    error = (values[:, :, 0] - true) / values[:, :, 1]
    return {
        "seed": seed, "day_m": day_m, "coefficient_m2_n": true_machine.coefficient_m2_n,
        "grown_m": (true[-1] - true[0]).tolist(), "visits": len(rows),
        "rmse_m": float(np.sqrt(np.mean((values[:, :, 0] - true) ** 2))),
        "inside": float(np.mean(np.abs(error) <= 1.645)),
        **dict(zip(("p05_ratio", "p50_ratio", "p90_ratio", "p95_ratio"), quantiles, strict=True)),
    }  # fmt: skip


def true_path(true_machine: Machine, rng: np.random.Generator, day_m: float) -> life.Path:
    jump, periods = tuning.JUMP, tuning.MEAN_PERIODS
    tuning.JUMP, tuning.MEAN_PERIODS = (jump[0] / 4.0, jump[1]), (periods[0], 4 * periods[1])
    try:
        t, wrench = load_of(true_machine, rng, (sum(tuning.MEAN_PERIODS) + 1) * PERIOD)
        scene = replace(
            true_machine.scene,
            loads=(Table("cutting", t, wrench * true_machine.gain),),
            wear=true_machine.believed.wear,
        )
        most = true_machine.coefficient_m2_n * float(DAYS[-1]) * day_m / PAD_AREA_M2
        return life.wear_path(scene, (np.inf, np.inf), most)
    finally:
        tuning.JUMP, tuning.MEAN_PERIODS = jump, periods


def summary(rows: list[dict[str, Any]]) -> str:
    ratio = np.array([[row[key] for key in ("p05_ratio", "p50_ratio", "p90_ratio", "p95_ratio")] for row in rows])
    near = (np.abs(np.log(ratio)) <= np.log(FACTOR)).sum(axis=0)
    held = int(((ratio[:, 0] <= 1.0) & (ratio[:, 3] >= 1.0)).sum())
    growth = 1e3 * np.array([row["grown_m"] for row in rows]).mean(axis=1)
    used, ends = sum(row["visits"] for row in rows), np.median(ratio, axis=0)
    return "\n".join([
        f"| months | growth [mm] | visits used | P50 within a factor {FACTOR} | P90 | 90 % interval contains truth | "
        "P05 and P95 over truth, median |",
        "|---|---|---|---|---|---|---|",
        f"| {len(rows)} | {growth.min():.2f} to {growth.max():.2f} | {used} of {len(rows) * len(DAYS)} | {near[1]} | "
        f"{near[2]} | {held} | {ends[0]:.2f}, {ends[3]:.2f} |",
    ])  # fmt: skip


@click.command()
@click.option("--truths", default=12, show_default=True)
@click.option("--seed", default=100, show_default=True, help="First seed.")
@click.option("--day-km", default=75.0, show_default=True, help="Travel along the face in a day: 300 passes of 250 m.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "month.jsonl", show_default=True)
def main(truths: int, seed: int, day_km: float, out: Path) -> None:
    cases = [(number, 1e3 * day_km) for number in range(seed, seed + truths)]
    rows = completed(out, ("seed", "day_m"), cases, one_month)
    click.echo(summary([row for row in rows if (row["seed"], row["day_m"]) in cases]))


if __name__ == "__main__":
    main()
