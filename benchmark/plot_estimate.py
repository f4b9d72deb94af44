"""The picture of the estimate's results in `benchmark/results`: `python benchmark/plot_estimate.py`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from estimate import RESULTS, load_rows
from estimate_truths import GROUPS
from lives import SHARES

from plow_twin.estimate.result import NORMAL_P95, State

STYLES = {
    "plain": "#1f4e9c", "sensor": "#5aae61", "stochastic": "#dfa526", "middle": "#8c510a", "firm": "#35978f",
    "hard": "#d62728", "hard_sensor": "#9970ab",
}  # fmt: skip
#: First seed that was not used for tuning.
_FRESH = 50_000
_MOST_MM = 0.5


def draw(rows: Sequence[dict[str, Any]], lives: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the errors with intervals against the stiffness, the coverage of intervals, and the forecasts of lives."""
    figure, panels = plt.subplots(2, 2, figsize=(12.5, 8.2), layout="constrained")
    for panel, axis, name in zip(panels[0], "hv", ("horizontal", "vertical"), strict=True):
        for group, color in STYLES.items():
            _draw_errors(panel, [row for row in rows if row["group"] == group], axis, color, GROUPS[group].title)
        panel.set(xscale="log", ylim=(-_MOST_MM, _MOST_MM), xlabel="true contact stiffness [N/m]")
        panel.set_title(f"{name} clearance: error and 90 % interval [mm]")
        panel.axhline(0.0, color="0.4", linewidth=0.8)
    _draw_coverage(panels[1][0], rows)
    _draw_lives(panels[1][1], lives)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def fresh(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the newest row of each truth that was not used for tuning."""
    newest = {(row["group"], row["seed"]): row for row in rows if row["seed"] >= _FRESH and "not_drawn" not in row}
    return list(newest.values())


def _draw_errors(panel: Any, rows: Sequence[dict[str, Any]], axis: str, color: str, title: str) -> None:
    estimated = [row for row in rows if row[f"{axis}_state"] == State.ESTIMATED.value]
    stiffness = [row["stiffness"] for row in estimated]
    errors = np.array([1e3 * row[f"{axis}_error_m"] for row in estimated])
    bars = np.array([1e3 * NORMAL_P95 * row[f"{axis}_sd_m"] for row in estimated])
    panel.errorbar(stiffness, errors, bars, fmt=".", color=color, label=title, linewidth=0.8, markersize=4)
    unknown = [row["stiffness"] for row in rows if row[f"{axis}_state"] != State.ESTIMATED.value]
    # a truth without an estimate is marked at the lower edge
    panel.plot(unknown, [-0.98 * _MOST_MM] * len(unknown), "|", color=color, markersize=9)


def _draw_coverage(panel: Any, rows: Sequence[dict[str, Any]]) -> None:
    levels_drawn = np.linspace(0.02, 0.98, 49)
    for group, color in STYLES.items():
        errors = [
            abs(row[f"{axis}_error_m"]) / row[f"{axis}_sd_m"]
            for row in rows for axis in "hv"
            if row["group"] == group and row[f"{axis}_state"] == State.ESTIMATED.value
        ]  # fmt: skip
        levels = [math.erf(error / math.sqrt(2.0)) for error in errors]
        held = [np.mean(np.array(levels) <= level) for level in levels_drawn] if levels else []
        panel.plot(100.0 * levels_drawn[: len(held)], 100.0 * np.array(held), color=color)
    panel.plot([0, 100], [0, 100], color="0.4", linewidth=0.8)
    panel.set(xlabel="level of the interval [%]", xlim=(0, 100), ylim=(0, 100))
    panel.set_title("intervals that hold the true clearance [%]")


def _draw_lives(panel: Any, lives: Sequence[dict[str, Any]]) -> None:
    for place, share in enumerate(SHARES):
        errors = sorted(100.0 * row["error"] for row in lives if row["share"] == share)
        panel.plot(np.linspace(place - 0.3, place + 0.3, len(errors)), errors, ".", color="#1f4e9c")
    panel.axhspan(-20.0, 20.0, color="0.92", zorder=0)
    panel.set_xticks(range(len(SHARES)), [f"at {share:g} of the life" for share in SHARES])
    panel.set_title("time to the limit: error of the median forecast [%], one point a life")


def main() -> None:
    path = RESULTS.parent.parent / "docs" / "images" / "estimate.png"
    draw(fresh(load_rows(RESULTS / "estimate.jsonl")), load_rows(RESULTS / "lives.jsonl"), path)


if __name__ == "__main__":
    main()
