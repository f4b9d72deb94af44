"""`plow-twin view`: a recording as a rerun file, in a browser, or as a picture."""

from __future__ import annotations

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, FAILED, POSITIVE, progress, quiet_option


@click.command(epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but parts of the recording are missing.")
@click.argument("recording", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="The .rrd file; by default beside the .mcap."
)
@click.option("--exaggerate", type=POSITIVE, help="How many times as wide the clearance is drawn beside the true one.")
@click.option("--png", type=click.Path(path_type=Path, dir_okay=False), help="A picture instead; needs no viewer.")
@click.option("--web", is_flag=True, help="Serve rerun's own web viewer on this machine until interrupted.")
@click.option("--web-port", type=click.IntRange(0, 65535), default=9090, show_default=True, help="Its port.")
@quiet_option
def view(
    recording: Path, out: Path | None, exaggerate: float | None, png: Path | None, web: bool, web_port: int, quiet: bool
) -> int:
    """Make a .rrd of RECORDING: the cross-section in motion, force and clearance curves, the event log."""
    from plow_twin.record.reader import FileStatus, mcap_path

    if png is not None:
        from plow_twin.view.picture import to_png

        status = to_png(recording, png, exaggerate=exaggerate)
        if status is not FileStatus.COMPLETE:
            click.echo(f"plow-twin: {recording}: {status.value}", err=True)
        if not quiet:
            click.echo(f"{png}")
        return DONE if status is FileStatus.COMPLETE else DONE_WITH_LOSS
    from plow_twin.view import to_rrd

    out = out or mcap_path(recording).with_suffix(".rrd")
    with progress(f"writing {out.name}", quiet) as on_progress:
        summary = to_rrd(recording, out, exaggerate=exaggerate, on_progress=on_progress)
    if summary.status is not FileStatus.COMPLETE:
        click.echo(f"plow-twin: {recording}: {summary.status.value}", err=True)
    if summary.lost:
        click.echo(f"plow-twin: {recording}: lost {dict(summary.lost)}", err=True)
    if not quiet:
        click.echo(f"{out}: {summary.curve_rows} force rows, {summary.section_rows} pictures, {summary.events} events")
        click.echo(f"look at it with: rerun {out}")
    if web:
        return _serve(out, web_port, quiet)
    return DONE if summary.status is FileStatus.COMPLETE and not summary.lost else DONE_WITH_LOSS


def _serve(file: Path, port: int, quiet: bool) -> int:
    """Serve a .rrd with the viewer's own program on the loopback address until it is interrupted."""
    program = _viewer_program()
    if program is None:
        click.echo("plow-twin: the program `rerun` is not installed: pip install 'plow_twin[view]'", err=True)
        return FAILED
    command = [program, str(file), "--serve-web", "--bind", "127.0.0.1", "--port", "auto"]
    if not quiet:
        click.echo(f"serving on http://127.0.0.1:{port} until interrupted")
    sys.stdout.flush()
    # in the place of this process: whoever stops it stops the server
    os.execv(program, [*command, "--web-viewer-port", str(port)])


def _viewer_program() -> str | None:
    """Return rerun's own program, not the wrapper of the same name, which would outlive whoever stops it."""
    found = find_spec("rerun_cli")
    if found is not None and found.origin is not None:
        program = Path(found.origin).with_name("rerun")
        if program.exists():
            return str(program)
    return shutil.which("rerun")
