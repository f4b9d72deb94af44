"""The picture of run time against error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from cases import Row
from matplotlib.ticker import LogLocator, NullFormatter
from work_precision import OURS, SECTION

STYLES: dict[str, tuple[str, str]] = {
    OURS: ("#d62728", "o"),
    "heyoka (Taylor, events)": ("#111111", "*"),
    "DOP853 (numba, events located)": ("#6a3d9a", "d"),
    "lean RK4 (numba)": ("#7f7f7f", "v"),
    "CVODE Adams (C)": ("#1f4e9c", "s"),
    "CVODE Adams (C, rootfinding)": ("#4a90d9", "D"),
    "CVODE BDF (C)": ("#7fb8e6", "s"),
    "LSODA (SciPy odeint)": ("#1b7837", "^"),
    "CVODE Adams (scikit-sundae)": ("#5aae61", "p"),
    "DOP853 (SciPy solve_ivp)": ("#9970ab", "P"),
    "Radau (SciPy solve_ivp)": ("#c2a5cf", "X"),
    "MuJoCo Euler": ("#bf812d", "<"),
    "MuJoCo RK4": ("#8c510a", ">"),
    "Exudyn RK44": ("#dfa526", "h"),
}
#: Engines that have only dense rows, 1 ms apart. They are drawn together with the sparse rows of the other solvers.
_DENSE_ONLY = ("MuJoCo", "Exudyn")


def draw(rows: Sequence[Row], path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(12.5, 5.6), sharey=True, layout="constrained")
    titles = {"kv": "Kelvin-Voigt, F = max(0, K d + C d')", "hc": "Hunt-Crossley, F = max(0, K d$^{1.5}$ (1 + λ d'))"}
    for panel, (scene, title) in zip(panels, titles.items(), strict=True):
        for solver, (colour, marker) in STYLES.items():
            _draw_solver(panel, rows, scene, solver, colour, marker)
        _dress(panel, title)
    panels[0].set_ylabel("largest error of the pose / clearance")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_solver(panel: Any, rows: Sequence[Row], scene: str, solver: str, colour: str, marker: str) -> None:
    output_s = 1e-3 if solver.startswith(_DENSE_ONLY) else 0.1
    picked = [
        (row.wall_ms, row.error)
        for row in rows
        if row.section == SECTION and row.scene == scene and row.solver == solver and row.output_s == output_s
        and row.wall_ms is not None and row.error is not None and 0.0 < row.error < 0.5
    ]  # fmt: skip
    if picked or scene == "kv":
        times, errors = zip(*picked, strict=True) if picked else ((), ())
        own = solver == OURS
        panel.plot(
            times, errors, marker=marker, color=colour, label=solver, markersize=7 if own else 5,
            linewidth=2.6 if own else 1.3, zorder=3 if own else 2,
        )  # fmt: skip


def _dress(panel: Any, title: str) -> None:
    panel.set(xscale="log", yscale="log", title=title, xlabel="run time of 20 s in ms, one core")
    panel.set_ylim(1e-14, 1.0)
    panel.yaxis.set_major_locator(LogLocator(10.0, numticks=20))
    panel.yaxis.set_minor_formatter(NullFormatter())
    panel.grid(True, which="major", color="0.87", linewidth=0.8)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
