"""Tables of the pages about the estimate, from `benchmark/results/estimate.jsonl`.

`TRUTHS` contains the seeds that were not used to set thresholds. Only these truths are counted on the pages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from estimate import RESULTS, load_rows, summary
from estimate_mismatch import KINDS
from estimate_mismatch import summary as of_kind
from estimate_truths import GROUPS
from scipy.stats import beta

from plow_twin.estimate.result import NORMAL_P95, State

#: Seeds of each group, in the order of the page: pairs of a first seed and a number of truths.
TRUTHS: dict[str, tuple[tuple[int, int], ...]] = {
    "plain": ((54000, 50),),
    "sensor": ((54000, 50),),
    "stochastic": ((52000, 60),),
    "middle": ((54000, 8), (56100, 16), (61000, 16), (64000, 15)),
    "firm": ((64000, 35),),
    "hard": ((50000, 23), (54000, 10), (60000, 30), (63000, 20)),
    "hard_sensor": ((50000, 23), (54000, 10)),
    "noisy": ((54000, 8),),
    "slow": ((52000, 8),),
    "kelvin_voigt": ((57000, 16),),
    "exponent": ((54000, 4), (57000, 8)),
    "shape": ((54000, 4), (57000, 8)),
    "scale": ((54000, 4),),
    "jam": ((54000, 4),),
    "shift": ((54000, 4),),
    "stuck": ((54000, 4),),
    "noisier": ((54000, 4),),
    "hard_shape": ((50000, 6),),
    **dict.fromkeys(("mirrored_theta", "mirrored_x", "mirrored_y", "swapped"), ((710000, 4),)),
    **dict.fromkeys(("hard_mirrored_theta", "hard_mirrored_y", "hard_swapped"), ((710000, 4),)),
    "hard_kelvin_voigt": ((50000, 23), (54000, 10), (60000, 30)),
}
#: First seed and number of the truths of `plain` and `sensor` that were computed by the current version of the code.
PRESENT = (54001, 8)
#: Target of each group for the RMSE of the clearances [mm].
ASKED = {"plain": 0.05, "sensor": 0.06, "stochastic": 0.06, "middle": 0.05, "firm": 0.05, "hard": 0.1}
_LEVEL = 0.95


def truths(group: str, seeds: Sequence[tuple[int, int]]) -> list[dict[str, Any]]:
    """Return the newest row of each truth in a group."""
    chosen_seeds = {seed for first, count in seeds for seed in range(first, first + count)}
    rows = load_rows(RESULTS / "estimate.jsonl")
    newest = {row["seed"]: row for row in rows if row["group"] == group and row["seed"] in chosen_seeds}
    return [row for row in newest.values() if "not_drawn" not in row]


def right_models() -> str:
    """Return the table of errors and coverage for the truths to which the model applies."""
    lines = [
        "| group | truths | RMSE gx, gy [mm] | target | estimated gx, gy | 90 % interval contains gx | gy | "
        "median width [mm] | flagged | range of motion [mm] | CPU [s], most |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    flagged = total = 0
    for group, seeds in TRUTHS.items():
        if (GROUPS[group].model, GROUPS[group].sensor) != ("ok", "ok"):
            continue
        rows = truths(group, seeds)
        figures, target = summary(group, rows), ASKED.get(group)
        flagged, total = flagged + sum(map(_flagged, rows)), total + len(rows)
        estimated = [[row for row in rows if row[f"{axis}_state"] == State.ESTIMATED.value] for axis in "hv"]
        held = [
            coverage([bool(row[f"{axis}_inside"]) for row in own]) for axis, own in zip("hv", estimated, strict=True)
        ]
        lines.append(
            f"| {GROUPS[group].title} | {len(rows)} | {figures['h_rmse_mm']:.3f}, {figures['v_rmse_mm']:.3f} | "
            f"{'' if target is None else target} | {len(estimated[0])}, {len(estimated[1])} | {held[0]} | {held[1]} | "
            f"{figures['h_width_mm']:.2f}, {figures['v_width_mm']:.2f} | {sum(map(_flagged, rows))} | "
            f"{figures['h_range_rmse_mm']:.1f}, {figures['v_range_rmse_mm']:.1f} | "
            f"{figures['cpu_s']:.1f}, {figures['cpu_s_most']:.1f} |"
        )
    share = f"{flagged / total:.1%}"
    lines += ["", f"Of {total} truths with the correct model, {flagged} are flagged as suspect ({share})."]
    return "\n".join(lines)


def narrowed(text: str, keep: Sequence[int]) -> list[list[str]]:
    """Return the given columns of a Markdown table as cells, beginning with the header, without bounds in brackets."""
    lines = [line for line in text.splitlines() if line.startswith("| ") and "---" not in line]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [[row[column].partition(" (")[0] for column in keep] for row in rows]


def right_sum() -> str:
    """Return the short table of all groups with an error target, and the number of truths that are flagged."""
    text = right_models()
    head, *rows = narrowed(text, (0, 1, 2, 3, 5, 6))
    lines = ["| " + " | ".join(row) + " |" for row in (head, *(row for row in rows if row[3]))]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:], "", text.splitlines()[-1]])


def right_now() -> str:
    """Return a sentence about the truths that were computed by the current version of the code."""
    rows = [row for group in ("plain", "sensor") for row in truths(group, [PRESENT])]
    error, deviation, inside = (
        np.array([row[f"{axis}_{key}"] for row in rows for axis in "hv"]) for key in ("error_m", "sd_m", "inside")
    )
    return (
        f"By the present code, {len(error)} clearances of the first two groups have an RMS error of "
        f"{1e3 * np.sqrt(np.mean(error**2)):.3f} mm and a median width of "
        f"{2e3 * NORMAL_P95 * np.median(deviation):.2f} mm; {inside.sum()} intervals contain the truth."
    )


def wrong_models() -> str:
    """Return the table of the shares of truths that are flagged, by deviation from the model."""
    lines = ["| deviation of the truth from the model | truths | flagged | share, 95 % interval |", "|---|---|---|---|"]
    for group, seeds in TRUTHS.items():
        if (GROUPS[group].model, GROUPS[group].sensor) != ("ok", "ok"):
            rows = truths(group, seeds)
            flagged = [_flagged(row) for row in rows]
            lines.append(f"| {GROUPS[group].title} | {len(rows)} | {sum(flagged)} | {coverage(flagged)} |")
    return "\n".join(lines)


def wrong_sum() -> str:
    """Return a sentence about the truths outside the model that are flagged, for soft and for hard contacts."""
    names = [name for name in TRUTHS if (GROUPS[name].model, GROUPS[name].sensor) != ("ok", "ok")]
    hard = "hard_kelvin_voigt"
    soft = [_flagged(row) for name in names if name != hard for row in truths(name, TRUTHS[name])]
    other = [_flagged(row) for row in truths(hard, TRUTHS[hard])]
    return (
        f"Of {len(soft)} truths with a wrong law, load or sensor, {sum(soft)} were flagged; of {len(other)} with the "
        f"wrong law and hard contacts, {sum(other)}."
    )


def _flagged(row: dict[str, Any]) -> bool:
    return "suspect" in (row["model"], row["sensor"])


def coverage(held: Sequence[bool]) -> str:
    """Return a share with its Clopper-Pearson interval."""
    count, total = sum(held), len(held)
    if not total:
        return "-"
    tail = (1.0 - _LEVEL) / 2.0
    low = float(beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, total - count)) if count < total else 1.0
    return f"{count / total:.2f} ({low:.2f} to {high:.2f})"


#: Kinds of machines with hard contacts whose difference from the scene is hidden by the geometry.
HIDDEN = ("hard_corners", "hard_askew", "hard_theta")


def _mismatch_row(title: str, rows: Sequence[dict[str, Any]]) -> str:
    row = of_kind(rows)
    numbers = f"{row['rmse_mm']:.2f} | {row['coverage']:.2f} | {row['width_mm']:.2f} | {row['far_off']:.2f}"
    return (
        f"| {title} | {row['clearances']} | {row['published']:.2f} | "
        f"{row['useful']:.2f} | {numbers.replace('nan', '-') if row['published'] else '- | - | - | -'} |"
    )


def mismatch() -> str:
    """Return the table of estimates for machines that differ from the model."""
    now = load_rows(RESULTS / "estimate_mismatch.jsonl")
    lines = [
        "| what differs | clearances | share published | interval below 4 mm | RMSE [mm] | "
        "90 % interval contains truth | median width [mm] | error beyond 3 deviations |",
        "|---|---|---|---|---|---|---|---|",
        _mismatch_row("all", now),
    ]
    by_kind = ((name, [row for row in now if row["kind"] == name]) for name in KINDS)
    return "\n".join([*lines, *(_mismatch_row(KINDS[name].title, rows) for name, rows in by_kind if rows)])


def mismatch_sum() -> str:
    """Return three rows of machines: all, without a difference, and with hidden differences; and kinds by coverage."""
    head, line, every, nothing, *rows = mismatch().splitlines()
    hidden = [row for row in load_rows(RESULTS / "estimate_mismatch.jsonl") if row["kind"] in HIDDEN]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in (nothing, *rows)]
    kinds = Counter(cell[5] for cell in cells if cell[5] != "-")
    counts = ", ".join(f"{coverage} for {count}" for coverage, count in sorted(kinds.items()))
    most = max(int(cell[1]) for cell in cells)
    shown = [head, line, every, nothing, _mismatch_row("hard contacts; corners, pads or scale of theta", hidden)]
    return "\n".join([*shown, "", f"Kinds with up to {most} clearances each, by their coverage: {counts}."])


def filter_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of errors and coverage of the two filters, by group."""
    lines = ["| group | filter | truths | RMSE gx, gy [mm] | coverage gx, gy | CPU [s] |", "|---|---|---|---|---|---|"]
    for name, method in dict.fromkeys((row["group"], row["method"]) for row in rows):
        own = [row for row in rows if (row["group"], row["method"]) == (name, method) and "failed" not in row]
        errors = np.array([[row["h_error_m"], row["v_error_m"]] for row in own]).reshape(-1, 2)
        rmse = 1e3 * np.sqrt((errors**2).mean(axis=0))
        inside = np.mean([[row["h_inside"], row["v_inside"]] for row in own], axis=0)
        cpu_s = np.mean([row["cpu_s"] for row in own])
        lines.append(
            f"| {GROUPS[name].title} | {method.upper()} | {len(own)} | {rmse[0]:.3f}, {rmse[1]:.3f} | "
            f"{inside[0]:.2f}, {inside[1]:.2f} | {cpu_s:.1f} |"
        )
    return "\n".join(lines)


def filters() -> str:
    return filter_table(load_rows(RESULTS / "filter_peers.jsonl"))


FIGURES: dict[str, Callable[[], str]] = {
    "right_models": right_models, "right_sum": right_sum, "right_now": right_now, "wrong_models": wrong_models,
    "wrong_sum": wrong_sum, "mismatch": mismatch, "mismatch_sum": mismatch_sum, "filters": filters,
}  # fmt: skip
