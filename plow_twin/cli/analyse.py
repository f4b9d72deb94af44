"""The command `plow-twin analyse`, which compares recordings with the predictions of the model."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, FAILED, output_console, progress, say_error, say_lost, table
from plow_twin.cli.options import FOLDER, PLACE, POSITIVE, json_option, map_option, quiet_option, unit_option


@click.command(
    short_help="Compare recordings with the model's predictions.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.",
)
@click.argument("recordings", metavar="RUN...", type=PLACE, nargs=-1, required=True)
@click.option("--scene", help="Scene file or preset; needed for a recording of another program.")
@map_option
@unit_option
@click.option("--with", "others", multiple=True, help="A further scene for predictions; may be repeated.")
@click.option("--out", type=FOLDER, help="Folder for report.html and Parquet files.")
@click.option("--workers", type=click.IntRange(1), help="Processes for many recordings; by default one per core.")
@click.option(
    "--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster for many recordings, e.g. tcp://host:8786."
)
@click.option("--watch", type=POSITIVE, metavar="S", help="Follow a run while it is recorded, with a report every S s.")
@json_option
@quiet_option
def analyse(
    recordings: tuple[Path, ...],
    scene: str | None,
    mapping: Path | None,
    units: dict[str, str],
    others: tuple[str, ...],
    out: Path | None,
    workers: int | None,
    dask: str | None,
    watch: float | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Analyse recordings.

    RUN is a run of plow_twin, another recording (MCAP, sqlite3 of rosbag2, CSV), or a folder of recordings.
    """
    from plow_twin.study.analysis.task import Task, names_apart

    scene_file, further = Path(scene) if scene else None, tuple(map(Path, others))
    if watch is not None:
        if dask is not None or workers is not None:
            raise click.UsageError("--watch cannot be combined with --dask or --workers: it follows one run")
        if len(recordings) != 1:
            raise click.UsageError(f"--watch: got {len(recordings)} recordings, expected one")
        return _watched(Task(recordings[0], scene_file, mapping, further, out, units=units), watch, as_json, quiet)
    recordings_found, left_out_files = found_recordings(recordings, out)
    many = len(recordings_found) > 1 or recordings_found != list(recordings)
    for option, value in (("--dask", dask), ("--workers", workers)):
        if value is not None and not many:
            raise click.UsageError(f"{option}: got one recording, expected many, or a folder of recordings")
    if dask is not None and workers is not None:
        raise click.UsageError("--workers cannot be combined with --dask: a cluster has its own workers")
    folders = (
        [out / name for name in names_apart(recordings_found)]
        if out is not None and many
        else [out] * len(recordings_found)
    )
    beside = () if many else left_out_files
    tasks = [
        Task(path, scene_file, mapping, further, folder, beside, units)
        for path, folder in zip(recordings_found, folders, strict=True)
    ]
    for task in tasks:  # all tasks are checked before any task removes a file
        task.check(recordings_found)
    results = _results(tasks, many, workers, dask, quiet)
    if many and out is not None:
        from plow_twin.study.analysis.report import write_table_of_runs

        write_table_of_runs(results, out, left_out_files)
    _show(results, many, as_json, quiet, list(map(str, left_out_files)))
    if out is not None and not (as_json or quiet):
        click.echo(str(out / ("runs.parquet" if many else "report.html")))
    failed = any("error" in facts for facts in results)
    lossy = any(facts.get("lossy") for facts in results)
    return FAILED if failed else DONE_WITH_LOSS if lossy else DONE


def found_recordings(recordings: Sequence[Path], out: Path | None = None) -> tuple[list[Path], tuple[Path, ...]]:
    """Return the recordings at paths and in folders, and the items in the folders that are not recordings."""
    from plow_twin.study.analysis.recordings import counted_once, expand, left_out

    for path in recordings:
        if not path.exists():
            raise click.BadParameter(f"{path}: does not exist", param_hint="RUN...")
    # the results of an earlier analysis are not reported
    results_before = () if out is None else (out.resolve(), (out / "run").resolve())
    left = {item: path for path in recordings for item in left_out(path, results_before)}
    left = {item: path for item, path in left.items() if item.resolve() not in results_before}
    for item, path in left.items():
        say_error(f"plow-twin: {item}: left out: not a recording of {path}")
    found, repeated = counted_once(expand(recordings, results_before))
    for sentence in repeated:
        say_error(f"plow-twin: {sentence}")
    return found, tuple(left)


