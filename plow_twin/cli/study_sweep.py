"""The command `plow-twin study sweep`, which computes statistics of the motion over one or two parameters."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, output_console, progress, say_error
from plow_twin.cli.console import table as rich_table
from plow_twin.cli.options import FOLDER, POSITIVE, quiet_option
from plow_twin.cli.study_options import set_option, study_scene, usage_errors

if TYPE_CHECKING:
    from plow_twin.study.store import Store
    from plow_twin.study.sweep.table import Axis, Table

#: Largest number of rows of a table on the terminal. The files contain all rows.
MOST_ROWS: Final = 24
#: Width of a column of numbers, and width that is added for the first column [characters].
_COLUMN, _FIRST_COLUMN = 12, 8


@click.command(
    short_help="Sweep one or two parameters of a scene.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done, but some members failed (listed).",
)
@click.argument("scene")
@click.option("--x", "first", required=True, metavar="AXIS", help="PATH=LOW:HIGH:COUNT[:log] or PATH=VALUE,VALUE..")
@click.option("--y", "second", metavar="AXIS", help="A second parameter, in the same form.")
@click.option(
    "--statistic",
    "statistics",
    multiple=True,
    required=True,
    metavar="PATH",
    help="Statistic to compute, e.g. max.ccw.a; may be repeated.",
)
@click.option("--t-end", metavar="T", type=POSITIVE, required=True, help="Time to simulate [s].")
@click.option("--tol", type=POSITIVE, default=1e-9, show_default=True, help="Tolerance, relative to the clearance.")
@click.option("--out", type=FOLDER, required=True, help="Folder for chunks, table and picture.")
@set_option
@click.option("--workers", type=click.IntRange(1), help="Threads; all cores by default.")
@click.option("--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster to run on, e.g. tcp://host:8786.")
@click.option(
    "--chunk",
    type=click.IntRange(1),
    help="Number of members stored together; by default 16, or twice the number of cores if larger.",
)
@click.option("--resume/--fresh", default=True, show_default=True, help="Use or discard the results in the folder.")
@quiet_option
def sweep(
    scene: str,
    first: str,
    second: str | None,
    statistics: tuple[str, ...],
    t_end: float,
    tol: float,
    out: Path,
    settings: tuple[str, ...],
    workers: int | None,
    dask: str | None,
    chunk: int | None,
    resume: bool,
    quiet: bool,
) -> int:
    """Sweep one or two parameters of SCENE, a file or a preset.

    The results are written to sweep.parquet and sweep.png.
    """
    from plow_twin.scene_file import dump_scene
    from plow_twin.study.report import require
    from plow_twin.study.store import Store
    from plow_twin.study.sweep.output import draw, write_parquet
    from plow_twin.study.sweep.table import Sweep, parse_axis

    require("matplotlib", "pyarrow", *(["distributed"] if dask else []))
    with usage_errors():
        model = study_scene(scene, settings)
        axes = tuple(parse_axis(text, model) for text in (first, second) if text is not None)
        question = Sweep(dump_scene(model), axes, statistics, t_end, tol)
        store = Store(out, question, chunk or max(16, 2 * (os.cpu_count() or 1)), fresh=not resume)
    result = _computed(store, workers, dask, quiet)
    write_parquet(result, out / "sweep.parquet")
    draw(result, out / "sweep.png", f"Sweep of {scene}: {t_end:g} s each, drawn {datetime.now(UTC):%Y-%m-%d}")
    if not quiet:
        _show(result, out)
    _list_failed(result)
    if len(result.builds) > 1:
        say_error("plow-twin: warning: computed by several builds, which may round differently (see metadata)")
    return DONE_WITH_LOSS if result.failed else DONE


def _list_failed(result: Table) -> None:
    reasons: dict[str, list[str]] = {}
    for member in result.failed:
        values = ", ".join(f"{path}={_text(value)}" for path, value in result.sweep.values(member).items())
        reasons.setdefault(result.reason(member), []).append(values)
    for reason, members in reasons.items():
        say_error(f"plow-twin: {len(members)} of {result.sweep.size} members failed: {reason}")
        for values in members[:MOST_ROWS]:
            say_error(f"  {values}")
        if len(members) > MOST_ROWS:
            say_error(f"  and {len(members) - MOST_ROWS} more, which are listed in sweep.parquet")


def _computed(store: Store, workers: int | None, dask: str | None, quiet: bool) -> Table:
    from plow_twin.study.sweep.run import run_here, run_on_cluster

    size, chunks = store.sweep.size, store.chunks
    missing = sum(len(chunks[index]) for index in store.missing())
    if not quiet:
        say_error(f"{size} members, {size - missing} already stored, {missing} to compute")
    with progress("sweeping", quiet) as on_progress:

        def report(done: int) -> None:
            on_progress(done / size)

        return run_on_cluster(store, dask, report) if dask else run_here(store, workers, report)


def _show(result: Table, out: Path) -> None:
    console = output_console()
    show = _show_curve if len(result.sweep.axes) == 1 else _show_grids
    thinned = show(console, result)
    note = "; the table above does not show all rows and columns" if thinned else ""
    console.print(f"{out / 'sweep.parquet'}, {out / 'sweep.png'}{note}", highlight=False, soft_wrap=True)


def _show_curve(console: Any, result: Table) -> bool:
    (axis,) = result.sweep.axes
    rows = _thinned(len(axis.values), MOST_ROWS)
    heads = [f"{name} {_unit(name)}".strip() for name in result.sweep.statistics]
    shown = rich_table(f"{result.sweep.size} members, {result.sweep.t_end_s:g} s", axis.path, *heads)
    for row in rows:
        shown.add_row(
            _text(axis.values[row]), *(_cell(result, row, column) for column in range(result.numbers.shape[1]))
        )
    console.print(shown)
    return len(rows) < len(axis.values)


def _show_grids(console: Any, result: Table) -> bool:
    first, second = result.sweep.axes
    room = max(3, (console.width - len(first.path) - _FIRST_COLUMN) // _COLUMN)
    rows, columns = _thinned(len(first.values), MOST_ROWS), _thinned(len(second.values), room)
    for index, name in enumerate(result.sweep.statistics):
        heads = (_text(second.values[column]) for column in columns)
        unit = f" in {_unit(name)}" if _unit(name) else ""
        shown = rich_table(f"{name}{unit}, across: {second.path}", first.path, *heads)
        for row in rows:
            cells = (_cell(result, row * len(second.values) + column, index) for column in columns)
            shown.add_row(_text(first.values[row]), *cells)
        console.print(shown)
        console.print(_extremes(result, index, first, second), highlight=False, soft_wrap=True)
    return len(rows) < len(first.values) or len(columns) < len(second.values)


def _extremes(result: Table, index: int, first: Axis, second: Axis) -> str:
    import numpy as np

    numbers = result.numbers[:, index]
    if np.isnan(numbers).all():
        return "no member has a result"
    parts = []
    for word, member in (("smallest", int(np.nanargmin(numbers))), ("largest", int(np.nanargmax(numbers)))):
        values = result.sweep.values(member)
        where = f"{first.path}={_text(values[first.path])}, {second.path}={_text(values[second.path])}"
        parts.append(f"{word} {_number(numbers[member], result.sweep.statistics[index])} at {where}")
    return "; ".join(parts)


def _thinned(count: int, most: int) -> list[int]:
    import numpy as np

    places: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    return places


def _unit(name: str) -> str:
    from plow_twin.study.statistics import unit_of

    unit = unit_of(name)
    return f"k{unit}" if unit.startswith("N") else unit.replace("1", "")


def _cell(result: Table, member: int, column: int) -> str:
    if result.status[member]:
        return "failed"
    return _number(result.numbers[member, column], result.sweep.statistics[column])


def _number(value: float, name: str) -> str:
    return f"{value / 1e3:.4g}" if _unit(name).startswith("kN") else f"{value:.4g}"


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
