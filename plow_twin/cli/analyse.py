"""`plow-twin analyse`: what recordings show, predicted against measured."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import click

from plow_twin.cli.console import (
    DONE,
    DONE_WITH_LOSS,
    FAILED,
    json_option,
    output_console,
    progress,
    quiet_option,
    table,
)


@click.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.")
@click.argument("recordings", metavar="RUN...", type=click.Path(path_type=Path, exists=True), nargs=-1, required=True)
@click.option("--scene", help="Scene file or preset; needed for a recording that is no run of ours.")
@click.option(
    "--map",
    "mapping",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="YAML that says which topic is the excitation, the head_pose, the travel, the forces, the gaps.",
)
@click.option("--with", "others", multiple=True, help="A further scene to predict with; may be given many times.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Folder for report.html and Parquet.")
@click.option("--workers", type=click.IntRange(1), help="Processes for many recordings; by default one a core.")
@json_option
@quiet_option
def analyse(
    recordings: tuple[Path, ...],
    scene: str | None,
    mapping: Path | None,
    others: tuple[str, ...],
    out: Path | None,
    workers: int | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Analyse recordings: runs of ours, MCAP, rosbag2's sqlite3, CSV, or folders of them."""
    from plow_twin.study.analysis.analyse import expand
    from plow_twin.study.analysis.task import Task

    found = expand(recordings)
    many = len(found) > 1 or found != list(recordings)
    extra = tuple(Path(name) for name in others)
    scene_file = Path(scene) if scene else None
    tasks = [Task(path, scene_file, mapping, extra, _out(out, path, many)) for path in found]
    results = _run(tasks, workers or os.cpu_count() or 1, quiet) if many else [_alone(tasks[0], quiet)]
    if many and out is not None:
        from plow_twin.study.analysis.report import write_table_of_runs

        write_table_of_runs(results, out)
    _show(results, many, as_json, quiet)
    failed = any("error" in facts for facts in results)
    lossy = any(facts.get("lossy") for facts in results)
    return FAILED if failed else DONE_WITH_LOSS if lossy else DONE


def _out(out: Path | None, path: Path, many: bool) -> Path | None:
    return out / path.stem if out is not None and many else out


def _alone(task: Any, quiet: bool) -> dict[str, Any]:
    from plow_twin.study.analysis.analyse import analyse as run
    from plow_twin.study.analysis.report import write_report

    with progress("analysing", quiet) as on_progress:
        found = run(
            task.path,
            scene=task.scene,
            mapping=task.mapping,
            others=task.others,
            out=task.out,
            on_progress=on_progress,
        )
    if task.out is not None:
        write_report(found, task.out)
    return {**found.facts(), "lossy": found.lossy}


def _run(tasks: list[Any], workers: int, quiet: bool) -> list[dict[str, Any]]:
    """Analyse on all cores; results that are there already are taken, so that an interrupted call goes on."""
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    from plow_twin.study.analysis.task import analyse_task

    results: dict[int, dict[str, Any]] = {}
    for number, task in enumerate(tasks):
        done = None if task.out is None else task.out / "analysis.json"
        if done is not None and done.is_file():
            facts = json.loads(done.read_text(encoding="utf-8"))
            results[number] = {**facts, "lossy": bool(facts["lost"])}
    with (
        progress("analysing", quiet) as on_progress,
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
    ):
        waiting = {pool.submit(analyse_task, task): n for n, task in enumerate(tasks) if n not in results}
        for future in as_completed(waiting):
            number = waiting[future]
            try:
                results[number] = future.result()
            except Exception as error:  # a worker that was killed takes its own result alone
                results[number] = {"run": str(tasks[number].path), "error": f"worker ended: {error!r}"}
            on_progress(len(results) / len(tasks))
    return [results[number] for number in range(len(tasks))]


def _show(results: list[dict[str, Any]], many: bool, as_json: bool, quiet: bool) -> None:
    for facts in results:
        if "error" in facts:
            click.echo(f"plow-twin: {facts['error']}", err=True)
        elif facts["lost"]:
            click.echo(f"plow-twin: {facts['run']}: lost {facts['lost']}", err=True)
    if as_json:
        click.echo(json.dumps({"runs": results} if many else results[0], indent=2, allow_nan=False))
        return
    if quiet:
        return
    console = output_console()
    for facts in results:
        if "error" in facts:
            continue
        shown = table(
            f"{facts['run']}: predicted minus measured", "signal", "n", "bias", "rms", "correlation", "lag [s]"
        )
        for name, signal in facts["signals"].items():
            numbers = (signal[key] for key in ("bias", "rms", "correlation", "lag_s"))
            shown.add_row(name, str(signal["n"]), *("" if value is None else f"{value:.4g}" for value in numbers))
        console.print(shown)
