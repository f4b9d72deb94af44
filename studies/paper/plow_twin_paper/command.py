"""The command `plow-twin study paper`, which compares the paper's figures and numbers with this model."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, output_console, progress, say_error
from plow_twin.cli.options import POSITIVE, quiet_option

if TYPE_CHECKING:
    from plow_twin_paper.rows import Row
    from plow_twin_paper.study import PaperStudy

_STYLES = {"yes": "blue", "no": "dark_orange", "not computed": "dim"}


@click.command(
    short_help="Compute the paper's figures and numbers again.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done, but single runs failed.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out/paper"),
    show_default=True,
    help="New or empty folder for the report.",
)
@click.option("--t-end", metavar="T", type=POSITIVE, default=60.0, show_default=True, help="Length of the runs [s].")
@click.option("--workers", type=click.IntRange(min=1), help="Number of threads. The default is the number of cores.")
@click.option(
    "--scene",
    default="paper",
    show_default=True,
    help="Another scene to compare, at the clearances of the paper's Fig. 6.",
)
@click.option(
    "--recording/--no-recording", default=True, show_default=True, help="Also write the run as MCAP and .rrd."
)
@quiet_option
def paper(out: Path, t_end: float, workers: int | None, scene: str, recording: bool, quiet: bool) -> int:
    """Reproduce the paper's figures and numbers with the preset `paper`, and write a report into a folder.

    The folder gets report.html with plots and a table of published and reconstructed numbers. It also gets the table as
    JSON and CSV, the plots, and the run as MCAP recording and .rrd.
    """
    from plow_twin.scene_file import load_scene
    from plow_twin_paper.runs import LONGEST_S, SHORTEST_S
    from plow_twin_paper.study import study_paper

    if not SHORTEST_S <= t_end <= LONGEST_S:
        message = f"got {t_end:g} s, expected {SHORTEST_S:.4f} s (two periods of the load) to {LONGEST_S:g} s"
        raise click.BadParameter(message, param_hint="--t-end")
    if out.exists() and any(out.iterdir()):
        raise click.BadParameter(f"got {str(out)!r}, which is not empty, expected a new folder", param_hint="--out")
    model = load_scene(scene)
    with progress("the paper's figures (the first run compiles)", quiet) as on_progress:
        study = study_paper(model, scene, out, t_end, workers, recording, on_progress)
    if study.runs.failed:
        say_error(f"plow-twin: {study.runs.failed} run(s) failed; their rows are not computed")
    if not quiet:
        _print(study, out)
    return DONE_WITH_LOSS if study.runs.failed else DONE


def _print(study: PaperStudy, out: Path) -> None:
    from plow_twin.study.report import percent

    console = output_console()
    console.print(f"scene {study.name} beside the paper, {study.runs.t_end:g} s", style="italic", highlight=False)
    group = ""
    for row in study.rows:
        if row.group != group:
            console.print(Text(f"\n{row.group}", "bold"))
            group = row.group
        _print_row(console, row, percent(row.difference))
    console.print()
    counts = ", ".join(f"{verdict}: {number}" for verdict, number in study.verdicts.items() if number)
    console.print(f"agrees? {counts}; took {study.wall_s:.1f} s", highlight=False)
    console.print(f"report: {out / 'report.html'}", highlight=False, soft_wrap=True)
    if study.recording is not None:
        console.print(f"look at the run with: rerun {study.recording.rrd}", highlight=False, soft_wrap=True)


def _print_row(console: Console, row: Row, difference: str) -> None:
    verdict = Text(f"{row.verdict.value:13}", _STYLES[row.verdict.value])
    if row.published_value is not None:
        figures = f"{row.published:>6} {row.computed:>8} {row.unit:2} {difference:>8}"
        room = max(20, min(console.width, 120) - len(verdict) - len(figures) - 2)
        if len(row.what) <= room:
            console.print(verdict + Text(f"{row.what:{room}}  {figures}"), soft_wrap=True)
            return
        rest = [f"paper {row.published} {row.unit}, here {row.computed} {row.unit}, {difference}"]
    else:
        rest = [f"paper: {row.published}", f"here:  {row.computed}"]
    head, *more = wrap(row.what, console.width - len(verdict))
    console.print(verdict + Text(head))
    for text in more:
        console.print(Padding(Text(text), (0, 0, 0, len(verdict))))
    for text in rest:
        console.print(Padding(Text(text, "dim"), (0, 0, 0, len(verdict) + 2)))
