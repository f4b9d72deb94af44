"""Errors, coverage, interval widths and flags of the estimate for synthetic truths that were not used for tuning.

The errors are compared with the errors of the range of motion, the simplest estimate of a clearance.

    python benchmark/estimate.py --truths 50 --seed 5000          # all groups
    python benchmark/estimate.py --group plain --group hard --truths 20

Each result is written as soon as it is computed, and truths that are in the file are skipped. A long benchmark can thus
be stopped and continued. The thresholds of `plow_twin/estimate/tuning.py` were set with other seeds. `tools/pages.py`
makes the tables of the pages from the seeds in `estimate_pages.TRUTHS`.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # one thread, as in `Worker`

import click
import numpy as np
from estimate_truths import GROUPS, draw

from plow_twin.errors import SolverError
from plow_twin.estimate.estimate import estimate, warm_up
from plow_twin.estimate.result import NORMAL_P95, State
from plow_twin.estimate.start import range_of_motion

RESULTS = Path(__file__).resolve().parent / "results"


def run_one(name: str, seed: int, periods: float | None = None) -> dict[str, Any]:
    group = GROUPS[name]
    try:
        truth = draw(group if periods is None else type(group)(**{**vars(group), "periods": periods}), seed)
    except SolverError as error:  # the head has passed through a wall, which is impossible in a real machine
        return {"group": name, "seed": seed, "not_drawn": str(error)}
    begin = time.process_time()
    result = estimate(truth.nominal, truth.load, truth.poses, forces=truth.forces)
    cpu_s = time.process_time() - begin
    simple, _ = range_of_motion(truth.nominal, truth.poses)
    row: dict[str, Any] = {
        "group": name, "seed": seed, "stiffness": truth.scene.contact.stiffness, "model": result.model,
        "stiffness_mean": result.stiffness.mean, "stiffness_p05": result.stiffness.p05,
        "stiffness_p95": result.stiffness.p95,
        "sensor": result.sensor, "cpu_s": cpu_s, "work": result.figures.get("work", 0.0),
    }  # fmt: skip
    for index, (axis, value, state) in enumerate(
        (("h", result.horizontal, result.horizontal_state), ("v", result.vertical, result.vertical_state))
    ):
        true = float(truth.clearance[index])
        row |= {
            f"{axis}_error_m": value.mean - true,
            f"{axis}_sd_m": (value.p95 - value.p05) / (2.0 * NORMAL_P95),
            f"{axis}_inside": int(value.p05 <= true <= value.p95),
            f"{axis}_state": state.value,
            f"{axis}_range_error_m": float(simple[index]) - true,
        }
    row |= {f"figure_{key}": value for key, value in result.figures.items()}
    row["reasons"] = "; ".join(result.reasons)
    return row


def summary(name: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a group. Withdrawn estimates are not used for errors and coverage."""
    out: dict[str, Any] = {"group": name, "truths": len(rows)}
    expected = GROUPS[name]
    out["as_expected"] = np.mean([(row["model"], row["sensor"]) == (expected.model, expected.sensor) for row in rows])
    out["withdrawn"] = np.mean([row["h_state"] == State.WITHDRAWN.value for row in rows])
    for axis in ("h", "v"):
        estimated = [row for row in rows if row[f"{axis}_state"] == State.ESTIMATED.value]
        errors = np.array([row[f"{axis}_error_m"] for row in estimated])
        out[f"{axis}_rmse_mm"] = 1e3 * float(np.sqrt(np.mean(errors**2))) if len(estimated) else float("nan")
        out[f"{axis}_coverage"] = (
            float(np.mean([row[f"{axis}_inside"] for row in estimated])) if estimated else float("nan")
        )
        widths = [2.0 * NORMAL_P95 * row[f"{axis}_sd_m"] for row in estimated]
        out[f"{axis}_width_mm"] = 1e3 * float(np.median(widths)) if estimated else float("nan")
        simple = np.array([row[f"{axis}_range_error_m"] for row in rows])
        out[f"{axis}_range_rmse_mm"] = 1e3 * float(np.sqrt(np.mean(simple**2)))
    estimated = [row for row in rows if row["h_state"] == State.ESTIMATED.value and "stiffness_mean" in row]
    ratios = np.array([row["stiffness_mean"] / row["stiffness"] for row in estimated])
    out["k_rmse"] = float(np.sqrt(np.mean((ratios - 1.0) ** 2))) if estimated else float("nan")
    inside = [row["stiffness_p05"] <= row["stiffness"] <= row["stiffness_p95"] for row in estimated]
    out["k_coverage"] = float(np.mean(inside)) if estimated else float("nan")
    widths = [(row["stiffness_p95"] - row["stiffness_p05"]) / row["stiffness"] for row in estimated]
    out["k_width"] = float(np.median(widths)) if estimated else float("nan")
    out["cpu_s"] = float(np.mean([row["cpu_s"] for row in rows]))
    out["cpu_s_most"] = float(np.max([row["cpu_s"] for row in rows]))
    return out


