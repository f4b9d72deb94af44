"""The command `plow-twin dashboard`, which shows a node or a recording on a page in the browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from plow_twin.cli.console import DONE, say_error
from plow_twin.cli.options import FILE, PLACE, combined, find_ros_wheels, node_options, wait_option

if TYPE_CHECKING:
    from plow_twin.dashboard.access import PageAccess
    from plow_twin.dashboard.screen import Screen


access_options = combined(
    click.option(
        "--listen",
        metavar="HOST:PORT",
        default="127.0.0.1:8070",
        show_default=True,
        help="Address of the page; other machines need a token. With port 0, a free port is chosen.",
    ),
    click.option(
        "--token-file",
        type=FILE,
        help="File whose first line is the token of the page; by default PLOW_TWIN_DASHBOARD_TOKEN.",
    ),
)
dashboard_option = click.option("--dashboard", is_flag=True, help="Show the run on a page in the browser.")


def access_of(options: dict[str, Any]) -> PageAccess:
    """Return the address and the token of the page. Raise `DashboardError` if they cannot be used."""
    from plow_twin.dashboard.access import PageAccess, listening

    access = PageAccess.of(options["listen"], options["token_file"])
    listening(access).close()
    return access


def access_if_shown(options: dict[str, Any]) -> PageAccess | None:
    """Return the result of `access_of`, or None without `--dashboard`.

    Raise an error if `--listen` or `--token-file` is given without `--dashboard`.
    """
    if options["dashboard"]:
        return access_of(options)
    context = click.get_current_context()
    for name in ("listen", "token_file"):
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--{name.replace('_', '-')}: expected it only with --dashboard")
    return None


def say_where(screen: Screen, access: PageAccess) -> None:
    """Print the address of the page."""
    say_error(f"screen: {screen.url}" + ("#token=... (the token file contains the rest)" if access.token else ""))


def stay(screen: Screen, stopped: Callable[[], bool]) -> None:
    """Serve the page until a stop is requested or the server ends."""
    say_error("the input has ended; the page is served until Ctrl-C")
    while not (stopped() or screen.has_ended):
        screen.feed.turn()
        time.sleep(0.2)


@click.command(
    short_help="Show a node or a recording on a page in the browser.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage.",
)
@click.argument("run", type=PLACE, required=False)
@click.option("--ros", is_flag=True, help="Show a node through its topics.")
@node_options
@wait_option("Time to wait for the node or recording [s].")
@access_options
def dashboard(
    run: Path | None, ros: bool, namespace: str, name: str, scene: str | None, wait: float, **options: Any
) -> int:
    """Show a recording or a node (--ros) on a page until interrupted.

    RUN is the recording, which may still be written.
    """
    if ros == (run is not None):
        raise click.UsageError("expected a recording or --ros")
    if scene is not None and not ros:
        raise click.UsageError("--scene: expected it only with --ros, because a recording contains its scene")
    from plow_twin.cli.interruption import interruptible

    access = access_of(options)
    with interruptible() as stopped:
        if run is None:
            find_ros_wheels()
            from plow_twin.dashboard.node import show_node

            show_node(namespace, name, scene, access, wait, stopped, lambda screen: say_where(screen, access))
        else:
            from plow_twin.dashboard.run import show_run
            from plow_twin.record.running import find_run

            folder = run if run.exists() else find_run(run, wait, stopped)
            show_run(folder, access, stopped, lambda screen: say_where(screen, access))
    return DONE
