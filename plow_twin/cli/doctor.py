"""The command `plow-twin doctor`, which reports the content and losses of a recording, and repairs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, print_facts
from plow_twin.cli.options import EXISTING, json_option


@click.command(
    short_help="Report the content and losses of a recording, and repair it.",
    epilog="Exit codes: 0 complete, 1 failed or no recording, 2 wrong usage, 3 incomplete.",
)
@click.argument("recording", type=EXISTING)
@click.option("--repair", is_flag=True, help="Rewrite truncated and damaged files; the old files are renamed.")
@json_option
def doctor(recording: Path, repair: bool, as_json: bool) -> int:
    """Report the content and losses of RECORDING. With --repair, truncated and damaged files are rewritten."""
    from plow_twin.record.doctor import examine
    from plow_twin.record.doctor import repair as make_whole

    before = examine(recording)
    rewritten = make_whole(recording) if repair else []
    report = examine(recording) if repair else before
    facts = {**report.facts(), "repaired": [path.name for path in rewritten]}
    if rewritten:
        facts["problems_before"] = before.problems
    print_facts(facts if as_json else _shown(facts), as_json=as_json)
    return DONE_WITH_LOSS if before.problems else DONE


def _shown(facts: dict[str, Any]) -> dict[str, Any]:
    parts = {part["file"]: {key: value for key, value in part.items() if key != "file"} for part in facts["parts"]}
    problems: dict[str, Any] = {
        key: dict(enumerate(facts[key], 1)) if facts[key] else None
        for key in ("problems", "problems_before")
        if key in facts
    }
    return {**facts, **problems, "parts": parts}
