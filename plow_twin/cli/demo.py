"""The command `plow-twin demo`, which runs a publisher, the node and the recorder together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from plow_twin.cli.dashboard import access_if_shown, access_options, dashboard_option
from plow_twin.cli.options import FOLDER, POSITIVE, quiet_option


@click.command(
    short_help="Run a publisher, the node and the recorder for some seconds.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done with counted loss.",
)
@click.option(
    "--speed",
    type=click.Choice(["real", "fast"]),
    default="real",
    show_default=True,
    help="Run in real time (real), or as fast as possible under /clock (fast).",
)
@click.option("--seconds", type=POSITIVE, default=20.0, show_default=True, help="Duration in the machine's time [s].")
@click.option(
    "--out",
    type=FOLDER,
    default=Path("out/demo"),
    show_default=True,
    help="Folder for the recording and the view.",
)
@dashboard_option
@access_options
@quiet_option
def demo(speed: str, seconds: float, out: Path, quiet: bool, dashboard: bool, **options: Any) -> int:
    """Run the twin under the load of the paper, which a publisher process sends to the node and its recorder."""
    from plow_twin.demo.demo import run_demo

    if access_if_shown({**options, "dashboard": dashboard}) is None:
        return run_demo(speed, seconds, out, quiet)
    token = options["token_file"]
    shown = ["--listen", options["listen"], *(("--token-file", str(token)) if token is not None else ())]
    return run_demo(speed, seconds, out, quiet, shown)