def as_markdown(groups: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| group | truths | RMSE gx, gy [mm] | coverage gx, gy | median width [mm] | flagged as it should be | "
        "range of motion [mm] | CPU [s] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in groups:
        lines.append(
            f"| {GROUPS[row['group']].title} | {row['truths']} | {row['h_rmse_mm']:.3f}, {row['v_rmse_mm']:.3f} | "
            f"{row['h_coverage']:.2f}, {row['v_coverage']:.2f} | {row['h_width_mm']:.2f}, {row['v_width_mm']:.2f} | "
            f"{100 * row['as_expected']:.0f} % | {row['h_range_rmse_mm']:.1f}, {row['v_range_rmse_mm']:.1f} | "
            f"{row['cpu_s']:.1f} (most {row['cpu_s_most']:.1f}) |"
        )
    lines += ["", "| group | stiffness: RMSE | coverage | median width |", "|---|---|---|---|"]
    for group in groups:
        title, widths = GROUPS[group["group"]].title, (group["k_rmse"], group["k_width"])
        rmse, width = (f"{100 * value:.3f} %" for value in widths)
        lines.append(f"| {title} | {rmse} | {group['k_coverage']:.2f} | {width} |")
    return "\n".join(lines).replace("nan, nan", "-")


def load_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a JSON lines file, or an empty list if the file does not exist."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def completed(
    path: Path, keys: Sequence[str], cases: Iterable[tuple[Any, ...]], run: Callable[..., dict[str, Any]]
) -> list[dict[str, Any]]:
    """Run the cases that a JSON lines file lacks, append each row as soon as it is computed, and return all rows.

    A case contains the arguments of `run`, which are the values of its row at `keys`.
    """
    rows = load_rows(path)
    done = {tuple(row[key] for key in keys) for row in rows}
    for case in cases:
        if case not in done:
            rows.append(run(*case))
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    return rows


@click.command()
@click.option("--group", "groups", multiple=True, type=click.Choice(list(GROUPS)))
@click.option("--truths", default=50, show_default=True)
@click.option("--seed", default=5000, show_default=True, help="First seed.")
@click.option("--periods", type=float, help="Number of load periods. The default is that of the group.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "estimate.jsonl", show_default=True)
def main(groups: tuple[str, ...], truths: int, seed: int, periods: float | None, out: Path) -> None:
    warm_up(draw(type(GROUPS["plain"])("start", periods=1.0), 0).nominal)
    names = groups or tuple(GROUPS)
    seeds = range(seed, seed + truths)
    # the groups alternate, so that a run that is stopped early has groups of equal size
    cases = ((name, number) for number in seeds for name in names)
    rows = completed(out, ("group", "seed"), cases, partial(run_one, periods=periods))
    chosen_rows = [row for row in rows if row["seed"] in seeds and "not_drawn" not in row]
    click.echo(as_markdown([summary(name, [row for row in chosen_rows if row["group"] == name]) for name in names]))


if __name__ == "__main__":
    main()
