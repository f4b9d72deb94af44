"""Measure run time against error of this solver and its peers. Write the table, the picture and the pages' figures.

`make bench` is one run. Rows are measured on one core unless they state otherwise.
"""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import click
import cvode
import ensemble_rows
import levels
import live_rows
import random_rows
import summary
import work_precision
import workloads
from bench_scenes import NAMES, ROOT
from cases import Case, Row, machine_name, measure, write_csv
from native import NotInstalled
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

RESULTS = Path(__file__).resolve().parent / "results"
PICTURE = ROOT / "docs" / "images" / "work_precision.png"
PEERS: dict[str, Callable[[str], Iterator[Case]]] = {
    "own": work_precision.own_cases,
    "lean": work_precision.lean_cases,
    "cvode": work_precision.cvode_cases,
    "python": work_precision.python_cases,
    "heyoka": work_precision.heyoka_cases,
    "dop853": work_precision.located_cases,
    "multibody": work_precision.multibody_cases,
}
SECTIONS = (
    *PEERS, "ensemble", "stiffness", "machine_time", "contact_events", "features", "sampled_load", "start",
    "random_scenes",
)  # fmt: skip
_QUICK = ("own", "ensemble", "stiffness", "machine_time", "contact_events", "random_scenes")
Notify = Callable[[str], None]
Fill = Callable[[Sequence[Row]], None]


@click.command()
@click.option("--quick", is_flag=True, help="For tests: run few cases of our solver once, without picture and pages.")
@click.option("--only", multiple=True, type=click.Choice(SECTIONS), help="Measure only this part. May be repeated.")
@click.option(
    "--repeats", default=5, show_default=True, type=click.IntRange(1), help="Number of rounds over all cases."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="CSV file. The default is benchmark/results/<machine>.csv.",
)
@click.option("--summary", "page", type=click.Path(path_type=Path, dir_okay=False), help="Markdown file of the tables.")
def main(quick: bool, only: tuple[str, ...], repeats: int, out: Path | None, page: Path | None) -> None:
    complete = not quick and not only
    if out is None and not complete:
        raise click.UsageError("a part is not the committed table: name a file with --out")
    console = Console(stderr=True)
    chosen = set(only) or (set(_QUICK) if quick else set(SECTIONS))
    columns = SpinnerColumn(), TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=None)

        def notify(text: str) -> None:
            progress.update(task, advance=1, description=text)

        rows = _run(chosen, 1 if quick else repeats, quick, notify)
    path = out or RESULTS / f"{machine_name()}.csv"
    write_csv(path, rows)
    measured = summary.text(rows, machine_name(), _versions())
    if page is not None:
        page.write_text(measured + "\n", encoding="utf-8")
    if out is None:
        _publish(rows, measured)
    click.echo(str(path))


def _run(chosen: set[str], repeats: int, quick: bool, notify: Notify) -> list[Row]:
    rows: list[Row] = []
    if quick:
        rows += measure(list(work_precision.quick_cases()) if "own" in chosen else [], 1, notify)
    else:
        for scene in NAMES:
            cases = [case for name, build in PEERS.items() if name in chosen for case in build(scene)]
            rows += measure(cases, repeats, notify, levels.contenders)
            if "multibody" in chosen:
                rows += work_precision.unmodelled(scene)
    further: dict[str, tuple[Iterable[Case], Fill]] = {
        "stiffness": (workloads.stiffness_cases(), lambda rows: None),
        "machine_time": (workloads.horizon_cases(10.0 if quick else workloads.HOUR_S), workloads.add_steps_per_hour),
        "contact_events": (workloads.event_cases(quick), workloads.add_steps_per_event),
        "features": (workloads.feature_cases(), workloads.add_ratios),
    }
    for name, (more, fill) in further.items():
        if name in chosen:
            measured = measure(list(more), repeats, notify)
            fill(measured)
            rows += measured
    if "sampled_load" in chosen:
        rows += live_rows.sampled_rows(repeats, notify)
    if "start" in chosen:
        rows += live_rows.start_rows(notify)
    if "ensemble" in chosen:
        columns, lines, steps = (3, 2, ()) if quick else (ensemble_rows.COLUMNS, ensemble_rows.ROWS, (1e-3,))
        rows += ensemble_rows.ensemble_rows(columns, lines, steps, min(repeats, 3), notify)
        if not quick:
            rows += ensemble_rows.lanes_rows(columns, lines, min(repeats, 3), notify)
    if "random_scenes" in chosen:
        rows += random_rows.random_rows(quick, notify)
    return rows


def _publish(rows: list[Row], measured: str) -> None:
    import figures
    import plot

    plot.draw(rows, PICTURE)
    (RESULTS / f"{machine_name()}.md").write_text(f"{summary.TITLE}\n\n{measured}\n", encoding="utf-8")
    figures.NEWEST.write_text(f"{machine_name()}\n", encoding="utf-8")
    subprocess.run([sys.executable, str(ROOT / "tools" / "pages.py")], check=True)


def _versions() -> dict[str, str]:
    versions = {"Python": platform.python_version()}
    for name in ("numpy", "numba", "scipy", "scikit-sundae", "mujoco", "exudyn", "heyoka"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    try:
        versions["SUNDIALS (C)"] = cvode.version()
    except NotInstalled:
        versions["SUNDIALS (C)"] = "not installed"
    return versions


if __name__ == "__main__":
    main()
