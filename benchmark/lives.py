"""Forecasts of synthetic lives: accuracy within 20 %, coverage of 80 % and 90 % intervals, CRPS, and horizon.

    python benchmark/lives.py --lives 8

The wear coefficient of each life is drawn from the prior, and the load has a gain that the forecast does not get. The
clearances are measured with noise at each visit. The true wear is computed with steps that are a quarter as long as the
steps of the forecast.

References
----------
Saxena et al. (2010), Int. J. Prognostics Health Management 1, 1: alpha-lambda accuracy and prognostic horizon.
Gneiting, Raftery (2007), J. Am. Stat. Assoc. 102, 359: CRPS.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from estimate import RESULTS, load_rows
from numpy.typing import NDArray

from plow_twin import Clearance, Scene, Wear, load_scene
from plow_twin.estimate import life, tuning
from plow_twin.estimate.coefficient import History, coefficient
from plow_twin.estimate.forecast import HOUR_S, Plan, forecast, with_clearances
from plow_twin.model.scene import Harmonic

Array = NDArray[np.float64]
#: 5 % and 95 % points of the prior [m^2/N]. The true coefficient is drawn from this prior.
PRIOR = (1e-15, 1e-14)
#: Growth of a clearance at which a life ends [m], standard deviation of an estimated clearance [m], number of visits in
#: a life, and shares of the life at which forecasts are made.
GROWTH, NOISE, VISITS, SHARES = 3e-3, 5e-5, 20, (0.3, 0.5, 0.7)
#: Quantiles at the ends of the central 80 % and 90 % intervals.
_INNER, _INNER_90 = (0.1, 0.9), (0.05, 0.95)
#: Largest relative error of a forecast that counts as right.
ALPHA = 0.2


def truth(rng: np.random.Generator) -> tuple[Scene, float, life.Path]:
    """Draw a machine. Return its scene, its wear coefficient and the path of its wear."""
    paper = load_scene("paper")
    gain = 1.0 + 0.05 * rng.standard_normal()
    loads = tuple(
        replace(load, force_n=(gain * load.force_n[0], gain * load.force_n[1])) if isinstance(load, Harmonic) else load
        for load in paper.loads
    )
    clearance = Clearance(*rng.uniform(0.020, 0.030, 2))
    nominal = replace(paper, clearance=clearance, wear=Wear(1e-15, 0.015, 2.0, prior_m2_n=PRIOR))
    low, high = np.log(PRIOR)
    true_coefficient = float(np.exp(rng.normal(0.5 * (low + high), (high - low) / 3.2897)))
    jump = tuning.JUMP
    tuning.JUMP = (jump[0] / 4.0, jump[1])
    try:
        path = life.wear_path(replace(nominal, loads=loads), limits(nominal), np.inf)
    finally:
        tuning.JUMP = jump
    return nominal, true_coefficient, path


def limits(scene: Scene) -> tuple[float, float]:
    """Return the clearances [m] at which a life ends."""
    return scene.clearance.horizontal_m + GROWTH, scene.clearance.vertical_m + GROWTH


def one_life(seed: int) -> list[dict[str, Any]]:
    """Forecast one life at each of the `SHARES`. Return a row for each forecast."""
    rng = np.random.default_rng([20261121, seed])
    scene, k_s, path = truth(rng)
    wear = scene.wear
    assert wear is not None
    growth = path.clearance_growth()
    end = min(float(np.interp(GROWTH, column, path.exposure, right=np.inf)) for column in growth.T)
    hours = end * wear.pad_area_m2 / (k_s * wear.travel_speed_m_s) / HOUR_S
    rows = []
    for share in SHARES:
        exposure = np.linspace(0.0, share * end, max(3, round(share * VISITS)))
        true = np.stack([np.interp(exposure, path.exposure, column) for column in growth.T], axis=1)
        start = np.array([scene.clearance.horizontal_m, scene.clearance.vertical_m])
        history = History(
            exposure * wear.pad_area_m2 / k_s,
            start + true + NOISE * rng.standard_normal(true.shape),
            np.full(true.shape, NOISE),
        )
        estimated = coefficient(scene, history)
        now = with_clearances(scene, float(estimated.clearance[0]), float(estimated.clearance[1]), estimated.depth)
        plan = Plan(*limits(scene), horizon_h=50.0 * hours, draws=2000, seed=seed)
        ordered = np.sort(
            forecast(now, plan, (float(estimated.deviation[0]), float(estimated.deviation[1])), estimated).hours
        )
        remaining = (1.0 - share) * hours
        median, low, high, low_90, high_90 = np.quantile(ordered, [0.5, *_INNER, *_INNER_90])
        spread = np.abs(ordered - ordered[rng.permutation(len(ordered))]).mean()
        rows.append(
            {
                "seed": seed, "share": share, "life_h": hours, "error": float(median / remaining - 1.0),
                "inside_80": bool(low <= remaining <= high), "width": float((high - low) / remaining),
                "inside_90": bool(low_90 <= remaining <= high_90), "width_90": float((high_90 - low_90) / remaining),
                "crps": float((np.abs(ordered - remaining).mean() - 0.5 * spread) / hours),
                "coefficient_ratio": float(estimated.interval().mean / k_s),
                "coefficient_p95_ratio": float(estimated.interval().p95 / k_s),
            }
        )  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> str:
    lines = [
        f"| share of the life | lives | within {100 * ALPHA:.0f} % | 80 % interval holds | its width / "
        "time left | 90 % interval holds | its width / time left | CRPS / life | coefficient within 1.3 |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for share in SHARES:
        own = [row for row in rows if row["share"] == share]
        right = np.mean([abs(row["error"]) <= ALPHA for row in own])
        near = np.mean([abs(np.log(row["coefficient_ratio"])) <= np.log(1.3) for row in own])
        held = [
            f"{100 * np.mean([row[f'inside_{inner}'] for row in own]):.0f} % | {np.mean([row[key] for row in own]):.2f}"
            for inner, key in ((80, "width"), (90, "width_90"))
        ]
        crps = np.mean([row["crps"] for row in own])
        lines.append(
            f"| {share:g} | {len(own)} | {100 * right:.0f} % | {' | '.join(held)} | {crps:.3f} | {100 * near:.0f} % |"
        )
    horizons = []
    for seed in {row["seed"] for row in rows}:
        wrong = [row["share"] for row in rows if row["seed"] == seed and abs(row["error"]) > ALPHA]
        horizons.append(next((share for share in SHARES if share > max(wrong, default=0.0)), np.nan))
    lines.append("")
    lines.append(f"Prognostic horizon (share of the life from which all stay within {ALPHA:g}), median: ")
    lines[-1] += f"{np.nanmedian(horizons):g}."
    return "\n".join(lines)


@click.command()
@click.option("--lives", default=20, show_default=True)
@click.option("--seed", default=1000, show_default=True, help="First seed.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "lives.jsonl", show_default=True)
def main(lives: int, seed: int, out: Path) -> None:
    rows = load_rows(out)
    for number in range(seed, seed + lives):
        if any(row["seed"] == number for row in rows):
            continue
        own = one_life(number)
        rows += own
        with out.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in own)
    click.echo(summary([row for row in rows if row["seed"] in range(seed, seed + lives)]))


if __name__ == "__main__":
    main()
