"""The command `plow-twin record`, which records topics of other nodes in the folder of a run."""

from __future__ import annotations

import re
from pathlib import Path

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, print_facts, say_error
from plow_twin.cli.options import FOLDER, find_ros_wheels, json_option, quiet_option, wait_option


@click.command(
    short_help="Record other topics in the folder of a run.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but messages were lost or a topic was not recorded.",
)
@click.argument("run", type=FOLDER)
@click.argument("topics", metavar="[TOPIC]...", nargs=-1)
@click.option("--all", "every", is_flag=True, help="Record all topics except hidden topics and topics of the run.")
@click.option("--exclude", metavar="REGEX", help="Topics that --all does not include.")
@wait_option("Time to wait for a run [s].")
@json_option
@quiet_option
def record(
    run: Path, topics: tuple[str, ...], every: bool, exclude: str | None, wait: float, as_json: bool, quiet: bool
) -> int:
    """Record topics to a subfolder of RUN until interrupted.

    RUN is the folder in which the twin is recording: its `record_path`, or the newest of RUN_2, RUN_3, .... If the twin
    is not recording, the folder is created, and the twin can use it later.
    """
    if not topics and not every:
        raise click.UsageError("got no topic, expected topics or --all")
    try:
        re.compile(exclude or "")
    except re.error as error:
        raise click.BadParameter(
            f"got {exclude!r}, expected a regular expression: {error}", param_hint="--exclude"
        ) from None
    find_ros_wheels()
    from plow_twin.cli.interruption import interruptible
    from plow_twin.record.reader import RunReader
    from plow_twin.record.running import running_run
    from plow_twin.record.writer import BESIDE, free_folder
    from plow_twin.ros.topic_recorder import record_topics

    with interruptible() as stopped:
        present = running_run(run, wait, stopped)
        own = {*RunReader(present).header.topics.values()} if present is not None else set()
        folder = (present or free_folder(run)) / BESIDE

        def say(folder: Path) -> None:
            if not quiet:
                say_error(f"recording to {folder} until interrupted")

        facts = record_topics(
            folder,
            topics,
            every=every,
            exclude=exclude,
            but=own,
            stopped=stopped,
            on_started=say,
            on_trouble=lambda text: say_error(f"plow-twin: {text}"),
        )
    print_facts(facts, as_json=as_json, quiet=quiet)
    for name, reason in facts["skipped_topics"].items():
        say_error(f"plow-twin: {name}: not recorded: {reason}")
    for name in facts["without_publisher"]:
        say_error(f"plow-twin: {name}: not recorded: got no publisher, expected at least one")
    return DONE if facts["complete"] else DONE_WITH_LOSS
