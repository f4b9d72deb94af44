"""The command `plow-twin call`, which calls a service of a twin that runs without ROS."""

from __future__ import annotations

from pathlib import Path

import click

from plow_twin.cli.console import DONE, FAILED, say_error
from plow_twin.cli.options import PLACE
from plow_twin.live.service_names import SERVICES, mark_problem


@click.command(
    short_help="Request a service of a running `plow-twin live`, such as reset or a mark.",
    epilog="Exit codes: 0 done, 1 refused or no answer, 2 wrong usage.",
)
@click.argument("socket", type=PLACE)
@click.argument("service", type=click.Choice(SERVICES))
@click.argument("text", required=False)
def call(socket: Path, service: str, text: str | None) -> int:
    """Call a SERVICE of the twin that was started by `plow-twin live --control SOCKET`.

    TEXT is the text of a mark.
    """
    from plow_twin.live.control import call as ask

    if text is not None and service != "mark":
        raise click.UsageError(f"{service}: got the text {text!r}, expected no text: only a mark has one")
    if text is not None and (problem := mark_problem(text)) is not None:
        raise click.UsageError(problem)
    done, answer = ask(socket, service, text)
    if not done:
        say_error(f"plow-twin: {service}: {answer}")
        return FAILED
    click.echo(answer)
    return DONE
