"""Measure run time against error, side by side with the peers, and write the table, the picture and the page's figures.

One run: `make bench`. Everything is measured on one core unless a row says otherwise.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import cvode
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
PAGE = ROOT / "docs" / "benchmark.md"
PEERS: dict[str, Callable[[str], Iterator[Case]]] = {
    "own": work_precision.own_cases,
    "lean": work_precision.lean_cases,
    "cvode": work_precision.cvode_cases,
    "python": work_precision.python_cases,
    "multibody": work_precision.multibody_cases,
}
SECTIONS = (*PEERS, "ensemble", "stiffness", "machine_time", "contact_events", "sampled_load", "random_scenes")
_QUICK = frozenset({"own", "ensemble", "stiffness", "machine_time", "contact_events", "random_scenes"})
Notify = Callable[[str], None]


@click.command()
@click.option(
    "--quick", is_flag=True, help="Own rows only, few of them, once; for tests. Writes no picture and no page."
)
@click.option("--only", multiple=True, type=click.Choice(SECTIONS), help="Measure this part only; repeatable.")
@click.option("--repeats", default=7, show_default=True, type=click.IntRange(1), help="Rounds over all cases.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="CSV file; benchmark/results/<machine>.csv by default.",
)
def main(quick: bool, only: tuple[str, ...], repeats: int, out: Path | None) -> None:
    """Run the benchmark."""
    console = Console(stderr=True)
    chosen = set(only) or (set(_QUICK) if quick else set(SECTIONS))
    columns = SpinnerColumn(), TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=None)

        def notify(text: str) -> None:
            progress.update(task, advance=1, description=text)

        rows = _run(chosen, 1 if quick else repeats, quick, notify)
    path = out or RESULTS / f"{machine_name()}.csv"
    complete = not quick and not only
    if out is None and not complete:
        raise click.UsageError("a part is not the committed table: name a file with --out")
    write_csv(path, rows)
    if complete:
        _publish(rows)
    click.echo(str(path))


def _run(chosen: set[str], repeats: int, quick: bool, notify: Notify) -> list[Row]:
    rows = []
    for scene in NAMES:
        cases = [case for name, build in PEERS.items() if name in chosen for case in build(scene)]
        if quick:
            cases = [case for case in cases if _is_quick(case.row)]
        rows += measure(cases, repeats, notify)
        if "multibody" in chosen:
            rows += work_precision.unmodelled(scene)
    further = {
        "stiffness": workloads.stiffness_cases,
        "machine_time": lambda: workloads.horizon_cases(10.0 if quick else 3600.0),
        "contact_events": workloads.event_cases,
    }
    for name, build in further.items():
        if name in chosen:
            rows += measure(list(build()), min(repeats, 3), notify)
    if "sampled_load" in chosen:
        rows += workloads.sampled_rows(repeats, notify)
    if "ensemble" in chosen:
        rows += workloads.ensemble_rows(*((3, 2) if quick else (40, 25)), repeats=min(repeats, 3), notify=notify)
    if "random_scenes" in chosen:
        rows += workloads.random_rows(quick, notify)
    return rows


def _is_quick(row: Row) -> bool:
    settings = ("tol=0.001", "tol=1e-06", "tol=1e-09", "tol=1e-12", "dt=0.001")
    return row.solver != work_precision.OURS_BARE and row.setting in settings


def _publish(rows: list[Row]) -> None:
    """Draw the picture and replace the measured part of the page."""
    import plot

    plot.draw(rows, PICTURE)
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(summary.BEGIN)
    _, _, after = rest.partition(summary.END)
    measured = summary.text(rows, machine_name(), _versions())
    PAGE.write_text(f"{before}{summary.BEGIN}\n\n{measured}\n\n{summary.END}{after}", encoding="utf-8")


def _versions() -> dict[str, str]:
    versions = {"Python": platform.python_version()}
    for name in ("numpy", "numba", "scipy", "scikit-sundae", "mujoco", "exudyn"):
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
