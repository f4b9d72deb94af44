"""The command `plow-twin view`, which shows a recording as a rerun file, in a browser, or as a picture."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, busy, progress, say_end, say_error, say_lost
from plow_twin.cli.options import NEW_FILE, PLACE, POSITIVE, map_option, quiet_option, unit_option, wait_option

if TYPE_CHECKING:
    from plow_twin.model.scene import Scene
    from plow_twin.record.reader import FileStatus
    from plow_twin.view.rrd import ViewSummary


#: Largest factor by which a drawing enlarges the clearance.
_MOST_EXAGGERATED = 1e4


@click.command(
    short_help="Draw a recording for rerun, or as a picture.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but parts of the recording are missing.",
)
@click.argument("recording", type=PLACE)
@click.option("--out", type=NEW_FILE, help="The .rrd file; by default in the folder of the .mcap file.")
@click.option("--exaggerate", type=POSITIVE, help="Factor by which a second cross-section enlarges the clearance.")
@click.option(
    "--with",
    "others",
    multiple=True,
    metavar="SCENE",
    help="A further scene, whose forces under the load of the run are drawn, too; may be repeated.",
)
@click.option("--scene", help="Scene file or preset for a recording of another program.")
@map_option
@unit_option
@click.option("--png", type=NEW_FILE, help="Write a picture instead, which needs no viewer.")
@click.option(
    "--html",
    type=NEW_FILE,
    help="Write a page with picture, curves and tables instead, which needs neither viewer nor network.",
)
@click.option("--web", is_flag=True, help="Serve the web viewer of rerun on this machine until interrupted.")
@click.option(
    "--web-port",
    type=click.IntRange(0, 65535),
    default=9090,
    show_default=True,
    help="Port of the web viewer; with 0, a free port is chosen.",
)
@click.option("--follow", is_flag=True, help="Show a run while it is recorded: in a window, with --web, or into --out.")
@wait_option("Time that --follow waits for a run [s].")
@quiet_option
def view(
    recording: Path,
    out: Path | None,
    exaggerate: float | None,
    others: tuple[str, ...],
    scene: str | None,
    mapping: Path | None,
    units: dict[str, str],
    png: Path | None,
    html: Path | None,
    web: bool,
    web_port: int,
    follow: bool,
    wait: float,
    quiet: bool,
) -> int:
    """Write a .rrd file of RECORDING with the moving cross-section, curves of forces and clearances, and events.

    For a recording of another program (--scene, --map), the motion is computed by the model, as in `plow-twin analyse`.
    """
    from plow_twin.record.reader import mcap_path

    foreign = scene is not None or mapping is not None or bool(units)
    if foreign and follow:
        raise click.UsageError("--follow cannot be combined with --scene, --map or --unit: it needs a run of plow_twin")
    if not follow and not recording.exists():
        raise click.BadParameter(f"{recording}: does not exist", param_hint="RECORDING")
    if exaggerate is not None and exaggerate > _MOST_EXAGGERATED:
        raise click.BadParameter(
            f"got {exaggerate:g}, expected at most {_MOST_EXAGGERATED:g}", param_hint="--exaggerate"
        )
    if png is not None and html is not None:
        raise click.UsageError("--png cannot be combined with --html: the page contains the picture")
    for option, file in (("--png", png), ("--html", html)):
        if file is not None:
            _check_still(option, moving=out is not None or web or follow, exaggerate=exaggerate, others=others)
    if follow and out is not None and web:
        raise click.UsageError("--follow: got --out and --web, expected at most one of them")
    if follow:
        return _follow(recording, out, exaggerate, _scenes(others), web_port if web else None, wait, quiet)
    with ExitStack() as opened:
        run, lossy = recording, False
        if foreign:
            run, lossy = opened.enter_context(_made_run(recording, scene, mapping, units, quiet))
        if png is not None or html is not None:
            lossy |= _print_losses(recording, *_still(run, png, html))
            if not quiet:
                click.echo(f"{png or html}")
            return DONE_WITH_LOSS if lossy else DONE
        from plow_twin.view import to_rrd

        out = out or (recording.with_suffix(".rrd") if foreign else mcap_path(recording).with_suffix(".rrd"))
        with progress(f"writing {out.name}", quiet) as on_progress:
            summary = to_rrd(run, out, exaggerate=exaggerate, others=_scenes(others), on_progress=on_progress)
    code = _show(recording, out, summary, quiet)
    if web:
        return _serve(out, web_port)
    if not quiet:
        click.echo(f"show it with: rerun {out}")
    return DONE_WITH_LOSS if lossy else code


def _check_still(option: str, *, moving: bool, exaggerate: float | None, others: tuple[str, ...]) -> None:
    if moving:
        raise click.UsageError(f"{option} cannot be combined with --out, --web or --follow: it shows a whole run")
    if exaggerate is not None:
        raise click.UsageError(f"--exaggerate cannot be combined with {option}: a picture shows the gaps as numbers")
    if others:
        raise click.UsageError(f"--with cannot be combined with {option}: a picture shows only the run")


def _still(run: Path, png: Path | None, html: Path | None) -> tuple[FileStatus, dict[str, int], int]:
    if png is not None:
        from plow_twin.view.picture import to_png

        return to_png(run, png)
    from plow_twin.study.run_page import write_run_page

    assert html is not None
    return write_run_page(run, html)


@contextmanager
def _made_run(
    recording: Path, scene: str | None, mapping: Path | None, units: dict[str, str], quiet: bool
) -> Iterator[tuple[Path, bool]]:
    """Yield a run computed from a recording of another program, and whether a part of the recording was not used."""
    from tempfile import TemporaryDirectory

    from plow_twin.study.analysis.analyse import analyse

    with TemporaryDirectory() as folder:
        place = Path(folder) / recording.resolve().name
        with busy("computing", quiet):
            analysis = analyse(recording, scene=Path(scene) if scene else None, mapping=mapping, units=units, out=place)
        if analysis.kind != "other":
            raise click.UsageError("--scene, --map, --unit: got a run of plow_twin, expected another recording")
        if analysis.lost:
            say_lost(recording, analysis.lost)
        yield place / "run", analysis.lossy


def _scenes(files: tuple[str, ...]) -> dict[str, Scene]:
    from plow_twin.scene_file import load_scene

    stems = [Path(file).stem for file in files]
    names = [stem if stems.count(stem) == 1 else file for stem, file in zip(stems, files, strict=True)]
    return {name: load_scene(file) for name, file in zip(names, files, strict=True)}


def _show(recording: Path, out: object, summary: ViewSummary, quiet: bool) -> int:
    lossy = _print_losses(recording, summary.status, summary.lost, summary.failed)
    if not quiet:
        thinned = "" if summary.curve_rows == summary.rows else f" of {summary.rows} read"
        click.echo(
            f"{out}: {summary.curve_rows} force rows{thinned}, {summary.section_rows} pictures, {summary.events} events"
        )
    return DONE_WITH_LOSS if lossy else DONE


def _print_losses(recording: Path, status: FileStatus, lost: Mapping[str, int], failed: int) -> bool:
    from plow_twin.record.reader import FileStatus

    whole = status in (FileStatus.COMPLETE, FileStatus.UNREAD)
    say_end(recording, status.value)
    say_lost(recording, lost)
    if failed:
        say_error(f"plow-twin: {recording}: {failed} advances failed: their samples have no forces")
    return not whole or bool(lost or failed)


def _serve(file: Path, port: int) -> int:
    from plow_twin.view.viewer import LOOPBACK, free_port, page_address, page_port, viewer_program

    program, data_port = viewer_program(), free_port()
    port = page_port(port)
    command = [program, str(file), "--serve-web", "--bind", LOOPBACK, "--port", str(data_port)]
    click.echo(f"serving until interrupted: {page_address(port, data_port)}")
    sys.stdout.flush()
    # The program replaces this process, to receive its signals. The address in its log, which is off, would select the
    # light theme.
    os.execve(program, [*command, "--web-viewer-port", str(port)], {"RUST_LOG": "error", **os.environ})


def _follow(
    recording: Path,
    out: Path | None,
    exaggerate: float | None,
    others: dict[str, Scene],
    web_port: int | None,
    wait: float,
    quiet: bool,
) -> int:
    """Show a run while it is recorded. A viewer that the command has started ends with the command."""
    from plow_twin.cli.interruption import interruptible
    from plow_twin.record.running import find_run
    from plow_twin.view.live import follow
    from plow_twin.view.rrd_file import RrdFile
    from plow_twin.view.viewer import start_viewer

    with ExitStack() as opened:
        viewer = None if out is not None else start_viewer(web_port=web_port)
        if viewer is not None:
            opened.callback(viewer.close)
        stopped = opened.enter_context(interruptible(viewer.close if viewer is not None else lambda: None))
        run = find_run(recording, wait, stopped)
        if not quiet:
            click.echo(f"following {run}" + (f" on {viewer.page}" if viewer is not None and viewer.page else ""))
            sys.stdout.flush()
        show = partial(follow, run, exaggerate=exaggerate, others=others)
        if viewer is not None:
            summary = show(viewer.attach, stopped)
        elif out is not None:
            with RrdFile(out) as file:
                summary = show(file.attach, lambda: stopped() or file.failed)
        code = _show(run, out or run, summary, quiet)
        sys.stdout.flush()
        # after the end of the run, the viewer stays open until the user closes it
        while viewer is not None and viewer.process.poll() is None and not stopped():
            time.sleep(0.2)
    return code
