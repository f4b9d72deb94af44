"""`plow-twin view`: a recording as a rerun file."""

from __future__ import annotations

from pathlib import Path

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, progress, quiet_option


@click.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but parts of the recording are missing.")
@click.argument("recording", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="The .rrd file; by default beside the .mcap."
)
@quiet_option
def view(recording: Path, out: Path | None, quiet: bool) -> int:
    """Make a .rrd of RECORDING: the cross-section in motion, force and clearance curves, the event log."""
    from plow_twin.record.reader import FileStatus, mcap_path
    from plow_twin.view import to_rrd

    out = out or mcap_path(recording).with_suffix(".rrd")
    with progress(f"writing {out.name}", quiet) as on_progress:
        summary = to_rrd(recording, out, on_progress=on_progress)
    if summary.status is not FileStatus.COMPLETE:
        click.echo(f"plow-twin: {recording}: {summary.status.value}", err=True)
    if summary.lost:
        click.echo(f"plow-twin: {recording}: lost {dict(summary.lost)}", err=True)
    if not quiet:
        click.echo(f"{out}: {summary.curve_rows} force rows, {summary.section_rows} pictures, {summary.events} events")
        click.echo(f"look at it with: rerun {out}")
    return DONE if summary.status is FileStatus.COMPLETE and not summary.lost else DONE_WITH_LOSS
