"""From the table's rows to the figures in `docs/benchmark.md`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from cases import Row
from work_precision import OURS, OURS_BARE, SECTION

LEVELS = (1e-2, 1e-3, 1e-6, 1e-9)
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

#: Groups of peers that are compared as one: the fastest member that reaches a level stands for the group.
GROUPS: dict[str, Callable[[str], bool]] = {
    "CVODE from C": lambda solver: solver.startswith("CVODE") and solver.endswith("(C)"),
    "CVODE from C, rootfinding": lambda solver: "rootfinding" in solver,
    "best from Python": lambda solver: "SciPy" in solver or "scikit-sundae" in solver,
    "best multibody engine": lambda solver: solver.startswith(("MuJoCo", "Exudyn")),
    "lean jitted RK4": lambda solver: solver.startswith("lean"),
    "our RK4": lambda solver: solver.startswith("plow_twin RK4"),
}


def fastest(
    rows: Sequence[Row], scene: str, output_s: float, level: float, member: Callable[[str], bool]
) -> Row | None:
    """Return the row of the fastest setting with an error of at most `level`."""
    reached = [
        row for row in rows
        if row.section == SECTION and row.scene == scene and row.output_s == output_s and row.status == "ok"
        and member(row.solver) and row.error is not None and row.error <= level
    ]  # fmt: skip
    return min(reached, key=_wall, default=None)


def _wall(row: Row) -> float:
    return row.wall_ms if row.wall_ms is not None else float("inf")


def text(rows: Sequence[Row], machine: str, versions: dict[str, str]) -> str:
    """Return everything measured as Markdown."""
    blocks = [
        f"Machine: `{machine}`; " + ", ".join(f"{name} {version}" for name, version in versions.items()) + ".",
        *_ratio_tables(rows), _random_table(rows), _ensemble_table(rows), _plain_tables(rows), _not_run(rows),
    ]  # fmt: skip
    return "\n\n".join(block for block in blocks if block)


def _ratio_tables(rows: Sequence[Row]) -> Iterator[str]:
    for scene in ("kv", "hc"):
        for output_s, words in ((0.1, "output each 0.1 s"), (1e-3, "output each 1 ms")):
            head = ["error at most", "ours", "ours, poses only", *GROUPS]
            lines = [
                f"**{scene.upper()}, 20 s, {words}**",
                "",
                "| " + " | ".join(head) + " |",
                "|" + "---|" * len(head),
            ]
            for level in LEVELS:
                lines.append("| " + " | ".join(_ratio_cells(rows, scene, output_s, level)) + " |")
            yield "\n".join(lines)


def _ratio_cells(rows: Sequence[Row], scene: str, output_s: float, level: float) -> Iterator[str]:
    own = fastest(rows, scene, output_s, level, lambda solver: solver == OURS)
    bare = fastest(rows, scene, output_s, level, lambda solver: solver == OURS_BARE)
    yield f"{level:g}"
    for row in (own, bare):
        yield "-" if row is None else f"{row.wall_ms:.2f} ms"
    for member in GROUPS.values():
        peer = fastest(rows, scene, output_s, level, member)
        if not any(row.scene == scene and row.output_s == output_s and member(row.solver) for row in rows):
            yield "1 ms only"
        elif peer is None or own is None or peer.wall_ms is None or own.wall_ms is None:
            yield "not reached"
        else:
            yield f"{peer.wall_ms:.4g} ms, **{peer.wall_ms / own.wall_ms:.1f}x**"


def _random_table(rows: Sequence[Row]) -> str:
    picked = [row for row in rows if row.section == "random_scenes"]
    if not picked:
        return ""
    lines = [
        "**Random scenes**",
        "",
        "| tolerance | amplification | scenes | median error / tol | worst | above 10 |",
        "|---|---|---|---|---|---|",
    ]
    for tol in dict.fromkeys(row.setting for row in picked):
        for low, high in ((0.0, 1e2), (1e2, 1e4), (1e4, np.inf)):
            some = [
                row
                for row in picked
                if row.setting == tol and row.status == "ok" and low <= (row.amplification or 0.0) < high
            ]
            values = np.array([row.value for row in some if row.value is not None])
            if values.size:
                figures = f"{values.size} | {np.median(values):.2g} | {values.max():.3g} | {(values > 10).sum()}"
                lines.append(f"| {tol} | {low:g} to {high:g} | {figures} |")
        for kind, words in (("chaotic", "no reference (chaotic)"), ("failed", "failed")):
            count = sum(row.setting == tol and row.status.startswith(kind) for row in picked)
            lines.append(f"| {tol} | {words} | {count} | | | |")
    worst = sorted((row for row in picked if row.status == "ok"), key=lambda row: -(row.value or 0.0))[:8]
    lines += [
        "",
        "The worst of those with a reference:",
        "",
        "| scene | tolerance | error / tol | amplification |",
        "|---|---|---|---|",
    ]
    lines += [f"| {row.scene} | {row.setting} | {row.value:.3g} | {row.amplification:.2g} |" for row in worst]
    return "\n".join(lines)


def _ensemble_table(rows: Sequence[Row]) -> str:
    picked = [row for row in rows if row.section == "ensemble" and row.wall_ms is not None]
    if not picked:
        return ""
    lines = [
        f"**Ensemble: {picked[0].scene}, 20 s**",
        "",
        "| solver | setting | s | worst error | members beyond 1e-4 |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.solver} | {row.setting} | {1e-3 * (row.wall_ms or 0.0):.2f} | {row.error:.2g} | {row.value:g} |"
        for row in picked
    ]
    return "\n".join(lines)


def _plain_tables(rows: Sequence[Row]) -> str:
    titles = {
        "stiffness": "Stiffness (tolerance 1e-6, error over the first 2 s against our own 1e-12)",
        "machine_time": "Machine time (tolerance 1e-6)",
        "contact_events": "Cost against contact events (tolerance 1e-6, 20 s)",
        "sampled_load": "Sampled load (tolerance 1e-6; the last column is times real time)",
    }
    blocks = []
    for section, title in titles.items():
        picked = [row for row in rows if row.section == section]
        if picked:
            lines = [
                f"**{title}**",
                "",
                "| scene | simulated s | ms | steps | events | error | status |",
                "|---|---|---|---|---|---|---|",
            ]
            lines += [_plain_line(row) for row in picked]
            blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _plain_line(row: Row) -> str:
    def cell(value: float | int | None, form: str) -> str:
        return "" if value is None else format(value, form)

    last = cell(row.value, ".0f") if row.value is not None else row.status
    cells = (
        row.scene, cell(row.simulated_s, "g"), cell(row.wall_ms, ".4g"), cell(row.steps, "d"), cell(row.events, "d"),
        cell(row.error, ".1e"), last,
    )  # fmt: skip
    return "| " + " | ".join(words.replace("|", "\\|") for words in cells) + " |"


def _not_run(rows: Sequence[Row]) -> str:
    problems = dict.fromkeys(
        f"- {row.solver} ({row.scene}): {row.status}" for row in rows if row.section == SECTION and row.status != "ok"
    )
    return "Not run or failed:\n\n" + "\n".join(problems) if problems else "Every peer was run."
