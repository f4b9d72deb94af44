"""Tables of the reference pages, made from the code: topics, verbs of the command, priors."""

from __future__ import annotations

from collections.abc import Callable

import click

from plow_twin.cli.app import commands
from plow_twin.estimate.priors import DEFAULTS
from plow_twin.model.scene import Mark
from plow_twin.stream.topics import TOPICS


def topics() -> str:
    """Return the topics that a twin sends."""
    lines = ["| topic | type | sent | content |", "|---|---|---|---|"]
    for topic in TOPICS:
        kind = topic.type.replace("/msg/", "/")
        sent = f"{topic.cadence.value}{', latched' * topic.latched}"
        lines.append(f"| `{topic.name}` | {kind} | {sent} | {topic.content} |")
    return "\n".join(lines)


def verbs() -> str:
    """Return the verbs of `plow-twin`."""
    lines = ["| verb | does |", "|---|---|"]
    for name, command in sorted(commands.commands.items()):
        if isinstance(command, click.Group):
            lines += [_verb(f"{name} {inner}", verb) for inner, verb in command.commands.items()]
        else:
            lines.append(_verb(name, command))
    return "\n".join(lines)


def _verb(name: str, command: click.Command) -> str:
    arguments = " ".join(part for part in command.collect_usage_pieces(click.Context(command)) if part != "[OPTIONS]")
    return f"| `{f'{name} {arguments}'.strip()}` | {command.get_short_help_str(limit=200)} |"


def priors() -> str:
    """Return the prior's standard deviations of a scene's numbers, by mark."""
    marks = (Mark.MEASURED, Mark.GIVEN, Mark.RECONSTRUCTED, Mark.ASSUMED)
    lines = ["| number | " + " | ".join(mark.value for mark in marks) + " |", "|---" * (1 + len(marks)) + "|"]
    for name, by_mark in DEFAULTS.items():
        lines.append(f"| {name} | " + " | ".join(f"{by_mark[mark]:g}" for mark in marks) + " |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[], str]] = {"topics": topics, "verbs": verbs, "priors": priors}