def _results(tasks: list[Any], many: bool, workers: int | None, dask: str | None, quiet: bool) -> list[dict[str, Any]]:
    from plow_twin.study.analysis.many import run_many

    with progress("analysing", quiet) as on_progress:
        if many:
            return run_many(tasks, workers=workers or os.cpu_count() or 1, dask=dask, on_progress=on_progress)
        return [tasks[0].stored() or tasks[0].run(on_progress)]


def _watched(task: Any, every: float, as_json: bool, quiet: bool) -> int:
    import time

    from plow_twin.cli.interruption import interruptible
    from plow_twin.record.follow import Tail
    from plow_twin.record.running import find_run
    from plow_twin.study.analysis.report import write_report

    due = time.monotonic() + every

    def show(analysis: Any, **end: bool) -> None:
        facts = {**analysis.facts(), **end}
        if task.out is not None:
            write_report(analysis, task.out)
        if as_json:
            click.echo(json.dumps(facts, allow_nan=False))
            sys.stdout.flush()
        else:
            _show([facts], False, False, quiet)

    def report(found: Any) -> None:
        nonlocal due
        begin = time.monotonic()
        if begin >= due:
            show(found)
            # the interval between reports is chosen so that the reports take at most a tenth of the time
            due = time.monotonic() + max(every, 9.0 * (time.monotonic() - begin))

    with interruptible() as stopped:
        path = find_run(task.path, max(every, 10.0), stopped)
        task.clear([path])
        found = replace(task, path=path).analyse(tail=Tail(stopped), on_caught_up=report)
        show(found, lossy=found.lossy)
    return DONE_WITH_LOSS if found.lossy else DONE


def _show_contacts(console: Console, results: Sequence[dict[str, Any]]) -> None:
    shown = table("Contacts computed", "run", "time [s]", "impacts [1/min]", "largest force [kN]", "at")
    shown.columns[0].no_wrap, shown.columns[0].overflow = False, "fold"
    for facts in results:
        loads = facts["loads"]
        largest = loads["largest_force_n"]
        place = max(largest, key=lambda pair: largest[pair])
        minutes = loads["duration_s"] / 60.0
        numbers = (
            f"{loads['duration_s']:.1f}",
            f"{sum(loads['impacts'].values()) / minutes:.1f}" if minutes else "",
            f"{largest[place] / 1e3:.2f}",
            place if largest[place] else "",
        )
        shown.add_row(facts["run"], *numbers)
    console.print(shown)
    if len(results) > 1:
        console.print("For differences beyond chance, pad by pad: plow-twin compare RUN...", highlight=False)


def _show(results: list[dict[str, Any]], many: bool, as_json: bool, quiet: bool, left_out: Sequence[str] = ()) -> None:
    for facts in results:
        if "error" in facts:
            say_error(f"plow-twin: {facts['error']}")
        elif facts["lost"]:
            say_lost(facts["run"], facts["lost"])
    if as_json:
        facts = {"runs": results, "left_out": left_out} if many else results[0]
        click.echo(json.dumps(facts, indent=2, allow_nan=False))
        return
    if quiet:
        return
    from plow_twin.study.analysis.signals import signal_unit

    console = output_console()
    good = [facts for facts in results if "error" not in facts]
    if good:
        _show_contacts(console, good)
    for facts in good:
        if "without_samples" in facts:
            text = f"{facts['run']}: {facts['without_samples']}; in these intervals the load is interpolated linearly"
            console.print(text, highlight=False, soft_wrap=True)
        if not facts["signals"]:
            text = f"{facts['run']}: no measured values to compare with the model"
            console.print(text, highlight=False, soft_wrap=True)
            continue
        shown = table(
            f"{facts['run']}: predicted minus measured", "signal", "n", "bias", "RMS", "correlation [1]", "lag [s]"
        )
        for name, signal in facts["signals"].items():
            numbers = (signal[key] for key in ("bias", "rms", "correlation", "lag_s"))
            shown.add_row(
                f"{name} [{signal_unit(name)}]",
                str(signal["n"]),
                *("" if value is None else f"{value:.4g}" for value in numbers),
            )
        console.print(shown)
        if "stretches" in facts:
            not_compared = ", ".join(f"{name} {count}" for name, count in facts["not_compared"].items()) or "none"
            intervals = f"{facts['stretches']} stretches between resets; the table shows the longest."
            console.print(f"{intervals} Not compared: {not_compared}.")
        if "outside" in facts:
            outside = ", ".join(f"{name} {count}" for name, count in facts["outside"].items())
            console.print(f"Measurements outside the time of the load, not compared: {outside}.")
