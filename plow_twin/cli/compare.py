"""The command `plow-twin compare`, which compares the runs of one machine by run, day or shift."""

from __future__ import annotations

import json
import os
from datetime import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, output_console, progress, say_error, say_lost, table
from plow_twin.cli.options import FOLDER, PLACE, POSITIVE, json_option, quiet_option

if TYPE_CHECKING:
    from plow_twin.study.comparison.change import Change
    from plow_twin.study.comparison.compare import Comparison


@click.command(
    short_help="Compare the contacts of runs, and find whether the load or the machine changed.",
    epilog="Exit codes: 0 done; 1 failed; 2 wrong usage; 3 done, but a run was left out or has losses.",
)
@click.argument("recordings", metavar="RUN...", type=PLACE, nargs=-1, required=True)
@click.option(
    "--by", type=click.Choice(["run", "day", "shift"]), default="run", show_default=True, help="Kind of the groups."
)
@click.option("--shifts", default="06:00,14:00,22:00", show_default=True, help="Times at which shifts begin.")
@click.option("--zone", default="UTC", show_default=True, help="Time zone of days and shifts, e.g. Europe/Berlin.")
@click.option("--window", type=POSITIVE, metavar="S", help="Length of a window [s]; by default the load's period.")
@click.option("--out", type=FOLDER, help="Folder for compare.html and Parquet files.")
@click.option("--workers", type=click.IntRange(1), help="Processes; by default one per core.")
@click.option("--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster, e.g. tcp://host:8786.")
@json_option
@quiet_option
def compare(
    recordings: tuple[Path, ...],
    by: str,
    shifts: str,
    zone: str,
    window: float | None,
    out: Path | None,
    workers: int | None,
    dask: str | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Compare runs, or folders of runs, with the first run.

    The compared quantities are peaks, impacts, contact, impulse, dissipation and wear.
    """
    from plow_twin.cli.analyse import found_recordings
    from plow_twin.study.analysis.many import run_many
    from plow_twin.study.analysis.task import names_apart
    from plow_twin.study.comparison.change import FEWEST
    from plow_twin.study.comparison.compare import WindowsTask
    from plow_twin.study.comparison.compare import compare as compared

    label = _label(by, shifts, zone)
    recordings_found, _ = found_recordings(recordings)
    tasks = [WindowsTask(path, window) for path in recordings_found]
    with progress("reading", quiet or as_json) as on_progress:
        results = run_many(tasks, workers=workers or os.cpu_count() or 1, dask=dask, on_progress=on_progress)
    failed = [result["error"] for result in results if "error" in result]
    for error in failed:
        say_error(f"plow-twin: left out: {error}")
    names = names_apart(recordings_found)
    runs = [(name, result["windows"]) for name, result in zip(names, results, strict=True) if "error" not in result]
    lost = {result["run"]: result["lost"] for result in results if result.get("lost")}
    for run, counts in lost.items():
        say_lost(run, counts)
    scenes = {name: result["scene"] for name, result in zip(names, results, strict=True) if "error" not in result}
    comparison = compared(runs, label, scenes=scenes)
    for note in comparison.notes:
        say_error(f"plow-twin: {note}")
    for name, windows in comparison.groups.items():
        if len(windows.start_ns) < FEWEST:
            say_error(
                f"plow-twin: {name}: got {len(windows.start_ns)} windows, expected at least {FEWEST}: too few to "
                "separate a change from chance; a shorter --window gives more"
            )
    if out is not None:
        from plow_twin.study.comparison.report import write_comparison

        write_comparison(comparison, lost, out)
    if as_json:
        click.echo(json.dumps({**comparison.facts(), "lost": lost, "left_out": failed}, indent=2, allow_nan=False))
    elif not quiet:
        _show(comparison)
        if out is not None:
            click.echo(str(out / "compare.html"))
    return DONE_WITH_LOSS if failed or lost else DONE


def _label(by: str, shifts: str, zone: str) -> Any:
    from zoneinfo import ZoneInfo

    from plow_twin.study.comparison.compare import by_run, by_time

    if by == "run":
        return by_run
    try:
        begins = [time.fromisoformat(text.strip()) for text in shifts.split(",")]
    except ValueError as error:
        raise click.BadParameter(
            f"got {shifts!r}, expected times like 06:00,14:00,22:00", param_hint="--shifts"
        ) from error
    try:
        return by_time(by, begins, ZoneInfo(zone))
    except (OSError, ValueError, KeyError) as error:
        raise click.BadParameter(f"got {zone!r}, expected a zone like Europe/Berlin", param_hint="--zone") from error


def _show(comparison: Comparison) -> None:
    console = output_console()
    groups = table("Groups", "group", "windows", "load, RMS [kN]", "horizontal [mm]", "vertical [mm]")
    for name, windows in comparison.groups.items():
        clearance = 1e3 * windows.clearance.mean(axis=0)
        numbers = (1e-3 * windows.load[:, 0].mean(), *clearance)
        groups.add_row(name, str(len(windows.start_ns)), *(f"{number:.3f}" for number in numbers))
    console.print(groups)
    first = next(iter(comparison.groups))
    for name, by_pair in comparison.changes.items():
        names = {"dissipation": "energy", "in_contact": "in contact"}
        quantities = [names.get(quantity, quantity) for quantity in next(iter(by_pair.values()))]
        view = table(f"{name} compared with {first}: change of the means [%]", "pad", *quantities)
        appeared = comparison.appeared(name)
        for pair, by_quantity in by_pair.items():
            cells = ("new" if key in appeared[pair] else _text(change) for key, change in by_quantity.items())
            view.add_row(pair, *cells)
        console.print(view)
        if comparison.equal(name):
            console.print(f"{name} equals {first}: all means are the same", highlight=False)
        changes = (f"{axis} {_text(change)}" for axis, change in comparison.clearance_changes[name].items())
        console.print(f"clearance [%]: {', '.join(changes)}", highlight=False)
    console.print(_KEY, highlight=False)


#: Sign of each cause of a change in a table.
_SIGNS: Final = {"chance": "", "machine": "M", "load": "L", "load or machine": "?"}
_KEY: Final = (
    "M: the machine changed; L: the load changed; ?: the machine or the load changed; no letter: the change may be "
    "random. All numbers of a table are tested together, so that one letter in twenty is random. new: zero in the "
    "first group only; -: zero in both groups, or too few windows. Contact is the share of samples with force."
)


def _text(change: Change | None) -> str:
    if change is None:
        return "-"
    percent = round(100.0 * change.share, 1) + 0.0
    number = f"{percent:+.1f}" if abs(percent) < 100.0 else f"{min(percent, 99999.0):+.0f}"
    return f"{number}{_SIGNS[change.verdict]}"
