"""`plow-twin view`: a recording as a rerun file."""

from __future__ import annotations

from pathlib import Path

import click

from plow_twin.cli.console import DONE, busy, quiet_option


@click.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong usage.")
@click.argument("recording", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="The .rrd file; beside RECORDING by default."
)
@quiet_option
def view(recording: Path, out: Path | None, quiet: bool) -> int:
    """Make a .rrd of RECORDING: the cross-section in motion, force and clearance curves, the event log."""
    from plow_twin.view import to_rrd

    out = out or recording.with_suffix(".rrd")
    with busy(f"writing {out}", quiet):
        to_rrd(recording, out)
    if not quiet:
        click.echo(f"{out}\nlook at it with: rerun {out}")
    return DONE
